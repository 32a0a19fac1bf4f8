"""Roof returns of a model: the points that the sensor saw of its roof from above.

A point off the roof is on a facade, beneath an overhang or inside the building if another point stands steeply over it.
The top of a facade has none above it. It is known by what is around it: it stands steeply over other points, and points
on the roof beside it are higher. Such points say nothing about the roof, so the figures of fit leave them out and count
them apart. All other points are roof returns, wherever they lie: on a chimney, on a dormer that is not modelled, on a
roof beyond the outline.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.geometry import grid_shape, sorted_into_grid
from pipeline.model import BoolArray, FloatArray
from pipeline.prepared_cloud import SHADING_HEIGHT_M, SHADING_RADIUS_M

TOLERANCE_M = 0.2
"""A point within this vertical distance of the roof is explained by it."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute values."""
_SIGMAS = 3.0
"""A point is on the roof up to so many standard deviations of the noise."""
_RISE_MM, _RUN_MM = round(SHADING_HEIGHT_M * 1000.0), round(SHADING_RADIUS_M * 1000.0)
"""A point stands steeply over another one beyond this slope: 65 degrees, steeper than roofs are."""


def roof_returns(points: FloatArray, residuals: FloatArray, spacing_m: float) -> BoolArray:
    """Which points of a candidate are roof returns of a model, (n,) bool.

    A point is on the roof up to three standard deviations of the noise, at least 0.2 m and at most 1.1 m. Its
    neighbours lie within 0.5 m in plan, or within a point spacing if that is larger. A point off the roof is not a roof
    return if

    - a neighbour is higher by more than that distance, and by more than 2.2 m per metre in plan, or
    - it is as much above a neighbour, and a neighbour on the roof is higher.

    The noise is that of the points up to 1.1 m from the roof: few of a facade's points are. With 1.1 m a point is
    hidden as for the methods and the ruler.

    Parameters
    ----------
    points : (n, 3) float64
        All points of the candidate, local metres, multiples of 1 mm.
    residuals : (n,) float64
        Points minus roof, vertical, metres; nan where the model has no roof, which is off it.
    spacing_m : float
        Typical distance of neighbouring roof points in plan; nan counts as small.
    """
    if len(points) == 0:
        return np.zeros(0, np.bool_)
    points = np.ascontiguousarray(points, dtype=np.float64)
    return _roof_returns(points, residuals, max(SHADING_RADIUS_M, spacing_m))


@kernel
def _noise_mm(residuals: FloatArray) -> float:
    """Standard deviation of the residuals (n,), metres, that are at most 1.1 m, in mm; by their median, to 1 mm."""
    counts = np.zeros(_RISE_MM + 1, np.int64)
    n = 0
    for residual in residuals:
        distance_mm = np.rint(abs(residual) * 1000.0)
        if distance_mm <= _RISE_MM:
            counts[int(distance_mm)] += 1
            n += 1
    passed = median = 0
    while 2 * (passed + counts[median]) < n:
        passed += counts[median]
        median += 1
    return MAD_TO_SIGMA * median


@kernel
def _roof_returns(points: FloatArray, residuals: FloatArray, radius_m: float) -> BoolArray:
    """The kernel of `roof_returns`; neighbours of the points (n, 3) lie within the radius in plan.

    Places are compared on whole millimetres.
    """
    n = len(points)
    reach_mm = round(min(max(TOLERANCE_M * 1000.0, _SIGMAS * _noise_mm(residuals)), float(_RISE_MM)))
    on_roof = np.empty(n, np.bool_)
    xyz_mm = np.empty((n, 3), np.int64)
    for i in range(n):
        on_roof[i] = abs(residuals[i]) * 1000.0 <= reach_mm
        for k in range(3):
            xyz_mm[i, k] = int(np.rint(points[i, k] * 1000.0))
    returns = np.ones(n, np.bool_)
    if on_roof.all():
        return returns
    radius_mm = round(radius_m * 1000.0)
    x_min, y_min, size, columns, rows = grid_shape(points, radius_m + 0.001)
    start, members = sorted_into_grid(points, x_min, y_min, size, columns, rows)
    for i in range(n):
        if on_roof[i]:
            continue
        stands_over = roof_is_higher = False
        column, row = int((points[i, 0] - x_min) / size), int((points[i, 1] - y_min) / size)
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                for q in range(start[r * columns + c], start[r * columns + c + 1]):
                    if not returns[i]:
                        break
                    j = members[q]
                    dx, dy, dz = xyz_mm[j, 0] - xyz_mm[i, 0], xyz_mm[j, 1] - xyz_mm[i, 1], xyz_mm[j, 2] - xyz_mm[i, 2]
                    square = dx * dx + dy * dy
                    if square > radius_mm * radius_mm:
                        continue
                    # as floats, since far outliers would not fit into 64 bits
                    is_steep = abs(dz) > reach_mm and (_RUN_MM * float(dz)) ** 2 > float(_RISE_MM * _RISE_MM * square)
                    stands_over |= is_steep and dz < 0
                    roof_is_higher |= dz > 0 and on_roof[j]
                    returns[i] = not ((is_steep and dz > 0) or (stands_over and roof_is_higher))
    return returns
