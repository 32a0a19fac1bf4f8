"""Roof shapes over one part of an outline: flat, pent, gable, hip and half-hip, fitted to few points by robust lines.

Every plane falls along one axis of the part's frame, so a shape is the lower envelope of planes of two parameters each:
a convex roof. The first fits have the least freedom (the ridge in the middle, equal pitch). From the best of them
planes become free, as long as the points pay for the parameters.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray

MAX_PLANES = 4
"""Planes of a hip, the shape with most of them."""
CAP_SIGMAS = 3.0
"""A point farther than this from a shape is not explained by it: the usual bound of 3 standard deviations."""
_STEPS = 5
"""Refits of a line: the distance that counts as far halves each time, from 16 times the last."""
_MIN_SLOPE = math.tan(math.radians(7.0))
_MAX_SLOPE = math.tan(math.radians(70.0))
"""Slopes of the sides of a gable or hip: below it is flat, as in Hofmann et al. (2003), above it is a wall."""
_RIDGE_PLACES = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8)
"""Where a ridge may lie, as shares of the part's width; the first in the middle. Planes that go free refine it."""
_BOTH_ENDS = 3
"""Bits of the ends of a ridge with hips."""
_RIDGES = _BOTH_ENDS + len(_RIDGE_PLACES)
"""Ridges that are tried in each direction: without hips, with them at either end, at both, and off the middle."""
_FIRST_RIDGED = 3
"""Trials before the ridged shapes: level, pent in two directions."""
_MIN_PENT = 0.02
"""A pent roof of less slope is flat: over 10 m it falls by two standard deviations of the points."""
_BEYOND_M = 0.3
"""By how much a shape may leave the heights of its points within the part, besides its fall over one spacing: three
standard deviations of the points."""
_REFITS = 4
"""Refits of free planes: the first two with wider reaches, then two with the last one."""


@kernel
def robust_line(t: FloatArray, z: FloatArray, reach_m: float, level: bool) -> tuple[float, float]:
    """The line z = c + s t that most points lie near, by graduated non-convexity.

    Weights of Geman and McClure, (reach^2 / (reach^2 + r^2))^2, with a reach that halves from fit to fit (Blake and
    Zisserman 1987) down to `reach_m`: first all points count, at last those within the reach.

    Places `t` and heights `z` are (m,), metres. The result is the height c at t = 0 and the slope s, which is 0 for a
    level line and where all places are one.
    """
    c, s = 0.0, 0.0
    for step in range(_STEPS + 1):
        reach2 = (reach_m * 2.0 ** (_STEPS - step)) ** 2
        w0 = wt = wz = wtt = wtz = 0.0
        for i in range(len(t)):
            w = 1.0
            if step > 0:
                r = z[i] - c - s * t[i]
                w = reach2 / (reach2 + r * r)
                w *= w
            w0 += w
            wt += w * t[i]
            wz += w * z[i]
            wtt += w * t[i] * t[i]
            wtz += w * t[i] * z[i]
        spread = w0 * wtt - wt * wt
        s = 0.0 if level or spread <= 1e-9 * w0 * w0 else (w0 * wtz - wt * wz) / spread
        c = (wz - s * wt) / w0
    return c, s


@kernel
def height(planes: FloatArray, count: int, u: float, v: float) -> tuple[float, int]:
    """Height of a lower envelope over a place, and the plane that gives it."""
    lowest, which = math.inf, -1
    for k in range(count):
        z = planes[k, 0] * u + planes[k, 1] * v + planes[k, 2]
        if z < lowest:
            lowest, which = z, k
    return lowest, which


@kernel
def misfit(planes: FloatArray, count: int, points: FloatArray, sigma_m: float) -> float:
    """Sum of the squared residuals over sigma, each at most the square of `CAP_SIGMAS`."""
    total = 0.0
    for i in range(len(points)):
        z, _ = height(planes, count, points[i, 0], points[i, 1])
        r = (points[i, 2] - z) / sigma_m
        total += min(r * r, CAP_SIGMAS * CAP_SIGMAS)
    return total


@kernel
def _stays_near(planes: FloatArray, count: int, points: FloatArray, box: FloatArray) -> bool:
    """Whether slopes are possible for a roof, and the envelope stays near the heights of the points within the box."""
    steepest = 0.0
    for k in range(count):
        steepest = max(steepest, abs(planes[k, 0]) + abs(planes[k, 1]))
    if steepest > _MAX_SLOPE:
        return False
    # ridges and eaves lie up to a spacing beyond points
    beyond_m = _BEYOND_M + steepest * math.sqrt((box[1] - box[0]) * (box[3] - box[2]) / len(points))
    low, high = math.inf, -math.inf
    for i in range(len(points)):
        low, high = min(low, points[i, 2]), max(high, points[i, 2])
    # planes fall along one axis each: the lowest of either axis' planes is highest at an end, or where two cross
    top, bottom = math.inf, math.inf
    for axis in range(2):
        of_axis = -math.inf
        for p in range(count):
            if planes[p, 1 - axis] != 0.0:
                continue
            for q in range(-2, p):
                t = box[2 * axis + 2 + q] if q < 0 else 0.0
                if q >= 0:
                    turn = planes[p, axis] - planes[q, axis]
                    if planes[q, 1 - axis] != 0.0 or turn == 0.0:
                        continue
                    t = (planes[q, 2] - planes[p, 2]) / turn
                    t = min(max(t, box[2 * axis]), box[2 * axis + 1])
                z = math.inf
                for k in range(count):
                    if planes[k, 1 - axis] == 0.0:
                        z = min(z, planes[k, axis] * t + planes[k, 2])
                of_axis = max(of_axis, z)
        if of_axis > -math.inf:
            top = min(top, of_axis)
    for corner in range(4):
        bottom = min(bottom, height(planes, count, box[corner // 2], box[2 + corner % 2])[0])
    return top <= high + beyond_m and bottom >= low - beyond_m


@kernel
def _refit(planes: FloatArray, count: int, points: FloatArray, reach_m: float) -> bool:
    """Let every plane of an envelope go free: points to their plane, planes to their points (Magnani and Boyd 2009).

    False where a plane is left with too few points, or turns over; the planes are then undefined.
    """
    sums = np.empty((count, 6))
    for step in range(_REFITS):
        reach2 = (reach_m * 2.0 ** max(2 - step, 0)) ** 2
        for k in range(count):
            for q in range(6):
                sums[k, q] = 0.0
        for i in range(len(points)):
            z, k = height(planes, count, points[i, 0], points[i, 1])
            r = points[i, 2] - z
            w = reach2 / (reach2 + r * r)
            w *= w
            t = points[i, 0] if planes[k, 0] != 0.0 else points[i, 1]
            sums[k, 0] += w
            sums[k, 1] += w * t
            sums[k, 2] += w * points[i, 2]
            sums[k, 3] += w * t * t
            sums[k, 4] += w * t * points[i, 2]
            if abs(r) <= reach_m:
                sums[k, 5] += 1.0
        for k in range(count):
            spread = sums[k, 0] * sums[k, 3] - sums[k, 1] ** 2
            if sums[k, 5] < 2.0 or spread <= 1e-3 * sums[k, 0] ** 2:
                return False
            s = (sums[k, 0] * sums[k, 4] - sums[k, 1] * sums[k, 2]) / spread
            axis = 0 if planes[k, 0] != 0.0 else 1
            if s * planes[k, axis] <= 0.0:  # it turned over: another shape
                return False
            planes[k, axis] = s
            planes[k, 2] = (sums[k, 2] - s * sums[k, 1]) / sums[k, 0]
    return True


@kernel
def _drop(u: float, v: float, axis: int, ridge: float, box: FloatArray, ends: int) -> float:
    """Distance in plan of a place from the ridge of a roof of equal pitch, along the fall; metres.

    The ridge runs across `axis`; where bits of `ends` say so, it ends half the box's width before the box.
    """
    if axis == 0:
        across, along, low, high = u, v, box[2], box[3]
        half = 0.5 * (box[1] - box[0])
    else:
        across, along, low, high = v, u, box[0], box[1]
        half = 0.5 * (box[3] - box[2])
    drop = abs(across - ridge)
    if ends & 1:
        drop = max(drop, low + half - along)
    if ends & 2:
        drop = max(drop, along - high + half)
    return drop


@kernel
def _ridged(planes: FloatArray, axis: int, ridge: float, box: FloatArray, ends: int, c: float, slope: float) -> int:
    """Fill in the planes of such a roof (see `_drop`) from its ridge's elevation c and its slope; their number."""
    along = 1 - axis
    planes[0, axis], planes[0, along], planes[0, 2] = -slope, 0.0, c + slope * ridge
    planes[1, axis], planes[1, along], planes[1, 2] = slope, 0.0, c - slope * ridge
    count = 2
    half = 0.5 * (box[2 * axis + 1] - box[2 * axis])
    for end in range(2):
        if ends & (1 << end):
            sign = 1.0 if end == 0 else -1.0
            start = box[2 * along + end] + sign * half
            planes[count, axis], planes[count, along] = 0.0, sign * slope
            planes[count, 2] = c - sign * slope * start
            count += 1
    return count


@kernel
def copy_planes(planes: FloatArray, to: FloatArray) -> None:
    """Copy planes; written out, since assigning whole arrays compiles for seconds."""
    for k in range(len(planes)):
        for q in range(3):
            to[k, q] = planes[k, q]


@kernel(inline="always")
def _fit_of_least_freedom(
    points: FloatArray, heights: FloatArray, box: FloatArray, trial: int, reach_m: float, planes: FloatArray
) -> int:
    """Fit a shape by one line: 0 level, 1 and 2 pent along u and v, else ridged; its planes, 0 if it does not fit."""
    axis, ends, ridge = max(trial - 1, 0), 0, 0.0
    if trial >= _FIRST_RIDGED:
        axis, variant = (trial - _FIRST_RIDGED) // _RIDGES, (trial - _FIRST_RIDGED) % _RIDGES
        ends, place = (variant, 0) if variant <= _BOTH_ENDS else (0, variant - _BOTH_ENDS)
        ridge = box[2 * axis] + _RIDGE_PLACES[place] * (box[2 * axis + 1] - box[2 * axis])
    t = np.empty(len(points))
    for i in range(len(points)):
        if trial >= _FIRST_RIDGED:
            t[i] = _drop(points[i, 0], points[i, 1], axis, ridge, box, ends)
        else:
            t[i] = points[i, axis]
    c, s = robust_line(t, heights, reach_m, trial == 0)
    if trial >= _FIRST_RIDGED:
        return 0 if -s < _MIN_SLOPE else _ridged(planes, axis, ridge, box, ends, c, -s)
    planes[0, 0], planes[0, 1], planes[0, 2] = 0.0, 0.0, c
    if trial > 0:
        planes[0, axis] = s
        if abs(s) < _MIN_PENT:
            return 0
    return 1


@kernel
def best_shape(
    points: FloatArray, box: FloatArray, sigma_m: float, cost_of_parameter: float, thorough: bool
) -> tuple[float, int, int, FloatArray]:
    """The shape of least cost over a part: its misfit and its parameters.

    Parameters
    ----------
    points : (m, 3) float64
        Along the frame's axes u and v, and elevation; metres, m >= 1.
    box : (4,) float64
        Extent of the part: least and largest u, least and largest v.
    sigma_m : float
        Standard deviation of the noise.
    cost_of_parameter : float
        Logarithm of the number of all points, for the BIC.
    thorough : bool
        False leaves out hips, ridges off the middle and free planes.

    Returns
    -------
    cost : float
        `misfit` + parameters times their cost; inf where no shape has fewer parameters than points.
    parameters : int
        Their number.
    count : int
        Planes.
    planes : (4, 3) float64
        (a, b, c) of z = a u + b v + c; the roof is the lowest of the first `count`.
    """
    reach_m = CAP_SIGMAS * sigma_m / math.sqrt(3.0)
    m = len(points)
    best = math.inf
    best_count, best_parameters = 0, 0
    best_planes = np.zeros((MAX_PLANES, 3))
    ridged = math.inf
    start_count = 0
    start = np.zeros((MAX_PLANES, 3))
    planes = np.zeros((MAX_PLANES, 3))
    heights = np.empty(m)
    for i in range(m):
        heights[i] = points[i, 2]
    free = _FIRST_RIDGED + 2 * _RIDGES
    for trial in range(free + MAX_PLANES - 1 if thorough else free):
        variant = (trial - _FIRST_RIDGED) % _RIDGES
        parameters = 1 if trial == 0 else 2
        count = 1
        if trial >= free:
            # the best ridged shape so far, every plane free
            count = trial - free + 2
            parameters = 2 * count
            if count > start_count or (start_count == MAX_PLANES and count == 3):
                continue
        elif trial >= _FIRST_RIDGED:
            if not thorough and variant > 0:
                continue
            parameters = 2 if variant <= _BOTH_ENDS else 3
        if m < parameters + (1 if trial < _FIRST_RIDGED else 2) or best <= parameters * cost_of_parameter:
            continue
        if trial >= free:
            copy_planes(start, planes)
            if not _refit(planes, count, points, reach_m):
                continue
        else:
            count = _fit_of_least_freedom(points, heights, box, trial, reach_m, planes)
        if count == 0 or (trial > 0 and not _stays_near(planes, count, points, box)):
            continue
        own = misfit(planes, count, points, sigma_m)
        if _FIRST_RIDGED <= trial < free and own < ridged:
            ridged, start_count = own, count
            copy_planes(planes, start)
        cost = own + parameters * cost_of_parameter
        if cost < best:
            best, best_count, best_parameters = cost, count, parameters
            copy_planes(planes, best_planes)
    return best, best_parameters, best_count, best_planes
