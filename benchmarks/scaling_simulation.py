"""Simulates the engine's task graph with measured times for up to 1,000 workers, to find where it stops scaling.

    python -m benchmarks.scaling_simulation --traces DIR/run.trace.json [more] --costs DIR/engine_costs.json --out DIR
                                            [--buildings 20000 1000000 10000000] [--workers 1 2 8 32 100 300 1000]
                                            [--storage-mb-s 0] [--tile-size 500] [--figure FILE.png]

The traces come from `city_scale.py`, the costs from `engine_costs.py`. A stage's tasks draw their CPU times from those
of the first trace, with the same number per building. The simulation keeps the engine's order (largest first), its
window of tasks in flight, its barriers between stages and its steps in the driver. Driver, scheduler and storage each
serve one request after the other. A task costs the driver its CPU time per task in that stage of the first trace (keys,
packing, submission, result; at least that of a task that does nothing), and the scheduler an assignment and a
completion. A byte of a result passes through both, and a byte of scratch takes its share of the bandwidth;
`--storage-mb-s 0` means no limit.

Every trace is also replayed: its own tasks with their measured wall-clock times on the same number of workers. The
reported error is the difference between the simulated and the measured wall-clock time.
"""

from __future__ import annotations

import argparse
import dataclasses
import heapq
import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.city_scale import is_mark
from benchmarks.entries import markdown_table
from pipeline.model import FloatArray
from pipeline.runtime.cluster.dispatch import TASKS_PER_THREAD
from pipeline.runtime.scratch.folder import POINT

_SEED = 20
_HALO_M = 41.5
"""Halo of a split; `SceneSettings.split_support_m`."""
STAGES = ("ingest", "cells", "ground", "split", "join", "outline", "reconstruct", "publish")
GROUPED = frozenset({"ingest", "join", "outline", "reconstruct"})
REQUIRED = 0.80
_LARGE = 5_000_000
"""Cities with more buildings are simulated with the larger numbers of workers only: a minute each."""
_LARGE_WORKERS = 100


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stage:
    """A step of the driver, then a map over tasks."""

    name: str
    before_s: float
    """What the driver does alone before the first task."""
    durations_s: FloatArray
    """(n,) of the tasks, in the order in which they are sent off."""
    driver_s: float = 0.0
    """What a task costs the driver: packing, submission, result."""
    scheduler_s: float = 0.0
    """What a task costs the scheduler."""
    result_bytes: float = 0.0
    """Bytes of a task's result."""
    stored_bytes: float = 0.0
    """What a task reads and writes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Machine:
    """What the stages run on."""

    workers: int
    """Number of workers, each with one thread."""
    byte_s: float = 0.0
    """What a byte of a result costs scheduler and driver, each."""
    worker_s: float = 0.0
    """Between two tasks of one worker."""
    storage_bytes_s: float = math.inf
    """Bandwidth of the storage that all share."""
    tasks_a_thread: int = TASKS_PER_THREAD
    """The window of tasks in flight."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of a simulation."""

    wall_s: float
    busy_s: float
    """Tasks' own time, of all workers."""
    stages_s: Mapping[str, float]
    """Wall of each stage, its step in the driver included."""
    driver_s: float
    """How long the driver was at work."""
    scheduler_s: float
    """How long the scheduler was at work."""
    workers: int

    @property
    def efficiency(self) -> float:
        """Tasks' own time over wall times workers."""
        return self.busy_s / (self.wall_s * self.workers)


class _Server:
    """Serves one after the other."""

    def __init__(self, free_s: float) -> None:
        self.free_s = free_s
        self.worked_s = 0.0

    def serve(self, now_s: float, cost_s: float) -> float:
        """When a request that comes now is done."""
        self.free_s = max(now_s, self.free_s) + cost_s
        self.worked_s += cost_s
        return self.free_s


_SENT, _READY, _DONE, _TOLD, _LANDED = range(5)


def run_stage(stage: Stage, machine: Machine, began_s: float) -> tuple[float, float, float]:
    """Simulate one stage: when its last result was in the driver, and what driver and scheduler worked."""
    now_s = began_s + stage.before_s
    count = len(stage.durations_s)
    driver, scheduler, storage = _Server(now_s), _Server(now_s), _Server(now_s)
    storing_s = 0.0 if math.isinf(machine.storage_bytes_s) else stage.stored_bytes / machine.storage_bytes_s
    carrying_s = machine.byte_s * stage.result_bytes
    events: list[tuple[float, int, int]] = []
    number = sent = started = ready = landed = 0
    idle = machine.workers

    def tell(at_s: float, kind: int) -> None:
        nonlocal number
        number += 1
        heapq.heappush(events, (at_s, number, kind))

    def send() -> None:
        nonlocal sent
        if sent < count:
            sent += 1
            tell(driver.serve(now_s, 0.5 * stage.driver_s), _SENT)

    def start() -> None:
        nonlocal started
        read_s = storage.serve(now_s, storing_s) if storing_s else now_s
        tell(read_s + float(stage.durations_s[started]) + machine.worker_s, _DONE)
        started += 1

    for _ in range(machine.tasks_a_thread * max(2, machine.workers)):
        send()
    while events:
        now_s, _, kind = heapq.heappop(events)
        if kind == _SENT:
            tell(scheduler.serve(now_s, 0.5 * stage.scheduler_s), _READY)
        elif kind == _READY:
            if idle:
                idle -= 1
                start()
            else:
                ready += 1
        elif kind == _DONE:
            if ready:
                ready -= 1
                start()
            else:
                idle += 1
            tell(scheduler.serve(now_s, 0.5 * stage.scheduler_s + carrying_s), _TOLD)
        elif kind == _TOLD:
            tell(driver.serve(now_s, 0.5 * stage.driver_s + carrying_s), _LANDED)
        else:
            landed += 1
            send()
    if landed != count:
        raise RuntimeError(f"{landed} of {count} tasks of {stage.name} came back")
    return now_s, stage.before_s + driver.worked_s, scheduler.worked_s


def simulate(stages: Sequence[Stage], machine: Machine) -> Outcome:
    """All stages, one after the other."""
    now_s, driver_s, scheduler_s = 0.0, 0.0, 0.0
    walls: dict[str, float] = {}
    for stage in stages:
        ended_s, by_driver, by_scheduler = run_stage(stage, machine, now_s)
        walls[stage.name] = walls.get(stage.name, 0.0) + ended_s - now_s
        now_s, driver_s, scheduler_s = ended_s, driver_s + by_driver, scheduler_s + by_scheduler
    return Outcome(
        wall_s=now_s,
        busy_s=float(sum(stage.durations_s.sum() for stage in stages)),
        stages_s=walls,
        driver_s=driver_s,
        scheduler_s=scheduler_s,
        workers=machine.workers,
    )


# ------------------------------------------------------------------------------------------------- from what was seen


def own_times(trace: Mapping[str, Any], name: str) -> dict[str, FloatArray]:
    """CPU or wall-clock times (`cpu_s`, `seconds`) of a trace's tasks by stage, in the order in which they began."""
    tasks = sorted(trace["tasks"], key=lambda task: task["began_s"])
    return {stage: np.array([t[name] for t in tasks if t["stage"] == stage]) for stage in STAGES}


def marks(trace: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """When each stage began and ended; those of the driver alone, too."""
    lines = [line for line in trace["diary"] if is_mark(line)]
    times = [(line["stage"] or "end", line["at_s"]) for line in lines]
    found = {name: (at_s, after_s) for (name, at_s), (_, after_s) in itertools.pairwise(times)}
    return {"plan": found["plan"], **{name: found[name] for name in STAGES if name in found}}


def replayed(trace: Mapping[str, Any]) -> tuple[float, float]:
    """The wall that the simulation gives to a trace's own tasks, and the wall that they took; plan and end left out.

    Tasks take the wall-clock times that they took; what the driver does alone before a stage's first task and behind
    its last result is taken as it was.
    """
    times, when = own_times(trace, "seconds"), marks(trace)
    gaps = []
    stages = []
    for name in STAGES:
        own = sorted((t for t in trace["tasks"] if t["stage"] == name), key=lambda t: t["began_s"])
        before_s = max(0.0, own[0]["began_s"] - when[name][0]) if own else when[name][1] - when[name][0]
        behind_s = max(0.0, when[name][1] - max(t["back_s"] for t in own)) if own else 0.0
        stages.append(Stage(name=name, before_s=before_s, durations_s=times[name]))
        stages.append(Stage(name=name, before_s=behind_s, durations_s=np.empty(0)))
        for process in {t["process"] for t in own}:
            done = [t for t in own if t["process"] == process]
            gaps += [b["began_s"] - a["began_s"] - a["seconds"] for a, b in itertools.pairwise(done)]
    machine = Machine(workers=trace["workers"], worker_s=float(np.median(gaps)))
    measured_s = when["publish"][1] - when["ingest"][0]
    return simulate(stages, machine).wall_s, measured_s


@dataclasses.dataclass(frozen=True, kw_only=True)
class Engine:
    """What was measured of the engine, a building or a task."""

    times: Mapping[str, FloatArray]
    """CPU seconds of tasks, by stage."""
    buildings: int
    """Number of buildings in the trace."""
    files: int
    points: int
    tiles: int
    plan_s: float
    """The driver's seconds per file."""
    join_s: float
    """Driver seconds per building from the end of the splits to the first task of the join. `engine_costs.py` measures
    that it grows no faster than the city."""
    digest_s: float
    """The driver's seconds per building: digest, sums and the removal of scratch at the end."""
    driver_s: Mapping[str, float]
    """The driver's seconds per task, by stage."""
    scheduler_s: float
    """The scheduler's seconds per task."""
    byte_s: float
    """Seconds per byte of a result, for either."""
    result_bytes: Mapping[str, float]
    """By stage."""
    start_s: float
    """From the start of the workers to the first task."""
    tile_m: float
    """Side of a tile."""


def measured_engine(trace: Mapping[str, Any], costs: Mapping[str, Any], tile_m: float) -> Engine:
    """The engine as a trace and the costs tell it."""
    counts = trace["summary"]["counts"]
    times = own_times(trace, "cpu_s")
    small = [row for row in costs["tasks"] if row["result_bytes"] < 100_000]
    large = max(costs["tasks"], key=lambda row: row["result_bytes"])
    scheduler_s = float(np.median([row["scheduler_s"] for row in small]))
    driver_s = float(np.median([row["driver_s"] for row in small]))
    beyond_s = max(0.0, large["scheduler_s"] - scheduler_s) + max(0.0, large["driver_s"] - driver_s)
    lines = {line["stage"]: line for line in trace["diary"] if line["kind"] == "stage"}
    files = len(times["ingest"])
    results = {
        stage: float(np.mean([s["bytes"] for s in trace["sizes"] if s["stage"] == stage and s["what"] == "result"]))
        for stage in STAGES
    }
    # CPU time, since others may have used the machine: from the last tile's result to the end
    reported = {(line["kind"], line["stage"]): line["cpu_s"] for line in trace["diary"]}
    ending_s = reported["finished", ""] - reported["progress", "publish"]
    return Engine(
        times=times,
        buildings=counts["candidates"],
        files=files,
        points=counts["points"],
        tiles=counts["tiles"],
        # its CPU time up to the first task, but for what it took to start
        plan_s=max(0.0, lines["ingest"]["cpu_s"] - trace["diary"][0]["cpu_s"]) / files,
        join_s=_alone_s(trace, "join") / counts["candidates"],
        digest_s=ending_s / counts["candidates"],
        driver_s=_driver_costs(trace, costs, driver_s, scheduler_s),
        scheduler_s=scheduler_s,
        byte_s=beyond_s / 2.0 / large["result_bytes"],
        result_bytes=results,
        start_s=2.0,
        tile_m=tile_m,
    )


def _alone_s(trace: Mapping[str, Any], stage: str) -> float:
    """Seconds that the driver works alone before a stage's first task."""
    first_s = min((task["began_s"] for task in trace["tasks"] if task["stage"] == stage), default=0.0)
    return max(0.0, first_s - marks(trace)[stage][0])


def _driver_costs(
    trace: Mapping[str, Any], costs: Mapping[str, Any], min_s: float, scheduler_s: float
) -> dict[str, float]:
    """What a task of each stage costs the driver, from its CPU time in that stage.

    The trace's driver holds the scheduler, too: its tasks, and what it takes with nothing to do, are taken away, and of
    the join what the driver does alone.
    """
    tasks = own_times(trace, "cpu_s")
    lines = [line for line in trace["diary"] if is_mark(line)]
    idle = costs["tasks"][0]["scheduler_idle_share"]
    found = dict.fromkeys(STAGES, min_s)
    # what comes behind the last result is the digest's
    last = {line["stage"]: line for line in trace["diary"] if line["kind"] == "progress"}
    for line, after in itertools.pairwise(lines):
        count = len(tasks.get(line["stage"], ()))
        after = last.get(line["stage"], after) if line["stage"] == "publish" else after  # noqa: PLW2901
        if count:
            own_s = after["cpu_s"] - line["cpu_s"] - idle * (after["at_s"] - line["at_s"])
            if line["stage"] == "join":
                own_s -= _alone_s(trace, "join")
            found[line["stage"]] = max(min_s, own_s / count - scheduler_s)
    return found


@dataclasses.dataclass(frozen=True, kw_only=True)
class Change:
    """What is done otherwise; as the engine is by default."""

    joined_in_driver: float = 1.0
    """Share of the join that stays in the driver; the rest is tasks of 64 tiles."""
    digest_in_driver: float = 1.0
    """Share of the digest that stays in the driver."""
    plan_in_driver: float = 1.0
    """Share of the look at the inputs that stays in the driver."""
    tasks_a_batch: float = 1.0
    """So many tasks become one, but those of whole tiles: input files, units, outlines, batches of buildings."""
    drivers: int = 1
    """Runs side by side, each with a scheduler and a share of the workers."""
    tasks_a_thread: int = TASKS_PER_THREAD
    """Window of tasks in flight."""


def city_stages(engine: Engine, buildings: int, change: Change, seed: int = _SEED) -> list[Stage]:
    """The stages of a run over a city of so many buildings."""
    random = np.random.default_rng(seed)
    factor = buildings / engine.buildings
    points_a_file, points_a_tile = engine.points / engine.files, engine.points / engine.tiles
    window = (1.0 + 2.0 * _HALO_M / engine.tile_m) ** 2
    stored = {
        "ingest": POINT.itemsize * points_a_file * 1.15 * change.tasks_a_batch,
        "cells": POINT.itemsize * points_a_tile,
        "split": POINT.itemsize * points_a_tile * (window + 0.3),
        "reconstruct": POINT.itemsize * 20_000 * 1.5 * change.tasks_a_batch,
    }
    joining_s = engine.join_s * buildings
    n_files, n_tiles = max(1, round(engine.files * factor)), max(1, round(engine.tiles * factor))
    before = {
        "ingest": engine.start_s + engine.plan_s * n_files * change.plan_in_driver,
        "join": joining_s * change.joined_in_driver,
    }
    stages = []
    for name in STAGES:
        seen = engine.times[name]
        count = max(1, round(len(seen) * factor))
        durations = random.choice(seen, count)
        if name in GROUPED and change.tasks_a_batch != 1.0:
            count = max(1, round(count / change.tasks_a_batch))
            durations = np.array([part.sum() for part in np.array_split(durations, count)])
        if name in {"cells", "split", "reconstruct"}:
            durations = np.sort(durations)[::-1]
        in_tasks = {"join": (1.0 - change.joined_in_driver) * joining_s, "ingest": 0.0}.get(name, 0.0)
        if name == "ingest":
            in_tasks = engine.plan_s * n_files * (1.0 - change.plan_in_driver)
        if name == "publish":
            in_tasks = engine.digest_s * buildings * (1.0 - change.digest_in_driver)
        if in_tasks and name == "join":
            regions = max(1, n_tiles // 64)
            durations = np.concatenate((np.full(regions, in_tasks / regions), durations))
        elif in_tasks:
            durations = durations + in_tasks / count
        stages.append(
            Stage(
                name=name,
                before_s=before.get(name, 0.0),
                durations_s=durations,
                driver_s=engine.driver_s[name],
                scheduler_s=engine.scheduler_s,
                result_bytes=engine.result_bytes[name],
                stored_bytes=stored.get(name, 0.0),
            )
        )
    digest_s = engine.digest_s * buildings * change.digest_in_driver
    return [*stages, Stage(name="digest", before_s=digest_s, durations_s=np.empty(0))]


def city_run(engine: Engine, buildings: int, workers: int, change: Change, storage_bytes_s: float) -> Outcome:
    """A run over a city; of several drivers one is simulated, with its share of all."""
    share = change.drivers
    machine = Machine(
        workers=max(1, workers // share),
        byte_s=engine.byte_s,
        worker_s=0.002,
        storage_bytes_s=storage_bytes_s / share,
        tasks_a_thread=change.tasks_a_thread,
    )
    return simulate(city_stages(engine, max(1, buildings // share), change), machine)


REGIONS = Change(joined_in_driver=0.05)
"""Regions of 64 tiles joined in tasks."""
ALL = dataclasses.replace(REGIONS, digest_in_driver=0.02, plan_in_driver=0.05, tasks_a_batch=4.0)
PLAIN, CHANGED = "as it is", "with all changes"
CHANGES: Mapping[str, Change] = {
    "as it is": Change(),
    "window twice as large": Change(tasks_a_thread=2 * TASKS_PER_THREAD),
    "tasks four times larger": Change(tasks_a_batch=4.0),
    "join by regions, in tasks": REGIONS,
    "digest by tile": Change(digest_in_driver=0.02),
    "inputs looked at in tasks": Change(plan_in_driver=0.05),
    "all of these but the window": ALL,
    "the same, four runs side by side": dataclasses.replace(ALL, drivers=4),
}
"""What moves the point where it stops scaling."""


def scaling_rows(
    engine: Engine, buildings: int, workers: Sequence[int], change: Change, storage_bytes_s: float
) -> list[Outcome]:
    """A city on more and more workers."""
    return [city_run(engine, buildings, count, change, storage_bytes_s) for count in workers]


def curves(engine: Engine, wanted: argparse.Namespace) -> dict[tuple[int, str], list[Outcome]]:
    """Cities on more and more workers, as the engine is and with all changes."""
    storage = wanted.storage_mb_s * 1e6 if wanted.storage_mb_s else math.inf
    found = {}
    for buildings in wanted.buildings:
        workers = [n for n in wanted.workers if buildings < _LARGE or n >= _LARGE_WORKERS]
        for label, change in ((PLAIN, Change()), (CHANGED, ALL)):
            found[buildings, label] = scaling_rows(engine, buildings, workers, change, storage)
    return found


def max_workers(run_with: Callable[[int], Outcome], least: float, limit: int) -> int:
    """The largest number of workers, up to a limit, at which the efficiency is still as large as wanted; by halves."""
    low, high = 0, limit
    while high - low > max(1, low // 20):
        middle = (low + high + 1) // 2
        low, high = (middle, high) if run_with(middle).efficiency >= least else (low, middle - 1)
    return low


def outcome_cells(found: Outcome) -> list[str]:
    """Wall, efficiency, and how busy driver and scheduler were."""
    shares = found.efficiency, found.driver_s / found.wall_s, found.scheduler_s / found.wall_s
    return [f"{found.wall_s / 60:.1f}", *(f"{share:.2f}" for share in shares)]


def changes_table(engine: Engine, buildings: int, workers: int, storage_bytes_s: float) -> str:
    """What each change gives."""
    rows = []
    for label, change in CHANGES.items():
        found = city_run(engine, buildings, workers, change, storage_bytes_s)

        def run_with(count: int, change: Change = change) -> Outcome:
            return city_run(engine, buildings, max(count, change.drivers), change, storage_bytes_s)

        most = str(max_workers(run_with, REQUIRED, 1000))
        rows.append([label, *outcome_cells(found), most])
    return markdown_table(
        ["change", "wall, min", "efficiency", "driver at work", "scheduler at work", "workers at which it is 0.8"],
        rows,
    )


def curve_table(buildings: int, found: Sequence[Outcome]) -> str:
    """A city on more and more workers."""
    rows = []
    for one in found:
        slowest = sorted(one.stages_s.items(), key=lambda item: -item[1])[:3]
        slow = ", ".join(f"{name} {seconds / one.wall_s:.0%}" for name, seconds in slowest)
        cells = outcome_cells(one)
        rows.append([str(one.workers), cells[0], f"{buildings / one.wall_s:.0f}", *cells[1:], slow])
    heads = ["workers", "wall, min", "buildings per second", "efficiency", "driver at work", "scheduler at work"]
    return markdown_table([*heads, "stages that take most"], rows)


def tables(
    engine: Engine,
    wanted: argparse.Namespace,
    replays: Sequence[tuple[str, int, float, float]],
    found: Mapping[tuple[int, str], Sequence[Outcome]],
) -> str:
    """The whole report."""
    storage = wanted.storage_mb_s * 1e6 if wanted.storage_mb_s else math.inf
    rows = [[name, str(n), f"{a:.1f}", f"{b:.1f}", f"{100 * (a / b - 1):+.1f} %"] for name, n, a, b in replays]
    parts = ["## Replayed\n", markdown_table(["trace", "workers", "simulated, s", "measured, s", "error"], rows)]
    for (buildings, label), outcomes in found.items():
        parts += [f"\n## {buildings} buildings, {label}\n", curve_table(buildings, outcomes)]
    middle, most = wanted.buildings[len(wanted.buildings) // 2], wanted.workers[-1]
    parts.append(f"\n## What moves it: {middle} buildings, {most} workers\n")
    parts.append(changes_table(engine, middle, most, storage))
    parts.append(f"\n## A limit of the storage: {middle} buildings, {most} workers, {CHANGED}\n")
    rows = []
    for mb_s in (math.inf, 10_000.0, 3_000.0, 1_000.0, 300.0):
        limited = city_run(engine, middle, most, ALL, mb_s * 1e6)
        rows.append(["none" if math.isinf(mb_s) else f"{mb_s:g}", *outcome_cells(limited)[:2]])
    parts.append(markdown_table(["MB per second", "wall, min", "efficiency"], rows))
    return "\n".join(parts)


def draw(found: Mapping[tuple[int, str], Sequence[Outcome]], path: Path) -> None:
    """Efficiency by workers, as it is and with all changes."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6.4, 3.8), dpi=120)
    cities = list(dict.fromkeys(buildings for buildings, _ in found))
    for (buildings, label), outcomes in found.items():
        axis.plot(
            [one.workers for one in outcomes],
            [one.efficiency for one in outcomes],
            "-" if label == PLAIN else "--",
            color=f"C{cities.index(buildings)}",
            marker="o",
            markersize=3,
            label=f"{buildings:,} buildings, {label}",
        )
    axis.axhline(REQUIRED, color="0.6", linewidth=0.8)
    axis.set_xscale("log")
    axis.set_ylim(0.0, 1.0)
    axis.set_xlabel("workers")
    axis.set_ylabel("efficiency (simulated)")
    axis.legend(fontsize=7)
    axis.grid(visible=True, alpha=0.3)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--traces", type=Path, nargs="+", required=True)
    parser.add_argument("--costs", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--buildings", type=int, nargs="+", default=[20_000, 1_000_000, 10_000_000])
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 8, 32, 100, 300, 1000])
    parser.add_argument("--storage-mb-s", type=float, default=0.0)
    parser.add_argument("--tile-size", type=float, default=500.0, help="of the first trace's lattice")
    parser.add_argument("--figure", type=Path)
    wanted = parser.parse_args(arguments)
    traces = {path.name.split(".")[0]: json.loads(path.read_text(encoding="utf-8")) for path in wanted.traces}
    replays = [(name, trace["workers"], *replayed(trace)) for name, trace in traces.items()]
    costs = json.loads(wanted.costs.read_text(encoding="utf-8"))
    engine = measured_engine(next(iter(traces.values())), costs, wanted.tile_size)
    found = curves(engine, wanted)
    text = tables(engine, wanted, replays, found)
    wanted.out.mkdir(parents=True, exist_ok=True)
    (wanted.out / "scaling.md").write_text(text + "\n", encoding="utf-8")
    if wanted.figure is not None:
        draw(found, wanted.figure)
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
