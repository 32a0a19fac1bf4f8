"""Roof faces that continue beyond their points: they end at the heights that the points show.

A plane says little beyond its last points. Up its slope it may continue by its noise plus its rise over two point
spacings, the farthest that a ridge lies from its points; above that it is level. Down its slope it may continue
farther, since hidden eaves are common. A face without any point of its own, or under the floor, is level as a whole.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import shapely

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray, Plane
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPoints
from pipeline.roof.roof_settings import RoofSettings

REACH_SPACINGS = 2.0
"""A ridge, or an outline, lies no farther than this from the points of a slope that was seen up to there."""
ON_PLANE_M = 0.3
"""A point this near to a plane shows that it is roof: as `residual_cap_m`, of which it is no part, since other methods
have none."""
_NOISES, _MOST_NOISE_M = 3.0, 0.15
"""How far points lie from their plane, in its standard deviations and at most."""


class _Heights(NamedTuple):
    """What faces (f,) span and what the points show of them, metres."""

    tops: FloatArray
    bottoms: FloatArray
    highest: FloatArray
    """Highest point on the face's plane near the face, else that of its label, else of all."""
    lowest: FloatArray
    label_highest: FloatArray
    """Highest point of the face's label anywhere, else of all."""
    label_lowest: FloatArray
    own: BoolArray
    """Points near the face lie on its plane, at least half as many as have its label there."""


def noise_of(plane: Plane) -> float:
    """How far points of a plane may lie from it, metres."""
    return min(_NOISES * plane.rmse_m, _MOST_NOISE_M)


def level_unsupported_faces(
    partition: RoofPartition,
    roof: RoofPoints,
    planes: Sequence[Plane],
    ground_z_m: float,
    settings: RoofSettings,
    *,
    ends: bool = True,
) -> tuple[RoofPartition, list[Plane]]:
    """End every face that leaves the heights of its points: the rest of it is level, or the whole face.

    Without `ends`, slopes go on, and only faces that leave all their points become level, each as a whole.

    A face that only comes down to the floor keeps its plane: `cut_at_floor` ends it there. Returns the partition with
    the labels of the new planes, which follow the old ones in the list; the same partition if all faces fit.
    """
    floor = ground_z_m + settings.min_clearance_m
    found = heights_of_faces(partition, roof, planes)
    below = np.maximum(found.bottoms, floor) < found.lowest - settings.max_overshoot_m
    above = found.tops > found.highest + settings.max_overshoot_m
    lost = (found.tops <= floor) | ((below | above) & ~found.own)
    extended = list(planes)
    if lost.any():
        labels = partition.labels.copy()
        for k in np.flatnonzero(lost).tolist():
            middle = 0.5 * (float(found.bottoms[k]) + float(found.tops[k]))
            height = max(floor, min(middle, float(found.highest[k])))
            extended.append(_level_plane(partition.polygons[k], int(labels[k]), roof, height, floor))
            labels[k] = len(extended) - 1
        partition = RoofPartition(polygons=partition.polygons, labels=labels)
        found = heights_of_faces(partition, roof, extended)
    ceilings = {}
    for k, label in enumerate(partition.labels.tolist()):
        plane = extended[label]
        rise_m = roof.spacing_m * math.hypot(plane.a, plane.b)
        seen_m = float(found.highest[k]) + noise_of(plane)
        if ends and float(found.tops[k]) > seen_m + REACH_SPACINGS * rise_m and rise_m > 0.0:
            ceilings[k] = seen_m + rise_m
    partition, extended = _cut(partition, extended, ceilings, above=True, undivided=False)
    if ends and below.any():
        found = heights_of_faces(partition, roof, extended)
        least = found.lowest - settings.max_overshoot_m
        dips = {k: float(least[k]) for k in np.flatnonzero(np.maximum(found.bottoms, floor) < least).tolist()}
        partition, extended = _cut(partition, extended, dips, above=False, undivided=True)
    return partition, extended


def _cut(
    partition: RoofPartition, planes: Sequence[Plane], levels_m: Mapping[int, float], *, above: bool, undivided: bool
) -> tuple[RoofPartition, list[Plane]]:
    """`cut_at_levels`; the same partition without faces to cut."""
    if not levels_m:
        return partition, list(planes)
    from pipeline.roof.floor_cut import cut_at_levels

    return cut_at_levels(partition, planes, levels_m, above=above, undivided=undivided)


def goes_far(
    partition: RoofPartition, roof: RoofPoints, planes: Sequence[Plane], ground_z_m: float, settings: RoofSettings
) -> bool:
    """Whether some face leaves the heights of its points by more than `max_overshoot_m`: it may be misplaced."""
    found, most_m = heights_of_faces(partition, roof, planes), settings.max_overshoot_m
    bottoms = np.maximum(found.bottoms, ground_z_m + settings.min_clearance_m)
    return bool(((found.tops > found.label_highest + most_m) | (bottoms < found.label_lowest - most_m)).any())


def levelled_share_of(level: RoofPartition, n_planes: int) -> float:
    """Share of the area on planes beyond the first `n_planes`: those of faces that were made level; 0 without faces."""
    new = level.labels >= n_planes
    if not new.any():
        return 0.0
    areas = shapely.area(np.array(level.polygons, object))
    return float(areas[new].sum()) / float(areas.sum())


def heights_of_faces(partition: RoofPartition, roof: RoofPoints, planes: Sequence[Plane]) -> _Heights:
    """What the faces of a partition span and what the points show of them."""
    xy, face = shapely.get_coordinates(np.array(partition.polygons, object), return_index=True)
    coefficients = np.array([plane.coefficients for plane in planes]).reshape(len(planes), 3)
    return _heights_of_faces(xy, face, partition.labels, coefficients, roof.points, roof.labels, roof.spacing_m)


@kernel
def _heights_of_faces(
    xy_mm: FloatArray,
    face: IntArray,
    labels: LabelArray,
    planes: FloatArray,
    points: FloatArray,
    label_of_point: LabelArray,
    spacing_m: float,
) -> _Heights:
    """The kernel of `heights_of_faces`: a point is near a face within a spacing of the box around it.

    Vertices `xy_mm` (v, 2) with the face of each; faces have the plane `labels` (f,), points (n, 3) `label_of_point`.
    """
    n_faces = len(labels)
    tops, bottoms = np.full(n_faces, -np.inf), np.full(n_faces, np.inf)
    boxes = np.empty((n_faces, 4))
    boxes[:, :2], boxes[:, 2:] = np.inf, -np.inf
    for v in range(len(xy_mm)):
        f = face[v]
        x, y = xy_mm[v, 0] * 1e-3, xy_mm[v, 1] * 1e-3
        z = planes[labels[f], 0] * x + planes[labels[f], 1] * y + planes[labels[f], 2]
        tops[f], bottoms[f] = max(tops[f], z), min(bottoms[f], z)
        boxes[f, 0], boxes[f, 1] = min(boxes[f, 0], x - spacing_m), min(boxes[f, 1], y - spacing_m)
        boxes[f, 2], boxes[f, 3] = max(boxes[f, 2], x + spacing_m), max(boxes[f, 3], y + spacing_m)
    highest, lowest = np.full(n_faces, -np.inf), np.full(n_faces, np.inf)
    on_plane, labelled = np.zeros(n_faces, np.int64), np.zeros(n_faces, np.int64)
    of_label_high, of_label_low = np.full(len(planes), -np.inf), np.full(len(planes), np.inf)
    low, high = np.inf, -np.inf
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        low, high = min(low, z), max(high, z)
        label = label_of_point[i]
        if label >= 0:
            of_label_high[label], of_label_low[label] = max(of_label_high[label], z), min(of_label_low[label], z)
        for f in range(n_faces):
            if x < boxes[f, 0] or y < boxes[f, 1] or x > boxes[f, 2] or y > boxes[f, 3]:
                continue
            labelled[f] += label == labels[f]
            plane = planes[labels[f]]
            if abs(plane[0] * x + plane[1] * y + plane[2] - z) <= ON_PLANE_M:
                highest[f], lowest[f] = max(highest[f], z), min(lowest[f], z)
                on_plane[f] += 1
    own = (on_plane > 0) & (2 * on_plane >= labelled)
    label_highest, label_lowest = np.empty(n_faces), np.empty(n_faces)
    for f in range(n_faces):
        label = labels[f]
        # a side of a template can be without points: it is as high as the others
        is_seen = of_label_high[label] > -np.inf
        label_highest[f] = of_label_high[label] if is_seen else high
        label_lowest[f] = of_label_low[label] if is_seen else low
        if not own[f]:
            highest[f], lowest[f] = label_highest[f], label_lowest[f]
    return _Heights(tops, bottoms, highest, lowest, label_highest, label_lowest, own)


def _level_plane(polygon: shapely.Polygon, label: int, roof: RoofPoints, otherwise: float, floor: float) -> Plane:
    """The horizontal plane through a face's own points, else all points within it, else at a given height."""
    shapely.prepare(polygon)
    inside = shapely.intersects_xy(polygon, roof.xy_mm[:, 0], roof.xy_mm[:, 1])
    own = inside & (roof.labels == label)
    z = np.sort(roof.points[own if own.any() else inside, 2])
    height = round(max(float(z[len(z) // 2]) if len(z) else otherwise, floor), 3)
    rmse = math.sqrt(math.fsum(((z - height) ** 2).tolist()) / len(z)) if len(z) else 0.0
    return Plane(a=0.0, b=0.0, c=height, n_points=len(z), rmse_m=rmse)


_SMALL_DIP_M = 0.04
"""Faces may dip so far below the least elevation: less than the least `min_clearance_m`, so they stay above ground."""


def cut_at_floor(
    partition: RoofPartition, planes: Sequence[Plane], floor_z_m: float
) -> tuple[RoofPartition, list[Plane]]:
    """Cut every face that dips below the elevation `floor_z_m`, and make the part below level at that elevation.

    Returns the partition and the planes, the level one last where any face was cut. A face whose cut does not divide it
    into polygons becomes level as a whole. Without such faces the same partition comes back.
    """
    lowest = _lowest_m(partition, planes)
    dips = np.flatnonzero(lowest < floor_z_m - _SMALL_DIP_M).tolist()
    return _cut(partition, planes, dict.fromkeys(dips, floor_z_m), above=False, undivided=True)


def _lowest_m(partition: RoofPartition, planes: Sequence[Plane]) -> FloatArray:
    """Elevation of the lowest corner of every face, (p,)."""
    xy, face = shapely.get_coordinates(np.array(partition.polygons, object), return_index=True)
    a, b, c = np.array([plane.coefficients for plane in planes]).reshape(len(planes), 3)[partition.labels[face]].T
    z: FloatArray = a * (xy[:, 0] * 1e-3) + b * (xy[:, 1] * 1e-3) + c
    lowest: FloatArray = np.minimum.reduceat(z, np.searchsorted(face, np.arange(len(partition.labels))))
    return lowest
