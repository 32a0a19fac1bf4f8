"""The schedules of a store: made, changed, read and decided. Every method is one transaction."""

from __future__ import annotations

import builtins
import contextlib
import dataclasses
import datetime as dt
import uuid
from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.errors import SettingsError
from pipeline.schedule import Cron, Outcome, Rules, decided_by, enter, look, miss_passed
from service.deliveries import Delivery
from service.errors import ChangedMeanwhileError, TooManySchedulesError
from service.jobs import UNLIMITED, Job, QueueLimits
from service.schedules import Definition, Schedule, ScheduleRun
from service.store import queries, schedules, ticks
from service.store.database import LOCK_SUBMISSIONS, StorePart, lock
from service.store.records import storable
from service.store.schedules import COLUMN_OF, last_runs, row_of, run_of, schedule_of
from service.store.slot_book import SlotBook
from service.store.submissions import hold_uploads
from service.store.tables import SCHEDULE_RUNS, SCHEDULE_UPLOADS, SCHEDULES
from service.store.uploads import creating

MAX_PER_TICK = 200
"""Maximum number of schedules that one tick decides; the next tick continues."""


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


class ScheduleStore(StorePart):
    """Schedules and their history; `JobStore.schedules`.

    It uses the clock of the database: replicas whose clocks differ agree on what is due.
    """

    # --- for clients

    def create(
        self, definition: Definition, *, owner: str | None, most: int, delivery: Delivery[Schedule] | None = None
    ) -> Schedule:
        """Make a schedule; its first slot is the next one.

        Parameters
        ----------
        definition : Definition
            Already checked.
        owner : str or None
            The key that makes it; None if keys are not used.
        most : int
            Maximum number of schedules of the key, or in total if keys are not used.
        delivery : Delivery, optional
            What is written with the schedule: uploads, and the answer under the request's key.

        Raises
        ------
        TooManySchedulesError
            The key has reached its limit.
        NoSuchUploadError
            The request names an upload that is gone.
        """
        with creating(self._database, delivery) as (connection, made):
            # no other process adds one between counting and adding
            lock(connection, LOCK_SUBMISSIONS)
            now = self._database.now(connection)
            own = sa.select(sa.func.count()).select_from(SCHEDULES)
            own = own if owner is None else own.where(SCHEDULES.c.owner == owner)
            found = connection.execute(own).scalar_one()
            if found >= most:
                raise TooManySchedulesError(
                    f"there are {found} schedules, the limit is {most}: remove one, or raise "
                    "GABLEWORK_MAX_SCHEDULES_PER_KEY"
                )
            schedule_id = uuid.uuid4().hex
            values = {
                "schedule_id": schedule_id,
                "owner": owner,
                "version": 1,
                "created_at": now,
                "updated_at": now,
                "decided_until": now,
                "last_number": 0,
                **dict.fromkeys(COLUMN_OF.values(), 0),
                "next_at": _next_at(definition, now),
                **_columns(definition),
            }
            connection.execute(sa.insert(SCHEDULES).values(**values))
            _need_uploads(connection, schedule_id, definition)
            return made(schedules.get(connection, schedule_id, None))

    def get(self, schedule_id: str, *, owner: str | None = None) -> Schedule:
        """One schedule; with an owner only its own.

        Raises
        ------
        NoSuchScheduleError
            It does not exist, or belongs to another key.
        """
        with self._database.read() as connection:
            return schedules.get(connection, schedule_id, owner)

    def list(self, criteria: ScheduleFilter) -> builtins.list[Schedule]:
        """The schedules that fit, newest first."""
        chosen = sa.select(SCHEDULES).order_by(SCHEDULES.c.created_at.desc(), SCHEDULES.c.schedule_id.desc())
        if criteria.owner is not None:
            chosen = chosen.where(SCHEDULES.c.owner == criteria.owner)
        if criteria.state is not None:
            chosen = chosen.where(SCHEDULES.c.is_paused.is_(criteria.state == "paused"))
        if criteria.process_id is not None:
            chosen = chosen.where(SCHEDULES.c.process_id == storable(criteria.process_id))
        with self._database.read() as connection:
            rows = connection.execute(chosen.limit(criteria.limit).offset(criteria.offset)).all()
            last = last_runs(connection, [row.schedule_id for row in rows])
            return [schedule_of(row, last.get(row.schedule_id)) for row in rows]

    def change(
        self,
        schedule_id: str,
        definition: Definition,
        *,
        version: int,
        owner: str | None = None,
        delivery: Delivery[Schedule] | None = None,
    ) -> Schedule:
        """Change what the client defines, if the version is still the one that the client saw.

        New times count from now on; slots of the old times that have passed undecided are missed.

        Raises
        ------
        NoSuchScheduleError
            It does not exist, or belongs to another key.
        ChangedMeanwhileError
            It has another version by now.
        NoSuchUploadError
            The request names an upload that is gone.
        """
        with creating(self._database, delivery) as (connection, made):
            now = self._database.now(connection)
            row = row_of(connection, schedule_id, owner, locked=True)
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
            return made(schedules.get(connection, schedule_id, owner))

    def remove(self, schedule_id: str, *, owner: str | None = None) -> None:
        """Delete a schedule and its history; its jobs stay, and a running one continues.

        Raises
        ------
        NoSuchScheduleError
            It does not exist, or belongs to another key.
        """
        with self._database.write() as connection:
            row_of(connection, schedule_id, owner, locked=True)
            for table in (SCHEDULE_RUNS, SCHEDULE_UPLOADS, SCHEDULES):
                connection.execute(sa.delete(table).where(table.c.schedule_id == schedule_id))

    def runs(
        self, schedule_id: str, *, owner: str | None = None, limit: int = 100, offset: int = 0
    ) -> builtins.list[ScheduleRun]:
        """The history of a schedule, latest first.

        Raises
        ------
        NoSuchScheduleError
            The schedule does not exist, or belongs to another key.
        """
        with self._database.read() as connection:
            row_of(connection, schedule_id, owner)
            chosen = sa.select(SCHEDULE_RUNS).where(SCHEDULE_RUNS.c.schedule_id == schedule_id)
            ordered = chosen.order_by(SCHEDULE_RUNS.c.number.desc()).limit(limit).offset(offset)
            return [run_of(row) for row in connection.execute(ordered)]

    def run_now(
        self,
        schedule_id: str,
        *,
        owner: str | None = None,
        limits: QueueLimits = UNLIMITED,
        delivery: Delivery[Job] | None = None,
    ) -> Job:
        """Make a job now, independent of the clock, also if the schedule is paused.

        Raises
        ------
        NoSuchScheduleError
            It does not exist, or belongs to another key.
        ScheduleBusyError
            A job of it is under way.
        QueueFullError
            Too many jobs wait.
        """
        with creating(self._database, delivery) as (connection, made):
            now = self._database.now(connection)
            job_id = ticks.run_by_hand(connection, schedule_id, owner, now=now, limits=limits)
            return made(queries.get(connection, job_id, None))

    def counts(self) -> tuple[dict[str, int], dict[Outcome, int]]:
        """Schedules by state (`active`, `paused`), and the slots of all of them by outcome."""
        grouped = sa.select(SCHEDULES.c.is_paused, sa.func.count()).group_by(SCHEDULES.c.is_paused)
        sums = [sa.func.coalesce(sa.func.sum(SCHEDULES.c[column]), 0) for column in COLUMN_OF.values()]
        with self._database.read() as connection:
            found = {bool(paused): number for paused, number in connection.execute(grouped)}
            slots = connection.execute(sa.select(*sums)).one()
        by_outcome = {outcome: int(number) for outcome, number in zip(COLUMN_OF, slots, strict=True)}
        return {"active": found.get(False, 0), "paused": found.get(True, 0)}, by_outcome

    # --- for drivers

    def tick(self, *, limits: QueueLimits = UNLIMITED, now: dt.datetime | None = None) -> builtins.list[ScheduleRun]:
        """Decide every slot that has passed. Any number of drivers may do so at once.

        Each schedule is a transaction of its own, in which its slots are decided and its job is made.

        Parameters
        ----------
        limits : QueueLimits
            How many jobs may wait.
        now : datetime, optional
            The present; by default the database's clock.

        Returns
        -------
        list of ScheduleRun
            New history.
        """
        # most checks find nothing: they take no lock
        with self._database.read() as connection:
            at = self._database.now(connection) if now is None else now
            if not ticks.something_is_due(connection, at):
                return []
        added: list[ScheduleRun] = []
        for _ in range(MAX_PER_TICK):
            with self._database.write() as connection:
                # a process that stood still since its last look must not take the work of others for the future
                at = self._database.now(connection) if now is None else now
                found = ticks.decide_first(connection, now=at, limits=limits)
            if found is None:
                break
            added += found
        return added


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
