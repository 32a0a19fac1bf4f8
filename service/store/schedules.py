"""Reads schedules and their history. Within a transaction."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.schedule import Cron, Missed, Outcome, Overlap
from service.errors import NoSuchScheduleError
from service.files import is_id
from service.jobs import JobRequest, JobStatus
from service.schedules import Definition, Schedule, ScheduleRun, Trigger
from service.store.records import storable
from service.store.tables import JOBS, SCHEDULE_RUNS, SCHEDULES

COLUMN_OF = {
    Outcome.SUBMITTED: "submitted",
    Outcome.SKIPPED: "skipped",
    Outcome.MISSED: "missed_slots",
    Outcome.FAILED: "failed",
}
"""The columns that count slots, by final outcome."""

_NOT_OVER = [status.value for status in JobStatus if not status.is_over]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScheduleFilter:
    """Which schedules to list."""

    owner: str | None = None
    """Only schedules of this key; None for all."""
    state: Literal["active", "paused"] | None = None
    """Only schedules in this state; None for all."""
    process_id: str | None = None
    """Only schedules of this process."""
    limit: int = 100
    """Maximum number of schedules to list."""
    offset: int = 0
    """Number of schedules to skip."""


def lock(connection: Connection, schedule_id: str, owner: str | None) -> sa.Row[Any]:
    """A schedule's row, locked until the transaction ends.

    Raises
    ------
    NoSuchScheduleError
        It does not exist, or belongs to another key.
    """
    return _row(connection, schedule_id, owner, locked=True)


def get(connection: Connection, schedule_id: str, owner: str | None) -> Schedule:
    """One schedule.

    Raises
    ------
    NoSuchScheduleError
        It does not exist, or belongs to another key.
    """
    row = _row(connection, schedule_id, owner, locked=False)
    return schedule_of(row, _last_runs(connection, [schedule_id]).get(schedule_id))


def listed(connection: Connection, criteria: ScheduleFilter) -> list[Schedule]:
    """The schedules that fit, newest first."""
    chosen = sa.select(SCHEDULES).order_by(SCHEDULES.c.created_at.desc(), SCHEDULES.c.schedule_id.desc())
    if criteria.owner is not None:
        chosen = chosen.where(SCHEDULES.c.owner == criteria.owner)
    if criteria.state is not None:
        chosen = chosen.where(SCHEDULES.c.is_paused.is_(criteria.state == "paused"))
    if criteria.process_id is not None:
        chosen = chosen.where(SCHEDULES.c.process_id == storable(criteria.process_id))
    rows = connection.execute(chosen.limit(criteria.limit).offset(criteria.offset)).all()
    last = _last_runs(connection, [row.schedule_id for row in rows])
    return [schedule_of(row, last.get(row.schedule_id)) for row in rows]


def runs(connection: Connection, schedule_id: str, owner: str | None, *, limit: int, offset: int) -> list[ScheduleRun]:
    """The history of a schedule, latest first.

    Raises
    ------
    NoSuchScheduleError
        The schedule does not exist, or belongs to another key.
    """
    _row(connection, schedule_id, owner, locked=False)
    chosen = sa.select(SCHEDULE_RUNS).where(SCHEDULE_RUNS.c.schedule_id == schedule_id)
    ordered = chosen.order_by(SCHEDULE_RUNS.c.number.desc()).limit(limit).offset(offset)
    return [run_of(row) for row in connection.execute(ordered)]


def busy_job(connection: Connection, schedule_id: str) -> str | None:
    """The job of a schedule that is not over; None if there is none."""
    active = sa.and_(JOBS.c.schedule_id == schedule_id, JOBS.c.status.in_(_NOT_OVER))
    return connection.execute(sa.select(JOBS.c.job_id).where(active).limit(1)).scalar_one_or_none()


def is_busy() -> sa.ColumnElement[bool]:
    """Whether a schedule has a job that is not over, as a condition on rows of `schedules`."""
    active = sa.and_(JOBS.c.schedule_id == SCHEDULES.c.schedule_id, JOBS.c.status.in_(_NOT_OVER))
    return sa.exists(sa.select(JOBS.c.job_id).where(active))


def counts(connection: Connection) -> tuple[dict[str, int], dict[Outcome, int]]:
    """Schedules by state, and the slots of all of them by outcome."""
    grouped = sa.select(SCHEDULES.c.is_paused, sa.func.count()).group_by(SCHEDULES.c.is_paused)
    found = {bool(paused): number for paused, number in connection.execute(grouped)}
    sums = [sa.func.coalesce(sa.func.sum(SCHEDULES.c[column]), 0) for column in COLUMN_OF.values()]
    slots = connection.execute(sa.select(*sums)).one()
    by_outcome = {outcome: int(number) for outcome, number in zip(COLUMN_OF, slots, strict=True)}
    return {"active": found.get(False, 0), "paused": found.get(True, 0)}, by_outcome


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


def run_of(row: sa.Row[Any]) -> ScheduleRun:
    """A row of `schedule_runs`."""
    return ScheduleRun(**row._asdict() | {"trigger": Trigger(row.trigger), "outcome": Outcome(row.outcome)})


def _row(connection: Connection, schedule_id: str, owner: str | None, *, locked: bool) -> sa.Row[Any]:
    one = sa.select(SCHEDULES).where(SCHEDULES.c.schedule_id == schedule_id)
    row = None
    if is_id(schedule_id):
        row = connection.execute(one.with_for_update() if locked else one).one_or_none()
    if row is None or (owner is not None and row.owner != owner):
        raise NoSuchScheduleError(f"there is no schedule {schedule_id[:64]!r}")
    return row


def _last_runs(connection: Connection, schedule_ids: list[str]) -> dict[str, ScheduleRun]:
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
    return {row.schedule_id: run_of(row) for row in found}
