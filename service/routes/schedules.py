"""Schedules: made, listed, changed, paused, run by hand, removed; and what became of their slots."""

from __future__ import annotations

import datetime as dt
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Body, Header, Path, Query, Request, Response
from fastapi.responses import JSONResponse
from starlette.concurrency import run_in_threadpool

from service.errors import ChangedMeanwhileError
from service.jobs import JobRequest
from service.routes.bound import Base, Folder, Reader, Settings_, Store, Submitter
from service.routes.documented import (
    JOB_MADE,
    SCHEDULE_EXAMPLE,
    SCHEDULE_ID,
    SCHEDULE_REQUEST_EXAMPLE,
    SCHEDULE_RUN_EXAMPLE,
    document,
    problems,
    reference,
)
from service.routes.schedule_requests import read_plan
from service.routes.status import execute_request, link, status_info, timestamp
from service.routes.submission import Submission
from service.schedules import Definition, Schedule, ScheduleRun
from service.store import ScheduleFilter

router = APIRouter(tags=["schedules"])

NEXT_TIMES = 5
"""Times to come that are told."""

ScheduleId = Annotated[
    str, Path(alias="scheduleID", description="As the schedule itself tells it.", examples=[SCHEDULE_ID])
]
Limit = Annotated[int, Query(ge=1, le=1000, description="Most to list.")]
Offset = Annotated[int, Query(ge=0, le=2**31 - 1, description="How many to pass over.")]

_TAG = {"ETag": {"description": "The version, for If-Match.", "schema": {"type": "string"}}}


def _body(schema: str, example: Any, *more: str) -> dict[str, Any]:
    content = {"schema": reference(schema), "example": example}
    return {"requestBody": {"required": True, "content": dict.fromkeys(("application/json", *more), content)}}


@router.post(
    "/schedules",
    summary="Make a schedule",
    status_code=201,
    responses={
        201: document(
            "Schedule",
            "The schedule; its first slot is the first one after now.",
            SCHEDULE_EXAMPLE,
            headers={"Location": {"description": "The schedule.", "schema": {"type": "string"}}, **_TAG},
        ),
        **problems(400, 404, 409, 422, 507),
    },
    openapi_extra=_body("ScheduleRequest", SCHEDULE_REQUEST_EXAMPLE),
)
async def make_schedule(
    request: Request,
    body: Annotated[dict[str, Any], Body()],
    base: Base,
    settings: Settings_,
    store: Store,
    folder: Folder,
    caller: Submitter,
) -> JSONResponse:
    """Make a schedule: a cron expression, a time zone, and the request of its jobs.

    The request is checked as that of a job that is submitted now, its inputs included. Uploads that it names are kept
    as long as the schedule is there.
    """
    plan = read_plan(body, None, settings)
    draft = plan.draft
    assert draft is not None

    def create(asked: JobRequest) -> Schedule:
        definition = plan.definition(asked, draft.priority)
        return store.schedules.create(definition, owner=caller.key_id, most=settings.max_schedules_per_key)

    async with Submission(
        store=store, folder=folder, settings=settings, caller=caller, threads=request.app.state.submitting
    ) as submission:
        made = await submission.checked(draft, create)
    place = f"{base}/schedules/{made.schedule_id}"
    return _answer(made, base, status_code=201, headers={"Location": place})


@router.get(
    "/schedules",
    summary="List schedules",
    responses={
        200: document("ScheduleList", "The schedules, newest first.", {"schedules": [SCHEDULE_EXAMPLE], "links": []}),
        **problems(400),
    },
)
def schedules(
    base: Base,
    store: Store,
    caller: Reader,
    state: Annotated[Literal["active", "paused"] | None, Query(description="Only these.")] = None,
    process_id: Annotated[str | None, Query(alias="processID", description="Only of this process.")] = None,
    limit: Limit = 100,
    offset: Offset = 0,
) -> JSONResponse:
    """List the schedules that this key may see."""
    criteria = ScheduleFilter(owner=caller.owner, state=state, process_id=process_id, limit=limit + 1, offset=offset)
    found = store.schedules.list(criteria)
    links = _pages(f"{base}/schedules", {"state": state, "processID": process_id}, len(found), limit, offset)
    told = [schedule_document(one, base, with_request=False) for one in found[:limit]]
    return JSONResponse({"schedules": told, "links": links})


@router.get(
    "/schedules/{scheduleID}",
    summary="A schedule",
    responses={
        200: document("Schedule", "The schedule.", SCHEDULE_EXAMPLE, headers=_TAG),
        **problems(404),
    },
)
def schedule(schedule_id: ScheduleId, base: Base, store: Store, caller: Reader) -> JSONResponse:
    """Tell what is run and when: the next times, the last run, and how many slots were run, skipped and missed."""
    return _answer(store.schedules.get(schedule_id, owner=caller.owner), base)


@router.patch(
    "/schedules/{scheduleID}",
    summary="Change, pause or resume a schedule",
    responses={
        200: document("Schedule", "The schedule as it is now.", SCHEDULE_EXAMPLE, headers=_TAG),
        **problems(400, 404, 412, 422, 507),
    },
    openapi_extra=_body("SchedulePatch", {"paused": True}, "application/merge-patch+json"),
)
async def change_schedule(
    request: Request,
    schedule_id: ScheduleId,
    body: Annotated[dict[str, Any], Body()],
    base: Base,
    settings: Settings_,
    store: Store,
    folder: Folder,
    caller: Submitter,
    if_match: Annotated[
        str | None, Header(description="The ETag that the client saw; the change is refused where it is another now.")
    ] = None,
) -> JSONResponse:
    """Change what is given; the rest stays. Slots while it is paused are not missed: nobody wants them."""
    before = await run_in_threadpool(store.schedules.get, schedule_id, owner=caller.owner)
    plan = read_plan(body, before.definition, settings)
    # a precondition counts only for a request that would succeed without it
    _check_version(if_match, before)
    draft = plan.draft

    def change(definition: Definition) -> Schedule:
        return store.schedules.change(schedule_id, definition, version=before.version, owner=caller.owner)

    if draft is None:
        kept = plan.definition(before.definition.request, before.definition.priority)
        return _answer(await run_in_threadpool(change, kept), base)
    priority = draft.priority
    async with Submission(
        store=store, folder=folder, settings=settings, caller=caller, threads=request.app.state.submitting
    ) as submission:
        changed = await submission.checked(draft, lambda asked: change(plan.definition(asked, priority)))
    return _answer(changed, base)


@router.delete(
    "/schedules/{scheduleID}",
    summary="Remove a schedule",
    status_code=204,
    response_class=Response,
    responses={204: {"description": "It is gone. Its jobs stay; one that runs goes on."}, **problems(404)},
)
def remove_schedule(schedule_id: ScheduleId, store: Store, caller: Submitter) -> Response:
    """Remove a schedule, and what is known of its slots."""
    store.schedules.remove(schedule_id, owner=caller.owner)
    return Response(status_code=204)


@router.post(
    "/schedules/{scheduleID}/run",
    summary="Run a schedule now",
    status_code=201,
    responses={201: JOB_MADE, **problems(404, 409)},
)
def run_schedule(
    schedule_id: ScheduleId, base: Base, settings: Settings_, store: Store, caller: Submitter
) -> JSONResponse:
    """Make a job now, whatever the clock says; also of a schedule that is paused.

    While a job of the schedule is under way this is refused, and `jobID` of the problem names that job.
    """
    job = store.schedules.run_now(
        schedule_id,
        owner=caller.owner,
        max_queued=settings.max_queued,
        max_queued_per_key=settings.max_queued_per_key,
    )
    return JSONResponse(status_info(job, base), status_code=201, headers={"Location": f"{base}/jobs/{job.job_id}"})


@router.get(
    "/schedules/{scheduleID}/runs",
    summary="What became of a schedule's slots",
    responses={
        200: document("ScheduleRunList", "Latest first.", {"runs": [SCHEDULE_RUN_EXAMPLE], "links": []}),
        **problems(400, 404),
    },
)
def schedule_runs(
    schedule_id: ScheduleId, base: Base, store: Store, caller: Reader, limit: Limit = 100, offset: Offset = 0
) -> JSONResponse:
    """Tell of every slot and run by hand which job was made, or why none was."""
    found = store.schedules.runs(schedule_id, owner=caller.owner, limit=limit + 1, offset=offset)
    links = _pages(f"{base}/schedules/{schedule_id}/runs", {}, len(found), limit, offset)
    links.append(link(f"{base}/schedules/{schedule_id}", "up", "The schedule"))
    return JSONResponse({"runs": [run_document(run, base) for run in found[:limit]], "links": links})


def schedule_document(found: Schedule, base: str, *, with_request: bool = True) -> dict[str, Any]:
    """A schedule as clients see it.

    Parameters
    ----------
    found : Schedule
        As stored.
    base : str
        The service's own URL.
    with_request : bool
        Whether the request is told; lists leave it out.
    """
    definition = found.definition
    place = f"{base}/schedules/{found.schedule_id}"
    times: list[dt.datetime] = []
    if not definition.is_paused:
        times = definition.cron.next_times(found.decided_until, NEXT_TIMES if with_request else 1)
    told: dict[str, Any] = {
        "scheduleID": found.schedule_id,
        "version": found.version,
        "title": definition.title,
        "state": "paused" if definition.is_paused else "active",
        "cron": definition.cron.expression,
        "timeZone": definition.cron.time_zone,
        "missed": definition.missed.value,
        "graceSeconds": definition.grace_s,
        "overlap": definition.overlap.value,
        "processID": definition.request.process_id,
        "execute": execute_request(definition.request, base, definition.priority) if with_request else None,
        "created": timestamp(found.created_at),
        "updated": timestamp(found.updated_at),
        # with the offset that the clock on the wall has then
        "nextTimes": [at.isoformat() for at in times],
        "waiting": timestamp(found.waiting_slot),
        "lastRun": None if found.last_run is None else run_document(found.last_run, base),
        "counts": {outcome.value: number for outcome, number in found.counts.items()},
        "links": [
            link(place, "self", "This schedule"),
            link(f"{place}/runs", "runs", "What became of its slots"),
            link(f"{base}/jobs?{urlencode({'scheduleID': found.schedule_id})}", "jobs", "Its jobs"),
        ],
    }
    return {name: value for name, value in told.items() if value is not None}


def run_document(run: ScheduleRun, base: str) -> dict[str, Any]:
    """What became of a slot, as clients see it."""
    told: dict[str, Any] = {
        "number": run.number,
        "trigger": run.trigger.value,
        "outcome": run.outcome.value,
        "slot": timestamp(run.slot),
        "firstSlot": timestamp(run.first_slot),
        "slots": run.slots,
        "moreSlots": None if run.is_counted else True,
        "jobID": run.job_id,
        "at": timestamp(run.at),
        "message": run.message,
        "links": [] if run.job_id is None else [link(f"{base}/jobs/{run.job_id}", "monitor", "The job")],
    }
    return {name: value for name, value in told.items() if value is not None}


def _answer(
    found: Schedule, base: str, *, status_code: int = 200, headers: dict[str, str] | None = None
) -> JSONResponse:
    told = {"ETag": f'"{found.version}"', "Cache-Control": "no-store", **(headers or {})}
    return JSONResponse(schedule_document(found, base), status_code=status_code, headers=told)


def _check_version(if_match: str | None, found: Schedule) -> None:
    """Refuse a change of what the client did not see; a weak tag never counts.

    Raises
    ------
    ChangedMeanwhileError
        The header names other versions only.
    """
    if if_match is None or if_match.strip() == "*":
        return
    if f'"{found.version}"' not in [tag.strip() for tag in if_match.split(",")]:
        raise ChangedMeanwhileError(
            f'schedule {found.schedule_id} has the ETag "{found.version}", If-Match has {if_match[:80]}: '
            "read it again, then change it"
        )


def _pages(place: str, given: dict[str, str | None], found: int, limit: int, offset: int) -> list[dict[str, str]]:
    """Links to this page of a list and to those beside it; one more than `limit` was asked for."""

    def page(start: int) -> str:
        query = {name: value for name, value in given.items() if value is not None}
        return f"{place}?{urlencode({**query, 'limit': limit, 'offset': start}, errors='replace')}"

    links = [link(page(offset), "self", "This list")]
    if found > limit:
        links.append(link(page(offset + limit), "next", "Older ones"))
    if offset > 0:
        links.append(link(page(max(0, offset - limit)), "prev", "Newer ones"))
    return links
