"""The history of a schedule as rows. Within a transaction that holds the schedule's row."""

from __future__ import annotations

import dataclasses
import datetime as dt
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.schedule import Entry, Outcome, ScheduleState
from service.schedules import ScheduleRun, Trigger
from service.store.records import storable
from service.store.schedules import COLUMN_OF, busy_job
from service.store.tables import SCHEDULE_RUNS, SCHEDULES

_MOMENT = dt.timedelta(microseconds=1)
MAX_KEPT = 1000
"""Maximum number of stored entries per schedule; the counts include all."""


class SlotBook:
    """The `ScheduleBook` of one schedule in a database; the schedule's row is locked."""

    def __init__(self, connection: Connection, row: sa.Row[Any]) -> None:
        self.connection = connection
        self.row = row
        self.state = ScheduleState(decided_until=row.decided_until, waiting=row.waiting_slot)
        self.busy_with = busy_job(connection, row.schedule_id)
        self.added: list[ScheduleRun] = []
        self._number = row.last_number
        self._counts = {outcome: getattr(row, column) for outcome, column in COLUMN_OF.items()}

    @property
    def under_way(self) -> str | None:
        """The schedule's job that is under way, in words."""
        return None if self.busy_with is None else f"job {self.busy_with} of this schedule"

    def add(self, entry: Entry, *, trigger: Trigger = Trigger.CLOCK, job_id: str | None = None) -> None:
        """Add to the history. The final entry of a slot that waited changes its row."""
        if entry.outcome in {Outcome.SKIPPED, Outcome.WAITING}:
            job_id = self.busy_with
        clean = dataclasses.replace(entry, message=storable(entry.message))
        number = self._end_waiting(clean, job_id)
        run = ScheduleRun(
            **vars(clean),
            schedule_id=self.row.schedule_id,
            number=number or self._number + 1,
            trigger=trigger,
            job_id=job_id,
        )
        if number is None:
            self._make_room(run.slot)
            self._number = run.number
            self.connection.execute(sa.insert(SCHEDULE_RUNS).values(**dataclasses.asdict(run)))
        if run.outcome in self._counts:
            self._counts[run.outcome] += run.slots
        self.added.append(run)

    def has_run(self, slot: dt.datetime) -> bool:
        """Whether the history has a job of a slot."""
        # an entry may have been moved; slots are minutes apart
        of_slot = SCHEDULE_RUNS.c.slot.between(slot - dt.timedelta(seconds=1), slot)
        own = SCHEDULE_RUNS.c.schedule_id == self.row.schedule_id
        made = sa.and_(own, of_slot, SCHEDULE_RUNS.c.outcome == Outcome.SUBMITTED.value)
        return self.connection.execute(sa.select(SCHEDULE_RUNS.c.number).where(made)).first() is not None

    def _make_room(self, slot: dt.datetime | None) -> None:
        """Move an earlier entry of a slot by a microsecond: each slot has one, and this one came before a clock change.

        An entry that is in its way moves, too.
        """
        if slot is None:
            return
        same = sa.and_(SCHEDULE_RUNS.c.schedule_id == self.row.schedule_id, SCHEDULE_RUNS.c.slot == slot)
        number = self.connection.execute(sa.select(SCHEDULE_RUNS.c.number).where(same)).scalar_one_or_none()
        if number is not None:
            before = slot - _MOMENT
            self._make_room(before)
            self.connection.execute(sa.update(SCHEDULE_RUNS).where(same).values(slot=before))

    def save(self, **columns: Any) -> None:
        """Write the schedule's own row, with further columns; delete its oldest entries."""
        values = {COLUMN_OF[outcome]: count for outcome, count in self._counts.items()} | columns
        values |= {"decided_until": self.state.decided_until, "waiting_slot": self.state.waiting}
        one = SCHEDULES.c.schedule_id == self.row.schedule_id
        self.connection.execute(sa.update(SCHEDULES).where(one).values(last_number=self._number, **values))
        old = sa.and_(
            SCHEDULE_RUNS.c.schedule_id == self.row.schedule_id,
            SCHEDULE_RUNS.c.number <= self._number - MAX_KEPT,
            SCHEDULE_RUNS.c.outcome != Outcome.WAITING.value,
        )
        self.connection.execute(sa.delete(SCHEDULE_RUNS).where(old))

    def _end_waiting(self, entry: Entry, job_id: str | None) -> int | None:
        """Change the row of the slot that waited; its number, or None if the entry is about another slot."""
        if entry.slot is None or entry.slot != self.row.waiting_slot:
            return None
        waited = sa.and_(SCHEDULE_RUNS.c.schedule_id == self.row.schedule_id, SCHEDULE_RUNS.c.slot == entry.slot)
        changed = {"outcome": entry.outcome.value, "at": entry.at, "message": entry.message, "job_id": job_id}
        self.connection.execute(sa.update(SCHEDULE_RUNS).where(waited).values(**changed))
        return int(self.connection.execute(sa.select(SCHEDULE_RUNS.c.number).where(waited)).scalar_one())
