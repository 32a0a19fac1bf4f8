"""The plane of each cell of the subdivision: the fit of its points weighed against the cost of borders and faces.

The cost of a cell's label is the sum of its points' capped residuals, in unexplained points. A border costs points per
length, a face a fixed number: the roof gets a short description (minimum description length). Only the points that
misfit the neighbouring plane count for a face. A few points are enough evidence if they lie on its plane. If some of
them misfit it as well, as in a crown above the roof, the face must be larger.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order, counting_sort
from pipeline.kernels.union_find import numbered_sets, unite
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.guide_lines import length_on_guide
from pipeline.roof.arrangement.raster_labels import COST_SCALE, Limits, vertical_distance_m
from pipeline.roof.arrangement.subdivision import CELLS, EDGES, FACE, LINE, ORIGIN, Subdivision, between_vertices

_MIN_BEYOND = 3.0
"""Points that a cell counts for at least where a plane leaves the heights of its own: splinters hold none."""
_ROW_MM = 200.0
"""Height of the rows by which edges are sorted; changes the speed only."""
_TOLERANCE = 0.5
"""Share of the cap: points nearer than this to a plane fit it; from there to the cap they misfit more and more."""
_DOUBTFUL_SHARE = 0.5
"""Share of a face's points that misfit its own plane from which on it costs the most: a plane amid points that fill a
space, as a crown does, is met by about half of them."""
_SLIVER = 5.0
"""A sliver is at least this many times as long as wide: narrow triangles of hips and dormers are not."""

_ALONG = 0.75
"""Share of its length with which a parapet is on the outline."""
_SMEARED_SHARE = 0.1
"""Share of a sliver's points that misfit its own plane from which on they are those of a wall, smeared by the beam: the
points of a parapet's top fit it, those of a wall are spread over its height."""
_LOW_SHARE = 0.5
"""A sliver joins its neighbour if the misfit per point is at most this: its points are as low as that roof."""


@kernel
def cells_of_points(plan: Subdivision, points: FloatArray) -> IntArray:
    """The cell of each point (n, 3), metres, as (n,) int64; -1 outside. Borders belong to the cell east of them."""
    xy, graph, n_edges = plan.xy, plan.graph, plan.counts[EDGES]
    low, high = math.inf, -math.inf
    for h in range(n_edges):
        low = min(low, float(xy[graph[h, ORIGIN], 1]))
        high = max(high, float(xy[graph[h, ORIGIN], 1]))
    rows = int((high - low) / _ROW_MM) + 1
    # every edge that runs down, once for each row of places that it passes
    room = 0
    for h in range(n_edges):
        top, bottom = xy[graph[h, ORIGIN], 1], xy[graph[h ^ 1, ORIGIN], 1]
        if top > bottom:
            room += int((top - low) / _ROW_MM) - int((bottom - low) / _ROW_MM) + 1
    held, row_of = np.empty(room, np.int64), np.empty(room, np.int32)
    m = 0
    for h in range(n_edges):
        top, bottom = xy[graph[h, ORIGIN], 1], xy[graph[h ^ 1, ORIGIN], 1]
        if top > bottom:
            for r in range(int((bottom - low) / _ROW_MM), int((top - low) / _ROW_MM) + 1):
                held[m], row_of[m] = h, r
                m += 1
    starts, in_row = counting_sort(row_of, rows)
    # the ends of these edges, row by row: every point looks at all of its row
    ends, cell_of = np.empty((m, 4)), np.empty(m, np.int64)
    for s in range(m):
        h = held[in_row[s]]
        cell_of[s] = graph[h, FACE]
        for end in range(2):
            v = graph[h ^ end, ORIGIN]
            ends[s, 2 * end], ends[s, 2 * end + 1] = xy[v, 0], xy[v, 1]
    cells = np.full(len(points), -1, np.int64)
    for i in range(len(points)):
        x, y = points[i, 0] * 1e3, between_vertices(points[i, 1] * 1e3)
        if y < low or y >= high:
            continue
        r = int((y - low) / _ROW_MM)
        nearest = -math.inf
        for s in range(starts[r], starts[r + 1]):
            x0, y0, x1, y1 = ends[s, 0], ends[s, 1], ends[s, 2], ends[s, 3]
            if y0 > y >= y1:
                at = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
                if nearest < at <= x:
                    nearest = at
                    cells[i] = cell_of[s]
    return cells


@kernel
def cell_areas_m2(plan: Subdivision) -> FloatArray:
    """Area of every cell, (c,) float64."""
    xy, graph = plan.xy, plan.graph
    twice = np.zeros(plan.counts[CELLS], np.int64)
    for h in range(plan.counts[EDGES]):
        if graph[h, FACE] >= 0:
            p, q = graph[h, ORIGIN], graph[h ^ 1, ORIGIN]
            twice[graph[h, FACE]] += xy[p, 0] * xy[q, 1] - xy[p, 1] * xy[q, 0]
    areas = np.empty(len(twice))
    for cell in range(len(twice)):
        areas[cell] = twice[cell] * 0.5e-6
    return areas


@kernel(inline="always")
def _heights_of_planes(points: FloatArray, labels: LabelArray, planes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest point of each plane, (k,) metres; for a level plane without points its own height."""
    k = len(planes)
    lowest, highest = np.full(k, math.inf), np.full(k, -math.inf)
    for i in range(len(points)):
        if labels[i] >= 0:
            lowest[labels[i]] = min(lowest[labels[i]], points[i, 2])
            highest[labels[i]] = max(highest[labels[i]], points[i, 2])
    for label in range(k):
        if lowest[label] > highest[label] and planes[label, 0] == 0.0 == planes[label, 1]:
            lowest[label] = highest[label] = planes[label, 2]
    return lowest, highest


@kernel
def cell_costs(
    plan: Subdivision, points: FloatArray, labels: LabelArray, planes: FloatArray, cells: IntArray, limits: Limits
) -> tuple[IntArray, IntArray]:
    """Cost of every plane in every cell, (c, k) int64, in thousandths of an unexplained point.

    Where a plane leaves the heights of its own points at corners of a cell, it costs as if that share of the cell, or a
    few points, were not explained: planes are not continued far above or below their data without points. That share of
    the points that the cell lacks for its area misfits, or a few points. Costs are capped residuals; the misfits,
    returned too, are the same without residuals within half the cap.
    """
    xy, graph, n_cells = plan.xy, plan.graph, plan.counts[CELLS]
    k = len(planes)
    costs, misfits = np.zeros((n_cells, k), np.int64), np.zeros((n_cells, k), np.int64)
    expected, lacking = cell_areas_m2(plan), np.empty(n_cells)
    for cell in range(n_cells):
        expected[cell] *= limits.points_per_m2
        lacking[cell] = expected[cell]
    for i in range(len(points)):
        cell = cells[i]
        if cell < 0:
            continue
        lacking[cell] -= 1.0
        for label in range(k):
            share = min(vertical_distance_m(points, i, planes, label) / limits.cap_m, 1.0)
            costs[cell, label] += int(COST_SCALE * share)
            if share > _TOLERANCE:
                misfits[cell, label] += int(COST_SCALE * (share - _TOLERANCE) / (1.0 - _TOLERANCE))
    lowest, highest = _heights_of_planes(points, labels, planes)
    overshoot_m = limits.overshoot_m
    beyond = np.zeros((n_cells, k), np.int64)
    corners = np.zeros(n_cells, np.int64)
    for h in range(plan.counts[EDGES]):
        cell = graph[h, FACE]
        if cell < 0:
            continue
        corners[cell] += 1
        x, y = xy[graph[h, ORIGIN], 0] * 1e-3, xy[graph[h, ORIGIN], 1] * 1e-3
        for label in range(k):
            z = planes[label, 0] * x + planes[label, 1] * y + planes[label, 2]
            if lowest[label] <= highest[label] and (
                z < lowest[label] - overshoot_m or z > highest[label] + overshoot_m
            ):
                beyond[cell, label] += 1
    for cell in range(n_cells):
        for label in range(k):
            if beyond[cell, label] != 0:
                share = beyond[cell, label] / corners[cell]
                costs[cell, label] += int(COST_SCALE * max(share * expected[cell], _MIN_BEYOND))
                misfits[cell, label] += int(COST_SCALE * max(share * lacking[cell], _MIN_BEYOND))
    return costs, misfits


@kernel
def cell_borders(plan: Subdivision, cost_per_m: float, guides: FloatArray) -> tuple[IntArray, IntArray]:
    """Pairs of cells that share an edge, (m, 2), and what a border there costs, (m,), thousandths of points.

    The pieces of guides (g, 4), metres, lie on the first lines. Borders on them cost nothing.
    """
    xy, graph, n_edges = plan.xy, plan.graph, plan.counts[EDGES]
    pairs = np.empty((n_edges // 2, 2), np.int64)
    weights = np.empty(n_edges // 2, np.int64)
    m = 0
    for h in range(0, n_edges, 2):
        f, g = graph[h, FACE], graph[h ^ 1, FACE]
        if f < 0 or g < 0 or f == g:
            continue
        p, q = graph[h, ORIGIN], graph[h ^ 1, ORIGIN]
        length = math.hypot(float(xy[q, 0] - xy[p, 0]), float(xy[q, 1] - xy[p, 1])) * 1e-3
        pairs[m, 0], pairs[m, 1] = f, g
        if 0 <= graph[h, LINE] < len(guides):
            length -= length_on_guide(xy, p, q, guides[graph[h, LINE]])
        weights[m] = int(COST_SCALE * cost_per_m * length)
        m += 1
    return pairs[:m], weights[:m]


@kernel
def connected_faces(labels: LabelArray, pairs: IntArray) -> tuple[LabelArray, int]:
    """The face of every cell, numbered by its lowest cell, and their number: cells of one label connected by edges."""
    parent = np.arange(len(labels))
    for e in range(len(pairs)):
        if labels[pairs[e, 0]] == labels[pairs[e, 1]]:
            unite(parent, pairs[e, 0], pairs[e, 1])
    return numbered_sets(parent)


@kernel(inline="always")
def points_per_cell(cells: IntArray, n_cells: int) -> LabelArray:
    """How many points lie in each cell, (c,) int32; `cells` as from `cells_of_points`."""
    held = np.zeros(n_cells, np.int32)
    for cell in cells:
        if cell >= 0:
            held[cell] += 1
    return held


@kernel(inline="always")
def _borders_of_faces(faces: LabelArray, count: int, pairs: IntArray, weights: IntArray) -> tuple[IntArray, IntArray]:
    """Borders of faces by keys face * count + neighbour, ascending, and the cost of each of their edges."""
    keys = np.empty(2 * len(pairs), np.int64)
    between = np.empty(2 * len(pairs), np.int64)
    m = 0
    for e in range(len(pairs)):
        f, g = faces[pairs[e, 0]], faces[pairs[e, 1]]
        if f != g:
            keys[m], keys[m + 1] = np.int64(f) * count + g, np.int64(g) * count + f
            between[m] = between[m + 1] = weights[e]
            m += 2
    order = ascending_order(keys[:m])
    return keys[order], between[order]


@kernel(inline="always")
def _fitted(misfits: IntArray, label_of: LabelArray, held: IntArray, keys: IntArray) -> BoolArray:
    """Whether the points `held` by each face, (f,), fit its plane and no neighbour's; keys of `_borders_of_faces`."""
    is_fitted = np.empty(len(held), np.bool_)
    for f in range(len(held)):
        is_fitted[f] = misfits[f, label_of[f]] < _SMEARED_SHARE * COST_SCALE * held[f]
    for key in keys:
        f, g = key // len(held), key % len(held)
        is_fitted[f] &= misfits[f, label_of[g]] >= _LOW_SHARE * COST_SCALE * held[f]
    return is_fitted


@kernel(inline="always")
def _narrowest_sliver(
    plan: Subdivision, areas: FloatArray, faces: LabelArray, is_fitted: BoolArray, inside: IntArray, min_width_m: float
) -> int:
    """The face that is the narrowest sliver of those with a neighbour, if narrower than the minimum; -1 for none.

    Width and length are those of the rectangle with the area and the perimeter of the face. A fitted face (f,) whose
    long side is on the outline is a parapet and stays. A face without points `inside` (f,) goes however short it is.
    """
    xy, graph = plan.xy, plan.graph
    count = len(is_fitted)
    area, half, outer = np.zeros(count), np.zeros(count), np.zeros(count)
    has_neighbour = np.zeros(count, np.bool_)
    for cell in range(len(areas)):
        area[faces[cell]] += areas[cell]
    for h in range(plan.counts[EDGES]):
        f, g = graph[h, FACE], graph[h ^ 1, FACE]
        if f >= 0 and (g < 0 or faces[f] != faces[g]):
            p, q = graph[h, ORIGIN], graph[h ^ 1, ORIGIN]
            length = 1e-3 * math.hypot(float(xy[q, 0] - xy[p, 0]), float(xy[q, 1] - xy[p, 1]))
            half[faces[f]] += 0.5 * length
            has_neighbour[faces[f]] |= g >= 0
            if g < 0:
                outer[faces[f]] += length
    least, sliver = min_width_m, -1
    for f in range(count):
        square = 0.25 * half[f] * half[f] - area[f]
        if has_neighbour[f] and (square > 0.0 or inside[f] == 0):
            width = 0.5 * half[f] - math.sqrt(max(square, 0.0))
            length = half[f] - width
            is_parapet = is_fitted[f] and outer[f] >= _ALONG * length
            if width < least and (length >= _SLIVER * width or inside[f] == 0) and not is_parapet:
                least, sliver = width, f
    return sliver


@kernel
def unite_faces(
    plan: Subdivision,
    misfits: IntArray,
    held: LabelArray,
    pairs: IntArray,
    weights: IntArray,
    labels: LabelArray,
    limits: Limits,
) -> None:
    """Give whole faces the label of a neighbour while that saves more than it costs, the best first, in place.

    This saves their common border, and a face for every neighbour with that label; it costs the points that misfit
    then. A face costs more the more of its own points misfit it: `face_cost` if all fit, `doubtful_cost` if half of
    them misfit. When nothing is saved any more, slivers that are too narrow for a roof go to a neighbour all the same;
    parapets do not.
    Misfits are those of `cell_costs`, `held` of `points_per_cell`, pairs and weights of `cell_borders`.
    """
    k, face_cost, doubtful_cost = misfits.shape[1], limits.face_cost, limits.doubtful_cost
    areas = cell_areas_m2(plan)
    sliver = -1
    while True:
        faces, count = connected_faces(labels, pairs)
        if count < 2:
            return
        data = np.zeros((count, k), np.int64)
        inside = np.zeros(count, np.int64)
        label_of = np.empty(count, np.int32)
        for i in range(len(labels)):
            label_of[faces[i]] = labels[i]
            for label in range(k):
                data[faces[i], label] += misfits[i, label]
            inside[faces[i]] += held[i]
        keys, between = _borders_of_faces(faces, count, pairs, weights)
        best = np.int64(0) if sliver < 0 else np.iinfo(np.int64).max
        best_face, best_label = -1, -1
        saved = np.zeros(k, np.int64)
        s = 0
        while s < len(keys):
            f = keys[s] // count
            first = s
            while s < len(keys) and keys[s] // count == f:
                label = label_of[keys[s] % count]
                saved[label] += between[s]
                if s == first or keys[s] != keys[s - 1]:
                    saved[label] += face_cost
                s += 1
            own = data[f, label_of[f]]
            doubt = min(own / (_DOUBTFUL_SHARE * COST_SCALE * inside[f]), 1.0) if inside[f] > 0 else 1.0
            own += int(doubt * (doubtful_cost - face_cost))
            for q in range(first, s):
                label = label_of[keys[q] % count]
                change = data[f, label] - own - saved[label]
                if change < best and sliver in (-1, f):
                    best = change
                    best_face, best_label = f, label
            for q in range(first, s):
                saved[label_of[keys[q] % count]] = 0
        for i in range(len(labels)):
            if faces[i] == best_face:
                labels[i] = best_label
        if best_face >= 0:
            sliver = -1
        else:
            is_fitted = _fitted(data, label_of, inside, keys)
            sliver = _narrowest_sliver(plan, areas, faces, is_fitted, inside, limits.min_face_width_m)
            if sliver < 0:
                return
