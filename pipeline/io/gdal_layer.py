"""One layer of a GeoPackage, GeoJSON or Shapefile, read by GDAL."""

from __future__ import annotations

import contextlib
import json
import mmap
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from pipeline.errors import UnreadableInputError
from pipeline.io.formats import first_bytes
from pipeline.io.library_faults import in_our_words
from pipeline.io.nearby import BATCH, Boxes, Nearby, Shape, cells_limit
from pipeline.io.reading import moved
from pipeline.io.vector_text import BYTES, Texts, without_controls
from pipeline.io.wkb import EncodedLayer

VALID = (
    "Valid are GeoPackage (.gpkg), GeoJSON (.geojson, .json), Shapefile (.shp with .shx and .dbf) "
    "and GeoParquet (.parquet)"
)
DRIVERS = {b"SQLi": "GPKG:", b"\0\0\x27\x0a": ""}
"""The format that GDAL gets, by a file's first bytes; text in braces is GeoJSON. Left to itself GDAL goes by content,
and there are formats that name other files and servers to read. Shapefiles have no such prefix and no such twins."""
GEOJSON = "GeoJSON:"

_Batch: TypeAlias = tuple[npt.NDArray[np.int64], npt.NDArray[np.object_]]
"""Feature ids and WKB of some features."""

_WHAT = "vector data"
_CRS = re.compile(rb'"(?:c|\\u00[46]3)(?:r|\\u00[57]2)(?:s|\\u00[57]3)"\s*:\s*(?=\{)', re.IGNORECASE)
"""A member `crs` of GeoJSON, its letters escaped or not; GDAL takes small and capital ones."""
_CRS_BYTES = 4096
"""Maximum length of such a member that is an object."""
_FETCHED = frozenset({"link", "url"})
"""Types of a CRS that GDAL would fetch from a server."""
_NAME_IT = 'Name the CRS: "crs": { "type": "name", "properties": { "name": "EPSG:28992" } }'


def read_by_gdal(path: Path, layer: str | None, boxes: Boxes | None, shape: Shape) -> EncodedLayer:
    """The layer, as `pipeline.io.vector_layer.read_layer` describes it.

    Raises UnreadableInputError if the file cannot be read, has not the layer, has too many values near the
    boxes, or names a server that knows its CRS.
    """
    import pyogrio

    source = _source_of(path)
    about = None
    with in_our_words(path, _WHAT, VALID):
        if source.startswith(GEOJSON):  # it has one layer, and is parsed at each look
            about = pyogrio.read_info(source, encoding=BYTES, force_feature_count=True)
            layers = {str(about["layer_name"]): about["geometry_type"]}
        else:
            layers = {str(name): kind for name, kind in pyogrio.list_layers(source)}
    name = _chosen(path, layers, layer, shape)
    near, elsewhere = (None, 0) if boxes is None else _near(path, source, name, boxes, shape)
    with in_our_words(path, _WHAT, VALID):
        about = about or pyogrio.read_info(source, layer=name, encoding=BYTES, force_feature_count=near is None)
        _check_cells(path, about["features"] if near is None else len(near), len(about["fields"]))
        meta, feature_ids, wkb, columns, is_decoded = _read(source, name, near)
    none = near is not None and len(near) == 0
    kept = slice(0, 0) if none else slice(None)
    feature_ids = feature_ids[kept].astype(np.int64)
    texts = Texts()
    named: dict[str, Sequence[Any]] = {}
    for field, column in zip(meta["fields"], columns, strict=True):
        if is_decoded:
            title = without_controls(str(field))
        else:
            raw = str(field).encode(BYTES)
            title = texts.of_bytes(raw, f"the name of column {raw!r}")
        values: Any = column[kept]
        if is_decoded and values.dtype == object:
            values = [without_controls(value) for value in values]
        elif values.dtype == object:
            rows = feature_ids.tolist()
            values = [texts.of_value(value, title, row) for value, row in zip(values, rows, strict=True)]
        named[title] = values
    return EncodedLayer(meta["crs"], feature_ids, wkb[kept], named, elsewhere, texts.warnings)


def _source_of(path: Path) -> str:
    """The path as GDAL is given it: with the one format that it may be."""
    where = path.resolve().as_posix()
    head = first_bytes(path)
    if head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        refuse_links(path)
        return f"{GEOJSON}{where}"
    driver = next((name for magic, name in DRIVERS.items() if head.startswith(magic)), None)
    if driver is None:
        raise UnreadableInputError(str(path), f"cannot be read as {_WHAT}: it begins with {head[:8]!r}", VALID)
    return f"{driver}{where}"


def refuse_links(path: Path) -> None:
    """Refuse GeoJSON that names its CRS by a link: GDAL would fetch it from whatever server that is.

    Raises UnreadableInputError.
    """
    with path.open("rb") as stream:
        content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    for found in _CRS.finditer(content):
        text = content[found.end() : found.end() + _CRS_BYTES].decode(errors="replace")
        kinds = _kinds_of(text)
        if kinds is None:
            raise UnreadableInputError(
                str(path), f"its member crs is not an object of JSON within {_CRS_BYTES} bytes: {text[:40]!r}", _NAME_IT
            )
        if not _FETCHED.isdisjoint(kinds):
            raise UnreadableInputError(
                str(path), f"its member crs is a link, which is not followed: {text[:80]!r}", _NAME_IT
            )


def _kinds_of(text: str) -> set[str] | None:
    """The values of all members `type` of the object that a text begins with; None if it begins with none."""
    kinds: set[str] = set()

    def collect(pairs: list[tuple[str, Any]]) -> None:
        kinds.update(str(value).strip().lower() for key, value in pairs if key.lower() == "type")

    try:
        json.JSONDecoder(object_pairs_hook=collect, parse_int=float).raw_decode(text)
    except (ValueError, RecursionError):
        return None
    return kinds


def _chosen(path: Path, layers: dict[str, str | None], layer: str | None, shape: Shape) -> str:
    """The one layer that is wanted."""
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
    return found[0]


def _check_cells(path: Path, features: int, columns: int) -> None:
    """Refuse a layer with so many values that holding the empty ones is too much."""
    limit = cells_limit(path.stat().st_size)
    if features * columns > limit:
        raise UnreadableInputError(
            str(path),
            f"it has {features} features with {columns} columns each: more than {limit} values for its size",
            "Leave out columns, or cut out the area of the points",
        )


def _read(
    source: str, layer: str, near: npt.NDArray[np.int64] | None
) -> tuple[dict[str, Any], npt.NDArray[np.int64], npt.NDArray[np.object_], list[npt.NDArray[Any]], bool]:
    """Facts, feature ids, WKB and columns of a layer, and whether its text is decoded or one character per byte."""
    import pyogrio

    none = near is not None and len(near) == 0
    options = {
        "layer": layer,
        "return_fids": True,
        "fids": None if none else near,
        "max_features": 1 if none else None,  # without any feature GDAL gives no columns
    }
    if source.startswith(tuple(filter(None, (*DRIVERS.values(), GEOJSON)))):
        return *pyogrio.raw.read(source, encoding=BYTES, **options), False
    try:
        # A Shapefile may declare its encoding, by a .cpg file or in the .dbf. GDAL follows it.
        found = pyogrio.raw.read(source, **options)
        return *found, found[0]["encoding"] != BYTES
    except UnicodeDecodeError:  # it declares UTF-8 and is not
        return *pyogrio.raw.read(source, encoding=BYTES, **options), False


def _near(path: Path, source: str, layer: str, boxes: Boxes, shape: Shape) -> tuple[npt.NDArray[np.int64] | None, int]:
    """The ids of the features near the boxes, None where all are; and how many polygons are not."""
    kept = [np.empty(0, np.int64)]
    passed_over = 0
    with in_our_words(path, _WHAT, VALID), _opened(source, layer) as (crs, batches):
        nearby = Nearby(boxes(crs), shape)
        if nearby.all:
            return None, 0
        for feature_ids, wkb in batches:
            near = nearby.of(wkb)
            kept.append(feature_ids[near])
            passed_over += int(np.count_nonzero(~near))
    return (np.concatenate(kept) if passed_over else None), nearby.elsewhere


@contextlib.contextmanager
def _opened(source: str, layer: str) -> Iterator[tuple[str | None, Iterator[_Batch]]]:
    """CRS of a layer, and its ids and WKB in batches."""
    import pyogrio

    with contextlib.ExitStack() as stack:
        try:
            meta, reader = stack.enter_context(
                pyogrio.raw.open_arrow(
                    source, layer=layer, columns=[], batch_size=BATCH, return_fids=True, use_pyarrow=True
                )
            )
        except UnicodeDecodeError:  # a column's name; only this way takes an encoding
            meta, ids, wkb, _ = pyogrio.raw.read(source, layer=layer, columns=[], return_fids=True, encoding=BYTES)
            yield meta["crs"], iter([(ids.astype(np.int64), wkb)])
            return
        yield meta["crs"], _batches(meta["geometry_name"] or "wkb_geometry", reader)


def _batches(geometry: str, reader: Any) -> Iterator[_Batch]:
    """Ids and WKB of the batches of an Arrow reader."""
    number = next(name for name in reader.schema.names if name != geometry)
    for batch in reader:
        moved()
        wkb = np.array([*batch.column(geometry).to_pylist(), None], dtype=object)[:-1]
        yield np.asarray(batch.column(number), dtype=np.int64), wkb
