"""Runs on a real scheduler and real workers: killed, drained, missing, late, of other versions, and interrupted."""

import contextlib
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import chores
import psutil
import pytest
from faults import asked
from processes import Program, Programs, free_port, lives, program, wait_for

from pipeline.errors import ClusterError, RunCancelledError, VersionMismatchError
from pipeline.runtime.cluster.dask_executor import Cluster
from pipeline.runtime.manifest import RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.measurement import Measured
from pipeline.runtime.monitoring.progress import Event, Watch
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run
from pipeline.settings import RunSettings

pytestmark = pytest.mark.slow

CHORES = Path(chores.__file__).parent
END_S = 300.0
"""A deadline for a whole run of a few seconds."""

OTHER_VERSION = """
import importlib.metadata
import distributed.versions

def version(name, real=importlib.metadata.version):
    return "9.9" if name == "shapely" else real(name)

importlib.metadata.version = distributed.versions.version = version
distributed.versions._version_cached.cache_clear()

import pipeline.runtime.monitoring.versions as ours

ours._version = version
ours.versions_here.cache_clear()
ours.fingerprint.cache_clear()
"""


class Bench:
    """A scheduler, its workers, and runs of one tile on them."""

    def __init__(self, programs: Programs, folder: Path, tile: Path) -> None:
        self.programs = programs
        self.folder = folder
        self.tile = tile
        self.port = free_port()
        self.events: list[Event] = []
        self.threads = ThreadPoolExecutor(4)
        self.over = threading.Event()
        self.scheduler = self.start_scheduler()

    @property
    def address(self) -> str:
        """The scheduler's."""
        return f"tcp://127.0.0.1:{self.port}"

    def start_scheduler(self) -> Program:
        """`dask scheduler` on the loopback."""
        return self.programs.start_scheduler(self.port)

    def start_worker(self, name: str, *options: str, env: dict[str, str] | None = None) -> Program:
        """`dask worker` with one thread under a nanny."""
        command = [str(program("dask")), "worker", self.address, "--nthreads", "1", "--name", name, "--no-dashboard"]
        scratch = ["--local-directory", str(self.folder / name), "--memory-limit", "4GiB"]
        return self.programs.start(name, [*command, *scratch, *options], env=env)

    def start_gablework_worker(self, name: str, *options: str) -> Program:
        """`gablework worker`, which finds the chores of the tests."""
        command = [str(program("gablework")), "worker", "--scheduler", self.address, "--name", name]
        return self.programs.start(name, [*command, *options], env={"PYTHONPATH": str(CHORES)})

    def run(self, out: str, cancelled: Callable[[], bool] | None = None) -> RunSummary:
        """Reconstruct the tile on the workers; cancelled where the test is over before."""
        inputs, resources = (str(self.tile),), Resources(scheduler=self.address)
        settings = RunSettings.from_mapping({"tile_size_m": 40.0})
        request = RunRequest(inputs=inputs, out=str(self.folder / out), settings=settings, resources=resources)
        return run(request, self.listen, cancelled=cancelled or self.over.is_set)

    def listen(self, event: Event) -> None:
        """Keep the events of a run."""
        self.events.append(event)

    def begin(self, out: str) -> Future[RunSummary]:
        """Reconstruct in another thread."""
        return self.threads.submit(self.run, out)

    def paused(self, stage: str = "split") -> tuple[Path, Program, Future[RunSummary]]:
        """A run whose one worker came to a stage and waits there: its folder, the worker, the run."""
        folder, env = self.pausing(stage)
        worker = self.start_worker("one", env=env)
        running = self.begin("run")
        wait_for(reached(folder), f"a task of {stage}")
        return folder, worker, running

    def pausing(self, stage: str) -> tuple[Path, dict[str, str]]:
        """A folder, and the environment of workers that stop before the tasks of a stage until it holds `go`."""
        folder = self.folder / f"pause-{stage}"
        folder.mkdir()
        return folder, asked.environment(pause={stage: str(folder)})


@pytest.fixture
def bench(programs: Programs, tmp_path: Path, tile: Path) -> Iterator[Bench]:
    """A scheduler without workers."""
    one = Bench(programs, tmp_path, tile)
    try:
        yield one
    finally:
        one.over.set()
        one.threads.shutdown()


def reached(folder: Path) -> Callable[[], int | None]:
    """The process that came to a pause."""

    def pid() -> int | None:
        marks = sorted(folder.glob("reached-*"))
        return int(marks[0].name.split("-")[1]) if marks else None

    return pid


def owner(of: int, workers: list[Program]) -> Program:
    return next(worker for worker in workers if of in {child.pid for child in worker.children()})


# --- killed ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stage", ["ingest", "split", "reconstruct", "publish"])
def test_a_worker_killed_in_any_stage_changes_nothing(stage: str, bench: Bench, digest: str) -> None:
    folder, env = bench.pausing(stage)
    workers = [bench.start_worker(name, env=env) for name in ("one", "two")]
    running = bench.begin("run")
    victim = owner(wait_for(reached(folder), f"a task of {stage}"), workers)
    victim.kill()
    wait_for(lambda: not victim.children(), "the end of its processes")
    (folder / "go").touch()
    summary = running.result(END_S)
    assert summary.digest == digest
    assert summary.failed_tiles == ()
    assert read_manifest(bench.folder / "run").status is RunStatus.FINISHED


def test_a_worker_process_that_is_killed_below_its_nanny_changes_nothing(bench: Bench, digest: str) -> None:
    folder, _, running = bench.paused()
    pid = wait_for(reached(folder), "its process")
    (folder / "go").touch()
    psutil.Process(pid).kill()
    assert running.result(END_S).digest == digest


def test_a_run_without_workers_reports_that_it_waits_and_continues_when_one_comes(bench: Bench, digest: str) -> None:
    folder, env = bench.pausing("split")
    only = bench.start_worker("one", env=env)
    running = bench.begin("run")
    wait_for(reached(folder), "a task of split")
    only.kill()

    def messages(kind: str) -> list[str]:
        return [event.message for event in bench.events if (event.kind, event.stage) == (kind, "split")]

    waiting = wait_for(lambda: messages("waiting"), "the event that it waits")[0]
    assert f"gablework worker --scheduler {bench.address}" in waiting
    # the workers are counted once a second: the second one stops in the stage, too, until it is seen
    bench.start_worker("two", env=env)
    wait_for(
        lambda: [one for one in messages("run") if "workers are there after" in one], "the event that one is there"
    )
    (folder / "go").touch()
    assert running.result(END_S).digest == digest


def test_a_scheduler_killed_under_a_run_ends_it_with_a_clear_error(bench: Bench) -> None:
    _, _, running = bench.paused()
    bench.scheduler.kill()
    with pytest.raises(ClusterError, match=rf"the scheduler {bench.address} was lost"):
        running.result(END_S)
    assert read_manifest(bench.folder / "run").status is RunStatus.FAILED
    assert not (bench.folder / "run" / "scratch").exists()


# --- cancelled ------------------------------------------------------------------------------------------------------


def test_a_run_that_is_called_off_leaves_a_cluster_that_serves_the_next(bench: Bench, digest: str) -> None:
    bench.start_worker("one")

    def split_began() -> bool:
        return any(event.kind == "progress" and event.stage == "split" for event in bench.events)

    with pytest.raises(RunCancelledError):
        bench.run("off", cancelled=split_began)
    assert read_manifest(bench.folder / "off").status is RunStatus.CANCELLED
    assert bench.run("next").digest == digest


def test_ctrl_c_ends_a_run_and_all_its_processes(programs: Programs, tile: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pause"
    folder.mkdir()
    command = [str(program("gablework")), "reconstruct", str(tile), "--out", str(tmp_path / "run"), "--workers", "2"]
    started = programs.start("reconstruct", command, env=asked.environment(pause={"split": str(folder)}))
    wait_for(reached(folder), "a task of split")
    family = started.children()
    assert len(family) >= 2
    # a terminal sends it to the whole group
    os.killpg(started.pid, signal.SIGINT)
    assert started.ended() == 130
    wait_for(lambda: not any(lives(process) for process in family), "the end of its workers")
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "cancelled"
    assert not (tmp_path / "run" / "scratch").exists()
    assert "Traceback" not in started.text


# --- versions --------------------------------------------------------------------------------------------------------


def test_a_worker_of_another_version_is_named_before_the_first_task(bench: Bench, tmp_path: Path) -> None:
    preload = tmp_path / "other_version.py"
    preload.write_text(OTHER_VERSION)
    bench.start_worker("one")
    bench.start_worker("other", "--preload", str(preload))
    with Cluster(scheduler=bench.address) as cluster, cluster.executor() as executor:
        wait_for(lambda: len(executor._client.scheduler_info()["workers"]) == 2, "both workers")
    with pytest.raises(VersionMismatchError, match=r"worker tcp://\S+: shapely 9\.9 where the client has 2\."):
        bench.run("run")
    assert not any(event.kind == "stage" for event in bench.events)


def test_a_worker_of_another_version_that_comes_late_is_refused_by_its_first_task(bench: Bench, tmp_path: Path) -> None:
    preload = tmp_path / "other_version.py"
    preload.write_text(OTHER_VERSION)
    _, only, running = bench.paused()
    bench.start_worker("other", "--preload", str(preload))
    only.kill()
    with pytest.raises(VersionMismatchError, match=r"worker \S+:\d+: shapely 9\.9 where the client has 2\."):
        running.result(END_S)


# --- gablework worker ------------------------------------------------------------------------------------------------


def test_a_worker_that_drains_finishes_its_task_and_nothing_runs_twice(bench: Bench) -> None:
    workers = [bench.start_gablework_worker(name) for name in ("one", "two")]
    for worker in workers:
        worker.wait_for_text("is at the scheduler")
    marks = bench.folder / "marks"
    marks.mkdir()
    tasks = [(str(marks), f"task{k}") for k in range(12)]
    with Cluster(scheduler=bench.address) as cluster, cluster.executor() as executor:
        watch = Watch(cancelled=bench.over.is_set)
        executor.prepare("wait", watch)
        running = bench.threads.submit(lambda: list(executor.map("wait", chores.wait_for_mark, tasks, watch)))
        wait_for(lambda: len(list(marks.glob("started-*"))) == 2, "a task on each worker")
        leaving = workers[0]
        leaving.process.send_signal(signal.SIGTERM)
        leaving.wait_for_text("no new tasks")
        assert leaving.alive
        (marks / "go").touch()
        results = [measured.result for measured in running.result(END_S)]
    assert sorted(results) == sorted(name for _, name in tasks)
    names = [path.name.split("-")[2] for path in marks.glob("started-*")]
    assert sorted(names) == sorted(results), "a task ran twice"
    assert leaving.ended() == 0
    assert "drained, tasks waited for: 1" in leaving.text
    assert workers[1].alive


@contextlib.contextmanager
def draining(bench: Bench, marks: Path) -> Iterator[tuple[Program, Future[list[Measured[str]]]]]:
    """A worker that was asked to end while it has a task, and the map of the task, which waits for a mark."""
    worker = bench.start_gablework_worker("one")
    worker.wait_for_text("is at the scheduler")
    marks.mkdir()
    with Cluster(scheduler=bench.address) as cluster, cluster.executor() as executor:
        watch = Watch(cancelled=bench.over.is_set)
        tasks = [(str(marks), "only")]
        running = bench.threads.submit(lambda: list(executor.map("wait", chores.wait_for_mark, tasks, watch)))
        wait_for(lambda: list(marks.glob("started-*")), "the task")
        worker.process.send_signal(signal.SIGTERM)
        worker.wait_for_text("no new tasks")
        yield worker, running


def test_the_last_worker_hands_its_result_over_before_it_leaves(bench: Bench) -> None:
    marks = bench.folder / "marks"
    with draining(bench, marks) as (worker, running):
        (marks / "go").touch()
        assert [measured.result for measured in running.result(END_S)] == ["only"]
    assert worker.ended() == 0
    assert len(list(marks.glob("started-*"))) == 1


def test_a_second_signal_ends_a_worker_at_once(bench: Bench) -> None:
    with draining(bench, bench.folder / "marks") as (worker, running):
        worker.process.send_signal(signal.SIGTERM)
        assert worker.ended() == 0
        assert "ended at once" in worker.text
        bench.over.set()
        with pytest.raises(RunCancelledError):
            running.result(END_S)


def test_a_worker_waits_for_its_scheduler_to_come_back(bench: Bench) -> None:
    worker = bench.start_gablework_worker("one")
    worker.wait_for_text("is at the scheduler")
    bench.scheduler.kill()
    worker.wait_for_text("is gone")
    bench.start_scheduler()
    worker.wait_for(lambda: worker.text.count("is at the scheduler") == 2, "its return")
    with Cluster(scheduler=bench.address) as cluster, cluster.executor() as executor:
        assert [m.result for m in executor.map("double", chores.double, [4], Watch())] == [8]
    assert worker.stop() == 0


def test_a_worker_that_is_asked_to_gives_a_lost_scheduler_up(bench: Bench) -> None:
    bench.scheduler.kill()
    worker = bench.start_gablework_worker("one", "--give-up-after", "1")
    assert worker.ended() == 4
    assert f"the scheduler {bench.address} was away" in worker.text
