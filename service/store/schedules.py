"""Schedules in the database: made, read, changed, removed. Within a transaction."""

from __future__ import annotations

import dataclasses
import datetime as dt
import uuid
from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.schedule import Cron, Missed, Overlap
from service.errors import ChangedMeanwhileError, NoSuchScheduleError, TooManySchedulesError
from service.files import is_id
from service.jobs import JobRequest, JobStatus
from service.schedules import COUNTED, Definition, Outcome, Schedule, ScheduleRun, Trigger
from service.store.records import storable
from service.store.submissions import hold_uploads
from service.store.tables import JOBS, SCHEDULE_RUNS, SCHEDULE_UPLOADS, SCHEDULES

COLUMN_OF = {
    Outcome.SUBMITTED: "submitted",
    Outcome.SKIPPED: "skipped",
    Outcome.MISSED: "missed_slots",
    Outcome.FAILED: "failed",
}
"""The columns that count slots, by outcome."""

_NOT_OVER = [status.value for status in JobStatus if not status.is_over]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScheduleFilter:
    """Which schedules to list."""

    owner: str | None = None
    """Only this key's; None for everybody's."""
    state: Literal["active", "paused"] | None = None
    """Only these; None for all."""
    process_id: str | None = None
    """Only of this process."""
    limit: int = 100
    """Most schedules to list."""
    offset: int = 0
    """Schedules to pass over."""


def insert(connection: Connection, definition: Definition, *, owner: str | None, most: int, now: dt.datetime) -> str:
    """Store a new schedule; its id.

    Raises
    ------
    TooManySchedulesError
        The key has as many as it may have.
    NoSuchUploadError
        It names an upload that is gone.
    """
    own = sa.select(sa.func.count()).select_from(SCHEDULES)
    own = own if owner is None else own.where(SCHEDULES.c.owner == owner)
    found = connection.execute(own).scalar_one()
    if found >= most:
        raise TooManySchedulesError(
            f"there are {found} schedules and {most} may be: remove one, or raise GABLEWORK_MAX_SCHEDULES_PER_KEY"
        )
    schedule_id = uuid.uuid4().hex
    connection.execute(
        sa.insert(SCHEDULES).values(
            schedule_id=schedule_id,
            owner=owner,
            version=1,
            created_at=now,
            updated_at=now,
            decided_until=now,
            last_number=0,
            **dict.fromkeys(COLUMN_OF.values(), 0),
            **_columns(definition, now),
        )
    )
    _need_uploads(connection, schedule_id, definition)
    return schedule_id


def change(
    connection: Connection,
    schedule_id: str,
    definition: Definition,
    *,
    owner: str | None,
    version: int,
    now: dt.datetime,
) -> None:
    """Change what the client says, if nobody else did since. Slots before now are decided by that.

    Raises
    ------
    NoSuchScheduleError
        It does not exist, or belongs to another key.
    ChangedMeanwhileError
        It has another version by now.
    NoSuchUploadError
        It names an upload that is gone.
    """
    row = lock(connection, schedule_id, owner)
    if row.version != version:
        raise ChangedMeanwhileError(
            f"schedule {schedule_id} has version {row.version}, the change is for version {version}: "
            "read it again, then change it"
        )
    # a clock that was put back brings no slot a second time
    decided_until = max(now, row.decided_until)
    values = _columns(definition, decided_until) | {
        "version": version + 1,
        "updated_at": now,
        "decided_until": decided_until,
    }
    if definition.is_paused and row.waiting_slot is not None:
        end_waiting(connection, row, outcome=Outcome.MISSED, now=now, message="paused while this slot waited")
        values |= {"waiting_slot": None, "missed_slots": row.missed_slots + 1}
    connection.execute(sa.update(SCHEDULES).where(SCHEDULES.c.schedule_id == schedule_id).values(**values))
    connection.execute(sa.delete(SCHEDULE_UPLOADS).where(SCHEDULE_UPLOADS.c.schedule_id == schedule_id))
    _need_uploads(connection, schedule_id, definition)


def end_waiting(
    connection: Connection,
    row: sa.Row[Any],
    *,
    outcome: Outcome,
    now: dt.datetime,
    message: str,
    job_id: str | None = None,
) -> int:
    """Tell what became of the slot that waited; the number of its run."""
    waited = sa.and_(SCHEDULE_RUNS.c.schedule_id == row.schedule_id, SCHEDULE_RUNS.c.slot == row.waiting_slot)
    told = {"outcome": outcome.value, "at": now, "message": message, "job_id": job_id}
    connection.execute(sa.update(SCHEDULE_RUNS).where(waited).values(**told))
    return int(connection.execute(sa.select(SCHEDULE_RUNS.c.number).where(waited)).scalar_one())


def remove(connection: Connection, schedule_id: str, owner: str | None) -> None:
    """Forget a schedule and what became of its slots; its jobs stay.

    Raises
    ------
    NoSuchScheduleError
        It does not exist, or belongs to another key.
    """
    lock(connection, schedule_id, owner)
    for table in (SCHEDULE_RUNS, SCHEDULE_UPLOADS, SCHEDULES):
        connection.execute(sa.delete(table).where(table.c.schedule_id == schedule_id))


def lock(connection: Connection, schedule_id: str, owner: str | None) -> sa.Row[Any]:
    """A schedule's row, which nobody else changes until the transaction ends.

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
    """What became of a schedule's slots, latest first.

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
    """The job of a schedule that is not over; None where there is none."""
    active = sa.and_(JOBS.c.schedule_id == schedule_id, JOBS.c.status.in_(_NOT_OVER))
    return connection.execute(sa.select(JOBS.c.job_id).where(active).limit(1)).scalar_one_or_none()


def is_busy() -> sa.ColumnElement[bool]:
    """The same as a condition on rows of `schedules`."""
    active = sa.and_(JOBS.c.schedule_id == SCHEDULES.c.schedule_id, JOBS.c.status.in_(_NOT_OVER))
    return sa.exists(sa.select(JOBS.c.job_id).where(active))


def counts(connection: Connection) -> tuple[dict[str, int], dict[Outcome, int]]:
    """Schedules by state, and the slots of all of them by outcome."""
    grouped = sa.select(SCHEDULES.c.is_paused, sa.func.count()).group_by(SCHEDULES.c.is_paused)
    found = {bool(paused): number for paused, number in connection.execute(grouped)}
    sums = [sa.func.coalesce(sa.func.sum(SCHEDULES.c[COLUMN_OF[outcome]]), 0) for outcome in COUNTED]
    slots = connection.execute(sa.select(*sums)).one()
    by_outcome: dict[Outcome, int] = {outcome: int(number) for outcome, number in zip(COUNTED, slots, strict=True)}
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
    return ScheduleRun(
        schedule_id=row.schedule_id,
        number=row.number,
        trigger=Trigger(row.trigger),
        outcome=Outcome(row.outcome),
        slot=row.slot,
        first_slot=row.first_slot,
        slots=row.slots,
        is_counted=row.is_counted,
        job_id=row.job_id,
        at=row.at,
        message=row.message,
    )


def _columns(definition: Definition, decided_until: dt.datetime) -> dict[str, Any]:
    """What the client says, as columns; when it is due next follows from that."""
    cron = definition.cron
    return {
        "title": None if definition.title is None else storable(definition.title),
        "cron": storable(cron.expression, 200),
        "time_zone": storable(cron.time_zone, 128),
        "process_id": storable(definition.request.process_id, 64),
        "request": definition.request.as_dict(),
        "priority": definition.priority,
        "missed": definition.missed.value,
        "grace_s": definition.grace_s,
        "overlap": definition.overlap.value,
        "is_paused": definition.is_paused,
        "next_at": None if definition.is_paused else cron.next_time(decided_until),
    }


def _need_uploads(connection: Connection, schedule_id: str, definition: Definition) -> None:
    needed = definition.request.upload_ids
    hold_uploads(connection, needed)
    if needed:
        rows = [{"schedule_id": schedule_id, "upload_id": name} for name in needed]
        connection.execute(sa.insert(SCHEDULE_UPLOADS), rows)


def _row(connection: Connection, schedule_id: str, owner: str | None, *, locked: bool) -> sa.Row[Any]:
    one = sa.select(SCHEDULES).where(SCHEDULES.c.schedule_id == schedule_id)
    row = None
    if is_id(schedule_id):
        row = connection.execute(one.with_for_update() if locked else one).one_or_none()
    if row is None or (owner is not None and row.owner != owner):
        raise NoSuchScheduleError(f"there is no schedule {schedule_id[:64]!r}")
    return row


def _last_runs(connection: Connection, schedule_ids: list[str]) -> dict[str, ScheduleRun]:
    """Of each schedule the latest run for which a job was made."""
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
