"""The two clients: `Client` blocks, `AsyncClient` is for an event loop. They have the same methods."""

from __future__ import annotations

import logging
import ssl
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx

from pipeline.errors import SettingsError
from service.client.answers import Event, FetchedFile, Job, Output, Submitted
from service.client.attempts import PATIENCE_S
from service.client.operations import JobRef, OnEvent, Operations, Paths, ignore
from service.client.session import Notify, Session, service_key, service_url
from service.client.transport import AsyncTransport, BlockingTransport, finished
from service.client.upload_memory import UploadMemory
from service.client.uploads import OnTransfer

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
        self._operations = Operations(session, memory or UploadMemory.of_user())

    def __enter__(self) -> Self:
        """The client."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all connections."""
        self.close()

    def upload(self, path: str | Path, *, on_transfer: OnTransfer = ignore) -> str:
        """Send a file; the id of its upload. A call that was interrupted continues; a file is sent once."""
        return finished(self._operations.upload(path, on_transfer=on_transfer))

    def submit(
        self,
        tiles: Paths,
        *,
        process: str = "reconstruct",
        footprints: str | Path | None = None,
        guides: str | Path | None = None,
        outputs: Sequence[str] | None = None,
        new: bool = False,
        on_transfer: OnTransfer = ignore,
        **inputs: Any,
    ) -> Job:
        """Send tiles and start a job with them; the job. See `AsyncClient.submit`."""
        return self.submission(
            tiles,
            process=process,
            inputs=inputs,
            footprints=footprints,
            guides=guides,
            outputs=outputs,
            new=new,
            on_transfer=on_transfer,
        ).job

    def submission(
        self,
        tiles: Paths,
        *,
        process: str,
        inputs: Mapping[str, Any],
        footprints: str | Path | None = None,
        guides: str | Path | None = None,
        outputs: Sequence[str] | None = None,
        new: bool = False,
        on_transfer: OnTransfer = ignore,
    ) -> Submitted:
        """As `submit`; the job, and whether this call has made it."""
        return finished(
            self._operations.submission(
                tiles,
                process=process,
                inputs=inputs,
                footprints=footprints,
                guides=guides,
                outputs=outputs,
                new=new,
                on_transfer=on_transfer,
            )
        )

    def job(self, job: JobRef) -> Job:
        """The job as it is now."""
        return finished(self._operations.job(job))

    def jobs(
        self,
        *,
        status: str | Sequence[str] | None = None,
        process: str | Sequence[str] | None = None,
        limit: int = 100,
        offset: int = 0,
    ) -> list[Job]:
        """A page of the jobs that the key may see, newest first."""
        return finished(self._operations.jobs(status=status, process=process, limit=limit, offset=offset))

    def watch(self, job: JobRef, *, after: int = 0) -> Iterator[Event]:
        """The events of a job as they come, to its end."""
        events = self._operations.watch(job, after=after)
        try:
            while True:
                try:
                    event = finished(events.__anext__())
                except StopAsyncIteration:
                    return
                yield event
        finally:
            finished(events.aclose())

    def wait(self, job: JobRef, *, on_event: OnEvent = ignore) -> Job:
        """The job once it has succeeded; raises if it ended otherwise."""
        return finished(self._operations.wait(job, on_event=on_event))

    def cancel(self, job: JobRef) -> Job:
        """Stop a job that waits or runs; one that is over stays as it is."""
        return finished(self._operations.cancel(job))

    def retry(self, job: JobRef, *, outputs: Sequence[str] | None = None, **inputs: Any) -> Job:
        """A new job with the request of one that is over; inputs replace those of the old one, None takes one away."""
        return finished(self._operations.retry(job, outputs=outputs, **inputs))

    def keep(self, job: JobRef, *, keep: bool = True) -> Job:
        """Keep a job with its results, whatever its age and size, or no longer."""
        return finished(self._operations.keep(job, keep=keep))

    def remove(self, job: JobRef) -> None:
        """Remove a job that is over, with its results."""
        finished(self._operations.remove(job))

    def results(self, job: JobRef, *, method: str | None = None, status: Sequence[str] = ()) -> list[Output]:
        """The outputs of a job that succeeded; also those of one method, or with buildings of some statuses only."""
        return finished(self._operations.results(job, method=method, status=status))

    def fetch(
        self,
        job: JobRef,
        out: str | Path,
        kinds: Sequence[str] = (),
        *,
        method: str | None = None,
        status: Sequence[str] = (),
        overwrite: bool = False,
        on_transfer: OnTransfer = ignore,
    ) -> list[FetchedFile]:
        """Fetch outputs into a folder, all or those of some kinds. A call that was interrupted continues.

        With `status` such as `["ok"]` they hold only buildings of these statuses.
        """
        return finished(
            self._operations.fetch(
                job, out, kinds, method=method, status=status, overwrite=overwrite, on_transfer=on_transfer
            )
        )

    def request(self, method: str, path: str, *, params: Mapping[str, Any] | None = None, document: Any = None) -> Any:
        """Any other request: the document that is answered, or the bytes if it is not JSON; None without content."""
        return finished(self._operations.request(method, path, params=params, document=document))

    def close(self) -> None:
        """End all connections."""
        finished(self._operations.close())


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
