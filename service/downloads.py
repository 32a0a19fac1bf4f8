"""Files behind URLs: fetched as they are, within limits, from listed hosts only.

Nothing is decompressed on the way: a body with a content encoding is refused, so it cannot grow. Each redirect is
checked like the first URL.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import unquote

import httpx

from pipeline.errors import RunCancelledError, UnreadableInputError
from service.disk import FULL, Disk
from service.errors import NoSpaceError, TooLargeError
from service.filenames import clean_filename
from service.input_policy import checked_url, shown
from service.settings import ServiceSettings

ATTEMPTS = 4
"""Attempts to fetch a file."""
FIRST_PAUSE_S = 1.0
"""Seconds before the second attempt; each further pause is four times the one before."""
LONGEST_PAUSE_S = 60.0
PASSING = frozenset({408, 425, 429, 500, 502, 503, 504})
"""Status codes after which another attempt may help."""
REDIRECTS = frozenset({301, 302, 303, 307, 308})
MAX_REDIRECTS = 3
CONNECT_S = 10.0
READ_S = 30.0
"""Seconds without a byte after which a server counts as silent."""
FETCH_S = 3600.0
"""Seconds for one whole file; a slow server cannot hold a job for longer."""
PIECE_BYTES = 1 << 18

Cancel = Callable[[], bool]
"""Whether the job was cancelled."""


def pause_s(attempt: int, *, status: int | None, retry_after: str | None = None) -> float | None:
    """Seconds to wait after a failed attempt; None if another one cannot help.

    Parameters
    ----------
    attempt : int
        The attempt that failed, from 1.
    status : int or None
        Status of the answer; None without an answer.
    retry_after : str, optional
        The header; dates are not read.

    >>> [pause_s(attempt, status=503) for attempt in (1, 2, 3, 4)]
    [1.0, 4.0, 16.0, None]
    >>> pause_s(1, status=404) is None
    True
    """
    if attempt >= ATTEMPTS or (status is not None and status not in PASSING):
        return None
    wanted = float(retry_after) if retry_after is not None and retry_after.isascii() and retry_after.isdigit() else 0.0
    return min(max(FIRST_PAUSE_S * 4.0 ** (attempt - 1), wanted), LONGEST_PAUSE_S)


class _PassingError(Exception):
    """An attempt that failed and may succeed next time."""

    def __init__(self, problem: str, status: int | None, retry_after: str | None = None) -> None:
        self.problem = problem
        self.status = status
        self.retry_after = retry_after
        super().__init__(problem)


def name_of(url: httpx.URL) -> str:
    """The file's name at the end of a URL, cleaned.

    Raises
    ------
    RequestError
        It does not end in the name of a supported file.
    """
    return clean_filename(unquote(url.path.rsplit("/", 1)[-1]))


def download(text: str, *, settings: ServiceSettings, target: Path, cancelled: Cancel) -> tuple[Path, str]:
    """Fetch a file into a folder of its own below `target`, since two URLs may end in the same name.

    The result is the file and its SHA-256, hexadecimal; `cancelled` is called often.

    Raises
    ------
    InputRefusedError
        The URL or one of its redirects is not on a listed host.
    TooLargeError
        More bytes than allowed.
    NoSpaceError
        The disk is full, or only its reserve is free.
    UnreadableInputError
        The server does not deliver it.
    RunCancelledError
        The job was cancelled.
    """
    url = checked_url(text, settings)
    place = target / hashlib.sha256(text.encode()).hexdigest()[:16]
    place.mkdir(parents=True, exist_ok=True)
    path = place / name_of(url)
    # No proxies, cookies or .netrc from the environment: they could divert the checked URL.
    timeout = httpx.Timeout(READ_S, connect=CONNECT_S)
    with httpx.Client(timeout=timeout, trust_env=False, verify=httpx.create_ssl_context()) as client:
        attempt = 1
        while True:
            try:
                return path, _try(client, url, path, settings, cancelled)
            except _PassingError as fault:
                wait_s = pause_s(attempt, status=fault.status, retry_after=fault.retry_after)
                if wait_s is None:
                    problem = f"{fault.problem} (tried {attempt} times)"
                    raise UnreadableInputError(shown(url), problem, "Check the URL, or upload the file") from fault
            except OSError as fault:
                if fault.errno in FULL:
                    raise NoSpaceError(f"there is no room on the disk for {path.name}") from fault
                raise
            attempt += 1
            _pause(wait_s, cancelled)


def _pause(wait_s: float, cancelled: Cancel) -> None:
    """Wait, unless the job is cancelled."""
    until_s = time.monotonic() + wait_s
    while (left_s := until_s - time.monotonic()) > 0.0:
        _check_cancelled(cancelled)
        time.sleep(min(left_s, 0.2))


def _check_cancelled(cancelled: Cancel) -> None:
    if cancelled():
        raise RunCancelledError("the job was cancelled while its inputs were fetched")


def _try(client: httpx.Client, url: httpx.URL, path: Path, settings: ServiceSettings, cancelled: Cancel) -> str:
    """One attempt: follow redirects within the list, stream the body to the file; its SHA-256."""
    try:
        for _ in range(MAX_REDIRECTS + 1):
            _check_cancelled(cancelled)
            with client.stream("GET", url, headers={"Accept-Encoding": "identity"}) as response:
                if response.status_code not in REDIRECTS:
                    _check_answer(url, response)
                    return _stream_to(path, url, response, settings, cancelled)
                client.cookies.clear()
                url = checked_url(str(url.join(response.headers.get("location", ""))), settings)
    except (httpx.TimeoutException, httpx.NetworkError, httpx.RemoteProtocolError) as fault:
        raise _PassingError(f"the server does not answer ({type(fault).__name__})", None) from fault
    except (httpx.HTTPError, httpx.InvalidURL) as fault:
        raise UnreadableInputError(shown(url), f"cannot be fetched ({fault})", "Check the URL") from fault
    raise UnreadableInputError(shown(url), f"redirects more than {MAX_REDIRECTS} times", "Give the last URL")


def _check_answer(url: httpx.URL, response: httpx.Response) -> None:
    """Refuse an answer that is not a plain file."""
    status = response.status_code
    if status in PASSING:
        raise _PassingError(f"the server answers {status}", status, response.headers.get("retry-after"))
    if status != httpx.codes.OK:
        raise UnreadableInputError(shown(url), f"the server answers {status}", "Check the URL, or upload the file")
    encoding = response.headers.get("content-encoding", "identity").lower()
    if encoding != "identity":
        raise UnreadableInputError(
            shown(url), f"the server sends it with the encoding {encoding!r}", "Serve the file as it is"
        )


def _stream_to(
    path: Path, url: httpx.URL, response: httpx.Response, settings: ServiceSettings, cancelled: Cancel
) -> str:
    """The body to a file, counted; its SHA-256."""
    limit, promised = settings.max_upload_bytes, response.headers.get("content-length", "")
    until_s, size, digest = time.monotonic() + FETCH_S, 0, hashlib.sha256()
    disk = Disk(path.parent, settings.reserve_bytes)
    if promised.isdigit():
        _check_size(url, int(promised), limit)
        disk.require(int(promised), path.name)
    with _removed_on_failure(path), path.open("wb") as stream:
        for piece in response.iter_raw(PIECE_BYTES):
            _check_cancelled(cancelled)
            size += len(piece)
            _check_size(url, size, limit)
            if time.monotonic() > until_s:
                raise UnreadableInputError(shown(url), f"not fetched within {FETCH_S:g} s", "Upload the file")
            disk.require(len(piece), path.name)
            digest.update(piece)
            stream.write(piece)
        stream.flush()
        os.fsync(stream.fileno())
    return digest.hexdigest()


@contextlib.contextmanager
def _removed_on_failure(path: Path) -> Iterator[None]:
    """Leave no partial file."""
    try:
        yield
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _check_size(url: httpx.URL, size: int, limit: int) -> None:
    if size > limit:
        raise TooLargeError(
            f"{shown(url)} has {size} bytes or more, this service takes {limit}: cut it into tiles, or raise "
            "GABLEWORK_MAX_UPLOAD_BYTES"
        )
