"""Roof faces of models against true roof faces: completeness, correctness, quality, and splits and joins.

A true face is found if a model face overlaps it by at least half of both plan areas, the normals agree within 10 deg
and the offset within 0.3 m, one to one; after the comparison of building extraction by Rutzinger,
Rottensteiner and Pfeifer (2009). All faces of all models take part: a building that was split costs no faces.

The offset is the mean signed distance over the common area, across the true plane. Both are planes, so it is the
distance at the centroid. A root mean square would also grow with the angle and the size of the face (5 deg across a
face of 12 m give 0.3 m), and the limit of 10 deg would never decide. The surface and residual measures show how far a
tilted face is off.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.evaluation.bootstrap import Share, Sums, quality, share
from pipeline.ruler.evaluation.face_matching import FaceMatch, match_faces
from pipeline.ruler.evaluation.matching import (
    excused_models,
    mostly_on,
    overlapping,
    sound_polygons,
    summed,
    where_judged,
)
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import Subset, measured, summed_over_units, total
from pipeline.ruler.evaluation.topology import FaceComponent, Topology, TopologyInput, face_components

MIN_FACE_AREA_M2 = 10.0
"""Smaller true faces need not be found, smaller faces of a model are not wrong; in the plane of the face."""
MIN_FACE_POINTS = 11
"""True faces with fewer points need not be found."""
_ROUNDING = 1e-6
"""Numerical guard, square metres."""


class FaceVerdict(StrEnum):
    """Verdict on a model face."""

    RIGHT = "right"
    """Matches a true face that was to be found, or a piece of one."""
    WRONG = "wrong"
    """At least 10 m2 and matches none."""
    NEITHER = "neither"
    """Too small to be wrong, or matches a true face that need not be found."""
    LEFT_OUT = "left_out"
    """On a building that touches the data edge, of a model at that edge, or outside the reference."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReferenceFace:
    """One true roof face. Several with one `unit` count as one: the parts of a bent hip face."""

    building: int
    """Index of its reference building."""
    building_id: str
    """Name of it."""
    plane_id: int
    """Its number in the building."""
    group: int
    """As in the reference; -1 for none."""
    unit: int
    """Number of the counted unit: a face alone, or a group."""
    area_m2: float
    """Its own area in its plane."""
    slope_deg: float
    """0 is horizontal."""
    n_points: int
    """Its own points; -1 if unknown."""
    unit_area_m2: float
    """Area of the unit."""
    to_be_found: bool
    """Whether the unit has at least 10 m2 and 11 points, and the data edge does not cut its building."""
    found: bool
    """Whether the unit was found."""
    matched: bool
    """Whether a model face matches this face itself, or its group as a whole."""
    as_group: bool
    """Whether the figures below are those of its group as one face with its mean plane."""
    model: int
    """Index of the model of the matching face, else of the one that overlaps it most; -1 without any."""
    model_id: str | None
    """Name of that model."""
    model_plane_id: int
    """Number of that face in its model; -1 without any."""
    overlap_reference: float
    """Common area as share of this face (of the group), in plan."""
    overlap_model: float
    """Common area as share of the model face, in plan."""
    angle_deg: float
    """Between the normals; nan without an overlap."""
    offset_m: float
    """Model minus true plane, mean over the common area, across the true plane; nan without an overlap."""
    topology: Topology | None
    """Topology of the connected component; None below 10 m2 and at the data edge."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelFace:
    """One roof face of a model."""

    model: int
    """Index of its model."""
    model_id: str
    """Name of it."""
    plane_id: int
    """Its number in the model."""
    area_m2: float
    """In its plane."""
    slope_deg: float
    """0 is horizontal."""
    building: int
    """Index of the reference building that it matches in, else of the one that it lies on most; -1 for none."""
    matched: bool
    """Whether it matches a true face, of any size."""
    unit: int
    """The unit of that face; -1 for none."""
    verdict: FaceVerdict
    """What it counts as."""
    topology: Topology | None
    """Topology of the connected component; None below 10 m2 and where it is left out."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FaceScore:
    """All faces with their verdicts."""

    reference: tuple[ReferenceFace, ...]
    """One per true roof face, building by building."""
    models: tuple[ModelFace, ...]
    """One per model face, model by model."""
    components: tuple[FaceComponent, ...]
    """Faces of at least 10 m2 that lie on one another."""


def score_faces(models: Sequence[RoofModel], reference: Reference) -> FaceScore:
    """Match all faces of all models to all true faces, and give each a verdict; empty without true faces.

    A model face that matches a true face is judged unless the data edge cuts the building. Other faces are judged as in
    `where_judged`, except on a cut building, or on no building as part of a model that the edge of the data excuses
    (`excused_models`). A cut model may still find faces.
    """
    if not reference.has_faces:
        return FaceScore(reference=(), models=(), components=())
    match = match_faces(models, reference.buildings)
    units = len(match.pieces)
    cut = np.array([building.touches_data_edge for building in reference.buildings], np.bool_)
    unit_building = np.zeros(units, np.int64)
    unit_building[match.unit] = match.true.owner
    unit_cut = cut[unit_building]
    unit_m2 = summed(match.unit, match.true.area_m2, units)
    points = _points(reference)
    large = unit_m2 >= MIN_FACE_AREA_M2 - _ROUNDING
    to_be_found = large & ~unit_cut
    if reference.face_points:
        to_be_found &= summed(match.unit, points.astype(np.float64), units) >= MIN_FACE_POINTS
    building, left_out = _judged(models, reference, match, unit_building, unit_cut, cut)
    made_large = match.made.area_m2 >= MIN_FACE_AREA_M2 - _ROUNDING
    unit_of = match.matched_unit
    # Pieces of a bent face may be small: they count with the large unit that they match.
    matched_large = np.append(large, False)[unit_of]
    components, unit_topology, made_topology = face_components(
        TopologyInput(
            unit=match.unit[match.pairs.overlaps.first],
            face=match.pairs.overlaps.second,
            common_m2=match.pairs.overlaps.common_m2,
            unit_m2=summed(match.unit, match.true.plan_m2, units),
            face_m2=match.made.plan_m2,
            unit_counts=large & ~unit_cut,
            face_counts=(made_large | matched_large) & ~left_out,
            unit_building=unit_building,
            face_building=building,
            face_model=match.made.owner,
            face_group=np.where((unit_of >= 0) & (match.pieces[unit_of] > 1), unit_of, -1) if units else unit_of,
        )
    )
    return FaceScore(
        reference=_reference_rows(models, reference, match, points, unit_m2, to_be_found, unit_topology),
        models=_model_rows(
            models, match, building, _verdicts(unit_of, to_be_found, made_large, left_out), made_topology
        ),
        components=components,
    )


def _points(reference: Reference) -> IntArray:
    """Points of every true face; -1 if unknown."""
    known = reference.face_points
    counts = [
        known.get((building.building_id, surface.plane_id), 0) if known else -1
        for building in reference.buildings
        for surface in building.surfaces
    ]
    return np.array(counts, np.int64)


def _judged(
    models: Sequence[RoofModel],
    reference: Reference,
    match: FaceMatch,
    unit_building: IntArray,
    unit_cut: BoolArray,
    cut: BoolArray,
) -> tuple[IntArray, BoolArray]:
    """The reference building of every model face, and whether the face is left out."""
    footprints = sound_polygons([building.footprint for building in reference.buildings])
    over = overlapping(footprints, match.made.polygon)
    building = mostly_on(len(match.made.owner), over)
    left_out = ~where_judged(match.made.polygon, footprints, over, reference.extent)
    elsewhere = building < 0
    left_out[elsewhere] |= excused_models(models, reference)[match.made.owner[elsewhere]]
    left_out[~elsewhere] |= cut[building[~elsewhere]]
    matched = match.matched_unit >= 0
    building[matched] = unit_building[match.matched_unit[matched]]
    left_out[matched] = unit_cut[match.matched_unit[matched]]
    return building, left_out


def _verdicts(
    unit_of: IntArray, to_be_found: BoolArray, made_large: BoolArray, left_out: BoolArray
) -> list[FaceVerdict]:
    verdicts = []
    for unit, large, out in zip(unit_of.tolist(), made_large.tolist(), left_out.tolist(), strict=True):
        if out:
            verdicts.append(FaceVerdict.LEFT_OUT)
        elif unit >= 0:
            verdicts.append(FaceVerdict.RIGHT if to_be_found[unit] else FaceVerdict.NEITHER)
        else:
            verdicts.append(FaceVerdict.WRONG if large else FaceVerdict.NEITHER)
    return verdicts


def _reference_rows(
    models: Sequence[RoofModel],
    reference: Reference,
    match: FaceMatch,
    points: IntArray,
    unit_m2: FloatArray,
    to_be_found: BoolArray,
    topology: Sequence[Topology | None],
) -> tuple[ReferenceFace, ...]:
    planes = [surface.plane_id for model in models for surface in model.surfaces]
    nearest = np.full(len(match.unit), -1, np.int64)
    by_area = np.argsort(match.pairs.overlaps.common_m2, kind="stable")
    nearest[match.pairs.overlaps.first[by_area]] = by_area  # the largest comes last
    area, slope = match.true.area_m2, match.true.slope_deg
    rows = []
    surfaces = [surface for building in reference.buildings for surface in building.surfaces]
    for k, surface in enumerate(surfaces):
        unit, owner = int(match.unit[k]), int(match.true.owner[k])
        as_group = bool(match.whole_of[unit] >= 0)
        itself = bool(match.pair_of[k] >= 0)
        shown = match.wholes if as_group else match.pairs
        pair = int(match.whole_of[unit] if as_group else match.pair_of[k] if itself else nearest[k])
        face = int(shown.overlaps.second[pair]) if pair >= 0 else -1
        model = int(match.made.owner[face]) if face >= 0 else -1
        rows.append(
            ReferenceFace(
                building=owner,
                building_id=reference.buildings[owner].building_id,
                plane_id=surface.plane_id,
                group=surface.group,
                unit=unit,
                area_m2=float(area[k]),
                slope_deg=float(slope[k]),
                n_points=int(points[k]),
                unit_area_m2=float(unit_m2[unit]),
                to_be_found=bool(to_be_found[unit]),
                found=bool(match.found[unit]),
                matched=as_group or itself,
                as_group=as_group,
                model=model,
                model_id=models[model].building_id if model >= 0 else None,
                model_plane_id=planes[face] if face >= 0 else -1,
                overlap_reference=float(shown.share_true[pair]) if face >= 0 else 0.0,
                overlap_model=float(shown.share_model[pair]) if face >= 0 else 0.0,
                angle_deg=float(shown.angle_deg[pair]) if face >= 0 else math.nan,
                offset_m=float(shown.offset_m[pair]) if face >= 0 else math.nan,
                topology=topology[unit],
            )
        )
    return tuple(rows)


def _model_rows(
    models: Sequence[RoofModel],
    match: FaceMatch,
    building: IntArray,
    verdicts: Sequence[FaceVerdict],
    topology: Sequence[Topology | None],
) -> tuple[ModelFace, ...]:
    area, slope = match.made.area_m2, match.made.slope_deg
    surfaces = [surface for model in models for surface in model.surfaces]
    return tuple(
        ModelFace(
            model=int(match.made.owner[k]),
            model_id=models[match.made.owner[k]].building_id,
            plane_id=surface.plane_id,
            area_m2=float(area[k]),
            slope_deg=float(slope[k]),
            building=int(building[k]),
            matched=bool(match.matched_unit[k] >= 0),
            unit=int(match.matched_unit[k]),
            verdict=verdicts[k],
            topology=topology[k],
        )
        for k, surface in enumerate(surfaces)
    )


def measures(score: FaceScore, subset: Subset) -> list[Measure]:
    """The figures of one subset of the buildings; none without true faces.

    Model faces on no reference building count in the subset `all` only.
    """
    if not score.reference:
        return []
    columns, n = _columns(score, subset)
    found = []
    for suffix, true in (("10m2", "large"), ("all", "true")):
        both, wrong = f"found_{true}", f"wrong_{true}"
        columns[f"made_{suffix}"] = columns[both] + columns[wrong]
        made = float(columns[f"made_{suffix}"].sum())
        union = n[true] + float(columns[wrong].sum())
        found += [
            measured(f"faces.completeness_{suffix}", columns, share(both, true), n=n[true], subset=subset),
            measured(f"faces.correctness_{suffix}", columns, share(both, f"made_{suffix}"), n=made, subset=subset),
            measured(f"faces.quality_{suffix}", columns, quality(both, true, f"made_{suffix}"), n=union, subset=subset),
        ]
    found += [
        measured("faces.completeness_area", columns, share("found_m2", "true_m2"), n=n["true"], subset=subset),
        measured("faces.correctness_area", columns, share("right_m2", "made_m2"), n=n["made"], subset=subset),
        measured(
            "faces.quality_area",
            columns,
            Share(figure=_quality_by_area, denominator="true_m2"),
            n=n["true"] + n["made"],
            subset=subset,
        ),
    ]
    for kind in Topology:
        found.append(measured(TOPOLOGY_NAMES[kind], columns, total(kind.value), n=n["components"], subset=subset))
    return found


def _columns(score: FaceScore, subset: Subset) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """Sums over the units of the bootstrap, and counts of the subset."""
    units = list({row.unit: row for row in reversed(score.reference)}.values())
    true = {
        "large": [row.to_be_found for row in units],
        "found_large": [row.to_be_found and row.found for row in units],
        "true": [True for _ in units],
        "found_true": [row.found for row in units],
        "true_m2": [row.unit_area_m2 for row in units],
        "found_m2": [row.unit_area_m2 if row.found else 0.0 for row in units],
    }
    judged = [row for row in score.models if row.verdict is not FaceVerdict.LEFT_OUT]
    made = {
        "wrong_large": [row.verdict is FaceVerdict.WRONG for row in judged],
        "wrong_true": [not row.matched for row in judged],
        "made_m2": [row.area_m2 for row in judged],
        "right_m2": [row.area_m2 if row.matched else 0.0 for row in judged],
        "made": [True for _ in judged],
    }
    parts = {kind.value: [row.kind is kind for row in score.components] for kind in Topology}
    parts["components"] = [True for _ in score.components]
    tables = (true, made, parts)
    lengths = [len(units), len(judged), len(score.components)]
    building = [row.building for row in units] + [row.building for row in judged]
    building += [row.building for row in score.components]
    model = [0] * len(units) + [row.model for row in judged] + [row.model for row in score.components]
    columns = {
        name: np.concatenate(
            [
                np.asarray(values, np.float64) if other is table else np.zeros(length)
                for other, length in zip(tables, lengths, strict=True)
            ]
        )
        for table in tables
        for name, values in table.items()
    }
    summed = summed_over_units(subset, np.array(building, np.int64), np.array(model, np.int64), columns)
    return summed, {name: float(summed[name].sum()) for name in ("large", "true", "made", "components")}


def _quality_by_area(sums: Sums) -> FloatArray:
    """1 / (1 / completeness + 1 / correctness - 1), 0 where either is."""
    complete, correct = sums["found_m2"] / sums["true_m2"], sums["right_m2"] / sums["made_m2"]
    complete, correct = (np.where(share > 0.0, share, 0.0) for share in (complete, correct))
    both = complete * correct
    return np.where(
        (sums["true_m2"] > 0.0) | (sums["made_m2"] > 0.0),
        np.where(both > 0.0, both / (complete + correct - both), 0.0),
        np.nan,
    )


_MATCH = "matched: mutual overlap >= 50 % in plan, normals within 10 deg, mean offset within 0.3 m, one to one"

TOPOLOGY_NAMES = {
    Topology.ONE_TO_ONE: "faces.topology_1_1",
    Topology.SPLIT: "faces.topology_1_n",
    Topology.JOINED: "faces.topology_n_1",
    Topology.TANGLED: "faces.topology_n_m",
    Topology.MISSED: "faces.topology_1_0",
    Topology.EXTRA: "faces.topology_0_1",
}
"""Names of the measures that count components."""

_COMPONENTS = (
    "connected components of true and model faces >= 10 m2, linked where they share at least half of either in plan, "
    "with "
)

DEFINITIONS = (
    defined(
        "faces.completeness_10m2",
        "true faces >= 10 m2 found",
        "TP / (TP + FN) over true faces >= 10 m2 with >= 11 points (groups count as one face); TP = found; " + _MATCH,
    ),
    defined(
        "faces.correctness_10m2",
        "model faces >= 10 m2 right",
        "TP / (TP + FP); TP as in completeness, FP = model faces >= 10 m2 that match no true face of any size",
    ),
    defined("faces.quality_10m2", "quality of faces >= 10 m2", "TP / (TP + FN + FP)"),
    defined(
        "faces.completeness_all",
        "true faces found, all sizes",
        "TP / (TP + FN) over all true faces of any size; " + _MATCH,
    ),
    defined(
        "faces.correctness_all",
        "model faces right, all sizes",
        "TP / (TP + FP), FP = model faces of any size that match no true face",
    ),
    defined("faces.quality_all", "quality of faces, all sizes", "TP / (TP + FN + FP)"),
    defined(
        "faces.completeness_area", "true roof area in found faces", "area of found true faces / area of all true faces"
    ),
    defined(
        "faces.correctness_area",
        "model roof area in right faces",
        "area of matched model faces / area of all model faces",
    ),
    defined("faces.quality_area", "quality by area", "1 / (1 / completeness_area + 1 / correctness_area - 1)"),
    defined(
        "faces.topology_1_1",
        "faces 1:1",
        _COMPONENTS + "one of each (model faces that match pieces of one group count as one)",
        Better.HIGHER,
        "count",
    ),
    defined("faces.topology_1_n", "true faces split (1:N)", _COMPONENTS + "one true face", Better.LOWER, "count"),
    defined("faces.topology_n_1", "true faces joined (N:1)", _COMPONENTS + "one model face", Better.LOWER, "count"),
    defined("faces.topology_n_m", "faces N:M", _COMPONENTS + "several of both", Better.LOWER, "count"),
    defined("faces.topology_1_0", "true faces without any (1:0)", _COMPONENTS + "no model face", Better.LOWER, "count"),
    defined("faces.topology_0_1", "model faces without any (0:1)", _COMPONENTS + "no true face", Better.LOWER, "count"),
)
"""The measures."""
