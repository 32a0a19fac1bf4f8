"""From a request to what it makes: a job, a schedule, an upload. If the request is refused, nothing of it is kept."""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections.abc import AsyncIterator, Callable
from types import TracebackType
from typing import Annotated, Self, TypeVar

import anyio
import anyio.to_thread
from fastapi import Depends
from fastapi.responses import Response

from service.auth import Principal
from service.deliveries import Claim, Delivery, Fingerprint, key_of
from service.drafts import Draft, Inline
from service.errors import ForbiddenError, QuotaError, StoreBusyError, StoreError, StoreFullError
from service.fetching import resolve_inputs
from service.files import StateFolder
from service.jobs import InputReference, Job, JobRequest, Subscriber, Upload
from service.keys import Scope
from service.multipart import Form
from service.routes.bound import Base, Folder, Settings_, Store, Submitter
from service.routes.replay import HeldKey, IdempotencyKey, checked_replay, fingerprint_of, stored_answer
from service.routes.writing import Write, Writer
from service.settings import ServiceSettings
from service.store import JobStore
from service.uploads import check_number, receive, remove_file
from service.webhook_targets import check_receiver

Made = TypeVar("Made")
"""A job, a schedule, or whatever else a request makes."""


@dataclasses.dataclass(frozen=True)
class Arrived:
    """The uploads of a request, beside those of the store: their records are written with what the request makes."""

    store: JobStore
    uploads: list[Upload] = dataclasses.field(default_factory=list)

    def now(self) -> dt.datetime:
        """The time, with a time zone."""
        return self.store.now()

    def add_upload(self, upload: Upload) -> None:
        """Remember the record."""
        self.uploads.append(upload)

    def upload(self, upload_id: str, *, owner: str | None = None) -> Upload:
        """One upload; with `owner` only if it belongs to that key."""
        arrived = next((upload for upload in self.uploads if upload.upload_id == upload_id), None)
        return self.store.upload(upload_id, owner=owner) if arrived is None else arrived


class Submission:
    """A request that makes something, for one caller; a context manager.

    At its beginning it claims the request's key, or raises the answer that is kept under it. If the request fails, its
    files are removed and its key is free again.

    Parameters
    ----------
    writer : Writer
        Writes for the request.
    store, folder, settings, caller, base
        As the application bound them.
    """

    def __init__(
        self,
        writer: Writer,
        *,
        store: JobStore,
        folder: StateFolder,
        settings: ServiceSettings,
        caller: Principal,
        base: str,
    ) -> None:
        self.store = store
        self.folder = folder
        self.settings = settings
        self.caller = caller
        self._base = base
        self._writer = writer
        self._request = writer.request
        self._arrived = Arrived(store)
        self._key = key_of(self._request.headers.getlist("idempotency-key"))
        self._held: HeldKey | None = None
        self._seen: Fingerprint | None = None
        self._is_streamed = False
        self._is_made = False

    # --- the body

    def body(self) -> AsyncIterator[bytes]:
        """The body as it arrives."""
        self._is_streamed = True
        return aiter(self._request.stream()) if self._seen is None else self._counted(self._seen)

    async def _counted(self, seen: Fingerprint) -> AsyncIterator[bytes]:
        async for piece in self._request.stream():
            seen.update(piece)
            yield piece

    def form(self, *, max_parts: int) -> Form:
        """The body as a form that arrives."""
        self._is_streamed = True
        kind = self._request.headers.get("content-type", "")
        return Form(aiter(self._request.stream()), kind, max_parts=max_parts, fingerprint=self._seen)

    async def receive(self, stream: AsyncIterator[bytes], filename: str, sha256: str | None = None) -> Upload:
        """Store a file that came with the request; `sha256` is the digest that the client promised.

        Raises
        ------
        QuotaError
            The uploads of the key are too large.
        TooManyUploadsError
            The key has too many uploads already.
        """
        most = self.settings.max_uploads_per_key
        await anyio.to_thread.run_sync(check_number, self.store, self.caller.key_id, most, len(self._arrived.uploads))
        return await receive(
            await self._within_quota(stream),
            filename,
            store=self._arrived,
            folder=self.folder,
            settings=self.settings,
            owner=self.caller.key_id,
            sha256=sha256,
        )

    async def keep(self, stream: AsyncIterator[bytes], filename: str) -> InputReference:
        """Store a file that came with the request, as an input of its job."""
        return InputReference(kind="upload", value=(await self.receive(stream, filename)).upload_id)

    async def _within_quota(self, stream: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
        """The same stream; it is cut off where the uploads of the key are too large."""
        most = self.settings.max_upload_bytes_per_key
        if most == 0:
            return stream
        stored = await anyio.to_thread.run_sync(self.store.stored_bytes, self.caller.key_id)
        stored += sum(upload.size_bytes for upload in self._arrived.uploads)

        async def limited() -> AsyncIterator[bytes]:
            seen = 0
            async for piece in stream:
                seen += len(piece)
                if stored + seen > most:
                    raise QuotaError(stored, seen, most)
                yield piece

        return limited()

    # --- what it makes

    async def submit(self, draft: Draft, answer: Callable[[Job], Response]) -> Response:
        """Queue a job; its row is committed when this returns. Raises as `checked`, or QueueFullError."""

        def create(request: JobRequest, delivery: Delivery[Job]) -> Job:
            return self.store.create(
                request,
                owner=self.caller.key_id,
                priority=draft.priority,
                limits=self.settings.queue_limits,
                delivery=delivery,
            )

        return await self.checked(draft, create, answer)

    async def checked(
        self, draft: Draft, make: Callable[[JobRequest, Delivery[Made]], Made], answer: Callable[[Made], Response]
    ) -> Response:
        """Check a request, then make a job or a schedule from it.

        Raises
        ------
        RequestError, InputRefusedError, NoSuchUploadError
            An input cannot be used.
        TargetRefusedError
            The job's news would go to a URL to which webhooks are not sent.
        ForbiddenError
            The priority needs another scope.
        """
        if draft.priority > 0 and Scope.ADMIN not in self.caller.scopes:
            raise ForbiddenError(
                f"priority is {draft.priority}: this needs the scope {Scope.ADMIN}, use 0 or less with this key"
            )
        subscriber: Subscriber | None = draft.values.get("subscriber")
        if subscriber is not None:
            for uri in subscriber.uris:
                await check_receiver(uri, self.settings)
            subscriber = dataclasses.replace(subscriber, base=self._base)
        # a page may be open at another name of the service than that of its settings
        bases = {self._base, str(self._request.base_url).rstrip("/")}
        stored: dict[Inline, InputReference] = {}
        for inline in draft.inline:
            stored[inline] = await self.keep(_once(inline.content), inline.filename)

        def check_and_make(delivery: Delivery[Made]) -> Made:
            request = dataclasses.replace(draft.request(stored, bases), subscriber=subscriber)
            owner = self.caller.owner
            resolve_inputs(request, store=self._arrived, folder=self.folder, settings=self.settings, owner=owner)
            return make(request, delivery)

        return await self.make(check_and_make, answer)

    async def make(self, make: Callable[[Delivery[Made]], Made], answer: Callable[[Made], Response]) -> Response:
        """Make something in one of the threads that write; `make` passes the delivery on to the store.

        Raises
        ------
        StoreBusyError
            The database was busy for too long: nothing was made.
        KeyInUseError
            The key of the request has passed to another one.
        """
        seen, held = self._seen, self._held
        if seen is not None and not self._is_streamed:
            seen.update(await self._request.body())
        delivery: Delivery[Made] = Delivery(
            uploads=tuple(self._arrived.uploads),
            max_upload_bytes=self.settings.max_upload_bytes_per_key,
            max_uploads=self.settings.max_uploads_per_key,
            claim=None if held is None else held.claim,
            answer=None if seen is None else lambda made: stored_answer(answer(made), seen),
            kept_s=self.settings.idempotency_hours * 3600.0,
        )

        def written() -> Made:
            made = make(delivery)
            self._is_made = True
            return made

        return answer(await self._writer(written))

    # --- the key, and what a failure leaves behind

    async def __aenter__(self) -> Self:
        """Refuse a request that there is no room for; claim its key.

        Raises
        ------
        ReplayedError
            The request was answered before.
        KeyInUseError
            It is under way.
        KeyReusedError
            Its key was used for another request.
        NoSpaceError
            Only the reserve of the disk is free, or less.
        """
        owner = self.caller.key_id or ""
        if self._key is not None:
            stored = await anyio.to_thread.run_sync(self.store.answer_to, owner, self._key)
            if stored is not None:
                raise await checked_replay(self._request, stored)
        length = self._request.headers.get("content-length", "")
        expected = int(length) if length.isascii() and length.isdigit() else 0
        await anyio.to_thread.run_sync(self.folder.disk.require, expected, "this request")
        if self._key is not None:
            claim = Claim(owner=owner, key=self._key)
            stored = await self._writer.while_body_arrives(lambda: self.store.claim_key(claim))
            if stored is not None:
                raise await checked_replay(self._request, stored)
            self._held = HeldKey(self.store, self._writer, claim)
            self._seen = fingerprint_of(self._request)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave nothing behind of a request that made nothing, also if the client has disconnected."""
        # if the database went away during the commit, the records may be there; a janitor decides about the files
        is_unknown = isinstance(error, StoreError) and not isinstance(error, StoreBusyError | StoreFullError)
        if not self._is_made and not is_unknown:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(self._remove_files)
        if self._held is not None:
            await self._held.release(is_kept=self._is_made)

    def _remove_files(self) -> None:
        for upload in self._arrived.uploads:
            remove_file(upload.upload_id, self.folder)


async def _changing(
    writer: Write, store: Store, folder: Folder, settings: Settings_, caller: Submitter, base: Base
) -> Submission:
    return Submission(writer, store=store, folder=folder, settings=settings, caller=caller, base=base)


async def _submitting(
    submission: Annotated[Submission, Depends(_changing)], idempotency_key: IdempotencyKey = None
) -> Submission:
    del idempotency_key  # only for the OpenAPI document
    return submission


Changing = Annotated[Submission, Depends(_changing)]
"""A request that changes something and may bring files."""

Submitting = Annotated[Submission, Depends(_submitting)]
"""A request of the caller, who may submit, that makes something."""


async def _once(content: bytes) -> AsyncIterator[bytes]:
    yield content
