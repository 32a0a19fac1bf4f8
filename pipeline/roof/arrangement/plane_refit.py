"""Refits planes to the points of the places that they were given."""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import moments_of, solve_plane_moments
from pipeline.model import FloatArray, LabelArray
from pipeline.roof.arrangement.raster_labels import Raster, vertical_distance_m

_ROUNDS = 3
"""Most refits of a plane: bounds the work; they end when the cost no longer falls."""
_FEWEST_POINTS = 6
"""Planes with fewer points keep their coefficients: twice as many as there are coefficients."""
_MIN_WIDTH_M = 0.2
"""Standard deviation of the points across their longest direction below which they do not determine that slope."""


@kernel
def labels_of_points(points: FloatArray, labels: LabelArray, raster: Raster) -> LabelArray:
    """The label of the raster cell in which each point lies, (n,) int32; -1 outside."""
    found = np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        c = math.floor((points[i, 0] - raster.west) / raster.cell_m)
        r = math.floor((points[i, 1] - raster.south) / raster.cell_m)
        if 0 <= c < raster.columns and 0 <= r < raster.rows:
            cell = raster.number[r * raster.columns + c]
            if cell >= 0:
                found[i] = labels[cell]
    return found


@kernel
def _fit(
    points: FloatArray, chosen: LabelArray, planes: FloatArray, label: int, cap_m: float, fitted: FloatArray
) -> bool:
    """Least squares over the chosen points nearer than the cap to one of the planes; whether they determine one."""
    near = np.empty(len(chosen), np.int32)
    n = 0
    for i in chosen:
        if vertical_distance_m(points, i, planes, label) < cap_m:
            near[n] = i
            n += 1
    if n < _FEWEST_POINTS:
        return False
    found = moments_of(points, near[:n])
    # the smaller eigenvalue of the scatter is at least determinant / trace
    if found.xx * found.yy - found.xy * found.xy < n * _MIN_WIDTH_M**2 * (found.xx + found.yy):
        return False
    a, b = solve_plane_moments(found.xx, found.xy, found.yy, found.xz, found.yz)
    fitted[0, 0], fitted[0, 1], fitted[0, 2] = a, b, found.z - a * found.x - b * found.y
    return True


@kernel
def refitted_planes(points: FloatArray, labels: LabelArray, planes: FloatArray, cap_m: float) -> FloatArray:
    """Every plane (k, 3) refitted by least squares to the points of its places that it explains.

    This is repeated while it lowers the sum of residuals capped at `cap_m`, from which a point is unexplained. Points
    (n, 3) are in local metres, in a canonical order; `labels` has the plane of the place of each, -1 for none.
    """
    better = planes.copy()
    fitted = np.empty((1, 3))
    chosen = np.empty(len(points), np.int32)
    for label in range(len(planes)):
        n = 0
        for i in range(len(points)):
            if labels[i] == label:
                chosen[n] = i
                n += 1
        for _ in range(_ROUNDS):
            if not _fit(points, chosen[:n], better, label, cap_m, fitted):
                break
            change = 0.0
            for i in chosen[:n]:
                change += min(vertical_distance_m(points, i, fitted, 0), cap_m)
                change -= min(vertical_distance_m(points, i, better, label), cap_m)
            if change >= 0.0:
                break
            better[label] = fitted[0]
    return better


@kernel(inline="always")
def support_of_planes(points: FloatArray, labels: LabelArray, planes: FloatArray, cap_m: float) -> FloatArray:
    """Points that each plane explains of those with its label, and their squared vertical residuals, (k, 2) float64."""
    support = np.zeros((len(planes), 2))
    for i in range(len(points)):
        if labels[i] >= 0:
            off = vertical_distance_m(points, i, planes, labels[i])
            if off < cap_m:
                support[labels[i], 0] += 1.0
                support[labels[i], 1] += off * off
    return support
