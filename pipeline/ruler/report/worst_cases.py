"""The worst buildings of an evaluation, each in plan and in section with its points, and as a bird's-eye view."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import shapely
from markupsafe import Markup
from matplotlib.collections import PathCollection

from pipeline.model import FloatArray, LabelArray
from pipeline.report.pictures import blank, paths_of, png_of
from pipeline.ruler.evaluation.evaluate import Evaluation
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.report.model_pictures import corners_of, draw_true_edges, view_png, viewed_faces
from pipeline.ruler.report.section import RESIDUAL_CLASSES, UNCOVERED, profile_line, residual_class, section_svg, top_of

CASES = 12
"""Largest number of cases."""
MAX_NOT_FOUND = 4
"""Largest number of cases without a model."""
SOUND_SHARE = 0.999
"""A correct building with at least this share within 0.2 m is not a worst case."""
POINTS_PER_CASE = 12_000
"""Most points of a building; more are thinned evenly."""
SIDE_PX = 560
"""Width and height of a picture."""
MODEL_COLOUR, SECTION_COLOUR = "#7f93a6", "#777d86"
_MARGIN_M = 1.5
_CAPTION = (
    ("outcome", "outcome", "{}"),
    ("roof type", "type", "{}"),
    ("model", "model", "{}"),
    ("shape", "shape", "{}"),
    ("made hard by", "made_hard_by", "{}"),
    ("status", "model_status", "{}"),
    ("faces", "faces", "{}"),
    ("top points within 0.2 m", "top_within", "{}"),
    ("points within 0.2 m", "within", "{}"),
    ("roof within 0.2 m", "roof", "{:.1f} %"),
    ("RMSE of the top points", "top_rmse_m", "{:.3f} m"),
    ("point RMSE", "point_rmse_m", "{:.3f} m"),
    ("footprint IoU", "iou", "{:.2f}"),
    ("footprint", "footprint_area_m2", "{:.0f} m²"),
)
"""Figures of a caption: label, column or name, text."""
_BADNESS = {"false": 0, "passable": 1, "correct": 2}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One building with its pictures."""

    building_id: str
    figures: tuple[tuple[str, str], ...]
    plan_png: bytes
    """Faces of the models with the points over them, true outlines dashed."""
    view_png: bytes | None
    """The model from the south, else the true one; None if neither has faces."""
    view_is_truth: bool
    section: Markup | None
    """An SVG of the profile across the building; None without any faces."""


def worst_cases(evaluation: Evaluation) -> list[Case]:
    """The worst buildings with their pictures; empty without a reference. Each tile is read at most once.

    Buildings without a model and false ones come first, then by the mean of the shares of roof and top-visible
    points within 0.2 m.
    """
    reference, table = evaluation.reference, evaluation.tables.get("buildings")
    if reference is None or table is None:
        return []
    rows = chosen_rows(table)
    place = {building.building_id: number for number, building in enumerate(reference.buildings)}
    rows = [row for row in rows if row["building_id"] in place]
    points = _points_of(reference, [place[row["building_id"]] for row in rows])
    models = evaluation.models.models
    tree = shapely.STRtree([model.footprint for model in models])
    cases = []
    for row in rows:
        truth = reference.buildings[place[row["building_id"]]]
        near = shapely.box(*truth.footprint.bounds).buffer(_MARGIN_M, join_style="mitre")
        around = [models[i] for i in sorted(tree.query(near, predicate="intersects"))]
        own = [model for model in around if shapely.intersects(model.footprint, truth.footprint)]
        cases.append(_case(row, truth, own, around, points[place[row["building_id"]]]))
    return cases


def chosen_rows(table: pa.Table) -> list[dict[str, Any]]:
    """The rows of the worst buildings, the worst first, without those at the edge of the data."""
    rows = [row for row in table.to_pylist() if not row.get("touches_data_edge")]
    judged = []
    for row in rows:
        within = _within(row)
        outcome = row.get("outcome")
        missing = row.get("model_id") is None and "model_id" in row
        is_sound = not missing and outcome in {None, "correct"} and within >= SOUND_SHARE
        if not is_sound:
            badness = _BADNESS.get(outcome, 2) if outcome is not None else 2
            judged.append((0 if missing else badness, within, row["building_id"], missing, row))
    judged.sort(key=lambda entry: entry[:3])
    chosen, lost = [], 0
    for *_, missing, row in judged:
        lost += missing
        if not missing or lost <= MAX_NOT_FOUND:
            chosen.append(row)
    return chosen[:CASES]


def _within(row: Mapping[str, Any]) -> float:
    """Mean of the shares of the true roof and of the points within 0.2 m, as far as known; 1 if neither is.

    Both count: a survey that is shifted as a whole puts good models beside the true roofs, and not beside the points.
    """
    known = []
    share = row.get("surface_within")
    if share is not None and math.isfinite(share):
        known.append(float(share))
    prefix = _points_of_row(row)
    points, within = row.get(f"{prefix}n_points"), row.get(f"{prefix}n_within")
    if points and within is not None:
        known.append(float(within / points))
    return sum(known) / len(known) if known else 1.0


def _points_of_row(row: Mapping[str, Any]) -> str:
    """Prefix of the columns on points: top-visible ones, since facades do not make a model bad; older rows have all."""
    return "top_" if row.get("top_n_points") is not None else ""


def _points_of(reference: Reference, wanted: Sequence[int]) -> dict[int, FloatArray]:
    """Roof points of some buildings, (n, 3) each, thinned evenly; tiles without any of them are not read."""
    kept: dict[int, list[FloatArray]] = {building: [] for building in wanted}
    keys = np.array(sorted(wanted), np.int64)
    areas = [reference.buildings[building].footprint for building in wanted]
    for number, read in enumerate(reference.tiles):
        if reference.bounds and not shapely.intersects(areas, shapely.box(*reference.bounds[number])).any():
            continue
        chunk = read()
        held = np.flatnonzero(chunk.is_roof & np.isin(chunk.building, keys))
        owner: LabelArray = chunk.building[held]
        for building in np.unique(owner).tolist():
            kept[building].append(chunk.xyz[held[owner == building]])
    found = {}
    for building, parts in kept.items():
        xyz = np.concatenate(parts) if parts else np.zeros((0, 3))
        found[building] = xyz[:: max(1, math.ceil(len(xyz) / POINTS_PER_CASE))]
    return found


def _case(
    row: Mapping[str, Any],
    truth: RoofModel,
    own: Sequence[RoofModel],
    around: Sequence[RoofModel],
    xyz: FloatArray,
) -> Case:
    view_is_truth = not own
    viewed = [viewed_faces(one) for one in (own or [truth])]
    return Case(
        building_id=truth.building_id,
        figures=_figures(row),
        plan_png=_plan(truth, own, around, xyz),
        view_png=view_png(viewed, corners_of(viewed), (SIDE_PX, SIDE_PX)),
        view_is_truth=view_is_truth,
        section=section_svg(truth, own, xyz),
    )


def _figures(row: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """The caption, as far as known."""
    known = {
        name: value
        for name, value in row.items()
        if value is not None and not (isinstance(value, float) and math.isnan(value))
    }
    modelled = "not found" if row.get("model_id") is None else str(row.get("model_type") or "")
    if known.get("true_type", "none") not in {"none", "unknown"}:
        known["type"] = f"{row['true_type']}, modelled: {modelled or '?'}"
    elif "model_id" in row:
        known["model"] = modelled or "found"
    if known.get("model_status") == "ok":
        del known["model_status"]
    known["made_hard_by"] = ", ".join(row.get("defects") or ())
    if "faces_to_find" in known:
        wrong = row.get("faces_wrong") or 0
        known["faces"] = f"{row['faces_found']} of {row['faces_to_find']} found, {wrong} wrong"
    if "surface_within" in known:
        known["roof"] = 100.0 * row["surface_within"]
    prefix = _points_of_row(row)
    if n_points := known.get(f"{prefix}n_points"):
        known[f"{prefix}within"] = f"{100.0 * row[f'{prefix}n_within'] / n_points:.1f} % of {n_points:,}"
    known.pop("point_rmse_m" if prefix else "top_rmse_m", None)
    held = ((label, text, known.get(name)) for label, name, text in _CAPTION)
    return tuple((label, text.format(value)) for label, text, value in held if value not in {None, ""})


def _square(truth: RoofModel, own: Sequence[RoofModel]) -> tuple[float, float, float]:
    """Middle and side of the plan: the building and its models, at most twice the size of the building."""
    west, south, east, north = truth.footprint.bounds
    side = max(east - west, north - south)
    x, y = (west + east) / 2.0, (south + north) / 2.0
    reach = shapely.box(x - side, y - side, x + side, y + side)
    bounds = shapely.total_bounds([truth.footprint, *(shapely.intersection(one.footprint, reach) for one in own)])
    west, south, east, north = (float(value) for value in bounds)
    return (west + east) / 2.0, (south + north) / 2.0, max(east - west, north - south) + 2.0 * _MARGIN_M


def _plan(truth: RoofModel, own: Sequence[RoofModel], around: Sequence[RoofModel], xyz: FloatArray) -> bytes:
    """Faces of the models, points by residual, true outlines dashed, and where the section lies."""
    figure, axes = blank(SIDE_PX, SIDE_PX)
    x, y, side = _square(truth, own)
    faces = [surface.polygon for model in around for surface in model.surfaces]
    axes.add_collection(
        PathCollection(paths_of(faces), facecolors=f"{MODEL_COLOUR}38", edgecolors=MODEL_COLOUR, linewidths=1.4)
    )
    if len(xyz):
        kinds = residual_class(xyz[:, 2] - top_of(around, xyz[:, 0], xyz[:, 1]))
        size = float(np.clip(60_000.0 / len(xyz), 3.0, 40.0))
        for place in (2, 1, 3, 0, 4):
            at = kinds == place
            axes.scatter(xyz[at, 0], xyz[at, 1], s=size, c=RESIDUAL_CLASSES[place].colour, linewidths=0, zorder=3)
        bare = kinds == UNCOVERED
        axes.scatter(
            xyz[bare, 0],
            xyz[bare, 1],
            s=1.6 * size,
            c=RESIDUAL_CLASSES[UNCOVERED].colour,
            marker="x",
            linewidths=1.1,
            zorder=4,
        )
    draw_true_edges(axes, truth, np.zeros(2), 2.0)
    middle, along, half = profile_line(truth, own, xyz)
    line = np.array([middle - (half + _MARGIN_M) * along, middle + (half + _MARGIN_M) * along])
    axes.plot(line[:, 0], line[:, 1], color=SECTION_COLOUR, linewidth=1.3, marker="o", markersize=4.0, zorder=6)
    axes.set_xlim(x - side / 2.0, x + side / 2.0)
    axes.set_ylim(y - side / 2.0, y + side / 2.0)
    return png_of(figure)
