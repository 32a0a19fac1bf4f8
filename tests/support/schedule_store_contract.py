"""What the store does with schedules on every database: the same tests for SQLite and PostgreSQL."""

import contextlib
import dataclasses
import datetime as dt
import functools
import itertools
import os
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from migrated import add_old_job, at_revision
from schedule_contract import DAY, HOUR, MINUTE, NOON, ScheduleContract, StoredSchedule
from store_contract import DatabaseContract, claim, request, submit, upload

from pipeline.errors import SettingsError
from pipeline.schedule import Cron, Entry, Missed, Outcome, Overlap, passed_slots
from service.errors import (
    ChangedMeanwhileError,
    NoSuchScheduleError,
    NoSuchUploadError,
    QueueFullError,
    ScheduleBusyError,
    StoreError,
    TooManySchedulesError,
    UploadInUseError,
)
from service.jobs import Job, JobStatus, QueueLimits
from service.keys import Scope, new_key
from service.schedules import COUNTED, Definition, Schedule, ScheduleRun, Trigger
from service.store import JobFilter, JobStore, ScheduleFilter, schedules
from service.store.slot_book import MAX_KEPT, SlotBook
from service.store.tables import SCHEDULE_RUNS, SCHEDULES, UPLOADS


def definition(cron: str = "@hourly", zone: str = "UTC", **values: Any) -> Definition:
    return Definition(**{"cron": Cron(cron, zone), "request": request(), **values})


def make(store: JobStore, *, owner: str | None = None, at: dt.datetime = NOON, **values: Any) -> Schedule:
    """A schedule as if it were made at some time."""
    made = store.schedules.create(definition(**values), owner=owner, most=1000)
    next_at = None if made.next_at is None else made.definition.cron.next_time(at)
    with store._database.write() as connection:
        one = sa.update(SCHEDULES).where(SCHEDULES.c.schedule_id == made.schedule_id)
        connection.execute(one.values(decided_until=at, next_at=next_at))
    return store.schedules.get(made.schedule_id)


def tick(store: JobStore, now: dt.datetime) -> list[tuple[Outcome, dt.datetime | None, int]]:
    """What one tick decides: outcome, slot, how many."""
    return [(run.outcome, run.slot, run.slots) for run in store.schedules.tick(now=now)]


def jobs_of(store: JobStore, schedule: Schedule) -> list[Job]:
    return store.list(JobFilter(schedule_id=schedule.schedule_id, limit=1000))


def runs_of(store: JobStore, schedule: Schedule) -> list[ScheduleRun]:
    return store.schedules.runs(schedule.schedule_id, limit=2000)


def end(store: JobStore, job: Job) -> None:
    """Bring a job to its end."""
    store.dismiss(job.job_id)
    assert store.get(job.job_id).status is JobStatus.DISMISSED


def assert_not_there(store: JobStore, schedule_id: str, **owner: str) -> None:
    """To all questions the answer is that there is no such schedule."""
    book = store.schedules
    change = functools.partial(book.change, definition=definition(), version=1)
    for ask in (book.get, book.remove, book.runs, book.run_now, change):
        with pytest.raises(NoSuchScheduleError, match="no schedule"):
            ask(schedule_id, **owner)


class InDatabase:
    """A schedule of a store, for the contract that all storages of schedules meet."""

    done, max_kept = Outcome.SUBMITTED, MAX_KEPT

    def __init__(self, store: JobStore) -> None:
        self._store = store
        self._schedule_id = make(store).schedule_id

    @contextlib.contextmanager
    def opened(self) -> Iterator[SlotBook]:
        with self._store._database.write() as connection:
            yield SlotBook(connection, schedules.row_of(connection, self._schedule_id, None, locked=True))

    def run(self, book: SlotBook, slot: dt.datetime, now: dt.datetime) -> None:
        book.add(Entry(outcome=self.done, slot=slot, at=now), job_id="0" * 32)

    def entries(self) -> list[Entry]:
        return list(reversed(self._store.schedules.runs(self._schedule_id, limit=2 * MAX_KEPT)))

    def counts(self) -> dict[Outcome, int]:
        counts = self._store.schedules.get(self._schedule_id).counts
        return {outcome: number for outcome, number in counts.items() if number}


class ScheduleStoreContract(ScheduleContract, DatabaseContract):
    """What a store of schedules does, whatever the database."""

    @pytest.fixture
    def schedule(self, store: JobStore) -> StoredSchedule:
        return InDatabase(store)

    # --- the tables

    def test_a_database_of_the_first_revision_is_brought_on_with_its_jobs(self, url: str) -> None:
        with JobStore(url) as store:
            with at_revision(store, "0001") as connection:
                job_id = add_old_job(connection, request())
            with pytest.raises(StoreError, match="revision 0001, this version needs"):
                store.check()
            store.migrate()
            store.check()
            found = store.get(job_id)
            assert (found.schedule_id, found.created_at.year, found.request) == (None, 2026, request())
            assert claim(store).job_id == job_id

    def test_stored_requests_get_the_new_names_of_settings(self, url: str) -> None:
        old = {"method": "kmeans", "roof": {"minimum_points": 7, "flat_below_deg": 4.0}, "kmeans": {"least_points": 9}}
        new = {"method": "kmeans", "roof": {"min_points": 7, "flat_below_deg": 4.0}, "kmeans": {"min_points": 9}}
        with JobStore(url) as store:
            with at_revision(store, "0002") as connection:
                job_id = add_old_job(connection, dataclasses.replace(request(), settings=old))
            store.migrate()
            assert store.get(job_id).request.settings == new

    # --- made, read, changed, removed

    def test_a_schedule_comes_back_as_it_was_made(self, store: JobStore) -> None:
        asked = definition(
            "30 2 * * *",
            "Europe/Amsterdam",
            title="nightly \N{HOUSE BUILDING}",
            request=request("https://a.example/b.laz", "url", bbox=(0.0, 0.0, 1.5, 2.0), process_id="compare"),
            priority=-3,
            missed=Missed.SKIP,
            grace_s=12.5,
            overlap=Overlap.WAIT,
        )
        before = store.now()
        made = store.schedules.create(asked, owner="k", most=1)
        assert made.definition == asked
        assert (made.owner, made.version, made.waiting_slot, made.last_run) == ("k", 1, None, None)
        assert made.next_at == asked.cron.next_time(made.created_at)
        assert made.decided_until == made.created_at >= before
        assert made.counts == dict.fromkeys(COUNTED, 0)
        assert store.schedules.get(made.schedule_id, owner="k") == made
        assert runs_of(store, made) == []

    @pytest.mark.parametrize("schedule_id", ["", "x", "0" * 32, "0" * 31 + "\0", "\ud800" * 32])
    def test_a_schedule_that_does_not_exist_is_reported(self, store: JobStore, schedule_id: str) -> None:
        assert_not_there(store, schedule_id)

    def test_the_schedules_of_other_keys_do_not_exist(self, store: JobStore) -> None:
        made, book = make(store, owner="mine"), store.schedules
        assert_not_there(store, made.schedule_id, owner="other")
        assert book.list(ScheduleFilter(owner="other")) == []
        assert [one.schedule_id for one in book.list(ScheduleFilter(owner="mine"))] == [made.schedule_id]

    def test_lists_are_filtered_and_come_in_pages(self, store: JobStore) -> None:
        active = [make(store), make(store, request=request(process_id="compare"))]
        paused = make(store, is_paused=True)

        def ids(**criteria: Any) -> list[str]:
            return [one.schedule_id for one in store.schedules.list(ScheduleFilter(**criteria))]

        every = ids()
        assert set(every) == {one.schedule_id for one in (*active, paused)}
        assert ids(state="paused") == [paused.schedule_id]
        assert set(ids(state="active")) == {one.schedule_id for one in active}
        assert ids(process_id="compare") == [active[1].schedule_id]
        assert ids(process_id="a\0") == []
        assert [*ids(limit=2), *ids(limit=2, offset=2)] == every
        assert store.schedules.counts()[0] == {"active": 2, "paused": 1}

    def test_a_key_has_no_more_schedules_than_it_may(self, store: JobStore) -> None:
        def create(owner: str | None) -> bool:
            try:
                store.schedules.create(definition(), owner=owner, most=4)
            except TooManySchedulesError:
                return False
            return True

        with ThreadPoolExecutor(8) as crew:
            assert sum(crew.map(create, ["a"] * 12)) == 4
        assert create("b")

    def test_a_change_counts_only_for_the_version_that_was_seen(self, store: JobStore) -> None:
        made, book = make(store), store.schedules

        def rename(number: int) -> bool:
            asked = dataclasses.replace(made.definition, title=str(number))
            try:
                book.change(made.schedule_id, asked, version=made.version)
            except ChangedMeanwhileError:
                return False
            return True

        with ThreadPoolExecutor(8) as crew:
            done = list(crew.map(rename, range(8)))
        assert sum(done) == 1
        found = book.get(made.schedule_id)
        assert (found.version, found.definition.title) == (2, str(done.index(True)))
        with pytest.raises(ChangedMeanwhileError, match="has version 2, the change is for version 1"):
            book.change(made.schedule_id, made.definition, version=1)

    def test_other_times_count_from_the_change_on_and_undecided_slots_are_missed(self, store: JobStore) -> None:
        full_hour = store.now().replace(minute=0, second=0, microsecond=0)
        made = make(store, at=full_hour - 3 * HOUR)
        # by other words than its times nothing is decided
        renamed = store.schedules.change(made.schedule_id, dataclasses.replace(made.definition, title="x"), version=1)
        assert (renamed.decided_until, renamed.next_at) == (made.decided_until, made.next_at)
        assert runs_of(store, made) == []
        changed = store.schedules.change(made.schedule_id, definition("15 3 * * *"), version=2)
        assert changed.decided_until == changed.updated_at >= made.updated_at
        assert changed.next_at == changed.definition.cron.next_time(changed.updated_at)
        assert tick(store, changed.updated_at) == []
        (missed,) = runs_of(store, made)
        passed = passed_slots(made.definition.cron, made.decided_until, changed.updated_at)
        assert (missed.outcome, missed.first_slot, missed.slot) == (Outcome.MISSED, passed.first, passed.latest)
        assert changed.counts[Outcome.MISSED] == missed.slots == passed.earlier + 1 >= 3
        assert jobs_of(store, made) == []

    def test_a_schedule_that_is_paused_is_never_due_and_what_passes_meanwhile_is_not_missed(
        self, store: JobStore
    ) -> None:
        made = make(store, at=store.now())
        paused = store.schedules.change(
            made.schedule_id, dataclasses.replace(made.definition, is_paused=True), version=1
        )
        assert paused.next_at is None
        assert tick(store, store.now() + 10 * DAY) == []
        resumed = store.schedules.change(made.schedule_id, made.definition, version=2)
        assert resumed.next_at > resumed.decided_until >= paused.decided_until
        assert tick(store, resumed.decided_until) == []
        assert resumed.counts[Outcome.MISSED] == 0

    def test_a_clock_that_was_put_back_decides_no_slot_twice(self, store: JobStore) -> None:
        later = store.now() + 10 * DAY
        made = make(store, at=later - HOUR)
        assert len(tick(store, later)) == 1
        # the database's own clock is ten days behind: the new times count from now on
        changed = store.schedules.change(made.schedule_id, definition("*/30 * * * *"), version=1)
        assert changed.decided_until < later - 9 * DAY
        found = tick(store, later)
        assert [outcome for outcome, _, _ in found] == [Outcome.MISSED, Outcome.SKIPPED]
        assert len(jobs_of(store, made)) == 1

    def test_a_clock_that_was_put_back_does_not_stop_a_schedule(self, store: JobStore) -> None:
        made = make(store)
        assert len(tick(store, NOON + 10 * DAY)) == 2
        store.dismiss(jobs_of(store, made)[0].job_id)
        back = NOON + 2 * HOUR + MINUTE
        assert tick(store, back) == [(Outcome.MISSED, back, 1)]
        assert tick(store, back) == []
        assert store.schedules.get(made.schedule_id).next_at == NOON + 3 * HOUR
        assert tick(store, NOON + 3 * HOUR) == [(Outcome.SUBMITTED, NOON + 3 * HOUR, 1)]

    def test_a_schedule_that_is_removed_leaves_its_jobs(self, store: JobStore) -> None:
        made = make(store)
        tick(store, NOON + HOUR)
        store.schedules.remove(made.schedule_id)
        with pytest.raises(NoSuchScheduleError):
            store.schedules.get(made.schedule_id)
        (job,) = jobs_of(store, made)
        assert (job.status, job.schedule_id) == (JobStatus.ACCEPTED, made.schedule_id)
        with store._database.read() as connection:
            assert connection.execute(sa.select(sa.func.count()).select_from(SCHEDULE_RUNS)).scalar_one() == 0

    # --- uploads

    def test_an_upload_that_a_schedule_needs_is_neither_removed_nor_expired(self, store: JobStore) -> None:
        sent, other = upload(store, days=-1.0), upload(store, days=-1.0)
        made = make(store, request=request(sent.upload_id, "upload"))
        assert [one.upload_id for one in store.expired_uploads(store.now())] == [other.upload_id]
        with pytest.raises(UploadInUseError, match="1 schedules need"):
            store.remove_upload(sent.upload_id)
        store.schedules.change(made.schedule_id, definition(request=request(other.upload_id, "upload")), version=1)
        assert [one.upload_id for one in store.expired_uploads(store.now())] == [sent.upload_id]
        store.remove_upload(sent.upload_id)
        store.schedules.remove(made.schedule_id)
        store.remove_upload(other.upload_id)

    def test_a_schedule_with_an_upload_that_is_gone_is_not_made(self, store: JobStore) -> None:
        with pytest.raises(NoSuchUploadError, match="send the file again"):
            make(store, request=request("0" * 32, "upload"))
        assert store.schedules.list(ScheduleFilter()) == []

    # --- the clock

    def test_a_slot_becomes_a_job_at_its_time_and_once(self, store: JobStore) -> None:
        made = make(store, owner="k", title="hourly", priority=-2)
        assert tick(store, NOON + HOUR - dt.timedelta(milliseconds=1)) == []
        assert tick(store, NOON + HOUR) == [(Outcome.SUBMITTED, NOON + HOUR, 1)]
        assert tick(store, NOON + HOUR) == []
        (job,) = jobs_of(store, made)
        assert (job.owner, job.priority, job.schedule_id, job.request.title) == ("k", -2, made.schedule_id, "hourly")
        found = store.schedules.get(made.schedule_id)
        assert (found.next_at, found.decided_until) == (NOON + 2 * HOUR, NOON + HOUR)
        assert (found.last_run.job_id, found.last_run.slot) == (job.job_id, NOON + HOUR)
        assert (found.last_run.trigger, found.last_run.at) == (Trigger.CLOCK, NOON + HOUR)
        assert found.counts[Outcome.SUBMITTED] == 1
        assert claim(store).job_id == job.job_id

    def test_each_run_is_a_job_of_its_own(self, store: JobStore) -> None:
        made = make(store)
        for hours in range(1, 6):
            assert tick(store, NOON + hours * HOUR) == [(Outcome.SUBMITTED, NOON + hours * HOUR, 1)]
            end(store, jobs_of(store, made)[0])
        assert len(jobs_of(store, made)) == 5
        assert [run.number for run in runs_of(store, made)] == [5, 4, 3, 2, 1]
        assert [run.number for run in store.schedules.runs(made.schedule_id, limit=2, offset=1)] == [4, 3]

    def test_a_slot_that_comes_while_a_job_is_under_way_is_skipped(self, store: JobStore) -> None:
        made = make(store)
        tick(store, NOON + HOUR)
        (job,) = jobs_of(store, made)
        assert tick(store, NOON + 2 * HOUR) == [(Outcome.SKIPPED, NOON + 2 * HOUR, 1)]
        held = claim(store)
        assert tick(store, NOON + 3 * HOUR) == [(Outcome.SKIPPED, NOON + 3 * HOUR, 1)]
        skipped = runs_of(store, made)[0]
        assert skipped.job_id == job.job_id
        assert job.job_id in skipped.message
        store.succeed(held, message="", summary={})
        assert tick(store, NOON + 4 * HOUR) == [(Outcome.SUBMITTED, NOON + 4 * HOUR, 1)]
        counts = store.schedules.get(made.schedule_id).counts
        assert (counts[Outcome.SUBMITTED], counts[Outcome.SKIPPED]) == (2, 2)
        assert store.schedules.counts()[1] == counts

    def test_a_slot_that_waits_is_run_when_the_job_is_over(self, store: JobStore) -> None:
        made = make(store, overlap=Overlap.WAIT)
        tick(store, NOON + HOUR)
        assert tick(store, NOON + 2 * HOUR) == [(Outcome.WAITING, NOON + 2 * HOUR, 1)]
        assert tick(store, NOON + 2 * HOUR + MINUTE) == []
        assert tick(store, NOON + 3 * HOUR) == [
            (Outcome.MISSED, NOON + 2 * HOUR, 1),
            (Outcome.WAITING, NOON + 3 * HOUR, 1),
        ]
        assert store.schedules.get(made.schedule_id).waiting_slot == NOON + 3 * HOUR
        end(store, jobs_of(store, made)[0])
        # not at its next time, but as soon as the job is over
        assert tick(store, NOON + 3 * HOUR + 10 * MINUTE) == [(Outcome.SUBMITTED, NOON + 3 * HOUR, 1)]
        assert tick(store, NOON + 3 * HOUR + 11 * MINUTE) == []
        found = store.schedules.get(made.schedule_id)
        assert (found.waiting_slot, found.next_at) == (None, NOON + 4 * HOUR)
        outcomes = [(run.number, run.outcome) for run in runs_of(store, made)]
        assert outcomes == [(3, Outcome.SUBMITTED), (2, Outcome.MISSED), (1, Outcome.SUBMITTED)]
        assert found.last_run == runs_of(store, made)[0]

    def test_a_slot_that_waits_is_missed_when_the_schedule_is_paused(self, store: JobStore) -> None:
        made = make(store, overlap=Overlap.WAIT)
        tick(store, NOON + HOUR)
        tick(store, NOON + 2 * HOUR)
        store.schedules.change(made.schedule_id, dataclasses.replace(made.definition, is_paused=True), version=1)
        end(store, jobs_of(store, made)[0])
        assert tick(store, NOON + 3 * HOUR) == []
        missed = runs_of(store, made)[0]
        assert (missed.outcome, missed.slot) == (Outcome.MISSED, NOON + 2 * HOUR)
        assert "paused" in missed.message
        assert store.schedules.get(made.schedule_id).counts[Outcome.MISSED] == 1

    def test_a_full_queue_is_reported_and_leaves_no_half_a_job(self, store: JobStore) -> None:
        made = make(store, owner="k")
        submit(store, owner="k")
        entries = store.schedules.tick(now=NOON + HOUR, limits=QueueLimits(max_queued=10, max_queued_per_key=1))
        assert [(run.outcome, run.job_id) for run in entries] == [(Outcome.FAILED, None)]
        assert "1 jobs of this key wait, the limit is 1" in entries[0].message
        assert runs_of(store, made) == entries
        assert jobs_of(store, made) == []
        assert store.counts()[JobStatus.ACCEPTED] == 1
        # the next slot is tried again
        assert tick(store, NOON + 2 * HOUR) == [(Outcome.SUBMITTED, NOON + 2 * HOUR, 1)]

    def test_an_upload_that_is_gone_is_reported_and_leaves_no_half_a_job(self, store: JobStore) -> None:
        sent = upload(store)
        made = make(store, request=request(sent.upload_id, "upload"))
        with store._database.write() as connection:
            connection.execute(sa.delete(UPLOADS))
        (entry,) = store.schedules.tick(now=NOON + HOUR)
        assert (entry.outcome, entry.job_id) == (Outcome.FAILED, None)
        assert sent.upload_id in entry.message
        assert jobs_of(store, made) == []
        assert store.schedules.get(made.schedule_id).counts[Outcome.FAILED] == 1

    def test_a_revoked_key_runs_nothing_more(self, store: JobStore) -> None:
        key, _ = new_key("old", Scope.SUBMIT, now=store.now())
        store.add_key(key)
        made = make(store, owner=key.key_id)
        tick(store, NOON + HOUR)
        end(store, jobs_of(store, made)[0])
        store.revoke_key(key.key_id)
        (entry,) = store.schedules.tick(now=NOON + 2 * HOUR)
        assert entry.outcome is Outcome.FAILED
        assert "'old'" in entry.message
        assert "was revoked" in entry.message
        assert len(jobs_of(store, made)) == 1

    def test_an_unknown_time_zone_is_reported_and_blocks_no_other_schedule(self, store: JobStore) -> None:
        bad, good = make(store, overlap=Overlap.WAIT), make(store)
        with store._database.write() as connection:
            one = sa.update(SCHEDULES).where(SCHEDULES.c.schedule_id == bad.schedule_id)
            connection.execute(one.values(time_zone="Mars/Olympus"))
        entries = {run.schedule_id: run for run in store.schedules.tick(now=NOON + HOUR)}
        assert (entries[bad.schedule_id].outcome, entries[bad.schedule_id].slot) == (Outcome.FAILED, NOON + HOUR)
        assert "Mars/Olympus" in entries[bad.schedule_id].message
        assert entries[good.schedule_id].outcome is Outcome.SUBMITTED
        assert tick(store, NOON + HOUR + MINUTE) == []
        with pytest.raises(SettingsError, match="Mars/Olympus"):
            store.schedules.get(bad.schedule_id)
        with store._database.write() as connection:
            connection.execute(one.values(time_zone="UTC"))
        # known again: slots in the meantime are missed, the latest is run
        assert (Outcome.MISSED, NOON + 3 * HOUR, 2) in tick(store, NOON + 4 * HOUR)
        store.schedules.remove(bad.schedule_id)

    # --- by hand

    def test_a_run_by_hand_is_a_job_at_once_and_leaves_the_times_alone(self, store: JobStore) -> None:
        made = make(store, owner="k", title="by the hour")
        job = store.schedules.run_now(made.schedule_id, owner="k")
        assert (job.status, job.schedule_id, job.request.title) == (JobStatus.ACCEPTED, made.schedule_id, "by the hour")
        (run,) = runs_of(store, made)
        assert (run.trigger, run.outcome) == (Trigger.HAND, Outcome.SUBMITTED)
        assert (run.slot, run.job_id) == (None, job.job_id)
        found = store.schedules.get(made.schedule_id)
        assert (found.next_at, found.decided_until, found.version) == (made.next_at, made.decided_until, 1)

    def test_a_run_by_hand_is_refused_while_a_job_is_under_way(self, store: JobStore) -> None:
        made = make(store, overlap=Overlap.WAIT)
        job = store.schedules.run_now(made.schedule_id)
        with pytest.raises(ScheduleBusyError, match=job.job_id) as raised:
            store.schedules.run_now(made.schedule_id)
        assert raised.value.job_id == job.job_id
        assert tick(store, NOON + HOUR) == [(Outcome.WAITING, NOON + HOUR, 1)]
        end(store, job)
        store.schedules.run_now(made.schedule_id)
        # the slot goes on waiting for this one
        assert store.schedules.get(made.schedule_id).waiting_slot == NOON + HOUR
        assert tick(store, NOON + HOUR + MINUTE) == []

    def test_a_paused_schedule_can_be_run_by_hand(self, store: JobStore) -> None:
        made = make(store, is_paused=True)
        store.schedules.run_now(made.schedule_id)
        found = store.schedules.get(made.schedule_id)
        assert (found.next_at, found.counts[Outcome.SUBMITTED]) == (None, 1)

    def test_a_run_by_hand_that_a_full_line_refuses_leaves_nothing(self, store: JobStore) -> None:
        made = make(store)
        submit(store)
        with pytest.raises(QueueFullError):
            store.schedules.run_now(made.schedule_id, limits=QueueLimits(max_queued=1, max_queued_per_key=1))
        assert runs_of(store, made) == []

    # --- several at once, and failures

    def test_many_ticks_and_hands_at_once_make_one_job(self, store: JobStore) -> None:
        made = [make(store) for _ in range(6)]
        barrier = threading.Barrier(8)

        def one(number: int) -> None:
            barrier.wait()
            if number % 2:
                tick(store, NOON + HOUR)
                return
            for schedule in made:
                try:
                    store.schedules.run_now(schedule.schedule_id)
                except ScheduleBusyError:
                    continue

        with ThreadPoolExecutor(8) as crew:
            list(crew.map(one, range(8)))
        tick(store, NOON + HOUR)
        for schedule in made:
            assert len(jobs_of(store, schedule)) == 1
            runs = runs_of(store, schedule)
            assert Counter(run.outcome for run in runs)[Outcome.SUBMITTED] == 1
            # the slot was decided once: run, or skipped as the hand was faster
            assert [run.slot for run in runs if run.trigger is Trigger.CLOCK] == [NOON + HOUR]

    def test_what_breaks_between_the_job_and_the_note_leaves_neither(
        self, store: JobStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        from service.store import ticks

        made = make(store)

        def broken(*_: object, **__: object) -> None:
            raise StoreError("the connection was cut")

        with monkeypatch.context() as patched:
            patched.setattr(ticks.SlotBook, "save", broken)
            with pytest.raises(StoreError):
                tick(store, NOON + HOUR)
        assert jobs_of(store, made) == []
        assert runs_of(store, made) == []
        assert tick(store, NOON + HOUR) == [(Outcome.SUBMITTED, NOON + HOUR, 1)]

    def test_a_slot_cannot_be_written_twice(self, store: JobStore) -> None:
        made = make(store)
        tick(store, NOON + HOUR)
        (run,) = runs_of(store, made)
        with pytest.raises(sa.exc.IntegrityError), store._database.write() as connection:
            connection.execute(sa.insert(SCHEDULE_RUNS).values(**dataclasses.asdict(run) | {"number": 2}))

    @pytest.mark.slow
    def test_replicas_that_are_killed_while_they_tick_lose_no_slot_and_double_none(
        self, url: str, store: JobStore
    ) -> None:
        """Processes tick through twenty hours of shared, shifted time; in each fifth of it one of them is killed."""
        start = dt.datetime(2031, 10, 25, 12, tzinfo=dt.UTC)
        ticks, lap = 200, 40
        every, step = 5, 6
        made = [
            make(store, cron=f"*/{every} * * * *", zone="Europe/Amsterdam", at=start, missed=missed)
            for missed in (Missed.RUN_LATEST, Missed.SKIP) * 3
        ]
        hammer = Path(__file__).resolve().parent / "schedule_hammer.py"
        environment = {**os.environ, "PYTHONPATH": str(hammer.parents[1])}

        def started(name: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, str(hammer), url, name, start.isoformat(), str(step), str(ticks), str(lap)]
            return subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)

        def may_go_on(one: subprocess.Popen[bytes], laps: int = 1) -> None:
            one.stdin.write(b"\n" * laps)

        def end(one: subprocess.Popen[bytes]) -> None:
            one.kill()
            one.wait()
            for stream in (one.stdin, one.stdout):
                stream.close()

        steady = [started("left"), started("right")]
        try:
            for number in range(ticks // lap):
                victim = started("victim")
                try:
                    # the others wait for this lap to begin: here at the latest it makes a job, and never comes farther
                    may_go_on(victim, number + 1)
                    assert victim.stdout.readline()
                    for one in steady:
                        may_go_on(one)
                finally:
                    end(victim)
            for one in steady:
                # what it prints would fill its pipe
                one.stdout.read()
                one.wait()
        finally:
            for one in steady:
                end(one)
        assert [one.returncode for one in steady] == [0, 0]
        until = start + (ticks - 1) * step * MINUTE
        tick(store, until)
        for schedule in made:
            times = (at.astimezone(dt.UTC) for at in schedule.definition.cron.times(start))
            expected = set(itertools.takewhile(lambda at: at <= until, times))
            with store._database.read() as connection:
                query = sa.select(SCHEDULE_RUNS).where(SCHEDULE_RUNS.c.schedule_id == schedule.schedule_id)
                rows = connection.execute(query).all()
            singles = [row.slot for row in rows if row.first_slot is None]
            assert len(set(singles)) == len(singles)
            stretches = [(row.first_slot, row.slot) for row in rows if row.first_slot is not None]
            decided = Counter([*singles, *(at for low, high in stretches for at in expected if low <= at <= high)])
            assert set(decided) == expected
            assert max(decided.values()) == 1
            jobs = [row.job_id for row in rows if row.outcome == Outcome.SUBMITTED]
            assert len(set(jobs)) == len(jobs) == len(jobs_of(store, schedule))
            counts = store.schedules.get(schedule.schedule_id).counts
            assert sum(counts.values()) == len(expected)
