"""Rows of the measure modules as tables of buildings, models, faces and points."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import shapely

from pipeline.model import IntArray
from pipeline.ruler.evaluation.delivery import Delivery, Stands
from pipeline.ruler.evaluation.divisions import WholeModels
from pipeline.ruler.evaluation.face_scores import FaceScore, FaceVerdict
from pipeline.ruler.evaluation.form_scores import FormScore
from pipeline.ruler.evaluation.ground_scores import tile_figures
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.residual_scores import BIAS, COVERAGE, EDGES_M, RMSE, WITHIN, Residuals
from pipeline.ruler.evaluation.roof_types import confusion, outcome_tables
from pipeline.ruler.evaluation.subsets import Columns, Subset
from pipeline.ruler.evaluation.surface import SurfaceScore
from pipeline.ruler.evaluation.topology import Topology
from pipeline.ruler.evaluation.validity_scores import ModelValidity, code_counts
from pipeline.ruler.evaluation.wireframe_scores import STATISTICS, TOLERANCES_M, WireframeScore, tolerance_name

TALLIED = ("n_points", "n_covered", "n_within")
TRUE_FACES = (
    *("building_id", "plane_id", "group", "area_m2", "slope_deg", "n_points", "to_be_found", "found", "model_id"),
    *("model_plane_id", "overlap_true", "overlap_model", "angle_deg", "offset_m", "topology"),
)
MODEL_FACES = ("model_id", "plane_id", "area_m2", "slope_deg", "verdict", "found", "wrong", "building_id", "topology")
"""Columns of the tables of faces, besides the geometry."""
ROLES = {
    Stands.FOR_BUILDING: "matched",
    Stands.PART: "part",
    Stands.JOINS: "joins",
    Stands.FALSE: "false",
    Stands.LEFT_OUT: "edge",
}
"""Places of a model in the table."""


def _table(columns: Mapping[str, Any]) -> pa.Table:
    """Columns as a table; nan and None are null."""
    arrays = {
        name: column if isinstance(column, pa.Array) else pa.array(column, from_pandas=True)
        for name, column in columns.items()
    }
    return pa.table(arrays)


def _numbers(values: IntArray) -> pa.Array:
    """Whole numbers where -1 is null."""
    return pa.array(values, mask=values < 0)


def _texts(values: Iterable[str | None]) -> pa.Array:
    """Words of a closed list as plain text."""
    return pa.array([None if value is None else str(value) for value in values], pa.string())


def _middles(models: Sequence[RoofModel]) -> dict[str, list[float | None]]:
    """Middles of footprints; null for an empty one."""
    middles = [model.footprint.centroid for model in models]
    return {axis: [None if one.is_empty else getattr(one, axis) for one in middles] for axis in ("x", "y")}


def building_table(
    reference: Reference,
    wholes: WholeModels,
    footprints: Columns,
    roof_types: Columns,
    residuals: Residuals | None,
    surface: SurfaceScore | None,
) -> pa.Table:
    """One row per reference building; columns of measures that were not possible are absent.

    `model_id` is the first of `model_ids`, which has several where models divide a block into its houses.
    """
    buildings = reference.buildings
    standing = [None if number < 0 else number for number in footprints["model"].tolist()]
    models = [None if number is None else wholes.models[number] for number in standing]
    columns: dict[str, Any] = {
        "building_id": [building.building_id for building in buildings],
        "touches_data_edge": [building.touches_data_edge for building in buildings],
        "footprint_area_m2": footprints["area_m2"],
        **_middles(buildings),
        "model_id": _texts(footprints["model_id"]),
        "model_ids": pa.array(
            [[] if number is None else list(wholes.names[number]) for number in standing], pa.list_(pa.string())
        ),
        "model_type": [None if model is None else model.roof_type.value for model in models],
        "model_status": [None if model is None else model.status.value for model in models],
        "iou": footprints["iou"],
        "iou_union": footprints["iou_together"],
        **{name: footprints[name] for name in ("models_over", "area_bias", "outline_offset_m")},
    }
    if reference.conditions:
        known = [reference.conditions.get(building.building_id) for building in buildings]
        for name in ("shape", "good", "defects", "pitch_deg", "terrain_slope_deg"):
            columns[name] = [None if one is None else getattr(one, name) for one in known]
    if roof_types:
        columns |= {name: _texts(roof_types[name]) for name in ("true_type", "outcome")}
        columns |= {name: roof_types[name] for name in ("faces_to_find", "faces_found", "faces_wrong")}
    if residuals is not None:
        for prefix, counts, tallies in (("point", "", residuals.all_points), ("top", "top_", residuals.top_visible)):
            columns |= {f"{counts}{name}": tallies.counts[:, k] for k, name in enumerate(TALLIED)}
            figures = {"rmse": RMSE, "bias": BIAS, "median": tallies.quantile(0.5), "p95": tallies.quantile(0.95)}
            columns |= {f"{prefix}_{name}_m": tallies.figure(of) for name, of in figures.items()}
    if surface is not None:
        columns |= {
            "surface_coverage": surface.tallies.figure(COVERAGE),
            "surface_within": surface.tallies.figure(WITHIN),
            "surface_median_m": surface.median_m,
            "surface_rmse_m": surface.tallies.figure(RMSE),
            "surface_bias_m": surface.tallies.figure(BIAS),
        }
    return _table(columns)


def model_table(models: ModelSet, solids: Sequence[ModelValidity], delivery: Delivery | None) -> pa.Table:
    """One row per model, then one per record without a model."""
    everything, failed = (*models.models, *models.failed), len(models.failed)
    columns: dict[str, Any] = {
        "model_id": [model.building_id for model in everything],
        "status": [model.status.value for model in models.models] + ["failed"] * failed,
        "lod": [model.lod for model in everything],
        "roof_type": [model.roof_type.value for model in everything],
        "footprint_area_m2": [model.footprint.area for model in everything],
        **_middles(everything),
        "faces": [len(model.surfaces) for model in everything],
        "has_solid": [row.is_closed for row in solids] + [False] * failed,
        "validity_codes": [sorted({code for codes in row.codes for code in codes}) for row in solids] + [None] * failed,
    }
    if delivery is not None:
        columns["on_reference"] = [*delivery.models["on_reference"].tolist(), *[None] * failed]
        columns["role"] = [*(ROLES[Stands(one)] for one in delivery.models["stands"]), *["failed"] * failed]
    return _table(columns)


def true_face_table(score: FaceScore, reference: Reference) -> pa.Table:
    """One row per true roof face."""
    nullable = {name: _numbers(score.true[name]) for name in ("group", "n_points", "model_plane_id")}
    texts = {name: _texts(score.true[name]) for name in ("building_id", "model_id", "topology")}
    return _face_table(TRUE_FACES, score.true | nullable | texts, reference.buildings)


def model_face_table(score: FaceScore, models: Sequence[RoofModel], reference: Reference) -> pa.Table:
    """One row per roof face of a model."""
    names = np.array([*(building.building_id for building in reference.buildings), None], object)
    made = score.made | {"building_id": names[score.made["building"]]}
    texts = {name: _texts(made[name]) for name in ("model_id", "verdict", "building_id", "topology")}
    return _face_table(MODEL_FACES, made | texts | {"wrong": made["verdict"] == FaceVerdict.WRONG}, models)


def _face_table(names: Sequence[str], columns: Mapping[str, Any], models: Sequence[RoofModel]) -> pa.Table:
    polygons = np.array([surface.polygon for model in models for surface in model.surfaces], dtype=object)
    return _table({name: columns[name] for name in names} | {"geometry": shapely.to_wkb(polygons)})


def topology_table(score: FaceScore) -> pa.Table:
    """Components of faces that lie on one another, counted by kind."""
    of_kind = [score.components["kind"] == kind for kind in Topology]
    return _table(
        {"relation": [kind.value for kind in Topology], "components": [int(one.sum()) for one in of_kind]}
        | {name: [int(score.components[name][one].sum()) for one in of_kind] for name in ("true_faces", "model_faces")}
    )


def residual_histogram(residuals: Residuals) -> pa.Table:
    """Points of all counted buildings by the size of their residual; points without a roof are in no bin."""
    counts = {"count": residuals.all_points, "count_top": residuals.top_visible}
    sums = {name: one.histogram[residuals.counts].sum(axis=0, dtype=np.int64) for name, one in counts.items()}
    return _table({"low_m": EDGES_M[:-1], "high_m": EDGES_M[1:], **sums})


def outcome_table(rows: Columns, subsets: Sequence[Subset]) -> Mapping[str, pa.Table]:
    """Outcomes by roof type and by shape in every subset, and the confusion of types over all."""
    found = [outcome_tables(rows, subset) for subset in subsets]
    by_type, by_shape = ([row for tables in found for row in tables[k]] for k in (0, 1))
    confused = [
        {"true_type": true.value, "model_type": made.value, "buildings": count}
        for (true, made), count in confusion(rows, subsets[0]).items()
    ]
    tables = {"outcomes": by_type, "outcomes_by_shape": by_shape, "confusion": confused}
    return {name: pa.Table.from_pylist(listed) for name, listed in tables.items() if listed}


def validity_table(rows: Sequence[ModelValidity]) -> pa.Table:
    """How many solids have each code."""
    counts = code_counts(rows)
    return _table({"code": _texts(counts), "solids": pa.array(list(counts.values()), pa.int64())})


def ground_table(blocks: Columns) -> pa.Table:
    """The ground figures of each tile."""
    figures = tile_figures(blocks)
    return _table({name: figures[name] for name in ("tile", "type_1", "type_2", "total", "kappa", "ground", "object")})


def wireframe_table(score: WireframeScore, board: Columns) -> pa.Table:
    """One row per true wireframe."""
    columns: dict[str, Any] = {
        "building_id": list(score.building_ids),
        "x": score.places[:, 0],
        "y": score.places[:, 1],
        "model_ids": pa.array(list(map(list, score.model_ids)), pa.list_(pa.string())),
        "has_model": score.has_model,
    }
    for kind, unit in (("edges", "_m"), ("corners", "")):
        for side in ("true", "model"):
            amount = score.amounts[f"{side}_{kind}"][:, 0]
            columns[f"{side}_{kind}{unit}"] = amount if unit else np.rint(amount).astype(np.int64)
    for kind in ("edge", "corner"):
        for k, tolerance in enumerate(TOLERANCES_M):
            with np.errstate(divide="ignore", invalid="ignore"):
                for name, statistic in STATISTICS.items():
                    figure = statistic(score.columns(kind, k))
                    columns[f"{kind}_{name}_{tolerance_name(tolerance)}"] = figure
    columns |= {f"board_{name}": board[name].astype(np.int64) for name in ("right_corners", "right_edges")}
    return _table(columns)


def form_tables(score: FormScore, models: Sequence[RoofModel]) -> Mapping[str, pa.Table]:
    """One row per model: the form of its outlines; and one row per drawn block, if there are any."""
    names = {"model_id": [model.building_id for model in models]}
    found = {"outlines": _table(names | score.found)}
    if score.blocks:
        found["blocks"] = _table({name: column for name, column in score.blocks.items() if name != "away"})
    return found
