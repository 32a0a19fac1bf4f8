"""The tasks of one stage on a Dask cluster: a bounded window of them in flight, whatever happens to the workers.

What may happen, and what comes of it:

| event | outcome |
| --- | --- |
| a worker dies | its tasks go elsewhere, results that only it held are made again |
| workers die of a task again and again | the task waits until the others are through and is tried alone |
| they die of it alone, too | `RunError` that names the task |
| no worker is left | told as `waiting`, again and again, until one is back |
| the scheduler is lost, or is silent for long | `ClusterError` |
| the run is called off | the tasks in flight are told, waited for with a bound, and taken back |
| a task needs more memory than any worker announces | it runs where most is announced, alone; told |
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
from pipeline.runtime.monitoring.events import Event, Watch
from pipeline.runtime.monitoring.logs import LOG, facts_of_task
from pipeline.runtime.monitoring.measurement import Measured, Result, Task, measure_packed, packed
from pipeline.runtime.monitoring.tallies import TALLIES
from pipeline.runtime.monitoring.versions import fingerprint

TICK_S = 0.2
"""Seconds between two looks at what no result tells."""
TASKS_PER_THREAD = 3
"""Tasks in flight for each thread of the cluster: one runs, the others are on their way."""
SETTLE_S = 30.0
"""Longest time that tasks in flight are waited for after the run was called off."""
SETTLE_INTERRUPTED_S = 3.0
"""The same after an interrupt from the keyboard."""
_AHEAD = 2
"""Declared memory of the tasks in flight, by what all workers announce: as much runs, and as much is on its way."""
_RESULT_S = 5.0
_ENDED = frozenset({"finished", "error", "cancelled"})
"""A future that is pending is still to come, and one that is lost is made again."""
_SUSPECTS = "gablework-suspects"
_NOT_SHARED = (
    "a worker does not see the run's scratch folder: "
    "the run directory must be on a file system that all workers share, under the same name"
)


def blame(stage: str, task: object, *, here: bool = False) -> str:
    """The message where processes died of one task, whatever else ran; `here` where they are no workers."""
    smaller = ", or set a smaller tile_size_m" if stage == "split" else ""
    who, advice = ("processes", "Use a machine with more memory") if here else ("workers", "Give them more memory")
    return (
        f"stage {stage}: {who} died again and again on one task, also when it ran alone: {repr(task)[:300]}. "
        f"{advice}{smaller}"
    )


class ClusterMonitor:
    """Looks after the cluster while nothing comes: whether workers are there, whether the scheduler answers.

    Parameters
    ----------
    client : distributed.Client
        Connected to the scheduler.
    address : str
        The scheduler's, for messages.
    on_count : callable
        Gets the number of workers that take tasks, at every look.
    advice : str
        What to do where no worker is there.
    clock : callable
        Seconds, monotonic; replaced in tests.
    """

    grace_s = 3.0
    """A cluster without workers for so long is told: a worker that is restarted takes about 2 s."""
    repeat_s = 30.0
    """It is told again after so long."""
    silence_s = 60.0
    """A scheduler that answers nothing for so long is lost."""
    memory_s = 10.0
    """What workers announce is asked again after so long, while somebody wants to know."""
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
        self._looked_s = -1e9
        self._bare_since_s: float | None = None
        self._told_s: float | None = None
        self.threads = 0
        """Threads of the workers that take tasks, when last looked."""
        self._asked_s = -1e9
        self._announced: list[int] | None = None

    def announced(self) -> list[int] | None:
        """Memory that the workers announce, bytes, one entry a worker that does; None while no worker is there."""
        now = self._clock()
        if now - self._asked_s >= (self._every_s if self._announced is None else self.memory_s):
            try:
                identity = self._client.scheduler.identity
                found = self._client.sync(identity, n_workers=-1, callback_timeout=self._answer_s)
            except (OSError, TimeoutError):
                # `look` tells whether it is lost; what was known still counts
                self.check()
            else:
                self._announced = announced_bytes(found["workers"]) if found["workers"] else None
            self._asked_s = self._clock()
        return self._announced

    def check(self) -> None:
        """See that the scheduler is there.

        Raises
        ------
        ClusterError
            It is not.
        """
        if self._client.status != "running":
            raise self.lost("the connection to it broke")

    def lost(self, why: str) -> ClusterError:
        """The error of a lost scheduler."""
        return ClusterError(f"the scheduler {self._address} was lost: {why}. Start it, then the run again")

    def look(self, stage: str, watch: Watch) -> None:
        """Count the workers, at most once a second, and tell where none are left, or are back.

        Raises
        ------
        ClusterError
            The scheduler is lost.
        """
        self.check()
        now = self._clock()
        if now - self._looked_s < self._every_s:
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
            self._looked_s = self._clock()
        self._answered_s = self._looked_s
        self.threads = sum(running.values())
        self._on_count(len(running))
        self._tell(stage, watch, self._looked_s)

    def _tell(self, stage: str, watch: Watch, now: float) -> None:
        if self.threads:
            if self._told_s is not None and self._bare_since_s is not None:
                message = f"workers are there after {now - self._bare_since_s:.0f} s, threads: {self.threads}"
                watch.listener(Event(kind="run", stage=stage, message=message))
            self._bare_since_s = self._told_s = None
            return
        if self._bare_since_s is None:
            self._bare_since_s = now
        bare_s = now - self._bare_since_s
        if bare_s < self.grace_s or (self._told_s is not None and now - self._told_s < self.repeat_s):
            return
        self._told_s = now
        message = f"no worker has been there for {bare_s:.0f} s: the run goes on as soon as one is. {self._advice}"
        watch.listener(Event(kind="waiting", stage=stage, message=message))


@dataclasses.dataclass
class Dispatch(Generic[Task, Result]):
    """The tasks of one stage, on their way through the cluster."""

    client: Any
    monitor: ClusterMonitor
    stage: str
    function: Callable[[Task], Result]
    tasks: Sequence[Task]
    watch: Watch
    priority: int = 0
    settle_s: float = SETTLE_S

    def __post_init__(self) -> None:
        """Nothing is on its way yet."""
        self._needs = {n: need for n, task in enumerate(self.tasks) if (need := declared_bytes(task))}
        self._waiting = deque(n for n in range(len(self.tasks)) if n not in self._needs)
        self._large = deque(self._needs)
        self._reserved: dict[Any, int] = {}
        self._told = False
        self._suspects: deque[int] = deque()
        self._flying: dict[Any, int] = {}
        self._alone: Any = None
        self._wake = threading.Event()
        self._name = uuid.uuid4().hex[:12]
        self._submitted = 0

    def results(self) -> Generator[Measured[Result], None, None]:
        """Results as they come.

        Raises
        ------
        RunCancelledError
            The watch called the run off.
        ClusterError
            The scheduler was lost.
        RunError
            Workers died again and again on one task, also when it ran alone.
        """
        try:
            while self._large or self._waiting or self._suspects or self._flying:
                self.watch.check_cancelled()
                self.monitor.look(self.stage, self.watch)
                self._reconsider()
                self._submit()
                self._wake.wait(TICK_S)
                self._wake.clear()
                for future in [future for future in self._flying if future.status in _ENDED]:
                    yield from self._landed(future)
        except KeyboardInterrupt:
            self.settle_s = min(self.settle_s, SETTLE_INTERRUPTED_S)
            raise
        except GableworkError:
            raise
        except Exception as error:
            # what a client says that has just lost its scheduler comes in many kinds
            if self.client.status != "running":
                raise self.monitor.lost(f"{type(error).__name__}: {error}") from error
            raise
        finally:
            self._settle()

    def _submit(self) -> None:
        """Send off what may fly now: a window of tasks, or a suspect all alone."""
        if self._suspects:
            if not self._flying and self._take_turn():
                number = self._suspects.popleft()
                largest = max(self.monitor.announced() or (), default=0)
                self._send(number, min(self._needs.get(number, 0), largest))
            return
        if self._alone is not None:
            # the last suspect still flies: nothing may be blamed in its place
            return
        window = TASKS_PER_THREAD * max(2, self.monitor.threads)
        self._submit_large(window)
        # those that wait for memory do not keep the others from going
        while self._waiting and len(self._flying) - len(self._reserved) < window:
            self._send(self._waiting.popleft())

    def _submit_large(self, window: int) -> None:
        """Send off tasks that need much memory: as many as the workers can take, and as many again on their way."""
        if not self._large:
            return
        announced = self.monitor.announced()
        if announced is None:
            return
        if not announced:
            self._tell_once(
                f"{len(self._large)} tasks of {self.stage} need much memory (up to {self._most()}) and no worker "
                f"announces how much it has: they run anywhere. Use gablework worker, or dask worker --resources "
                f"{RESOURCE}=BYTES"
            )
            while self._large and len(self._flying) < window:
                self._send(self._large.popleft())
            return
        largest, room = max(announced), _AHEAD * sum(announced)
        if max(self._needs[number] for number in self._large) > largest:
            self._tell_once(
                f"tasks of {self.stage} need up to {self._most()} of memory, the largest worker has "
                f"{largest / 2**30:.1f} GiB: they run there with all that it has. Give it more, or add a larger one"
            )
        while self._large:
            need = min(self._needs[self._large[0]], largest)
            if self._reserved and sum(self._reserved.values()) + need > room:
                return
            self._send(self._large.popleft(), need)

    def _reconsider(self) -> None:
        """Take back tasks that wait for memory which no worker has any more; they are sent anew."""
        if not self._reserved:
            return
        announced = self.monitor.announced()
        if announced is None:
            return
        largest = max(announced, default=0)
        for future, need in list(self._reserved.items()):
            if need > largest and future.status not in _ENDED:
                self._large.appendleft(self._flying[future])
                self._drop(future, "sent again")

    def _most(self) -> str:
        return f"{max(self._needs.values()) / 2**30:.1f} GiB"

    def _tell_once(self, message: str) -> None:
        if not self._told:
            self._told = True
            self.watch.listener(Event(kind="warning", stage=self.stage, message=message))

    def _send(self, number: int, need_bytes: int = 0) -> None:
        self._submitted += 1
        task = packed(self.function, self.tasks[number])
        future = self.client.submit(
            measure_packed,
            fingerprint(),
            task,
            self.stage,
            key=f"{self.stage}-{self._name}-{number}-{self._submitted}",
            pure=False,
            priority=self.priority,
            resources={RESOURCE: need_bytes} if need_bytes else None,
        )
        self._flying[future] = number
        if need_bytes:
            self._reserved[future] = need_bytes
        TALLIES.send(self.stage, len(task))
        future.add_done_callback(lambda _: self._wake.set())

    def _take_turn(self) -> bool:
        """Whether it is this run's turn to try a suspect: one at a time on the whole cluster, lest two are blamed."""
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
        """What became of a task that is no longer pending: its result, or another try."""
        from distributed.scheduler import KilledWorker

        if future.status == "cancelled":
            self.monitor.check()
            raise self.monitor.lost("it no longer knows the tasks of this run")
        number = self._flying[future]
        if future.status == "error":
            try:
                error = future.exception(timeout=_RESULT_S)
            except TimeoutError:
                # a busy cluster: it is looked at again
                self.monitor.check()
                return
            if isinstance(error, RunCancelledError) and not self.watch.cancelled():
                raise RunError(_NOT_SHARED) from error
            if not isinstance(error, KilledWorker):
                raise error
            if self._alone is not None:
                raise RunError(blame(self.stage, self.tasks[number])) from error
            self._drop(future, "suspect")
            LOG.warning("workers died of the task: it is tried alone", extra=self._facts(number))
            self._suspects.append(number)
            return
        try:
            measured = future.result(timeout=_RESULT_S)
        except (TimeoutError, OSError):
            # its worker died with the result: it is made again, and looked at again
            self.monitor.check()
            return
        self._drop(future, "done")
        self._end_turn()
        yield measured

    def _facts(self, number: int) -> dict[str, object]:
        """The ids of a task, for the log."""
        return {"stage": self.stage, **facts_of_task(self.tasks[number])}

    def _drop(self, future: Any, outcome: str) -> None:
        del self._flying[future]
        self._reserved.pop(future, None)
        TALLIES.land(self.stage, outcome)
        future.release()

    def _settle(self) -> None:
        """Tell the tasks in flight to end, wait for those that run, take all back."""
        if not self._flying:
            return
        self.watch.stop()
        deadline = time.monotonic() + self.settle_s
        flying = list(self._flying)
        try:
            while time.monotonic() < deadline and self.client.status == "running":
                flying = [future for future in flying if future.status not in _ENDED]
                if not flying or not self._executing(flying):
                    break
                self._wake.wait(TICK_S)
                self._wake.clear()
            if self.client.status == "running":
                self.client.cancel(list(self._flying), force=True)
                self._end_turn()
        except (OSError, TimeoutError):
            # the scheduler went away meanwhile, and the tasks with it
            pass
        for _ in self._flying:
            TALLIES.land(self.stage, "taken back")
        self._flying.clear()
        self._reserved.clear()

    def _executing(self, futures: list[Any]) -> bool:
        """Whether any of these runs just now; those that only queue are taken back without a wait."""
        keys = [future.key for future in futures]
        try:
            stacks = self.client.sync(self.client.scheduler.call_stack, keys=keys, callback_timeout=_RESULT_S)
        except KeyError:
            # the scheduler did not take them
            return False
        return any(stacks.values())
