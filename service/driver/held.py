"""A job that this driver holds: a thread keeps the lease, looks for a dismissal, and writes down what happens."""

from __future__ import annotations

import logging
import threading
import time
from enum import IntEnum
from types import TracebackType
from typing import Protocol, Self

from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.monitoring.events import Event
from service.driver.progress import WORDS, percent
from service.driver.wording import Scrubber
from service.errors import LeaseLostError, StoreError
from service.jobs import Job, JobEvent
from service.store import JobStore

LOG = logging.getLogger("gablework.driver")

_FLUSH_S = 0.5
"""Progress is written at most so often."""
_MAX_PENDING = 500
"""Events that wait while the database is away; the oldest go first."""


class Engine(Protocol):
    """`pipeline.runtime.cluster.dask_executor.Cluster`."""

    def executor(self, priority: int = 0) -> Executor:
        """An executor for one run."""

    def __enter__(self) -> Self:
        """Start."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop."""


class Stop(IntEnum):
    """Why an attempt is to end before its time; a higher reason wins."""

    RELEASED = 1
    """The driver ends: the job goes back to the line."""
    DISMISSED = 2
    """The client does not want it any more."""
    LOST = 3
    """The job belongs to another driver, or may by now."""


class HeldJob:
    """Keeps a claimed job while it is worked on; a context manager.

    The lease is renewed from a thread of its own, three times within its length, whatever the run does. (The run's
    heavy work is in other processes; what it does in this one lets other threads run at least every few
    milliseconds, as numpy and pyarrow give up the interpreter's lock.) When the database does not answer for as long as
    the lease counts, another driver may have the job: then the attempt ends.

    Parameters
    ----------
    store : JobStore
        Where the job is.
    job : Job
        As it was claimed.
    lease_s : float
        Length of the lease.
    poll_s : float
        Seconds between looks for a dismissal.
    claimed_s : float
        `time.monotonic()` of a moment before the claim.
    """

    def __init__(self, store: JobStore, job: Job, *, lease_s: float, poll_s: float, claimed_s: float) -> None:
        self.job = job
        self._store = store
        self._lease_s = lease_s
        self._poll_s = min(poll_s, lease_s / 6.0)
        self._renewed_s = claimed_s
        self._renewed_at_s = time.time()
        self._written_s = claimed_s
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._stop: Stop | None = None
        self._stopped = threading.Event()
        self._over = threading.Event()
        self._pending: list[JobEvent] = []
        self._progress = 0
        self._waited = False
        self._pulse = threading.Thread(target=self._keep, name=f"lease-{job.job_id[:8]}", daemon=True)
        self.scrub = Scrubber()
        self.engine: Engine | None = None
        """The workers on which the attempt runs; None until it does."""

    def __enter__(self) -> Self:
        """Start the thread."""
        self._pulse.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the thread; the lease is left as it is."""
        self._over.set()
        self._pulse.join()

    @property
    def stopped_for(self) -> Stop | None:
        """Why the attempt is to end; None while it is not."""
        return self._stop

    def cancelled(self) -> bool:
        """Whether the attempt is to end; also where the database keeps the heartbeat waiting for too long."""
        if not self._stopped.is_set() and time.monotonic() - self._renewed_s >= self._lease_s:
            self.stop(Stop.LOST)
        return self._stopped.is_set()

    @property
    def overdue(self) -> bool:
        """Whether the lease should have been renewed long ago by the wall clock, which counts a machine's sleep too."""
        return not self.cancelled() and time.time() - self._renewed_at_s > self._lease_s / 2.0

    def wait(self, seconds: float) -> bool:
        """Wait, but not longer than the attempt may go on; whether it is to end."""
        return self._stopped.wait(seconds)

    def stop(self, reason: Stop) -> None:
        """Let the attempt end."""
        with self._lock:
            if self._stop is None or reason > self._stop:
                self._stop = reason
        self._stopped.set()

    def tell(self, event: Event) -> None:
        """Take what a run tells; it is written down soon, by another thread, so that the run never waits for it."""
        with self._lock:
            told = self._told(event)
            if told is None:
                return
            if told.kind == "progress":
                self._pending = [e for e in self._pending if (e.kind, e.stage) != ("progress", told.stage)]
            self._pending = [*self._pending, told][-_MAX_PENDING:]

    def write(self) -> None:
        """Write down what waits.

        Raises
        ------
        LeaseLostError
            The job is not held any more.
        StoreError
            The database does not answer; what waits goes on waiting.
        """
        with self._writing:
            with self._lock:
                pending, self._pending = self._pending, []
            if not pending:
                return
            try:
                self._store.record(self.job, pending)
            except StoreError:
                with self._lock:
                    self._pending = [*pending, *self._pending][-_MAX_PENDING:]
                raise
            self._written_s = time.monotonic()

    def _told(self, event: Event) -> JobEvent | None:
        """An event of a run in the words of the service; None for what clients need not know."""
        if event.kind == "finished" or (event.kind == "run" and not self._waited):
            return None
        # where nothing more is known, the stage itself says what happens; after a pause it says so again
        words = WORDS.get(event.stage, "") if event.kind == "stage" or self._waited else ""
        if event.kind == "stage" and event.message and words:
            # one of several methods, by its label
            message = f"{event.message}: {words}"
        else:
            message = event.message or words
        if event.kind != "warning":
            self._waited = event.kind == "waiting"
        if event.kind in {"stage", "progress"}:
            self._progress = max(self._progress, percent(event.stage, event.done, event.total))
        return JobEvent(
            sequence=0,
            at=self.job.updated_at,
            kind="stage" if event.kind == "run" else event.kind,
            stage=event.stage,
            done=event.done,
            total=event.total,
            progress=self._progress,
            message=self.scrub(message),
        )

    def _keep(self) -> None:
        """Renew, look and write, until the attempt is over."""
        while not self._over.wait(self._poll_s):
            try:
                self._look()
                if time.monotonic() - self._written_s >= _FLUSH_S:
                    self.write()
            except LeaseLostError as error:
                self.stop(Stop.LOST)
                # the attempt may just have written its own end
                if not self._over.wait(_FLUSH_S):
                    LOG.warning("%s", error, extra=self.facts)
                return
            except StoreError as error:
                # the thread goes on: should nobody have taken the job, it can still be given back
                if not self.cancelled():
                    silent_s = time.monotonic() - self._renewed_s
                    LOG.warning("no heartbeat for %.0f s: %s", silent_s, error, extra=self.facts)

    def _look(self) -> None:
        """Renew the lease where it is time, else look whether the job is to be dismissed."""
        now_s = time.monotonic()
        if now_s - self._renewed_s >= self._lease_s / 3.0 - self._poll_s:
            wanted = self._store.renew(self.job, lease_s=self._lease_s)
            self._renewed_s, self._renewed_at_s = now_s, time.time()
        else:
            wanted = self._store.still_held(self.job)
        if wanted:
            self.stop(Stop.DISMISSED)

    @property
    def facts(self) -> dict[str, object]:
        """What a line of the log tells beside its message."""
        return {"job": self.job.job_id, "attempt": self.job.attempt}
