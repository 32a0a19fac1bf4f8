"""The operations of drivers on jobs: claim, renew, record, finish, give back."""

from __future__ import annotations

import builtins
import datetime as dt
import math
from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.jobs import EndedAttempt, Job, JobEvent, JobFailure, JobStatus, NewLogLine, Wishes
from service.store import logs
from service.store.changes import append, held_row, lock_held, move
from service.store.delivery_line import give_up_all
from service.store.policies import after_end, after_loss, loss, other_ends, own_ends, standstill
from service.store.queries import JobQueries, get
from service.store.records import job_of, storable
from service.store.tables import JOBS

_SWEPT_AT_ONCE = 100


class JobLeases(JobQueries):
    """What drivers do with jobs."""

    def claim(self, driver: str, *, lease_s: float, max_attempts: int) -> Job | None:
        """Claim the first job in the queue: highest priority, then oldest.

        Before that, jobs whose lease has ended go back into the queue, fail if they were lost `max_attempts` times,
        or are dismissed if that was requested.

        Parameters
        ----------
        driver : str
            Name of the driver, unique per process.
        lease_s : float
            Seconds for which the job is held, unless it is renewed.
        max_attempts : int
            Number of losses after which a job fails.

        Returns
        -------
        Job or None
            The job as it is now held; None if no job waits.
        """
        # most checks find nothing: they take no lock
        with self._database.read() as connection:
            now = self._database.now(connection)
            some = sa.select(JOBS.c.job_id).where(sa.or_(_claimable(now), _expired(now))).limit(1)
            if connection.execute(some).first() is None:
                return None
        with self._database.write() as connection:
            now = self._database.now(connection)
            lost = sa.select(JOBS).where(_expired(now)).order_by(JOBS.c.lease_until).limit(_SWEPT_AT_ONCE)
            for row in connection.execute(lost.with_for_update(skip_locked=True)).all():
                _give_up(connection, row, now=now, max_attempts=max_attempts, cause="was silent")
            job_id = _take_first(connection, driver, now=now, lease_s=lease_s)
            return None if job_id is None else get(connection, job_id, None)

    def give_up(self, driver: str, *, max_attempts: int) -> builtins.list[str]:
        """Take back the jobs of a driver that is known to be dead, before their leases end; returns their ids.

        They go back into the queue, fail if they were lost `max_attempts` times, or are dismissed if that was
        requested. Webhooks that it was sending are sent again.
        """
        held = sa.and_(JOBS.c.status == JobStatus.RUNNING.value, JOBS.c.lease_owner == storable(driver, 255))
        with self._database.write() as connection:
            now = self._database.now(connection)
            give_up_all(connection, driver)
            rows = connection.execute(sa.select(JOBS).where(held).with_for_update()).all()
            for row in rows:
                _give_up(connection, row, now=now, max_attempts=max_attempts, cause="ended")
            return [row.job_id for row in rows]

    def renew(self, job: Job, *, lease_s: float, due_s: float = math.inf) -> bool:
        """Hold a job for `lease_s` seconds from now; True if it must be dismissed.

        It counts as stalled if it is not renewed with a later `due_s`, seconds from now. An expired lease that no
        driver took can be renewed.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            row = lock_held(connection, job)
            until = now + dt.timedelta(seconds=lease_s)
            due_at = None if math.isinf(due_s) else now + dt.timedelta(seconds=due_s)
            renewed = sa.update(JOBS).where(JOBS.c.job_id == job.job_id)
            connection.execute(renewed.values(lease_until=until, progress_due_at=due_at))
            return bool(row.dismiss_requested)

    def still_held(self, job: Job) -> Wishes:
        """What clients want from a job that is held; only reads, and takes no lock.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        with self._database.read() as connection:
            row = held_row(connection, job)
            return Wishes(dismissal=bool(row.dismiss_requested), watched_at=row.watched_at)

    def record(self, job: Job, events: Sequence[JobEvent], lines: Sequence[NewLogLine] = ()) -> None:
        """Append events and lines of the log; progress, stage and message of the job follow the events.

        The store gives numbers and times.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        with self._database.write() as connection:
            row = lock_held(connection, job)
            now = self._database.now(connection)
            append(connection, row, events, now)
            logs.append(connection, row, lines, now, attempt=job.attempt)

    def succeed(self, job: Job, *, message: str, summary: Mapping[str, Any]) -> None:
        """End a job with success.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        self._finish(job, JobStatus.SUCCESSFUL, message=message, summary=dict(summary), progress=100)

    def fail(self, job: Job, failure: JobFailure) -> None:
        """End a job with a failure.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        self._finish(job, JobStatus.FAILED, message=failure.detail, **_failed_values(failure))

    def dismissed(self, job: Job) -> None:
        """End a job whose dismissal was requested: its driver has stopped.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        self._finish(job, JobStatus.DISMISSED, message="dismissed")

    def release(self, job: Job, *, lost: bool, message: str = "", retry_after_s: float = 0.0) -> None:
        """Put a job back into the queue; if its dismissal was requested, it ends instead.

        Parameters
        ----------
        job : Job
            As it was claimed.
        lost : bool
            Whether the attempt counts as lost.
        message : str
            The reason, for the client.
        retry_after_s : float
            Seconds during which it cannot be claimed.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            row = lock_held(connection, job)
            counted = {"lost_attempts": row.lost_attempts + int(lost)}
            if row.dismiss_requested:
                move(connection, row, JobStatus.DISMISSED, now=now, message="dismissed", **counted)
                return
            later = now + dt.timedelta(seconds=retry_after_s) if retry_after_s > 0.0 else None
            reason = message or f"driver {job.lease_owner} gave the job back; it waits for another"
            move(connection, row, JobStatus.ACCEPTED, now=now, message=reason, not_before=later, **counted)

    def end_attempt(self, job: Job, ended: EndedAttempt, *, max_attempts: int, kept_days: float) -> None:
        """Put a job back into the queue whose attempt's process ended, or end it after too many of them.

        Parameters
        ----------
        job : Job
            As it was claimed.
        ended : EndedAttempt
            What happened.
        max_attempts : int
            Number of attempts in a row that may end by themselves in one stage.
        kept_days : float
            Days for which the inputs of a job that failed so are kept.

        Raises
        ------
        LeaseLostError
            The job is no longer held.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            row = lock_held(connection, job)
            _end_attempt(connection, row, ended, now=now, max_attempts=max_attempts, kept_days=kept_days)

    def stalled(self) -> builtins.list[str]:
        """Ids of the running jobs that make no progress: none was seen in time, or their lease has ended."""
        with self._database.read() as connection:
            now = self._database.now(connection)
            late = sa.or_(JOBS.c.progress_due_at <= now, JOBS.c.lease_until <= now)
            found = sa.select(JOBS.c.job_id).where(JOBS.c.status == JobStatus.RUNNING.value, late)
            return list(connection.execute(found.order_by(JOBS.c.job_id)).scalars())

    def _finish(self, job: Job, status: JobStatus, *, message: str, **values: Any) -> None:
        with self._database.write() as connection:
            now = self._database.now(connection)
            move(connection, lock_held(connection, job), status, now=now, message=message, **values)


def _give_up(connection: Connection, row: sa.Row[Any], *, now: dt.datetime, max_attempts: int, cause: str) -> None:
    """Take back one locked job from a driver that was lost; `cause` is a verb, for the message."""
    job = job_of(row)
    status = after_loss(job, max_attempts)
    counted = {"lost_attempts": job.lost_attempts + 1}
    if status is JobStatus.FAILED:
        failure = loss(job)
        move(connection, row, status, now=now, message=failure.detail, **counted, **_failed_values(failure))
    elif status is JobStatus.DISMISSED:
        move(connection, row, status, now=now, message="dismissed; its driver was lost", **counted)
    else:
        reason = f"attempt {job.attempt} is lost: driver {job.lease_owner} {cause}; the job waits for another"
        move(connection, row, status, now=now, message=reason, **counted)


def _take_first(connection: Connection, driver: str, *, now: dt.datetime, lease_s: float) -> str | None:
    """Claim the first job in line; its id, or None."""
    line = sa.select(JOBS).where(_claimable(now)).order_by(JOBS.c.priority.desc(), JOBS.c.created_at, JOBS.c.job_id)
    row = connection.execute(line.limit(1).with_for_update(skip_locked=True)).one_or_none()
    if row is None:
        return None
    move(
        connection,
        row,
        JobStatus.RUNNING,
        now=now,
        message=f"attempt {row.attempt + 1} runs" if row.attempt else "runs",
        attempt=row.attempt + 1,
        lease_owner=storable(driver, 255),
        lease_until=now + dt.timedelta(seconds=lease_s),
        started_at=row.started_at or now,
        not_before=None,
        progress_due_at=None,
        progress=0,
        stage="",
    )
    return str(row.job_id)


def _end_attempt(
    connection: Connection,
    row: sa.Row[Any],
    ended: EndedAttempt,
    *,
    now: dt.datetime,
    max_attempts: int,
    kept_days: float,
) -> None:
    job = job_of(row)
    status = after_end(job, ended, max_attempts)
    counted: dict[str, Any] = {"own_ends": own_ends(job, ended), "other_ends": other_ends(job, ended)}
    if ended.is_own:
        counted["own_end_stage"] = storable(ended.stage, 64)
    if status is JobStatus.FAILED:
        failure = standstill(job, ended, kept_days)
        kept = {"inputs_until": now + dt.timedelta(days=kept_days)}
        move(connection, row, status, now=now, message=failure.detail, **counted, **kept, **_failed_values(failure))
    elif status is JobStatus.DISMISSED:
        move(connection, row, status, now=now, message="dismissed", **counted)
    else:
        message = f"attempt {job.attempt} {ended.detail} at stage {ended.stage}; the job waits for another attempt"
        move(connection, row, status, now=now, message=message, **counted)


def _failed_values(failure: JobFailure) -> dict[str, Any]:
    """The columns of a failure."""
    return {"fault": failure.fault.value, "fault_detail": storable(failure.detail)}


def _claimable(now: dt.datetime) -> sa.ColumnElement[bool]:
    due = sa.or_(JOBS.c.not_before.is_(None), JOBS.c.not_before <= now)
    return sa.and_(JOBS.c.status == JobStatus.ACCEPTED.value, due)


def _expired(now: dt.datetime) -> sa.ColumnElement[bool]:
    return sa.and_(JOBS.c.status == JobStatus.RUNNING.value, JOBS.c.lease_until <= now)
