"""Coarse labels of an outline: a raster, every cell with the plane that explains its points and suits its neighbours.

They are not a result: their borders show where lines are worth trying. A coarse raster is labelled by alpha expansion;
a raster of half the cell starts from it and settles by iterated conditional modes (Besag 1986).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import counting_sort, sort_few
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.minimum_cut import Allowed, Costs, Neighbours, cost_of, expand_labels
from pipeline.roof.roof_settings import ArrangementSettings

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


_FRAME = 2
"""Width of the frame: labels are tried as far from their points, and neighbours need no test of the border."""


class _Framed(NamedTuple):
    """A raster in a frame of cells that lie outside."""

    number: LabelArray
    """(rows * width,) int32, number of every cell; -1 outside."""
    at: LabelArray
    """(n,) int32, place of each numbered cell."""
    width: int
    """Columns with the frame."""


class _Explained(NamedTuple):
    """Planes that explain each of n points, in compressed rows."""

    starts: IntArray
    """(n + 1,) int64, first entry of every point."""
    labels: LabelArray
    """(m,) int32, the planes, ascending at each point."""
    saved: LabelArray
    """(m,) int32, by how much the point costs less than an unexplained one."""


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
                x = edges[e, 0] + fraction * (edges[e, 2] - edges[e, 0])
                crossings[found] = x
                found += 1
        sort_few(crossings[:found])
        for k in range(0, found - 1, 2):
            first = max(math.ceil((crossings[k] - west) / cell_m - 0.5), 0)
            last = min(math.floor((crossings[k + 1] - west) / cell_m - 0.5), columns - 1)
            for c in range(first, last + 1):
                if number[r * columns + c] < 0:
                    number[r * columns + c] = n
                    place[n] = r * columns + c
                    n += 1
    return Raster(west, south, cell_m, columns, rows, number, place[:n].copy())


@kernel
def _framed(raster: Raster) -> _Framed:
    """Put a frame around a raster."""
    columns, width = raster.columns, raster.columns + 2 * _FRAME
    number = np.full(width * (raster.rows + 2 * _FRAME), -1, np.int32)
    at = np.empty(len(raster.place), np.int32)
    for r in range(raster.rows):
        first = (r + _FRAME) * width + _FRAME
        for c in range(columns):
            i = raster.number[r * columns + c]
            number[first + c] = i
            if i >= 0:
                at[i] = first + c
    return _Framed(number, at, width)


@kernel
def _explained(points: FloatArray, planes: FloatArray, cap_m: float) -> _Explained:
    """Which of k planes explain each of n points, and what that saves."""
    n, k = len(points), len(planes)
    starts = np.empty(n + 1, np.int64)
    labels, saved = np.empty(2 * n + k, np.int32), np.empty(2 * n + k, np.int32)
    m = 0
    for i in range(n):
        starts[i] = m
        if m + k > len(labels):
            labels, saved = np.concatenate((labels, labels)), np.concatenate((saved, saved))
        for label in range(k):
            off = vertical_distance_m(points, i, planes, label)
            if off < cap_m:
                labels[m], saved[m] = label, COST_SCALE - int(COST_SCALE * off / cap_m)
                m += 1
    starts[n] = m
    return _Explained(starts, labels, saved)


@kernel
def _cell_costs(points: FloatArray, explained: _Explained, raster: Raster) -> Costs:
    """Costs of planes in n cells: other planes than those listed explain none of a cell's points."""
    n = len(raster.place)
    cell_of = np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        c = int((points[i, 0] - raster.west) / raster.cell_m)
        r = int((points[i, 1] - raster.south) / raster.cell_m)
        if c >= 0 and r >= 0 and c < raster.columns and r < raster.rows:
            cell_of[i] = raster.number[r * raster.columns + c]
    first, members = counting_sort(cell_of, n)
    starts, others = np.zeros(n + 1, np.int64), np.empty(n, np.int64)
    room = explained.starts[len(points)]
    labels, costs = np.empty(room, np.int32), np.empty(room, np.int64)
    m = 0
    for cell in range(n):
        unexplained = COST_SCALE * np.int64(first[cell + 1] - first[cell])
        for s in range(first[cell], first[cell + 1]):
            for e in range(explained.starts[members[s]], explained.starts[members[s] + 1]):
                # labels ascend at each cell
                label, q = explained.labels[e], m
                while q > starts[cell] and labels[q - 1] > label:
                    q -= 1
                if q == starts[cell] or labels[q - 1] != label:
                    for moved in range(m, q, -1):
                        labels[moved], costs[moved] = labels[moved - 1], costs[moved - 1]
                    labels[q], costs[q] = label, unexplained
                    q, m = q + 1, m + 1
                costs[q - 1] -= explained.saved[e]
        others[cell] = unexplained
        starts[cell + 1] = m
    return Costs(starts, labels[:m].copy(), costs[:m].copy(), others)


@kernel
def _first_labels(costs: Costs, framed: _Framed) -> LabelArray:
    """The best label of every cell with points, (n,); from there outwards over those without."""
    n = len(framed.at)
    around = np.array([1, framed.width, -1, -framed.width])
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
        for step in range(4):
            j = framed.number[framed.at[i] + around[step]]
            if j >= 0 and labels[j] < 0:
                labels[j] = labels[i]
                queue[tail] = j
                tail += 1
    for i in range(n):
        labels[i] = max(labels[i], 0)
    return labels


@kernel(inline="always")
def _places_around(width: int) -> IntArray:
    """Steps to the eight neighbours of a cell, row by row."""
    return np.array([-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1])


@kernel(inline="always")
def _weights_around(side: int, diagonal: int) -> IntArray:
    """Costs of the borders to the eight neighbours of a cell."""
    return np.array([diagonal, side, diagonal, side, side, diagonal, side, diagonal])


@kernel
def _raster_neighbours(framed: _Framed, side: int, diagonal: int) -> Neighbours:
    """The neighbours of every cell over sides and corners, and the costs of borders there."""
    n = len(framed.at)
    around, weight = _places_around(framed.width), _weights_around(side, diagonal)
    starts, others, weights = np.zeros(n + 1, np.int32), np.empty(8 * n, np.int32), np.empty(8 * n, np.int64)
    m = 0
    for i in range(n):
        for q in range(8):
            j = framed.number[framed.at[i] + around[q]]
            if j >= 0:
                others[m], weights[m] = j, weight[q]
                m += 1
        starts[i + 1] = m
    return Neighbours(starts, others[:m].copy(), weights[:m].copy())


@kernel
def _near_own_points(costs: Costs, labels: LabelArray, framed: _Framed, k: int) -> Allowed:
    """For each of k labels the cells within two cells of a point that it explains, and those that start with it."""
    at, width = framed.at, framed.width
    n = len(at)
    cell_of = np.empty(len(costs.labels), np.int32)
    for i in range(n):
        for s in range(costs.starts[i], costs.starts[i + 1]):
            cell_of[s] = i
    first, entries = counting_sort(costs.labels, k)
    first_own, own = counting_sort(labels, k)
    allowed = np.zeros(len(framed.number), np.bool_)
    nodes = np.empty(min(n * k, n + 25 * len(cell_of)), np.int32)
    starts = np.zeros(k + 1, np.int32)
    m = 0
    for label in range(k):
        allowed[:] = False
        for s in range(first_own[label], first_own[label + 1]):
            allowed[at[own[s]]] = True
        for s in range(first[label], first[label + 1]):
            corner = at[cell_of[entries[s]]] - _FRAME * (width + 1)
            for r in range(2 * _FRAME + 1):
                for c in range(2 * _FRAME + 1):
                    allowed[corner + r * width + c] = True
        for i in range(n):
            if allowed[at[i]]:
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
        cost += weight[q] * ((other >= 0) & (other != label))
    return cost


@kernel
def _settle(costs: Costs, framed: _Framed, side: int, diagonal: int, labels: LabelArray) -> None:
    """Give every cell the best label among its own and its neighbours', until none changes (Besag 1986).

    A cell is looked at if a neighbour has another label, and again only if a neighbour has changed: else it would
    choose the same. `labels` (n,) change in place; `side` and `diagonal` are the costs of a border over a side and over
    a corner.
    """
    at, number = framed.at, framed.number
    around, weight = _places_around(framed.width), _weights_around(side, diagonal)
    placed = np.full(len(number), -1, np.int32)
    waits = np.zeros(len(at), np.bool_)
    for i in range(len(at)):
        placed[at[i]] = labels[i]
        for q in range(4, 8):
            j = number[at[i] + around[q]]
            if j >= 0 and labels[j] != labels[i]:
                waits[i] = waits[j] = True
    for _ in range(_SETTLING_ROUNDS):
        changed = False
        for i in range(len(at)):
            if not waits[i]:
                continue
            waits[i] = False
            here, own = at[i], labels[i]
            best = own
            least = cost_of(costs, i, best) + _border_cost(placed, here, around, weight, own)
            tried = own
            for s in range(8):
                label = placed[here + around[s]]
                if label < 0 or label in (own, tried):
                    continue
                tried = label
                cost = cost_of(costs, i, label) + _border_cost(placed, here, around, weight, label)
                if cost < least or (cost == least and label < best and best != own):
                    best = label
                    least = cost
            if best != own:
                placed[here] = best
                labels[i] = best
                changed = True
                for q in range(8):
                    j = number[here + around[q]]
                    if j >= 0:
                        waits[j] = True
        if not changed:
            break


@kernel
def _labels_of_halves(fine: Raster, coarse: _Framed, coarse_labels: LabelArray) -> LabelArray:
    """Labels of a raster of half the cells, (n,), from those of the coarse one."""
    labels = np.zeros(len(fine.place), np.int32)
    around = _places_around(coarse.width)
    for r in range(fine.rows):
        for c in range(fine.columns):
            i = fine.number[r * fine.columns + c]
            if i < 0:
                continue
            here = (r // 2 + _FRAME) * coarse.width + c // 2 + _FRAME
            j = coarse.number[here]
            # a fine cell at the outline can lie in a coarse one that does not count: then beside it
            for q in range(8 if j < 0 else 0):
                if j < 0:
                    j = coarse.number[here + around[q]]
            labels[i] = coarse_labels[j] if j >= 0 else 0
    return labels


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
    framed = _framed(raster)
    explained = _explained(points, planes, cap_m)
    costs = _cell_costs(points, explained, raster)
    coarse = _first_labels(costs, framed)
    side = int(COST_SCALE * cost_per_m * cell_m * _SIDE)
    diagonal = int(COST_SCALE * cost_per_m * cell_m * _DIAGONAL)
    if len(planes) > 1:
        _settle(costs, framed, side, diagonal, coarse)
        neighbours = _raster_neighbours(framed, side, diagonal)
        allowed = _near_own_points(costs, coarse, framed, len(planes))
        expand_labels(costs, allowed, neighbours, coarse, _ROUNDS)

    fine = raster_cells(edges, west, south, 0.5 * cell_m, 2 * columns, 2 * rows)
    labels = _labels_of_halves(fine, framed, coarse)
    if len(planes) > 1:
        _settle(_cell_costs(points, explained, fine), _framed(fine), side // 2, diagonal // 2, labels)
    return labels, fine


class Limits(NamedTuple):
    """`ArrangementSettings` at a density of points."""

    cell_m: float
    points_per_m2: float
    cap_m: float
    """Residual from which a point is unexplained."""
    cost_per_m: float
    """Unexplained points that a metre of border must save."""
    face_cost: int
    """Cost of a face that all its points fit, thousandths of a point."""
    doubtful_cost: int
    """Cost of a face that half of its points misfit, thousandths of a point."""
    min_face_width_m: float
    """Slivers that are narrower are not faces."""
    line_length_m: float
    line_reach_m: float
    corner_cost: float
    """Points that a corner must save."""
    corner_gap_m: float
    corner_reach_m: float
    plane_shift_m: float
    overshoot_m: float
    """How far a plane may go above or below the points."""
    clearance: float
    """Times the usual distances that vertices keep from each other."""


def limits_at(spacing_m: float, settings: ArrangementSettings, clearance: float = 1.0) -> Limits:
    """The limits at a typical distance of neighbouring points in plan."""
    points_per_m2 = 1.0 / spacing_m**2
    face_cost, doubtful_cost = settings.costs_of_face(points_per_m2)
    return Limits(
        cell_m=settings.raster_cell_of(spacing_m),
        points_per_m2=points_per_m2,
        cap_m=settings.residual_cap_m,
        cost_per_m=settings.border_cost / spacing_m,
        face_cost=round(face_cost * COST_SCALE),
        doubtful_cost=round(doubtful_cost * COST_SCALE),
        min_face_width_m=settings.min_face_width_m,
        line_length_m=settings.line_length_m,
        line_reach_m=max(settings.line_reach_m, spacing_m),
        corner_cost=settings.corner_share * face_cost,
        corner_gap_m=settings.corner_gap_m,
        corner_reach_m=settings.corner_reach_m,
        plane_shift_m=settings.plane_shift_m,
        overshoot_m=max(settings.overshoot_m, spacing_m),
        clearance=clearance,
    )
