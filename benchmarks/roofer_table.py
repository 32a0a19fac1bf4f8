"""The methods beside roofer 1.1.0-beta.1 on real points: `python -m benchmarks.roofer_table --out DIR`.

    [--data ../shared/data] [--survey delft] [--methods METHOD[:PRESET] ...] [--skip PART ...] [--repeat 3]
    [--page FILE]

roofer's figures were measured once on `delft_west` and `delft_east` with the given footprints and the file's classes;
its times were those of another machine and are left out. The methods are run here. A survey without given footprints is
compared with the outlines of its own class 6, and has no figures of roofer.

- Processor seconds are those of a whole run of the command line, serial, in a separate process, including its children:
  the minimum of `--repeat` runs after one that compiled what was missing. GABLEWORK_PYTHON names the interpreter of
  another environment, such as one without the tools of the tests, which some libraries load where they find them.
- Milliseconds per building are processor time of `reconstruct_building` in this process, for the candidates that the
  stages of a run find; the minimum of `--repeat` times of each building counts.
- Delivered buildings are ok and LoD2.2; valid ones have solids that keep all rules, by our own checker, and by val3dity
  if GABLEWORK_VAL3DITY names that program.
- Scores are over all points of class 6 inside the outlines, against the highest roof there; a point without a roof is a
  miss. Top-visible points have no other one of the same building more than 1.1 m higher within 0.5 m in plan.
- Thinned surveys keep the points whose hash of their place is small, of all classes alike (`thinned_surveys.py`), so
  that class 6 inside the outlines has the stated density; the score is over the points of the whole survey.

Writes DIR/roofer_table_<survey>.md and the same figures as .json.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.entries import Entry, Workplace, fill_page, markdown_table, run_settings
from benchmarks.run_scores import RunScore, score_run
from benchmarks.survey_runs import Seconds, candidates_of, run_survey
from benchmarks.thinned_surveys import roof_density, thinned, write_changed
from pipeline.extras.compare.compare import Variant, settings_of
from pipeline.io import ReadOptions
from pipeline.model import FloatArray
from pipeline.recipe import reconstruct_building
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.reference_points import read_points_reference

PARTS = ("times", "seconds", "thinned")
"""What can be left out."""


def surveys(data: Path) -> dict[str, Entry]:
    """The real surveys with building classes, by name."""
    delft = tuple(data / "ahn3" / f"{name}.laz" for name in ("delft_west", "delft_east"))
    entries = (
        Entry(name="delft", tiles=delft, crs="EPSG:7415", footprints=data / "ahn3" / "footprints.gpkg"),
        Entry(name="hdf_870000", tiles=(data / "ign" / "hdf_870000_6617100.laz",)),
        Entry(name="hd_770500", tiles=(data / "ign" / "hd_770500_6277500.laz",)),
    )
    return {entry.name: entry for entry in entries}


# --------------------------------------------------------------------------------------------------------- measuring


def building_times(entry: Entry, variants: Sequence[Variant], repeat: int) -> dict[str, FloatArray]:
    """Processor seconds per building (n,) of each method, by label: the shortest of `repeat` times after one more.

    The methods take turns candidate by candidate, so other work on the machine slows all alike.
    """
    candidates = [candidate for candidate in candidates_of(entry, run_settings(entry)) if len(candidate.points)]
    ways = {one: settings_of(run_settings(entry), one).building for one in variants}
    took_s = {one: np.empty((repeat + 1, len(candidates))) for one in variants}
    for turn in range(repeat + 1):
        for number, candidate in enumerate(candidates):
            for one in variants:
                began = time.process_time()
                reconstruct_building(candidate, one.method, ways[one])
                took_s[one][turn, number] = time.process_time() - began
    return {one.label: times[1:].min(axis=0) for one, times in took_s.items()}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figures:
    """All that is measured of one method on one survey. What was left out is None or empty."""

    whole: RunScore
    """The survey as it is."""
    warm: Seconds | None = None
    """The cheapest of several runs that found all caches filled."""
    mean_ms: float = math.nan
    """Processor time of a building."""
    median_ms: float = math.nan
    """Its median."""
    thinned: Mapping[str, RunScore] = dataclasses.field(default_factory=dict)
    """By the density."""


def thinned_surveys(entry: Entry, reference: Reference, place: Workplace) -> dict[str, Entry]:
    """The thinned surveys, by their density. Writes their files."""
    found, surveys = roof_density(reference).per_m2, {}
    for name, wanted in ((f"{wanted:g}", wanted) for wanted in THINNED if wanted < found):
        tiles = write_changed(entry.tiles, place.root / "surveys" / entry.name / name, thinned(wanted / found))
        surveys[name] = dataclasses.replace(entry, name=f"{entry.name}-{name}", tiles=tiles)
    return surveys


def measure(
    entry: Entry,
    sparser: Mapping[str, Entry],
    variant: Variant,
    reference: Reference,
    place: Workplace,
    arguments: argparse.Namespace,
) -> Figures:
    """Run one method on a survey and all that is made of it; the milliseconds are measured elsewhere."""
    val3dity = os.environ.get("GABLEWORK_VAL3DITY")
    out, skip = place.run(variant, entry), arguments.skip
    first = run_survey(entry, variant, out)
    reported(variant, entry, first)
    warm = None
    if "seconds" not in skip:
        runs = [run_survey(entry, variant, out) for _ in range(arguments.repeat)]
        warm = min(runs, key=lambda run: run.processor)
        reported(variant, entry, warm)
    whole = score_run(out, reference, val3dity)
    scores = {}
    for name, survey in sparser.items():
        reported(variant, survey, run_survey(survey, variant, place.run(variant, survey)))
        scores[name] = score_run(place.run(variant, survey), reference, val3dity)
    return Figures(whole=whole, warm=warm, thinned=scores)


def reported(variant: Variant, entry: Entry, seconds: Seconds) -> None:
    """Say on the terminal that a run is done."""
    print(f"{variant.label} on {entry.name}: {seconds.processor:.1f} CPU s, {seconds.clock:.1f} s", flush=True)


# ------------------------------------------------------------------------------------------------------------- table


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """A line of the table."""

    label: str
    """What is measured."""
    roofer: str = ""
    """roofer's figure on `delft`."""
    cell: Callable[[Figures], str]
    """A method's figure; empty where it was left out."""


def number(value: float, digits: int = 3) -> str:
    """A figure; empty for nan."""
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def _seconds(one: Seconds | None) -> str:
    return "" if one is None else f"{one.processor:.1f}"


def _milliseconds(found: Figures) -> str:
    return "" if math.isnan(found.mean_ms) else f"{number(found.mean_ms, 1)} / {number(found.median_ms, 1)}"


def _lod2(score: RunScore) -> str:
    return f"{score.lod2} of {score.candidates}"


def _reasons(score: RunScore) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in score.reasons.items()) or "none"


def _within(score: RunScore) -> str:
    return number(score.within)


def _judged(own: int, other: int | None, whole: int) -> str:
    """How many are valid by the own checker and by val3dity."""
    return f"{own} / {'not run' if other is None else other} of {whole}"


def _valid_elsewhere(found: Figures) -> str:
    """Models of the thinned surveys that are valid."""
    scores = list(found.thinned.values())
    if not scores:
        return ""
    others = [score.models_val3dity for score in scores if score.models_val3dity is not None]
    own, whole = sum(score.models_valid for score in scores), sum(score.models for score in scores)
    return _judged(own, sum(others) if len(others) == len(scores) else None, whole)


def _thinned(name: str, cell: Callable[[RunScore], str], found: Figures) -> str:
    """A figure of a thinned survey; empty where there is none."""
    return cell(found.thinned[name]) if name in found.thinned else ""


THINNED: Mapping[float, tuple[str, str]] = {
    4.0: ("157", ".75"),
    2.0: ("136", ".53"),
    1.0: ("63", ".34"),
    0.5: ("0", ""),
}
"""By class-6 points per square metre: what roofer delivers, and the share of points within 0.2 m of it."""


def _thinned_rows() -> Iterator[Row]:
    for per_m2, (delivered, within) in THINNED.items():
        name, head = f"{per_m2:g}", f"{per_m2:g} class-6 points per m2"
        yield Row(label=f"{head}: LoD2.2", roofer=delivered, cell=partial(_thinned, name, _lod2))
        yield Row(label=f"{head}: reasons of the others", cell=partial(_thinned, name, _reasons))
        yield Row(label=f"{head}: within 0.2 m of the full cloud", roofer=within, cell=partial(_thinned, name, _within))


def _valid(found: Figures) -> str:
    return _judged(found.whole.valid, found.whole.val3dity, found.whole.lod2)


ROWS: tuple[Row, ...] = (
    # roofer's times were those of another machine
    Row(label="CPU seconds in all, warm", cell=lambda found: _seconds(found.warm)),
    Row(label="reconstruction of a building, ms, mean / median", cell=_milliseconds),
    Row(label="LoD2.2", roofer="160 of 160", cell=lambda found: _lod2(found.whole)),
    Row(label="valid of these, own checker / val3dity", roofer="160 of 160", cell=_valid),
    Row(label="within 0.2 m of all class-6 points", roofer=".814", cell=lambda found: _within(found.whole)),
    Row(label="at this many roof faces", roofer="588", cell=lambda found: str(found.whole.roof_faces)),
    Row(label="points with a roof", cell=lambda found: number(found.whole.coverage)),
    Row(label="top-visible points within 0.2 m", roofer=".894", cell=lambda found: number(found.whole.within_top)),
    Row(
        label="top-visible points, median RMSE of a building, m",
        roofer=".367",
        cell=lambda found: number(found.whole.rmse_top_median_m),
    ),
    Row(
        label="all points, median RMSE of a building, m",
        roofer=".754",
        cell=lambda found: number(found.whole.rmse_median_m),
    ),
    *_thinned_rows(),
    Row(label="models of these thinned surveys that are valid, own checker / val3dity", cell=_valid_elsewhere),
)
"""The table, line by line."""


def roofer_table(found: Mapping[str, Figures], *, with_roofer: bool) -> str:
    """The figures of all methods, by label, as Markdown; `with_roofer` on the survey of roofer's figures."""
    lines = []
    for row in ROWS:
        cells = [row.cell(figures) for figures in found.values()]
        if any(cells):
            lines.append([row.label, *([row.roofer] if with_roofer else []), *cells])
    heads = ["", *(["roofer 1.1.0-beta.1"] if with_roofer else []), *found]
    return markdown_table(heads, lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--survey", choices=tuple(surveys(Path())), default="delft")
    parser.add_argument("--methods", nargs="+", metavar="METHOD[:PRESET]", default=["fuzzy-sart"])
    parser.add_argument("--skip", nargs="+", choices=PARTS, default=[], help="parts that are left out")
    parser.add_argument("--repeat", type=int, default=3, help="times over; the shortest time counts")
    parser.add_argument("--page", type=Path, help="fill in this page of results")
    arguments = parser.parse_args(argv)
    entry, place = surveys(arguments.data)[arguments.survey], Workplace(root=arguments.out)
    variants = [Variant.parse(text) for text in arguments.methods]
    reference = read_points_reference(entry.tiles, footprints=entry.footprints, read_options=ReadOptions(crs=entry.crs))
    density = roof_density(reference)
    head = (
        f"{entry.name}: {len(reference.buildings)} outlines ({reference.outlines}), {density.points} points of "
        f"class 6 in {density.area_m2:.0f} m2 of them, {density.per_m2:.2f} per m2; {os.cpu_count()} cores, "
        f"{platform.machine()}, load {os.getloadavg()[0]:.1f} before.\n"
    )
    print(head, flush=True)
    sparser = {} if "thinned" in arguments.skip else thinned_surveys(entry, reference, place)
    found = {variant.label: measure(entry, sparser, variant, reference, place, arguments) for variant in variants}
    if "times" not in arguments.skip:
        for label, took_s in building_times(entry, variants, arguments.repeat).items():
            mean, median = (1e3 * float(of(took_s)) for of in (np.mean, np.median))
            found[label] = dataclasses.replace(found[label], mean_ms=mean, median_ms=median)
    text = f"{head}\n{roofer_table(found, with_roofer=entry.name == 'delft')}"
    print(text)
    place.root.mkdir(parents=True, exist_ok=True)
    target = place.root / f"roofer_table_{entry.name}"
    target.with_suffix(".md").write_text(text, encoding="utf-8")
    figures = {label: dataclasses.asdict(one) for label, one in found.items()}
    target.with_suffix(".json").write_text(json.dumps(figures, indent=1), encoding="utf-8")
    if arguments.page is not None:
        fill_page(arguments.page, place.root)
    return 0


if __name__ == "__main__":
    sys.exit(main())
