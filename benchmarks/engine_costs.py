"""Costs of scheduler and driver per task, byte of a result and building of the join, by number of workers.

    python -m benchmarks.engine_costs --out DIR [--workers 2 20 100 300] [--tasks 2000] [--city DIR/city36]

A scheduler in a separate process serves the workers, which share one more process (they have nothing to do), and tasks
that do nothing go through `DaskExecutor` like those of a run. It reports the CPU seconds of the scheduler and of the
driver per task, with small results and with large ones. With `--city` the tiles of a city are split, copies of the
results are placed side by side, and the CPU time and the memory of the join are measured; a straight line is fitted to
the logarithms. `scaling_simulation.py` reads DIR/engine_costs.json.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import dataclasses
import gc
import json
import multiprocessing
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.city_scale import free_port, wait_for_listener
from benchmarks.entries import markdown_table
from pipeline.io import ReadOptions
from pipeline.model import IntArray
from pipeline.runtime.cluster.dask_executor import Cluster, DaskExecutor
from pipeline.runtime.engine import executor_for
from pipeline.runtime.monitoring.events import Watch, ignore
from pipeline.runtime.monitoring.progress import Progress
from pipeline.runtime.plan import Plan, make_plan
from pipeline.runtime.resources import Resources
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.ground import find_ground
from pipeline.runtime.stages.ingest import ingest
from pipeline.runtime.stages.join import NOWHERE, join, join_tiles
from pipeline.runtime.stages.open_fragments import BorderFacets
from pipeline.runtime.stages.split import split
from pipeline.runtime.stages.split_window import Split
from pipeline.settings import RunSettings
from pipeline.tiling import Tile

_WAIT_S = 120.0
_ODD = 0x9E3779B97F4A7C15
"""Spreads small numbers over 64 bits (the golden ratio)."""
_WARM_TASKS = 200


def nothing(size_bytes: int) -> bytes:
    """A result of some size, made without work."""
    return bytes(size_bytes)


async def idle_workers(address: str, count: int) -> None:
    """Workers without work of their own, all in this process; until it is ended."""
    from distributed import Worker

    workers = [Worker(address, nthreads=1, memory_limit=0, dashboard=False) for _ in range(count)]
    await asyncio.gather(*workers)
    await asyncio.gather(*(worker.finished() for worker in workers))


@contextlib.contextmanager
def cluster_of(count: int, log: Path) -> Iterator[tuple[Cluster, psutil.Process]]:
    """A scheduler in one process, workers in another; and the scheduler's process."""
    port = str(free_port())
    address = f"tcp://127.0.0.1:{port}"
    dask = Path(sys.executable).parent / "dask"
    listening = ["--host", "127.0.0.1", "--port", port, "--dashboard-address", "127.0.0.1:0"]
    with log.open("ab") as out, contextlib.ExitStack() as stack:
        for command in (
            [str(dask), "scheduler", *listening],
            [sys.executable, "-m", "benchmarks.engine_costs", "--idle-workers", str(count), "--at", address],
        ):
            process = subprocess.Popen(command, stdout=out, stderr=out)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            if command[0] == str(dask):
                scheduler = psutil.Process(process.pid)
                wait_for_listener(int(port), log)
        yield Cluster(scheduler=address), scheduler


def cpu_of(process: psutil.Process) -> float:
    """CPU seconds of another process so far."""
    times = process.cpu_times()
    return float(times.user + times.system)


def all_there(executor: DaskExecutor, count: int) -> None:
    """Wait until so many workers are there."""
    end = time.monotonic() + _WAIT_S
    while len(executor._client.scheduler_info(n_workers=-1)["workers"]) < count:  # noqa: SLF001 - nothing else knows
        if time.monotonic() > end:
            raise SystemExit(f"{count} workers did not come")
        time.sleep(0.2)


def cost_of_tasks(count: int, tasks: int, size_bytes: int, log: Path) -> dict[str, Any]:
    """CPU seconds per task of scheduler and driver, and the rate at which tasks went through."""
    from benchmarks.engine_costs import nothing as work  # not of __main__, which workers do not have

    with cluster_of(count, log) as (cluster, scheduler), cluster.executor() as executor:
        executor.prepare("noop", Watch())
        all_there(executor, count)
        for _ in executor.map("noop", work, [1] * _WARM_TASKS, Watch()):
            pass
        # as many as look at the workers each second: what the cluster costs when nothing happens
        idle_at, idle_cpu_s = time.perf_counter(), cpu_of(scheduler)
        time.sleep(3.0)
        idle_share = (cpu_of(scheduler) - idle_cpu_s) / (time.perf_counter() - idle_at)
        began_s, scheduler_s, driver_s = time.perf_counter(), cpu_of(scheduler), time.process_time()
        for _ in executor.map("noop", work, [size_bytes] * tasks, Watch()):
            pass
        wall_s = time.perf_counter() - began_s
        return {
            "workers": count,
            "tasks": tasks,
            "result_bytes": size_bytes,
            "scheduler_s": (cpu_of(scheduler) - scheduler_s - idle_share * wall_s) / tasks,
            "driver_s": (time.process_time() - driver_s) / tasks,
            "scheduler_idle_share": idle_share,
            "tasks_a_second": tasks / wall_s,
        }


# --------------------------------------------------------------------------------------------------------------- join


def splits_of(folder: Path, tile_size_m: float) -> tuple[Plan, list[Split], int]:
    """The descriptors of a city's tiles, and how many buildings it has after blocks were split into units."""
    settings = RunSettings.from_mapping({"classes": "ignore", "tile_size_m": tile_size_m})
    tiles = sorted(str(path) for path in folder.glob("*.laz"))
    plan = make_plan(tiles, ReadOptions(), settings)
    with (
        tempfile.TemporaryDirectory(prefix="gablework-") as place,
        executor_for(Resources(workers=2), local_directory=place) as executor,
    ):
        scratch = Scratch(str(Path(place, "scratch")))
        scratch.create()
        context = RunContext(plan=plan, progress=Progress(ignore), executor=executor, scratch=scratch)
        ingested = ingest(context, tiles)
        ground = find_ground(context, settings, ingested, footprints=False)
        found = split(context, settings, ingested, ground, None)
        splits = list(found.stored(context))
        joined = join(context, settings.scene, settings.building.roof, found, None)
    return plan, splits, joined.candidates


def moved(one: Split, columns: int, size_mm: int) -> Split:
    """The same surfaces so many tiles farther east; a copy that shares no memory."""
    tile = Tile(one.tile.column + columns, one.tile.row)
    found = one.surfaces
    if found is None:
        return dataclasses.replace(one, tile=tile)
    shift = columns * size_mm

    def points(places: IntArray) -> IntArray:
        copy = places.copy()
        copy[copy[:, 0] != NOWHERE, 0] += shift
        return copy

    def boxes(places: IntArray) -> IntArray:
        copy = places.copy()
        copy[np.ix_(copy[:, 0] <= copy[:, 2], (0, 2))] += shift
        return copy

    def facets(held: BorderFacets) -> BorderFacets:
        # names are digests: another city has others, and those of one stay equal among themselves
        return BorderFacets(names=held.names ^ np.uint64(columns * _ODD % 2**64), holders=held.holders.copy())

    done = dataclasses.replace(
        found.done,
        candidate_points_mm=points(found.done.candidate_points_mm),
        candidate_ranges=found.done.candidate_ranges.copy(),
        sums=found.done.sums.copy(),
        boxes_mm=boxes(found.done.boxes_mm),
        lowest_point_mm=points(found.done.lowest_point_mm),
        rejected_ranges=found.done.rejected_ranges.copy(),
    )
    surfaces = dataclasses.replace(
        found,
        done=done,
        sums=found.sums.copy(),
        boxes_mm=boxes(found.boxes_mm),
        lowest_point_mm=points(found.lowest_point_mm),
        ranges=found.ranges.copy(),
        facets=facets(found.facets),
        step_facets=facets(found.step_facets),
        along_steps=found.along_steps.copy(),
    )
    return dataclasses.replace(one, tile=tile, surfaces=surfaces)


def cost_of_join(plan: Plan, splits: Sequence[Split], buildings: int, times: int) -> dict[str, Any]:
    """CPU seconds and memory of the join of a city laid side by side so many times; in a process of its own."""
    columns = [one.tile.column for one in splits]
    stride = max(columns) - min(columns) + 3
    gc.collect()
    before = psutil.Process().memory_info().rss
    making_s = 0.0

    def city() -> Iterator[Split]:
        # one at a time, as the driver reads them
        nonlocal making_s
        for k in range(times):
            for one in splits:
                began_s = time.process_time()
                copy = moved(one, stride * k, plan.grid.size_mm)
                making_s += time.process_time() - began_s
                yield copy

    join_tiles(iter(splits), plan.grid, RunSettings().scene.candidates, "EPSG:25832")  # kernels are loaded once
    began = time.process_time()
    joined = join_tiles(city(), plan.grid, RunSettings().scene.candidates, "EPSG:25832")
    cpu_s = time.process_time() - began - making_s
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    return {
        "buildings": times * buildings,
        "candidates": len(joined.candidates),
        "tiles": times * len(splits),
        "fragments": times * sum(0 if one.surfaces is None else len(one.surfaces.kind) for one in splits),
        "cpu_s": cpu_s,
        "splits_bytes": times * sum(len(pickle.dumps(one, protocol=pickle.HIGHEST_PROTOCOL)) for one in splits),
        "peak_bytes": peak,
    }


def fitted(rows: Sequence[dict[str, Any]], name: str) -> tuple[float, float]:
    """Factor and exponent of `name` = factor x buildings ^ exponent."""
    x, y = np.log([row["buildings"] for row in rows]), np.log([row[name] for row in rows])
    exponent, constant = np.polyfit(x, y, 1)
    return float(np.exp(constant)), float(exponent)


def join_costs(folder: Path, tile_size_m: float, repeats: Sequence[int]) -> dict[str, Any]:
    """The join's costs at several sizes, and the lines fitted to them."""
    plan, splits, buildings = splits_of(folder, tile_size_m)
    fresh = multiprocessing.get_context("spawn")
    rows = []
    for times in repeats:
        with fresh.Pool(1) as pool:
            rows.append(pool.apply(cost_of_join, (plan, splits, buildings, times)))
        print(rows[-1], flush=True)
    return {"rows": rows, **{name: fitted(rows, name) for name in ("cpu_s", "splits_bytes", "peak_bytes")}}


def tables(costs: dict[str, Any]) -> str:
    """What was measured, as tables."""
    parts = [
        markdown_table(
            ["workers", "bytes per result", "scheduler, ms per task", "driver, ms per task", "tasks per second"],
            [
                [str(row["workers"]), str(row["result_bytes"])]
                + [f"{1e3 * row[name]:.2f}" for name in ("scheduler_s", "driver_s")]
                + [f"{row['tasks_a_second']:.0f}"]
                for row in costs["tasks"]
            ],
        )
    ]
    if "join" in costs:
        found = costs["join"]
        parts.append(
            markdown_table(
                ["buildings", "tiles", "fragments", "join, CPU s", "descriptors, MB", "peak, MB"],
                [
                    [*(str(row[name]) for name in ("buildings", "tiles", "fragments")), f"{row['cpu_s']:.1f}"]
                    + [f"{row[name] / 1e6:.0f}" for name in ("splits_bytes", "peak_bytes")]
                    for row in found["rows"]
                ],
            )
        )
        factor, exponent = found["cpu_s"]
        parts.append(f"Join: {factor:.3g} s x buildings^{exponent:.3f}.\n")
    return "\n".join(parts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 20, 100, 300])
    parser.add_argument("--tasks", type=int, default=2000)
    parser.add_argument("--large", type=int, default=1_000_000, help="bytes of a large result")
    parser.add_argument("--city", type=Path)
    parser.add_argument("--tile-size", type=float, default=500.0)
    parser.add_argument("--repeats", type=int, nargs="+", default=[1, 4, 16, 64])
    parser.add_argument("--idle-workers", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--at", help=argparse.SUPPRESS)
    wanted = parser.parse_args(arguments)
    if wanted.idle_workers:
        asyncio.run(idle_workers(wanted.at, wanted.idle_workers))
        return 0
    if wanted.out is None:
        parser.error("give --out")
    wanted.out.mkdir(parents=True, exist_ok=True)
    log = wanted.out / "engine_costs.log"
    costs: dict[str, Any] = {"tasks": []}
    kinds = [(count, wanted.tasks, 1000) for count in wanted.workers]
    kinds.append((wanted.workers[0], max(100, wanted.tasks // 10), wanted.large))
    for count, tasks, size_bytes in kinds:
        costs["tasks"].append(cost_of_tasks(count, tasks, size_bytes, log))
        print(costs["tasks"][-1], flush=True)
    if wanted.city is not None:
        costs["join"] = join_costs(wanted.city, wanted.tile_size, wanted.repeats)
    (wanted.out / "engine_costs.json").write_text(json.dumps(costs, indent=1) + "\n", encoding="utf-8")
    text = tables(costs)
    (wanted.out / "engine_costs.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
