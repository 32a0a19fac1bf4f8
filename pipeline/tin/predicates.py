"""Exact orientation and in-circle predicates on integer millimetres.

Coordinates are whole millimetres held in float64, at most 2^21 apart. All differences, their products, the lifts and
the 2 x 2 minors then stay below 2^53, so float64 computes them without rounding: the orientation test is exact as it
stands. The in-circle determinant, a sum of three products of lift and minor below 2^85 each, is not. Its rounded value
is off by less than 2^36; where it is larger its sign is certain, and where it is not, the true value is below 2^37 and
the same sum modulo 2^64 is that value.

Four points of one circle have no sign. They get one by simulation of simplicity (Edelsbrunner & Mücke 1990): the lift
of every point is thought raised by an infinitesimal amount, the more the smaller the point is in the lexicographic
order of (x, y). No three points of a circle are collinear, so the smallest of the four always decides. The perturbed
lifts stay strictly convex: every point remains a vertex, the triangulation is a regular one and unique, and as the
order needs nothing but the coordinates themselves, it is the same for any order of insertion, translation, and cut of
the data.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel

MAX_EXTENT_MM = 1 << 21
"""The predicates are exact for points whose coordinates differ by at most this."""

_CERTAIN = float(1 << 36)
"""Bound of the rounding error of the in-circle determinant: 3 products and 2 sums, below 2^86 * 2^-53 each."""


@kernel
def orientation(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> float:
    """Twice the signed area of the triangle a, b, c in mm2; positive where it turns left; exact.

    Coordinates are whole millimetres, at most 2^21 apart.
    """
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


@kernel
def lies_in_circumcircle(
    ax: float, ay: float, bx: float, by: float, cx: float, cy: float, dx: float, dy: float
) -> bool:
    """Whether d lies inside the circle through a, b, c, which turn left; exact, ties broken symbolically (see above).

    Coordinates are whole millimetres, at most 2^21 apart; four different points. Where a, b, c are collinear the circle
    is the half-plane that d's sign of orientation makes of it, as Lawson's flips need it.
    """
    adx = ax - dx
    ady = ay - dy
    bdx = bx - dx
    bdy = by - dy
    cdx = cx - dx
    cdy = cy - dy
    lift_a = adx * adx + ady * ady
    lift_b = bdx * bdx + bdy * bdy
    lift_c = cdx * cdx + cdy * cdy
    minor_a = bdx * cdy - bdy * cdx
    minor_b = cdx * ady - cdy * adx
    minor_c = adx * bdy - ady * bdx
    rounded = lift_a * minor_a + lift_b * minor_b + lift_c * minor_c
    if rounded > _CERTAIN:
        return True
    if rounded < -_CERTAIN:
        return False
    # unsigned, because only its overflow is defined; by way of int64, because negative floats have no unsigned value
    exact = np.int64(
        np.uint64(np.int64(lift_a)) * np.uint64(np.int64(minor_a))
        + np.uint64(np.int64(lift_b)) * np.uint64(np.int64(minor_b))
        + np.uint64(np.int64(lift_c)) * np.uint64(np.int64(minor_c))
    )
    if exact != 0:
        return bool(exact > 0)
    # det = lift_a minor_a + lift_b minor_b + lift_c minor_c - lift_d (minor_a + minor_b + minor_c)
    smallest_x = ax
    smallest_y = ay
    sign = minor_a
    if bx < smallest_x or (bx == smallest_x and by < smallest_y):
        smallest_x = bx
        smallest_y = by
        sign = minor_b
    if cx < smallest_x or (cx == smallest_x and cy < smallest_y):
        smallest_x = cx
        smallest_y = cy
        sign = minor_c
    if dx < smallest_x or (dx == smallest_x and dy < smallest_y):
        sign = -(minor_a + minor_b + minor_c)
    return bool(sign > 0.0)
