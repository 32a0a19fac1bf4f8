"""One table of a run as one GeoParquet file: the rows of the tiles in sequence, few in memory at a time."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import RunError
from pipeline.export.geoparquet import geo_metadata, shape_names, stored_schema

ROWS_PER_GROUP = 5_000
"""Rows in one row group: a reader with a window skips the groups whose `bbox` is elsewhere."""


def merge_tables(path: Path, table_name: str, tiles: Iterable[tuple[str, Path]], geo: Mapping[str, Any]) -> None:
    """Write one GeoParquet file from the tiles' files; `tile` becomes an ordinary column.

    Parameters
    ----------
    path : Path
        The file to write.
    table_name : str
        buildings, planes or rejected.
    tiles : iterable of tuple
        Key and file of each tile.
    geo : mapping
        The `geo` metadata, of `united_metadata`.

    Raises
    ------
    RunError
        A file is missing or damaged.
    """
    plain = stored_schema(table_name).append(pa.field("tile", pa.string(), nullable=False))
    schema = plain.with_metadata({"geo": json.dumps(geo, sort_keys=True, separators=(",", ":"))})
    waiting = schema.empty_table()
    with pq.ParquetWriter(path, schema, compression="zstd", write_statistics=True) as writer:
        for tile, source in tiles:
            table = _read(source)
            named = table.append_column(schema.field("tile"), pa.array([tile] * table.num_rows, pa.string()))
            waiting = pa.concat_tables([waiting, named.select(schema.names).cast(schema)])
            whole = waiting.num_rows // ROWS_PER_GROUP * ROWS_PER_GROUP
            if whole:
                writer.write_table(waiting.slice(0, whole), row_group_size=ROWS_PER_GROUP)
                # a copy: a slice would keep the whole table in memory
                waiting = waiting.slice(whole).combine_chunks()
        if waiting.num_rows:
            writer.write_table(waiting, row_group_size=ROWS_PER_GROUP)


def _read(path: Path) -> pa.Table:
    """The rows of one tile's file."""
    try:
        with pq.ParquetFile(path) as file:
            return file.read()
    except (pa.ArrowInvalid, OSError) as error:
        raise RunError(f"{path} cannot be read as Parquet: {error}") from error


def united_metadata(table_name: str, sources: Iterable[Path], projjson: Mapping[str, Any] | None) -> dict[str, Any]:
    """The `geo` metadata of several files as one: all geometry types, and the bounds of all.

    Parameters
    ----------
    table_name : str
        buildings, planes or rejected.
    sources : iterable of Path
        The tiles' files.
    projjson : mapping or None
        The CRS of a table without tiles; None if it is unknown.

    Raises
    ------
    RunError
        A file is missing or damaged, or the files are of several CRS.
    """
    found = []
    for path in sources:
        try:
            found.append(json.loads(pq.read_metadata(path).metadata[b"geo"]))
        except (pa.ArrowInvalid, OSError, KeyError, TypeError) as error:
            raise RunError(f"{path} cannot be read as GeoParquet: {error}") from error
    if not found:
        no_geometry = np.empty(0, dtype=object)
        return geo_metadata(no_geometry, projjson, dict.fromkeys(shape_names(table_name), no_geometry))
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
