"""Cost of starting up and of small jobs, beside an earlier version on the same machine within the same hour.

    python -m benchmarks.start_up --baseline CHECKOUT --out DIR [--data ../shared/data] [--rows NAME ...] [--repeat 3]
                                  [--city TILES]

CHECKOUT is another checkout of this repository with its environment (`make .venv/.run-stamp`). Both versions run the
same commands in turns; the ratio is that of the medians. Processor seconds are those of a command and of everything
that it starts, also of what outlives it for a moment: such processes are waited for. Kernels are compiled already,
except for the rows of the demo, which clone both checkouts and begin with nothing. A machine that others use at the
same time still gives valid ratios of processor seconds; those of wall seconds need a quiet one.
"""

from __future__ import annotations

import argparse
import ctypes
import dataclasses
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.entries import markdown_table
from benchmarks.survey_runs import ROOT, processor_s

_PR_SET_CHILD_SUBREAPER = 36

IMPORT = "import pipeline.runtime.run"
BUILDINGS = """
import time
from benchmarks.candidates import found_scene
try:
    from pipeline.recipe import reconstruct_building
except ImportError:  # earlier versions
    from pipeline.reconstruct import reconstruct_building
from pipeline.settings import RunSettings

settings = RunSettings()
found = found_scene({tiles!r}, "EPSG:7415", settings, {footprints!r})
found = getattr(found, "candidates", found)  # of earlier versions
building = settings.building
best = [9e9] * len(found)
for turn in range(4):
    for k, candidate in enumerate(found):
        began = time.process_time()
        reconstruct_building(candidate, settings.general.method, building)
        best[k] = min(best[k], time.process_time() - began)
print(sum(best) / len(best))
"""


@dataclasses.dataclass(frozen=True)
class Cost:
    """What a command cost."""

    processor_s: float
    wall_s: float
    said: str


@dataclasses.dataclass(frozen=True)
class Row:
    """Lines of the table: a command of both versions."""

    label: str
    ours: list[str]
    theirs: list[str]
    is_figure: bool = False
    """Whether the command prints the figure to be compared, in place of its processor and wall seconds."""


def become_reaper() -> None:
    """Have processes that lose their parent become children of this one, so that their time is counted here."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def cost(command: list[str], folder: Path, environment: dict[str, str] | None = None) -> Cost:
    """Run a command and wait for all that it started.

    Raises
    ------
    RuntimeError
        It failed.
    """
    variables = {**os.environ, **(environment or {})}
    variables.pop("PYTHONDONTWRITEBYTECODE", None)
    before, began = processor_s(), time.perf_counter()
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    wall_s = time.perf_counter() - began
    while True:
        try:
            os.wait()
        except ChildProcessError:
            break
    if done.returncode:
        raise RuntimeError(f"{command} in {folder} ended with {done.returncode}: {done.stderr[-2000:]}")
    return Cost(processor_s() - before, wall_s, done.stdout)


def program(checkout: Path, *words: str) -> list[str]:
    """A gablework command of a checkout."""
    return [str(checkout / ".venv" / "bin" / "gablework"), *words]


def rows(baseline: Path, data: Path, out: Path, city: Path | None) -> dict[str, Row]:
    """All rows except the demo."""
    east, west = str(data / "ahn3" / "delft_east.laz"), str(data / "ahn3" / "delft_west.laz")
    footprints, crs = str(data / "ahn3" / "footprints.gpkg"), ("--crs", "EPSG:7415")
    both = (east, west, *crs, "--meshes", "none")

    def command(label: str, *words: str) -> Row:
        ours, theirs = (
            program(one, *words, "--out", str(out / f"{one.name}-run"), "--overwrite", "--quiet")
            for one in (ROOT, baseline)
        )
        return Row(label, ours, theirs)

    def code(label: str, text: str, *, is_figure: bool = False) -> Row:
        return Row(label, *([str(one / ".venv/bin/python"), "-c", text] for one in (ROOT, baseline)), is_figure)

    buildings = BUILDINGS.format(tiles=[east, west], footprints=footprints)
    found = {
        "given": command("Both Delft tiles with footprints", "reconstruct", *both, "--footprints", footprints),
        "both": command("Both Delft tiles without footprints", "reconstruct", *both),
        "east": command("`delft_east`", "reconstruct", east, *crs),
        "classify": command("`classify` of `samp11`", "classify", str(data / "isprs" / "samp11-utm.laz")),
        "import": code("Import of what `reconstruct` needs", IMPORT),
        "buildings": code("Milliseconds per building, warm", buildings, is_figure=True),
    }
    if city is not None:
        found["city"] = command("City of 36 files", "reconstruct", str(city))
    return found


def measured(row: Row, baseline: Path, repeat: int) -> list[list[str]]:
    """The lines of a row: ratio of medians of runs in turns, after one run each that does not count."""
    ours, theirs = [], []
    for _ in range(repeat + 1):
        ours.append(cost(row.ours, ROOT))
        theirs.append(cost(row.theirs, baseline))
    return compared(row.label, ours[1:], theirs[1:], is_figure=row.is_figure)


def compared(label: str, ours: Sequence[Cost], theirs: Sequence[Cost], *, is_figure: bool = False) -> list[list[str]]:
    """Lines of the table: the medians of both versions and their ratio."""
    seconds: dict[str, Callable[[Cost], float]] = {
        "CPU, s": lambda one: one.processor_s,
        "wall, s": lambda one: one.wall_s,
    }
    lines = []
    for what, way in {"CPU, ms": lambda one: 1e3 * float(one.said)}.items() if is_figure else seconds.items():
        mine, other = (statistics.median(map(way, costs)) for costs in (ours, theirs))
        lines.append([f"{label}: {what}", f"{other:.2f}", f"{mine:.2f}", f"{mine / other:.2f}"])
    return lines


def demo(checkout: Path, folder: Path) -> Cost:
    """`make demo` in a fresh clone with empty caches."""
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run(["git", "clone", "--quiet", str(checkout), str(folder)], check=True)
    return cost(["make", "demo"], folder)


def demos(baseline: Path, out: Path, repeat: int) -> list[list[str]]:
    """The lines of the demo."""
    ours, theirs = [], []
    for _ in range(repeat):
        ours.append(demo(ROOT, out / "clone"))
        theirs.append(demo(baseline, out / "clone"))
    return compared("`make demo` in a fresh clone", ours, theirs)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--baseline", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--city", type=Path, help="the tiles that benchmarks/city_tiles.py made; without, no such row")
    parser.add_argument("--rows", nargs="*", help="demo, given, both, east, classify, import, buildings, city; all")
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    become_reaper()
    out, baseline = arguments.out.resolve(), arguments.baseline.resolve()
    out.mkdir(parents=True, exist_ok=True)
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    every = rows(baseline, arguments.data.resolve(), out, arguments.city)
    wanted = arguments.rows or ["demo", *every]
    unknown = [name for name in wanted if name not in {"demo", *every}]
    if unknown:
        sys.exit(f"unknown rows {unknown}: use demo, {', '.join(every)}")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before, medians of {arguments.repeat}\n")
    lines = []
    for name in wanted:
        is_demo = name == "demo"
        lines += (
            demos(baseline, out, arguments.repeat) if is_demo else measured(every[name], baseline, arguments.repeat)
        )
        print(f"{name} is measured", file=sys.stderr, flush=True)
    print(markdown_table(["", "before", "now", "ratio"], lines))


if __name__ == "__main__":
    main()
