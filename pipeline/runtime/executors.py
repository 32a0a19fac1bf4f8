"""Where tasks run: serially in this process, or on Dask. The only module that imports dask.

A plan is data and tasks are plain functions of one argument; an executor maps a function over tasks
and yields results as they come, in any order. Nothing else of the engine shows.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import resource
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar

from pipeline.errors import RunError

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measured(Generic[Result]):
    """A result and what it took."""

    result: Result
    seconds: float
    process: str
    """host:pid."""
    peak_bytes: int
    """Largest resident size of the process so far."""


def peak_of_process() -> tuple[str, int]:
    """The process as host:pid, and its largest resident size so far in bytes."""
    return f"{socket.gethostname()}:{os.getpid()}", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def measure(function: Callable[[Task], Result], task: Task) -> Measured[Result]:
    """Run one task and measure it."""
    started = time.perf_counter()
    result = function(task)
    seconds = time.perf_counter() - started
    process, peak_bytes = peak_of_process()
    return Measured(result=result, seconds=seconds, process=process, peak_bytes=peak_bytes)


class Executor(Protocol):
    """What a run needs of an engine."""

    def map(self, stage: str, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Measured[Result]]:
        """Results of all tasks, in the order in which they finish."""

    @property
    def memory_limit_bytes(self) -> int | None:
        """Memory of one worker; None where there is no limit."""

    def __enter__(self) -> Self:
        """Start."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop."""


class SerialExecutor:
    """One task after the other, in this process."""

    def map(self, stage: str, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Measured[Result]]:
        """Results in the order of the tasks."""
        del stage
        for task in tasks:
            yield measure(function, task)

    @property
    def memory_limit_bytes(self) -> int | None:
        """No limit of its own."""
        return None

    def __enter__(self) -> Self:
        """Nothing to start."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing to stop."""


class DaskExecutor:
    """An embedded cluster of worker processes, or a scheduler that is already there.

    Parameters
    ----------
    workers : int
        Processes of the embedded cluster, one thread each.
    scheduler : str or None
        Address of a scheduler; then no cluster is embedded.
    local_directory : str
        Where the embedded workers spill.
    """

    def __init__(self, *, workers: int, scheduler: str | None, local_directory: str) -> None:
        self._workers = workers
        self._scheduler = scheduler
        self._local_directory = local_directory
        self._stack = contextlib.ExitStack()
        self._client: Any = None

    def __enter__(self) -> Self:
        """Start the cluster or connect to the scheduler.

        Raises
        ------
        RunError
            The scheduler does not answer.
        """
        import dask
        from distributed import Client, LocalCluster

        quiet = {"distributed.admin.log-format": "%(message)s", "distributed.logging.distributed": "error"}
        # what was entered before a fault is left again
        with contextlib.ExitStack() as stack:
            stack.enter_context(dask.config.set(quiet))
            if self._scheduler is None:
                cluster = LocalCluster(
                    n_workers=self._workers,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address="127.0.0.1:0",
                    local_directory=self._local_directory,
                    silence_logs="ERROR",
                )
                stack.enter_context(cluster)
                self._client = stack.enter_context(Client(cluster))
            else:
                try:
                    self._client = stack.enter_context(Client(self._scheduler, timeout="20s"))
                except OSError as error:
                    raise RunError(
                        f"the scheduler {self._scheduler} does not answer: {error}. Check the address, or use --workers"
                    ) from error
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close what was started."""
        self._stack.__exit__(kind, error, trace)

    @property
    def memory_limit_bytes(self) -> int | None:
        """The smallest worker's limit."""
        limits = [w["memory_limit"] for w in self._client.scheduler_info(n_workers=-1)["workers"].values()]
        return min((limit for limit in limits if limit), default=None)

    def map(self, stage: str, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Measured[Result]]:
        """Results as they come, with a bounded window of tasks in flight.

        Raises
        ------
        RunError
            A worker died again and again on one task.
        """
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        waiting = iter(enumerate(tasks))
        threads = max(2, sum(self._client.nthreads().values()))

        def submit(number: int, task: Task) -> Any:
            return self._client.submit(measure, function, task, key=f"{stage}-{number}-{id(self)}", pure=False)

        running = as_completed([submit(*item) for item in itertools.islice(waiting, 3 * threads)])
        for future in running:
            try:
                measured = future.result()
            except KilledWorker as error:
                task = tasks[int(str(future.key).removeprefix(f"{stage}-").split("-")[0])]
                raise RunError(
                    f"stage {stage}: workers died again and again on one task: {_told(task)}. Give them more memory"
                    + (", or set a smaller tile_size_m" if stage == "split" else "")
                ) from error
            future.release()
            for item in itertools.islice(waiting, 1):
                running.add(submit(*item))
            yield measured


def _told(task: object) -> str:
    """A task in a message: its first plain facts."""
    return repr(task)[:300]


def executor_for(*, workers: int, scheduler: str | None, local_directory: str) -> Executor:
    """The executor that a request asks for: serial without workers and scheduler, else Dask."""
    if workers == 0 and scheduler is None:
        return SerialExecutor()
    return DaskExecutor(workers=workers, scheduler=scheduler, local_directory=local_directory)
