"""What the driver of a large run does and holds: its processor time by stage, and its memory, by number of buildings.

    python -m benchmarks.driver_scale --out DIR --city DIR/city100 [--buildings 100000 1000000 2000000]

The driver is that of a run; its tasks are not. A small city is run once for real, and every task's brief is kept. A
large city is that one, laid side by side many times: each of its tasks gives the brief of the task that it copies, with
tiles farther east, and leaves nothing in scratch. The driver packs each task as for a cluster and unpacks each brief;
it has no connection to any cluster, whose cost per message `engine_costs.py` measures. Files are not opened either:
what a look at one of them costs is measured in the small city.

It writes DIR/driver_scale.json, which `scaling_simulation.py` reads, and DIR/driver_scale.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import io
import json
import math
import multiprocessing
import pickle
import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks.entries import markdown_table
from pipeline.io import ReadOptions
from pipeline.runtime import run as run_module
from pipeline.runtime.cluster.local_executor import LocalExecutor
from pipeline.runtime.cluster.packed_tasks import pack_tasks
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.monitoring.measurement import Measured, Result, Task, peak_of_process
from pipeline.runtime.monitoring.progress import Event, Watch, ignore
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run
from pipeline.runtime.run_plan import Plan, make_plan, tiles_per_block
from pipeline.runtime.scratch.outcomes import OutcomeTask, StoredOutcome
from pipeline.runtime.stages import divided_units as units
from pipeline.runtime.stages import join, stored_sites, touching
from pipeline.runtime.stages.join import JoinBrief
from pipeline.settings import RunSettings
from pipeline.tiling import MM, Tile

_UNIT = re.compile(r"(.*)x(-?\d+)_y(-?\d+)")
_ACROSS = 8
"""Tiles across a block of the join, which no copy of the city may share with another."""
_PATH = "#"
"""Between the path of a file and the number of its copy."""
_LAST = "blocks"
"""Unit of the join between all blocks."""
_shift = [0]
"""Columns by which the tiles of a brief are moved as it is read."""


def tile_at(column: int, row: int) -> Tile:
    """A tile of a brief that is read."""
    return Tile(column + _shift[0], row)


class BriefPickler(pickle.Pickler):
    """Writes tiles so that they can be moved as they are read."""

    def reducer_override(self, value: Any) -> Any:
        """How a tile is written; all else as usual."""
        return (tile_at, (value.column, value.row)) if isinstance(value, Tile) else NotImplemented


def written(brief: object) -> bytes:
    """A brief whose tiles can be moved."""
    stream = io.BytesIO()
    BriefPickler(stream, protocol=pickle.HIGHEST_PROTOCOL).dump(brief)
    return stream.getvalue()


def moved(stored: bytes, columns: int) -> Any:
    """A brief with its tiles so many columns farther east."""
    _shift[0] = columns
    return pickle.loads(stored)


def name_of(work: OutcomeTask[Any, Any, Any], unit: str) -> tuple[str, ...]:
    """A name for a task that does not depend on keys."""
    task = work.task
    stage = work.place.stage.partition("-")[0]
    if stage == "ingest":
        return stage, Path(task.path.partition(_PATH)[0]).name, str(task.share)
    more = {"units": lambda: str(task.share), "models": lambda: task.group.figures.digest}
    return stage, unit, more[stage]() if stage in more else ""


class Recorder(LocalExecutor):
    """Runs tasks in children, and keeps their briefs."""

    def __init__(self) -> None:
        super().__init__(2)
        self.briefs: dict[tuple[str, ...], bytes] = {}

    def map(
        self, stage: str, function: Callable[[Task], Result], tasks: Sequence[Task], watch: Watch
    ) -> Generator[Measured[Result], None, None]:
        """As the inner one."""
        names = {work.place: name_of(work, work.place.unit) for work in tasks if isinstance(work, OutcomeTask)}
        for measured in super().map(stage, function, tasks, watch):
            found = measured.result
            if isinstance(found, StoredOutcome):
                self.briefs[names[found.place]] = written(found.brief)
            yield measured


class Copier(SerialExecutor):
    """Gives each task the brief of the one that it copies.

    `briefs` are those of the small city, whose first column of tiles is `first`; its copies lie `stride` columns apart.
    A block of the ground is `block` tiles across; the stride is even.
    """

    def __init__(
        self, briefs: Mapping[tuple[str, ...], bytes], first: int, stride: int, copies: int, block: int
    ) -> None:
        self._briefs, self._first, self._stride, self._copies = briefs, first, stride, copies
        self._across = {"ground": block, "join": _ACROSS, touching.STAGE: touching.ACROSS}
        self.before_s: dict[str, float] = {}
        """Processor time from the end of the stage before to the first task, by stage: nothing runs then."""
        self.during_s: dict[str, float] = {}
        """Processor time from there to the last result."""
        self.ended_s = time.process_time()
        self.tasks: Counter[str] = Counter()
        self.task_bytes: Counter[str] = Counter()
        self.brief_bytes: Counter[str] = Counter()

    def map(
        self,
        stage: str,
        function: Callable[[Task], Result],
        tasks: Sequence[Task],
        watch: Watch,  # noqa: ARG002
    ) -> Generator[Measured[Any], None, None]:
        """The results of copies."""
        began_s = time.process_time()
        self.before_s[stage] = self.before_s.get(stage, 0.0) + began_s - self.ended_s
        try:
            for task in tasks:
                self.tasks[stage] += 1
                self.task_bytes[stage] += len(pack_tasks(function, [task]))
                result = self._copied(task, stage) if isinstance(task, OutcomeTask) else "0" * 64
                yield Measured(
                    result=result, seconds=1.0, cpu_s=1.0, began_s=0.0, process="copier:1", peak_bytes=1, tile=None
                )
        finally:
            self.ended_s = time.process_time()
            self.during_s[stage] = self.during_s.get(stage, 0.0) + self.ended_s - began_s

    def _copied(self, work: OutcomeTask[Any, Any, Any], stage: str) -> StoredOutcome[Any]:
        place = work.place
        if stage == "digest":
            return StoredOutcome(place=place, brief=(0, 0, 0))
        copy, unit = 0, place.unit
        if place.stage == "ingest":
            copy = int(work.task.path.rpartition(_PATH)[2])
        elif (found := _UNIT.fullmatch(unit)) is not None:
            across = self._across.get(place.stage, 1)
            column = int(found[2])
            copy = (column - self._first // across) // (self._stride // across)
            unit = f"{found[1]}x{column - copy * (self._stride // across)}_y{found[3]}"
        elif unit == _LAST:
            return StoredOutcome(place=place, brief=self._last_join())
        stored = self._briefs[name_of(work, unit)]
        self.brief_bytes[stage] += len(stored)
        return StoredOutcome(place=place, brief=moved(stored, copy * self._stride))

    def _last_join(self) -> JoinBrief:
        """What the join between all blocks finds: as much for each copy as in the small city."""
        stored = self._briefs["join", _LAST, ""]
        copies = [moved(stored, copy * self._stride) for copy in range(self._copies)]
        return JoinBrief(
            owned=tuple(sites for brief in copies for sites in brief.owned),
            passed_on="",
            small_fragments=sum(brief.small_fragments for brief in copies),
        )


def request_of(out: str, tile_size_m: float) -> RunRequest:
    """The request of both cities; the small one is planned here, the large one is made of it."""
    settings = RunSettings.from_mapping({"classes": "ignore", "tile_size_m": tile_size_m})
    return RunRequest(inputs=("city",), out=out, settings=settings, resources=Resources(workers=2))


def run_with(plan: Plan, request: RunRequest, executor: Any, on_event: Callable[[Event], None] = ignore) -> RunSummary:
    """A run over a plan that is made already."""
    made = plan, [info.path for info in plan.sources]
    with mock.patch.object(run_module, "plan_inputs", return_value=made):
        return run(request, on_event, executor)


def recorded(city: Sequence[str], scale: int, tile_size_m: float) -> tuple[Plan, dict[tuple[str, ...], bytes], int]:
    """The plan of the small city, all briefs of its run with tasks of a large one, and its buildings."""
    recorder = Recorder()
    with tempfile.TemporaryDirectory(prefix="gablework-") as folder:
        request = request_of(str(Path(folder, "run")), tile_size_m)
        plan = make_plan(sorted(city), ReadOptions(), request.settings)
        with (
            mock.patch.object(stored_sites, "_LARGEST_SCALE", scale),
            mock.patch.object(stored_sites, "_GROUPS", 0),
            mock.patch.object(join, "_AT_ONCE", 0),
        ):
            summary = run_with(plan, request, recorder)
    return plan, recorder.briefs, summary.counts["candidates"]


def copied(plan: Plan, copies: int, stride: int) -> Plan:
    """The plan of a city laid side by side so many times."""
    step_m = stride * plan.grid.size_mm / MM
    sources = []
    for copy in range(copies):
        for info in plan.sources:
            x0, y0, z0, x1, y1, z1 = info.bounds_m
            bounds = (x0 + copy * step_m, y0, z0, x1 + copy * step_m, y1, z1)
            # a copy of its own of all that a real plan holds apiece
            own = pickle.loads(pickle.dumps(info))
            path = f"{info.path}{_PATH}{copy}"
            facts = dataclasses.replace(own.facts, crs=info.facts.crs, dimensions=info.facts.dimensions)
            sources.append(dataclasses.replace(own, path=path, bounds_m=bounds, reference=info.reference, facts=facts))
    return dataclasses.replace(plan, sources=tuple(sources), points=copies * plan.points)


def cost_of_driver(
    plan: Plan, briefs: Mapping[tuple[str, ...], bytes], copies: int, scale: int, tile_size_m: float
) -> dict[str, Any]:
    """Processor time and memory of the driver of a city laid side by side; in a process of its own."""
    side_mm = plan.grid.size_mm
    columns = [tile.column for tile in map(Tile.from_key, {key[1] for key in briefs if key[0] == "cells"})]
    block = tiles_per_block(side_mm)
    together = math.lcm(_ACROSS, block)
    # no block holds tiles of two copies, wherever the city lies
    stride = ((max(columns) + 2) // together - min(columns) // together + 1) * together
    large = copied(plan, copies, stride)
    executor = Copier(briefs, min(columns), stride, copies, block)
    before = peak_of_process()[1]
    with tempfile.TemporaryDirectory(prefix="gablework-") as folder:
        request = request_of(str(Path(folder, "run")), tile_size_m)
        with mock.patch.object(units, "scale_of", return_value=scale), mock.patch.object(join, "_AT_ONCE", 0):
            summary = run_with(large, request, executor)
    after_s = time.process_time() - executor.ended_s
    return {
        "buildings": summary.counts["candidates"],
        "files": len(large.sources),
        "tiles": summary.counts["tiles"],
        "scale": scale,
        "before_s": executor.before_s,
        "during_s": executor.during_s,
        "after_s": after_s,
        "tasks": dict(executor.tasks),
        "task_bytes": {stage: executor.task_bytes[stage] / count for stage, count in executor.tasks.items()},
        "brief_bytes": {stage: executor.brief_bytes[stage] / count for stage, count in executor.tasks.items()},
        "peak_bytes": peak_of_process()[1],
        "before_bytes": before,
    }


def look_s(city: Sequence[str], settings: RunSettings) -> float:
    """Seconds of processor time that the plan takes per file."""
    began = time.process_time()
    make_plan(sorted(city), ReadOptions(), settings)
    return (time.process_time() - began) / len(city)


def hash_s() -> float:
    """Seconds of processor time that the digest takes per byte of the hashes that it puts together."""
    content = bytes(2**26)
    began = time.process_time()
    hashlib.sha256(content).digest()
    return (time.process_time() - began) / len(content)


def in_all(row: Mapping[str, Any]) -> float:
    """The driver's processor seconds."""
    return float(sum(row["before_s"].values()) + sum(row["during_s"].values()) + row["after_s"])


def tables(costs: Mapping[str, Any]) -> str:
    """What was measured, as tables."""
    rows = costs["rows"]
    heads = ["buildings", "files", "tiles", "tasks", "processor s", "µs per building", "peak, MB", "bytes per building"]
    lines = [
        [
            *(str(row[name]) for name in ("buildings", "files", "tiles")),
            str(sum(row["tasks"].values())),
            f"{in_all(row):.1f}",
            f"{1e6 * in_all(row) / row['buildings']:.0f}",
            f"{row['peak_bytes'] / 1e6:.0f}",
            f"{(row['peak_bytes'] - row['before_bytes']) / row['buildings']:.0f}",
        ]
        for row in rows
    ]
    first, last, stages = markdown_table(heads, lines), rows[-1], []
    for stage, count in last["tasks"].items():
        before_s, during_s = last["before_s"][stage], last["during_s"][stage]
        sizes = [f"{last[name].get(stage, 0):.0f}" for name in ("task_bytes", "brief_bytes")]
        per_task_ms = f"{1e3 * (before_s + during_s) / count:.2f}"
        stages.append([stage, str(count), f"{before_s:.1f}", f"{during_s:.1f}", per_task_ms, *sizes])
    heads = ["stage", "tasks", "before the first task, s", "while tasks run, s", "ms per task"]
    second = markdown_table([*heads, "task, bytes", "brief, bytes"], stages)
    return f"{first}\nThe largest of them, by stage:\n\n{second}\nA look at a file: {1e3 * costs['look_s']:.1f} ms.\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--city", type=Path, required=True)
    parser.add_argument("--tile-size", type=float, default=500.0)
    parser.add_argument("--buildings", type=int, nargs="+", default=[100_000, 1_000_000, 2_000_000])
    wanted = parser.parse_args(arguments)
    wanted.out.mkdir(parents=True, exist_ok=True)
    city = [str(path) for path in wanted.city.glob("*.laz")]
    rows = []
    known: dict[int, tuple[Plan, dict[tuple[str, ...], bytes], int]] = {}
    fresh = multiprocessing.get_context("spawn")
    for buildings in wanted.buildings:
        scale = stored_sites.scale_of(600 * buildings)
        if scale not in known:
            known[scale] = recorded(city, scale, wanted.tile_size)
        plan, briefs, count = known[scale]
        with fresh.Pool(1) as pool:
            rows.append(pool.apply(cost_of_driver, (plan, briefs, -(-buildings // count), scale, wanted.tile_size)))
        print(rows[-1], flush=True)
    costs = {"rows": rows, "hash_s": hash_s(), "look_s": look_s(city, request_of("", wanted.tile_size).settings)}
    (wanted.out / "driver_scale.json").write_text(json.dumps(costs, indent=1) + "\n", encoding="utf-8")
    text = tables(costs)
    (wanted.out / "driver_scale.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
