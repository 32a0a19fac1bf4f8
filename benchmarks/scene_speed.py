"""Time and memory of splitting a scene into candidates: ingest, split and join.

    python -m benchmarks.scene_speed clock --out DIR [--data ../shared/data] [--tile ahn3/delft_west.laz] [--rounds 7]
                                           [--workers 0 2] [--top 25]
    python -m benchmarks.scene_speed large --out DIR [--piece 500 1000] [--repeats 6 3] [--density 10.5] [--workers 2]
                                           [--simulate-only] [--keep]

`clock` runs the three stages again and again over one tile, read without its classes. The first round, which compiles
or loads the kernels and starts the workers, does not count. It reports the median of the rounds by stage, points per
second, and of the serial run the functions that take most CPU time (cProfile). `large` writes one LAS file of about a
hundred million points, copies of a piece of a simulated city side by side, splits it, and reports the peak memory of
every process; the file is removed afterwards. DIR/speed.md and DIR/large.md hold the tables.
"""

from __future__ import annotations

import argparse
import cProfile
import dataclasses
import io
import pstats
import resource
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import laspy
import numpy as np

from benchmarks.entries import markdown_table
from pipeline.io import ReadOptions
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.runtime.cluster.serial_executor import Executor, SerialExecutor
from pipeline.runtime.engine import executor_for
from pipeline.runtime.monitoring.events import ignore
from pipeline.runtime.monitoring.progress import Progress
from pipeline.runtime.plan import Plan, make_plan
from pipeline.runtime.resources import SERIAL, Resources
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.ground import find_ground
from pipeline.runtime.stages.join import join
from pipeline.runtime.stages.read_inputs import read_inputs
from pipeline.runtime.stages.split import split
from pipeline.settings import RunSettings

STAGES = ("ingest", "cells", "ground", "split", "join", "outline")
REQUIRED_POINTS_A_SECOND = 300_000.0
WANTED_POINTS_A_SECOND = 1_000_000.0
_MB = 1e6
_CHUNK_POINTS = 1_000_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lap:
    """One round over the three stages."""

    seconds: Mapping[str, float]
    """Wall-clock time by stage."""
    cpu_s: float | None
    """CPU time of all stages; None where other processes ran them."""
    points: int
    """Points without duplicates."""
    candidates: int
    peaks: Mapping[str, int]
    """Largest resident size in bytes, by process, of those that ran tasks."""
    scratch_bytes: int
    """Size of what lies in scratch at the end."""

    @property
    def total_s(self) -> float:
        """All stages together."""
        return sum(self.seconds[stage] for stage in STAGES)


def settings_without_classes() -> RunSettings:
    """The defaults, with the classes of files ignored."""
    return RunSettings.from_mapping({"classes": "ignore"})


def one_lap(tiles: Sequence[str], plan: Plan, settings: RunSettings, executor: Executor, folder: str) -> Lap:
    """Ingest, ground, split and join once, in a scratch of its own below `folder`."""
    progress = Progress(ignore)
    with tempfile.TemporaryDirectory(prefix="gablework-", dir=folder) as place:
        scratch = Scratch(str(Path(place, "scratch")))
        scratch.create()
        context = RunContext(plan=plan, progress=progress, executor=executor, scratch=scratch)
        began = time.process_time()
        inputs = read_inputs(context, settings, tiles, None)
        ingested, ground = inputs.ingested, find_ground(context, settings, inputs.cells)
        splits = split(context, settings, ingested, ground, None)
        joined = join(context, settings.scene, settings.building.roof, splits, None)
        cpu_s = time.process_time() - began
        held = sum(path.stat().st_size for path in Path(place).rglob("*") if path.is_file())
    return Lap(
        seconds={stage: progress.timings[stage] for stage in STAGES},
        cpu_s=cpu_s if isinstance(executor, SerialExecutor) else None,
        points=sum(found.points for found in splits.figures),
        candidates=joined.candidates,
        peaks=dict(progress.peaks),
        scratch_bytes=held,
    )


def laps(tiles: Sequence[str], crs: str | None, workers: int, rounds: int, folder: str) -> list[Lap]:
    """Several rounds by one executor; an extra first one is left out.

    Parameters
    ----------
    tiles : sequence of str
        Point files.
    crs : str or None
        Where the files tell none.
    workers : int
        0 runs in this process.
    rounds : int
        Rounds that count.
    folder : str
        Where scratch goes.
    """
    settings = settings_without_classes()
    plan = make_plan(tiles, ReadOptions(crs=crs), settings)
    with executor_for(Resources(workers=workers), local_directory=folder) as executor:
        return [one_lap(tiles, plan, settings, executor, folder) for _ in range(rounds + 1)][1:]


def profile(tiles: Sequence[str], crs: str | None, folder: str, top: int) -> str:
    """The functions that take most CPU time of their own in one serial round, as text."""
    settings = settings_without_classes()
    plan = make_plan(tiles, ReadOptions(crs=crs), settings)
    profiler = cProfile.Profile(time.process_time)
    with executor_for(SERIAL, local_directory=folder) as executor:
        one_lap(tiles, plan, settings, executor, folder)
        profiler.enable()
        one_lap(tiles, plan, settings, executor, folder)
        profiler.disable()
    text = io.StringIO()
    pstats.Stats(profiler, stream=text).strip_dirs().sort_stats("tottime").print_stats(top)
    lines = text.getvalue().splitlines()
    start = next(number for number, line in enumerate(lines) if line.lstrip().startswith("ncalls"))
    return "\n".join(line.rstrip() for line in lines[start:] if line.strip())


def speed_row(label: str, found: Sequence[Lap]) -> list[str]:
    """Medians of some laps as a row of `speed_table`."""
    middle = {stage: statistics.median(lap.seconds[stage] for lap in found) for stage in STAGES}
    total = statistics.median(lap.total_s for lap in found)
    cpu = [lap.cpu_s for lap in found if lap.cpu_s is not None]
    return [
        label,
        str(found[0].points),
        *(f"{middle[stage]:.2f}" for stage in STAGES),
        f"{total:.2f}",
        f"{min(lap.total_s for lap in found):.2f} to {max(lap.total_s for lap in found):.2f}",
        f"{found[0].points / total / 1e6:.2f}",
        f"{statistics.median(cpu):.2f}" if cpu else "",
    ]


def speed_table(rows: Sequence[Sequence[str]]) -> str:
    """Seconds by stage and points per second."""
    heads = ["", "points", *(f"{stage}, s" for stage in STAGES), "together, s", "range, s"]
    heads += ["million points per second", "CPU, s"]
    return markdown_table(heads, rows)


def run_clock(arguments: argparse.Namespace) -> int:
    """Clock one tile."""
    tile = arguments.data / arguments.tile
    if not tile.exists():
        print(f"{tile} is not there: give --data", file=sys.stderr)
        return 1
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows, best = [], 0.0
    with tempfile.TemporaryDirectory(prefix="gablework-", dir=arguments.out) as folder:
        for workers in arguments.workers:
            found = laps([str(tile)], arguments.crs, workers, arguments.rounds, folder)
            label = f"{workers} workers" if workers else "in one process"
            rows.append(speed_row(label, found))
            best = max(best, found[0].points / statistics.median(lap.total_s for lap in found))
        reported = profile([str(tile)], arguments.crs, folder, arguments.top) if arguments.top else ""
    held = [
        f"{'reached' if best >= limit else 'missed'}: {name} of {limit / 1e6:g} million points per second"
        for name, limit in (("required", REQUIRED_POINTS_A_SECOND), ("wanted", WANTED_POINTS_A_SECOND))
    ]
    text = f"`{tile.name}`, {arguments.rounds} rounds after the first.\n\n{speed_table(rows)}\n{'; '.join(held)}.\n"
    (arguments.out / "speed.md").write_text(text, encoding="utf-8")
    (arguments.out / "profile.txt").write_text(reported + "\n", encoding="utf-8")
    print(f"\n{text}\n{reported}")
    return 0


# ------------------------------------------------------------------------------------------------------------- large


def large_file(folder: Path, piece_m: Sequence[float], repeats: Sequence[int], density: float) -> Path:
    """One LAS file of a city that is simulated in a piece and laid side by side, so many times east and north.

    Parameters
    ----------
    folder : Path
        Where the piece is made and the file is written.
    piece_m : (2,) float
        Extent of the piece, whole metres.
    repeats : (2,) int
        How often.
    density : float
        Pulses per square metre.
    """
    made = simulate(
        "city", folder / "piece", seed_of("dev", 0), size_m=(piece_m[0], piece_m[1]), density_per_m2=density
    )
    path = folder / "large_city.las"
    pieces = sorted((folder / "piece" / "tiles").iterdir())
    with laspy.open(pieces[0]) as first:
        header = first.header
    steps = [round(length / scale) for length, scale in zip(piece_m, header.scales, strict=False)]
    with laspy.open(path, mode="w", header=header) as writer:
        for column in range(repeats[0]):
            for row in range(repeats[1]):
                for piece in pieces:
                    with laspy.open(piece) as reader:
                        if (reader.header.scales != header.scales).any():
                            raise ValueError(f"{piece} has scales of its own")
                        shift = np.rint((reader.header.offsets - header.offsets) / header.scales).astype(np.int64)
                        for points in reader.chunk_iterator(_CHUNK_POINTS):
                            points.array["X"] += column * steps[0] + shift[0]
                            points.array["Y"] += row * steps[1] + shift[1]
                            points.array["Z"] += shift[2]
                            writer.write_points(points)
    shutil.rmtree(made.truth.parent)
    return path


def run_large(arguments: argparse.Namespace) -> int:
    """Split a large simulated city in bounded memory."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "large_city.las"
    if not path.exists():
        began = time.perf_counter()
        large_file(arguments.out, arguments.piece, arguments.repeats, arguments.density)
        print(f"{path.stat().st_size / _MB:.0f} MB written in {time.perf_counter() - began:.0f} s", flush=True)
    if arguments.simulate_only:
        return 0
    try:
        settings = settings_without_classes()
        plan = make_plan([str(path)], ReadOptions(), settings)
        with (
            tempfile.TemporaryDirectory(prefix="gablework-", dir=arguments.out) as folder,
            executor_for(Resources(workers=arguments.workers), local_directory=folder) as executor,
        ):
            lap = one_lap([str(path)], plan, settings, executor, folder)
    finally:
        if not arguments.keep:
            path.unlink()
    text = large_text(lap, plan, arguments.workers)
    (arguments.out / "large.md").write_text(text, encoding="utf-8")
    print(f"\n{text}")
    return 0


def large_text(lap: Lap, plan: Plan, workers: int) -> str:
    """The figures of a large run."""
    driver = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    peaks = sorted(lap.peaks.values(), reverse=True)
    rows = [[f"worker {number}", f"{peak / _MB:.0f}"] for number, peak in enumerate(peaks, start=1)]
    rows.append(["driver", f"{driver / _MB:.0f}"])
    head = (
        f"{lap.points} points in one file, {lap.candidates} candidates, {workers} workers, tiles of "
        f"{plan.grid.size_mm / 1000:g} m with a halo of {plan.grid.halo_mm / 1000:g} m, "
        f"{lap.scratch_bytes / _MB:.0f} MB of scratch.\n"
    )
    return "\n".join((head, speed_table([speed_row("", [lap])]), markdown_table(["process", "peak, MB"], rows)))


def main(words: Sequence[str] | None = None) -> int:
    """Clock and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(required=True)
    clock = kinds.add_parser("clock", help="points per second over one tile")
    clock.add_argument("--data", type=Path, default=Path("../shared/data"))
    clock.add_argument("--tile", default="ahn3/delft_west.laz", help="below the data folder")
    clock.add_argument("--crs", default="EPSG:7415")
    clock.add_argument("--rounds", type=int, default=7)
    clock.add_argument("--workers", type=int, nargs="*", default=[0, 2], help="0: in this process")
    clock.add_argument("--top", type=int, default=25, help="lines of the profile; 0: none")
    clock.set_defaults(run=run_clock)
    large = kinds.add_parser("large", help="a hundred million simulated points in bounded memory")
    large.add_argument("--piece", type=float, nargs=2, default=[500.0, 1000.0], metavar=("EAST", "NORTH"))
    large.add_argument("--repeats", type=int, nargs=2, default=[6, 3], metavar=("EAST", "NORTH"))
    large.add_argument("--density", type=float, default=10.5, help="pulses per square metre")
    large.add_argument("--workers", type=int, default=2)
    large.add_argument("--simulate-only", action="store_true", help="make the city and leave it for the next call")
    large.add_argument("--keep", action="store_true", help="leave the city there")
    large.set_defaults(run=run_large)
    for kind in (clock, large):
        kind.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(words)
    result: int = arguments.run(arguments)
    return result


if __name__ == "__main__":
    sys.exit(main())
