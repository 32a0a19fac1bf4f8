"""Small jobs run in children of the command: equal results, and no child's death costs more than its task."""

import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import chores
import pytest
from faults.asked import environment
from processes import wait_for

from pipeline.errors import RunCancelledError, RunError
from pipeline.runtime.cluster.local_executor import LocalExecutor
from pipeline.runtime.cluster.serial_executor import run_alone
from pipeline.runtime.isolation import child_pool
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.measurement import Measured, peak_of_process
from pipeline.runtime.monitoring.progress import Event, Watch


@pytest.fixture(autouse=True)
def children_that_know_chores(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Children of a server of its own, which finds the tasks of this file."""
    child_pool.kill_children()
    monkeypatch.setenv("PYTHONPATH", str(Path(chores.__file__).parent), prepend=os.pathsep)
    yield
    child_pool.kill_children()


def results(executor: LocalExecutor, function: Any, tasks: list[Any], watch: Watch | None = None) -> list[Any]:
    """Results of a map, as they came."""
    return [measured.result for measured in executor.map("test", function, tasks, watch or Watch())]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_task_gives_its_result_however_many_children_there_are(count: int) -> None:
    executor = LocalExecutor(count)
    assert sorted(results(executor, chores.double, list(range(7)))) == [0, 2, 4, 6, 8, 10, 12]
    assert results(executor, chores.double, []) == []
    assert run_alone(executor, "test", chores.double, 21) == 42


def test_tasks_see_the_environment_of_now_also_where_older_children_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    executor = LocalExecutor(1)
    for key in ("one", "two"):
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", key)
        assert results(executor, chores.variable, ["AWS_ACCESS_KEY_ID"]) == [key]
    assert child_pool.has_idle_child()
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "three")
    assert not child_pool.has_idle_child()


def test_what_tasks_say_is_said_by_the_command_the_same_of_several_children_once(capfd: Any) -> None:
    words = [f"tile {os.getpid()} is odd", "another one", f"tile {os.getpid()} is odd"]
    assert len(set(results(LocalExecutor(1), chores.say, words))) == 1
    assert capfd.readouterr().err.splitlines() == words[:2]


def largest_overlap(done: list[Measured[Any]]) -> int:
    """How many tasks ran at once at most."""
    return max(sum(one.began_s <= other.began_s < one.began_s + one.seconds for one in done) for other in done)


def test_as_many_tasks_run_at_once_as_there_are_children_and_no_more(tmp_path: Path) -> None:
    # children that wait for work: a task too many would begin with the first two
    results(LocalExecutor(4), chores.meet, [(str(tmp_path), f"before-{k}", 4) for k in range(4)])
    shutil.rmtree(tmp_path)
    tmp_path.mkdir()
    done: list[Measured[Any]] = []
    tasks = [(str(tmp_path), name) for name in "abcdef"]
    running = threading.Thread(
        target=lambda: done.extend(LocalExecutor(2).map("test", chores.wait_for_mark, tasks, Watch()))
    )
    running.start()
    wait_for(lambda: len(list(tmp_path.glob("started-*"))) >= 2, "two tasks at once")
    (tmp_path / "go").touch()
    running.join()
    assert sorted(one.result for one in done) == list("abcdef")
    assert largest_overlap(done) == 2


def test_tasks_that_need_more_memory_than_there_is_run_one_after_the_other(tmp_path: Path) -> None:
    (tmp_path / "go").touch()
    tasks = [chores.Weighty(str(tmp_path), name, 3 * 2**30) for name in ("a", "b")]
    measured = list(LocalExecutor(2, 4 * 2**30).map("test", chores.weigh, tasks, Watch()))
    first, second = sorted(measured, key=lambda one: one.began_s)
    assert first.began_s + first.seconds <= second.began_s
    assert {one.result for one in measured} == {"a", "b"}


def test_tasks_run_in_processes_of_their_own() -> None:
    (measured,) = LocalExecutor(1).map("test", chores.double, [4], Watch())
    assert measured.process.partition(":")[0] == peak_of_process()[0].partition(":")[0]
    assert measured.process != peak_of_process()[0]
    assert measured.peak_bytes > 0


@pytest.mark.parametrize("count", [1, 2])
def test_a_task_that_costs_its_child_is_tried_alone_and_then_counts(tmp_path: Path, count: int) -> None:
    tasks = [(str(tmp_path), number, 1 if number == 2 else 0) for number in range(5)]
    events: list[Event] = []
    watch = Watch(listener=events.append)
    assert sorted(results(LocalExecutor(count), chores.die_at_first, tasks, watch)) == [0, 1, 2, 3, 4]
    assert {(event.kind, event.stage) for event in events} == {("detail", "test")}
    assert all("tried alone" in event.message for event in events)
    assert len(list(tmp_path.glob("2.*"))) == 2


def test_a_task_that_kills_its_child_alone_too_ends_the_run_and_is_named() -> None:
    with pytest.raises(RunError, match=r"stage test: processes died again and again on one task.*: 5\. Use a machine"):
        results(LocalExecutor(2), chores.die_if_five, list(range(8)))


def test_an_error_of_a_task_is_raised_here_and_says_where_it_happened() -> None:
    with pytest.raises(ZeroDivisionError, match="on purpose") as raised:
        results(LocalExecutor(2), chores.fail, ["on purpose"])
    assert "in fail" in raised.value.__notes__[0]


@pytest.mark.slow
def test_cancelling_stops_running_tasks(tmp_path: Path) -> None:
    stopped = threading.Event()

    def begun() -> bool:
        return bool(list(tmp_path.glob("started-*")))

    watch = Watch(cancelled=begun, stop=stopped.set)
    with pytest.raises(RunCancelledError):
        results(LocalExecutor(2), chores.wait_for_mark, [(str(tmp_path), name) for name in "abcd"], watch)
    assert stopped.is_set()
    assert len(list(tmp_path.glob("started-*"))) <= 2, "no other task began"


@pytest.mark.slow
def test_the_content_is_that_of_a_serial_run(suburb: Path, reconstruct: Any) -> None:
    serial = reconstruct(suburb, settings={"tile_size_m": 40.0})
    local = reconstruct(suburb, settings={"tile_size_m": 40.0}, workers=None)
    one = reconstruct(suburb, settings={"tile_size_m": 40.0}, executor=LocalExecutor(1), workers=None)
    assert local.digest == one.digest == serial.digest
    assert serial.statuses["ok"] >= 1
    manifest = read_manifest(local.run_dir)
    assert set(manifest.timings_s) == set(read_manifest(serial.run_dir).timings_s)
    assert len(manifest.peak_memory_bytes) >= 2, "this process, and children"
    assert all(peak > 0 for peak in manifest.peak_memory_bytes.values())


def test_a_building_that_crashes_costs_itself_alone(
    suburb: Path, reconstruct: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = reconstruct(suburb)
    victim = min(path.stem for path in Path(good.run_dir, "meshes").rglob("*.obj"))
    for name, value in environment(crash=[victim]).items():
        monkeypatch.setenv(name, value)
    hurt = reconstruct(suburb, workers=None)
    assert hurt.reasons == {**good.reasons, "crashed": 1}
    assert sum(hurt.statuses.values()) == sum(good.statuses.values())
    assert [path.stem for path in Path(hurt.run_dir, "quarantine").iterdir()] == [victim]
