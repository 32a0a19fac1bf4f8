"""Coarse labels of an outline: a raster, every cell with the plane that explains its points and suits its neighbours.

They are not a result: their borders show where lines are worth trying. A coarse raster is labelled by alpha expansion;
a raster of half the cell starts from it and settles by iterated conditional modes (Besag 1986).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.counting_sort import counting_sort
from pipeline.kernels.merge_sort import in_order
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.minimum_cut import Allowed, Costs, cost_of, expand_labels, neighbour_lists

COST_SCALE = 1000
"""Integer cost of one unexplained point."""
_SIDE = math.pi / 8.0
_DIAGONAL = math.pi / (8.0 * math.sqrt(2.0))
"""Length of border, in cells, that a pair of neighbours over a side or a corner represents: with eight neighbours
borders of any direction measure nearly alike (Boykov and Kolmogorov 2003, Cauchy-Crofton)."""
_ROUNDS = 3
_SETTLING_ROUNDS = 8
"""Most turns of either method: they bound the work, and the labels only propose lines."""


class Raster(NamedTuple):
    """Square cells, row by row from the lower left corner; those with their centre inside an outline are numbered."""

    west: float
    """Left border, metres."""
    south: float
    """Lower border, metres."""
    cell_m: float
    columns: int
    rows: int
    number: LabelArray
    """(rows * columns,) int32, number of every cell; -1 outside."""
    place: LabelArray
    """(n,) int32, row * columns + column of each numbered cell, ascending."""


@kernel
def vertical_distance_m(points: FloatArray, i: int, planes: FloatArray, k: int) -> float:
    """How far point i of (n, 3) lies above or below plane k of (m, 3), z = a x + b y + c."""
    # by numbers: a view of a row counts references, which takes longer than the distance
    return abs(float(points[i, 2] - planes[k, 0] * points[i, 0] - planes[k, 1] * points[i, 1] - planes[k, 2]))


@kernel
def raster_cells(edges: FloatArray, west: float, south: float, cell_m: float, columns: int, rows: int) -> Raster:
    """Number the cells of a raster inside an outline, from the edges of its rings: x0, y0, x1, y1, (e, 4), metres."""
    number = np.full(rows * columns, -1, np.int32)
    place = np.empty(rows * columns, np.int32)
    crossings = np.empty(len(edges))
    n = 0
    for r in range(rows):
        y = south + (r + 0.5) * cell_m
        found = 0
        for e in range(len(edges)):
            if (edges[e, 1] > y) != (edges[e, 3] > y):
                fraction = (y - edges[e, 1]) / (edges[e, 3] - edges[e, 1])
                crossings[found] = edges[e, 0] + fraction * (edges[e, 2] - edges[e, 0])
                found += 1
        ordered = in_order(crossings[:found])
        for k in range(0, found - 1, 2):
            first = max(math.ceil((ordered[k] - west) / cell_m - 0.5), 0)
            last = min(math.floor((ordered[k + 1] - west) / cell_m - 0.5), columns - 1)
            for c in range(first, last + 1):
                if number[r * columns + c] < 0:
                    number[r * columns + c] = n
                    place[n] = r * columns + c
                    n += 1
    return Raster(west, south, cell_m, columns, rows, number, place[:n].copy())


@kernel
def _cell_costs(points: FloatArray, planes: FloatArray, cap_m: float, raster: Raster) -> Costs:
    """Costs of k planes in n cells: other planes than those listed explain none of a cell's points."""
    n = len(raster.place)
    cell_of = np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        c = int((points[i, 0] - raster.west) / raster.cell_m)
        r = int((points[i, 1] - raster.south) / raster.cell_m)
        if c >= 0 and r >= 0 and c < raster.columns and r < raster.rows:
            cell_of[i] = raster.number[r * raster.columns + c]
    first, members = counting_sort(cell_of, n)
    starts, others = np.zeros(n + 1, np.int64), np.empty(n, np.int64)
    explaining, costs = np.empty(0, np.int32), np.empty(0, np.int64)
    # the second turn writes what the first one counted
    for turn in range(2):
        m = 0
        for cell in range(n):
            others[cell] = COST_SCALE * (first[cell + 1] - first[cell])
            for label in range(len(planes) if others[cell] > 0 else 0):
                cost, explains = 0, False
                for s in range(first[cell], first[cell + 1]):
                    off = vertical_distance_m(points, members[s], planes, label)
                    if off < cap_m:
                        cost += int(COST_SCALE * off / cap_m)
                        explains = True
                    else:
                        cost += COST_SCALE
                if explains:
                    if turn == 1:
                        explaining[m], costs[m] = label, cost
                    m += 1
            starts[cell + 1] = m
        if turn == 0:
            explaining, costs = np.empty(m, np.int32), np.empty(m, np.int64)
    return Costs(starts, explaining, costs, others)


@kernel
def _first_labels(costs: Costs, raster: Raster) -> LabelArray:
    """The best label of every cell with points, (n,); from there outwards over those without."""
    number, place, columns, rows = raster.number, raster.place, raster.columns, raster.rows
    n = len(place)
    labels = np.full(n, -1, np.int32)
    queue = np.empty(n, np.int32)
    tail = 0
    for i in range(n):
        if costs.others[i] > 0:
            # of equal costs the first plane's; the first of all where none explains anything
            labels[i] = 0
            least = costs.others[i]
            for s in range(costs.starts[i], costs.starts[i + 1]):
                if costs.costs[s] < least:
                    labels[i], least = costs.labels[s], costs.costs[s]
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
def _raster_edges(raster: Raster, side: int, diagonal: int) -> tuple[IntArray, IntArray]:
    """Pairs of neighbouring cells, over sides and corners, (m, 2), and the cost of a border between them, (m,)."""
    number, place, columns, rows = raster.number, raster.place, raster.columns, raster.rows
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
def _near_own_points(costs: Costs, labels: LabelArray, raster: Raster, k: int) -> Allowed:
    """For each of k labels the cells within two cells of a point that it explains, and those that start with it."""
    number, place, columns, rows = raster.number, raster.place, raster.columns, raster.rows
    n = len(place)
    cell_of = np.empty(len(costs.labels), np.int32)
    for i in range(n):
        cell_of[costs.starts[i] : costs.starts[i + 1]] = i
    first, entries = counting_sort(costs.labels, k)
    first_own, own = counting_sort(labels, k)
    allowed = np.zeros(n, np.bool_)
    nodes = np.empty(min(n * k, n + 25 * len(cell_of)), np.int32)
    starts = np.zeros(k + 1, np.int32)
    m = 0
    for label in range(k):
        allowed[:] = False
        for s in range(first_own[label], first_own[label + 1]):
            allowed[own[s]] = True
        for s in range(first[label], first[label + 1]):
            i = cell_of[entries[s]]
            r, c = place[i] // columns, place[i] % columns
            for rr in range(max(r - 2, 0), min(r + 3, rows)):
                for cc in range(max(c - 2, 0), min(c + 3, columns)):
                    j = number[rr * columns + cc]
                    if j >= 0:
                        allowed[j] = True
        for i in range(n):
            if allowed[i]:
                nodes[m] = i
                m += 1
        starts[label + 1] = m
    return Allowed(nodes[:m].copy(), starts)


@kernel
def _border_cost(framed: LabelArray, here: int, around: IntArray, weight: IntArray, label: int) -> int:
    """Cost of the borders of a cell with eight neighbours, if it has a label."""
    cost = 0
    for q in range(8):
        other = framed[here + around[q]]
        if other >= 0 and other != label:
            cost += weight[q]
    return cost


@kernel
def _settle(costs: Costs, raster: Raster, side: int, diagonal: int, labels: LabelArray) -> None:
    """Give every cell the best label among its own and its neighbours', until none changes (Besag 1986).

    After the first round a cell is looked at again only if a neighbour has changed: else it would choose the same.
    `labels` (n,) change in place; `side` and `diagonal` are the costs of a border over a side and over a corner.
    """
    place, columns, rows = raster.place, raster.columns, raster.rows
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
            least = cost_of(costs, i, best) + _border_cost(framed, here, around, weight, own)
            tried = own
            for s in range(8):
                label = framed[here + around[s]]
                if label < 0 or label in (own, tried):
                    continue
                tried = label
                cost = cost_of(costs, i, label) + _border_cost(framed, here, around, weight, label)
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
) -> tuple[LabelArray, Raster]:
    """The labels of a raster of half the given cell, (n,) int32, and that raster, for points (n, 3) and planes (k, 3).

    Parameters
    ----------
    edges : (e, 4) float64
        Edges of the outline's rings, metres.
    cell_m : float
        Cell of the coarse raster.
    cap_m : float
        Residual from which a point is unexplained.
    cost_per_m : float
        Unexplained points that a metre of border must save.
    """
    west, south, east, north = math.inf, math.inf, -math.inf, -math.inf
    for e in range(len(edges)):
        for end in range(0, 4, 2):
            west, south = min(west, edges[e, end]), min(south, edges[e, end + 1])
            east, north = max(east, edges[e, end]), max(north, edges[e, end + 1])
    columns, rows = int((east - west) / cell_m) + 1, int((north - south) / cell_m) + 1
    raster = raster_cells(edges, west, south, cell_m, columns, rows)
    costs = _cell_costs(points, planes, cap_m, raster)
    coarse = _first_labels(costs, raster)
    side = int(COST_SCALE * cost_per_m * cell_m * _SIDE)
    diagonal = int(COST_SCALE * cost_per_m * cell_m * _DIAGONAL)
    if len(planes) > 1:
        _settle(costs, raster, side, diagonal, coarse)
        pairs, weights = _raster_edges(raster, side, diagonal)
        neighbours = neighbour_lists(len(raster.place), pairs, weights)
        allowed = _near_own_points(costs, coarse, raster, len(planes))
        expand_labels(costs, allowed, neighbours, coarse, _ROUNDS)

    fine = raster_cells(edges, west, south, 0.5 * cell_m, 2 * columns, 2 * rows)
    labels = np.full(len(fine.place), -1, np.int32)
    for i in range(len(fine.place)):
        r, c = fine.place[i] // (4 * columns), fine.place[i] % (2 * columns) // 2
        # a fine cell at the outline can lie in a coarse one that does not count: then beside it
        for reach in range(2):
            for rr in range(max(r - reach, 0), min(r + reach + 1, rows)):
                for cc in range(max(c - reach, 0), min(c + reach + 1, columns)):
                    if labels[i] < 0 and raster.number[rr * columns + cc] >= 0:
                        labels[i] = coarse[raster.number[rr * columns + cc]]
        labels[i] = max(labels[i], 0)
    if len(planes) > 1:
        costs = _cell_costs(points, planes, cap_m, fine)
        _settle(costs, fine, side // 2, diagonal // 2, labels)
    return labels, fine
