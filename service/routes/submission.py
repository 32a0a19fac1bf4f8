"""From a draft to a waiting job or a schedule. If the call is refused, what it stored is removed."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import AsyncIterator, Callable, Iterable
from types import TracebackType
from typing import Annotated, Self, TypeVar

import anyio
import anyio.to_thread
from fastapi import Depends, Request

from service.auth import Principal
from service.drafts import Draft, Inline
from service.errors import ForbiddenError, UploadInUseError
from service.fetching import resolve_inputs
from service.files import StateFolder
from service.jobs import InputReference, Job, JobRequest, Upload
from service.keys import Scope
from service.routes.bound import Folder, Settings_, Store, Submitter
from service.settings import ServiceSettings
from service.store import JobStore
from service.uploads import receive, remove_file

Made = TypeVar("Made")
"""A job, or a schedule."""

WRITERS = 3
"""Threads that write jobs: few, because writers wait for one another and readers must not wait for them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Submission:
    """A call that submits for one caller. As a context manager it removes its uploads if the call fails."""

    store: JobStore
    folder: StateFolder
    settings: ServiceSettings
    caller: Principal
    threads: anyio.CapacityLimiter
    """Limits the calls that write jobs at the same time."""
    made: list[str] = dataclasses.field(default_factory=list)
    """Ids of the uploads of this call."""

    async def receive(self, stream: AsyncIterator[bytes], filename: str, sha256: str | None = None) -> Upload:
        """Store a file that came with the call; `sha256` is the digest that the client promised."""
        upload = await receive(
            stream,
            filename,
            store=self.store,
            folder=self.folder,
            settings=self.settings,
            owner=self.caller.key_id,
            sha256=sha256,
        )
        self.made.append(upload.upload_id)
        return upload

    async def keep(self, stream: AsyncIterator[bytes], filename: str) -> InputReference:
        """Store a file that came with the call, as an input of its job."""
        return InputReference(kind="upload", value=(await self.receive(stream, filename)).upload_id)

    async def submit(self, draft: Draft) -> Job:
        """Queue a job; its row is committed when this returns. Raises as `checked`, or QueueFullError."""

        def create(request: JobRequest) -> Job:
            return self.store.create(
                request,
                owner=self.caller.key_id,
                priority=draft.priority,
                max_queued=self.settings.max_queued,
                max_queued_per_key=self.settings.max_queued_per_key,
            )

        return await self.checked(draft, create)

    async def checked(self, draft: Draft, write: Callable[[JobRequest], Made]) -> Made:
        """Check a request, then write a job or a schedule from it in one of the threads that write.

        Raises
        ------
        RequestError, InputRefusedError, NoSuchUploadError
            An input cannot be used.
        ForbiddenError
            The priority needs another scope.
        """
        if draft.priority > 0 and Scope.ADMIN not in self.caller.scopes:
            raise ForbiddenError(
                f"priority is {draft.priority}: this needs the scope {Scope.ADMIN}, use 0 or less with this key"
            )
        stored: dict[Inline, InputReference] = {}
        for inline in draft.inline:
            stored[inline] = await self.keep(_once(inline.content), inline.filename)

        def check_and_write() -> Made:
            request = draft.request(stored)
            owner = self.caller.owner
            resolve_inputs(request, store=self.store, folder=self.folder, settings=self.settings, owner=owner)
            return write(request)

        return await anyio.to_thread.run_sync(check_and_write, limiter=self.threads)

    async def __aenter__(self) -> Self:
        """Nothing is stored yet."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the uploads of a call that failed, also if the client has disconnected."""
        if kind is None:
            return
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(self._remove, tuple(self.made), limiter=self.threads)

    def _remove(self, upload_ids: Iterable[str]) -> None:
        for upload_id in upload_ids:
            # in use: the job was made, but the client did not wait for the answer
            with contextlib.suppress(UploadInUseError):
                self.store.remove_upload(upload_id)
                remove_file(upload_id, self.folder)


async def _submission(
    request: Request, store: Store, folder: Folder, settings: Settings_, caller: Submitter
) -> Submission:
    threads = request.app.state.submitting
    return Submission(store=store, folder=folder, settings=settings, caller=caller, threads=threads)


Submitting = Annotated[Submission, Depends(_submission)]
"""A submission for the caller, who may submit."""


async def _once(content: bytes) -> AsyncIterator[bytes]:
    yield content
