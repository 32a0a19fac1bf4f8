"""Decides due schedules, and runs them by hand. Within a transaction that holds the schedule's row.

The driver that holds the row decides a slot, makes its job and writes both in one transaction. Two drivers never decide
the same slot, and one that dies midway leaves everything as it was.
"""

from __future__ import annotations

import datetime as dt

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.errors import SettingsError
from pipeline.schedule import PUT_BACK, Entry, Outcome, ScheduleState, decided_by, enter, look
from service.errors import ForbiddenError, ScheduleBusyError, ServiceError
from service.jobs import QueueLimits
from service.schedules import Schedule, ScheduleRun, Trigger
from service.store import schedules
from service.store.records import key_of
from service.store.slot_book import SlotBook
from service.store.submissions import check_queue, insert
from service.store.tables import KEYS, SCHEDULES

BROKEN_PAUSE = dt.timedelta(hours=1)
"""Time after which a schedule that this machine cannot read is tried again."""


def something_is_due(connection: Connection, now: dt.datetime) -> bool:
    """Whether a tick may find something."""
    return connection.execute(sa.select(SCHEDULES.c.schedule_id).where(_is_due(now)).limit(1)).first() is not None


def decide_first(connection: Connection, *, now: dt.datetime, limits: QueueLimits) -> list[ScheduleRun] | None:
    """Decide the slots of one schedule that is due; the new history, or None if nothing is due."""
    line = sa.select(SCHEDULES).where(_is_due(now)).order_by(SCHEDULES.c.next_at, SCHEDULES.c.schedule_id)
    row = connection.execute(line.limit(1).with_for_update(skip_locked=True)).one_or_none()
    if row is None:
        return None
    book = SlotBook(connection, row)
    try:
        schedule = schedules.schedule_of(row)
        found = look(book.state, schedule.definition, now, under_way=book.under_way, has_run=book.has_run)
        next_at = schedule.definition.cron.next_time(found.state.decided_until)
    except SettingsError as error:
        _fail_unreadable(book, now, str(error))
        return book.added
    due = enter(book, found)
    if due is not None:
        try:
            with connection.begin_nested():
                job_id = _submit(connection, schedule, now, limits)
        except ServiceError as error:
            book.add(Entry(outcome=Outcome.FAILED, slot=due, at=now, message=str(error)))
        else:
            entry = Entry(outcome=Outcome.SUBMITTED, slot=due, at=now, message=_lateness(due, now))
            book.add(entry, job_id=job_id)
    book.save(next_at=next_at)
    return book.added


def run_by_hand(
    connection: Connection, schedule_id: str, owner: str | None, *, now: dt.datetime, limits: QueueLimits
) -> str:
    """Make a job now, independent of the clock; returns its id.

    Raises
    ------
    NoSuchScheduleError
        The schedule does not exist, or belongs to another key.
    ScheduleBusyError
        A job of it is under way.
    QueueFullError
        Too many jobs wait.
    """
    row = schedules.row_of(connection, schedule_id, owner, locked=True)
    book = SlotBook(connection, row)
    if book.busy_with is not None:
        raise ScheduleBusyError(f"{book.under_way} is under way: wait until it is over, or dismiss it", book.busy_with)
    job_id = _submit(connection, schedules.schedule_of(row), now, limits)
    entry = Entry(outcome=Outcome.SUBMITTED, slot=None, at=now, message="run by hand")
    book.add(entry, trigger=Trigger.HAND, job_id=job_id)
    book.save()
    return job_id


def _fail_unreadable(book: SlotBook, now: dt.datetime, message: str) -> None:
    """The schedule has a time zone that this machine does not know: its slots fail, and it is tried again later."""
    row = book.row
    is_due = row.next_at <= now
    slots = [row.waiting_slot, row.next_at if is_due else None]
    for slot in slots:
        if slot is not None:
            book.add(Entry(outcome=Outcome.FAILED, slot=slot, at=now, message=message))
    book.state = ScheduleState(decided_until=row.next_at if is_due else decided_by(book.state, now))
    book.save(next_at=now + BROKEN_PAUSE if is_due else row.next_at)


def _submit(connection: Connection, schedule: Schedule, now: dt.datetime, limits: QueueLimits) -> str:
    """Make a job; its id.

    Raises
    ------
    ServiceError
        The reason why none can be made.
    """
    owner = schedule.owner
    if owner is not None:
        row = connection.execute(sa.select(KEYS).where(KEYS.c.key_id == owner)).one_or_none()
        key = None if row is None else key_of(row)
        fault = None if key is None else key.fault(key.digest, now)
        if key is not None and fault is not None:
            raise ForbiddenError(
                f"the key {key.name!r} that made this schedule {fault}: make the schedule again with another key, or "
                "rotate this one if it expired"
            )
    check_queue(connection, owner, limits)
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
    # the clock was put back: otherwise the schedule would wait until the clock is where it was
    put_back = sa.and_(SCHEDULES.c.next_at.is_not(None), SCHEDULES.c.decided_until > now + PUT_BACK)
    return sa.or_(SCHEDULES.c.next_at <= now, freed, put_back)


def _lateness(slot: dt.datetime, now: dt.datetime) -> str:
    late_s = max(0.0, (now - slot).total_seconds())
    return "on time" if late_s < 60.0 else f"{late_s:.0f} s after its time"
