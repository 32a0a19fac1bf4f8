"""Rows of the measure modules as tables of buildings, models, faces and points."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from pipeline.ruler.evaluation.delivery import Delivery, Stands
from pipeline.ruler.evaluation.divisions import WholeModels
from pipeline.ruler.evaluation.faces import FaceScore, FaceVerdict
from pipeline.ruler.evaluation.footprints import FootprintRow
from pipeline.ruler.evaluation.ground import GroundBlock, tile_figures
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.residuals import EDGES_M, BuildingResiduals, ResidualTally
from pipeline.ruler.evaluation.roof_types import RoofTypeRow, confusion, outcome_table
from pipeline.ruler.evaluation.subsets import Subset
from pipeline.ruler.evaluation.surface import SurfaceRow
from pipeline.ruler.evaluation.topology import Topology
from pipeline.ruler.evaluation.validity import ModelValidity, code_counts
from pipeline.ruler.evaluation.wireframes import TOLERANCES_M, WireframeScore, recall_precision_f1, tolerance_name

ROLES = {
    Stands.FOR_BUILDING: "matched",
    Stands.PART: "part",
    Stands.JOINS: "joins",
    Stands.FALSE: "false",
    Stands.LEFT_OUT: "edge",
}
"""Places of a model in the table."""
Columns = dict[str, list[Any]]


def _known(value: float) -> float | None:
    """A figure of a table: nan is null."""
    return value if math.isfinite(value) else None


def building_table(
    reference: Reference,
    wholes: WholeModels,
    footprints: Sequence[FootprintRow],
    roof_types: Sequence[RoofTypeRow],
    residuals: Sequence[BuildingResiduals],
    surface: Sequence[SurfaceRow],
) -> pa.Table:
    """One row per reference building; columns of measures that were not possible are absent.

    `model_id` is the first of `model_ids`, which has several where models divide a block into its houses.
    """
    buildings, models = reference.buildings, wholes.models
    middles = [building.footprint.centroid for building in buildings]
    columns: Columns = {
        "building_id": [building.building_id for building in buildings],
        "touches_data_edge": [building.touches_data_edge for building in buildings],
        "footprint_area_m2": [row.area_m2 for row in footprints],
        "x": [_known(middle.x if not middle.is_empty else math.nan) for middle in middles],
        "y": [_known(middle.y if not middle.is_empty else math.nan) for middle in middles],
        "model_id": [row.model_id for row in footprints],
        "model_ids": pa.array(
            [list(wholes.names[row.model]) if row.model >= 0 else [] for row in footprints], pa.list_(pa.string())
        ),
        "model_type": [models[row.model].roof_type.value if row.model >= 0 else None for row in footprints],
        "model_status": [models[row.model].status.value if row.model >= 0 else None for row in footprints],
        "iou": [row.iou for row in footprints],
        "iou_union": [row.iou_together for row in footprints],
        "models_over": [row.models_over for row in footprints],
        "area_bias": [_known(row.area_bias) for row in footprints],
        "outline_offset_m": [_known(row.offset_m) for row in footprints],
    }
    if reference.conditions:
        known = [reference.conditions.get(building.building_id) for building in buildings]
        columns |= {
            "shape": [one.shape if one else None for one in known],
            "good": [one.good if one else None for one in known],
            "defects": [list(one.defects) if one else None for one in known],
            "pitch_deg": [one.pitch_deg if one else None for one in known],
            "terrain_slope_deg": [one.terrain_slope_deg if one else None for one in known],
        }
    if roof_types:
        columns |= {
            "true_type": [row.true_type.value for row in roof_types],
            "outcome": [row.outcome.value for row in roof_types],
            "faces_to_find": [row.faces_to_find for row in roof_types],
            "faces_found": [row.faces_found for row in roof_types],
            "faces_wrong": [row.wrong_faces for row in roof_types],
        }
    if residuals:
        columns |= _tallied("point", [row.all_points for row in residuals])
        columns |= _tallied("top", [row.top_visible for row in residuals])
    if surface:
        columns |= {
            "surface_coverage": [_known(row.coverage) for row in surface],
            "surface_within": [_known(row.share_within) for row in surface],
            "surface_median_m": [_known(row.median_m) for row in surface],
            "surface_rmse_m": [_known(row.rmse_m) for row in surface],
            "surface_bias_m": [_known(row.bias_m) for row in surface],
        }
    return pa.table(columns)


def _tallied(prefix: str, tallies: Sequence[ResidualTally]) -> Columns:
    counts = "" if prefix == "point" else f"{prefix}_"
    return {
        f"{counts}n_points": [tally.n_points for tally in tallies],
        f"{counts}n_covered": [tally.n_covered for tally in tallies],
        f"{counts}n_within": [tally.n_within for tally in tallies],
        f"{prefix}_rmse_m": [_known(tally.rmse_m) for tally in tallies],
        f"{prefix}_bias_m": [_known(tally.bias_m) for tally in tallies],
        f"{prefix}_median_m": [_known(tally.median_m) for tally in tallies],
        f"{prefix}_p95_m": [_known(tally.p95_m) for tally in tallies],
    }


def model_table(models: ModelSet, solids: Sequence[ModelValidity], delivery: Delivery | None) -> pa.Table:
    """One row per model, then one per record without a model."""
    everything = (*models.models, *models.failed)
    empty = [None] * len(models.failed)
    middles = [model.footprint.centroid for model in everything]
    columns: Columns = {
        "model_id": [model.building_id for model in everything],
        "status": [model.status.value for model in models.models] + ["failed"] * len(models.failed),
        "lod": [model.lod for model in everything],
        "roof_type": [model.roof_type.value for model in everything],
        "footprint_area_m2": [model.footprint.area for model in everything],
        "x": [None if middle.is_empty else middle.x for middle in middles],
        "y": [None if middle.is_empty else middle.y for middle in middles],
        "faces": [len(model.surfaces) for model in everything],
        "has_solid": [row.is_closed for row in solids] + [False] * len(models.failed),
        "validity_codes": [sorted({code for codes in row.codes for code in codes}) for row in solids] + empty,
    }
    if delivery is not None:
        columns["on_reference"] = [row.share_on_reference for row in delivery.models] + empty
        columns["role"] = [ROLES[row.stands] for row in delivery.models] + ["failed"] * len(models.failed)
    return pa.table(columns)


def true_face_table(score: FaceScore, reference: Reference) -> pa.Table:
    """One row per true roof face."""
    polygons = [surface.polygon for building in reference.buildings for surface in building.surfaces]
    rows = score.reference
    return pa.table(
        {
            "building_id": [row.building_id for row in rows],
            "plane_id": [row.plane_id for row in rows],
            "group": [row.group if row.group >= 0 else None for row in rows],
            "area_m2": [row.area_m2 for row in rows],
            "slope_deg": [row.slope_deg for row in rows],
            "n_points": [row.n_points if row.n_points >= 0 else None for row in rows],
            "to_be_found": [row.to_be_found for row in rows],
            "found": [row.found for row in rows],
            "model_id": [row.model_id for row in rows],
            "model_plane_id": [row.model_plane_id if row.model_plane_id >= 0 else None for row in rows],
            "overlap_true": [row.overlap_reference for row in rows],
            "overlap_model": [row.overlap_model for row in rows],
            "angle_deg": [_known(row.angle_deg) for row in rows],
            "offset_m": [_known(row.offset_m) for row in rows],
            "topology": [None if row.topology is None else row.topology.value for row in rows],
            "geometry": shapely.to_wkb(np.array(polygons, dtype=object)),
        }
    )


def model_face_table(score: FaceScore, models: Sequence[RoofModel], reference: Reference) -> pa.Table:
    """One row per roof face of a model."""
    polygons = [surface.polygon for model in models for surface in model.surfaces]
    rows, buildings = score.models, reference.buildings
    return pa.table(
        {
            "model_id": [row.model_id for row in rows],
            "plane_id": [row.plane_id for row in rows],
            "area_m2": [row.area_m2 for row in rows],
            "slope_deg": [row.slope_deg for row in rows],
            "verdict": [row.verdict.value for row in rows],
            "found": [row.matched for row in rows],
            "wrong": [row.verdict is FaceVerdict.WRONG for row in rows],
            "building_id": [buildings[row.building].building_id if row.building >= 0 else None for row in rows],
            "topology": [None if row.topology is None else row.topology.value for row in rows],
            "geometry": shapely.to_wkb(np.array(polygons, dtype=object)),
        }
    )


def topology_table(score: FaceScore) -> pa.Table:
    """Components of faces that lie on one another, counted by kind."""
    by_kind = {kind: [one for one in score.components if one.kind is kind] for kind in Topology}
    return pa.table(
        {
            "relation": [kind.value for kind in by_kind],
            "components": [len(found) for found in by_kind.values()],
            "true_faces": [sum(one.true_faces for one in found) for found in by_kind.values()],
            "model_faces": [sum(one.model_faces for one in found) for found in by_kind.values()],
        }
    )


def residual_histogram(rows: Sequence[BuildingResiduals]) -> pa.Table:
    """Points of all counted buildings by the size of their residual; points without a roof are in no bin."""
    counted = [row for row in rows if row.counts]

    def summed(tallies: Sequence[ResidualTally]) -> list[int]:
        total = np.zeros(len(EDGES_M) - 1, np.int64)
        for tally in tallies:
            total += tally.histogram
        return [int(count) for count in total]

    return pa.table(
        {
            "low_m": EDGES_M[:-1],
            "high_m": EDGES_M[1:],
            "count": summed([row.all_points for row in counted]),
            "count_top": summed([row.top_visible for row in counted]),
        }
    )


def outcome_tables(rows: Sequence[RoofTypeRow], subsets: Sequence[Subset]) -> Mapping[str, pa.Table]:
    """Outcomes by roof type and by shape in every subset, and the confusion of types over all."""
    kinds: dict[str, list[dict[str, Any]]] = {"type": [], "shape": []}
    for subset in subsets:
        for row in outcome_table(rows, subset):
            counts = {"correct": row.correct, "passable": row.passable, "false": row.false}
            key = "true_type" if row.kind == "type" else "shape"
            kinds[row.kind].append({"subset": subset.name, key: row.name, **counts})
    confused = [
        {"true_type": true.value, "model_type": made.value, "buildings": count}
        for (true, made), count in confusion(rows, subsets[0]).items()
    ]
    tables = {"outcomes": kinds["type"], "outcomes_by_shape": kinds["shape"], "confusion": confused}
    return {name: pa.Table.from_pylist(found) for name, found in tables.items() if found}


def validity_table(rows: Sequence[ModelValidity]) -> pa.Table:
    """How many solids have each code."""
    counts = code_counts(rows)
    return pa.table(
        {"code": pa.array(counts, pa.string()), "solids": pa.array(list(counts.values()), pa.int64())},
    )


def ground_table(rows: Sequence[GroundBlock]) -> pa.Table:
    """The ground figures of each tile."""
    figures = tile_figures(rows)
    return pa.table(
        {
            "tile": [one.tile for one in figures],
            "type_1": [_known(one.type_1) for one in figures],
            "type_2": [_known(one.type_2) for one in figures],
            "total": [_known(one.total) for one in figures],
            "kappa": [_known(one.kappa) for one in figures],
            "ground": [one.ground for one in figures],
            "object": [one.object for one in figures],
        }
    )


def wireframe_table(score: WireframeScore) -> pa.Table:
    """One row per true wireframe."""
    rows = score.rows
    columns: Columns = {
        "building_id": [row.building_id for row in rows],
        "x": [_known(row.place[0]) for row in rows],
        "y": [_known(row.place[1]) for row in rows],
        "model_ids": [list(row.model_ids) for row in rows],
        "has_model": [row.has_model for row in rows],
        "true_edges_m": [row.true_edges.total for row in rows],
        "model_edges_m": [row.model_edges.total for row in rows],
        "true_corners": [round(row.true_corners.total) for row in rows],
        "model_corners": [round(row.model_corners.total) for row in rows],
    }
    for kind in ("edge", "corner"):
        for k, tolerance in enumerate(TOLERANCES_M):
            shares = [
                recall_precision_f1(getattr(row, f"true_{kind}s"), getattr(row, f"model_{kind}s"), k) for row in rows
            ]
            for name, values in zip(("recall", "precision", "f1"), zip(*shares, strict=True), strict=True):
                columns[f"{kind}_{name}_{tolerance_name(tolerance)}"] = [_known(value) for value in values]
    return pa.table(columns)
