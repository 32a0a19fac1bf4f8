"""Which engine runs a job, by what is asked for and by what it will cost."""

from pathlib import Path

import pytest

from pipeline.errors import SettingsError
from pipeline.io import ReadOptions
from pipeline.runtime.cluster.local_executor import LocalExecutor
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.engine import ALONE_S, SMALL_S, engine_of, executor_for
from pipeline.runtime.expected import RATES, Expected, expected
from pipeline.runtime.isolation import preloading
from pipeline.runtime.monitoring import measurement as machine
from pipeline.runtime.resources import SERIAL, Resources
from pipeline.runtime.run_plan import make_plan
from pipeline.settings import RunSettings


@pytest.mark.parametrize(
    ("resources", "cpu_s", "at", "models", "engine"),
    [
        (Resources(), 0.0, 2, True, ("local", 2)),
        (Resources(), 2 * SMALL_S, 2, True, ("local", 2)),
        (Resources(), 2 * SMALL_S + 1.0, 2, True, ("cluster", 2)),
        (Resources(), 2 * SMALL_S + 1.0, 16, True, ("local", 16)),
        (Resources(), 5.0, 1, True, ("local", 1)),
        (Resources(performance_report="time.html"), 5.0, 4, True, ("cluster", 4)),
        (Resources(scheduler="tcp://far:8786"), 5.0, 4, True, ("cluster", 0)),
        (Resources(workers=0, scheduler="tcp://far:8786"), 5.0, 4, True, ("cluster", 0)),
        (Resources(workers=0), 1e6, 4, True, ("serial", 1)),
        (Resources(workers=0, performance_report="time.html"), 1e6, 4, True, ("serial", 1)),
        (Resources(workers=3), 0.0, 8, True, ("cluster", 3)),
        # Only the smallest jobs without buildings need no children.
        (Resources(), 0.0, 4, False, ("serial", 1)),
        (Resources(), 0.9 * ALONE_S, 4, False, ("serial", 1)),
        (Resources(), 0.9 * ALONE_S, 4, True, ("local", 4)),
        (Resources(), ALONE_S, 4, False, ("local", 4)),
        (Resources(), 4 * SMALL_S + 1.0, 4, False, ("cluster", 4)),
        (Resources(performance_report="time.html"), 0.0, 4, False, ("cluster", 4)),
        (Resources(workers=2), 0.0, 4, False, ("cluster", 2)),
    ],
)
def test_the_resources_of_a_request_count_before_the_cost_of_a_job(
    resources: Resources, cpu_s: float, at: int, models: bool, engine: tuple[str, int]
) -> None:
    assert engine_of(resources, expected_cpu_s=cpu_s, at=at, models=models) == engine


@pytest.mark.parametrize(("starts", "engine"), [(9.0, "local"), (11.0, "cluster")])
@pytest.mark.parametrize("at", [1, 2, 16])
def test_a_cluster_starts_only_where_its_start_is_less_than_a_tenth_of_the_job(
    at: int, starts: float, engine: str
) -> None:
    cpu_s = starts * RATES.cluster_start_s * at
    assert engine_of(Resources(), expected_cpu_s=cpu_s, at=at) == (engine, at)


def test_a_large_job_has_no_more_workers_than_there_is_memory_for(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    monkeypatch.setattr("pipeline.runtime.cluster.dask_executor.Cluster", lambda **given: made.append(given["workers"]))
    monkeypatch.setattr("pipeline.runtime.cluster.dask_executor.DaskExecutor", lambda *_, **__: None)
    monkeypatch.setattr("pipeline.runtime.engine.cores", lambda: 8)
    monkeypatch.setattr("pipeline.runtime.engine.memory_bytes", lambda: 16 * 2**30)
    large = Expected(points_by_file={"a": 10**9}, tiles=99, seen_points=2e9, buildings=10**6, task_bytes=3 * 2**30)
    for workers in (None, 8):
        executor_for(Resources(workers=workers), local_directory="", work=large)
    assert made == [4, 8]


def test_executors_are_what_the_engine_says() -> None:
    assert isinstance(executor_for(SERIAL, local_directory=""), SerialExecutor)
    assert isinstance(executor_for(Resources(), local_directory=""), LocalExecutor)
    nothing = Expected(points_by_file={}, tiles=0, seen_points=0.0, buildings=0, models=False)
    assert isinstance(executor_for(Resources(), local_directory="", work=nothing), SerialExecutor)
    with pytest.raises(SettingsError, match="--workers 1"):
        executor_for(Resources(workers=0, performance_report="time.html"), local_directory="")


def test_inputs_are_surely_small_where_all_are_files_of_this_machine_and_small_together(tmp_path: Path) -> None:
    def file(name: str, size: int) -> str:
        with (tmp_path / name).open("wb") as stream:
            stream.truncate(size)
        return str(tmp_path / name)

    most = preloading._SMALL_BYTES
    half, rest, more = file("half.laz", most // 2), file("rest.laz", most - most // 2 - 1), file("more.laz", most)
    assert preloading.is_surely_small([half])
    assert preloading.is_surely_small([half, rest])
    assert not preloading.is_surely_small([half, half])
    assert not preloading.is_surely_small([more])
    assert not preloading.is_surely_small([half, str(tmp_path)])
    assert not preloading.is_surely_small([half, str(tmp_path / "none.laz")])
    assert not preloading.is_surely_small(["s3://bucket/half.laz"])


def test_more_points_buildings_and_halos_cost_more() -> None:
    def cost(*, points: int = 10**6, seen: float = 2e6, buildings: int = 100) -> float:
        work = Expected(points_by_file={"a": points}, tiles=4, seen_points=seen, buildings=buildings)
        return sum(work.cpu_s().values())

    assert cost() < cost(points=2 * 10**6)
    assert cost() < cost(seen=4e6)
    assert cost() < cost(buildings=200)


def test_a_plan_has_points_tiles_and_buildings(suburb: Path) -> None:
    plan = make_plan([str(suburb)], ReadOptions(), RunSettings())
    found = expected(plan)
    assert found.points == plan.points
    assert found.tiles >= 1
    assert found.points <= found.seen_points <= found.points * max(1, found.tiles)
    x0, y0, _, x1, y1, _ = plan.sources[0].bounds_m
    assert found.buildings == round((x1 - x0) * (y1 - y0) / 1e6 * RATES.buildings_per_km2)
    assert expected(plan, 7).buildings == 7
    off = make_plan([str(suburb)], ReadOptions(bbox=(-9e6, -9e6, -8e6, -8e6)), RunSettings())
    assert (expected(off).points, expected(off).tiles) == (0, 0)


def test_one_file_is_not_read_by_several_hands() -> None:
    work = Expected(points_by_file={"a": 10**6}, tiles=4, seen_points=1e6, buildings=100)
    alone, four = work.wall_s(1), work.wall_s(4)
    assert four["ingest"] == alone["ingest"]
    assert four["digest"] == alone["digest"]
    assert four["split"] == alone["split"] / 4


@pytest.mark.parametrize(
    ("quota", "most"), [("150000 100000", 1), ("50000 100000", 1), ("max 100000", None), (None, None)]
)
def test_a_quota_of_the_control_group_bounds_the_cores(tmp_path: Path, quota: str | None, most: int | None) -> None:
    if quota is not None:
        (tmp_path / "cpu.max").write_text(quota)
    free = machine.cores(tmp_path / "nowhere")
    assert machine.cores(tmp_path) == (free if most is None else min(free, most))


def test_a_limit_of_the_control_group_bounds_the_memory(tmp_path: Path) -> None:
    assert machine.memory_bytes(tmp_path) > 2**20
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.memory_bytes(tmp_path) > 2**20
    (tmp_path / "memory.max").write_text(f"{2**20}\n")
    assert machine.memory_bytes(tmp_path) == 2**20
