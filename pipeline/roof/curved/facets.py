"""Facets of a curved surface: strips of a barrel, sectors of a cone, rings of sectors of a dome.

The surface is drawn a little larger than it is, so that the facets lie as far outside at their edges as inside at their
middles. Facets meet in edges of equal height: they have planes through three corners, and corners of one ring have one
elevation. Arcs end where the surface is steep; from there one facet leads to where the outline ends.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.model import FloatArray, RoofType
from pipeline.roof.curved.surfaces import Surface

STEEPEST_DEG = 75.0
"""Slope at which an arc ends."""
_SAGITTA, _OUT = 1.5, 2.0 / 3.0
"""Sagitta of a facet in tolerances, and the share of it by which its ends lie outside: the squares are least."""
_FEWEST_SECTORS, _FEWEST_AT_TOP = 16, 5
_NEAR_M = 0.05
"""Edges of facets that pass a corner of the outline at this distance go through it."""
_SMALLER = 0.15
_BEYOND_M = 0.2
"""How far facets go beyond the outline."""
_SHORT = 0.6
"""Sectors are halved where their arcs are shorter than this share of the next ring's width."""
_SAMPLES = 400

Corner = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Facet:
    """A plane facet of a surface, and where it lies in plan."""

    corners: tuple[Corner, ...]
    """Its corners, counter-clockwise, x, y, z in the frame of the surface."""

    @property
    def plane(self) -> tuple[float, float, float]:
        """Coefficients of the plane through its three corners that are farthest apart in order."""
        a, b, c = (np.array(self.corners[k]) for k in (0, 1, len(self.corners) - 1))
        normal = np.cross(b - a, c - a)
        x, y = float(-normal[0] / normal[2]), float(-normal[1] / normal[2])
        return x, y, float(a[2] - x * a[0] - y * a[1])


def facets_of(surface: Surface, outline: FloatArray, tolerance_m: float, turn: float) -> list[Facet]:
    """Facets over all of an outline, whose corners (n, 2) are given, no farther than a tolerance from the surface.

    `turn`, below 1, is the share of a sector by which those of cones and domes are turned; facets are smaller by a part
    of it, too, so that other corners follow.
    """
    sagitta_m = _SAGITTA * tolerance_m * (1.0 - _SMALLER * turn)
    if surface.kind is RoofType.BARREL:
        return _strips(surface, outline, sagitta_m)
    x, y, *_ = surface.parameters
    around = outline - np.array([x, y])
    if surface.kind is RoofType.CONE:
        return _sectors(surface, around, sagitta_m, turn)
    return _rings(surface, around, 0.5 * sagitta_m, turn)


def _snapped(places: FloatArray, corners: FloatArray, near: FloatArray) -> FloatArray:
    """Ascending places, each at the nearest corner (n,) of the outline that is as near to it as that corner allows."""
    away = np.abs(places[:, None] - corners[None, :])
    nearest = away.argmin(axis=1)
    moves = away[np.arange(len(places)), nearest] < near[nearest]
    return np.where(moves, corners[nearest], places)


def _angles(around: FloatArray, count: int, turn: float) -> tuple[FloatArray, float]:
    """The angles (count + 1,) between sectors, through corners of an outline that they nearly meet; reach of them."""
    away = np.hypot(around[:, 0], around[:, 1])
    step = 2.0 * math.pi / count
    angles = np.asarray((np.arange(count) + turn) * step, np.float64)
    corners = np.arctan2(around[:, 1], around[:, 0]) % (2.0 * math.pi)
    corners = np.where(corners < (turn - 0.5) * step, corners + 2.0 * math.pi, corners)
    angles = _snapped(angles, corners, np.minimum(_NEAR_M / np.maximum(away, _NEAR_M), 0.3 * step))
    return np.append(angles, angles[0] + 2.0 * math.pi), float(away.max()) + _BEYOND_M


def _nodes(width: float, height: float, ends: tuple[float, float], sagitta_m: float) -> tuple[FloatArray, FloatArray]:
    """Places and elevations of the corners of an arc of an ellipse between two places, outside by a share."""
    steepest = math.atan(width / height * math.tan(math.radians(STEEPEST_DEG)))
    low, high = (min(max(math.asin(min(max(end / width, -1.0), 1.0)), -steepest), steepest) for end in ends)
    turns = np.linspace(low, high, _SAMPLES)
    speed = np.hypot(width * np.cos(turns), height * np.sin(turns))
    radius = speed**3 / (width * height)
    rate = speed / np.sqrt(8.0 * sagitta_m * radius)
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(turns)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    at = np.interp(np.linspace(0.0, along[-1], math.ceil(along[-1]) + 1), along, turns)
    size = np.hypot(width * np.cos(at), height * np.sin(at))
    out = _OUT * sagitta_m / size
    places, heights = np.sin(at) * (width + out * height), np.cos(at) * (height + out * width)
    return places, heights


def _bridged(
    places: FloatArray, heights: FloatArray, width: float, height: float, ends: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """An arc with a corner at each end of the outline that it does not reach."""
    low, high = ends

    def at(place: float) -> float:
        return height * math.sqrt(max(0.0, 1.0 - (place / width) ** 2))

    if low < places[0] - _BEYOND_M / 2:
        places, heights = np.insert(places, 0, low), np.insert(heights, 0, at(low))
    if high > places[-1] + _BEYOND_M / 2:
        places, heights = np.append(places, high), np.append(heights, at(high))
    return places, heights


def _strips(surface: Surface, outline: FloatArray, sagitta_m: float) -> list[Facet]:
    """Strips along the axis of a barrel."""
    azimuth, at, base, *_ = surface.parameters
    width, height = surface.axes
    along = np.array([math.cos(azimuth), math.sin(azimuth)])
    across = np.array([-along[1], along[0]])
    v, u = outline @ across - at, outline @ along
    ends = float(v.min()), float(v.max())
    places, heights = _bridged(*_nodes(width, height, ends, sagitta_m), width, height, ends)
    snapped = _snapped(places, v, np.full(len(v), _NEAR_M))
    heights += (snapped - places) * np.gradient(heights, places)
    places = snapped
    slopes = np.diff(heights) / np.diff(places)
    first, last = min(places[0], ends[0] - _BEYOND_M), max(places[-1], ends[1] + _BEYOND_M)
    heights[0] += slopes[0] * (first - places[0])
    heights[-1] += slopes[-1] * (last - places[-1])
    places[0], places[-1] = first, last
    low, high = u.min() - _BEYOND_M, u.max() + _BEYOND_M

    def corner(k: int, end: float) -> Corner:
        x, y = (end * along + (places[k] + at) * across).tolist()
        return x, y, float(heights[k] + base)

    return [
        Facet(corners=(corner(k, low), corner(k, high), corner(k + 1, high), corner(k + 1, low)))
        for k in range(len(places) - 1)
    ]


def _sectors(surface: Surface, around: FloatArray, sagitta_m: float, turn: float) -> list[Facet]:
    """Sectors of a cone."""
    x, y, top, slope = surface.parameters
    reach = float(np.hypot(around[:, 0], around[:, 1]).max())
    sag = sagitta_m / (reach * slope / math.hypot(1.0, slope))
    count = max(_FEWEST_SECTORS, math.ceil(math.pi / math.sqrt(2.0 * sag)))
    wide = 1.0 + _OUT * (1.0 - math.cos(math.pi / count))
    angles, reach = _angles(around, count, turn)
    ring = [(x + reach * math.cos(a), y + reach * math.sin(a), top - slope / wide * reach) for a in angles.tolist()]
    return [Facet(corners=((x, y, top), ring[k], ring[k + 1])) for k in range(count)]


def _rings(surface: Surface, around: FloatArray, sagitta: float, turn: float) -> list[Facet]:
    """A level top and rings of sectors of a sphere; towards the top each sector takes the place of two."""
    x, y, base, radius = surface.parameters
    reach = float(np.hypot(around[:, 0], around[:, 1]).max()) + _BEYOND_M
    places, heights = _nodes(radius, radius, (-reach, reach), sagitta)
    if len(places) % 2 == 1:  # a level facet in the middle
        places, heights = _even(radius, reach, sagitta, len(places))
    places, heights = places[len(places) // 2 :], heights[len(heights) // 2 :]
    places, heights = _bridged(places, heights, radius, radius, (places[0], reach))
    if places[-1] < reach:
        slope = (heights[-1] - heights[-2]) / (places[-1] - places[-2])
        heights[-1] += slope * (reach - places[-1])
        places[-1] = reach
    steepest = min(float(places[-2]), radius * math.sin(math.radians(STEEPEST_DEG))) / radius
    wanted = max(float(_FEWEST_SECTORS), math.pi * steepest * math.sqrt(0.5 * radius / sagitta))
    doubled = 2 ** math.floor(math.log2(wanted / _FEWEST_AT_TOP))
    most = doubled * math.ceil(wanted / doubled)
    counts = [most]
    for k in range(len(places) - 2, -1, -1):
        arc, width = 2.0 * math.pi * places[k] / counts[0], places[k + 1] - places[k]
        counts.insert(
            0,
            counts[0] // 2
            if arc < _SHORT * width and counts[0] % 2 == 0 and counts[0] > 2 * _FEWEST_AT_TOP
            else counts[0],
        )
    angles, _ = _angles(around, most, turn)
    wide = [1.0 + _OUT * (1.0 - math.cos(math.pi / count)) for count in counts]

    def corner(ring: int, k: int) -> Corner:
        angle = float(angles[k * (most // counts[ring])])
        away = places[ring] * wide[ring]
        return x + away * math.cos(angle), y + away * math.sin(angle), float(heights[ring] + base)

    found = [Facet(corners=tuple(corner(0, k) for k in range(counts[0])))]
    for ring in range(len(places) - 1):
        for k in range(counts[ring]):
            inner, after = corner(ring, k), corner(ring, k + 1)
            if counts[ring] == counts[ring + 1]:
                found.append(Facet(corners=(inner, corner(ring + 1, k), corner(ring + 1, k + 1), after)))
                continue
            outer = [corner(ring + 1, 2 * k + j) for j in range(3)]
            found.append(Facet(corners=(inner, outer[0], outer[1])))
            found.append(Facet(corners=(inner, outer[1], after)))
            found.append(Facet(corners=(after, outer[1], outer[2])))
    return found


def _even(radius: float, reach: float, sagitta: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Corners of an arc as `_nodes` has them, one more, so that none lies in the middle."""
    end = math.asin(min(reach / radius, math.sin(math.radians(STEEPEST_DEG))))
    at = np.linspace(-end, end, count + 1)
    return np.sin(at) * (radius + _OUT * sagitta), np.cos(at) * (radius + _OUT * sagitta)


def cut_to(outline_mm: shapely.MultiPolygon, facets: Sequence[Facet]) -> tuple[list[shapely.Polygon], list[int]]:
    """The outline cut along the edges of facets: polygons in integer millimetres, and the facet of each."""
    areas = [shapely.Polygon([(round(x * 1e3), round(y * 1e3)) for x, y, _ in one.corners]) for one in facets]
    lines = shapely.intersection(shapely.union_all(shapely.boundary(areas)), outline_mm)
    noded = shapely.union_all([outline_mm.boundary, lines], grid_size=1.0)
    pieces = shapely.get_parts(shapely.polygonize(shapely.get_parts(noded).tolist()))
    inner = shapely.point_on_surface(pieces)
    tree = shapely.STRtree(areas)
    kept = shapely.contains(outline_mm, inner)
    pieces, inner = pieces[kept], inner[kept]
    owners = tree.nearest(inner)
    order = sorted(range(len(pieces)), key=lambda k: (int(owners[k]), inner[k].x, inner[k].y))
    return [pieces[k] for k in order], [int(owners[k]) for k in order]
