"""What a run learns about itself while it runs: progress, timings, peak memory, warnings."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal

from pipeline.errors import RunCancelledError
from pipeline.runtime.monitoring.measurement import Measured, Part, traces_are_wanted


def span(name: str, *, first: bool = False, **facts: Any) -> contextlib.AbstractContextManager[Any]:
    """A span around a block while traces are on; the `first` one only if there is none around it."""
    if not traces_are_wanted():
        return contextlib.nullcontext()
    from pipeline.runtime.monitoring import tracing

    return contextlib.nullcontext() if first and tracing.current() else tracing.span(name, **facts)


class Progress:
    """Timings, peak memory and warnings of a run; the listener gets an event for each of them.

    Parameters
    ----------
    listener : callable
        Gets the events.
    watch : Watch, optional
        Passed to the executor with every stage.
    """

    def __init__(self, listener: Listener, watch: Watch | None = None) -> None:
        self.listener = listener
        self.watch = watch or Watch(listener=listener)
        self.timings: dict[str, float] = {}
        self.peaks: dict[str, int] = {}
        self.warnings: list[str] = []
        self.headline = ""
        """The first of the warnings, where a reader must know it before any figure."""
        self._part, self._parts, self._label = 0, 1, ""

    def part(self, number: int, parts: int, label: str) -> Progress:
        """The progress of one of several equal parts, from 0: a copy that knows what happened before.

        The events of a stage count all parts one after the other. Messages call the part by its label.
        """
        own = Progress(self.listener, self.watch)
        own.timings, own.peaks, own.warnings = dict(self.timings), dict(self.peaks), list(self.warnings)
        own.headline = self.headline
        own._part, own._parts, own._label = number, parts, label
        return own

    def tell(self, kind: EventKind, stage: str, message: str = "", **counts: Any) -> None:
        """Send an event; `counts` are the counting fields of `Event`, or its facts."""
        self.listener(Event(kind=kind, stage=stage, message=message, **counts))

    def warn(self, stage: str, message: str) -> None:
        """Store and send a warning; the same one only once."""
        if message not in self.warnings:
            self.warnings.append(message)
            self.tell("warning", stage, message)

    def warn_first(self, stage: str, message: str) -> None:
        """Store and send a warning that comes before all others, and before the figures of the run."""
        self.headline = message
        self.warnings.insert(0, message)
        self.tell("warning", stage, message, facts={"place": "first"})

    def detail(self, stage: str, message: str, **facts: str | float) -> None:
        """Send what only logs need: something about one building or task."""
        self.listener(Event(kind="detail", stage=stage, message=message, facts=facts))

    def measured(self, found: Measured[Any], parts: Callable[[], Iterable[Part]] = tuple) -> None:
        """Note the peak memory of the process that ran a task, and the spans of the task and of its parts."""
        self.peaks[found.process] = max(self.peaks.get(found.process, 0), found.peak_bytes)
        if not traces_are_wanted():
            return
        from pipeline.runtime.monitoring import tracing

        if tracing.is_on():
            name, times = "task" if found.tile is None else "tile", (found.began_s, found.began_s + found.seconds)
            facts: dict[str, Any] = {"tile": found.tile, "process": found.process, "cpu_s": round(found.cpu_s, 3)}
            task = tracing.finished(name, *times, **facts)
            for part in parts():
                tracing.finished(part.name, part.began_s, part.ended_s, below=task, error=part.error, **part.facts)

    @contextlib.contextmanager
    def stage(self, name: str, total: int, *, quiet: bool = False) -> Iterator[StageProgress]:
        """Time a stage and report how far it is; a quiet one is part of another stage and does neither."""
        started = time.perf_counter()
        stage = StageProgress(self, name, self._part * total, self._parts * total, quiet=quiet)
        if not quiet:
            self.tell("stage", name, self._label, done=stage.done, total=stage.total)
        with contextlib.nullcontext() if quiet else span(f"stage {name}", stage=name, total=total):
            yield stage
        if not quiet:
            self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - started


class StageProgress:
    """How far one stage is."""

    def __init__(self, progress: Progress, name: str, done: int, total: int, *, quiet: bool) -> None:
        self._progress = progress
        self._name = name
        self._quiet = quiet
        self.done, self.total, self.failed = done, total, 0

    def add(self, units: int, failed: int = 0, *, kept: int = 0, message: str = "") -> None:
        """Count units as done, some of which failed or were kept from an earlier run."""
        self.done += units
        self.failed += failed
        if not self._quiet:
            counts = {"done": self.done, "total": self.total, "kept": kept, "failed": self.failed}
            self._progress.tell("progress", self._name, message, **counts)


TICK_S = 0.2
"""Seconds between two checks of the cluster and of the run's cancellation."""


EventKind = Literal["run", "stage", "progress", "warning", "waiting", "detail", "finished"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened; has no object of the engine, so it can be logged, stored or sent."""

    kind: EventKind
    """Kind of the event; `waiting` means that no worker is there, `detail` is for logs: about one building or task."""
    stage: str = ""
    """The name of a stage, such as ingest or reconstruct; empty for the run as a whole."""
    done: int = 0
    """Finished units of this stage (files, tiles or candidates)."""
    total: int = 0
    """Units of this stage; 0 where unknown."""
    message: str = ""
    """One sentence of text; empty for mere progress."""
    kept: int = 0
    """Finished units taken from an earlier run; sent once, when the stage begins."""
    failed: int = 0
    """Failed units, which are among the finished ones."""
    facts: Mapping[str, str | float] = dataclasses.field(default_factory=dict)
    """What a detail is about: tile, building, reason, seconds. A warning that comes before all others has a place."""


Listener = Callable[[Event], None]


def ignore(event: Event) -> None:
    """Listen to nothing."""
    del event


def never() -> bool:
    """Never cancel."""
    return False


def nothing() -> None:
    """Stop nothing, miss nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Watch:
    """What an executor polls, calls and sends events to while the tasks of a run are in progress."""

    cancelled: Callable[[], bool] = never
    """Whether the run was cancelled; polled several times a second."""
    check_scratch: Callable[[], None] = nothing
    """Raises RunOverError where this process misses the run's scratch, too, when a task did."""
    stop: Callable[[], None] = nothing
    """Asks the tasks in flight to end, because their results are not needed any more."""
    listener: Listener = ignore
    """Gets events that do not come with a result: workers are missing or back."""

    def check_cancelled(self) -> None:
        """Raise RunCancelledError if the run was cancelled."""
        if self.cancelled():
            raise RunCancelledError("the run was cancelled")
