"""Checks a client's file of footprints or guides without the library that will read it.

A GeoPackage is a database, which can hold endless views and computed columns; GeoJSON can be nested without limit;
GeoParquet can hold far more than its size suggests. All of these are refused here. Shapefiles are several files and
are accepted by path only.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import sqlite3
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from pipeline.errors import EmptyInputError, InputError, UnreadableInputError
from pipeline.extras.vector_files.gdal_source import (
    FLATGEOBUF_MAGIC,
    RECORD,
    SHAPE_MAGIC,
    is_lines,
    refuse_links,
    refuse_unread,
    xml_ending,
)
from pipeline.extras.vector_files.nearby import POLYGONS as SHAPE_OF_FOOTPRINTS
from pipeline.extras.vector_files.vector_archive import ZIP_MAGIC, refuse_without_vectors, unpacked, vector_members
from pipeline.io.crs_given import parse_crs
from pipeline.io.formats import ARCHIVE_SUFFIXES, GEOJSON_SUFFIXES, LINES_SUFFIXES, PARQUET_SUFFIXES, XML_SUFFIXES
from pipeline.io.library_faults import in_our_words, shortened
from service.errors import TooLargeError

GEOPACKAGE_LIMIT = 2**30
"""Maximum number of bytes of a GeoPackage or GeoParquet; if all of it overlaps the points, all is held in memory."""
GEOJSON_LIMIT = 2**28
"""Bytes."""
DEPTH_LIMIT = 64
"""Maximum depth of GeoJSON; a multipolygon in a collection has twelve levels."""
STEPS_LIMIT = 50_000_000
"""Steps of the database engine for one statement, about a second."""
VALUE_LIMIT = 2**24
"""Maximum number of bytes of one value in a GeoPackage."""
PARSED_BYTES = 2**25
"""GeoJSON up to this size is parsed; of larger files a job says what is in them."""
HEAD_BYTES = 65_536
BLOCK_BYTES = 1 << 20

FIX = (
    "Give a GeoPackage (.gpkg), GeoJSON (.geojson, .json, .geojsonl), GeoParquet (.parquet), FlatGeobuf (.fgb), GML "
    "(.gml), KML (.kml) or a zip archive (.zip, .kmz) with polygons of buildings, or with lines of roofs"
)
ARCHIVED_LIMIT = 20
"""Maximum number of vector files in a zip archive: each is examined."""
SQLITE_MAGIC = b"SQLite format 3\0"
APPLICATION_IDS = (b"GPKG", b"GP10", b"GP11")
POLYGONAL = ("POLYGON", "MULTIPOLYGON", "CURVEPOLYGON", "GEOMETRY", "GEOMETRYCOLLECTION", "SURFACE", "MULTISURFACE")
"""Types of geometry columns that can hold polygons."""
LINEAR = ("LINESTRING", "MULTILINESTRING", "GEOMETRY")
"""Types of geometry columns that can hold lines."""
POLYGONS, LINES = "polygons", "lines"
"""Words for what a file can hold: footprints, guides."""
HARMLESS_MODULES = ("rtree", "fts3", "fts4", "fts5")
"""Virtual tables that only index."""
MODULE = re.compile(r"\bUSING\s+[\"'\[`]?(\w+)", re.IGNORECASE)
CRS_NAME = re.compile(rb'"crs"\s*:.{0,100}?"name"\s*:\s*"((?:urn:ogc:def:crs:|EPSG:)[\w:.]{1,80})"', re.DOTALL)
MEMBER = re.compile(
    rb'"type"\s*:\s*"(FeatureCollection|Feature|(?:Multi)?Polygon|(?:Multi)?LineString|GeometryCollection)"'
)


def examine_vector(path: Path) -> dict[str, Any]:
    """The facts of a file of footprints or guides; see `service.preflight.examine`.

    Raises
    ------
    UnreadableInputError, CrsError
        Not the format that its name says, damaged, or built to harm.
    EmptyInputError
        No features, or neither polygons nor lines.
    TooLargeError
        More bytes than allowed.
    """
    suffix = path.suffix.lower()
    limit = GEOJSON_LIMIT if suffix in (*GEOJSON_SUFFIXES, *LINES_SUFFIXES, *XML_SUFFIXES) else GEOPACKAGE_LIMIT
    size = path.stat().st_size
    if size > limit:
        raise TooLargeError(
            f"{path.name} has {size} bytes, footprints or guides in {suffix} may have {limit}: "
            "cut out the area of the points"
        )
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    refuse_unread(path, head)
    if suffix == ".shp":
        if not head.startswith(SHAPE_MAGIC):
            raise UnreadableInputError(str(path), f"not a Shapefile: it begins with {head[:4]!r}", FIX)
        return _facts("shapefile", None, None, None, [], (POLYGONS, LINES))
    if suffix == ".fgb":
        if not head.startswith(FLATGEOBUF_MAGIC):
            raise UnreadableInputError(str(path), f"not a FlatGeobuf: it begins with {head[:8]!r}", FIX)
        return _facts("flatgeobuf", None, None, None, [], (POLYGONS, LINES))
    if suffix in XML_SUFFIXES:
        ending = xml_ending(head)
        if ending is None:
            raise UnreadableInputError(str(path), f"neither GML nor KML: it begins with {head[:16]!r}", FIX)
        return _facts(ending[1:], None, None, None, [], (POLYGONS, LINES))
    if suffix in ARCHIVE_SUFFIXES:
        return _archive(path, head)
    if suffix == ".gpkg":
        if not head.startswith(SQLITE_MAGIC) or head[68:72] not in APPLICATION_IDS:
            raise UnreadableInputError(str(path), f"not a GeoPackage: it begins with {head[:16]!r}", FIX)
        return _geopackage(path)
    if suffix in PARQUET_SUFFIXES:
        from service.parquet import parquet_facts

        rows, column, crs, types = parquet_facts(path)
        linear = ["LineString" in one for one in types]
        shapes = _shapes(not all(linear) or not types, any(linear) or not types)
        return _facts("geoparquet", rows, [column], crs, [], shapes)
    return _geojson(path, head)


def _shapes(has_polygons: bool, has_lines: bool) -> tuple[str, ...]:
    """The words for what a file can hold."""
    return (*((POLYGONS,) if has_polygons else ()), *((LINES,) if has_lines else ()))


def _facts(
    kind: str,
    count: int | None,
    layers: list[str] | None,
    crs: dict[str, Any] | None,
    problems: list[str],
    shapes: tuple[str, ...],
) -> dict[str, Any]:
    return {
        "kind": "footprints" if POLYGONS in shapes else "guides",
        "shapes": list(shapes),
        "format": kind,
        "featureCount": count,
        "layers": layers,
        "crs": crs,
        "warnings": [],
        "usable": not problems,
        "problems": problems,
    }


def _archive(path: Path, head: bytes) -> dict[str, Any]:
    """A zip archive, by the vector files in it: the only one, or layers."""
    if not head.startswith(ZIP_MAGIC):
        raise UnreadableInputError(str(path), f"not a zip archive: it begins with {head[:4]!r}", FIX)
    with in_our_words(path, "a zip archive", FIX), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    size = sum(one.file_size for one in members)
    if size > GEOPACKAGE_LIMIT:
        raise TooLargeError(f"{path.name} unpacks to {size} bytes, it may have {GEOPACKAGE_LIMIT}: cut out the area")
    layers = sorted(vector_members(members))
    if not layers:
        refuse_without_vectors(path, members)
    if len(layers) > ARCHIVED_LIMIT:
        problem = f"it is a zip archive with {len(layers)} vector files: it may have 1 to {ARCHIVED_LIMIT}"
        raise UnreadableInputError(str(path), problem, FIX)
    found = []
    for layer in layers:
        with unpacked(path, layer if len(layers) > 1 else None, SHAPE_OF_FOOTPRINTS) as (file, _):
            try:
                found.append(examine_vector(file))
            except InputError as fault:
                raise fault.of(str(path), str(file)) from fault
    if len(found) == 1:
        return found[0]
    shapes = _shapes(*(any(shape in one["shapes"] for one in found) for shape in (POLYGONS, LINES)))
    return _facts("zip", None, layers, None, [_several(layers, has_polygons=POLYGONS in shapes)], shapes)


def _several(layers: Sequence[str], *, has_polygons: bool) -> str:
    """What to do about several layers."""
    if has_polygons:
        named = ", ".join(layers)
        return f"{len(layers)} layers could be the footprints: give the input footprintsLayer, one of {named}"
    return f"{len(layers)} layers could be the guides: give a file with one of them"


def _geopackage(path: Path) -> dict[str, Any]:
    """A GeoPackage, by its own tables of contents, read only and with a limit on the engine's work."""
    with in_our_words(path, "a GeoPackage", FIX), contextlib.closing(_opened(path)) as database:
        _refuse_programs(path, database)
        return _contents(path, database)


def _opened(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1", uri=True)
    database.text_factory = lambda raw: raw.decode(errors="replace")
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, VALUE_LIMIT)
    database.execute("PRAGMA trusted_schema = OFF")
    database.execute("PRAGMA cell_size_check = ON")
    steps = 0

    def count() -> int:
        nonlocal steps
        steps += 100_000
        return int(steps > STEPS_LIMIT)

    database.set_progress_handler(count, 100_000)
    return database


def _refuse_programs(path: Path, database: sqlite3.Connection) -> None:
    """Refuse virtual tables except indexes, and views as tables of the format."""
    for kind, name, statement in database.execute("SELECT type, name, sql FROM sqlite_master"):
        module = MODULE.search(str(statement)) if kind == "table" else None
        is_virtual = str(statement).lstrip().upper().startswith("CREATE VIRTUAL")
        if is_virtual and (module is None or module[1].lower() not in HARMLESS_MODULES):
            raise UnreadableInputError(str(path), f"table {str(name)[:60]!r} is a virtual table", FIX)
        if kind == "view" and str(name).lower().startswith("gpkg_"):
            raise UnreadableInputError(str(path), f"{str(name)[:60]!r} is a view, not a table", FIX)


def _contents(path: Path, database: sqlite3.Connection) -> dict[str, Any]:
    """Layers with polygons, or with lines if there are none, their features and CRS."""
    rows = database.execute(
        "SELECT c.table_name, upper(g.geometry_type_name), s.srs_name, upper(s.organization), "
        "s.organization_coordsys_id "
        "FROM gpkg_contents c JOIN gpkg_geometry_columns g ON lower(g.table_name) = lower(c.table_name) "
        "LEFT JOIN gpkg_spatial_ref_sys s ON s.srs_id = g.srs_id WHERE c.data_type = 'features' LIMIT 1000"
    ).fetchall()
    polygons, lines = ([row for row in rows if row[1] in types] for types in (POLYGONAL, LINEAR))
    found, shapes = polygons or lines, _shapes(bool(polygons), bool(lines))
    if not found:
        raise EmptyInputError(str(path), f"none of its {len(rows)} layers can hold polygons or lines", FIX)
    for row in {*polygons, *lines}:
        _check_table(path, database, str(row[0]))
    layers = [str(row[0]) for row in found]
    if len(found) != 1:
        return _facts("geopackage", None, layers, None, [_several(layers, has_polygons=bool(polygons))], shapes)
    table = layers[0].replace('"', '""')
    count = int(database.execute(f'SELECT count(*) FROM "{table}"').fetchone()[0])  # noqa: S608 - quoted; SQLite takes no names as parameters
    if count == 0:
        raise EmptyInputError(str(path), f"layer {layers[0][:60]!r} has no features", FIX)
    _, _, name, organization, code = found[0]
    crs = None if name is None else {"name": str(name)[:200], "epsg": int(code) if organization == "EPSG" else None}
    return _facts("geopackage", count, layers, crs, [], shapes)


def _check_table(path: Path, database: sqlite3.Connection, name: str) -> None:
    """Refuse a layer that is a view, or computes a column."""
    kinds = database.execute("SELECT type FROM sqlite_master WHERE lower(name) = lower(?)", (name,)).fetchall()
    if [kind for (kind,) in kinds] != ["table"]:
        raise UnreadableInputError(str(path), f"layer {name[:60]!r} is a view or is not there", FIX)
    hidden = database.execute("SELECT count(*) FROM pragma_table_xinfo(?) WHERE hidden <> 0", (name,)).fetchone()
    if hidden[0]:
        raise UnreadableInputError(str(path), f"layer {name[:60]!r} has computed columns", FIX)


def _geojson(path: Path, head: bytes) -> dict[str, Any]:
    """GeoJSON, by one pass over its brackets."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().removeprefix(RECORD)
    if not text.startswith(b"{"):
        raise UnreadableInputError(str(path), f"not GeoJSON: it begins with {head[:16]!r}", FIX)
    member = MEMBER.search(text)
    if member is None:
        raise UnreadableInputError(str(path), "no GeoJSON object in its first 64 KiB", FIX)
    refuse_links(path)
    depth, count = 0, 0
    for levels, features in _levels(path):
        low, high, last = levels
        if depth + high > DEPTH_LIMIT:
            raise UnreadableInputError(str(path), f"nested more than {DEPTH_LIMIT} levels deep", FIX)
        if depth + low < 0:
            raise UnreadableInputError(str(path), "more brackets are closed than opened", FIX)
        depth += last
        count += features
    if depth != 0:
        raise UnreadableInputError(str(path), f"truncated: {depth} brackets are not closed", FIX)
    if member[1] == b"FeatureCollection" and count == 0:
        raise EmptyInputError(str(path), "the collection has no features", FIX)
    is_parsed = path.stat().st_size <= PARSED_BYTES and not is_lines(path)
    shapes = _shapes_within(path) if is_parsed else (POLYGONS, LINES)
    named = CRS_NAME.search(text)
    name = named[1].decode() if named else "WGS 84 (CRS84)"
    code = re.search(r"EPSG:(?:[\d.]*:)?(\d{4,6})$", name)
    crs = {"name": name, "epsg": int(code[1]) if code else None}
    if code:
        parse_crs(f"EPSG:{code[1]}", path=str(path))
    return _facts("geojson", max(count, 1), None, crs, [], shapes)


def _shapes_within(path: Path) -> tuple[str, ...]:
    """What GeoJSON holds; refuses what is not JSON, or has neither. Its depth is known to be small."""

    def number(word: str) -> float:
        value = float(word)
        if not math.isfinite(value):
            problem = f"cannot be read as JSON: {shortened(word)} is not a number that can be held"
            raise UnreadableInputError(str(path), problem, FIX)
        return value

    # text that is not UTF-8 is looked at by the reader
    text = path.read_bytes().decode("utf-8-sig", errors="replace")
    with in_our_words(path, "JSON", FIX):
        document = json.loads(text, parse_constant=number, parse_float=number, parse_int=number)
    found = document["features"] if isinstance(document.get("features"), list) else [document]
    shapes = _shapes(*(any(_holds(one, shape) for one in found) for shape in ("Polygon", "LineString")))
    if not shapes:
        problem = f"none of its {len(found)} features is a polygon with a ring or a line"
        raise EmptyInputError(str(path), problem, FIX)
    return shapes


def _holds(found: Any, shape: str) -> bool:
    """Whether a feature or a geometry has a polygon with a ring of at least four positions, or a line of two."""
    if not isinstance(found, dict):
        return False
    parts, kind = found.get("coordinates"), found.get("type")
    is_whole = _is_ringed if shape == "Polygon" else _is_line
    if kind == "Feature":
        return _holds(found.get("geometry"), shape)
    if kind == "GeometryCollection":
        members = found.get("geometries")
        return isinstance(members, list) and any(_holds(one, shape) for one in members)
    if kind == f"Multi{shape}":
        return isinstance(parts, list) and any(map(is_whole, parts))
    return bool(kind == shape) and is_whole(parts)


def _is_ringed(rings: Any) -> bool:
    """Whether the first of a polygon's rings has four positions or more, all of numbers."""
    return isinstance(rings, list) and bool(rings) and _is_line(rings[0], 4)


def _is_line(places: Any, fewest: int = 2) -> bool:
    """Whether there are so many positions or more, all of numbers."""
    if not isinstance(places, list) or len(places) < fewest:
        return False
    return all(
        isinstance(place, list) and len(place) >= 2 and all(type(value) is float for value in place) for place in places
    )


def _levels(path: Path) -> Iterator[tuple[tuple[int, int, int], int]]:
    """For each block of the file: lowest, highest and last level of brackets relative to its start; its features."""
    in_text, rest = False, b""
    with path.open("rb") as stream:
        while block := rest + stream.read(BLOCK_BYTES - len(rest)):
            if len(block) == len(rest):
                rest = b""  # the end: an escape without its character
                continue
            # An escape must not be cut in two.
            slashes = len(block) - len(block.rstrip(b"\\"))
            rest = block[-1:] if slashes % 2 else b""
            body = re.sub(rb"\\.", b"__", block[: len(block) - len(rest)], flags=re.DOTALL)
            raw = np.frombuffer(body, dtype=np.uint8)
            quotes = np.cumsum(raw == ord('"')) + int(in_text)
            outside = quotes % 2 == 0
            if len(quotes):
                in_text = bool(quotes[-1] % 2)
            opened = ((raw == ord("{")) | (raw == ord("["))) & outside
            closed = ((raw == ord("}")) | (raw == ord("]"))) & outside
            steps = np.cumsum(opened.astype(np.int64) - closed)
            if len(steps):
                yield (int(steps.min()), int(steps.max()), int(steps[-1])), body.count(b'"Feature"')
