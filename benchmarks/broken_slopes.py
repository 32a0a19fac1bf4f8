"""Roofs of the suite `broken_slopes`: how many have all faces right, and the name that a person would give.

    python -m benchmarks.broken_slopes --out DIR [--split dev|test] [--draws 2] [--cells all|required] [--jobs 2]
                                       [--given] [--baseline CHECKOUT]

A draw is a scene with four buildings of each form under surveys of several densities and noises. True faces and faces
of models are paired one to one, the largest common area first: each covers at least half of the other in plan, their
normals agree within 5 degrees and their mean offset is at most 0.15 m. A face counts if it has 1 m2 in plan, and the
area of 11 points, and is two spacings wide. All faces of a roof are right if each true face that counts is paired, and
each face of a model that counts, too. `--given` gives the true outlines.

`--baseline` models the scenes with another checkout as well. DIR/SPLIT.json has a row per building. Runs that are there
already are not repeated: delete them after a change of code.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import shapely

from benchmarks.entries import Entry, markdown_table
from benchmarks.survey_runs import ROOT, run_survey
from pipeline.extras.compare.compare import Variant
from pipeline.model import BoolArray
from pipeline.ruler.evaluation.building_matching import MIN_SHARE, mostly_on, one_to_one, overlapping, sound_polygons
from pipeline.ruler.evaluation.face_matching import Planes, compared, flattened
from pipeline.ruler.evaluation.face_scores import MIN_FACE_POINTS
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.simulation.broken_slopes import CELLS
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.roofs import ROOF_TYPES, BrokenForm
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.sweep import Cell
from pipeline.settings import RunSettings

REQUIRED = Cell(density_per_m2=8.0, noise_m=0.02)
"""The survey of the required figure."""
MAX_ANGLE_DEG, MAX_OFFSET_M = 5.0, 0.15
LEAST_M2, LEAST_POINTS, LEAST_SPACINGS = 1.0, MIN_FACE_POINTS, 2.0
"""Least area in plan, points on it, and width of a face that counts."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judged:
    """The faces that models of one checkout found of a building."""

    code: str = ""
    building: str = ""
    form: str = ""
    per_m2: float = math.nan
    noise_m: float = math.nan
    wanted: int = 0
    """True faces that count."""
    right: int = 0
    """These with a face of a model."""
    wrong: int = 0
    """Faces of models that count and have no true face."""
    roof_type: str = "none"
    """Of the model that covers most of it."""

    @property
    def is_right(self) -> bool:
        """Whether all its faces are right."""
        return self.right == self.wanted and self.wrong == 0

    @property
    def is_named(self) -> bool:
        """Whether the roof type is what a person calls it."""
        return self.roof_type == ROOF_TYPES[BrokenForm(self.form)]


def counted(faces: Planes, per_m2: float) -> BoolArray:
    """Which faces (n,) are large and wide enough to count."""
    narrow = shapely.is_empty(shapely.buffer(faces.polygon, -0.5 * LEAST_SPACINGS / math.sqrt(per_m2)))
    is_large: BoolArray = faces.plan_m2 >= max(LEAST_M2, LEAST_POINTS / per_m2)
    return is_large & ~narrow


def judged(models: Sequence[RoofModel], houses: Sequence[RoofModel], per_m2: float) -> Iterator[Judged]:
    """All true buildings beside all models."""
    true, made = flattened(houses), flattened(models)
    pairs = compared(true, made)
    fits = np.minimum(pairs.share_true, pairs.share_model) >= MIN_SHARE
    fits &= (pairs.angle_deg <= MAX_ANGLE_DEG) & (np.abs(pairs.offset_m) <= MAX_OFFSET_M)
    first, second, common = (values[fits] for values in dataclasses.astuple(pairs.overlaps)[:3])
    kept = one_to_one(first, second, common)
    found, sound = np.zeros(len(true.owner), bool), np.zeros(len(made.owner), bool)
    found[first[kept]], sound[second[kept]] = True, True
    wanted, wrong = counted(true, per_m2), counted(made, per_m2) & ~sound
    outlines = sound_polygons([house.footprint for house in houses])
    over = mostly_on(len(made.owner), overlapping(outlines, made.polygon))
    plans = overlapping(outlines, sound_polygons([model.footprint for model in models]))
    for number, house in enumerate(houses):
        own = true.owner == number
        here = np.flatnonzero(plans.first == number)
        most = here[np.argmax(plans.common_m2[here])] if len(here) else -1
        yield Judged(
            building=house.building_id,
            form=house.building_id.rpartition("-")[0],
            wanted=int((own & wanted).sum()),
            right=int((own & wanted & found).sum()),
            wrong=int((wrong & (over == number)).sum()),
            roof_type="none" if most < 0 else str(models[plans.second[most]].roof_type),
        )


def write_outlines(truth: Path, path: Path) -> None:
    """The true outlines as GeoJSON in the CRS of the scene."""
    features = [
        {"type": "Feature", "properties": {"id": one.building_id}, "geometry": shapely.geometry.mapping(one.footprint)}
        for one in read_models(truth).models
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}), encoding="utf-8")


def measured(given: argparse.Namespace, codes: dict[str, Path]) -> list[Judged]:
    """Make, model and judge all scenes of some draws, with every checkout."""
    variant, out = Variant(method=RunSettings().general.method), given.out.resolve()
    cells = CELLS if given.cells == "all" else (REQUIRED,)
    tasks = list(itertools.product(range(given.draws), cells, codes))
    for draw, cell in itertools.product(range(given.draws), cells):
        if not (out / f"{given.split}{draw}" / cell.key / "truth" / "scene.json").exists():
            chosen = {"density_per_m2": cell.density_per_m2, "noise_m": cell.noise_m}
            simulate("broken_slopes", out / f"{given.split}{draw}", seed_of(given.split, draw), **chosen)
        if given.given:
            survey = out / f"{given.split}{draw}" / cell.key
            write_outlines(survey / "truth", survey / "outlines.geojson")

    def one(task: tuple[int, Cell, str]) -> list[Judged]:
        draw, cell, code = task
        folder = out / f"{given.split}{draw}" / cell.key
        run = folder / f"models-{code}{'-given' if given.given else ''}"
        if not (run / "run.json").exists():
            outlines = folder / "outlines.geojson" if given.given else None
            entry = Entry(
                name=folder.name, tiles=(folder / "broken_slopes.laz",), classes="ignore", footprints=outlines
            )
            run_survey(entry, variant, run, codes[code])
        labels = {"code": code, "per_m2": cell.density_per_m2, "noise_m": cell.noise_m}
        found = judged(read_models(run).models, read_models(folder / "truth").models, cell.density_per_m2)
        return [dataclasses.replace(row, building=f"{draw}-{row.building}", **labels) for row in found]

    with ThreadPoolExecutor(given.jobs) as pool:
        return [row for rows in pool.map(one, tasks) for row in rows]


def line(name: str, rows: Sequence[Judged]) -> list[str]:
    """A line of a table."""
    wanted, right, wrong = (sum(getattr(row, key) for row in rows) for key in ("wanted", "right", "wrong"))
    shares = [sum(row.is_right for row in rows) / len(rows), right / max(wanted, 1), right / max(right + wrong, 1)]
    named = sum(row.is_named for row in rows) / len(rows)
    return [name, str(len(rows)), *(f"{share:.3f}" for share in shares), f"{wrong / len(rows):.2f}", f"{named:.3f}"]


def table(rows: Sequence[Judged], key: Callable[[Judged], str]) -> str:
    """A line per value of a key, in their order, and one of all."""
    names = list(dict.fromkeys(map(key, rows)))
    lines = [line(name, [row for row in rows if key(row) == name]) for name in names]
    heads = ["", "roofs", "all faces right", "faces found", "of faces right", "wrong per roof", "named"]
    return markdown_table(heads, [*lines, line("all", rows)])


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--cells", choices=("all", "required"), default="all")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--given", action="store_true", help="give the true outlines")
    parser.add_argument("--baseline", type=Path, help="another checkout of this repository")
    given = parser.parse_args()
    codes = {path.name: path for path in (ROOT, given.baseline and given.baseline.resolve()) if path}
    if given.baseline and len(codes) == 1:
        parser.error(
            f"--baseline {given.baseline} is called {ROOT.name}, as this checkout: give a folder of another name"
        )
    rows = measured(given, codes)
    (given.out / f"{given.split}.json").write_text(json.dumps(list(map(dataclasses.asdict, rows))), encoding="utf-8")
    for code in codes:
        own = [row for row in rows if row.code == code]
        required = [row for row in own if (row.per_m2, row.noise_m) == (REQUIRED.density_per_m2, REQUIRED.noise_m)]
        print(f"{code}, {given.split} seeds, by survey:\n")
        print(table(own, lambda row: f"{row.per_m2:g} per m2, {100 * row.noise_m:g} cm"))
        print(f"{code}, at {REQUIRED.density_per_m2:g} per m2 and {100 * REQUIRED.noise_m:g} cm, by form:\n")
        print(table(required, lambda row: row.form))
    return 0


if __name__ == "__main__":
    sys.exit(main())
