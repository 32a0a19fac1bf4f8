"""CPU time and peak memory of a tree of processes by role, measured from outside.

It looks four times per second. The last look at a process that dies is up to a quarter of a second old, so its CPU time
comes out a little too small.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

import psutil

from pipeline.runtime.cluster import worker_setup
from pipeline.runtime.isolation import child_main, fork_server

LOOK_S = 0.25
DRIVER, WORKER, CHILD, OTHER = "driver", "worker", "child", "other"
FORKING = "process server"
ROLES = (DRIVER, FORKING, WORKER, CHILD, OTHER)
_NAMES = {child_main.NAME: CHILD, fork_server.NAME: FORKING, worker_setup.NAME: WORKER}


@dataclasses.dataclass(kw_only=True)
class Seen:
    """What was seen of one process."""

    pid: int
    role: str
    cpu_s: float = 0.0
    """User and system time, without children."""
    peak_bytes: int = 0
    """Largest resident size, VmHWM."""


def role_of(name: str, command: Sequence[str], roots: dict[int, str], pid: int) -> str:
    """What a process is, by its name, its command line and its id.

    >>> role_of("gablework-child", ["python", "-P", "-m", "pipeline.runtime.isolation.fork_server", "7"], {}, 8)
    'child'
    """
    if pid in roots:
        return roots[pid]
    if name in _NAMES:
        return _NAMES[name]
    return WORKER if "spawn_main" in " ".join(command) else OTHER


class Watcher:
    """Looks at some processes, given with their roles, and all below them; a context manager.

    Every `kill_every_s` seconds (0: never) a worker is killed, in turns, as soon as `may_kill` says so.
    """

    def __init__(
        self, roots: dict[int, str], kill_every_s: float = 0.0, may_kill: Callable[[], bool] = lambda: True
    ) -> None:
        self._roots = roots
        self._kill_every_s = kill_every_s
        self._may_kill = may_kill
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look_on, daemon=True)
        self._turn = 0
        self.seen: dict[int, Seen] = {}
        """All processes, by id."""
        self.killed: list[int] = []
        """Workers that were killed."""
        self.load: list[float] = []
        """The machine's load over one minute, at every look."""

    def __enter__(self) -> Self:
        """Begin to look."""
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Look no more."""
        self._over.set()
        self._thread.join()

    def _look_on(self) -> None:
        kill_at = time.monotonic() + self._kill_every_s
        while not self._over.wait(LOOK_S):
            for root in self._roots:
                with contextlib.suppress(psutil.Error):
                    top = psutil.Process(root)
                    for process in (top, *top.children(recursive=True)):
                        self._look_at(process)
            self.load.append(os.getloadavg()[0])
            if self._kill_every_s and time.monotonic() >= kill_at and self._may_kill():
                kill_at = time.monotonic() + self._kill_every_s
                self._kill_one()

    def _look_at(self, process: psutil.Process) -> None:
        with contextlib.suppress(psutil.Error, OSError, ValueError):
            seen = self.seen.get(process.pid)
            # a process gets its name when it has loaded
            role = role_of(process.name(), process.cmdline(), self._roots, process.pid)
            if seen is None:
                seen = self.seen[process.pid] = Seen(pid=process.pid, role=role)
            seen.role = role
            times = process.cpu_times()
            seen.cpu_s = max(seen.cpu_s, times.user + times.system)
            for line in Path(f"/proc/{process.pid}/status").read_text(encoding="ascii").splitlines():
                if line.startswith("VmHWM:"):
                    seen.peak_bytes = max(seen.peak_bytes, int(line.split()[1]) * 1024)

    def _kill_one(self) -> None:
        """Kill the next worker that is there."""
        there = [pid for pid, seen in sorted(self.seen.items()) if seen.role == WORKER and psutil.pid_exists(pid)]
        if there:
            pid = there[self._turn % len(there)]
            self._turn += 1
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                self.killed.append(pid)

    def by_role(self) -> dict[str, tuple[int, float, int]]:
        """Number of processes, their CPU seconds and the largest peak in bytes, per role."""
        reported = {}
        for role in ROLES:
            own = [seen for seen in tuple(self.seen.values()) if seen.role == role]
            if own:
                reported[role] = (len(own), sum(seen.cpu_s for seen in own), max(seen.peak_bytes for seen in own))
        return reported
