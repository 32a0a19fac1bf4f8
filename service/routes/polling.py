"""The status of a job, for clients that poll.

Hundreds of clients that poll once a second must leave time for the rest of the service. The framework's resolution of
dependencies and two threads per request take three times as long as everything else. So the plain request, without a
query and answered as JSON, passes them by, and those that come at the same time share one look into the database. Any
other request takes the framework's way. The checks of both are the same, in the same order (`bound.principal_of`).
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from typing import Any

import anyio
from fastapi import Request, Response
from starlette.concurrency import run_in_threadpool

from service.errors import StoreBusyError, StoreError
from service.gathering import Gathered
from service.jobs import Job
from service.keys import Scope
from service.routes.bound import base_url_of, is_remembered, principal_of
from service.routes.html import PageRoute
from service.status import status_info
from service.store import JobStore
from service.store.queries import seen_by
from service.wire.base import respond

_JSON_ACCEPTED = frozenset({"", "*/*", "application/json"})
"""Values of the header Accept by which a client gets JSON."""
_MOMENT_S = 0.01
"""Seconds that a look into the database waits for more requests, while they come in numbers."""


class PolledJobs:
    """Finds jobs for many requests at the same time.

    Parameters
    ----------
    store : JobStore
        The jobs.
    wait_s : float
        Seconds that a request waits.
    """

    def __init__(self, store: JobStore, wait_s: float) -> None:
        self._store = store
        self._wait_s = wait_s
        self._gathered = Gathered(self._existing, moment_s=_MOMENT_S)

    async def job(self, job_id: str) -> Job | None:
        """The job, if it exists.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        with anyio.move_on_after(self._wait_s):
            return await self._gathered.ask(job_id)
        raise StoreBusyError(f"the database has not answered for {self._wait_s:g} s")

    def _existing(self, job_ids: set[str]) -> Mapping[str, Job | Exception]:
        try:
            return self._store.existing(job_ids)
        except StoreError:
            raise
        except Exception:  # noqa: BLE001 - a row that cannot be read must fail no other
            return {job_id: self._alone(job_id) for job_id in job_ids}

    def _alone(self, job_id: str) -> Job | Exception:
        try:
            return self._store.get(job_id)
        except Exception as error:  # noqa: BLE001 - raised for those who ask for it
            return error


def job_status(job: Job, base: str) -> Response:
    """The answer to a request for the status of a job."""
    return respond(status_info(job, base), headers={"Cache-Control": "no-store", "Vary": "Accept"})


class StatusRoute(PageRoute):
    """The route of a job's status."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler of all its requests."""
        handle_any = super().get_route_handler()

        async def handle(request: Request) -> Response:
            is_plain = not request.scope["query_string"] and request.headers.get("accept", "") in _JSON_ACCEPTED
            return await (_plain(request) if is_plain else handle_any(request))

        return handle


async def _plain(request: Request) -> Response:
    caller = principal_of(request) if is_remembered(request) else await run_in_threadpool(principal_of, request)
    caller.require(Scope.READ)
    job_id, polled = request.path_params["jobID"], request.app.state.polled_jobs
    return job_status(seen_by(caller.owner, await polled.job(job_id), job_id), base_url_of(request))
