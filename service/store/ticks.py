"""What the clock does with schedules, and what a run by hand does. Within a transaction that holds the schedule's row.

A slot is decided, its job made and both written down in one transaction, by whoever holds the row: two drivers never
decide the same slot, and one that dies on the way leaves everything as it was.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections.abc import Callable

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.errors import SettingsError
from pipeline.schedule import Decision, PassedSlots, decide, passed_slots
from service.errors import ForbiddenError, ScheduleBusyError, ServiceError
from service.schedules import Outcome, Schedule, ScheduleRun, Trigger
from service.store import schedules
from service.store.slot_book import SlotBook
from service.store.submissions import check_queue, insert
from service.store.tables import KEYS, SCHEDULES

BROKEN_PAUSE = dt.timedelta(hours=1)
"""A schedule that this machine cannot read is looked at again after so long."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LineLimits:
    """How many jobs may wait, and how jobs are kept from being made beside that."""

    max_queued: int
    """Of all."""
    max_queued_per_key: int
    """Of one key."""
    lock: Callable[[Connection], None]
    """Until the transaction ends, nobody else makes jobs."""


def something_is_due(connection: Connection, now: dt.datetime) -> bool:
    """Whether a tick may find something."""
    return connection.execute(sa.select(SCHEDULES.c.schedule_id).where(_is_due(now)).limit(1)).first() is not None


def decide_first(connection: Connection, *, now: dt.datetime, limits: LineLimits) -> list[ScheduleRun] | None:
    """Decide what is due of one schedule; what became of its slots, or None where nothing is due."""
    line = sa.select(SCHEDULES).where(_is_due(now)).order_by(SCHEDULES.c.next_at, SCHEDULES.c.schedule_id)
    row = connection.execute(line.limit(1).with_for_update(skip_locked=True)).one_or_none()
    if row is None:
        return None
    book = SlotBook(connection, row, now)
    busy_with = schedules.busy_job(connection, row.schedule_id)
    try:
        schedule = schedules.schedule_of(row)
        definition = schedule.definition
        passed = passed_slots(definition.cron, row.decided_until, now)
        next_at = definition.cron.next_time(max(now, row.decided_until))
    except SettingsError as error:
        _write_unreadable(book, str(error))
        return book.told
    decision = decide(
        passed,
        waiting=row.waiting_slot,
        is_busy=busy_with is not None,
        now=now,
        missed=definition.missed,
        overlap=definition.overlap,
        grace=dt.timedelta(seconds=definition.grace_s),
    )
    _write(book, schedule, passed, decision, busy_with, limits)
    book.close(decided_until=max(now, row.decided_until), next_at=next_at, waiting_slot=decision.waits)
    return book.told


def run_by_hand(
    connection: Connection, schedule_id: str, owner: str | None, *, now: dt.datetime, limits: LineLimits
) -> str:
    """Make a job now, whatever the clock says; its id.

    Raises
    ------
    NoSuchScheduleError
        The schedule does not exist, or belongs to another key.
    ScheduleBusyError
        A job of it is under way.
    QueueFullError
        Too many jobs wait.
    """
    row = schedules.lock(connection, schedule_id, owner)
    busy_with = schedules.busy_job(connection, schedule_id)
    if busy_with is not None:
        raise ScheduleBusyError(
            f"job {busy_with} of this schedule is under way: wait until it is over, or dismiss it", busy_with
        )
    book = SlotBook(connection, row, now)
    job_id = _submit(connection, schedules.schedule_of(row), now, limits)
    book.add(Outcome.SUBMITTED, None, trigger=Trigger.HAND, job_id=job_id, message="run by hand")
    book.close()
    return job_id


def _write(
    book: SlotBook,
    schedule: Schedule,
    passed: PassedSlots | None,
    decision: Decision,
    busy_with: str | None,
    limits: LineLimits,
) -> None:
    """Do what was decided, and write it down."""
    if passed is not None:
        _write_missed(book, passed, decision)
    if decision.replaced is not None:
        book.add(Outcome.MISSED, decision.replaced, message="waited for a job to end, and a later slot took its place")
    if decision.skipped is not None:
        book.add(
            Outcome.SKIPPED,
            decision.skipped,
            job_id=busy_with,
            message=f"job {busy_with} of this schedule was still under way",
        )
    if decision.waits is not None and decision.waits != book.row.waiting_slot:
        book.add(Outcome.WAITING, decision.waits, job_id=busy_with, message=f"waits until job {busy_with} is over")
    if decision.run is not None:
        try:
            with book.connection.begin_nested():
                job_id = _submit(book.connection, schedule, book.now, limits)
        except ServiceError as error:
            book.add(Outcome.FAILED, decision.run, message=str(error))
        else:
            book.add(Outcome.SUBMITTED, decision.run, job_id=job_id, message=_lateness(decision.run, book.now))


def _write_unreadable(book: SlotBook, why: str) -> None:
    """A time zone that another machine knew and this one does not: told, and looked at again later."""
    row = book.row
    if row.waiting_slot is not None:
        book.add(Outcome.FAILED, row.waiting_slot, message=why)
    is_due = row.next_at <= book.now
    if is_due:
        book.add(Outcome.FAILED, row.next_at, message=why)
    book.close(
        waiting_slot=None,
        decided_until=row.next_at if is_due else row.decided_until,
        next_at=book.now + BROKEN_PAUSE if is_due else row.next_at,
    )


def _write_missed(book: SlotBook, passed: PassedSlots, decision: Decision) -> None:
    """One row for all that were missed together."""
    last = decision.late or passed.before_latest
    if last is None:
        return
    grace_s = book.row.grace_s
    fate = f"seen later than {grace_s:g} s" if decision.late else "only the latest of those that had passed counts"
    book.add(
        Outcome.MISSED,
        last,
        first_slot=passed.first,
        slots=passed.earlier + (1 if decision.late else 0),
        is_counted=passed.is_counted,
        message=f"no driver looked in time, from {_utc(passed.first or last)} to {_utc(book.now)}: {fate}",
    )


def _submit(connection: Connection, schedule: Schedule, now: dt.datetime, limits: LineLimits) -> str:
    """Make a job; its id.

    Raises
    ------
    ServiceError
        Why none can be made.
    """
    owner = schedule.owner
    if owner is not None:
        key = connection.execute(sa.select(KEYS.c.name, KEYS.c.revoked_at).where(KEYS.c.key_id == owner)).one_or_none()
        if key is not None and key.revoked_at is not None:
            raise ForbiddenError(
                f"the key {key.name!r} that made this schedule was revoked: make the schedule again with another key"
            )
    limits.lock(connection)
    check_queue(connection, owner, max_queued=limits.max_queued, max_queued_per_key=limits.max_queued_per_key)
    definition = schedule.definition
    return insert(
        connection,
        definition.job_request(),
        owner=owner,
        priority=definition.priority,
        now=now,
        schedule_id=schedule.schedule_id,
    )


def _is_due(now: dt.datetime) -> sa.ColumnElement[bool]:
    # a schedule that is paused has neither
    freed = sa.and_(SCHEDULES.c.waiting_slot.is_not(None), ~schedules.is_busy())
    return sa.or_(SCHEDULES.c.next_at <= now, freed)


def _lateness(slot: dt.datetime, now: dt.datetime) -> str:
    late_s = max(0.0, (now - slot).total_seconds())
    return "in time" if late_s < 60.0 else f"{late_s:.0f} s after its time"


def _utc(at: dt.datetime) -> str:
    return at.astimezone(dt.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
