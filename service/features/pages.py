"""Pages of features: which rows of an index a request selects, and their GeoJSON.

A selection is SQL. Geometries are tested beside it, for many rows at a time: `shape(k, position)` in a condition is the
answer of test k for a row.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import functools
import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from service.features.index import TIMES, Box, Part, RowIndex, parts, stamp

if TYPE_CHECKING:
    from service.features.feature_crs import Geometries, NamedCrs, RunCrs

GEOMETRY = "geometry"
"""The property that is a geometry."""
MAX_READ = 1_000_000
"""Rows that are looked at for one page. Then a page that has a feature is short, and its link goes on; one without goes
on itself, since clients take an empty page for the last."""
MAX_COUNTED = 250_000
"""Most rows that are looked at to count all matches; beyond, the answer has no number."""
_KEPT_COUNTS = 4096
_AT_ONCE = 500
"""Features whose texts are made at once."""

Interval = tuple[dt.datetime | None, dt.datetime | None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Condition:
    """A condition on rows."""

    sql: str
    """As SQL, in parentheses."""
    values: tuple[Any, ...] = ()
    """The values of its placeholders."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShapeTest:
    """A test of geometries."""

    crs: NamedCrs
    """The CRS of the geometries, easting first."""
    test: Callable[[Geometries], Any]
    """One answer per geometry; that of a missing one is not looked at."""


def among(column: str, words: Sequence[str]) -> Condition:
    """Rows with one of some words."""
    return Condition(sql=f"({column} IN ({', '.join('?' * len(words))}))", values=tuple(words))


def acquired_in(interval: Interval) -> Condition:
    """Rows whose acquisition meets an interval, or is unknown."""
    named = [(name, sign, at) for name, sign, at in zip(TIMES, ("<=", ">="), interval[::-1], strict=True) if at]
    text = " AND ".join(f"({name} IS NULL OR {name} {sign} ?)" for name, sign, _ in named)
    return Condition(sql=f"({text or 'TRUE'})", values=tuple(stamp(at) for *_, at in named))


def bounded_by(boxes: Sequence[Box], *, native: bool) -> Condition:
    """Buildings whose footprint's bounds meet one of some boxes, border included; those without footprint never do."""
    names = ("x_min", "x_max", "y_min", "y_max") if native else ("west", "east", "south", "north")
    text = " AND ".join(f"{name} {sign} ?" for name, sign in zip(names, ("<=", ">=") * 2, strict=True))
    corners = tuple(value for west, south, east, north in boxes for value in (east, west, north, south))
    return Condition(sql=f"({' OR '.join([text] * len(boxes))})", values=corners)


# --- which rows ------------------------------------------------------------------------------------------------------


def sorted_page(
    index: RowIndex, conditions: Sequence[Condition], *, by: str, limit: int, offset: int
) -> tuple[int, list[int]]:
    """The number of buildings that meet all conditions, and positions of those of a page, in the order of a column."""
    where, values = _joined(conditions)
    with index.opened() as connection:
        (matched,) = connection.execute(f"SELECT count(*) FROM buildings WHERE {where}", values).fetchone()  # noqa: S608 - our own words
        page = f"SELECT position FROM buildings WHERE {where} ORDER BY {by} LIMIT ? OFFSET ?"  # noqa: S608
        return matched, [position for (position,) in connection.execute(page, (*values, limit, offset))]


def _joined(conditions: Sequence[Condition]) -> tuple[str, list[Any]]:
    return (
        " AND ".join(["TRUE", *(one.sql for one in conditions)]),
        [value for one in conditions for value in one.values],
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Search:
    """A search for rows of a table in their order; equal for searches that select the same rows."""

    version: str
    """State of the run."""
    table: str
    """Name of the table."""
    key: str
    """The same for requests that select the same rows."""
    index: RowIndex = dataclasses.field(compare=False)
    """Its rows."""
    crs: RunCrs = dataclasses.field(compare=False)
    """The CRS of the run."""
    conditions: Sequence[Condition] = dataclasses.field(default=(), compare=False)
    """All that rows must meet, beside the boxes."""
    shapes: Sequence[ShapeTest] = dataclasses.field(default=(), compare=False)
    """The tests that the conditions name."""
    boxes: Sequence[Box] | None = dataclasses.field(default=None, compare=False)
    """Rows whose geometry meets one of these, or that have none; easting first."""
    boxes_crs: NamedCrs = dataclasses.field(compare=False)
    """Their CRS."""
    windows: Sequence[Box] | None = dataclasses.field(default=None, compare=False)
    """Boxes of the run's CRS in which all wanted geometries lie, beside rows without; None for anywhere."""

    def page(self, limit: int, start: int) -> tuple[list[int], int | None]:
        """Positions of at most so many rows from `start` on, and the start of the next page; None if there is none."""
        found: list[int] = []
        looked_at = 0
        with self.index.opened() as connection:
            rows = _Rows(self, connection)
            for part in rows.parts(start):
                if found and looked_at >= MAX_READ:
                    return found, part.first
                looked_at += part.n
                found += [position for position in rows.selected(part) if position >= start]
                if len(found) > limit:
                    return found[:limit], found[limit]
        return found, None

    @functools.lru_cache(maxsize=_KEPT_COUNTS)  # noqa: B019 - the pages of one list share their number
    def matched(self) -> int | None:
        """The number of rows on all pages; None if counting would take too long."""
        if not self.conditions and self.boxes is None:
            return self.index.totals(self.table).n
        with self.index.opened() as connection:
            rows = _Rows(self, connection)
            near = rows.parts()
            looked_at = sum(part.n for part in near if self.conditions or not rows.is_inside(part))
            return None if looked_at > MAX_COUNTED else sum(len(rows.selected(part)) for part in near)


class _Rows:
    """The rows of a search, part by part."""

    def __init__(self, search: Search, connection: sqlite3.Connection) -> None:
        self._search = search
        self._connection = connection
        connection.create_function("shape", 2, lambda k, position: self._answers[k][position - self._first])
        boxes = search.boxes
        self._union = None if boxes is None else shapely.union_all([shapely.box(*box) for box in boxes])
        self._first = 0
        self._answers: list[list[bool | None]] = []

    def parts(self, start: int = 0) -> list[Part]:
        """The parts that can hold what is looked for."""
        return parts(self._connection, self._search.table, self._search.windows, start)

    def is_inside(self, part: Part) -> bool:
        """Whether the boxes select all rows of a part."""
        if self._union is None or part.bounds is None:
            return True
        bounds = self._search.crs.outside(part.bounds, self._search.boxes_crs)
        return bounds is not None and bool(shapely.covers(self._union, shapely.box(*bounds)))

    def selected(self, part: Part) -> Sequence[int]:
        """The positions of the selected rows of a part."""
        conditions, shapes = list(self._search.conditions), list(self._search.shapes)
        if not self.is_inside(part):
            conditions.append(Condition(sql=f"(geometry IS NULL OR shape({len(shapes)}, position))"))
            shapes.append(
                ShapeTest(crs=self._search.boxes_crs, test=lambda found: shapely.intersects(found, self._union))
            )
        ends = (part.first, part.first + part.n)
        if not conditions:
            return range(*ends)
        source = f"FROM {self._search.table} WHERE position >= ? AND position < ?"
        if shapes:
            stored = self._connection.execute(f"SELECT geometry {source} ORDER BY position", ends)
            own = from_wkb([wkb for (wkb,) in stored])
            answers = [one.test(self._search.crs.moved(own, one.crs)) for one in shapes]
            missing = shapely.is_missing(own)
            self._first = part.first
            self._answers = [np.where(missing, np.array(None), answer).tolist() for answer in answers]
        where, values = _joined(conditions)
        rows = self._connection.execute(f"SELECT position {source} AND {where} ORDER BY position", (*ends, *values))
        return [position for (position,) in rows]


# --- their texts -----------------------------------------------------------------------------------------------------


def from_wkb(values: Sequence[bytes | None]) -> Geometries:
    """Geometries, None where there is none."""
    return np.asarray(shapely.from_wkb(np.array([*values, None], dtype=object)[:-1]), dtype=object)


def geojson(shape: shapely.Geometry | None) -> str:
    """A geometry as GeoJSON text."""
    return "null" if shape is None else str(shapely.to_geojson(shape))


def feature_texts(
    index: RowIndex, table: str, positions: Sequence[int], written: Callable[[Geometries], Geometries] | None = None
) -> Iterator[bytes]:
    """Features as GeoJSON texts, in the order of their positions.

    `written` makes the geometries of answers of those of the run; None for footprints of buildings in degrees, which
    the index has.
    """
    kinds = index.kinds(table)
    columns = ", ".join(f'"{name}"' for name in kinds)
    shown = "degrees" if written is None else GEOMETRY
    with index.opened() as connection:
        for start in range(0, len(positions), _AT_ONCE):
            some = positions[start : start + _AT_ONCE]
            rows = connection.execute(
                f"SELECT position, id, {shown}, {columns} FROM {table}"  # noqa: S608 - our own words
                " WHERE position IN (SELECT value FROM json_each(?))",
                (json.dumps(list(some)),),
            )
            found = {row[0]: row[1:] for row in rows}
            ordered = [found[position] for position in some]
            shapes = [row[1] or "null" for row in ordered]
            if written is not None:
                shapes = list(map(geojson, written(from_wkb([row[1] for row in ordered]))))
            for (name, _, *values), shape in zip(ordered, shapes, strict=True):
                head = f'{{"type":"Feature","id":{json.dumps(name)},"geometry":{shape},"properties":'
                yield head.encode() + _json(properties(kinds, values)) + b"}"


def properties(kinds: Mapping[str, str], values: Sequence[Any]) -> dict[str, Any]:
    """The properties of a feature by their names, from the values of a row."""
    return {
        name: value if value is None or kind not in _SHOWN else _SHOWN[kind](value)
        for (name, kind), value in zip(kinds.items(), values, strict=True)
    }


_SHOWN: Mapping[str, Callable[[Any], Any]] = {
    "boolean": bool,
    "list": json.loads,
    "time": lambda text: text.replace("+00:00", "Z"),
}


def collected(members: Mapping[str, Any], features: Iterator[bytes]) -> Iterator[bytes]:
    """A feature collection as GeoJSON, piece by piece: the members beside the features, then these, one per line."""
    yield json.dumps({"type": "FeatureCollection", **members}, ensure_ascii=False).encode()[:-1] + b',"features":['
    between = b"\n"
    for text in features:
        yield between + text
        between = b",\n"
    yield b"\n]}\n"


def _json(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()
