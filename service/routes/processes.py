"""The processes: list, description, execution."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Body, Depends, Header, Query, Request
from fastapi.responses import JSONResponse

from service.drafts import shortened
from service.errors import RequestError
from service.processes import PROCESSES, process_named
from service.routes.bound import Base, Folder, Settings_, Store, Submitter, visitor
from service.routes.documented import EXECUTE_EXAMPLE, JOB_MADE, document, problems
from service.routes.status import link, status_info
from service.routes.submission import Submission

router = APIRouter(tags=["processes"])

_SUMMARY = {
    "id": "reconstruct",
    "version": "0.1.0",
    "title": "Reconstruct buildings",
    "jobControlOptions": ["async-execute", "dismiss"],
    "outputTransmission": ["reference"],
    "links": [{"href": "http://127.0.0.1:8000/processes/reconstruct", "rel": "self", "type": "application/json"}],
}


@router.get(
    "/processes",
    summary="List the processes",
    dependencies=[Depends(visitor)],
    responses={200: document("ProcessList", "The processes.", {"processes": [_SUMMARY], "links": []})},
)
def processes(
    base: Base,
    limit: Annotated[int, Query(ge=1, le=10_000, description="Most processes to list.")] = 10,
    offset: Annotated[int, Query(ge=0, le=10_000, description="Processes to pass over.")] = 0,
) -> JSONResponse:
    """List the processes."""
    rows = list(PROCESSES.values())
    links = [link(f"{base}/processes?limit={limit}&offset={offset}", "self", "This list")]
    if offset + limit < len(rows):
        links.append(link(f"{base}/processes?limit={limit}&offset={offset + limit}", "next", "The next ones"))
    return JSONResponse(
        {"processes": [process.summary(base) for process in rows[offset : offset + limit]], "links": links}
    )


@router.get(
    "/processes/{processID}",
    summary="Describe a process",
    dependencies=[Depends(visitor)],
    responses={
        200: document(
            "Process",
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
def process(processID: str, base: Base, settings: Settings_) -> JSONResponse:  # noqa: N803 - the standard's word
    """Describe a process: its inputs with their schemas, its outputs with their media types."""
    return JSONResponse(process_named(processID).describe(base, settings))


@router.post(
    "/processes/{processID}/execution",
    summary="Start a job",
    status_code=201,
    responses={
        201: JOB_MADE,
        **problems(400, 404, 422),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "application/json": {
                    "schema": {"$ref": "#/components/schemas/Execute"},
                    "example": EXECUTE_EXAMPLE,
                }
            },
        }
    },
)
async def execute(
    request: Request,
    processID: str,  # noqa: N803 - the standard's word
    body: Annotated[dict[str, Any], Body()],
    base: Base,
    settings: Settings_,
    store: Store,
    folder: Folder,
    caller: Submitter,
    prefer: Annotated[str | None, Header(description="`respond-async` is what happens anyway.")] = None,
) -> JSONResponse:
    """Submit a job. It always runs asynchronously: the answer comes at once and tells where to look."""
    chosen = process_named(processID)
    inputs, outputs = execute_parts(body)
    draft = chosen.draft(inputs, outputs, settings)
    async with Submission(
        store=store, folder=folder, settings=settings, caller=caller, threads=request.app.state.submitting
    ) as submission:
        job = await submission.submit(draft)
    headers = {"Location": f"{base}/jobs/{job.job_id}"}
    if prefer is not None and "respond-async" in prefer.lower():
        headers["Preference-Applied"] = "respond-async"
    return JSONResponse(status_info(job, base), status_code=201, headers=headers)


def execute_parts(body: Mapping[str, Any]) -> tuple[dict[str, Any], list[str] | None]:
    """Inputs and wanted outputs of an execute request.

    Raises
    ------
    RequestError
        It is none.
    """
    faults = []
    inputs, outputs = body.get("inputs", {}), body.get("outputs")
    if not isinstance(inputs, dict):
        faults.append(f"inputs is {shortened(inputs)}: use an object")
    if outputs is not None and not (isinstance(outputs, dict) and all(isinstance(o, dict) for o in outputs.values())):
        faults.append(f"outputs is {shortened(outputs)}: use an object of objects, by the outputs' ids")
    if body.get("mode", "async") not in ("async", "auto"):
        faults.append(f"mode is {shortened(body['mode'])}: jobs run asynchronously, use async or leave it out")
    if body.get("response", "document") not in ("document", "raw"):
        faults.append(f"response is {shortened(body['response'])}: use document or raw")
    if body.get("subscriber") is not None:
        faults.append("subscriber is given: this service does not call back, follow the job's events")
    if faults:
        raise RequestError(faults)
    return inputs, None if outputs is None else list(outputs)
