"""The simulation of the task graph: limits that can be reckoned by hand, and traces that it gives again."""

import dataclasses

import numpy as np
import pytest

from benchmarks.scaling_simulation import (
    STAGES,
    Engine,
    Machine,
    Stage,
    city_run,
    city_stages,
    replayed,
    run_stage,
    simulate,
)


def stage(count: int, seconds: float = 1.0, **other: float) -> Stage:
    return Stage(name="split", before_s=0.0, durations_s=np.full(count, seconds), **other)


def test_tasks_that_cost_nothing_else_fill_all_workers() -> None:
    found = simulate([stage(100)], Machine(workers=10))
    assert found.wall_s == pytest.approx(10.0)
    assert found.efficiency == pytest.approx(1.0)


def test_the_longest_first_is_kept() -> None:
    times = np.array([5.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    for durations_s, expected in ((times, 5.0), (times[::-1], 7.0)):
        split = Stage(name="split", before_s=0.0, durations_s=durations_s)
        assert run_stage(split, Machine(workers=2), 0.0)[0] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("tasks", "machine", "wall_s", "driver_s"),
    [
        (stage(2000, 0.01, driver_s=0.01), Machine(workers=10), 20.0, 20.0),
        (stage(2000, 0.01, driver_s=0.01), Machine(workers=1000), 20.0, 20.0),
        (stage(2000, 0.01, scheduler_s=0.02), Machine(workers=1000), 40.0, 0.0),
        (stage(500, 0.01, result_bytes=1e6), Machine(workers=100, byte_s=2e-8), 10.0, 10.0),
    ],
    ids=["driver of few", "driver of many", "scheduler", "bytes of results"],
)
def test_the_scarcest_part_bounds_the_rate(tasks: Stage, machine: Machine, wall_s: float, driver_s: float) -> None:
    found = simulate([tasks], dataclasses.replace(machine, together_s=0.0))
    assert found.wall_s == pytest.approx(wall_s, rel=0.05)
    assert found.driver_s == pytest.approx(driver_s)


def test_a_barrier_waits_for_the_last_task() -> None:
    uneven = Stage(name="split", before_s=0.0, durations_s=np.array([3.0, 1.0]))
    found = simulate([uneven, uneven], Machine(workers=2))
    assert found.wall_s == pytest.approx(6.0)
    assert found.stages_s["split"] == pytest.approx(6.0)


def test_a_window_smaller_than_the_workers_leaves_some_idle() -> None:
    full = simulate([stage(400, 1.0, driver_s=0.02)], Machine(workers=40, tasks_a_thread=3))
    scant = simulate([stage(400, 1.0, driver_s=0.02)], Machine(workers=40, tasks_a_thread=1))
    assert scant.wall_s > 1.01 * full.wall_s


def test_short_tasks_travel_together_and_cost_fewer_messages() -> None:
    tasks = stage(4000, 0.01, driver_s=0.01)
    alone = simulate([tasks], Machine(workers=20, together_s=0.0))
    together = simulate([tasks], Machine(workers=20))
    assert alone.wall_s == pytest.approx(40.0, rel=0.05)
    assert together.wall_s < 0.25 * alone.wall_s
    assert together.driver_s < 0.25 * alone.driver_s
    assert together.busy_s == pytest.approx(alone.busy_s)


def engine() -> Engine:
    rng = np.random.default_rng(4)
    return Engine(
        times={name: rng.uniform(0.5, 1.5, 60) for name in STAGES},
        buildings=2000,
        files=0.03,
        look_s=0.01,
        tasks=dict.fromkeys(STAGES, 0.02),
        before_s=dict.fromkeys(STAGES, 2e-6),
        task_s=dict.fromkeys(STAGES, 1e-4),
        after_s=1e-6,
        digest_s=1e-7,
        message_s=1e-3,
        scheduler_s=1e-3,
        byte_s=1e-9,
        result_bytes=dict.fromkeys(STAGES, 1000.0),
        start_s=1.0,
    )


def test_a_city_ten_times_as_large_has_ten_times_the_tasks_and_the_work() -> None:
    small, large = (city_stages(engine(), n) for n in (2000, 20_000))
    for a, b in zip(small[1:-2], large[1:-2], strict=True):
        assert len(b.durations_s) == 10 * len(a.durations_s) == 400
        assert b.durations_s.sum() == pytest.approx(10 * a.durations_s.sum(), rel=0.1)
        assert b.before_s == pytest.approx(10 * a.before_s)


def test_every_file_is_looked_at_and_every_building_hashed() -> None:
    look, *_, digest, _ = city_stages(engine(), 20_000)
    assert look.durations_s.sum() == pytest.approx(20_000 * 0.03 * 0.01)
    assert digest.durations_s.tolist() == [20_000 * 1e-7]


def test_efficiency_falls_with_workers() -> None:
    found = [city_run(engine(), 50_000, n).efficiency for n in (2, 50, 500)]
    assert found == sorted(found, reverse=True)
    assert all(0.0 < value <= 1.0 for value in found)


def test_a_trace_is_given_again() -> None:
    def task(stage: str, process: str, began_s: float, seconds: float) -> dict[str, object]:
        back = {"back_s": began_s + seconds}
        return {"stage": stage, "process": process, "began_s": began_s, "seconds": seconds, "cpu_s": seconds, **back}

    diary = [{"kind": "run", "stage": "plan", "at_s": 0.0, "cpu_s": 0.0}]
    tasks = []
    for k, name in enumerate(STAGES[:-1]):
        start = 5.0 + 10.0 * k
        diary.append({"kind": "stage", "stage": name, "at_s": start, "cpu_s": 0.0})
        tasks += [
            task(name, "a", start + 1.0, 4.0),
            task(name, "a", start + 5.0, 4.0),
            task(name, "b", start + 1.0, 9.0),
        ]
    diary.append({"kind": "finished", "stage": "", "at_s": 5.0 + 10.0 * len(STAGES[:-1]), "cpu_s": 0.0})
    simulated, measured = replayed({"workers": 2, "diary": diary, "tasks": tasks})
    assert measured == pytest.approx(10.0 * len(STAGES[:-1]))
    assert simulated == pytest.approx(10.0 * len(STAGES[:-1]))
