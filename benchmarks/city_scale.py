"""The engine at the scale of a city: efficiency, memory, the cost of the driver and of killed workers.

    python -m benchmarks.city_scale --out DIR [--tiles 400] [--tile-size 0] [--workers 2]
                                    [--mode traced|plain] [--kill-every 30] [--label NAME] [--keep]

makes the city of `city_tiles.py` in DIR/city<tiles> (minutes), runs the pipeline over it in processes of their own,
watches them from outside, and writes DIR/<label>.md (tables), DIR/<label>.json and DIR/<label>.trace.json (one row per
task; `scaling_simulation.py` reads it). `traced` is the run of `gablework reconstruct` with an executor that records
the cost of each task; `plain` is the command itself, watched only from outside. With `--kill-every S` a worker's
process is killed every S seconds, in turns, as soon as the run has its workers.

Efficiency is the CPU time of all task bodies, their child processes included, over wall-clock time times workers. On a
machine that others use too, it comes out too small: the wall-clock time grows, the CPU time does not. Two more figures
are therefore reported: the share of the time in which the workers had a task (occupancy), and the share of all CPU time
that was spent in tasks. On a quiet machine efficiency is about their product.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.city_tiles import SUFFIX, make_city, square_of
from benchmarks.entries import markdown_table
from benchmarks.process_watch import DRIVER, Watcher
from benchmarks.traced_run import folder_bytes
from pipeline.model import Status

REQUIRED, WANTED = 0.80, 0.90
RESULTS = ("buildings", "planes", "rejected", "meshes", "cityjson", "state")


def command_of(arguments: argparse.Namespace, tiles: Path, run_dir: Path) -> list[str]:
    """What is started."""
    if arguments.mode == "plain":
        command = [sys.executable, "-m", "service.cli", "reconstruct", str(tiles), "--out", str(run_dir), "--overwrite"]
        command += ["--workers", str(arguments.workers)]
        if arguments.tile_size:
            settings = run_dir.parent / f"{arguments.label}.toml"
            settings.write_text(f"[settings]\ntile_size_m = {arguments.tile_size}\n", encoding="utf-8")
            command += ["--settings", str(settings)]
        return command
    trace = run_dir.parent / f"{arguments.label}.trace.json"
    command = [sys.executable, "-m", "benchmarks.traced_run", str(tiles), "--out", str(run_dir), "--trace", str(trace)]
    command += ["--workers", str(arguments.workers), "--tile-size", str(arguments.tile_size)]
    return command


def watched_run(arguments: argparse.Namespace, tiles: Path, run_dir: Path) -> dict[str, Any]:
    """Run once and tell what was seen from outside."""
    log = run_dir.parent / f"{arguments.label}.log"
    with contextlib.ExitStack() as stack:
        out = stack.enter_context(log.open("wb"))
        load_before = os.getloadavg()[0]
        began = time.perf_counter()
        process = subprocess.Popen(command_of(arguments, tiles, run_dir), stdout=out, stderr=out)
        # it is written when the workers are there: one that dies before ends the run
        begun = run_dir / "run.json"
        watcher = stack.enter_context(Watcher({process.pid: DRIVER}, arguments.kill_every, begun.exists))
        code = process.wait()
        wall_s = time.perf_counter() - began
    if code:
        raise SystemExit(f"the run ended with exit code {code}: see {log}")
    return {
        "wall_s": wall_s,
        "load_before": load_before,
        "load_mean": statistics.fmean(watcher.load),
        "killed": len(watcher.killed),
        "roles": watcher.by_role(),
    }


def is_mark(line: Mapping[str, Any]) -> bool:
    """Whether a line of the diary begins a stage or ends the run; returning workers are logged for the run, too."""
    return line["kind"] in {"stage", "finished"} or (line["kind"] == "run" and line["stage"] == "plan")


def stage_rows(trace: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What each stage took: walls, CPU time of its tasks, when workers had nothing to do, what the driver spent."""
    workers = trace["workers"]
    marks = [line for line in trace["diary"] if is_mark(line)]
    rows = []
    for mark, after in itertools.pairwise(marks):
        own = [t for t in trace["tasks"] if mark["at_s"] <= t["began_s"] < after["at_s"]]
        wall_s = after["at_s"] - mark["at_s"]
        by_process: dict[str, list[dict[str, Any]]] = {}
        for task in own:
            by_process.setdefault(task["process"], []).append(task)
        gaps = []
        for done in by_process.values():
            done.sort(key=lambda t: t["began_s"])
            gaps += [b["began_s"] - a["began_s"] - a["seconds"] for a, b in itertools.pairwise(done)]
        ends = sorted(max(t["began_s"] + t["seconds"] for t in done) for done in by_process.values())
        rows.append(
            {
                "stage": mark["stage"],
                "tasks": len(own),
                "wall_s": wall_s,
                "task_s": sum(t["seconds"] for t in own),
                "task_cpu_s": sum(t["cpu_s"] for t in own),
                "driver_cpu_s": after["cpu_s"] - mark["cpu_s"],
                "idle_s": wall_s * workers - sum(t["seconds"] for t in own),
                "head_s": (min(t["began_s"] for t in own) - mark["at_s"]) * workers if own else 0.0,
                "between_s": sum(gaps),
                "tail_s": sum(ends[-1] - end for end in ends) if own else 0.0,
                "gap_s": statistics.median(gaps) if gaps else 0.0,
                "longest_s": max((t["seconds"] for t in own), default=0.0),
            }
        )
    return rows


def stage_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The stages as a table; idle times are those of all workers together."""
    seconds = {
        "wall, s": "wall_s",
        "tasks' wall, s": "task_s",
        "tasks' CPU, s": "task_cpu_s",
        "driver's CPU, s": "driver_cpu_s",
        "idle, worker s": "idle_s",
        "before the first": "head_s",
        "between tasks": "between_s",
        "behind the last": "tail_s",
        "median gap, s": "gap_s",
        "longest task, s": "longest_s",
    }
    return markdown_table(
        ["stage", "tasks", *seconds],
        [[row["stage"], str(row["tasks"]), *(f"{row[name]:.3g}" for name in seconds.values())] for row in rows],
    )


def report(seen: Mapping[str, Any], trace: Mapping[str, Any] | None, run_dir: Path, workers: int) -> tuple[str, Any]:
    """The tables, and the same as figures."""
    manifest = json.loads((run_dir / "run.json").read_text(encoding="utf-8"))
    counts = manifest["counts"]
    buildings, points = counts["candidates"], counts["points"]
    wall_s = seen["wall_s"]
    results = {name: folder_bytes(run_dir / name) for name in RESULTS}
    figures: dict[str, Any] = {
        "buildings": buildings,
        "points": points,
        "tiles": counts["tiles"],
        "wall_s": wall_s,
        "buildings_a_second": buildings / wall_s,
        "digest": manifest["content_sha256"],
        "statuses": {status.value: counts.get(status, 0) for status in Status},
        "seen": dict(seen),
        "result_bytes": results,
    }
    all_cpu_s = sum(cpu_s for _, cpu_s, _ in seen["roles"].values())
    conditions = (
        f"{counts['tiles']} lattice tiles, {buildings} buildings, {points} points; {workers} workers; "
        f"load of the machine before {seen['load_before']:.1f}, mean {seen['load_mean']:.1f}; "
        f"workers killed {seen['killed']}; digest {manifest['content_sha256'][:16]}."
    )
    speed = (
        f"wall {wall_s:.1f} s, {buildings / wall_s:.1f} buildings per second, "
        f"CPU of all processes {all_cpu_s:.1f} s ({all_cpu_s / wall_s:.2f} cores)."
    )
    lines = [conditions, "", speed]
    if trace is not None:
        cpu_s = sum(t["cpu_s"] for t in trace["tasks"])
        busy_s = sum(t["seconds"] for t in trace["tasks"])
        figures["task_cpu_s"], figures["task_s"] = cpu_s, busy_s
        figures["efficiency"] = cpu_s / (wall_s * workers)
        figures["occupancy"] = busy_s / (wall_s * workers)
        figures["task_share_of_cpu"] = cpu_s / all_cpu_s
        figures["stages"] = stage_rows(trace)
        figures["scratch_bytes_a_point"] = max(trace["scratch_bytes"].values()) / points
        held = "reached" if figures["efficiency"] >= WANTED else "required reached"
        held = held if figures["efficiency"] >= REQUIRED else "missed"
        reported = (
            f"efficiency {figures['efficiency']:.3f} ({held}; required {REQUIRED:g}, wanted {WANTED:g}), "
            f"occupancy {figures['occupancy']:.3f}, tasks' share of all CPU time {figures['task_share_of_cpu']:.3f}; "
            f"CPU of task bodies {cpu_s:.1f} s.  \n"
            f"Scratch {figures['scratch_bytes_a_point']:.1f} bytes per point at most."
        )
        lines += ["", reported, "", stage_table(figures["stages"])]
    lines += [
        "",
        markdown_table(
            ["processes", "how many", "CPU, s", "share of CPU", "largest peak, MB"],
            [
                [role, str(count), f"{cpu_s:.1f}", f"{cpu_s / all_cpu_s:.3f}", f"{peak / 1e6:.0f}"]
                for role, (count, cpu_s, peak) in seen["roles"].items()
            ],
        ),
        markdown_table(
            ["results", "MB", "bytes per building"],
            [[name, f"{size / 1e6:.1f}", f"{size / max(1, buildings):.0f}"] for name, size in results.items()],
        ),
    ]
    return "\n".join(lines), figures


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tiles", type=int, default=400)
    parser.add_argument("--density", type=float, default=4.5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tile-size", type=float, default=0.0, help="of gablework's lattice; 0 leaves it the choice")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--mode", choices=("traced", "plain"), default="traced")
    parser.add_argument("--kill-every", type=float, default=0.0, metavar="S")
    parser.add_argument("--label", default="run")
    parser.add_argument("--keep", action="store_true", help="leave the run directory")
    wanted = parser.parse_args(arguments)
    wanted.out = wanted.out.resolve()
    tiles = wanted.out / f"city{wanted.tiles}"
    city = square_of(wanted.tiles, 200.0, wanted.density, wanted.seed)
    if len(list(tiles.glob(f"city_*{SUFFIX}"))) < wanted.tiles:
        began = time.perf_counter()
        made = make_city(city, tiles, os.cpu_count() or 1)
        print(
            f"{len(made)} tiles, {sum(t.buildings for t in made)} buildings, {sum(t.points for t in made)} points "
            f"in {time.perf_counter() - began:.0f} s",
            flush=True,
        )
    run_dir = wanted.out / f"{wanted.label}.run"
    try:
        seen = watched_run(wanted, tiles, run_dir)
        trace_file = wanted.out / f"{wanted.label}.trace.json"
        trace = None if wanted.mode == "plain" else json.loads(trace_file.read_text(encoding="utf-8"))
        text, figures = report(seen, trace, run_dir, wanted.workers)
    finally:
        if not wanted.keep:
            shutil.rmtree(run_dir, ignore_errors=True)
    (wanted.out / f"{wanted.label}.md").write_text(text + "\n", encoding="utf-8")
    (wanted.out / f"{wanted.label}.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
