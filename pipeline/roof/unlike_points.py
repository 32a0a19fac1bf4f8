"""Models whose faces contradict the points: one rises where nothing was seen, or one is level where the roof slopes.

Faces are cut and continued so that this seldom happens. A model that still contradicts its points is not delivered.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.model import Doubt, Plane, Reason
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPoints
from pipeline.roof.solid import SolidPart
from pipeline.roof.unsupported_faces import ON_PLANE_M, REACH_SPACINGS, heights_of_faces, noise_of

# Not settings: they say when a face contradicts the points, for any survey.
_SLOPED = math.tan(math.radians(7.0))
"""Rise over run from which a plane is a slope, as in `flat_below_deg`."""
_MOST_ON_SLOPE = 0.5
"""Share of the points within a level face that lie on a slope and not on the face, up to which the face is level."""
_LEAST_AREA_M2, _LEAST_SHARE = 4.0, 0.05
"""Smaller faces, in plan and as a share of the roof, are details that do not change what kind of roof it is."""

_AROUND_M, _FAR_M = 1.0, 1.0
"""Points this near to a face in plan bound its height, within this tolerance: a few point spacings, less than a
storey."""


def contradiction_of(
    partition: RoofPartition, planes: Sequence[Plane], roof: RoofPoints, slopes: RoofPoints, sides: Sequence[Plane]
) -> Doubt | None:
    """The worst contradiction between the final faces of a model and its roof points; None if there is none.

    `partition` and the labels of `roof` number `planes`. The labels of `slopes`, the same points, number `sides`, the
    planes of the segmentation. The points may hold those that continue slopes up to a ridge: a face may rise as far.
    """
    return _rising(partition, planes, roof) or _level_through_slope(partition, planes, slopes, sides)


def _rising(partition: RoofPartition, planes: Sequence[Plane], roof: RoofPoints) -> Doubt | None:
    """A face that rises above its points by more than their noise and its rise over two point spacings."""
    found = heights_of_faces(partition, roof, planes)
    worst: tuple[float, float, float] | None = None
    for k, label in enumerate(partition.labels.tolist()):
        plane = planes[label]
        rise = math.hypot(plane.a, plane.b)
        if rise == 0.0:  # ends a slope, or lies half-way between points
            continue
        limit_m = noise_of(plane) + REACH_SPACINGS * roof.spacing_m * rise
        above_m = float(found.tops[k] - found.highest[k])
        if above_m > max(limit_m, ON_PLANE_M) and (worst is None or above_m - limit_m > worst[0]):
            worst = above_m - limit_m, above_m, limit_m
    if worst is None:
        return None
    _, above_m, limit_m = worst
    words = f"a face rises {above_m:.2f} m above its points, more than {limit_m:.2f} m"
    return Doubt.of(Reason.ABOVE_POINTS, words, "above_points_m", above_m, limit_m)


def _level_through_slope(
    partition: RoofPartition, planes: Sequence[Plane], roof: RoofPoints, sides: Sequence[Plane]
) -> Doubt | None:
    """A level face most of whose points lie on a slope."""
    if len(sides) == 0:
        return None
    coefficients = np.array([side.coefficients for side in sides]).reshape(len(sides), 3)
    of_point = coefficients[np.maximum(roof.labels, 0)]
    x, y, z = roof.points.T
    on_side = np.abs(z - of_point[:, 0] * x - of_point[:, 1] * y - of_point[:, 2]) <= ON_PLANE_M
    on_slope = (roof.labels >= 0) & on_side & (np.hypot(of_point[:, 0], of_point[:, 1]) >= _SLOPED)
    if not on_slope.any():
        return None
    least_mm2 = max(_LEAST_AREA_M2 * 1e6, _LEAST_SHARE * math.fsum(one.area for one in partition.polygons))
    worst = _MOST_ON_SLOPE
    for polygon, label in zip(partition.polygons, partition.labels.tolist(), strict=True):
        plane = planes[label]
        if polygon.area < least_mm2 or math.hypot(plane.a, plane.b) >= _SLOPED:
            continue
        shapely.prepare(polygon)
        inside = shapely.intersects_xy(polygon, roof.xy_mm[:, 0], roof.xy_mm[:, 1])
        off = np.abs(z - plane.a * x - plane.b * y - plane.c) > ON_PLANE_M
        if inside.any():
            worst = max(worst, float(np.mean((on_slope & off)[inside])))
    if worst <= _MOST_ON_SLOPE:
        return None
    words = f"{worst:.0%} of the points of a level face lie on a slope, more than {_MOST_ON_SLOPE:.0%}"
    return Doubt.of(Reason.LEVEL_THROUGH_SLOPE, words, "level_on_slope_share", worst, _MOST_ON_SLOPE)


def stays_near(parts: Sequence[SolidPart], roof: RoofPoints) -> bool:
    """Whether no corner of a roof face lies far above or below all points in the face and around it."""
    faces = [face.polygon for part in parts for face in part.faces]
    x, y, z = roof.points.T
    for face in faces:
        around = z[shapely.intersects_xy(face.buffer(_AROUND_M), x, y)]
        corners = shapely.get_coordinates(face, include_z=True)[:, 2]
        if len(around) and (corners.max() > around.max() + _FAR_M or corners.min() < around.min() - _FAR_M):
            return False
    return True
