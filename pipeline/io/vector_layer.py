"""One layer of a vector file, unchanged: GeoPackage, GeoJSON, Shapefile or GeoParquet.

Of a file that covers a country, only what lies near the data is kept: its geometries go by in batches, and the columns
of the others are never read (GDAL), or let go batch by batch (GeoParquet).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.errors import InputError, UnreadableInputError
from pipeline.io.formats import first_bytes
from pipeline.io.nearby import BATCH, POLYGONS, Boxes, Nearby, Shape
from pipeline.io.remote_file import on_this_machine
from pipeline.io.urls import is_url, shown

VALID = (
    "Valid are GeoPackage (.gpkg), GeoJSON (.geojson, .json), Shapefile (.shp with .shx and .dbf) "
    "and GeoParquet (.parquet)"
)
DRIVERS = {b"SQLi": "GPKG:", b"\0\0\x27\x0a": ""}
"""The format that GDAL gets, by a file's first bytes; text in braces is GeoJSON. Left to itself GDAL goes by content,
and there are formats that name other files and servers to read. Shapefiles have no such prefix and no such twins."""
PARQUET_MAGIC = b"PAR1"


@dataclasses.dataclass(frozen=True, kw_only=True)
class VectorLayer:
    """The features of a layer. All arrays have one length n."""

    crs: str | None
    """As the file has it: a code, WKT or PROJJSON; None where it is unknown."""
    feature_ids: npt.NDArray[np.int64]
    """(n,) int64, the file's own numbers of the features."""
    geometries: npt.NDArray[np.object_]
    """(n,) shapely geometries; None where there is none, or where it cannot be read."""
    unreadable: npt.NDArray[np.bool_]
    """(n,) bool, True where there is a geometry that cannot be read."""
    columns: Mapping[str, Sequence[Any]]
    """All columns but the geometry, by name."""
    elsewhere: int = 0
    """Features of the wanted shape that were passed over, since they lie off the boxes."""


def read_layer(path: str | Path, layer: str | None, boxes: Boxes | None = None, shape: Shape = POLYGONS) -> VectorLayer:
    """The one layer of a file that can hold polygons, or features of another shape, or the named one.

    Raises UnreadableInputError if the file cannot be read as vector data, or the layer is not there.

    Parameters
    ----------
    path : str or Path
        The file, or its URL: then it is fetched for as long as it is read. Its first bytes show its format.
    layer : str, optional
        The layer; of GeoParquet the geometry column.
    boxes : callable, optional
        Where features are wanted; those whose bounds meet none of its boxes are passed over. None reads all.
    shape : Shape
        What the features are.
    """
    label = shown(str(path))
    if is_url(path) and label.lower().endswith(".shp"):
        raise UnreadableInputError(label, "a Shapefile is several files", "Give a GeoPackage, or fetch its files first")
    with on_this_machine(path) as file:
        try:
            return _read(file, layer, boxes, shape)
        except InputError as fault:
            raise fault.of(label, str(file)) from fault


def _read(path: Path, layer: str | None, boxes: Boxes | None, shape: Shape) -> VectorLayer:
    """The layer of a file of this machine."""
    head = first_bytes(path)
    if head.startswith(PARQUET_MAGIC):
        from pipeline.io.geoparquet import read_geoparquet

        crs, feature_ids, geometry_bytes, columns, elsewhere = read_geoparquet(path, layer, boxes, shape)
    else:
        crs, feature_ids, geometry_bytes, columns, elsewhere = _by_gdal(
            path, _driver_of(path, head), layer, boxes, shape
        )
    geometries: npt.NDArray[np.object_] = np.asarray(shapely.from_wkb(geometry_bytes, on_invalid="ignore"), object)
    there = np.array([data is not None for data in geometry_bytes], np.bool_)
    return VectorLayer(
        crs=crs,
        feature_ids=feature_ids,
        geometries=geometries,
        unreadable=there & shapely.is_missing(geometries),
        columns=columns,
        elsewhere=elsewhere,
    )


def _driver_of(path: Path, head: bytes) -> str:
    """The path as GDAL is given it: with the one format that it may be."""
    where = path.resolve().as_posix()
    if head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        return f"GeoJSON:{where}"
    driver = next((name for magic, name in DRIVERS.items() if head.startswith(magic)), None)
    if driver is None:
        raise UnreadableInputError(str(path), f"cannot be read as vector data: it begins with {head[:8]!r}", VALID)
    return f"{driver}{where}"


def _by_gdal(
    path: Path, source: str, layer: str | None, boxes: Boxes | None, shape: Shape
) -> tuple[str | None, npt.NDArray[np.int64], npt.NDArray[np.object_], dict[str, Sequence[Any]], int]:
    """CRS, feature ids, WKB and columns of a layer, and how many of its polygons were passed over."""
    import pyogrio
    from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError, GeometryError

    try:
        layers = {str(name): kind for name, kind in pyogrio.list_layers(source)}
        if layer is None:
            # The kind is None for tables without geometry and "Unknown" where a layer does not say.
            found = [name for name, kind in layers.items() if kind and (shape.word in kind or "Unknown" in kind)]
            found = found or [name for name, kind in layers.items() if kind]
        else:
            found = [name for name in layers if name == layer]
        if len(found) != 1:
            raise UnreadableInputError(
                str(path),
                f"layer {layer!r} is not there" if layer else f"{len(found)} layers could be the {shape.named}",
                f"Name one of the layers {', '.join(sorted(layers)) or '(there are none)'}",
            )
        near, elsewhere = (None, 0) if boxes is None else _near(source, found[0], boxes, shape)
        none = near is not None and len(near) == 0
        meta, feature_ids, geometry_bytes, columns = pyogrio.raw.read(
            source,
            layer=found[0],
            return_fids=True,
            fids=None if none else near,
            max_features=1 if none else None,  # without any feature GDAL gives no columns
        )
    except (DataSourceError, DataLayerError, FeatureError, FieldError, GeometryError, OSError) as fault:
        raise UnreadableInputError(str(path), f"cannot be read as vector data ({str(fault)[:160]})", VALID) from fault
    kept = slice(0, 0) if none else slice(None)
    named = {str(field): column[kept] for field, column in zip(meta["fields"], columns, strict=True)}
    return meta["crs"], feature_ids[kept].astype(np.int64), geometry_bytes[kept], named, elsewhere


def _near(source: str, layer: str, boxes: Boxes, shape: Shape) -> tuple[npt.NDArray[np.int64] | None, int]:
    """The ids of the features near the boxes, None where all are; and how many polygons are not."""
    import pyogrio

    with pyogrio.raw.open_arrow(
        source, layer=layer, columns=[], batch_size=BATCH, return_fids=True, use_pyarrow=True
    ) as (meta, reader):
        nearby = Nearby(boxes(meta["crs"]), shape)
        if nearby.all:
            return None, 0
        geometry = meta["geometry_name"] or "wkb_geometry"
        number = next(name for name in reader.schema.names if name != geometry)
        kept = [np.empty(0, np.int64)]
        passed_over = 0
        for batch in reader:
            near = nearby.of(np.array([*batch.column(geometry).to_pylist(), None], dtype=object)[:-1])
            kept.append(np.asarray(batch.column(number), dtype=np.int64)[near])
            passed_over += int(np.count_nonzero(~near))
    return (np.concatenate(kept) if passed_over else None), nearby.elsewhere
