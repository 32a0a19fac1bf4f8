"""The measured entries: scenes and tiles, each modelled by several methods and compared with its reference.

`ruler.py`, `hofmann_tables.py` and `roofer_table.py` share these parts. All work in one folder, where each finds the
results of the others; existing results are not computed again if the settings are the same (delete DIR after a change
of the code).

    DIR/scenes/<entry>/           the simulated scene and its truth, made once for all methods
    DIR/<label>/<entry>/run/      the run directory of a method (label: METHOD, or METHOD-PRESET)
    DIR/<label>/<entry>/report/   its measures as tables; with a page if the entry has one

A run is what `gablework compare` does: points are read, ground is found and candidates are isolated once for all
methods, then each models the same candidates. Each entry runs in one process; entries share the processors.
"""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.extras.compare.compare import Variant, run_variants, settings_of
from pipeline.io.source import ReadOptions
from pipeline.methods import METHODS
from pipeline.ruler.evaluation.evaluate import Evaluation, evaluate
from pipeline.ruler.evaluation.evaluation_writing import write_tables
from pipeline.ruler.evaluation.ground_scores import GroundOfRun
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.reference_points import read_points_reference
from pipeline.ruler.evaluation.reference_truth import read_truth_reference
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.sweep import CELLS, Cell
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.settings import RunSettings

GROUND = "ground."
"""Beginning of the names of the measures that are of the scene, not of a method."""
_PART = re.compile(r"(<!-- begin (\S+) -->\n).*?(<!-- end \2 -->)", re.DOTALL)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimulatedScene:
    """A scene that is made where it is not there yet."""

    suite: str
    """Name of the suite."""
    seed: int
    """Seed of the scene."""
    cell: Cell | None = None
    """Which survey of a suite of several."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entry:
    """A scene or some tiles, with what there is to hold models against."""

    name: str
    """Also its folder."""
    scene: SimulatedScene | None = None
    """What is simulated; None for real tiles."""
    tiles: tuple[Path, ...] = ()
    """Real tiles."""
    crs: str | None = None
    """Where the files tell none."""
    footprints: Path | None = None
    """Given outlines, for the run and the reference."""
    classes: str = "trust"
    """What the classes of the files are worth to the run."""
    points: tuple[Path, ...] = ()
    """Classified points as reference; none: a real entry is measured by itself."""
    has_page: bool = True
    """Whether there is a page to look at beside the tables."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Workplace:
    """The folder of all that is made."""

    root: Path

    def scene(self, entry: Entry) -> Path:
        """Folder of an entry's scene: its LAZ files and `truth`."""
        folder = self.root / "scenes" / entry.name
        return folder / entry.scene.cell.key if entry.scene is not None and entry.scene.cell is not None else folder

    def run(self, variant: Variant, entry: Entry) -> Path:
        """The run directory of a method."""
        return self.root / variant.label / entry.name / "run"

    def report(self, variant: Variant, entry: Entry) -> Path:
        """The tables of a method."""
        return self.root / variant.label / entry.name / "report"

    def is_run(self, variant: Variant, entry: Entry) -> bool:
        """Whether a run is there, whole and by these settings."""
        if not (self.run(variant, entry) / "run.json").exists():
            return False
        manifest, settings = self.manifest(variant, entry), settings_of(run_settings(entry), variant)
        return (manifest["status"], manifest["settings_hash"]) == ("finished", settings.settings_hash)

    def is_measured(self, variant: Variant, entry: Entry) -> bool:
        """Whether the measures of such a run are there: of all files of a report `report.md` is written last."""
        report = self.report(variant, entry) / "report.md"
        return self.is_run(variant, entry) and report.exists()

    def table(self, variant: Variant, entry: Entry, name: str) -> list[dict[str, Any]]:
        """The rows of a table of a report, such as `measures`; none where the entry has no such table."""
        path = self.report(variant, entry) / f"{name}.parquet"
        rows: list[dict[str, Any]] = pq.read_table(path).to_pylist() if path.exists() else []
        return rows

    def manifest(self, variant: Variant, entry: Entry) -> dict[str, Any]:
        """The run's own record."""
        path = self.run(variant, entry) / "run.json"
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return document


def hofmann_entries(split: str, draws: int) -> Iterator[Entry]:
    """Draws of `hofmann310`; the first is the one that the ruler measures too."""
    for draw in range(draws):
        yield Entry(
            name="hofmann310" if draw == 0 else f"hofmann310-{draw}",
            scene=SimulatedScene(suite="hofmann310", seed=seed_of(split, draw)),
            has_page=False,
        )


def sweep_entries(split: str, cells: Sequence[Cell] = CELLS) -> Iterator[Entry]:
    """Cells of `sweep`, the dense ones first: they take longest."""
    for cell in sorted(cells, key=lambda one: -one.density_per_m2):
        scene = SimulatedScene(suite="sweep", seed=seed_of(split, 0), cell=cell)
        yield Entry(name=f"sweep-{cell.key}", scene=scene, has_page=False)


def all_variants(*, with_faithful: bool) -> list[Variant]:
    """Every method with its default settings, and on demand each that has a paper as the paper has it."""
    return [
        Variant(method=name, preset=preset)
        for name, method in METHODS.items()
        for preset in method.presets[: None if with_faithful else 1]
    ]


def tiles_of(entry: Entry, place: Workplace) -> tuple[str, ...]:
    """The point files of an entry; its scene is simulated where it is not there yet."""
    if entry.scene is None:
        return tuple(str(tile) for tile in entry.tiles)
    folder, scene = place.scene(entry), entry.scene
    if not (folder / "truth" / "scene.json").exists():
        target = folder if scene.cell is None else folder.parent
        density = None if scene.cell is None else scene.cell.density_per_m2
        noise = None if scene.cell is None else scene.cell.noise_m
        simulate(scene.suite, target, scene.seed, density_per_m2=density, noise_m=noise)
    return tuple(sorted(str(path) for path in [*folder.glob("*.laz"), *folder.glob("tiles/*.laz")]))


def run_settings(entry: Entry) -> RunSettings:
    """The settings that find the candidates of an entry; those of the methods are their defaults."""
    return RunSettings.from_mapping({"classes": entry.classes})


def modelled(tile: Path, out: Path, *, classes: str = "ignore", **options: Any) -> None:
    """Model a file in this process, with default settings except for its classes; `options` are those of a request."""
    settings = RunSettings.from_mapping({"classes": classes})
    run(RunRequest(inputs=(str(tile),), out=str(out), settings=settings, resources=SERIAL, overwrite=True, **options))


def measure_entry(entry: Entry, variants: Sequence[Variant], place: Workplace) -> None:
    """Simulate, run and evaluate what is not there yet."""
    unmeasured = [variant for variant in variants if not place.is_measured(variant, entry)]
    to_run = [variant for variant in unmeasured if not place.is_run(variant, entry)]
    if to_run:
        folder = place.root / "scratch" / f"{entry.name}-{os.getpid()}"  # another program may be at the same entry
        folder.mkdir(parents=True, exist_ok=True)
        request = RunRequest(
            inputs=tiles_of(entry, place),
            out=str(folder),
            settings=run_settings(entry),
            footprints=None if entry.footprints is None else str(entry.footprints),
            crs=entry.crs,
            resources=SERIAL,
            meshes="none",
        )
        ways = {one: (str(place.run(one, entry)), settings_of(request.settings, one)) for one in to_run}
        for variant in to_run:  # of the measures nothing may be left that is of an earlier run
            shutil.rmtree(place.report(variant, entry), ignore_errors=True)
        run_variants(request, ways)
        shutil.rmtree(folder)
    if unmeasured:
        _evaluate(entry, unmeasured, place)


def _evaluate(entry: Entry, variants: Sequence[Variant], place: Workplace) -> None:
    """Hold the runs of an entry against one reference, read once; the ground is that of the scene, measured once."""
    reference = _reference(entry, place)
    found: Evaluation | None = None
    for variant in variants:
        models = read_models(place.run(variant, entry))
        if found is None and reference is not None and reference.has_ground:
            found = evaluate(models, reference, ground=GroundOfRun(reference, run_settings(entry).scene))
            evaluation = found
        else:
            evaluation = _with_ground(evaluate(models, reference), found)
        folder = place.report(variant, entry)
        if entry.has_page:
            from pipeline.ruler.report.evaluation_page import write_page

            write_page(evaluation, folder)
        write_tables(evaluation, folder)


def _reference(entry: Entry, place: Workplace) -> Reference | None:
    """What the models of an entry are held against."""
    if entry.scene is not None:
        return read_truth_reference(place.scene(entry) / "truth", as_surveyed=True)
    if not entry.points:
        return None
    return read_points_reference(
        [str(path) for path in entry.points],
        footprints=None if entry.footprints is None else str(entry.footprints),
        read_options=ReadOptions(crs=entry.crs),
    )


def _with_ground(evaluation: Evaluation, other: Evaluation | None) -> Evaluation:
    """An evaluation with the ground measures of another one of the same scene."""
    if other is None:
        return evaluation
    ground = tuple(measure for measure in other.measures if measure.name.startswith(GROUND))
    tables: dict[str, pa.Table] = dict(evaluation.tables)
    if "ground" in other.tables:
        tables["ground"] = other.tables["ground"]
    return dataclasses.replace(evaluation, measures=(*evaluation.measures, *ground), tables=tables)


def measure_all(wanted: Iterable[tuple[Entry, Sequence[Variant]]], place: Workplace, jobs: int) -> list[str]:
    """Measure many entries in `jobs` processes (0: in this one); returns what went wrong, a line per entry.

    The largest entries come first, so that no long one is left for the end.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    todo = [(entry, ways) for entry, ways in wanted if any(not place.is_measured(variant, entry) for variant in ways)]
    faults: list[str] = []
    if jobs == 0:
        for entry, ways in todo:
            measure_entry(entry, ways, place)
            print(f"{entry.name} is measured", flush=True)
        return faults
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        running = {pool.submit(measure_entry, entry, ways, place): entry for entry, ways in todo}
        for done in as_completed(running):
            error, name = done.exception(), running[done].name
            if error is not None:
                faults.append(f"{name}: {type(error).__name__}: {error}")
            print(f"{name} is measured" if error is None else faults[-1], flush=True)
    return faults


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def filled(page: str, out: Path) -> tuple[str, list[str]]:
    """A page whose text between `<!-- begin NAME -->` and `<!-- end NAME -->` is that of OUT/NAME.

    Also the names of parts without a file: they stay as they are.
    """
    missing = []

    def part(found: re.Match[str]) -> str:
        path = out / found[2]
        if not path.exists():
            missing.append(found[2])
            return found[0]
        return f"{found[1]}\n{path.read_text(encoding='utf-8').strip()}\n\n{found[3]}"

    return _PART.sub(part, page), missing


def fill_page(page: Path, out: Path) -> None:
    """Put measured tables into a page of results. Prose is left alone: read it again when the figures change."""
    text, missing = filled(page.read_text(encoding="utf-8"), out)
    page.write_text(text, encoding="utf-8")
    for name in missing:
        print(f"{out / name} is not there: its part stays as it is", file=sys.stderr)
