"""A folder that keeps what the tasks of a run found: a run that was cut off goes on there, a later one begins there.

One process at a time works in it. It holds the folder by a lock of the system, which ends with the process whatever
ended it, so nothing needs to be cleared away after a crash.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import fcntl
import json
import os
import shutil
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

from pipeline.errors import RunError
from pipeline.io import LocalStorage
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import FOLDER

_LOCK = "lock"
DRIVER_LOCK = "driver.lock"
"""Held by who drives a batch, from before its first word about it; tasks are kept under `_LOCK`, later."""
_OF_WHO_WORKS = (DRIVER_LOCK, _LOCK)
_SCRATCH = "scratch"
_MARK = "work.json"
_BESIDE = {_LOCK, "status.json"}
"""What a batch may have written before the folder was made."""
_PATIENCE_S, _PAUSE_S = 0.5, 0.01
"""Whoever asks whether a lock is held holds it for microseconds: it is tried again for so long, so often."""
_FORMAT = 1
_BOOT = "boot"
_DISTRUSTED_S = 300.0
"""Ten times as long as systems keep what is not on the disk yet."""
_OF_A_RUN = ("dask", "fetched")
"""Folders of scratch that a process leaves behind only where it was killed."""


@contextlib.contextmanager
def locked_work(folder: str) -> Iterator[Scratch]:
    """Hold a work folder, made where it is not there, until the block ends.

    Parameters
    ----------
    folder : str
        On a file system that all workers share.

    Yields
    ------
    Scratch
        Where tasks keep what they find, taken over from all earlier attempts.

    Raises
    ------
    RunError
        Another process works there, or the folder is none of ours, or cannot be written.
    """
    root = Path(folder).resolve()
    make_work(root)
    with locked_file(root, _LOCK):
        scratch = Scratch(str(root / _SCRATCH), attempt=uuid4().hex)
        scratch.create()
        _distrust_the_last(root, scratch)
        for left in _OF_A_RUN:
            shutil.rmtree(Path(scratch.root, left), ignore_errors=True)
        yield scratch


def _distrust_the_last(root: Path, scratch: Scratch) -> None:
    """Forget what was kept shortly before this machine was started anew.

    What a process wrote outlives it, but not a loss of power: the system writes to the disk up to half a minute later
    (`vm.dirty_expire_centisecs`), names before contents. So of an outcome that was kept within minutes of the end
    nobody knows whether it is whole. Where another machine goes on, the folder lies on a server of files, which has
    what was closed.
    """
    file, host, now = root / _BOOT, socket.gethostname(), boot_id()
    # of a folder that does not tell nobody knows; a new one has nothing that could be distrusted
    before = file.read_text(errors="replace").split() if file.is_file() else [host]
    if before[:1] == [host] and before[1:] != [now]:
        kept = [path for path in Path(scratch.root, FOLDER).glob("*/*/*") if path.name[0] != "."]
        last = max((path.stat().st_mtime for path in kept), default=0.0)
        for path in kept:
            if path.stat().st_mtime > last - _DISTRUSTED_S:
                path.unlink()
    LocalStorage(root=root).put(_BOOT, f"{host} {now}".encode())


def boot_id() -> str:
    """What differs each time that this machine is started; `unknown` where the system does not tell it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return "unknown"


def make_work(root: Path) -> None:
    """Make a work folder where it is not there.

    Raises
    ------
    RunError
        The folder is none of ours, or cannot be written.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        _check_mark(root)
    except OSError as error:
        raise RunError(f"{root} cannot be written: {error.strerror or error}. Give another work folder") from error


@contextlib.contextmanager
def locked_file(root: Path, name: str) -> Iterator[None]:
    """Hold a file in a work folder until the block ends.

    Raises
    ------
    RunError
        Another process holds it, or the folder cannot be written or knows no locks.
    """
    try:
        handle = os.open(root / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise RunError(f"{root} cannot be written: {error.strerror or error}. Give another work folder") from error
    try:
        try:
            take_lock(handle)
        except BlockingIOError:
            raise RunError(
                f"{root} is at work already ({_holder(root / name)}): wait for it, or end it first"
            ) from None
        except OSError as error:
            raise RunError(
                f"{root} is on a file system without locks ({error.strerror or error}): "
                "two runs could meet there unseen. Give a work folder elsewhere"
            ) from error
        now = dt.datetime.now(tz=dt.UTC).isoformat(timespec="seconds")
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()} since {now}".encode(), 0)
        yield
    finally:
        os.close(handle)


def take_lock(handle: int) -> None:
    """Lock an open file until all who have it open closed it, or ended.

    Raises
    ------
    BlockingIOError
        Another process holds it.
    OSError
        It is on a file system without locks.
    """
    end = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > end:
                raise
        time.sleep(_PAUSE_S)


def refuse_locked(folder: str) -> None:
    """Say early that another process works in a folder; `locked_work` has the last word.

    Raises
    ------
    RunError
        One does.
    """
    for name in _OF_WHO_WORKS:
        if is_locked(folder, name):
            raise RunError(f"{folder} is at work already ({_holder(Path(folder, name))}): wait for it, or end it first")


def is_at_work(folder: str) -> bool:
    """Whether some process works in a folder."""
    return any(is_locked(folder, name) for name in _OF_WHO_WORKS)


def refuse_foreign(folder: str) -> None:
    """Say early that a work folder cannot be one; nothing is made.

    Raises
    ------
    RunError
        It is a file, holds other people's files, or was made by another version.
    """
    root = Path(folder)
    try:
        if root.exists():
            _is_marked(root)
    except OSError as error:
        raise RunError(f"{root} cannot be read: {error.strerror or error}. Give another work folder") from error


def _holder(lock: Path) -> str:
    """Who holds a lock, as the holder says."""
    try:
        return lock.read_text(errors="replace").strip() or "by another process"
    except OSError:
        return "by another process"


def is_locked(folder: str, lock: str) -> bool:
    """Whether some process of this machine, or of one that shares the folder's locks, works there just now."""
    try:
        handle = os.open(Path(folder, lock), os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(handle)
    return False


def _check_mark(root: Path) -> None:
    """Refuse a folder with other people's files, or of another format; mark it as ours."""
    if not _is_marked(root):
        (root / _MARK).write_text(json.dumps({"format": _FORMAT}) + "\n")


def _is_marked(root: Path) -> bool:
    """Whether a folder is ours already; one with other people's files, or of another format, is refused."""
    mark = root / _MARK
    if mark.is_file():
        try:
            found = json.loads(mark.read_text()).get("format")
        except (json.JSONDecodeError, AttributeError):
            found = None
        if found != _FORMAT:
            raise RunError(f"{root} was made by another version (format {found!r}): remove it, or give another folder")
        return True
    left = sorted(entry.name for entry in root.iterdir() if entry.name not in _BESIDE)
    if left:
        raise RunError(f"{root} holds {left[0]} and is no work folder: give a new or empty one")
    return False
