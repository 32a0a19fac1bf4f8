"""The janitor removes what no job needs, and nothing else."""

import contextlib
import os
import tempfile
import time
from pathlib import Path

import pytest
from driver_bench import Bench
from processes import wait_for
from store_contract import upload

from pipeline.io.temporary import temporary_folder
from service.driver.janitor import tidy, tidy_jobs
from service.jobs import Fault, Job, JobFailure
from service.store import JobFilter


def test_the_janitor_removes_what_no_job_needs_and_nothing_else(bench: Bench) -> None:
    folder, store = bench.folder, bench.store

    def attempts(job_id: str, *numbers: int) -> None:
        for number in numbers:
            folder.run(job_id, number).mkdir(parents=True)

    def claimed() -> Job:
        held = store.claim("d", lease_s=60.0, max_attempts=9)
        assert held is not None
        return held

    running = bench.submit(priority=9)
    store.release(claimed(), lost=False)
    assert claimed().attempt == 2
    attempts(running.job_id, 1, 2)
    done = bench.submit(priority=8)
    store.succeed(claimed(), message="", summary={})
    attempts(done.job_id, 1)
    failed = bench.submit(priority=8)
    store.fail(claimed(), JobFailure(fault=Fault.LOST, detail="lost"))
    attempts(failed.job_id, 1)
    given_back = bench.submit(priority=7)
    store.release(claimed(), lost=True, retry_after_s=60.0)
    attempts(given_back.job_id, 1)
    dismissed = bench.submit()
    store.dismiss(dismissed.job_id)
    attempts(dismissed.job_id, 1)
    attempts("f" * 32, 1)
    (folder.jobs / "not ours").mkdir()
    tidy_jobs(store, folder)
    left = {path.relative_to(folder.jobs).as_posix() for path in folder.jobs.glob("*/*")}
    assert left == {f"{running.job_id}/attempt-2", f"{done.job_id}/attempt-1"}
    assert {path.name for path in folder.jobs.iterdir()} == {
        *(running.job_id, done.job_id, given_back.job_id, failed.job_id),
        "not ours",
    }


def test_a_driver_removes_temporary_folders_that_killed_processes_left(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with temporary_folder() as held:
        left = held.with_name(f"{held.name}-left")
        left.mkdir()
        (left / "unpacked").write_bytes(b"1")
        bench.driver()
        wait_for(lambda: not left.exists(), "the janitor")
        assert held.is_dir()


def test_the_janitor_keeps_all_results_beside_an_empty_database(bench: Bench) -> None:
    bench.folder.run("f" * 32, 1).mkdir(parents=True)
    assert tidy_jobs(bench.store, bench.folder) == []
    assert bench.folder.run("f" * 32, 1).exists()


def test_the_janitor_removes_uploads_whose_time_is_over(bench: Bench) -> None:
    for name, days in (("a", -1), ("b", 1)):
        upload(bench.store, days=days, upload_id=name * 32)
        bench.folder.upload(name * 32).mkdir(parents=True)
    for name, age_s in (("c", 2 * 24 * 3600.0), ("d", 60.0)):
        folder = bench.folder.upload(name * 32)
        folder.mkdir()
        os.utime(folder, (time.time() - age_s,) * 2)
    removed = tidy(bench.store, bench.folder, bench.settings)
    assert {path.name for path in removed} == {"a" * 32, "c" * 32}
    assert {path.name for path in bench.folder.uploads.iterdir()} == {"b" * 32, "d" * 32}
    assert bench.store.upload_ids() == {"b" * 32}


def test_the_janitor_works_without_any_folder(bench: Bench) -> None:
    with contextlib.suppress(FileNotFoundError):
        bench.folder.jobs.rmdir()
    assert tidy(bench.store, bench.folder, bench.settings) == []


# --- old jobs


def over(bench: Bench, size: int, *, keep: bool = False) -> str:
    """The id of a job that failed, with a file of so many bytes."""
    job = bench.submit()
    held = bench.store.claim("a", lease_s=60.0, max_attempts=3)
    assert held.job_id == job.job_id
    bench.store.succeed(held, message="", summary={})
    bench.store.keep(job.job_id, keep=keep)
    place = bench.folder.outputs(job.job_id, 1)
    place.mkdir(parents=True)
    (place / "file").write_bytes(b"x" * size)
    wait_for(lambda: bench.store.now() > bench.store.get(job.job_id).finished_at, "a later time")
    return job.job_id


def left(bench: Bench) -> set[str]:
    listed = {job.job_id for job in bench.store.list(JobFilter())}
    assert {path.name for path in bench.folder.jobs.iterdir()} == listed
    return listed


def test_jobs_stay_unless_a_limit_is_set(bench: Bench) -> None:
    job_id = over(bench, 1000)
    assert tidy(bench.store, bench.folder, bench.settings) == []
    assert left(bench) == {job_id}


def test_jobs_that_are_over_for_too_long_are_removed_but_not_those_that_are_kept(bench: Bench) -> None:
    old, kept = over(bench, 10), over(bench, 10, keep=True)
    waiting = bench.submit().job_id
    bench.folder.job(waiting).mkdir()
    settings = bench.settings.model_copy(update={"job_days": 1e-9})
    assert tidy(bench.store, bench.folder, settings) == [bench.folder.job(old)]
    assert left(bench) == {kept, waiting}
    bench.store.keep(kept, keep=False)
    tidy(bench.store, bench.folder, settings)
    assert left(bench) == {waiting}
    assert tidy(bench.store, bench.folder, bench.settings.model_copy(update={"job_days": 1.0})) == []


def test_the_jobs_that_ended_first_make_room_for_the_others(bench: Bench) -> None:
    first, kept, second, third = over(bench, 400), over(bench, 300, keep=True), over(bench, 200), over(bench, 100)
    for most, expected in ((1000, {first, kept, second, third}), (600, {kept, second, third}), (350, {kept})):
        tidy(bench.store, bench.folder, bench.settings.model_copy(update={"max_results_bytes": most}))
        assert left(bench) == expected
