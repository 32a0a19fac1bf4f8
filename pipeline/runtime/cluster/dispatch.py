"""The tasks of one stage on a Dask cluster: a bounded window in flight, and a plan for every fault.

| event | outcome |
| --- | --- |
| a worker dies | its tasks go elsewhere, and results that only it held are computed again |
| a task kills several workers | it and those that travel with it wait until the others are done, then run alone |
| it kills workers again | `RunError` with the task's name |
| no worker is left | a repeated event `waiting`, until one is back |
| the scheduler is lost, or silent for long | `ClusterError` |
| the run is cancelled | tasks in flight are asked to end, get a limited time, and are taken back |
| a task needs more memory than any worker announces | it runs alone on the largest worker, with a warning |
"""

from __future__ import annotations

import dataclasses
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Generator, Sequence
from typing import Any, Generic

from pipeline.errors import ClusterError, GableworkError, RunCancelledError, RunError
from pipeline.runtime.cluster.memory_needs import RESOURCE, announced_bytes, declared_bytes
from pipeline.runtime.cluster.packed_tasks import measure_packed, pack_tasks
from pipeline.runtime.monitoring.logs import LOG, facts_of_task
from pipeline.runtime.monitoring.measurement import TALLIES, Measured, Result, Task
from pipeline.runtime.monitoring.progress import TICK_S, Event, Watch
from pipeline.runtime.monitoring.versions import fingerprint

TASKS_PER_THREAD = 3
"""Tasks in flight per thread of the cluster: one runs, the others are on their way."""
SETTLE_S = 30.0
"""Longest wait for tasks in flight after the run was cancelled."""
SETTLE_INTERRUPTED_S = 3.0
"""The same after an interrupt from the keyboard."""
_TOGETHER_S = 1.0
"""Short tasks travel together, as many as take about so many seconds: each message costs driver and scheduler 3 ms."""
_SHARES = 8
"""But at most this part of what is left for each thread, so that all end at the same time: guided self-scheduling
(Polychronopoulos and Kuck 1987)."""
_AHEAD = 2
"""Declared memory of the tasks in flight as a multiple of the announced memory: one part runs, one is on its way."""
_QUIET_S = 60.0
"""Seconds without a result after which a run looks whether any of its tasks is executed."""
_RESULT_S = 5.0
_ENDED = frozenset({"finished", "error", "cancelled"})
"""Final states of a future; a pending future will still finish, and a lost one is computed again."""
_SUSPECTS = "gablework-suspects"
_NOT_SHARED = (
    "a worker does not see the run's scratch folder: "
    "the run directory must be on a file system that all workers share, under the same name"
)


def blame(stage: str, task: object, *, here: bool = False) -> str:
    """The message if a task alone killed its processes; `here` if they are children, not workers."""
    smaller = ", or set a smaller tile_size_m" if stage in {"cells", "split"} else ""
    who, advice = ("processes", "Use a machine with more memory") if here else ("workers", "Give them more memory")
    return (
        f"stage {stage}: {who} died again and again on one task, also when it ran alone: {repr(task)[:300]}. "
        f"{advice}{smaller}"
    )


def tried_alone(stage: str, task: object) -> Event:
    """The event of a task that killed its processes and is tried alone."""
    facts = {name: str(value) for name, value in facts_of_task(task).items() if name == "tile" and value is not None}
    message = "the processes of a task died: it is tried alone"
    return Event(kind="detail", stage=stage, message=message, facts=facts)


class ClusterMonitor:
    """Checks, while no result comes, whether workers are there and the scheduler answers.

    Parameters
    ----------
    client : distributed.Client
        Connected to the scheduler.
    address : str
        The scheduler's, for messages.
    on_count : callable
        Gets the number of workers that take tasks, at every check.
    advice : str
        What to do if no worker is there.
    clock : callable
        Seconds, monotonic; replaced in tests.
    """

    grace_s = 3.0
    """Seconds without workers before an event reports it: restarting a worker takes about 2 s."""
    repeat_s = 30.0
    """Seconds between repeated events."""
    silence_s = 60.0
    """Seconds without an answer after which the scheduler is lost."""
    memory_s = 10.0
    """Seconds between two requests of the workers' announced memory."""
    _every_s = 1.0
    _answer_s = 5.0

    def __init__(
        self,
        client: Any,
        address: str,
        on_count: Callable[[int], None],
        advice: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client = client
        self._address = address
        self._on_count = on_count
        self._advice = advice
        self._clock = clock
        self._answered_s = clock()
        self._checked_s = -1e9
        self._empty_since_s: float | None = None
        self._reported_s: float | None = None
        self.threads = 0
        """Threads of the workers that take tasks, at the last check."""
        self._requested_s = -1e9
        self._announced: list[int] | None = None

    def announced(self) -> list[int] | None:
        """Announced memory in bytes, one entry per announcing worker; None while no worker is there."""
        now = self._clock()
        if now - self._requested_s >= (self._every_s if self._announced is None else self.memory_s):
            try:
                identity = self._client.scheduler.identity
                found = self._client.sync(identity, n_workers=-1, callback_timeout=self._answer_s)
            except (OSError, TimeoutError):
                # `look` detects whether it is lost; the last answer still counts
                self.check()
            else:
                self._announced = announced_bytes(found["workers"]) if found["workers"] else None
            self._requested_s = self._clock()
        return self._announced

    def check(self) -> None:
        """Raise an error if the client is not connected to the scheduler."""
        if self._client.status != "running":
            raise self.lost("the connection to it broke")

    def lost(self, why: str) -> ClusterError:
        """The error of a lost scheduler."""
        return ClusterError(f"the scheduler {self._address} was lost: {why}. Start it, then the run again")

    def look(self, stage: str, watch: Watch) -> None:
        """Count the workers, at most once a second, and report when none are left, or when some are back."""
        self.check()
        now = self._clock()
        if now - self._checked_s < self._every_s:
            return
        try:
            running = self._client.sync(self._client.scheduler.ncores_running, callback_timeout=self._answer_s)
        except (OSError, TimeoutError) as error:
            self.check()
            silent_s = self._clock() - self._answered_s
            if silent_s > self.silence_s:
                raise self.lost(f"it has not answered for {silent_s:.0f} s") from error
            return
        finally:
            self._checked_s = self._clock()
        self._answered_s = self._checked_s
        self.threads = sum(running.values())
        self._on_count(len(running))
        self._report(stage, watch, self._checked_s)

    def _report(self, stage: str, watch: Watch, now: float) -> None:
        if self.threads:
            if self._reported_s is not None and self._empty_since_s is not None:
                message = f"workers are there after {now - self._empty_since_s:.0f} s, threads: {self.threads}"
                watch.listener(Event(kind="run", stage=stage, message=message))
            self._empty_since_s = self._reported_s = None
            return
        if self._empty_since_s is None:
            self._empty_since_s = now
        empty_s = now - self._empty_since_s
        if empty_s < self.grace_s or (self._reported_s is not None and now - self._reported_s < self.repeat_s):
            return
        self._reported_s = now
        message = f"no worker has been there for {empty_s:.0f} s: the run continues as soon as one is. {self._advice}"
        watch.listener(Event(kind="waiting", stage=stage, message=message))


@dataclasses.dataclass
class Dispatch(Generic[Task, Result]):
    """The tasks of one stage on the cluster."""

    client: Any
    monitor: ClusterMonitor
    stage: str
    function: Callable[[Task], Result]
    tasks: Sequence[Task]
    watch: Watch
    priority: int = 0
    settle_s: float = SETTLE_S

    def __post_init__(self) -> None:
        """Sort the tasks into large and other ones."""
        self._needs = {n: need for n, task in enumerate(self.tasks) if (need := declared_bytes(task))}
        self._waiting = deque(n for n in range(len(self.tasks)) if n not in self._needs)
        self._large = deque(self._needs)
        self._reserved: dict[Any, int] = {}
        self._warned = False
        self._suspects: deque[int] = deque()
        self._in_flight: dict[Any, tuple[int, ...]] = {}
        self._spent_s, self._timed = 0.0, 0
        self._alone: Any = None
        self._wake = threading.Event()
        self._name = uuid.uuid4().hex[:12]
        self._submitted = 0
        self._quiet_since_s = time.monotonic()

    def results(self) -> Generator[Measured[Result], None, None]:
        """Results as they come."""
        try:
            while self._large or self._waiting or self._suspects or self._in_flight:
                self.watch.check_cancelled()
                self.monitor.look(self.stage, self.watch)
                self._reconsider()
                self._submit()
                self._wake.wait(TICK_S)
                self._wake.clear()
                self._say_if_queued()
                for future in [future for future in self._in_flight if future.status in _ENDED]:
                    self._quiet_since_s = time.monotonic()
                    yield from self._landed(future)
        except KeyboardInterrupt:
            self.settle_s = min(self.settle_s, SETTLE_INTERRUPTED_S)
            raise
        except GableworkError:
            raise
        except Exception as error:
            # a client that has just lost its scheduler raises many kinds of errors
            if self.client.status != "running":
                raise self.monitor.lost(f"{type(error).__name__}: {error}") from error
            raise
        finally:
            self._settle()

    def _say_if_queued(self) -> None:
        """Report now and then that no task of this run has its turn, since all workers are busy with other runs."""
        now_s = time.monotonic()
        if now_s - self._quiet_since_s < _QUIET_S or not self.monitor.threads:
            return
        self._quiet_since_s = now_s
        try:
            if self._in_flight and self._executing(list(self._in_flight)):
                return
        except (OSError, TimeoutError):
            # a worker that does not answer may be at work on one
            return
        message = "all workers are busy with other runs: this one continues as soon as one is free"
        self.watch.listener(Event(kind="waiting", stage=self.stage, message=message))

    def _submit(self) -> None:
        """Send the tasks that may run now: a window of tasks, or one suspect alone."""
        if self._suspects:
            if not self._in_flight and self._take_turn():
                number = self._suspects.popleft()
                largest = max(self.monitor.announced() or (), default=0)
                self._send((number,), min(self._needs.get(number, 0), largest))
            return
        if self._alone is not None:
            # the last suspect still runs: no other task may be blamed in its place
            return
        window = TASKS_PER_THREAD * max(2, self.monitor.threads)
        self._submit_large(window)
        # tasks that wait for memory do not hold up the others
        while self._waiting and len(self._in_flight) - len(self._reserved) < window:
            self._send(tuple(self._waiting.popleft() for _ in range(self._together())))

    def _together(self) -> int:
        """How many of the tasks that wait travel together now."""
        if not self._timed:
            return 1
        share = len(self._waiting) // (_SHARES * max(1, self.monitor.threads))
        return max(1, min(share, int(_TOGETHER_S * self._timed / max(self._spent_s, 1e-9))))

    def _submit_large(self, window: int) -> None:
        """Send tasks that need much memory: as many as the workers can take, and as many again on their way."""
        if not self._large:
            return
        announced = self.monitor.announced()
        if announced is None:
            return
        if not announced:
            self._warn_once(
                f"{len(self._large)} tasks of {self.stage} need much memory (up to {self._largest_need()}) and "
                f"no worker announces how much it has: they run anywhere. Use gablework worker, or dask worker "
                f"--resources {RESOURCE}=BYTES"
            )
            while self._large and len(self._in_flight) < window:
                self._send((self._large.popleft(),))
            return
        largest, room = max(announced), _AHEAD * sum(announced)
        if max(self._needs[number] for number in self._large) > largest:
            self._warn_once(
                f"tasks of {self.stage} need up to {self._largest_need()} of memory, the largest worker has "
                f"{largest / 2**30:.1f} GiB: they run there with all that it has. Give it more, or add a larger one"
            )
        while self._large:
            need = min(self._needs[self._large[0]], largest)
            if self._reserved and sum(self._reserved.values()) + need > room:
                return
            self._send((self._large.popleft(),), need)

    def _reconsider(self) -> None:
        """Take back tasks that wait for memory that no worker has any longer; they are sent again."""
        if not self._reserved:
            return
        announced = self.monitor.announced()
        if announced is None:
            return
        largest = max(announced, default=0)
        for future, need in list(self._reserved.items()):
            if need > largest and future.status not in _ENDED:
                self._large.extendleft(self._in_flight[future])
                self._drop(future, "sent again")

    def _largest_need(self) -> str:
        return f"{max(self._needs.values()) / 2**30:.1f} GiB"

    def _warn_once(self, message: str) -> None:
        if not self._warned:
            self._warned = True
            self.watch.listener(Event(kind="warning", stage=self.stage, message=message))

    def _send(self, numbers: tuple[int, ...], need_bytes: int = 0) -> None:
        self._submitted += 1
        packed = pack_tasks(self.function, [self.tasks[number] for number in numbers])
        future = self.client.submit(
            measure_packed,
            fingerprint(),
            packed,
            self.stage,
            key=f"{self.stage}-{self._name}-{numbers[0]}-{self._submitted}",
            pure=False,
            priority=self.priority,
            resources={RESOURCE: need_bytes} if need_bytes else None,
        )
        self._in_flight[future] = numbers
        if need_bytes:
            self._reserved[future] = need_bytes
        TALLIES.send(self.stage, len(numbers), len(packed))
        future.add_done_callback(lambda _: self._wake.set())

    def _take_turn(self) -> bool:
        """Whether this run may try a suspect: one at a time on the whole cluster, so only one can be blamed."""
        from distributed import Lock

        if self._alone is not None:
            return True
        lock = Lock(_SUSPECTS, scheduler_rpc=self.client.scheduler, loop=self.client.loop)
        if lock.acquire(timeout=TICK_S):
            self._alone = lock
        return self._alone is not None

    def _end_turn(self) -> None:
        if self._alone is not None:
            lock, self._alone = self._alone, None
            lock.release()

    def _landed(self, future: Any) -> Generator[Measured[Result], None, None]:
        """Handle a task that is no longer pending: yields its result, or sends it again."""
        from distributed.scheduler import KilledWorker

        if future.status == "cancelled":
            self.monitor.check()
            raise self.monitor.lost("it no longer knows the tasks of this run")
        numbers = self._in_flight[future]
        if future.status == "error":
            try:
                error = future.exception(timeout=_RESULT_S)
            except TimeoutError:
                # a busy cluster: it is checked again
                self.monitor.check()
                return
            if isinstance(error, RunCancelledError) and not self.watch.cancelled():
                self.watch.check_scratch()
                raise RunError(_NOT_SHARED) from error
            if not isinstance(error, KilledWorker):
                raise error
            if self._alone is not None:
                raise RunError(blame(self.stage, self.tasks[numbers[0]])) from error
            self._drop(future, "suspect")
            with_others = "" if len(numbers) == 1 else f", as are {len(numbers) - 1} tasks that travelled with it"
            LOG.warning("the task killed workers: it is tried alone%s", with_others, extra=self._facts(numbers[0]))
            self.watch.listener(tried_alone(self.stage, self.tasks[numbers[0]]))
            self._suspects.extend(numbers)
            return
        try:
            found = future.result(timeout=_RESULT_S)
        except (TimeoutError, OSError):
            # its worker died with the result, which is computed and checked again
            self.monitor.check()
            return
        self._drop(future, "done")
        self._end_turn()
        self._spent_s += sum(measured.seconds for measured in found)
        self._timed += len(found)
        yield from found

    def _facts(self, number: int) -> dict[str, object]:
        """The ids of a task, for the log."""
        return {"stage": self.stage, **facts_of_task(self.tasks[number])}

    def _drop(self, future: Any, outcome: str) -> None:
        TALLIES.land(self.stage, outcome, len(self._in_flight.pop(future)))
        self._reserved.pop(future, None)
        future.release()

    def _settle(self) -> None:
        """Ask the tasks in flight to end, wait for those that run, take all back."""
        if not self._in_flight:
            return
        self.watch.stop()
        deadline = time.monotonic() + self.settle_s
        waiting = list(self._in_flight)
        try:
            while time.monotonic() < deadline and self.client.status == "running":
                waiting = [future for future in waiting if future.status not in _ENDED]
                if not waiting or not self._executing(waiting):
                    break
                self._wake.wait(TICK_S)
                self._wake.clear()
            if self.client.status == "running":
                self.client.cancel(list(self._in_flight), force=True)
                self._end_turn()
        except (OSError, TimeoutError):
            # the scheduler is gone, and the tasks with it
            pass
        for numbers in self._in_flight.values():
            TALLIES.land(self.stage, "taken back", len(numbers))
        self._in_flight.clear()
        self._reserved.clear()

    def _executing(self, futures: list[Any]) -> bool:
        """Whether any of these runs now; queued ones are taken back without waiting."""
        keys = [future.key for future in futures]
        try:
            stacks = self.client.sync(self.client.scheduler.call_stack, keys=keys, callback_timeout=_RESULT_S)
        except KeyError:
            # the scheduler does not know them
            return False
        return any(stacks.values())
