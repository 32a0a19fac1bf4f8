"""Roofs of the suite `curved_roofs`: how many are named right, and how their points lie about the models.

    python -m benchmarks.curved_roofs --out DIR [--split dev|test] [--draws 2] [--cells all|required] [--jobs 2]
                                      [--given] [--baseline CHECKOUT]

A draw is a scene with four buildings of each form under surveys of several densities and noises. A roof has the name of
the model that covers most of it; its residuals are that model's `noise_m`, which is over the noise of the survey. The
medians are those of all roofs, right or not. `--given` gives the true outlines.

`--baseline` models the scenes with another checkout as well. DIR/SPLIT.json has a row per building. Runs that are there
already are not repeated: delete them after a change of code.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from benchmarks.suite_surveys import asked, by_checkout, measured
from pipeline.ruler.evaluation.building_matching import overlapping, sound_polygons
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.simulation.curved_roofs import CELLS
from pipeline.ruler.simulation.roofs import ROOF_TYPES, CurvedForm
from pipeline.ruler.simulation.sweep import Cell

HEADS = ["named", "residuals over noise", "90 %", "faces", "ok"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judged:
    """The model of one building by one checkout."""

    code: str = ""
    building: str = ""
    form: str = ""
    per_m2: float = math.nan
    noise_m: float = math.nan
    roof_type: str = "none"
    """Of the model that covers most of it."""
    status: str = "none"
    residual_m: float = math.nan
    """Its `noise_m`."""
    faces: int = 0

    @property
    def is_named(self) -> bool:
        """Whether the roof type is that of its form."""
        return self.roof_type == ROOF_TYPES[CurvedForm(self.form)]


def judged(
    models: Sequence[RoofModel], houses: Sequence[RoofModel], records: Mapping[str, Mapping[str, Any]]
) -> Iterator[Judged]:
    """All true buildings beside the models that cover most of each; records are rows of `buildings` by their ids."""
    outlines = sound_polygons([house.footprint for house in houses])
    plans = overlapping(outlines, sound_polygons([model.footprint for model in models]))
    for number, house in enumerate(houses):
        here = np.flatnonzero(plans.first == number)
        form = house.building_id.rpartition("-")[0]
        if not len(here):
            yield Judged(building=house.building_id, form=form)
            continue
        model = models[plans.second[here[np.argmax(plans.common_m2[here])]]]
        record = records[model.building_id]
        yield Judged(
            building=house.building_id,
            form=form,
            roof_type=str(record["roof_type"]),
            status=str(record["status"]),
            residual_m=math.nan if record["noise_m"] is None else float(record["noise_m"]),
            faces=len(model.surfaces),
        )


def line(name: str, rows: Sequence[Judged]) -> list[str]:
    """A line of a table."""
    named = sum(row.is_named for row in rows) / len(rows)
    sound = sum(row.status == "ok" for row in rows) / len(rows)
    ratios = np.array([row.residual_m / row.noise_m for row in rows])
    ratios = ratios[np.isfinite(ratios)]
    median, most = (float(np.quantile(ratios, at)) if len(ratios) else math.nan for at in (0.5, 0.9))
    faces = float(np.median([row.faces for row in rows]))
    return [name, str(len(rows)), f"{named:.3f}", f"{median:.2f}", f"{most:.2f}", f"{faces:.0f}", f"{sound:.3f}"]


def main() -> int:
    """Measure and print."""
    given, codes = asked(__doc__)

    def judge(run: Path, truth: Path, cell: Cell) -> list[Judged]:
        del cell
        rows = pq.read_table(run / "buildings", columns=["building_id", "roof_type", "status", "noise_m"]).to_pylist()
        records = {row["building_id"]: row for row in rows}
        return list(judged(read_models(run).models, read_models(truth).models, records))

    by_checkout(measured(given, codes, "curved_roofs", CELLS, judge), codes, given.split, HEADS, line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
