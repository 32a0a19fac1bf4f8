"""The work folder, which stores the outcomes of tasks: an interrupted run resumes there, and a later run starts there.

One process at a time works in it. It locks the folder by a lock of the system, which ends with the process, however it
ends, so a crash leaves nothing to clean up.
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
from pipeline.runtime.scratch.folder import ATTEMPTS, Scratch
from pipeline.runtime.scratch.outcomes import FOLDER

_LOCK = "lock"
DRIVER_LOCK = "driver.lock"
"""Locked by the driver of a batch before it reports anything; `_LOCK` protects the tasks' outcomes, later."""
_LOCKS = (DRIVER_LOCK, _LOCK)
_SCRATCH = "scratch"
_MARK = "work.json"
_BESIDE = {_LOCK, "status.json"}
"""Files that a batch may have written before the folder was made."""
_PATIENCE_S, _PAUSE_S = 0.5, 0.01
"""How long, and how often, a lock is tried again: a process that only checks a lock holds it for microseconds."""
_FORMAT = 1
_OF_A_RUN = ("dask", "fetched")
"""Folders of scratch that only a killed process leaves behind."""


@contextlib.contextmanager
def locked_work(folder: str) -> Iterator[Scratch]:
    """Lock a work folder until the block ends; made where it does not exist, on a file system that all workers share.

    Its scratch stores the outcomes of tasks; they are taken over from all earlier attempts. Raises RunError if another
    process works there, or the folder is not a work folder, or cannot be written.
    """
    root = Path(folder).resolve()
    make_work(root)
    with locked_file(root, _LOCK):
        scratch = Scratch(str(root / _SCRATCH), attempt=uuid4().hex)
        scratch.create()
        for left in _OF_A_RUN:
            shutil.rmtree(Path(scratch.root, left), ignore_errors=True)
        yield scratch


def make_work(root: Path) -> None:
    """Make a work folder where it does not exist."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        _check_mark(root)
    except OSError as error:
        raise RunError(f"{root} cannot be written: {error.strerror or error}. Give another work folder") from error


@contextlib.contextmanager
def locked_file(root: Path, name: str) -> Iterator[None]:
    """Lock a file in a work folder until the block ends."""
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
    """Lock an open file until all processes that have it open close it or end.

    Raises
    ------
    BlockingIOError
        Another process has locked it.
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
    """Raise `RunError` early where another process works in a folder; `locked_work` decides."""
    for name in _LOCKS:
        if is_locked(folder, name):
            raise RunError(f"{folder} is at work already ({_holder(Path(folder, name))}): wait for it, or end it first")


def is_at_work(folder: str) -> bool:
    """Whether some process works in a folder."""
    return any(is_locked(folder, name) for name in _LOCKS)


def is_known(folder: str, stage: str) -> bool:
    """Whether a work folder has outcomes of a stage, or had some."""
    return Path(folder, _SCRATCH, FOLDER, stage).is_dir()


def refuse_foreign(folder: str) -> None:
    """Refuse early a folder that cannot be a work folder; makes nothing.

    Raises RunError if it is a file, has files of others, or was made by another version.
    """
    root = Path(folder)
    try:
        if root.exists():
            _is_marked(root)
    except OSError as error:
        raise RunError(f"{root} cannot be read: {error.strerror or error}. Give another work folder") from error


def _holder(lock: Path) -> str:
    """The process that holds a lock, as written in it."""
    try:
        return lock.read_text(errors="replace").strip() or "by another process"
    except OSError:
        return "by another process"


def is_locked(folder: str, lock: str) -> bool:
    """Whether a process of this machine, or of one that shares the folder's locks, has locked a file there."""
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
    """Refuse a folder with files of others, or of another format; mark it as ours."""
    if not _is_marked(root):
        LocalStorage(root=root).put(_MARK, (json.dumps({"format": _FORMAT}) + "\n").encode())


def _is_marked(root: Path) -> bool:
    """Whether a folder is ours already; raises `RunError` for one with files of others, or of another format."""
    mark = root / _MARK
    if mark.is_file():
        with contextlib.suppress(ValueError):  # cut off, or full of zeros, after a loss of power
            found = json.loads(mark.read_bytes())
            kind = found.get("format") if isinstance(found, dict) else None
            if kind == _FORMAT:
                return True
            raise RunError(f"{root} was made by another version (format {kind!r}): remove it, or give another folder")
    left = sorted(entry.name for entry in root.iterdir() if entry.name not in _BESIDE)
    if left and not (root / _SCRATCH / ATTEMPTS).is_dir():
        raise RunError(f"{root} holds {left[0]} and is no work folder: give a new or empty one")
    return False
