"""What the store does on every database: the same tests for SQLite and PostgreSQL."""

import dataclasses
import datetime as dt
import os
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

import pytest
from checkout import ROOT
from processes import LONG_S, wait_for

from service import migrations
from service.errors import (
    LeaseLostError,
    NoSuchJobError,
    NoSuchUploadError,
    QueueFullError,
    ResultNotReadyError,
    StoreError,
    UploadInUseError,
)
from service.jobs import Fault, InputReference, Job, JobEvent, JobFailure, JobRequest, JobStatus, QueueLimits, Upload
from service.keys import Scope, digest_of, new_key, rotated
from service.store import JobFilter, JobStore
from service.store.changes import MAX_KEPT
from service.store.tables import METADATA

Value = TypeVar("Value")

HOUR_S = 3600.0
SOON_S = 0.02
"""A lease that is over at once."""


def until(condition: Callable[[], Value | None]) -> Value:
    """What the condition returns once it is true."""
    return wait_for(condition, "what the database is to hold", interval_s=0.01)


def request(value: str = "/data/tile.laz", kind: Any = "path", **others: Any) -> JobRequest:
    return JobRequest(tiles=(InputReference(kind=kind, value=value),), **others)


def submit(store: JobStore, *, owner: str | None = None, priority: int = 0, **others: Any) -> Job:
    return store.create(request(**others), owner=owner, priority=priority)


def claim(store: JobStore, driver: str = "a", *, lease_s: float = HOUR_S, max_attempts: int = 3) -> Job:
    job = store.claim(driver, lease_s=lease_s, max_attempts=max_attempts)
    assert job is not None
    return job


def running(store: JobStore, driver: str = "a", *, lease_s: float = HOUR_S) -> Job:
    """A job that a driver holds."""
    submit(store)
    return claim(store, driver, lease_s=lease_s)


def happened(kind: str = "warning", **values: Any) -> JobEvent:
    return JobEvent(sequence=0, at=dt.datetime(2020, 1, 1, tzinfo=dt.UTC), kind=kind, **values)


def upload(store: JobStore, *, owner: str | None = None, days: float = 1.0, upload_id: str | None = None) -> Upload:
    now = store.now()
    one = Upload(
        upload_id=upload_id or uuid4().hex,
        owner=owner,
        filename="tile.laz",
        size_bytes=5 * 2**30,
        sha256="0" * 64,
        created_at=now,
        expires_at=now + dt.timedelta(days=days),
        preflight={"points": 12, "crs": None, "bounds": [0.5, 1.5]},
    )
    store.add_upload(one)
    return one


def ids(store: JobStore, **criteria: Any) -> set[str]:
    """The jobs that a filter finds."""
    return {job.job_id for job in store.list(JobFilter(**criteria))}


def statuses(store: JobStore, job: Job) -> list[JobStatus | None]:
    return [event.status for event in store.events(job.job_id) if event.kind == "status"]


class DatabaseContract:
    """Each database brings its `url`."""

    @pytest.fixture
    def url(self) -> str:
        raise NotImplementedError

    @pytest.fixture
    def store(self, url: str) -> Iterator[JobStore]:
        with JobStore(url) as store:
            store.migrate()
            yield store

    @pytest.fixture
    def held(self, store: JobStore) -> Job:
        """A job that a driver holds."""
        return running(store)


class StoreContract(DatabaseContract):
    """What a store of jobs does, whatever the database."""

    # --- the tables

    def test_a_database_without_tables_is_reported(self, url: str) -> None:
        with JobStore(url) as store, pytest.raises(StoreError, match=r"start the service|does not exist"):
            store.check()

    def test_many_may_migrate_at_once(self, url: str) -> None:
        stores = [JobStore(url) for _ in range(6)]
        with ThreadPoolExecutor(len(stores)) as crew:
            list(crew.map(JobStore.migrate, stores))
        for store in stores:
            store.check()
            store.close()

    def test_migrating_again_keeps_what_is_there(self, store: JobStore) -> None:
        job = submit(store)
        store.migrate()
        assert store.get(job.job_id) == job

    def test_a_database_of_a_newer_version_is_refused(self, store: JobStore) -> None:
        with store._database.write() as connection:
            connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
        for refused in (store.check, store.migrate):
            with pytest.raises(StoreError, match="9999"):
                refused()

    def test_the_revisions_make_the_tables_that_the_code_knows(self, store: JobStore) -> None:
        from alembic.autogenerate import compare_metadata
        from alembic.runtime.migration import MigrationContext

        with store._database.read() as connection:
            assert migrations.current(connection) == migrations.head()
            context = MigrationContext.configure(connection, opts={"compare_type": True})
            assert compare_metadata(context, METADATA) == []

    # --- submitting and reading

    def test_a_job_comes_back_as_it_was_submitted(self, store: JobStore) -> None:
        asked = JobRequest(
            tiles=(InputReference(kind="path", value="/a"), InputReference(kind="url", value="https://b/c")),
            footprints=InputReference(kind="path", value="/f"),
            bbox=(1.0, 2.0, 3.5, 4.25),
            process_id="compare",
            methods=("fuzzy-sart", "fuzzy-sart:faithful"),
            settings={"general": {"method": "arrangement"}},
            outputs=("buildings", "report"),
            title="Straße \N{HOUSE BUILDING}",
        )
        job = store.create(asked, owner="k", priority=3, limits=QueueLimits(max_queued=1, max_queued_per_key=1))
        assert job.request == asked
        assert (job.status, job.owner, job.priority, job.attempt) == (JobStatus.ACCEPTED, "k", 3, 0)
        assert store.get(job.job_id) == job
        assert len(job.job_id) == 32

    def test_times_have_a_time_zone_and_come_from_the_database(self, store: JobStore) -> None:
        before = store.now()
        job = submit(store)
        held = claim(store)
        store.succeed(held, message="", summary={})
        after = store.now()
        done = store.get(job.job_id)
        times = [before, job.created_at, done.started_at, done.finished_at, after]
        assert times == sorted(times)
        assert {time.utcoffset() for time in times} == {dt.timedelta(0)}
        assert abs((after - dt.datetime.now(dt.UTC)).total_seconds()) < HOUR_S

    @pytest.mark.parametrize("job_id", ["", "x", "0" * 32, "0" * 31 + "\0", "../../etc", "\ud800" * 32])
    def test_a_job_that_does_not_exist_is_reported(self, store: JobStore, job_id: str) -> None:
        for ask in (store.get, store.dismiss):
            with pytest.raises(NoSuchJobError, match="no job"):
                ask(job_id)
        assert store.events(job_id) == []

    def test_the_jobs_of_other_keys_do_not_exist(self, store: JobStore) -> None:
        job = submit(store, owner="mine")
        assert store.get(job.job_id, owner="mine") == job
        for ask in (store.get, store.dismiss):
            with pytest.raises(NoSuchJobError):
                ask(job.job_id, owner="other")
        assert store.get(job.job_id).status is JobStatus.ACCEPTED
        assert store.list(JobFilter(owner="other")) == []

    def test_text_that_a_database_would_refuse_is_stored_without_its_odd_characters(self, store: JobStore) -> None:
        submit(store, title="a\0b\ud800")
        held = claim(store)
        store.record(held, [happened(message="nul \0 and surrogate \ud800", stage="s" * 100)])
        store.fail(held, JobFailure(fault=Fault.INPUT, detail="bad \0 value"))
        failure = store.get(held.job_id).failure
        assert failure.detail == "bad \ufffd value"

    def test_a_full_line_refuses_and_running_jobs_do_not_count(self, store: JobStore) -> None:
        def create(owner: str | None) -> Job:
            return store.create(request(), owner=owner, limits=QueueLimits(max_queued=3, max_queued_per_key=2))

        create("a"), create("a")
        with pytest.raises(QueueFullError, match="2 jobs of this key"):
            create("a")
        create("b")
        with pytest.raises(QueueFullError, match="3 jobs wait"):
            create(None)
        claim(store)
        create("a")

    def test_the_limit_holds_when_many_submit_at_once(self, store: JobStore) -> None:
        def create(number: int) -> bool:
            del number
            try:
                store.create(request(), owner="k", limits=QueueLimits(max_queued=100, max_queued_per_key=7))
            except QueueFullError:
                return False
            return True

        with ThreadPoolExecutor(16) as crew:
            assert sum(crew.map(create, range(40))) == 7
        assert store.counts()[JobStatus.ACCEPTED] == 7

    # --- lists

    def test_jobs_are_listed_newest_first_and_in_pages(self, store: JobStore) -> None:
        jobs = []
        for number in range(5):
            jobs.append(submit(store, title=str(number)))
            until(lambda: store.now() > jobs[-1].created_at)
        titles = [job.request.title for job in store.list(JobFilter())]
        assert titles == ["4", "3", "2", "1", "0"]
        assert [job.request.title for job in store.list(JobFilter(limit=2, offset=1))] == ["3", "2"]

    def test_words_are_searched_in_title_id_and_process(self, store: JobStore) -> None:
        delft = submit(store, title="Delft West, 2 tiles")
        echo = submit(store, process_id="echo", title="100 % of 5_000")
        bare = submit(store)
        assert ids(store, words=["west", "DELFT"]) == {delft.job_id}
        assert ids(store, words=["west", "echo"]) == set()
        assert ids(store, words=["Echo"]) == {echo.job_id}
        assert ids(store, words=[bare.job_id[3:12].upper()]) == {bare.job_id}
        # the signs of patterns are plain signs
        assert ids(store, words=["0 % o"]) == ids(store, words=["5_0"]) == {echo.job_id}
        assert ids(store, words=["5__"]) == ids(store, words=["a\0b"]) == set()
        assert store.matching(JobFilter(words=["t"], limit=1)) == len(ids(store, words=["t"]))

    def test_lists_are_filtered_by_status_process_and_time(self, store: JobStore) -> None:
        first = submit(store)
        until(lambda: store.now() > first.created_at)
        other = submit(store, process_id="echo")

        held = claim(store)
        assert held.job_id == first.job_id
        assert ids(store, statuses=[JobStatus.RUNNING]) == {first.job_id}
        assert ids(store, statuses=[JobStatus.RUNNING, JobStatus.ACCEPTED]) == {first.job_id, other.job_id}
        assert ids(store, process_ids=["echo"]) == {other.job_id}
        assert ids(store, process_ids=["e\0cho"]) == set()
        assert ids(store, created_from=other.created_at) == {other.job_id}
        assert ids(store, created_to=first.created_at) == {first.job_id}
        east = dt.timezone(dt.timedelta(hours=5))
        assert ids(store, created_to=first.created_at.astimezone(east)) == {first.job_id}

    def test_lists_are_filtered_by_duration_up_to_now_for_jobs_that_run(self, store: JobStore) -> None:
        waiting, done = submit(store, priority=0), submit(store, priority=1)
        held = claim(store)
        assert held.job_id == done.job_id

        for _ in range(2):
            assert ids(store, min_duration_s=0) == {done.job_id}
            assert ids(store, max_duration_s=HOUR_S) == {done.job_id}
            assert ids(store, min_duration_s=HOUR_S) == set()
            assert ids(store, max_duration_s=-1.0) == set()
            assert ids(store, min_duration_s=float("inf")) == set()
            if store.get(done.job_id).status is JobStatus.RUNNING:
                store.succeed(held, message="", summary={})
        assert waiting.job_id not in ids(store, max_duration_s=1e300)

    # --- the line

    def test_the_line_goes_by_priority_then_age(self, store: JobStore) -> None:
        for title, priority in (("low", -1), ("old", 0), ("young", 0), ("high", 5)):
            job = submit(store, title=title, priority=priority)
            until(lambda job=job: store.now() > job.created_at)
        assert [claim(store).request.title for _ in range(4)] == ["high", "old", "young", "low"]
        assert store.claim("a", lease_s=1.0, max_attempts=3) is None

    def test_a_claimed_job_is_held_with_a_lease(self, store: JobStore) -> None:
        held = running(store, "driver-1", lease_s=100.0)
        assert (held.status, held.lease_owner, held.attempt) == (JobStatus.RUNNING, "driver-1", 1)
        assert held.lease_until - held.started_at == dt.timedelta(seconds=100)
        assert store.get(held.job_id) == held

    def test_renewing_lengthens_the_lease(self, store: JobStore) -> None:
        held = running(store, lease_s=1.0)
        assert store.renew(held, lease_s=HOUR_S) is False
        renewed = store.get(held.job_id)
        assert renewed.lease_until > held.lease_until + dt.timedelta(minutes=30)

    def test_a_lease_that_was_not_taken_can_still_be_renewed(self, store: JobStore) -> None:
        held = running(store, lease_s=SOON_S)
        until(lambda: held.lease_until is not None and store.now() > held.lease_until)
        assert store.renew(held, lease_s=HOUR_S) is False
        assert store.claim("b", lease_s=1.0, max_attempts=3) is None

    def test_an_expired_lease_passes_to_the_next_driver_and_the_first_can_write_no_more(self, store: JobStore) -> None:
        first = running(store, "a", lease_s=SOON_S)
        second = until(lambda: store.claim("b", lease_s=HOUR_S, max_attempts=3))
        assert (second.job_id, second.attempt, second.lost_attempts) == (first.job_id, 2, 1)
        assert second.started_at == first.started_at
        for write in (
            lambda: store.renew(first, lease_s=1.0),
            lambda: store.record(first, [happened()]),
            lambda: store.succeed(first, message="", summary={}),
            lambda: store.fail(first, JobFailure(fault=Fault.INPUT, detail="x")),
            lambda: store.dismissed(first),
            lambda: store.release(first, lost=False),
        ):
            with pytest.raises(LeaseLostError, match="attempt"):
                write()
        assert store.get(first.job_id) == second
        store.succeed(second, message="done", summary={"n": 1})
        assert statuses(store, first) == ["accepted", "running", "accepted", "running", "successful"]
        assert any("a was silent" in event.message for event in store.events(first.job_id))

    def test_the_jobs_of_a_driver_that_is_known_to_be_dead_wait_at_once(self, store: JobStore) -> None:
        first, second = submit(store), submit(store)
        held = store.claim("dead", lease_s=LONG_S, max_attempts=3)
        other = store.claim("alive", lease_s=LONG_S, max_attempts=3)
        assert (held.job_id, other.job_id) == (first.job_id, second.job_id)
        assert store.give_up("dead", max_attempts=3) == [first.job_id]
        with pytest.raises(LeaseLostError):
            store.succeed(held, message="late", summary={})
        again = store.claim("next", lease_s=LONG_S, max_attempts=3)
        assert (again.job_id, again.attempt, again.lost_attempts) == (first.job_id, 2, 1)
        assert any("driver dead ended" in event.message for event in store.events(first.job_id))
        assert store.still_held(other).dismissal is False

    def test_the_same_driver_with_an_older_attempt_can_write_no_more(self, store: JobStore) -> None:
        first = running(store, "a", lease_s=SOON_S)
        until(lambda: store.claim("a", lease_s=HOUR_S, max_attempts=3))
        with pytest.raises(LeaseLostError):
            store.succeed(first, message="", summary={})

    def test_a_job_that_is_lost_too_often_fails(self, store: JobStore) -> None:
        job = submit(store)
        for attempt in (1, 2):
            held = until(lambda: store.claim("a", lease_s=SOON_S, max_attempts=2))
            assert held.attempt == attempt
        other = submit(store)
        claimed = until(
            lambda: (store.get(job.job_id).status.is_over and "over") or store.claim("b", lease_s=9, max_attempts=2)
        )
        assert claimed == "over" or claimed.job_id == other.job_id
        until(lambda: store.claim("c", lease_s=9, max_attempts=2) or store.get(job.job_id).status.is_over)
        failed = store.get(job.job_id)
        assert failed.status is JobStatus.FAILED
        assert failed.failure.fault is Fault.LOST
        assert "2 drivers" in failed.failure.detail
        assert failed.lost_attempts == 2
        assert failed.finished_at is not None
        assert statuses(store, job) == ["accepted", "running", "accepted", "running", "failed"]

    def test_a_released_job_is_claimed_again_at_once_and_loses_nothing(self, store: JobStore) -> None:
        held = running(store, "a")
        store.release(held, lost=False, message="the driver stops")
        waiting = store.get(held.job_id)
        assert (waiting.status, waiting.message) == (JobStatus.ACCEPTED, "the driver stops")
        again = claim(store, "b")
        assert (again.attempt, again.lost_attempts, again.lease_owner) == (2, 0, "b")

    def test_a_job_released_for_later_waits_until_then(self, store: JobStore, held: Job) -> None:
        store.release(held, lost=True, retry_after_s=HOUR_S)
        assert store.claim("b", lease_s=1.0, max_attempts=3) is None
        held = running(store)
        store.release(held, lost=True, retry_after_s=0.05)
        assert until(lambda: store.claim("b", lease_s=HOUR_S, max_attempts=3)).lost_attempts == 1

    # --- the end

    def test_a_success_has_its_summary_and_is_final(self, store: JobStore, held: Job) -> None:
        store.succeed(held, message="80 buildings", summary={"counts": {"ok": 80}, "total_s": 1.5})
        done = store.get(held.job_id)
        assert (done.status, done.progress, done.message) == (JobStatus.SUCCESSFUL, 100, "80 buildings")
        assert done.summary == {"counts": {"ok": 80}, "total_s": 1.5}
        assert (done.lease_owner, done.lease_until) == (None, None)
        for write in (
            lambda: store.succeed(held, message="", summary={}),
            lambda: store.fail(held, JobFailure(fault=Fault.INTERNAL, detail="x")),
            lambda: store.release(held, lost=True),
        ):
            with pytest.raises(LeaseLostError, match="successful"):
                write()
        assert store.dismiss(held.job_id) == done

    def test_a_failure_has_its_cause(self, store: JobStore, held: Job) -> None:
        failure = JobFailure(fault=Fault.SETTINGS, detail="cell_size_m is 0")
        store.fail(held, failure)
        failed = store.get(held.job_id)
        assert (failed.status, failed.failure, failed.message) == (JobStatus.FAILED, failure, "cell_size_m is 0")

    def test_a_waiting_job_is_dismissed_at_once(self, store: JobStore) -> None:
        job = submit(store)
        assert store.dismiss(job.job_id).status is JobStatus.DISMISSED
        assert store.claim("a", lease_s=1.0, max_attempts=3) is None
        assert statuses(store, job) == ["accepted", "dismissed"]

    def test_the_driver_of_a_running_job_is_asked_to_let_go(self, store: JobStore, held: Job) -> None:
        asked = store.dismiss(held.job_id)
        assert (asked.status, asked.dismiss_requested) == (JobStatus.RUNNING, True)
        assert store.dismiss(held.job_id).status is JobStatus.RUNNING
        assert store.renew(held, lease_s=HOUR_S) is True
        store.dismissed(held)
        assert store.get(held.job_id).status is JobStatus.DISMISSED

    def test_a_released_job_that_was_to_be_dismissed_is_dismissed(self, store: JobStore, held: Job) -> None:
        store.dismiss(held.job_id)
        store.release(held, lost=False)
        assert store.get(held.job_id).status is JobStatus.DISMISSED

    def test_a_job_whose_driver_died_while_it_was_to_be_dismissed_is_dismissed(self, store: JobStore) -> None:
        held = running(store, lease_s=1.0)
        store.dismiss(held.job_id)

        def over() -> bool:
            assert store.claim("b", lease_s=HOUR_S, max_attempts=3) is None
            return store.get(held.job_id).status is JobStatus.DISMISSED

        assert until(over)

    def test_a_job_whose_driver_is_lost_is_dismissed_at_once(self, store: JobStore) -> None:
        held = running(store, lease_s=SOON_S)
        until(lambda: held.lease_until is not None and store.now() > held.lease_until)
        assert store.dismiss(held.job_id).status is JobStatus.DISMISSED
        with pytest.raises(LeaseLostError):
            store.succeed(held, message="", summary={})

    def test_only_a_job_that_is_over_can_be_removed(self, store: JobStore) -> None:
        job = submit(store)
        with pytest.raises(ResultNotReadyError, match="accepted"):
            store.remove(job.job_id)
        held = claim(store)
        with pytest.raises(ResultNotReadyError, match="running"):
            store.remove(job.job_id)
        store.succeed(held, message="", summary={})
        store.remove(job.job_id)
        with pytest.raises(NoSuchJobError):
            store.get(job.job_id)
        with pytest.raises(NoSuchJobError):
            store.remove(job.job_id)
        assert store.events(job.job_id) == []

    def test_the_attempts_of_jobs_are_known_for_those_that_exist(self, store: JobStore) -> None:
        job, waiting = submit(store, priority=1), submit(store)
        claim(store)
        many = [uuid4().hex for _ in range(1100)]
        assert store.attempts([*many, job.job_id, waiting.job_id, "../x"]) == {
            job.job_id: (JobStatus.RUNNING, 1),
            waiting.job_id: (JobStatus.ACCEPTED, 0),
        }

    # --- events

    def test_events_carry_progress_stage_and_message_to_the_job(self, store: JobStore, held: Job) -> None:
        split = happened("progress", stage="split", done=1, total=4, progress=20)
        store.record(held, [happened("stage", stage="split"), split])
        store.record(held, [happened("progress", progress=10, message="two workers are back")])
        job = store.get(held.job_id)
        assert (job.progress, job.stage, job.message) == (20, "split", "two workers are back")
        last = store.events(held.job_id)[-1]
        assert last.at >= job.created_at
        assert last.progress == 20

    def test_progress_starts_again_with_the_next_attempt(self, store: JobStore, held: Job) -> None:
        store.record(held, [happened("progress", stage="split", progress=60)])
        store.release(held, lost=False)
        again = claim(store)
        assert (again.progress, again.stage) == (0, "")

    def test_the_latest_progress_of_each_stage_is_kept(self, store: JobStore, held: Job) -> None:
        for done in range(1, 6):
            for stage in ("ingest", "split"):
                store.record(held, [happened("progress", stage=stage, done=done, total=5, progress=done)])
        kept = [(event.stage, event.done) for event in store.events(held.job_id) if event.kind == "progress"]
        assert kept == [("ingest", 5), ("split", 5)]
        assert [event.sequence for event in store.events(held.job_id)] == [1, 2, 11, 12]

    def test_the_events_of_a_job_stay_few(self, store: JobStore, held: Job) -> None:
        for number in range(5):
            store.record(held, [happened(message=f"{number}.{k}") for k in range(MAX_KEPT // 2)])
        kept = store.events(held.job_id, limit=10 * MAX_KEPT)
        assert [event.kind for event in kept[:2]] == ["status", "status"]
        assert len(kept) == 2 + MAX_KEPT
        assert kept[-1].message == f"4.{MAX_KEPT // 2 - 1}"

    def test_events_are_read_on_from_a_number_and_in_pages(self, store: JobStore, held: Job) -> None:
        store.record(held, [happened(message=str(n)) for n in range(5)])
        assert [event.sequence for event in store.events(held.job_id, after=3, limit=2)] == [4, 5]
        assert store.events(held.job_id, after=7) == []
        assert store.events(held.job_id, after=10**30) == []
        assert len(store.events(held.job_id, after=-5)) == 7

    def test_events_have_numbers_without_gaps_however_many_write(self, store: JobStore, held: Job) -> None:
        with ThreadPoolExecutor(12) as crew:
            list(crew.map(lambda n: store.record(held, [happened(message=f"{n}")] * 2), range(60)))
        found = store.events(held.job_id)
        assert [event.sequence for event in found] == list(range(1, 123))
        # what was recorded together stands together
        messages = [event.message for event in found[2:]]
        assert messages[::2] == messages[1::2]
        assert len(set(messages)) == 60

    # --- uploads

    def test_an_upload_comes_back_as_it_was_stored(self, store: JobStore) -> None:
        one = upload(store, owner="k")
        assert store.upload(one.upload_id) == one
        assert store.upload(one.upload_id, owner="k") == one
        for missing, owner in ((one.upload_id, "other"), ("0" * 32, None), ("..", None)):
            with pytest.raises(NoSuchUploadError):
                store.upload(missing, owner=owner)
        assert store.upload_ids() == {one.upload_id}

    def test_a_job_with_an_upload_that_is_gone_is_not_created(self, store: JobStore) -> None:
        with pytest.raises(NoSuchUploadError, match="send the file again"):
            submit(store, value=uuid4().hex, kind="upload")
        assert sum(store.counts().values()) == 0

    def test_an_upload_that_jobs_need_is_neither_removed_nor_expired(self, store: JobStore) -> None:
        old, free = upload(store, days=-1.0), upload(store, days=-1.0)
        young = upload(store)
        submit(store, value=old.upload_id, kind="upload")
        assert store.expired_uploads(store.now()) == [free]
        with pytest.raises(UploadInUseError, match="1 job"):
            store.remove_upload(old.upload_id)
        held = claim(store)
        assert store.expired_uploads(store.now()) == [free]
        store.succeed(held, message="", summary={})
        assert [one.upload_id for one in store.expired_uploads(store.now())] == [old.upload_id, free.upload_id]
        store.remove_upload(old.upload_id)
        store.remove_upload(old.upload_id)
        store.remove_upload("no id")
        assert store.upload_ids() == {free.upload_id, young.upload_id}

    def test_an_upload_is_either_needed_or_removed_when_both_happen_at_once(self, store: JobStore) -> None:
        def submitted(one: Upload) -> bool:
            try:
                submit(store, value=one.upload_id, kind="upload")
            except NoSuchUploadError:
                return False
            return True

        def removed(one: Upload) -> bool:
            try:
                store.remove_upload(one.upload_id)
            except UploadInUseError:
                return False
            return True

        with ThreadPoolExecutor(8) as crew:
            for _ in range(25):
                one = upload(store)
                both = crew.submit(submitted, one), crew.submit(removed, one)
                assert both[0].result() != both[1].result()

    # --- keys

    def test_keys_are_found_by_their_digest_and_revoked(self, store: JobStore) -> None:
        assert not store.has_keys()
        key, secret = new_key("plain words", Scope.SUBMIT, now=store.now())
        store.add_key(key)
        assert store.has_keys()
        assert store.key_by_digest(digest_of(secret)) == key
        assert store.key_by_digest(digest_of("other")) is None
        store.revoke_key(key.key_id)
        found = store.key_by_digest(digest_of(secret))
        assert found.revoked_at is not None
        store.revoke_key(key.key_id)
        assert store.keys() == [found]
        assert not store.has_keys()

    def test_a_rotated_key_is_found_by_both_secrets_and_an_expired_one_counts_as_none(self, store: JobStore) -> None:
        now = store.now()
        first, old = new_key("a", Scope.SUBMIT, now=now)
        store.add_key(first)
        key, new = rotated(first, now=now, grace=dt.timedelta(hours=1), lasting=dt.timedelta(days=1))
        store.rotate_key(key)
        for secret in (old, new):
            assert store.key_by_digest(digest_of(secret)) == key
        assert store.keys() == [key]
        assert store.has_keys()
        store.rotate_key(dataclasses.replace(key, expires_at=now - dt.timedelta(days=1)))
        assert not store.has_keys()

    # --- many at once

    def test_no_job_is_claimed_twice_by_threads(self, store: JobStore) -> None:
        for _ in range(60):
            submit(store)

        def drain(name: str) -> list[str]:
            found = []
            while (job := store.claim(name, lease_s=HOUR_S, max_attempts=3)) is not None:
                found.append(job.job_id)
            return found

        with ThreadPoolExecutor(8) as crew:
            claimed = [job_id for found in crew.map(drain, map(str, range(8))) for job_id in found]
        assert len(set(claimed)) == len(claimed) == 60

    def test_only_one_of_many_finishes_a_job(self, store: JobStore) -> None:
        for _ in range(10):
            held = running(store)
            gate = threading.Barrier(6)

            def finish(number: int, held: Job = held, gate: threading.Barrier = gate) -> bool:
                gate.wait()
                try:
                    if number % 3 == 0:
                        store.succeed(held, message=str(number), summary={})
                    elif number % 3 == 1:
                        store.fail(held, JobFailure(fault=Fault.INPUT, detail=str(number)))
                    else:
                        store.release(held, lost=False)
                        store.dismiss(held.job_id)
                except LeaseLostError:
                    return False
                return True

            with ThreadPoolExecutor(6) as crew:
                assert sum(crew.map(finish, range(6))) == 1
            assert store.get(held.job_id).status.is_over
            ends = [status for status in statuses(store, held) if status is not None and status.is_over]
            assert len(ends) == 1

    @pytest.mark.slow
    def test_processes_that_are_killed_lose_no_job_and_finish_none_twice(
        self, store: JobStore, url: str, tmp_path: Path
    ) -> None:
        jobs = [submit(store, title=str(n)) for n in range(120)]
        log = tmp_path / "done.log"
        log.touch()
        hammer = str(Path(__file__).with_name("store_hammer.py"))

        def start(name: str) -> subprocess.Popen[bytes]:
            environment = {**os.environ, "PYTHONPATH": str(ROOT)}
            return subprocess.Popen([sys.executable, hammer, url, name, str(log), "3"], env=environment)

        crew = [start(f"p{n}") for n in range(3)]
        try:
            for number in range(4):
                reached = 20 * (number + 1)
                until(lambda reached=reached: len(log.read_text().splitlines()) >= reached)
                crew[number % 3].kill()
                crew[number % 3].wait()
                crew[number % 3] = start(f"q{number}")
            for one in crew:
                assert one.wait(LONG_S) == 0
        finally:
            for one in crew:
                one.kill()
                one.wait()
        lines = [line.split() for line in log.read_text().splitlines()]
        finished = Counter(job_id for job_id, _ in lines)
        assert set(finished.values()) == {1}
        # one that was killed between its commit and its line finished the job without telling
        assert len(jobs) - 4 * 3 <= len(finished) <= len(jobs)
        assert store.counts()[JobStatus.SUCCESSFUL] == len(jobs)
        for job in jobs:
            events = store.events(job.job_id)
            assert [event.sequence for event in events] == list(range(1, len(events) + 1))
            assert [event.status for event in events].count(JobStatus.SUCCESSFUL) == 1
            assert [event.status for event in events].count(JobStatus.RUNNING) == store.get(job.job_id).attempt
