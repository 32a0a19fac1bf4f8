"""Memory of one building in its child process by number of points: the figures of `cluster/needs.py`.

    .venv/bin/python benchmarks/giant_memory.py [--points 50000 200000 1000000 3000000] [--method arrangement]

Three synthetic giants with the same points: a flat hall, a hall with a saw-tooth roof of 60 m2 per face, and a hall
with 200 things on its roof. Each is modelled in a separate process with all methods loaded, like the supervised child.
It reports the largest resident size minus the size before the building, and bytes per point.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from multiprocessing.connection import Connection

import numpy as np

from pipeline.methods import METHODS, ReconstructSettings
from pipeline.model import Candidate

DENSITY_PER_M2 = 8.0
KINDS = ("flat", "saw-tooth", "cluttered")


def giant(kind: str, count: int, seed: int) -> Candidate:
    """A square hall of 12 m height with `count` points."""
    random = np.random.default_rng(seed)
    side_m = float(np.sqrt(count / DENSITY_PER_M2))
    x, y = random.uniform(0.0, side_m, (2, count))
    z = np.full(count, 12.0)
    if kind == "saw-tooth":
        z += 0.4 * np.abs((x % 10.0) - 5.0)
    if kind == "cluttered":
        for _ in range(200):
            west, south = random.uniform(0.0, 0.95 * side_m, 2)
            z[(np.abs(x - west) < 4.0) & (np.abs(y - south) < 3.0)] = 12.0 + random.uniform(1.5, 5.0)
    z += random.normal(0.0, 0.03, count)
    points = np.rint(np.column_stack((x, y, z)) * 1e3) / 1e3
    points = points[np.lexsort((points[:, 2], points[:, 1], points[:, 0]))]
    ring = np.arange(-10.0, side_m + 10.0)
    east, north = (axis.ravel() for axis in np.meshgrid(ring, ring, indexing="ij"))
    around = (east < 0.0) | (east > side_m) | (north < 0.0) | (north > side_m)
    ground = np.column_stack((east[around], north[around], np.zeros(int(around.sum()))))
    return Candidate(building_id="giant", origin=(0.0, 0.0, 0.0), points=points, ground=ground, ground_z_m=0.0)


def peak() -> int:
    """Largest resident size so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def model(kind: str, count: int, method: str, answers: Connection) -> None:
    """Model one giant and tell what it took."""
    from pipeline.recipe import reconstruct_building
    from pipeline.runtime.stages.model_batch import load

    load(*METHODS)
    before = peak()
    began_s = time.perf_counter()
    candidate = giant(kind, count, 7)
    result = reconstruct_building(candidate, method, ReconstructSettings())
    answers.send((before, peak(), time.perf_counter() - began_s, result.status.value, len(result.faces)))


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[50_000, 200_000, 1_000_000, 3_000_000])
    parser.add_argument("--method", default="arrangement", choices=list(METHODS))
    given = parser.parse_args()
    print(f"| {given.method} | points | before, MiB | peak, MiB | bytes per point | s | outcome |", flush=True)
    print("| --- | ---: | ---: | ---: | ---: | ---: | --- |", flush=True)
    fresh = multiprocessing.get_context("spawn")
    for kind in KINDS:
        for count in given.points:
            ours, theirs = fresh.Pipe()
            process = fresh.Process(target=model, args=(kind, count, given.method, theirs))
            process.start()
            theirs.close()
            try:
                before, most, seconds, status, faces = ours.recv()
            except EOFError:
                print(f"| {kind} | {count} | | | | | died |", flush=True)
                continue
            finally:
                process.join()
            share = (most - before) / count
            print(
                f"| {kind} | {count} | {before / 2**20:.0f} | {most / 2**20:.0f} | {share:.0f} | {seconds:.1f} "
                f"| {status}, {faces} faces |",
                flush=True,
            )


if __name__ == "__main__":
    main()
