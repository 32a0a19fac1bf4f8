"""Folders that several processes make side by side, and those that killed processes left."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

_NAME = re.compile(r"\.?[0-9a-f]{32}")


@contextlib.contextmanager
def locked_folder(parent: Path) -> Iterator[Path]:
    """A new folder in `parent`, locked until the block ends; then removed, and `parent` with it where it is empty.

    On a file system without locks the folder is made all the same, and no other folder is removed there. `parent` is a
    folder for nothing else; it is made where it does not exist.
    """
    folder, handle = _made(parent)
    try:
        yield folder
    finally:
        # renamed first, so that no late task finds it and fills it again
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
    """A folder and the handle that locks it."""
    while True:
        folder = parent / uuid4().hex
        folder.mkdir(parents=True)
        try:
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except FileNotFoundError:
            continue  # removed as abandoned before it was locked
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        if folder.is_dir():
            return folder, handle
        os.close(handle)


def remove_abandoned(parent: Path) -> list[str]:
    """Remove the folders of `locked_folder` in `parent` that no living process locks; their names."""
    removed = []
    found = parent.iterdir() if parent.is_dir() else ()
    for folder in sorted(path for path in found if _NAME.fullmatch(path.name)):  # other folders there are not ours
        with contextlib.suppress(OSError):
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder)
                removed.append(folder.name)
            finally:
                os.close(handle)
    return removed
