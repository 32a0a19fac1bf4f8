"""Cost of starting up and of small jobs, beside an earlier version on the same machine within the same hour.

    python -m benchmarks.start_up --baseline CHECKOUT --out DIR [--data ../shared/data] [--rows NAME ...] [--repeat 3]
                                  [--alike]

CHECKOUT is another checkout of this repository with its environment (`make .venv/.run-stamp`), `d53c62d` for the
table in docs/results/start_up.md. Both versions run in turns; the ratio is that of the medians. Processor
seconds are those of a command and of everything that it starts, also of what outlives it for a moment: such processes
are waited for. Kernels are compiled already, except for the rows of the demo, which clone both checkouts and begin with
nothing. That version had no children, so its rows run with `--workers 0`; with `--alike` both versions run the same
commands, and each ratio is held against 1.02. A machine that others use at the same time still gives valid ratios of
processor seconds; those of wall seconds need a quiet one.
"""

from __future__ import annotations

import argparse
import ctypes
import dataclasses
import os
import resource
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_PR_SET_CHILD_SUBREAPER = 36

COUNTED = """
from numba.core import event

seen = []

class Counting(event.Listener):
    def on_start(self, event):
        seen.append(event.data["dispatcher"].py_func)

    def on_end(self, event):
        pass

event.register("numba:compile", Counting())
{code}
print(len({{(one.__module__, one.__qualname__) for one in seen if one.__module__.startswith("pipeline")}}), len(seen))
"""
ALL_OF_DEMO = """
from pipeline.compiler.warm_up import _compile, listed
for one in listed(["reconstruct", "simulate", "evaluate"]):
    _compile(one)
"""
ALL_OF_BASELINE = """
import sys
from service.cli import main
sys.argv = ["gablework", "warm-up", "--quiet"]
try:
    main()
except SystemExit:
    pass
"""
ENGINES = ("classify", "east", "given", "both", "city")
"""Rows whose job is also run by explicit numbers of workers."""
ALIKE = (1.02, 1.0)
"""Required and stretch where both versions run the same commands."""
IMPORT = "import pipeline.runtime.run"
BUILDINGS = """
import time
from benchmarks.candidates import found_scene
from pipeline.recipe import reconstruct_building
from pipeline.settings import RunSettings

settings = RunSettings()
found = found_scene({tiles!r}, "EPSG:7415", settings, {footprints!r}).candidates
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """A line of the table: two commands, and the marks of their ratio."""

    label: str
    ours: list[str]
    theirs: list[str]
    marks: dict[str, tuple[float, float]]
    """Required and stretch by what is compared: `CPU` or `wall`."""


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
    before, began = _processor_s(), time.perf_counter()
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    wall_s = time.perf_counter() - began
    while True:
        try:
            os.wait()
        except ChildProcessError:
            break
    if done.returncode:
        raise RuntimeError(f"{command} in {folder} ended with {done.returncode}: {done.stderr[-2000:]}")
    return Cost(_processor_s() - before, wall_s, done.stdout)


def _processor_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def program(checkout: Path, *words: str) -> list[str]:
    """A gablework command of a checkout."""
    return [str(checkout / ".venv" / "bin" / "gablework"), *words]


def rows(baseline: Path, data: Path, out: Path, city: Path | None, *, alike: bool) -> dict[str, Row]:
    """All rows but those that begin with nothing; `alike`: both versions run the same commands."""
    east, west = data / "ahn3" / "delft_east.laz", data / "ahn3" / "delft_west.laz"
    crs = ("--crs", "EPSG:7415")

    def run(checkout: Path, command: str, *words: str) -> list[str]:
        made = out / f"{checkout.name}-run"
        return program(checkout, command, *words, "--out", str(made), "--overwrite", "--quiet")

    def against_serial(command: str, *words: str) -> tuple[list[str], list[str]]:
        way = () if alike else ("--workers", "0")
        return run(ROOT, command, *words), run(baseline, command, *words, *way)

    both = (str(east), str(west), *crs, "--meshes", "none")
    footprints = data / "ahn3" / "footprints.gpkg"
    found = {}
    ours, theirs = against_serial("reconstruct", *both, "--footprints", str(footprints))
    marks = {"CPU": (0.84, 0.60), "wall": (0.90, 0.55)}
    found["given"] = Row(
        label="Both Delft tiles with footprints, default options", ours=ours, theirs=theirs, marks=marks
    )
    ours, theirs = against_serial("reconstruct", *both)
    marks = {"wall": (0.65, 0.55)}
    found["both"] = Row(
        label="Both Delft tiles without footprints, default options", ours=ours, theirs=theirs, marks=marks
    )
    ours, theirs = against_serial("reconstruct", str(east), *crs)
    marks = {"CPU": (0.9, 0.6), "wall": (0.9, 0.6)}
    found["east"] = Row(label="`delft_east`, default options", ours=ours, theirs=theirs, marks=marks)
    ours, theirs = against_serial("classify", str(data / "isprs" / "samp11-utm.laz"))
    marks = {"CPU": (0.7, 0.4)}
    found["classify"] = Row(label="`classify` of `samp11`, default options", ours=ours, theirs=theirs, marks=marks)
    ours, theirs = ([str(one / ".venv/bin/python"), "-c", IMPORT] for one in (ROOT, baseline))
    marks = {"CPU": (0.6, 0.4)}
    found["import"] = Row(label="Import of what `reconstruct` needs", ours=ours, theirs=theirs, marks=marks)
    code = BUILDINGS.format(tiles=[str(east), str(west)], footprints=str(footprints))
    ours, theirs = ([str(one / ".venv/bin/python"), "-c", code] for one in (ROOT, baseline))
    marks = {"said": (1.05, 0.95)}
    found["buildings"] = Row(label="Milliseconds per building, warm", ours=ours, theirs=theirs, marks=marks)
    if city is not None:
        ours, theirs = (run(one, "reconstruct", str(city)) for one in (ROOT, baseline))
        marks = {"wall": (1.0, 0.9)}
        found["city"] = Row(label="City of 36 files", ours=ours, theirs=theirs, marks=marks)
    if alike:
        found = {name: dataclasses.replace(row, marks=dict.fromkeys(row.marks, ALIKE)) for name, row in found.items()}
    return found


def measured(row: Row, baseline: Path, repeat: int) -> list[list[str]]:
    """The lines of a row: ratio of medians of runs in turns, after one run each that does not count."""
    for command, folder in ((row.ours, ROOT), (row.theirs, baseline)):
        cost(command, folder)
    ours, theirs = [], []
    for _ in range(repeat):
        ours.append(cost(row.ours, ROOT))
        theirs.append(cost(row.theirs, baseline))
    ways: dict[str, Callable[[Cost], float]] = {
        "CPU": lambda one: one.processor_s,
        "wall": lambda one: one.wall_s,
        "said": lambda one: float(one.said),
    }
    lines = []
    for what in {"CPU", "wall"} | row.marks.keys() if "said" not in row.marks else row.marks:
        way = ways[what]
        mine, other = (statistics.median(map(way, costs)) for costs in (ours, theirs))
        required, stretch = row.marks.get(what, (None, None))
        scale, unit = (1000.0, "ms") if what == "said" else (1.0, "s")
        lines.append(
            line(
                f"{row.label}: {'CPU' if what == 'said' else what}",
                mine * scale,
                other * scale,
                unit,
                required,
                stretch,
            )
        )
    return sorted(lines)


def engines(every: dict[str, Row], repeat: int) -> list[list[str]]:
    """Lines of wall seconds: what `auto` takes, both explicit choices, and its ratio to the better of them."""
    lines = []
    for name in ENGINES:
        if name not in every:
            continue
        ways = [every[name].ours, *([*every[name].ours, "--workers", count] for count in ("0", "2"))]
        walls: list[list[float]] = [[] for _ in ways]
        for turn in range(repeat + 1):
            for way, found in zip(ways, walls, strict=True):
                wall_s = cost(way, ROOT).wall_s
                if turn:
                    found.append(wall_s)
        auto, *explicit = map(statistics.median, walls)
        label = every[name].label.removesuffix(", default options")
        lines.append([label, *(f"{wall:.2f} s" for wall in (auto, *explicit)), f"{auto / min(explicit):.2f}"])
    return lines


def line(label: str, mine: float, other: float, unit: str, required: float | None, stretch: float | None) -> list[str]:
    """A line of the table."""
    marks = ["" if mark is None else f"{mark:.2f}" for mark in (required, stretch)]
    return [label, f"{other:.2f} {unit}", f"{mine:.2f} {unit}", f"{mine / other:.2f}", *marks]


def demo(checkout: Path, folder: Path) -> Cost:
    """`make demo` in a fresh clone with empty caches."""
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run(["git", "clone", "--quiet", str(checkout), str(folder)], check=True)
    return cost(["make", "demo"], folder)


def compiled(checkout: Path, code: str, folder: Path) -> list[str]:
    """How many kernels of ours and how many functions in all one process compiles that has none, by numba's events."""
    shutil.rmtree(folder, ignore_errors=True)
    command = [str(checkout / ".venv/bin/python"), "-c", COUNTED.format(code=code)]
    return cost(command, checkout, {"NUMBA_CACHE_DIR": str(folder)}).said.split()[-2:]


def demos(baseline: Path, out: Path, repeat: int) -> list[list[str]]:
    """The lines of the demo."""
    found: dict[Path, list[Cost]] = {ROOT: [], baseline: []}
    for _ in range(repeat):
        for checkout, made in found.items():
            made.append(demo(checkout, out / "clone"))
    ours, theirs = found[ROOT], found[baseline]
    lines = []
    for label, marks, way in (
        ("`make demo` in a fresh clone: CPU", (0.55, 0.30), lambda one: one.processor_s),
        ("`make demo` in a fresh clone: wall", (0.35, 0.22), lambda one: one.wall_s),
    ):
        mine, other = (statistics.median(map(way, costs)) for costs in (ours, theirs))
        lines.append(line(label, mine, other, "s", *marks))
    before, now = compiled(baseline, ALL_OF_BASELINE, out / "kernels"), compiled(ROOT, ALL_OF_DEMO, out / "kernels")
    lines.append(["Kernels that the demo needs", before[0], now[0], "", "300", "200"])
    lines.append(["Compilations for them, numba's own helpers included", before[1], now[1], "", "450", "300"])
    return lines


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--baseline", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--city", type=Path, help="the tiles that benchmarks/city_tiles.py made; without, no such row")
    parser.add_argument(
        "--rows", nargs="*", help="demo, given, both, east, classify, import, buildings, city, engines; all"
    )
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--alike", action="store_true", help="both versions run the same commands")
    arguments = parser.parse_args()
    become_reaper()
    out, baseline = arguments.out.resolve(), arguments.baseline.resolve()
    out.mkdir(parents=True, exist_ok=True)
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    every = rows(baseline, arguments.data.resolve(), out, arguments.city, alike=arguments.alike)
    known = ["demo", *every, "engines"]
    wanted = arguments.rows or known
    unknown = [name for name in wanted if name not in known]
    if unknown:
        sys.exit(f"unknown rows {unknown}: use {', '.join(known)}")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before, medians of {arguments.repeat}")
    table("", "before", "now", "ratio", "required", "stretch")
    for name in wanted:
        if name == "engines":
            continue
        lines = (
            demos(baseline, out, arguments.repeat)
            if name == "demo"
            else measured(every[name], baseline, arguments.repeat)
        )
        for cells in lines:
            reported(cells)
    if "engines" in wanted:
        table("wall", "`--workers auto`", "`--workers 0`", "`--workers 2`", "`auto` to the better of both")
        for cells in engines(every, arguments.repeat):
            reported(cells)


def table(*heads: str) -> None:
    """Begin a table."""
    print()
    reported(heads)
    reported(["---"] * len(heads))


def reported(cells: Sequence[str]) -> None:
    """Print a line of a table."""
    print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
