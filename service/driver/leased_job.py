"""A job that this driver holds: a thread renews the lease, looks for a dismissal and writes events."""

from __future__ import annotations

import dataclasses
import logging
import math
import threading
import time
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from pipeline.runtime.monitoring.progress import Event
from service.driver.failure_words import Scrubber
from service.driver.job_log import AttemptLog
from service.driver.job_progress import CLASSIFY_WEIGHTS, WEIGHTS, WORDS, percent
from service.errors import LeaseLostError, StoreError
from service.jobs import Job, JobEvent, LogLevel
from service.store import JobStore

if TYPE_CHECKING:
    from pipeline.runtime.cluster.dask_executor import Cluster

LOG = logging.getLogger("gablework.driver")

_FLUSH_S = 0.5
"""Minimum seconds between two writes of progress."""
_WATCHED_S = 60.0
"""Seconds for which a job counts as watched after a client read its buildings."""
ABANDON_S = 120.0
"""Seconds after the request to stop from which an attempt that goes on loses its lease; its process is ended before."""
_MAX_PENDING = 500
"""Maximum number of events that wait while the database does not answer; the oldest are dropped first."""


class Stop(IntEnum):
    """Why an attempt must end early; a higher reason wins."""

    NO_SPACE = 1
    """Only the reserve of the disk is free: the job is tried again later."""
    STALLED = 2
    """It makes no progress."""
    RELEASED = 3
    """The driver ends: the job goes back to the queue."""
    DISMISSED = 4
    """The client dismissed it."""
    LOST = 5
    """The job belongs to another driver, or may belong to one by now."""


class LeasedJob:
    """Holds a claimed job while the driver works on it; a context manager.

    A thread renews the lease three times within its length, as long as the attempt gets somewhere: it is stopped when
    it makes no progress for longer than a step of its stage may take. If the attempt does not end although it was
    stopped, the lease is no longer renewed, and another driver takes the job. If the database does not answer for the
    length of the lease, another driver may have the job: the attempt ends.

    Parameters
    ----------
    store : JobStore
        The store with the job.
    job : Job
        As it was claimed.
    lease_s : float
        Length of the lease.
    poll_s : float
        Seconds between checks for a dismissal.
    claimed_s : float
        `time.monotonic()` of a moment before the claim.
    step_s : callable
        Seconds that one step of a stage may take, by the stage's name.
    """

    def __init__(
        self,
        store: JobStore,
        job: Job,
        *,
        lease_s: float,
        poll_s: float,
        claimed_s: float,
        step_s: Callable[[str], float],
    ) -> None:
        self.job = job
        self._store = store
        self._lease_s = lease_s
        self._poll_s = min(poll_s, lease_s / 6.0)
        self._step_s = step_s
        self.stage = ""
        """The stage that runs."""
        self._moved_s = claimed_s
        self._stopped_s = math.inf
        self._renewed_s = claimed_s
        self._renewed_at_s = time.time()
        self._written_s = claimed_s
        self._watched_at = job.watched_at
        self._watched_s: float | None = None
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._stop: Stop | None = None
        self._stopped = threading.Event()
        self._over = threading.Event()
        self._pending: list[JobEvent] = []
        self._progress = 0
        self._weights = CLASSIFY_WEIGHTS if job.request.process_id == "classify" else WEIGHTS
        self._waited = False
        self._is_silent = False
        self._pulse = threading.Thread(target=self._keep, name=f"lease-{job.job_id[:8]}", daemon=True)
        self.scrub = Scrubber()
        self._log = AttemptLog(self.scrub, WORDS)
        self.engine: Cluster | None = None
        """The workers that run the attempt; None before it runs."""
        self.place: Path | None = None
        """The folder in which the attempt works; None before it begins."""

    def __enter__(self) -> Self:
        """Start the thread."""
        self._pulse.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the thread; the lease stays as it is."""
        self._over.set()
        self._pulse.join()

    @property
    def stopped_for(self) -> Stop | None:
        """Why the attempt must end; None while it may go on."""
        return self._stop

    def cancelled(self) -> bool:
        """Whether the attempt must end; also if the database blocks the heartbeat for too long."""
        if not self._stopped.is_set() and time.monotonic() - self._renewed_s >= self._lease_s:
            self.stop(Stop.LOST)
        return self._stopped.is_set()

    @property
    def overdue(self) -> bool:
        """Whether the lease is overdue by the wall clock, which also counts the time that the machine slept."""
        return not self.cancelled() and time.time() - self._renewed_at_s > self._lease_s / 2.0

    @property
    def is_watched(self) -> bool:
        """Whether clients read the buildings that it has so far, since the attempt began."""
        return self._watched_s is not None and time.monotonic() - self._watched_s < _WATCHED_S

    def wait(self, seconds: float) -> bool:
        """Wait, at most until the attempt must end; returns whether it must."""
        return self._stopped.wait(seconds)

    def stop(self, reason: Stop) -> None:
        """Request the end of the attempt."""
        with self._lock:
            if self._stop is None or reason > self._stop:
                self._stop = reason
            self._stopped_s = min(self._stopped_s, time.monotonic())
        self._stopped.set()

    def move(self) -> None:
        """Note that the attempt got somewhere."""
        self._moved_s = time.monotonic()

    def rest(self) -> None:
        """Note that the work is over, and only its outcome must still be written: no progress is expected."""
        self._moved_s = math.inf

    @property
    def step_s(self) -> float:
        """Seconds that one step of the present stage may take."""
        return self._step_s(self.stage)

    @property
    def _left_s(self) -> float:
        """Seconds until the attempt counts as stalled."""
        return self.step_s - (time.monotonic() - self._moved_s)

    def record(self, event: Event) -> None:
        """Take an event of the run. Another thread writes it soon, and the run never waits for that."""
        self.move()
        with self._lock:
            if event.kind == "stage":
                self.stage = event.stage
            self._log.hear(event)
            shown = None if event.kind == "detail" else self._job_event(event)
            if shown is None:
                return
            if shown.kind == "progress":
                self._pending = [e for e in self._pending if (e.kind, e.stage) != ("progress", shown.stage)]
            self._pending = [*self._pending, shown][-_MAX_PENDING:]

    def note(self, message: str, *, level: LogLevel = LogLevel.INFO, **facts: Any) -> None:
        """Add a line to the job's log."""
        with self._lock:
            self._log.say(message, level=level, **facts)

    def end_stage(self) -> None:
        """Note in the job's log how its last stage ended."""
        with self._lock:
            self._log.end_stage()

    def write(self) -> None:
        """Write the events and the lines of the log that wait.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        StoreError
            The database does not answer; they continue to wait.
        """
        with self._writing:
            with self._lock:
                pending, self._pending = self._pending, []
                lines = self._log.take()
            if not pending and not lines:
                return
            now_s = time.monotonic()
            aged = [dataclasses.replace(line, age_s=max(0.0, now_s - said_s)) for said_s, line in lines]
            try:
                self._store.record(self.job, pending, aged)
            except StoreError:
                with self._lock:
                    self._pending = [*pending, *self._pending][-_MAX_PENDING:]
                    self._log.put_back(lines)
                raise
            self._written_s = time.monotonic()

    def _job_event(self, event: Event) -> JobEvent | None:
        """Translate an event of a run into one of the job; None if clients do not need it."""
        if event.kind == "finished" or (event.kind == "run" and not self._waited):
            return None
        # without a message, the stage is described; after a pause it is described again
        words = WORDS.get(event.stage, "") if event.kind == "stage" or self._waited else ""
        if event.kind == "stage" and event.message and words:
            # one of several methods, by its label
            message = f"{event.message}: {words}"
        else:
            message = event.message or words
        if event.kind != "warning":
            self._waited = event.kind == "waiting"
        if event.kind in {"stage", "progress"}:
            self._progress = max(self._progress, percent(event.stage, event.done, event.total, self._weights))
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
        """Renew the lease, check for a dismissal and write events until the attempt is over."""
        while not self._over.wait(self._poll_s):
            if self._left_s <= 0.0 and self._stop is None:
                LOG.error("no progress for %g s at stage %r: it is stopped", self.step_s, self.stage, extra=self.facts)
                self.stop(Stop.STALLED)
            if time.monotonic() - self._stopped_s > ABANDON_S:
                LOG.error("the attempt does not end: its lease is no longer renewed", extra=self.facts)
                self.stop(Stop.LOST)
                return
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
                # the thread goes on: if no other driver took the job, it can still be given back
                if not self.cancelled():
                    silent_s = time.monotonic() - self._renewed_s
                    LOG.warning("no heartbeat for %.0f s: %s", silent_s, error, extra=self.facts)
                    if not self._is_silent:
                        self.note("the database does not answer", level=LogLevel.WARNING)
                    self._is_silent = True
            else:
                self._is_silent = False

    def _look(self) -> None:
        """Renew the lease if that is due, otherwise check for a dismissal and for readers."""
        now_s = time.monotonic()
        if now_s - self._renewed_s >= self._lease_s / 3.0 - self._poll_s:
            wanted = self._store.renew(self.job, lease_s=self._lease_s, due_s=self._left_s)
            self._renewed_s, self._renewed_at_s = now_s, time.time()
        else:
            wishes = self._store.still_held(self.job)
            wanted = wishes.dismissal
            # by change: the clocks of database and driver may differ
            if wishes.watched_at != self._watched_at:
                self._watched_at, self._watched_s = wishes.watched_at, now_s
        if wanted:
            self.stop(Stop.DISMISSED)

    @property
    def facts(self) -> dict[str, object]:
        """Additional fields of a log line."""
        return {"job": self.job.job_id, "attempt": self.job.attempt}
