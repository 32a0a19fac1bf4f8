"""Folders locked by the process that works in them: scratch that several processes make side by side, and results.

A killed process cannot clean up. It locks its folder by a lock of the system, which ends with the process, however it
ends. The next process can then distinguish an abandoned folder from one in use.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
from collections.abc import Callable, Iterator

from pipeline.errors import FolderLostError, RunError
from pipeline.io.locations import is_url


@contextlib.contextmanager
def locked_results(run_dir: str) -> Iterator[Callable[[], None]]:
    """Lock a run directory while it is written, so that no other run on this file system writes it too.

    The lock needs no file in it. Object stores, and file systems that cannot lock folders, are not locked. Yields a
    check that raises FolderLostError if the directory was removed or replaced meanwhile: what is written later makes it
    again, without what it held. Raises RunError if another run has locked the directory.
    """
    if is_url(run_dir):
        yield lambda: None
        return
    handle = os.open(run_dir, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(f"{run_dir} is being written by another run: wait for it, or give another --out") from None
        except OSError:
            pass  # NFS locks files alone
        yield functools.partial(_check_same, run_dir, handle)
    finally:
        os.close(handle)


def _check_same(folder: str, handle: int) -> None:
    """Raise FolderLostError if a path leads elsewhere than when the folder was opened."""
    try:
        if os.path.samestat(os.stat(folder), os.fstat(handle)):  # noqa: PTH116 - not worth a path
            return
    except (FileNotFoundError, NotADirectoryError):
        pass
    raise FolderLostError(
        f"{folder} was removed while the run was going, with what had been written: leave it in place until the run "
        "ends. Run again"
    )
