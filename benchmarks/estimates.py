"""Estimates of `batch plan` against true runs: wall time and memory, by ratio.

    python -m benchmarks.estimates --out DIR [--data ../shared/data] [--suites DIR] [--cities DIR DIR] [--rounds 3]
                                   [--only NAME ...] [--cpu]

Each round plans each job and runs it right after, both as commands of their own, so that both meet about the same load.
`--suites` holds what `gablework simulate SUITE --split test --out DIR/SUITE` wrote, `--cities` what `city_tiles.py`
wrote. DIR/estimates.md holds, for each job, the medians of the estimate, of the true figure and of their ratio, with
the least and the greatest ratio, and the load of the machine; DIR/estimates.json holds every round. Memory is that of
the largest process, and of all processes together, by `run.json`. Runs of less than 20 s are listed, too.

With `--cpu` each job is sampled and run serially in one process whose clock is its CPU time: what others do on the
machine then counts little. The table is DIR/estimates_cpu.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.entries import markdown_table
from pipeline.batch.batch_file import read_batch
from pipeline.batch.remaining_time import duration
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.expected import expected
from pipeline.runtime.monitoring.events import ignore
from pipeline.runtime.monitoring.progress import Progress
from pipeline.runtime.request import plan_inputs
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.runtime.sample import sample_tasks, sample_window, sampled
from pipeline.runtime.stages.given_footprints import footprints_of_run
from pipeline.runtime.stages.model_batch import load

COMMAND = [sys.executable, "-m", "service.cli"]
FIGURES = ("wall_s", "largest_gib", "all_gib")
CHOSEN_ON = ("city of 36 files", "suite city", "sparse town", "Delft")
"""Jobs whose stage times gave the rates, or on which the sample was developed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """A run to estimate."""

    name: str
    inputs: tuple[Path, ...]
    workers: int | str = "auto"
    classes: str = "ignore"
    method: str = "arrangement"
    crs: str = ""
    footprints: str = ""

    @property
    def label(self) -> str:
        """Its name and its options."""
        words = [
            "" if self.workers == "auto" else f"workers {self.workers}",
            "" if self.classes == "ignore" else "with classes",
            "" if self.method == "arrangement" else self.method,
            "in footprints" if self.footprints else "",
        ]
        return ", ".join([self.name, *filter(None, words)])

    def batch(self, out: Path) -> str:
        """Its batch file."""
        inputs = [f"paths = {json.dumps([str(path.resolve()) for path in self.inputs])}", f'crs = "{self.crs}"']
        if self.footprints:
            inputs.append(f'footprints = "{Path(self.footprints).resolve()}"')
        settings = [f'classes = "{self.classes}"', f'method = "{self.method}"']
        workers = json.dumps(self.workers)
        tables = {"inputs": inputs, "settings": settings, "output": [f'path = "{out.resolve()}"']}
        tables["cluster"] = [f"workers = {workers}"]
        return "".join("\n".join([f"[{name}]", *lines, ""]) for name, lines in tables.items())

    def words(self, out: Path) -> list[str]:
        """Its command."""
        given = {"--crs": self.crs, "--footprints": self.footprints, "--workers": str(self.workers)}
        given |= {"--classes": self.classes, "--method": self.method, "--out": str(out)}
        options = [word for name, value in given.items() if value for word in (name, value)]
        return ["reconstruct", *(str(path) for path in self.inputs), *options, "--overwrite", "--json"]


def jobs(data: Path | None, suites: Path | None, cities: Sequence[Path]) -> Iterator[Job]:
    """All jobs whose inputs are there."""
    for city in cities:
        name = f"city of {len(list(city.glob('*.laz')))} files"
        yield Job(name=name, inputs=(city,))
        for workers in (0, 1, 2):
            yield Job(name=name, inputs=(city,), workers=workers)
    for suite in sorted(suites.iterdir()) if suites is not None else ():
        files = tuple(sorted(suite.rglob("*.laz")))
        if files:
            yield Job(name=f"suite {suite.name}", inputs=files)
            yield Job(name=f"suite {suite.name}", inputs=files, workers=0)
    if data is not None:
        delft = (data / "ahn3" / "delft_west.laz", data / "ahn3" / "delft_east.laz")
        sparse = (data / "more" / "ign" / "sparse_0382_6565.laz",)
        footprints = str(data / "ahn3" / "footprints.gpkg")
        yield Job(name="Delft", inputs=delft, crs="EPSG:7415")
        yield Job(name="Delft", inputs=delft, crs="EPSG:7415", workers=0)
        yield Job(name="Delft", inputs=delft, crs="EPSG:7415", workers=0, classes="trust")
        yield Job(name="Delft", inputs=delft, crs="EPSG:7415", workers=0, footprints=footprints)
        for method in ("fuzzy-sart", "parameter-space-2d", "parameter-space-3d", "kmeans"):
            yield Job(name="Delft", inputs=delft, crs="EPSG:7415", method=method)
        yield Job(name="sparse town", inputs=sparse)
        yield Job(name="sparse town", inputs=sparse, workers=0)
        yield Job(name="sparse town", inputs=sparse, workers=0, classes="trust")
        yield Job(name="CSite2", inputs=(data / "isprs" / "CSite2_orig-utm.laz",))
        yield Job(name="CSite2", inputs=(data / "isprs" / "CSite2_orig-utm.laz",), workers=0)
        yield Job(name="forest", inputs=(data / "more" / "ign" / "forest_0906_6665.laz",), workers=0)
        yield Job(name="Tallinn", inputs=(data / "more" / "building3d" / "tallinn.laz",), workers=0)


def _called(words: Sequence[str]) -> tuple[dict[str, Any], float]:
    """The document of a command and its wall seconds."""
    began = time.perf_counter()
    ended = subprocess.run([*COMMAND, *words], check=True, capture_output=True, text=True)
    return json.loads(ended.stdout), time.perf_counter() - began


def measured(job: Job, out: Path) -> dict[str, Any]:
    """Plan a job, run it, and compare."""
    file, run_dir = out / "job.toml", out / "models"
    shutil.rmtree(run_dir, ignore_errors=True)
    file.write_text(job.batch(run_dir))
    load = os.getloadavg()[0]
    plan, plan_s = _called(["batch", "plan", str(file), "--json"])
    _, wall_s = _called(job.words(run_dir))
    manifest = json.loads((run_dir / "run.json").read_text())
    peaks = [peak / 2**30 for peak in manifest["peak_memory_bytes"].values()]
    least, most = plan["seconds"]
    return {
        "job": job.label,
        "plan_s": plan_s,
        "sampled": plan["sampled"],
        "load": load,
        "load_after": os.getloadavg()[0],
        "range_s": plan["seconds"],
        "wall_s": [(least * most) ** 0.5, wall_s],
        "largest_gib": [plan["worker_bytes"] / 2**30, max(peaks)],
        "all_gib": [plan["memory_bytes"] / 2**30, sum(peaks)],
        "buildings": [plan["buildings"], manifest["counts"]["candidates"]],
        "stage_s": [plan["stage_s"], manifest["timings_s"]],
        "peaks_gib": peaks,
    }


def measured_by_cpu(job: Job, out: Path) -> dict[str, Any]:
    """Sample a job and run it serially, by the CPU time of this process, which must be fresh: its clock is replaced."""
    time.perf_counter = time.process_time
    (out / "job.toml").write_text(dataclasses.replace(job, workers=0).batch(out / "models"))
    request = dataclasses.replace(read_batch(str(out / "job.toml")).request(), overwrite=True, resources=SERIAL)
    plan, paths = plan_inputs(request, Progress(ignore))
    given = footprints_of_run(request.footprints, plan, request.settings.footprints)
    known = None if given is None else len(given.polygons)
    by_rates = expected(plan, known)
    load(request.settings.general.method)
    # libraries and kernels are loaded before the clock starts, as children load them
    sample_window(sample_tasks(by_rates, request, plan, paths, 1)[0])
    found = sampled(by_rates, request, plan, paths, hands=1, buildings=known, executor=SerialExecutor())
    assert found is not None
    summary = run(request)
    guess, truth = found.wall_s(1), {stage: summary.timings_s.get(stage, 0.0) for stage in found.wall_s(1)}
    return {
        "job": dataclasses.replace(job, workers="auto").label,
        "cpu_s": [sum(guess.values()), sum(truth.values())],
        "stage_s": [guess, truth],
        "buildings": [found.buildings, summary.counts["candidates"]],
    }


def cpu_rows(rounds: Iterable[dict[str, Any]]) -> list[list[str]]:
    """A row per job."""
    table = []
    for found in rounds:
        guess, truth = found["cpu_s"]
        name = f"{found['job']} *" if found["job"].split(",")[0] in CHOSEN_ON else found["job"]
        counts = "{} / {}".format(*found["buildings"])
        table.append([name, f"{guess:.1f} s", f"{truth:.1f} s", f"{guess / truth:.2f}", counts])
    return table


def rows(rounds: Iterable[dict[str, Any]]) -> list[list[str]]:
    """A row per job: medians, and the range of the ratios of estimate to truth."""
    by_job: dict[str, list[dict[str, Any]]] = {}
    for found in rounds:
        by_job.setdefault(found["job"], []).append(found)
    table = []
    for job, several in by_job.items():
        row = [f"{job} *" if job.split(",")[0] in CHOSEN_ON else job, str(len(several))]
        for figure in FIGURES:
            pairs = [found[figure] for found in several]
            guess, truth = (statistics.median(pair[k] for pair in pairs) for k in (0, 1))
            ratios = sorted(pair[0] / pair[1] for pair in pairs)
            values = [f"{v:.1f} s" if figure == "wall_s" else f"{v:.2f} GiB" for v in (guess, truth)]
            row += [*values, f"{statistics.median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})"]
        counts = [statistics.median(found["buildings"][k] for found in several) for k in (0, 1)]
        loads = [found[name] for found in several for name in ("load", "load_after")]
        row += [f"{counts[0]:.0f} / {counts[1]:.0f}", duration(statistics.median(found["plan_s"] for found in several))]
        table.append([*row, f"{min(loads):.1f} to {max(loads):.1f}"])
    return table


HEADER = (
    *("job", "rounds", "time estimated", "true", "ratio", "largest process estimated", "true", "ratio"),
    *("all processes estimated", "true", "ratio", "buildings", "planning", "load"),
)


def _by_cpu(chosen: Sequence[Job], out: Path) -> int:
    """One round by CPU time, each job in a fresh process."""
    found: list[dict[str, Any]] = []
    # engines do not differ here
    for job in {dataclasses.replace(job, workers="auto"): job for job in chosen}:
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            found.append(pool.submit(measured_by_cpu, job, out).result())
        guess, truth = found[-1]["cpu_s"]
        print(f"{job.label}: {guess:.1f} s estimated, {truth:.1f} s true, ratio {guess / truth:.2f}", flush=True)
        Path(out, "estimates_cpu.json").write_text(json.dumps(found, indent=1) + "\n")
        Path(out, "estimates_cpu.md").write_text(markdown_table(CPU_HEADER, cpu_rows(found)))
    return 0


CPU_HEADER = ("job", "CPU time estimated", "true", "ratio", "buildings")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--suites", type=Path)
    parser.add_argument("--cities", type=Path, nargs="*", default=())
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--cpu", action="store_true")
    wanted = parser.parse_args(arguments)
    wanted.out.mkdir(parents=True, exist_ok=True)
    chosen = [
        job
        for job in jobs(wanted.data, wanted.suites, wanted.cities)
        if not wanted.only or any(job.label.startswith(name) for name in wanted.only)
    ]
    if wanted.cpu:
        return _by_cpu(chosen, wanted.out)
    found = []
    for _ in range(wanted.rounds):
        for job in chosen:
            found.append(measured(job, wanted.out))
            guess, truth = found[-1]["wall_s"]
            print(f"{job.label}: {guess:.1f} s estimated, {truth:.1f} s true, ratio {guess / truth:.2f}", flush=True)
            Path(wanted.out, "estimates.json").write_text(json.dumps(found, indent=1) + "\n")
            Path(wanted.out, "estimates.md").write_text(markdown_table(HEADER, rows(found)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
