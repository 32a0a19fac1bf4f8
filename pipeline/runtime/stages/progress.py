"""What a run learns about itself while it runs its stages: progress, timings, peak memory, warnings."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.monitoring.events import Event, EventKind, Listener, Watch
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Keeping, Place, keep, told_of

Task = TypeVar("Task")
Result = TypeVar("Result")
Told = TypeVar("Told")


class Progress:
    """What a run learns about itself: timings, peak memory, warnings; all of it told to the listener.

    Parameters
    ----------
    listener : callable
        Gets the events.
    watch : Watch
        Handed to the executor with every map.
    """

    def __init__(self, listener: Listener, watch: Watch | None = None) -> None:
        self._listener = listener
        self.watch = watch or Watch(listener=listener)
        self.timings: dict[str, float] = {}
        self.peaks: dict[str, int] = {}
        self.warnings: list[str] = []
        self._part, self._parts, self._label = 0, 1, ""

    def part(self, number: int, parts: int, label: str) -> Progress:
        """The progress of one of several equal parts of what follows: a copy that knows what was before.

        Parameters
        ----------
        number : int
            Which part, from 0.
        parts : int
            Of how many; done and total of a stage count all of them, one after the other.
        label : str
            What messages call it.
        """
        own = Progress(self._listener, self.watch)
        own.timings, own.peaks, own.warnings = dict(self.timings), dict(self.peaks), list(self.warnings)
        own._part, own._parts, own._label = number, parts, label
        return own

    def tell(
        self,
        kind: EventKind,
        stage: str,
        message: str = "",
        done: int = 0,
        total: int = 0,
        kept: int = 0,
        failed: int = 0,
    ) -> None:
        """Send an event."""
        self._listener(Event(kind=kind, stage=stage, done=done, total=total, message=message, kept=kept, failed=failed))

    def warn(self, stage: str, message: str) -> None:
        """Keep and send a warning."""
        if message not in self.warnings:
            self.warnings.append(message)
            self.tell("warning", stage, message)

    def stage(
        self,
        executor: Executor,
        name: str,
        function: Callable[[Task], Result],
        tasks: Sequence[Task],
        weight: Callable[[Result], int] = lambda _: 1,
        total: int | None = None,
    ) -> list[Result]:
        """Run a stage's tasks and report its progress in units of `weight`."""
        started = time.perf_counter()
        whole = len(tasks) if total is None else total
        done, all_parts = self._part * whole, self._parts * whole
        self.tell("stage", name, self._label, done=done, total=all_parts)
        results = []
        # closed at once where the listener raises, so that no task goes on for nobody
        with contextlib.closing(executor.map(name, function, tasks, self.watch)) as running:
            for measured in running:
                results.append(measured.result)
                self.peaks[measured.process] = max(self.peaks.get(measured.process, 0), measured.peak_bytes)
                done += weight(measured.result)
                self.tell("progress", name, done=done, total=all_parts)
        self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - started
        return results

    def kept(
        self,
        executor: Executor,
        name: str,
        function: Callable[[Task], Result],
        tasks: Mapping[Place, Task],
        scratch: Scratch,
        told: Callable[[Result], Told],
        weight: Callable[[Told], int] = lambda _: 1,
        total: int | None = None,
        failures: Callable[[Told], int] = lambda _: 0,
        landed_here: Callable[[Told], None] = lambda _: None,
        *,
        quiet: bool = False,
    ) -> dict[Place, Told]:
        """Run those of a stage's tasks whose outcomes are not kept yet; what all of them tell, in the tasks' order.

        Parameters
        ----------
        executor, name, function
            As of `stage`.
        tasks : mapping
            By the place of each one's outcome.
        scratch : Scratch
            Where outcomes are kept.
        told : callable
            What of a result travels to the driver.
        weight : callable
            Progress of a task, by what it tells.
        total : int, optional
            Progress of all; the number of tasks by default.
        failures : callable
            How much of a task's progress failed, by what it tells.
        landed_here : callable
            Gets what those tasks tell that ran now.
        quiet : bool
            Part of another stage: no event and no timing of its own.
        """
        started = time.perf_counter()
        whole = len(tasks) if total is None else total
        done, all_parts = self._part * whole, self._parts * whole
        if not quiet:
            self.tell("stage", name, self._label, done=done, total=all_parts)
        found: dict[Place, Told] = {}
        lost = 0
        for place in tasks:
            if scratch.has(place.name):
                found[place] = told_of(scratch, place)
                done += weight(found[place])
        if found and not quiet:
            kept = sum(map(weight, found.values()))
            lost = sum(map(failures, found.values()))
            message = f"{len(found)} of {len(tasks)} tasks were done before"
            self.tell("progress", name, message, done=done, total=all_parts, kept=kept, failed=lost)
        todo = [
            Keeping(function=function, task=task, place=place, scratch=scratch, told=told, stage=name)
            for place, task in tasks.items()
            if place not in found
        ]
        # closed at once where the listener raises, so that no task goes on for nobody
        with contextlib.closing(executor.map(name, keep, todo, self.watch)) as running:
            for measured in running:
                landed = measured.result
                found[landed.place] = landed.told
                landed_here(landed.told)
                self.peaks[measured.process] = max(self.peaks.get(measured.process, 0), measured.peak_bytes)
                done += weight(landed.told)
                lost += failures(landed.told)
                if not quiet:
                    self.tell("progress", name, done=done, total=all_parts, failed=lost)
        if not quiet:
            self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - started
        return {place: found[place] for place in tasks}
