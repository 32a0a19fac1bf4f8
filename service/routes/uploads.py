"""Uploads: send a file by itself, look at it, remove it. A job names it afterwards."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import AsyncIterator
from http import HTTPStatus
from typing import Annotated, Any
from urllib.parse import unquote, urlencode

from fastapi import APIRouter, Header, HTTPException, Path, Query, Request, Response
from fastapi.responses import JSONResponse
from python_multipart.multipart import parse_options_header
from starlette.concurrency import run_in_threadpool

from service.errors import RequestError, TooLargeError
from service.files import StateFolder
from service.jobs import Upload
from service.multipart import Form, Part
from service.routes.bound import Base, Folder, Reader, Settings_, Store, Submitter
from service.routes.documented import document, problems
from service.settings import ServiceSettings
from service.store import JobStore
from service.uploads import as_document, receive, remove_file

router = APIRouter(tags=["uploads"])

UPLOAD_ID = "0123456789abcdef0123456789abcdef"
"""The upload of the examples."""
FILE_FIELD = "file"
"""Field of a form that holds the file."""
MAX_PARTS = 20
FORM_SLACK_BYTES = 65_536
"""What a form may have beside the file."""
DIGEST = re.compile(r"(?:^|,)\s*sha-256\s*=\s*:([A-Za-z0-9+/=]*):", re.IGNORECASE)

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
_LOCATION = {"Location": {"description": "The upload.", "schema": {"type": "string"}}}

UploadId = Annotated[
    str, Path(alias="uploadID", description="As the answer to the upload tells it.", examples=[UPLOAD_ID])
]


@router.post(
    "/uploads",
    summary="Send a file",
    status_code=201,
    responses={
        201: document("Upload", "The file is stored, and what its header tells.", EXAMPLE, headers=_LOCATION),
        **problems(400, 413, 415, 422, 507),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
                "multipart/form-data": {
                    "schema": {
                        "type": "object",
                        "required": [FILE_FIELD],
                        "properties": {FILE_FIELD: {"type": "string", "format": "binary"}},
                    }
                },
            },
        }
    },
)
async def send(
    request: Request,
    base: Base,
    settings: Settings_,
    store: Store,
    folder: Folder,
    caller: Submitter,
    filename: Annotated[
        str | None,
        Query(
            max_length=1024, description="Name of the file, where the body is the file; its ending tells the format."
        ),
    ] = None,
    content_disposition: Annotated[
        str | None, Header(description='Names the file likewise: `attachment; filename="a.laz"`.')
    ] = None,
    x_filename: Annotated[str | None, Header(description="Names the file likewise, percent-encoded.")] = None,
    content_digest: Annotated[
        str | None, Header(description="`sha-256=:base64:` of the file (RFC 9530); what differs is refused.")
    ] = None,
    repr_digest: Annotated[str | None, Header(description="As Content-Digest.")] = None,
) -> JSONResponse:
    """Send one file, as the body itself or as the field `file` of a form; it is stored as it comes in.

    The answer tells what the file's header says. `usable: false` comes with `problems` that a job can still heal, such
    as a missing projected CRS.
    """
    encoding = request.headers.get("content-encoding", "identity").strip().lower()
    if encoding != "identity":
        raise HTTPException(
            HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"Content-Encoding is {encoding[:40]!r}: send the file as it is"
        )
    digest = _promised(content_digest, repr_digest)
    is_form = request.headers.get("content-type", "").strip().lower().startswith("multipart/")
    _check_length(request, settings, slack_bytes=FORM_SLACK_BYTES if is_form else 0)

    async def keep(stream: AsyncIterator[bytes], name: str) -> Upload:
        return await receive(
            stream, name, store=store, folder=folder, settings=settings, owner=caller.key_id, sha256=digest
        )

    if is_form:
        if digest is not None:
            raise RequestError(["the digest is that of a whole form: send the file as the body itself"])
        form = Form(aiter(request.stream()), request.headers["content-type"], max_parts=MAX_PARTS)
        upload = await _from_form(form, keep, store, folder)
    else:
        named = filename or _disposition_name(content_disposition) or unquote(x_filename or "")
        if not named:
            raise RequestError(["the file has no name: add ?filename=tile.laz, or the header Content-Disposition"])
        upload = await keep(aiter(request.stream()), named)
    told = as_document(upload, base)
    return JSONResponse(told, status_code=201, headers={"Location": f"{base}/uploads/{upload.upload_id}"})


async def _from_form(form: Form, keep: Any, store: JobStore, folder: StateFolder) -> Upload:
    """The one file of a form; nothing is kept of a form that is not whole."""
    upload: Upload | None = None
    try:
        async for part in form.parts():
            upload = await keep(part.chunks(), _file_name(part, is_first=upload is None))
    except BaseException:
        if upload is not None:
            await run_in_threadpool(_remove, upload.upload_id, store, folder)
        raise
    if upload is None:
        raise RequestError([f"the form has no file: send one, as the field {FILE_FIELD!r}"])
    return upload


def _file_name(part: Part, *, is_first: bool) -> str:
    """The name of the one file that a form may have.

    Raises
    ------
    RequestError
        It is another field, or a second file.
    """
    if part.name != FILE_FIELD or part.filename is None or not is_first:
        raise RequestError([f"the form has the field {part.name[:80]!r}: send one file, as the field {FILE_FIELD!r}"])
    return part.filename


def _check_length(request: Request, settings: ServiceSettings, *, slack_bytes: int) -> None:
    """Refuse what says itself that it is too long, before it is read."""
    length = request.headers.get("content-length", "")
    if length.isascii() and length.isdigit() and int(length) > settings.max_upload_bytes + slack_bytes:
        raise TooLargeError(
            f"the body has {int(length)} bytes, this service takes {settings.max_upload_bytes}: cut the file into "
            "tiles, or raise GABLEWORK_MAX_UPLOAD_BYTES"
        )


def _promised(*headers: str | None) -> str | None:
    """The SHA-256 that digest headers promise, hexadecimal; other algorithms are passed over."""
    found = set()
    for header in headers:
        for text in DIGEST.findall(header or ""):
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


def _disposition_name(header: str | None) -> str:
    """The file name of a Content-Disposition header; empty where there is none."""
    if header is None:
        return ""
    encoded = re.search(r"filename\*\s*=\s*utf-8'[^']*'([^;\s]+)", header, re.IGNORECASE)
    if encoded is not None:
        return unquote(encoded[1])
    _, options = parse_options_header(header.encode("latin-1", "replace"))
    return options.get(b"filename", b"").decode("utf-8", "replace")


def _remove(upload_id: str, store: JobStore, folder: StateFolder) -> None:
    store.remove_upload(upload_id)
    remove_file(upload_id, folder)


@router.get(
    "/uploads",
    summary="List uploads",
    responses={
        200: document("UploadList", "The uploads, newest first.", {"uploads": [EXAMPLE], "links": EXAMPLE["links"]}),
        **problems(400),
    },
)
def uploads(
    base: Base,
    store: Store,
    caller: Reader,
    limit: Annotated[int, Query(ge=1, le=1000, description="Most uploads to list.")] = 100,
    offset: Annotated[int, Query(ge=0, le=2**31 - 1, description="Uploads to pass over.")] = 0,
) -> JSONResponse:
    """List the uploads that this key may see."""
    found = store.list_uploads(owner=caller.owner, limit=limit + 1, offset=offset)

    def page(start: int, relation: str) -> dict[str, str]:
        query = urlencode({"limit": limit, "offset": start})
        return {"href": f"{base}/uploads?{query}", "rel": relation, "type": "application/json"}

    links = [page(offset, "self")]
    if len(found) > limit:
        links.append(page(offset + limit, "next"))
    if offset > 0:
        links.append(page(max(0, offset - limit), "prev"))
    return JSONResponse({"uploads": [as_document(upload, base) for upload in found[:limit]], "links": links})


@router.get(
    "/uploads/{uploadID}",
    summary="What is known of an upload",
    responses={200: document("Upload", "What is known of it.", EXAMPLE), **problems(404)},
)
def upload(upload_id: UploadId, base: Base, store: Store, caller: Reader) -> JSONResponse:
    """Tell what is known of an upload; its bytes are not given out again."""
    return JSONResponse(as_document(store.upload(upload_id, owner=caller.owner), base))


@router.delete(
    "/uploads/{uploadID}",
    summary="Remove an upload",
    status_code=204,
    responses={204: {"description": "It is gone."}, **problems(404, 409)},
)
def remove(upload_id: UploadId, store: Store, folder: Folder, caller: Submitter) -> Response:
    """Remove an upload, unless a job that is not over needs it."""
    _remove(store.upload(upload_id, owner=caller.owner).upload_id, store, folder)
    return Response(status_code=204)
