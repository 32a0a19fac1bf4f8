"""Requests whose files are not stored yet.

Files that come within a request (base64, GeoJSON) become uploads before the job is made; until then it is a `Draft`.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Mapping
from typing import Any
from urllib.parse import SplitResult, unquote, urlsplit

from service.jobs import InputReference, JobRequest

_UPLOAD = re.compile(r"/?uploads/([0-9a-f]{32})/?")
_PORTS = {"http": 80, "https": 443}


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

    def request(self, stored: Mapping[Inline, InputReference], bases: Collection[str]) -> JobRequest:
        """The request, once inline files are uploads; `bases` are the service's own URLs, below which uploads lie."""

        def placed(source: InputReference | Inline) -> InputReference:
            return stored[source] if isinstance(source, Inline) else own_upload(source, bases)

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

    A URL or a path of an upload is one until `own_upload` has seen the service's own URL.

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


def own_upload(source: InputReference, bases: Collection[str]) -> InputReference:
    """A URL or a path of an upload below one of the service's own URLs as that upload; anything else as it is.

    >>> source = InputReference(kind="url", value="https://example.org/models/uploads/" + "a" * 32)
    >>> own_upload(source, ["https://example.org/models"]).kind, own_upload(source, ["https://example.org"]).kind
    ('upload', 'url')
    """
    for base in bases:
        rest = _below(source, base)
        found = None if rest is None else _UPLOAD.fullmatch(rest)
        if found is not None:
            return InputReference(kind="upload", value=found.group(1))
    return source


def _below(source: InputReference, base: str) -> str | None:
    """The part of a URL or a path after that of the service; None if it is not below it."""
    own = urlsplit(base)
    if source.kind == "url":
        parts = urlsplit(source.value)
        if _origin(parts) != _origin(own) or parts.query or parts.fragment:
            return None
        path = parts.path
    elif source.kind == "path" and own.path.strip("/"):
        path = source.value
    else:
        return None
    prefix = own.path.rstrip("/")
    return path.removeprefix(prefix) if path.startswith(f"{prefix}/") else None


def _origin(parts: SplitResult) -> tuple[str, str | None, int | None, bool]:
    """Scheme, host, port, and whether there is a user or a password."""
    try:
        port = parts.port or _PORTS.get(parts.scheme)
    except ValueError:  # it is not a number
        port = None
    return parts.scheme, parts.hostname, port, "@" in parts.netloc
