"""Unfinished uploads: files that arrive in several requests, over broken connections and restarts of the service.

Each has a folder `.tus-<id>` beside the finished uploads, with what the client promised (`promise.json`), how far it
came (`progress.json`), and the file in a folder of its own, which becomes the folder of the finished upload. A request
that changes an upload holds a lock on its promise, which the system releases when the process dies.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import fcntl
import hashlib
import json
import os
import shutil
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from service.errors import NoSuchUploadError, QuotaError, TooLargeError, TooManyUploadsError, UploadBusyError
from service.files import StateFolder, is_id
from service.uploads import TEMPORARY

PREFIX = ".tus-"
"""Begins the name of the folder of an unfinished upload."""
SYNC_BYTES = 64 << 20
"""Bytes after which a long request is written to the disk: a loss of power costs no more than this."""
READ_BYTES = 1 << 20
"""Bytes that are hashed at once."""
_BOOT = Path("/proc/sys/kernel/random/boot_id")
_PROMISE = "promise.json"
_PROGRESS = "progress.json"
_FILE = "file"
_creating = threading.Lock()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Promise:
    """What the client said when it created an upload; it never changes."""

    upload_id: str
    """The id of the unfinished upload and of the finished one."""
    owner: str | None
    """Id of the key that created it."""
    filename: str
    """Cleaned name of the file."""
    size_bytes: int
    """Bytes of the whole file."""
    sha256: str | None
    """Promised digest of the whole file, hexadecimal."""
    metadata: str
    """The header Upload-Metadata as it was sent."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress:
    """How far an upload came."""

    synced_bytes: int
    """Bytes that are on the disk for certain."""
    boot: str | None
    """The run of the operating system that wrote to the file. While it lasts, the file's size counts: what a killed
    process has written is not lost. None if only `synced_bytes` count."""
    expires_at: dt.datetime
    """Time after which the upload is removed."""


class Unfinished:
    """An unfinished upload that this request holds alone, until `close`. Call `recover` first.

    Its methods run in threads, one after the other.

    Parameters
    ----------
    folder : StateFolder
        The folder of all uploads.
    promise : Promise
        The upload, as `find` returns it.

    Raises
    ------
    NoSuchUploadError
        It is gone.
    UploadBusyError
        Another request holds it.
    """

    def __init__(self, folder: StateFolder, promise: Promise) -> None:
        self.promise = promise
        self._place = _place(folder, promise.upload_id)
        self._final = folder.upload(promise.upload_id)
        self._disk = folder.disk
        self._lock = _locked(self._place / _PROMISE, promise.upload_id)
        self._stream: BinaryIO | None = None
        self._is_checked = False
        self._unsynced = 0

    @property
    def path(self) -> Path:
        """The file."""
        return self._place / _FILE / self.promise.filename

    @property
    def is_whole(self) -> bool:
        """Whether all bytes have arrived."""
        return self.offset == self.promise.size_bytes

    @property
    def is_moved(self) -> bool:
        """Whether a process died while it finished the upload: it is finished if there is a record, else `recover`."""
        return not self.path.parent.exists()

    def recover(self) -> None:
        """Find out how many bytes count, after whatever ended the request before.

        Raises
        ------
        NoSuchUploadError
            Parts of it are gone.
        """
        if self.is_moved and self._final.exists():
            self._final.rename(self.path.parent)
        try:
            progress, size = _progress(self._place), self.path.stat().st_size
        except (FileNotFoundError, ValueError):
            raise _gone(self.promise.upload_id) from None
        self.expires_at = progress.expires_at
        self.offset = size if _is_same_boot(progress.boot) else min(size, progress.synced_bytes)
        self._synced = progress.synced_bytes
        if size != self.offset or self._synced != self.offset:
            with self.path.open("r+b", buffering=0) as stream:
                stream.truncate(self.offset)
                os.fsync(stream.fileno())
            self._note(synced=self.offset, boot=_boot())

    def begin(self, expires_at: dt.datetime, *, is_checked: bool) -> None:
        """Begin to write at the offset. If the bytes have a checksum, they count only when `end` was called."""
        self.expires_at = expires_at
        self._is_checked = is_checked
        self._begun = self.offset
        self._note(synced=self.offset, boot=None if is_checked else _boot())
        self._stream = self.path.open("r+b", buffering=0)
        self._stream.seek(self.offset)

    def write(self, block: bytes) -> None:
        """Write some bytes.

        Raises
        ------
        TooLargeError
            More bytes than were promised; nothing of the block is written.
        NoSpaceError
            They would use the reserve of the disk.
        """
        assert self._stream is not None, "begin first"
        left = self.promise.size_bytes - self.offset
        if len(block) > left:
            raise TooLargeError(
                f"{self.promise.filename} was announced with {self.promise.size_bytes} bytes and has more: create the "
                "upload again with its true Upload-Length"
            )
        self._disk.require(len(block), self.promise.filename)
        view = memoryview(block)
        while view:
            written = self._stream.write(view)
            self.offset += written
            self._unsynced += written
            view = view[written:]
        if self._unsynced >= SYNC_BYTES and not self._is_checked:
            self._sync()

    def end(self) -> None:
        """Write everything to the disk: from now on it counts."""
        if self._stream is not None:
            self._sync()
            self._stream.close()
            self._stream = None

    def revert(self) -> None:
        """Forget the bytes of this request."""
        if self._stream is not None:
            self._cut(self._begun)
            self.end()

    def _sync(self) -> None:
        assert self._stream is not None
        try:
            os.fdatasync(self._stream.fileno())
        except OSError:
            # the system may have dropped what it could not write
            self._cut(self._synced)
            raise
        self._unsynced = 0
        self._note(synced=self.offset, boot=_boot())

    def _cut(self, size: int) -> None:
        assert self._stream is not None
        self._stream.truncate(size)
        self._stream.seek(size)
        self.offset = size

    def _note(self, *, synced: int, boot: str | None) -> None:
        """Store the progress."""
        _write_progress(self._place, Progress(synced_bytes=synced, boot=boot, expires_at=self.expires_at))
        self._synced = synced

    def sha256(self) -> str:
        """The digest of the file as it is on the disk."""
        digest = hashlib.sha256()
        with self.path.open("rb", buffering=0) as stream:
            while block := stream.read(READ_BYTES):
                digest.update(block)
        return digest.hexdigest()

    def keep(self, store: Callable[[], None]) -> None:
        """Make it a finished upload; `store` stores its record."""
        # a folder without a record is removed when it is old
        os.utime(self.path.parent)
        self.path.parent.rename(self._final)
        try:
            store()
        except BaseException:
            self._final.rename(self.path.parent)
            raise
        self.remove()

    def remove(self) -> None:
        """Remove everything that is left of it."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        _remove(self._place)

    def close(self) -> None:
        """Let others have it."""
        if self._stream is not None:
            self._stream.close()
        os.close(self._lock)


def create(
    folder: StateFolder, promise: Promise, expires_at: dt.datetime, *, most: int, room_bytes: int | None = None
) -> None:
    """Make an unfinished upload without any bytes.

    Its owner may have `most` of them, and all its uploads, finished or not, `room_bytes` more than are finished.

    Raises
    ------
    TooManyUploadsError
        The owner has as many.
    QuotaError
        They would have too many bytes.
    NoSpaceError
        The file would use the reserve of the disk.
    """
    temporary = folder.uploads / f"{TEMPORARY}{promise.upload_id}"
    with _creating:
        others = [other.size_bytes for other in unfinished(folder) if other.owner == promise.owner]
        if room_bytes is not None and sum(others) + promise.size_bytes > room_bytes:
            raise QuotaError(sum(others), promise.size_bytes, room_bytes)
        folder.disk.require(promise.size_bytes, promise.filename)
        if len(others) >= most:
            raise TooManyUploadsError(
                f"{len(others)} uploads are not finished and the limit is {most}: finish or remove some, or raise "
                "GABLEWORK_MAX_UNFINISHED_UPLOADS"
            )
        try:
            (temporary / _FILE).mkdir(parents=True)
            (temporary / _FILE / promise.filename).touch()
            _write(temporary / _PROMISE, dataclasses.asdict(promise))
            _write_progress(temporary, Progress(synced_bytes=0, boot=_boot(), expires_at=expires_at))
            temporary.rename(_place(folder, promise.upload_id))
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise


def new_id() -> str:
    """The id of a new upload: random, so it cannot be guessed."""
    return uuid.uuid4().hex


def find(folder: StateFolder, upload_id: str, owner: str | None) -> Promise:
    """One unfinished upload.

    Raises
    ------
    NoSuchUploadError
        It does not exist, or belongs to another key.
    """
    found = _promise(_place(folder, upload_id)) if is_id(upload_id) else None
    if found is None or (owner is not None and found.owner != owner):
        raise _gone(upload_id)
    return found


def unfinished(folder: StateFolder) -> Iterator[Promise]:
    """All unfinished uploads."""
    for place in folder.uploads.glob(f"{PREFIX}*"):
        promise = _promise(place)
        if promise is not None:
            yield promise


def remove_expired(folder: StateFolder, now: dt.datetime) -> list[Path]:
    """Remove the unfinished uploads whose time is over and that no request holds; returns their folders."""
    removed = []
    for place in folder.uploads.glob(f"{PREFIX}*"):
        with contextlib.suppress(FileNotFoundError, NoSuchUploadError, UploadBusyError):
            lock = _locked(place / _PROMISE, place.name.removeprefix(PREFIX))
            try:
                if _is_over(place, now):
                    _remove(place)
                    removed.append(place)
            finally:
                os.close(lock)
    return removed


def _is_over(place: Path, now: dt.datetime) -> bool:
    """Whether the time of an upload is over; a damaged one can never be continued."""
    try:
        return _progress(place).expires_at <= now
    except (FileNotFoundError, ValueError):
        return True


def _place(folder: StateFolder, upload_id: str) -> Path:
    return folder.uploads / f"{PREFIX}{folder.upload(upload_id).name}"


def _remove(place: Path) -> None:
    """Remove a folder; if the process dies over it, the rest counts as left behind."""
    rest = place.with_name(place.name.replace(PREFIX, TEMPORARY))
    place.rename(rest)
    shutil.rmtree(rest, ignore_errors=True)


def _gone(upload_id: str) -> NoSuchUploadError:
    return NoSuchUploadError(f"there is no upload {upload_id[:64]!r} (any more): create it again")


def _promise(place: Path) -> Promise | None:
    """The promise; None if the folder is gone or damaged."""
    try:
        return Promise(**json.loads((place / _PROMISE).read_text()))
    except (FileNotFoundError, ValueError, TypeError):
        return None


def _locked(path: Path, upload_id: str) -> int:
    """A descriptor that holds the lock of an upload.

    Raises
    ------
    NoSuchUploadError
        It was finished or removed.
    UploadBusyError
        Another request holds it.
    """
    try:
        lock = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        raise _gone(upload_id) from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        raise busy(upload_id) from None
    # the holder before us may have removed the file that we opened
    if os.fstat(lock).st_nlink == 0:
        os.close(lock)
        raise _gone(upload_id)
    return lock


def busy(upload_id: str) -> UploadBusyError:
    """The refusal of a second request."""
    return UploadBusyError(f"another request sends the upload {upload_id}: wait until it has ended, then ask by HEAD")


def _progress(place: Path) -> Progress:
    values = json.loads((place / _PROGRESS).read_text())
    return Progress(**{**values, "expires_at": dt.datetime.fromisoformat(values["expires_at"])})


def _write_progress(place: Path, progress: Progress) -> None:
    _write(place / _PROGRESS, {**dataclasses.asdict(progress), "expires_at": progress.expires_at.isoformat()})


def _write(path: Path, values: Mapping[str, object]) -> None:
    """Replace a file: after a loss of power it is the old or the new one."""
    new = path.with_name(f"{path.name}.new")
    with new.open("w") as stream:
        json.dump(values, stream)
        stream.flush()
        os.fsync(stream.fileno())
    new.replace(path)


def _boot() -> str | None:
    """The run of the operating system; None where it cannot be known."""
    try:
        return _BOOT.read_text().strip()
    except OSError:
        return None


def _is_same_boot(boot: str | None) -> bool:
    return boot is not None and boot == _boot()
