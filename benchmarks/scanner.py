"""Speed of the simulated scanner in million returns per second: warm, median of several runs.

python -m benchmarks.scanner [--density D …] [--size METRES] [--threads N] [--repeat R]
python -m benchmarks.scanner --write [--density D …] [--size METRES]     scan, write LAZ, labels and truth

`scan` counts the scanner alone (kernel and packing of returns), by the clock and by processor time: on an idle machine
with N cores the first is the second times N. `make` is the time to build the scene.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from pipeline.ruler.simulation.als import ScannerSettings, scan
from pipeline.ruler.simulation.city import CITY_SCANNER, CityPlan
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.scene import Scene
from pipeline.ruler.simulation.suites import SUITES

DENSITIES_PER_M2 = (1.0, 8.0, 30.0)


def _suite(name: str) -> Callable[[float], Scene]:
    return lambda size: SUITES[name].make(SUITES[name].seed, (size, size))


def _city_tile(east_m: float, north_m: float) -> Callable[[float], Scene]:
    """A tile out of a city of 3 km: on the plain or on the hillside of up to 30 deg."""
    return lambda size: CityPlan(1, (3000.0, 3000.0)).part((east_m, north_m, east_m + size, north_m + size))


SCENES: dict[str, tuple[Callable[[float], Scene], ScannerSettings]] = {
    "suburb": (_suite("suburb"), SUITES["suburb"].scanner),
    "town": (_suite("town"), SUITES["town"].scanner),
    "city, plain": (_city_tile(2200.0, 500.0), CITY_SCANNER),
    "city, hillside": (_city_tile(800.0, 500.0), CITY_SCANNER),
}


def scan_once(scene: Scene, settings: ScannerSettings, threads: int) -> tuple[int, float, float]:
    """Returns, seconds by the clock and of the processor."""
    clock, processor = time.perf_counter(), time.process_time()
    count = sum(len(block) for block in scan(scene, settings, 1, threads=threads))
    return count, time.perf_counter() - clock, time.process_time() - processor


def report_scanner(densities: list[float], size_m: float, threads: int, repeat: int) -> None:
    """Measure and print the scanner alone."""
    print(f"{'scene':16s} {'houses':>7s} {'trees':>6s} {'make s':>7s} {'per m2':>7s} {'returns':>11s} ", end="")
    print(f"{'Mpt/s':>6s} {'us of processor a point':>24s}")
    for name, (make, settings) in SCENES.items():
        start = time.process_time()
        scene = make(size_m)
        made = time.process_time() - start
        for density in densities:
            survey = dataclasses.replace(settings, pulse_density_per_m2=density)
            if density == densities[0]:
                scan_once(scene, dataclasses.replace(settings, pulse_density_per_m2=0.05), threads)  # compiles
            runs = [scan_once(scene, survey, threads) for _ in range(repeat)]
            count = runs[0][0]
            clock = statistics.median(run[1] for run in runs)
            processor = statistics.median(run[2] for run in runs)
            print(
                f"{name:16s} {len(scene.buildings):7d} {len(scene.trees):6d} {made:7.2f} {density:7g} {count:11,d} "
                f"{count / clock / 1e6:6.2f} {processor / count * 1e6:24.3f}",
                flush=True,
            )


def report_writing(densities: list[float], size_m: float) -> None:
    """Measure and print whole runs of `simulate`."""
    for name in ("town", "city"):
        for density in densities:
            with tempfile.TemporaryDirectory() as folder:
                clock, processor = time.perf_counter(), time.process_time()
                made = simulate(name, Path(folder), size_m=(size_m, size_m), density_per_m2=density)
                clock, processor = time.perf_counter() - clock, time.process_time() - processor
            speed, cost = made.points / clock / 1e6, processor / made.points * 1e6
            print(
                f"simulate {name:8s} {density:7g} per m2 {made.points:11,d} points {made.buildings:6d} buildings "
                f"{clock:7.1f} s {speed:6.2f} Mpt/s {cost:6.3f} us of processor a point",
                flush=True,
            )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--density", type=float, nargs="+", default=list(DENSITIES_PER_M2), help="pulses per m2")
    parser.add_argument("--size", type=float, default=400.0, help="edge of the scenes in metres")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--write", action="store_true", help="measure whole simulations instead")
    arguments = parser.parse_args()
    if arguments.write:
        report_writing(arguments.density, arguments.size)
    else:
        report_scanner(arguments.density, arguments.size, arguments.threads, arguments.repeat)


if __name__ == "__main__":
    main()
