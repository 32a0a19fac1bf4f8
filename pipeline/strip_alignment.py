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
from pipeline.kernels.normal_equations import moments_of, solve_plane_moments
from pipeline.kernels.sorting import counting_sort
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
def _find_nearest(points: FloatArray, first: int, x: float, y: float, squares: FloatArray, nearest: LabelArray) -> None:
    """The nearest ones in plan to a place among some points: squared distances and numbers, nearest first.

    They go into `squares` and `nearest`, both (k,), of equally near ones the first; a distance is infinite where there
    are fewer. The points (m, 3) ascend by x, and from `first` on none lies west of the place: the search goes east and
    west from there until all others are too far.
    """
    squares[:] = np.inf
    for step, start, end in ((1, first, len(points)), (-1, first - 1, -1)):
        for j in range(start, end, step):
            dx, dy = points[j, 0] - x, points[j, 1] - y
            k = _NEAREST - 1
            if dx * dx > squares[k]:
                break
            square = dx * dx + dy * dy
            if square > squares[k] or (square == squares[k] and j > nearest[k]):
                continue
            while k > 0 and (squares[k - 1] > square or (squares[k - 1] == square and nearest[k - 1] > j)):
                squares[k], nearest[k] = squares[k - 1], nearest[k - 1]
                k -= 1
            squares[k], nearest[k] = square, j


@kernel
def _local_plane(
    points: FloatArray, first: int, x: float, y: float, squares: FloatArray, nearest: LabelArray
) -> tuple[float, float, float, float]:
    """Elevation, slopes a and b, and variance of the plane of some points (m, 3) at a place.

    The variance is in those of a point, infinite where no plane explains the nearest ones; other arguments are those of
    `_find_nearest`.
    """
    _find_nearest(points, first, x, y, squares, nearest)
    if squares[_NEAREST - 1] == np.inf:
        return 0.0, 0.0, 0.0, np.inf
    m = moments_of(points, nearest)
    a, b = solve_plane_moments(m.xx, m.xy, m.yy, m.xz, m.yz)
    error = 0.0
    for j in nearest:
        error += (points[j, 2] - m.z - a * (points[j, 0] - m.x) - b * (points[j, 1] - m.y)) ** 2
    det = m.xx * m.yy - m.xy * m.xy
    if error > _NEAREST * _MAX_ROUGHNESS_M**2 or det <= 1e-2 * m.xx * m.yy:
        return 0.0, 0.0, 0.0, np.inf
    dx, dy = x - m.x, y - m.y
    variance = 1.0 / _NEAREST + (m.yy * dx * dx - 2.0 * m.xy * dx * dy + m.xx * dy * dy) / det
    return m.z + a * dx + b * dy, a, b, variance


@kernel
def _comparisons(points: FloatArray, strip: LabelArray, step: int, strips: int) -> FloatArray:
    """Local planes of two strips at the same place, (k, 6): the strips, difference, slopes a and b, variance.

    `strip` (n,) is the number of the strip of each of the points (n, 3), which ascend by x, -1 for others. The places
    are those of every `step`-th point of a strip.
    The difference of elevation in metres is that of the first strip over the second; its variance is in those of a
    point.
    """
    start, members = counting_sort(strip, strips)
    rows = np.empty((len(members) // step + 1, strips - 1, 6)).reshape(-1, 6)
    count = 0
    by_strip = points[members]
    squares = np.empty(_NEAREST)
    nearest = np.zeros(_NEAREST, np.int32)
    first = start[:strips].copy()
    wait = step // 2
    for i in range(len(points)):
        own = strip[i]
        if own < 0:
            continue
        if wait == 0:
            wait = step
            x, y = points[i, 0], points[i, 1]
            z, a, b, variance = _local_plane(
                by_strip[start[own] : start[own + 1]], first[own] - start[own], x, y, squares, nearest
            )
            for s in range(strips):
                if s == own or variance > _MAX_LEVERAGE:
                    continue
                other_z, other_a, other_b, other_variance = _local_plane(
                    by_strip[start[s] : start[s + 1]], first[s] - start[s], x, y, squares, nearest
                )
                if other_variance > _MAX_LEVERAGE or math.hypot(a - other_a, b - other_b) > _MAX_TURN:
                    continue
                rows[count, 0], rows[count, 1] = own, s
                rows[count, 2] = z - other_z
                rows[count, 3] = 0.5 * (a + other_a)
                rows[count, 4] = 0.5 * (b + other_b)
                rows[count, 5] = variance + other_variance
                count += 1
        wait -= 1
        first[own] += 1
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


@kernel
def _numbered(strip: npt.NDArray[np.uint16]) -> tuple[LabelArray, IntArray]:
    """The strips with the most points, at most `_MAX_STRIPS`: the number of each point's, (n,), and their sizes (k,).

    The largest has the number 0, of equal ones the first by name; points of all others have -1.
    """
    number = np.full(len(strip), -1, np.int32)
    sizes = np.empty(_MAX_STRIPS, np.int64)
    if len(strip) == 0:
        return number, sizes[:0]
    lowest = int(strip.min())
    counts = np.zeros(int(strip.max()) - lowest + 1, np.int64)
    for name in strip:
        counts[name - lowest] += 1
    numbers = np.full(len(counts), -1, np.int32)
    found = 0
    while found < _MAX_STRIPS:
        largest = np.argmax(counts)
        if counts[largest] < _NEAREST:
            break
        numbers[largest], sizes[found], counts[largest] = found, counts[largest], 0
        found += 1
    for i in range(len(strip)):
        number[i] = numbers[strip[i] - lowest]
    return number, sizes[:found]


def _shifts_m(points: FloatArray, number: LabelArray, sizes: IntArray, min_offset_m: float) -> FloatArray | None:
    """Offset of each strip from the mean of all their points, (k + 1, 3) float64, metres; None where strips fit.

    The last row is that of the points of other strips: 0. `number` and `sizes` are those of `_numbered`, and the other
    arguments those of `strip_offsets_m`.
    """
    strips, total = len(sizes), int(sizes.sum())
    if strips < 2:
        return None
    few, more = (max(1, -(-total // most)) for most in (_FIRST_PLACES, _PLACES))
    rows = _comparisons(points, number, few, strips)
    if len(rows) >= _FEW:
        differences = np.sort(np.abs(rows[:, 2]))
        median = 0.5 * (differences[(len(rows) - 1) // 2] + differences[len(rows) // 2])
        if median < 0.5 * min_offset_m:
            return None
    if more < few:
        rows = _comparisons(points, number, more, strips)
    if len(rows) < _FEW:
        return None
    shifts = _offsets(rows, strips).reshape(-1, 3)
    between = shifts[rows[:, 0].astype(np.int64)] - shifts[rows[:, 1].astype(np.int64)]
    explained = between[:, 2] - rows[:, 3] * between[:, 0] - rows[:, 4] * between[:, 1]
    agrees = np.abs(rows[:, 2] - explained) <= 3.0 * np.sqrt(_NOISE_M**2 * rows[:, 5] + 0.03**2)
    if agrees.mean() < _AGREEING or math.sqrt(np.mean(explained[agrees] ** 2)) <= min_offset_m:
        return None
    weights = sizes / total
    return np.vstack((shifts - (weights[:, None] * shifts).sum(axis=0), np.zeros(3)))


def strip_offsets_m(points: FloatArray, strip: npt.NDArray[np.uint16], min_offset_m: float) -> FloatArray:
    """Offset of the strip of every point from the mean of all points, (n, 3) float64, metres; 0 where strips fit.

    `points` (n, 3) in metres, ascending by x, `strip` (n,) their flight lines. The offsets are 0 unless strips disagree
    by more than `min_offset_m`, root mean square of the elevations over the surfaces that both saw.
    """
    number, sizes = _numbered(strip)
    shifts = _shifts_m(np.ascontiguousarray(points), number, sizes, min_offset_m)
    return np.zeros((len(points), 3)) if shifts is None else shifts[number]


def _largest_m(shifts: FloatArray, sizes: IntArray, points: int) -> float:
    """The largest offset between two strips of so many points, metres, from their `_shifts_m`."""
    used = shifts if sizes.sum() < points else shifts[:-1]
    return math.sqrt(((used[:, None] - used) ** 2).sum(axis=2).max())


def disagreement_m(points: FloatArray, strip: npt.NDArray[np.uint16], min_offset_m: float) -> float:
    """The largest offset between two strips, metres; nan where they fit, or nothing shows that they do not.

    Arguments are those of `strip_offsets_m`.
    """
    number, sizes = _numbered(strip)
    shifts = _shifts_m(np.ascontiguousarray(points), number, sizes, min_offset_m)
    return math.nan if shifts is None else _largest_m(shifts, sizes, len(points))


def aligned_mm(
    xyz_mm: IntArray, strip: npt.NDArray[np.uint16], marked: BoolArray, min_offset_m: float
) -> tuple[IntArray, BoolArray, float]:
    """Points with their strips aligned, sorted by x, y and z; their marks; the largest offset between two strips.

    `xyz_mm` (n, 3) in canonical order, `strip` (n,) their flight lines, `marked` (n,) any marks, which follow the
    points. Every strip is moved to the mean of all points, so the building as a whole stays where the survey saw it.
    Where strips fit, or nothing shows that they do not, the points come back as they are, with nan metres.
    """
    number, sizes = _numbered(strip)
    if len(sizes) < 2:
        return xyz_mm, marked, math.nan
    shifts = _shifts_m((xyz_mm - xyz_mm[0]) / 1e3, number, sizes, min_offset_m)
    if shifts is None:
        return xyz_mm, marked, math.nan
    moved = xyz_mm - np.rint(shifts * 1e3).astype(np.int64)[number]
    largest_m = _largest_m(shifts, sizes, len(number))
    order = np.lexsort(moved.T[::-1])
    return moved[order], marked[order], largest_m
