"""What a run delivered, and how near it is to the measured roofs."""

from __future__ import annotations

import collections
import dataclasses
import json
import math
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.export.geoparquet import read_table
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.residual_scores import RMSE, building_residuals
from pipeline.ruler.evaluation.validity_scores import validity

LOD2 = "2.2"
"""The level of detail that counts as delivered."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunScore:
    """A run against the roof points of a reference."""

    candidates: int
    """Buildings that have a record: with given footprints one a footprint."""
    lod2: int
    """Those that are ok and LoD2.2."""
    reasons: Mapping[str, int]
    """Why the others are not: how many have each reason of the records."""
    valid: int
    """Those of LoD2.2 whose solids all keep the rules, by `pipeline.quality.validity`."""
    val3dity: int | None
    """The same by val3dity; None where the program is not at hand."""
    models: int
    """All that were delivered, blocks too."""
    models_valid: int
    """Those whose solids all keep the rules."""
    models_val3dity: int | None
    """The same by val3dity."""
    roof_faces: int
    """Roof faces of all models, blocks too; pieces of one plane that touch are one face."""
    points: int
    """Roof points of the reference."""
    coverage: float
    """Share of them that a roof covers."""
    within: float
    """Share of them within 0.2 m of the highest roof there; a point without a roof is a miss."""
    within_top: float
    """The same of the top-visible ones."""
    rmse_median_m: float
    """Median over the buildings of the root mean square distance of the covered points."""
    rmse_top_median_m: float
    """The same of the top-visible ones."""


def score_run(run: Path, reference: Reference, val3dity: str | None = None) -> RunScore:
    """Hold a run directory against the roof points of a reference; `val3dity` is the program, if it is there.

    All points of class 6 inside the outlines count, those at the end of the data too.
    """
    found = read_models(run)
    lod2 = {model.building_id for model in found.models if _is_lod2(model)}
    valid = {row.building_id for row in validity(found) if row.is_valid}
    by_val3dity = None if val3dity is None else valid_by_val3dity(run, val3dity)
    residuals = building_residuals(found.models, reference)
    (points, covered, within), (points_top, _, within_top) = (
        one.counts.sum(axis=0).tolist() for one in (residuals.all_points, residuals.top_visible)
    )
    reasons = collections.Counter(read_table(str(run), "buildings").column("reason").to_pylist())
    return RunScore(
        candidates=len(found.models) + len(found.failed),
        lod2=len(lod2),
        reasons={name: count for name, count in sorted(reasons.items(), key=str) if name is not None},
        valid=len(lod2 & valid),
        val3dity=None if by_val3dity is None else len(lod2 & by_val3dity),
        models=len(found.models),
        models_valid=len(valid),
        models_val3dity=None
        if by_val3dity is None
        else sum(model.building_id in by_val3dity for model in found.models),
        roof_faces=sum(len(model.surfaces) for model in found.models),
        points=points,
        coverage=_ratio(covered, points),
        within=_ratio(within, points),
        within_top=_ratio(within_top, points_top),
        rmse_median_m=_median(residuals.all_points.figure(RMSE).tolist()),
        rmse_top_median_m=_median(residuals.top_visible.figure(RMSE).tolist()),
    )


def _is_lod2(model: RoofModel) -> bool:
    return model.status.has_roof and model.lod == LOD2


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _median(values: list[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.median(known)) if known else math.nan


def val3dity_report(file: Path, program: str, *options: str) -> dict[str, Any]:
    """val3dity's report of a file of CityJSON or CityJSONSeq; RuntimeError if there is none.

    Its exit code says nothing about validity. Versions before 2.5 do not read CityJSONSeq.
    """
    with tempfile.TemporaryDirectory(prefix="gablework-") as folder:
        place = Path(folder, "report.json")
        done = subprocess.run(
            [program, str(file), "--report", str(place), *options], capture_output=True, text=True, check=False
        )
        if not place.exists():
            raise RuntimeError(f"{program} gives no report of {file}: {(done.stdout + done.stderr)[-300:]}")
        found: dict[str, Any] = json.loads(place.read_text(encoding="utf-8"))
        return found


def valid_by_val3dity(run: Path, program: str) -> set[str]:
    """The ids of the buildings whose CityJSONSeq val3dity finds valid; RuntimeError if it cannot judge a file."""
    valid: set[str] = set()
    for file in sorted(run.glob("cityjson/*/*.city.jsonl")):
        report = val3dity_report(file, program)
        if report["dataset_errors"]:
            raise RuntimeError(f"val3dity on {file}: {report['dataset_errors']}")
        valid |= {feature["id"] for feature in report["features"] if feature["validity"]}
    return valid
