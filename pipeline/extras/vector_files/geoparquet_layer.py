"""GeoParquet as input: what its `geo` metadata say of a geometry column, and the column as WKB.

Read are versions 1.0 and 1.1 (https://geoparquet.org/releases/v1.1.0/) with WKB, and 1.1's own encodings of polygons.
A missing `crs` means OGC:CRS84, longitude and latitude; `null` means unknown.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.errors import UnreadableInputError
from pipeline.extras.vector_files.nearby import BATCH, POLYGONS, Boxes, Nearby, Shape, VectorLayer, cells_limit
from pipeline.extras.vector_files.vector_text import Texts
from pipeline.io.library_faults import in_our_words, shortened
from pipeline.io.reading import moved

if TYPE_CHECKING:
    import pyarrow as pa

DEFAULT_CRS = "OGC:CRS84"
"""What a geometry column without `crs` is in."""
DEPTHS = {"polygon": 2, "multipolygon": 3}
"""Levels of lists above the coordinates, by the encodings of polygons beside WKB."""

DECODED_LIMIT = 10_000_000_000
"""Maximum number of values, rows times columns, that are decoded to find those near the points. A few bytes of Parquet
can promise as many as they like; the buildings of a continent have fewer."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GeometryColumn:
    """What a file says of its geometries."""

    name: str
    """Name of the column."""
    crs: str | None
    """As a code or PROJJSON; None where the file says that it is unknown."""
    encoding: str
    """`WKB`, or one of `DEPTHS`; others are not read."""
    wanted: list[str]
    """This column and those of attributes: all but other geometries and what only covers one."""
    types: tuple[str, ...] = ()
    """Types of the geometries, as the file states them; empty where they are unknown."""


def geometry_column(path: Path, schema: pa.Schema, column: str | None = None) -> GeometryColumn:
    """The facts about a geometry column in a file's schema; None for the primary one.

    Raises UnreadableInputError if the schema says nothing of geometry, or the column is not there.
    """
    geo = _geo_of(path, schema.metadata or {})
    columns = geo["columns"]
    name = geo["primary_column"] if column is None else column
    if name not in columns or schema.names.count(name) != 1:
        raise UnreadableInputError(
            str(path), f"geometry column {name!r} is not there", f"Name one of {', '.join(columns) or '(none)'}"
        )
    idle = set(columns) | _covering(columns)
    crs, types = columns[name].get("crs", DEFAULT_CRS), columns[name].get("geometry_types")
    return GeometryColumn(
        name=name,
        crs=crs if crs is None or isinstance(crs, str) else json.dumps(crs),
        encoding=str(columns[name].get("encoding")),
        types=tuple(map(str, types)) if isinstance(types, list) else (),
        wanted=[field for field in schema.names if field == name or field not in idle],
    )


def read_geoparquet(path: Path, column: str | None, boxes: Boxes | None = None, shape: Shape = POLYGONS) -> VectorLayer:
    """The layer of a file: all its columns but other geometries and what only covers one, as plain Python values.

    Features are wanted in `boxes`, as in `vector_layer.read_layer`. Their ids are their rows in the file.
    Raises UnreadableInputError if the file is not Parquet, has no geometry, encodes it in a way that is not supported,
    or has too many rows or values.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with in_our_words(path, "Parquet", "Write it again"), pq.ParquetFile(path) as file:
        about = geometry_column(path, file.schema_arrow, column)
        _check_size(path, "values, rows times columns", file.metadata.num_rows * len(about.wanted), DECODED_LIMIT)
        nearby = Nearby(boxes, about.crs, shape)
        rows, batches, geometries = [np.empty(0, np.int64)], [], [np.empty(0, object)]
        first, cells = 0, 0
        for batch in file.iter_batches(BATCH, columns=about.wanted):
            moved()
            wkb = _wkb_of(path, batch.column(batch.schema.names.index(about.name)), about.encoding)
            near = nearby.of(wkb)
            rows.append(first + np.flatnonzero(near))
            geometries.append(wkb[near])
            # a filter copies: of what is passed over nothing is held
            batches.append(batch if near.all() else batch.filter(pa.array(near)))
            first += len(near)
            cells += len(rows[-1]) * len(about.wanted)
            _check_size(path, "values near the points, rows times columns", cells, cells_limit(path.stat().st_size))
        table = pa.Table.from_batches(batches) if batches else file.read_row_groups([], columns=about.wanted)
        numbers, texts = np.concatenate(rows), Texts()
        attributes: dict[str, Sequence[Any]] = {}
        for field, values in zip(table.column_names, table.columns, strict=True):
            if field != about.name and field not in attributes:  # of two columns of one name the first
                attributes[field] = _values(values, field, numbers, texts)
    return VectorLayer.of(
        np.concatenate(geometries),
        feature_ids=numbers,
        columns=attributes,
        elsewhere=nearby.elsewhere,
        warnings=texts.warnings,
    )


def _check_size(path: Path, what: str, count: int, limit: int) -> None:
    """Refuse more values than are read."""
    if count > limit:
        raise UnreadableInputError(
            str(path),
            f"it has {count} {what}: more than {limit}",
            "Cut out the area of the points, or leave out columns",
        )


def _values(column: pa.ChunkedArray, name: str, rows: npt.NDArray[np.int64], texts: Texts) -> list[Any]:
    """A column as Python values; None for those that Python cannot hold, such as years beyond 9999."""
    import pyarrow as pa

    # an unknown time zone is a KeyError where pytz is installed
    not_held = (pa.ArrowException, ValueError, OverflowError, KeyError)

    def value(scalar: pa.Scalar) -> Any:
        try:
            return scalar.as_py()
        except not_held:
            return None

    try:
        return list(column.to_pylist())
    except not_held:
        if pa.types.is_dictionary(column.type):
            column = column.cast(column.type.value_type)
        if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
            return [value(scalar) for scalar in column]
        where = f"the text in column {shortened(name)!r} of row"
        return [
            None if raw is None else texts.of_bytes(raw, f"{where} {row}")
            for raw, row in zip(column.cast(pa.large_binary()).to_pylist(), rows.tolist(), strict=True)
        ]


def _geo_of(path: Path, metadata: Mapping[bytes, bytes]) -> dict[str, Any]:
    """The `geo` entry of the file's metadata."""
    fix = "Write it as GeoParquet, as GDAL, DuckDB or geopandas do"
    if b"geo" not in metadata:
        raise UnreadableInputError(str(path), "this Parquet file has no `geo` metadata: it says of no geometry", fix)
    try:
        geo = json.loads(metadata[b"geo"])
        sane = isinstance(geo["primary_column"], str) and all(isinstance(c, dict) for c in geo["columns"].values())
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        sane = False
    if not sane:
        raise UnreadableInputError(str(path), "its `geo` metadata name no geometry column", fix)
    return dict(geo)


def _covering(columns: Mapping[str, Mapping[str, Any]]) -> set[str]:
    """Columns that only hold the geometries' bounds."""
    found = set()
    for about in columns.values():
        covering = about.get("covering")
        box = covering.get("bbox") if isinstance(covering, dict) else None
        places = box.values() if isinstance(box, dict) else ()
        found |= {place[0] for place in places if isinstance(place, list) and place and isinstance(place[0], str)}
    return found


def _wkb_of(path: Path, column: pa.Array, encoding: str) -> npt.NDArray[np.object_]:
    """A geometry column as WKB."""
    import pyarrow as pa

    if isinstance(column, pa.ExtensionArray):
        column = column.storage
    if encoding == "WKB":
        if not (pa.types.is_binary(column.type) or pa.types.is_large_binary(column.type)):
            raise UnreadableInputError(str(path), f"its WKB column is of type {column.type}", "Write it as bytes")
        found: npt.NDArray[np.object_] = np.array([*column.to_pylist(), None], dtype=object)[:-1]
        return found
    if encoding not in DEPTHS:
        raise UnreadableInputError(
            str(path),
            f"its geometries are encoded as {encoding!r}",
            f"Write them as WKB; {' and '.join(DEPTHS)} are read, too",
        )
    return _native(path, column, encoding)


def _native(path: Path, column: pa.Array, encoding: str) -> npt.NDArray[np.object_]:
    """Polygons of nested lists of coordinates."""
    import pyarrow as pa
    import pyarrow.compute as pc

    missing = np.asarray(column.is_null())
    offsets = []
    for _ in range(DEPTHS[encoding]):
        if not (pa.types.is_list(column.type) or pa.types.is_large_list(column.type)):
            raise UnreadableInputError(str(path), f"its {encoding} column is not of nested lists", "Write it as WKB")
        lengths = np.asarray(pc.fill_null(pc.list_value_length(column), 0), dtype=np.int64)
        offsets.append(np.concatenate(([0], np.cumsum(lengths))))
        column = column.flatten()
    if not pa.types.is_struct(column.type) or not {"x", "y"} <= {field.name for field in column.type}:
        raise UnreadableInputError(str(path), f"its {encoding} coordinates have no x and y", "Write it as WKB")
    xy = np.column_stack([np.asarray(column.field(axis), dtype=np.float64) for axis in "xy"])
    kind = shapely.GeometryType.POLYGON if encoding == "polygon" else shapely.GeometryType.MULTIPOLYGON
    geometries = shapely.from_ragged_array(kind, xy, tuple(reversed(offsets)))
    wkb: npt.NDArray[np.object_] = np.asarray(shapely.to_wkb(geometries), dtype=object)
    wkb[missing] = None
    return wkb
