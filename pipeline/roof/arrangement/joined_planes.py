"""Planes are fitted once more, on condition that neighbours agree at the vertices of their common border.

Fitted one by one, three planes that meet in one corner of a roof miss it by centimetres, and the solid gets small walls
and clusters of vertices there. Each condition "these two planes have one height over this vertex" is linear, so least
squares under it is one step of a Kalman filter with an exact measurement (Kalman 1960), in which the noise of its
points weighs each plane: a plane that they determine well moves less. Conditions come in order of their costs. One that
costs more points than the corners of a gap must save is left out, and so is one that moves a plane farther from its
points than the settings allow: such a gap is real, or the corner lies in the wrong place.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.movable_borders import Borders
from pipeline.roof.arrangement.raster_labels import Limits, vertical_distance_m

_FEWEST_POINTS = 6
"""Planes with fewer points keep their coefficients: twice as many as there are coefficients."""
_MAX_GAP_M = 0.25
"""Wider gaps are steps. Not a setting: hardly more than what planes that share a corner miss it by (`corner_gap_m`)."""
_CORNERS = 4.0
"""Corners that a gap costs: there is a wall in it, and each of the edges beside it is two."""
_EXACT_M = 1e-12
"""Variance over noise below which earlier conditions hold a gap as it is; numerical guard."""
_LEAST_NOISE_M = 0.01
"""Noise of planes that fit their points better: no survey does; numerical guard."""
_LEAST_MOMENT = (1e-2, 1e-2, 1e-3)
"""Added to the moments so that they can be inverted; numerical guard."""


@kernel(inline="always")
def _conditions(borders: Borders, n_planes: int) -> IntArray:
    """Vertices and the two planes beside their edges, (m, 3) int64, each once."""
    edges, plane_of_face = borders.edges, borders.plane_of_face
    found = np.empty((2 * len(edges), 3), np.int64)
    keys = np.empty(2 * len(edges), np.int64)
    m = 0
    for e in range(len(edges)):
        if edges[e, 0] < 0 or edges[e, 3] < 0:
            continue
        p, q = plane_of_face[edges[e, 2]], plane_of_face[edges[e, 3]]
        if p == q:
            continue
        for side in range(2):
            found[m, 0], found[m, 1], found[m, 2] = edges[e, side], min(p, q), max(p, q)
            keys[m] = (found[m, 0] * n_planes + found[m, 1]) * n_planes + found[m, 2]
            m += 1
    kept = np.empty((m, 3), np.int64)
    n = 0
    before = np.int64(-1)
    for s in ascending_order(keys[:m]):
        if keys[s] != before:
            kept[n] = found[s]
            n += 1
        before = keys[s]
    return kept[:n].copy()


@kernel(inline="always")
def _moments(
    points: FloatArray, labels: LabelArray, planes: FloatArray, middle: FloatArray, cap_m: float
) -> FloatArray:
    """Sums of x x, x y, x, y y, y, 1 and squared residuals over the points of each plane, about the middle, (k, 7)."""
    sums = np.zeros((len(planes), 7))
    for i in range(len(points)):
        label = labels[i]
        off = vertical_distance_m(points, i, planes, label) if label >= 0 else cap_m
        if off < cap_m:
            x, y = points[i, 0] - middle[0], points[i, 1] - middle[1]
            sums[label, 0] += x * x
            sums[label, 1] += x * y
            sums[label, 2] += x
            sums[label, 3] += y * y
            sums[label, 4] += y
            sums[label, 5] += 1.0
            sums[label, 6] += off * off
    return sums


@kernel(inline="always")
def _covariance(moments: FloatArray) -> FloatArray:
    """Covariance of all coefficients over the noise of their plane, (3 k, 3 k); zero for planes with too few points."""
    k = len(moments)
    covariance = np.zeros((3 * k, 3 * k))
    for p in range(k):
        if moments[p, 5] < _FEWEST_POINTS:
            continue
        xx, xy, x = moments[p, 0] + _LEAST_MOMENT[0], moments[p, 1], moments[p, 2]
        yy, y, n = moments[p, 3] + _LEAST_MOMENT[1], moments[p, 4], moments[p, 5] + _LEAST_MOMENT[2]
        a, b, c = yy * n - y * y, x * y - xy * n, xy * y - x * yy
        determinant = xx * a + xy * b + x * c
        inverse = covariance[3 * p : 3 * p + 3, 3 * p : 3 * p + 3]
        inverse[0, 0], inverse[0, 1], inverse[0, 2] = a, b, c
        inverse[1, 1], inverse[1, 2], inverse[2, 2] = xx * n - x * x, x * xy - xx * y, xx * yy - xy * xy
        inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
        noise_m = max(math.sqrt(moments[p, 6] / moments[p, 5]), _LEAST_NOISE_M)
        for i in range(3):
            for j in range(3):
                inverse[i, j] *= noise_m / determinant
    return covariance


@kernel(inline="always")
def _is_near(moments: FloatArray, change: FloatArray, max_shift_m: float) -> bool:
    """Whether no plane moves farther than a distance, root mean square over its points."""
    for p in range(len(moments)):
        a, b, c = change[3 * p], change[3 * p + 1], change[3 * p + 2]
        xx, xy, x = moments[p, 0], moments[p, 1], moments[p, 2]
        yy, y, n = moments[p, 3], moments[p, 4], moments[p, 5]
        squares = a * a * xx + b * b * yy + c * c * n + 2.0 * (a * b * xy + a * c * x + b * c * y)
        if squares > max_shift_m * max_shift_m * n:
            return False
    return True


@kernel(inline="always")
def _terms(
    borders: Borders, conditions: IntArray, planes: FloatArray, middle: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Factors of the coefficients in each condition, (m, 6), which coefficients, (m, 6), and gaps, (m,) metres."""
    m = len(conditions)
    factors, index, gaps = np.empty((m, 6)), np.empty((m, 6), np.int64), np.empty(m)
    for i in range(m):
        v, p, q = conditions[i, 0], conditions[i, 1], conditions[i, 2]
        x, y = borders.xy[v, 0] * 1e-3, borders.xy[v, 1] * 1e-3
        gaps[i] = (planes[p, 0] - planes[q, 0]) * x + (planes[p, 1] - planes[q, 1]) * y + planes[p, 2] - planes[q, 2]
        for axis in range(3):
            factor = x - middle[0] if axis == 0 else y - middle[1] if axis == 1 else 1.0
            factors[i, axis], factors[i, 3 + axis] = factor, -factor
            index[i, axis], index[i, 3 + axis] = 3 * p + axis, 3 * q + axis
    return factors, index, gaps


@kernel(inline="always")
def _cheapest(
    factors: FloatArray,
    index: IntArray,
    gaps: FloatArray,
    change: FloatArray,
    covariance: FloatArray,
    is_open: BoolArray,
    max_rise_m: float,
) -> tuple[int, float, float]:
    """The open condition that raises the residuals least, its gap now and its variance over noise; -1 for none."""
    best, best_gap, best_variance, least = -1, 0.0, 0.0, max_rise_m
    for i in range(len(gaps)):
        if not is_open[i]:
            continue
        variance, gap = 0.0, gaps[i]
        for s in range(6):
            gap += factors[i, s] * change[index[i, s]]
            for t in range(6):
                variance += factors[i, s] * factors[i, t] * covariance[index[i, s], index[i, t]]
        if abs(gap) < _MAX_GAP_M and variance > _EXACT_M and gap * gap < least * variance:
            best, best_gap, best_variance, least = i, gap, variance, gap * gap / variance
    return best, best_gap, best_variance


@kernel(inline="always")
def joined_planes(
    points: FloatArray, labels: LabelArray, planes: FloatArray, borders: Borders, limits: Limits
) -> FloatArray:
    """The planes (k, 3), moved so that neighbours have one height at common vertices, where that costs little.

    `points` (n, 3) in metres and their planes `labels` (n,), -1 for none, determine the costs.
    """
    k = len(planes)
    middle = np.zeros(2)
    for i in range(len(points)):
        middle[0] += points[i, 0] / len(points)
        middle[1] += points[i, 1] / len(points)
    moments = _moments(points, labels, planes, middle, limits.cap_m)
    covariance = _covariance(moments)
    factors, index, gaps = _terms(borders, _conditions(borders, k), planes, middle)
    is_open = np.full(len(gaps), limits.plane_shift_m > 0.0)
    # the sum of |residuals| of a point rises by d^2 / (sqrt(2 pi) noise) if its plane moves by d; the cap is one point
    max_rise_m = _CORNERS * limits.corner_cost * limits.cap_m * math.sqrt(2.0 * math.pi)
    change, trial, gain = np.zeros(3 * k), np.empty(3 * k), np.empty(3 * k)
    while True:
        i, gap, variance = _cheapest(factors, index, gaps, change, covariance, is_open, max_rise_m)
        if i < 0:
            break
        is_open[i] = False
        for j in range(3 * k):
            gain[j] = 0.0
            for s in range(6):
                gain[j] += covariance[j, index[i, s]] * factors[i, s]
            trial[j] = change[j] - gain[j] * gap / variance
        if not _is_near(moments, trial, limits.plane_shift_m):
            continue
        change[:] = trial
        for j in range(3 * k):
            for t in range(3 * k):
                covariance[j, t] -= gain[j] * gain[t] / variance
    joined = planes.copy()
    for p in range(k):
        a, b, c = change[3 * p], change[3 * p + 1], change[3 * p + 2]
        joined[p, 0] += a
        joined[p, 1] += b
        joined[p, 2] += c - a * middle[0] - b * middle[1]
    return joined
