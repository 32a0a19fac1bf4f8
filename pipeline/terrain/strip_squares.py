"""Fits a plane per strip in squares of the lattice, small enough to be level ground or one roof plane."""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import solve_plane_moments
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray

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
