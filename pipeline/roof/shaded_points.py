"""Roof points in the shadow of a wall: at the foot of a higher part, points of the lower roof count again.

Points with another point well above them nearby are hidden, since most lie on a facade. A lower roof therefore seems to
end half a metre from the wall, and one that is hardly wider seems to be missing. A facade has points at all heights;
the ones on the plane of a roof that continues beside them belong to that roof. At the foot of a wall all higher points
are on one side. A point that they surround lies beneath the upper roof: under its eave, or seen through a gap.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pipeline.compiler import kernel
from pipeline.geometry import surrounded
from pipeline.model import FloatArray, IntArray, LabelArray, Plane, PreparedCloud
from pipeline.prepared_cloud import SHADING_HEIGHT_M, SHADING_RADIUS_M
from pipeline.roof.plan import RoofPoints

_REACH_M = 2.0 * SHADING_RADIUS_M
"""The visible points of a lower roof begin a radius from the wall, and its hidden ones lie within that radius."""
_ON_PLANE_M = 0.2
"""Several times the noise of a point. On a facade few points lie within it, so this is not a setting."""


def with_shaded_points(roof: RoofPoints, cloud: PreparedCloud, planes: Sequence[Plane]) -> RoofPoints:
    """Add the hidden points of a cloud that lie on a plane near visible points of it, with its label.

    Points that visible ones well above them surround stay hidden. The labels of `roof` number `planes`. Positions stay
    distinct: of hidden points at one the highest counts, and none where a roof point is. A point between several planes
    takes the nearest, the first of equal ones.
    """
    if len(cloud.visible) == len(cloud.points):
        return roof
    is_hidden = np.ones(len(cloud.points), np.bool_)
    is_hidden[cloud.visible] = False
    hidden = np.flatnonzero(is_hidden)
    points = cloud.candidate.points.take(hidden, axis=0)
    xy_mm = cloud.points_mm.take(hidden, axis=0)[:, :2] + (cloud.shift_m[:2] * 1e3).astype(np.int64)
    coefficients = np.array([plane.coefficients for plane in planes]).reshape(len(planes), 3)
    label = _planes_beside(points, xy_mm, coefficients, roof.xy_mm, roof.labels)
    added = np.flatnonzero(label >= 0)
    if len(added):
        visible = cloud.candidate.points.take(cloud.visible, axis=0)
        added = added[~surrounded(points[added], visible, SHADING_RADIUS_M, SHADING_HEIGHT_M)]
    if len(added) == 0:
        return roof
    added = added[np.argsort(-points[added, 2], kind="stable")]
    together = np.concatenate((roof.xy_mm, xy_mm[added]))
    _, order = np.unique((together[:, 0] << 32) + together[:, 1], return_index=True)
    if len(order) == len(roof.xy_mm):
        return roof
    return dataclasses.replace(
        roof,
        points=np.take(np.concatenate((roof.points, points[added])), order, axis=0),
        xy_mm=np.take(together, order, axis=0),
        index=np.concatenate((roof.index, hidden[added]))[order],
        labels=np.concatenate((roof.labels, label[added]))[order],
        split=np.concatenate((roof.split, np.zeros(len(added), np.bool_)))[order],
    )


@kernel
def _planes_beside(
    points: FloatArray, xy_mm: IntArray, planes: FloatArray, roof_mm: IntArray, label_of_roof: LabelArray
) -> LabelArray:
    """The nearest plane of each point that has roof points of that plane within reach in plan, (n,); -1 without any.

    Points (n, 3) are in metres, their places `xy_mm` (n, 2) and those of the roof points (r, 2) in millimetres; roof
    points ascend by x. Planes are a, b, c, (k, 3).
    """
    reach_mm = round(_REACH_M * 1e3)
    x_mm = roof_mm[:, 0].copy()
    nearest = np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        x, y, z = points[i]
        first = np.searchsorted(x_mm, xy_mm[i, 0] - reach_mm)
        least = _ON_PLANE_M
        for k in range(len(planes)):
            off = abs(planes[k, 0] * x + planes[k, 1] * y + planes[k, 2] - z)
            if off >= least:
                continue
            for r in range(first, len(roof_mm)):
                dx, dy = roof_mm[r, 0] - xy_mm[i, 0], roof_mm[r, 1] - xy_mm[i, 1]
                if dx > reach_mm:
                    break
                if label_of_roof[r] == k and dx * dx + dy * dy <= reach_mm * reach_mm:
                    least, nearest[i] = off, k
                    break
    return nearest
