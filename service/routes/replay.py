"""Requests that are sent again under an `Idempotency-Key`: the claim of the key, and the answer that is kept."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
from collections.abc import AsyncIterator
from typing import Annotated
from urllib.parse import urlsplit

import anyio
import anyio.to_thread
from fastapi import Header, Request
from fastapi.responses import Response

from service.deliveries import CLAIM_S, Claim, Fingerprint, StoredAnswer
from service.errors import (
    KeyReusedError,
    NoSuchJobError,
    NoSuchScheduleError,
    NoSuchUploadError,
    NoSuchWebhookError,
    RemovedSinceError,
    StoreError,
)
from service.multipart import Form
from service.resumable import find
from service.routes.writing import Writer
from service.store import JobStore, RequestDeadline
from service.wire import patterns

KEPT_HEADERS = (
    *("location", "etag", "cache-control", "content-type", "preference-applied"),
    *("upload-offset", "upload-expires", "content-location"),
)
"""Headers of an answer that are kept with it."""

NAMING = ("content-disposition", "x-filename", "upload-length", "upload-metadata")
"""Headers that decide what a request makes."""

FREE_S = 1.0
"""Seconds that an answer waits until the key of its request is free again, and between two tries to free it."""

IdempotencyKey = Annotated[
    str | None,
    Header(
        json_schema_extra=patterns.stated(patterns.KEY),
        description="A text of your choice that names this request. Sent again with the same text, it makes nothing "
        "new and is answered as before.",
        examples=["8e03978e-40d5-43dd-bc93-6894a57f9324"],
    ),
]
"""The header, for the OpenAPI document; `key_of` reads it."""

_log = logging.getLogger("gablework.service")
_freeing: set[asyncio.Task[None]] = set()


class ReplayedError(Exception):
    """Not a fault: the request was answered before, and `response` is that answer."""

    def __init__(self, stored: StoredAnswer) -> None:
        headers = {**stored.headers, "idempotency-replayed": "true"}
        self.response = Response(stored.body, stored.status, headers)
        super().__init__("the request was answered before")


async def replayed(_request: Request, error: Exception) -> Response:
    """The handler of that exception."""
    assert isinstance(error, ReplayedError)
    return error.response


def fingerprint_of(request: Request) -> Fingerprint:
    """The fingerprint of a request, before its body."""
    query = sorted(request.query_params.multi_items())
    naming = [request.headers.get(name, "") for name in NAMING]
    return Fingerprint(request.method, request.url.path, repr(query), *naming)


async def checked_replay(request: Request, stored: StoredAnswer) -> ReplayedError:
    """The answer that is kept, for a request whose body is that of the first one; nothing of it is stored.

    Raises
    ------
    KeyReusedError
        It is another request.
    RemovedSinceError
        What the first one made is gone: its answer would be wrong now, and a second one was not asked for.
    """
    seen = fingerprint_of(request)
    async for _ in content(request, seen):
        if seen.size_bytes > stored.size_bytes:
            break
    if seen.hexdigest() != stored.fingerprint:
        raise KeyReusedError(
            "the Idempotency-Key was used for another request: use a new key for each request, and the same body when "
            "it is sent again"
        )
    location = urlsplit(stored.headers.get("location", "")).path
    if location and not await anyio.to_thread.run_sync(_is_there, request, location):
        raise RemovedSinceError(
            f"the request with this Idempotency-Key made {location}, which was removed since: use a new key to make "
            "another"
        )
    return ReplayedError(stored)


def _is_there(request: Request, location: str) -> bool:
    """Whether a thing that a request made still exists, by the end of its path; whose it is the key has shown."""
    store: JobStore = request.app.state.store
    *_, collection, name = location.split("/")
    try:
        if collection == "jobs":
            store.get(name)
        elif collection == "schedules":
            store.schedules.get(name)
        elif collection == "webhooks":
            store.webhooks.get(name)
        elif collection == "uploads" or not _is_unfinished(request, name):
            store.upload(name)
    except (NoSuchJobError, NoSuchScheduleError, NoSuchUploadError, NoSuchWebhookError):
        return False
    return True


def _is_unfinished(request: Request, upload_id: str) -> bool:
    try:
        find(request.app.state.folder, upload_id, None)
    except NoSuchUploadError:
        return False
    return True


async def content(request: Request, seen: Fingerprint) -> AsyncIterator[None]:
    """Read the body of a request, piece by piece, only for its fingerprint."""
    if is_form(request):
        form = Form(aiter(request.stream()), request.headers["content-type"], max_parts=2**31, fingerprint=seen)
        async for part in form.parts():
            async for _ in part.chunks():
                yield
        return
    async for piece in request.stream():
        seen.update(piece)
        yield


def is_form(request: Request) -> bool:
    """Whether the body is a form with files."""
    return request.headers.get("content-type", "").strip().lower().startswith("multipart/")


def stored_answer(response: Response, seen: Fingerprint) -> StoredAnswer:
    """An answer, to be kept."""
    headers = {name: response.headers[name] for name in KEPT_HEADERS if name in response.headers}
    return StoredAnswer(
        fingerprint=seen.hexdigest(),
        size_bytes=seen.size_bytes,
        status=response.status_code,
        headers=headers,
        body=bytes(response.body).decode("utf-8"),
    )


@dataclasses.dataclass
class HeldKey:
    """A claimed key; it is renewed until `release`."""

    store: JobStore
    writer: Writer
    claim: Claim

    def __post_init__(self) -> None:
        self._renewing = asyncio.ensure_future(self._renew())

    async def release(self, *, is_kept: bool) -> None:
        """End the claim; without a kept answer the key is free afterwards."""
        self._renewing.cancel()
        if is_kept:
            return
        with anyio.CancelScope(shield=True):
            if await self._is_dropped():
                return
        task = asyncio.ensure_future(self._drop())
        _freeing.add(task)
        task.add_done_callback(_freeing.discard)

    async def _renew(self) -> None:
        while True:
            await asyncio.sleep(CLAIM_S / 3.0)
            # after a failure the claim may pass to another request: then this one makes nothing
            with contextlib.suppress(StoreError):
                await self._write(self.store.renew_claim)

    async def _drop(self) -> None:
        """Free the key as soon as the database answers; in the end the claim ends by itself."""
        with anyio.move_on_after(CLAIM_S):
            while not await self._is_dropped():
                await asyncio.sleep(FREE_S)

    async def _is_dropped(self) -> bool:
        try:
            await self._write(self.store.drop_claim)
        except StoreError as error:
            _log.warning("a key cannot be freed yet: %s", error)
            return False
        return True

    async def _write(self, write: object) -> None:
        def patiently() -> None:
            assert callable(write)
            with RequestDeadline(FREE_S):
                write(self.claim)

        await anyio.to_thread.run_sync(patiently, limiter=self.writer.threads)
