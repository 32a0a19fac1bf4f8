"""Coarse labels of an outline: a raster, every cell with the plane that explains its points and suits its neighbours.

They are no result: their borders tell where lines are worth trying. A coarse raster is labelled by alpha expansion,
a raster of half the cell starts from it and settles by iterated conditional modes (Besag 1986).
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.merge_sort import in_order
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.minimum_cut import expand_labels, neighbour_lists

COST_SCALE = 1000
"""Integer cost of one unexplained point."""
_SIDE = math.pi / 8.0
_DIAGONAL = math.pi / (8.0 * math.sqrt(2.0))
"""Length of border, in cells, for which a pair of neighbours over a side, over a corner stands: with eight neighbours
these measure borders of any direction nearly alike (Boykov and Kolmogorov 2003, Cauchy-Crofton)."""
_ROUNDS = 3
_SETTLING_ROUNDS = 8


@kernel
def vertical_distance_m(point: FloatArray, plane: FloatArray) -> float:
    """How far a point lies above or below the plane z = a x + b y + c."""
    distance: float = abs(point[2] - plane[0] * point[0] - plane[1] * point[1] - plane[2])
    return distance


@kernel
def raster_cells(
    edges: FloatArray, low_x: float, low_y: float, cell_m: float, columns: int, rows: int
) -> tuple[LabelArray, LabelArray]:
    """The cells whose centres lie inside an outline.

    Parameters
    ----------
    edges : (e, 4) float64
        Edges x0, y0, x1, y1 of all its rings, metres.
    low_x, low_y, cell_m, columns, rows
        The raster.

    Returns
    -------
    number : (rows * columns,) int32
        Number of every cell, row by row; -1 outside.
    place : (n,) int32
        Where in the raster each numbered cell lies, ascending.
    """
    number = np.full(rows * columns, -1, np.int32)
    place = np.empty(rows * columns, np.int32)
    crossings = np.empty(len(edges))
    n = 0
    for r in range(rows):
        y = low_y + (r + 0.5) * cell_m
        found = 0
        for e in range(len(edges)):
            if (edges[e, 1] > y) != (edges[e, 3] > y):
                fraction = (y - edges[e, 1]) / (edges[e, 3] - edges[e, 1])
                crossings[found] = edges[e, 0] + fraction * (edges[e, 2] - edges[e, 0])
                found += 1
        ordered = in_order(crossings[:found])
        for k in range(0, found - 1, 2):
            first = max(math.ceil((ordered[k] - low_x) / cell_m - 0.5), 0)
            last = min(math.floor((ordered[k + 1] - low_x) / cell_m - 0.5), columns - 1)
            for c in range(first, last + 1):
                if number[r * columns + c] < 0:
                    number[r * columns + c] = n
                    place[n] = r * columns + c
                    n += 1
    return number, place[:n].copy()


@kernel
def _cell_costs(
    points: FloatArray,
    planes: FloatArray,
    cap_m: float,
    number: LabelArray,
    n: int,
    low_x: float,
    low_y: float,
    cell_m: float,
    columns: int,
    rows: int,
) -> tuple[IntArray, LabelArray, LabelArray]:
    """Cost of every plane in every cell, points in each, and whether one of them is explained by each plane."""
    k = len(planes)
    costs = np.zeros((n, k), np.int64)
    count = np.zeros(n, np.int32)
    near = np.zeros((n, k), np.int32)
    for i in range(len(points)):
        c = int((points[i, 0] - low_x) / cell_m)
        r = int((points[i, 1] - low_y) / cell_m)
        if c < 0 or r < 0 or c >= columns or r >= rows:
            continue
        cell = number[r * columns + c]
        if cell < 0:
            continue
        count[cell] += 1
        for label in range(k):
            off = vertical_distance_m(points[i], planes[label])
            if off < cap_m:
                costs[cell, label] += int(COST_SCALE * off / cap_m)
                near[cell, label] = 1
            else:
                costs[cell, label] += COST_SCALE
    return costs, count, near


@kernel
def _first_labels(
    costs: IntArray, count: LabelArray, number: LabelArray, place: LabelArray, columns: int, rows: int
) -> LabelArray:
    """The best label of every cell with points; from there outwards over those without."""
    n = len(place)
    labels = np.full(n, -1, np.int32)
    queue = np.empty(n, np.int32)
    tail = 0
    for i in range(n):
        if count[i] > 0:
            labels[i] = np.argmin(costs[i])
            queue[tail] = i
            tail += 1
    head = 0
    while head < tail:
        i = queue[head]
        head += 1
        r, c = place[i] // columns, place[i] % columns
        for step in range(4):
            rr = r + (step == 1) - (step == 3)
            cc = c + (step == 0) - (step == 2)
            if rr < 0 or cc < 0 or rr >= rows or cc >= columns:
                continue
            j = number[rr * columns + cc]
            if j >= 0 and labels[j] < 0:
                labels[j] = labels[i]
                queue[tail] = j
                tail += 1
    for i in range(n):
        labels[i] = max(labels[i], 0)
    return labels


@kernel
def _raster_edges(
    number: LabelArray, place: LabelArray, columns: int, rows: int, side: int, diagonal: int
) -> tuple[IntArray, IntArray]:
    """Pairs of neighbouring cells, over sides and corners, and what a border between them costs."""
    edges = np.empty((4 * len(place), 2), np.int64)
    weights = np.empty(4 * len(place), np.int64)
    m = 0
    for i in range(len(place)):
        r, c = place[i] // columns, place[i] % columns
        for step in range(4):
            # east, north, north-east, north-west
            rr = r + (step > 0)
            cc = c + (step == 0) + (step == 2) - (step == 3)
            if rr >= rows or cc < 0 or cc >= columns or number[rr * columns + cc] < 0:
                continue
            edges[m, 0] = i
            edges[m, 1] = number[rr * columns + cc]
            weights[m] = side if step < 2 else diagonal
            m += 1
    return edges[:m], weights[:m]


@kernel
def _near_own_points(
    near: LabelArray, labels: LabelArray, number: LabelArray, place: LabelArray, columns: int, rows: int
) -> tuple[LabelArray, LabelArray]:
    """For every label the cells within two cells of a point that it explains, and those that start with it."""
    n, k = near.shape
    allowed = np.zeros((k, n), np.uint8)
    for i in range(n):
        r, c = place[i] // columns, place[i] % columns
        allowed[labels[i], i] = 1
        for label in range(k):
            if near[i, label] == 0:
                continue
            for rr in range(max(r - 2, 0), min(r + 3, rows)):
                for cc in range(max(c - 2, 0), min(c + 3, columns)):
                    j = number[rr * columns + cc]
                    if j >= 0:
                        allowed[label, j] = 1
    nodes = np.empty(k * n, np.int32)
    starts = np.zeros(k + 1, np.int32)
    m = 0
    for label in range(k):
        for i in range(n):
            if allowed[label, i] != 0:
                nodes[m] = i
                m += 1
        starts[label + 1] = m
    return nodes[:m], starts


@kernel
def _settle(
    costs: IntArray,
    place: LabelArray,
    columns: int,
    rows: int,
    side: int,
    diagonal: int,
    labels: LabelArray,
) -> None:
    """Give every cell the best label among its own and its neighbours', until none changes.

    A cell that has chosen chooses alike until a neighbour changes, so after the first round only those are looked at
    again of which one has.
    """
    # a frame of cells without a label spares all tests of the raster's border
    width = columns + 2
    around = np.array([-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1])
    weight = np.array([diagonal, side, diagonal, side, side, diagonal, side, diagonal])
    framed = np.full(width * (rows + 2), -1, np.int32)
    waits = np.zeros(width * (rows + 2), np.bool_)
    at = np.empty(len(place), np.int32)
    for i in range(len(place)):
        at[i] = (place[i] // columns + 1) * width + place[i] % columns + 1
        framed[at[i]] = labels[i]
        waits[at[i]] = True
    for _ in range(_SETTLING_ROUNDS):
        changed = False
        for i in range(len(place)):
            here = at[i]
            if not waits[here]:
                continue
            waits[here] = False
            own = framed[here]
            mixed = False
            for q in range(8):
                label = framed[here + around[q]]
                mixed |= (label != own) & (label >= 0)
            if not mixed:
                continue
            best = own
            least = costs[i, best]
            for q in range(8):
                label = framed[here + around[q]]
                if label >= 0 and label != best:
                    least += weight[q]
            tried = own
            for s in range(8):
                label = framed[here + around[s]]
                if label < 0 or label in (own, tried):
                    continue
                tried = label
                cost = costs[i, label]
                for q in range(8):
                    other = framed[here + around[q]]
                    if other >= 0 and other != label:
                        cost += weight[q]
                if cost < least or (cost == least and label < best and best != own):
                    best = label
                    least = cost
            if best != own:
                framed[here] = best
                labels[i] = best
                changed = True
                for q in range(8):
                    waits[here + around[q]] = True
        if not changed:
            break


@kernel
def raster_labels(
    points: FloatArray, planes: FloatArray, edges: FloatArray, cell_m: float, cap_m: float, cost_per_m: float
) -> tuple[LabelArray, LabelArray, float, float, int]:
    """Labels of the cells of a raster of half the given cell.

    Parameters
    ----------
    points : (n, 3) float64
        Roof points, local metres.
    planes : (k, 3) float64
        Coefficients a, b, c; at least one.
    edges : (e, 4) float64
        Edges of the outline's rings, metres.
    cell_m : float
        Cell of the coarse raster.
    cap_m : float
        Residual from which a point is unexplained.
    cost_per_m : float
        Unexplained points that a metre of border must save.

    Returns
    -------
    labels : (n,) int32
        Plane of every fine cell inside.
    place : (n,) int32
        Row * columns + column of each.
    low_x, low_y : float
        Lower left corner of the raster.
    columns : int
        Its columns; the cell is half of `cell_m`.
    """
    low_x, low_y, high_x, high_y = math.inf, math.inf, -math.inf, -math.inf
    for e in range(len(edges)):
        for end in range(0, 4, 2):
            low_x, low_y = min(low_x, edges[e, end]), min(low_y, edges[e, end + 1])
            high_x, high_y = max(high_x, edges[e, end]), max(high_y, edges[e, end + 1])
    columns, rows = int((high_x - low_x) / cell_m) + 1, int((high_y - low_y) / cell_m) + 1
    number, place = raster_cells(edges, low_x, low_y, cell_m, columns, rows)
    costs, count, near = _cell_costs(points, planes, cap_m, number, len(place), low_x, low_y, cell_m, columns, rows)
    coarse = _first_labels(costs, count, number, place, columns, rows)
    side = int(COST_SCALE * cost_per_m * cell_m * _SIDE)
    diagonal = int(COST_SCALE * cost_per_m * cell_m * _DIAGONAL)
    if len(planes) > 1:
        _settle(costs, place, columns, rows, side, diagonal, coarse)
        pairs, weights = _raster_edges(number, place, columns, rows, side, diagonal)
        starts, others, border = neighbour_lists(len(place), pairs, weights)
        allowed, allowed_starts = _near_own_points(near, coarse, number, place, columns, rows)
        expand_labels(costs, allowed, allowed_starts, starts, others, border, coarse, _ROUNDS)

    half = 0.5 * cell_m
    fine_number, fine_place = raster_cells(edges, low_x, low_y, half, 2 * columns, 2 * rows)
    labels = np.full(len(fine_place), -1, np.int32)
    for i in range(len(fine_place)):
        r, c = fine_place[i] // (4 * columns), fine_place[i] % (2 * columns) // 2
        # a fine cell at the outline can lie in a coarse one that does not count: then beside it
        for reach in range(2):
            for rr in range(max(r - reach, 0), min(r + reach + 1, rows)):
                for cc in range(max(c - reach, 0), min(c + reach + 1, columns)):
                    if labels[i] < 0 and number[rr * columns + cc] >= 0:
                        labels[i] = coarse[number[rr * columns + cc]]
        labels[i] = max(labels[i], 0)
    if len(planes) > 1:
        costs, _, _ = _cell_costs(
            points, planes, cap_m, fine_number, len(fine_place), low_x, low_y, half, 2 * columns, 2 * rows
        )
        _settle(costs, fine_place, 2 * columns, 2 * rows, side // 2, diagonal // 2, labels)
    return labels, fine_place, low_x, low_y, 2 * columns
