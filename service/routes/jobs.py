"""Jobs: the one-call submission, list, status, dismissal."""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
import logging
import shutil
from typing import Annotated, Any
from urllib.parse import urlencode

import anyio
from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import JSONResponse
from starlette.concurrency import run_in_threadpool

from service.drafts import shortened
from service.errors import RequestError
from service.files import StateFolder
from service.jobs import Job, JobStatus
from service.multipart import Form, Part
from service.processes import process_named
from service.routes.bound import Base, Folder, Reader, Settings_, Store, Submitter
from service.routes.documented import JOB_ID, JOB_MADE, STATUS_EXAMPLE, document, problems, reference
from service.routes.status import link, status_info
from service.routes.submission import Submission
from service.settings import ServiceSettings
from service.store import JobFilter, JobStore

router = APIRouter(tags=["jobs"])

DISMISSAL_S = 5.0
"""Seconds that a dismissal waits for the driver to let go."""

LOOK_S = 0.1
"""Seconds between looks at a job that is being dismissed."""

OTHER_PARTS = 50
"""Parts of a form beside its files."""

JobId = Annotated[str, Path(alias="jobID", description="As the job's statusInfo tells it.", examples=[JOB_ID])]

_MILLISECOND = dt.timedelta(microseconds=999)
"""The rest of the millisecond that a told time stands for."""
_LAST = dt.datetime.max.replace(tzinfo=dt.UTC)

_log = logging.getLogger("gablework.service")


# --- one call --------------------------------------------------------------------------------------------------------


@router.post(
    "/jobs",
    summary="Send tiles and start a job",
    status_code=201,
    responses={
        201: JOB_MADE,
        **problems(400, 404, 413, 422, 507),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "multipart/form-data": {
                    "schema": reference("JobForm"),
                    "example": {"tile": ["<the file>"], "crs": "EPSG:28992", "method": "fuzzy-sart"},
                }
            },
        }
    },
)
async def submit(
    request: Request, base: Base, settings: Settings_, store: Store, folder: Folder, caller: Submitter
) -> JSONResponse:
    """Send one tile or more as a form and start a job with them: files go to storage as they come in.

    With the field `methods` the job compares these methods, else it reconstructs with one. If anything is refused,
    nothing of the call is kept.
    """
    async with Submission(
        store=store, folder=folder, settings=settings, caller=caller, threads=request.app.state.submitting
    ) as submission:
        inputs, outputs = await _read(request, submission, settings)
        # who names several methods means to compare them
        draft = process_named("compare" if "methods" in inputs else "reconstruct").draft(inputs, outputs, settings)
        job = await submission.submit(draft)
    return JSONResponse(status_info(job, base), status_code=201, headers={"Location": f"{base}/jobs/{job.job_id}"})


async def _read(
    request: Request, submission: Submission, settings: ServiceSettings
) -> tuple[dict[str, Any], list[str] | None]:
    """Inputs and wanted outputs of a form; its files are stored on the way.

    Raises
    ------
    RequestError
        It is no form, or holds what cannot be read.
    """
    content_type = request.headers.get("content-type", "")
    form = Form(aiter(request.stream()), content_type, max_parts=settings.max_inputs + OTHER_PARTS)
    inputs: dict[str, Any] = {}
    outputs: list[str] | None = None
    faults: list[str] = []
    left = settings.max_body_bytes
    async for part in form.parts():
        name = "tiles" if part.name == "tile" else part.name
        if name in {"tiles", "footprints"} and part.filename is not None:
            source: dict[str, Any] = await _stored(part, submission, len(inputs.get(name, ())), settings)
            inputs.setdefault(name, []).append(source)
            continue
        text = await part.text(left)
        left -= len(text.encode())
        if name in {"tiles", "footprints"}:
            inputs.setdefault(name, []).append({"href": text.strip()})
        elif name == "outputs":
            outputs = [*(outputs or ()), *_words(text)]
        elif name == "methods":
            if words := _words(text):  # like any other field, left empty it was not given
                inputs.setdefault(name, []).extend(words)
        elif name in inputs:
            faults.append(f"{shortened(name)} is given twice: give it once")
        elif text.strip():
            inputs[name] = _value(name, text, faults)
    if faults:
        raise RequestError(faults)
    return inputs, outputs


async def _stored(part: Part, submission: Submission, number: int, settings: ServiceSettings) -> dict[str, str]:
    """A file of the form, as a reference to its upload."""
    if number >= settings.max_inputs:
        raise RequestError([f"{part.name} comes more than {settings.max_inputs} times: use fewer files"])
    kept = await submission.keep(part.chunks(), part.filename or "")
    return {"href": f"/uploads/{kept.value}"}


def _words(text: str) -> list[str]:
    """Words with commas between them."""
    return [word.strip() for word in text.split(",") if word.strip()]


def _value(name: str, text: str, faults: list[str]) -> Any:
    """A field's value: settings are JSON, a rectangle and a priority are numbers, anything else is text."""
    if name not in {"settings", "bbox", "priority"}:
        return text.strip()
    if name == "bbox" and not text.strip().startswith(("[", "{")):
        text = f"[{text}]"
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        faults.append(f"{name} is {shortened(text)}: use JSON ({error})")
        return None


# --- list ------------------------------------------------------------------------------------------------------------

_STATUSES = [status.value for status in JobStatus]


@router.get(
    "/jobs",
    summary="List jobs",
    responses={
        200: document("JobList", "The jobs, newest first.", {"jobs": [STATUS_EXAMPLE], "links": []}),
        **problems(400),
    },
)
def jobs(
    base: Base,
    store: Store,
    caller: Reader,
    kind: Annotated[list[str] | None, Query(alias="type", description="Only `process` is here.")] = None,
    process_ids: Annotated[list[str] | None, Query(alias="processID", description="Only of these processes.")] = None,
    statuses: Annotated[
        list[str] | None, Query(alias="status", description=f"Only with these: {', '.join(_STATUSES)}.")
    ] = None,
    schedule_id: Annotated[str | None, Query(alias="scheduleID", description="Only of this schedule.")] = None,
    created: Annotated[
        str | None,
        Query(alias="datetime", description="Created then: an RFC 3339 time, or `a/b`, `../b`, `a/..`."),
    ] = None,
    min_duration: Annotated[
        float | None, Query(alias="minDuration", ge=0.0, le=1e9, allow_inf_nan=False, description="Seconds.")
    ] = None,
    max_duration: Annotated[
        float | None, Query(alias="maxDuration", ge=0.0, le=1e9, allow_inf_nan=False, description="Seconds.")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=10_000, description="Most jobs to list.")] = 100,
    offset: Annotated[int, Query(ge=0, le=2**31 - 1, description="Jobs to pass over.")] = 0,
) -> JSONResponse:
    """List the jobs that this key may see."""
    faults: list[str] = []
    wanted = _listed(statuses)
    faults.extend(
        f"status is {shortened(word)}: use one of {', '.join(_STATUSES)}" for word in wanted if word not in _STATUSES
    )
    first, last = _interval(created, faults)
    if faults:
        raise RequestError(faults)
    given: list[tuple[str, object]] = [
        *(("type", word) for word in _listed(kind)),
        *(("processID", word) for word in _listed(process_ids)),
        *(("status", word) for word in wanted),
        ("scheduleID", schedule_id),
        ("datetime", created),
        ("minDuration", min_duration),
        ("maxDuration", max_duration),
        ("limit", limit),
    ]
    found: list[Job] = []
    if not _listed(kind) or "process" in _listed(kind):
        criteria = JobFilter(
            owner=caller.owner,
            statuses=[JobStatus(word) for word in wanted],
            process_ids=_listed(process_ids),
            schedule_id=schedule_id,
            created_from=first,
            created_to=last,
            min_duration_s=min_duration,
            max_duration_s=max_duration,
            limit=limit + 1,
            offset=offset,
        )
        found = store.list(criteria)

    def page(start: int) -> str:
        query = [(name, value) for name, value in (*given, ("offset", start)) if value is not None]
        return f"{base}/jobs?{urlencode(query)}"

    links = [link(page(offset), "self", "These jobs")]
    if len(found) > limit:
        links.append(link(page(offset + limit), "next", "Older jobs"))
    if offset > 0:
        links.append(link(page(max(0, offset - limit)), "prev", "Newer jobs"))
    listed = [status_info(job, base, with_request=False) for job in found[:limit]]
    return JSONResponse({"jobs": listed, "links": links})


def _listed(values: list[str] | None) -> list[str]:
    """A parameter that may come several times, with commas, or both."""
    return [word for value in values or () for word in value.split(",") if word]


def _interval(text: str | None, faults: list[str]) -> tuple[dt.datetime | None, dt.datetime | None]:
    """From when to when; an instant stands for its millisecond, as times are told."""
    if text is None:
        return None, None
    parts = text.split("/")
    first = _instant(parts[0], faults, is_open=len(parts) == 2)
    if len(parts) == 1:
        # nothing comes after the last instant that there is
        return first, None if first is None or first > _LAST - _MILLISECOND else first + _MILLISECOND
    if len(parts) > 2:
        faults.append(f"datetime is {shortened(text)}: use one time, or two with a slash between them")
        return None, None
    last = _instant(parts[1], faults, is_open=True)
    if first is not None and last is not None and first > last:
        faults.append(f"datetime is {shortened(text)}: use an end that is not before the start")
    return first, last


def _instant(text: str, faults: list[str], *, is_open: bool) -> dt.datetime | None:
    """An RFC 3339 time in UTC; None for an open end."""
    if is_open and text in {"", ".."}:
        return None
    try:
        # in a query an unescaped plus is a space
        at = dt.datetime.fromisoformat(text.strip().replace(" ", "+") if "T" in text else text)
        return (at if at.tzinfo is not None else at.replace(tzinfo=dt.UTC)).astimezone(dt.UTC)
    except (ValueError, OverflowError):
        faults.append(f"datetime is {shortened(text)}: use a time such as 2026-03-01T09:30:00Z")
        return None


# --- one job ---------------------------------------------------------------------------------------------------------


@router.get(
    "/jobs/{jobID}",
    summary="Status of a job",
    responses={200: document("StatusInfo", "Its status.", STATUS_EXAMPLE), **problems(404)},
)
def job(job_id: JobId, base: Base, store: Store, caller: Reader) -> JSONResponse:
    """Tell how far a job is."""
    found = store.get(job_id, owner=caller.owner)
    return JSONResponse(status_info(found, base), headers={"Cache-Control": "no-store"})


@router.delete(
    "/jobs/{jobID}",
    summary="Dismiss a job",
    responses={
        200: document(
            "StatusInfo",
            "The job is dismissed or removed. Where its driver has not let go yet it still reads `running`, "
            "with a message that says so.",
            STATUS_EXAMPLE | {"status": "dismissed", "message": "dismissed"},
        ),
        **problems(404),
    },
)
async def dismiss(job_id: JobId, base: Base, store: Store, folder: Folder, caller: Submitter) -> JSONResponse:
    """Stop a job that waits or runs; remove one that is over, with its results."""
    before = await run_in_threadpool(store.get, job_id, owner=caller.owner)
    if before.status.is_over:
        await run_in_threadpool(_remove, before, store, folder)
        gone = dataclasses.replace(before, status=JobStatus.DISMISSED, message="removed with its results", failure=None)
        return JSONResponse(status_info(gone, base))
    found = await run_in_threadpool(store.dismiss, job_id, owner=caller.owner)
    with anyio.move_on_after(DISMISSAL_S):
        while not found.status.is_over:
            await anyio.sleep(LOOK_S)
            found = await run_in_threadpool(store.get, job_id, owner=caller.owner)
    if not found.status.is_over:
        found = dataclasses.replace(found, message="dismissal was requested; the work is being stopped")
    return JSONResponse(status_info(found, base))


def _remove(job: Job, store: JobStore, folder: StateFolder) -> None:
    """Forget a job, then its files; what cannot be removed now is the driver's janitor's business."""
    store.remove(job.job_id)

    def tell(_function: object, path: str, error: tuple[type[BaseException], BaseException, object]) -> None:
        if not isinstance(error[1], FileNotFoundError):
            _log.warning("%s of job %s cannot be removed: %s", path, job.job_id, error[1])

    shutil.rmtree(folder.job(job.job_id), onerror=tell)
