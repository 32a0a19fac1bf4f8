"""Running and measuring a task, in any process."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import math
import os
import resource
import socket
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

from pipeline.errors import GableworkError, RunCancelledError
from pipeline.runtime.monitoring.logs import LOG, about, facts_of_task

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measured(Generic[Result]):
    """A result with time and memory of its task."""

    result: Result
    seconds: float
    cpu_s: float
    """CPU seconds of the task's own thread and of its child processes."""
    began_s: float
    """Start time, in seconds since 1970 by this machine's clock."""
    process: str
    """host:pid."""
    peak_bytes: int
    """Largest resident size of the process so far."""
    tile: str | None = None
    """The tile of the task, if it has one."""


class _Account(threading.local):
    """CPU time of child processes for the task of this thread."""

    cpu_s: float = 0.0


_spent_by_children = _Account()


def charge(cpu_s: float) -> None:
    """Add CPU seconds of a child process to the task of this thread."""
    _spent_by_children.cpu_s += cpu_s


def peak_of_process() -> tuple[str, int]:
    """The process as host:pid, and its largest resident size so far in bytes."""
    return f"{socket.gethostname()}:{os.getpid()}", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def measure(function: Callable[[Task], Result], task: Task, stage: str = "") -> Measured[Result]:
    """Run, count and measure one task; log lines during it have its ids."""
    _spent_by_children.cpu_s = 0.0
    began_s, started, cpu_s = time.time(), time.perf_counter(), time.thread_time()
    outcome = "failed"
    TALLIES.begin()
    facts = facts_of_task(task)
    try:
        with about(stage=stage, **facts):
            try:
                result = function(task)
            except RunCancelledError:
                outcome = "cancelled"
                raise
            except GableworkError as error:
                LOG.error("the task failed: %s", error)
                raise
            except Exception:
                LOG.exception("the task failed")
                raise
        outcome = "done"
        cpu_s = time.thread_time() - cpu_s + _spent_by_children.cpu_s
    finally:
        seconds = time.perf_counter() - started
        TALLIES.end(stage, outcome, seconds)
    process, peak_bytes = peak_of_process()
    tile = facts["tile"]
    return Measured(
        result=result,
        seconds=seconds,
        cpu_s=cpu_s,
        began_s=began_s,
        process=process,
        peak_bytes=peak_bytes,
        tile=None if tile is None else str(tile),
    )


_CGROUP = Path("/sys/fs/cgroup")


def cores(cgroup: Path = _CGROUP) -> int:
    """Cores that this process may use, at least one.

    The folder `cgroup` has the limits of the control group (version 2); a quota of two and a half cores counts as two.
    """
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, _, period = _text(cgroup / "cpu.max").partition(" ")
    if quota.isdigit() and period.isdigit() and int(period):
        count = min(count, math.floor(int(quota) / int(period)))
    return max(1, count)


def memory_bytes(cgroup: Path = _CGROUP) -> int:
    """Memory that this process may use: the machine's, or the limit of its control group."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limits = [_text(cgroup / name) for name in ("memory.max", "memory.high", "memory/memory.limit_in_bytes")]
    return min([total, *(int(limit) for limit in limits if limit.isdigit() and int(limit))])


def _text(path: Path) -> str:
    """The text of a system file; empty if it does not exist."""
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError:
        return ""


class Tallies:
    """Counts of one process; all except `in_flight` and `busy` only grow."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.sent: Counter[str] = Counter()
        """Tasks sent to a cluster, by stage; a task that is sent again counts again."""
        self.sent_bytes: Counter[str] = Counter()
        """Their sizes in bytes, by stage."""
        self.in_flight: Counter[str] = Counter()
        """Tasks on a cluster now, by stage."""
        self.landed: Counter[tuple[str, str]] = Counter()
        """Tasks that came back, by stage and outcome: done, suspect (its workers died), sent again, taken back."""
        self.worked: Counter[tuple[str, str]] = Counter()
        """Tasks run in this process, by stage and outcome: done, failed, cancelled."""
        self.seconds: defaultdict[str, float] = defaultdict(float)
        """Their wall-clock seconds, by stage."""
        self.busy = 0
        """Tasks that run in this process now."""
        self.buildings: Counter[tuple[str, str]] = Counter()
        """Buildings modelled by tasks of this process, by status and reason."""

    def send(self, stage: str, tasks: int, size_bytes: int) -> None:
        """Count tasks sent to the cluster together."""
        with self._lock:
            self.sent[stage] += tasks
            self.sent_bytes[stage] += size_bytes
            self.in_flight[stage] += tasks

    def land(self, stage: str, outcome: str, tasks: int) -> None:
        """Count tasks that came back from the cluster together."""
        with self._lock:
            self.in_flight[stage] -= tasks
            self.landed[stage, outcome] += tasks

    def begin(self) -> None:
        """Count the start of a task in this process."""
        with self._lock:
            self.busy += 1

    def end(self, stage: str, outcome: str, seconds: float) -> None:
        """Count the end of a task in this process."""
        with self._lock:
            self.busy -= 1
            self.worked[stage, outcome] += 1
            self.seconds[stage] += seconds

    def building(self, status: str, reason: str | None) -> None:
        """Count a modelled building."""
        with self._lock:
            self.buildings[status, reason or ""] += 1


TALLIES = Tallies()
"""Tallies of this process."""


TRACING_LOG = logging.getLogger("gablework.tracing")


ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
"""Variables that turn traces on."""


SLOW_BUILDING_S = 1.0
"""Seconds of a building from which it gets a span, unless `GABLEWORK_TRACE_BUILDING_S` has another number."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a task that gets a span of its own."""

    name: str
    """Its kind."""
    began_s: float
    ended_s: float
    """Its times in seconds since 1970."""
    error: str | None = None
    """Why it failed."""
    facts: Mapping[str, Any]
    """Its attributes."""


def traces_are_wanted() -> bool:
    """Whether a variable names a collector."""
    return any(os.environ.get(name) for name in ENDPOINTS)


@functools.cache
def slow_building_s() -> float:
    """Seconds of a building from which it gets a span of its own; a number that makes no sense costs a warning."""
    text = os.environ.get("GABLEWORK_TRACE_BUILDING_S", "")
    with contextlib.suppress(ValueError):
        seconds = float(text or SLOW_BUILDING_S)
        if seconds >= 0.0:
            return seconds
    TRACING_LOG.warning("GABLEWORK_TRACE_BUILDING_S is %r: give seconds from 0 on; %g is used", text, SLOW_BUILDING_S)
    return SLOW_BUILDING_S
