"""Throughput of triangulation, greedy insertion and neighbour search, in million points per second of one thread.

python -m benchmarks.tin [--points N] [--repeat R]
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable

import numpy as np

from pipeline import geometry
from pipeline.model import FloatArray, IntArray
from pipeline.tin.delaunay import triangulate
from pipeline.tin.greedy_insertion import GreedyInsertionSettings, insert_greedily


def shuffled_unique(xy: IntArray) -> IntArray:
    """Different positions in an order without any locality."""
    unique = np.unique(xy, axis=0)
    return unique[np.random.default_rng(0).permutation(len(unique))]


def point_sets(n: int) -> dict[str, IntArray]:
    """Positions in millimetres of some kinds."""
    rng = np.random.default_rng(1)
    side = math.isqrt(n)
    lattice = np.stack(np.meshgrid(np.arange(side) * 1000, np.arange(side) * 1000), -1).reshape(-1, 2)
    centres = rng.integers(0, 1000, (30, 2))[rng.integers(0, 30, n)] * 1000
    return {
        "uniform, 1 km": shuffled_unique(rng.integers(0, 1_000_000, (n, 2))),
        "the same, sorted": np.unique(rng.integers(0, 1_000_000, (n, 2)), axis=0),
        "lattice of 1 m": shuffled_unique(lattice),
        "whole centimetres": shuffled_unique(rng.integers(0, 50_000, (n, 2)) * 10),
        "30 clusters": shuffled_unique((rng.normal(0, 1500, (n, 2)) + centres).astype(np.int64)),
        "100 lines": shuffled_unique(np.c_[rng.integers(0, 2_000_000, n), rng.integers(0, 100, n) * 10_000]),
    }


def gables(n: int, noise_m: float) -> FloatArray:
    """Rows of gable roofs on a plain, 4 points per square metre."""
    rng = np.random.default_rng(2)
    side = math.sqrt(n / 4.0)
    u, v = rng.uniform(0, side, (2, n))
    in_house = (u % 20 < 12) & (v % 16 < 8)
    roof = 4 + 0.577 * (4 - np.abs(v % 16 - 4))
    return np.round(np.column_stack((u, v, np.where(in_house, roof, 0.0) + rng.normal(0, noise_m, n))), 3)


def best_seconds(work: Callable[[], object], repeat: int) -> float:
    """Shortest processor time of some runs."""
    times = []
    for _ in range(repeat):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=300_000)
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    n, repeat = arguments.points, arguments.repeat

    def report(name: str, count: int, work: Callable[[], object]) -> None:
        seconds = best_seconds(work, repeat)
        print(f"{name:45s} {count:9,d} points {seconds * 1e3:9.1f} ms {count / seconds / 1e6:7.2f} Mpt/s")

    triangulate(point_sets(100)["uniform, 1 km"])
    for name, xy in point_sets(n).items():
        report(f"Delaunay, {name}", len(xy), lambda xy=xy: triangulate(xy))
    for absorption in ("bucket", "insert"):
        rules = GreedyInsertionSettings(absorption=absorption)
        insert_greedily(gables(100, 0.05), rules, 0.0)
        for count in (1_000, 10_000, 100_000):
            points = gables(count, 0.05)
            report(f"greedy insertion, {absorption}", count, lambda p=points, r=rules: insert_greedily(p, r, 0.0))
    points = gables(n, 0.05)
    small = points[:10]
    plan, small_plan = points[:, :2], small[:, :2]
    geometry.nearest_neighbours(small, 2), geometry.nearest_neighbours(small_plan, 2)
    geometry.top_visible(small), geometry.noise_sigma_m(small)
    report("8 nearest neighbours in plan", n, lambda: geometry.nearest_neighbours(plan, 8))
    report("8 nearest neighbours in space", n, lambda: geometry.nearest_neighbours(points, 8))
    report("top-visible points", n, lambda: geometry.top_visible(points))
    report("noise", n, lambda: geometry.noise_sigma_m(points))


if __name__ == "__main__":
    main()
