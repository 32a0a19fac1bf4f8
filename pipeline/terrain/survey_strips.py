"""How flight strips of a survey fit each other, by the smooth places that two of them saw.

Squares of the lattice are small enough to be level ground or one roof plane. In each the plane of the last returns of
one strip is compared with that of another; rough squares, with trees, edges or cars, do not count. Counts of whole
centimetres add up over tiles and inputs: the outcome depends on neither tiles, nor workers, nor order. Strips that
differ by more than houses bear are moved, as whole strips, to their common mean.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import solve_plane_moments
from pipeline.kernels.union_find import united
from pipeline.model import BoolArray, ByteArray, FloatArray, IntArray, LabelArray
from pipeline.terrain.settings import StripSettings
from pipeline.tiling import Window

SQUARE_MM = 4000
"""Side of the squares. Not a setting: it holds a plane of sparse points, and is smaller than most roof planes."""
_FEWEST = 5
"""Points of a strip that draw a plane in a square: two more than it needs."""
_ROUGHNESS_MM = 100.0
"""Largest standard deviation of a smooth square; that of planar windows (`roughness_m`)."""
_MAX_TURN = 0.25
"""Largest difference of slope, rise over run, of two planes of one surface."""
_MAX_APART_MM = 2000.0
"""Largest distance in plan between the middles of the points of two strips in a square."""
_MOST_CM = 1000
"""Larger differences are those of two surfaces."""
_FEW_SQUARES = 12
"""Fewest squares that show an offset of two strips."""
_FEW_TO_MOVE = 30
"""Fewest squares by which whole strips are moved: those of one roof may lie apart for a reason of its own."""
_MOST_NAMED = 5
"""Pairs of strips that a warning names; it counts the others."""
_QUARTERS = (0.25, 0.5, 0.75)
"""Shares of the squares at which differences are read: a fault that only some squares show, such as a tide or a field
that grew between two flights, is not one of the strips; one that drifts or tilts a strip shows in the quartiles."""

Rows = IntArray
"""(k, 4) int64: two strips, the first with the smaller number; centimetres of the first over the second; squares."""
NO_ROWS: Rows = np.empty((0, 4), np.int64)


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class StripOffset:
    """Two strips that do not fit."""

    first: int
    """The strip (`point_source_id`) with the smaller number."""
    second: int
    """The other one."""
    offset_m: float
    """How far the first lies above the second, metres: the median over the squares."""
    low_m: float
    """The lower quartile."""
    high_m: float
    """The upper quartile."""
    squares: int
    """Squares that both saw."""

    def __str__(self) -> str:
        """In words."""
        seen = f"({self.squares} places)"
        if self.high_m - self.low_m > 0.1:
            low, high = f"{self.low_m:+.2f}", f"{self.high_m:+.2f}"
            return f"strip {self.first} lies {low} to {high} m above strip {self.second} {seen}"
        side = "above" if self.offset_m > 0.0 else "below"
        return f"strip {self.first} lies {abs(self.offset_m):.2f} m {side} strip {self.second} {seen}"


@kernel
def _square_sums(
    places: tuple[IntArray, IntArray, IntArray],
    used: BoolArray,
    square: IntArray,
    strip: LabelArray,
    counts: tuple[int, int],
) -> tuple[LabelArray, FloatArray, IntArray]:
    """Strip and square of each pair that a used point has, (m, 2); sums of these points, (m, 10).

    `places` are x, y, z (n,) in mm; `square` and `strip` (n,) numbers from 0, and `counts` how many there are of each.
    Also the smallest point by x and y of each square, (squares, 2), of all points. Sums are of 1, x, y, z, xx, xy, yy,
    xz, yz, zz about the square's corner and lowest point: whole numbers below 2^53.
    """
    x, y, z = places
    squares, strips = counts
    lowest = np.full(squares, 2**62)
    smallest = np.full((squares, 2), 2**62)
    number = np.full(squares * strips, -1, np.int32)
    count = 0
    for i in range(x.size):
        s = square[i]
        if x[i] < smallest[s, 0] or (x[i] == smallest[s, 0] and y[i] < smallest[s, 1]):
            smallest[s, 0], smallest[s, 1] = x[i], y[i]
        if not used[i]:
            continue
        lowest[s] = min(lowest[s], z[i])
        if number[s * strips + strip[i]] < 0:
            number[s * strips + strip[i]] = count
            count += 1
    sums = np.zeros((count, 10))
    of = np.empty((count, 2), np.int32)
    for i in range(x.size):
        if not used[i]:
            continue
        s = square[i]
        m = number[s * strips + strip[i]]
        of[m, 0], of[m, 1] = strip[i], s
        dx, dy, dz = float(x[i] % SQUARE_MM), float(y[i] % SQUARE_MM), float(z[i] - lowest[s])
        sums[m, 0] += 1.0
        sums[m, 1] += dx
        sums[m, 2] += dy
        sums[m, 3] += dz
        sums[m, 4] += dx * dx
        sums[m, 5] += dx * dy
        sums[m, 6] += dy * dy
        sums[m, 7] += dx * dz
        sums[m, 8] += dy * dz
        sums[m, 9] += dz * dz
    return of, sums, smallest


@kernel
def _plane(sums: FloatArray) -> tuple[bool, float, float, float, float, float]:
    """Whether the points of some sums (10,) are smooth; slopes a and b of their plane, and their mean place, mm."""
    n = sums[0]
    mx, my, mz = sums[1] / n, sums[2] / n, sums[3] / n
    xx, xy, yy = sums[4] / n - mx * mx, sums[5] / n - mx * my, sums[6] / n - my * my
    xz, yz, zz = sums[7] / n - mx * mz, sums[8] / n - my * mz, sums[9] / n - mz * mz
    a, b = solve_plane_moments(xx, xy, yy, xz, yz)
    # points along a line draw no plane
    spread = xx * yy - xy * xy > 1e-2 * xx * yy
    return spread and zz - a * xz - b * yz <= _ROUGHNESS_MM**2, a, b, mx, my, mz


@kernel
def _compared(of: LabelArray, sums: FloatArray, order: IntArray, owned: BoolArray) -> IntArray:
    """Rows (k, 3) of two strips and their difference in cm, of the squares that are owned.

    `order` (m,) sorts the sums by square, then by strip.
    """
    rows = np.empty((max(1, len(order)), 3), np.int64)
    count = 0
    planes = np.empty((len(order), 5))
    smooth = np.empty(len(order), np.bool_)
    for k in range(len(order)):
        if sums[order[k], 0] < _FEWEST or not owned[of[order[k], 1]]:
            smooth[k] = False
            continue
        smooth[k], planes[k, 0], planes[k, 1], planes[k, 2], planes[k, 3], planes[k, 4] = _plane(sums[order[k]])
    for k in range(len(order)):
        j = k + 1
        while smooth[k] and j < len(order) and of[order[j], 1] == of[order[k], 1]:
            p, q = planes[k], planes[j]
            apart = math.hypot(p[2] - q[2], p[3] - q[3])
            if smooth[j] and apart <= _MAX_APART_MM and math.hypot(p[0] - q[0], p[1] - q[1]) <= _MAX_TURN:
                x, y = 0.5 * (p[2] + q[2]), 0.5 * (p[3] + q[3])
                first = p[4] + p[0] * (x - p[2]) + p[1] * (y - p[3])
                second = q[4] + q[0] * (x - q[2]) + q[1] * (y - q[3])
                cm = int(np.rint((first - second) / 10.0))
                if abs(cm) <= _MOST_CM:
                    if count == len(rows):
                        grown = np.empty((2 * count, 3), np.int64)
                        grown[:count] = rows
                        rows = grown
                    rows[count, 0], rows[count, 1], rows[count, 2] = of[order[k], 0], of[order[j], 0], cm
                    count += 1
            j += 1
    return rows[:count].copy()


def compared_strips(
    places_mm: tuple[IntArray, IntArray, IntArray],
    returns: tuple[ByteArray, ByteArray],
    strip: npt.NDArray[np.uint16],
    core: Window | None,
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
    core : Window or None
        A square belongs to the tile whose core holds its smallest point by x and y, whatever the tiles are. None takes
        all squares.
    """
    if len(strip) == 0 or (strip == strip[0]).all():
        return NO_ROWS
    x, y, _ = places_mm
    # not by np.unique, which loads np.ma
    names = np.flatnonzero(np.bincount(strip))
    number = np.zeros(int(names[-1]) + 1, np.int32)
    number[names] = np.arange(len(names))
    square, squares = _squares(x, y)
    last, of_strip = returns[0] >= returns[1], number[strip]
    of, sums, smallest = _square_sums(places_mm, last, square, of_strip, (squares, len(names)))
    owned = np.ones(squares, np.bool_) if core is None else core.contains(smallest[:, 0], smallest[:, 1])
    order = np.lexsort((of[:, 0], of[:, 1])).astype(np.int64)
    found = _compared(of, sums, order, owned)
    found[:, :2] = names[found[:, :2]]
    return counted(np.column_stack((found, np.ones(len(found), np.int64))))


def _squares(x_mm: IntArray, y_mm: IntArray) -> tuple[IntArray, int]:
    """The square of each point, (n,) numbered from 0, and how many numbers there are."""
    column, row = x_mm // SQUARE_MM, y_mm // SQUARE_MM
    column, row = column - column.min(), row - row.min()
    rows = int(row.max()) + 1
    key, count = column * rows + row, (int(column.max()) + 1) * rows
    if count <= 4 * len(key):
        return key, count
    order = np.argsort(key, kind="stable")
    is_first = np.diff(key[order], prepend=-1) > 0
    number = np.empty(len(key), np.int64)
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


def _all_pairs(parts: Iterable[Rows]) -> list[StripOffset]:
    """All pairs of strips that some square compares."""
    rows = counted(np.concatenate([NO_ROWS, *parts]))
    found = []
    for first, second in dict.fromkeys(map(tuple, rows[:, :2].tolist())):
        own = rows[(rows[:, 0] == first) & (rows[:, 1] == second)]
        total = np.cumsum(own[:, 3])
        squares = int(total[-1])
        # whole squares: the lower one of two in the middle
        low, middle, high = (float(own[np.searchsorted(total, share * squares), 2]) / 100.0 for share in _QUARTERS)
        found.append(StripOffset(first=first, second=second, offset_m=middle, low_m=low, high_m=high, squares=squares))
    return found


def offsets_of(parts: Iterable[Rows], settings: StripSettings) -> list[StripOffset]:
    """Pairs of strips that differ by more than `warn_m` at a quarter of the squares, the largest offset first.

    `parts` are the rows of all tiles.
    """
    found = [
        pair
        for pair in _all_pairs(parts)
        if pair.squares >= _FEW_SQUARES and max(-pair.low_m, pair.high_m) > settings.warn_m
    ]
    return sorted(found, key=lambda pair: (-max(-pair.low_m, pair.high_m), pair.first, pair.second))


def strips_warning(apart: Sequence[StripOffset], moves_mm: Mapping[int, int]) -> str:
    """What does not fit and what a run does about it, for people; `apart` is not empty."""
    named = "; ".join(map(str, apart[:_MOST_NAMED]))
    if len(apart) > _MOST_NAMED:
        named += f"; and {len(apart) - _MOST_NAMED} pairs more"
    if not moves_mm:
        return f"flight strips do not fit: {named}. Buildings that two strips saw are aligned one by one"
    moved = ", ".join(f"{strip} by {move / 1000.0:+.2f} m" for strip, move in sorted(moves_mm.items()))
    return f"flight strips do not fit: {named}. They are moved to their common mean: strip {moved}"


def moves_of(parts: Sequence[Rows], settings: StripSettings) -> dict[int, int]:
    """By how many millimetres each strip is moved up; empty where all strips fit.

    Strips that differ by no more than `align_m` keep their places to each other. The others are fitted by least squares
    over the squares that they share, so that the mean of all places that strips were compared at stays.
    """
    pairs = _all_pairs(parts)
    apart = [p for p in pairs if abs(p.offset_m) > settings.align_m and p.squares >= _FEW_TO_MOVE]
    if not apart:
        return {}
    index = {strip: k for k, strip in enumerate(sorted({strip for p in pairs for strip in (p.first, p.second)}))}
    close = [(index[p.first], index[p.second]) for p in pairs if abs(p.offset_m) <= settings.align_m]
    fit = np.array(close, np.int64).reshape(-1, 2)
    group = united(len(index), fit[:, 0], fit[:, 1])
    weight = np.zeros(len(index))
    for p in pairs:
        for strip in (p.first, p.second):
            weight[group[index[strip]]] += p.squares
    level = _levels(group, [(index[p.first], index[p.second], p.offset_m, p.squares) for p in apart], weight)
    moves = {strip: round(-100.0 * level[int(group[k])]) * 10 for strip, k in index.items()}
    return {strip: move for strip, move in moves.items() if move}


def _levels(group: IntArray, pairs: Sequence[tuple[int, int, float, int]], weight: FloatArray) -> Mapping[int, float]:
    """Height of each group of strips above the mean of those it is compared with, metres.

    `pairs` are two strips, how far the first lies above the second, and the squares. Gauss and Seidel's iteration: few
    groups, added up in a fixed order.
    """
    roots = sorted({int(group[k]) for pair in pairs for k in pair[:2]})
    level = dict.fromkeys(map(int, group), 0.0)
    edges = [(int(group[a]), int(group[b]), offset, n) for a, b, offset, n in pairs if group[a] != group[b]]
    for _ in range(_ROUNDS):
        for root in roots:
            total = sum(n for a, b, _, n in edges if root in {a, b})
            if total:
                own = sum(n * (level[b] + o if root == a else level[a] - o) for a, b, o, n in edges if root in {a, b})
                level[root] = own / total
    part = united(len(group), np.array([a for a, *_ in edges], np.int64), np.array([e[1] for e in edges], np.int64))
    for piece in {int(part[root]) for root in roots}:
        members = [root for root in roots if int(part[root]) == piece]
        mean = sum(weight[root] * level[root] for root in members) / sum(weight[root] for root in members)
        for root in members:
            level[root] -= mean
    return level


_ROUNDS = 500
"""Rounds of the iteration: far more than a chain of strips across a city needs to a centimetre."""
