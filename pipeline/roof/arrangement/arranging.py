"""The arrangement: turns labelled roof points and planes into roof faces that fill an outline exactly."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.model import FloatArray, IntArray, LabelArray, Plane, Reason
from pipeline.roof.arrangement.arranged_faces import corners_of_borders, part_crossings, rings_of_faces, trace_faces
from pipeline.roof.arrangement.candidate_lines import CandidateLines, candidate_lines, outline_directions
from pipeline.roof.arrangement.far_corners import (
    HeightsAround,
    add_costs_of_far_planes,
    cut_off_far_corners,
    heights_around,
    heights_raster,
    with_level_planes,
)
from pipeline.roof.arrangement.guide_lines import NO_GUIDES, Guides, mark_edges_on_guides, with_guides
from pipeline.roof.arrangement.joined_planes import joined_planes
from pipeline.roof.arrangement.merged_vertices import merge_vertices, rings_with_merged
from pipeline.roof.arrangement.minimum_cut import costs_of_all, every_label, expand_labels, neighbour_lists
from pipeline.roof.arrangement.movable_borders import Borders, edges_of_rings
from pipeline.roof.arrangement.moved_vertices import move_vertices
from pipeline.roof.arrangement.plan_cells import cell_borders, cell_costs, cells_of_points, points_per_cell, unite_faces
from pipeline.roof.arrangement.plane_refit import labels_of_points, refitted_planes, support_of_planes
from pipeline.roof.arrangement.raster_labels import Limits, limits_at, raster_labels
from pipeline.roof.arrangement.step_lines import border_places
from pipeline.roof.arrangement.subdivision import CELLS, EDGES, VERTICES, Subdivision, subdivide, subdivision_of
from pipeline.roof.partition import RoofPartition
from pipeline.roof.roof_settings import ArrangementSettings

_EDGES_PER_LINE = 24
_SPARE_EDGES = 256
"""Room for new edges; lines that find none left are not drawn."""
_ROUNDS = 5
"""Most turns of the expansion: bounds the work; it ends as soon as no label changes."""
_CUTS = 3
"""How often cells are cut whose plane leaves the points: bounds the work."""


class _Outline(NamedTuple):
    """Rings of an outline: vertices (n, 2) mm, first vertex of each and number of vertices, polygon of each; int64."""

    xy: IntArray
    starts: IntArray
    polygons: IntArray


class _Arranged(NamedTuple):
    """The subdivision; rings from `rings_of_faces`; plane of each face, face of each cell; planes and their support."""

    plan: Subdivision
    rings: tuple[FloatArray, IntArray, LabelArray, bool]
    plane_of_face: LabelArray
    faces: LabelArray
    planes: FloatArray
    support: FloatArray


@kernel(inline="always")
def _outline_edges(outline: _Outline) -> FloatArray:
    """Edges x0, y0, x1, y1 of all rings, (n, 4), metres."""
    edges = np.empty((len(outline.xy), 4))
    for r in range(len(outline.starts) - 1):
        first, last = outline.starts[r], outline.starts[r + 1]
        for v in range(first, last):
            after = v + 1 if v + 1 < last else first
            for axis in range(2):
                edges[v, axis] = outline.xy[v, axis] * 1e-3
                edges[v, 2 + axis] = outline.xy[after, axis] * 1e-3
    return edges


@kernel(inline="always")
def _planes_and_lines(
    points: FloatArray, planes: FloatArray, edges: FloatArray, guides: Guides, limits: Limits
) -> tuple[FloatArray, CandidateLines]:
    """The planes refitted to the points of their coarse labels, (k, 3); guides and lines along the borders of those."""
    k, cap_m = len(planes), limits.cap_m
    if k == 1:
        nowhere = np.empty(0, np.int32)
        lines = CandidateLines(np.empty((0, 3)), np.empty(0), nowhere, np.empty((0, 2)), nowhere)
        return refitted_planes(points, np.zeros(len(points), np.int32), planes, cap_m), lines
    labels, raster = raster_labels(points, planes, edges, limits.cell_m, cap_m, limits.cost_per_m)
    planes = refitted_planes(points, labels_of_points(points, labels, raster), planes, cap_m)
    lines = candidate_lines(border_places(labels, raster, k), points, planes, edges, raster.cell_m, limits)
    return planes, with_guides(lines, guides, raster.cell_m, limits.line_length_m)


@kernel(inline="always")
def _label_cells(  # noqa: PLR0913 - the parts of one arrangement
    plan: Subdivision,
    points: FloatArray,
    labels: LabelArray,
    planes: FloatArray,
    limits: Limits,
    around: HeightsAround,
    is_again: bool,
    guides: FloatArray,
    chosen: LabelArray,
) -> IntArray:
    """Give every cell its plane, in place of those `chosen` before, -1 for none; the cell of each point, (n,).

    `labels` are the planes of the points. From the second time on planes that are far from the points cost more. The
    pieces of guides (g, 4) lie on the first lines.
    """
    n_cells = plan.counts[CELLS]
    cells = cells_of_points(plan, points)
    costs, misfits = cell_costs(plan, points, labels, planes, cells, limits)
    if is_again:
        add_costs_of_far_planes(plan, planes, around, limits.overshoot_m, costs, misfits)
    borders, weights = cell_borders(plan, limits.cost_per_m, guides)
    for i in range(n_cells):
        if chosen[i] < 0:
            chosen[i] = np.argmin(costs[i])
    neighbours = neighbour_lists(n_cells, borders, weights)
    expand_labels(costs_of_all(costs), every_label(n_cells, len(planes)), neighbours, chosen, _ROUNDS)
    held = points_per_cell(cells, n_cells)
    unite_faces(plan, misfits, held, borders, weights, chosen, limits)
    return cells


@kernel(inline="always")
def clean_borders(
    borders: Borders,
    rings: tuple[IntArray, IntArray],
    points: FloatArray,
    labels: LabelArray,
    planes: FloatArray,
    limits: Limits,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Fewer corners, each where its planes meet, and planes that meet there; vertices of the borders move in place.

    Vertices and starts of the rings are those of `trace_faces`; `points` (n, 3) and `planes` (k, 3) are in metres,
    `labels` (n,) are the planes of the points. Returns the vertices and starts of the new rings and the new planes.
    """
    vertices, starts = rings_with_merged(rings[0], rings[1], merge_vertices(borders, points, planes, limits))
    planes = refitted_planes(points, labels, planes, limits.cap_m)
    if move_vertices(borders, points, planes, limits):
        into = merge_vertices(borders, points, planes, limits)
        vertices, starts = rings_with_merged(vertices, starts, into)
    return vertices, starts, joined_planes(points, labels, planes, borders, limits)


@kernel
def _arranged(
    points: FloatArray, labels: LabelArray, planes: FloatArray, outline: _Outline, guides: Guides, limits: Limits
) -> _Arranged:
    """Kernel of `arrange`."""
    planes, lines = _planes_and_lines(points, planes, _outline_edges(outline), guides, limits)
    n_lines = len(lines.lines)
    plan = subdivision_of(outline.xy, outline.starts, outline.polygons, _SPARE_EDGES + _EDGES_PER_LINE * n_lines)
    counts = plan.counts
    subdivide(plan, lines, limits.line_reach_m, limits.clearance)

    raster_of_heights = heights_raster(points, 1.0 / math.sqrt(limits.points_per_m2))
    label_of_point = np.zeros(len(points), np.int32)
    cell_labels = np.zeros(counts[CELLS] + len(plan.xy), np.int32)
    known = 0
    for attempt in range(_CUTS + 1 if len(planes) > 1 else 0):
        n_cells, k = counts[CELLS], len(planes)
        before, cell_labels = cell_labels, np.full(n_cells + len(plan.xy), -1, np.int32)
        for i in range(known):
            cell_labels[i] = before[i]
        known = n_cells
        chosen = cell_labels[:n_cells]
        around = heights_around(plan, raster_of_heights)
        cells = _label_cells(plan, points, labels, planes, limits, around, attempt > 0, guides.pieces, chosen)
        for i in range(len(points)):
            label_of_point[i] = chosen[cells[i]] if cells[i] >= 0 else -1
        if attempt == _CUTS:
            break
        planes = with_level_planes(plan, planes, chosen, around, limits.overshoot_m)
        line = n_lines + attempt * len(plan.graph)
        found = cut_off_far_corners(plan, points, cells, planes, chosen, around, limits, line)
        if found == 0 or (attempt > 0 and counts[CELLS] == n_cells and len(planes) == k):
            break

    faces, n_faces = part_crossings(plan, cell_labels, planes, limits.clearance)
    plane_of_face = np.empty(n_faces, np.int32)
    for i in range(counts[CELLS]):
        plane_of_face[faces[i]] = cell_labels[i]
    vertices, ring_starts, owner = trace_faces(plan, faces, corners_of_borders(plan, len(outline.xy), faces))
    # one row more, in which places are tried
    xy = np.concatenate((plan.xy, np.zeros((1, 2), np.int64)))
    if n_faces > 1 and limits.clearance == 1.0:
        edges = edges_of_rings(xy, vertices, ring_starts, owner)
        mark_edges_on_guides(xy, edges, guides.pieces)
        directions = outline_directions(_outline_edges(outline))
        borders = Borders(xy, edges, plane_of_face, np.arange(len(xy)) < len(outline.xy), directions)
        rings = vertices, ring_starts
        vertices, ring_starts, planes = clean_borders(borders, rings, points, label_of_point, planes, limits)
    support = support_of_planes(points, label_of_point, planes, limits.cap_m)
    polygons = rings_of_faces(xy, vertices, ring_starts, owner, n_faces)
    used = Subdivision(plan.xy[: counts[VERTICES]].copy(), plan.graph[: counts[EDGES]].copy(), counts)
    return _Arranged(used, polygons, plane_of_face, faces, planes, support)


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
    """The faces, from `rings_of_faces`; None where they are not a coverage."""
    lines = shapely.linearrings(nodes, indices=ring_of)
    # without holes each ring is a polygon, which shapely makes in half the time
    polygons = shapely.polygons(lines, indices=owner if len(owner) > owner[-1] + 1 else None)
    if not shapely.is_valid(polygons).all() or not (len(polygons) == 1 or shapely.coverage_is_valid(polygons)):
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
    guides: Guides = NO_GUIDES,
) -> RoofPartition:
    """Fill an outline with the roof faces that explain the points best for their number and their borders' length.

    Coarse labels of a raster give candidate lines along their borders; the lines cut the outline into cells where
    they have support; the cells get the labels of least cost; cells of one label are a face. Every plane is refitted to
    the points of its coarse labels before the lines are drawn. Cells whose plane leaves the points around them are cut
    once more (`far_corners`).

    Parameters
    ----------
    points : (n, 3) float64
        Roof points that see the sky, local metres, in a canonical order.
    labels : (n,) int32
        Plane of each, -1 for none; they show how high each plane reaches.
    planes : (k, 3) float64
        Coefficients a, b, c of z = a x + b y + c.
    outline_mm : MultiPolygon
        Valid, in integer millimetres of the same frame; with courtyards as holes.
    spacing_m : float
        Typical distance of neighbouring points in plan.
    clearance : float
        Times the usual distances that vertices keep from each other; more where planes nearly meet in one point and no
        solid is valid.
    guides : Guides
        Given lines, local metres, along which faces may part at no cost.

    Returns
    -------
    RoofPartition
        A valid coverage of the whole outline: polygons in integer millimetres that share their borders exactly. A
        place without points belongs to a neighbour's plane. Its planes are the given ones in their order, then
        horizontal ones for places where none of them fits.

    Raises
    ------
    BuildingError
        `no_plane` without planes; `no_partition` where the outline is empty or the faces are not a coverage.
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
    limits = limits_at(spacing_m, settings, clearance)
    near = Guides(guides.pieces - np.array([*shift[:2], *shift[:2]]), guides.distance_m)
    outline = _Outline(ring_xy - low, ring_starts, polygon_of_ring)
    found = _arranged(points - shift, labels, moved, outline, near, limits)
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
        raise BuildingError(Reason.NO_PARTITION, "the cells of the outline do not make a coverage")
    fitted = found.planes
    fitted[:, 2] -= fitted[:, 0] * shift[0] + fitted[:, 1] * shift[1]
    described = tuple(
        Plane(a=a, b=b, c=c, n_points=int(n), rmse_m=math.sqrt(squares / n) if n else 0.0)
        for (a, b, c), (n, squares) in zip(fitted.tolist(), found.support.tolist(), strict=True)
    )
    return RoofPartition(polygons=polygons, labels=found.plane_of_face, planes=described)
