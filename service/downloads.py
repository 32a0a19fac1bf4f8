"""Files behind URLs: fetched as they are, within limits, from listed hosts only.

Nothing is decompressed on the way: a body with a content encoding is refused, so it cannot grow. Each redirect is
checked like the first URL. An event loop waits for the network, so that every wait can end at once: if the job is
cancelled, if the server is slower than the settings allow, or after the time for one file.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import time
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

import httpx

from pipeline.backoff import Backoff, wanted_pause_s
from pipeline.errors import RunCancelledError, UnreadableInputError
from service.disk import FULL, MAKE_ROOM, Disk
from service.errors import NoSpaceError, TooLargeError
from service.filenames import clean_filename
from service.input_policy import checked_url, shown
from service.pace import Pace, look_s
from service.settings import ServiceSettings

BACKOFF = Backoff(first_s=1.0, longest_s=60.0, factor=4.0, attempts=4)
"""Attempts to fetch a file. A server that asks for a longer pause than the longest gets that."""
PASSING = frozenset({408, 425, 429, 500, 502, 503, 504})
"""Status codes after which another attempt may help."""
REDIRECTS = frozenset({301, 302, 303, 307, 308})
MAX_REDIRECTS = 3
CONNECT_S = 10.0
"""Seconds for the look-up of a host's name and the connection, and as many for the handshake."""
LOOK_S = 0.25
"""Longest time in seconds between looks at whether the job was cancelled."""
REPORT_S = 0.25
"""Shortest time in seconds between reports of the bytes."""
BLOCK_BYTES = 1 << 18
"""Bytes that are written at once."""

Result = TypeVar("Result")

Cancel = Callable[[], bool]
"""Whether the job was cancelled."""
OnBytes = Callable[[int], None]
"""Takes the number of bytes so far."""


def ignore_bytes(_bytes: int) -> None:
    """Do nothing."""


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
    if status is not None and status not in PASSING:
        return None
    return BACKOFF.pause_s(attempt, wanted_s=min(wanted_pause_s(retry_after), BACKOFF.longest_s))


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


def download(
    text: str, *, settings: ServiceSettings, target: Path, cancelled: Cancel, progress: OnBytes = ignore_bytes
) -> tuple[Path, str]:
    """Fetch a file into a folder of its own below `target`, since two URLs may end in the same name.

    The result is the file and its SHA-256, hexadecimal. Whatever the server does, `cancelled` is called several times a
    second, also during the look-up of the name, the connection and a handshake. `progress` gets the bytes so far, of
    all attempts, at most a few times a second, and only while they come as fast as the settings ask for.

    Raises
    ------
    InputRefusedError
        The URL or one of its redirects is not on a listed host.
    TooLargeError
        More bytes than allowed.
    NoSpaceError
        The disk is full, or only its reserve is free.
    UnreadableInputError
        The server does not deliver it, or not fast enough.
    RunCancelledError
        The job was cancelled.
    """
    url = checked_url(text, settings)
    place = target / hashlib.sha256(text.encode()).hexdigest()[:16]
    place.mkdir(parents=True, exist_ok=True)
    path = place / name_of(url)
    watch = _Watch(url, settings, cancelled, progress)
    loop = asyncio.new_event_loop()
    try:
        return path, loop.run_until_complete(watch.over(_fetch(url, path, settings, watch)))
    except OSError as fault:
        if fault.errno in FULL:
            raise NoSpaceError(f"there is no room on the disk for {path.name}. {MAKE_ROOM}") from fault
        raise
    finally:
        # not `asyncio.run`: it waits for the thread of a name's look-up, which no one can end
        loop.close()


class _Watch:
    """Ends a fetch that was cancelled, or is too slow; reports those that are not."""

    def __init__(self, url: httpx.URL, settings: ServiceSettings, cancelled: Cancel, progress: OnBytes) -> None:
        now_s = time.monotonic()
        self._url = url
        self._settings = settings
        self._cancelled = cancelled
        self._progress = progress
        self._until_s = now_s + settings.max_fetch_s
        self._look_s = min(LOOK_S, look_s(settings.slow_s, settings.max_fetch_s))
        self._reported_s = now_s
        self.pace = Pace(settings.min_bytes_per_s, settings.slow_s, now_s)

    async def over(self, work: Coroutine[Any, Any, Result]) -> Result:
        """The result of the work, which is cancelled if this watch ends it."""
        task = asyncio.ensure_future(work)
        try:
            while not task.done():
                self._check()
                await asyncio.wait({task}, timeout=self._look_s)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        return task.result()

    def took(self, count: int) -> None:
        """Count bytes that have arrived."""
        now_s = time.monotonic()
        if self.pace.took(count, now_s) and now_s - self._reported_s >= REPORT_S:
            self._reported_s = now_s
            self._progress(self.pace.total_bytes)

    def _check(self) -> None:
        if self._cancelled():
            raise RunCancelledError("the job was cancelled while its inputs were fetched")
        now_s, settings = time.monotonic(), self._settings
        if now_s > self._until_s:
            raise UnreadableInputError(
                shown(self._url),
                f"not fetched within {settings.max_fetch_s:g} s",
                "Upload the file, or raise GABLEWORK_MAX_FETCH_S",
            )
        # rather a look early than late
        if self.pace.is_slow(now_s + self._look_s):
            raise UnreadableInputError(
                shown(self._url),
                f"the server sends less than {settings.min_bytes_per_s:g} bytes per second over {settings.slow_s:g} s",
                "Upload the file, or try again when the server is faster",
            )


async def _fetch(url: httpx.URL, path: Path, settings: ServiceSettings, watch: _Watch) -> str:
    """The file by as many attempts as may help; its SHA-256."""
    # No proxies, cookies or .netrc from the environment: they could divert the checked URL.
    timeout = httpx.Timeout(settings.silent_s, connect=CONNECT_S)
    async with httpx.AsyncClient(timeout=timeout, trust_env=False, verify=httpx.create_ssl_context()) as client:
        attempt = 1
        while True:
            try:
                return await _try(client, url, path, settings, watch)
            except _PassingError as fault:
                wait_s = pause_s(attempt, status=fault.status, retry_after=fault.retry_after)
                if wait_s is None:
                    problem = f"{fault.problem} (tried {attempt} times)"
                    raise UnreadableInputError(shown(url), problem, "Check the URL, or upload the file") from fault
            attempt += 1
            watch.pace.rest(wait_s)
            await asyncio.sleep(wait_s)


async def _try(client: httpx.AsyncClient, url: httpx.URL, path: Path, settings: ServiceSettings, watch: _Watch) -> str:
    """One attempt: follow redirects within the list, stream the body to the file; its SHA-256."""
    try:
        for _ in range(MAX_REDIRECTS + 1):
            async with client.stream("GET", url, headers={"Accept-Encoding": "identity"}) as response:
                if response.status_code not in REDIRECTS:
                    _check_answer(url, response)
                    return await _stream_to(path, url, response, settings, watch)
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


async def _stream_to(
    path: Path, url: httpx.URL, response: httpx.Response, settings: ServiceSettings, watch: _Watch
) -> str:
    """The body to a file, counted as it arrives, written in larger blocks; its SHA-256."""
    limit, promised = settings.max_upload_bytes, response.headers.get("content-length", "")
    size, digest, disk = 0, hashlib.sha256(), Disk(path.parent, settings.reserve_bytes)
    if promised.isdigit():
        _check_size(url, int(promised), limit)
        disk.require(int(promised), path.name)
    with _removed_on_failure(path), path.open("wb") as stream:

        def write(block: bytearray) -> None:
            disk.require(len(block), path.name)
            digest.update(block)
            stream.write(block)

        waiting = bytearray()
        async for piece in response.aiter_raw():
            watch.took(len(piece))
            size += len(piece)
            _check_size(url, size, limit)
            waiting += piece
            if len(waiting) >= BLOCK_BYTES:
                write(waiting)
                waiting = bytearray()
        write(waiting)
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
