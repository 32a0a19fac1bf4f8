"""A sample of a run: where its windows lie, what they measure, and how the measurements are scaled."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import laspy
import numpy as np
import pytest

from pipeline.errors import RunError, UnreadableInputError
from pipeline.io import ReadOptions, SpatialReference
from pipeline.runtime import forecast as forecasts
from pipeline.runtime import sample
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.engine import Engine
from pipeline.runtime.expected import RATES, Expected, expected
from pipeline.runtime.forecast import WORTH_S, forecast
from pipeline.runtime.monitoring.progress import Progress, ignore
from pipeline.runtime.request import RunRequest, plan_inputs
from pipeline.runtime.resources import SERIAL, Resources
from pipeline.runtime.run import run
from pipeline.runtime.run_plan import Plan, make_plan
from pipeline.runtime.sample import Sampled, SampleTask, sample_tasks, sample_window, sampled, scaled
from pipeline.settings import RunSettings

LARGE = Expected(points_by_file={"a": 50_000_000}, tiles=40, seen_points=1e8, buildings=9000, ground_km2=(2.0,) * 9)


def planned(paths: Sequence[Path]) -> tuple[RunRequest, Plan, list[str]]:
    request = RunRequest(inputs=tuple(map(str, paths)), out="nowhere")
    plan, found = plan_inputs(request, Progress(ignore))
    return request, plan, found


def with_points(plan: Plan, points: int) -> Plan:
    """A plan whose files claim so many points each."""
    return dataclasses.replace(plan, sources=tuple(dataclasses.replace(i, point_count=points) for i in plan.sources))


def window(pace: float, *, points: int = 100_000, candidates: int = 30) -> Sampled:
    """A window that took so many times what the rates say."""
    stage_s = {stage: pace * s for stage, s in sample._work_of(points, 0.03, candidates).cpu_s().items()}
    stage_s["outline"] += stage_s.pop("units")
    return Sampled(points=points, area_km2=0.03, candidates=candidates, buildings=0.9 * candidates, stage_s=stage_s)


@pytest.mark.parametrize("pace", [0.5, 1.0, 4.0])
def test_a_machine_that_takes_longer_for_the_windows_takes_as_much_longer_for_the_run(pace: float) -> None:
    found = scaled(LARGE, [window(pace), window(pace, points=50_000)], buildings=LARGE.buildings)
    assert found is not None
    for hands in (1, 2, 8):
        stage_s = LARGE.wall_s(hands)
        assert found.wall_s(hands) == pytest.approx({stage: pace * s for stage, s in stage_s.items()}, rel=0.02)


def test_each_stage_has_its_own_pace() -> None:
    slow = window(1.0)
    stage_s = {**slow.stage_s, "split": 5.0 * slow.stage_s["split"]}
    found = scaled(LARGE, [dataclasses.replace(slow, stage_s=stage_s)], buildings=LARGE.buildings)
    assert found is not None
    ratios = {stage: s / LARGE.cpu_s()[stage] for stage, s in found.cpu_s().items() if s}
    assert ratios.pop("split") == pytest.approx(5.0)
    assert list(ratios.values()) == pytest.approx([1.0] * len(ratios), rel=0.02)


def test_the_buildings_of_windows_are_scaled_by_points_unless_they_are_known() -> None:
    windows = [window(1.0, points=100_000, candidates=40), window(1.0, points=300_000, candidates=0), Sampled()]
    found = scaled(LARGE, windows)
    assert found is not None
    assert found.buildings == 50_000_000 * 36 / 400_000
    known = scaled(LARGE, windows, buildings=7)
    assert known is not None
    assert known.buildings == 7
    assert scaled(LARGE, [Sampled(), Sampled()]) is None


def test_tiles_without_points_cost_nothing() -> None:
    found = scaled(LARGE, [dataclasses.replace(window(1.0), filled=0.25), window(1.0)])
    assert found is not None
    assert found.tiles == 10
    assert sum(found.ground_km2) == 0.25 * sum(LARGE.ground_km2)


@pytest.mark.parametrize("hands", [1, 2, 3, 16])
def test_all_processes_have_as_many_windows_and_all_parts_of_the_inputs_are_sampled(
    town: Path, tmp_path: Path, hands: int
) -> None:
    files = [tmp_path / f"{k}.laz" for k in range(5)]
    for file in files:
        file.write_bytes(town.read_bytes())
    request, plan, paths = planned(files)
    for size in (expected(plan), LARGE):
        work = dataclasses.replace(size, points_by_file=dict.fromkeys(paths, 1000))
        tasks = sample_tasks(work, request, plan, paths, hands)
        assert len(tasks) % hands == 0
        assert len(tasks) >= 2
        assert 1 <= len(tasks) / hands <= 5
        assert len({task.path for task in tasks}) == min(5, len(tasks))
        assert len({task.at for task in tasks}) == len(tasks)
        assert all(0.0 <= task.at < 1.0 and task.share is None for task in tasks)
    one = sample_tasks(LARGE, *planned(files[:1]), hands)
    assert not one  # the work names no file of the plan


def test_of_a_large_file_each_window_reads_another_share(town: Path) -> None:
    request, plan, paths = planned([town])
    work = dataclasses.replace(LARGE, points_by_file={paths[0]: 1})
    tasks = sample_tasks(work, request, with_points(plan, 50_000_000), paths, 2)
    shares = [task.share for task in tasks]
    assert all(share is not None and share.of == 51 and 0 <= share.number < 51 for share in shares)
    assert len(set(shares)) == len(shares)


def test_files_elsewhere_are_not_fetched_for_a_sample(town: Path) -> None:
    request, plan, _ = planned([town])
    url = "https://somewhere.example/town.laz"
    plan = dataclasses.replace(plan, sources=(dataclasses.replace(plan.sources[0], path=url),))
    work = dataclasses.replace(LARGE, points_by_file={url: 1})
    assert sample_tasks(work, request, plan, [url], 2) == []
    assert sampled(work, request, plan, [url], hands=2, executor=SerialExecutor()) is None


def the_task(town: Path, *, side_m: float = 80.0) -> SampleTask:
    request, plan, paths = planned([town])
    work = dataclasses.replace(LARGE, points_by_file={paths[0]: 1})
    return dataclasses.replace(sample_tasks(work, request, plan, paths, 1)[0], side_m=side_m)


def test_reading_takes_no_longer_than_it_may(town: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample, "_CHUNK_POINTS", 10_000)
    read: list[int] = []
    cut = sample._cut
    monkeypatch.setattr(sample, "_cut", lambda clouds, *rest: read.append(len(clouds)) or cut(clouds, *rest))
    found = sample_window(the_task(town), itertools.count(0.0, 1.5).__next__)
    # the clock says 1.5, 3.0 and 4.5 s after the chunks
    assert read == [3]
    assert found.filled is None


def test_the_clock_measures_what_reading_a_window_takes(town: Path) -> None:
    quick = sample_window(the_task(town), lambda: 0.0)
    # it is asked when reading begins, after the only chunk, and at the end
    ticks = iter([0.0, 2.0, *[2.0] * 1000])
    slow = sample_window(the_task(town), ticks.__next__)
    assert slow.points == quick.points > 0
    assert slow.filled == 1.0
    # two seconds for all points, of which the window holds some
    share = slow.points / planned([town])[1].points
    assert slow.stage_s["ingest"] == pytest.approx(sample._INGEST * 2.0 * share)
    assert quick.stage_s["ingest"] == 0.0


def test_windows_that_come_too_late_are_left_out_except_one_for_each_process(town: Path) -> None:
    request, plan, paths = planned([town])
    work = dataclasses.replace(LARGE, points_by_file={paths[0]: 1})
    tasks = sample_tasks(work, request, plan, paths, 2)
    assert [task.until_s == math.inf for task in tasks] == [True, True, *[False] * (len(tasks) - 2)]
    late = dataclasses.replace(tasks[-1], until_s=0.0, path="nowhere")
    assert sample_window(late) == Sampled()


def test_a_share_that_lacks_flight_lines_is_not_taken_for_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sample, "_READ_POINTS", 5_000)
    file, x = tmp_path / "lines.las", np.arange(10_000) % 100
    las = laspy.create(point_format=6)
    # two flight lines over the same square, one after the other
    las.xyz = np.column_stack([np.tile(x, 2), np.tile(np.arange(10_000) // 100, 2), np.zeros(20_000)])
    las.write(file)
    request, plan, paths = planned([file])
    task = sample_tasks(dataclasses.replace(LARGE, points_by_file={paths[0]: 1}), request, plan, paths, 1)[0]
    assert task.share is not None
    task = dataclasses.replace(task, side_m=20.0)
    seen = sample._seen(task, sample.open_source(file), lambda: 0.0)
    assert seen is not None
    assert seen.read_points == 20_000
    # laid out one after the other, a share is as dense as the file
    las.xyz = np.column_stack([np.arange(20_000) // 100, np.arange(20_000) % 100, np.zeros(20_000)])
    las.write(file)
    seen = sample._seen(
        dataclasses.replace(task, side_m=20.0, density_per_m2=1.0), sample.open_source(file), lambda: 0.0
    )
    assert seen is not None
    assert seen.read_points <= 5_000


def test_a_window_that_takes_too_long_counts_for_nothing(town: Path) -> None:
    ticks = iter([0.0, 0.0, 0.0, 0.0])
    found = sample_window(the_task(town), lambda: next(ticks, 1e9))
    assert found == Sampled()


def test_the_window_lies_within_the_data_and_shrinks_where_it_holds_too_much(
    town: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clouds = list(sample.open_source(town).chunks(10_000))
    for at in (0.0, 0.3, 0.999):
        points, side_m = sample._cut(clouds, at, 100.0)
        assert side_m == 100.0
        assert (points.xyz[:, :2].max(axis=0) - points.xyz[:, :2].min(axis=0)).tolist() == pytest.approx(
            [100.0, 100.0], abs=3.0
        )
    monkeypatch.setattr(sample, "_MOST_POINTS", 10_000)
    points, side_m = sample._cut(clouds, 0.5, 200.0)
    assert side_m < 200.0
    assert len(points) <= 10_000
    assert sample._cut(clouds, 0.5, 1e6)[1] <= 1e6


def test_a_damaged_file_is_refused_and_not_left_out(town: Path, tmp_path: Path) -> None:
    file = tmp_path / "town.laz"
    file.write_bytes(town.read_bytes())
    task = the_task(file)
    content = bytearray(file.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 2000] = bytes(2000)
    file.write_bytes(content)
    with pytest.raises(UnreadableInputError):
        sample_window(task)


@pytest.mark.slow
def test_a_sample_finds_about_as_many_buildings_as_the_run(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("_SAMPLE_S", "_READ_S", "_RUN_S"):
        monkeypatch.setattr(sample, limit, math.inf)  # other work on this machine shall not decide
    request, plan, paths = planned([town])
    truth = run(dataclasses.replace(request, out=str(tmp_path / "out"), resources=SERIAL)).counts["candidates"]
    found = sampled(expected(plan), request, plan, paths, hands=1, executor=SerialExecutor())
    assert found is not None
    assert truth / 1.5 < found.buildings < truth * 1.5
    assert set(found.pace) == {stage for stage, seconds in found.cpu_s().items() if seconds > 0.0}
    assert min(found.pace.values()) > 0.0


def test_a_window_is_written_in_the_units_of_its_crs(town: Path, tmp_path: Path) -> None:
    (cloud,) = sample.open_source(town).chunks()
    feet_unknown = SpatialReference(horizontal_unit_m=0.3048, vertical_unit_m=0.3048)
    given = (("EPSG:2992", "ft"), ("EPSG:2992", "m"), ("EPSG:28992", "us-ft"), ("EPSG:28992", None), (None, None))
    options = [ReadOptions(crs=name, vertical_unit=unit) for name, unit in given]
    for reference in (feet_unknown, *(sample.open_source(town, one).info.reference for one in options)):
        sample._write(tmp_path / "window.ply", cloud, reference)
        again = ReadOptions(crs=reference.wkt)
        (read,) = sample.open_source(tmp_path / "window.ply", again).chunks()
        assert np.abs(read.xyz - cloud.xyz).max() < 1e-4
        for field in ("return_number", "return_count", "classification", "gps_time", "source_id"):
            assert (getattr(read, field) == getattr(cloud, field)).all()


class _Fails:
    """A sample that must not be run."""

    def __call__(self, *_: object, **__: object) -> Expected | None:
        raise AssertionError


def foreseen(town: Path, engine: Engine, resources: Resources, worth_s: float, workers: int = 2) -> forecasts.Forecast:
    request, plan, paths = planned([town])
    request = dataclasses.replace(request, resources=resources)
    return forecast(request, plan, paths, engine=engine, workers=workers, worth_s=worth_s)


def test_a_sample_is_run_only_where_it_is_worth_it(town: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample, "sampled", _Fails())
    monkeypatch.setattr(forecasts, "compiling_s", lambda _groups: 0.0)
    short = foreseen(town, "local", Resources(), WORTH_S)
    assert not short.sampled
    assert short.range_s == pytest.approx((short.total_s / 2.0, short.total_s * 2.0))
    # workers elsewhere are other machines
    assert not foreseen(town, "cluster", Resources(scheduler="tcp://far:8786"), 0.0).sampled
    # a sample would compile what is not compiled
    monkeypatch.setattr(forecasts, "compiling_s", lambda _groups: 30.0)
    cold = foreseen(town, "local", Resources(), 0.0)
    assert not cold.sampled
    assert cold.range_s == pytest.approx((short.range_s[0] + 15.0, short.range_s[1] + 60.0))
    assert foreseen(town, "cluster", Resources(scheduler="tcp://far:8786"), 0.0).cold_s == 0.0


def test_other_methods_and_points_over_models_need_kernels_of_their_own(
    town: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(forecasts, "compiling_s", lambda groups: asked.append(groups) or 0.0)
    request, plan, paths = planned([town])
    general = dataclasses.replace(request.settings.general, method="kmeans", terrain="tin")
    settings = dataclasses.replace(request.settings, general=general)
    for one in (request, dataclasses.replace(request, points=True), dataclasses.replace(request, settings=settings)):
        forecast(one, plan, paths, engine="local", workers=2, worth_s=1e9)
    assert asked == [("reconstruct",), ("reconstruct", "classify"), ("reconstruct", "compare", "terrain")]


def test_what_was_measured_makes_the_range_narrower(town: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecasts, "compiling_s", lambda _groups: 0.0)
    by_rates = foreseen(town, "local", Resources(), 1e9)
    pace = dict.fromkeys(by_rates.work.cpu_s(), 3.0)
    monkeypatch.setattr(sample, "sampled", lambda work, *_, **__: dataclasses.replace(work, pace=pace))
    found = foreseen(town, "local", Resources(), 0.0)
    assert found.sampled
    assert found.total_s - RATES.start_s == pytest.approx(3.0 * (by_rates.total_s - RATES.start_s))
    assert found.range_s == pytest.approx((found.total_s / 1.5, found.total_s * 1.5))
    monkeypatch.setattr(sample, "sampled", lambda *_, **__: None)
    assert foreseen(town, "local", Resources(), 0.0) == by_rates


def test_a_building_that_ends_its_process_leaves_the_rates(town: Path) -> None:
    class Dying(SerialExecutor):
        def map(self, *_: object) -> object:  # type: ignore[override]
            raise RunError("the task killed its process")

    request, plan, paths = planned([town])
    assert sampled(expected(plan), request, plan, paths, hands=1, executor=Dying()) is None


def test_more_workers_than_cores_are_no_faster_and_need_more_memory(
    town: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecasts, "cores", lambda: 2)
    two, four = (foreseen(town, "cluster", Resources(), 1e9, workers) for workers in (2, 4))
    assert two.total_s == four.total_s
    assert four.memory_bytes == pytest.approx(two.memory_bytes + 2 * two.work.process_bytes(alone=False), abs=2)
    far = Resources(scheduler="tcp://far:8786")
    assert foreseen(town, "cluster", far, 1e9, 4).total_s < foreseen(town, "cluster", far, 1e9, 2).total_s


def test_more_processes_and_denser_tiles_need_more_memory(town: Path) -> None:
    serial = foreseen(town, "serial", Resources(workers=0), 1e9)
    local = foreseen(town, "local", Resources(), 1e9)
    cluster = foreseen(town, "cluster", Resources(), 1e9)
    assert serial.process_bytes > local.process_bytes
    assert serial.memory_bytes < local.memory_bytes < cluster.memory_bytes
    plan = make_plan([str(town)], ReadOptions(), RunSettings())
    dense = expected(with_points(plan, 100 * plan.points))
    assert dense.process_bytes(alone=True) > expected(plan).process_bytes(alone=True) + 2**27
