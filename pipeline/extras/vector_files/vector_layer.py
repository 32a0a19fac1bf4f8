"""One layer of a vector file, unchanged: GeoParquet, or a format that GDAL reads.

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
from pipeline.extras.vector_files.gdal_layer import read_by_gdal
from pipeline.extras.vector_files.nearby import POLYGONS, Boxes, Shape
from pipeline.extras.vector_files.vector_archive import unpacked
from pipeline.extras.vector_files.wkb import geometries_of
from pipeline.io.formats import first_bytes
from pipeline.io.locations import is_url, shown
from pipeline.io.places import on_this_machine

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
    bounds_elsewhere: tuple[float, ...] | None = None
    """xmin, ymin, xmax, ymax of these in the layer's CRS; None where there are none."""
    warnings: tuple[str, ...] = ()
    """What is odd but usable, one sentence each."""


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
        raise UnreadableInputError(
            label, "a Shapefile is several files", "Give a GeoPackage or a zip archive, or fetch its files first"
        )
    with on_this_machine(path) as file:
        inner = file
        try:
            with unpacked(file, layer, shape) as (inner, name):
                return _read(inner, name, boxes, shape)
        except InputError as fault:
            raise fault.of(label, str(inner)) from fault


def _read(path: Path, layer: str | None, boxes: Boxes | None, shape: Shape) -> VectorLayer:
    """The layer of a file of this machine."""
    if first_bytes(path).startswith(PARQUET_MAGIC):
        from pipeline.extras.vector_files.geoparquet_layer import read_geoparquet

        found = read_geoparquet(path, layer, boxes, shape)
    else:
        found = read_by_gdal(path, layer, boxes, shape)
    geometries = geometries_of(found.wkb)
    there = np.array([data is not None for data in found.wkb], np.bool_)
    return VectorLayer(
        crs=found.crs,
        feature_ids=found.feature_ids,
        geometries=geometries,
        unreadable=there & shapely.is_missing(geometries),
        columns=found.columns,
        elsewhere=found.elsewhere,
        bounds_elsewhere=found.bounds_elsewhere,
        warnings=found.warnings,
    )
