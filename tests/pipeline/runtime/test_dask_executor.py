"""Executors: every task gives its result, whatever happens to the workers, or an error says why not."""

import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import chores
import dask
import psutil
import pytest
from distributed import Client, Status
from processes import LONG_S, wait_for

from pipeline.errors import ClusterError, RunCancelledError, RunError, RunOverError, VersionMismatchError
from pipeline.runtime.cluster import dispatch, worker_setup
from pipeline.runtime.cluster.dask_executor import Cluster
from pipeline.runtime.cluster.dispatch import ClusterMonitor
from pipeline.runtime.cluster.local_executor import LocalExecutor
from pipeline.runtime.cluster.packed_tasks import differences, measure_packed, pack_tasks, versions_of
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.engine import executor_for
from pipeline.runtime.isolation.forked_child import can_fork
from pipeline.runtime.monitoring.measurement import Measured
from pipeline.runtime.monitoring.progress import Event, Watch
from pipeline.runtime.monitoring.versions import ENGINE, fingerprint, versions_here
from pipeline.runtime.resources import Resources
from pipeline.runtime.scratch.folder import Scratch


def worked_off(cluster: Cluster, stage: str, function: Callable[[Any], Any], tasks: Iterable[Any]) -> list[Any]:
    """Results of a map on a cluster, as they came."""
    with cluster.executor() as executor:
        return [measured.result for measured in executor.map(stage, function, list(tasks), Watch())]


def collect(running: Iterable[Measured[int]], results: list[int]) -> None:
    """Keep the results so far, even if the map ends with an error."""
    for measured in running:
        results.append(measured.result)  # noqa: PERF401 - extend would keep nothing then


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """Two workers for all tests of this file."""
    with Cluster(workers=2) as both:
        yield both


# --- what comes back -------------------------------------------------------------------------------------------------


def test_every_task_gives_its_result(cluster: Cluster) -> None:
    with cluster.executor() as executor:
        executor.prepare("double", Watch())
        results = [measured.result for measured in executor.map("double", chores.double, range(50), Watch())]
    assert sorted(results) == [2 * n for n in range(50)]


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many tasks each message to the cluster had."""
    sizes: list[int] = []

    def noted(function: Callable[[Any], Any], tasks: Sequence[Any]) -> bytes:
        sizes.append(len(tasks))
        return pack_tasks(function, tasks)

    monkeypatch.setattr(dispatch, "pack_tasks", noted)
    return sizes


def test_short_tasks_travel_together_and_fewer_towards_the_end(cluster: Cluster, sent: list[int]) -> None:
    assert sorted(worked_off(cluster, "double", chores.double, range(600))) == [2 * n for n in range(600)]
    assert sum(sent) == 600
    assert sent[0] == sent[-1] == 1
    assert 8 < max(sent) <= 600 // (2 * dispatch._SHARES)
    assert len(sent) < 300


def test_tasks_that_take_long_travel_alone(cluster: Cluster, sent: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "_TOGETHER_S", 0.0)
    assert len(worked_off(cluster, "double", chores.double, range(100))) == 100
    assert sent == [1] * 100


@pytest.mark.slow
def test_tasks_that_travel_with_a_killer_are_not_lost(cluster: Cluster, sent: list[int], tmp_path: Path) -> None:
    tasks = [(str(tmp_path), number, 3 if number == 90 else 0) for number in range(200)]
    assert sorted(worked_off(cluster, "die", chores.die_at_first, tasks)) == list(range(200))
    assert max(sent) > 1


def test_workers_do_not_spend_their_time_on_looking_at_themselves(cluster: Cluster) -> None:
    with Client(cluster.address, set_as_default=False) as client:
        for name, wanted in worker_setup.LEAN_LOOP.items():
            assert set(client.run(dask.config.get, name).values()) == {wanted}
    assert dask.config.get("distributed.worker.profile.enabled")  # this process's own settings are left alone


@pytest.mark.skipif(not can_fork(), reason="this system starts workers the long way")
def test_workers_are_forked_from_one_server_and_their_children_from_what_they_were_born_with(cluster: Cluster) -> None:
    with Client(cluster.address, set_as_default=False) as client:
        found = client.run(chores.family, None)
    assert len(found) == 2
    (server,) = {parent for parent, _, _ in found.values()}
    assert server != os.getpid()
    for _, worker, own_server in found.values():
        assert psutil.Process(own_server).ppid() == worker
        assert psutil.Process(own_server).cmdline() == psutil.Process(server).cmdline(), "it was forked"


def test_several_runs_share_one_cluster_at_once(cluster: Cluster) -> None:
    def go(first: int) -> list[int]:
        return sorted(worked_off(cluster, "double", chores.double, range(first, first + 20)))

    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(go, (0, 100, 200, 300)))
    assert found == [[2 * n for n in range(first, first + 20)] for first in (0, 100, 200, 300)]


def test_a_fault_of_a_task_is_raised_as_it_is(cluster: Cluster) -> None:
    with cluster.executor() as executor, pytest.raises(ZeroDivisionError, match="on purpose"):
        list(executor.map("fail", chores.fail, ["on purpose"], Watch()))


def test_a_task_whose_worker_dies_runs_again_elsewhere(cluster: Cluster, tmp_path: Path) -> None:
    tasks = [(str(tmp_path), number, 1) for number in range(3)]
    assert sorted(worked_off(cluster, "die", chores.die_at_first, tasks)) == [0, 1, 2]
    for number in range(3):
        assert len(list(tmp_path.glob(f"{number}.*"))) >= 2


@pytest.mark.slow
def test_only_the_task_that_kills_its_workers_again_and_again_is_blamed(cluster: Cluster) -> None:
    results: list[int] = []
    with cluster.executor() as executor, pytest.raises(RunError, match=r"stage die: .* when it ran alone: 5\. "):
        collect(executor.map("die", chores.die_if_five, range(12), Watch()), results)
    assert set(results) <= set(range(12)) - {5}
    assert sorted(worked_off(cluster, "double", chores.double, range(8))) == [2 * n for n in range(8)]


@pytest.mark.slow
def test_tasks_under_suspicion_are_tried_alone_and_none_is_lost(cluster: Cluster, tmp_path: Path) -> None:
    # more deaths than Dask allows a task; what was on the same workers is suspected with it
    tasks = [(str(tmp_path), number, 3 if number == 5 else 0) for number in range(12)]
    assert sorted(worked_off(cluster, "die", chores.die_at_first, tasks)) == list(range(12))


@pytest.mark.slow
def test_a_keeper_stays_while_it_starts_its_worker_anew_and_one_that_gave_up_is_replaced(tmp_path: Path) -> None:
    # Dask would end it if no worker of that name is there at the time
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "1 ms"}):
        with Cluster(workers=1) as one, one.executor() as executor:
            keeper = one._embedded.workers[0]
            (found,) = executor.map("die", chores.die_at_first, [(str(tmp_path), 7, 1)], Watch())
            assert found.result == 7
            assert one._embedded.workers[0] is keeper
            assert keeper.status == Status.running
            one._embedded.sync(keeper.close)
            left = [measured.result for measured in executor.map("double", chores.double, range(3), Watch())]
            assert sorted(left) == [0, 2, 4]
            assert one._embedded.workers.get(0) is not keeper
        assert dask.config.get("distributed.deploy.lost-worker-timeout") == "1 ms"


def test_higher_priorities_go_first(tmp_path: Path) -> None:
    def go(cluster: Cluster, name: str, priority: int) -> None:
        with cluster.executor(priority) as executor:
            tasks = [(str(tmp_path), f"{name}{k}") for k in range(2)]
            results = [measured.result for measured in executor.map(name, chores.wait_for_mark, tasks, Watch())]
        assert sorted(results) == [f"{name}0", f"{name}1"]

    def started() -> list[str]:
        return [path.name.split("-")[2] for path in sorted(tmp_path.glob("started-*"))]

    with Cluster(workers=1) as cluster, ThreadPoolExecutor(3) as threads, Client(cluster._embedded) as client:

        def known() -> int:
            # at the worker: it is the one that chooses, and what is still on its way to it cannot be chosen
            return sum(client.run(chores.tasks_held).values())

        ways = []
        for count, (name, priority) in enumerate((("first", 0), ("low", 0), ("high", 5)), start=1):
            ways.append(threads.submit(go, cluster, name, priority))
            wait_for(lambda count=count: known() == 2 * count, f"the tasks of {name}")
            wait_for(started, "a task that runs")
        Path(tmp_path, "go").touch()
        for way in ways:
            way.result(LONG_S)
    order = started()
    assert order[0].startswith("first")
    high, low = (max(order.index(f"{name}{k}") for k in range(2)) for name in ("high", "low"))
    assert high < min(order.index("low0"), order.index("low1")) <= low


def test_a_run_says_that_it_waits_for_workers_that_others_keep_busy_and_one_at_work_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatch, "_QUIET_S", 0.2)
    events: dict[str, list[Event]] = {"first": [], "second": []}

    def go(cluster: Cluster, name: str) -> None:
        with cluster.executor() as executor:
            watch = Watch(listener=events[name].append)
            list(executor.map(name, chores.wait_for_mark, [(str(tmp_path), name)], watch))

    with Cluster(workers=1) as cluster, ThreadPoolExecutor(2) as threads:
        ways = [threads.submit(go, cluster, "first")]
        wait_for(lambda: list(tmp_path.glob("started-*")), "the first task")
        ways.append(threads.submit(go, cluster, "second"))
        wait_for(
            lambda: len([one for one in events["second"] if one.kind == "waiting"]) >= 2, "the words of the second"
        )
        assert "busy with other runs" in events["second"][-1].message
        assert [one for one in events["first"] if one.kind == "waiting"] == []
        Path(tmp_path, "go").touch()
        for way in ways:
            way.result(LONG_S)


@pytest.mark.slow
def test_the_content_is_that_of_children_of_this_process(cluster: Cluster, suburb: Path, reconstruct: Any) -> None:
    settings = {"tile_size_m": 40.0}
    far = reconstruct(suburb, settings=settings, executor=cluster.executor(), workers=None)
    near = reconstruct(suburb, settings=settings, executor=LocalExecutor(2), workers=None)
    assert far.statuses["ok"] >= 1
    assert (near.digest, near.statuses, near.reasons) == (far.digest, far.statuses, far.reasons)


# --- cancelled ------------------------------------------------------------------------------------------------------


def test_a_cancelled_run_stops_its_tasks_and_waits_for_them(cluster: Cluster, tmp_path: Path) -> None:
    off = threading.Event()
    watch = Watch(cancelled=off.is_set, stop=Path(tmp_path, "go").touch)
    tasks = [(str(tmp_path), f"task{k}") for k in range(30)]
    with cluster.executor() as executor:
        running = executor.map("wait", chores.wait_for_mark, tasks, watch)
        with ThreadPoolExecutor(1) as thread:
            way = thread.submit(list, running)
            wait_for(lambda: list(tmp_path.glob("started-*")), "a task that runs")
            off.set()
            with pytest.raises(RunCancelledError, match="cancelled"):
                way.result(LONG_S)
    begun = len(list(tmp_path.glob("started-*")))
    assert begun < len(tasks)
    assert worked_off(cluster, "double", chores.double, [4]) == [8]
    assert len(list(tmp_path.glob("started-*"))) == begun, "a task of the run that was cancelled began later"


def test_scratch_that_only_a_worker_misses_is_not_shared_and_one_that_all_miss_is_gone(
    cluster: Cluster, tmp_path: Path
) -> None:
    ours, theirs = Scratch(str(tmp_path / "ours"), attempt="mine"), Scratch(str(tmp_path / "theirs"), attempt="mine")
    ours.create()
    watch = Watch(check_scratch=ours.check_cancelled)
    with cluster.executor() as executor:
        with pytest.raises(RunError, match="a worker does not see the run's scratch folder"):
            list(executor.map("look", chores.look_at_scratch, [theirs], watch))
        # as when a removal has reached the mark of the run, but not the folder itself
        ours.cancel()
        with pytest.raises(RunOverError, match="ours is over"):
            list(executor.map("look", chores.look_at_scratch, [ours], watch))


def test_tasks_of_a_map_that_is_closed_do_not_begin(cluster: Cluster, tmp_path: Path) -> None:
    stopped = threading.Event()

    def stop() -> None:
        stopped.set()
        Path(tmp_path, "go").touch()

    with cluster.executor() as executor:
        tasks = [(str(tmp_path), f"task{k}") for k in range(30)]
        Path(tmp_path, "go").touch()
        running = executor.map("wait", chores.wait_for_mark, tasks, Watch(stop=stop))
        next(running)
        running.close()
    assert stopped.is_set()
    assert len(list(tmp_path.glob("started-*"))) < len(tasks)


def test_serial_tasks_are_cancelled_between_two() -> None:
    found: list[int] = []
    watch = Watch(cancelled=lambda: len(found) == 2)
    with pytest.raises(RunCancelledError):
        collect(SerialExecutor().map("double", chores.double, [1, 2, 3], watch), found)
    assert found == [2, 4]


# --- scheduler and workers that are not there ------------------------------------------------------------------------


class FakeScheduler:
    """What a monitor asks: how many threads there are, or nothing where it does not answer."""

    def __init__(self) -> None:
        self.threads: dict[str, int] | None = {}
        self.status = "running"
        self.scheduler = self

    def ncores_running(self) -> None:
        """The name of what is asked."""

    def sync(self, ask: Any, callback_timeout: float) -> dict[str, int]:
        """Answer, or be silent."""
        assert ask == self.ncores_running
        assert callback_timeout > 0
        if self.threads is None:
            raise TimeoutError
        return self.threads


class Lookouts:
    """A monitor over a fake scheduler, with a clock of its own."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.client = FakeScheduler()
        self.events: list[Event] = []
        self.counts: list[int] = []
        tell = self.counts.append
        self.monitor = ClusterMonitor(self.client, "tcp://s:8786", tell, "Start one", clock=lambda: self.now_s)

    def pass_time(self, seconds: float) -> None:
        """Look once a second for a while."""
        for _ in range(round(seconds)):
            self.now_s += 1.0
            self.monitor.look("split", Watch(listener=self.events.append))


def test_events_report_missing_workers_with_time_and_fix_and_their_return() -> None:
    world = Lookouts()
    world.pass_time(70)
    assert [event.kind for event in world.events] == ["waiting"] * 3
    assert world.events[0].message.startswith("no worker has been there for 3 s")
    assert world.events[0].message.endswith("Start one")
    assert "for 63 s" in world.events[2].message
    world.client.threads = {"tcp://w:1": 2}
    world.pass_time(5)
    assert [event.kind for event in world.events[3:]] == ["run"]
    assert "workers are there after 70 s" in world.events[3].message
    assert world.monitor.threads == 2
    assert world.counts == [0] * 70 + [1] * 5


def test_a_worker_that_is_restarted_at_once_is_not_worth_a_word() -> None:
    world = Lookouts()
    for _ in range(5):
        world.client.threads = {}
        world.pass_time(2)
        world.client.threads = {"tcp://w:1": 1}
        world.pass_time(2)
    assert world.events == []


def test_a_scheduler_that_is_silent_is_lost_after_a_while_and_not_before() -> None:
    world = Lookouts()
    world.client.threads = {"tcp://w:1": 1}
    world.pass_time(3)
    world.client.threads = None
    world.pass_time(59)
    with pytest.raises(ClusterError, match=r"scheduler tcp://s:8786 was lost: it has not answered for 6\d s"):
        world.pass_time(3)


def test_a_broken_connection_to_the_scheduler_is_an_error_at_once() -> None:
    world = Lookouts()
    world.client.status = "connecting"
    with pytest.raises(ClusterError, match="connection to it broke"):
        world.pass_time(1)


def test_a_scheduler_that_is_not_there_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.runtime.cluster.dask_executor.CONNECT_S", 1.0)
    executor = executor_for(Resources(workers=2, scheduler="tcp://127.0.0.1:9"), local_directory="")
    with pytest.raises(ClusterError, match=r"tcp://127.0.0.1:9 does not answer.*Check the address"), executor:
        pytest.fail("it connected")


def test_an_executor_that_was_not_entered_says_so() -> None:
    executor = Cluster(scheduler="tcp://127.0.0.1:9").executor()
    with pytest.raises(ClusterError, match="not connected"):
        list(executor.map("double", chores.double, [1], Watch()))
    with pytest.raises(ClusterError, match="not running"):
        Cluster().executor().__enter__()


# --- versions --------------------------------------------------------------------------------------------------------


def test_a_task_of_another_version_is_refused_before_it_is_unpacked() -> None:
    other = fingerprint().replace(f"{ENGINE}=", f"{ENGINE}=9.")
    with pytest.raises(VersionMismatchError, match=rf"worker \S+: {ENGINE} \S+ where the client has 9\."):
        measure_packed(other, b"no pickle at all")
    found = measure_packed(fingerprint(), pack_tasks(chores.double, [4, 5]))
    assert [measured.result for measured in found] == [8, 10]


def test_a_fingerprint_has_every_version() -> None:
    assert versions_of(fingerprint()) == dict(versions_here())
    assert {"python", "numpy", "numba", "distributed", "pyarrow", "shapely", ENGINE} <= set(versions_here())
    assert "none" not in versions_here().values()


def test_all_differences_are_listed() -> None:
    ours = {"numpy": "2.1", "numba": "0.63", "scipy": "1.16"}
    found = differences(ours, {"numpy": "2.0", "scipy": "1.16", "pandas": "3"})
    assert found == ["numpy 2.0 where the client has 2.1", "no numba where the client has 0.63"]
