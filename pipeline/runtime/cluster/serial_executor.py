"""The interface of executors, and the simplest one: one task after the other, in this process.

A plan is data and tasks are plain functions of one argument. An executor maps a function over tasks and yields results
as they come, in any order. It shows nothing else of the engine.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Sequence
from types import TracebackType
from typing import Protocol, Self

from pipeline.runtime.monitoring.measurement import Measured, Result, Task, measure
from pipeline.runtime.monitoring.progress import Watch


class Executor(Protocol):
    """Runs the tasks of a run. One executor serves one run at a time."""

    def prepare(self, stage: str, watch: Watch) -> None:
        """Wait until tasks can run, and check that all processes run the same versions."""

    def map(
        self, stage: str, function: Callable[[Task], Result], tasks: Sequence[Task], watch: Watch
    ) -> Generator[Measured[Result], None, None]:
        """Results of all tasks, in the order in which they finish."""

    @property
    def memory_limit_bytes(self) -> int | None:
        """Memory limit of one worker; None without a limit."""

    def __enter__(self) -> Self:
        """Start."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop."""


class SerialExecutor:
    """One task after the other, in this process."""

    def prepare(self, stage: str, watch: Watch) -> None:
        """Nothing to wait for."""

    def map(
        self, stage: str, function: Callable[[Task], Result], tasks: Sequence[Task], watch: Watch
    ) -> Generator[Measured[Result], None, None]:
        """Results in the order of the tasks."""
        for task in tasks:
            watch.check_cancelled()
            yield measure(function, task, stage)

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


def run_alone(
    executor: Executor, stage: str, function: Callable[[Task], Result], task: Task, watch: Watch | None = None
) -> Result:
    """Run one task in a process with the libraries that it needs; without a watch it cannot be cancelled."""
    with contextlib.closing(executor.map(stage, function, [task], watch or Watch())) as found:
        return next(found).result
