"""The city that the engine is measured on, what is seen of its processes, and the tables of a run."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import psutil
import pytest

from benchmarks.city_scale import report, stage_rows, stage_table
from benchmarks.city_tiles import make_city, make_row, square_of
from benchmarks.process_watch import CHILD, DRIVER, FORKING, OTHER, WORKER, Seen, Watcher, role_of
from benchmarks.traced_run import TracingExecutor
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.monitoring.progress import Watch


def test_a_city_is_as_square_as_its_tiles_allow() -> None:
    shapes = [(square_of(n, 200.0, 4.5, 1).columns, square_of(n, 200.0, 4.5, 1).rows) for n in (400, 12, 7)]
    assert shapes == [(20, 20), (4, 3), (7, 1)]


@pytest.mark.slow
def test_the_same_city_has_the_same_bytes_whatever_the_processes(tmp_path: Path) -> None:
    city = square_of(4, 100.0, 1.0, 5)
    made = make_city(city, tmp_path / "two", 2)
    again = [tile for row in range(city.rows) for tile in _row(tmp_path / "one", city, row)]
    assert made == again
    assert len(made) == 4
    sums = [
        [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())]
        for folder in (tmp_path / "one", tmp_path / "two")
    ]
    assert sums[0] == sums[1]
    assert len(set(sums[0])) == 4


def _row(folder: Path, city: object, row: int) -> list[object]:
    folder.mkdir(exist_ok=True)
    return make_row(city, row, folder)


def test_tiles_lie_side_by_side_and_hold_their_buildings(tmp_path: Path) -> None:
    city = square_of(2, 100.0, 2.0, 5)
    made = make_row(city, 0, tmp_path)
    clouds = [laspy.read(tmp_path / tile.name) for tile in made]
    assert [len(cloud.points) for cloud in clouds] == [tile.points for tile in made]
    assert np.median(clouds[1].x) - np.median(clouds[0].x) == pytest.approx(100.0, abs=10.0)
    assert set(np.unique(clouds[0].classification)) == {1}
    assert sum(tile.buildings for tile in made) > 5


def test_tiles_that_are_there_are_kept(tmp_path: Path) -> None:
    city = square_of(1, 60.0, 1.0, 5)
    first = make_row(city, 0, tmp_path)
    path = tmp_path / first[0].name
    written = path.stat().st_mtime_ns
    assert make_row(city, 0, tmp_path) == first
    assert path.stat().st_mtime_ns == written


def test_processes_are_separated_by_what_they_run() -> None:
    assert role_of("gablework-child", ["python", "-m", "pipeline.runtime.isolation.fork_server", "12"], {}, 3) == CHILD
    assert role_of("gablework-work", ["python", "-c", "from multiprocessing.forkserver import main"], {}, 3) == WORKER
    assert role_of("gablework-fork", ["python", "-c", "from multiprocessing.forkserver import main"], {}, 3) == FORKING
    assert role_of("python", ["python", "-c", "from multiprocessing.spawn import spawn_main"], {}, 3) == WORKER
    assert role_of("python", ["python", "run.py"], {3: DRIVER}, 3) == DRIVER
    assert role_of("python", ["resource_tracker"], {}, 3) == OTHER


@pytest.mark.slow
def test_what_a_process_spends_is_seen_from_outside() -> None:
    burn = "import time\nblock = b'x' * 60_000_000\nwhile time.process_time() < 0.8: pass\ninput()"
    process = subprocess.Popen([sys.executable, "-c", burn], stdin=subprocess.PIPE)
    try:
        with Watcher({process.pid: DRIVER}) as watcher:
            while DRIVER not in watcher.by_role() or watcher.by_role()[DRIVER][1] < 0.7:
                assert process.poll() is None
    finally:
        process.communicate(b"\n")
    count, cpu_s, peak_bytes = watcher.by_role()[DRIVER]
    assert count == 1
    assert 0.7 <= cpu_s < 10.0
    assert peak_bytes > 60_000_000


def test_only_workers_are_killed_and_in_turns() -> None:
    idle = "import time\ntime.sleep(600)"
    processes = [subprocess.Popen([sys.executable, "-c", idle]) for _ in range(3)]
    try:
        watcher = Watcher({})
        for process, role in zip(processes, (WORKER, CHILD, WORKER), strict=True):
            watcher.seen[process.pid] = Seen(pid=process.pid, role=role)
        watcher._kill_one()
        watcher._kill_one()
        assert sorted(watcher.killed) == sorted({processes[0].pid, processes[2].pid})
        assert processes[0].wait() == processes[2].wait() == -9
        assert processes[1].poll() is None
        watcher._kill_one()  # none is left
        assert len(watcher.killed) == 2
    finally:
        for process in processes:
            if process.poll() is None:
                psutil.Process(process.pid).kill()
            process.wait()


def task(stage: str, process: str, began_s: float, seconds: float, cpu_s: float) -> dict[str, object]:
    return {
        "stage": stage,
        "function": stage,
        "process": process,
        "began_s": began_s,
        "seconds": seconds,
        "cpu_s": cpu_s,
        "back_s": began_s + seconds,
    }


def small_trace() -> dict[str, object]:
    marks = [("run", "plan", 0.0, 0.0), ("stage", "split", 1.0, 0.5), ("finished", "", 11.0, 1.5)]
    marks.insert(2, ("run", "split", 3.0, 0.6))  # workers that are back: no stage of its own
    return {
        "workers": 2,
        "diary": [{"kind": k, "stage": s, "at_s": at, "cpu_s": cpu, "message": ""} for k, s, at, cpu in marks],
        "tasks": [
            task("split", "a", 1.5, 4.0, 3.0),
            task("split", "a", 5.6, 4.4, 4.0),
            task("split", "b", 1.5, 6.5, 6.0),
        ],
        "sizes": [{"stage": "split", "what": "result", "bytes": 3000}],
        "scratch_bytes": {"split": 4000},
    }


def test_idle_time_is_reported_by_where_it_lies() -> None:
    plan, split = stage_rows(small_trace())
    assert (plan["tasks"], plan["wall_s"], plan["idle_s"]) == (0, 1.0, 2.0)
    assert split["wall_s"] == 10.0
    assert split["idle_s"] == pytest.approx(20.0 - 14.9)
    assert split["head_s"] == pytest.approx(2 * 0.5)
    assert split["between_s"] == pytest.approx(0.1)
    assert split["tail_s"] == pytest.approx(2.0)
    assert split["driver_cpu_s"] == pytest.approx(1.0)
    assert "| split | 3 | 10 | 14.9 | 13 |" in stage_table([split])


def test_efficiency_is_cpu_time_of_tasks_over_wall_times_workers(tmp_path: Path) -> None:
    counts = {"candidates": 50, "points": 1000, "tiles": 3, "ok": 49, "fallback": 1, "failed": 0}
    (tmp_path / "run.json").write_text(json.dumps({"counts": counts, "content_sha256": "ab" * 32}), encoding="utf-8")
    seen = {
        "wall_s": 8.0,
        "load_before": 0.1,
        "load_mean": 2.0,
        "killed": 0,
        "roles": {"driver": (1, 3.0, 10**8), "worker": (2, 17.0, 2 * 10**8)},
    }
    text, figures = report(seen, small_trace(), tmp_path, 2)
    assert figures["efficiency"] == pytest.approx(13.0 / 16.0)
    assert figures["occupancy"] == pytest.approx(14.9 / 16.0)
    assert figures["task_share_of_cpu"] == pytest.approx(13.0 / 20.0)
    assert figures["scratch_bytes_a_point"] == 4.0
    assert "efficiency 0.812 (required reached" in text
    assert "| worker | 2 | 17.0 | 0.850 | 200 |" in text


def double(number: int) -> int:
    return 2 * number


def test_a_traced_executor_hands_on_every_result_and_keeps_what_it_took() -> None:
    executor = TracingExecutor(SerialExecutor())
    with executor:
        found = [measured.result for measured in executor.map("split", double, list(range(20)), Watch())]
    assert found == [2 * k for k in range(20)]
    assert [row["stage"] for row in executor.tasks] == ["split"] * 20
    assert all(row["back_s"] >= row["began_s"] for row in executor.tasks)
    assert {size["what"] for size in executor.sizes} == {"task", "result"}
