"""Sends files by tus 1.0, over broken connections, restarts of the service, and calls that were interrupted."""

from __future__ import annotations

import base64
import uuid
from collections.abc import Callable
from typing import TYPE_CHECKING

from pipeline.errors import UnreadableInputError
from service.client.client_answers import Transfer
from service.client.client_errors import ForeignAnswerError, NotFoundError, RefusedError
from service.client.session import Session, path_of
from service.client.transport import LAST_BYTES_S, FileBytes, LostError
from service.client.upload_memory import LocalFile, Remembered, UploadMemory

if TYPE_CHECKING:
    from service.client.transport import Answer

OnTransfer = Callable[[Transfer], None]
"""Takes reports of how far an upload or a download is."""

_TUS = {"Tus-Resumable": "1.0.0"}
_BYTES = {**_TUS, "Content-Type": "application/offset+octet-stream"}


async def send_file(session: Session, memory: UploadMemory, file: LocalFile, on_transfer: OnTransfer) -> str:
    """The id of the upload of a file; what an earlier call has sent is not sent again.

    Raises
    ------
    UnreadableInputError
        The file cannot be read, or changed while it was sent.
    UnreachableError, ForeignAnswerError, RefusedError
        Those of every request; the message of a refusal names the file.
    """
    known = memory.find(session.url, session.key, file)
    while True:
        is_remembered = known is not None
        if known is None:
            sha256 = await session.transport.work(file.sha256)
            known = Remembered(upload_id=await _begin(session, file, sha256), sha256=sha256)
            _remember(session, memory, file, known)
        try:
            await _continue(session, known.upload_id, file, on_transfer)
        except NotFoundError:
            # expired, removed, or of a service that has lost its state
            _forget(session, memory, file)
            if not is_remembered:
                raise
            known = None
        except RefusedError as error:
            if error.status in {400, 413, 422}:
                _forget(session, memory, file)
            raise
        else:
            return known.upload_id


async def _begin(session: Session, file: LocalFile, sha256: str) -> str:
    pairs = {"filename": file.path.name, "sha256": sha256}
    metadata = ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in pairs.items())
    headers = {**_TUS, "Upload-Length": str(file.size_bytes), "Upload-Metadata": metadata}
    # a creation whose answer is lost makes one upload
    answer = await session.ask("POST", "/uploads/tus", headers={**headers, "Idempotency-Key": uuid.uuid4().hex})
    upload_id = answer.headers.get("location", "").rstrip("/").rpartition("/")[2]
    if not upload_id:
        raise ForeignAnswerError(f"{session.url} has begun an upload and does not say where: check the URL")
    return upload_id


async def _continue(session: Session, upload_id: str, file: LocalFile, on_transfer: OnTransfer) -> None:
    """Send the rest of a file, from where the service has it."""
    path, attempts, furthest = path_of("uploads", "tus", upload_id), session.attempts(), -1
    while True:
        at = await _offset(session, path, file)
        on_transfer(Transfer(name=file.path.name, done_bytes=at, total_bytes=file.size_bytes))
        if at >= file.size_bytes:
            return
        if at > furthest:
            attempts.progressed()
        furthest = at
        _check_unchanged(file)
        try:
            answer = await _send_from(session, path, file, at, on_transfer)
        except LostError as lost:
            await session.after_loss(lost, attempts)
            continue
        except OSError as error:
            raise UnreadableInputError(str(file.path), f"cannot be read ({error.strerror})", "Check the file") from None
        if answer.status >= 300:
            # 409: the bytes of a broken connection have arrived since, so the next request continues elsewhere
            await session.after_refusal(answer, attempts, can_pass=answer.status == 409)


async def _offset(session: Session, path: str, file: LocalFile) -> int:
    """How many bytes the service has; it finishes an upload that is whole, and may then refuse it."""
    try:
        answer = await session.ask("HEAD", path, headers=_TUS)
    except NotFoundError:
        raise
    except RefusedError as error:
        # an answer to HEAD has no document
        if error.status in {400, 413, 422}:
            raise UnreadableInputError(
                str(file.path), f"the service refuses it (status {error.status})", "Send it again to see why"
            ) from error
        raise
    offset = answer.headers.get("upload-offset", "")
    if not offset.isdigit():
        raise ForeignAnswerError(f"{session.url} does not say how much of {file.path.name} it has: check the URL")
    return int(offset)


async def _send_from(session: Session, path: str, file: LocalFile, at: int, on_transfer: OnTransfer) -> Answer:
    done = at

    def on_sent(count: int) -> None:
        nonlocal done
        done += count
        on_transfer(Transfer(name=file.path.name, done_bytes=done, total_bytes=file.size_bytes))

    body = FileBytes(path=file.path, offset=at, length=file.size_bytes - at, on_sent=on_sent)
    headers = {**_BYTES, "Upload-Offset": str(at)}
    async with session.open("PATCH", path, headers=headers, body=body, read_s=LAST_BYTES_S) as answer:
        return await answer.whole()


def _check_unchanged(file: LocalFile) -> None:
    now = LocalFile.at(file.path)
    if now != file:
        raise UnreadableInputError(str(file.path), "changed while it was sent", "Send it again when it is complete")


def _remember(session: Session, memory: UploadMemory, file: LocalFile, known: Remembered) -> None:
    try:
        memory.keep(session.url, session.key, file, known)
    except OSError as error:
        session.notify(
            f"{file.path.name} would be sent anew if this is interrupted: the cache cannot be written ({error})"
        )


def _forget(session: Session, memory: UploadMemory, file: LocalFile) -> None:
    try:
        memory.forget(session.url, session.key, file)
    except OSError as error:
        session.notify(f"the cache cannot be written ({error})")
