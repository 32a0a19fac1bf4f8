"""Requests whose files are not stored yet.

Files that come within a request (base64, GeoJSON) become uploads before the job is made; until then it is a `Draft`.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any
from urllib.parse import unquote, urlsplit

from service.jobs import InputReference, JobRequest

_UPLOAD = re.compile(r"(?:.*/)?uploads/([0-9a-f]{32})/?")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inline:
    """A file within the request."""

    content: bytes
    filename: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Draft:
    """A request whose inline files are not stored yet."""

    tiles: tuple[InputReference | Inline, ...]
    """Point clouds."""
    footprints: InputReference | Inline | None
    """Outlines."""
    guides: InputReference | Inline | None = None
    """Lines of roofs."""
    priority: int
    """Higher runs first."""
    values: Mapping[str, Any]
    """The other fields of the `JobRequest`."""

    def request(self, stored: Mapping[Inline, InputReference]) -> JobRequest:
        """The request, once inline files are uploads."""

        def placed(source: InputReference | Inline) -> InputReference:
            return stored[source] if isinstance(source, Inline) else source

        footprints, guides = (None if one is None else placed(one) for one in (self.footprints, self.guides))
        tiles = tuple(placed(tile) for tile in self.tiles)
        return JobRequest(tiles=tiles, footprints=footprints, guides=guides, **self.values)

    @property
    def inline(self) -> tuple[Inline, ...]:
        """The files that must be stored."""
        sources = (*self.tiles, self.footprints, self.guides)
        return tuple(dict.fromkeys(source for source in sources if isinstance(source, Inline)))


def reference_of(href: str) -> InputReference | None:
    """The meaning of an href: an upload of this service, a path, or a URL; None for anything else.

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
