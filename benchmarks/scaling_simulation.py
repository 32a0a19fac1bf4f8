"""Simulates the engine's task graph with measured times for up to 1,000 workers, to find where it stops scaling.

    python -m benchmarks.scaling_simulation --traces DIR/run.trace.json [more] --costs DIR/engine_costs.json
                                            --driver DIR/driver_scale.json --out DIR
                                            [--buildings 20000 1000000 10000000] [--workers 1 2 8 32 100 300 1000]

The traces come from `city_scale.py`, the costs from `engine_costs.py` and `driver_scale.py`. A stage's tasks draw their
CPU times from those of the first trace; larger runs have fewer and larger ones, as many as the driver of a large run
had. The simulation keeps the engine's order (largest first), its window of messages in flight, how many tasks travel
together, its barriers between stages and what the driver does alone between them. Driver and scheduler each serve
one request after the other. A task costs the driver what it cost in that stage of a large run, a message what one with
a task that does nothing costs driver and scheduler. A byte of a result passes through both. Storage has no limit.

Every trace is also replayed: its own tasks with their measured wall-clock times on the same number of workers. The
reported error is the difference between the simulated and the measured wall-clock time.
"""

from __future__ import annotations

import argparse
import dataclasses
import heapq
import itertools
import json
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.city_scale import is_mark
from benchmarks.entries import markdown_table
from pipeline.model import FloatArray
from pipeline.runtime.cluster.dispatch import _SHARES, _TOGETHER_S, TASKS_PER_THREAD

_SEED = 20
STAGES = ("ingest", "cells", "ground", "split", "join", "outline", "reconstruct", "publish", "digest")
_HASH_BYTES = 32
_FILES_PER_LOOK = 32
"""Files at which one task looks; `pipeline.runtime.looking`."""
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
    task_s: float = 0.0
    """What a task costs the driver beside its message: it is packed, its brief unpacked."""
    driver_s: float = 0.0
    """What a message costs the driver, there and back."""
    scheduler_s: float = 0.0
    """What a message costs the scheduler."""
    result_bytes: float = 0.0
    """Bytes of a task's result."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Machine:
    """What the stages run on."""

    workers: int
    """Number of workers, each with one thread."""
    byte_s: float = 0.0
    """What a byte of a result costs scheduler and driver, each."""
    worker_s: float = 0.0
    """Between two tasks of one worker."""
    tasks_a_thread: int = TASKS_PER_THREAD
    """The window of messages in flight."""
    together_s: float = _TOGETHER_S
    """Tasks that take so long together travel in one message."""


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
    until = np.concatenate(([0.0], np.cumsum(stage.durations_s)))
    short = int(machine.together_s * count / max(float(until[-1]), 1e-9)) if count else 1
    driver, scheduler = _Server(now_s), _Server(now_s)
    carrying_s = machine.byte_s * stage.result_bytes
    events: list[tuple[float, int, int, tuple[int, int]]] = []
    ready: deque[tuple[int, int]] = deque()
    number = sent = landed = 0
    idle = machine.workers

    def tell(at_s: float, kind: int, tasks: tuple[int, int]) -> None:
        nonlocal number
        number += 1
        heapq.heappush(events, (at_s, number, kind, tasks))

    def send() -> None:
        nonlocal sent
        if sent < count:
            share = (count - sent) // (_SHARES * machine.workers)
            size = max(1, min(share, short)) if landed else 1
            tasks, sent = (sent, sent + size), sent + size
            tell(driver.serve(now_s, 0.5 * (stage.driver_s + size * stage.task_s)), _SENT, tasks)

    def start(tasks: tuple[int, int]) -> None:
        first, last = tasks
        tell(now_s + float(until[last] - until[first]) + machine.worker_s * (last - first), _DONE, tasks)

    for _ in range(machine.tasks_a_thread * max(2, machine.workers)):
        send()
    while events:
        now_s, _, kind, tasks = heapq.heappop(events)
        size = tasks[1] - tasks[0]
        if kind == _SENT:
            tell(scheduler.serve(now_s, 0.5 * stage.scheduler_s), _READY, tasks)
        elif kind == _READY:
            if idle:
                idle -= 1
                start(tasks)
            else:
                ready.append(tasks)
        elif kind == _DONE:
            if ready:
                start(ready.popleft())
            else:
                idle += 1
            tell(scheduler.serve(now_s, 0.5 * stage.scheduler_s + carrying_s * size), _TOLD, tasks)
        elif kind == _TOLD:
            cost_s = 0.5 * (stage.driver_s + size * stage.task_s) + carrying_s * size
            tell(driver.serve(now_s, cost_s), _LANDED, tasks)
        else:
            landed += size
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
    for name in (name for name in STAGES if name in when):
        # the digest has no mark of its own
        names = {name, "digest"} if name == "publish" else {name}
        own = sorted((t for t in trace["tasks"] if t["stage"] in names), key=lambda t: t["began_s"])
        before_s = max(0.0, own[0]["began_s"] - when[name][0]) if own else when[name][1] - when[name][0]
        behind_s = max(0.0, when[name][1] - max(t["back_s"] for t in own)) if own else 0.0
        durations = np.concatenate([times[one] for one in sorted(names, key=STAGES.index)])
        stages.append(Stage(name=name, before_s=before_s, durations_s=durations))
        stages.append(Stage(name=name, before_s=behind_s, durations_s=np.empty(0)))
        for process in {t["process"] for t in own}:
            done = [t for t in own if t["process"] == process]
            gaps += [b["began_s"] - a["began_s"] - a["seconds"] for a, b in itertools.pairwise(done)]
    machine = Machine(workers=trace["workers"], worker_s=float(np.median(gaps)), together_s=0.0)
    measured_s = when["publish"][1] - when["ingest"][0]
    return simulate(stages, machine).wall_s, measured_s


@dataclasses.dataclass(frozen=True, kw_only=True)
class Engine:
    """What was measured of the engine."""

    times: Mapping[str, FloatArray]
    """CPU seconds of tasks, by stage."""
    buildings: int
    """Number of buildings in the trace."""
    files: float
    """Files per building."""
    look_s: float
    """Seconds of a look at a file."""
    tasks: Mapping[str, float]
    """Tasks per building of a large run, by stage."""
    before_s: Mapping[str, float]
    """Driver's seconds per building before the first task of a stage."""
    task_s: Mapping[str, float]
    """Driver's seconds per task, by stage."""
    after_s: float
    """Driver's seconds per building at the end."""
    digest_s: float
    """Seconds per building of the one task that hashes all rows in their order."""
    message_s: float
    """Driver's seconds per message."""
    scheduler_s: float
    """Scheduler's seconds per message."""
    byte_s: float
    """Seconds per byte of a result, for either."""
    result_bytes: Mapping[str, float]
    """By stage."""
    start_s: float
    """From the start of the workers to the first task."""


def measured_engine(trace: Mapping[str, Any], costs: Mapping[str, Any], driver: Mapping[str, Any]) -> Engine:
    """The engine as a trace, the costs of messages and the driver of a large run have it."""
    small = [row for row in costs["tasks"] if row["result_bytes"] < 100_000]
    large = max(costs["tasks"], key=lambda row: row["result_bytes"])
    scheduler_s = float(np.median([row["scheduler_s"] for row in small]))
    message_s = float(np.median([row["driver_s"] for row in small]))
    beyond_s = max(0.0, large["scheduler_s"] - scheduler_s) + max(0.0, large["driver_s"] - message_s)
    row = max(driver["rows"], key=lambda one: one["buildings"])
    counts = trace["summary"]["counts"]
    return Engine(
        times=own_times(trace, "cpu_s"),
        buildings=counts["candidates"],
        files=row["files"] / row["buildings"],
        look_s=driver["look_s"],
        tasks={stage: row["tasks"][stage] / row["buildings"] for stage in STAGES},
        before_s={stage: row["before_s"][stage] / row["buildings"] for stage in STAGES},
        task_s={stage: row["during_s"][stage] / row["tasks"][stage] for stage in STAGES},
        after_s=row["after_s"] / row["buildings"],
        digest_s=driver["hash_s"]
        * _HASH_BYTES
        * (1.0 + (counts["roof_faces"] + counts["rejected"]) / counts["candidates"]),
        message_s=message_s,
        scheduler_s=scheduler_s,
        byte_s=beyond_s / 2.0 / large["result_bytes"],
        result_bytes={
            stage: float(
                np.mean([s["bytes"] for s in trace["sizes"] if s["stage"] == stage and s["what"] == "result"] or [0.0])
            )
            for stage in STAGES
        },
        start_s=2.0,
    )


def city_stages(engine: Engine, buildings: int, seed: int = _SEED) -> list[Stage]:
    """The stages of a run over a city of so many buildings."""
    random = np.random.default_rng(seed)
    files = engine.files * buildings
    looks = max(1, round(files / _FILES_PER_LOOK))
    costs = {"driver_s": engine.message_s, "scheduler_s": engine.scheduler_s}
    look = np.full(looks, files * engine.look_s / looks)
    stages = [Stage(name="plan", before_s=engine.start_s, durations_s=look, **costs)]
    for name in STAGES:
        seen = engine.times[name]
        drawn = random.choice(seen, max(1, round(len(seen) * buildings / engine.buildings)))
        # as many as a large run has, of as much work
        count = max(1, round(engine.tasks[name] * buildings))
        durations = np.array([part.sum() for part in np.array_split(drawn, min(count, len(drawn)))])
        if name in {"cells", "split", "reconstruct"}:
            durations = np.sort(durations)[::-1]
        stages.append(
            Stage(
                name=name,
                before_s=engine.before_s[name] * buildings,
                durations_s=durations,
                task_s=engine.task_s[name],
                result_bytes=engine.result_bytes[name],
                **costs,
            )
        )
    last = Stage(name="digest", before_s=0.0, durations_s=np.array([engine.digest_s * buildings]), **costs)
    return [*stages, last, Stage(name="end", before_s=engine.after_s * buildings, durations_s=np.empty(0))]


def city_run(engine: Engine, buildings: int, workers: int) -> Outcome:
    """A run over a city."""
    return simulate(city_stages(engine, buildings), Machine(workers=workers, byte_s=engine.byte_s, worker_s=0.002))


def curves(engine: Engine, sizes: Sequence[int], workers: Sequence[int]) -> dict[int, list[Outcome]]:
    """Cities of some numbers of buildings on more and more workers."""
    return {
        buildings: [
            city_run(engine, buildings, count) for count in workers if buildings < _LARGE or count >= _LARGE_WORKERS
        ]
        for buildings in sizes
    }


def outcome_cells(found: Outcome) -> list[str]:
    """Wall, efficiency, and how busy driver and scheduler were."""
    shares = found.efficiency, found.driver_s / found.wall_s, found.scheduler_s / found.wall_s
    return [f"{found.wall_s / 60:.1f}", *(f"{share:.2f}" for share in shares)]


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


def tables(replays: Sequence[tuple[str, int, float, float]], found: Mapping[int, Sequence[Outcome]]) -> str:
    """The whole report."""
    rows = [[name, str(n), f"{a:.1f}", f"{b:.1f}", f"{100 * (a / b - 1):+.1f} %"] for name, n, a, b in replays]
    parts = ["## Replayed\n", markdown_table(["trace", "workers", "simulated, s", "measured, s", "error"], rows)]
    for buildings, outcomes in found.items():
        parts += [f"\n## {buildings} buildings\n", curve_table(buildings, outcomes)]
    return "\n".join(parts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--traces", type=Path, nargs="+", required=True)
    parser.add_argument("--costs", type=Path, required=True)
    parser.add_argument("--driver", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--buildings", type=int, nargs="+", default=[20_000, 1_000_000, 10_000_000])
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 8, 32, 100, 300, 1000])
    wanted = parser.parse_args(arguments)
    traces = {path.name.split(".")[0]: json.loads(path.read_text(encoding="utf-8")) for path in wanted.traces}
    replays = [(name, trace["workers"], *replayed(trace)) for name, trace in traces.items()]
    costs = json.loads(wanted.costs.read_text(encoding="utf-8"))
    driver = json.loads(wanted.driver.read_text(encoding="utf-8"))
    engine = measured_engine(next(iter(traces.values())), costs, driver)
    text = tables(replays, curves(engine, wanted.buildings, wanted.workers))
    wanted.out.mkdir(parents=True, exist_ok=True)
    (wanted.out / "scaling.md").write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
