"""What a client sends as a process's inputs, read one by one: every fault is told, not only the first.

Files that come within the request (base64, GeoJSON) are stored as uploads before the job is made: until then the
request is a `Draft`.
"""

from __future__ import annotations

import base64
import binascii
import dataclasses
import json
import math
import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from typing import Any
from urllib.parse import unquote, urlsplit

from pipeline.errors import CrsError
from pipeline.io.crs import horizontal_unit_of
from service import catalogue
from service.errors import RequestError
from service.input_policy import checked_crs
from service.jobs import InputReference, JobRequest

LONGEST_TEXT = 500
"""Characters of a title or a licence."""

LONGEST_CRS = 20_000
"""Characters of a CRS; WKT is long."""

LAS, LAZ, PLY, TEXT, CSV = "application/vnd.las", "application/vnd.laszip", "application/ply", "text/plain", "text/csv"

ENDINGS: Mapping[str, str] = {LAZ: ".laz", LAS: ".las", PLY: ".ply", TEXT: ".xyz", CSV: ".csv"}
"""Media types of point clouds sent by value, and how their files are called."""

_OUTLINES = {b"SQLite format 3": ".gpkg", b"PAR1": ".parquet"}
"""How footprints that are sent by value are called, by their first bytes; others are GeoJSON."""

_UPLOAD = re.compile(r"(?:.*/)?uploads/([0-9a-f]{32})/?")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inline:
    """A file that was sent within the request."""

    content: bytes
    filename: str


Reading = Callable[[str, Any], InputReference | Inline | None]
"""Reads one file of an input: its name for the faults, and what was sent."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Draft:
    """A request whose inline files are not stored yet."""

    tiles: tuple[InputReference | Inline, ...]
    """Point clouds."""
    footprints: InputReference | Inline | None
    """Outlines."""
    priority: int
    """Higher goes first."""
    values: Mapping[str, Any]
    """The other fields of the `JobRequest`."""

    def request(self, stored: Mapping[Inline, InputReference]) -> JobRequest:
        """The request, once inline files are uploads."""

        def placed(source: InputReference | Inline) -> InputReference:
            return stored[source] if isinstance(source, Inline) else source

        footprints = None if self.footprints is None else placed(self.footprints)
        return JobRequest(tiles=tuple(placed(tile) for tile in self.tiles), footprints=footprints, **self.values)

    @property
    def inline(self) -> tuple[Inline, ...]:
        """The files to be stored."""
        sources = (*self.tiles, *(() if self.footprints is None else (self.footprints,)))
        return tuple(dict.fromkeys(source for source in sources if isinstance(source, Inline)))


class Inputs:
    """Inputs of one request, read one by one; collects the faults."""

    def __init__(self, given: Mapping[str, Any]) -> None:
        self.given = given
        self.faults: list[str] = []

    def text(self, name: str, longest: int = LONGEST_TEXT) -> str | None:
        """A plain text."""
        value = self._plain(name)
        if value is None:
            return None
        if not isinstance(value, str) or not value.strip():
            self._fault(name, value, "use a text")
            return None
        if len(value) > longest:
            self._fault(name, value, f"use at most {longest} characters")
            return None
        if any(unicodedata.category(character) in {"Cs", "Cc"} for character in value if character not in "\t\r\n"):
            self._fault(name, value, "use no control characters")
            return None
        return str(value)

    def word(self, name: str, words: Sequence[str]) -> str | None:
        """One of some words."""
        value = self._plain(name)
        if value is not None and value not in words:
            self._fault(name, value, f"use one of {', '.join(words)}")
            return None
        return None if value is None else str(value)

    def integer(self, name: str, low: int, high: int) -> int:
        """A whole number, 0 where it is not given."""
        value = self._plain(name)
        if value is None:
            return 0
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self._fault(name, value, f"use a whole number from {low} to {high}")
            return 0
        return value

    def crs(self, name: str) -> str | None:
        """A projected CRS that PROJ understands."""
        value = self.text(name, LONGEST_CRS)
        if value is not None:
            try:
                horizontal_unit_of(checked_crs(value, path=name), path=name)
            except CrsError as error:
                self.faults.append(f"{name}: {error.problem}. Give a projected CRS, such as EPSG:28992")
        return value

    def settings(self, name: str) -> dict[str, Any]:
        """Tables of settings, checked."""
        value = self._plain(name)
        if value is None:
            return {}
        if not isinstance(value, Mapping):
            self._fault(name, value, "use an object, as the tables of a settings file")
            return {}
        self.faults.extend(f"{name}: {fault}" for fault in catalogue.load().faults(value))
        return dict(value)

    def bbox(self, name: str, crs: str | None) -> tuple[float, float, float, float] | None:
        """A rectangle in the tiles' CRS."""
        value = self.given.get(name)
        if isinstance(value, Mapping) and "value" in value:
            value = value["value"]
        if value is None:
            return None
        if isinstance(value, Mapping):
            told = value.get("crs")
            if told is None or crs is None or not _same_crs(str(told), crs):
                self._fault(
                    name, value, "the rectangle is read in the tiles' CRS: give the same crs here and as the input crs"
                )
                return None
            value = value.get("bbox")
        if not (
            isinstance(value, Sequence)
            and len(value) == 4
            and all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e12 for x in value)
        ):
            self._fault(name, value, "use four numbers: x_min, y_min, x_max, y_max")
            return None
        x_min, y_min, x_max, y_max = (float(x) for x in value)
        if not (x_min < x_max and y_min < y_max) or not math.isfinite(x_max - x_min):
            self._fault(name, value, "use x_min, y_min, x_max, y_max with a positive width and depth")
            return None
        return x_min, y_min, x_max, y_max

    def files(self, name: str, most: int, read: Reading) -> tuple[InputReference | Inline, ...]:
        """One or several files."""
        value = self.given.get(name)
        if value is None:
            return ()
        values = value if isinstance(value, list) else [value]
        if len(values) > most:
            self.faults.append(f"{name} has {len(values)} entries: use at most {most}")
            return ()
        placed = [read(name if len(values) == 1 else f"{name}[{n}]", entry) for n, entry in enumerate(values)]
        return tuple(entry for entry in placed if entry is not None)

    def tile(self, name: str, value: Any) -> InputReference | Inline | None:
        """A point cloud by reference or by value."""
        if isinstance(value, Mapping) and "href" in value:
            return self._reference(name, value["href"])
        media_type = None
        if isinstance(value, Mapping):
            media_type = value.get("mediaType")
            if media_type is not None and not (isinstance(media_type, str) and media_type in ENDINGS):
                self._fault(f"{name}.mediaType", media_type, f"use one of {', '.join(ENDINGS)}")
                return None
            if value.get("encoding", "base64") != "base64":
                self._fault(f"{name}.encoding", value["encoding"], "use base64")
                return None
            value = value.get("value")
        content = self._decoded(name, value)
        if content is None:
            return None
        ending = _ending_of(content) if media_type is None else ENDINGS[media_type]
        return Inline(content=content, filename=f"{re.sub('[^a-z0-9]+', '-', name).strip('-')}{ending}")

    def outlines(self, name: str, value: Any) -> InputReference | Inline | None:
        """Footprints by reference or by value."""
        if isinstance(value, Mapping) and "href" in value:
            return self._reference(name, value["href"])
        if isinstance(value, Mapping) and "value" in value:
            if value.get("encoding") == "base64":
                content = self._decoded(name, value["value"])
                if content is None:
                    return None
                ending = next((end for magic, end in _OUTLINES.items() if content.startswith(magic)), ".geojson")
                return Inline(content=content, filename=f"footprints{ending}")
            value = value["value"]
        if not isinstance(value, Mapping) or value.get("type") != "FeatureCollection":
            self._fault(name, value, "use an href, or a GeoJSON FeatureCollection")
            return None
        return Inline(content=_json(value), filename="footprints.geojson")

    def unknown(self, known: Sequence[str]) -> None:
        """Faults of names that are no inputs."""
        for name in self.given:
            if name not in known:
                self.faults.append(f"{shortened(name)} is no input: use {', '.join(known)}")

    def _plain(self, name: str) -> Any:
        value = self.given.get(name)
        if isinstance(value, list) and len(value) == 1:
            value = value[0]  # a client may write every input as a list
        if isinstance(value, Mapping) and set(value) <= {"value", "mediaType"} and "value" in value:
            return value["value"]
        return value

    def _reference(self, name: str, href: Any) -> InputReference | None:
        if not isinstance(href, str) or not href.strip() or not href.isprintable() or len(href) > 4096:
            self._fault(f"{name}.href", href, "use an upload, a URL or a path")
            return None
        reference = reference_of(href)
        if reference is None:
            self._fault(
                f"{name}.href", href, "use /uploads/{id}, an https URL, or an absolute path below an input folder"
            )
            return None
        return reference

    def _decoded(self, name: str, value: Any) -> bytes | None:
        try:
            content = base64.b64decode("".join(value.split()), validate=True) if isinstance(value, str) else b""
        except (ValueError, binascii.Error):
            content = b""
        if not content:
            self._fault(name, value, "use an href, or a value with base64 content")
            return None
        return content

    def _fault(self, name: str, value: Any, fix: str) -> None:
        self.faults.append(f"{name} is {shortened(value)}: {fix}")


def reference_of(href: str) -> InputReference | None:
    """What an href means: an upload of this service, a path, or a URL; None for anything else.

    >>> reference_of("/uploads/" + "a" * 32).kind, reference_of("file:///data/a.laz").value
    ('upload', '/data/a.laz')
    >>> reference_of("https://example.org/a.laz").kind, reference_of("../a.laz")
    ('url', None)
    """
    found = _UPLOAD.fullmatch(href)
    if found is not None:
        return InputReference(kind="upload", value=found.group(1))
    try:
        parts = urlsplit(href)
    except ValueError:
        return None
    if parts.scheme in {"https", "http"} and parts.netloc:
        return InputReference(kind="url", value=href)
    if parts.scheme == "file" and parts.netloc in {"", "localhost"} and parts.path.startswith("/"):
        return InputReference(kind="path", value=unquote(parts.path))
    if href.startswith("/"):
        return InputReference(kind="path", value=href)
    return None


def _ending_of(content: bytes) -> str:
    """How a point cloud's file is called, by its first bytes."""
    if content.startswith(b"LASF"):
        # the point format's highest bit tells compression
        return ".laz" if len(content) > 104 and content[104] & 0x80 else ".las"
    return ".ply" if content.startswith(b"ply") else ".xyz"


def _same_crs(one: str, other: str) -> bool:
    try:
        return checked_crs(one, path="bbox") == checked_crs(other, path="crs")
    except CrsError:
        return False


def _json(value: Any) -> bytes:
    """A part of a request as JSON again.

    Raises
    ------
    RequestError
        It could just be read, but is nested too deeply to be written.
    """
    try:
        return json.dumps(value, ensure_ascii=False).encode("utf-8", "replace")
    except RecursionError:
        raise RequestError(["the request is nested hundreds of levels deep: nothing that is read here is"]) from None


def shortened(value: Any) -> str:
    """A value as JSON, cut where it is long."""
    text = _json(value).decode("utf-8")
    return text if len(text) <= 80 else f"{text[:77]}..."
