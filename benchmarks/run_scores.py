"""What a run delivered, how near it is to the measured roofs, and which buildings two runs make differently."""

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
from pipeline.ruler.evaluation.residuals import BuildingResiduals, building_residuals
from pipeline.ruler.evaluation.validity import validity
from pipeline.runtime.digest import NOT_CONTENT

LOD2 = "2.2"
"""The level of detail that counts as delivered."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingScore:
    """One reference building: how near the models are to its roof points."""

    points: int
    """Roof points inside its outline."""
    within: float
    """Share of them within 0.2 m of a roof; without a roof is a miss; nan without points."""
    within_top: float
    """The same of the top-visible ones."""
    rmse_top_m: float
    """Root mean square distance of the top-visible ones that a roof covers; nan without any."""


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
    buildings: Mapping[str, BuildingScore]
    """By the name of the reference building."""


def score_run(run: Path, reference: Reference, val3dity: str | None = None) -> RunScore:
    """Hold a run directory against the roof points of a reference.

    All points of class 6 inside the outlines count, those at the end of the data too.

    Parameters
    ----------
    run : Path
        The run directory.
    reference : Reference
        With points.
    val3dity : str, optional
        The program.

    Raises
    ------
    RunError
        The run cannot be read.
    RuntimeError
        val3dity does not answer.
    """
    found = read_models(run)
    lod2 = {model.building_id for model in found.models if _is_lod2(model)}
    valid = {row.building_id for row in validity(found) if row.is_valid}
    by_val3dity = None if val3dity is None else valid_by_val3dity(run, val3dity)
    rows = building_residuals(found.models, reference)
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
        points=sum(row.all_points.n_points for row in rows),
        coverage=_ratio(sum(row.all_points.n_covered for row in rows), sum(row.all_points.n_points for row in rows)),
        within=_ratio(sum(row.all_points.n_within for row in rows), sum(row.all_points.n_points for row in rows)),
        within_top=_ratio(sum(row.top_visible.n_within for row in rows), sum(row.top_visible.n_points for row in rows)),
        rmse_median_m=_median([row.all_points.rmse_m for row in rows]),
        rmse_top_median_m=_median([row.top_visible.rmse_m for row in rows]),
        buildings={row.building_id: _building(row) for row in rows},
    )


def _is_lod2(model: RoofModel) -> bool:
    return model.status.has_roof and model.lod == LOD2


def _building(row: BuildingResiduals) -> BuildingScore:
    return BuildingScore(
        points=row.all_points.n_points,
        within=row.all_points.share_within,
        within_top=row.top_visible.share_within,
        rmse_top_m=row.top_visible.rmse_m,
    )


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _median(values: list[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.median(known)) if known else math.nan


def valid_by_val3dity(run: Path, program: str) -> set[str]:
    """The buildings of a run that val3dity finds valid, by their ids.

    Its exit code says nothing about validity, so its report is read.

    Parameters
    ----------
    run : Path
        A run directory; its CityJSONSeq is judged, with val3dity's own tolerances.
    program : str
        val3dity, 2.5 or later: older ones know no CityJSONSeq.

    Raises
    ------
    RuntimeError
        A file has no report, or faults as a whole.
    """
    valid: set[str] = set()
    for file in sorted(run.glob("cityjson/*/*.city.jsonl")):
        with tempfile.TemporaryDirectory(prefix="gablework-") as folder:
            report = Path(folder, "report.json")
            reported = subprocess.run(
                [program, str(file), "--report", str(report)], capture_output=True, text=True, check=False
            )
            if not report.exists():
                raise RuntimeError(f"{program} gives no report of {file}: {(reported.stdout + reported.stderr)[-300:]}")
            valid |= valid_features(json.loads(report.read_text(encoding="utf-8")))
    return valid


def valid_features(report: Mapping[str, Any]) -> set[str]:
    """The ids of the valid features of a report of val3dity.

    Raises
    ------
    RuntimeError
        The report has faults of the file as a whole: none of its features was judged.
    """
    if report["dataset_errors"]:
        raise RuntimeError(f"val3dity on {report['input_file']}: {report['dataset_errors']}")
    return {feature["id"] for feature in report["features"] if feature["validity"]}


def differing_buildings(one: Path, other: Path) -> set[str]:
    """The buildings that two runs made differently, or that only one of them has, by their ids.

    What counts is what `gablework digest` counts: all columns of the records and the planes but those that may differ
    between tilings.
    """
    first, second = _contents(one), _contents(other)
    return {name for name in first.keys() | second.keys() if first.get(name) != second.get(name)}


def _contents(run: Path) -> dict[str, list[str]]:
    """Each building's rows as texts that tell every bit of a number."""
    rows: dict[str, list[str]] = {}
    for table in ("buildings", "planes"):
        for row in read_table(str(run), table).to_pylist():
            reported = sorted((name, value) for name, value in row.items() if name not in NOT_CONTENT)
            rows.setdefault(row["building_id"], []).append(f"{table} {reported!r}")
    return rows


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScoreLoss:
    """How much less of the roofs a run meets than another one with more input, building by building."""

    buildings: int
    """Reference buildings with roof points."""
    within_5_points: int
    """Those whose share of points within 0.2 m is at most 0.05 less; better ones too."""
    within_2_points: int
    """Those where it is at most 0.02 less."""
    mean: float
    """Mean loss of a building's share, points within 0.2 m; negative where the run is better; nan without buildings."""
    median: float
    """Median loss."""


def score_loss(more_input: RunScore, less_input: RunScore) -> ScoreLoss:
    """Compare two runs on the same reference building by building."""
    lost = np.array(
        [
            one.within - less_input.buildings[name].within
            for name, one in more_input.buildings.items()
            if one.points and not math.isnan(one.within)
        ]
    )
    rounding = 1e-9
    return ScoreLoss(
        buildings=len(lost),
        within_5_points=int((lost <= 0.05 + rounding).sum()),
        within_2_points=int((lost <= 0.02 + rounding).sum()),
        mean=float(lost.mean()) if len(lost) else math.nan,
        median=float(np.median(lost)) if len(lost) else math.nan,
    )
