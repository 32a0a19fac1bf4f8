"""Jobs: the one-call submission, list, status, dismissal."""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Body, Path, Query, Response
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool

from pipeline.options import served
from service import bodies
from service.errors import JobNotOverError, RequestError
from service.files import StateFolder
from service.jobs import Fault, Job, JobStatus
from service.keys import Scope
from service.multipart import Part
from service.processes import process_named
from service.routes.answers import JOB_ID, JOB_MADE, STATUS_EXAMPLE, document, problems, reference
from service.routes.bound import Base, Folder, Reader, Store, Submitter
from service.routes.html import PageRoute, in_either_form
from service.routes.polling import StatusRoute, job_status
from service.routes.submission import Submission, Submitting
from service.routes.writing import Write
from service.status import execute_request, job_made, status_info
from service.store import JobFilter
from service.wire.base import page_links, respond
from service.wire.execute import RETRY_EXAMPLES, Execute, Retry, wanted
from service.wire.faults import sentences, shortened
from service.wire.inputs import FILES
from service.wire.jobs import JobChanges, JobForm, JobList, StatusInfo
from service.wire.queries import JobQuery, interval

router = APIRouter(tags=["jobs"], route_class=PageRoute)

DISMISSAL_S = 5.0
"""Seconds that a dismissal waits for the driver to stop."""

LOOK_S = 0.1
"""Seconds between checks of a job that is being dismissed."""

MAX_WORDS = 100
"""Most words of one field of a form."""

OTHER_PARTS = 50
"""Maximum number of parts of a form that are not files."""

JobId = Annotated[str, Path(alias="jobID", description="As in the job's statusInfo.", examples=[JOB_ID])]

_log = logging.getLogger("gablework.service")


# --- one call --------------------------------------------------------------------------------------------------------


@router.post(
    "/jobs",
    summary="Send tiles and start a job",
    status_code=201,
    responses={
        201: JOB_MADE,
        **problems(400, 404, 409, 413, 422, 507),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "multipart/form-data": {
                    "schema": reference(JobForm),
                    "example": {"tile": ["<the file>"], "crs": "EPSG:28992", "method": "fuzzy-sart"},
                }
            },
        }
    },
)
async def submit(base: Base, submitting: Submitting) -> Response:
    """Send one tile or more as a form and start a job with them: files go to storage as they come in.

    With the field `methods` the job compares these methods, else it reconstructs with one. If anything is refused,
    nothing of the call is kept.
    """
    async with submitting as submission:
        execute = await _read(submission)
        process = process_named("compare" if "methods" in execute.inputs else "reconstruct")
        draft = process.draft(execute, submission.settings)
        return await submission.submit(draft, lambda job: job_made(job, base))


async def _read(submission: Submission) -> Execute:
    """The request in a form; its files are stored on the way."""
    settings = submission.settings
    form = submission.form(max_parts=settings.max_inputs + OTHER_PARTS)
    inputs: dict[str, Any] = {}
    outputs: list[str] | None = None
    faults: list[str] = []
    left = settings.max_body_bytes
    async for part in form.parts():
        name = "tiles" if part.name == "tile" else part.name
        is_file = name in FILES
        if is_file and part.filename is not None:
            inputs.setdefault(name, []).append(await _stored(part, submission, len(inputs.get(name, ()))))
            continue
        text = await part.text(left)
        left -= len(text.encode())
        if is_file:
            inputs.setdefault(name, []).append({"href": text.strip()})
        elif name == "outputs":
            outputs = [*(outputs or ()), *_words(text)]
        elif name in {"methods", "publish"}:
            if words := _words(text):  # an empty field counts as absent, as for any other field
                inputs.setdefault(name, []).extend(words)
        elif name in inputs:
            faults.append(f"{shortened(name)} is given twice: give it once")
        elif text.strip():
            inputs[name] = await _value(name, text, settings.max_body_bytes, faults)
    if faults:
        raise RequestError(faults)
    given = {"subscriber": inputs.pop("subscriber")} if "subscriber" in inputs else {}
    try:
        return Execute.model_validate(
            {"inputs": inputs, "outputs": None if outputs is None else wanted(outputs), **given}
        )
    except ValidationError as error:
        raise RequestError(sentences(error.errors(include_url=False))) from error


async def _stored(part: Part, submission: Submission, number: int) -> dict[str, str]:
    """A file of the form, as a reference to its upload."""
    most = submission.settings.max_inputs
    if number >= most:
        raise RequestError([f"{part.name} is given more than {most} times: use fewer files"])
    kept = await submission.keep(part.chunks(), part.filename or "")
    return {"href": f"/uploads/{kept.value}"}


def _words(text: str) -> list[str]:
    """Words with commas between them.

    Raises
    ------
    RequestError
        More than anything here has.
    """
    found = [word.strip() for word in text.split(",") if word.strip()]
    if len(found) > MAX_WORDS:
        raise RequestError([f"{shortened(text)} has {len(found):,} words: use at most {MAX_WORDS}"])
    return found


_AS_JSON = frozenset(
    {"settings", "subscriber", "priority", "geoidHeight", *(one.input for one in served() if one.type is not str)}
)


async def _value(name: str, text: str, max_bytes: int, faults: list[str]) -> Any:
    """A field's value: settings, subscriber, numbers and permissions (true, false) are JSON, anything else is text."""
    if name not in _AS_JSON:
        return text.strip()
    if name == "bbox" and not text.strip().startswith(("[", "{")):
        text = f"[{text}]"
    try:
        return await bodies.read(text, max_bytes)
    except json.JSONDecodeError as error:
        faults.append(f"{name} is {shortened(text)}: use JSON ({error})")
    except ValueError:  # the limit of Python's own, whose message names a function of Python
        faults.append(f"{name} is {shortened(text)}: use numbers of fewer digits")
    return None


# --- list ------------------------------------------------------------------------------------------------------------


@router.get(
    "/jobs",
    summary="List jobs",
    dependencies=[in_either_form],
    responses={
        200: document(JobList, "The jobs, newest first.", {"jobs": [STATUS_EXAMPLE], "numberMatched": 1, "links": []}),
        **problems(400),
    },
)
def jobs(base: Base, store: Store, caller: Reader, query: Annotated[JobQuery, Query()]) -> Response:
    """List the jobs that this key may see."""
    created_from, created_to = interval(query.datetime)
    found: list[Job] = []
    matched = 0
    if not query.type or "process" in query.type:
        criteria = JobFilter(
            owner=caller.owner,
            statuses=[JobStatus(word) for word in query.status or ()],
            process_ids=query.processID or [],
            schedule_id=query.scheduleID,
            words=(query.q or "").split(),
            created_from=created_from,
            created_to=created_to,
            min_duration_s=query.minDuration,
            max_duration_s=query.maxDuration,
            limit=query.limit + 1,
            offset=query.offset,
        )
        found = store.list(criteria)
        matched = store.matching(criteria)
    given = [
        *((name, word) for name in ("type", "processID", "status") for word in getattr(query, name) or ()),
        *((name, getattr(query, name)) for name in ("scheduleID", "q", "datetime", "minDuration", "maxDuration")),
    ]
    links = page_links(f"{base}/jobs", given, len(found), query.limit, query.offset)
    listed = [status_info(job, base, with_request=False) for job in found[: query.limit]]
    return respond(JobList(jobs=listed, numberMatched=matched, links=links))


# --- one job ---------------------------------------------------------------------------------------------------------


def job(job_id: JobId, base: Base, store: Store, caller: Reader) -> Response:
    """Status and progress of a job."""
    return job_status(store.get(job_id, owner=caller.owner), base)


router.add_api_route(
    "/jobs/{jobID}",
    job,
    methods=["GET"],
    summary="Status of a job",
    dependencies=[in_either_form],
    responses={200: document(StatusInfo, "Its status.", STATUS_EXAMPLE), **problems(404)},
    route_class_override=StatusRoute,
)


@router.post(
    "/jobs/{jobID}/retry",
    summary="Try a job again",
    status_code=201,
    responses={201: JOB_MADE, **problems(400, 403, 404, 409, 422, 507)},
)
async def retry(
    job_id: JobId,
    base: Base,
    submitting: Submitting,
    changes: Annotated[Retry | None, Body(openapi_examples=RETRY_EXAMPLES)] = None,
) -> Response:
    """Start a new job with the request of one that is over, with changes if some are given. The old job stays.

    A job that failed since its attempts stood still needs a key with the scope `admin`.
    """
    async with submitting as submission:
        before = await run_in_threadpool(submission.store.get, job_id, owner=submission.caller.owner)
        if not before.status.is_over:
            raise JobNotOverError(f"job {job_id} is {before.status.value}: dismiss it first, or wait until it is over")
        if before.failure is not None and before.failure.fault is Fault.STALLED:
            submission.caller.require(Scope.ADMIN)
        execute = (changes or Retry()).applied_to(execute_request(before.request, base, before.priority))
        draft = process_named(before.request.process_id).draft(execute, submission.settings)
        return await submission.submit(draft, lambda job: job_made(job, base))


@router.patch(
    "/jobs/{jobID}",
    summary="Keep a job",
    responses={200: document(StatusInfo, "The job.", STATUS_EXAMPLE | {"keep": True}), **problems(400, 404)},
)
async def change(
    job_id: JobId, changes: JobChanges, base: Base, store: Store, write: Write, caller: Submitter
) -> Response:
    """Keep a job with its results, whatever its age and size, or no longer."""
    found = await write(lambda: store.keep(job_id, keep=changes.keep, owner=caller.owner))
    return respond(status_info(found, base))


@router.delete(
    "/jobs/{jobID}",
    summary="Dismiss a job",
    responses={
        200: document(
            StatusInfo,
            "The job is dismissed or removed. If its driver has not stopped yet, the status is still `running`, with "
            "a message that says so.",
            STATUS_EXAMPLE | {"status": "dismissed", "message": "dismissed"},
        ),
        **problems(404),
    },
)
async def dismiss(job_id: JobId, base: Base, store: Store, folder: Folder, caller: Submitter, write: Write) -> Response:
    """Stop a job that waits or runs; remove one that is over, with its results."""
    before = await run_in_threadpool(store.get, job_id, owner=caller.owner)
    if before.status.is_over:
        await write(lambda: store.remove(job_id))
        await run_in_threadpool(_remove_files, before, folder)
        gone = dataclasses.replace(before, status=JobStatus.DISMISSED, message="removed with its results", failure=None)
        return respond(status_info(gone, base))
    found = await write(lambda: store.dismiss(job_id, owner=caller.owner))
    with anyio.move_on_after(DISMISSAL_S):
        while not found.status.is_over:
            await anyio.sleep(LOOK_S)
            found = await run_in_threadpool(store.get, job_id, owner=caller.owner)
    if not found.status.is_over:
        found = dataclasses.replace(found, message="dismissal was requested; the work is being stopped")
    return respond(status_info(found, base))


def _remove_files(job: Job, folder: StateFolder) -> None:
    """Remove the files of a job; the driver's janitor removes what cannot be removed now."""

    def warn(_function: object, path: str, error: tuple[type[BaseException], BaseException, object]) -> None:
        if not isinstance(error[1], FileNotFoundError):
            _log.warning("%s of job %s cannot be removed: %s", path, job.job_id, error[1])

    shutil.rmtree(folder.job(job.job_id), onerror=warn)
