"""What becomes of a schedule's slots, written down and counted. Within a transaction that holds the schedule's row."""

from __future__ import annotations

import dataclasses
import datetime as dt
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.schedules import Outcome, ScheduleRun, Trigger
from service.store.records import storable
from service.store.schedules import COLUMN_OF
from service.store.tables import SCHEDULE_RUNS, SCHEDULES

MAX_KEPT = 1000
"""Runs of a schedule that are kept; its counts go on."""


class SlotBook:
    """Writes down what becomes of one schedule's slots; the row is locked."""

    def __init__(self, connection: Connection, row: sa.Row[Any], now: dt.datetime) -> None:
        self.connection = connection
        self.row = row
        self.now = now
        self.told: list[ScheduleRun] = []
        self._number = row.last_number
        self._counts = {outcome: getattr(row, column) for outcome, column in COLUMN_OF.items()}

    def add(self, outcome: Outcome, slot: dt.datetime | None, *, message: str, **values: Any) -> None:
        """What became of a slot; of the one that waited, its row changes."""
        message = storable(message)
        number = None
        if slot is not None and slot == self.row.waiting_slot:
            number = _end_waiting(
                self.connection,
                self.row,
                outcome=outcome,
                now=self.now,
                message=message,
                job_id=values.get("job_id"),
            )
        run = ScheduleRun(
            schedule_id=self.row.schedule_id,
            number=self._number + 1 if number is None else number,
            outcome=outcome,
            slot=slot,
            at=self.now,
            message=message,
            **{"trigger": Trigger.CLOCK, **values},
        )
        if number is None:
            self._number = run.number
            self.connection.execute(sa.insert(SCHEDULE_RUNS).values(**dataclasses.asdict(run)))
        if outcome in self._counts:
            self._counts[outcome] += run.slots
        self.told.append(run)

    def close(self, **values: Any) -> None:
        """Write the schedule's own row; forget its oldest runs."""
        counted = {COLUMN_OF[outcome]: count for outcome, count in self._counts.items()}
        one = SCHEDULES.c.schedule_id == self.row.schedule_id
        self.connection.execute(sa.update(SCHEDULES).where(one).values(last_number=self._number, **counted, **values))
        old = sa.and_(
            SCHEDULE_RUNS.c.schedule_id == self.row.schedule_id,
            SCHEDULE_RUNS.c.number <= self._number - MAX_KEPT,
            SCHEDULE_RUNS.c.outcome != Outcome.WAITING.value,
        )
        self.connection.execute(sa.delete(SCHEDULE_RUNS).where(old))


def _end_waiting(
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
