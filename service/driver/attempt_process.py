"""Each attempt in a process of its own, watched from here: it can be ended alone, and its neighbours go on.

The process is forked from one that has loaded everything. It is ended if it does not stop in time, makes no progress,
or takes too much memory; then the slot of the driver is free again, whatever a library does in there. One whose attempt
succeeded waits for the next one, which finds everything in use already: a small job is as fast as in the driver itself.
"""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.errors import RunCancelledError, RunError
from pipeline.io.temporary import remove_left_folders
from pipeline.runtime.isolation.child_messages import Finished, OutOfMemory, Progressed
from pipeline.runtime.isolation.child_pool import ChildPool
from pipeline.runtime.isolation.supervision import SupervisedChild, system_kills
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.scratch.folder import PULSE
from service.disk import has_no_space
from service.driver.attempt_child import (
    LOADS,
    End,
    Lent,
    Moved,
    Name,
    Note,
    Order,
    WorkersMissing,
    WorkersWanted,
    attend,
)
from service.driver.kernels import Kernels
from service.driver.leased_job import LOG, LeasedJob, Stop
from service.driver.shared_cluster import SharedCluster
from service.errors import AttemptEndedError, NoProcessError, NoSuchUploadError
from service.files import StateFolder
from service.jobs import Upload
from service.settings import ServiceSettings
from service.store import JobStore

_LOOK_S = 0.5
"""Seconds between two looks at the memory of the process, and at the pulse of its workers."""
_NEAR = 0.9
"""Share of the limit from which a process that was killed counts as out of memory."""
_PULSES = tuple(Path(folder, "scratch", PULSE) for folder in ("run/scratch", "comparison/scratch"))
"""Where the tasks of an attempt note that they get somewhere, below its folder."""
_MOST_ATTEMPTS = 50
"""Attempts of a process, one after the other: what libraries lose little by little is given back."""
_KEPT_BYTES = 2**29
"""Memory up to which a process may wait for the next attempt."""
_KEPT_SPACE_BYTES = 2**31
"""The same for its address space, of which Arrow returns nothing: after a small job it is 1.3 GiB, 1.8 on 64 cores."""
_MARGIN_BYTES = 2**30
"""Allowance above the limit: a process reserves more address space than it uses."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DriverParts:
    """The parts of a driver that its attempts use."""

    settings: ServiceSettings
    folder: StateFolder
    store: JobStore
    cluster: SharedCluster


class InOwnProcess:
    """Attempts in processes of their own.

    Parameters
    ----------
    parts : DriverParts
        Settings, folder, store, cluster.
    name : str
        Name of the driver.
    work : callable
        Called in the process with its order; `attend`, except in tests of processes that go wrong.
    kernels : Kernels, optional
        Compiles what attempts call; by default on this machine, unless the workers are elsewhere.
    """

    def __init__(
        self,
        parts: DriverParts,
        name: str,
        work: Callable[[Order], tuple[str, dict[str, Any]]] = attend,
        kernels: Kernels | None = None,
    ) -> None:
        self._parts = parts
        self._name = name
        self._work = work
        self._pool = ChildPool(stderr=sys.stderr.fileno())
        self._kernels = kernels or Kernels(compiles=parts.settings.scheduler is None)

    def preload(self) -> None:
        """Start the process from which attempts are forked, and the compilation of kernels."""
        self._kernels.start()
        self._pool.preload(LOADS)

    def wait_until_ready(self) -> None:
        """Wait for the kernels of most attempts."""
        self._kernels.wait_for_first()

    def close(self) -> None:
        """End all processes."""
        self._kernels.stop()
        self._pool.close()

    def __call__(self, held: LeasedJob, place: Path) -> tuple[str, dict[str, Any]]:
        """As `service.driver.attempt.perform`.

        Raises
        ------
        AttemptEndedError
            The process ended, or was ended, before the attempt.
        NoProcessError
            It cannot be started now.
        """
        self._kernels.wait_for(held)
        order = Order(
            job=held.job,
            settings=self._parts.settings,
            place=place,
            uploads=_uploads(self._parts.store, held),
            driver=self._name,
        )
        # what befell an attempt may come from those before it in its process
        is_retry = held.job.own_ends > 0
        with contextlib.ExitStack() as stack:
            # what it unpacked stays behind if it is ended
            stack.callback(remove_left_folders)
            try:
                child = stack.enter_context(self._pool.borrowed(held.cancelled, fresh=is_retry, loads=LOADS))
            except RunCancelledError:
                raise
            except (RunError, OSError, RuntimeError) as error:
                if has_no_space(error):
                    raise
                raise NoProcessError(
                    f"this machine has no room for its process now ({type(error).__name__})"
                ) from error
            # the pool ends a child that an error leaves
            done = _Attended(held, child, order, self._parts.cluster).result(self._work)
            if is_retry or held.cancelled() or _is_worn(child, order.settings.attempt_memory_bytes):
                child.end()
            return done


def _is_worn(child: SupervisedChild, limit_bytes: int) -> bool:
    """Whether a process has done or holds so much that the next attempt begins in another one."""
    return (
        child.begun >= _MOST_ATTEMPTS
        or child.memory_bytes > _KEPT_BYTES
        or child.address_space_bytes > min(_KEPT_SPACE_BYTES, limit_bytes)
    )


def _uploads(store: JobStore, held: LeasedJob) -> dict[str, Upload]:
    """The uploads of a job that exist, by id."""
    found = {}
    for upload_id in held.job.request.upload_ids:
        with contextlib.suppress(NoSuchUploadError):
            found[upload_id] = store.upload(upload_id)
    return found


class _Attended:
    """One process, seen from its driver."""

    def __init__(self, held: LeasedJob, child: SupervisedChild, order: Order, cluster: SharedCluster) -> None:
        self._held = held
        self._child = child
        self._order = order
        self._cluster = cluster
        self._limit_bytes = order.settings.attempt_memory_bytes
        self._used_bytes = 0
        self._looked_s = 0.0
        self._pulse_ns = 0
        self._ending_s: float | None = None

    def result(self, work: Callable[[Order], tuple[str, dict[str, Any]]]) -> tuple[str, dict[str, Any]]:
        """The result of the attempt; raises as `perform`, and AttemptEndedError."""
        kills, begun = system_kills(), self._child.begun
        limit = self._limit_bytes + _MARGIN_BYTES
        for word in self._child.converse(work, self._order, data_limit_bytes=limit):
            if isinstance(word, Finished):
                done: tuple[str, dict[str, Any]] = word.result
                return done
            if isinstance(word, OutOfMemory):
                raise AttemptEndedError(f"asked for more than {self._allowed}", is_own=True)
            if word is None:
                self._look()
            else:
                self._take(word)
        self._check_wanted()
        if begun and self._child.begun == begun:
            raise NoProcessError("the process that waited for it has ended")
        detail = self._child.how_it_ended().removeprefix("its process ")
        if self._child.return_code != -signal.SIGKILL:
            raise AttemptEndedError(detail, is_own=True)
        if self._used_bytes >= _NEAR * self._limit_bytes or system_kills() > kills:
            raise AttemptEndedError("was ended by the system, which ran out of memory", is_own=True)
        raise AttemptEndedError("was killed from outside", is_own=False)

    @property
    def _allowed(self) -> str:
        return f"the {self._limit_bytes / 2**30:g} GiB that a job's process may take (GABLEWORK_ATTEMPT_MEMORY_BYTES)"

    def _take(self, word: object) -> None:
        """Take a word of the process."""
        match word:
            case Event():
                self._held.record(word)
            case Moved() | Progressed():
                self._held.move()
            case Note():
                self._held.note(word.message, level=word.level, **word.facts)
            case Name():
                self._held.scrub.name(word.path, word.name)
            case WorkersWanted():
                self._cluster.wait_until_there(self._held)
                engine = self._held.engine = self._cluster.engine()
                self._child.answer(Lent(engine.address, engine.embedded))
            case WorkersMissing():
                if self._held.engine is not None:
                    self._held.engine.mend(word.present)

    def _look(self) -> None:
        """Look at what the attempt takes, and whether it must end."""
        now_s = time.monotonic()
        if now_s - self._looked_s >= _LOOK_S:
            self._looked_s = now_s
            self._look_at_pulse()
            self._used_bytes = self._child.memory_bytes or self._used_bytes
            if self._used_bytes > self._limit_bytes:
                self._child.kill()
                raise AttemptEndedError(f"took more than {self._allowed}", is_own=True)
        if not self._held.cancelled():
            return
        if self._ending_s is None:
            self._ending_s = now_s
            self._child.answer(End())
            if self._held.stopped_for is Stop.STALLED:
                # where it stands still, for the operator
                self._child.show_trace()
        elif now_s - self._ending_s >= self._order.settings.stop_s:
            LOG.warning("the process of the attempt does not stop and is ended", extra=self._held.facts)
            self._child.kill()
            self._check_wanted()

    def _check_wanted(self) -> None:
        if self._held.stopped_for is not None:
            raise RunCancelledError("the job was cancelled")

    def _look_at_pulse(self) -> None:
        """Count what the workers do as progress: their tasks and buildings, of which the run hears only at the end."""
        for pulse in _PULSES:
            with contextlib.suppress(OSError):
                beaten_ns = (self._order.place / pulse).stat().st_mtime_ns
                if beaten_ns > self._pulse_ns:
                    self._pulse_ns = beaten_ns
                    self._held.move()
