"""Small jobs without a cluster: tasks in supervised child processes of this one, as many at once as there are cores.

This process plans, merges results and writes the manifest; it loads no kernels. Its children do everything else and
stay from stage to stage. Deaths of children are handled as deaths of workers are (`runtime.cluster.dispatch`):

| event | outcome |
| --- | --- |
| a building kills a child | only that building is lost: its task supervises each (`isolation.isolated_items`) |
| another task kills a child | the task waits until the others are done, then runs alone in a fresh child |
| it kills that child, too | `RunError` with the task's name |
| the run is cancelled | running tasks are asked to end, get a limited time, and are then killed |
| tasks need more memory than there is | they run one after the other |
"""

from __future__ import annotations

import contextvars
import math
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from types import TracebackType
from typing import Any, Generic, Self

from pipeline.errors import RunCancelledError, RunError
from pipeline.runtime.cluster.dispatch import SETTLE_INTERRUPTED_S, blame, tried_alone
from pipeline.runtime.cluster.packed_tasks import measure_in_child
from pipeline.runtime.isolation.child_pool import FRUITLESS_STARTS, borrowed_child, start_failure
from pipeline.runtime.isolation.supervision import ChildEnd
from pipeline.runtime.monitoring.logs import LOG, facts_of_task
from pipeline.runtime.monitoring.measurement import TALLIES, Measured, Result, Task, cores, measure, memory_bytes
from pipeline.runtime.monitoring.progress import TICK_S, Watch

_WORN_BYTES = 2**30
"""A child that holds more than this between tasks is not used again; buildings have their own limits."""

_PASSED_ON: set[str] = set()


class LocalExecutor:
    """Tasks in child processes of this one.

    Parameters
    ----------
    children : int, optional
        Number of concurrent tasks; by default one per core.
    memory_limit_bytes : int, optional
        Their total memory; by default the machine's memory.
    """

    def __init__(self, children: int | None = None, memory_limit_bytes: int | None = None) -> None:
        self._children = children or cores()
        self._memory_bytes = memory_limit_bytes or memory_bytes()

    def prepare(self, stage: str, watch: Watch) -> None:
        """Nothing to wait for: children start with the first task."""

    def map(
        self, stage: str, function: Callable[[Task], Result], tasks: Sequence[Task], watch: Watch
    ) -> Generator[Measured[Result], None, None]:
        """Results as they come.

        Raises RunCancelledError if the run was cancelled, RunError if one task killed its children, also when it ran
        alone.
        """
        return _Stage(stage, function, tasks, watch, self._memory_bytes).results(self._children)

    @property
    def memory_limit_bytes(self) -> int | None:
        """The machine's memory: one task may take all of it while no other runs."""
        return self._memory_bytes

    def __enter__(self) -> Self:
        """Nothing to start."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Keep the children for the next run of this process; they end with it."""


class _Stage(Generic[Task, Result]):
    """The tasks of one stage: handed out to threads, each of which has one child at a time."""

    def __init__(
        self, stage: str, function: Callable[[Task], Result], tasks: Sequence[Task], watch: Watch, memory: int
    ) -> None:
        self._stage = stage
        self._function = function
        self._tasks = tasks
        self._watch = watch
        self._memory_bytes = memory
        self._changed = threading.Condition()
        self._waiting = deque(range(len(tasks)))
        self._suspects: deque[int] = deque()
        self._running: dict[int, int] = {}
        self._alone = False
        self._over = False
        self._killed = threading.Event()
        self._landed: queue.SimpleQueue[Measured[Result] | BaseException] = queue.SimpleQueue()

    def results(self, children: int) -> Generator[Measured[Result], None, None]:
        """Results as they come."""
        threads = [
            threading.Thread(
                target=contextvars.copy_context().run, args=(self._work,), name=f"{self._stage}-{k}", daemon=True
            )
            for k in range(min(children, len(self._tasks)))
        ]
        try:
            for thread in threads:
                thread.start()
            for _ in self._tasks:
                yield self._next()
        finally:
            self._settle()
            for thread in threads:
                if thread.ident is not None:
                    thread.join()

    def _next(self) -> Measured[Result]:
        """The next result, waited for."""
        while True:
            self._watch.check_cancelled()
            try:
                landed = self._landed.get(timeout=TICK_S)
            except queue.Empty:
                continue
            if isinstance(landed, BaseException):
                raise landed
            return landed

    def _settle(self) -> None:
        """Start no more tasks, ask running ones to end, and kill those that do not."""
        with self._changed:
            self._over = True
            self._changed.notify_all()
            if not self._running:
                return
        self._watch.stop()
        deadline = time.monotonic() + SETTLE_INTERRUPTED_S
        with self._changed:
            while self._running and time.monotonic() < deadline:
                self._changed.wait(TICK_S)
        self._killed.set()

    # --- in the threads ----------------------------------------------------------------------------------------------

    def _work(self) -> None:
        """Run tasks until there are none."""
        while (number := self._taken()) is not None:
            landed: Measured[Result] | BaseException | None = None
            try:
                outcome = self._done(number)
                if isinstance(outcome, Measured):
                    landed = outcome
                elif self._alone:
                    landed = RunError(blame(self._stage, self._tasks[number], here=True))
                else:
                    facts = {"stage": self._stage, **facts_of_task(self._tasks[number])}
                    LOG.warning("the task killed its process (%s): it is tried alone", outcome.detail, extra=facts)
                    self._watch.listener(tried_alone(self._stage, self._tasks[number]))
            except BaseException as error:  # noqa: BLE001 - raised where the results are waited for
                landed = error
            with self._changed:
                del self._running[number]
                self._alone = False
                if landed is None:
                    self._suspects.append(number)
                self._changed.notify_all()
            # last, since the last result ends the stage and cancels what still runs
            if landed is not None:
                self._landed.put(landed)

    def _taken(self) -> int | None:
        """The next task, once it may run; None if nothing is left to do."""
        with self._changed:
            while not self._over:
                if self._suspects:
                    if not self._running:
                        self._alone = True
                        return self._begun(self._suspects.popleft())
                elif self._waiting:
                    if not self._alone and self._fits(self._waiting[0]):
                        return self._begun(self._waiting.popleft())
                elif not self._running:
                    break
                self._changed.wait()
            return None

    def _begun(self, number: int) -> int:
        self._running[number] = self._need_bytes(number)
        return number

    def _need_bytes(self, number: int) -> int:
        return int(getattr(self._tasks[number], "memory_bytes", 0))

    def _fits(self, number: int) -> bool:
        """Whether there is memory for a task beside the running ones; a single task always fits."""
        return not self._running or sum(self._running.values()) + self._need_bytes(number) <= self._memory_bytes

    def _done(self, number: int) -> Measured[Result] | ChildEnd:
        """The result of a task, or the end of its child."""
        task = self._tasks[number]
        if getattr(task, "supervises", False):
            return measure(self._function, task, self._stage)
        TALLIES.begin()
        began, outcome = time.perf_counter(), "failed"
        try:
            found = self._in_child(task)
        except RunCancelledError:
            outcome = "cancelled"
            raise
        else:
            outcome = "done" if isinstance(found, Measured) else "failed"
            return found
        finally:
            TALLIES.end(self._stage, outcome, time.perf_counter() - began)

    def _in_child(self, task: Task) -> Measured[Result] | ChildEnd:
        """Run a task in a child, with the machine's memory and without a time-out."""
        for _ in range(FRUITLESS_STARTS):
            with borrowed_child(self._killed.is_set, fresh=self._alone, loads=()) as child:
                found: Any = None
                for message in child.work(
                    measure_in_child,
                    [(0, (self._function, task, self._stage))],
                    timeout_s=math.inf,
                    memory_bytes=self._memory_bytes,
                    cancelled=self._killed.is_set,
                    one="task",
                ):
                    found = message
                if not isinstance(found, ChildEnd):
                    self._pass_on(child.new_output())
                if isinstance(found, ChildEnd) or child.memory_bytes > _WORN_BYTES:
                    child.end()
            if not isinstance(found, ChildEnd):
                measured: Measured[Result] = found.result
                return measured
            if found.index is not None:
                return found
        raise RunError(start_failure(found.detail, found.stderr, f"runs the tasks of the stage {self._stage}"))

    @staticmethod
    def _pass_on(output: str) -> None:
        """Print a child's warnings and log lines; the same output of several children once."""
        if output and output not in _PASSED_ON:
            _PASSED_ON.add(output)
            sys.stderr.write(output)
