"""The fork server of Dask's workers on this machine: Python's own forkserver, which Dask can use."""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from multiprocessing import forkserver
from typing import Any

from pipeline.runtime.isolation.forked_child import can_fork, read_at_start
from pipeline.runtime.isolation.spawned_child import environment_with_this_package, run_in_starter_thread
from pipeline.runtime.isolation.start_up import WITHOUT_THREADS

_PRELOADED = ("distributed.nanny", "pipeline.runtime.cluster.worker_preload")
_SETTINGS = {"distributed.worker.multiprocessing-method": "forkserver"}
_SAFE_PATH = {"PYTHONSAFEPATH": "1"}
"""Nothing is imported from the working directory."""
_END_S = 2.0
_changing = threading.Lock()
_users = 0
_was_used = False
_environment: Mapping[str, str] | None = None


def start_early() -> None:
    """Start a fork server if there is none: it imports while this process still plans.

    What stands in the way is said when the server is needed.
    """
    if can_fork():
        with _changing, contextlib.suppress(OSError):
            run_in_starter_thread(_start)


@contextlib.contextmanager
def forked_workers() -> Iterator[Mapping[str, Any]]:
    """Start a fork server; yields Dask's settings for forking workers from it. A context manager.

    For processes that have imported Dask. There is one server per process. It stays for the next cluster, unless the
    environment changes in between. If this system cannot fork, there are no settings and workers are spawned.
    """
    global _users, _was_used  # noqa: PLW0603 - one server per process
    if not can_fork():
        yield {}
        return
    # Dask would otherwise import all optional packages and replace the server's list by its own
    vars(sys.modules["distributed.utils"])["_forkserver_preload_set"] = True
    with _changing:
        run_in_starter_thread(_start)
        _users += 1
        _was_used = True
    try:
        yield _SETTINGS
    finally:
        with _changing:
            _users -= 1


def _start() -> None:
    """Start the server if there is none, or replace one with another environment and no workers."""
    global _environment  # noqa: PLW0603 - as above
    now = read_at_start(os.environ)
    if now != _environment and not _users:
        _stop()
        _environment = now
    multiprocessing.set_forkserver_preload(list(_PRELOADED))
    before = dict(os.environ)
    special = {"PYTHONPATH": environment_with_this_package()["PYTHONPATH"], **WITHOUT_THREADS, **_SAFE_PATH}
    # the server inherits the environment of this process: there is no other way to set it
    os.environ.update(special)
    try:
        forkserver.ensure_running()
    finally:
        for name in special:
            if name in before:
                os.environ[name] = before[name]
            else:
                del os.environ[name]


def _stop() -> None:
    """End the server, if there is one; by itself if all workers are gone, which counts their processor time.

    One that never had workers still imports, and is not waited for. Python has no public function for it.
    """
    global _was_used  # noqa: PLW0603 - as above
    server: Any = forkserver._forkserver  # noqa: SLF001
    pid = server._forkserver_pid  # noqa: SLF001
    if pid is None:
        return
    os.close(server._forkserver_alive_fd)  # noqa: SLF001
    server._forkserver_alive_fd = server._forkserver_address = server._forkserver_pid = None  # noqa: SLF001
    pidfd = os.pidfd_open(pid)
    try:
        if not select.select([pidfd], [], [], _END_S if _was_used else 0.0)[0]:
            os.kill(pid, signal.SIGKILL)
        _was_used = False
    finally:
        os.close(pidfd)
    os.waitpid(pid, 0)


@atexit.register
def _close() -> None:
    with _changing:
        _stop()
