"""Fetches the outputs of a job into a folder: continues what was interrupted, and checks length and SHA-256."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import os
import re
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Any
from urllib.parse import unquote

from pipeline.errors import RunError
from service.client.client_answers import FetchedFile, Job, Output, Transfer
from service.client.client_errors import DamagedError, JobDismissedError, JobFailedError, RefusedError
from service.client.session import Session, path_of
from service.client.transport import LostError, OpenAnswer
from service.client.uploads import OnTransfer

READ_BYTES = 1 << 20
_ATTEMPTS = 2
"""Attempts at a file that arrives with another checksum: the second one begins at its first byte."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Choice:
    """Which results of a job."""

    method: str | None = None
    """The run of a comparison."""
    status: Sequence[str] = ()
    """The statuses of the buildings in them; all if it is empty."""

    @property
    def query(self) -> dict[str, Any]:
        """As parameters of a request."""
        return {"method": self.method, "status": ",".join(self.status) or None}


async def outputs_of(session: Session, job_id: str, kinds: Sequence[str], choice: Choice) -> list[Output]:
    """The outputs of a job, or those of these kinds.

    Raises
    ------
    JobFailedError, JobDismissedError
        There are none, since the job has failed or was dismissed.
    NotFoundError
        The job is unknown, still runs, or lacks this output.
    """
    path = path_of("jobs", job_id, "results", outputs=tuple(kinds), **choice.query)
    try:
        answer = await session.ask("GET", path)
    except RefusedError as error:
        if error.problem.kind == "result-not-ready" or error.problem.kind.startswith("job-failed"):
            job = Job.of(await session.json("GET", path_of("jobs", job_id)))
            if job.status == "failed":
                raise JobFailedError(job) from error
            if job.status == "dismissed":
                raise JobDismissedError(job) from error
        raise
    if answer.status == 204:
        # of a job that was submitted with `response: raw`: a header names the outputs
        names = re.findall(r'title="([^"]+)"', answer.headers.get("link", ""))
        return [await _described(session, job_id, name, choice) for name in names if name in kinds or not kinds]
    return [Output.of(output_id, entry) for output_id, entry in session.document(answer).items()]


async def _described(session: Session, job_id: str, output_id: str, choice: Choice) -> Output:
    """An output, from the headers of its file."""
    headers = (await session.ask("HEAD", path_of("jobs", job_id, "results", output_id, **choice.query))).headers
    return Output(
        id=output_id,
        media_type=headers["content-type"],
        title=output_id,
        size_bytes=int(headers["content-length"]),
        sha256=headers["etag"].strip('"'),
    )


async def fetch_output(
    session: Session,
    job_id: str,
    output: Output,
    folder: Path,
    *,
    choice: Choice,
    overwrite: bool,
    on_transfer: OnTransfer,
) -> FetchedFile:
    """One output as a file in a folder.

    Raises
    ------
    RunError
        The file cannot be written, or is there with another content.
    DamagedError
        The bytes differ from their checksum.
    UnreachableError, ForeignAnswerError, RefusedError
        Those of every request.
    """
    path = path_of("jobs", job_id, "results", output.id, **choice.query)
    head = await session.ask("HEAD", path)
    target = folder / file_name(head.headers.get("content-disposition", ""), job_id, output.id)
    try:
        if target.exists():
            if await session.transport.work(lambda: _digest(target)) == (output.size_bytes, output.sha256):
                return FetchedFile(output=output, path=target, is_new=False)
            if not overwrite:
                raise RunError(f"{target} is there with another content: choose another folder, or use --overwrite")
        folder.mkdir(parents=True, exist_ok=True)
        await _fetch_into(session, path, output, target, on_transfer)
    except OSError as error:
        raise RunError(f"{target} cannot be written ({error.strerror}): make room, or choose another folder") from error
    return FetchedFile(output=output, path=target, is_new=True)


async def _fetch_into(session: Session, path: str, output: Output, target: Path, on_transfer: OnTransfer) -> None:
    # the name holds the digest, so bytes of another result are never continued
    part = target.with_name(f".{target.name}.{output.sha256[:16]}.part")
    for _ in range(_ATTEMPTS):
        await _complete(session, path, output, part, target.name, on_transfer)
        if await session.transport.work(lambda: _digest(part)) == (output.size_bytes, output.sha256):
            part.replace(target)
            return
        part.unlink()
    raise DamagedError(f"{target.name} arrived {_ATTEMPTS} times with another SHA-256 than {output.sha256}: try again")


async def _complete(
    session: Session, path: str, output: Output, part: Path, name: str, on_transfer: OnTransfer
) -> None:
    """Fetch what a part lacks."""
    attempts = session.attempts()
    while (before := _length(part)) < output.size_bytes:
        at = Transfer(name=name, done_bytes=max(0, before), total_bytes=output.size_bytes)
        headers = {"Range": f"bytes={before}-", "If-Range": f'"{output.sha256}"'} if before > 0 else {}
        refused, lost = None, LostError(f"{name} broke off")
        try:
            async with session.open("GET", path, headers=headers) as answer:
                if answer.status >= 300:
                    refused = await answer.whole()
                else:
                    await _write(session, answer, part, at, on_transfer)
        except LostError as error:
            lost = error
        if _length(part) > before:
            attempts.progressed()
        if refused is not None:
            await session.after_refusal(refused, attempts)
        elif _length(part) < output.size_bytes:
            await session.after_loss(lost, attempts)


def _length(part: Path) -> int:
    return part.stat().st_size if part.exists() else -1


async def _write(session: Session, answer: OpenAnswer, part: Path, at: Transfer, on_transfer: OnTransfer) -> None:
    """Add the bytes of an answer to a part; a whole answer replaces it."""
    is_rest = answer.status == 206
    done = at.done_bytes if is_rest else 0
    on_transfer(Transfer(name=at.name, done_bytes=done, total_bytes=at.total_bytes))
    with part.open("ab" if is_rest else "wb") as stream:
        try:
            async for piece in answer.pieces:
                await session.transport.work(functools.partial(stream.write, piece))
                done += len(piece)
                if done > at.total_bytes:
                    break
                on_transfer(Transfer(name=at.name, done_bytes=done, total_bytes=at.total_bytes))
        finally:
            stream.flush()
            os.fsync(stream.fileno())


def _digest(path: Path) -> tuple[int, str]:
    """Length and SHA-256 of a file."""
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as stream:
        while piece := stream.read(READ_BYTES):
            digest.update(piece)
            size += len(piece)
    return size, digest.hexdigest()


def file_name(disposition: str, job_id: str, output_id: str) -> str:
    """The name of an output's file, from the header Content-Disposition; never a path.

    >>> file_name('attachment; filename="gablework-0f0f0f0f-buildings.parquet"', "0f" * 16, "buildings")
    'buildings.parquet'
    >>> file_name('attachment; filename="../../.profile"', "0f" * 16, "report"), file_name("", "0f" * 16, "report")
    ('profile', 'report')
    >>> file_name("", "0f" * 16, "../../.profile"), file_name("", "0f" * 16, "/etc/ssh/config")
    ('profile', 'config')
    """
    encoded = re.search(r"filename\*\s*=\s*utf-8'[^']*'([^;\s]+)", disposition, re.IGNORECASE)
    plain = re.search(r'filename\s*=\s*"([^"]*)"', disposition, re.IGNORECASE)
    name = unquote(encoded[1]) if encoded is not None else plain[1] if plain is not None else ""
    for given in (name, output_id):
        last = PureWindowsPath(given).name.removeprefix(f"gablework-{job_id[:8]}-").lstrip(".")
        if last and last.isprintable():
            return last
    return "output"
