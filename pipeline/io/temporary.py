"""Folders for temporary files that do not outlive their process for long, however it ends.

A folder is locked by the process that made it, by a lock of the system, which ends with the process. Whenever another
folder is made, folders that no one has locked are removed: those of processes that were killed.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

_NAME = "gablework-temporary-"
"""Begins the name of a folder that is locked, or left."""
_NEW = ".gablework-"
"""Begins the name of one that is not locked yet."""


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """A folder in the one for temporary files (`TMPDIR`), until the block ends; first, left ones are removed there.

    Raises OSError if it cannot be made.
    """
    remove_left_folders()
    # nothing looks for a folder of this name before it is locked
    made = Path(tempfile.mkdtemp(prefix=_NEW))
    handle = os.open(made, os.O_RDONLY)
    try:
        # where a file system has no locks, none is ever taken for left
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        folder = made.rename(made.with_name(_NAME + made.name.removeprefix(_NEW)))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(handle)


def remove_left_folders() -> list[Path]:
    """Remove this user's temporary folders whose processes were killed, and return them."""
    removed = []
    for folder in Path(tempfile.gettempdir()).glob(f"{_NAME}*"):
        try:
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError:  # it went meanwhile, or is another user's
            continue
        try:
            if os.fstat(handle).st_uid == os.geteuid():
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
                removed.append(folder)
        except OSError:  # its process is alive
            continue
        finally:
            os.close(handle)
    return removed
