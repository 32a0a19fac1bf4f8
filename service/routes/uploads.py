"""Uploads: send a file by itself, look at it, remove it. Later a job names it."""

from __future__ import annotations

import base64
import binascii
import re
from typing import Annotated, Any
from urllib.parse import unquote

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from python_multipart.multipart import parse_options_header
from starlette.concurrency import run_in_threadpool

from service.errors import RequestError, TooLargeError
from service.jobs import Upload
from service.multipart import Form, Part
from service.routes.answers import document, header, problems
from service.routes.bound import Base, Folder, Reader, Store, Submitter
from service.routes.replay import is_form
from service.routes.submission import Submission, Submitting
from service.routes.writing import Write
from service.settings import ServiceSettings
from service.uploads import remove_file
from service.wire import uploads as wire
from service.wire.base import link, page_links, respond
from service.wire.queries import Page

router = APIRouter(tags=["uploads"])

UPLOAD_ID = "0123456789abcdef0123456789abcdef"
"""The upload of the examples."""
FILE_FIELD = "file"
"""Field of a form that holds the file."""
MAX_PARTS = 20
FORM_SLACK_BYTES = 65_536
"""Bytes that a form may have in addition to the file."""
DIGEST = re.compile(r"(?:^|,)\s*sha-256\s*=\s*:?([^:,]*):?", re.IGNORECASE)

EXAMPLE: dict[str, Any] = {
    "uploadID": UPLOAD_ID,
    "filename": "delft_east.laz",
    "bytes": 1170107,
    "sha256": "5f0c0f2b8f7d1d7a3c6f9a1e2b4d6c8e0a1b3c5d7e9f0a2b4c6d8e0f1a3b5c7d",
    "created": "2026-03-01T09:29:58+00:00",
    "expires": "2026-03-08T09:29:58+00:00",
    "preflight": {
        "kind": "points",
        "format": "laz",
        "pointCount": 208432,
        "crs": {"name": "Amersfoort / RD New + NAP height", "epsg": 7415},
        "horizontalUnitM": 1.0,
        "verticalUnitM": 1.0,
        "bounds": [85000.001, 447412.8, -0.606, 85072.299, 447641.299, 26.329],
        "place": {"longitude": 4.3672, "latitude": 52.0126},
        "areaOfUse": {
            "name": "Netherlands - onshore, including Waddenzee and Dutch Wadden Islands.",
            "west": 3.2,
            "south": 50.75,
            "east": 7.22,
            "north": 53.7,
        },
        "outsideAreaOfUse": None,
        "densityPerM2": 12.617,
        "hasReturns": True,
        "hasClasses": True,
        "acquiredFrom": None,
        "acquiredTo": None,
        "warnings": [],
        "problems": [],
        "usable": True,
    },
    "links": [{"href": f"http://127.0.0.1:8000/uploads/{UPLOAD_ID}", "rel": "self", "type": "application/json"}],
}

UploadId = Annotated[str, Path(alias="uploadID", description="As in the answer to the upload.", examples=[UPLOAD_ID])]

_BINARY = {"type": "string", "format": "binary"}
_FORM = {
    "type": "object",
    "required": [FILE_FIELD],
    "properties": {FILE_FIELD: _BINARY},
    "additionalProperties": False,
}


def _named(
    filename: Annotated[
        str | None,
        Query(max_length=1024, description="Name of the file, if the body is the file; its ending decides the format."),
    ] = None,
    content_disposition: Annotated[
        str | None, Header(description='Another way to name the file: `attachment; filename="a.laz"`.')
    ] = None,
    x_filename: Annotated[str | None, Header(description="Another way to name the file, percent-encoded.")] = None,
) -> str:
    """The name of the file; empty if there is none."""
    return filename or _disposition_name(content_disposition) or unquote(x_filename or "")


def _promised(
    content_digest: Annotated[
        str | None, Header(description="`sha-256=:base64:` of the file (RFC 9530); a file that differs is refused.")
    ] = None,
    repr_digest: Annotated[str | None, Header(description="As Content-Digest.")] = None,
) -> str | None:
    """The SHA-256 in the digest headers, hexadecimal; other algorithms are ignored."""
    found = set()
    for value in (content_digest, repr_digest):
        for text in DIGEST.findall(value or ""):
            try:
                raw = base64.b64decode(text, validate=True)
            except (binascii.Error, ValueError):
                raw = b""
            if len(raw) != 32:
                raise RequestError([f"the digest is {text[:80]!r}: write sha-256=:the base64 of 32 bytes:"])
            found.add(raw.hex())
    if len(found) > 1:
        raise RequestError(["Content-Digest and Repr-Digest differ: send one"])
    return found.pop() if found else None


@router.post(
    "/uploads",
    summary="Send a file",
    status_code=201,
    responses={
        201: document(
            wire.Upload,
            "The file is stored; `preflight` has the content of its header.",
            EXAMPLE,
            headers=header("Location", "The upload."),
        ),
        **problems(400, 409, 413, 415, 422, 507),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "application/octet-stream": {"schema": _BINARY},
                "multipart/form-data": {"schema": _FORM},
            },
        }
    },
)
async def send(
    request: Request,
    base: Base,
    store: Store,
    submitting: Submitting,
    named: Annotated[str, Depends(_named)],
    digest: Annotated[str | None, Depends(_promised)],
) -> Response:
    """Send one file, as the body itself or as the field `file` of a form; it is stored while it arrives.

    The answer has the content of the file's header. `usable: false` comes with `problems` that a job can still fix,
    such as a missing projected CRS.
    """
    slack_bytes = FORM_SLACK_BYTES if is_form(request) else 0
    _check_length(request, submitting.settings, slack_bytes=slack_bytes)
    async with submitting as submission:
        if is_form(request):
            if digest is not None:
                raise RequestError(["the digest is that of a whole form: send the file as the body itself"])
            stored = await _from_form(submission.form(max_parts=MAX_PARTS), submission)
        else:
            if not named:
                raise RequestError(["the file has no name: add ?filename=tile.laz, or the header Content-Disposition"])
            stored = await submission.receive(submission.body(), named, sha256=digest)
        headers = {"Location": f"{base}/uploads/{stored.upload_id}"}
        answer = respond(upload_document(stored, base), status_code=201, headers=headers)
        return await submission.make(store.add_uploads, lambda _: answer)


def upload_document(upload: Upload, base: str) -> wire.Upload:
    """The upload as clients see it."""
    return wire.Upload(
        uploadID=upload.upload_id,
        filename=upload.filename,
        bytes=upload.size_bytes,
        sha256=upload.sha256,
        created=upload.created_at,
        expires=upload.expires_at,
        preflight=wire.Preflight(**upload.preflight),
        links=[link(f"{base}/uploads/{upload.upload_id}", "self", "This upload")],
    )


async def _from_form(form: Form, submission: Submission) -> Upload:
    """The one file of a form."""
    upload: Upload | None = None
    async for part in form.parts():
        upload = await submission.receive(part.chunks(), _file_name(part, is_first=upload is None))
    if upload is None:
        raise RequestError([f"the form has no file: send one, as the field {FILE_FIELD!r}"])
    return upload


def _file_name(part: Part, *, is_first: bool) -> str:
    """The name of the one file that a form may have; another field or a second file is refused."""
    if part.name != FILE_FIELD or part.filename is None or not is_first:
        raise RequestError([f"the form has the field {part.name[:80]!r}: send one file, as the field {FILE_FIELD!r}"])
    return part.filename


def _check_length(request: Request, settings: ServiceSettings, *, slack_bytes: int) -> None:
    """Refuse a body that is too long according to its header, before it is read."""
    length = request.headers.get("content-length", "")
    if length.isascii() and length.isdigit() and int(length) > settings.max_upload_bytes + slack_bytes:
        raise TooLargeError(
            f"the body has {int(length)} bytes, this service takes {settings.max_upload_bytes}: cut the file into "
            "tiles, or raise GABLEWORK_MAX_UPLOAD_BYTES"
        )


def _disposition_name(header: str | None) -> str:
    """The file name of a Content-Disposition header; empty if there is none."""
    if header is None:
        return ""
    encoded = re.search(r"filename\*\s*=\s*utf-8'[^']*'([^;\s]+)", header, re.IGNORECASE)
    if encoded is not None:
        return unquote(encoded[1])
    _, options = parse_options_header(header.encode("latin-1", "replace"))
    return options.get(b"filename", b"").decode("utf-8", "replace")


@router.get(
    "/uploads",
    summary="List uploads",
    responses={
        200: document(wire.UploadList, "The uploads, newest first.", {"uploads": [EXAMPLE], "links": EXAMPLE["links"]}),
        **problems(400),
    },
)
def uploads(base: Base, store: Store, caller: Reader, page: Annotated[Page, Query()]) -> Response:
    """List the uploads that this key may see."""
    found = store.list_uploads(owner=caller.owner, limit=page.limit + 1, offset=page.offset)
    links = page_links(f"{base}/uploads", (), len(found), page.limit, page.offset)
    listed = [upload_document(upload, base) for upload in found[: page.limit]]
    return respond(wire.UploadList(uploads=listed, links=links))


@router.get(
    "/uploads/{uploadID}",
    summary="An upload",
    responses={200: document(wire.Upload, "The upload.", EXAMPLE), **problems(404)},
)
def upload(upload_id: UploadId, base: Base, store: Store, caller: Reader) -> Response:
    """The record of an upload; its bytes cannot be downloaded."""
    return respond(upload_document(store.upload(upload_id, owner=caller.owner), base))


@router.delete(
    "/uploads/{uploadID}",
    summary="Remove an upload",
    status_code=204,
    responses={204: {"description": "It is removed."}, **problems(404, 409)},
)
async def remove(upload_id: UploadId, store: Store, folder: Folder, caller: Submitter, write: Write) -> Response:
    """Remove an upload, unless an unfinished job or a schedule needs it."""

    def removed() -> str:
        found = store.upload(upload_id, owner=caller.owner)
        store.remove_upload(found.upload_id)
        return found.upload_id

    await run_in_threadpool(remove_file, await write(removed), folder)
    return Response(status_code=204)
