"""Schedules: make, list, change, pause, run by hand and remove them; and what happened to their slots."""

from __future__ import annotations

import datetime as dt
from typing import Annotated
from urllib.parse import urlencode

from fastapi import APIRouter, Body, Header, Path, Query, Response
from starlette.concurrency import run_in_threadpool

from pipeline.schedule import Cron, Missed, Overlap
from service.deliveries import Delivery
from service.drafts import Draft
from service.errors import ChangedMeanwhileError, RequestError, within
from service.jobs import Job, JobRequest
from service.processes import process_named
from service.routes.answers import (
    JOB_MADE,
    SCHEDULE_EXAMPLE,
    SCHEDULE_ID,
    SCHEDULE_REQUEST_EXAMPLE,
    SCHEDULE_RUN_EXAMPLE,
    document,
    header,
    problems,
    reference,
)
from service.routes.bound import Base, Reader, Settings_, Store, Submitter
from service.routes.submission import Changing, Submitting
from service.routes.writing import Write
from service.schedules import Definition, Schedule, ScheduleRun
from service.settings import ServiceSettings
from service.status import execute_request, job_made
from service.store import ScheduleFilter
from service.wire import schedules as wire
from service.wire.base import link, page_links, respond
from service.wire.execute import Execute
from service.wire.queries import Page, ScheduleQuery

router = APIRouter(tags=["schedules"])

NEXT_TIMES = 5
"""Number of next times in a schedule's document."""

ScheduleId = Annotated[str, Path(alias="scheduleID", description="As in the schedule itself.", examples=[SCHEDULE_ID])]

_PATCH = {"schema": reference(wire.SchedulePatch)}
_TAG = header("ETag", "The version, for If-Match.")


@router.post(
    "/schedules",
    summary="Make a schedule",
    status_code=201,
    responses={
        201: document(
            wire.Schedule,
            "The schedule; its first slot is the first one after now.",
            SCHEDULE_EXAMPLE,
            headers={**header("Location", "The schedule."), **_TAG},
        ),
        **problems(400, 404, 409, 422, 507),
    },
)
async def make_schedule(
    body: Annotated[wire.ScheduleRequest, Body(openapi_examples={"nightly": {"value": SCHEDULE_REQUEST_EXAMPLE}})],
    base: Base,
    store: Store,
    submitting: Submitting,
) -> Response:
    """Make a schedule: a cron expression, a time zone, and the request of its jobs.

    The request is checked as that of a job that is submitted now, its inputs included. The uploads that it names are
    kept as long as the schedule exists.
    """
    settings, caller = submitting.settings, submitting.caller

    def answer(made: Schedule) -> Response:
        place = f"{base}/schedules/{made.schedule_id}"
        return _answer(made, base, status_code=201, headers={"Location": place})

    async with submitting as submission:
        draft = _draft(body.processID, body.execute, settings)

        def create(request: JobRequest, delivery: Delivery[Schedule]) -> Schedule:
            definition = _definition(body, None, request, draft.priority)
            most = settings.max_schedules_per_key
            return store.schedules.create(definition, owner=caller.key_id, most=most, delivery=delivery)

        return await submission.checked(draft, create, answer)


def _draft(process_id: str, execute: Execute, settings: ServiceSettings) -> Draft:
    """The draft of a schedule's jobs; raises RequestError with the faults of `execute`."""
    try:
        return process_named(process_id).draft(execute, settings)
    except RequestError as error:
        raise RequestError(within("execute", error.faults)) from error


def _definition(body: wire.SchedulePatch, before: Definition | None, request: JobRequest, priority: int) -> Definition:
    """The definition of a new schedule, or of one that is changed: members that are not given stay."""
    given = {name: getattr(body, name) for name in body.model_fields_set}
    old = Definition(cron=Cron("* * * * *", body.timeZone), request=request) if before is None else before
    return Definition(
        title=given.get("title", old.title),
        cron=Cron(given.get("cron", old.cron.expression), given.get("timeZone", old.cron.time_zone)),
        request=request,
        priority=priority,
        missed=Missed(given.get("missed", old.missed)),
        grace_s=float(given.get("graceSeconds", old.grace_s)),
        overlap=Overlap(given.get("overlap", old.overlap)),
        is_paused=given.get("paused", old.is_paused),
    )


@router.get(
    "/schedules",
    summary="List schedules",
    responses={
        200: document(
            wire.ScheduleList, "The schedules, newest first.", {"schedules": [SCHEDULE_EXAMPLE], "links": []}
        ),
        **problems(400),
    },
)
def schedules(base: Base, store: Store, caller: Reader, query: Annotated[ScheduleQuery, Query()]) -> Response:
    """List the schedules that this key may see."""
    criteria = ScheduleFilter(
        owner=caller.owner,
        state=query.state,
        process_id=query.processID,
        limit=query.limit + 1,
        offset=query.offset,
    )
    found = store.schedules.list(criteria)
    asked = [("state", query.state), ("processID", query.processID)]
    links = page_links(f"{base}/schedules", asked, len(found), query.limit, query.offset)
    listed = [schedule_document(one, base, with_request=False) for one in found[: query.limit]]
    return respond(wire.ScheduleList(schedules=listed, links=links))


@router.get(
    "/schedules/{scheduleID}",
    summary="A schedule",
    responses={
        200: document(wire.Schedule, "The schedule.", SCHEDULE_EXAMPLE, headers=_TAG),
        **problems(404),
    },
)
def schedule(schedule_id: ScheduleId, base: Base, store: Store, caller: Reader) -> Response:
    """A schedule: the next times, the last run, and how many slots were run, skipped and missed."""
    return _answer(store.schedules.get(schedule_id, owner=caller.owner), base)


@router.patch(
    "/schedules/{scheduleID}",
    summary="Change, pause or resume a schedule",
    responses={
        200: document(wire.Schedule, "The schedule as it is now.", SCHEDULE_EXAMPLE, headers=_TAG),
        **problems(400, 404, 412, 422, 507),
    },
    openapi_extra={
        "requestBody": {"content": {"application/merge-patch+json": {"schema": reference(wire.SchedulePatch)}}}
    },
)
async def change_schedule(
    schedule_id: ScheduleId,
    body: Annotated[wire.SchedulePatch, Body(openapi_examples={"pause": {"value": {"paused": True}}})],
    base: Base,
    store: Store,
    submitting: Changing,
    if_match: Annotated[
        str | None,
        Header(description="The ETag that the client has; the change is refused if the schedule has another one."),
    ] = None,
) -> Response:
    """Change what is given; the rest stays. Slots that come while it is paused do not count as missed."""
    owner = submitting.caller.owner
    before = await run_in_threadpool(store.schedules.get, schedule_id, owner=owner)
    process_id = before.definition.request.process_id
    draft = None
    if "execute" in body.model_fields_set:
        chosen = body.processID if "processID" in body.model_fields_set else process_id
        draft = _draft(chosen, body.execute, submitting.settings)
    elif "processID" in body.model_fields_set and body.processID != process_id:
        raise RequestError([f'processID is "{body.processID}": the schedule runs {process_id}, give execute, too'])
    # a precondition counts only for a request that would succeed without it
    _check_version(if_match, before)

    priority = before.definition.priority if draft is None else draft.priority

    def change(request: JobRequest, delivery: Delivery[Schedule]) -> Schedule:
        definition = _definition(body, before.definition, request, priority)
        return store.schedules.change(schedule_id, definition, version=before.version, owner=owner, delivery=delivery)

    def answer(changed: Schedule) -> Response:
        return _answer(changed, base)

    if draft is None:
        return await submitting.make(lambda delivery: change(before.definition.request, delivery), answer)
    async with submitting as submission:
        return await submission.checked(draft, change, answer)


@router.delete(
    "/schedules/{scheduleID}",
    summary="Remove a schedule",
    status_code=204,
    response_class=Response,
    responses={204: {"description": "It is removed. Its jobs stay; a running one continues."}, **problems(404)},
)
async def remove_schedule(schedule_id: ScheduleId, store: Store, caller: Submitter, write: Write) -> Response:
    """Remove a schedule with the history of its slots."""
    await write(lambda: store.schedules.remove(schedule_id, owner=caller.owner))
    return Response(status_code=204)


@router.post(
    "/schedules/{scheduleID}/run",
    summary="Run a schedule now",
    status_code=201,
    responses={201: JOB_MADE, **problems(400, 404, 409, 422, 507)},
)
async def run_schedule(
    schedule_id: ScheduleId, base: Base, settings: Settings_, store: Store, submitting: Submitting
) -> Response:
    """Make a job now, independent of the clock, also if the schedule is paused.

    This is refused while a job of the schedule is under way; `jobID` of the problem names that job.
    """

    def run(delivery: Delivery[Job]) -> Job:
        return store.schedules.run_now(
            schedule_id,
            owner=submitting.caller.owner,
            limits=settings.queue_limits,
            delivery=delivery,
        )

    async with submitting as submission:
        return await submission.make(run, lambda job: job_made(job, base))


@router.get(
    "/schedules/{scheduleID}/runs",
    summary="Outcomes of a schedule's times",
    responses={
        200: document(wire.ScheduleRunList, "Latest first.", {"runs": [SCHEDULE_RUN_EXAMPLE], "links": []}),
        **problems(400, 404),
    },
)
def schedule_runs(
    schedule_id: ScheduleId, base: Base, store: Store, caller: Reader, page: Annotated[Page, Query()]
) -> Response:
    """List every slot and run by hand with its job, or the reason why there is none."""
    found = store.schedules.runs(schedule_id, owner=caller.owner, limit=page.limit + 1, offset=page.offset)
    links = page_links(f"{base}/schedules/{schedule_id}/runs", (), len(found), page.limit, page.offset)
    links.append(link(f"{base}/schedules/{schedule_id}", "up", "The schedule"))
    runs = [run_document(run, base) for run in found[: page.limit]]
    return respond(wire.ScheduleRunList(runs=runs, links=links))


def schedule_document(found: Schedule, base: str, *, with_request: bool = True) -> wire.Schedule:
    """A schedule as clients see it; lists leave the request out."""
    definition = found.definition
    place = f"{base}/schedules/{found.schedule_id}"
    times: list[dt.datetime] = []
    if not definition.is_paused:
        times = definition.cron.next_times(found.decided_until, NEXT_TIMES if with_request else 1)
    return wire.Schedule(
        scheduleID=found.schedule_id,
        version=found.version,
        title=definition.title,
        state="paused" if definition.is_paused else "active",
        cron=definition.cron.expression,
        timeZone=definition.cron.time_zone,
        missed=definition.missed.value,
        graceSeconds=definition.grace_s,
        overlap=definition.overlap.value,
        processID=definition.request.process_id,
        execute=execute_request(definition.request, base, definition.priority) if with_request else None,
        created=found.created_at,
        updated=found.updated_at,
        nextTimes=times,
        waiting=found.waiting_slot,
        lastRun=None if found.last_run is None else run_document(found.last_run, base),
        counts={outcome.value: number for outcome, number in found.counts.items()},
        links=[
            link(place, "self", "This schedule"),
            link(f"{place}/runs", "runs", "What happened to its slots"),
            link(f"{base}/jobs?{urlencode({'scheduleID': found.schedule_id})}", "jobs", "Its jobs"),
        ],
    )


def run_document(run: ScheduleRun, base: str) -> wire.ScheduleRun:
    """The outcome of a slot, as clients see it."""
    return wire.ScheduleRun(
        number=run.number,
        trigger=run.trigger.value,
        outcome=run.outcome.value,
        slot=run.slot,
        firstSlot=run.first_slot,
        slots=run.slots,
        moreSlots=None if run.is_counted else True,
        jobID=run.job_id,
        at=run.at,
        message=run.message,
        links=[] if run.job_id is None else [link(f"{base}/jobs/{run.job_id}", "monitor", "The job")],
    )


def _answer(found: Schedule, base: str, *, status_code: int = 200, headers: dict[str, str] | None = None) -> Response:
    all_headers = {"ETag": f'"{found.version}"', "Cache-Control": "no-store", **(headers or {})}
    return respond(schedule_document(found, base), status_code=status_code, headers=all_headers)


def _check_version(if_match: str | None, found: Schedule) -> None:
    """Refuse a change of a version that the client has not seen; a weak tag never counts."""
    if if_match is None or if_match.strip() == "*":
        return
    if f'"{found.version}"' not in [tag.strip() for tag in if_match.split(",")]:
        raise ChangedMeanwhileError(
            f'schedule {found.schedule_id} has the ETag "{found.version}", If-Match has {if_match[:80]}: '
            "read it again, then change it"
        )
