"""How well the flight strips of a survey fit each other, at smooth places that two of them saw.

Squares of the lattice are small enough to be level ground or one roof plane. In each the planes of the last returns of
two strips are compared; rough squares, with trees, edges or cars, do not count. First the ids are the strips; then the
passes of each id, if its GPS times show several. Counts of whole centimetres add up over tiles and inputs: the outcome
depends on neither tiles, nor workers, nor order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import solve_plane_moments
from pipeline.kernels.sorting import counting_sort
from pipeline.model import BoolArray, ByteArray, FloatArray, IntArray, LabelArray
from pipeline.terrain.flight_passes import FIRST_PASS, SLICE_S, Strip, numbers_of
from pipeline.tiling import Window

_FEWEST = 5
"""Points of a strip that draw a plane in a square: two more than it needs."""
_MAX_APART_MM = 2000.0
"""Largest distance in plan between the middles of the points of two strips in a square."""
_MIXED_MM = 1000.0
"""Largest distance in plan between the middles of two surfaces that lie above one another throughout a square: where an
edge cuts a square, they are 1.9 m apart at least."""
_CLEAR = 1.0 / 3.0
"""Least share of the distance of two such surfaces in which no point lies."""

_CROSSED_S = 0.02
"""An aircraft takes longer to cross a square; times that vary by less say nothing."""

Rows = IntArray
"""(k, 4) int64: two strips by their numbers (`numbers_of`), the smaller one first; centimetres of the first over the
second; squares. Where both numbers are equal, the centimetres are those between two surfaces throughout squares that
this id saw alone: 0 where it saw one, `UNCLEAR` where the points show neither."""
UNCLEAR = -1
NO_ROWS: Rows = np.empty((0, 4), np.int64)


@kernel
def _compared(of: LabelArray, sums: FloatArray, owned: BoolArray) -> IntArray:
    """Rows (k, 3) of two strips and their difference in cm, of the squares that are owned, from `square_sums`."""
    rows = np.empty((max(1, len(of)), 3), np.int64)
    count = 0
    planes = np.empty((len(of), 5))
    smooth = np.empty(len(of), np.bool_)
    for k in range(len(of)):
        if sums[k, 0] < _FEWEST or not owned[of[k, 1]]:
            smooth[k] = False
            continue
        smooth[k], planes[k, 0], planes[k, 1], planes[k, 2], planes[k, 3], planes[k, 4] = plane_of(sums[k])
    for k in range(len(of)):
        j = k + 1
        while smooth[k] and j < len(of) and of[j, 1] == of[k, 1]:
            cm = above_cm(planes[k], planes[j], _MAX_APART_MM) if smooth[j] else MOST_CM + 1
            if abs(cm) <= MOST_CM:
                if count == len(rows):
                    grown = np.empty((2 * count, 3), np.int64)
                    grown[:count] = rows
                    rows = grown
                rows[count, 0], rows[count, 1], rows[count, 2] = of[k, 0], of[j, 0], cm
                count += 1
            j += 1
    return rows[:count].copy()


@kernel
def _surfaces_apart_cm(
    places: tuple[IntArray, IntArray, IntArray],
    used: BoolArray,
    members: LabelArray,
    lowest: int,
    middle: tuple[float, float, float, float, float],
) -> int:
    """Centimetres between two smooth surfaces that the used ones of a square's points lie on; `UNCLEAR` without these.

    `middle` are slopes and mean place of the plane of all of them, about the corner and the lowest point.
    """
    x, y, z = places
    a, b, mx, my, mz = middle
    sums = np.zeros((2, 10))
    highest_below, lowest_above = -np.inf, np.inf
    for i in members:
        if not used[i]:
            continue
        dx, dy, dz = float(x[i] % SQUARE_MM), float(y[i] % SQUARE_MM), float(z[i] - lowest)
        above = dz - mz - a * (dx - mx) - b * (dy - my)
        if above > 0.0:
            lowest_above = min(lowest_above, above)
            add_point(sums[1], dx, dy, dz)
        else:
            highest_below = max(highest_below, above)
            add_point(sums[0], dx, dy, dz)
    if min(sums[0, 0], sums[1, 0]) < _FEWEST:
        return UNCLEAR
    planes = np.empty((2, 5))
    for k in range(2):
        smooth, planes[k, 0], planes[k, 1], planes[k, 2], planes[k, 3], planes[k, 4] = plane_of(sums[k])
        if not smooth:
            return UNCLEAR
    cm = above_cm(planes[1], planes[0], _MIXED_MM)
    return cm if 0 < cm <= MOST_CM and lowest_above - highest_below >= 10.0 * _CLEAR * cm else UNCLEAR


@kernel
def _surfaces(
    places: tuple[IntArray, IntArray, IntArray],
    used: tuple[BoolArray, FloatArray],
    start: LabelArray,
    members: LabelArray,
    found: tuple[LabelArray, FloatArray, IntArray, BoolArray],
) -> IntArray:
    """Rows (k, 3) of the squares that one strip saw alone: its number twice, and cm between two surfaces.

    A place that was seen within a few seconds was seen by one pass: two surfaces there are not two strips. `used` are
    which points are used, and their times; `found` the outcomes of `square_sums`, and whether each square is owned.
    """
    of, sums, corner, owned = found
    last, time = used
    rows = np.empty((len(of), 3), np.int64)
    count = 0
    for k in range(len(of)):
        s = of[k, 1]
        alone = (k == 0 or of[k - 1, 1] != s) and (k + 1 == len(of) or of[k + 1, 1] != s)
        if not (alone and owned[s]) or sums[k, 0] < 2 * _FEWEST:
            continue
        smooth, a, b, mx, my, mz = plane_of(sums[k])
        rows[count, 0], rows[count, 1], rows[count, 2] = of[k, 0], of[k, 0], 0
        if not smooth:
            own = members[start[s] : start[s + 1]]
            early, late = np.inf, -np.inf
            for i in own:
                if last[i]:
                    early, late = min(early, time[i]), max(late, time[i])
            if not _CROSSED_S < late - early < SLICE_S:
                rows[count, 2] = _surfaces_apart_cm(places, last, own, corner[s, 2], (a, b, mx, my, mz))
        count += 1
    return rows[:count].copy()


def compared_strips(
    places_mm: tuple[IntArray, IntArray, IntArray],
    returns: tuple[ByteArray, ByteArray],
    strip: npt.NDArray[np.uint16],
    gps_time: FloatArray,
    core: Window | None,
    passes: Sequence[Strip] = (),
) -> Rows:
    """Differences of the strips of a tile, over the squares that it owns.

    Parameters
    ----------
    places_mm : three arrays (n,) int64
        x, y and z of the points of the core and of a square around it.
    returns : two arrays (n,)
        Number of the return, and returns of its pulse.
    strip : (n,) uint16
        `point_source_id`.
    gps_time : (n,) float64
        Seconds; all equal where they are unknown.
    core : Window or None
        A square belongs to the tile whose core holds its smallest point by x and y, whatever the tiles are. None takes
        all squares.
    passes : sequence of Strip
        Those of all ids that have several over all inputs (`passes_of`).
    """
    if len(strip) == 0:
        return NO_ROWS
    x, y, _ = places_mm
    square, squares = _squares(x, y)
    start, members = counting_sort(square, squares)
    last = returns[0] >= returns[1]

    def by(numbers: IntArray, *, is_alone: bool) -> Rows:
        # not by np.unique, which loads np.ma
        names = np.flatnonzero(np.bincount(numbers))
        place = np.zeros(int(names[-1]) + 1, np.int32)
        place[names] = np.arange(len(names))
        of, sums, corner = square_sums(places_mm, last, (place[numbers], len(names)), start, members)
        owned = np.ones(squares, np.bool_) if core is None else core.contains(corner[:, 0], corner[:, 1])
        found = _compared(of, sums, owned)
        if is_alone:
            alone = _surfaces(places_mm, (last, gps_time), start, members, (of, sums, corner, owned))
            found = np.concatenate((found, alone))
        found[:, :2] = names[found[:, :2]]
        return np.column_stack((found, np.ones(len(found), np.int64)))

    rows = by(strip.astype(np.int64), is_alone=True)
    number = numbers_of(strip, gps_time, passes)
    if (number != strip).any():
        timed = by(number, is_alone=False)
        rows = np.concatenate((rows, timed[timed[:, 1] >= FIRST_PASS]))
    return counted(rows)


def _squares(x_mm: IntArray, y_mm: IntArray) -> tuple[LabelArray, int]:
    """The square of each point, (n,) numbered from 0, and how many numbers there are."""
    column, row = x_mm // SQUARE_MM, y_mm // SQUARE_MM
    column, row = column - column.min(), row - row.min()
    rows = int(row.max()) + 1
    key, count = column * rows + row, (int(column.max()) + 1) * rows
    if count <= 4 * len(key):
        return key.astype(np.int32), count
    order = np.argsort(key, kind="stable")
    is_first = np.diff(key[order], prepend=-1) > 0
    number = np.empty(len(key), np.int32)
    number[order] = np.cumsum(is_first) - 1
    return number, int(np.count_nonzero(is_first))


def rows_of(stored: bytes) -> Rows:
    """Rows from their bytes, as they travel."""
    return np.frombuffer(stored, np.int64).reshape(-1, 4)


def counted(rows: Rows) -> Rows:
    """Rows with the counts of equal ones added up, in their order."""
    if len(rows) == 0:
        return NO_ROWS
    rows = rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]
    first = np.flatnonzero(np.append(True, (rows[1:, :3] != rows[:-1, :3]).any(axis=1)))
    return np.column_stack((rows[first, :3], np.add.reduceat(rows[:, 3], first)))


SQUARE_MM = 4000
"""Side of the squares. Not a setting: it holds a plane of sparse points, and is smaller than most roof planes."""


_ROUGHNESS_MM = 100.0
"""Largest standard deviation of a smooth square; that of planar windows (`roughness_m`)."""


_MAX_TURN = 0.25
"""Largest difference of slope, rise over run, of two planes of one surface."""


MOST_CM = 1000
"""Larger differences are those of two surfaces."""


@kernel(inline="always")
def add_point(sums: FloatArray, x: float, y: float, z: float) -> None:
    """Add a point to sums (10,) of 1, x, y, z, xx, xy, yy, xz, yz, zz."""
    sums[0] += 1.0
    sums[1] += x
    sums[2] += y
    sums[3] += z
    sums[4] += x * x
    sums[5] += x * y
    sums[6] += y * y
    sums[7] += x * z
    sums[8] += y * z
    sums[9] += z * z


@kernel
def square_sums(
    places: tuple[IntArray, IntArray, IntArray],
    used: BoolArray,
    strips: tuple[LabelArray, int],
    start: LabelArray,
    members: LabelArray,
) -> tuple[LabelArray, FloatArray, IntArray]:
    """Strip and square of each pair that a used point has, (m, 2), by square, then strip; sums of these, (m, 10).

    `places` are x, y, z (n,) in mm, `strips` numbers (n,) from 0 and how many there are; the points of square s are
    `members` from `start[s]` to `start[s + 1]`. Also the smallest point by x and y of each square and its lowest used
    one, (squares, 3), the former of all points. Sums are those of `add_point` about the square's corner and lowest
    point: whole numbers below 2^53.
    """
    x, y, z = places
    strip, strip_count = strips
    squares = len(start) - 1
    corner = np.full((squares, 3), 2**62)
    seen, place = np.full(strip_count, -1, np.int32), np.empty(strip_count, np.int64)
    names = np.empty(strip_count, np.int32)
    of, sums = np.empty((squares, 2), np.int32), np.zeros((squares, 10))
    count = 0
    for s in range(squares):
        own = members[start[s] : start[s + 1]]
        found = 0
        for i in own:
            if x[i] < corner[s, 0] or (x[i] == corner[s, 0] and y[i] < corner[s, 1]):
                corner[s, 0], corner[s, 1] = x[i], y[i]
            if not used[i]:
                continue
            corner[s, 2] = min(corner[s, 2], z[i])
            if seen[strip[i]] != s:
                seen[strip[i]] = s
                names[found] = strip[i]
                found += 1
        if count + found > len(of):
            grown_of, grown = np.empty((2 * len(of) + found, 2), np.int32), np.zeros((2 * len(of) + found, 10))
            grown_of[:count], grown[:count] = of[:count], sums[:count]
            of, sums = grown_of, grown
        if found > 1:
            names[:found] = np.sort(names[:found])
        for k in range(found):
            of[count, 0], of[count, 1] = names[k], s
            place[names[k]] = count
            count += 1
        for i in own:
            if used[i]:
                dx, dy, dz = float(x[i] % SQUARE_MM), float(y[i] % SQUARE_MM), float(z[i] - corner[s, 2])
                add_point(sums[place[strip[i]]], dx, dy, dz)
    return of[:count].copy(), sums[:count].copy(), corner


@kernel
def plane_of(sums: FloatArray) -> tuple[bool, float, float, float, float, float]:
    """Whether the points of some sums (10,) are smooth; slopes a and b of their plane, and their mean place, mm."""
    n = sums[0]
    mx, my, mz = sums[1] / n, sums[2] / n, sums[3] / n
    xx, xy, yy = sums[4] / n - mx * mx, sums[5] / n - mx * my, sums[6] / n - my * my
    xz, yz, zz = sums[7] / n - mx * mz, sums[8] / n - my * mz, sums[9] / n - mz * mz
    a, b = solve_plane_moments(xx, xy, yy, xz, yz)
    # points along a line draw no plane
    spread = xx * yy - xy * xy > 1e-2 * xx * yy
    return spread and zz - a * xz - b * yz <= _ROUGHNESS_MM**2, a, b, mx, my, mz


@kernel(inline="always")
def above_cm(p: FloatArray, q: FloatArray, max_apart_mm: float) -> int:
    """Centimetres of one plane over another, of slopes a, b and mean place (5,), halfway between their middles.

    More than `MOST_CM` if they are not two views of one surface.
    """
    if math.hypot(p[2] - q[2], p[3] - q[3]) > max_apart_mm or math.hypot(p[0] - q[0], p[1] - q[1]) > _MAX_TURN:
        return MOST_CM + 1
    x, y = 0.5 * (p[2] + q[2]), 0.5 * (p[3] + q[3])
    first = p[4] + p[0] * (x - p[2]) + p[1] * (y - p[3])
    second = q[4] + q[0] * (x - q[2]) + q[1] * (y - q[3])
    return int(np.rint((first - second) / 10.0))
