"""Paths and URLs as texts. No secret part of a URL is ever shown."""

from __future__ import annotations

import hashlib
from urllib.parse import unquote, urlsplit, urlunsplit


def is_url(text: object) -> bool:
    """Whether something names a thing elsewhere, not a file of this machine.

    >>> is_url("s3://bucket/a.laz"), is_url("tiles/a.laz"), is_url("C:/a.laz")
    (True, False, False)
    """
    return isinstance(text, str) and "://" in text


def shown(location: str) -> str:
    """A path as it is; a URL without user and password, and with a mark in place of its query.

    The query of a signed URL is a secret; the query of a download service identifies the file. The mark identifies it
    and reveals nothing.

    >>> shown("tiles/a.laz"), shown("s3://bucket/a.laz"), shown("https://me:pw@host/a.laz")
    ('tiles/a.laz', 's3://bucket/a.laz', 'https://host/a.laz')
    >>> shown("https://host/get?file=a.laz")
    'https://host/get?query-8e09d103'
    """
    if not is_url(location):
        return location
    try:
        parts = urlsplit(location)
    except ValueError:
        return location.partition("://")[0] + "://…"
    if location.lower().startswith("s3://"):
        return location
    mark = f"query-{hashlib.sha256(parts.query.encode()).hexdigest()[:8]}" if parts.query else ""
    return urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, mark, ""))


def has_mark(location: str) -> bool:
    """Whether a shown URL had a query, and so cannot be opened again."""
    return is_url(location) and "?query-" in location


def name_in(location: str) -> str:
    """The last part of a path or URL, without its query.

    >>> name_in("https://host/a%20b.laz?token=1"), name_in("s3://bucket/tiles/"), name_in("tiles/a.laz")
    ('a b.laz', '', 'a.laz')
    """
    if not is_url(location):
        return location.rpartition("/")[2]
    if location.lower().startswith("s3://"):
        return location.rpartition("/")[2]
    return unquote(urlsplit(location).path).rpartition("/")[2]
