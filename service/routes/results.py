"""Results of a job: the document that lists them, and each output as a file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import FileResponse
from starlette.exceptions import HTTPException

from service.errors import RequestError
from service.outputs import KINDS, OUTPUTS, output_file
from service.outputs.kinds import HTML
from service.routes.answers import JOB_ID, document, header, problems
from service.routes.bound import Base
from service.routes.finished_jobs import Asked, FinishedJob
from service.routes.html import PageRoute, in_either_form
from service.routes.negotiation import preferred
from service.status import results_document
from service.wire.base import respond
from service.wire.queries import Words
from service.wire.results import Results

router = APIRouter(tags=["results"], route_class=PageRoute)

FAILED = (422, 500, 503)
"""Status codes of a failed job's results, by the cause."""

SANDBOX = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; font-src data:; script-src 'unsafe-inline'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox allow-scripts"
)
"""Content security policy of a page among the results. The page is self-contained: it may show its own content, but
load and send nothing. It has its own origin, so nothing in it reaches the service, its keys or its storage."""

_RANGES = re.compile(r"bytes=\s*(\d{1,18}-\d{0,18}|-\d{1,18})(\s*,\s*(\d{1,18}-\d{0,18}|-\d{1,18}))*\s*", re.IGNORECASE)

_EXAMPLE = {
    output_id: {
        "href": f"http://127.0.0.1:8000/jobs/{JOB_ID}/results/{output_id}",
        "rel": "item",
        "type": OUTPUTS[output_id].media_type,
        "title": OUTPUTS[output_id].title,
        "bytes": size,
        "sha256": "9f" * 32,
    }
    for output_id, size in (("buildings", 89_644), ("report", 6_767))
}


@router.get(
    "/jobs/{jobID}/results",
    summary="Results of a job",
    dependencies=[in_either_form],
    responses={
        200: document(Results, "The outputs by reference.", _EXAMPLE),
        204: {
            "description": "The outputs by reference, for a job that was submitted with `response` raw.",
            "headers": header("Link", "One link per output: `rel` item, its id as `title`."),
        },
        **problems(400, 404, 507, *FAILED),
    },
)
def results(
    asked: Asked,
    base: Base,
    outputs: Annotated[Words, Query(description="Only these, with commas between them or the parameter again.")] = None,
) -> Response:
    """List the outputs of a finished job, each with media type, size and sha256."""
    wanted = outputs or []
    unknown = [name for name in wanted if name not in KINDS]
    if unknown:
        raise RequestError([f"query outputs names {unknown[0][:80]!r}: use {', '.join(KINDS)}"])
    finished = asked.having(wanted)
    place = f"{base}/jobs/{finished.job.job_id}/results"
    found = results_document(finished.catalogue, lambda name: finished.address(f"{place}/{name}"), wanted)
    headers = {"Cache-Control": "private, no-cache"}
    if finished.job.request.response == "raw":
        # outputs by reference have no body of their own (OGC 18-062)
        links = (
            f'<{entry.href}>; rel="item"; type="{entry.type}"; title="{name}"' for name, entry in found.root.items()
        )
        return Response(status_code=204, headers=headers | {"Link": ", ".join(links)})
    return respond(found, headers=headers)


def file_answers(documents: Mapping[str, bool], **described: str) -> dict[int | str, dict[str, Any]]:
    """Answers of the path of a file.

    Parameters
    ----------
    documents : mapping
        By its media types, whether a file of that type is a JSON object.
    described : str
        Descriptions of its headers, with _ in place of -.
    """
    binary = {"schema": {"type": "string", "format": "binary"}}
    content = {kind: {"schema": {"type": "object"}} if is_object else binary for kind, is_object in documents.items()}
    headers = header("Accept-Ranges", "Ranges of bytes are served.")
    for name, description in described.items():
        headers |= header(name.replace("_", "-"), description)
    part = {"application/octet-stream": binary}
    return {
        200: {"description": "The file.", "content": content, "headers": headers},
        206: {"description": "The requested range of bytes.", "content": {**content, **part}},
        304: {"description": "The client has this file already."},
        **problems(400, 404, 406, 416, 507, *FAILED),
    }


@router.get(
    "/jobs/{jobID}/results/{outputID}",
    summary="One output as a file",
    response_class=Response,
    responses=file_answers(
        {kind.media_type: kind.is_document for kind in KINDS.values()},
        ETag="The sha256.",
        Content_Disposition="A name to save it under.",
    ),
)
def result(
    request: Request,
    asked: Asked,
    output_id: Annotated[
        str, Path(alias="outputID", description=f"One of {', '.join(KINDS)}.", examples=["buildings"])
    ],
) -> Response:
    """Send one output; ranges of bytes are served, so Parquet can be read remotely."""
    finished = asked.having([output_id])
    path = output_file(finished.out_dir, output_id)
    kind, stored = KINDS[output_id], finished.catalogue.outputs[output_id]
    preferred(request.headers.get("accept"), [kind.media_type])
    etag = f'"{stored.sha256}"'
    headers = {"ETag": etag, "Cache-Control": "private, no-cache", "Vary": "Accept"}
    is_page = kind.media_type == HTML
    if is_page:
        headers["Content-Security-Policy"] = SANDBOX
    return sent_file(
        request,
        path,
        stored.size_bytes,
        media_type=kind.media_type,
        headers=headers,
        filename=_saved_name(finished.job.job_id, finished.label, *finished.statuses, path.name),
        content_disposition_type="inline" if is_page else "attachment",
    )


def sent_file(request: Request, path: FilePath, size: int, *, headers: Mapping[str, str], **options: Any) -> Response:
    """A file of so many bytes, or a range of it, unless the client has it; `headers` hold its ETag."""
    if is_known(request.headers.get("if-none-match", ""), headers["ETag"]):
        return Response(status_code=304, headers=headers)
    _check_range(request, size)
    return FileResponse(path, headers=headers, **options)


def unchanging_file(request: Request, finished: FinishedJob, path: FilePath, media_type: str) -> Response:
    """A file of a finished job that clients may keep for good; FileNotFoundError if it is not there."""
    preferred(request.headers.get("accept"), [media_type])
    found = path.stat()
    # results never change: the job and the path name the content
    etag = f'"{finished.job.job_id}-{found.st_mtime_ns:x}-{found.st_size:x}"'
    headers = {"ETag": etag, "Cache-Control": "private, max-age=31536000, immutable", "Vary": "Accept"}
    return sent_file(request, path, found.st_size, media_type=media_type, headers=headers, stat_result=found)


def _saved_name(job_id: str, *parts: str | None) -> str:
    """The name under which a browser saves a file.

    >>> _saved_name("ab" * 16, None, "buildings.parquet")
    'gablework-abababab-buildings.parquet'
    >>> _saved_name("ab" * 16, "kmeans", "report.json")
    'gablework-abababab-kmeans-report.json'
    """
    return "-".join(("gablework", job_id[:8], *(part for part in parts if part is not None)))


def is_known(if_none_match: str, etag: str) -> bool:
    """Whether a client already has the file.

    >>> is_known('W/"a", "b"', '"b"'), is_known("*", '"b"'), is_known("", '"b"')
    (True, True, False)
    """
    tags = [tag.strip().removeprefix("W/") for tag in if_none_match.split(",")]
    return etag in tags or "*" in tags


def _check_range(request: Request, size: int) -> None:
    """Refuse a range beyond the end; one that cannot be parsed is ignored, as RFC 9110 (14.2) requires."""
    text = request.headers.get("range")
    if text is None:
        return
    parts = text.partition("=")[2].split(",") if _RANGES.fullmatch(text) else []
    ends = [part.strip().partition("-")[::2] for part in parts]
    if not ends or any(first and last and int(last) < int(first) for first, last in ends):
        request.scope["headers"] = [entry for entry in request.scope["headers"] if entry[0] != b"range"]
        return
    if any(int(first) >= size if first else int(last) == 0 for first, last in ends):
        problem = f"the range {text[:80]} lies beyond the end: the file has {size} bytes"
        raise HTTPException(416, problem, {"Content-Range": f"bytes */{size}"})
