"""Pages of a job's buildings as GeoJSON, cut out of prepared files; loads no numerical library."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

from service.errors import NoSuchOutputError, RequestError
from service.outputs.building_index import FEATURES_NAME, NAME, Box
from service.outputs.catalogue import ResultsCrs

GONE = "the buildings of this job are no longer in the state folder: submit it again"
"""The message if the files were removed."""
MAX_LIMIT = 10_000
"""Maximum number of buildings of one page."""
MAX_OFFSET = 10**12
"""Maximum number of buildings before a page."""
_CHUNK_BYTES = 1 << 16
_CACHE_KIB = 512
_NARROW_SHARE = 0.05
"""A window whose tiles hold a smaller share of all buildings is looked up tile by tile; a row then costs ten times
more."""


class CoordinateChoice(StrEnum):
    """The coordinates of a request."""

    CRS84 = "CRS84"
    """Longitude and latitude in WGS 84."""
    CRS84_URI = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
    """The same by its full name."""
    NATIVE = "native"
    """Easting and northing of the tiles, in their own units."""

    @property
    def is_native(self) -> bool:
        """Whether these are the tiles' own coordinates."""
        return self is CoordinateChoice.NATIVE


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingQuery:
    """The query for a page."""

    bbox: Box | None = None
    """Buildings whose footprint's bounds meet this window, border included; those without a footprint never do."""
    bbox_native: bool = False
    """The window is in the tiles' own coordinates."""
    native: bool = False
    """The answer has the tiles' own coordinates."""
    statuses: tuple[str, ...] = ()
    """Any of these; empty for all."""
    roof_types: tuple[str, ...] = ()
    """Any of these; empty for all."""
    reasons: tuple[str, ...] = ()
    """Any of these; empty for all."""
    limit: int = 100
    """Maximum number of buildings of the page."""
    offset: int = 0
    """Number of buildings before it."""
    by_arrival: bool = False
    """In the order in which they were modelled, so that a list that grows does so at its end; else by building_id."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class FeaturePart:
    """Position of a building's feature in the file, and the geometry that replaces its own."""

    start: int
    size: int
    geometry_start: int
    geometry_size: int
    native: bytes | None
    """The geometry to show; None for the one in the file."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingPage:
    """One page of buildings; `features` reads them as they are sent."""

    matched: int
    """Buildings that fit the request, on all pages."""
    parts: tuple[FeaturePart, ...]
    """Those of this page, in the order of the query."""
    path: Path
    """The file of features."""

    def features(self) -> Iterator[bytes]:
        """The features as GeoJSON texts."""
        if not self.parts:
            return
        with self.path.open("rb") as stream:
            for part in self.parts:
                stream.seek(part.start)
                text = stream.read(part.size)
                if part.native is None:
                    yield text
                else:
                    end = part.geometry_start + part.geometry_size
                    yield text[: part.geometry_start] + part.native + text[end:]

    def chunks(self, members: Mapping[str, Any]) -> Iterator[bytes]:
        """The page as a feature collection, some kilobytes at a time.

        Parameters
        ----------
        members : mapping
            Members beside type and features, such as links.
        """
        head = {"type": "FeatureCollection", "numberMatched": self.matched, "numberReturned": len(self.parts)}
        waiting = bytearray(json.dumps({**head, **members}, ensure_ascii=False).encode()[:-1])
        waiting += b', "features": ['
        for number, text in enumerate(self.features()):
            waiting += b",\n" if number else b"\n"
            waiting += text
            if len(waiting) >= _CHUNK_BYTES:
                yield bytes(waiting)
                waiting.clear()
        yield bytes(waiting + b"\n]}\n")


def parsed_bbox(text: str, *, native: bool) -> Box:
    """A window from four numbers.

    Parameters
    ----------
    text : str
        West, south, east, north (or x_min, y_min, x_max, y_max), separated by commas.
    native : bool
        Whether the numbers are the tiles' own coordinates.

    Raises
    ------
    RequestError
        It is not a window. A window over the 180th meridian must be requested in two halves.

    Examples
    --------
    >>> parsed_bbox("4.3,52,4.4,52.1", native=False)
    (4.3, 52.0, 4.4, 52.1)
    """
    try:
        # Python also reads 1_000
        values = [float(part) for part in text.replace("_", "?").split(",", 6)]
    except ValueError:
        values = []
    if len(values) != 4 or not all(math.isfinite(value) for value in values):
        raise RequestError([f"query bbox is {text[:80]!r}: give four numbers, such as 4.35,52.00,4.37,52.01"])
    west, south, east, north = values
    if south > north:
        raise RequestError([f"query bbox is {text!r}: its south {south:g} lies north of its north {north:g}"])
    if west > east:
        hint = "" if native else "; request a window over the 180th meridian in two halves"
        raise RequestError([f"query bbox is {text!r}: its west {west:g} lies east of its east {east:g}{hint}"])
    return west, south, east, north


def checked_choice(choice: CoordinateChoice | None, crs: ResultsCrs, parameter: str) -> bool:
    """Whether the tiles' own coordinates are requested; they are the only ones if the CRS is unknown.

    Raises
    ------
    RequestError
        WGS 84 is requested, but the CRS of the tiles is unknown.
    """
    if crs.is_known:
        return choice is not None and choice.is_native
    if choice is not None and not choice.is_native:
        fault = f"query {parameter} is {choice.value}, but the CRS of the tiles is unknown or local"
        raise RequestError([f"{fault}: use native, or leave it out"])
    return True


@contextlib.contextmanager
def opened_index(out_dir: Path) -> Iterator[sqlite3.Connection]:
    """The index of a folder of outputs, for reading.

    Raises
    ------
    NoSuchOutputError
        It is gone.
    """
    path = (out_dir / NAME).resolve()
    if not path.is_file():
        raise NoSuchOutputError(GONE)
    connection = sqlite3.connect(f"{path.as_uri()}?mode=ro&immutable=1", uri=True)
    try:
        # small, since many requests may run at once; the system caches the pages of the file anyway
        connection.execute(f"PRAGMA cache_size = -{_CACHE_KIB}")
        yield connection
    except sqlite3.OperationalError:
        # the job may be removed while it is read
        if not path.is_file():
            raise NoSuchOutputError(GONE) from None
        raise
    finally:
        connection.close()


def building_page(out_dir: Path, query: BuildingQuery) -> BuildingPage:
    """One page of buildings.

    Raises
    ------
    NoSuchOutputError
        The outputs are gone.
    """
    with opened_index(out_dir) as connection:
        source, conditions, values = _selection(connection, query)
        where = f" WHERE {' AND '.join(conditions)}" if conditions else ""
        (matched,) = connection.execute(f"SELECT count(*) FROM {source}{where}", values).fetchone()  # noqa: S608
        native = "native" if query.native else "NULL"
        order, by = ("key.place", "at") if query.by_arrival else ("key.building_id", "id")
        found = connection.execute(
            f"SELECT start, size, geometry_start, geometry_size, {native} FROM building JOIN"  # noqa: S608 - our own words
            f" (SELECT key.building_id AS id, key.place AS at FROM {source}{where} ORDER BY {order}"
            f" LIMIT ? OFFSET ?) ON building.place = at ORDER BY {by}",
            (*values, query.limit, query.offset),
        ).fetchall()
    parts = tuple(
        FeaturePart(start=start, size=size, geometry_start=first, geometry_size=length, native=geometry)
        for start, size, first, length, geometry in found
    )
    return BuildingPage(matched=matched, parts=parts, path=out_dir / FEATURES_NAME)


def _selection(connection: sqlite3.Connection, query: BuildingQuery) -> tuple[str, list[str], list[Any]]:
    """Tables, conditions and their values.

    A narrow window selects tiles first and then only their buildings; for a wide one a scan of all buildings in the
    order of their ids is cheaper.
    """
    conditions: list[str] = []
    values: list[Any] = []
    source = "key"
    if query.bbox is not None:
        window, corners = _window(query)
        (near,) = connection.execute(
            f"SELECT total(n) FROM tile WHERE {window.format('tile')}",  # noqa: S608
            corners,
        ).fetchone()
        (total,) = connection.execute("SELECT total(n) FROM tile").fetchone()
        if near <= _NARROW_SHARE * total:
            # CROSS JOIN prevents SQLite from reversing the order
            source = "tile CROSS JOIN key ON key.tile = tile.tile"
            conditions.append(window.format("tile"))
            values += corners
        conditions.append(window.format("key"))
        values += corners
    for column, allowed in (("status", query.statuses), ("roof_type", query.roof_types), ("reason", query.reasons)):
        if allowed:
            conditions.append(f"key.{column} IN ({', '.join('?' * len(allowed))})")
            values += allowed
    return source, conditions, values


def _window(query: BuildingQuery) -> tuple[str, Sequence[float]]:
    """The condition of the window, with a placeholder for the table, and its values."""
    assert query.bbox is not None
    low_x, low_y, high_x, high_y = query.bbox
    names = ("x_min", "x_max", "y_min", "y_max") if query.bbox_native else ("west", "east", "south", "north")
    text = " AND ".join(f"{{0}}.{name} {sign} ?" for name, sign in zip(names, ("<=", ">=", "<=", ">="), strict=True))
    return text, (high_x, low_x, high_y, low_y)
