"""Attempts in processes of their own: whatever one does, its slot is free again and the others go on."""

import errno
import os
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hostile_attempts
import psutil
import pytest
from driver_bench import Bench
from processes import LONG_S, wait_for

from service.driver import attempt_process, process
from service.driver import attempt_records as attempts
from service.jobs import Fault, JobStatus
from service.store import policies

pytestmark = pytest.mark.slow

STALL_S = 1.5


@pytest.fixture
def apart(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """A bench whose attempts are processes that find the tests' modules."""
    paths = [str(Path(hostile_attempts.__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    bench.settings = bench.settings.model_copy(update={"stall_s": STALL_S, "stop_s": 0.5, "max_attempts": 2})
    return bench


@pytest.mark.parametrize(
    ("work", "words"),
    [
        (hostile_attempts.loop_for_ever, "made no progress for 1.5 s"),
        (hostile_attempts.keep_the_interpreter, "made no progress for 1.5 s"),
        (hostile_attempts.stop_itself, "made no progress for 1.5 s"),
        (hostile_attempts.wait_for_itself, "made no progress for 1.5 s"),
        (hostile_attempts.crash, "SIGSEGV"),
        (hostile_attempts.eat_memory_at_once, "asked for more than"),
    ],
)
def test_an_attempt_that_ends_by_itself_is_tried_again_and_then_the_job_fails(
    apart: Bench, work: Callable[..., Any], words: str
) -> None:
    apart.work = work
    job = apart.submit()
    apart.driver()
    done = apart.over(job)
    assert (done.status, done.attempt, done.own_ends, done.own_end_stage) == (JobStatus.FAILED, 2, 2, "split")
    assert done.failure is not None
    assert done.failure.fault is Fault.STALLED
    assert words in done.failure.detail
    assert "2 attempts in a row ended by themselves at stage split" in done.failure.detail
    assert done.lost_attempts == 0


def test_what_an_attempt_unpacked_goes_with_its_process(
    apart: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setenv("TMPDIR", str(place))
    monkeypatch.setattr(tempfile, "tempdir", None)
    apart.work = hostile_attempts.crash_with_much_unpacked
    made: list[Path] = []
    removed = attempt_process.remove_left_folders

    def note() -> list[Path]:
        made.extend(place.rglob("unpacked"))
        return removed()

    monkeypatch.setattr(attempt_process, "remove_left_folders", note)
    monkeypatch.setattr(process, "remove_left_folders", list)  # the janitor's: not what is tested here
    job = apart.submit()
    apart.driver()
    assert apart.over(job).own_ends == 2
    assert len(made) == 2, "each attempt has unpacked something"
    assert list(place.rglob("unpacked")) == []


def test_a_process_that_takes_too_much_memory_is_ended(apart: Bench) -> None:
    apart.work = hostile_attempts.eat_memory
    job = apart.submit()
    apart.driver(attempt_memory_bytes=2**30, max_attempts=1, stall_s=LONG_S)
    failure = apart.over(job).failure
    assert failure is not None
    assert (failure.fault, "GABLEWORK_ATTEMPT_MEMORY_BYTES" in failure.detail) == (Fault.STALLED, True)


def test_other_slots_go_on_while_one_stands_still(apart: Bench) -> None:
    apart.work = hostile_attempts.loop_unless_urgent
    stuck = apart.submit()
    apart.driver(driver_jobs=2, stall_s=LONG_S)
    wait_for(lambda: apart.store.get(stuck.job_id).stage == "split", "the loop")
    for _ in range(3):
        assert apart.over(apart.submit(priority=1)).status is JobStatus.SUCCESSFUL
    assert apart.store.get(stuck.job_id).status is JobStatus.RUNNING
    apart.store.dismiss(stuck.job_id)
    assert apart.over(stuck).status is JobStatus.DISMISSED


def test_a_dismissed_job_ends_although_its_process_does_not_hear(apart: Bench) -> None:
    apart.work = hostile_attempts.keep_the_interpreter
    job = apart.submit()
    apart.driver(stall_s=LONG_S)
    wait_for(lambda: apart.store.get(job.job_id).stage == "split", "the loop")
    apart.store.dismiss(job.job_id)
    assert apart.over(job).status is JobStatus.DISMISSED
    assert not apart.folder.job(job.job_id).exists()


@pytest.mark.parametrize("forked", [True, False], ids=["forked", "spawned"])
@pytest.mark.parametrize("work", [hostile_attempts.stop_when_asked, hostile_attempts.stop_never_then_work])
def test_a_driver_that_ends_hands_the_attempt_back_and_the_next_one_goes_on(
    apart: Bench, monkeypatch: pytest.MonkeyPatch, *, work: Callable[..., Any], forked: bool
) -> None:
    if not forked:
        monkeypatch.setattr("pipeline.runtime.isolation.child_pool.can_fork", lambda: False)
    apart.work = work
    job = apart.submit()
    driver = apart.driver(drain_s=0.0, stall_s=LONG_S)
    wait_for(lambda: apart.store.get(job.job_id).stage == "split", "the work")
    driver.stop()
    apart.join()
    assert apart.codes == [0]
    waiting = apart.store.get(job.job_id)
    assert (waiting.status, waiting.attempt, waiting.lost_attempts) == (JobStatus.ACCEPTED, 1, 0)
    apart.driver()
    done = apart.over(job)
    assert (done.status, done.attempt, done.message) == (JobStatus.SUCCESSFUL, 2, "done in attempt-1")
    wait_for(lambda: [path.name for path in apart.folder.job(job.job_id).iterdir()] == ["attempt-2"], "one folder")
    assert (apart.folder.attempt(job.job_id, 2) / "left").read_text() == "1"


def test_honest_work_that_takes_long_is_not_ended(apart: Bench) -> None:
    apart.work = hostile_attempts.work_slowly
    job = apart.submit()
    apart.driver(stall_s=4.0)
    done = apart.over(job)
    assert (done.status, done.attempt) == (JobStatus.SUCCESSFUL, 1)
    assert done.summary is not None
    assert done.summary["pid"] != os.getpid()


def process_of(bench: Bench, **values: Any) -> int | None:
    """The process of a new job's attempt; None if the job failed."""
    summary = bench.over(bench.submit(**values)).summary
    return None if summary is None else int(summary["pid"])


def test_a_process_goes_on_with_the_next_job_only_after_success(apart: Bench) -> None:
    apart.work = hostile_attempts.refuse_unless_urgent
    apart.driver()
    first, second = process_of(apart, priority=1), process_of(apart, priority=1)
    assert first == second
    assert process_of(apart) is None
    assert process_of(apart, priority=1) not in {first, None}


def test_a_process_that_keeps_much_memory_or_has_done_much_is_replaced(
    apart: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    apart.work = hostile_attempts.keep_much
    apart.driver()
    assert process_of(apart, priority=1) == (first := process_of(apart, priority=600))
    assert (second := process_of(apart, priority=1)) != first
    with monkeypatch.context() as fewer:
        fewer.setattr(attempt_process, "_MOST_ATTEMPTS", 2)
        assert process_of(apart, priority=1) == second
        assert (third := process_of(apart, priority=1)) != second
    monkeypatch.setattr(attempt_process, "_KEPT_SPACE_BYTES", 1)
    assert process_of(apart, priority=1) == third
    assert process_of(apart, priority=1) != third


def test_a_job_that_met_what_another_one_left_is_tried_again_in_a_fresh_process(apart: Bench) -> None:
    apart.work = hostile_attempts.crash_in_a_used_process
    apart.driver(max_attempts=2)
    assert apart.over(apart.submit()).attempt == 1
    done = apart.over(apart.submit())
    assert (done.status, done.attempt, done.own_ends) == (JobStatus.SUCCESSFUL, 2, 1)


def test_a_process_that_ended_while_it_waited_costs_a_job_nothing(
    apart: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempts, "NO_SPACE_PAUSE_S", 0.1)
    apart.work = hostile_attempts.refuse_unless_urgent
    apart.driver()
    first = process_of(apart, priority=1)
    assert first is not None
    with monkeypatch.context() as unseen:
        unseen.setattr("pipeline.runtime.isolation.supervision.SupervisedChild.alive", True)
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: not psutil.pid_exists(first) or psutil.Process(first).status() == "zombie", "its end")
        job = apart.submit(priority=1)
        wait_for(lambda: apart.store.get(job.job_id).message.startswith("waiting"), "the attempt without a process")
    done = apart.over(job)
    assert (done.status, done.own_ends, done.other_ends, done.lost_attempts) == (JobStatus.SUCCESSFUL, 0, 0, 0)


def test_what_a_process_says_after_an_attempt_does_not_count_for_the_next_one(apart: Bench) -> None:
    apart.work = hostile_attempts.say_too_late
    apart.driver()
    first = process_of(apart)
    (apart.settings.state / "go").touch()
    wait_for((apart.settings.state / "said").exists, "the late word")
    done = apart.over(apart.submit())
    assert done.summary is not None
    assert done.summary["pid"] == first
    assert done.stage != "late"


def test_a_refusal_travels_whole_from_the_process(apart: Bench) -> None:
    apart.work = hostile_attempts.refuse
    job = apart.submit()
    apart.driver()
    failure = apart.over(job).failure
    assert failure is not None
    assert (failure.fault, failure.detail) == (Fault.INPUT, "tile.laz: is truncated. Send it again")
    apart.end()
    apart.work = hostile_attempts.refuse_the_request
    job = apart.submit()
    apart.driver()
    failure = apart.over(job).failure
    assert failure is not None
    assert (failure.fault, failure.detail) == (Fault.INPUT, "the first fault; the second fault")


def test_a_process_killed_from_outside_does_not_count_as_the_jobs_own_end(
    apart: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policies, "MAX_OTHER_ENDS", 4)
    apart.work = hostile_attempts.be_killed
    job = apart.submit()
    apart.driver()
    done = apart.over(job)
    # twice as many as may end by themselves
    assert (done.attempt, done.other_ends, done.own_ends, done.lost_attempts) == (4, 4, 0, 0)
    assert done.failure is not None
    assert (done.failure.fault, "killed from outside" in done.failure.detail) == (Fault.STALLED, True)


def test_a_machine_without_room_for_a_process_fails_no_job(apart: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_given: object, **_more: object) -> None:
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(attempts, "NO_SPACE_PAUSE_S", 0.1)
    with monkeypatch.context() as short:
        short.setattr("pipeline.runtime.isolation.child_pool.SupervisedChild", full)
        apart.work = hostile_attempts.work_slowly
        job = apart.submit()
        apart.driver(stall_s=4.0)
        wait_for(lambda: apart.store.get(job.job_id).attempt >= 2, "another attempt")
    done = apart.over(job)
    assert (done.status, done.lost_attempts, done.other_ends, done.own_ends) == (JobStatus.SUCCESSFUL, 0, 0, 0)
