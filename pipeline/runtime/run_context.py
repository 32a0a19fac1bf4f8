"""What one run has while it runs, and the one way to begin and end it."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from pipeline.errors import FolderLostError, RunOverError
from pipeline.runtime.cluster.serial_executor import Executor, SerialExecutor
from pipeline.runtime.isolation.process_limits import IsolationLimits
from pipeline.runtime.monitoring.logs import about
from pipeline.runtime.monitoring.measurement import Part
from pipeline.runtime.monitoring.progress import TICK_S, Progress, Watch, never, span
from pipeline.runtime.resources import Resources
from pipeline.runtime.run_plan import Plan, check_memory
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import FOLDER as OUTCOMES
from pipeline.runtime.scratch.outcomes import Files, OutcomeTask, Place, brief_of, run_and_store

if TYPE_CHECKING:
    from pipeline.runtime.expected import Expected
    from pipeline.runtime.kept_files import KeptFiles

Task = TypeVar("Task")
Result = TypeVar("Result")
Brief = TypeVar("Brief")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProgressUnits(Generic[Brief]):
    """How the progress of a stage is counted."""

    total: int | None = None
    """Units of the whole stage; the number of its tasks by default."""
    done: Callable[[Brief], int] = lambda _: 1
    """Units of a task, by its brief."""
    failed: Callable[[Brief], int] = lambda _: 0
    """How many of them failed."""
    parts: Callable[[Brief], Iterable[Part]] = lambda _: ()
    """Parts of a task that get spans of their own in a trace."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunContext:
    """What one run has while it runs."""

    plan: Plan
    """What is read, on which lattice."""
    progress: Progress
    """Gets timings, peaks, warnings; sends events; knows whether the run was cancelled."""
    executor: Executor
    """Runs the tasks."""
    scratch: Scratch
    """Holds the intermediate results."""
    isolation: IsolationLimits | None = None
    """Limits of the child processes that model buildings; None models buildings in the workers themselves."""
    reading: IsolationLimits | None = None
    """Limits of the child processes that read inputs; None reads them in the workers themselves."""
    kept: KeptFiles | None = None
    """Files of earlier runs that no task of this one has read yet; None where scratch is new."""

    @contextlib.contextmanager
    def blaming_lost_scratch(self) -> Iterator[None]:
        """Blame what goes wrong within the block on the loss of the scratch folder where that is the cause.

        No task can know why it lost its folder: for most, the run is over. The driver knows that it is not.

        Raises
        ------
        FolderLostError
            The folder was removed, or another run took it over, and this run was not cancelled.
        """
        try:
            yield
        except FolderLostError:
            raise
        except Exception as fault:
            if self.progress.watch.cancelled():
                raise
            if not self.scratch.has("."):
                raise FolderLostError(
                    f"{self.scratch.root} was removed while the run was going: leave it in place until the run ends. "
                    "Run again"
                ) from fault
            if isinstance(fault, RunOverError):
                raise FolderLostError(
                    f"{self.scratch.root} was changed while the run was going, by another run or by removals: give "
                    "each run a folder of its own and leave it in place, then run again"
                ) from fault
            raise

    def map_stored(
        self,
        stage: str,
        function: Callable[[Task], Result],
        tasks: Mapping[Place, Task],
        brief: Callable[[Result], Brief],
        units: ProgressUnits[Brief] | None = None,
        on_new: Callable[[Brief], None] = lambda _: None,
        files: Files[Task, Brief] | None = None,
        *,
        quiet: bool = False,
    ) -> dict[Place, Brief]:
        """Run those tasks of a stage that have no stored outcome, and store theirs; the briefs of all, in order.

        Parameters
        ----------
        tasks : mapping
            By the place of each one's outcome.
        brief : callable
            The small part of a result that travels to the driver.
        units : ProgressUnits, optional
            How progress is counted; by tasks by default.
        on_new : callable
            Gets the briefs of the tasks that ran now.
        files : Files, optional
            What the tasks read and leave in scratch beside their outcomes; nothing by default.
        quiet : bool
            Part of another stage: no events and no timing of its own.
        """
        units, files = units or ProgressUnits(), files or Files()
        with self.progress.stage(stage, len(tasks) if units.total is None else units.total, quiet=quiet) as counter:
            works = {
                place: OutcomeTask(
                    function=function, task=task, place=place, scratch=self.scratch, brief=brief, stage=stage
                )
                for place, task in tasks.items()
            }
            if self.kept is None:
                found: dict[Place, Brief] = {
                    place: brief_of(self.scratch, place) for place in works if self.scratch.has(place.name)
                }
            else:
                found = self.kept.found(works, files, self.progress)
            if found:
                kept, failed = sum(map(units.done, found.values())), sum(map(units.failed, found.values()))
                counter.add(kept, failed, kept=kept, message=f"{len(found)} of {len(tasks)} tasks were done before")
            todo = [work for place, work in works.items() if place not in found]
            if self.kept is not None:
                self.check(folder for work in todo for folder in files.reads(work.task))
            # closed at once where the listener raises, so that no task goes on in vain
            with contextlib.closing(self.executor.map(stage, run_and_store, todo, self.progress.watch)) as running:
                for measured in running:
                    new = measured.result
                    found[new.place] = new.brief
                    on_new(new.brief)
                    self.progress.measured(measured, functools.partial(units.parts, new.brief))
                    counter.add(units.done(new.brief), units.failed(new.brief))
        return {place: found[place] for place in tasks}

    def check(self, folders: Iterable[str]) -> None:
        """Check what earlier runs left in some folders of scratch, once per run; what is damaged is made again."""
        if self.kept is not None:
            self.kept.check(folders, self.progress)


@contextlib.contextmanager
def run_context(
    plan: Plan,
    progress: Progress,
    resources: Resources,
    scratch: AbstractContextManager[Scratch],
    work: Callable[[], Expected],
    *,
    loads: Sequence[str],
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
) -> Iterator[RunContext]:
    """Open scratch, start the executor, watch for cancellation, and check that the plan fits into memory.

    Without an executor the one that `resources` and `work` call for runs the tasks. An exception within the block also
    ends the tasks that still run.

    Parameters
    ----------
    work : callable
        What there is to do; called where it decides which executor runs it.
    loads : sequence of str
        What child processes load, from `loads_of`.

    Raises
    ------
    InputError
        The largest task does not fit into a worker.
    FolderLostError
        The scratch folder was removed meanwhile.
    RunCancelledError, ClusterError, RunError
        No executor came up, or the scratch cannot be used.
    """
    with scratch as opened:
        folder = str(Path(opened.root, "dask"))
        engine = executor or _own_executor(resources, folder, work, loads)
        starting = time.perf_counter()
        # the driver of a service has a span already
        with span("run", first=True), about(run=opened.name), _watching(opened, cancelled) as was_cancelled, engine:
            progress.watch = Watch(
                cancelled=was_cancelled,
                check_scratch=opened.check_mark,
                stop=opened.cancel,
                listener=progress.listener,
            )
            engine.prepare("plan", progress.watch)
            progress.timings["start workers"] = time.perf_counter() - starting
            check_memory(plan, engine.memory_limit_bytes)
            context = RunContext(
                plan=plan,
                progress=progress,
                executor=engine,
                scratch=opened,
                isolation=resources.isolation,
                reading=resources.reading,
                kept=_kept_files(opened, engine),
            )
            try:
                with context.blaming_lost_scratch():
                    yield context
            except BaseException:
                opened.cancel()
                raise


def _own_executor(
    resources: Resources, local_directory: str, work: Callable[[], Expected], loads: Sequence[str]
) -> Executor:
    """The executor that a run starts for itself."""
    if resources.is_serial and resources.performance_report is None:
        return SerialExecutor()
    from pipeline.runtime.engine import executor_for

    return executor_for(resources, local_directory=local_directory, work=work(), loads=loads)


def _kept_files(scratch: Scratch, executor: Executor) -> KeptFiles | None:
    """What earlier runs left in scratch."""
    if not scratch.has(OUTCOMES):
        return None
    from pipeline.runtime.kept_files import KeptFiles

    return KeptFiles(scratch, executor)


@contextlib.contextmanager
def _watching(scratch: Scratch, cancelled: Callable[[], bool]) -> Iterator[Callable[[], bool]]:
    """Watch for cancellation from a thread of its own, so that a task in this very process notices it too."""
    if cancelled is never:
        yield never
        return
    if cancelled():  # before it began: a short run could else be over before the next question
        scratch.cancel()
        yield lambda: True
        return
    over, noticed = threading.Event(), threading.Event()

    def ask() -> None:
        try:
            while not over.wait(TICK_S) and not cancelled():
                pass
        finally:
            # where `cancelled` raises, no later request to end the run would be noticed: end it now
            if not over.is_set():
                noticed.set()
                scratch.cancel()

    asking = threading.Thread(target=ask, name="gablework-cancelled", daemon=True)
    asking.start()
    try:
        yield noticed.is_set
    finally:
        over.set()
        asking.join()
