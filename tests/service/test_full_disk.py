"""A disk that is full, or nearly: what is refused, what still works, and that the end of a job can be written."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from driver_bench import Bench
from finished_runs import problem
from live_service import DEADLINE_S, POINTS, serving, settings_in
from processes import wait_for
from store_contract import submit

from service.disk import Ballast, Disk
from service.downloads import _stream_to, _Watch, ignore_bytes
from service.driver import workplace
from service.driver.janitor import tidy_jobs
from service.errors import NoSpaceError, StoreError, StoreFullError
from service.jobs import Fault, JobStatus
from service.keys import Scope
from service.settings import ServiceSettings
from service.store import JobStore

MIB = 1 << 20
DISK_BYTES = 48 * MIB


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A folder with a real file system of 48 MiB."""
    folder = tmp_path / "small"
    folder.mkdir()
    mount = shutil.which("mount")
    if mount is None or sys.platform != "linux":
        pytest.skip("needs mount on Linux, to make a small file system")
    command = [mount, "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "gablework-test", str(folder)]
    made = subprocess.run(command, check=False, capture_output=True, text=True)
    if made.returncode:
        pytest.skip(f"needs the right to mount a small file system: {made.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(folder: Path, *, left_bytes: int = 0) -> Path:
    """Fill the disk, as another program would, except for some bytes."""
    path = folder / "of another program"
    with path.open("ab", buffering=0) as stream, contextlib.suppress(OSError):
        while (free := shutil.disk_usage(folder).free - left_bytes) > 0:
            stream.write(bytes(min(free, MIB)))
    return path


class Free:
    """A disk of which the test says how much is free."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.bytes = 1000 * MIB
        patch.setattr("service.disk.shutil", SimpleNamespace(disk_usage=lambda _: SimpleNamespace(free=self.bytes)))


@pytest.fixture
def free(monkeypatch: pytest.MonkeyPatch) -> Free:
    return Free(monkeypatch)


# --- requests


def test_uploads_leave_the_reserve_and_what_makes_room_still_works(small_disk: Path) -> None:
    reserve_bytes = 8 * MIB
    settings = settings_in(small_disk, reserve_bytes=reserve_bytes)

    def endless() -> Iterator[bytes]:
        for _ in range(DISK_BYTES // MIB):
            yield POINTS[:10] * (MIB // 10)

    with serving(settings) as url, httpx.Client(base_url=url, timeout=DEADLINE_S) as client:
        first = client.post("/uploads?filename=a.xyz", content=POINTS)
        assert first.status_code == 201
        assert client.get("/readyz").json()["status"] == "ok"
        detail = problem(client.post("/uploads?filename=b.xyz", content=endless()), 507, "no-space")
        assert str(reserve_bytes) in detail
        # the one that was cut off is gone, and no byte of the reserve was used
        assert shutil.disk_usage(small_disk).free > reserve_bytes
        fill(small_disk, left_bytes=reserve_bytes // 2)
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["status"]) == (200, "degraded")
        assert str(reserve_bytes) in ready.json()["checks"]["disk"]
        figures = dict(
            line.split() for line in client.get("/metrics").text.splitlines() if line.startswith("gablework_disk")
        )
        assert float(figures["gablework_disk_free_bytes"]) < float(figures["gablework_disk_reserve_bytes"])
        upload = first.json()["uploadID"]
        asked = {"inputs": {"tiles": [{"href": f"/uploads/{upload}"}], "crs": "EPSG:28992"}}
        for answer in (
            client.post("/uploads?filename=b.xyz", content=POINTS),
            client.post("/jobs", files={"tile": ("a.xyz", POINTS)}),
            client.post("/processes/reconstruct/execution", json=asked),
            client.post("/schedules", json={"cron": "@daily", "execute": asked}),
        ):
            problem(answer, 507, "no-space")
        assert client.get("/jobs").json()["jobs"] == []
        assert client.delete(f"/uploads/{upload}").status_code == 204


def test_a_disk_that_is_full_to_the_last_byte_is_not_ready_and_an_upload_can_be_removed(small_disk: Path) -> None:
    settings = settings_in(small_disk, reserve_bytes=0)
    with serving(settings) as url, httpx.Client(base_url=url, timeout=DEADLINE_S) as client:
        upload = client.post("/uploads?filename=a.xyz", content=POINTS).json()["uploadID"]
        other = fill(small_disk)
        answer = client.get("/readyz")
        assert (answer.status_code, answer.json()["status"]) == (503, "unavailable")
        problem(client.post("/uploads?filename=b.xyz", content=POINTS), 507, "no-space")
        assert client.delete(f"/uploads/{upload}").status_code == 204
        other.unlink()
        assert client.get("/readyz").status_code == 200


def test_the_database_gets_the_room_that_was_set_aside_for_it(small_disk: Path) -> None:
    with JobStore(f"sqlite:///{small_disk / 'a.db'}") as store:
        store.migrate()
        store.fill_ballast(0)
        ballast = Ballast(small_disk)
        assert ballast.path.stat().st_size == ballast.size_bytes
        other = fill(small_disk)

        def write() -> None:
            submit(store, title="x" * (4 * MIB))

        with pytest.raises(StoreFullError, match="set aside"):
            write()
        assert not ballast.path.exists()
        write()
        fill(small_disk)
        with pytest.raises(StoreFullError):
            submit(store, title="x" * (8 * MIB))
        # it is made again when there is room for it beside the reserve, not before
        other.unlink()
        store.fill_ballast(DISK_BYTES)
        assert not ballast.path.exists()
        store.fill_ballast(MIB)
        assert ballast.path.exists()
        assert [path.name for path in small_disk.glob(".ballast*")] == [ballast.path.name]


def test_a_full_disk_of_the_database_is_reported_as_such(starting: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    service = starting()

    def full(*_values: Any, **_named: Any) -> None:
        raise StoreFullError("/secret/service.db")

    monkeypatch.setattr(JobStore, "add_uploads", full)
    answer = service.client.post("/uploads?filename=a.xyz", content=POINTS)
    assert "secret" not in problem(answer, 507, "no-space")
    assert int(answer.headers["Retry-After"]) > 0


def test_uploads_of_a_key_have_a_limit_together(starting: Any) -> None:
    most = 2 * len(POINTS) + 10
    service = starting(max_upload_bytes_per_key=most)
    mine, others = service.key(Scope.SUBMIT), service.key(Scope.SUBMIT)
    uploads = [service.upload(**mine) for _ in range(2)]
    for answer in (
        service.client.post("/uploads?filename=a.xyz", content=POINTS, headers=mine),
        service.client.post("/jobs", files={"tile": ("a.xyz", POINTS)}, headers=mine),
    ):
        detail = problem(answer, 507, "quota-exceeded")
        assert str(2 * len(POINTS)) in detail
        assert str(most) in detail
    assert len(list((service.settings.state / "uploads").iterdir())) == 2
    service.upload(**others)
    assert service.client.delete(f"/uploads/{uploads[0]}", headers=mine).status_code == 204
    service.upload(**mine)


def test_a_fetched_input_leaves_the_reserve(free: Free, tmp_path: Path) -> None:
    settings = ServiceSettings(state=tmp_path, reserve_bytes=free.bytes - 100)
    url = httpx.URL("https://example.org/a.laz")

    def stream_to(answer: httpx.Response) -> None:
        watch = _Watch(url, settings, lambda: False, ignore_bytes)
        asyncio.run(_stream_to(tmp_path / "a.laz", url, answer, settings, watch))

    for headers in ({"content-length": "101"}, {}):
        answer = httpx.Response(200, headers=headers, stream=httpx.ByteStream(bytes(101)))
        with pytest.raises(NoSpaceError, match=r"a\.laz"):
            stream_to(answer)
    assert not (tmp_path / "a.laz").exists()
    answer = httpx.Response(200, stream=httpx.ByteStream(bytes(100)))
    stream_to(answer)


def test_the_disk_of_a_folder_that_is_not_there_yet_is_that_of_its_parent(tmp_path: Path) -> None:
    assert Disk(tmp_path / "a" / "b").free_bytes > 0


# --- the driver


def test_a_run_that_uses_the_reserve_is_stopped_and_tried_again_when_there_is_room(bench: Bench, free: Free) -> None:
    bench.patch.setattr("service.driver.attempt_records.NO_SPACE_PAUSE_S", 0.0)
    older, newer = bench.submit(priority=1), bench.submit()
    bench.script.waits()
    bench.script.waits()
    bench.driver(driver_jobs=2, reserve_bytes=100)
    bench.runs(2)
    free.bytes = 99
    waiting = bench.becomes(newer, JobStatus.ACCEPTED)
    assert "the disk is full except for its reserve" in waiting.message
    assert not bench.folder.attempt(newer.job_id, 1).exists()
    # its files made room: the older one goes on
    free.bytes = 100
    bench.script.go_on.set()
    done = bench.over(older)
    assert (done.status, done.attempt) == (JobStatus.SUCCESSFUL, 1)
    done = bench.over(newer)
    assert (done.status, done.attempt) == (JobStatus.SUCCESSFUL, 2)


def test_no_job_begins_while_only_the_reserve_is_free(bench: Bench, free: Free) -> None:
    free.bytes = 99
    job = bench.submit()
    looked = threading.Event()
    plain = Disk.is_short.fget
    assert plain is not None

    def is_short(disk: Disk) -> bool:
        found = bool(plain(disk))
        looked.set()
        return found

    bench.patch.setattr(Disk, "is_short", property(is_short))
    bench.driver(reserve_bytes=100)
    assert looked.wait(DEADLINE_S)
    looked.clear()
    assert looked.wait(DEADLINE_S)
    assert bench.store.get(job.job_id).attempt == 0
    free.bytes = 100
    assert bench.over(job).status is JobStatus.SUCCESSFUL


def test_a_job_that_the_disk_never_has_room_for_fails_with_the_reason(bench: Bench) -> None:
    bench.patch.setattr("service.driver.attempt_records.NO_SPACE_PAUSE_S", 0.0)
    errors = [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/secret/a") for _ in range(3)]
    failure = bench.failure(*errors)
    assert failure.fault is Fault.NO_SPACE
    assert "3 times" in failure.detail
    assert "secret" not in failure.detail


def test_the_end_of_a_job_is_written_on_a_full_disk(small_disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(small_disk / "state", monkeypatch)
    monkeypatch.setattr("service.driver.attempt.outcome", lambda *_: "x" * MIB)
    plain = bench.script.write_outputs

    def write_outputs(run_dir: Path, out_dir: Path, *others: Any) -> None:
        plain(run_dir, out_dir, *others)
        fill(small_disk)

    monkeypatch.setattr(bench.script, "write_outputs", write_outputs)
    try:
        job = bench.submit()
        bench.store.fill_ballast(0)
        bench.driver(reserve_bytes=0)
        done = bench.over(job)
        assert (done.status, done.attempt) == (JobStatus.SUCCESSFUL, 1)
        assert bench.script.runs == 1
    finally:
        bench.end()
        bench.store.close()


def test_a_driver_that_cannot_write_the_end_of_a_job_ends_and_the_next_one_writes_it(bench: Bench) -> None:
    plain, refused = JobStore.succeed, threading.Event()

    def away(*_values: Any, **_named: Any) -> None:
        refused.set()
        raise StoreError("the database does not answer")

    bench.patch.setattr(JobStore, "succeed", away)
    job = bench.submit()
    # had it waited for the database, this would not end before the test does
    driver = bench.driver(drain_s=1e6)
    assert refused.wait(DEADLINE_S)
    driver.stop()
    bench.join()
    assert bench.store.get(job.job_id).status is JobStatus.RUNNING
    assert workplace.has_end(bench.folder.attempt(job.job_id, 1))
    bench.patch.setattr(JobStore, "succeed", plain)
    bench.end_leases()
    with bench.store._database.write() as connection:
        connection.exec_driver_sql("UPDATE jobs SET status = 'accepted', lease_owner = NULL, lease_until = NULL")
    # the janitor of another driver leaves it alone
    assert tidy_jobs(bench.store, bench.folder) == []
    bench.driver()
    done = bench.over(job)
    assert (done.status, done.attempt, bench.script.runs) == (JobStatus.SUCCESSFUL, 2, 1)
    assert done.summary is not None
    assert done.summary["digest"] == "d" * 64
    assert (bench.folder.outputs(job.job_id, 2) / "outputs.json").exists()
    assert [path.name for path in bench.folder.job(job.job_id).iterdir()] == ["attempt-2"]


def test_old_answers_go_with_a_round_of_the_janitor(bench: Bench) -> None:
    asked = threading.Event()
    bench.patch.setattr(JobStore, "forget_answers", lambda _: asked.set())
    bench.driver()
    assert asked.wait(DEADLINE_S)
    wait_for((bench.settings.state / ".ballast").exists, "the ballast")
