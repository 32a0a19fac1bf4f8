"""The arrangement: labelled roof points and planes to roof faces that fill an outline exactly."""

from __future__ import annotations

import numpy as np
import shapely
from numba import njit
from shapely import MultiPolygon

from pipeline.errors import BuildingError
from pipeline.model import FloatArray, IntArray, LabelArray, Reason
from pipeline.roof.arrangement.candidate_lines import border_places, candidate_lines
from pipeline.roof.arrangement.cells import cell_borders, cell_costs, cells_of_points, unite_faces
from pipeline.roof.arrangement.faces import corners_of_borders, part_crossings, trace_faces
from pipeline.roof.arrangement.minimum_cut import every_label, expand_labels, neighbour_lists
from pipeline.roof.arrangement.raster_labels import COST_SCALE, raster_labels
from pipeline.roof.arrangement.settings import ArrangementSettings
from pipeline.roof.arrangement.subdivision import outline_graph, subdivide
from pipeline.roof.partition import RoofPartition

_EDGES_PER_LINE = 24
_SPARE_EDGES = 256
_ROUNDS = 5


@njit(cache=True, nogil=True)
def _arranged(
    points: FloatArray,
    labels: LabelArray,
    planes: FloatArray,
    ring_xy: IntArray,
    ring_starts: LabelArray,
    polygon_of_ring: LabelArray,
    cell_m: float,
    points_per_m2: float,
    cap_m: float,
    cost_per_m: float,
    face_cost: int,
    line_length_m: float,
    line_reach_m: float,
    overshoot_m: float,
) -> tuple[IntArray, LabelArray, LabelArray, LabelArray, LabelArray, LabelArray, LabelArray]:
    """Vertices; rings, their starts and faces without and with all vertices on lines; planes of the faces."""
    n_outline = len(ring_xy)
    edges = np.empty((n_outline, 4))
    for r in range(len(ring_starts) - 1):
        for v in range(ring_starts[r], ring_starts[r + 1]):
            after = v + 1 if v + 1 < ring_starts[r + 1] else ring_starts[r]
            for axis in range(2):
                edges[v, axis] = ring_xy[v, axis] * 1e-3
                edges[v, 2 + axis] = ring_xy[after, axis] * 1e-3
    k = len(planes)

    lines, scores = np.empty((0, 3)), np.empty(0)
    crossing, line_of = np.empty(0, np.int32), np.empty(0, np.int32)
    places = np.empty((0, 2))
    if k > 1:
        raster, place, low_x, low_y, columns = raster_labels(points, planes, edges, cell_m, cap_m, cost_per_m)
        half = 0.5 * cell_m
        places, pairs = border_places(raster, place, low_x, low_y, half, columns, k)
        lines, scores, crossing, line_of = candidate_lines(
            places, pairs, points, planes, edges, half, cap_m, line_length_m
        )

    xy, graph = outline_graph(ring_xy, ring_starts, polygon_of_ring, _SPARE_EDGES + _EDGES_PER_LINE * len(lines))
    counts = np.array([n_outline, 2 * n_outline, polygon_of_ring.max() + 1], np.int32)
    subdivide(xy, graph, counts, lines, scores, crossing, line_of, places, line_reach_m)

    n_cells = counts[2]
    cell_labels = np.zeros(n_cells + len(xy), np.int32)
    if k > 1:
        cells = cells_of_points(xy, graph, counts[1], points)
        costs = cell_costs(
            xy, graph, counts[1], n_cells, points, labels, planes, cells, cap_m, points_per_m2, overshoot_m
        )
        borders, weights = cell_borders(xy, graph, counts[1], cost_per_m)
        chosen = cell_labels[:n_cells]
        for i in range(n_cells):
            chosen[i] = np.argmin(costs[i])
        starts, others, border_costs = neighbour_lists(n_cells, borders, weights)
        allowed, allowed_starts = every_label(n_cells, k)
        expand_labels(costs, allowed, allowed_starts, starts, others, border_costs, chosen, _ROUNDS)
        unite_faces(costs, borders, weights, chosen, face_cost)

    faces, n_faces = part_crossings(xy, graph, counts, cell_labels, planes)
    plane_of_face = np.empty(n_faces, np.int32)
    for i in range(counts[2]):
        plane_of_face[faces[i]] = cell_labels[i]
    needed = corners_of_borders(xy, graph, counts[0], counts[1], n_outline, faces)
    vertices, starts, owner = trace_faces(xy, graph, counts[1], faces, needed)
    return xy[: counts[0]].copy(), vertices, starts, owner, plane_of_face, graph[: counts[1]].copy(), faces


def _rings_of(outline_mm: MultiPolygon) -> tuple[IntArray, LabelArray, LabelArray]:
    """Rings of the outline, outer ones to the left, holes to the right, with their starts and polygons."""
    rings: list[IntArray] = []
    polygons: list[int] = []
    for number, polygon in enumerate(shapely.get_parts(shapely.orient_polygons(outline_mm)).tolist()):
        for ring in (polygon.exterior, *polygon.interiors):
            rings.append(np.rint(shapely.get_coordinates(ring)[:-1]).astype(np.int64))
            polygons.append(number)
    starts = np.cumsum([0, *(len(ring) for ring in rings)]).astype(np.int32)
    return np.concatenate(rings), starts, np.array(polygons, np.int32)


def _polygons(
    xy: IntArray, vertices: LabelArray, starts: LabelArray, owner: LabelArray, plane_of_face: LabelArray
) -> RoofPartition | None:
    """The faces as polygons; None where they are no coverage."""
    nodes = xy[vertices].astype(np.float64)
    following = np.arange(1, len(vertices) + 1)
    following[starts[1:] - 1] = starts[:-1]
    cross = nodes[:, 0] * nodes[following, 1] - nodes[following, 0] * nodes[:, 1]
    sizes = np.diff(starts)
    if sizes.min() < 3:
        return None
    twice_area = np.add.reduceat(cross, starts[:-1])
    order = np.lexsort((twice_area <= 0.0, owner))
    rings = shapely.linearrings(
        nodes[np.concatenate([np.arange(starts[r], starts[r + 1]) for r in order])],
        indices=np.repeat(np.arange(len(order)), sizes[order]),
    )
    firsts = np.flatnonzero(np.diff(owner[order], prepend=-1))
    polygons = shapely.polygons(rings, indices=owner[order])
    if (twice_area[order[firsts]] <= 0.0).any() or (twice_area > 0.0).sum() != len(plane_of_face):
        return None
    if not shapely.is_valid(polygons).all() or not shapely.coverage_is_valid(polygons):
        return None
    return RoofPartition(polygons=tuple(polygons.tolist()), labels=plane_of_face)


def arrange(
    points: FloatArray,
    labels: LabelArray,
    planes: FloatArray,
    outline_mm: MultiPolygon,
    spacing_m: float,
    settings: ArrangementSettings,
) -> RoofPartition:
    """Fill an outline with the roof faces that explain the points best for their number and their borders' length.

    Coarse labels of a raster give candidate lines along their borders; the lines cut the outline into cells where
    they have support; the cells get the labels of least cost; cells of one label are a face.

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

    Returns
    -------
    RoofPartition
        A valid coverage of the whole outline: polygons in integer millimetres that share their borders exactly. A
        place without points belongs to a neighbour's plane.

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
    xy, vertices, starts, owner, plane_of_face, graph, faces = _arranged(
        points - shift,
        labels,
        moved,
        ring_xy - low,
        ring_starts,
        polygon_of_ring,
        max(settings.raster_cell_m, spacing_m),
        points_per_m2,
        settings.residual_cap_m,
        settings.border_cost / spacing_m,
        round(settings.face_cost * COST_SCALE),
        settings.line_length_m,
        max(settings.line_reach_m, spacing_m),
        settings.overshoot_m,
    )
    partition = _polygons(xy + low, vertices, starts, owner, plane_of_face)
    if partition is None:
        # with every vertex that was put on a line the faces are as exact as the subdivision itself
        vertices, starts, owner = trace_faces(xy, graph, len(graph), faces, np.ones(len(xy), np.bool_))
        partition = _polygons(xy + low, vertices, starts, owner, plane_of_face)
    if partition is None:
        raise BuildingError(Reason.NO_PARTITION, "the cells of the outline make no coverage")
    return partition
