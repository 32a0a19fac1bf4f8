"""Roof points in the shadow of a wall: at the foot of a higher part, points of the lower roof count again.

Points with another one well above them nearby are hidden, since most are of a facade. So a lower roof seems to end half
a metre from the wall, and one that is hardly wider seems to be missing. A facade has points at all heights: those on
the plane of a roof that goes on beside them are of that roof. At the foot of a wall all higher points are on one side.
A point that they surround lies beneath the upper roof: under its eave, or met by a pulse through a gap.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pipeline.geometry import surrounded
from pipeline.model import Plane, PreparedCloud
from pipeline.prepared_cloud import SHADING_HEIGHT_M, SHADING_RADIUS_M
from pipeline.roof.labelling import nearest_points
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
    is_hidden = np.ones(len(cloud.points), np.bool_)
    is_hidden[cloud.visible] = False
    hidden = np.flatnonzero(is_hidden)
    if len(hidden) == 0:
        return roof
    points = cloud.candidate.points[hidden]
    xy_mm = cloud.points_mm[hidden, :2] + (cloud.shift_m[:2] * 1e3).astype(np.int64)
    best, label = np.full(len(hidden), _ON_PLANE_M), np.full(len(hidden), -1, np.int32)
    for number, plane in enumerate(planes):
        off = np.abs(plane.a * points[:, 0] + plane.b * points[:, 1] + plane.c - points[:, 2])
        close = np.flatnonzero(off < best)
        own = roof.labels == number
        if len(close) == 0 or not own.any():
            continue
        _, distance_m = nearest_points(roof.xy_mm[own], xy_mm[close])
        close = close[distance_m <= _REACH_M]
        best[close], label[close] = off[close], number
    added = np.flatnonzero(label >= 0)
    if len(added):
        visible = cloud.candidate.points[cloud.visible]
        added = added[~surrounded(points[added], visible, SHADING_RADIUS_M, SHADING_HEIGHT_M)]
    if len(added) == 0:
        return roof
    added = added[np.argsort(-points[added, 2], kind="stable")]
    together = np.concatenate((roof.xy_mm, xy_mm[added]))
    _, first = np.unique((together[:, 0] << 32) + together[:, 1], return_index=True)
    if len(first) == len(roof.xy_mm):
        return roof
    order = first[np.lexsort((together[first, 1], together[first, 0]))]
    return dataclasses.replace(
        roof,
        points=np.concatenate((roof.points, points[added]))[order],
        xy_mm=together[order],
        index=np.concatenate((roof.index, hidden[added]))[order],
        labels=np.concatenate((roof.labels, label[added]))[order],
        split=np.concatenate((roof.split, np.zeros(len(added), np.bool_)))[order],
    )
