"""The driver with a scripted run in place of the science: what becomes of a job, whatever happens."""

import contextlib
import errno
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from driver_bench import Bench, Engine
from processes import LONG_S, wait_for

from pipeline.backoff import Backoff
from pipeline.errors import ClusterError, RunError, UnreadableInputError
from pipeline.runtime.monitoring.progress import Event
from service.driver import attempt_records as attempts
from service.driver import process
from service.driver.shared_cluster import SharedCluster, answers
from service.errors import StoreError
from service.jobs import Fault, Job, JobFailure, JobStatus
from service.store import JobStore

# --- the good case


def test_a_job_is_run_and_its_results_are_kept(bench: Bench) -> None:
    job = bench.submit(priority=7)
    bench.driver()
    done = bench.over(job)
    assert (done.status, done.progress, done.attempt) == (JobStatus.SUCCESSFUL, 100, 1)
    assert done.message == "2 buildings: 2 ok, 0 doubtful, 0 fallback, 0 failed; 1 object rejected; 1 warning"
    assert done.summary["digest"] == "d" * 64
    assert (bench.folder.outputs(job.job_id, 1) / "outputs.json").exists()
    assert (bench.folder.run(job.job_id, 1) / "run.json").exists()
    # what was fetched is not needed any more
    assert not bench.folder.inputs(job.job_id, 1).exists()
    request, executor = bench.script.seen[0]
    assert executor.priority == 7
    assert request.resources.isolation.timeout_s == bench.settings.building_timeout_s


def test_events_tell_the_story_without_a_path_and_progress_never_falls(bench: Bench) -> None:
    done = bench.done()
    events = bench.store.events(done.job_id)
    statuses = [event.status for event in events if event.kind == "status"]
    assert statuses == [JobStatus.ACCEPTED, JobStatus.RUNNING, JobStatus.SUCCESSFUL]
    running = [event.progress for event in events[1:]]
    assert running == sorted(running)
    assert [event.stage for event in events if event.kind == "stage"] == ["inputs", "plan", "outputs"]
    warnings = [event.message for event in events if event.kind == "warning"]
    assert warnings == ["tile 0.laz: odd, see run.json"]
    for text in [*(event.message for event in events), done.message, str(done.summary)]:
        assert str(bench.folder.root) not in text
    assert done.summary["warnings"] == ["tile 0.laz: odd"]


def test_the_folders_of_earlier_attempts_go_with_the_success(bench: Bench) -> None:
    job = bench.submit()
    held = bench.store.claim("dead", lease_s=60.0, max_attempts=3)
    assert held is not None
    bench.folder.run(job.job_id, 1).mkdir(parents=True)
    bench.store.release(held, lost=False)
    bench.driver()
    assert bench.over(job).attempt == 2
    left = bench.folder.job(job.job_id)
    wait_for(lambda: [path.name for path in left.iterdir()] == ["attempt-2"], "one attempt")


def test_several_jobs_run_at_once_in_one_driver(bench: Bench) -> None:
    jobs = [bench.submit() for _ in range(3)]
    for _ in jobs:
        bench.script.waits()
    bench.driver(driver_jobs=3)
    bench.runs(3)
    assert bench.store.counts()[JobStatus.RUNNING] == 3
    bench.script.go_on.set()
    assert {bench.over(job).status for job in jobs} == {JobStatus.SUCCESSFUL}


# --- cancelled


def test_a_running_job_that_is_dismissed_stops_and_leaves_no_file(bench: Bench) -> None:
    job, _ = bench.under_way()
    assert bench.folder.attempt(job.job_id, 1).exists()
    bench.store.dismiss(job.job_id)
    assert bench.over(job).status is JobStatus.DISMISSED
    assert not bench.folder.job(job.job_id).exists()


def test_a_dismissal_is_seen_while_outputs_are_assembled(bench: Bench) -> None:
    job = bench.submit()
    plain = bench.script.write_outputs
    began = threading.Event()

    def endless(run_dir: Path, out_dir: Path, wanted: Any, on_progress: Callable[[int, int], None]) -> None:
        plain(run_dir, out_dir, wanted, on_progress)
        began.set()
        while True:
            on_progress(1, 2)
            time.sleep(0.01)

    bench.script.write_outputs = endless  # type: ignore[method-assign]
    bench.driver()
    assert began.wait(LONG_S)
    bench.store.dismiss(job.job_id)
    assert bench.over(job).status is JobStatus.DISMISSED


def test_further_formats_are_written_before_the_outputs_and_may_fail(bench: Bench) -> None:
    seen: list[Any] = []

    def publish(run_dir: Path, out_dir: Path, formats: Any, *, on_progress: Any, **options: Any) -> dict[str, Any]:
        seen.append((out_dir.exists(), formats, options))
        on_progress(1, 2)
        return {"pmtiles": RunError(f"the CRS of the run in {run_dir} is unknown: run it again with --crs")}

    bench.tools["publish"] = publish
    job = bench.submit({"publish": ("3dtiles", "pmtiles"), "geoid_height": 43.2})
    bench.driver()
    done = bench.over(job)
    assert seen == [(False, ("3dtiles", "pmtiles"), {"name": done.job_id, "geoid_height_m": 43.2})]
    assert done.summary["unpublished"] == {
        "pmtiles": "the CRS of the run in this job is unknown: run it again with the input crs"
    }
    assert "pmtiles could not be published" in done.message
    events = bench.store.events(done.job_id)
    assert [event.stage for event in events if event.kind == "stage"] == ["inputs", "plan", "formats", "outputs"]
    assert [event.message for event in events if event.kind == "warning" and event.stage == "formats"]
    # what comes before takes 90 of 100
    assert [event.progress for event in events if event.kind == "progress" and event.stage == "formats"] == [91]


def test_an_unexpected_fault_of_a_format_is_logged_and_leaves_the_rest(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    bench.tools["publish"] = lambda *_, **__: {"stac": ZeroDivisionError("secret detail")}
    job = bench.submit({"publish": ("geopackage", "stac")})
    bench.driver()
    done = bench.over(job)
    assert done.status is JobStatus.SUCCESSFUL
    assert "stac could not be published" in done.message
    (record,) = [record for record in caplog.records if record.exc_info]
    problem = done.summary["unpublished"]["stac"]
    assert f"ZeroDivisionError (reference {record.reference})" in problem
    assert "secret detail" in caplog.text
    assert "secret detail" not in problem
    (warning,) = [
        event.message
        for event in bench.store.events(done.job_id)
        if event.stage == "formats" and event.kind == "warning"
    ]
    assert warning == f"stac could not be published: {problem}"


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_job_whose_formats_fill_the_disk_is_tried_again(bench: Bench, wrapped: bool) -> None:
    full: Exception = OSError(errno.ENOSPC, "No space left on device")
    if wrapped:
        full, full.__cause__ = RunError("models.gpkg: No space left on device"), full
    bench.tools["publish"] = lambda *_, **__: {"stac": full}
    job = bench.submit({"publish": ("stac",)})
    bench.driver(max_attempts=1)
    failure = bench.over(job).failure
    assert failure is not None
    assert failure.fault is Fault.NO_SPACE


def test_a_dismissal_is_seen_while_formats_are_written(bench: Bench) -> None:
    began = threading.Event()

    def endless(*_: Any, on_progress: Callable[[int, int], None], **_options: Any) -> dict[str, Any]:
        began.set()
        while True:
            on_progress(0, 1)
            time.sleep(0.01)

    bench.tools["publish"] = endless
    job = bench.submit({"publish": ("3dtiles",)})
    bench.driver()
    assert began.wait(LONG_S)
    bench.store.dismiss(job.job_id)
    assert bench.over(job).status is JobStatus.DISMISSED
    assert not bench.folder.job(job.job_id).exists()


def test_a_driver_that_ends_lets_running_jobs_finish_and_claims_no_more(bench: Bench) -> None:
    first, second = bench.submit(priority=1), bench.submit()
    bench.script.waits()
    driver = bench.driver()
    bench.runs()
    driver.stop()
    wait_for(driver._stopping.is_set, "the stop")
    bench.script.go_on.set()
    bench.join()
    assert bench.codes == [0]
    assert bench.store.get(first.job_id).status is JobStatus.SUCCESSFUL
    assert bench.store.get(second.job_id).status is JobStatus.ACCEPTED
    assert bench.script.runs == 1


def test_a_second_signal_does_not_hurry_a_driver_whose_parent_decides(bench: Bench) -> None:
    # Ctrl-C goes to both, and the parent asks besides
    read_end, write_end = os.pipe()
    try:
        job, driver = bench.under_way(parent_pipe=read_end)
        for _ in range(2):
            driver.signalled()
        assert not driver._at_once.wait(0.5)
        bench.script.go_on.set()
        bench.join()
    finally:
        os.close(write_end)
        os.close(read_end)
    assert bench.store.get(job.job_id).status is JobStatus.SUCCESSFUL


@pytest.mark.parametrize("how", ["out of time", "second signal", "parent gone"])
def test_a_driver_that_must_end_gives_its_job_back_at_once(bench: Bench, how: str) -> None:
    ours, theirs = os.pipe()
    try:
        job, driver = bench.under_way(parent_pipe=ours, drain_s=0.0 if how == "out of time" else 1e6)
        if how == "parent gone":
            os.close(theirs)
        else:
            driver.stop()
        if how == "second signal":
            wait_for(driver._stopping.is_set, "the stop")
            assert bench.store.get(job.job_id).status is JobStatus.RUNNING
            driver.stop()
        bench.join()
    finally:
        os.close(ours)
        if how != "parent gone":
            os.close(theirs)
    assert bench.codes == [0]
    waiting = bench.store.get(job.job_id)
    assert (waiting.status, waiting.attempt, waiting.lost_attempts) == (JobStatus.ACCEPTED, 1, 0)
    left = bench.folder.run(job.job_id, 1) / "left"
    left.write_text("by the first attempt")
    bench.script.go_on.set()
    bench.driver()
    done = bench.over(job)
    assert (done.status, done.attempt) == (JobStatus.SUCCESSFUL, 2)
    # the second attempt went on in the folder of the first, with its inputs, and its results are under its own number
    first, second = (request for request, _ in bench.script.seen)
    assert (first.out, first.inputs) == (second.out, second.inputs)
    assert not bench.folder.attempt(job.job_id, 1).exists()
    assert (bench.folder.run(job.job_id, 2) / "left").read_text() == "by the first attempt"


def test_a_run_that_does_not_end_when_called_off_does_not_keep_the_job(bench: Bench) -> None:
    bench.patch.setattr(process, "_GRACE_S", 0.1)
    job = bench.submit()
    bench.script.steps.append(lambda *_given: bench.script.go_on.wait(LONG_S))
    driver = bench.driver(drain_s=0.0, stop_s=0.1)
    bench.runs()
    driver.stop()
    bench.join()
    assert bench.codes == [1]
    assert bench.store.get(job.job_id).status is JobStatus.ACCEPTED


# --- faults


def test_a_bad_input_fails_the_job_with_the_inputs_name(bench: Bench) -> None:
    job = bench.submit()
    path = bench.folder.inputs(job.job_id, 1) / "tile 0.laz"
    bench.script.raises(UnreadableInputError(str(path), "is truncated", "Send it again"))
    bench.driver()
    failure = bench.over(job).failure
    assert failure == JobFailure(fault=Fault.INPUT, detail="tile 0.laz: is truncated. Send it again")
    assert not bench.folder.attempt(job.job_id, 1).exists()


def test_a_fault_of_ours_is_logged_with_its_reference_and_not_shown(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    failed = bench.done(ZeroDivisionError("secret detail"))
    assert failed.failure.fault is Fault.INTERNAL
    assert "secret detail" not in failed.failure.detail
    (record,) = [record for record in caplog.records if record.exc_info]
    assert record.__dict__["reference"] in failed.failure.detail
    assert record.__dict__["job"] == failed.job_id
    assert "secret detail" in caplog.text


def test_bad_settings_fail_before_the_run(bench: Bench) -> None:
    job = bench.submit({"settings": {"method": "magic"}})
    bench.driver()
    failed = bench.over(job)
    assert failed.failure.fault is Fault.SETTINGS
    assert "magic" in failed.failure.detail
    assert bench.script.runs == 0


def test_a_lost_cluster_is_replaced_and_the_job_tried_again(bench: Bench) -> None:
    bench.patch.setattr(attempts, "LOST_CLUSTER", Backoff(first_s=0.05))
    bench.patch.setattr(Engine, "started", 0)
    done = bench.done(ClusterError("the scheduler tcp://127.0.0.1:5 was lost"))
    assert (done.status, done.attempt, done.lost_attempts) == (JobStatus.SUCCESSFUL, 2, 1)
    assert Engine.started == 2
    messages = [event.message for event in bench.store.events(done.job_id) if event.status is JobStatus.ACCEPTED]
    assert messages[1] == "waiting: the scheduler was lost; tried again in 0.05 s"


def test_a_cluster_that_is_lost_again_and_again_fails_the_job(bench: Bench) -> None:
    bench.patch.setattr(attempts, "LOST_CLUSTER", Backoff(first_s=0.01))
    failure = bench.failure(*[ClusterError("gone")] * 3)
    assert bench.script.runs == 3
    assert failure.fault is Fault.CLUSTER
    assert "lost 3 times" in failure.detail


@contextlib.contextmanager
def no_scheduler(bench: Bench) -> Iterator[socket.socket]:
    """A driver whose scheduler's port does not listen yet."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        bench.driver(scheduler=f"tcp://127.0.0.1:{listener.getsockname()[1]}")
        yield listener


def test_a_scheduler_that_is_away_is_reported_and_waited_for(bench: Bench) -> None:
    job = bench.submit()
    with no_scheduler(bench) as listener:
        waiting = wait_for(
            lambda: (found := bench.store.get(job.job_id)).message.startswith("waiting") and found, "waiting"
        )
        assert waiting.status is JobStatus.RUNNING
        assert "127.0.0.1" not in waiting.message
        assert [event.kind for event in bench.store.events(job.job_id)][-1] == "waiting"
        listener.listen()
        assert bench.over(job).status is JobStatus.SUCCESSFUL
    assert bench.script.runs == 1


def test_a_job_that_waits_for_a_scheduler_can_be_dismissed(bench: Bench) -> None:
    job = bench.submit()
    with no_scheduler(bench):
        bench.becomes(job, JobStatus.RUNNING)
        bench.store.dismiss(job.job_id)
        assert bench.over(job).status is JobStatus.DISMISSED
    assert bench.script.runs == 0


def test_after_waiting_for_workers_the_message_says_what_happens_again(bench: Bench) -> None:
    job = bench.submit()

    def step(request: Any, tell: Callable[[Event], None], cancelled: Any) -> None:
        tell(Event(kind="waiting", stage="split", message="no worker is there"))
        wait_for(lambda: bench.store.get(job.job_id).message == "no worker is there", "the message")
        tell(Event(kind="progress", stage="split", done=3, total=3))
        wait_for(lambda: bench.store.get(job.job_id).message == "surfaces are found in the tiles", "the next message")

    bench.script.steps.append(step)
    bench.driver()
    assert bench.over(job).status is JobStatus.SUCCESSFUL


@pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1:99999", "inproc://a/b/1"])
def test_an_address_that_cannot_be_tried_is_left_to_the_run(address: str) -> None:
    assert answers(address) is True


# --- leases and the database


def test_a_job_that_passed_to_another_driver_is_let_go_and_not_finished(bench: Bench) -> None:
    job, _ = bench.under_way()
    bench.end_leases()
    other = bench.store.claim("other", lease_s=60.0, max_attempts=3)
    assert other.attempt == 2
    wait_for(lambda: not bench.folder.attempt(job.job_id, 1).exists(), "the end of the first attempt")
    assert bench.store.get(job.job_id) == other
    bench.store.succeed(other, message="done by the other", summary={})
    bench.end()
    statuses = [event.status for event in bench.store.events(job.job_id)]
    assert statuses.count(JobStatus.SUCCESSFUL) == 1


class Flaky:
    """A store whose database is away when the test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.away = threading.Event()
        self.refused = 0
        for name in ("claim", "renew", "still_held", "record", "succeed", "release", "fail", "get"):
            monkeypatch.setattr(JobStore, name, self._guarded(getattr(JobStore, name)))

    def _guarded(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def asked(store: JobStore, *values: Any, **named: Any) -> Any:
            if self.away.is_set() and threading.current_thread() is not threading.main_thread():
                self.refused += 1
                raise StoreError("the database does not answer")
            return method(store, *values, **named)

        return asked


def test_a_driver_outlives_a_database_that_is_away_for_a_while(bench: Bench) -> None:
    flaky = Flaky(bench.patch)
    job, next_job = bench.submit(priority=1), bench.submit()
    bench.script.waits()
    bench.driver()
    bench.runs()
    flaky.away.set()
    wait_for(lambda: flaky.refused > 5, "refusals")
    # the run comes to its end while it cannot be written
    bench.script.go_on.set()
    wait_for(lambda: bench.folder.outputs(job.job_id, 1).exists(), "outputs")
    flaky.refused = 0
    wait_for(lambda: flaky.refused > 2, "refusals of the end")
    flaky.away.clear()
    done = bench.over(job)
    assert (done.status, done.attempt) == (JobStatus.SUCCESSFUL, 1)
    assert bench.over(next_job).status is JobStatus.SUCCESSFUL
    # events in the meantime are not lost
    assert "outputs" in [event.stage for event in bench.store.events(job.job_id)]


def test_a_success_whose_answer_was_lost_on_the_way_keeps_its_results(bench: Bench) -> None:
    plain, answers_lost = JobStore.succeed, []

    def cut(store: JobStore, *values: Any, **named: Any) -> None:
        plain(store, *values, **named)
        if not answers_lost:
            answers_lost.append(True)
            raise StoreError("the connection broke after the commit")

    bench.patch.setattr(JobStore, "succeed", cut)
    job = bench.submit()
    driver = bench.driver()
    assert bench.over(job).status is JobStatus.SUCCESSFUL
    driver.stop()
    bench.join()
    assert answers_lost
    assert (bench.folder.outputs(job.job_id, 1) / "outputs.json").exists()


def test_a_success_that_a_driver_never_learns_of_keeps_its_results(bench: Bench) -> None:
    plain, flaky = JobStore.succeed, Flaky(bench.patch)

    def cut(store: JobStore, *values: Any, **named: Any) -> None:
        if not flaky.away.is_set():
            plain(store, *values, **named)
            flaky.away.set()
        raise StoreError("the connection broke after the commit, and there is no other")

    bench.patch.setattr(JobStore, "succeed", cut)
    job = bench.submit()
    driver = bench.driver()
    wait_for(flaky.away.is_set, "the commit")
    driver.stop(at_once=True)
    bench.join()
    assert bench.store.get(job.job_id).status is JobStatus.SUCCESSFUL
    assert (bench.folder.outputs(job.job_id, 1) / "outputs.json").exists()


def test_a_driver_that_slept_renews_its_own_lease_before_it_looks_for_work(bench: Bench) -> None:
    job, driver = bench.under_way(driver_jobs=2)
    claims = []
    plain_claim, plain_renew = JobStore.claim, JobStore.renew
    renewals = threading.Event()

    def claim(store: JobStore, *values: Any, **named: Any) -> Job | None:
        claims.append(renewals.is_set())
        return plain_claim(store, *values, **named)

    def renew(store: JobStore, *values: Any, **named: Any) -> bool:
        renewals.set()
        return plain_renew(store, *values, **named)

    (held,) = driver._all_held()
    # as after an hour of sleep: the wall clock and the database's went on, the lease has ended
    bench.patch.setattr(held, "_renewed_at_s", time.time() - 3600.0)
    wait_for(lambda: driver._busy == 1, "the end of a claim that was under way")
    bench.end_leases()
    bench.patch.setattr(JobStore, "claim", claim)
    bench.patch.setattr(JobStore, "renew", renew)
    bench.patch.setattr(held, "_renewed_s", held._renewed_s - 15.0)
    wait_for(lambda: claims, "a claim")
    assert claims[0], "a claim came before the renewal"
    bench.script.go_on.set()
    done = bench.over(job)
    assert (done.status, done.attempt) == (JobStatus.SUCCESSFUL, 1)


def test_a_driver_that_cannot_start_ends_and_says_so(bench: Bench) -> None:
    def broken(store: JobStore) -> None:
        raise ZeroDivisionError

    bench.patch.setattr(JobStore, "migrate", broken)
    bench.driver()
    bench.join()
    assert bench.codes == [1]


def test_a_driver_waits_for_its_database_and_can_be_stopped_while_it_does(bench: Bench) -> None:
    asked = threading.Event()

    def away(store: JobStore) -> None:
        asked.set()
        raise StoreError("the database does not answer")

    bench.patch.setattr(JobStore, "migrate", away)
    driver = bench.driver()
    assert asked.wait(LONG_S)
    driver.stop()
    bench.join()
    assert bench.codes == [0]


def test_workers_are_not_started_again_once_the_driver_has_ended(bench: Bench) -> None:
    cluster = SharedCluster(bench.settings, Engine)
    cluster.replace(cluster.engine())
    cluster.engine()
    cluster.close()
    with pytest.raises(ClusterError, match="driver is ending"):
        cluster.engine()


def test_a_job_whose_workers_broke_leaves_the_new_ones_of_another_job_alone(bench: Bench) -> None:
    cluster = SharedCluster(bench.settings, Engine)
    broken = cluster.engine()
    cluster.replace(broken)
    new = cluster.engine()
    stopped = Engine.stopped
    cluster.replace(broken)
    assert cluster.engine() is new is not broken
    assert Engine.stopped == stopped


def test_a_slot_outlives_a_fault_that_is_unexpected(bench: Bench) -> None:
    plain, faults = JobStore.claim, []

    def broken(store: JobStore, *values: Any, **named: Any) -> Job | None:
        if not faults:
            faults.append(True)
            raise TypeError("a request of another version")
        return plain(store, *values, **named)

    bench.patch.setattr(JobStore, "claim", broken)
    assert bench.done().status is JobStatus.SUCCESSFUL
    assert faults


def test_without_a_heartbeat_for_the_length_of_the_lease_the_work_stops(bench: Bench) -> None:
    flaky = Flaky(bench.patch)
    job, _ = bench.under_way(lease_s=3.0)
    bench.script.waits()
    flaky.away.set()
    wait_for(lambda: not bench.folder.attempt(job.job_id, 1).exists(), "the end of the attempt")
    flaky.away.clear()
    bench.runs(2)
    bench.script.go_on.set()
    done = bench.over(job)
    assert (done.status, done.attempt, done.lost_attempts) == (JobStatus.SUCCESSFUL, 2, 1)


def test_a_lease_is_renewed_for_as_long_as_the_run_takes(bench: Bench) -> None:
    job, _ = bench.under_way(lease_s=5.0)
    first = bench.store.get(job.job_id).lease_until
    end = time.monotonic() + LONG_S

    def renewed() -> bool:
        # another driver looks for work all the while, and never gets this job
        assert bench.store.claim("other", lease_s=60.0, max_attempts=3) is None
        assert time.monotonic() < end
        until_now = bench.store.get(job.job_id).lease_until
        return (until_now - first).total_seconds() > 2.0

    wait_for(renewed, "renewals")
    bench.script.go_on.set()
    done = bench.over(job)
    assert (done.status, done.attempt) == (JobStatus.SUCCESSFUL, 1)
