"""The index of a run's tables: a SQLite file, written once, then only read.

It lists the row groups of the Parquet files in the order of the collection (by tile, then as stored), with the number
of rows and the bounds that the files' own statistics give, and the tile of each id. A page of features so costs the row
groups that it shows, and a single feature costs one file.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import datetime as dt
import gc
import math
import os
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow.fs as pafs
import pyarrow.parquet as pq

from pipeline.export.geoparquet import table_files
from service.features.runs import TABLES

Box = tuple[float, float, float, float]

_READERS = 8
"""Files that are read at once: those of an object store take long to arrive."""
_AHEAD = 8 * _READERS
_CACHE_KIB = 512
_IDS = {"buildings": "building_id", "rejected": "object_id"}
"""Columns of ids that are looked up; a plane is found by its building, which lies in the same tile."""
_BOUNDS = ("bbox.xmin", "bbox.ymin", "bbox.xmax", "bbox.ymax")
_ANYWHERE = (-math.inf, -math.inf, math.inf, math.inf)
_TIMES = ("acquired_from", "acquired_to")
_LAYOUT = """
CREATE TABLE part (
    collection TEXT NOT NULL,
    number INTEGER NOT NULL,
    path TEXT NOT NULL,               -- of the file
    tile TEXT NOT NULL,
    row_group INTEGER NOT NULL,
    first INTEGER NOT NULL,           -- position of its first row in the collection
    n INTEGER NOT NULL,               -- rows
    located INTEGER NOT NULL,         -- rows with a geometry
    x_min REAL, y_min REAL, x_max REAL, y_max REAL,  -- null if no row has one
    acquired_from TEXT, acquired_to TEXT,
    PRIMARY KEY (collection, number)
) WITHOUT ROWID;
CREATE TABLE object (
    collection TEXT NOT NULL,
    id TEXT NOT NULL,
    number INTEGER NOT NULL,
    PRIMARY KEY (collection, id)
) WITHOUT ROWID;
"""


@dataclasses.dataclass(frozen=True, slots=True)
class Part:
    """One row group of a table."""

    path: str
    """The file, in the file system of the run."""
    tile: str
    """Its tile."""
    row_group: int
    """Its number in the file."""
    first: int
    """Position of its first row in the collection."""
    n: int
    """Number of rows."""
    located: int
    """Rows with a geometry."""
    bounds: Box | None = None
    """Bounds of the geometries in the CRS of the run; None without any, or if they were not asked for."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Totals:
    """Facts about a whole table."""

    n: int
    """Rows."""
    bounds: Box | None
    """Bounds in the CRS of the run; None without geometry."""
    times: tuple[dt.datetime | None, dt.datetime | None]
    """First and last time of acquisition."""


def write_index(path: Path, place: str, filesystem: pafs.FileSystem) -> None:
    """Write the index of a run; the file appears whole.

    Parameters
    ----------
    path : Path
        The file to write.
    place : str
        The run directory in the file system.
    filesystem : pyarrow.fs.FileSystem
        Where the run lies.

    Raises
    ------
    RunError
        A table is missing.
    OSError
        A file cannot be read, or the index cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    temporary.unlink(missing_ok=True)
    with contextlib.closing(sqlite3.connect(temporary, isolation_level=None)) as connection:
        for setting in ("journal_mode=OFF", "synchronous=OFF"):
            connection.execute(f"PRAGMA {setting}")
        connection.executescript(_LAYOUT)
        connection.execute("BEGIN")
        with concurrent.futures.ThreadPoolExecutor(_READERS) as readers:
            for table in TABLES:
                files = table_files(place, table, filesystem)
                _add(connection, table, _all_facts(filesystem, files, _IDS.get(table), readers))
        connection.execute("COMMIT")
    temporary.replace(path)


def _add(connection: sqlite3.Connection, table: str, files: Any) -> None:
    """Add the row groups and ids of one table."""
    number, first = 0, 0
    for file, (groups, ids) in files:
        tile = file.split("/")[-2].removeprefix("tile=")
        connection.executemany("INSERT OR IGNORE INTO object VALUES (?,?,?)", ((table, one, number) for one in ids))
        for group, (n, located, bounds, times) in enumerate(groups):
            if not n:
                continue  # of a tile without rows
            row = (table, number, file, tile, group, first, n, located, *(bounds or (None,) * 4), *times)
            connection.execute("INSERT INTO part VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?)", row)
            number += 1
            first += n


def _all_facts(
    filesystem: pafs.FileSystem, files: Sequence[str], id_column: str | None, readers: concurrent.futures.Executor
) -> Iterator[tuple[str, tuple[list[Any], list[str]]]]:
    """The facts of each file, a few files ahead of the caller."""
    for start in range(0, len(files), _AHEAD):
        some = files[start : start + _AHEAD]
        yield from zip(some, readers.map(lambda path: _facts(filesystem, path, id_column), some), strict=True)
        # a reader of Parquet is part of a cycle, and a process of ours seldom collects those
        gc.collect(0)


def _facts(filesystem: pafs.FileSystem, path: str, id_column: str | None) -> tuple[list[Any], list[str]]:
    """Of each row group rows, rows with geometry, bounds and times; and the ids of the file."""
    with filesystem.open_input_file(path) as stream:
        file = pq.ParquetFile(stream)
        columns = {file.metadata.schema.column(k).path: k for k in range(file.metadata.num_columns)}
        groups = []
        for number in range(file.metadata.num_row_groups):
            group = file.metadata.row_group(number)
            stats = {name: group.column(columns[name]).statistics for name in (*_BOUNDS, *_TIMES) if name in columns}
            groups.append((group.num_rows, *_bounds(group.num_rows, stats), _times(stats)))
        ids = [] if id_column is None else file.read([id_column], use_threads=False).column(0).to_pylist()
    return groups, ids


def _bounds(rows: int, stats: dict[str, Any]) -> tuple[int, Box | None]:
    """Rows with a geometry and their bounds, from statistics that may lack; then anywhere."""
    found = [stats[name] for name in _BOUNDS if stats.get(name) is not None and stats[name].has_null_count]
    if len(found) < len(_BOUNDS):
        return 0, _ANYWHERE
    located = rows - found[0].null_count
    if not located:
        return 0, None
    if not all(one.has_min_max for one in found):
        return located, _ANYWHERE
    return located, (found[0].min, found[1].min, found[2].max, found[3].max)


def _times(stats: dict[str, Any]) -> tuple[str | None, str | None]:
    first, last = (stats.get(name) for name in _TIMES)
    return (
        first.min.isoformat() if first is not None and first.has_min_max else None,
        last.max.isoformat() if last is not None and last.has_min_max else None,
    )


class RowIndex:
    """Reads an index; opened as immutable, so also on a network folder and by many threads.

    Parameters
    ----------
    path : Path
        The file that `write_index` made.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    @contextlib.contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        connection = sqlite3.connect(f"{self._path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            connection.execute(f"PRAGMA cache_size = -{_CACHE_KIB}")
            yield connection
        finally:
            connection.close()

    def totals(self, table: str) -> Totals:
        """Facts about a whole table."""
        with self._opened() as connection:
            n, *rest = connection.execute(
                "SELECT coalesce(sum(n), 0), min(x_min), min(y_min), max(x_max), max(y_max), min(acquired_from),"
                " max(acquired_to) FROM part WHERE collection = ?",
                (table,),
            ).fetchone()
        first, last = (None if at is None else dt.datetime.fromisoformat(at) for at in rest[4:])
        bounds = None if rest[0] is None else (rest[0], rest[1], rest[2], rest[3])
        return Totals(n=n, bounds=bounds, times=(first, last))

    def parts(self, table: str, windows: Sequence[Box] | None, start: int = 0) -> Iterator[Part]:
        """The row groups that can hold what is looked for, in the order of the collection.

        Parameters
        ----------
        table : str
            The table.
        windows : sequence of tuple of float, optional
            Rows have a geometry in one of these, or none at all; in the CRS of the run. None for all rows.
        start : int
            Position of the first row that is looked at.
        """
        condition, values = "", []
        if windows is not None:
            near = " OR ".join("x_min <= ? AND x_max >= ? AND y_min <= ? AND y_max >= ?" for _ in windows)
            condition = f" AND (located < n{' OR ' + near if near else ''})"
            values = [value for west, south, east, north in windows for value in (east, west, north, south)]
        with self._opened() as connection:
            rows = connection.execute(
                "SELECT path, tile, row_group, first, n, located, x_min, y_min, x_max, y_max FROM part"  # noqa: S608
                f" WHERE collection = ? AND first + n > ?{condition} ORDER BY number",
                (table, start, *values),
            )
            for path, tile, group, first, n, located, *box in rows:
                bounds = None if box[0] is None else (box[0], box[1], box[2], box[3])
                yield Part(path, tile, group, first, n, located, bounds)

    def parts_with(self, table: str, object_id: str) -> list[Part]:
        """The row groups of the file that holds the object with an id of `table`, as parts of `table` itself."""
        with self._opened() as connection:
            row = connection.execute(
                "SELECT tile FROM object JOIN part USING (collection, number) WHERE collection = ? AND id = ?",
                (table, object_id),
            ).fetchone()
        return [] if row is None else self.parts_of_tile(table, row[0])

    def parts_of_tile(self, table: str, tile: str) -> list[Part]:
        """The row groups of a tile."""
        with self._opened() as connection:
            rows = connection.execute(
                "SELECT path, tile, row_group, first, n, located FROM part WHERE collection = ? AND tile = ?"
                " ORDER BY number",
                (table, tile),
            ).fetchall()
        return [Part(*row) for row in rows]
