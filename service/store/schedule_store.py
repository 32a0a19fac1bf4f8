"""The schedules of a store. Every method is one transaction, committed when it returns."""

from __future__ import annotations

import builtins
import datetime as dt
import functools

from pipeline.schedule import Outcome
from service.deliveries import Delivery
from service.jobs import Job
from service.schedules import Definition, Schedule, ScheduleRun
from service.store import queries, schedule_changes, schedules, ticks
from service.store.database import LOCK_SUBMISSIONS, Database
from service.store.delivering import creating
from service.store.schedules import ScheduleFilter
from service.store.ticks import QueueLimits

MAX_PER_TICK = 200
"""Maximum number of schedules that one tick decides; the next tick continues."""


class ScheduleStore:
    """Schedules and their history; `JobStore.schedules`.

    It uses the clock of the database: replicas whose clocks differ agree on what is due.

    Parameters
    ----------
    database : Database
        The store's own.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

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
            self._database.lock(connection, LOCK_SUBMISSIONS)
            now = self._database.now(connection)
            schedule_id = schedule_changes.insert(connection, definition, owner=owner, most=most, now=now)
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
        with self._database.read() as connection:
            return schedules.listed(connection, criteria)

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
            schedule_changes.change(connection, schedule_id, definition, owner=owner, version=version, now=now)
            return made(schedules.get(connection, schedule_id, owner))

    def remove(self, schedule_id: str, *, owner: str | None = None) -> None:
        """Delete a schedule and its history; its jobs stay, and a running one continues.

        Raises
        ------
        NoSuchScheduleError
            It does not exist, or belongs to another key.
        """
        with self._database.write() as connection:
            schedule_changes.remove(connection, schedule_id, owner)

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
            return schedules.runs(connection, schedule_id, owner, limit=limit, offset=offset)

    def run_now(
        self,
        schedule_id: str,
        *,
        owner: str | None = None,
        max_queued: int,
        max_queued_per_key: int,
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
        limits = self._limits(max_queued, max_queued_per_key)
        with creating(self._database, delivery) as (connection, made):
            now = self._database.now(connection)
            job_id = ticks.run_by_hand(connection, schedule_id, owner, now=now, limits=limits)
            return made(queries.get(connection, job_id, None))

    def counts(self) -> tuple[dict[str, int], dict[Outcome, int]]:
        """Schedules by state (`active`, `paused`), and the slots of all of them by outcome."""
        with self._database.read() as connection:
            return schedules.counts(connection)

    # --- for drivers

    def tick(
        self, *, max_queued: int, max_queued_per_key: int, now: dt.datetime | None = None
    ) -> builtins.list[ScheduleRun]:
        """Decide every slot that has passed. Any number of drivers may do so at once.

        Each schedule is a transaction of its own, in which its slots are decided and its job is made.

        Parameters
        ----------
        max_queued, max_queued_per_key : int
            Maximum number of waiting jobs, in total and per key.
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
        limits = self._limits(max_queued, max_queued_per_key)
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

    def _limits(self, max_queued: int, max_queued_per_key: int) -> QueueLimits:
        lock = functools.partial(self._database.lock, number=LOCK_SUBMISSIONS)
        return QueueLimits(max_queued=max_queued, max_queued_per_key=max_queued_per_key, lock=lock)
