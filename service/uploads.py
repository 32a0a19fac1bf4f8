"""Uploads: a client's bytes go to a file in the state folder, counted, hashed and examined.

The bytes go to a folder `.tmp-<id>`, which gets its final name when the last byte is on the disk. If anything fails
before, the folder is removed.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime as dt
import hashlib
import os
import shutil
import threading
import uuid
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

from pipeline.runtime.monitoring import tracing
from service.disk import FULL, MAKE_ROOM
from service.errors import NoSpaceError, RequestError, TooLargeError, TooManyUploadsError
from service.filenames import clean_filename
from service.files import StateFolder
from service.jobs import Upload
from service.preflight import is_quick, preflight
from service.settings import ServiceSettings

BLOCK_BYTES = 1 << 18
"""Bytes that are hashed and written at once."""
WRITERS = 4
"""Threads that write uploads: few, so that the other requests keep theirs."""
_LONG_TURN_S = 0.002
"""Seconds of a turn of the event loop beyond which uploads make way."""
_PAUSE_TURNS = 10.0
"""Length of an upload's pause, in turns."""
TEMPORARY = ".tmp-"
STALE_S = 24 * 3600.0
"""Seconds without a byte after which a temporary folder counts as left behind by a dead process."""
_writers = ThreadPoolExecutor(max_workers=WRITERS, thread_name_prefix="uploads")
_quick_examining = ThreadPoolExecutor(max_workers=1, thread_name_prefix="preflight-quick")
_slow_examining = ThreadPoolExecutor(max_workers=1, thread_name_prefix="preflight-slow")


class UploadTable(Protocol):
    """The part of the store that is used here."""

    def now(self) -> dt.datetime:
        """The time, with a time zone."""

    def add_upload(self, upload: Upload) -> None:
        """Store the record."""


class UploadLister(Protocol):
    """The part of the store that says how many there are."""

    def list_uploads(self, *, owner: str | None = None, limit: int, offset: int = 0) -> list[Upload]:
        """Uploads of a key, newest first; of all if it is None."""


class _Sink:
    """The file of one upload while it arrives. Its methods run in threads, one after the other."""

    def __init__(self, folder: StateFolder, upload_id: str, filename: str) -> None:
        self._lock = threading.Lock()
        self._disk = folder.disk
        self._digest = hashlib.sha256()
        self._final = folder.upload(upload_id)
        self._temporary = folder.uploads / f"{TEMPORARY}{upload_id}"
        self._temporary.mkdir(parents=True)
        self._over = False
        self.path = self._temporary / filename
        self._stream = self.path.open("xb", buffering=0)

    def write(self, block: bytes) -> None:
        """Hash and write some bytes."""
        with self._lock:
            if not self._over:
                self._disk.require(len(block), self.path.name)
                self._digest.update(block)
                view = memoryview(block)
                while view:
                    view = view[self._stream.write(view) :]

    def sync(self) -> str:
        """Write everything to the disk; the SHA-256."""
        with self._lock:
            os.fsync(self._stream.fileno())
            self._stream.close()
            return self._digest.hexdigest()

    def keep(self, upload: Upload, store: UploadTable) -> None:
        """Give the folder its final name, then store the record."""
        with self._lock:
            if self._over:
                return
            self._temporary.rename(self._final)
            try:
                store.add_upload(upload)
            except BaseException:
                shutil.rmtree(self._final, ignore_errors=True)
                raise
            self._over = True

    def discard(self) -> None:
        """Leave nothing behind, unless the upload was kept."""
        with self._lock:
            if not self._over:
                self._over = True
                self._stream.close()
                shutil.rmtree(self._temporary, ignore_errors=True)


async def receive(
    stream: AsyncIterator[bytes],
    filename: str,
    *,
    store: UploadTable,
    folder: StateFolder,
    settings: ServiceSettings,
    owner: str | None,
    sha256: str | None = None,
) -> Upload:
    """Receive an upload: write it to the disk while it arrives, examine it, then store the record.

    `sha256`, hexadecimal, is the digest that the client promised.

    Raises
    ------
    RequestError
        The name cannot be used, or the bytes differ from the promised digest.
    TooLargeError
        More bytes or points than allowed.
    NoSpaceError
        The disk is full, or only its reserve is free.
    InputError
        The file cannot be used.
    """
    loop, upload_id, name = asyncio.get_running_loop(), uuid.uuid4().hex, clean_filename(filename)
    made = tracing.begin("upload", upload_id=upload_id)
    sink = None
    try:
        sink = await loop.run_in_executor(_writers, _Sink, folder, upload_id, name)
        size = 0
        async for block in _blocks(stream):
            size += len(block)
            check_size(name, size, settings.max_upload_bytes)
            await loop.run_in_executor(_writers, sink.write, block)
            await make_way()
        found = await loop.run_in_executor(_writers, sink.sync)
        check_digest(name, found, sha256)
        upload = await examined(sink.path, upload_id, found, store=store, settings=settings, owner=owner)
        await loop.run_in_executor(_writers, sink.keep, upload, store)
    except BaseException as fault:
        tracing.failed(made, type(fault).__name__)
        if sink is not None:
            discarded = _writers.submit(sink.discard)
            if isinstance(fault, Exception):
                await asyncio.wrap_future(discarded)
        if isinstance(fault, OSError) and fault.errno in FULL:
            raise NoSpaceError(f"there is no room on the disk for {name}. {MAKE_ROOM}") from fault
        raise
    else:
        tracing.note(made, size_bytes=size)
    finally:
        tracing.end(made)
    return upload


async def examined(
    path: Path, upload_id: str, sha256: str, *, store: UploadTable, settings: ServiceSettings, owner: str | None
) -> Upload:
    """The record of a file that has arrived, with the content of its header; it is not stored.

    Raises
    ------
    TooLargeError
        More points than allowed.
    InputError
        The file cannot be used.
    """
    loop = asyncio.get_running_loop()
    examining = _quick_examining if is_quick(path) else _slow_examining
    facts = await loop.run_in_executor(examining, preflight, path, settings.max_points)
    now = await loop.run_in_executor(_writers, store.now)
    return Upload(
        upload_id=upload_id,
        owner=owner,
        filename=path.name,
        size_bytes=path.stat().st_size,
        sha256=sha256,
        created_at=now,
        expires_at=now + dt.timedelta(days=settings.upload_days),
        preflight=facts,
    )


def check_number(store: UploadLister, owner: str | None, most: int, more: int) -> None:
    """Refuse one more upload before its bytes come; `more` do not have a record yet.

    Raises
    ------
    TooManyUploadsError
        The owner has as many as `most`.
    """
    if more >= most or store.list_uploads(owner=owner, limit=1, offset=most - more - 1):
        raise TooManyUploadsError.stored(most)


def check_size(name: str, size: int, limit: int) -> None:
    """Refuse a file as soon as it is too large."""
    if size > limit:
        raise TooLargeError(
            f"{name} has more than {limit} bytes: cut it into tiles, or raise GABLEWORK_MAX_UPLOAD_BYTES"
        )


def check_digest(name: str, found: str, promised: str | None) -> None:
    """Refuse bytes that differ from the promised digest."""
    if promised is not None and promised != found:
        raise RequestError([f"the SHA-256 of {name} is {found}, not {promised} as promised: send it again"])


async def _blocks(stream: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The same bytes in blocks of at least `BLOCK_BYTES`, except the last."""
    held: list[bytes] = []
    size = 0
    async for piece in stream:
        held.append(piece)
        size += len(piece)
        if size >= BLOCK_BYTES:
            yield b"".join(held)
            held, size = [], 0
    if held:
        yield b"".join(held)


async def make_way() -> None:
    """Let short requests go first: where many uploads arrive at once, each pauses between its blocks.

    A turn of the event loop takes as long as all that is ready in it. With dozens of uploads a short request, which
    needs several turns, would wait for them all several times.
    """
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    await asyncio.sleep(0.0)
    turn_s = loop.time() - began_s
    if turn_s > _LONG_TURN_S:
        await asyncio.sleep(_PAUSE_TURNS * turn_s)


def remove_file(upload_id: str, folder: StateFolder) -> None:
    """Remove an upload's folder, after its record was removed from the store."""
    shutil.rmtree(folder.upload(upload_id), ignore_errors=True)


def remove_leftovers(folder: StateFolder, *, now_s: float) -> list[Path]:
    """Remove the temporary folders that a dead process left behind; returns them. `now_s` counts from the epoch."""
    removed = []
    for path in folder.uploads.glob(f"{TEMPORARY}*"):
        with contextlib.suppress(FileNotFoundError):
            newest_s = max(entry.stat().st_mtime for entry in (path, *path.iterdir()))
            if now_s - newest_s > STALE_S:
                shutil.rmtree(path, ignore_errors=True)
                removed.append(path)
    return removed
