"""Requests and answers over HTTP, for clients with and without an event loop.

All that the client does is written once, as coroutines over a `Transport`. That of `AsyncClient` waits in the event
loop. That of `Client` blocks: its coroutines never suspend, so `finished` runs one to its end without any loop.
"""

from __future__ import annotations

import contextlib
import dataclasses
import ssl
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar

import anyio
import anyio.to_thread
import httpx

from pipeline.errors import causes

Result = TypeVar("Result")

CONNECT_S = 10.0
READ_S = 60.0
"""Seconds without a byte after which an answer counts as lost; event streams send one at least every 15 s."""
LAST_BYTES_S = 600.0
"""The same for the answer to the last bytes of an upload: the service hashes the file, and examines it in its turn."""
PIECE_BYTES = 1 << 20


class LostError(Exception):
    """No answer, or only a part of one; the message says why."""

    def __init__(self, message: str, *, is_final: bool = False) -> None:
        self.is_final = is_final
        """Whether another attempt cannot help."""
        super().__init__(message)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FileBytes(httpx.SyncByteStream, httpx.AsyncByteStream):
    """The bytes of a file from an offset on, as the body of a request."""

    path: Path
    offset: int
    length: int
    on_sent: Callable[[int], None]
    """Called with the number of bytes of each piece, after the connection has taken it."""

    def __iter__(self) -> Iterator[bytes]:
        """The pieces."""
        for piece in self._pieces():
            yield piece
            self.on_sent(len(piece))

    async def __aiter__(self) -> AsyncIterator[bytes]:
        """The same; the file is read in a thread."""
        pieces = self._pieces()
        while piece := await anyio.to_thread.run_sync(next, pieces, b""):
            yield piece
            self.on_sent(len(piece))

    def _pieces(self) -> Iterator[bytes]:
        left = self.length
        with self.path.open("rb") as stream:
            stream.seek(self.offset)
            while left > 0 and (piece := stream.read(min(PIECE_BYTES, left))):
                yield piece
                left -= len(piece)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Request:
    """A request."""

    method: str
    url: str
    headers: Mapping[str, str]
    body: bytes | FileBytes = b""
    read_s: float = READ_S

    def as_httpx(self) -> httpx.Request:
        """The same for the library; nothing is added to the headers of a file."""
        extensions = {"timeout": httpx.Timeout(self.read_s, connect=CONNECT_S).as_dict()}
        if isinstance(self.body, bytes):
            return httpx.Request(
                self.method, self.url, headers=dict(self.headers), content=self.body or None, extensions=extensions
            )
        host = httpx.URL(self.url).netloc.decode()
        headers = {**self.headers, "Host": host, "Content-Length": str(self.body.length)}
        return httpx.Request(self.method, self.url, headers=headers, stream=self.body, extensions=extensions)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Answer:
    """An answer, with its body."""

    status: int
    headers: Mapping[str, str]
    """Names in any case."""
    body: bytes = b""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OpenAnswer:
    """An answer whose body arrives."""

    status: int
    headers: Mapping[str, str]
    pieces: AsyncIterator[bytes]
    """The body, once; raises LostError if it breaks off."""

    async def whole(self) -> Answer:
        """The same, when all of it has arrived."""
        body = b"".join([piece async for piece in self.pieces])
        return Answer(status=self.status, headers=self.headers, body=body)


class Transport(Protocol):
    """Sends requests and waits."""

    def open(self, request: Request) -> contextlib.AbstractAsyncContextManager[OpenAnswer]:
        """Send a request; the answer is open within the context. Raises LostError."""

    async def work(self, call: Callable[[], Result]) -> Result:
        """Do something that takes time on this machine, such as reading a file."""

    async def sleep(self, seconds: float) -> None:
        """Wait."""

    async def close(self) -> None:
        """End all connections."""


class AsyncTransport:
    """Waits in the event loop.

    Parameters
    ----------
    context : ssl.SSLContext
        The certificates that are trusted.
    """

    def __init__(self, context: ssl.SSLContext) -> None:
        self._client = httpx.AsyncClient(verify=context)

    @contextlib.asynccontextmanager
    async def open(self, request: Request) -> AsyncIterator[OpenAnswer]:
        """Send a request."""
        with _losses():
            response = await self._client.send(request.as_httpx(), stream=True)

        async def pieces() -> AsyncIterator[bytes]:
            with _losses():
                async for piece in response.aiter_raw():
                    yield piece

        try:
            yield OpenAnswer(status=response.status_code, headers=response.headers, pieces=pieces())
        finally:
            await response.aclose()

    async def work(self, call: Callable[[], Result]) -> Result:
        """Do it in a thread."""
        return await anyio.to_thread.run_sync(call)

    async def sleep(self, seconds: float) -> None:
        """Wait."""
        await anyio.sleep(seconds)

    async def close(self) -> None:
        """End all connections."""
        await self._client.aclose()


class BlockingTransport:
    """Blocks; its coroutines never suspend.

    Parameters
    ----------
    context : ssl.SSLContext
        The certificates that are trusted.
    """

    def __init__(self, context: ssl.SSLContext) -> None:
        self._client = httpx.Client(verify=context)

    @contextlib.asynccontextmanager
    async def open(self, request: Request) -> AsyncIterator[OpenAnswer]:
        """Send a request."""
        with _losses():
            response = self._client.send(request.as_httpx(), stream=True)

        async def pieces() -> AsyncIterator[bytes]:
            with _losses():
                for piece in response.iter_raw():
                    yield piece

        try:
            yield OpenAnswer(status=response.status_code, headers=response.headers, pieces=pieces())
        finally:
            response.close()

    async def work(self, call: Callable[[], Result]) -> Result:
        """Do it here."""
        return call()

    async def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)

    async def close(self) -> None:
        """End all connections."""
        self._client.close()


def finished(coroutine: Coroutine[Any, Any, Result]) -> Result:
    """The result of a coroutine that never suspends.

    >>> async def three():
    ...     return 3
    >>> finished(three())
    3
    """
    try:
        coroutine.send(None)
    except StopIteration as end:
        result: Result = end.value
        return result
    coroutine.close()
    raise RuntimeError("a coroutine over a blocking transport must not suspend")


@contextlib.contextmanager
def _losses() -> Iterator[None]:
    """Turn the library's errors into ours."""
    try:
        yield
    except httpx.TimeoutException as error:
        raise LostError(f"no answer in time ({type(error).__name__})") from error
    except httpx.TransportError as error:
        fault = _certificate_fault(error)
        if fault is not None:
            raise LostError(fault, is_final=True) from error
        raise LostError(str(error) or type(error).__name__, is_final=isinstance(error, httpx.ProxyError)) from error


def _certificate_fault(error: BaseException) -> str | None:
    """Why a certificate is not trusted; None if that is not the cause."""
    for cause in causes(error):
        if isinstance(cause, ssl.SSLCertVerificationError):
            return f"its certificate is not trusted ({cause.verify_message})"
        if isinstance(cause, ssl.SSLError) and "WRONG_VERSION_NUMBER" in str(cause):
            return "it does not speak TLS at this port: begin the URL with http://, or use the port for https"
    return None
