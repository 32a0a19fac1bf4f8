"""An outline divided by straight cuts along its main directions into parts, each with a roof shape of its own.

A gable with a flat annex, the two wings of an L, the three of a T: one cut after the other, at a corner of the outline
or between points, as long as the points pay for each (a guillotine partition chosen by BIC).
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.extras.templates.shapes import CAP_SIGMAS, MAX_PLANES, best_shape, copy_planes, height
from pipeline.kernels.sorting import ascending_order, in_order
from pipeline.model import FloatArray, LabelArray

MAX_PARTS = 6
"""Bounds the work."""
_EVERYWHERE_M = 1e6  # a half plane wider than any building
_CUT_PARAMETERS = 3.0
"""Price of a cut between points: its direction and place."""
_CORNER_CUT_PARAMETERS = 2.0
"""Price of a cut at a corner of the outline: which one."""
_MIN_SIDE_M = 1.0
"""Least width of a part: a narrower one is a detail."""
_PLACES = 12
"""Cuts between points that are tried in each direction; `_settled_place` refines the best."""
_CORNERS_APART_M = 0.3
"""Corners closer than this give one cut."""
_LONGEST_EDGES = 64
"""Edges of an outline that decide its direction: bounds the work, which is quadratic."""
_LESS = 1e-9
"""Sums that differ by less are equal; numerical guard."""
_FINALISTS = 3
"""Cuts whose sides are fitted thoroughly: bounds the work."""


@kernel
def main_direction(edges: FloatArray) -> float:
    """The direction along which, or across which, most of an outline runs; radians, -pi/4 to pi/4.

    `edges` (e, 4) are x, y of both ends, metres. If they are very many, only the longest ones decide: each is compared
    with every other.
    """
    if len(edges) > _LONGEST_EDGES:
        shortness = np.empty(len(edges))
        for e in range(len(edges)):
            shortness[e] = -np.hypot(edges[e, 2] - edges[e, 0], edges[e, 3] - edges[e, 1])
        order = ascending_order(shortness)
        longest = np.empty((_LONGEST_EDGES, 4))
        for e in range(_LONGEST_EDGES):
            for q in range(4):
                longest[e, q] = edges[order[e], q]
        edges = longest
    quarter = 0.5 * math.pi
    best, most = 0.0, -1.0
    for e in range(len(edges)):
        dx, dy = edges[e, 2] - edges[e, 0], edges[e, 3] - edges[e, 1]
        length = math.hypot(dx, dy)
        if length < 0.5:
            continue
        angle = math.atan2(dy, dx)
        support, turned = 0.0, 0.0
        for f in range(len(edges)):
            fx, fy = edges[f, 2] - edges[f, 0], edges[f, 3] - edges[f, 1]
            turn = math.atan2(fy, fx) - angle
            turn -= quarter * round(turn / quarter)
            if abs(turn) < 0.1:
                own = math.hypot(fx, fy)
                support += own
                turned += own * turn
        if support > most + 1e-6:
            most, best = support, angle + turned / support
    return best - quarter * round(best / quarter)


@kernel
def _box_of(edges: FloatArray, region: FloatArray) -> FloatArray:
    """Extent of the outline within a rectangle: of its edges there, and of the rectangle's corners inside it."""
    box = np.array([math.inf, -math.inf, math.inf, -math.inf])
    for e in range(len(edges)):
        begin, end = 0.0, 1.0
        for axis in range(2):
            a, d = edges[e, axis], edges[e, 2 + axis] - edges[e, axis]
            low, high = region[2 * axis], region[2 * axis + 1]
            if d == 0.0:
                if a < low or a > high:
                    end = -1.0
                continue
            first, last = (low - a) / d, (high - a) / d
            begin, end = max(begin, min(first, last)), min(end, max(first, last))
        if begin <= end:
            for share in (begin, end):
                for axis in range(2):
                    at = edges[e, axis] + share * (edges[e, 2 + axis] - edges[e, axis])
                    box[2 * axis], box[2 * axis + 1] = min(box[2 * axis], at), max(box[2 * axis + 1], at)
    for corner in range(4):
        x, y = region[corner // 2], region[2 + corner % 2]
        inside = False
        for e in range(len(edges)):
            x0, y0, x1, y1 = edges[e]
            if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                inside = not inside
        if inside:
            box[0], box[1] = min(box[0], x), max(box[1], x)
            box[2], box[3] = min(box[2], y), max(box[3], y)
    return box


@kernel
def _cuts(points: FloatArray, edges: FloatArray, box: FloatArray) -> tuple[FloatArray, int]:
    """Cuts to try, (c, 3): axis, place in metres and price in parameters; how many of the rows are used."""
    m, e = len(points), len(edges)
    cuts = np.empty((2 * (m + e), 3))
    count = 0
    along, corners_along = np.empty(m), np.empty(e)
    for axis in range(2):
        for i in range(m):
            along[i] = points[i, axis]
        for i in range(e):
            corners_along[i] = edges[i, axis]
        own, corners = in_order(along), in_order(corners_along)
        low, high = box[2 * axis] + _MIN_SIDE_M, box[2 * axis + 1] - _MIN_SIDE_M
        last = -math.inf
        for i in range(e):
            if low <= corners[i] <= high and corners[i] > last + _CORNERS_APART_M:
                last = corners[i]
                cuts[count, 0], cuts[count, 1], cuts[count, 2] = axis, last, _CORNER_CUT_PARAMETERS
                count += 1
        for i in range(1, m, max(1, m // _PLACES)):
            place = 0.5 * (own[i - 1] + own[i])
            if low <= place <= high:
                cuts[count, 0], cuts[count, 1], cuts[count, 2] = axis, place, _CUT_PARAMETERS
                count += 1
    return cuts, count


@kernel
def _side(points: FloatArray, region: FloatArray, axis: int, place: float, side: int) -> tuple[FloatArray, FloatArray]:
    """The points and the region on one side of a cut: 0 below, 1 from it on."""
    own = np.empty_like(points)
    m = 0
    for i in range(len(points)):
        if (points[i, axis] < place) == (side == 0):
            own[m, 0], own[m, 1], own[m, 2] = points[i, 0], points[i, 1], points[i, 2]
            m += 1
    half = np.empty(4)
    for q in range(4):
        half[q] = region[q]
    half[2 * axis + 1 - side] = place
    return own[:m], half


@kernel
def _settled_place(
    points: FloatArray,
    box: FloatArray,
    axis: int,
    place: float,
    planes: FloatArray,
    counts: LabelArray,
    sigma_m: float,
    fewest: int,
) -> float:
    """The place of a cut between points with the least misfit to given shapes, between its place and the next tried.

    `planes` (2, 4, 3) and `counts` (2,) are the shapes on both sides.
    """
    m = len(points)
    own = np.empty(m)
    total = 0.0
    change = np.empty(m)
    for i in range(m):
        at = i
        worse = 0.0
        for side in range(2):
            z, _ = height(planes[side], counts[side], points[i, 0], points[i, 1])
            r = (points[i, 2] - z) / sigma_m
            r = min(r * r, CAP_SIGMAS * CAP_SIGMAS)
            worse = r - worse  # below: its misfit; above: by how much that is more
            if side == 1:
                total += r
        while at > 0 and own[at - 1] > points[i, axis]:
            own[at], change[at] = own[at - 1], change[at - 1]
            at -= 1
        own[at], change[at] = points[i, axis], worse
    rank = 0
    while rank < m and own[rank] < place:
        rank += 1
    step = max(1, m // _PLACES)
    low, high = box[2 * axis] + _MIN_SIDE_M, box[2 * axis + 1] - _MIN_SIDE_M
    least, settled = math.inf, place
    for i in range(m):
        if i >= fewest and m - i >= fewest and abs(i - rank) < step and own[i] > own[i - 1]:
            middle = 0.5 * (own[i - 1] + own[i])
            if low <= middle <= high and total < least - _LESS:
                least, settled = total, middle
        total -= change[i]
    return settled


@kernel
def _best_cut(
    points: FloatArray,
    edges: FloatArray,
    region: FloatArray,
    sigma_m: float,
    cost_of_parameter: float,
    fewest: int,
) -> tuple[float, int, float, float]:
    """Cost of the two sides and the cut, its axis, its place and its price in parameters; inf where there is none.

    All cuts are tried with the shapes of least freedom, the best of them with all shapes.
    """
    box = _box_of(edges, region)
    cuts, count = _cuts(points, edges, box)
    finalists = np.zeros((_FINALISTS, 3))
    least = np.full(_FINALISTS, math.inf)
    best, chosen = math.inf, 0
    planes, best_planes = np.zeros((2, MAX_PLANES, 3)), np.zeros((2, MAX_PLANES, 3))
    counts, best_counts = np.zeros(2, np.int32), np.zeros(2, np.int32)
    for trial in range(count + _FINALISTS):
        thorough = trial >= count
        at = trial - count if thorough else trial
        if thorough and least[at] == math.inf:
            break
        axis, place, price = int(cuts[at, 0]), cuts[at, 1], cuts[at, 2]
        if thorough:
            axis, place, price = int(finalists[at, 0]), finalists[at, 1], finalists[at, 2]
        cost = price * cost_of_parameter
        limit = best if thorough else least[-1]
        for side in range(2):
            own, half = _side(points, region, axis, place, side)
            if len(own) < fewest:
                cost = math.inf
            if cost < limit:
                of_side, _, counts[side], shape = best_shape(
                    own, _box_of(edges, half), sigma_m, cost_of_parameter, thorough
                )
                copy_planes(shape, planes[side])
                cost += of_side
        if not cost < limit:
            continue
        if thorough:
            best, chosen = cost, at
            for side in range(2):
                best_counts[side] = counts[side]
                copy_planes(planes[side], best_planes[side])
            continue
        at = _FINALISTS - 1
        while at > 0 and least[at - 1] > cost:
            least[at] = least[at - 1]
            for q in range(3):
                finalists[at, q] = finalists[at - 1, q]
            at -= 1
        least[at] = cost
        finalists[at, 0], finalists[at, 1], finalists[at, 2] = axis, place, price
    axis, place, price = int(finalists[chosen, 0]), finalists[chosen, 1], finalists[chosen, 2]
    if best < math.inf and price == _CUT_PARAMETERS:
        place = _settled_place(points, box, axis, place, best_planes, best_counts, sigma_m, fewest)
    return best, axis, place, price


@kernel
def fit_parts(
    points: FloatArray, edges: FloatArray, sigma_m: float, fewest: int
) -> tuple[float, int, FloatArray, LabelArray, FloatArray, FloatArray, LabelArray]:
    """Parts of an outline and their shapes, of the least BIC that single cuts find.

    Parameters
    ----------
    points : (n, 3) float64
        In the frame of the outline: along u, along v, elevation; metres.
    edges : (e, 4) float64
        The outline in the same frame: u, v of both ends.
    sigma_m : float
        Standard deviation of the noise.
    fewest : int
        Points that a part must have.

    Returns
    -------
    parameters : float
        All parameters of shapes and cuts.
    parts : int
        Number p of parts; further rows are unused.
    regions : (6, 4) float64
        Least and largest u, least and largest v of each part.
    counts : (6,) int32
        Planes of each part.
    planes : (6, 4, 3) float64
        Planes of each part in the frame; its roof is the lowest of them.
    residuals : (n,) float64
        Height of every point above its roof, metres.
    plane_of : (n,) int32
        `MAX_PLANES` p + k for a point over plane k of part p.
    """
    n = len(points)
    cost_of_parameter = math.log(n)
    part_of = np.zeros(n, np.int32)
    regions = np.empty((MAX_PARTS, 4))
    for q in range(4):
        regions[0, q] = _EVERYWHERE_M if q % 2 else -_EVERYWHERE_M
    counts = np.zeros(MAX_PARTS, np.int32)
    planes = np.zeros((MAX_PARTS, MAX_PLANES, 3))
    of_parts = np.zeros(MAX_PARTS)
    of_cuts = 0.0
    parts = 1
    part = 0
    while part < parts:
        own = np.empty_like(points)
        m = 0
        for i in range(n):
            if part_of[i] == part:
                own[m, 0], own[m, 1], own[m, 2] = points[i, 0], points[i, 1], points[i, 2]
                m += 1
        own = own[:m]
        cost, parameters, count, shape = best_shape(
            own, _box_of(edges, regions[part]), sigma_m, cost_of_parameter, True
        )
        of_parts[part], counts[part] = parameters, count
        copy_planes(shape, planes[part])
        # two levels cannot cost less
        if parts == MAX_PARTS or m < 2 * fewest or cost <= (_CORNER_CUT_PARAMETERS + 2.0) * cost_of_parameter:
            part += 1
            continue
        cost_of_sides, axis, place, of_cut = _best_cut(own, edges, regions[part], sigma_m, cost_of_parameter, fewest)
        if not cost_of_sides < cost:
            part += 1
            continue
        for q in range(4):
            regions[parts, q] = regions[part, q]
        regions[part, 2 * axis + 1] = place
        regions[parts, 2 * axis] = place
        of_cuts += of_cut
        for i in range(n):
            if part_of[i] == part and not points[i, axis] < place:
                part_of[i] = parts
        parts += 1
    residuals = np.empty(n)
    for i in range(n):
        part = part_of[i]
        z, k = height(planes[part], counts[part], points[i, 0], points[i, 1])
        residuals[i] = points[i, 2] - z
        part_of[i] = MAX_PLANES * part + k
    parameters_of_all = of_cuts
    for part in range(parts):
        parameters_of_all += of_parts[part]
    return parameters_of_all, parts, regions, counts, planes, residuals, part_of
