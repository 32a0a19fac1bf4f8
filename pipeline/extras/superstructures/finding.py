"""Chimneys and roof units: compact groups of points with a level top above the roof faces.

A pulse that meets the edge of a chimney comes back from between its top and the roof. So the points of a group are a
level top and others beneath it at its edges. A crown has no level top, or it is a small part of a wide group. Wires
and the rods of aerials are narrow, and each pulse that meets them goes on to the roof.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
import shapely

from pipeline.model import BoolArray, FloatArray, IntArray, Plane, RoofFace
from pipeline.quality.residuals import TopSurface

# The thresholds below say what a box on a roof looks like in a survey; `superstructures` is one switch.
MIN_POINTS = 4
"""Fewest points of a level top."""
_MIN_HEIGHT_M, _MIN_HEIGHT_SIGMAS = 0.3, 6.0
"""Least height above the roof: gutters and panels are lower, and what noise explains."""
_LEVEL_M, _LEVEL_SIGMAS = 0.1, 6.0
"""Depth of a level top: least to greatest of many points with noise."""
_MAX_ABOVE_SHARE = 0.1
"""Share of a group that may be above its top: a cowl, an outlier."""
_MIN_LEVEL_SHARE = 0.4
"""Least share of a level top in the upper half: a chimney's other points are those of pulses that met its edge."""
_TOP_QUANTILE = 0.7
"""Of a level top some points are of pulses that met its edge."""
_LINK_SPACINGS, _MIN_LINK_M = 1.5, 0.3
"""Points as near in plan belong together."""
_WIDENED_SPACINGS = 1.0
"""Most that a side grows beyond the outermost points."""
_MIN_EXTENT_M = 0.15
"""Least extent of the points: rods are narrower."""
_MIN_SIDE_M, _MIN_SIDE_SPACINGS = 0.3, 1.0
"""A narrower box is not resolved."""
_MAX_ASPECT, _MAX_SLENDERNESS = 4.0, 6.0
"""Parapets and wires are longer over their width, masts higher."""
_MAX_SPLIT_SHARE = 0.8
"""Share of the top whose pulses went on to the roof: the middle of a chimney stops whole pulses, a wire stops none."""
_MIN_FILLED_SHARE = 0.5
"""Least share of the points that so dense a survey has on the rectangle."""
_CORE_SHARE, _MAX_BENEATH_SHARE = 0.6, 0.25
"""In the middle of the rectangle, this far along its sides, few points lie beneath the top."""
_BESIDE_SPACINGS, _MIN_BESIDE_M = 1.5, 0.4
"""A group reaches no farther beyond its rectangle: beams are as wide."""
_STEP_REACH_M, _STEP_M = 0.5, 0.15
"""Points this near a roof face in plan, and not higher above it, are its wall or its edge."""
_LEVEL_SLOPE_DEG = 3.0
"""Boxes on flatter roofs follow the longest wall."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FoundBox:
    """A box on a roof."""

    corners: FloatArray
    """(4, 2) float64, counter-clockwise, local metres."""
    top_z_m: float
    """Elevation of its top, local metres."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofModel:
    """The roof that boxes stand on."""

    surface: TopSurface
    faces: Sequence[RoofFace]
    planes: Sequence[Plane]
    outline: shapely.Geometry
    """In plan, local metres."""
    spacing_m: float
    """Typical distance of neighbouring points in plan."""
    noise_m: float
    """Standard deviation of points about the roof."""

    @property
    def least_m(self) -> float:
        """Height above the roof that noise does not explain."""
        return max(_MIN_HEIGHT_M, _MIN_HEIGHT_SIGMAS * self.noise_m)


def found_boxes(points: FloatArray, split: BoolArray, roof: RoofModel) -> list[FoundBox]:
    """Boxes above a roof by the points (n, 3) of its building, local metres, in canonical order.

    `split` (n,) is True for points whose pulse went on to a lower return.
    """
    residuals = roof.surface.residuals(points)[0]
    high = np.flatnonzero(residuals > roof.least_m)
    if len(high) < MIN_POINTS:
        return []
    high = high[~_beside_steps(points[high], roof)]
    boxes: list[FoundBox] = []
    taken: list[shapely.Polygon] = []
    for group in _groups(points[high, :2], max(_MIN_LINK_M, _LINK_SPACINGS * roof.spacing_m)):
        box = _box(high[group], points, residuals, split, roof)
        if box is not None:
            plan = shapely.Polygon(box.corners)
            if not any(plan.intersects(other) for other in taken):
                boxes.append(box)
                taken.append(plan)
    return boxes


def _beside_steps(points: FloatArray, roof: RoofModel) -> BoolArray:
    """Which points (n, 3) a face nearby explains that is as high: its wall, or its edge beyond where it was drawn."""
    polygons = np.array([shapely.force_2d(face.polygon) for face in roof.faces])
    places = shapely.points(points[:, :2])
    index, number = shapely.STRtree(polygons).query(places, predicate="dwithin", distance=_STEP_REACH_M)
    nearest = shapely.get_coordinates(shapely.shortest_line(polygons[number], places[index]))[::2]
    planes = np.array([roof.planes[face.plane].coefficients for face in roof.faces])[number]
    z = planes[:, 0] * nearest[:, 0] + planes[:, 1] * nearest[:, 1] + planes[:, 2]
    explained = np.zeros(len(points), np.bool_)
    explained[index[points[index, 2] <= z + _STEP_M]] = True
    return explained


def _groups(xy: FloatArray, link_m: float) -> Iterator[IntArray]:
    """Indices of points (n, 2) that are linked in plan, group by group in the order of their first points."""
    first, second = shapely.STRtree(shapely.points(xy)).query(shapely.points(xy), predicate="dwithin", distance=link_m)
    root = list(range(len(xy)))

    def top(k: int) -> int:
        while root[k] != k:
            root[k] = root[root[k]]
            k = root[k]
        return k

    for a, b in zip(first.tolist(), second.tolist(), strict=True):
        if a < b:
            one, other = sorted((top(a), top(b)))
            root[other] = one
    owner = np.array([top(k) for k in range(len(xy))], np.int64)
    for number in np.unique(owner).tolist():
        yield np.flatnonzero(owner == number)


def _box(
    group: IntArray, points: FloatArray, residuals: FloatArray, split: BoolArray, roof: RoofModel
) -> FoundBox | None:
    """The box of a group of points above a roof, None where it is none."""
    if len(group) < MIN_POINTS:
        return None
    z = points[group, 2]
    level = _level_top(z, max(_LEVEL_M, _LEVEL_SIGMAS * roof.noise_m))
    if level is None:
        return None
    on_top = group[level]
    if np.mean(split[on_top]) > _MAX_SPLIT_SHARE:
        return None
    top_z = float(np.quantile(points[on_top, 2], _TOP_QUANTILE))
    foot_z = top_z - float(np.median(residuals[on_top]))
    upper = group[z >= (top_z + foot_z) / 2]
    if len(on_top) < _MIN_LEVEL_SHARE * len(upper):
        return None
    along = _direction(points[on_top, :2].mean(axis=0), roof)
    frame = np.array([along, (-along[1], along[0])])
    local = points[:, :2] @ frame.T
    low, high = local[upper].min(axis=0), local[upper].max(axis=0)
    extent = high - low
    if extent.min() < _MIN_EXTENT_M:
        return None
    grown = np.minimum(2.0 * extent / (len(upper) - 1), _WIDENED_SPACINGS * roof.spacing_m)
    low, high = low - grown / 2, high + grown / 2
    sides = high - low
    if sides.min() < max(_MIN_SIDE_M, _MIN_SIDE_SPACINGS * roof.spacing_m):
        return None
    if sides.max() > _MAX_ASPECT * sides.min() or top_z - foot_z > _MAX_SLENDERNESS * sides.min():
        return None
    if len(upper) < _MIN_FILLED_SHARE * sides[0] * sides[1] / roof.spacing_m**2:
        return None
    beside = max(_MIN_BESIDE_M, _BESIDE_SPACINGS * roof.spacing_m)
    if not ((local[group] >= low - beside) & (local[group] <= high + beside)).all():
        return None
    core = np.abs(local - (low + high) / 2) <= _CORE_SHARE * sides / 2
    inside = core.all(axis=1)
    beneath = inside & (points[:, 2] < (top_z + foot_z) / 2)
    if beneath.sum() > _MAX_BENEATH_SHARE * inside.sum():
        return None
    corners = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]) @ frame
    return FoundBox(corners=corners, top_z_m=top_z)


def _level_top(z: FloatArray, depth_m: float) -> BoolArray | None:
    """Which of some elevations (n,) are a level top, None where few of them are."""
    ordered = np.sort(z)
    counts = np.arange(len(z)) + 1 - np.searchsorted(ordered, ordered - depth_m)
    above = len(z) - 1 - np.arange(len(z))
    tops = np.flatnonzero((counts >= MIN_POINTS) & (above <= _MAX_ABOVE_SHARE * len(z)))
    if len(tops) == 0:
        return None
    top = ordered[tops[np.argmax(counts[tops])]]
    level: BoolArray = (z <= top) & (z >= top - depth_m)
    return level


def _direction(place: FloatArray, roof: RoofModel) -> FloatArray:
    """Direction (2,) of a box: down the roof beneath it, or along the longest wall."""
    number = int(roof.surface.face(place[:1].copy(), place[1:].copy())[0])
    plane = roof.planes[roof.faces[number].plane] if number >= 0 else None
    if plane is not None and plane.slope_deg > _LEVEL_SLOPE_DEG:
        down = np.array([plane.a, plane.b])
    else:
        longest = max(shapely.get_parts(roof.outline), key=lambda part: part.area)
        ring = shapely.get_coordinates(longest.exterior)
        edges = np.diff(ring, axis=0)
        down = edges[int(np.argmax(np.hypot(edges[:, 0], edges[:, 1])))]
    along: FloatArray = down / math.hypot(*down)
    return along
