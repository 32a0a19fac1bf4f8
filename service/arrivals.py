"""Resumable uploads: one request at a time adds to an unfinished upload, and the last one makes it an ordinary upload.

A connection that was lost without a sign may seem open for minutes. A new request for the same upload therefore ends a
request in this process whose client has been silent for a moment; its bytes are kept.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import errno
import functools
import hashlib
import math
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from typing import TypeVar

import anyio
import anyio.to_thread
from starlette.requests import ClientDisconnect

from pipeline.errors import InputError
from service import resumable
from service.deliveries import Delivery
from service.disk import MAKE_ROOM
from service.errors import ChecksumError, NoSpaceError, NoSuchUploadError, OffsetError, RequestError, TooLargeError
from service.filenames import clean_filename
from service.files import StateFolder
from service.jobs import Upload
from service.resumable import Promise, Unfinished
from service.settings import ServiceSettings
from service.store import JobStore
from service.uploads import (
    BLOCK_BYTES,
    WRITERS,
    check_digest,
    check_number,
    check_size,
    examined,
    make_way,
    remove_file,
)

SILENT_S = 3.0
"""Seconds without a byte after which a client that sends counts as gone if another request wants the upload: longer
than the pauses of a slow network, shorter than a person waits."""
HASHING = 2
"""Threads that hash finished uploads: none waits for one large file."""
ALGORITHMS = ("sha1", "sha256")
"""Algorithms of checksums; the protocol demands the first."""

Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True, kw_only=True)
class State:
    """The state of a resumable upload, for its client."""

    upload_id: str
    size_bytes: int
    offset: int
    """Bytes that are safely on the disk."""
    expires_at: dt.datetime
    metadata: str | None = None
    """The header Upload-Metadata as the client sent it; None for a finished upload."""
    is_finished: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """What a request adds to an upload."""

    stream: AsyncIterator[bytes]
    """Its bytes."""
    offset: int
    """Where they belong."""
    length: int | None = None
    """Their number, if the client has said it."""
    checksum: tuple[str, bytes] | None = None
    """Algorithm and digest of the bytes."""


class _InterruptedError(Exception):
    """Another request wants the upload, and this one's client is silent."""


class _Holder:
    """A request that holds an unfinished upload."""

    def __init__(self) -> None:
        self.done = anyio.Event()
        self._heard_s = math.inf
        self._waiting: anyio.CancelScope | None = None

    @property
    def silent_from_s(self) -> float:
        """The time from which its client counts as gone; infinite while nothing is expected from it."""
        return self._heard_s + SILENT_S

    async def heard(self, stream: AsyncIterator[bytes]) -> AsyncGenerator[bytes]:
        """The same bytes.

        Raises
        ------
        _InterruptedError
            See `interrupt`.
        """
        try:
            while True:
                self._heard_s = anyio.current_time()
                with anyio.CancelScope() as self._waiting:
                    try:
                        piece = await anext(stream)
                    except StopAsyncIteration:
                        return
                if self._waiting.cancelled_caught:
                    raise _InterruptedError
                # writing is ours: the client is not silent while we are slow
                self._heard_s, self._waiting = math.inf, None
                yield piece
        finally:
            self._heard_s, self._waiting = math.inf, None

    def interrupt(self) -> None:
        """End the wait for the client."""
        if self._waiting is not None:
            self._waiting.cancel()


class Arrivals:
    """The resumable uploads of a service.

    Parameters
    ----------
    store : JobStore
        Takes the records of finished uploads.
    folder : StateFolder
        Takes the files.
    settings : ServiceSettings
        The limits.
    """

    def __init__(self, store: JobStore, folder: StateFolder, settings: ServiceSettings) -> None:
        self._store = store
        self._folder = folder
        self._settings = settings
        self._holders: dict[str, _Holder] = {}
        self._threads = anyio.CapacityLimiter(WRITERS)
        self._hashing = anyio.CapacityLimiter(HASHING)

    async def create(
        self, filename: str, size_bytes: int, *, sha256: str | None, metadata: str, owner: str | None
    ) -> State:
        """Make an unfinished upload.

        Raises
        ------
        RequestError
            The name cannot be used.
        TooLargeError
            The file is too large.
        TooManyUploadsError, QuotaError
            The owner has too many, or too many bytes.
        NoSpaceError
            There is no room on the disk.
        """
        name = clean_filename(filename)
        check_size(name, size_bytes, self._settings.max_upload_bytes)
        promise = Promise(
            upload_id=resumable.new_id(),
            owner=owner,
            filename=name,
            size_bytes=size_bytes,
            sha256=sha256,
            metadata=metadata,
        )
        expires_at = await self._expiry()
        await self._run(functools.partial(self._create, promise, expires_at))
        return State(upload_id=promise.upload_id, size_bytes=size_bytes, offset=0, expires_at=expires_at)

    def _create(self, promise: Promise, expires_at: dt.datetime) -> None:
        quota = self._settings.max_upload_bytes_per_key
        room = quota - self._store.stored_bytes(promise.owner) if quota else None
        most = self._settings.max_unfinished_uploads
        begun = sum(other.owner == promise.owner for other in resumable.unfinished(self._folder))
        check_number(self._store, promise.owner, self._settings.max_uploads_per_key, begun)
        resumable.create(self._folder, promise, expires_at, most=most, room_bytes=room)

    async def state(self, upload_id: str, *, owner: str | None) -> State:
        """Where an upload is. If all bytes have arrived but it is not finished, as after a restart, it is finished now.

        Raises
        ------
        NoSuchUploadError
            It does not exist, or belongs to another key.
        UploadBusyError
            A request sends it.
        RequestError, TooLargeError, InputError
            The whole file is refused; see `append`.
        """
        try:
            async with self._held(upload_id, owner) as (_, held):
                return await self._settled(held)
        except NoSuchUploadError:
            return await self._finished(upload_id, owner)

    async def append(self, upload_id: str, part: Part, *, owner: str | None) -> State:
        """Add bytes; the last ones finish the upload. If the connection breaks, those that have arrived are kept.

        Bytes with a checksum are kept only together.

        Raises
        ------
        NoSuchUploadError
            It does not exist, or belongs to another key.
        UploadBusyError
            Another request sends it.
        OffsetError
            The bytes do not begin where those before end.
        ChecksumError
            The bytes differ from their checksum.
        RequestError
            The whole file differs from the promised digest; it is removed.
        TooLargeError
            There are more bytes than announced; or the file has too many points, then it is removed.
        InputError
            The whole file cannot be used; it is removed.
        NoSpaceError
            The disk is full.
        """
        try:
            async with self._held(upload_id, owner) as (holder, held):
                _check_part(part, held)
                await self._run(functools.partial(held.begin, await self._expiry(), is_checked=bool(part.checksum)))
                await self._receive(part, holder, held)
                return await self._settled(held)
        except NoSuchUploadError:
            state = await self._finished(upload_id, owner)
            if part.offset != state.offset or part.length != 0:
                raise OffsetError(f"the upload {upload_id} is finished: it has all its {state.offset} bytes") from None
            return state
        except OSError as fault:
            if fault.errno in {errno.ENOSPC, errno.EDQUOT}:
                raise NoSpaceError(f"there is no room on the disk for the upload. {MAKE_ROOM}") from fault
            raise

    async def remove(self, upload_id: str, *, owner: str | None) -> None:
        """Remove an upload, finished or not.

        Raises
        ------
        NoSuchUploadError
            It does not exist, or belongs to another key.
        UploadBusyError
            A request sends it.
        UploadInUseError
            A job or a schedule needs it.
        """
        try:
            async with self._held(upload_id, owner) as (_, held):
                await self._run(held.remove)
        except NoSuchUploadError:
            await self._finished(upload_id, owner)
            await self._run(functools.partial(self._store.remove_upload, upload_id))
            await self._run(functools.partial(remove_file, upload_id, self._folder))

    @contextlib.asynccontextmanager
    async def _held(self, upload_id: str, owner: str | None) -> AsyncIterator[tuple[_Holder, Unfinished]]:
        """An unfinished upload, for this request alone."""
        promise = await self._run(functools.partial(resumable.find, self._folder, upload_id, owner))
        await self._wait_for_others(upload_id)
        holder = self._holders[upload_id] = _Holder()
        try:
            held = await self._run(functools.partial(Unfinished, self._folder, promise))
            try:
                await self._run(functools.partial(self._recover, held))
                yield holder, held
            finally:
                held.close()
        finally:
            del self._holders[upload_id]
            holder.done.set()

    async def _wait_for_others(self, upload_id: str) -> None:
        """Wait until no request of this process holds an upload, but not for one whose client goes on sending."""
        patience_s = anyio.current_time() + SILENT_S
        while (holder := self._holders.get(upload_id)) is not None:
            left_s = min(patience_s, holder.silent_from_s) - anyio.current_time()
            if left_s > 0:
                with anyio.move_on_after(left_s):
                    await holder.done.wait()
            elif holder.silent_from_s <= anyio.current_time():
                holder.interrupt()
                await holder.done.wait()
            else:
                raise resumable.busy(upload_id)

    def _recover(self, held: Unfinished) -> None:
        """Repair what a process left behind that died over the upload."""
        upload_id = held.promise.upload_id
        if held.is_moved and upload_id in self._store.upload_ids():
            held.remove()
            raise NoSuchUploadError(f"the upload {upload_id} is finished")
        held.recover()

    async def _receive(self, part: Part, holder: _Holder, held: Unfinished) -> None:
        """Write the bytes of a request, as many as arrive."""
        digest = hashlib.new(part.checksum[0]) if part.checksum is not None else None

        def write(block: bytes) -> None:
            if digest is not None:
                digest.update(block)
            held.write(block)

        is_complete = False
        try:
            try:
                await self._copy(holder.heard(part.stream), write)
                is_complete = True
            except ClientDisconnect:
                # no one reads the answer
                pass
            except _InterruptedError:
                raise resumable.busy(held.promise.upload_id) from None
        finally:
            is_right = part.checksum is None or (
                is_complete and digest is not None and digest.digest() == part.checksum[1]
            )
            with anyio.CancelScope(shield=True):
                await self._run(held.end if is_right else held.revert)
        if is_complete and not is_right:
            raise ChecksumError("the bytes differ from Upload-Checksum and were not kept: send them again")

    async def _copy(self, pieces: AsyncGenerator[bytes], write: Callable[[bytes], None]) -> None:
        """Write bytes in larger blocks; the last one also if the pieces end with an error."""
        waiting = bytearray()
        try:
            async with contextlib.aclosing(pieces):
                async for piece in pieces:
                    waiting += piece
                    if len(waiting) >= BLOCK_BYTES:
                        block, waiting = bytes(waiting), bytearray()
                        await self._run(functools.partial(write, block))
                        await make_way()
        finally:
            if waiting:
                with anyio.CancelScope(shield=True):
                    await self._run(functools.partial(write, bytes(waiting)))

    async def _settled(self, held: Unfinished) -> State:
        """The state of an upload after a request; it is finished if it can be."""
        promise = held.promise
        state = State(
            upload_id=promise.upload_id,
            size_bytes=promise.size_bytes,
            offset=held.offset,
            expires_at=held.expires_at,
            metadata=promise.metadata,
        )
        if not held.is_whole:
            return state
        upload = await self._finish(held)
        return dataclasses.replace(state, is_finished=True, expires_at=upload.expires_at)

    async def _finish(self, held: Unfinished) -> Upload:
        """Make an upload of a file that has arrived; a file that is refused is removed."""
        promise = held.promise
        try:
            found = await anyio.to_thread.run_sync(held.sha256, limiter=self._hashing)
            check_digest(promise.filename, found, promise.sha256)
            upload = await examined(
                held.path,
                promise.upload_id,
                found,
                store=self._store,
                settings=self._settings,
                owner=promise.owner,
            )
        except (RequestError, TooLargeError, InputError):
            await self._run(held.remove)
            raise
        record: Delivery[None] = Delivery(uploads=(upload,), max_upload_bytes=self._settings.max_upload_bytes_per_key)
        await self._run(functools.partial(held.keep, functools.partial(self._store.add_uploads, record)))
        return upload

    async def _finished(self, upload_id: str, owner: str | None) -> State:
        """The state of a finished upload."""
        upload = await self._run(functools.partial(self._store.upload, upload_id, owner=owner))
        size = upload.size_bytes
        return State(upload_id=upload_id, size_bytes=size, offset=size, expires_at=upload.expires_at, is_finished=True)

    async def _expiry(self) -> dt.datetime:
        now = await self._run(self._store.now)
        return now + dt.timedelta(hours=self._settings.unfinished_upload_hours)

    async def _run(self, call: Callable[[], Result]) -> Result:
        return await anyio.to_thread.run_sync(call, limiter=self._threads)


def _check_part(part: Part, held: Unfinished) -> None:
    """Refuse bytes that do not fit, before they are read."""
    name, size = held.promise.filename, held.promise.size_bytes
    if part.offset != held.offset:
        raise OffsetError(f"{held.offset} bytes of {name} are here, Upload-Offset is {part.offset}: continue there")
    if part.length is not None and part.length > size - held.offset:
        raise TooLargeError(
            f"{name} was announced with {size} bytes and {held.offset} are here: {part.length} more are too many"
        )
