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
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import Any

import numpy as np

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.evaluation.bootstrap import Share, Statistic, Sums, quality, share
from pipeline.ruler.evaluation.building_matching import (
    excused_models,
    mostly_on,
    overlapping,
    sound_polygons,
    summed,
    where_judged,
)
from pipeline.ruler.evaluation.face_matching import Compared, FaceMatch, match_faces
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import Columns, Subset, measured_all, summed_over_units, total
from pipeline.ruler.evaluation.topology import Topology, face_components

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
class FaceScore:
    """All faces with their verdicts, as columns."""

    true: Columns
    """True roof faces, building by building. `building`, `building_id`, `plane_id`, `group` (-1 for none), `unit`: the
    number of what counts as one, a face alone or a group such as the parts of a bent hip face. `area_m2` in its plane,
    `slope_deg`, `n_points` (-1 if unknown), `unit_area_m2`. `to_be_found`: whether the unit has at least 10 m2 and 11
    points, and the data edge does not cut its building; `found`: whether the unit was found; `matched`: whether a model
    face matches this face itself, or its group as a whole; `as_group`: whether the figures are those of its group as
    one face with its mean plane. `model_id`, `model_plane_id`: the matching face, else the one that overlaps it most,
    None and -1 without any. `overlap_true`, `overlap_model`: common area as share of both, in plan; `angle_deg` between
    the normals, `offset_m` of the model across the true plane, nan without an overlap; `topology` of the component."""
    made: Columns
    """Faces of the models, model by model. `model`, `model_id`, `plane_id`, `area_m2`, `slope_deg`; `building`: the
    reference building that it matches in, else the one that it lies on most, -1 for none; `found`: whether it matches a
    true face of any size; `verdict`; `topology`."""
    components: Columns
    """Faces of at least 10 m2 that lie on one another: see `face_components`."""


def score_faces(models: Sequence[RoofModel], reference: Reference) -> FaceScore:
    """Match all faces of all models to all true faces, and give each a verdict; empty without true faces.

    A model face that matches a true face is judged unless the data edge cuts the building. Other faces are judged as in
    `where_judged`, except on a cut building, or on no building as part of a model that the edge of the data excuses
    (`excused_models`). A cut model may still find faces.
    """
    if not reference.has_faces:
        return FaceScore(true={}, made={}, components={})
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
    components, unit_topology, made_topology = face_components(
        match,
        large & ~unit_cut,
        (made_large | np.append(large, False)[unit_of]) & ~left_out,
        unit_building,
        building,
    )
    true_faces = [(one.building_id, face) for one in reference.buildings for face in one.surfaces]
    made_faces = [(one.building_id, face) for one in models for face in one.surfaces]
    model_ids = np.array([*(name for name, _ in made_faces), None], object)
    planes = np.array([*(face.plane_id for _, face in made_faces), -1], np.int64)
    unit, as_group = match.unit, match.whole_of[match.unit] >= 0
    shown = _shown_pairs(match, as_group)

    def of_pair(figure: Callable[[Compared], IntArray | FloatArray], nothing: float) -> Any:
        """A figure of the pair that is shown for each true face."""
        return np.concatenate([figure(match.pairs), figure(match.wholes), [nothing]])[shown]

    face = of_pair(lambda pairs: pairs.overlaps.second, -1)
    return FaceScore(
        true={
            "building": match.true.owner,
            "building_id": np.array([name for name, _ in true_faces], object),
            "plane_id": np.array([face.plane_id for _, face in true_faces], np.int64),
            "group": np.array([face.group for _, face in true_faces], np.int64),
            "unit": unit,
            "area_m2": match.true.area_m2,
            "slope_deg": match.true.slope_deg,
            "n_points": points,
            "unit_area_m2": unit_m2[unit],
            "to_be_found": to_be_found[unit],
            "found": match.found[unit],
            "matched": as_group | (match.pair_of >= 0),
            "as_group": as_group,
            "model_id": model_ids[face],
            "model_plane_id": planes[face],
            "overlap_true": of_pair(lambda pairs: pairs.share_true, 0.0),
            "overlap_model": of_pair(lambda pairs: pairs.share_model, 0.0),
            "angle_deg": of_pair(lambda pairs: pairs.angle_deg, np.nan),
            "offset_m": of_pair(lambda pairs: pairs.offset_m, np.nan),
            "topology": unit_topology[unit],
        },
        made={
            "model": match.made.owner,
            "model_id": model_ids[:-1],
            "plane_id": planes[:-1],
            "area_m2": match.made.area_m2,
            "slope_deg": match.made.slope_deg,
            "building": building,
            "found": unit_of >= 0,
            "verdict": np.select(
                [left_out, np.append(to_be_found, False)[unit_of], unit_of >= 0, made_large],
                [FaceVerdict.LEFT_OUT, FaceVerdict.RIGHT, FaceVerdict.NEITHER, FaceVerdict.WRONG],
                FaceVerdict.NEITHER,
            ),
            "topology": made_topology,
        },
        components=components,
    )


def _shown_pairs(match: FaceMatch, as_group: BoolArray) -> IntArray:
    """The pair that is shown for each true face, (n,), among all `pairs` and then all `wholes`; -1 for none."""
    nearest = np.full(len(match.unit), -1, np.int64)
    by_area = np.argsort(match.pairs.overlaps.common_m2, kind="stable")
    nearest[match.pairs.overlaps.first[by_area]] = by_area  # the largest comes last
    whole = match.whole_of[match.unit] + len(match.pairs.fits)
    return np.where(as_group, whole, np.where(match.pair_of >= 0, match.pair_of, nearest))


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


def measures(score: FaceScore, subset: Subset) -> list[Measure]:
    """The figures of one subset of the buildings; none without true faces.

    Model faces on no reference building count in the subset `all` only.
    """
    if not score.true or not len(score.true["unit"]):
        return []
    columns = _columns(score, subset)
    n = {name: float(columns[name].sum()) for name in ("large", "true", "made", "components")}
    figures: list[tuple[str, Statistic, float]] = []
    for suffix, true in (("10m2", "large"), ("all", "true")):
        both, wrong, made = f"found_{true}", f"wrong_{true}", f"made_{suffix}"
        columns[made] = columns[both] + columns[wrong]
        union = n[true] + float(columns[wrong].sum())
        figures += [
            (f"faces.completeness_{suffix}", share(both, true), n[true]),
            (f"faces.correctness_{suffix}", share(both, made), float(columns[made].sum())),
            (f"faces.quality_{suffix}", quality(both, true, made), union),
        ]
    figures += [
        ("faces.completeness_area", share("found_m2", "true_m2"), n["true"]),
        ("faces.correctness_area", share("right_m2", "made_m2"), n["made"]),
        ("faces.quality_area", Share(figure=_quality_by_area, denominator="true_m2"), n["true"] + n["made"]),
        *((TOPOLOGY_NAMES[kind], total(kind.value), n["components"]) for kind in Topology),
    ]
    return measured_all(columns, subset, figures)


def _columns(score: FaceScore, subset: Subset) -> dict[str, FloatArray]:
    """Sums over the units of the bootstrap."""
    # One row per unit: its first face, in the order of the last faces from the end.
    first = np.unique(score.true["unit"], return_index=True)[1]
    last = np.unique(score.true["unit"][::-1], return_index=True)[1]
    true = {name: column[first[np.argsort(last)]] for name, column in score.true.items()}
    judged = score.made["verdict"] != FaceVerdict.LEFT_OUT
    made = {name: column[judged] for name, column in score.made.items()}
    parts = score.components
    sums: Sequence[tuple[Columns, Columns]] = (
        (
            true,
            {
                "large": true["to_be_found"],
                "found_large": true["to_be_found"] & true["found"],
                "true": np.ones_like(true["found"]),
                "found_true": true["found"],
                "true_m2": true["unit_area_m2"],
                "found_m2": np.where(true["found"], true["unit_area_m2"], 0.0),
            },
        ),
        (
            made,
            {
                "wrong_large": made["verdict"] == FaceVerdict.WRONG,
                "wrong_true": ~made["found"],
                "made_m2": made["area_m2"],
                "right_m2": np.where(made["found"], made["area_m2"], 0.0),
                "made": np.ones_like(made["found"]),
            },
        ),
        (
            parts,
            {kind.value: parts["kind"] == kind for kind in Topology} | {"components": np.ones(len(parts["kind"]))},
        ),
    )
    lengths = [len(rows["building"]) for rows, _ in sums]
    building = np.concatenate([rows["building"] for rows, _ in sums])
    model = np.concatenate([np.zeros(lengths[0], np.int64), made["model"], parts["model"]])
    starts = np.concatenate([[0], np.cumsum(lengths)])
    columns = {}
    for number, (_, values) in enumerate(sums):
        for name, column in values.items():
            columns[name] = np.zeros(len(building))
            columns[name][starts[number] : starts[number + 1]] = column
    return summed_over_units(subset, building, model, columns)


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
