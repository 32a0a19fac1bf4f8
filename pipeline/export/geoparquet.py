"""GeoParquet 1.1: the tables of a run directory, written and read.

Geometries are ISO WKB with planar edges and counter-clockwise exterior rings; an unknown coordinate reference system is
written as `crs: null`, since a missing key would mean WGS 84. A `bbox` column covers the geometries, so a reader can
skip row groups. In `buildings` the footprint is the primary geometry; the solids are further ones.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.fs as pafs
import pyarrow.parquet as pq
import shapely

from pipeline.errors import RunError
from pipeline.export.decisions import DECISIONS
from pipeline.export.decisions import NAME as DECISIONS_NAME
from pipeline.export.record_rows import KEYS, SCHEMAS
from pipeline.export.solid_geometry import SOLIDS, WALL_OUTLINE

if TYPE_CHECKING:
    import pyarrow.dataset as pads

VERSION = "1.1.0"
"""Version of GeoParquet."""
ROWS_A_GROUP = 20_000
"""Rows in one row group."""

BBOX = pa.struct([pa.field(name, pa.float64(), nullable=False) for name in ("xmin", "ymin", "xmax", "ymax")])
"""The type of the column `bbox`."""
_DIMENSION_SUFFIX = {2: "", 3: " Z"}


def stored_schema(table_name: str) -> pa.Schema:
    """The schema of a table's files: the record's columns, then `bbox`; `decisions` has no geometry and no `bbox`."""
    if table_name == DECISIONS_NAME:
        return DECISIONS
    return SCHEMAS[table_name].append(pa.field("bbox", BBOX))


def shape_names(table_name: str) -> tuple[str, ...]:
    """The columns of geometry of a table beside the primary one: faces of solids, a MultiPolygon Z each, and walls."""
    return tuple(name for name in (*SOLIDS, WALL_OUTLINE) if name in SCHEMAS[table_name].names)


def geo_metadata(
    geometries: Any, projjson: Mapping[str, Any] | None, shapes: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The `geo` entry of the file metadata. Null geometries are left out of types and bounds; an unknown CRS is None.

    `shapes` are the geometries of the columns of solids and of walls by their names. Rings of solids run outward round
    the solid, not counter-clockwise in plan, so no orientation is stated. The footprint is the outline of the solids,
    so the `bbox` column covers both. Coarser solids and walls are listed if there are any; rows may lack them, so
    `bbox` does not cover them.
    """
    column = _column_metadata(geometries, projjson)
    column["orientation"] = "counterclockwise"
    columns = {"geometry": column}
    for name, faces in (shapes or {}).items():
        metadata = _column_metadata(faces, projjson)
        if name == SOLIDS[0]:
            columns[name] = metadata
        elif not shapely.is_missing(faces).all():
            columns[name] = {key: value for key, value in metadata.items() if key != "covering"}
    return {"version": VERSION, "primary_column": "geometry", "columns": columns}


def _column_metadata(geometries: Any, projjson: Mapping[str, Any] | None) -> dict[str, Any]:
    """The metadata of a geometry column: encoding, types, CRS, bounds."""
    present = geometries[~shapely.is_missing(geometries)]
    has_z = shapely.has_z(present)
    names = {
        shapely.GeometryType(int(kind)).name.title().replace("Multipolygon", "MultiPolygon")
        + _DIMENSION_SUFFIX[3 if z else 2]
        for kind, z in zip(shapely.get_type_id(present), has_z, strict=True)
    }
    column: dict[str, Any] = {
        "encoding": "WKB",
        "geometry_types": sorted(names),
        "crs": None if projjson is None else dict(projjson),
        "edges": "planar",
        "covering": {"bbox": {name: ["bbox", name] for name in ("xmin", "ymin", "xmax", "ymax")}},
    }
    if len(present):
        bounds = [float(v) for v in shapely.total_bounds(present)]
        if has_z.all():
            z = shapely.get_coordinates(present, include_z=True)[:, 2]
            bounds = [*bounds[:2], float(z.min()), *bounds[2:], float(z.max())]
        column["bbox"] = bounds
    return column


def geo_table(table_name: str, rows: Sequence[Mapping[str, Any]], projjson: Mapping[str, Any] | None) -> pa.Table:
    """Rows of `pipeline.export.record_rows` as an Arrow table with GeoParquet metadata, sorted by the table's key.

    `projjson` is the CRS of the geometries; None if it is unknown.
    """
    schema, key = SCHEMAS[table_name], KEYS[table_name]
    ordered = sorted(rows, key=lambda row: tuple(row[column] for column in key))
    table = pa.Table.from_pylist([dict(row) for row in ordered], schema=schema)
    geometries = _from_wkb(ordered, "geometry")
    table = table.append_column(pa.field("bbox", BBOX), bbox_column(geometries))
    shapes = {name: _from_wkb(ordered, name) for name in shape_names(table_name)}
    geo = json.dumps(geo_metadata(geometries, projjson, shapes), sort_keys=True, separators=(",", ":"))
    return table.replace_schema_metadata({"geo": geo})


def bbox_column(geometries: Any) -> pa.StructArray:
    """The boxes around geometries, (n,), as the column `bbox`; null where there is none."""
    missing = shapely.is_missing(geometries)
    bounds = shapely.bounds(geometries).reshape(-1, 4)
    return pa.StructArray.from_arrays(
        [pa.array(np.where(missing, 0.0, bounds[:, i])) for i in range(4)],
        fields=list(BBOX),
        mask=pa.array(missing, pa.bool_()),
    )


def _from_wkb(rows: Sequence[Mapping[str, Any]], column: str) -> Any:
    """The geometries of a column, None where there is none."""
    return shapely.from_wkb(np.array([row[column] for row in rows], dtype=object))


def parquet_bytes(table: pa.Table) -> bytes:
    """A table as the bytes of a Parquet file: zstd, fixed row groups; the same table gives the same bytes."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", row_group_size=ROWS_A_GROUP, write_statistics=True)
    data: bytes = sink.getvalue().to_pybytes()
    return data


def table_files(
    run_dir: str, table_name: str, filesystem: pafs.FileSystem, tiles: Sequence[str] | None = None
) -> list[str]:
    """The files of one table of a run, sorted.

    If the keys of the `tiles` that have files are given, the files are not looked for. The other arguments are those of
    `table_dataset`.
    """
    folder = f"{str(run_dir).rstrip('/')}/{table_name}"
    if tiles is not None:
        return [f"{folder}/tile={tile}/part-0.parquet" for tile in tiles]
    if filesystem.get_file_info(folder).type != pafs.FileType.Directory:
        raise RunError(f"{folder} is not a folder: give the directory that a run wrote")
    found = [
        info.path
        for info in filesystem.get_file_info(pafs.FileSelector(folder, recursive=True))
        if info.type == pafs.FileType.File
    ]
    # as Arrow's own search: what is being written has a name that begins with a dot
    return sorted(path for path in found if not any(part[0] in "._" for part in path[len(folder) + 1 :].split("/")))


def files_dataset(files: Sequence[str], schema: pa.Schema, filesystem: pafs.FileSystem) -> pads.Dataset:
    """Parquet files as one dataset of a schema, `tile` as a text column from the folders' names."""
    import pyarrow.dataset as pads

    if not files:
        return pads.dataset(schema.empty_table())
    partitioning = pads.partitioning(pa.schema([("tile", pa.string())]), flavor="hive")
    return pads.dataset(files, schema=schema, filesystem=filesystem, format="parquet", partitioning=partitioning)


def table_batches(
    run_dir: str,
    table_name: str,
    columns: Sequence[str],
    filesystem: pafs.FileSystem,
    tiles: Sequence[str] | None = None,
    rows: int = 65_536,
) -> Iterator[pa.RecordBatch]:
    """Stored columns (not `tile`) of one table of a run, at most `rows` at a time; begins faster than `table_dataset`.

    Raises RunError if the folder does not exist, or holds a file that is not Parquet.
    """
    schema = stored_schema(table_name)
    try:
        for path in table_files(run_dir, table_name, filesystem, tiles):
            with filesystem.open_input_file(path) as stream:
                file = pq.ParquetFile(stream)
                if _holds(file.schema_arrow, schema, columns):
                    yield from file.iter_batches(rows, columns=list(columns))
                    continue
            # another writer's types, or a column that is not there: the dataset reads them as ours, but takes longer
            dataset = files_dataset([path], schema, filesystem)
            yield from dataset.to_batches(columns=list(columns), batch_size=rows, fragment_readahead=1)
    except (pa.ArrowInvalid, OSError) as error:
        folder = f"{str(run_dir).rstrip('/')}/{table_name}"
        raise RunError(f"{folder} cannot be read as Parquet: {error}") from error


def _holds(found: pa.Schema, wanted: pa.Schema, columns: Sequence[str]) -> bool:
    """Whether a file has all columns of the types in which they are written."""
    return all(column in found.names and found.field(column).type == wanted.field(column).type for column in columns)


def table_dataset(run_dir: str, table_name: str, filesystem: pafs.FileSystem | None = None) -> pads.Dataset:
    """All files of one table of a run, `tile` added as a text column from the folders' names.

    The run directory is a local path, or a path of `filesystem`. Raises RunError if the folder does not exist.
    """
    filesystem = filesystem or pafs.LocalFileSystem()
    schema = stored_schema(table_name).append(pa.field("tile", pa.string()))
    return files_dataset(table_files(run_dir, table_name, filesystem), schema, filesystem)


def read_table(run_dir: str, table_name: str, filesystem: pafs.FileSystem | None = None) -> pa.Table:
    """One table of a run as a whole, sorted by its key; the arguments are those of `table_dataset`.

    Raises RunError if the folder does not exist or a file in it is damaged.
    """
    dataset = table_dataset(run_dir, table_name, filesystem)
    try:
        table = dataset.to_table()
    except (pa.ArrowInvalid, OSError) as error:
        raise RunError(f"{table_name} of {run_dir} cannot be read as Parquet: {error}") from error
    return table.sort_by([(column, "ascending") for column in KEYS[table_name]])
