"""Writing the index of a run: from its Parquet files, or row by row while it is made."""

from __future__ import annotations

import concurrent.futures
import errno
import json
import shutil
import sqlite3
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.fs as pafs
import pyarrow.parquet as pq
import shapely

from pipeline.errors import RunError
from pipeline.export.geoparquet import table_files
from pipeline.runtime.manifest import RunManifest
from service.features.feature_crs import RunCrs
from service.features.feature_tables import GEOMETRY, LAYERS, TILE, Layer
from service.features.index import CRS84, TABLES, TIMES, stamp
from service.features.pages import from_wkb

_READERS = 8
"""Tiles that are read at once: files of an object store take long to arrive."""
_BOUNDS = ("x_min", "y_min", "x_max", "y_max", "west", "south", "east", "north")
"""Bounds of a building in the CRS of the run and in degrees."""
_WORDS = ("status", "roof_type", "reason")
"""Properties of buildings that pages of a job's buildings select by."""
_BY_ID = f"""
CREATE INDEX IF NOT EXISTS buildings_by_id ON buildings (id, {", ".join((*_WORDS, *_BOUNDS))});
CREATE INDEX IF NOT EXISTS planes_by_id ON planes (id);
CREATE INDEX IF NOT EXISTS rejected_by_id ON rejected (id);
"""
"""The search indexes. That of buildings holds all that pages of a job's buildings select by, which spares the table."""
_SQL = {"text": "TEXT", "boolean": "INTEGER", "time": "TEXT", "list": "TEXT"}
_LAYOUT = """
CREATE TABLE fact (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;  -- values as JSON
CREATE TABLE batch (name TEXT PRIMARY KEY) WITHOUT ROWID;  -- of a job that runs: those whose buildings are here
CREATE TABLE part (                   -- successive rows of one tile
    collection TEXT NOT NULL,
    number INTEGER NOT NULL,
    first INTEGER NOT NULL,           -- position of its first row in the collection
    n INTEGER NOT NULL,               -- rows
    located INTEGER NOT NULL,         -- rows with a geometry
    x_min REAL, y_min REAL, x_max REAL, y_max REAL,  -- null if no row has one
    acquired_from TEXT, acquired_to TEXT,
    PRIMARY KEY (collection, number)
) WITHOUT ROWID;
CREATE TABLE city (                   -- of a job that runs: where the CityJSON of a building is
    id TEXT PRIMARY KEY,
    start INTEGER NOT NULL,
    size INTEGER NOT NULL
) WITHOUT ROWID;
"""


def _table(layer: Layer) -> str:
    """The rows of a table by position: geometries as WKB, times as ISO 8601 in UTC, lists as JSON.

    Buildings also have bounds, and their footprint in degrees as GeoJSON.
    """
    columns = [f"{name} REAL" for name in _BOUNDS] + ["degrees TEXT"] if layer.table == "buildings" else []
    columns += [f'"{name}" {_SQL.get(kind) or _number(layer, name)}' for name, kind in layer.kinds.items()]
    return (
        f"CREATE TABLE {layer.table} (position INTEGER PRIMARY KEY, id TEXT NOT NULL, geometry BLOB,"
        f" {', '.join(columns)});"
    )


def _number(layer: Layer, name: str) -> str:
    return "INTEGER" if "int" in str(layer.properties[name]) else "REAL"


class IndexWriter:
    """Writes an index; a context manager. The file is complete at an end without an exception.

    Parameters
    ----------
    path : Path
        The file to write; if it exists, it is continued.
    crs : mapping, optional
        The `crs` entry of run.json.
    licence : str
        Licence of the source data; may be empty.
    """

    def __init__(self, path: Path, crs: Mapping[str, Any] | None, licence: str = "") -> None:
        is_new = not path.exists()
        self.crs = RunCrs.of_run(crs)
        """The CRS of the run."""
        self.connection = sqlite3.connect(path, isolation_level=None)
        """To read what is there."""
        # the file gets its name when it is complete, so nothing here needs to survive a crash
        for setting in ("journal_mode=OFF", "synchronous=OFF", "cache_size=-32000", "locking_mode=EXCLUSIVE"):
            self.connection.execute(f"PRAGMA {setting}")
        if is_new:
            self.connection.executescript(_LAYOUT + "".join(map(_table, LAYERS.values())))
            columns = {layer.table: layer.kinds for layer in LAYERS.values()}
            facts = {"crs": crs, "licence": licence, "columns": columns}
            entries = [(name, json.dumps(value)) for name, value in facts.items()]
            self.connection.executemany("INSERT INTO fact VALUES (?,?)", entries)
        self.connection.execute("BEGIN")

    def add(self, table: str, tile: str, rows: pa.Table) -> None:
        """Append rows of a table, all of one tile, with their geometries as WKB."""
        if not len(rows):
            return
        layer = LAYERS[table]
        last = "SELECT coalesce(max(first + n), 0), count(*) FROM part WHERE collection = ?"
        first, number = self.connection.execute(last, (table,)).fetchone()
        geometries = rows[GEOMETRY].to_numpy().tolist()
        shapes = from_wkb(geometries)
        bounds = shapely.bounds(shapes)
        more: list[list[Any]] = []
        if table == "buildings":
            degrees = np.full(len(shapes), None)
            if self.crs.is_known:
                degrees = self.crs.written(shapes, self.crs.named(CRS84, "crs"))
            more += [column.tolist() for column in np.hstack([bounds, shapely.bounds(degrees)]).T]
            more.append(shapely.to_geojson(degrees).tolist())
        own = {name: [None] * len(rows) for name in layer.kinds} | {TILE: [tile] * len(rows)}
        for name, column in zip(rows.column_names, rows.columns, strict=True):
            if name in own and name != TILE:  # an older run lacks some
                own[name] = _stored(layer.kinds[name], column)
        positions = range(first, first + len(rows))
        stored = zip(positions, layer.feature_ids(own), geometries, *more, *own.values(), strict=True)
        places = ",".join("?" * (3 + len(more) + len(own)))
        self.connection.executemany(f"INSERT INTO {table} VALUES ({places})", stored)  # noqa: S608 - our own words
        located = int(np.isfinite(bounds[:, 0]).sum())
        box = (*np.nanmin(bounds[:, :2], 0).tolist(), *np.nanmax(bounds[:, 2:], 0).tolist()) if located else (None,) * 4
        begins, ends = ([at for at in own.get(name, ()) if at is not None] for name in TIMES)
        part = (table, number, first, len(rows), located, *box, min(begins, default=None), max(ends, default=None))
        self.connection.execute("INSERT INTO part VALUES (?,?,?,?,?,?,?,?,?,?,?)", part)

    def __enter__(self) -> Self:
        """Open for writing."""
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Finish the file, or leave it if there was an exception; raises OSError if it cannot be written."""
        try:
            if error is None:
                self.connection.execute("COMMIT")
                self.connection.executescript(_BY_ID)  # faster than while rows are added
        except sqlite3.OperationalError as fault:
            error = fault
        finally:
            self.connection.close()
        if isinstance(error, sqlite3.OperationalError):
            number = errno.ENOSPC if error.sqlite_errorname == "SQLITE_FULL" else errno.EIO
            raise OSError(number, f"the index cannot be written ({error})") from error


def _stored(kind: str, column: pa.ChunkedArray) -> list[Any]:
    """The values of a column as they are stored; SQLite takes nan for null."""
    if kind == "time":
        # few times are different
        times = column.combine_chunks().dictionary_encode()
        words = np.array([*map(stamp, times.dictionary.to_pylist()), None], dtype=object)
        return list(words[times.indices.fill_null(len(words) - 1).to_numpy()])
    values: list[Any] = column.to_numpy().tolist()
    if kind == "list":
        return [None if value is None else json.dumps(value.tolist()) if len(value) else "[]" for value in values]
    return values


class GrowingIndex(IndexWriter):
    """Writes an index that readers see while it grows. They read a copy, which is replaced as a whole.

    A writer that was killed does no harm: the next one goes on from the copy.

    Parameters
    ----------
    path : Path
        The copy that is read.
    crs : mapping, optional
        The `crs` entry of run.json.
    """

    def __init__(self, path: Path, crs: Mapping[str, Any] | None) -> None:
        self._path = path
        self._own = path.with_name(f".growing-{path.name}")
        self._own.unlink(missing_ok=True)
        if path.exists():
            shutil.copyfile(path, self._own)
        super().__init__(self._own, crs)
        self.connection.executescript(_BY_ID)
        self.connection.execute("BEGIN")

    def figure(self, sql: str) -> int:
        """One number of the index."""
        (found,) = self.connection.execute(sql).fetchone()
        return int(found)

    @property
    def batches(self) -> set[str]:
        """Names of the batches whose buildings it has."""
        return {name for (name,) in self.connection.execute("SELECT name FROM batch")}

    def show(self) -> None:
        """Let readers see what was added since."""
        self.connection.execute("COMMIT")
        new = self._path.with_name(f".new-{self._path.name}")
        shutil.copyfile(self._own, new)
        new.replace(self._path)
        self.connection.execute("BEGIN")


def write_index(
    path: Path,
    place: str,
    filesystem: pafs.FileSystem,
    manifest: RunManifest,
    tiles: Iterable[str] | None = None,
) -> None:
    """Write the index of a run.

    Parameters
    ----------
    path : Path
        The file to write; must not exist.
    place : str
        The run directory in the file system.
    filesystem : pyarrow.fs.FileSystem
        Where the run lies.
    manifest : RunManifest
        The content of its run.json.
    tiles : iterable of str, optional
        Its tiles, which are read one after the other; by default all, a few at a time.

    Raises
    ------
    RunError
        A table is missing or damaged.
    OSError
        The index cannot be written.
    """

    def read(tile: str) -> list[tuple[str, str, pa.Table]]:
        return [(table, tile, _rows(filesystem, place, table, tile)) for table in TABLES]

    with IndexWriter(path, manifest.crs, manifest.source_licence or "") as writer:
        if tiles is not None:
            for tile in tiles:
                for table, name, rows in read(tile):
                    writer.add(table, name, rows)
            return
        files = table_files(place, "buildings", filesystem)
        found = in_z_order(file.split("/")[-2].removeprefix("tile=") for file in files)
        with concurrent.futures.ThreadPoolExecutor(_READERS) as readers:
            for start in range(0, len(found), _READERS):
                for entries in readers.map(read, found[start : start + _READERS]):
                    for table, name, rows in entries:
                        writer.add(table, name, rows)


def _rows(filesystem: pafs.FileSystem, place: str, table: str, tile: str) -> pa.Table:
    """The rows of a table of one tile, without the columns that features do not have."""
    (file,) = table_files(place, table, filesystem, [tile])
    try:
        with filesystem.open_input_file(file) as stream, pq.ParquetFile(stream) as stored:
            there = set(stored.schema_arrow.names)
            names = [name for name in (GEOMETRY, *LAYERS[table].properties) if name in there]
            return stored.read(columns=names, use_threads=False)
    except (OSError, pa.ArrowException) as error:
        raise RunError(f"{file} cannot be read as Parquet: {error}") from error


def in_z_order(tiles: Iterable[str]) -> list[str]:
    """Keys of tiles along a Z-order curve: successive ones are near each other.

    >>> in_z_order(["x0_y1", "x1_y1", "x1_y0", "x0_y0", "x-1_y0"])
    ['x-1_y0', 'x0_y0', 'x1_y0', 'x0_y1', 'x1_y1']
    """

    def place(tile: str) -> int:
        column, _, row = tile.removeprefix("x").partition("_y")
        # lattices lie far within 2^31 tiles of their origin
        x, y = int(column) + 2**31, int(row) + 2**31
        return sum(((x >> bit & 1) << (2 * bit)) | ((y >> bit & 1) << (2 * bit + 1)) for bit in range(33))

    return sorted(tiles, key=lambda tile: (place(tile), tile))
