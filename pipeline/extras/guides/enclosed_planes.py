"""Planes of the regions that guides enclose: with few points, methods find no plane in a small region."""

from __future__ import annotations

import math

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.compiler import kernel
from pipeline.model import FloatArray, LabelArray
from pipeline.roof.roof_settings import ArrangementSettings

_EXTENDED_M = 0.6
"""By so much a piece is made longer at both ends: drawn lines seldom meet exactly."""
_FEWEST_POINTS = 5
"""Least points that a plane of a region explains: two more than it has coefficients."""
_TURNS = 10
"""Turns of the fit, each with the points that the last plane explains: bounds the work."""


def with_enclosed_planes(
    points: FloatArray,
    labels: LabelArray,
    planes: FloatArray,
    pieces: FloatArray,
    outline_mm: MultiPolygon,
    settings: ArrangementSettings,
) -> tuple[FloatArray, LabelArray]:
    """Planes (k, 3) and labels (n,) with those of regions that no plane explains well enough.

    The pieces (g, 4) of guides and the outline divide the plan into regions. A region gets a plane of its own if that
    explains more points (n, 3) in it than any other plane does, by those that a face must save.
    """
    if len(pieces) == 0:
        return planes, labels
    found, labels = list(planes), labels.copy()
    for region in _regions(pieces, outline_mm):
        shapely.prepare(region)
        inside = np.flatnonzero(shapely.intersects_xy(region, points[:, 0], points[:, 1]))
        if len(inside) < _FEWEST_POINTS:
            continue
        own, explained = _fitted(np.ascontiguousarray(points[inside]), settings.residual_cap_m)
        if explained < _FEWEST_POINTS:
            continue
        costs = [_misfit(points[inside], plane, settings.residual_cap_m) for plane in (own, *planes)]
        if costs[0] + settings.face_cost > min(costs[1:]):
            continue
        off = np.abs(points[inside] @ np.array([-own[0], -own[1], 1.0]) - own[2])
        labels[inside[off < settings.residual_cap_m]] = len(found)
        found.append(own)
    return np.array(found).reshape(len(found), 3), labels


def _regions(pieces: FloatArray, outline_mm: MultiPolygon) -> list[shapely.Polygon]:
    """The parts of an outline between the pieces, metres, in the order of their places."""
    along = pieces[:, 2:] - pieces[:, :2]
    along *= (_EXTENDED_M / np.hypot(along[:, 0], along[:, 1]))[:, None]
    longer = np.hstack((pieces[:, :2] - along, pieces[:, 2:] + along))
    outline = shapely.transform(outline_mm, lambda xy: xy * 1e-3)
    edges = shapely.union_all([outline.boundary, *shapely.linestrings(longer.reshape(-1, 2, 2))], grid_size=1e-3)
    parts = shapely.get_parts(shapely.polygonize([edges])).tolist()
    return sorted((part for part in parts if outline.contains(part.representative_point())), key=lambda p: p.bounds)


def _misfit(points: FloatArray, plane: FloatArray, cap_m: float) -> float:
    """The sum of capped residuals of points (n, 3), in unexplained points."""
    off = np.abs(points[:, 2] - plane[0] * points[:, 0] - plane[1] * points[:, 1] - plane[2])
    return math.fsum(np.minimum(off / cap_m, 1.0).tolist())


@kernel
def _fitted(points: FloatArray, cap_m: float) -> tuple[FloatArray, int]:
    """The plane a, b, c through most of points (n, 3), by least squares over those within the cap, and their number.

    It starts from all points and drops the farthest half beyond the cap at a time.
    """
    n = len(points)
    plane, used = np.zeros(3), np.ones(n, np.bool_)
    off = np.empty(n)
    bound = math.inf
    for _ in range(_TURNS):
        m, mx, my, mz = 0, 0.0, 0.0, 0.0
        for i in range(n):
            if used[i]:
                m, mx, my, mz = m + 1, mx + points[i, 0], my + points[i, 1], mz + points[i, 2]
        if m < 3:
            return plane, 0
        mx, my, mz = mx / m, my / m, mz / m
        xx, xy, yy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            if used[i]:
                x, y, z = points[i, 0] - mx, points[i, 1] - my, points[i, 2] - mz
                xx, xy, yy, xz, yz = xx + x * x, xy + x * y, yy + y * y, xz + x * z, yz + y * z
        determinant = xx * yy - xy * xy
        if determinant < 1e-3 * m * m:
            return plane, 0
        a, b = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
        plane[0], plane[1], plane[2] = a, b, mz - a * mx - b * my
        far = 0.0
        for i in range(n):
            off[i] = abs(points[i, 2] - a * points[i, 0] - b * points[i, 1] - plane[2])
            if used[i]:
                far = max(far, off[i])
        bound = max(cap_m, 0.7 * far)
        changed = False
        for i in range(n):
            is_used = off[i] <= bound
            changed = changed or is_used != used[i]
            used[i] = is_used
        if not changed and bound == cap_m:
            break
    count = 0
    for i in range(n):
        count += off[i] <= cap_m
    return plane, count
