"""Memory that tasks declare: what is large goes where it fits, nothing waits for ever, and the small ones pass by."""

import dataclasses
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import chores
import pytest
from distributed import Client, LocalCluster, Nanny
from processes import LONG_S, wait_for

from pipeline.runtime.cluster.dask_executor import Cluster
from pipeline.runtime.cluster.memory_needs import (
    BUILDING_BASE_BYTES,
    BUILDING_BYTES_PER_POINT,
    DECLARED_FROM_BYTES,
    RESOURCE,
    announced_bytes,
    building_bytes,
    declared_bytes,
)
from pipeline.runtime.isolation.process_limits import IsolationLimits
from pipeline.runtime.monitoring.progress import Event, Watch
from pipeline.runtime.run_plan import window_bytes
from pipeline.runtime.stages.model_batch import BatchTask
from pipeline.tiling import Tile, TileGrid

GIB = 2**30


@dataclasses.dataclass
class Bench:
    """A scheduler, workers with given announcements, and the events of a run on them."""

    local: LocalCluster
    folder: Path
    events: list[Event]

    def cluster(self) -> Cluster:
        """As a run elsewhere sees it."""
        return Cluster(scheduler=self.local.scheduler_address)

    def run(self, tasks: list[chores.Weighty]) -> list[str]:
        """Work off tasks; their names in the order of the results."""
        with self.cluster().executor() as executor:
            watch = Watch(listener=self.events.append, stop=(self.folder / "go").touch)
            executor.prepare("weigh", watch)
            return [measured.result for measured in executor.map("weigh", chores.weigh, tasks, watch)]

    def task(self, name: str, need_bytes: int) -> chores.Weighty:
        """A task that says who runs it and waits for the file `go`."""
        return chores.Weighty(str(self.folder), name, need_bytes)

    def begun(self) -> list[str]:
        """Names of the tasks that were begun, in their order."""
        return [path.name.split("-", 2)[2] for path in sorted(self.folder.glob("started-*"))]

    def go(self) -> None:
        """Let all tasks end."""
        (self.folder / "go").touch()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """A scheduler without workers."""
    with LocalCluster(
        n_workers=0, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs="CRITICAL"
    ) as one:
        yield Bench(one, tmp_path, [])


def add_worker(bench: Bench, announced: int | None, threads: int = 1) -> None:
    """One more worker process."""
    number = len(bench.local.worker_spec)
    resources = None if announced is None else {RESOURCE: announced}
    options = {"nthreads": threads, "resources": resources, "dashboard": False, "silence_logs": "CRITICAL"}
    bench.local.worker_spec[number] = {"cls": Nanny, "options": options}
    bench.local.sync(bench.local._correct_state)
    bench.local.wait_for_workers(number + 1, timeout=LONG_S)


def test_two_giants_that_do_not_fit_together_never_run_at_once_and_small_ones_pass_by(bench: Bench) -> None:
    add_worker(bench, 4 * GIB, threads=3)
    tasks = [bench.task(f"giant{k}", 3 * GIB) for k in range(2)] + [bench.task(f"small{k}", 0) for k in range(2)]
    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(bench.run, tasks)
        try:
            # three threads: a giant and the two small ones, though the other giant came before them
            wait_for(lambda: len(bench.begun()) == 3, "three tasks that run")
            with Client(bench.local) as client:
                (left,) = client.run(chores.memory_left).values()
        finally:
            bench.go()
        assert sorted(running.result(LONG_S)) == ["giant0", "giant1", "small0", "small1"]
    assert sorted(name[:5] for name in bench.begun()[:3]) == ["giant", "small", "small"]
    assert left == GIB
    assert bench.events == []


@pytest.mark.slow
def test_giants_go_to_the_worker_that_has_room_for_them(bench: Bench) -> None:
    add_worker(bench, GIB)
    add_worker(bench, 8 * GIB)
    bench.go()
    tasks = [bench.task(f"giant{k}", 3 * GIB) for k in range(4)]
    with bench.cluster().executor() as executor:
        processes = {m.process for m in executor.map("weigh", chores.weigh, tasks, Watch())}
    assert len(processes) == 1


def test_without_announced_memory_all_tasks_run_with_a_warning(bench: Bench) -> None:
    add_worker(bench, None)
    bench.go()
    assert sorted(bench.run([bench.task(f"giant{k}", 3 * GIB) for k in range(3)])) == ["giant0", "giant1", "giant2"]
    (event,) = bench.events
    assert event.kind == "warning"
    assert "3 tasks of weigh need much memory (up to 3.0 GiB) and no worker announces" in event.message
    assert "--resources MEMORY=" in event.message


def test_a_task_too_large_for_every_worker_runs_on_the_largest_with_a_warning(bench: Bench) -> None:
    add_worker(bench, 2 * GIB)
    bench.go()
    assert bench.run([bench.task("giant", 64 * GIB)]) == ["giant"]
    (event,) = bench.events
    assert "need up to 64.0 GiB of memory, the largest worker has 2.0 GiB" in event.message


@pytest.mark.slow
def test_a_giant_does_not_wait_for_ever_for_a_worker_that_has_left(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.runtime.cluster.dispatch.ClusterMonitor.memory_s", 0.5)
    add_worker(bench, 8 * GIB)
    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(bench.run, [bench.task(f"giant{k}", 6 * GIB) for k in range(2)])
        try:
            wait_for(lambda: len(bench.begun()) == 1, "a giant that runs")
            # the large one goes, one comes that has less than they asked for
            add_worker(bench, GIB)
            del bench.local.worker_spec[0]
            bench.local.sync(bench.local._correct_state)
        finally:
            bench.go()
        assert sorted(running.result(LONG_S)) == ["giant0", "giant1"]
    assert any("the largest worker has 1.0 GiB" in event.message for event in bench.events)


@pytest.mark.slow
def test_embedded_workers_announce_their_share_of_the_machine() -> None:
    with Cluster(workers=2) as cluster, Client(cluster.address) as client:
        workers = client.scheduler_info(n_workers=-1)["workers"]
        announced = announced_bytes(workers)
        assert announced == [worker["memory_limit"] for worker in workers.values()]
        assert len(announced) == 2


# --- what is declared ------------------------------------------------------------------------------------------------


def test_a_batch_declares_its_largest_building_up_to_the_limit_of_its_process() -> None:
    given = {f.name: None for f in dataclasses.fields(BatchTask)} | {"own": {}}

    def group(largest: int) -> SimpleNamespace:
        return SimpleNamespace(figures=SimpleNamespace(largest=largest))

    limits = IsolationLimits(memory_bytes=GIB)
    task = BatchTask(**{**given, "group": group(160_000), "isolation": limits})
    assert task.memory_bytes == BUILDING_BASE_BYTES + 160_000 * BUILDING_BYTES_PER_POINT == declared_bytes(task)
    giant = dataclasses.replace(task, group=group(1_000_000))
    assert giant.memory_bytes == GIB
    assert dataclasses.replace(giant, isolation=None).memory_bytes == building_bytes(1_000_000) > 2 * GIB
    small = dataclasses.replace(task, group=group(2000))
    assert 0 < small.memory_bytes < DECLARED_FROM_BYTES
    assert declared_bytes(small) == declared_bytes(object()) == 0


def test_a_window_counts_the_points_of_its_halo() -> None:
    grid = TileGrid(size_mm=100_000, halo_mm=50_000, origin_x_mm=0, origin_y_mm=0)
    alone = window_bytes(grid, Tile(0, 0), {Tile(0, 0): 1_000_000})
    beside = window_bytes(grid, Tile(0, 0), {Tile(0, 0): 1_000_000, Tile(1, 0): 1_000_000})
    far = window_bytes(grid, Tile(0, 0), {Tile(0, 0): 1_000_000, Tile(5, 0): 1_000_000})
    per_point = (beside - alone) / 500_000
    assert 100 < per_point < 1000
    assert far == alone
