"""Planes z = a x + b y + c by least squares: moments about the mean, and the centred normal equations.

Sums run in the order of the points, one after the other, and not through BLAS: the result has the same bits on every
machine. Equations are those of Shorter & Kasparis.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray, LabelArray


class Moments(NamedTuple):
    """Mean of some points, metres, and sums of products of coordinates relative to it, square metres."""

    x: float
    y: float
    z: float
    xx: float
    xy: float
    yy: float
    xz: float
    yz: float


@kernel
def moments_of(points: FloatArray, index: LabelArray) -> Moments:
    """Moments of the points (n, 3) float64 with the numbers `index` (k,) int32, at least one."""
    k = len(index)
    mean_x, mean_y, mean_z = 0.0, 0.0, 0.0
    for i in index:
        mean_x += points[i, 0]
        mean_y += points[i, 1]
        mean_z += points[i, 2]
    mean_x /= k
    mean_y /= k
    mean_z /= k
    xx, xy, yy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in index:
        x, y, z = points[i, 0] - mean_x, points[i, 1] - mean_y, points[i, 2] - mean_z
        xx += x * x
        xy += x * y
        yy += y * y
        xz += x * z
        yz += y * z
    return Moments(mean_x, mean_y, mean_z, xx, xy, yy, xz, yz)


@kernel(inline="always")
def add_to_sums(sums: FloatArray | IntArray, x: float, y: float, z: float | np.int64) -> None:
    """Add one point to the first nine sums, in place: of 1, x, y, z, xx, xy, yy, xz, yz."""
    sums[0] += 1
    sums[1] += x
    sums[2] += y
    sums[3] += z
    sums[4] += x * x
    sums[5] += x * y
    sums[6] += y * y
    sums[7] += x * z
    sums[8] += y * z


@kernel
def solve_plane_moments(sxx: float, sxy: float, syy: float, sxz: float, syz: float) -> tuple[float, float]:
    """The slopes a, b that solve the centred normal equations (Eqs. 11 to 14).

    Arguments are sums of products of coordinates relative to their means. Where the points are collinear in plan, to
    1e-6 of their spread, the plane is undetermined across the line: it is taken level across, and sloping along the
    line. Where all are at one position it is horizontal.
    """
    determinant = sxx * syy - sxy * sxy
    trace = sxx + syy
    if trace <= 0.0:
        return 0.0, 0.0
    if determinant > 1e-12 * trace * trace:
        return (sxz * syy - syz * sxy) / determinant, (syz * sxx - sxz * sxy) / determinant
    # of rank one: the gradient lies along the line, whose direction is the larger row of the moments
    if sxx >= syy:
        along = sxz / (sxx * sxx + sxy * sxy)
        return along * sxx, along * sxy
    along = syz / (syy * syy + sxy * sxy)
    return along * sxy, along * syy


@kernel
def smallest_eigenvalue(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> float:
    """Smallest eigenvalue of a symmetric 3 x 3 matrix (trigonometric form, Smith 1961)."""
    q = (xx + yy + zz) / 3.0
    off = xy * xy + xz * xz + yz * yz
    p2 = (xx - q) ** 2 + (yy - q) ** 2 + (zz - q) ** 2 + 2.0 * off
    if p2 <= 1e-30:
        return q
    p = math.sqrt(p2 / 6.0)
    a, b, c = (xx - q) / p, (yy - q) / p, (zz - q) / p
    d, e, f = xy / p, xz / p, yz / p
    half_det = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / 2.0
    half_det = min(1.0, max(-1.0, half_det))
    return max(0.0, q + 2.0 * p * math.cos(math.acos(half_det) / 3.0 + 2.0 * math.pi / 3.0))
