"""Files that earlier runs left in scratch: checked once, before the tasks of this run read them.

A loss of power can leave a file cut off, full of zeros or missing, although its task was done. An outcome has its own
checksums (`outcomes.py`). The other files of a task are checked against what its brief says of them, and only where a
task is about to read them: a run that changes little looks at little. What this run writes itself is not checked.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, Generic

from pipeline.runtime.scratch.outcomes import Brief, OutcomeTask, Place, Task, brief_of, check_outcome


def _nothing(*_: object) -> tuple[str, ...]:
    return ()


def _all_there(*_: object) -> bool:
    return True


@dataclasses.dataclass(frozen=True, kw_only=True)
class Files(Generic[Task, Brief]):
    """What the tasks of a stage read and leave in scratch, by folders there; the functions see one task at a time."""

    reads: Callable[[Task], Iterable[str]] = _nothing
    """Folders with files of earlier stages that a task reads."""
    leaves: Callable[[Task, Brief], Iterable[str]] = _nothing
    """Folders in which later stages read what a task left; that of its outcome need not be named."""
    intact: Callable[[Task, Brief, str], bool] = _all_there
    """Whether the files in one of these folders are as the task left them, by its brief. Runs in a worker."""
    results: bool = False
    """Whether every run reads the results of all tasks: outcomes of earlier runs are then checked to their end."""
    at_once: bool = False
    """Whether the files of earlier runs are checked when the stage begins, since every run relies on all of them."""


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

    def __init__(self) -> None:
        self._promises: dict[str, dict[Place, Promise[Any, Any]]] = {}
        self._stages: dict[str, None] = {}

    def __bool__(self) -> bool:
        """Whether anything is left to check."""
        return bool(self._promises)

    def add(self, work: OutcomeTask[Task, Any, Brief], brief: Brief, files: Files[Task, Brief]) -> None:
        """Add what a task left; stages come in the order of the run."""
        self._stages[work.place.stage] = None
        left = dict.fromkeys(files.leaves(work.task, brief), files)
        # its outcome, which has checksums of its own, lies where tasks that read it look
        left.setdefault(work.place.folder, dataclasses.replace(files, intact=_all_there))
        for folder, how in left.items():
            promise = Promise(folder=folder, work=work, files=how)
            self._promises.setdefault(folder, {})[work.place] = promise

    def take(self, folders: Iterable[str]) -> list[Promise[Any, Any]]:
        """What is in some folders; it counts as checked from now on."""
        return [promise for folder in set(folders) for promise in self._promises.pop(folder, {}).values()]

    def in_order(self, promises: Iterable[Promise[Any, Any]]) -> list[list[OutcomeTask[Any, Any, Any]]]:
        """The tasks of some promises stage by stage, since those of a stage read what earlier stages left."""
        works = {promise.work.place: promise.work for promise in promises}
        stages = [[work for place, work in works.items() if place.stage == stage] for stage in self._stages]
        return [stage for stage in stages if stage]

    def made(self, places: Iterable[Place]) -> None:
        """Count all files of some outcomes as checked, since this run made them."""
        gone = set(places)
        for promises in self._promises.values():
            for place in gone & promises.keys():
                del promises[place]
