"""The two clients: `Client` blocks, `AsyncClient` is for an event loop. They have the same methods."""

from __future__ import annotations

import functools
import logging
import ssl
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import httpx

from pipeline.errors import SettingsError
from service.client.client_answers import Event
from service.client.client_retries import PATIENCE_S
from service.client.operations import JobRef, Operations
from service.client.session import Notify, Session, service_key, service_url
from service.client.transport import AsyncTransport, BlockingTransport, finished
from service.client.upload_memory import UploadMemory

Given = ParamSpec("Given")
Result = TypeVar("Result")

_log = logging.getLogger("gablework.client")


class AsyncClient(Operations):
    """A client of the service for an event loop.

    Parameters
    ----------
    url : str, optional
        The service's URL; default GABLEWORK_URL, or http://127.0.0.1:8000.
    key : str, optional
        The key, if the service needs one; default GABLEWORK_KEY.
    key_file : path, optional
        A file that holds the key; default GABLEWORK_KEY_FILE.
    ca : path, optional
        CA of the service's certificate, PEM; by default the usual ones, or those of SSL_CERT_FILE.
    patience_s : float
        Seconds that a call goes on while the service does not answer, or is busy.
    notify : callable, optional
        Takes sentences about waits; default the logger `gablework.client`.
    memory : UploadMemory, optional
        The files that were sent before; default in the user's cache folder.

    Raises
    ------
    SettingsError
        URL, key or CA cannot be used.
    """

    def __init__(
        self,
        url: str | None = None,
        key: str | None = None,
        *,
        key_file: str | Path | None = None,
        ca: str | Path | None = None,
        patience_s: float = PATIENCE_S,
        notify: Notify | None = None,
        memory: UploadMemory | None = None,
    ) -> None:
        place = service_url(url)
        session = Session(
            AsyncTransport(_trusted(place, ca)),
            url=place,
            key=service_key(key, key_file),
            patience_s=patience_s,
            notify=notify or _log.warning,
        )
        super().__init__(session, memory or UploadMemory.of_user())

    async def __aenter__(self) -> Self:
        """The client."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all connections."""
        await self.close()


def _blocking(
    operation: Callable[Concatenate[Operations, Given], Coroutine[Any, Any, Result]],
) -> Callable[Concatenate[Client, Given], Result]:
    """The method of `Client` that runs an operation to its end."""

    def method(client: Client, /, *given: Given.args, **named: Given.kwargs) -> Result:
        return finished(operation(client.operations, *given, **named))

    functools.update_wrapper(method, operation)
    return method


class Client:
    """A client of the service that blocks; its parameters, methods and errors are those of `AsyncClient`.

    >>> with Client("http://127.0.0.1:8000", key="gw_0") as client:
    ...     client.watch("0f" * 16)  # doctest: +ELLIPSIS
    <generator object Client.watch at 0x...>
    """

    def __init__(
        self,
        url: str | None = None,
        key: str | None = None,
        *,
        key_file: str | Path | None = None,
        ca: str | Path | None = None,
        patience_s: float = PATIENCE_S,
        notify: Notify | None = None,
        memory: UploadMemory | None = None,
    ) -> None:
        place = service_url(url)
        session = Session(
            BlockingTransport(_trusted(place, ca)),
            url=place,
            key=service_key(key, key_file),
            patience_s=patience_s,
            notify=notify or _log.warning,
        )
        self.operations = Operations(session, memory or UploadMemory.of_user())
        """The same methods as coroutines, which never suspend."""

    def __enter__(self) -> Self:
        """The client."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all connections."""
        self.close()

    upload = _blocking(Operations.upload)
    submit = _blocking(Operations.submit)
    submission = _blocking(Operations.submission)
    job = _blocking(Operations.job)
    jobs = _blocking(Operations.jobs)
    wait = _blocking(Operations.wait)
    cancel = _blocking(Operations.cancel)
    retry = _blocking(Operations.retry)
    keep = _blocking(Operations.keep)
    remove = _blocking(Operations.remove)
    results = _blocking(Operations.results)
    fetch = _blocking(Operations.fetch)
    request = _blocking(Operations.request)
    close = _blocking(Operations.close)

    def watch(self, job: JobRef, *, after: int = 0) -> Iterator[Event]:
        """The events of a job as they come, to its end."""
        events = self.operations.watch(job, after=after)
        try:
            while True:
                try:
                    event = finished(events.__anext__())
                except StopAsyncIteration:
                    return
                yield event
        finally:
            finished(events.aclose())


def _trusted(url: str, ca: str | Path | None) -> ssl.SSLContext:
    """The certificates that are trusted: those of a file, or the usual ones."""
    if url.startswith("http://") and ca is None:
        # loading them takes longer than many a call
        return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if ca is None:
        return httpx.create_ssl_context()
    try:
        return ssl.create_default_context(cafile=ca)
    except (OSError, ssl.SSLError) as error:
        raise SettingsError([f"the CA file {ca} cannot be used: {error}"]) from None
