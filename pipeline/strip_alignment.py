"""Flight strips of one building that do not fit each other, aligned by the surfaces that they share.

Each strip of a survey has an error of its own. Where two of them see one roof, every plane jumps by the offset of the
strips, and no plane explains its points any more. The offset shows in the points: around a place, the plane of the
nearest points of one strip is compared with that of the other. A plane z = a x + b y + c of a strip that is shifted by
(dx, dy, dz) lies dz - a dx - b dy higher, so planes of several slopes show the offset in plan, too.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.kernels.counting_sort import counting_sort
from pipeline.kernels.normal_equations import moments_of, solve_plane_moments
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray

# Not settings: they describe the estimate itself, not which offsets count.
_NEAREST = 6
"""Points of a local plane: twice as many as it needs, so that they also show how well it fits."""
_MAX_STRIPS = 8
"""Strips that are compared, those with the most points; a building is rarely seen from more than four."""
_PLACES, _FIRST_PLACES = 400, 48
"""Places at which strips are compared; most buildings show by a few that their strips fit."""
_MAX_ROUGHNESS_M = 0.15
"""A local plane with a larger deviation lies on an edge, or on leaves; the least distance of `arrangement`."""
_MAX_TURN = 0.25
"""Largest difference of slope, as rise over run, of two local planes of one surface: four standard deviations for
points 1 m apart with a noise of 0.06 m."""
_MAX_LEVERAGE = 8.0
"""Largest variance of a continued plane, in those of a point: that of five point spacings from their middle. Farther
away, it says less than the prior."""
_WIDEST_M, _NARROWEST_M, _NARROWING = 1.0, 0.12, 0.7
"""Scales of the residuals from which on a comparison counts less, first and last, and the factor between them."""
_PRIOR_M = 0.4
"""Standard deviation of the offset of a strip before anything is seen: what the planes do not show stays near 0."""
_NOISE_M = 0.05
"""Noise of a point, beside the prior."""
_FEW = 6
"""Fewest comparisons from which an offset is taken."""
_AGREEING = 0.75
"""Least share of the comparisons that an offset has to explain."""


@kernel(inline="always")
def _find_nearest(
    points: FloatArray, members: LabelArray, place: int, squares: FloatArray, nearest: LabelArray
) -> None:
    """The nearest ones in plan to the point `place` among some points: squared distances and numbers, nearest first.

    They go into `squares` and `nearest`, both (k,), of equally near ones the first; a distance is infinite where there
    are fewer. The points ascend by x and `members` (m,) are ascending numbers of them, so the search goes west and east
    until all others are too far.
    """
    squares[:] = np.inf
    x, y = points[place, 0], points[place, 1]
    east = np.searchsorted(members, place)
    west = east - 1
    while True:
        to_west = x - points[members[west], 0] if west >= 0 else np.inf
        to_east = points[members[east], 0] - x if east < len(members) else np.inf
        dx = min(to_west, to_east)
        if dx == np.inf or dx * dx > squares[_NEAREST - 1]:
            return
        if to_west < to_east:
            j = members[west]
            west -= 1
        else:
            j = members[east]
            east += 1
        dy = points[j, 1] - y
        square = dx * dx + dy * dy
        k = _NEAREST - 1
        if square > squares[k] or (square == squares[k] and j > nearest[k]):
            continue
        while k > 0 and (squares[k - 1] > square or (squares[k - 1] == square and nearest[k - 1] > j)):
            squares[k], nearest[k] = squares[k - 1], nearest[k - 1]
            k -= 1
        squares[k], nearest[k] = square, j


@kernel
def _comparisons(points: FloatArray, strip: LabelArray, places: IntArray, strips: int) -> FloatArray:
    """Local planes of two strips at the same place, (k, 6): the strips, difference, slopes a and b, variance.

    `strip` (n,) is the number of the strip of each of the points (n, 3), which ascend by x, -1 for others; `places` are
    numbers of points.
    The difference of elevation in metres is that of the first strip over the second; its variance is in those of a
    point.
    """
    rows = np.empty((len(places) * max(strips - 1, 0), 6))
    count = 0
    start, members = counting_sort(strip, strips)
    squares = np.empty(_NEAREST)
    nearest = np.zeros(_NEAREST, np.int32)
    found = np.empty((strips, 4))
    for i in places:
        own = strip[i]
        if own < 0:
            continue
        x, y = points[i, 0], points[i, 1]
        for s in range(strips):
            found[s, 3] = np.inf
            _find_nearest(points, members[start[s] : start[s + 1]], i, squares, nearest)
            if squares[_NEAREST - 1] == np.inf:
                continue
            m = moments_of(points, nearest)
            a, b = solve_plane_moments(m.xx, m.xy, m.yy, m.xz, m.yz)
            error = 0.0
            for j in nearest:
                error += (points[j, 2] - m.z - a * (points[j, 0] - m.x) - b * (points[j, 1] - m.y)) ** 2
            det = m.xx * m.yy - m.xy * m.xy
            if error > _NEAREST * _MAX_ROUGHNESS_M**2 or det <= 1e-2 * m.xx * m.yy:
                continue
            dx, dy = x - m.x, y - m.y
            found[s, 0], found[s, 1], found[s, 2] = m.z + a * dx + b * dy, a, b
            found[s, 3] = 1.0 / _NEAREST + (m.yy * dx * dx - 2.0 * m.xy * dx * dy + m.xx * dy * dy) / det
        for s in range(strips):
            if s == own or found[own, 3] > _MAX_LEVERAGE or found[s, 3] > _MAX_LEVERAGE:
                continue
            if math.hypot(found[own, 1] - found[s, 1], found[own, 2] - found[s, 2]) > _MAX_TURN:
                continue
            rows[count, 0], rows[count, 1] = own, s
            rows[count, 2] = found[own, 0] - found[s, 0]
            rows[count, 3] = 0.5 * (found[own, 1] + found[s, 1])
            rows[count, 4] = 0.5 * (found[own, 2] + found[s, 2])
            rows[count, 5] = found[own, 3] + found[s, 3]
            count += 1
    return rows[:count]


@kernel(inline="always")
def _solve(system: FloatArray, right: FloatArray) -> None:
    """Solve a positive definite system (n, n) in place by elimination; `right` (n,) becomes the solution."""
    n = len(right)
    for k in range(n):
        for i in range(k + 1, n):
            factor = system[i, k] / system[k, k]
            for j in range(k, n):
                system[i, j] -= factor * system[k, j]
            right[i] -= factor * right[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            right[k] -= system[k, j] * right[j]
        right[k] /= system[k, k]


@kernel
def _offsets(rows: FloatArray, strips: int) -> FloatArray:
    """Offset of every strip, (3 strips,): east, north, up, metres, from the comparisons of `_comparisons`.

    Graduated non-convexity (Blake and Zisserman 1987): first all comparisons count, at last those that agree.
    """
    n = 3 * strips
    shifts = np.zeros(n)
    factors = np.empty(6)
    at = np.empty(6, np.int64)
    scale = _WIDEST_M
    while True:
        system = np.zeros((n, n))
        right = np.zeros(n)
        for k in range(n):
            system[k, k] = 1.0 / _PRIOR_M**2
        for row in rows:
            first, second = 3 * int(row[0]), 3 * int(row[1])
            factors[0], factors[1], factors[2] = -row[3], -row[4], 1.0
            factors[3], factors[4], factors[5] = row[3], row[4], -1.0
            residual = row[2]
            for k in range(3):
                at[k], at[3 + k] = first + k, second + k
            for k in range(6):
                residual -= factors[k] * shifts[at[k]]
            width = scale * scale + _NOISE_M**2 * row[5]
            # neighbouring places share most of their points
            weight = (width / (width + residual * residual)) ** 2 / (_NEAREST * _NOISE_M**2 * row[5])
            for k in range(6):
                right[at[k]] += weight * factors[k] * row[2]
                for j in range(6):
                    system[at[k], at[j]] += weight * factors[k] * factors[j]
        _solve(system, right)
        shifts[:] = right
        if scale <= _NARROWEST_M:
            return shifts
        scale = max(_NARROWEST_M, scale * _NARROWING)


def strip_offsets_m(points: FloatArray, strip: npt.NDArray[np.uint16], min_offset_m: float) -> FloatArray:
    """Offset of the strip of every point from the mean of all points, (n, 3) float64, metres; 0 where strips fit.

    `points` (n, 3) in metres, ascending by x, `strip` (n,) their flight lines. The offsets are 0 unless strips disagree
    by more than `min_offset_m`, root mean square of the elevations over the surfaces that both saw.
    """
    offsets = np.zeros((len(points), 3))
    names, numbers, counts = np.unique(strip, return_inverse=True, return_counts=True)
    large = sorted((k for k in range(len(names)) if counts[k] >= _NEAREST), key=lambda k: (-counts[k], k))[:_MAX_STRIPS]
    if len(large) < 2:
        return offsets
    order = np.full(len(names), -1, np.int32)
    order[large] = np.arange(len(large), dtype=np.int32)
    number = order[numbers]
    points = np.ascontiguousarray(points)
    compared = np.flatnonzero(number >= 0)
    for most in (_FIRST_PLACES, _PLACES):
        step = max(1, -(-len(compared) // most))
        rows = _comparisons(points, number, np.ascontiguousarray(compared[step // 2 :: step]), len(large))
        if most == _FIRST_PLACES and len(rows) >= _FEW and np.median(np.abs(rows[:, 2])) < 0.5 * min_offset_m:
            return offsets
    if len(rows) < _FEW:
        return offsets
    shifts = _offsets(rows, len(large)).reshape(-1, 3)
    between = shifts[rows[:, 0].astype(np.int64)] - shifts[rows[:, 1].astype(np.int64)]
    explained = between[:, 2] - rows[:, 3] * between[:, 0] - rows[:, 4] * between[:, 1]
    agrees = np.abs(rows[:, 2] - explained) <= 3.0 * np.sqrt(_NOISE_M**2 * rows[:, 5] + 0.03**2)
    if agrees.mean() < _AGREEING or math.sqrt(np.mean(explained[agrees] ** 2)) <= min_offset_m:
        return offsets
    weights = counts[large] / counts[large].sum()
    shifts = shifts - (weights[:, None] * shifts).sum(axis=0)
    offsets[number >= 0] = shifts[number[number >= 0]]
    return offsets


def aligned_mm(
    xyz_mm: IntArray, strip: npt.NDArray[np.uint16], marked: BoolArray, min_offset_m: float
) -> tuple[IntArray, BoolArray, float]:
    """Points with their strips aligned, sorted by x, y and z; their marks; the largest offset between two strips.

    `xyz_mm` (n, 3) in canonical order, `strip` (n,) their flight lines, `marked` (n,) any marks, which follow the
    points. Every strip is moved to the mean of all points, so the building as a whole stays where the survey saw it.
    Where strips fit, or nothing shows that they do not, the points come back as they are, with nan metres.
    """
    if len(strip) == 0 or (strip == strip[0]).all():
        return xyz_mm, marked, math.nan
    offsets = strip_offsets_m((xyz_mm - xyz_mm[0]) / 1e3, strip, min_offset_m)
    if not offsets.any():
        return xyz_mm, marked, math.nan
    moved = xyz_mm - np.rint(offsets * 1e3).astype(np.int64)
    kinds = np.unique(offsets, axis=0)
    largest_m = max(float(np.sqrt(((one - kinds) ** 2).sum(axis=1)).max()) for one in kinds)
    order = np.lexsort(moved.T[::-1])
    return moved[order], marked[order], largest_m
