"""Runs attempts and writes their outcome: success, failure, another try or dismissal."""

from __future__ import annotations

import contextlib
import secrets
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.backoff import Backoff, Pauses
from pipeline.errors import ClusterError, GableworkError, RunCancelledError
from service import traces
from service.disk import FULL_BYTES, has_no_space
from service.driver import workplace
from service.driver.attempt_process import DriverParts, InOwnProcess
from service.driver.failures import failure_of, is_tried_again
from service.driver.leased_job import LOG, LeasedJob, Stop
from service.driver.loops import DATABASE
from service.driver.so_far import shown_while_watched
from service.errors import (
    AttemptEndedError,
    LeaseLostError,
    NoProcessError,
    NoSpaceError,
    ServiceError,
    StoreError,
    UnexpectedError,
)
from service.jobs import EndedAttempt, JobStatus, LogLevel
from service.store.policies import after_end

LOST_CLUSTER = Backoff(first_s=2.0, longest_s=60.0)
"""Pauses until a job whose cluster was lost is tried again."""
NO_SPACE_PAUSE_S = 30.0
"""Seconds until a job that the disk had no room for is tried again: others may end by then."""
LAST_PAUSE_S = 1.0
"""Seconds before the last try of a driver that ends."""


class Attempts:
    """Runs attempts to their end.

    Parameters
    ----------
    parts : DriverParts
        Store, folder, cluster.
    perform : InOwnProcess
        Does the work.
    name : str
        Name of the driver, for messages.
    ending : threading.Event
        Set when the driver ends: it then waits for the database no longer than one more try.
    """

    def __init__(self, parts: DriverParts, perform: InOwnProcess, *, name: str, ending: threading.Event) -> None:
        self._parts = parts
        self._perform = perform
        self._name = name
        self._ending = ending

    def work(self, held: LeasedJob) -> None:
        """Run one attempt and write its outcome."""
        LOG.info("the job runs", extra=held.facts)
        with held:
            try:
                message, summary = self._worked(held)
            except BaseException as error:  # noqa: BLE001 - every exception must end the job, not the driver
                held.rest()
                self._end_early(held, error)
                return
            held.rest()
            held.end_stage()
            done = self._settle(
                held,
                lambda: self._parts.store.succeed(held.job, message=message, summary=summary),
                JobStatus.SUCCESSFUL,
            )
        if done:
            LOG.info("the job succeeded: %s", message, extra=held.facts)
            self._forget(held, before=True)
        elif done is False:
            self._forget(held)
        else:
            try:
                workplace.leave_end(self._parts.folder, held.job, message, summary)
            except OSError as error:
                LOG.warning("the job must be run again: %s", error, extra=held.facts)

    def _worked(self, held: LeasedJob) -> tuple[str, dict[str, Any]]:
        """The result of the work, whose files are in the attempt's folder."""
        folder, job = self._parts.folder, held.job
        if held.cancelled():
            raise RunCancelledError("the job was cancelled")
        found = workplace.take_over_end(folder, job)
        if found is not None:
            return found
        place, is_resumed = workplace.take(folder, job)
        held.place = place
        if is_resumed:
            held.note("the attempt goes on where the one before stopped")
        with contextlib.ExitStack() as shown:
            if job.request.process_id == "reconstruct":
                shown.enter_context(shown_while_watched(held, place / "run", folder.so_far(job.job_id, job.attempt)))
            done = self._perform(held, place)
        workplace.deliver(place, folder, job)
        return done

    def _end_early(self, held: LeasedJob, error: BaseException) -> None:
        """Write the outcome of an attempt that did not succeed: dismissed, given back, tried again or failed."""
        job, reason = held.job, held.stopped_for
        if reason is not None:
            level = "cancelled" if isinstance(error, RunCancelledError) else f"ended with {type(error).__name__}"
            LOG.info("the attempt was %s: %s", level, reason.name.lower(), extra=held.facts)
        if reason is Stop.DISMISSED:
            self._forget(held, whole=True)
            self._settle(held, lambda: self._parts.store.dismissed(job), JobStatus.DISMISSED)
            return
        if reason is Stop.NO_SPACE:
            error = NoSpaceError("the disk is full except for its reserve")
        elif reason is Stop.STALLED:
            error = AttemptEndedError(f"made no progress for {held.step_s:g} s", is_own=True)
        elif reason is not None:
            is_handed_back = reason is Stop.RELEASED and self._hand_back(held)
            if not is_handed_back:
                self._forget(held)
            message = f"driver {self._name} ended; the job waits for another" if reason is Stop.RELEASED else ""
            lost = reason is Stop.LOST
            self._settle(held, lambda: self._parts.store.release(job, lost=lost, message=message), JobStatus.ACCEPTED)
            return
        elif self._is_full(error):
            error = NoSpaceError(f"the disk is full ({type(error).__name__})")
        if isinstance(error, AttemptEndedError):
            self._end_by_itself(held, error)
            return
        if isinstance(error, NoProcessError):
            self._wait_for_room(held, error)
            return
        reference = secrets.token_hex(4)
        facts: dict[str, Any] = {**held.facts, "reference": reference}
        expected = isinstance(error, GableworkError | ServiceError) and not isinstance(error, UnexpectedError)
        LOG.warning("the attempt failed: %s", error, extra=facts, exc_info=None if expected else error)
        kind = error.kind if isinstance(error, UnexpectedError) else type(error).__name__
        held.note(f"the attempt failed: {kind} (reference {reference})", level=LogLevel.WARNING)
        if isinstance(error, ClusterError) and held.engine is not None:
            self._parts.cluster.replace(held.engine)
        is_again = is_tried_again(error, job, self._parts.settings.max_attempts)
        if not (is_again and isinstance(error, ClusterError) and self._hand_back(held)):
            self._forget(held)
        if is_again:
            lost_s = LOST_CLUSTER.bound_s(job.lost_attempts + 1)
            pause = NO_SPACE_PAUSE_S if isinstance(error, NoSpaceError) else lost_s
            message = f"waiting: {held.scrub(str(error))}; tried again in {pause:g} s"
            lost = isinstance(error, ClusterError | NoSpaceError)
            self._settle(
                held,
                lambda: self._parts.store.release(job, lost=lost, message=message, retry_after_s=pause),
                JobStatus.ACCEPTED,
            )
            return
        failure = failure_of(error, scrub=held.scrub, reference=reference, attempts=job.lost_attempts + 1)
        self._settle(held, lambda: self._parts.store.fail(job, failure), JobStatus.FAILED)

    def _end_by_itself(self, held: LeasedJob, error: AttemptEndedError) -> None:
        """Write the outcome of an attempt whose process ended first: it is tried again, or the job failed."""
        job, settings = held.job, self._parts.settings
        LOG.error("the attempt %s at stage %r", error, held.stage, extra=held.facts)
        held.note(f"the attempt {error} at stage {held.stage}", level=LogLevel.ERROR)
        ended = EndedAttempt(stage=held.stage, detail=str(error), is_own=error.is_own)
        status = after_end(job, ended, settings.max_attempts)
        if status is JobStatus.FAILED and held.place is not None:
            self._so_far_is_over(held)
            workplace.keep_inputs(held.place)
        else:
            self._forget(held)
        self._settle(
            held,
            lambda: self._parts.store.end_attempt(
                job, ended, max_attempts=settings.max_attempts, kept_days=settings.stalled_days
            ),
            status,
        )

    def _wait_for_room(self, held: LeasedJob, error: NoProcessError) -> None:
        """Give a job back that could not begin, as it is."""
        LOG.warning("the attempt cannot begin: %s", error, extra=held.facts)
        self._hand_back(held)
        message = f"waiting: {error}; tried again in {NO_SPACE_PAUSE_S:g} s"
        self._settle(
            held,
            lambda: self._parts.store.release(held.job, lost=False, message=message, retry_after_s=NO_SPACE_PAUSE_S),
            JobStatus.ACCEPTED,
        )

    def _hand_back(self, held: LeasedJob) -> bool:
        """Leave the folder of an attempt for the next one; whether that worked."""
        if held.place is None:
            return False
        self._so_far_is_over(held)
        try:
            workplace.hand_back(held.place, held.job)
        except OSError as error:
            LOG.warning("the next attempt begins anew: %s", error, extra=held.facts)
            return False
        return True

    def _so_far_is_over(self, held: LeasedJob) -> None:
        """Remove the buildings that readers saw so far: those of the next attempt replace them."""
        shutil.rmtree(self._parts.folder.so_far(held.job.job_id, held.job.attempt), ignore_errors=True)

    def _is_full(self, error: BaseException) -> bool:
        """Whether the full disk is the cause. What a worker met arrives in words, so the disk is looked at, too."""
        if isinstance(error, StoreError):
            return False
        return has_no_space(error) or self._parts.folder.disk.free_bytes < FULL_BYTES

    def _settle(self, held: LeasedJob, write: Callable[[], None], status: JobStatus) -> bool | None:
        """Write the outcome of an attempt, as soon as the database answers; False if the lease is lost.

        If the answer to a commit was lost, the job already has this status at this attempt; its span, which the store
        makes after a commit, is then made here. None if the driver must end before the outcome is known: the job goes
        back to the queue when its lease has ended, and the next driver finds what was done.
        """
        pauses, is_last, is_repeated = Pauses(DATABASE), False, False
        while True:
            try:
                try:
                    with contextlib.suppress(LeaseLostError):
                        held.write()
                    write()
                except LeaseLostError as error:
                    known = self._parts.store.attempts([held.job.job_id]).get(held.job.job_id)
                    if is_repeated and known is not None and known[0].is_over and known[1] == held.job.attempt:
                        traces.job_ended(held.job, known[0])
                    if known == (status, held.job.attempt):
                        return True
                    LOG.warning("the attempt does not count: %s", error, extra=held.facts)
                    return False
            except StoreError as error:
                LOG.warning("the end of the attempt cannot be written yet: %s", error, extra=held.facts)
                is_repeated = True
                if is_last:
                    return None
                if self._ending.is_set():
                    time.sleep(LAST_PAUSE_S)
                is_last = self._ending.wait(pauses.next_s())
            else:
                return True

    def _forget(self, held: LeasedJob, *, whole: bool = False, before: bool = False) -> None:
        """Remove the folder of this attempt, of the whole job, or of the attempts before this one."""
        job, folder = held.job, self._parts.folder
        if whole:
            workplace.discard(folder.job(job.job_id))
        elif before:
            for number in range(1, job.attempt):
                workplace.discard(folder.attempt(job.job_id, number))
        else:
            for place in {held.place, folder.attempt(job.job_id, job.attempt)} - {None}:
                assert isinstance(place, Path)
                workplace.discard(place)
