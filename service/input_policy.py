"""Which paths, URLs and CRS a job may name. Pure, except that paths are looked up.

Hosts are listed in the setting `input_hosts`, each as an origin:

- `data.example.org` means `https://data.example.org` on its default port only;
- `data.example.org:8443` means https on that port;
- `http://10.0.0.7:9000` means plain http, for networks that use it on purpose.

A listed host is trusted, including the addresses of its name and its redirects to listed hosts.
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import TYPE_CHECKING

import httpx

from pipeline.errors import CrsError, UnreadableInputError
from pipeline.io.crs_given import BARE_CODE, parse_crs
from service.errors import InputRefusedError, StartUpError
from service.settings import ServiceSettings

if TYPE_CHECKING:
    import pyproj

PORTS = {"https": 443, "http": 80}
"""Ports of the schemes that are fetched."""
LONGEST_URL = 4096

CRS_FORMS = (
    BARE_CODE,
    re.compile(r"[A-Za-z_]{2,20}:{1,2}[A-Za-z0-9_.]{1,20}(\+\d{4,6})?"),  # EPSG:28992, EPSG:28992+5709
    re.compile(r"urn:ogc:def:crs:\w{2,20}:[\d.]{0,20}:\w{1,20}|urn:ogc:def:crs(,crs:\w{2,20}:[\d.]{0,20}:\w{1,20}){2}"),
    re.compile(
        r"(PROJ|GEOD|GEOG|COMPOUND|BOUND|DERIVEDPROJ)(CRS|EDCRS)\s*\[.*|(PROJ|GEOG|COMPD_|GEOC)CS\s*\[.*", re.DOTALL
    ),
    re.compile(r"https?://www\.opengis\.net/def/crs/\w{2,20}/[\d.]{1,10}/\w{1,20}"),
    re.compile(r"\{.*\}", re.DOTALL),
    re.compile(r"\+proj=[A-Za-z0-9_+=.,\s-]*"),
)
"""An EPSG code, authority and code, URN, WKT, the OGC's URI, PROJJSON, and PROJ strings without paths of files."""
CRS_FILES = re.compile(r"grids|\+init|PARAMETERFILE", re.IGNORECASE)
"""Words that make PROJ open files."""

Origin = tuple[str, str, int]
"""Scheme, host in lower case, port."""


def checked_crs(text: str, *, path: str) -> pyproj.CRS:
    """The CRS that a client names, as authority and code, URN, WKT, PROJJSON or PROJ string; `path` is for messages.

    PROJ takes any other text as a name and searches its whole database for the nearest one, which blocks everything
    else; and some texts make it open files. Such texts are refused here.

    Raises
    ------
    CrsError
        It is another text, or PROJ does not understand it.
    """
    text = text.strip()
    if not any(form.fullmatch(text) for form in CRS_FORMS) or CRS_FILES.search(text):
        raise CrsError(
            path,
            f"{text[:80]!r} is not a code, WKT, PROJJSON or plain PROJ string of a CRS",
            "Give one such as EPSG:28992",
        )
    return parse_crs(text, path=path)


def check_hosts(settings: ServiceSettings) -> None:
    """Check the entries of `input_hosts` and `webhook_hosts` when a process starts.

    Raises
    ------
    StartUpError
        One of them is not a host.
    """
    for setting in ("input_hosts", "webhook_hosts"):
        for entry in getattr(settings, setting):
            origin_of(entry, setting)


def check_roots(settings: ServiceSettings) -> None:
    """Check the entries of `input_roots` when a process starts; a folder may be mounted later.

    Raises
    ------
    StartUpError
        One of them is not a folder.
    """
    for root in settings.input_roots:
        if root.exists() and not root.is_dir():
            raise StartUpError(f"input_roots has {root}, which is not a folder: name the folder that holds the inputs")


def origin_of(entry: str, setting: str = "input_hosts") -> Origin:
    """The origin of an entry of a setting.

    Raises
    ------
    StartUpError
        It is not a host.

    >>> origin_of("Data.Example.org")
    ('https', 'data.example.org', 443)
    >>> origin_of("http://127.0.0.1:8080")
    ('http', '127.0.0.1', 8080)
    """
    try:
        url = httpx.URL(entry if "://" in entry else f"https://{entry}")
        origin = _origin(url)
    except (httpx.InvalidURL, ValueError):
        origin = None
    if origin is None or url.userinfo or url.raw_path not in {b"", b"/"} or url.fragment or "*" in entry:
        raise StartUpError(f"{setting} has {entry!r}: write a host, host:port or http://host:port")
    return origin


def _origin(url: httpx.URL) -> Origin | None:
    """The origin of a URL; None if it has no host or another scheme."""
    if url.scheme not in PORTS or not url.host:
        return None
    return url.scheme, url.host.lower(), url.port or PORTS[url.scheme]


def checked_url(text: str, settings: ServiceSettings) -> httpx.URL:
    """The URL, if it leads to a listed host.

    Raises
    ------
    InputRefusedError
        It does not, or it is not a URL. The message does not repeat passwords or queries.
    """
    try:
        url = httpx.URL(text) if len(text) <= LONGEST_URL and text.isprintable() else None
    except (httpx.InvalidURL, ValueError):
        url = None
    origin = None if url is None else _origin(url)
    if url is None or origin is None:
        # text before an @ or after a ? may be secret
        public = text.rpartition("@")[2].partition("?")[0]
        raise InputRefusedError(f"{public[:80]!r} is not a URL that can be fetched: give https://host/path")
    if url.userinfo:
        raise InputRefusedError(f"{shown(url)} contains a user or password: give a URL without them")
    allowed = {origin_of(entry) for entry in settings.input_hosts}
    if origin not in allowed:
        names = ", ".join(settings.input_hosts) or "none"
        raise InputRefusedError(
            f"{shown(url)}: the host {origin[0]}://{origin[1]}:{origin[2]} is not one from which inputs are fetched "
            f"({names}): upload the file, or add the host to GABLEWORK_INPUT_HOSTS"
        )
    return url


def shown(url: httpx.URL) -> str:
    """The URL without its secret parts.

    >>> shown(httpx.URL("https://me:pass@example.org/a.laz?token=1"))
    'https://example.org/a.laz'
    """
    return str(url.copy_with(username=None, password=None, query=None, fragment=None))


def checked_path(text: str, settings: ServiceSettings) -> Path:
    """The path with its links resolved, if it is a file below one of the roots.

    Nothing is revealed about paths outside the roots.

    Raises
    ------
    InputRefusedError
        Not absolute, or it leads out of the roots.
    UnreadableInputError
        Below a root, but not a file that can be opened.
    """
    if "\0" in text or not text.startswith("/"):
        raise InputRefusedError(f"{text[:200]!r} is not an absolute path")
    resolved = Path(os.path.realpath(text))
    roots = [Path(os.path.realpath(root)) for root in settings.input_roots]
    if not any(resolved != root and resolved.is_relative_to(root) for root in roots):
        raise InputRefusedError(
            f"{text[:200]!r} is not below a folder from which inputs are read "
            f"({', '.join(map(str, settings.input_roots)) or 'none'}): upload the file, or add its folder to "
            "GABLEWORK_INPUT_ROOTS"
        )
    try:
        # only opening it shows whether it can be read; non-blocking, since a pipe would wait for its writer
        handle = os.open(resolved, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError as fault:
        raise UnreadableInputError(text[:200], f"cannot be read ({fault.strerror})", "Check the path") from fault
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise UnreadableInputError(text[:200], "not a file", "Name the files one by one")
        _check_same(text, handle, resolved)
    finally:
        os.close(handle)
    return resolved


def _check_same(text: str, handle: int, resolved: Path) -> None:
    """Refuse a path whose target has just changed."""
    opened, now = os.fstat(handle), resolved.stat()
    if (opened.st_dev, opened.st_ino) != (now.st_dev, now.st_ino) or Path(os.path.realpath(resolved)) != resolved:
        raise InputRefusedError(f"{text[:200]!r} changes while it is checked")
