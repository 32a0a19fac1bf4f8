"""Resumable uploads by the protocol tus 1.0, with the extensions listed in `EXTENSIONS`."""

from __future__ import annotations

import base64
import binascii
import datetime as dt
import hashlib
import re
from collections.abc import AsyncIterator
from email.utils import format_datetime
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, HTTPException, Request, Response

from service.arrivals import ALGORITHMS, Arrivals, Part, State
from service.errors import RequestError
from service.problems import MEDIA_TYPE
from service.routes.answers import REQUIRED, problems, reference
from service.routes.bound import Base, Settings_, Store, Submitter, visitor
from service.routes.submission import Submitting
from service.routes.uploads import UploadId
from service.wire import patterns
from service.wire.problems import Problem

VERSION = "1.0.0"
"""Version of the protocol."""
EXTENSIONS = "creation,creation-with-upload,checksum,termination,expiration"
"""Its extensions that are here."""
BYTES = "application/offset+octet-stream"
"""Media type of the bytes of an upload."""
MAX_METADATA = 4096
"""Maximum length of Upload-Metadata: a name and a digest have at most some hundred signs."""


def _check_version(
    tus_resumable: Annotated[
        str | None,
        Header(
            description="Version of the protocol: 1.0.0.",
            examples=[VERSION],
            json_schema_extra={"enum": [VERSION], REQUIRED: True},
        ),
    ] = None,
) -> None:
    """Refuse other versions of the protocol."""
    if tus_resumable != VERSION:
        raise HTTPException(
            HTTPStatus.PRECONDITION_FAILED,
            f"Tus-Resumable is {(tus_resumable or '')[:40]!r}: this service speaks {VERSION}",
            headers={"Tus-Version": VERSION},
        )


router = APIRouter(tags=["uploads"])
_VERSIONED = [Depends(_check_version)]


async def _arrivals(request: Request) -> Arrivals:
    arrivals: Arrivals = request.app.state.arrivals
    return arrivals


Arriving = Annotated[Arrivals, Depends(_arrivals)]
"""The resumable uploads."""

Offset = Annotated[int, Header(ge=0, description="Where the bytes begin: the offset that the service last reported.")]
Checksum = Annotated[
    str | None,
    Header(
        description=f"Algorithm ({' or '.join(ALGORITHMS)}) and base64 of the digest of the bytes of this request; "
        "bytes that differ are not kept.",
        examples=["sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0="],
        json_schema_extra=patterns.stated(patterns.CHECKSUM),
    ),
]
Metadata = Annotated[
    str,
    Header(
        max_length=MAX_METADATA,
        description="`filename` with the base64 of the file's name; after a comma `sha256` with that of the file's "
        "SHA-256, hexadecimal. Other names are kept and not used.",
        examples=["filename ZGVsZnRfZWFzdC5sYXo="],
        json_schema_extra=patterns.stated(patterns.METADATA),
    ),
]

_BODY = {"content": {BYTES: {"schema": {"type": "string", "format": "binary"}}}}
_REFUSED_CHECKSUM: dict[int | str, dict[str, Any]] = {
    460: {"description": "Checksum Mismatch", "content": {MEDIA_TYPE: {"schema": reference(Problem)}}},
}


def _headers(**described: str) -> dict[str, Any]:
    """Headers of an answer, with their descriptions."""
    return {
        name.replace("_", "-"): {"description": description, "schema": {"type": "string"}}
        for name, description in described.items()
    }


_STATE_HEADERS = _headers(
    Upload_Offset="Bytes that are safely stored.",
    Upload_Expires="Time after which the upload is removed.",
    Content_Location="The finished upload; its answer has the content of the file's header.",
)


@router.options("/uploads/tus", include_in_schema=False, dependencies=[Depends(visitor)])
@router.options("/uploads/tus/{uploadID}", include_in_schema=False, dependencies=[Depends(visitor)])
async def capabilities(request: Request, settings: Settings_) -> Response:
    """The version, the extensions and the limits of resumable uploads."""
    is_one = "uploadID" in request.path_params
    return Response(
        status_code=HTTPStatus.NO_CONTENT,
        headers={
            "Allow": "DELETE, HEAD, OPTIONS, PATCH" if is_one else "OPTIONS, POST",
            "Tus-Version": VERSION,
            "Tus-Extension": EXTENSIONS,
            "Tus-Max-Size": str(settings.max_upload_bytes),
            "Tus-Checksum-Algorithm": ",".join(ALGORITHMS),
        },
    )


@router.post(
    "/uploads/tus",
    summary="Begin a resumable upload",
    status_code=201,
    response_class=Response,
    dependencies=_VERSIONED,
    responses={
        201: {
            "description": "Send the bytes to `Location`.",
            "headers": _headers(Location="The upload.") | _STATE_HEADERS,
        },
        **problems(409, 412, 413, 415, 422, 423, 507),
        **_REFUSED_CHECKSUM,
    },
    openapi_extra={"requestBody": _BODY},
)
async def begin(
    request: Request,
    base: Base,
    store: Store,
    submitting: Submitting,
    arriving: Arriving,
    upload_metadata: Metadata,
    upload_length: Annotated[int, Header(ge=0, description="Bytes of the whole file.", examples=[1170107])],
    upload_checksum: Checksum = None,
) -> Response:
    """Begin an upload that survives broken connections, by the protocol tus 1.0. The body may hold the first bytes.

    When all bytes have arrived, the upload is an ordinary one with the same id: `/uploads/{uploadID}`.
    """
    concatenation = request.headers.get("upload-concat")
    if concatenation is not None:
        raise RequestError([f"Upload-Concat is {concatenation[:40]!r}: send the file as one upload"])
    known = _metadata(upload_metadata)
    has_body = request.headers.get("content-length", "0") != "0" or "transfer-encoding" in request.headers
    owner = submitting.caller.owner
    async with submitting as submission:
        part = _part(request, submission.body(), 0, upload_checksum) if has_body else None
        state = await arriving.create(
            known.get("filename", ""),
            upload_length,
            sha256=_digest(known.get("sha256")),
            metadata=upload_metadata,
            owner=submission.caller.key_id,
        )
        if part is not None:
            state = await arriving.append(state.upload_id, part, owner=owner)
        elif upload_length == 0:
            state = await arriving.state(state.upload_id, owner=owner)
        headers = _state_headers(state, base) | {"Location": f"{base}/uploads/tus/{state.upload_id}"}
        answer = Response(status_code=HTTPStatus.CREATED, headers=headers)
        if "idempotency-key" not in request.headers:
            return answer
        return await submission.make(store.add_uploads, lambda _: answer)


@router.head(
    "/uploads/tus/{uploadID}",
    summary="How far a resumable upload is",
    response_class=Response,
    dependencies=_VERSIONED,
    responses={
        200: {
            "description": "Continue at `Upload-Offset`.",
            "headers": _STATE_HEADERS
            | _headers(Upload_Length="Bytes of the whole file.", Upload_Metadata="As it was sent."),
        },
        **problems(404, 412, 413, 422, 423, 507),
    },
)
async def offset(upload_id: UploadId, base: Base, arriving: Arriving, caller: Submitter) -> Response:
    """How many bytes are safely stored. It is refused with 423 while another request sends bytes."""
    state = await arriving.state(upload_id, owner=caller.owner)
    headers = _state_headers(state, base) | {"Upload-Length": str(state.size_bytes), "Cache-Control": "no-store"}
    if state.metadata is not None:
        headers["Upload-Metadata"] = state.metadata
    return Response(headers=headers)


@router.patch(
    "/uploads/tus/{uploadID}",
    summary="Continue a resumable upload",
    status_code=204,
    response_class=Response,
    dependencies=_VERSIONED,
    responses={
        204: {"description": "The bytes are stored.", "headers": _STATE_HEADERS},
        **problems(404, 409, 412, 413, 415, 422, 423, 507),
        **_REFUSED_CHECKSUM,
    },
    openapi_extra={"requestBody": {"required": True, **_BODY}},
)
async def append(
    request: Request,
    upload_id: UploadId,
    base: Base,
    arriving: Arriving,
    caller: Submitter,
    upload_offset: Offset,
    upload_checksum: Checksum = None,
) -> Response:
    """Send bytes. If the connection breaks, those that have arrived are kept; bytes with a checksum only together.

    The last bytes finish the upload: the file is examined as by `POST /uploads`, and a file that is refused is removed.
    """
    part = _part(request, aiter(request.stream()), upload_offset, upload_checksum)
    state = await arriving.append(upload_id, part, owner=caller.owner)
    return Response(status_code=HTTPStatus.NO_CONTENT, headers=_state_headers(state, base))


@router.delete(
    "/uploads/tus/{uploadID}",
    summary="Remove a resumable upload",
    status_code=204,
    response_class=Response,
    dependencies=_VERSIONED,
    responses={204: {"description": "It is removed."}, **problems(404, 409, 412, 423)},
)
async def terminate(upload_id: UploadId, arriving: Arriving, caller: Submitter) -> Response:
    """Remove an upload, finished or not, unless an unfinished job or a schedule needs it."""
    await arriving.remove(upload_id, owner=caller.owner)
    return Response(status_code=HTTPStatus.NO_CONTENT)


def _state_headers(state: State, base: str) -> dict[str, str]:
    headers = {
        "Upload-Offset": str(state.offset),
        "Upload-Expires": format_datetime(state.expires_at.astimezone(dt.UTC), usegmt=True),
    }
    if state.is_finished:
        headers["Content-Location"] = f"{base}/uploads/{state.upload_id}"
    return headers


def _part(request: Request, stream: AsyncIterator[bytes], at: int, checksum: str | None) -> Part:
    """The bytes that a request sends."""
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type != BYTES:
        raise HTTPException(
            HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"Content-Type is {media_type[:80]!r}: send the bytes as {BYTES}"
        )
    length = request.headers.get("content-length", "")
    return Part(
        stream=stream,
        offset=at,
        length=int(length) if length.isascii() and length.isdigit() else None,
        checksum=_checksum(checksum),
    )


def _metadata(header: str) -> dict[str, str]:
    """The pairs of Upload-Metadata.

    >>> _metadata("filename ZGVsZnRfZWFzdC5sYXo=,is_secret")
    {'filename': 'delft_east.laz', 'is_secret': ''}
    """
    found: dict[str, str] = {}
    for pair in filter(None, (pair.strip() for pair in header.split(","))):
        name, _, encoded = pair.partition(" ")
        if name in found:
            raise RequestError([f"Upload-Metadata has {name[:80]!r} twice: send it once"])
        try:
            found[name] = base64.b64decode(encoded, validate=True).decode()
        except (binascii.Error, ValueError):
            raise RequestError(
                [f"Upload-Metadata has {pair[:80]!r}: write a name, a space and the base64 of a text in UTF-8"]
            ) from None
    if not found.get("filename"):
        raise RequestError(["Upload-Metadata has no filename: add it, with the base64 of the file's name"])
    return found


def _digest(text: str | None) -> str | None:
    """The promised SHA-256 of a whole file."""
    if text is not None and re.fullmatch("[0-9a-fA-F]{64}", text) is None:
        raise RequestError([f"sha256 in Upload-Metadata is {text[:80]!r}: write 64 hexadecimal digits"])
    return text and text.lower()


def _checksum(header: str | None) -> tuple[str, bytes] | None:
    """Algorithm and digest of the bytes of a request.

    >>> _checksum("sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0=")[0]
    'sha1'
    """
    if header is None:
        return None
    name, _, encoded = header.partition(" ")
    if name not in ALGORITHMS:
        raise RequestError([f"Upload-Checksum names {name[:40]!r}: use {' or '.join(ALGORITHMS)}"])
    try:
        digest = base64.b64decode(encoded, validate=True)
    except (binascii.Error, ValueError):
        digest = b""
    if len(digest) != hashlib.new(name).digest_size:
        raise RequestError([f"Upload-Checksum is {header[:80]!r}: write {name} and the base64 of its digest"])
    return name, digest
