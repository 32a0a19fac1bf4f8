"""One table of a run as one GeoParquet file: the rows of the tiles in sequence, few in memory at a time."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import RunError
from pipeline.export.geoparquet import geo_metadata, shape_names, stored_schema

ROWS_PER_GROUP = 5_000
"""Rows in one row group: a reader with a window skips the groups whose `bbox` is elsewhere."""


class MergedTable:
    """Writes one GeoParquet file from the tiles' files; `tile` becomes an ordinary column.

    Parameters
    ----------
    path : Path
        The file to write.
    table_name : str
        buildings, planes or rejected.
    sources : sequence of Path
        The tiles' files, whose `geo` metadata are united.
    projjson : mapping or None
        The CRS of a table without tiles; None if it is unknown.
    """

    def __init__(
        self, path: Path, table_name: str, sources: Sequence[Path], projjson: Mapping[str, Any] | None
    ) -> None:
        no_geometry = np.empty(0, dtype=object)
        nothing = geo_metadata(no_geometry, projjson, dict.fromkeys(shape_names(table_name), no_geometry))
        geo = united_metadata(_metadata(source) for source in sources) if sources else nothing
        plain = stored_schema(table_name).append(pa.field("tile", pa.string(), nullable=False))
        self._schema = plain.with_metadata({"geo": json.dumps(geo, sort_keys=True, separators=(",", ":"))})
        self._writer = pq.ParquetWriter(path, self._schema, compression="zstd", write_statistics=True)
        self._waiting: list[pa.Table] = []
        self._rows = 0

    def add(self, tile: str, table: pa.Table) -> None:
        """Append the rows of one tile."""
        named = table.append_column(self._schema.field("tile"), pa.array([tile] * table.num_rows, pa.string()))
        self._waiting.append(named.select(self._schema.names).cast(self._schema))
        self._rows += table.num_rows
        if self._rows >= ROWS_PER_GROUP:
            self._write(whole_groups=True)

    def _write(self, *, whole_groups: bool) -> None:
        """Write the waiting rows, in whole row groups or all of them."""
        united = pa.concat_tables(self._waiting) if self._waiting else self._schema.empty_table()
        count = united.num_rows // ROWS_PER_GROUP * ROWS_PER_GROUP if whole_groups else united.num_rows
        if count:
            self._writer.write_table(united.slice(0, count).combine_chunks(), row_group_size=ROWS_PER_GROUP)
        # a copy: a slice would keep the whole table in memory
        rest = united.slice(count).combine_chunks()
        self._waiting, self._rows = ([rest] if rest.num_rows else []), rest.num_rows

    def __enter__(self) -> Self:
        """Open for writing."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write the last rows and the footer."""
        if kind is None:
            self._write(whole_groups=False)
        self._writer.close()


def read_tile(path: Path) -> pa.Table:
    """The rows of one tile's file.

    Raises
    ------
    RunError
        The file is missing or damaged.
    """
    try:
        with pq.ParquetFile(path) as file:
            return file.read()
    except (pa.ArrowInvalid, OSError) as error:
        raise RunError(f"{path} cannot be read as Parquet: {error}") from error


def _metadata(path: Path) -> dict[str, Any]:
    """The `geo` metadata of one file."""
    try:
        geo: dict[str, Any] = json.loads(pq.read_metadata(path).metadata[b"geo"])
    except (pa.ArrowInvalid, OSError, KeyError, TypeError) as error:
        raise RunError(f"{path} cannot be read as GeoParquet: {error}") from error
    return geo


def united_metadata(parts: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """The `geo` metadata of several files as one: all geometry types, and the bounds of all.

    Parameters
    ----------
    parts : iterable of dict
        Made by `pipeline.export.geoparquet.geo_metadata`, of one CRS; at least one.

    Raises
    ------
    RunError
        There is none, or the files are of several CRS.
    """
    found = list(parts)
    if not found:
        raise RunError("a merged table needs at least one tile")
    if any(part["columns"]["geometry"]["crs"] != found[0]["columns"]["geometry"]["crs"] for part in found):
        raise RunError("the tiles have more than one CRS: files of two runs lie in one directory")
    names = dict.fromkeys(name for part in found for name in part["columns"])
    columns_of = {name: [part["columns"][name] for part in found if name in part["columns"]] for name in names}
    return {**found[0], "columns": {name: _united_column(columns) for name, columns in columns_of.items()}}


def _united_column(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The metadata of one column of geometry in several files."""
    types = {kind for part in parts for kind in part["geometry_types"]}
    bounds = [part["bbox"] for part in parts if "bbox" in part]
    column = {**parts[0], "geometry_types": sorted(types)}
    column.pop("bbox", None)
    if bounds:
        column["bbox"] = _united_bounds(bounds)
    return column


def _united_bounds(bounds: Sequence[Sequence[float]]) -> list[float]:
    """The union of several bounds; 2D if one of them is 2D.

    >>> _united_bounds([[0.0, 0.0, 1.0, 2.0, 2.0, 3.0], [-1.0, 1.0, 0.0, 1.0, 5.0, 9.0]])
    [-1.0, 0.0, 0.0, 2.0, 5.0, 9.0]
    """
    flat = any(len(box) == 4 for box in bounds)
    axes = 2 if flat else 3
    low = [min(box[axis] for box in bounds) for axis in range(axes)]
    high = [max(box[len(box) // 2 + axis] for box in bounds) for axis in range(axes)]
    return [*low, *high]
