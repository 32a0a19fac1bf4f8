"""Standard deviation of a model's highest roof point, from the scatter of the points about the planes that make it.

A ridge is where two planes cross. With rises g1 and g2 across it an error of the planes at that place moves its height
by (g1 d2 - g2 d1) / (g1 - g2): a mean of the errors with weights that balance the rises. So for any number of planes:
the weights are those of the point of the hull of their gradients that is nearest to zero. What is left of the gradient
there (a pent roof's top edge, a step) turns an error of the edge's place in plan into one of height.

An error that the points of one strip share is in no figure here: no scatter shows it, and it moves the ridge by as
much. It has to come from the survey's own report.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FaceKind, FloatArray, IntArray, LabelArray, Plane, Solid

SAME_TOP_M = 0.05
"""Roof faces that end within this of the highest point meet there."""
MIN_SIGMA_M = 0.004
"""Least standard deviation, metres, however many the points: beams average over an edge, and survey and model are in
whole millimetres."""
_BLOCKS = 4
"""A plane's points are gathered in so many blocks each way, of equal size over their extent."""


def ridge_height_sigma_m(
    points: FloatArray,
    residuals: FloatArray,
    plane_of_point: LabelArray,
    reach_m: float,
    planes: Sequence[Plane],
    solids: Sequence[Solid],
    outline_sigma_m: float,
) -> float:
    """Standard deviation of the highest roof point of a delivered model, metres.

    Points (n, 3) are in local metres; residuals (n,) are points minus roof, nan where there is none; `plane_of_point`
    (n,) is the plane that each point was held against, -1 for none. Points farther than `reach_m` from their plane do
    not support it. `outline_sigma_m` is the standard deviation of edges in plan that no other plane determines. The
    result is nan without a roof, and where a plane at the top has one to three points of its own, or none of them any.
    """
    top = _top(solids)
    if top is None:
        return math.nan
    x, y, ending = top
    # a plane without points was drawn after those that it meets
    numbers = [number for number in ending if planes[number].n_points > 0]
    if not numbers:
        return math.nan
    variances = _variances_at(
        points, residuals, plane_of_point, reach_m, len(planes), np.array(numbers, np.int64), x, y
    ).tolist()
    if any(math.isnan(variance) for variance in variances):
        return math.nan
    weights, gradient = _weights([(planes[number].a, planes[number].b) for number in numbers])
    terms = [weight * weight * variance for weight, variance in zip(weights, variances, strict=True)]
    return math.sqrt(math.fsum(terms) + (gradient * outline_sigma_m) ** 2 + MIN_SIGMA_M**2)


def _top(solids: Sequence[Solid]) -> tuple[float, float, list[int]] | None:
    """Place in plan of the highest roof point, and the planes that end there, ascending."""
    best: tuple[float, float, float] | None = None
    at = None
    for solid in solids:
        k = int(np.argmax(solid.vertices[:, 2]))
        x, y, z = solid.vertices[k].tolist()
        if best is None or (z, -x, -y) > best:
            best, at = (z, -x, -y), solid
    if best is None or at is None:
        return None
    z, x, y = best[0], -best[1], -best[2]
    ends = (at.vertices[:, 0] == x) & (at.vertices[:, 1] == y) & (at.vertices[:, 2] >= z - SAME_TOP_M)
    there = set(np.flatnonzero(ends).tolist())
    numbers = {
        face.plane
        for face in at.faces
        if face.kind is FaceKind.ROOF and any(not there.isdisjoint(ring) for ring in face.rings)
    }
    return x, y, sorted(numbers)


@kernel
def _variances_at(
    points: FloatArray,
    residuals: FloatArray,
    plane_of_point: LabelArray,
    reach_m: float,
    n_planes: int,
    numbers: IntArray,
    x: float,
    y: float,
) -> FloatArray:
    """`_variance_at` of several planes, (m,) m2."""
    sums = _support(points, residuals, plane_of_point, reach_m, n_planes)
    variances = np.empty(len(numbers))
    for k in range(len(numbers)):
        number = numbers[k]
        variances[k] = _variance_at(points, residuals, plane_of_point, reach_m, number, sums[number], x, y)
    return variances


@kernel
def _support(
    points: FloatArray, residuals: FloatArray, plane_of_point: LabelArray, reach_m: float, n_planes: int
) -> FloatArray:
    """Number, mean x and y, centred moments xx, xy, yy and sum of squared residuals of each plane's points, (k, 7)."""
    sums = np.zeros((n_planes, 7))
    for turn in range(2):
        for i in range(len(points)):
            p = plane_of_point[i]
            if p < 0 or not abs(residuals[i]) <= reach_m:
                continue
            if turn == 0:
                sums[p, 0] += 1.0
                sums[p, 1] += points[i, 0]
                sums[p, 2] += points[i, 1]
            else:
                dx = points[i, 0] - sums[p, 1]
                dy = points[i, 1] - sums[p, 2]
                sums[p, 3] += dx * dx
                sums[p, 4] += dx * dy
                sums[p, 5] += dy * dy
                sums[p, 6] += residuals[i] * residuals[i]
        if turn == 0:
            for p in range(n_planes):
                if sums[p, 0] > 0.0:
                    sums[p, 1] /= sums[p, 0]
                    sums[p, 2] /= sums[p, 0]
    return sums


@kernel
def _variance_at(
    points: FloatArray,
    residuals: FloatArray,
    plane_of_point: LabelArray,
    reach_m: float,
    plane: int,
    sums: FloatArray,
    x: float,
    y: float,
) -> float:
    """Variance of a plane's elevation at a place, m2; nan of fewer than four points or of points on a line.

    The larger of what independent errors give, scatter times leverage, and of what the sums over blocks of neighbouring
    points give (White's estimate by clusters): errors that neighbours share, a border of strips or a bend that the
    plane passes over, do not cancel out in a block. To it comes the square of what a refit would move the plane there.
    """
    n, mean_x, mean_y, xx, xy, yy, squares = sums
    determinant = xx * yy - xy * xy
    if n < 4.0 or determinant <= 1e-12 * (xx + yy) ** 2:
        return math.nan
    at_x, at_y = x - mean_x, y - mean_y
    rise_x, rise_y = (yy * at_x - xy * at_y) / determinant, (xx * at_y - xy * at_x) / determinant
    leverage = 1.0 / n + rise_x * at_x + rise_y * at_y
    width, depth = math.sqrt(12.0 * xx / n), math.sqrt(12.0 * yy / n)
    blocks = np.zeros(_BLOCKS * _BLOCKS)
    filled = np.zeros(_BLOCKS * _BLOCKS, np.bool_)
    for i in range(len(points)):
        if plane_of_point[i] == plane and abs(residuals[i]) <= reach_m:
            dx, dy = points[i, 0] - mean_x, points[i, 1] - mean_y
            column = min(max(math.floor((dx / width + 0.5) * _BLOCKS), 0), _BLOCKS - 1)
            row = min(max(math.floor((dy / depth + 0.5) * _BLOCKS), 0), _BLOCKS - 1)
            blocks[row * _BLOCKS + column] += (1.0 / n + rise_x * dx + rise_y * dy) * residuals[i]
            filled[row * _BLOCKS + column] = True
    moved = 0.0
    clustered = 0.0
    count = 0
    for k in range(_BLOCKS * _BLOCKS):
        moved += blocks[k]
        clustered += blocks[k] * blocks[k]
        count += filled[k]
    if count > 3:
        clustered *= count / (count - 3.0)
    independent = squares / (n - 3.0) * leverage
    return float(max(independent, clustered) + moved * moved)


def _weights(gradients: Sequence[tuple[float, float]]) -> tuple[list[float], float]:
    """Weights of the planes that meet, and the length of the gradient that they leave.

    The point of the gradients' hull that is nearest to zero, by all corners, edges and triangles: where several serve
    equally the first counts.
    """
    n = len(gradients)
    found: tuple[float, dict[int, float]] = (math.inf, {})

    def offer(weights: dict[int, float]) -> None:
        nonlocal found
        left = math.hypot(*(math.fsum(w * gradients[k][axis] for k, w in weights.items()) for axis in range(2)))
        if left < found[0] - 1e-9:
            found = left, weights

    for i in range(n):
        offer({i: 1.0})
        for j in range(i):
            (ax, ay), (bx, by) = gradients[i], gradients[j]
            length = (ax - bx) ** 2 + (ay - by) ** 2
            if length > 0.0:
                share = min(1.0, max(0.0, (ax * (ax - bx) + ay * (ay - by)) / length))
                offer({i: 1.0 - share, j: share})
            for k in range(j):
                cx, cy = gradients[k]
                twice = (ax - cx) * (by - cy) - (bx - cx) * (ay - cy)
                if abs(twice) > 1e-9:
                    first, second = (bx * cy - cx * by) / twice, (cx * ay - ax * cy) / twice
                    if min(first, second, 1.0 - first - second) >= 0.0:
                        offer({i: first, j: second, k: 1.0 - first - second})
    left, weights = found
    return [weights.get(k, 0.0) for k in range(n)], left
