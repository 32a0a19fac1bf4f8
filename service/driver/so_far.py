"""Shows the buildings of a running job to clients, by a process that runs only while clients read."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from service.driver.leased_job import LOG, LeasedJob

_LOOK_S = 0.25
"""Seconds between looks at whether clients read."""
_AGAIN_S = 10.0
"""Seconds until a process that ended on its own is started again."""


@contextlib.contextmanager
def shown_while_watched(held: LeasedJob, run_dir: Path, folder: Path) -> Iterator[None]:
    """Show the buildings of a run while the block runs it.

    Nothing happens before a client reads; then a process is started, and it ends when no client has read for some time,
    or the block ends.

    Parameters
    ----------
    held : LeasedJob
        The job; knows whether clients read.
    run_dir : Path
        The run directory.
    folder : Path
        What readers see.
    """
    over = threading.Event()
    watching = threading.Thread(
        target=_watch, args=(held, run_dir, folder, over), name=f"so-far-{held.job.job_id[:8]}", daemon=True
    )
    watching.start()
    try:
        yield
    finally:
        over.set()
        watching.join()


def _watch(held: LeasedJob, run_dir: Path, folder: Path, over: threading.Event) -> None:
    process: subprocess.Popen[bytes] | None = None
    not_before_s = 0.0
    try:
        while not over.wait(_LOOK_S):
            if process is not None and process.poll() is not None:
                LOG.warning("the buildings so far are not shown: their process ended by itself", extra=held.facts)
                process, not_before_s = None, time.monotonic() + _AGAIN_S
            if held.is_watched and process is None and time.monotonic() >= not_before_s:
                process = _start(run_dir, folder)
            elif process is not None and not held.is_watched:
                _end(process)
                process = None
    except OSError as error:
        LOG.warning("the buildings so far are not shown: %s", error, extra=held.facts)
    finally:
        if process is not None:
            _end(process)


def _start(run_dir: Path, folder: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "service.driver.so_far_process", str(run_dir), str(folder)]
    return subprocess.Popen(command, stdin=subprocess.PIPE)  # noqa: S603 - our own program


def _end(process: subprocess.Popen[bytes]) -> None:
    """End it at once: the run need not wait for it, and what it has shown stays whole."""
    assert process.stdin is not None
    process.kill()
    process.wait()
    process.stdin.close()
