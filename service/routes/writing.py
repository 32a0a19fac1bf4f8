"""Writes of routes to the database: in few threads, for seconds at most, and only while the client still waits."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

import anyio
import anyio.to_thread
from fastapi import Depends, Request
from starlette.requests import ClientDisconnect

from service.errors import StoreFullError
from service.settings import ServiceSettings
from service.store import RequestDeadline

Written = TypeVar("Written")
"""What a write returns."""

THREADS = 3
"""Threads that write: few, because writers wait for one another and readers must not wait for them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Writer:
    """Writes to the database for one request."""

    request: Request
    threads: anyio.CapacityLimiter
    """Limits the writes at the same time, of all requests together."""
    wait_s: float
    """Seconds that the request waits for its turn and for the database."""

    async def __call__(self, write: Callable[[], Written]) -> Written:
        """Run `write` in a thread. The body of the request must have been read.

        If the time is over or the client goes away before the commit begins, nothing is written, also if the thread
        still waits for the database then.

        Raises
        ------
        StoreBusyError
            The database was busy all the time.
        ClientDisconnect
            The client has gone.
        """
        return await self._run(write, asyncio.ensure_future(self._gone()))

    async def while_body_arrives(self, write: Callable[[], Written]) -> Written:
        """Run `write` in a thread, before the body of the request was read: a client that goes away is not seen."""
        return await self._run(write, asyncio.get_running_loop().create_future())

    async def _run(self, write: Callable[[], Written], gone: asyncio.Future[None]) -> Written:
        deadline = RequestDeadline(self.wait_s)

        def patiently() -> Written:
            with deadline:
                try:
                    return write()
                except StoreFullError:
                    # the room that was set aside for the database is free now
                    return write()

        work = asyncio.ensure_future(anyio.to_thread.run_sync(patiently, limiter=self.threads, abandon_on_cancel=True))
        both: set[asyncio.Future[Any]] = {work, gone}
        try:
            await asyncio.wait(both, timeout=self.wait_s, return_when=asyncio.FIRST_COMPLETED)
            if work.done() or not deadline.abandon():
                return await work
            if not gone.done():
                raise deadline.used_up()
            # the thread keeps its place until it has seen that: clients that go away do not add threads
            await asyncio.wait({work})
            raise ClientDisconnect
        finally:
            if not deadline.abandon():
                with anyio.CancelScope(shield=True):
                    await asyncio.wait({work})
            for task in both:
                task.cancel()
            await asyncio.wait(both)

    async def _gone(self) -> None:
        """Wait until the client has gone."""
        while (await self.request.receive())["type"] != "http.disconnect":
            continue


def writing(settings: ServiceSettings) -> Callable[[Request], Writer]:
    """Makes the writers of an application's requests."""
    threads = anyio.CapacityLimiter(THREADS)
    return lambda request: Writer(request=request, threads=threads, wait_s=settings.database_wait_s)


async def _writer(request: Request) -> Writer:
    writer: Writer = request.app.state.writing(request)
    return writer


Write = Annotated[Writer, Depends(_writer)]
"""Writes for the request."""
