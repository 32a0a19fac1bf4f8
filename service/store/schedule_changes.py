"""The operations of clients on schedules: make, change, remove. Within a transaction."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import uuid
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.errors import SettingsError
from pipeline.schedule import Cron, Rules, decided_by, enter, look, miss_passed
from service.errors import ChangedMeanwhileError, TooManySchedulesError
from service.schedules import Definition
from service.store.records import storable
from service.store.schedules import COLUMN_OF, lock
from service.store.slot_book import SlotBook
from service.store.submissions import hold_uploads
from service.store.tables import SCHEDULE_RUNS, SCHEDULE_UPLOADS, SCHEDULES


def insert(connection: Connection, definition: Definition, *, owner: str | None, most: int, now: dt.datetime) -> str:
    """Store a new schedule; its id.

    Raises
    ------
    TooManySchedulesError
        The key has reached its limit.
    NoSuchUploadError
        It names an upload that is gone.
    """
    own = sa.select(sa.func.count()).select_from(SCHEDULES)
    own = own if owner is None else own.where(SCHEDULES.c.owner == owner)
    found = connection.execute(own).scalar_one()
    if found >= most:
        raise TooManySchedulesError(
            f"there are {found} schedules, the limit is {most}: remove one, or raise GABLEWORK_MAX_SCHEDULES_PER_KEY"
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
            next_at=_next_at(definition, now),
            **_columns(definition),
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
    """Change what the client defines, if the version is still the one that the client saw.

    If the times change, slots that have passed undecided are missed.

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
    book = SlotBook(connection, row)
    values = _columns(definition) | {"version": version + 1, "updated_at": now}
    if _times_of(definition) != (row.cron, row.time_zone, row.is_paused):
        # an unknown time zone has no slots; the client changes it for that reason
        with contextlib.suppress(SettingsError):
            before = Rules(cron=Cron(row.cron, row.time_zone), is_paused=row.is_paused)
            why = "not decided before the times of the schedule were changed"
            enter(book, miss_passed(book.state, before, now, why))
        book.state = dataclasses.replace(book.state, decided_until=decided_by(book.state, now))
        if definition.is_paused:
            enter(book, look(book.state, definition, now, under_way=None))
        values["next_at"] = _next_at(definition, book.state.decided_until)
    book.save(**values)
    connection.execute(sa.delete(SCHEDULE_UPLOADS).where(SCHEDULE_UPLOADS.c.schedule_id == schedule_id))
    _need_uploads(connection, schedule_id, definition)


def remove(connection: Connection, schedule_id: str, owner: str | None) -> None:
    """Delete a schedule and its history; its jobs stay.

    Raises
    ------
    NoSuchScheduleError
        It does not exist, or belongs to another key.
    """
    lock(connection, schedule_id, owner)
    for table in (SCHEDULE_RUNS, SCHEDULE_UPLOADS, SCHEDULES):
        connection.execute(sa.delete(table).where(table.c.schedule_id == schedule_id))


def _columns(definition: Definition) -> dict[str, Any]:
    """The client's part, as columns."""
    cron, zone, is_paused = _times_of(definition)
    return {
        "title": None if definition.title is None else storable(definition.title),
        "cron": cron,
        "time_zone": zone,
        "process_id": storable(definition.request.process_id, 64),
        "request": definition.request.as_dict(),
        "priority": definition.priority,
        "missed": definition.missed.value,
        "grace_s": definition.grace_s,
        "overlap": definition.overlap.value,
        "is_paused": is_paused,
    }


def _times_of(definition: Definition) -> tuple[str, str, bool]:
    """The columns that decide when it is due: cron, time zone, whether it is paused."""
    cron = definition.cron
    return storable(cron.expression, 200), storable(cron.time_zone, 128), definition.is_paused


def _next_at(definition: Definition, decided_until: dt.datetime) -> dt.datetime | None:
    return None if definition.is_paused else definition.cron.next_time(decided_until)


def _need_uploads(connection: Connection, schedule_id: str, definition: Definition) -> None:
    needed = definition.request.upload_ids
    hold_uploads(connection, needed)
    if needed:
        rows = [{"schedule_id": schedule_id, "upload_id": name} for name in needed]
        connection.execute(sa.insert(SCHEDULE_UPLOADS), rows)
