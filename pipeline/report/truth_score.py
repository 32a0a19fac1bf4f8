"""Models scored against exact truth: what was found, what it was taken for, and how far its roof is off.

Definitions follow the comparison of building extraction by Rutzinger, Rottensteiner and Pfeifer (2009): a building is
found where footprints overlap by an intersection over union (IoU) of at least one half; a roof face where the overlap
is at least half of both faces, the normals agree within 10 deg and the offset within 0.3 m, one to one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import BoolArray, FloatArray, RoofType
from pipeline.report.roof_models import RoofModel, RoofSurface

MIN_IOU = 0.5
"""Overlap from which on a building is found."""
MIN_FACE_OVERLAP = 0.5
"""Share of both faces that must overlap."""
MAX_NORMAL_ANGLE_DEG = 10.0
"""Largest angle between the normals of a face and its match."""
MAX_OFFSET_M = 0.3
"""Largest distance between a face and its match, across the plane."""
MIN_FACE_AREA_M2 = 10.0
"""Smaller true faces need not be found, smaller faces of a model are not wrong."""
GOOD_M = 0.2
"""Vertical distance that still counts as right."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingScore:
    """One true building and what was made of it. Figures of a building that was not found are nan or 0."""

    building_id: str
    """Of the truth."""
    model_id: str | None
    """Of the model; None where it was not found."""
    iou: float
    """Intersection over union with the model, 0 where not found."""
    true_type: RoofType
    """Its roof type."""
    model_type: RoofType
    """What the model says; none where not found."""
    true_faces: int
    """Faces of at least 10 m2."""
    model_faces: int
    """Faces of the model of at least 10 m2."""
    matched_faces: int
    """True faces that were found."""
    coverage: float
    """Share of the true roof (in plan) that the model's roof covers."""
    within_good: float
    """Share of the true roof (in plan) where the model is within 0.2 m; uncovered is a miss."""
    median_m: float
    """Median absolute vertical difference where covered."""
    bias_m: float
    """Mean vertical difference, model minus truth."""
    rmse_m: float
    """Root mean square vertical difference."""
    touches_data_edge: bool
    """As the truth's."""

    @property
    def found(self) -> bool:
        """Whether a model stands for it."""
        return self.model_id is not None

    @property
    def type_right(self) -> bool:
        """Whether it was found and its roof type is right."""
        return self.found and self.true_type == self.model_type


@dataclasses.dataclass(frozen=True, kw_only=True)
class TruthScore:
    """The score of a whole scene."""

    buildings: tuple[BuildingScore, ...]
    """One a true building, in the order of the truth."""
    false_alarms: tuple[str, ...]
    """Models of which less than half stands on any true building."""
    unmatched: tuple[str, ...]
    """Models that stand on true buildings, but match none: parts of one, or several in one."""
    median_m: float
    """Median absolute vertical difference over all covered roofs of found buildings; nan without any."""
    rmse_m: float
    """Root mean square of the same differences."""

    @property
    def counted(self) -> tuple[BuildingScore, ...]:
        """The buildings that had to be found: those not cut by the end of the data."""
        return tuple(score for score in self.buildings if not score.touches_data_edge)

    def table(self) -> list[tuple[str, str]]:
        """What the demo prints: a name and a figure a row."""
        counted = self.counted
        found = [score for score in counted if score.found]
        faces, matched = sum(s.true_faces for s in counted), sum(s.matched_faces for s in counted)
        made = sum(s.model_faces for s in found)
        within = _mean([s.within_good for s in counted])
        return [
            ("buildings found (IoU >= 0.5)", _share(len(found), len(counted))),
            ("models where no building is", str(len(self.false_alarms))),
            ("models that split or join buildings", str(len(self.unmatched))),
            ("roof type right", _share(sum(s.type_right for s in counted), len(counted))),
            ("roof faces >= 10 m2 found", _share(matched, faces)),
            ("roof faces >= 10 m2 modelled", str(made)),
            ("footprint IoU, median of found", _figure(_median([s.iou for s in found]), "")),
            ("vertical difference, median", _figure(self.median_m, " m")),
            ("vertical difference, RMSE", _figure(self.rmse_m, " m")),
            ("roof within 0.2 m, mean of all buildings", "none" if math.isnan(within) else f"{100 * within:.1f} %"),
        ]

    def confusion(self) -> dict[tuple[RoofType, RoofType], int]:
        """Counted buildings by true type and the model's type (none where not found), in the order of the types."""
        order = list(RoofType)
        pairs = sorted(
            {(s.true_type, s.model_type) for s in self.counted},
            key=lambda pair: (order.index(pair[0]), order.index(pair[1])),
        )
        return {pair: sum((s.true_type, s.model_type) == pair for s in self.counted) for pair in pairs}


def score_against_truth(
    models: Sequence[RoofModel], truth: Sequence[RoofModel], *, sample_m: float = 0.25
) -> TruthScore:
    """Score models against true buildings.

    Parameters
    ----------
    models : sequence of RoofModel
        What a run delivered; without those that have no footprint.
    truth : sequence of RoofModel
        The true buildings, in the same coordinates. They may touch, but not overlap.
    sample_m : float
        Spacing of the lattice on which roofs are compared; anchored at the coordinates' origin.

    Returns
    -------
    TruthScore
        One row a true building, in the order of `truth`.
    """
    matches = match_footprints([m.footprint for m in models], [t.footprint for t in truth])
    rows, differences = [], []
    for index, true in enumerate(truth):
        match = matches.get(index)
        if match is None:
            rows.append(_not_found(true))
            continue
        row, difference = _compare(true, models[match[0]], match[1], sample_m)
        rows.append(row)
        if not true.touches_data_edge:
            differences.append(difference)
    pooled = np.concatenate(differences) if differences else np.zeros(0)
    matched = {model for model, _ in matches.values()}
    on_truth = _share_on([m.footprint for m in models], [t.footprint for t in truth])
    others = [k for k, model in enumerate(models) if k not in matched and not model.touches_data_edge]
    return TruthScore(
        buildings=tuple(rows),
        false_alarms=tuple(models[k].building_id for k in others if on_truth[k] < MIN_IOU),
        unmatched=tuple(models[k].building_id for k in others if on_truth[k] >= MIN_IOU),
        median_m=float(np.median(np.abs(pooled))) if len(pooled) else math.nan,
        rmse_m=math.sqrt(float(np.mean(pooled**2))) if len(pooled) else math.nan,
    )


def match_footprints(
    models: Sequence[Polygon | MultiPolygon], truth: Sequence[Polygon | MultiPolygon]
) -> dict[int, tuple[int, float]]:
    """Best overlaps first, one to one: number of the true footprint to number of the model and IoU (>= 0.5)."""
    if not models or not truth:
        return {}
    tree = shapely.STRtree(list(models))
    true_index, model_index = tree.query(np.array(truth, dtype=object), predicate="intersects")
    pairs = []
    for t, m in zip(true_index.tolist(), model_index.tolist(), strict=True):
        common = shapely.intersection(truth[t], models[m]).area
        iou = common / (truth[t].area + models[m].area - common)
        if iou >= MIN_IOU:
            pairs.append((-iou, t, m))
    matches: dict[int, tuple[int, float]] = {}
    taken: set[int] = set()
    for negative, t, m in sorted(pairs):
        if t not in matches and m not in taken:
            matches[t] = (m, -negative)
            taken.add(m)
    return matches


def _share_on(models: Sequence[Polygon | MultiPolygon], truth: Sequence[Polygon | MultiPolygon]) -> FloatArray:
    """Share of each model's area that stands on true buildings."""
    on = np.zeros(len(models))
    if len(models) and len(truth):
        tree = shapely.STRtree(list(truth))
        for k, footprint in enumerate(models):
            near = [truth[t] for t in tree.query(footprint, predicate="intersects")]
            if near and footprint.area > 0:
                on[k] = shapely.intersection(footprint, shapely.union_all(near)).area / footprint.area
    return on


def _not_found(true: RoofModel) -> BuildingScore:
    return BuildingScore(
        building_id=true.building_id,
        model_id=None,
        iou=0.0,
        true_type=true.roof_type,
        model_type=RoofType.NONE,
        true_faces=len(_large(true)),
        model_faces=0,
        matched_faces=0,
        coverage=0.0,
        within_good=0.0,
        median_m=math.nan,
        bias_m=math.nan,
        rmse_m=math.nan,
        touches_data_edge=true.touches_data_edge,
    )


def _compare(true: RoofModel, model: RoofModel, iou: float, sample_m: float) -> tuple[BuildingScore, FloatArray]:
    """The row of a found building, and its vertical differences where covered."""
    x, y = lattice_inside(true.footprint, sample_m)
    true_z = true.top(x, y)
    on_roof = np.isfinite(true_z)
    difference = (model.top(x, y) - true_z)[on_roof]
    covered: BoolArray = np.isfinite(difference)
    some = difference[covered]
    row = BuildingScore(
        building_id=true.building_id,
        model_id=model.building_id,
        iou=iou,
        true_type=true.roof_type,
        model_type=model.roof_type,
        true_faces=len(_large(true)),
        model_faces=len(_large(model)),
        matched_faces=matched_faces(true.surfaces, model.surfaces),
        coverage=float(covered.mean()) if len(covered) else 0.0,
        within_good=float((np.abs(np.where(covered, difference, np.inf)) <= GOOD_M).mean()) if len(covered) else 0.0,
        median_m=float(np.median(np.abs(some))) if len(some) else math.nan,
        bias_m=float(some.mean()) if len(some) else math.nan,
        rmse_m=math.sqrt(float(np.mean(some**2))) if len(some) else math.nan,
        touches_data_edge=true.touches_data_edge,
    )
    return row, some


def lattice_inside(footprint: Polygon | MultiPolygon, sample_m: float) -> tuple[FloatArray, FloatArray]:
    """Places (x, y) of a lattice of whole multiples of sample_m, shifted by half of it, that lie in a footprint."""
    low_x, low_y, high_x, high_y = footprint.bounds
    columns = np.arange(math.floor(low_x / sample_m), math.ceil(high_x / sample_m)) + 0.5
    rows = np.arange(math.floor(low_y / sample_m), math.ceil(high_y / sample_m)) + 0.5
    x, y = (axis.ravel() for axis in np.meshgrid(columns * sample_m, rows * sample_m))
    inside = shapely.contains_xy(footprint, x, y)
    return x[inside], y[inside]


def _large(model: RoofModel) -> list[RoofSurface]:
    return [surface for surface in model.surfaces if surface.area_m2 >= MIN_FACE_AREA_M2]


def matched_faces(true: Sequence[RoofSurface], model: Sequence[RoofSurface]) -> int:
    """Number of true faces of at least 10 m2 that were found; largest overlaps first, one to one."""
    pairs = []
    for t, face in enumerate(true):
        if face.area_m2 < MIN_FACE_AREA_M2:
            continue
        for m, candidate in enumerate(model):
            common = shapely.intersection(face.polygon, candidate.polygon)
            if common.area < MIN_FACE_OVERLAP * max(face.polygon.area, candidate.polygon.area) or common.area == 0:
                continue
            cosine = min(1.0, float(face.normal @ candidate.normal))
            middle = common.centroid
            place = np.array([middle.x]), np.array([middle.y])
            offset = abs(float((candidate.elevation(*place) - face.elevation(*place))[0])) * float(face.normal[2])
            if math.degrees(math.acos(cosine)) <= MAX_NORMAL_ANGLE_DEG and offset <= MAX_OFFSET_M:
                pairs.append((-common.area, t, m))
    found: set[int] = set()
    taken: set[int] = set()
    for _, t, m in sorted(pairs):
        if t not in found and m not in taken:
            found.add(t)
            taken.add(m)
    return len(found)


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else math.nan


def _share(count: int, total: int) -> str:
    return f"{count} of {total}"


def _figure(value: float, unit: str) -> str:
    return "none" if math.isnan(value) else f"{value:.3f}{unit}"
