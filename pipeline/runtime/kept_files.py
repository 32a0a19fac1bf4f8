"""Files that earlier runs left in scratch: checked once, before the tasks of this run read them.

A loss of power can leave a file cut off, full of zeros or missing, although its task was done. An outcome has its own
checksums (`outcomes.py`). The other files of a task are checked against what its brief says of them, and only where a
task is about to read them: a run that changes little looks at little. What this run writes itself is not checked.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic

from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.monitoring.progress import Progress
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import (
    Brief,
    DamagedError,
    Files,
    OutcomeTask,
    Place,
    Task,
    all_there,
    brief_of,
    check_outcome,
    run_and_store,
)

_CHECKS_PER_TASK = 16
_NAMED = 3
"""Damaged results that a warning names."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Promise(Generic[Task, Brief]):
    """Files that an earlier run left in a folder."""

    folder: str
    """The folder in scratch."""
    work: OutcomeTask[Task, Any, Brief]
    """The task that left them, and its outcome; run again, it leaves the same."""
    files: Files[Task, Brief]
    """How they are checked."""

    @property
    def check(self) -> Check[Task, Brief]:
        """What a worker needs to check them."""
        return Check(folder=self.folder, work=self.work, intact=self.files.intact)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check(Generic[Task, Brief]):
    """A check of what an earlier run left in a folder."""

    folder: str
    """The folder in scratch."""
    work: OutcomeTask[Task, Any, Brief]
    """The task that left it."""
    intact: Callable[[Task, Brief, str], bool]
    """As in `Files`."""

    def holds(self) -> bool:
        """Whether outcome and files are as the task left them; raises RunCancelledError if the run is over."""
        work = self.work
        work.scratch.check_cancelled()
        try:
            check_outcome(work.scratch, work.place)
            return self.intact(work.task, brief_of(work.scratch, work.place), self.folder)
        except Exception:  # noqa: BLE001 - whatever goes wrong while a damaged file is read, its task runs again
            work.scratch.check_cancelled()
            return False


def damaged_among(checks: tuple[Check[Any, Any], ...]) -> list[Place]:
    """The outcomes of those checks that fail; a task. Raises RunCancelledError if the run is over."""
    return [check.work.place for check in checks if not check.holds()]


class KeptFiles:
    """What earlier runs left and this one has not checked yet, by folder."""

    def __init__(self, scratch: Scratch, executor: Executor) -> None:
        self._scratch, self._executor = scratch, executor
        self._promises: dict[str, dict[Place, Promise[Any, Any]]] = {}
        self._stages: dict[str, None] = {}

    def found(
        self, works: Mapping[Place, OutcomeTask[Task, Any, Brief]], files: Files[Task, Brief], progress: Progress
    ) -> dict[Place, Brief]:
        """The briefs of the outcomes that earlier runs stored; damaged ones are removed."""
        found: dict[Place, Brief] = {}
        damaged: list[Place] = []
        for place in works:
            if self._scratch.has(place.name):
                try:
                    found[place] = brief_of(self._scratch, place)
                    if files.results:
                        check_outcome(self._scratch, place)
                except DamagedError:
                    damaged.append(place)
        if files.at_once:
            promises = [Promise(folder="", work=works[place], files=files) for place in found]
            damaged += self._damaged(promises, progress)
        for place in damaged:
            found.pop(place, None)
        self._forget(damaged, progress)
        for place, brief in found.items():
            self._add(works[place], brief, files)
        return found

    def _add(self, work: OutcomeTask[Task, Any, Brief], brief: Brief, files: Files[Task, Brief]) -> None:
        """Add what a task left; stages come in the order of the run."""
        self._stages[work.place.stage] = None
        left = dict.fromkeys(files.leaves(work.task, brief), files)
        # its outcome, which has checksums of its own, lies where tasks that read it look
        left.setdefault(work.place.folder, dataclasses.replace(files, intact=all_there))
        for folder, how in left.items():
            promise = Promise(folder=folder, work=work, files=how)
            self._promises.setdefault(folder, {})[work.place] = promise

    def check(self, folders: Iterable[str], progress: Progress) -> None:
        """Check what earlier runs left in some folders of scratch, once per run; what is damaged is made again."""
        promises = self._take(folders)
        damaged: dict[Place, Promise[Any, Any]] = {}
        while promises:
            by_place = {promise.work.place: promise for promise in promises}
            new = {place: by_place[place] for place in self._damaged(promises, progress)}
            self._forget(new, progress)
            damaged |= new
            # a task that runs again reads the files of earlier stages, which may be damaged, too
            promises = self._take(
                folder for promise in new.values() for folder in promise.files.reads(promise.work.task)
            )
        for works in self._in_order(damaged.values()):
            running = self._executor.map(works[0].stage, run_and_store, works, progress.watch)
            with contextlib.closing(running):
                for measured in running:
                    progress.measured(measured)
        self._made(damaged)

    def _take(self, folders: Iterable[str]) -> list[Promise[Any, Any]]:
        """What is in some folders; it counts as checked from now on."""
        if not self._promises:
            return []
        return [promise for folder in set(folders) for promise in self._promises.pop(folder, {}).values()]

    def _damaged(self, promises: Sequence[Promise[Any, Any]], progress: Progress) -> list[Place]:
        """The outcomes of those promises that do not hold."""
        checks = [promise.check for promise in promises]
        groups = [tuple(checks[k : k + _CHECKS_PER_TASK]) for k in range(0, len(checks), _CHECKS_PER_TASK)]
        if not groups:
            return []
        checking = self._executor.map("check", damaged_among, groups, progress.watch)
        with contextlib.closing(checking) as running:
            return [place for measured in running for place in measured.result]

    def _forget(self, damaged: Collection[Place], progress: Progress) -> None:
        """Remove damaged outcomes, with a warning."""
        for place in damaged:
            Path(self._scratch.root, place.name).unlink(missing_ok=True)
        if damaged:
            names = sorted({f"{place.stage}/{place.unit}" for place in damaged})
            named = ", ".join(names[:_NAMED]) + (" …" if len(names) > _NAMED else "")
            progress.warn("check", f"{len(damaged)} stored results were damaged and are made again: {named}")

    def _in_order(self, promises: Iterable[Promise[Any, Any]]) -> list[list[OutcomeTask[Any, Any, Any]]]:
        """The tasks of some promises stage by stage, since those of a stage read what earlier stages left."""
        works = {promise.work.place: promise.work for promise in promises}
        stages = [[work for place, work in works.items() if place.stage == stage] for stage in self._stages]
        return [stage for stage in stages if stage]

    def _made(self, places: Iterable[Place]) -> None:
        """Count all files of some outcomes as checked, since this run made them."""
        gone = set(places)
        for promises in self._promises.values():
            for place in gone & promises.keys():
                del promises[place]
