"""Gross errors of coordinates: single points that do not lie on Earth, and bounds that single points spoil.

Points that are only far away are left to the outlier filter, which judges them by their neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pipeline.model import BoolArray, FloatArray

Bounds = tuple[float, float, float, float, float, float]
"""x_min, y_min, z_min, x_max, y_max, z_max."""

LARGEST_PLAN_M = 1e8
"""No projected CRS has larger coordinates: those with the number of a zone as a prefix go up to 64 500 km."""
LARGEST_ELEVATION_M = 1e5
"""Space begins here: nothing that an aircraft measures lies higher above the ground or deeper below it."""
MOST_STRAYS = 0.01
"""Largest share of points off the Earth in a file: with more, it is the unit or the scale that is wrong."""
WIDE_M = 1e5
"""Bounds that are wider are looked at: a tile has some kilometres."""
TIMES_WIDER = 10.0
"""Bounds so many times wider than nearly all points are spoiled: a long corridor fills its own."""
MARGIN_M = 1e4
"""Kept around nearly all sampled points, beside their own extent: a sample need not reach the borders."""
_OUTERMOST = 0.01
"""Share of a sample that is left out at either end of an axis; strays are rarer."""
_PER_PIECE = 2_000
ROUNDING = 0.02
"""Units of the CRS by which writers round the bounds in their headers."""


def off_earth(xyz: FloatArray, factors: FloatArray) -> BoolArray | None:
    """(n,) bool, True for points that do not lie on Earth; None if there are none.

    `factors` are the metres per unit of the three axes.
    """
    found: BoolArray | None = None
    for axis, largest_m in enumerate((LARGEST_PLAN_M, LARGEST_PLAN_M, LARGEST_ELEVATION_M)):
        values, limit = xyz[:, axis], largest_m / factors[axis]
        if values.max() > limit or values.min() < -limit:
            beyond = np.abs(values) > limit
            found = beyond if found is None else found | beyond
    return found


def thinned(xyz: FloatArray) -> FloatArray:
    """Some points of a piece, spread over it: a sample that costs little to hold."""
    return np.array(xyz[:: max(1, len(xyz) // _PER_PIECE)])


def typical_bounds(samples: Iterable[FloatArray]) -> Bounds:
    """Bounds of sampled points (n, 3) without the outermost hundredth at either end of each axis."""
    ordered = np.sort(np.concatenate(list(samples)), axis=0)
    cut = int(np.ceil(_OUTERMOST * (len(ordered) - 1)))
    low, high = ordered[min(cut, len(ordered) - 1)], ordered[max(len(ordered) - 1 - cut, 0)]
    if (low > high).any():  # two points or fewer
        low, high = ordered[0], ordered[-1]
    return float(low[0]), float(low[1]), float(low[2]), float(high[0]), float(high[1]), float(high[2])


def header_box_problem(lows: FloatArray, highs: FloatArray, sample: FloatArray) -> str | None:
    """What is wrong with the bounds in a header, (3,) each, by some points of the file (n, 3); None if nothing is.

    >>> some = np.array([[5.0, 5.0, 1.0], [6.0, 7.0, 2.0]])
    >>> header_box_problem(np.zeros(3), np.zeros(3), some)
    'do not hold the points, such as x 5, y 5, z 1'
    >>> header_box_problem(some[0], some[1], some) is None
    True
    """
    if not (np.isfinite(lows).all() and np.isfinite(highs).all() and (lows <= highs).all()):
        return "cannot be"
    outside = ((sample < lows - ROUNDING) | (sample > highs + ROUNDING)).any(axis=1)
    if outside.mean() > MOST_STRAYS:
        x, y, z = sample[np.argmax(outside)].tolist()
        return f"do not hold the points, such as x {x:.10g}, y {y:.10g}, z {z:.10g}"
    extent = np.ptp(sample, axis=0)
    wide = (highs - lows > WIDE_M) & (highs - lows > TIMES_WIDER * extent)
    return "are far wider than the points" if wide.any() else None


def without_strays(bounds: Bounds, typical: Bounds | None, factors: FloatArray) -> tuple[Bounds, tuple[str, ...]]:
    """Bounds that single far points do not widen, and a warning per axis that they did."""
    if typical is None:
        return bounds, ()
    found, warnings = list(bounds), []
    for axis, name in enumerate(("x", "y", "z")):
        low, high, near_low, near_high = bounds[axis], bounds[axis + 3], typical[axis], typical[axis + 3]
        width, usual = high - low, near_high - near_low
        if width * factors[axis] > WIDE_M and width > TIMES_WIDER * usual:
            margin = usual + MARGIN_M / factors[axis]
            found[axis], found[axis + 3] = max(low, near_low - margin), min(high, near_high + margin)
            warnings.append(
                f"{name} reaches from {low:.10g} to {high:.10g}, nearly all points lie between {near_low:.10g} and "
                f"{near_high:.10g}: points far from them are taken for outliers"
            )
    return (found[0], found[1], found[2], found[3], found[4], found[5]), tuple(warnings)
