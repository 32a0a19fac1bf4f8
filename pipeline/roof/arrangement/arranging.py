"""The arrangement: labelled roof points and planes to roof faces that fill an outline exactly."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.model import FloatArray, IntArray, LabelArray, Plane, Reason
from pipeline.roof.arrangement.candidate_lines import border_places, candidate_lines
from pipeline.roof.arrangement.cells import cell_borders, cell_costs, cells_of_points, points_per_cell, unite_faces
from pipeline.roof.arrangement.faces import corners_of_borders, part_crossings, rings_of_faces, trace_faces
from pipeline.roof.arrangement.far_corners import (
    add_costs_of_far_planes,
    cut_off_far_corners,
    heights_around,
    heights_raster,
    with_level_planes,
)
from pipeline.roof.arrangement.minimum_cut import every_label, expand_labels, neighbour_lists
from pipeline.roof.arrangement.plane_refit import labels_of_points, refitted_planes, support_of_planes
from pipeline.roof.arrangement.raster_labels import COST_SCALE, raster_labels
from pipeline.roof.arrangement.subdivision import CELLS, EDGES, VERTICES, Subdivision, subdivide, subdivision_of
from pipeline.roof.partition import RoofPartition
from pipeline.roof.settings import ArrangementSettings

_EDGES_PER_LINE = 24
_SPARE_EDGES = 256
_ROUNDS = 5
_CUTS = 3
"""How often cells are cut whose plane leaves the points."""


class _Outline(NamedTuple):
    """Rings of an outline: vertices (n, 2) mm, first vertex of each and number of vertices, polygon of each; int64."""

    xy: IntArray
    starts: IntArray
    polygons: IntArray


class _Weights(NamedTuple):
    """Costs and lengths: `ArrangementSettings` at a density of points."""

    cell_m: float
    points_per_m2: float
    cap_m: float
    cost_per_m: float
    face_cost: int
    doubtful_cost: int
    line_length_m: float
    line_reach_m: float
    overshoot_m: float
    clearance: float


class _Arranged(NamedTuple):
    """The subdivision; rings from `rings_of_faces`; plane of each face, face of each cell; planes and their support."""

    plan: Subdivision
    rings: tuple[FloatArray, IntArray, LabelArray, bool]
    plane_of_face: LabelArray
    faces: LabelArray
    planes: FloatArray
    support: FloatArray


@kernel
def _arranged(
    points: FloatArray, labels: LabelArray, planes: FloatArray, outline: _Outline, weights: _Weights
) -> _Arranged:
    """Kernel of `arrange`."""
    cap_m, overshoot_m, clearance = weights.cap_m, weights.overshoot_m, weights.clearance
    n_outline = len(outline.xy)
    edges = np.empty((n_outline, 4))
    for r in range(len(outline.starts) - 1):
        first, last = outline.starts[r], outline.starts[r + 1]
        for v in range(first, last):
            after = v + 1 if v + 1 < last else first
            for axis in range(2):
                edges[v, axis] = outline.xy[v, axis] * 1e-3
                edges[v, 2 + axis] = outline.xy[after, axis] * 1e-3
    k = len(planes)

    lines, scores = np.empty((0, 3)), np.empty(0)
    crossing, line_of = np.empty(0, np.int32), np.empty(0, np.int32)
    places = np.empty((0, 2))
    label_of_point = np.zeros(len(points), np.int32)
    if k == 1:
        planes = refitted_planes(points, label_of_point, planes, cap_m)
    else:
        raster, place, low_x, low_y, columns = raster_labels(
            points, planes, edges, weights.cell_m, cap_m, weights.cost_per_m
        )
        half = 0.5 * weights.cell_m
        label_of_point = labels_of_points(points, raster, place, low_x, low_y, half, columns)
        planes = refitted_planes(points, label_of_point, planes, cap_m)
        places, pairs = border_places(raster, place, low_x, low_y, half, columns, k)
        lines, scores, crossing, line_of = candidate_lines(
            places, pairs, points, planes, edges, half, cap_m, weights.line_length_m
        )

    plan = subdivision_of(outline.xy, outline.starts, outline.polygons, _SPARE_EDGES + _EDGES_PER_LINE * len(lines))
    counts = plan.counts
    subdivide(plan, lines, scores, crossing, line_of, places, weights.line_reach_m, clearance)

    spacing_m = 1.0 / math.sqrt(weights.points_per_m2)
    raster_of_heights = heights_raster(points, spacing_m)
    cell_labels = np.zeros(counts[CELLS] + len(plan.xy), np.int32)
    known = 0
    for attempt in range(_CUTS + 1):
        n_cells = counts[CELLS]
        before, cell_labels = cell_labels, np.zeros(n_cells + len(plan.xy), np.int32)
        if k == 1:
            break
        chosen = cell_labels[:n_cells]
        cells = cells_of_points(plan, points)
        costs, misfits = cell_costs(plan, points, labels, planes, cells, cap_m, weights.points_per_m2, overshoot_m)
        around = heights_around(plan, raster_of_heights)
        if attempt > 0:
            add_costs_of_far_planes(plan, planes, around, overshoot_m, costs, misfits)
        borders, border_weights = cell_borders(plan, weights.cost_per_m)
        for i in range(n_cells):
            chosen[i] = before[i] if i < known else np.argmin(costs[i])
        known = n_cells
        starts, others, border_costs = neighbour_lists(n_cells, borders, border_weights)
        allowed, allowed_starts = every_label(n_cells, k)
        expand_labels(costs, allowed, allowed_starts, starts, others, border_costs, chosen, _ROUNDS)
        held = points_per_cell(cells, n_cells)
        unite_faces(misfits, held, borders, border_weights, chosen, weights.face_cost, weights.doubtful_cost)
        for i in range(len(points)):
            label_of_point[i] = chosen[cells[i]] if cells[i] >= 0 else -1
        if attempt == _CUTS:
            break
        planes = with_level_planes(plan, planes, chosen, around, overshoot_m)
        is_more, k = len(planes) > k, len(planes)
        line = len(lines) + attempt * len(plan.graph)
        found = cut_off_far_corners(
            plan, points, cells, planes, chosen, around, raster_of_heights, overshoot_m, cap_m, line, clearance
        )
        if found == 0 or (attempt > 0 and counts[CELLS] == n_cells and not is_more):
            break
    support = support_of_planes(points, label_of_point, planes, cap_m)

    faces, n_faces = part_crossings(plan, cell_labels, planes, clearance)
    plane_of_face = np.empty(n_faces, np.int32)
    for i in range(counts[CELLS]):
        plane_of_face[faces[i]] = cell_labels[i]
    vertices, ring_starts, owner = trace_faces(plan, faces, corners_of_borders(plan, n_outline, faces))
    rings = rings_of_faces(plan.xy, vertices, ring_starts, owner, n_faces)
    used = Subdivision(plan.xy[: counts[VERTICES]].copy(), plan.graph[: counts[EDGES]].copy(), counts)
    return _Arranged(used, rings, plane_of_face, faces, planes, support)


def _rings_of(outline_mm: MultiPolygon) -> tuple[IntArray, IntArray, IntArray]:
    """Rings of the outline, outer ones to the left, holes to the right, with their starts and polygons."""
    rings: list[IntArray] = []
    polygons: list[int] = []
    for number, polygon in enumerate(shapely.get_parts(shapely.orient_polygons(outline_mm)).tolist()):
        for ring in (polygon.exterior, *polygon.interiors):
            rings.append(np.rint(shapely.get_coordinates(ring)[:-1]).astype(np.int64))
            polygons.append(number)
    starts = np.cumsum([0, *(len(ring) for ring in rings)], dtype=np.int64)
    return np.concatenate(rings), starts, np.array(polygons, np.int64)


def _polygons(nodes: FloatArray, ring_of: IntArray, owner: LabelArray) -> tuple[Polygon, ...] | None:
    """The faces, from `rings_of_faces`; None where they are no coverage."""
    polygons = shapely.polygons(shapely.linearrings(nodes, indices=ring_of), indices=owner)
    if not shapely.is_valid(polygons).all() or not shapely.coverage_is_valid(polygons):
        return None
    return tuple(polygons.tolist())


def arrange(
    points: FloatArray,
    labels: LabelArray,
    planes: FloatArray,
    outline_mm: MultiPolygon,
    spacing_m: float,
    settings: ArrangementSettings,
    clearance: float = 1.0,
) -> RoofPartition:
    """Fill an outline with the roof faces that explain the points best for their number and their borders' length.

    Coarse labels of a raster give candidate lines along their borders; the lines cut the outline into cells where
    they have support; the cells get the labels of least cost; cells of one label are a face. Before the lines are
    drawn every plane is fitted anew to the points of its places. Cells whose plane leaves the points around them are
    cut once more (`far_corners`).

    Parameters
    ----------
    points : (n, 3) float64
        Roof points that see the sky, local metres, in a canonical order.
    labels : (n,) int32
        Plane of each, -1 for none; they tell how high each plane reaches.
    planes : (k, 3) float64
        Coefficients a, b, c of z = a x + b y + c.
    outline_mm : MultiPolygon
        Valid, in integer millimetres of the same frame; with courtyards as holes.
    spacing_m : float
        Typical distance of neighbouring points in plan.
    settings : ArrangementSettings
        Costs and lengths.
    clearance : float
        Times the usual distances that vertices keep from each other: more where planes meet nearly in one point and no
        solid is sound.

    Returns
    -------
    RoofPartition
        A valid coverage of the whole outline: polygons in integer millimetres that share their borders exactly. A
        place without points belongs to a neighbour's plane. With its planes: the given ones in their order, behind
        them horizontal ones for places where none of them fits.

    Raises
    ------
    BuildingError
        `no_plane` without planes; `no_partition` where the outline is empty or the faces are no coverage.
    """
    if len(planes) == 0:
        raise BuildingError(Reason.NO_PLANE, "there is no plane to arrange")
    if outline_mm.is_empty:
        raise BuildingError(Reason.NO_PARTITION, "the outline is empty")
    ring_xy, ring_starts, polygon_of_ring = _rings_of(outline_mm)
    # everything else happens near the origin: products of millimetres stay exact, metres precise
    low = ring_xy.min(axis=0)
    shift = np.array([low[0] * 1e-3, low[1] * 1e-3, 0.0])
    moved = np.ascontiguousarray(planes, dtype=np.float64).copy()
    moved[:, 2] += moved[:, 0] * shift[0] + moved[:, 1] * shift[1]
    points_per_m2 = 1.0 / spacing_m**2
    face_cost, doubtful_cost = settings.costs_of_face(points_per_m2)
    weights = _Weights(
        cell_m=settings.raster_cell_of(spacing_m),
        points_per_m2=points_per_m2,
        cap_m=settings.residual_cap_m,
        cost_per_m=settings.border_cost / spacing_m,
        face_cost=round(face_cost * COST_SCALE),
        doubtful_cost=round(doubtful_cost * COST_SCALE),
        line_length_m=settings.line_length_m,
        line_reach_m=max(settings.line_reach_m, spacing_m),
        overshoot_m=max(settings.overshoot_m, spacing_m),
        clearance=clearance,
    )
    found = _arranged(points - shift, labels, moved, _Outline(ring_xy - low, ring_starts, polygon_of_ring), weights)
    nodes, ring_of, owner, is_sound = found.rings
    polygons = _polygons(nodes + low, ring_of, owner) if is_sound else None
    if polygons is None:
        # with every vertex that was put on a line the faces are as exact as the subdivision itself
        vertices, starts, owner = trace_faces(found.plan, found.faces, np.ones(len(found.plan.xy), np.bool_))
        nodes, ring_of, owner, is_sound = rings_of_faces(
            found.plan.xy, vertices, starts, owner, len(found.plane_of_face)
        )
        polygons = _polygons(nodes + low, ring_of, owner) if is_sound else None
    if polygons is None:
        raise BuildingError(Reason.NO_PARTITION, "the cells of the outline make no coverage")
    fitted = found.planes
    fitted[:, 2] -= fitted[:, 0] * shift[0] + fitted[:, 1] * shift[1]
    described = tuple(
        Plane(a=a, b=b, c=c, n_points=int(n), rmse_m=math.sqrt(squares / n) if n else 0.0)
        for (a, b, c), (n, squares) in zip(fitted.tolist(), found.support.tolist(), strict=True)
    )
    return RoofPartition(polygons=polygons, labels=found.plane_of_face, planes=described)
