"""Reads schedules and their history. Within a transaction."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.schedule import Cron, Missed, Outcome, Overlap
from service.errors import NoSuchScheduleError
from service.jobs import JobRequest, JobStatus
from service.schedules import Definition, Schedule, ScheduleRun
from service.store.records import from_row, row_by_id
from service.store.tables import JOBS, SCHEDULE_RUNS, SCHEDULES

COLUMN_OF = {
    Outcome.SUBMITTED: "submitted",
    Outcome.SKIPPED: "skipped",
    Outcome.MISSED: "missed_slots",
    Outcome.FAILED: "failed",
}
"""The columns that count slots, by final outcome."""

_NOT_OVER = [status.value for status in JobStatus if not status.is_over]


def get(connection: Connection, schedule_id: str, owner: str | None) -> Schedule:
    """One schedule.

    Raises
    ------
    NoSuchScheduleError
        It does not exist, or belongs to another key.
    """
    row = row_of(connection, schedule_id, owner)
    return schedule_of(row, last_runs(connection, [schedule_id]).get(schedule_id))


def busy_job(connection: Connection, schedule_id: str) -> str | None:
    """The job of a schedule that is not over; None if there is none."""
    active = sa.and_(JOBS.c.schedule_id == schedule_id, JOBS.c.status.in_(_NOT_OVER))
    return connection.execute(sa.select(JOBS.c.job_id).where(active).limit(1)).scalar_one_or_none()


def is_busy() -> sa.ColumnElement[bool]:
    """Whether a schedule has a job that is not over, as a condition on rows of `schedules`."""
    active = sa.and_(JOBS.c.schedule_id == SCHEDULES.c.schedule_id, JOBS.c.status.in_(_NOT_OVER))
    return sa.exists(sa.select(JOBS.c.job_id).where(active))


def schedule_of(row: sa.Row[Any], last_run: ScheduleRun | None = None) -> Schedule:
    """A row of `schedules`.

    Raises
    ------
    SettingsError
        This machine does not know its time zone.
    """
    return Schedule(
        schedule_id=row.schedule_id,
        owner=row.owner,
        definition=Definition(
            title=row.title,
            cron=Cron(row.cron, row.time_zone),
            request=JobRequest.from_dict(row.request),
            priority=row.priority,
            missed=Missed(row.missed),
            grace_s=row.grace_s,
            overlap=Overlap(row.overlap),
            is_paused=row.is_paused,
        ),
        version=row.version,
        created_at=row.created_at,
        updated_at=row.updated_at,
        decided_until=row.decided_until,
        next_at=row.next_at,
        waiting_slot=row.waiting_slot,
        counts={outcome: getattr(row, column) for outcome, column in COLUMN_OF.items()},
        last_run=last_run,
    )


def row_of(connection: Connection, schedule_id: str, owner: str | None, *, locked: bool = False) -> sa.Row[Any]:
    """A schedule's row; `locked` until the transaction ends.

    Raises
    ------
    NoSuchScheduleError
        It does not exist, or belongs to another key.
    """
    row = row_by_id(connection, SCHEDULES, schedule_id, locked=locked)
    if row is None or (owner is not None and row.owner != owner):
        raise NoSuchScheduleError(f"there is no schedule {schedule_id[:64]!r}")
    return row


def last_runs(connection: Connection, schedule_ids: list[str]) -> dict[str, ScheduleRun]:
    """The latest run of each schedule that made a job."""
    made = sa.and_(SCHEDULE_RUNS.c.schedule_id.in_(schedule_ids), SCHEDULE_RUNS.c.outcome == Outcome.SUBMITTED.value)
    latest = (
        sa.select(SCHEDULE_RUNS.c.schedule_id, sa.func.max(SCHEDULE_RUNS.c.number).label("number"))
        .where(made)
        .group_by(SCHEDULE_RUNS.c.schedule_id)
        .subquery()
    )
    same = sa.and_(SCHEDULE_RUNS.c.schedule_id == latest.c.schedule_id, SCHEDULE_RUNS.c.number == latest.c.number)
    found = connection.execute(sa.select(SCHEDULE_RUNS).join(latest, same))
    return {row.schedule_id: from_row(ScheduleRun, row) for row in found}
