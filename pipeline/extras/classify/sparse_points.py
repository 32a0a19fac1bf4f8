"""The chance that a point of a sparse survey is building, from its surroundings within 10 m.

With two points per square metre or fewer, no single surface shows where a roof ends and a tree begins. Several weak
signs do so together: pulses that go on, the share of the surroundings on the point's level, and the distance and share
of candidates. A logistic regression weighs them. `benchmarks/sparse_points.py` of commit 01fb6cec fitted the weights;
docs/methods/scene.md names the places, and the scores on places left out of the fit.

All counts are whole numbers, and each point's terms are computed alone: the chance does not depend on tiles or order.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import smallest_eigenvalue
from pipeline.model import BoolArray, FloatArray, IntArray, KindArray
from pipeline.spatial_hash import points_by_cell

# Not settings: the weights below belong to them.
NEAR_MM, AROUND_MM, FAR_MM = 3000, 6000, 10_000
"""Radii of the three discs: 3, 10 and 30 points at 0.1 points/m2, or 1.5, 3 and 5 spacings at 0.3 points/m2."""
LEVEL_MM = 500
"""What lies this near in elevation is on a point's level, as roofs between points some metres apart are."""
MIN_HEIGHT_MM, TYPICAL_HEIGHT_MM, MAX_HEIGHT_MM = 500, 4000.0, 40_000
"""Heights are limited to this range and taken as multiples of a typical one."""
MAX_UNDER_MM = 10_000
"""Points farther than this below a candidate's point count as this far below it."""
BAND_MM = 1500
"""What lies this near in elevation may belong to the same pitched roof or crown; its thickness is measured."""
HELD_CLEAR_MM = 6500
"""Candidates farther away than this do not count as near."""
MAX_THICKNESS_M = 0.6
"""Bands that are thicker are crowns, whatever their thickness."""
UNKNOWN_THICKNESS_M = 0.1
"""Thickness where fewer than four points lie in the band: between that of roofs and of crowns."""
FEWEST_IN_BAND = 4
"""Points from which a band has a thickness: one more than a plane needs."""


class Role(IntEnum):
    """What a point is to its neighbours."""

    NOISE = -1
    GROUND = 0
    OTHER = 1
    """Above the ground."""
    HELD = 2
    """In a candidate."""


class Sign(IntEnum):
    """What is measured of a point and its surroundings; columns of the first terms."""

    HELD_SHARE = 0
    """Share of candidates in what stands within 6 m."""
    PIERCED_AROUND = 1
    """Share of points from pulses of several returns in what stands within 6 m."""
    PIERCED_NEAR = 2
    """The same within 3 m."""
    PIERCED_HELD = 3
    """The same among the candidates within 10 m."""
    PIERCED = 4
    """Whether the point is one."""
    LOG_HELD_NEAR = 5
    """Candidates' points within 3 m, as log(1 + n)."""
    LOG_LEVEL = 6
    """Points on the level within 6 m, as log(1 + n)."""
    LOG_HELD_LEVEL = 7
    """Those of candidates."""
    LEVEL_SHARE = 8
    """Share of points on the level in what stands within 6 m."""
    LOG_HEIGHT = 9
    """log(height / 4 m), from 0.5 m to 40 m."""
    LOG_HEIGHT_2 = 10
    """Its square: cars and hedges are lower than roofs, trees are higher."""
    LOG_DENSITY = 11
    """Log of the points per m2 within 10 m."""
    STANDING_SHARE = 12
    """Share of points above the ground within 10 m."""
    GROUND_SHARE = 13
    """Share of ground within 3 m."""
    THICKNESS_NEAR = 14
    """Standard deviation across the plane through the band within 3 m, metres."""
    UNDER = 15
    """How far the point lies below the highest candidate's point within 3 m, up to 10 m: walls do."""
    HELD = 16
    """Whether the point is in a candidate."""
    SIZE = 17
    """Candidates' points within 10 m, as log(1 + n)."""
    AWAY = 18
    """Metres to the nearest candidate's point, up to 6.5."""
    THICKNESS_AROUND = 19
    """The thickness of the band within 6 m."""


CHANCE_LOGIT = 1.556
"""Logit of the chance where all terms are zero."""
SIGN_WEIGHTS = {
    Sign.HELD_SHARE: -1.578,
    Sign.PIERCED_AROUND: -3.896,
    Sign.PIERCED_NEAR: -4.308,
    Sign.PIERCED_HELD: -0.825,
    Sign.PIERCED: -1.021,
    Sign.LOG_HELD_NEAR: -0.938,
    Sign.LOG_LEVEL: -0.164,
    Sign.LOG_HELD_LEVEL: 0.501,
    Sign.LEVEL_SHARE: 1.853,
    Sign.LOG_HEIGHT: 1.903,
    Sign.LOG_HEIGHT_2: -1.318,
    Sign.LOG_DENSITY: 1.421,
    Sign.STANDING_SHARE: 11.852,
    Sign.GROUND_SHARE: -1.340,
    Sign.THICKNESS_NEAR: -7.140,
    Sign.UNDER: 0.159,
    Sign.HELD: -0.277,
    Sign.SIZE: -0.154,
    Sign.AWAY: 0.037,
    Sign.THICKNESS_AROUND: -1.148,
}
"""Weights of the signs, all of them in the order of `Sign`."""
PRODUCT_WEIGHTS = {
    (Sign.LOG_HEIGHT, Sign.HELD_SHARE): 0.812,
    (Sign.LOG_HEIGHT, Sign.PIERCED_AROUND): -3.085,
    (Sign.LOG_HEIGHT, Sign.PIERCED_NEAR): -1.378,
    (Sign.LOG_HEIGHT, Sign.LOG_DENSITY): 0.431,
    (Sign.LOG_HEIGHT_2, Sign.LOG_HELD_NEAR): 0.370,
    (Sign.LOG_DENSITY, Sign.THICKNESS_NEAR): -0.206,
    (Sign.LOG_DENSITY, Sign.SIZE): -0.385,
    (Sign.LOG_DENSITY, Sign.PIERCED_AROUND): 0.690,
    (Sign.LOG_DENSITY, Sign.PIERCED_NEAR): -1.693,
    (Sign.LOG_DENSITY, Sign.STANDING_SHARE): 1.222,
    (Sign.AWAY, Sign.SIZE): -0.149,
    (Sign.AWAY, Sign.PIERCED_AROUND): 0.106,
    (Sign.AWAY, Sign.HELD): 0.516,
    (Sign.SIZE, Sign.PIERCED_AROUND): 1.295,
    (Sign.SIZE, Sign.THICKNESS_AROUND): 0.023,
    (Sign.SIZE, Sign.LOG_HELD_NEAR): 0.174,
    (Sign.HELD_SHARE, Sign.PIERCED_HELD): -6.164,
    (Sign.HELD_SHARE, Sign.HELD_SHARE): 2.336,
    (Sign.STANDING_SHARE, Sign.PIERCED_AROUND): -3.479,
    (Sign.STANDING_SHARE, Sign.STANDING_SHARE): -5.655,
    (Sign.THICKNESS_NEAR, Sign.THICKNESS_NEAR): 8.021,
}
"""Weights of products of two signs. A sign says less or more beside another one: leaves of a tree over a roof."""


class _Count(IntEnum):
    """Columns of what is counted around one point."""

    ALL_FAR = 0
    STANDING_FAR = 1
    HELD_FAR = 2
    PIERCED_HELD_FAR = 3
    STANDING_AROUND = 4
    HELD_AROUND = 5
    PIERCED_AROUND = 6
    LEVEL_AROUND = 7
    HELD_LEVEL_AROUND = 8
    ALL_NEAR = 9
    GROUND_NEAR = 10
    STANDING_NEAR = 11
    HELD_NEAR = 12
    PIERCED_NEAR = 13
    TOP_NEAR = 14
    """Rise in mm to the highest candidate's point; 0 where there is none."""
    NEAREST = 15
    """Squared distance to the nearest candidate's point, mm2."""


LEAST_CHANCE = 0.42
"""Chance from which a point is building. The IoU of a whole is largest where points count from IoU / (1 + IoU) on:
0.42 to 0.45 at an IoU of 0.72 to 0.82, which the sparsest surveys reach."""
_LEAST_LOGIT = math.log(LEAST_CHANCE / (1.0 - LEAST_CHANCE))
_WEIGHTS = np.array((*SIGN_WEIGHTS.values(), *PRODUCT_WEIGHTS.values()))
_PAIRS = np.array(tuple(PRODUCT_WEIGHTS), np.int64)
_SIGNS, _TERMS, _COUNTS = len(SIGN_WEIGHTS), len(_WEIGHTS), len(_Count)


class SparsePoints(NamedTuple):
    """Points of a window; arrays of one length n."""

    x_mm: IntArray
    y_mm: IntArray
    z_mm: IntArray
    height_mm: IntArray
    """Height above the terrain."""
    role: KindArray
    """`Role`."""
    several: BoolArray
    """The pulse has several returns."""


@kernel(inline="always")
def _add_moments(s: IntArray, dx: int, dy: int, dz: int) -> None:
    """Add a point to a count and its moments of first and second order."""
    s[0] += 1
    s[1] += dx
    s[2] += dy
    s[3] += dz
    s[4] += dx * dx
    s[5] += dx * dy
    s[6] += dx * dz
    s[7] += dy * dy
    s[8] += dy * dz
    s[9] += dz * dz


@kernel(inline="always")
def _count_neighbour(
    points: SparsePoints, i: int, j: int, count: IntArray, band_around: IntArray, band_near: IntArray
) -> None:
    """Add point j to what lies around point i."""
    role = points.role[j]
    dx, dy = points.x_mm[j] - points.x_mm[i], points.y_mm[j] - points.y_mm[i]
    away = dx * dx + dy * dy
    if j == i or role < 0 or away > FAR_MM * FAR_MM:
        return
    stands, held, several = role > 0, role == Role.HELD, role > 0 and points.several[j]
    around, near = away <= AROUND_MM * AROUND_MM, away <= NEAR_MM * NEAR_MM
    dz = points.z_mm[j] - points.z_mm[i]
    level = around and stands and abs(dz) <= LEVEL_MM
    count[_Count.ALL_FAR] += 1
    count[_Count.STANDING_FAR] += stands
    count[_Count.HELD_FAR] += held
    count[_Count.PIERCED_HELD_FAR] += several and held
    count[_Count.STANDING_AROUND] += around and stands
    count[_Count.HELD_AROUND] += around and held
    count[_Count.PIERCED_AROUND] += around and several
    count[_Count.LEVEL_AROUND] += level
    count[_Count.HELD_LEVEL_AROUND] += level and held
    count[_Count.ALL_NEAR] += near
    count[_Count.GROUND_NEAR] += near and not stands
    count[_Count.STANDING_NEAR] += near and stands
    count[_Count.HELD_NEAR] += near and held
    count[_Count.PIERCED_NEAR] += near and several
    if held and around:
        count[_Count.NEAREST] = min(count[_Count.NEAREST], away)
        if near:
            count[_Count.TOP_NEAR] = max(count[_Count.TOP_NEAR], dz)
    if stands and abs(dz) <= BAND_MM:
        if around:
            _add_moments(band_around, dx, dy, dz)
        if near:
            _add_moments(band_near, dx, dy, dz)


@kernel
def _thickness_m(s: IntArray) -> float:
    """Standard deviation across the plane that fits a band best, metres, at most `MAX_THICKNESS_M`."""
    n = s[0]
    if n < FEWEST_IN_BAND:
        return UNKNOWN_THICKNESS_M
    mx, my, mz = s[1] / n, s[2] / n, s[3] / n
    across = smallest_eigenvalue(
        s[4] / n - mx * mx,
        s[5] / n - mx * my,
        s[6] / n - mx * mz,
        s[7] / n - my * my,
        s[8] / n - my * mz,
        s[9] / n - mz * mz,
    )
    return min(math.sqrt(across) / 1000.0, MAX_THICKNESS_M)


@kernel
def _weigh(
    count: IntArray, held: bool, several: bool, height_mm: int, thick: tuple[float, float], t: FloatArray
) -> None:
    """The terms of one point, from what lies around it, and the thickness of the bands within 3 m and 6 m."""
    standing = max(count[_Count.STANDING_AROUND], 1)
    height = math.log(min(max(height_mm, MIN_HEIGHT_MM), MAX_HEIGHT_MM) / TYPICAL_HEIGHT_MM)
    t[Sign.HELD_SHARE] = count[_Count.HELD_AROUND] / standing
    t[Sign.PIERCED_AROUND] = count[_Count.PIERCED_AROUND] / standing
    t[Sign.PIERCED_NEAR] = count[_Count.PIERCED_NEAR] / max(count[_Count.STANDING_NEAR], 1)
    t[Sign.PIERCED_HELD] = count[_Count.PIERCED_HELD_FAR] / max(count[_Count.HELD_FAR], 1)
    t[Sign.PIERCED] = several
    t[Sign.LOG_HELD_NEAR] = math.log(1.0 + count[_Count.HELD_NEAR])
    t[Sign.LOG_LEVEL] = math.log(1.0 + count[_Count.LEVEL_AROUND])
    t[Sign.LOG_HELD_LEVEL] = math.log(1.0 + count[_Count.HELD_LEVEL_AROUND])
    t[Sign.LEVEL_SHARE] = count[_Count.LEVEL_AROUND] / standing
    t[Sign.LOG_HEIGHT] = height
    t[Sign.LOG_HEIGHT_2] = height * height
    t[Sign.LOG_DENSITY] = math.log((count[_Count.ALL_FAR] + 1) / (math.pi * FAR_MM * FAR_MM / 1e6))
    t[Sign.STANDING_SHARE] = count[_Count.STANDING_FAR] / max(count[_Count.ALL_FAR], 1)
    t[Sign.GROUND_SHARE] = count[_Count.GROUND_NEAR] / max(count[_Count.ALL_NEAR], 1)
    t[Sign.THICKNESS_NEAR] = thick[0]
    t[Sign.UNDER] = min(count[_Count.TOP_NEAR], MAX_UNDER_MM) / 1000.0
    t[Sign.HELD] = held
    t[Sign.SIZE] = math.log(1.0 + count[_Count.HELD_FAR])
    t[Sign.AWAY] = min(math.sqrt(float(count[_Count.NEAREST])), HELD_CLEAR_MM) / 1000.0
    t[Sign.THICKNESS_AROUND] = thick[1]
    for k in range(_PAIRS.shape[0]):
        t[_SIGNS + k] = t[_PAIRS[k, 0]] * t[_PAIRS[k, 1]]


@kernel
def terms_of(points: SparsePoints, wanted: BoolArray) -> FloatArray:
    """Terms (n, T) of the wanted points, the signs and then the products; zeros for others."""
    x, y = points.x_mm, points.y_mm
    n = x.size
    out = np.zeros((n, _TERMS))
    if n == 0:
        return out
    start, members, column0, row0, columns, rows = points_by_cell(x, y, points.role >= 0, FAR_MM)
    count, around, near = np.zeros(_COUNTS, np.int64), np.zeros(10, np.int64), np.zeros(10, np.int64)
    for i in range(n):
        if not wanted[i]:
            continue
        count[:], around[:], near[:] = 0, 0, 0
        count[_Count.NEAREST] = FAR_MM * FAR_MM
        _add_moments(around, 0, 0, 0)
        _add_moments(near, 0, 0, 0)
        c, r = x[i] // FAR_MM - column0, y[i] // FAR_MM - row0
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for cc in range(max(c - 1, 0), min(c + 2, columns)):
                for m in range(start[rr * columns + cc], start[rr * columns + cc + 1]):
                    _count_neighbour(points, i, members[m], count, around, near)
        held, several = points.role[i] == Role.HELD, points.several[i]
        thick = (_thickness_m(near), _thickness_m(around))
        _weigh(count, held, several, points.height_mm[i], thick, out[i])
    return out


@kernel
def _logits(terms: FloatArray) -> FloatArray:
    """Weighted sums (n,) of terms (n, T), each in the order of the terms."""
    out = np.full(terms.shape[0], CHANCE_LOGIT)
    for i in range(terms.shape[0]):
        for k in range(terms.shape[1]):
            out[i] += _WEIGHTS[k] * terms[i, k]
    return out


def likely_building(points: SparsePoints, wanted: BoolArray) -> BoolArray:
    """Mask (n,) of the wanted points that are likely building: with a chance of `LEAST_CHANCE` or more."""
    likely: BoolArray = wanted & (_logits(terms_of(points, wanted)) >= _LEAST_LOGIT)
    return likely
