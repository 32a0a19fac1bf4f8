"""A table beside a run, written tile by tile: GeoParquet with its assumptions in the metadata."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.export.columns import Column, schema_of
from pipeline.export.geoparquet import BBOX, bbox_column, geo_metadata

SUFFIX = ".parquet"
"""Ending of the file."""


def with_bbox(columns: Iterable[Column]) -> pa.Schema:
    """The schema of a file with some columns; `bbox` follows them."""
    return schema_of(columns).append(pa.field("bbox", BBOX))


@dataclasses.dataclass(frozen=True)
class ResultTable:
    """A kind of such a table."""

    columns: tuple[Column, ...]
    """The columns in their order, without `bbox`."""
    facts_key: str
    """The key of the file's metadata that holds the facts, as JSON."""


class ResultFile:
    """A file that is being written, one row group or more per tile. The same rows give the same bytes.

    Parameters
    ----------
    table : ResultTable
        What it holds.
    path : Path
        The file, which no one else reads yet.
    projjson : mapping or None
        CRS of the geometries; None if unknown.
    facts : mapping
        Assumptions and facts about the run, as plain JSON values.
    """

    def __init__(
        self, table: ResultTable, path: Path, projjson: Mapping[str, Any] | None, facts: Mapping[str, Any]
    ) -> None:
        self._table, self._projjson, self._facts = table, projjson, facts
        self._schema = with_bbox(table.columns)
        self._writer = pq.ParquetWriter(path, self._schema, compression="zstd", store_schema=False)
        self._geo: dict[str, Any] | None = None
        self.rows = 0

    def write(self, columns: Mapping[str, Sequence[Any]], faces: Any) -> None:
        """Add the rows of a tile: all `columns` except `bbox`, and their geometries as shapes, (n,)."""
        arrays = [_array(columns[column.name], column.kind) for column in self._table.columns]
        self._writer.write_table(pa.Table.from_arrays([*arrays, bbox_column(faces)], schema=self._schema))
        self._geo = _united(self._geo, geo_metadata(faces, self._projjson))
        self.rows += len(faces)

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the file, with what is known only at the end: bounds and types of all geometries."""
        if kind is None:
            geo = self._geo or geo_metadata(np.zeros(0, object), self._projjson)
            for key, value in (("geo", geo), (self._table.facts_key, self._facts)):
                self._writer.add_key_value_metadata({key: json.dumps(value, sort_keys=True, separators=(",", ":"))})
        self._writer.close()


def _array(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """Values as an Arrow array of a type; nan becomes null."""
    if pa.types.is_list(kind):
        missing = np.isnan(np.asarray(values)).any(axis=1)
        return pa.array([None if gone else row for gone, row in zip(missing, values, strict=True)], kind)
    return pa.array(values, kind, from_pandas=True)


def _united(first: dict[str, Any] | None, second: dict[str, Any]) -> dict[str, Any]:
    """The metadata of the geometries of two tiles together."""
    if first is None:
        return second
    a, b = first["columns"]["geometry"], second["columns"]["geometry"]
    a["geometry_types"] = sorted({*a["geometry_types"], *b["geometry_types"]})
    if "bbox" in a and "bbox" in b:
        half = len(a["bbox"]) // 2
        low, high = np.minimum(a["bbox"], b["bbox"])[:half], np.maximum(a["bbox"], b["bbox"])[half:]
        a["bbox"] = [*low.tolist(), *high.tolist()]
    elif "bbox" in b:
        a["bbox"] = b["bbox"]
    return first
