"""The driver's process: slots that claim and work, the clock of the schedules, signals, draining, the janitor."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import secrets
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType

from pipeline.backoff import Pauses
from pipeline.errors import ClusterError
from pipeline.io.temporary import remove_left_folders
from pipeline.schedule import Outcome
from service.driver.attempt_process import DriverParts, InOwnProcess
from service.driver.attempt_records import Attempts
from service.driver.disk_watch import LOOK_S, DiskWatch
from service.driver.driver_logs import configure, quieten
from service.driver.janitor import tidy
from service.driver.job_progress import StepLimits
from service.driver.leased_job import LOG, LeasedJob, Stop
from service.driver.loops import DATABASE, repeat
from service.driver.shared_cluster import SharedCluster
from service.driver.webhooks import Sender
from service.errors import LeaseLostError, StoreError
from service.files import StateFolder
from service.input_policy import check_hosts
from service.settings import ServiceSettings
from service.store import JobStore

TIDY_S = 180.0
"""Seconds between two rounds of the janitor."""
BEAT_S = 1.0
"""Seconds between two signs of life for the parent."""
_GRACE_S = 4.0
"""Seconds, after those in which a job's process must stop, in which the outcome of its attempt must be written."""
_TICK_S = 0.1


class Driver:
    """Claims jobs and runs them, `driver_jobs` at once, until it is stopped.

    Parameters
    ----------
    settings : ServiceSettings
        Database, state folder, cluster, lease.
    name : str, optional
        Unique name of this process; made up by default.
    parent_pipe : int, optional
        A file descriptor: when its other end closes, the parent is gone and the driver ends at once. Into a socket the
        driver writes a byte every second as long as it works.
    perform : callable, optional
        Makes what does the work of attempts, from the parts of the driver and its name.
    cluster : SharedCluster, optional
        The workers.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        *,
        name: str | None = None,
        parent_pipe: int | None = None,
        perform: Callable[[DriverParts, str], InOwnProcess] = InOwnProcess,
        cluster: SharedCluster | None = None,
    ) -> None:
        self.name = name or f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(3)}"
        self._settings = settings
        self._parent_pipe = parent_pipe
        self._store = JobStore(settings.database, wait_s=settings.database_wait_s)
        self._cluster = cluster or SharedCluster(settings)
        folder = StateFolder(settings.state.resolve(), settings.reserve_bytes)
        self._parts = DriverParts(settings=settings, folder=folder, store=self._store, cluster=self._cluster)
        self._perform = perform(self._parts, self.name)
        self._held: dict[str, LeasedJob] = {}
        self._busy = 0
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._at_once = threading.Event()
        self._attempts = Attempts(self._parts, self._perform, name=self.name, ending=self._stopping)
        self._disk_watch = DiskWatch(folder.disk, self._all_held)
        self._sender = Sender(self._store, folder, settings, name=self.name)
        self._ended = threading.Event()
        # the signal handler counts here, since it must not take a lock
        self._stops = 0
        self._parent_gone = False
        self._broken = False
        self._beaten_s = -math.inf

    # --- from outside

    def stop(self, *, at_once: bool = False) -> None:
        """End the driver. It takes no new jobs; running jobs get `drain_s`, or no time with `at_once`."""
        self._stops += 2 if at_once else 1

    def signalled(self) -> None:
        """End on a signal, and at once on the second one; with a parent only the first counts.

        A terminal and a service manager send signals to all processes of a service, and the parent passes them on, too.
        The parent also ends a driver at once if needed.
        """
        if self._parent_pipe is None or self._stops == 0:
            self.stop()

    def run(self) -> int:
        """Work until stopped.

        Returns
        -------
        int
            0 if all jobs are done or given back; 1 if a cancelled run did not end, or nothing could be started.
        """
        LOG.info("the driver starts", extra=self._facts)
        slots = [
            self._loop(f"slot-{number}", self._slot, "cannot claim a job")
            for number in range(self._settings.driver_jobs)
        ]
        clock = self._loop("clock", self._tick, "cannot read the schedules")
        janitor = self._loop("janitor", self._tidy, "the state folder could not be tidied")
        if self._parent_pipe is not None:
            threading.Thread(target=self._watch_parent, name="parent", daemon=True).start()
        threading.Thread(target=self._watch_disk, name="disk", daemon=True).start()
        threads = [*slots, clock, janitor, *self._sender.threads]
        starter = threading.Thread(target=self._start, args=(threads,), name="start", daemon=True)
        starter.start()
        self._wait_for_stop()
        with self._lock:
            self._stopping.set()
        clean = self._drain()
        self._ended.set()
        # only now: jobs that ended while it drained have news, too
        self._sender.stop()
        starter.join(_TICK_S)
        for thread in threads:
            if thread.ident is not None:
                thread.join(1.0 if clean else _TICK_S)
        self._perform.close()
        self._cluster.close()
        self._store.close()
        LOG.info("the driver has ended", extra=self._facts)
        return 0 if clean and not self._broken else 1

    # --- start and end

    def _start(self, threads: list[threading.Thread]) -> None:
        """Wait for the database, let the slots claim, then start the workers."""
        try:
            self._parts.folder.make()
            self._perform.preload()
            if not self._until_done(self._store.migrate, "the database cannot be migrated"):
                return
            # jobs that wait for kernels say so, and workers start when they find them compiled
            self._start_all(threads)
            self._perform.wait_until_ready()
            if self._stopping.is_set():
                return
            try:
                self._cluster.engine()
            except ClusterError as error:
                LOG.warning("no workers yet, tried again with the first job: %s", error, extra=self._facts)
        except Exception:  # noqa: BLE001 - without this thread the driver would look alive and claim nothing
            LOG.exception("the driver cannot start", extra=self._facts)
            self._broken = True
            return
        quieten()

    def _start_all(self, threads: list[threading.Thread]) -> None:
        for thread in threads:
            if not self._stopping.is_set():
                thread.start()

    def _wait_for_stop(self) -> None:
        while self._stops == 0 and not self._parent_gone and not self._broken:
            self._beat()
            time.sleep(_TICK_S)

    def _beat(self) -> None:
        """Let the parent know that this process works: that it gets its turn, and that no thread keeps the lock."""
        if self._parent_pipe is None or time.monotonic() - self._beaten_s < BEAT_S:
            return
        if self._lock.acquire(timeout=BEAT_S):
            self._lock.release()
            self._beaten_s = time.monotonic()
            # a pipe takes no answer; a parent that is gone is noticed elsewhere
            with contextlib.suppress(OSError):
                os.write(self._parent_pipe, b".")

    def _drain(self) -> bool:
        """Let running jobs finish, or give them back; whether all ended."""
        began_s = time.monotonic()
        held = self._all_held()
        # the rest is for handing back the jobs that are not done
        drain_s = max(0.0, self._settings.drain_s - self._settings.stop_s - _GRACE_S - BEAT_S)
        LOG.info("the driver ends: its %d running jobs get %g s", len(held), drain_s, extra=self._facts)
        while self._is_busy():
            out_of_time = time.monotonic() - began_s >= drain_s
            if out_of_time or self._stops > 1 or self._parent_gone:
                break
            self._beat()
            time.sleep(_TICK_S)
        self._at_once.set()
        for one in self._all_held():
            LOG.info("the job is given back", extra=one.facts)
            one.stop(Stop.RELEASED)
        deadline_s = time.monotonic() + self._settings.stop_s + _GRACE_S
        while self._is_busy() and time.monotonic() < deadline_s:
            time.sleep(_TICK_S)
        stuck = self._all_held()
        for one in stuck:
            LOG.error("the run does not end; the job is given back anyway", extra=one.facts)
            with contextlib.suppress(LeaseLostError, StoreError):
                self._store.release(one.job, lost=False)
        return not stuck

    def _is_busy(self) -> bool:
        """Whether a slot claims or works."""
        with self._lock:
            return self._busy > 0

    def _all_held(self) -> list[LeasedJob]:
        with self._lock:
            return list(self._held.values())

    def _watch_parent(self) -> None:
        """Block until the other end of the pipe is closed."""
        assert self._parent_pipe is not None
        with contextlib.suppress(OSError):
            while os.read(self._parent_pipe, 1):
                continue
        LOG.info("the parent is gone", extra=self._facts)
        self._parent_gone = True

    def _watch_disk(self) -> None:
        """Stop jobs that use the reserve, until the last one is over."""
        while not self._ended.wait(LOOK_S):
            try:
                self._disk_watch.look()
            except OSError as error:
                LOG.warning("the disk cannot be looked at: %s", error, extra=self._facts)

    # --- the slots

    def _slot(self) -> float:
        """Claim and work once; seconds until the next time."""
        with self._lock:
            # under the lock: the end of the driver must see every claim
            if self._stopping.is_set():
                return 0.0
            self._busy += 1
        try:
            return 0.0 if self._claim_and_work() else self._settings.poll_s
        finally:
            with self._lock:
                self._busy -= 1

    def _claim_and_work(self) -> bool:
        """Work on one job; whether there was one.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        if any(held.overdue for held in self._all_held()):
            # this machine slept: our own leases are renewed first, or our own jobs would count as lost
            return False
        if self._parts.folder.disk.is_short:
            return False
        settings, claimed_s = self._settings, time.monotonic()
        job = self._store.claim(self.name, lease_s=settings.lease_s, max_attempts=settings.max_attempts)
        if job is None:
            return False
        held = LeasedJob(
            self._store,
            job,
            lease_s=settings.lease_s,
            poll_s=settings.poll_s,
            claimed_s=claimed_s,
            step_s=StepLimits(
                stall_s=settings.stall_s, input_s=settings.input_timeout_s, building_s=settings.building_timeout_s
            ).of,
        )
        with self._lock:
            self._held[job.job_id] = held
        try:
            # it was claimed while the driver began to end, and was not stopped with the others
            if self._at_once.is_set():
                held.stop(Stop.RELEASED)
            self._attempts.work(held)
        finally:
            with self._lock:
                # another slot may have the job's next attempt by now
                if self._held.get(job.job_id) is held:
                    del self._held[job.job_id]
        return True

    # --- the clock of the schedules

    def _tick(self) -> float:
        """Decide which schedules are due and log it. Every driver does so; one of them decides each slot.

        Raises
        ------
        StoreError
            The database does not answer.
        """
        settings = self._settings
        for run in self._store.schedules.tick(limits=self._settings.queue_limits):
            level = logging.WARNING if run.outcome in {Outcome.MISSED, Outcome.FAILED} else logging.INFO
            line = "schedule %s, %d slots up to %s: %s: %s"
            facts = self._facts | {"schedule": run.schedule_id, "job": run.job_id}
            LOG.log(level, line, run.schedule_id, run.slots, run.slot, run.outcome, run.message, extra=facts)
        return settings.poll_s

    # --- the janitor

    def _tidy(self) -> float:
        """Remove what is not needed any longer; seconds until the next time."""
        try:
            # those of drivers that were killed
            removed = remove_left_folders()
            removed += tidy(self._store, self._parts.folder, self._settings)
        except (StoreError, OSError) as error:
            LOG.warning("the state folder could not be tidied: %s", error, extra=self._facts)
        else:
            if removed:
                LOG.info("tidied away %d folders", len(removed), extra=self._facts)
        return TIDY_S

    def _loop(self, name: str, action: Callable[[], float], complaint: str) -> threading.Thread:
        """A thread that repeats an action until the driver ends; not started yet."""
        stopping, given = self._stopping, {"complaint": complaint, "facts": self._facts}
        return threading.Thread(
            target=repeat, args=(action, stopping.wait, stopping.is_set), kwargs=given, name=name, daemon=True
        )

    def _until_done(self, action: Callable[[], None], complaint: str) -> bool:
        """Repeat an action until the database answers; False if the driver must end."""
        pauses = Pauses(DATABASE)
        while not self._stopping.is_set():
            try:
                action()
            except StoreError as error:
                wait_s = pauses.next_s()
                LOG.warning("%s, next try in %g s: %s", complaint, wait_s, error, extra=self._facts)
                self._stopping.wait(wait_s)
            else:
                return True
        return False

    @property
    def _facts(self) -> dict[str, object]:
        return {"driver": self.name}


def run_driver(settings: ServiceSettings, *, name: str | None = None, parent_pipe: int | None = None) -> int:
    """Claim jobs and run them until SIGTERM or SIGINT; a second signal ends it at once, unless it has a parent. Blocks.

    Parameters
    ----------
    settings : ServiceSettings
        Database, state folder, cluster, lease.
    name : str, optional
        Unique name of this process; made up by default.
    parent_pipe : int, optional
        A file descriptor: when its other end closes, the parent is gone and the driver ends at once.

    Returns
    -------
    int
        The process's exit code.

    Raises
    ------
    StartUpError
        The database URL cannot be used, or a listed host is not one.
    """
    check_hosts(settings)
    configure(as_json=settings.log_json)
    driver = Driver(settings, name=name, parent_pipe=parent_pipe)
    with _signals(driver):
        return driver.run()


@contextlib.contextmanager
def _signals(driver: Driver) -> Iterator[None]:
    """SIGTERM and SIGINT stop the driver."""

    def stop(number: int, frame: FrameType | None) -> None:
        del number, frame
        driver.signalled()

    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
