"""Folders that are held by the process that works in them: scratch that several make side by side, and results.

A process that is killed cannot clean up. It holds its folder by a lock of the system, which ends with the process
whatever ended it, so whoever comes next can tell a folder that nobody holds from one that is in use.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

from pipeline.errors import RunError
from pipeline.io.urls import is_url

_NAME = re.compile(r"\.?[0-9a-f]{32}")


@contextlib.contextmanager
def locked_folder(parent: Path) -> Iterator[Path]:
    """A new folder in `parent`, held until the block ends; removed then, and `parent` with it where it is empty.

    Where the file system knows no locks the folder is made all the same, and nobody else's is removed there.

    Parameters
    ----------
    parent : Path
        A folder for nothing else; made where it is not there.

    Yields
    ------
    Path
        The folder.
    """
    folder, handle = _made(parent)
    try:
        yield folder
    finally:
        # by another name first, so that no late task finds it and fills it again
        doomed = folder.with_name(f".{folder.name}")
        try:
            folder.rename(doomed)
        except OSError:
            doomed = folder
        shutil.rmtree(doomed, ignore_errors=True)
        os.close(handle)
        with contextlib.suppress(OSError):
            parent.rmdir()


def _made(parent: Path) -> tuple[Path, int]:
    """A folder and the handle that holds it."""
    while True:
        folder = parent / uuid4().hex
        folder.mkdir(parents=True)
        try:
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except FileNotFoundError:
            continue  # taken for an abandoned one before it was held
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        if folder.is_dir():
            return folder, handle
        os.close(handle)


@contextlib.contextmanager
def locked_results(run_dir: str) -> Iterator[None]:
    """Hold a run directory while it is written, so that no other run on this file system writes it, too.

    Nothing lies in it for that. In an object store, and where the file system cannot lock folders, nothing is held.

    Parameters
    ----------
    run_dir : str
        The folder, which is there, or a URL.

    Raises
    ------
    RunError
        Another run holds it.
    """
    if is_url(run_dir):
        yield
        return
    handle = os.open(run_dir, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(f"{run_dir} is being written by another run: wait for it, or give another --out") from None
        except OSError:
            pass  # NFS locks files alone
        yield
    finally:
        os.close(handle)


def remove_abandoned(parent: Path) -> list[str]:
    """Remove those folders of `locked_folder` that no living process holds; their names.

    Parameters
    ----------
    parent : Path
        Where `locked_folder` makes them; need not be there.
    """
    removed = []
    found = parent.iterdir() if parent.is_dir() else ()
    for folder in sorted(path for path in found if _NAME.fullmatch(path.name)):  # what else lies there is not ours
        with contextlib.suppress(OSError):
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder)
                removed.append(folder.name)
            finally:
                os.close(handle)
    return removed
