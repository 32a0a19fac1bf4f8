"""The fsspec file system that answers for a URL.

What a store needs to know (endpoint, profile, region, keys) comes from the environment, as botocore reads it, and is
never part of a URL, a task or `run.json`.
"""

from __future__ import annotations

import dataclasses
import logging
import os
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from pipeline.errors import RunError
from pipeline.io.locations import shown

CONNECT_S = 10.0
"""A server that does not take a connection within so long is not there."""
READ_S = 60.0
"""One that says nothing for so long will say nothing any more: a request moves 16 MiB at most."""
REQUEST_S = 3600.0
"""Seconds for one request in all, however often a byte comes."""
WHOLE_S = 86_400.0
"""The same for a whole file, from a server that does not send parts."""


def _s3_options() -> dict[str, Any]:
    """How s3fs is to behave. Retries are ours alone: three layers of them would multiply."""
    return {
        "anon": os.environ.get("AWS_NO_SIGN_REQUEST", "").upper() in {"YES", "TRUE", "1"},
        "use_listings_cache": False,
        "config_kwargs": {
            "connect_timeout": CONNECT_S,
            "read_timeout": READ_S,
            "retries": {"total_max_attempts": 1},
        },
    }


def _http_options() -> dict[str, Any]:
    """How fsspec's HTTP is to behave: a generous limit on a whole download, and one on each silence."""
    # proxies as everywhere: HTTPS_PROXY, NO_PROXY
    return {"client_kwargs": {"timeout": _http_timeout(WHOLE_S), "trust_env": True}, "use_listings_cache": False}


def _http_timeout(total_s: float) -> Any:
    import aiohttp

    return aiohttp.ClientTimeout(total=total_s, sock_connect=CONNECT_S, sock_read=READ_S)


def range_options(url: str) -> dict[str, Any]:
    """Options of fsspec's `open` by which each request for a part of the file has its own limit of time."""
    return {"timeout": _http_timeout(REQUEST_S)} if url.lower().startswith("http") else {}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scheme:
    """A URL scheme."""

    options: Callable[[], dict[str, Any]]
    """Makes the options of the file system when it is used."""
    module: str
    """What must be installed."""
    extra: str | None = None
    """The extra of the package that brings it; None where it is always there."""
    stores: bool = False
    """Whether things can be put there, and are listed."""


SCHEMES: Mapping[str, Scheme] = MappingProxyType(
    {
        "s3": Scheme(options=_s3_options, module="s3fs", extra="s3", stores=True),
        "https": Scheme(options=_http_options, module="aiohttp"),
        "http": Scheme(options=_http_options, module="aiohttp"),
    }
)
"""The schemes that are understood."""


def scheme_of(url: str) -> Scheme:
    """The scheme of a URL; raises RunError for one that is not in `SCHEMES`."""
    name = url.partition("://")[0].lower()
    if name not in SCHEMES:
        raise RunError(f"{shown(url)}: {name}:// is not supported. Use {', '.join(SCHEMES)}://, or a path")
    return SCHEMES[name]


class _LostConnections(logging.Filter):
    """Drops asyncio's report that a task of aiohttp lost its connection: the request fails, too, and is tried again."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record is shown."""
        error = record.exc_info[1] if record.exc_info else None
        return not isinstance(error, ConnectionError)


_LOST_CONNECTIONS = _LostConnections()


def filesystem_of(url: str) -> Any:
    """The fsspec file system of a URL; one instance serves a whole process.

    Raises RunError if the scheme is unknown, or its library is not installed.
    """
    scheme = scheme_of(url)
    import fsspec

    name = url.partition("://")[0].lower()
    try:
        filesystem = fsspec.filesystem(name, **scheme.options())
    except ImportError as error:
        fix = f"Install gablework[{scheme.extra}]" if scheme.extra else f"Install {scheme.module}"
        raise RunError(f"{shown(url)}: {name}:// needs {scheme.module}, which is not installed. {fix}") from error
    filesystem.retries = 1  # s3fs has a loop of its own around each request
    logging.getLogger("asyncio").addFilter(_LOST_CONNECTIONS)  # adds it once
    return filesystem
