"""The results of a comparison as files: `changes.parquet` (GeoParquet) and `changes.geojson`, written part by part."""

from __future__ import annotations

import contextlib
import datetime as dt
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import shapely

from pipeline.errors import RunError
from pipeline.export.geoparquet import ROWS_A_GROUP, geo_metadata, stored_schema
from pipeline.io.crs import SpatialReference
from pipeline.io.storage import LocalStorage
from pipeline.ruler.epochs.change_records import SCHEMA, Change

PARQUET, GEOJSON, JSON = "changes.parquet", "changes.geojson", "changes.json"
"""The files."""
GeoJson = Literal["changed", "all", "none"]
"""Which rows `changes.geojson` holds."""
DEGREE_DIGITS = 8
"""Decimals of longitudes and latitudes: a millimetre."""

_BBOX = stored_schema("buildings").field("bbox")

TakeIn = Callable[[pa.Table], None]


@contextlib.contextmanager
def parquet_sink(storage: LocalStorage, reference: SpatialReference) -> Iterator[TakeIn]:
    """A function that appends rows to `changes.parquet`, which appears when the block ends."""
    geo: dict[str, Any] = geo_metadata(np.empty(0, object), reference.projjson)
    column = geo["columns"]["geometry"]
    with _writing(storage, PARQUET) as path:
        schema = SCHEMA.append(_BBOX)
        # Without the copy of the schema by Arrow: it would hide the metadata that are known only at the end.
        with pq.ParquetWriter(path, schema, compression="zstd", store_schema=False) as writer:

            def take_in(table: pa.Table) -> None:
                geometries = shapely.from_wkb(np.array(table["geometry"].to_pylist(), dtype=object))
                added = geo_metadata(geometries, None)["columns"]["geometry"]
                column["geometry_types"] = sorted({*column["geometry_types"], *added["geometry_types"]})
                if "bbox" in added:
                    column["bbox"] = _around(column.get("bbox"), added["bbox"])
                writer.write_table(table.append_column(_BBOX, _bbox(geometries)), row_group_size=ROWS_A_GROUP)

            yield take_in
            writer.add_key_value_metadata({"geo": json.dumps(geo, sort_keys=True, separators=(",", ":"))})


@contextlib.contextmanager
def geojson_sink(storage: LocalStorage, reference: SpatialReference, rows: GeoJson) -> Iterator[TakeIn]:
    """A function that appends rows to `changes.geojson`: longitude and latitude of WGS 84, as in RFC 7946.

    Raises ValueError if the CRS is unknown, or has no place on Earth.
    """
    moved = _to_degrees(reference)
    with _writing(storage, GEOJSON) as path, path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write('{"type":"FeatureCollection","features":[')
        separators = itertools.chain(["\n"], itertools.repeat(",\n"))

        def take_in(table: pa.Table) -> None:
            if rows == "changed":
                table = table.filter(pc.not_equal(table["change"], Change.UNCHANGED.value))
            geometries = shapely.from_wkb(np.array(table["geometry"].to_pylist(), dtype=object))
            turned = shapely.orient_polygons(shapely.transform(geometries, moved))
            texts = shapely.to_geojson(turned)
            for row, text in zip(table.drop_columns("geometry").to_pylist(), texts, strict=True):
                stream.write(next(separators) + _feature(row, text))

        yield take_in
        stream.write("\n]}\n")


def _feature(row: Mapping[str, Any], geometry: str | None) -> str:
    identity = json.dumps(row["change_id"])
    properties = json.dumps(row, separators=(",", ":"), ensure_ascii=False, allow_nan=False, default=_text)
    return f'{{"type":"Feature","id":{identity},"geometry":{geometry or "null"},"properties":{properties}}}'


def _text(value: Any) -> str:
    if isinstance(value, dt.datetime):
        return value.isoformat()
    raise TypeError(f"{type(value).__name__} is no JSON value")


def _to_degrees(reference: SpatialReference) -> Callable[[Any], Any]:
    transformer = reference.to_degrees
    if transformer is None:
        raise ValueError("the CRS is unknown, or has no place on Earth")

    def moved(xy: Any) -> Any:
        return np.round(np.column_stack(transformer.transform(xy[:, 0], xy[:, 1])), DEGREE_DIGITS)

    return moved


@contextlib.contextmanager
def _writing(storage: LocalStorage, key: str) -> Iterator[Path]:
    """A temporary path that replaces the file at the end; errors of the disk become a RunError."""
    try:
        with storage.putting(key) as path:
            yield path
    except OSError as error:
        raise RunError(f"{storage.path(key)} cannot be written: {error}. Free space, or give another --out") from error


def _bbox(geometries: Any) -> pa.StructArray:
    """The covering column."""
    missing = shapely.is_missing(geometries)
    bounds = shapely.bounds(geometries).reshape(-1, 4)
    return pa.StructArray.from_arrays(
        [pa.array(np.where(missing, 0.0, bounds[:, i])) for i in range(4)],
        fields=list(_BBOX.type),
        mask=pa.array(missing, pa.bool_()),
    )


def _around(held: list[float] | None, more: list[float]) -> list[float]:
    if held is None:
        return more
    return [*map(min, held[:2], more[:2]), *map(max, held[2:], more[2:])]
