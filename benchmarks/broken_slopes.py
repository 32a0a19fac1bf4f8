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

import dataclasses
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import shapely

from benchmarks.suite_surveys import asked, by_checkout, measured
from pipeline.model import BoolArray
from pipeline.ruler.evaluation.building_matching import MIN_SHARE, mostly_on, one_to_one, overlapping, sound_polygons
from pipeline.ruler.evaluation.face_matching import Planes, compared, flattened
from pipeline.ruler.evaluation.face_scores import MIN_FACE_POINTS
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.simulation.broken_slopes import CELLS
from pipeline.ruler.simulation.roofs import ROOF_TYPES, BrokenForm
from pipeline.ruler.simulation.sweep import Cell

MAX_ANGLE_DEG, MAX_OFFSET_M = 5.0, 0.15
LEAST_M2, LEAST_POINTS, LEAST_SPACINGS = 1.0, MIN_FACE_POINTS, 2.0
"""Least area in plan, points on it, and width of a face that counts."""

HEADS = ["all faces right", "faces found", "of faces right", "wrong per roof", "named"]


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


def line(name: str, rows: Sequence[Judged]) -> list[str]:
    """A line of a table."""
    wanted, right, wrong = (sum(getattr(row, key) for row in rows) for key in ("wanted", "right", "wrong"))
    shares = [sum(row.is_right for row in rows) / len(rows), right / max(wanted, 1), right / max(right + wrong, 1)]
    named = sum(row.is_named for row in rows) / len(rows)
    return [name, str(len(rows)), *(f"{share:.3f}" for share in shares), f"{wrong / len(rows):.2f}", f"{named:.3f}"]


def main() -> int:
    """Measure and print."""
    given, codes = asked(__doc__)

    def judge(run: Path, truth: Path, cell: Cell) -> list[Judged]:
        return list(judged(read_models(run).models, read_models(truth).models, cell.density_per_m2))

    by_checkout(measured(given, codes, "broken_slopes", CELLS, judge), codes, given.split, HEADS, line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
