"""The index of a run: a SQLite file with the rows of its tables, from which all pages of buildings and features come.

It is written once (`writing`) and then only read: opened as immutable, without locks, also on a network folder and by
many threads. While a job runs its index grows in a file of its own, and readers get a copy, which does not change
either. Reading loads neither Arrow nor PROJ.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import functools
import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from service.errors import NoSuchOutputError

NAME = "rows.sqlite"
"""File name of a job's index in its folder of outputs; not an output itself."""
GONE = "the buildings of this job are no longer in the state folder: submit it again"
"""The message if the index was removed."""
CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
"""Longitude and latitude in WGS 84: the default of answers."""
TABLES = ("buildings", "planes", "rejected")
"""Tables of a run that are collections, by the names of the layers of a GeoPackage."""
TIMES = ("acquired_from", "acquired_to")
"""Columns of first and last acquisition; only buildings have them."""
_CACHE_KIB = 512

Box = tuple[float, float, float, float]


@dataclasses.dataclass(frozen=True, slots=True)
class Part:
    """Successive rows of one tile in a table."""

    first: int
    """Position of its first row in the collection."""
    n: int
    """Number of rows."""
    bounds: Box | None
    """Bounds of the geometries in the CRS of the run; None without any."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Totals:
    """Facts about a whole table."""

    n: int
    """Rows."""
    bounds: Box | None
    """Bounds in the CRS of the run; None without geometry."""
    times: tuple[dt.datetime | None, dt.datetime | None]
    """First and last time of acquisition."""


class RowIndex:
    """Reads an index.

    Parameters
    ----------
    path : Path
        The file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path.resolve()

    @contextlib.contextmanager
    def opened(self) -> Iterator[sqlite3.Connection]:
        """A connection for reading; raises NoSuchOutputError if the file is gone."""
        if not self._path.is_file():
            raise NoSuchOutputError(GONE)
        connection = sqlite3.connect(f"{self._path.as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            # small, since many requests may run at once; the system caches the pages of the file anyway
            connection.execute(f"PRAGMA cache_size = -{_CACHE_KIB}")
            connection.execute("PRAGMA case_sensitive_like = ON")
            yield connection
        except sqlite3.OperationalError:
            # the job may be removed while it is read
            if not self._path.is_file():
                raise NoSuchOutputError(GONE) from None
            raise
        finally:
            connection.close()

    @functools.cached_property
    def facts(self) -> Mapping[str, Any]:
        """What the index says of the run: `crs` as in run.json, `licence`, and the kinds of `columns` by table."""
        with self.opened() as connection:
            return {name: json.loads(value) for name, value in connection.execute("SELECT name, value FROM fact")}

    def kinds(self, table: str) -> Mapping[str, str]:
        """The properties of a table's features: text, number, boolean, time or list."""
        found: Mapping[str, str] = self.facts["columns"][table]
        return found

    def figure(self, sql: str) -> int:
        """One number of the index."""
        with self.opened() as connection:
            (found,) = connection.execute(sql).fetchone()
        return int(found)

    def totals(self, table: str) -> Totals:
        """Facts about a whole table."""
        with self.opened() as connection:
            n, first, last, *box = connection.execute(
                "SELECT coalesce(sum(n), 0), min(acquired_from), max(acquired_to), min(x_min), min(y_min), max(x_max),"
                " max(y_max) FROM part WHERE collection = ?",
                (table,),
            ).fetchone()
        first, last = (None if at is None else dt.datetime.fromisoformat(at) for at in (first, last))
        return Totals(n=n, bounds=_box(box), times=(first, last))


def parts(connection: sqlite3.Connection, table: str, windows: Sequence[Box] | None, start: int = 0) -> list[Part]:
    """The parts that can hold what is looked for, in the order of the collection.

    Parameters
    ----------
    connection : Connection
        An opened index.
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
    rows = connection.execute(
        f"SELECT first, n, x_min, y_min, x_max, y_max FROM part WHERE collection = ? AND first + n > ?{condition}"  # noqa: S608
        " ORDER BY number",
        (table, start, *values),
    )
    return [Part(first, n, _box(box)) for first, n, *box in rows]


def _box(values: Sequence[Any]) -> Box | None:
    return None if values[0] is None else (values[0], values[1], values[2], values[3])


def stamp(at: dt.datetime) -> str:
    """A time as it is stored: the order of such texts is that of the times.

    >>> stamp(dt.datetime(2014, 3, 1, 10, tzinfo=dt.UTC))
    '2014-03-01T10:00:00+00:00'
    """
    return at.astimezone(dt.UTC).isoformat()
