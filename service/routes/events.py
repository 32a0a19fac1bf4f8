"""What happens to a job: as a stream of server-sent events, or as a list for those who poll."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Annotated, Literal

import anyio
from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event
from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from service.errors import NoSuchJobError, TooManyRequestsError
from service.jobs import JobEvent
from service.routes.bound import Base, Reader, Settings_, Store
from service.routes.documented import document, problems, reference
from service.routes.jobs import JobId
from service.routes.negotiation import preferred
from service.routes.status import event_data, link
from service.store import JobStore

router = APIRouter(tags=["jobs"])

RECONNECT_MS = 2000
"""Milliseconds after which a client comes again when its connection breaks."""

KEEP_ALIVE_S = 15.0
"""Seconds without an event after which a comment tells that the stream lives."""

LONGEST_LOOK_S = 2.0
"""Seconds between looks at a job to which nothing happens; a job to which something happens is looked at sooner."""

PAGE = 500
"""Events that are read at once."""

REPRESENTATIONS: Mapping[str, str] = {"application/json": "json", "text/event-stream": "sse"}
"""Media types of the events, and how the parameter f calls them; the first one counts among equals."""

_EXAMPLE = {
    "events": [
        {
            "id": 7,
            "at": "2026-03-01T09:30:20.000Z",
            "kind": "progress",
            "stage": "reconstruct",
            "done": 12,
            "total": 180,
            "progress": 41,
            "message": "",
        }
    ],
    "links": [],
}


@router.get(
    "/jobs/{jobID}/events",
    summary="Events of a job",
    response_class=JSONResponse,
    responses={
        200: {
            "description": "The events: a list, or a stream where `text/event-stream` is asked for.",
            "content": {
                **document("EventList", "", _EXAMPLE)["content"],
                "text/event-stream": {"schema": reference("ServerSentEvent")},
            },
        },
        204: {"description": "The job is over and all its events are known: do not come again."},
        **problems(404, 406),
    },
)
async def events(
    request: Request,
    job_id: JobId,
    base: Base,
    store: Store,
    settings: Settings_,
    caller: Reader,
    wanted: Annotated[
        Literal["json", "sse"] | None, Query(alias="f", description="Stands above the header Accept.")
    ] = None,
    after: Annotated[int, Query(ge=0, le=2**31 - 1, description="Only events with a higher id.")] = 0,
    limit: Annotated[int, Query(ge=1, le=PAGE, description="Most events of a list.")] = PAGE,
    last_event_id: Annotated[
        str | None, Header(alias="Last-Event-ID", description="Where a broken stream goes on.")
    ] = None,
) -> Response:
    """Follow a job. A stream ends after the status with which the job is over; it resumes by `Last-Event-ID`."""
    found = await run_in_threadpool(store.get, job_id, owner=caller.owner)
    if last_event_id is not None and last_event_id.isascii() and last_event_id.isdigit():
        after = max(after, min(int(last_event_id[:10]), 2**31 - 1))
    chosen = wanted or preferred(request.headers.get("accept"), list(REPRESENTATIONS))
    if REPRESENTATIONS.get(chosen, chosen) == "json":
        told = await run_in_threadpool(store.events, job_id, after, limit)
        place = f"{base}/jobs/{job_id}/events?f=json&limit={limit}"
        links = [link(f"{place}&after={after}", "self", "These events")]
        if told:
            links.append(link(f"{place}&after={told[-1].sequence}", "next", "What comes after them"))
        return JSONResponse(
            {"events": [event_data(event) for event in told], "links": links}, headers={"Cache-Control": "no-store"}
        )
    if found.status.is_over and not await run_in_threadpool(store.events, job_id, after, 1):
        return Response(status_code=204)
    streams: Streams = request.app.state.streams
    streams.open(settings.max_event_streams)
    return EventStream(follow(store, job_id, after, settings.poll_s, lambda: streams.closing), streams)


class Streams:
    """How many streams are open, and whether they are to end because the process does."""

    def __init__(self) -> None:
        self.count = 0
        self.closing = False

    def open(self, most: int) -> None:
        """Count one more.

        Raises
        ------
        TooManyRequestsError
            Too many are open.
        """
        if self.count >= most:
            raise TooManyRequestsError(
                f"{self.count} event streams are open and {most} may: poll the job, or come again", 30.0
            )
        self.count += 1

    def close(self) -> None:
        """Count one less."""
        self.count -= 1


class EventStream(StreamingResponse):
    """A stream of events, counted until it ends or its client goes."""

    media_type = "text/event-stream"

    def __init__(self, content: AsyncIterator[bytes], streams: Streams) -> None:
        super().__init__(content, headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        self._streams = streams

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._streams.close()


async def follow(
    store: JobStore, job_id: str, after: int, poll_s: float, is_closing: Callable[[], bool]
) -> AsyncIterator[bytes]:
    """Events of a job as they come, until it is over, gone, or the process ends.

    Parameters
    ----------
    store : JobStore
        Where the events are.
    job_id : str
        The job.
    after : int
        Number of the last event that the client knows.
    poll_s : float
        Seconds between looks while something happens.
    is_closing : callable
        Whether the process ends.
    """
    yield format_sse_event(retry=RECONNECT_MS)
    pause_s, quiet_s = poll_s, 0.0
    while not is_closing():
        told = await run_in_threadpool(store.events, job_id, after, PAGE)
        for event in told:
            yield _message(event)
            after = event.sequence
        if told and told[-1].status is not None and told[-1].status.is_over:
            return
        if told:
            pause_s, quiet_s = poll_s, 0.0
            continue
        if quiet_s >= KEEP_ALIVE_S:
            quiet_s = 0.0
            try:
                found = await run_in_threadpool(store.get, job_id)
            except NoSuchJobError:
                return
            if found.status.is_over and not await run_in_threadpool(store.events, job_id, after, 1):
                return
            yield KEEPALIVE_COMMENT
        await anyio.sleep(pause_s)
        quiet_s += pause_s
        pause_s = min(pause_s * 1.5, max(poll_s, LONGEST_LOOK_S))


def _message(event: JobEvent) -> bytes:
    data = json.dumps(event_data(event), ensure_ascii=False)
    return format_sse_event(data_str=data, event=event.kind, id=str(event.sequence))
