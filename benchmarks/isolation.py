"""Cost of supervised children and Dask: one tile serially and on two workers, each with and without children.

    python benchmarks/isolation.py ../shared/data/ahn3/delft_west.laz --crs EPSG:7415 [--rounds 5] [--json]

All ways take turns in one process, so a busy machine slows all alike. The first round of each is reported separately:
it starts children and loads compiled kernels (and compiles them if `gablework warm-up` did not run). For the others,
medians are reported in seconds of wall clock and in processor seconds of all processes together, which a busy machine
affects less; then the overhead over the serial way in percent. All digests must agree.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import tempfile
from collections.abc import Mapping
from pathlib import Path

import psutil

from pipeline.runtime.cluster.dask_executor import Cluster
from pipeline.runtime.cluster.serial_executor import Executor, SerialExecutor
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import run

STAGES = ("split", "reconstruct", "total")
COMPARED = ("reconstruct", "total", "cpu")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Way:
    """One way to run."""

    name: str
    workers: int
    isolate: bool


WAYS = (
    Way(name="serial", workers=0, isolate=False),
    Way(name="serial, child", workers=0, isolate=True),
    Way(name="2 workers", workers=2, isolate=False),
    Way(name="2 workers, children", workers=2, isolate=True),
)


def cpu_s() -> float:
    """Processor seconds of this process and all that it started and that still live."""
    here = psutil.Process()
    times = [process.cpu_times() for process in (here, *here.children(recursive=True))]
    return float(sum(t.user + t.system for t in times))


def run_once(way: Way, tile: str, crs: str | None, executor: Executor) -> dict[str, float | str]:
    """Seconds and digest of one run, into a folder that goes at once."""
    with tempfile.TemporaryDirectory(prefix="gablework-") as folder:
        request = RunRequest(
            inputs=(tile,),
            out=f"{folder}/run",
            crs=crs,
            resources=Resources(workers=way.workers, isolate=way.isolate),
            meshes="tile",
        )
        before = cpu_s()
        summary = run(request, executor=executor)
        return {"cpu": cpu_s() - before, "digest": summary.digest} | {s: summary.timings_s[s] for s in STAGES}


def measure(tile: str, crs: str | None, rounds: int) -> Mapping[str, dict[str, float]]:
    """Figures by the name of the way."""
    found: dict[str, list[dict[str, float | str]]] = {way.name: [] for way in WAYS}
    with Cluster(workers=2) as cluster:
        for _ in range(rounds + 1):
            for way in WAYS:
                executor = cluster.executor() if way.workers else SerialExecutor()
                found[way.name].append(run_once(way, tile, crs, executor))
    digests = {run["digest"] for runs in found.values() for run in runs}
    if len(digests) != 1:
        raise SystemExit(f"the runs differ: {len(digests)} digests")
    table: dict[str, dict[str, float]] = {}
    for name, (first, *others) in found.items():
        medians = {column: statistics.median(float(run[column]) for run in others) for column in (*STAGES, "cpu")}
        table[name] = {"first": float(first["total"]), **medians}
    bare = dict(table["serial"])
    for row in table.values():
        row |= {f"{column} %": 100.0 * (row[column] / bare[column] - 1.0) for column in COMPARED}
    return table


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tile", type=Path)
    parser.add_argument("--crs")
    parser.add_argument("--rounds", type=int, default=5, help="besides the first; 5 by default")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    table = measure(str(arguments.tile), arguments.crs, arguments.rounds)
    if arguments.json:
        print(json.dumps(table, indent=1))
        return
    columns = ("first", *STAGES, "cpu", *(f"{column} %" for column in COMPARED))
    print(f"{'':22}" + "".join(f"{name:>15}" for name in columns))
    for name, row in table.items():
        print(f"{name:22}" + "".join(f"{row[column]:15.2f}" for column in columns))


if __name__ == "__main__":
    main()
