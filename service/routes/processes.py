"""The processes: list, description, execution."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Body, Depends, Header, Path, Query, Response

from service.processes import PROCESSES, process_named
from service.routes.answers import JOB_MADE, document, problems
from service.routes.bound import Base, Settings_, visitor
from service.routes.html import PageRoute, in_either_form
from service.routes.submission import Submitting
from service.status import job_made
from service.wire.base import link, respond
from service.wire.execute import EXAMPLE, Execute
from service.wire.processes import Process, ProcessList

router = APIRouter(tags=["processes"], route_class=PageRoute)

ProcessId = Annotated[
    str, Path(alias="processID", description="As in the list of processes.", examples=["reconstruct"])
]

_SUMMARY = {
    "id": "reconstruct",
    "version": "0.2.0",
    "title": "Reconstruct buildings",
    "jobControlOptions": ["async-execute", "dismiss"],
    "outputTransmission": ["reference"],
    "links": [{"href": "http://127.0.0.1:8000/processes/reconstruct", "rel": "self", "type": "application/json"}],
}


@router.get(
    "/processes",
    summary="List the processes",
    dependencies=[Depends(visitor), in_either_form],
    responses={200: document(ProcessList, "The processes.", {"processes": [_SUMMARY], "links": []})},
)
def processes(
    base: Base,
    limit: Annotated[int, Query(ge=1, le=10_000, description="Maximum number of processes to list.")] = 10,
    offset: Annotated[int, Query(ge=0, le=10_000, description="Number of processes to skip.")] = 0,
) -> Response:
    """List the processes."""
    rows = list(PROCESSES.values())
    links = [link(f"{base}/processes?limit={limit}&offset={offset}", "self", "This list")]
    if offset + limit < len(rows):
        links.append(link(f"{base}/processes?limit={limit}&offset={offset + limit}", "next", "The next ones"))
    page = [process.summary(base) for process in rows[offset : offset + limit]]
    return respond(ProcessList(processes=page, links=links))


@router.get(
    "/processes/{processID}",
    summary="Describe a process",
    dependencies=[Depends(visitor), in_either_form],
    responses={
        200: document(
            Process,
            "Its inputs and outputs.",
            {
                **_SUMMARY,
                "inputs": {"crs": {"title": "CRS", "schema": {"type": "string"}, "minOccurs": 0, "maxOccurs": 1}},
                "outputs": {"report": {"title": "Report", "schema": {"type": "object"}}},
            },
        ),
        **problems(404),
    },
)
def process(process_id: ProcessId, base: Base, settings: Settings_) -> Response:
    """Describe a process: its inputs with their schemas, its outputs with their media types."""
    return respond(process_named(process_id).describe(base, settings))


@router.post(
    "/processes/{processID}/execution",
    summary="Start a job",
    status_code=201,
    responses={201: JOB_MADE, **problems(400, 404, 409, 422, 507)},
)
async def execute(
    process_id: ProcessId,
    body: Annotated[Execute, Body(openapi_examples={"reconstruct": {"value": EXAMPLE}})],
    base: Base,
    submitting: Submitting,
    prefer: Annotated[str | None, Header(description="`respond-async` always applies.")] = None,
) -> Response:
    """Submit a job. It always runs asynchronously: the answer comes at once and links to the job's status."""
    headers = {}
    if prefer is not None and "respond-async" in prefer.lower():
        headers["Preference-Applied"] = "respond-async"
    async with submitting as submission:
        draft = process_named(process_id).draft(body, submission.settings)
        return await submission.submit(draft, lambda job: job_made(job, base, headers))
