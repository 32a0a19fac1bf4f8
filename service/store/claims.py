"""The operations of drivers on jobs: claim, renew, record, finish, give back. Within a transaction."""

from __future__ import annotations

import datetime as dt
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.jobs import EndedAttempt, Job, JobFailure, JobStatus
from service.store.changes import lock_held, move
from service.store.policies import after_end, after_loss, loss, other_ends, own_ends, standstill
from service.store.records import job_of, storable
from service.store.tables import JOBS

_SWEPT_AT_ONCE = 100


def work_waits(connection: Connection, now: dt.datetime) -> bool:
    """Whether a claim may find something: a job to claim, or a lease that has ended."""
    some = sa.select(JOBS.c.job_id).where(sa.or_(_claimable(now), _expired(now))).limit(1)
    return connection.execute(some).first() is not None


def sweep(connection: Connection, *, now: dt.datetime, max_attempts: int) -> None:
    """Take back the jobs whose lease has ended: they wait again, or are dismissed or failed."""
    lost = sa.select(JOBS).where(_expired(now)).order_by(JOBS.c.lease_until).limit(_SWEPT_AT_ONCE)
    for row in connection.execute(lost.with_for_update(skip_locked=True)).all():
        give_up(connection, row, now=now, max_attempts=max_attempts)


def give_up_all(connection: Connection, driver: str, *, now: dt.datetime, max_attempts: int) -> list[str]:
    """Take back all jobs of a driver that is dead; returns their ids."""
    held = sa.and_(JOBS.c.status == JobStatus.RUNNING.value, JOBS.c.lease_owner == storable(driver, 255))
    rows = connection.execute(sa.select(JOBS).where(held).with_for_update()).all()
    for row in rows:
        give_up(connection, row, now=now, max_attempts=max_attempts, cause="ended")
    return [row.job_id for row in rows]


def give_up(
    connection: Connection, row: sa.Row[Any], *, now: dt.datetime, max_attempts: int, cause: str = "was silent"
) -> None:
    """Take back one locked job from a driver that was lost; `cause` is a verb, for the message."""
    job = job_of(row)
    status = after_loss(job, max_attempts)
    counted = {"lost_attempts": job.lost_attempts + 1}
    if status is JobStatus.FAILED:
        failure = loss(job)
        values = counted | {"fault": failure.fault.value, "fault_detail": failure.detail}
        move(connection, row, status, now=now, message=failure.detail, **values)
    elif status is JobStatus.DISMISSED:
        move(connection, row, status, now=now, message="dismissed; its driver was lost", **counted)
    else:
        reason = f"attempt {job.attempt} is lost: driver {job.lease_owner} {cause}; the job waits for another"
        move(connection, row, status, now=now, message=reason, **counted)


def take_first(connection: Connection, driver: str, *, now: dt.datetime, lease_s: float) -> str | None:
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


def renew(connection: Connection, held: Job, *, until: dt.datetime, due_at: dt.datetime | None) -> bool:
    """Extend a lease; True if the job must be dismissed. The job counts as stalled after `due_at`.

    An expired lease that no driver took can be renewed.

    Raises
    ------
    LeaseLostError
        The job is no longer held.
    """
    row = lock_held(connection, held)
    connection.execute(
        sa.update(JOBS).where(JOBS.c.job_id == held.job_id).values(lease_until=until, progress_due_at=due_at)
    )
    return bool(row.dismiss_requested)


def finish(
    connection: Connection, held: Job, status: JobStatus, *, now: dt.datetime, message: str, **values: Any
) -> None:
    """End a job that is held.

    Raises
    ------
    LeaseLostError
        The job is no longer held.
    """
    move(connection, lock_held(connection, held), status, now=now, message=message, **values)


def failed_values(failure: JobFailure) -> dict[str, Any]:
    """The columns of a failure."""
    return {"fault": failure.fault.value, "fault_detail": storable(failure.detail)}


def release(
    connection: Connection, held: Job, *, now: dt.datetime, lost: bool, message: str, not_before: dt.datetime | None
) -> None:
    """Put a job back into the queue, or end it if its dismissal was requested.

    Raises
    ------
    LeaseLostError
        The job is no longer held.
    """
    row = lock_held(connection, held)
    counted = {"lost_attempts": row.lost_attempts + int(lost)}
    if row.dismiss_requested:
        move(connection, row, JobStatus.DISMISSED, now=now, message="dismissed", **counted)
        return
    reason = message or f"driver {held.lease_owner} gave the job back; it waits for another"
    move(connection, row, JobStatus.ACCEPTED, now=now, message=reason, not_before=not_before, **counted)


def end_attempt(
    connection: Connection, held: Job, ended: EndedAttempt, *, now: dt.datetime, max_attempts: int, kept_days: float
) -> None:
    """Put a job back into the queue whose attempt's process ended, or end it: see `after_end`.

    Raises
    ------
    LeaseLostError
        The job is no longer held.
    """
    row = lock_held(connection, held)
    job = job_of(row)
    status = after_end(job, ended, max_attempts)
    counted: dict[str, Any] = {"own_ends": own_ends(job, ended), "other_ends": other_ends(job, ended)}
    if ended.is_own:
        counted["own_end_stage"] = storable(ended.stage, 64)
    if status is JobStatus.FAILED:
        failure = standstill(job, ended, kept_days)
        kept = {"inputs_until": now + dt.timedelta(days=kept_days)}
        move(connection, row, status, now=now, message=failure.detail, **counted, **kept, **failed_values(failure))
    elif status is JobStatus.DISMISSED:
        move(connection, row, status, now=now, message="dismissed", **counted)
    else:
        message = f"attempt {job.attempt} {ended.detail} at stage {ended.stage}; the job waits for another attempt"
        move(connection, row, status, now=now, message=message, **counted)


def stalled(connection: Connection, now: dt.datetime) -> list[str]:
    """Ids of the running jobs that make no progress: none was seen in time, or their lease has ended."""
    late = sa.or_(JOBS.c.progress_due_at <= now, JOBS.c.lease_until <= now)
    found = sa.select(JOBS.c.job_id).where(JOBS.c.status == JobStatus.RUNNING.value, late).order_by(JOBS.c.job_id)
    return list(connection.execute(found).scalars())


def _claimable(now: dt.datetime) -> sa.ColumnElement[bool]:
    due = sa.or_(JOBS.c.not_before.is_(None), JOBS.c.not_before <= now)
    return sa.and_(JOBS.c.status == JobStatus.ACCEPTED.value, due)


def _expired(now: dt.datetime) -> sa.ColumnElement[bool]:
    return sa.and_(JOBS.c.status == JobStatus.RUNNING.value, JOBS.c.lease_until <= now)
