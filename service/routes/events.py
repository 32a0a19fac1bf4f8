"""Events of a job: as a stream of server-sent events, or as a list for clients that poll."""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Annotated

import anyio
from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT, format_sse_event
from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from pipeline.backoff import Backoff, Pauses
from service.errors import NoSuchJobError, TooManyRequestsError
from service.jobs import JobEvent
from service.routes.answers import document, problems, reference
from service.routes.bound import Base, Reader, Settings_, Store
from service.routes.jobs import JobId
from service.routes.negotiation import preferred
from service.status import event_document
from service.store import JobStore
from service.wire.base import link, respond
from service.wire.jobs import EventList, ServerSentEvent
from service.wire.queries import EventQuery

router = APIRouter(tags=["jobs"])

RECONNECT_MS = 2000
"""Milliseconds after which a client reconnects if its connection breaks."""

KEEP_ALIVE_S = 15.0
"""Seconds without an event after which a comment keeps the stream alive."""

LONGEST_LOOK_S = 2.0
"""Longest time in seconds between looks at a job without events; the first looks come sooner."""

PAGE = 500
"""Maximum number of events per read."""

REPRESENTATIONS: Mapping[str, str] = {"application/json": "json", "text/event-stream": "sse"}
"""Media types of the events with their names in the parameter f; the first one wins among equals."""

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

_LIST_OR_STREAM = document(EventList, "The events: a list, or a stream if `text/event-stream` is requested.", _EXAMPLE)
_LIST_OR_STREAM["content"]["text/event-stream"] = {"schema": reference(ServerSentEvent)}


@router.get(
    "/jobs/{jobID}/events",
    summary="Events of a job",
    responses={
        200: _LIST_OR_STREAM,
        204: {"description": "The job is over and the client has all its events: it should not reconnect."},
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
    query: Annotated[EventQuery, Query()],
    last_event_id: Annotated[
        str | None, Header(alias="Last-Event-ID", description="Where to continue a broken stream.")
    ] = None,
) -> Response:
    """Follow a job. A stream ends after the job's last status; it resumes by `Last-Event-ID`."""
    found = await run_in_threadpool(store.get, job_id, owner=caller.owner)
    after = query.after
    if last_event_id is not None and last_event_id.isascii() and last_event_id.isdigit():
        after = max(after, min(int(last_event_id[:10]), 2**31 - 1))
    chosen = query.f or preferred(request.headers.get("accept"), list(REPRESENTATIONS))
    if REPRESENTATIONS.get(chosen, chosen) == "json":
        listed = await run_in_threadpool(store.events, job_id, after, query.limit)
        place = f"{base}/jobs/{job_id}/events?f=json&limit={query.limit}"
        links = [link(f"{place}&after={after}", "self", "These events")]
        if listed:
            links.append(link(f"{place}&after={listed[-1].sequence}", "next", "The events after them"))
        page = EventList(events=[event_document(event) for event in listed], links=links)
        return respond(page, headers={"Cache-Control": "no-store"})
    if found.status.is_over and not await run_in_threadpool(store.events, job_id, after, 1):
        return Response(status_code=204)
    streams: Streams = request.app.state.streams
    streams.open(caller.key_id, settings.max_event_streams, settings.max_event_streams_per_key)
    return EventStream(follow(store, job_id, after, settings.poll_s, lambda: streams.closing), streams, caller.key_id)


class Streams:
    """The number of open streams, and whether they must end because the process does."""

    def __init__(self) -> None:
        self._of_keys: Counter[str | None] = Counter()
        self.closing = False

    @property
    def count(self) -> int:
        """The number of all."""
        return self._of_keys.total()

    def open(self, key_id: str | None, most: int, most_per_key: int) -> None:
        """Count one more of a key; None if keys are not used, then only the total is limited.

        Raises
        ------
        TooManyRequestsError
            Too many are open.
        """
        own = self._of_keys[key_id]
        fix = "poll the job, or try again later"
        if key_id is not None and own >= most_per_key:
            raise TooManyRequestsError(
                f"{own} event streams of this key are open, the limit is {most_per_key}: {fix}", 30.0
            )
        if self.count >= most:
            raise TooManyRequestsError(f"{self.count} event streams are open, the limit is {most}: {fix}", 30.0)
        self._of_keys[key_id] += 1

    def close(self, key_id: str | None) -> None:
        """Count one less."""
        self._of_keys[key_id] -= 1
        if not self._of_keys[key_id]:
            del self._of_keys[key_id]


class EventStream(StreamingResponse):
    """A stream of events, counted until it ends or its client disconnects."""

    media_type = "text/event-stream"

    def __init__(self, content: AsyncIterator[bytes], streams: Streams, key_id: str | None) -> None:
        super().__init__(content, headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        self._streams, self._key_id = streams, key_id

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._streams.close(self._key_id)


async def follow(
    store: JobStore, job_id: str, after: int, poll_s: float, is_closing: Callable[[], bool]
) -> AsyncIterator[bytes]:
    """Events of a job as they come, until the job is over or removed, or the process ends."""
    yield format_sse_event(retry=RECONNECT_MS)
    looks = Pauses(Backoff(first_s=poll_s, longest_s=max(poll_s, LONGEST_LOOK_S), factor=1.5))
    quiet_s = 0.0
    while not is_closing():
        found = await run_in_threadpool(store.events, job_id, after, PAGE)
        for event in found:
            yield _message(event)
            after = event.sequence
        if found and found[-1].status is not None and found[-1].status.is_over:
            return
        if found:
            looks.begin_anew()
            quiet_s = 0.0
            continue
        if quiet_s >= KEEP_ALIVE_S:
            quiet_s = 0.0
            try:
                job = await run_in_threadpool(store.get, job_id)
            except NoSuchJobError:
                return
            if job.status.is_over and not await run_in_threadpool(store.events, job_id, after, 1):
                return
            yield KEEPALIVE_COMMENT
        pause_s = looks.next_s()
        await anyio.sleep(pause_s)
        quiet_s += pause_s


def _message(event: JobEvent) -> bytes:
    data = event_document(event).model_dump_json(exclude_defaults=True)
    return format_sse_event(data_str=data, event=event.kind, id=str(event.sequence))
