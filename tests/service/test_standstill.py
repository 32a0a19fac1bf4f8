"""What a standstill means for a job: decisions, the lease, the folder that the next attempt takes over."""

import datetime as dt
import pickle
import time
from pathlib import Path
from typing import Any

import pytest
from driver_bench import Bench
from processes import wait_for

from pipeline.runtime.monitoring.progress import Event
from service.driver import leased_job, workplace
from service.driver.janitor import tidy_jobs
from service.driver.leased_job import LeasedJob, Stop
from service.errors import AttemptEndedError, QuotaError, RequestError, ScheduleBusyError, ServiceError
from service.files import StateFolder
from service.jobs import EndedAttempt, Fault, InputReference, Job, JobRequest, JobStatus, Upload
from service.store.policies import MAX_OTHER_ENDS, after_end, other_ends, own_ends, standstill

NOW = dt.datetime(2026, 1, 1, tzinfo=dt.UTC)


def job(**values: Any) -> Job:
    known: dict[str, Any] = {"job_id": "a" * 32, "owner": None, "request": JobRequest(tiles=())}
    known |= {"status": JobStatus.RUNNING, "created_at": NOW, "updated_at": NOW, "attempt": 1}
    return Job(**(known | values))


def ended(stage: str = "split", *, is_own: bool = True) -> EndedAttempt:
    return EndedAttempt(stage=stage, detail="made no progress for 600 s", is_own=is_own)


# --- decisions


def test_three_ends_in_one_stage_fail_a_job_and_another_stage_counts_anew() -> None:
    assert after_end(job(), ended(), 3) is JobStatus.ACCEPTED
    assert after_end(job(own_ends=1, own_end_stage="split"), ended(), 3) is JobStatus.ACCEPTED
    assert after_end(job(own_ends=2, own_end_stage="split"), ended(), 3) is JobStatus.FAILED
    assert after_end(job(own_ends=2, own_end_stage="ingest"), ended(), 3) is JobStatus.ACCEPTED
    assert own_ends(job(own_ends=2, own_end_stage="ingest"), ended()) == 1
    assert after_end(job(own_ends=2, own_end_stage="split", dismiss_requested=True), ended(), 3) is JobStatus.DISMISSED


def test_kills_from_outside_have_a_count_of_their_own() -> None:
    killed = ended(is_own=False)
    assert after_end(job(own_ends=2, own_end_stage="split", other_ends=5), killed, 3) is JobStatus.ACCEPTED
    assert after_end(job(other_ends=MAX_OTHER_ENDS - 2), killed, 3) is JobStatus.ACCEPTED
    last = job(other_ends=MAX_OTHER_ENDS - 1, own_ends=1, own_end_stage="split")
    assert after_end(last, killed, 3) is JobStatus.FAILED
    assert own_ends(last, killed) == 1
    assert "20 attempts were killed from outside" in standstill(last, killed, 30.0).detail


def test_the_failure_says_what_happened_where_and_who_can_help() -> None:
    failure = standstill(job(own_ends=2, own_end_stage="split"), ended(), 30.0)
    assert failure.fault is Fault.STALLED
    assert failure.detail == (
        "3 attempts in a row ended by themselves at stage split: the last one made no progress for 600 s, so the job "
        "is not tried again. Its inputs are kept for 30 days. Ask the operator for the driver's log; only an "
        "operator's key, with the scope admin, may retry the job"
    )


def test_ends_now_here_now_there_are_counted_too() -> None:
    wandering = job(own_ends=1, own_end_stage="ingest", other_ends=MAX_OTHER_ENDS - 1)
    assert after_end(wandering, ended("split"), 3) is JobStatus.FAILED
    assert "now here, now there" in standstill(wandering, ended("split"), 30.0).detail
    assert other_ends(job(own_ends=1, own_end_stage="split"), ended("split")) == 0
    assert other_ends(job(own_ends=1, own_end_stage="ingest"), ended("split")) == 1
    assert other_ends(job(), ended("split")) == 0


# --- the lease


def held_of(bench: Bench, **values: Any) -> LeasedJob:
    bench.submit()
    claimed_s = time.monotonic()
    claimed = bench.store.claim("d", lease_s=30.0, max_attempts=3)
    assert claimed is not None
    known: dict[str, Any] = {"lease_s": 30.0, "poll_s": 0.01, "claimed_s": claimed_s, "step_s": lambda _stage: 1e6}
    return LeasedJob(bench.store, claimed, **(known | values))


class Clock:
    """Stands for `time` in the module of the lease: only the test lets time pass, however long a thread waits."""

    time = staticmethod(time.time)

    def __init__(self) -> None:
        self.now_s = time.monotonic()
        self.looks = 0

    def monotonic(self) -> float:
        return self.now_s

    def step_s(self, stage: str) -> float:
        """Seconds of a step; asked for by each look at the progress."""
        self.looks += 1
        return 1e6 if stage == "reconstruct" else 0.2

    def passes(self, seconds: float) -> None:
        """Let time pass, and the lease look at the progress twice: the first look may have begun before."""
        self.now_s += seconds
        seen = self.looks
        wait_for(lambda: self.looks >= seen + 2, "a look at the progress")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(leased_job, "time", found)
    return found


def test_an_attempt_without_progress_is_stopped_and_one_with_progress_is_not(bench: Bench, clock: Clock) -> None:
    held = held_of(bench, step_s=clock.step_s, claimed_s=clock.now_s)
    with held:
        held.record(Event(kind="stage", stage="reconstruct"))
        clock.passes(0.5)
        held.record(Event(kind="stage", stage="split"))
        for _ in range(10):
            clock.passes(0.15)
            assert not held.cancelled()
            held.move()
        clock.now_s += 0.25
        wait_for(held.cancelled, "the stop")
        assert held.stopped_for is Stop.STALLED


def test_an_attempt_that_is_over_needs_no_progress(bench: Bench, clock: Clock) -> None:
    held = held_of(bench, step_s=clock.step_s, claimed_s=clock.now_s)
    with held:
        held.rest()
        clock.passes(0.5)
        assert not held.cancelled()
        assert bench.store.stalled() == []


def test_a_lease_is_not_renewed_for_an_attempt_that_does_not_end(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leased_job, "ABANDON_S", 0.2)
    held = held_of(bench, lease_s=1.0)
    with held:
        held.stop(Stop.STALLED)
        wait_for(lambda: held.stopped_for is Stop.LOST, "the end of the lease")
        wait_for(lambda: bench.store.claim("other", lease_s=30.0, max_attempts=3), "another driver")


def test_a_job_that_makes_no_progress_is_shown_until_it_is_over(bench: Bench) -> None:
    held = held_of(bench)
    assert bench.store.stalled() == []
    bench.store.renew(held.job, lease_s=30.0, due_s=60.0)
    assert bench.store.stalled() == []
    bench.store.renew(held.job, lease_s=30.0, due_s=-1.0)
    assert bench.store.stalled() == [held.job.job_id]
    bench.store.renew(held.job, lease_s=-1.0)
    assert bench.store.stalled() == [held.job.job_id]
    bench.store.release(held.job, lost=False)
    assert bench.store.stalled() == []


# --- inputs of a job that failed


def test_the_inputs_of_a_job_that_stood_still_are_kept(bench: Bench) -> None:
    past = bench.store.now() - dt.timedelta(days=10)
    upload = Upload(
        upload_id="b" * 32,
        owner=None,
        filename="a.laz",
        size_bytes=1,
        sha256="0" * 64,
        created_at=past,
        expires_at=past,
    )
    bench.store.add_upload(upload)
    asked = {"tiles": (InputReference(kind="upload", value=upload.upload_id),)}
    request = JobRequest(**asked)
    bench.store.create(request, owner=None)
    for days, expired in ((30.0, []), (0.0, [upload.upload_id])):
        claimed = bench.store.claim("d", lease_s=30.0, max_attempts=3)
        assert claimed is not None
        place, _ = workplace.take(bench.folder, claimed)
        (place / "inputs").mkdir()
        (place / "run").mkdir()
        workplace.keep_inputs(place)
        bench.store.end_attempt(claimed, ended(), max_attempts=1, kept_days=days)
        assert [found.upload_id for found in bench.store.expired_uploads(bench.store.now())] == expired
        assert [path.name for path in place.iterdir()] == ["inputs"]
        assert (place in tidy_jobs(bench.store, bench.folder, days)) == (not days)
        assert place.exists() == bool(days)
        bench.store.remove(claimed.job_id)
        bench.store.create(request, owner=None)


# --- the folder of an attempt


@pytest.fixture
def folder(tmp_path: Path) -> StateFolder:
    return StateFolder(tmp_path)


def test_only_a_folder_that_was_handed_back_is_taken_over(folder: StateFolder) -> None:
    first, second, third = (job(attempt=number) for number in (1, 2, 3))
    place, is_resumed = workplace.take(folder, first)
    assert (place, is_resumed) == (folder.attempt(first.job_id, 1), False)
    # its driver died: something may still write there
    other, is_resumed = workplace.take(folder, second)
    assert (other, is_resumed) == (folder.attempt(first.job_id, 2), False)
    workplace.hand_back(other, second)
    assert workplace.take(folder, third) == (other, True)
    # it is taken: the next one cannot have it as well
    assert workplace.take(folder, job(attempt=4)) == (folder.attempt(first.job_id, 4), False)


def test_the_janitor_leaves_the_folder_of_an_attempt_that_goes_on_in_an_earlier_one(bench: Bench) -> None:
    bench.submit()
    first = bench.store.claim("d", lease_s=30.0, max_attempts=3)
    assert first is not None
    place, _ = workplace.take(bench.folder, first)
    workplace.hand_back(place, first)
    bench.store.release(first, lost=False)
    assert tidy_jobs(bench.store, bench.folder) == []
    second = bench.store.claim("d", lease_s=30.0, max_attempts=3)
    assert second is not None
    assert tidy_jobs(bench.store, bench.folder) == []
    assert workplace.take(bench.folder, second) == (place, True)
    assert tidy_jobs(bench.store, bench.folder) == []
    # handed back again, by the second attempt
    workplace.hand_back(place, second)
    bench.store.release(second, lost=False)
    assert tidy_jobs(bench.store, bench.folder) == []
    third = bench.store.claim("d", lease_s=30.0, max_attempts=3)
    assert third is not None
    (place / "holder.json").unlink()
    assert tidy_jobs(bench.store, bench.folder) == [place]


# --- errors between processes


@pytest.mark.parametrize(
    "error",
    [
        RequestError(["one", "two"]),
        QuotaError(1, 2, 3),
        ScheduleBusyError("busy", "a" * 32),
        AttemptEndedError("took too much", is_own=True),
    ],
)
def test_errors_of_the_service_survive_pickling(error: ServiceError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert (str(again), vars(again)) == (str(error), vars(error))
