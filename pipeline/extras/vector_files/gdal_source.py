"""A vector file as GDAL is given it: with the one format that it may be, alone in a folder where it must be.

Left to itself GDAL goes by content, and there are formats that name other files and servers to read.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.errors import UnreadableInputError
from pipeline.extras.vector_files.vector_text import BYTES
from pipeline.io.formats import CONVERT, UNREAD_VECTORS, first_bytes
from pipeline.io.library_faults import in_our_words
from pipeline.io.temporary import temporary_folder

VALID = (
    "Valid are GeoPackage (.gpkg), GeoJSON (.geojson, .json), lines of GeoJSON (.geojsonl), Shapefile (.shp with .shx "
    "and .dbf), FlatGeobuf (.fgb), GML (.gml), KML (.kml), GeoParquet (.parquet), and a zip archive of one of them "
    "(.zip, .kmz)"
)
WHAT = "vector data"
GEOJSON, GEOJSON_LINES = "GeoJSON:", "GeoJSONSeq:"
SHAPE_MAGIC, FLATGEOBUF_MAGIC = b"\0\0\x27\x0a", b"fgb\x03fgb"
PREFIXES = {b"SQLi": "GPKG:", SHAPE_MAGIC: "", FLATGEOBUF_MAGIC: ""}
"""What GDAL is given before the path, by a file's first bytes; text in braces is GeoJSON, and in angles GML or KML."""
RECORD = b"\x1e"
"""Begins each line of GeoJSON text sequences (RFC 8142), if their writer keeps to it."""
LINE_LIMIT = 2**24
"""Bytes of a first line that may be a feature of its own."""
_XML = {".gml": re.compile(rb"opengis\.net/gml\b"), ".kml": re.compile(rb"<(?:\w+:)?kml\b")}
"""What is found in the first bytes of XML, by its ending."""
_ELSEWHERE = re.compile(rb"<!(?:DOCTYPE|ENTITY)|<(?:\w+:)?NetworkLink\b")
"""XML whose content is in other files, or may be."""
_OTHERS = (
    (re.compile(rb"SQLite format 3(?s:.{53})(?!GPKG|GP1[01])(?!(?s:.*)gpkg_)"), UNREAD_VECTORS[".sqlite"]),
    (re.compile(rb"\s*\{(?s:.*)spec/json-fg"), "JSON-FG"),
    (re.compile(rb"!table\s", re.IGNORECASE), UNREAD_VECTORS[".tab"]),
    (re.compile(rb"version\s+\d+\s", re.IGNORECASE), UNREAD_VECTORS[".mif"]),
)
"""Formats that are not read, by the first bytes."""
_POINTER = re.compile(rb"<OGR[A-Z]")
"""Begins XML that names other files or servers; GDAL looks for it anywhere in the first bytes."""
HEAD_BYTES = 2**16
"""Bytes in which a namespace is looked for, and such XML: more than GDAL looks at."""
_CRS = re.compile(rb'"(?:c|\\u00[46]3)(?:r|\\u00[57]2)(?:s|\\u00[57]3)"\s*:\s*(?=\{)', re.IGNORECASE)
"""A member `crs` of GeoJSON, its letters escaped or not; GDAL takes small and capital ones."""
_CRS_BYTES = 4096
"""Maximum length of such a member that is an object."""
_FETCHED = frozenset({"link", "url"})
"""Types of a CRS that GDAL would fetch from a server."""
_NAME_IT = 'Name the CRS: "crs": { "type": "name", "properties": { "name": "EPSG:28992" } }'


class GdalSource(NamedTuple):
    """A file as GDAL is given it."""

    name: str
    """Path, behind the prefix of its format."""
    states_encoding: bool = False
    """Whether its text may be in an encoding that it states: a Shapefile's, by a .cpg file or in the .dbf."""

    @property
    def is_one_document(self) -> bool:
        """Whether it is GeoJSON, which has one layer, and is parsed at each look."""
        return self.name.startswith(GEOJSON)


@contextlib.contextmanager
def gdal_source(path: Path) -> Iterator[GdalSource]:
    """The file for as long as GDAL reads it.

    Raises UnreadableInputError if it is of no format that is read, or names a server that knows its CRS.
    """
    where = path.resolve()
    begin = first_bytes(path)
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    refuse_unread(path, head)
    prefix = next((prefix for magic, prefix in PREFIXES.items() if begin.startswith(magic)), None)
    text = begin.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith((b"{", RECORD)):
        refuse_links(path)
        prefix = GEOJSON_LINES if is_lines(path) else GEOJSON
    if not prefix and _POINTER.search(head):
        raise UnreadableInputError(str(path), f"cannot be read as {WHAT}: it may name other files or servers", VALID)
    if prefix is not None:
        yield GdalSource(f"{prefix}{where.as_posix()}", states_encoding=begin.startswith(SHAPE_MAGIC))
    elif ending := xml_ending(head):
        with _alone(where, ending) as name:
            yield GdalSource(name)
    else:
        raise UnreadableInputError(str(path), f"cannot be read as {WHAT}: it begins with {begin[:8]!r}", VALID)


def refuse_unread(path: Path, head: bytes) -> None:
    """Refuse a file that begins as a vector format that is not read; raises UnreadableInputError."""
    if other := next((name for pattern, name in _OTHERS if pattern.match(head)), None):
        raise UnreadableInputError(str(path), f"{other} is not read", CONVERT)


def xml_ending(head: bytes) -> str | None:
    """The ending of GML or KML, by a file's first bytes; None if it is neither."""
    if not head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"<"):
        return None
    return next((ending for ending, pattern in _XML.items() if pattern.search(head)), None)


@contextlib.contextmanager
def _alone(path: Path, ending: str) -> Iterator[str]:
    """GML or KML under a name in a folder of its own, for GDAL leaves a file beside GML that describes it.

    Once that is there, or a schema, no server is asked for one.
    """
    import pyogrio

    with path.open("rb") as stream:
        if found := _ELSEWHERE.search(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)):
            named = found[0].decode()
            raise UnreadableInputError(str(path), f"it is XML with entities of its own or links: {named}", VALID)
    with temporary_folder() as folder:
        name = folder / (path.stem + ending)
        name.symlink_to(path)
        schema = path.with_suffix(".xsd")
        if schema.is_file():
            name.with_suffix(".xsd").symlink_to(schema)
        options = {"WRITE_GFS": "YES", "DOWNLOAD_SCHEMA": "NO"} if ending == ".gml" else {}
        with in_our_words(path, WHAT, VALID):
            driver = pyogrio.read_info(name, encoding=BYTES, **options)["driver"]
        kind = ending[1:].upper()
        if driver.removeprefix("LIB") != kind:
            raise UnreadableInputError(str(path), f"cannot be read as {WHAT}: it is {driver}, not {kind}", VALID)
        yield name.as_posix()


def is_lines(path: Path) -> bool:
    """Whether text that begins with a brace has a feature in each line, and is not one document."""
    with path.open("rb") as stream:
        line = stream.readline(LINE_LIMIT).removeprefix(b"\xef\xbb\xbf").strip()
        has_more = bool(stream.read(HEAD_BYTES).strip())
    if line.startswith(RECORD):
        return True
    if not (has_more and line.endswith(b"}")):
        return False
    try:
        return isinstance(json.loads(line), dict)
    except (ValueError, RecursionError):
        return False


def refuse_links(path: Path) -> None:
    """Refuse GeoJSON that names its CRS by a link: GDAL would fetch it from whatever server that is.

    Raises UnreadableInputError.
    """
    with path.open("rb") as stream:
        content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    for found in _CRS.finditer(content):
        text = content[found.end() : found.end() + _CRS_BYTES].decode(errors="replace")
        kinds = _kinds_of(text)
        if kinds is None:
            raise UnreadableInputError(
                str(path), f"its member crs is not an object of JSON within {_CRS_BYTES} bytes: {text[:40]!r}", _NAME_IT
            )
        if not _FETCHED.isdisjoint(kinds):
            raise UnreadableInputError(
                str(path), f"its member crs is a link, which is not followed: {text[:80]!r}", _NAME_IT
            )


def _kinds_of(text: str) -> set[str] | None:
    """The values of all members `type` of the object that a text begins with; None if it begins with none."""
    kinds: set[str] = set()

    def collect(pairs: list[tuple[str, Any]]) -> None:
        kinds.update(str(value).strip().lower() for key, value in pairs if key.lower() == "type")

    try:
        json.JSONDecoder(object_pairs_hook=collect, parse_int=float).raw_decode(text)
    except (ValueError, RecursionError):
        return None
    return kinds
