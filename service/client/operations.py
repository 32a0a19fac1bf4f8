"""What a client can do, once for both clients: coroutines over one session."""

from __future__ import annotations

import hashlib
import itertools
import json
import uuid
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import SettingsError
from service.client.client_answers import OVER, Event, FetchedFile, Job, Output, Submitted
from service.client.client_errors import (
    ForeignAnswerError,
    JobDismissedError,
    JobFailedError,
    NotFoundError,
    RefusedError,
)
from service.client.downloads import Choice, fetch_output, outputs_of
from service.client.events import follow
from service.client.session import Session, path_of
from service.client.transport import LostError
from service.client.upload_memory import LocalFile, UploadMemory
from service.client.uploads import OnTransfer, send_file

JobRef = str | Job
"""A job, or its id."""
Paths = str | Path | Sequence[str | Path]
"""One file or several; a text with `://` is a URL that the service fetches."""
OnEvent = Callable[[Event], None]


def ignore(_: object) -> None:
    """Do nothing with a report."""


_REMOVED = "removed-since"
"""The kind of problem of a request under a key whose job was removed since."""


class Operations:
    """What a client can do.

    Parameters
    ----------
    session : Session
        The service.
    memory : UploadMemory
        The files that were sent before.
    """

    def __init__(self, session: Session, memory: UploadMemory) -> None:
        self._session = session
        self._memory = memory

    # --- from files to a job

    async def upload(self, path: str | Path, *, on_transfer: OnTransfer = ignore) -> str:
        """Send a file; the id of its upload. A call that was interrupted continues; a file is sent once."""
        file = await self._session.transport.work(lambda: LocalFile.at(path))
        return await send_file(self._session, self._memory, file, on_transfer)

    async def submit(
        self,
        /,
        tiles: Paths,
        *,
        process: str = "reconstruct",
        footprints: str | Path | None = None,
        guides: str | Path | None = None,
        outputs: Sequence[str] | None = None,
        new: bool = False,
        on_transfer: OnTransfer = ignore,
        **inputs: Any,
    ) -> Job:
        """Send tiles and start a job with them; see `submission`."""
        made = await self.submission(
            tiles,
            process=process,
            footprints=footprints,
            guides=guides,
            outputs=outputs,
            new=new,
            on_transfer=on_transfer,
            inputs=inputs,
        )
        return made.job

    async def submission(
        self,
        tiles: Paths,
        *,
        process: str,
        inputs: Mapping[str, Any],
        footprints: str | Path | None = None,
        guides: str | Path | None = None,
        outputs: Sequence[str] | None = None,
        new: bool = False,
        on_transfer: OnTransfer = ignore,
    ) -> Submitted:
        """Send tiles and start a job with them. An equal call gives the same job, unless that failed or is gone."""
        paths = [tiles] if isinstance(tiles, str | Path) else list(tiles)
        given = {name: value for name, value in inputs.items() if value is not None}
        subscriber = given.pop("subscriber", None)
        if paths:
            given["tiles"] = [await self._source(path, on_transfer) for path in paths]
        if footprints is not None:
            given["footprints"] = await self._source(footprints, on_transfer)
        if guides is not None:
            given["guides"] = await self._source(guides, on_transfer)
        body: dict[str, Any] = {"inputs": given}
        if outputs is not None:
            body["outputs"] = {name: {} for name in outputs}
        if subscriber is not None:
            body["subscriber"] = subscriber
        return await self._made(path_of("processes", process, "execution"), body, new=new)

    async def _source(self, path: str | Path, on_transfer: OnTransfer) -> dict[str, str]:
        if isinstance(path, str) and ("://" in path or path.startswith("/uploads/")):
            return {"href": path}
        return {"href": f"/uploads/{await self.upload(path, on_transfer=on_transfer)}"}

    async def _made(self, path: str, body: Mapping[str, Any], *, new: bool) -> Submitted:
        """The job of a request. Its key follows from its content, so that an equal request is the same one."""
        try:
            content = json.dumps([path, body], sort_keys=True, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise SettingsError([f"an input is not a JSON value: {error}"]) from None
        name = uuid.uuid4().hex if new else hashlib.sha256(content.encode()).hexdigest()[:32]
        for number in itertools.count(1):
            key = {"Idempotency-Key": f"{name}-{number}"}
            try:
                answer = await self._session.ask("POST", path, document=body, headers=key)
            except RefusedError as error:
                if error.problem.kind == _REMOVED:
                    continue
                raise
            job = self._job(self._session.document(answer))
            if answer.headers.get("idempotency-replayed") != "true" or new:
                return Submitted(job=job, is_new=True)
            try:
                job = await self.job(job)
            except NotFoundError:
                continue
            if job.status not in {"failed", "dismissed"}:
                return Submitted(job=job, is_new=False)
            self._session.notify(f"job {job.id} had the same request and is {job.status}: another one is made")
        raise AssertionError("numbers do not end")

    def _job(self, document: Any) -> Job:
        try:
            return Job.of(document)
        except (KeyError, TypeError, ValueError, AssertionError) as error:
            raise ForeignAnswerError(
                f"{self._session.url} answers with something else than a job: check the URL"
            ) from error

    # --- jobs

    async def job(self, job: JobRef) -> Job:
        """The job as it is now."""
        return self._job(await self._session.json("GET", path_of("jobs", _id(job))))

    async def jobs(
        self,
        *,
        status: str | Sequence[str] | None = None,
        process: str | Sequence[str] | None = None,
        limit: int = 100,
        offset: int = 0,
    ) -> list[Job]:
        """A page of the jobs that the key may see, newest first."""
        path = path_of("jobs", status=status, processID=process, limit=limit, offset=offset)
        document = await self._session.json("GET", path)
        if not isinstance(document, Mapping) or not isinstance(document.get("jobs"), list):
            raise ForeignAnswerError(f"{self._session.url} answers with something else than jobs: check the URL")
        return [self._job(entry) for entry in document["jobs"]]

    def watch(self, job: JobRef, *, after: int = 0) -> AsyncGenerator[Event, None]:
        """The events of a job as they come, to its end."""
        return follow(self._session, _id(job), after)

    async def wait(self, job: JobRef, *, on_event: OnEvent = ignore) -> Job:
        """The job once it has succeeded.

        Raises
        ------
        JobFailedError, JobDismissedError
            It ended otherwise.
        """
        async for event in self.watch(job):
            on_event(event)
        found = await self.job(job)
        if found.status == "failed":
            raise JobFailedError(found)
        if found.status == "dismissed":
            raise JobDismissedError(found)
        return found

    async def cancel(self, job: JobRef) -> Job:
        """Stop a job that waits or runs; one that is over stays as it is."""
        attempts = self._session.attempts()
        while True:
            found = await self.job(job)
            if found.is_over:
                return found
            # never sent twice unseen: a second request would remove the dismissed job
            try:
                path = path_of("jobs", found.id)
                async with self._session.open("DELETE", path) as opened:
                    answer = await opened.whole()
            except LostError as lost:
                await self._session.after_loss(lost, attempts)
                continue
            if answer.status < 300:
                return self._job(self._session.document(answer))
            await self._session.after_refusal(answer, attempts)

    async def retry(self, /, job: JobRef, *, outputs: Sequence[str] | None = None, **inputs: Any) -> Job:
        """A new job with the request of one that is over; inputs replace those of the old one, None takes one away."""
        body: dict[str, Any] = {"inputs": inputs} if inputs else {}
        if outputs is not None:
            body["outputs"] = {name: {} for name in outputs}
        key = {"Idempotency-Key": uuid.uuid4().hex}
        path = path_of("jobs", _id(job), "retry")
        return self._job(await self._session.json("POST", path, document=body, headers=key))

    async def keep(self, job: JobRef, *, keep: bool = True) -> Job:
        """Keep a job with its results, whatever its age and size, or no longer."""
        return self._job(await self._session.json("PATCH", path_of("jobs", _id(job)), document={"keep": keep}))

    async def remove(self, job: JobRef) -> None:
        """Remove a job that is over, with its results.

        Raises
        ------
        SettingsError
            It is not over.
        """
        found = await self.job(job)
        if found.status not in OVER:
            raise SettingsError([f"job {found.id} is {found.status}: cancel it first, or wait until it is over"])
        try:
            await self._session.ask("DELETE", path_of("jobs", found.id))
        except NotFoundError:
            # removed by the attempt whose answer was lost, or by another client
            return

    # --- results

    async def results(self, job: JobRef, *, method: str | None = None, status: Sequence[str] = ()) -> list[Output]:
        """The outputs of a job that succeeded; also those of one method, or with buildings of some statuses only."""
        return await outputs_of(self._session, _id(job), (), Choice(method=method, status=status))

    async def fetch(
        self,
        job: JobRef,
        out: str | Path,
        kinds: Sequence[str] = (),
        *,
        method: str | None = None,
        status: Sequence[str] = (),
        overwrite: bool = False,
        on_transfer: OnTransfer = ignore,
    ) -> list[FetchedFile]:
        """Fetch outputs into a folder, all or those of some kinds. A call that was interrupted continues.

        With `status` such as `["ok"]` they hold only buildings of these statuses.
        """
        job_id, folder, choice = _id(job), Path(out), Choice(method=method, status=status)
        found = await outputs_of(self._session, job_id, kinds, choice)
        return [
            await fetch_output(
                self._session, job_id, output, folder, choice=choice, overwrite=overwrite, on_transfer=on_transfer
            )
            for output in found
        ]

    async def request(
        self, method: str, path: str, *, params: Mapping[str, Any] | None = None, document: Any = None
    ) -> Any:
        """Any other request: the document that is answered, or the bytes if it is not JSON; None without content.

        A request that changes something is sent again only if the service asks for it before it has done anything.
        """
        query = path_of("", **(params or {})).removeprefix("/")
        is_reading = method.upper() in {"GET", "HEAD"}
        place = f"/{path.lstrip('/')}" + (query.replace("?", "&", 1) if "?" in path else query)
        answer = await self._session.ask(method.upper(), place, document=document, is_repeatable=is_reading)
        if not answer.body:
            return None
        return self._session.document(answer) if "json" in answer.headers.get("content-type", "") else answer.body

    async def close(self) -> None:
        """End all connections."""
        await self._session.transport.close()


def _id(job: JobRef) -> str:
    job_id = job.id if isinstance(job, Job) else job.strip()
    if not job_id.isalnum() or not job_id.isascii():
        raise SettingsError([f"the job is {job_id!r}: give its id, 32 hexadecimal digits as `gablework jobs` shows"])
    return job_id
