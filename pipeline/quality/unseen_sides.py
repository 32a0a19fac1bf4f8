"""Places without any point beside a model: a part of its roof may lie there, wet or hidden, and be left out.

Where a roof returns no pulse, neither does the ground below it, and an outline that follows the points ends too early.
At an eave the roof ends anyway, and the shadow of a wall is often there. A slope that rises up to such a place, or that
it cuts across, may go on, and so may one that has hardly begun to fall. Where a level roof ends, nothing shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray, Plane, RoofFace
from pipeline.quality.residuals import surface_of
from pipeline.terrain.lattice import HALF_DIAGONAL_M

Area: TypeAlias = Polygon | MultiPolygon

# Not settings: they say how an outline is followed.
STEP_M = 0.5
"""Places are looked at so far apart, half the side of a cell."""
_REACH_M = 8.0
"""Half the width of a large house; the cells without points are known as far."""
_START_M, _START_SPACINGS = 1.5, 1.5
"""A place without points begins this near to an outline; cells next to it may hold a point of the roof."""
INSIDE_M = 0.05
"""So far inside an outline lies the face that ends there."""
SLOPED = math.tan(math.radians(7.0))
"""Rise over run from which a face is a slope, as in `flat_below_deg`."""
_CELL_M = 1.0
"""Cells that hold a point of the roof are within this of it."""
_DOWNHILL = -0.7
"""An outline is an eave where it lies within 45 degrees of straight down the slope, as a cosine."""


def unseen_beside_m2(
    footprint: Area,
    faces: Sequence[RoofFace],
    planes: Sequence[Plane],
    voids: FloatArray,
    spacing_m: float,
) -> float:
    """Area beside slopes, except beside low eaves, of cells of 1 m without points nearby; m2, in plan.

    `voids` (v, 2 or 3) are the centres of such cells, all in local metres.
    """
    if len(voids) == 0:
        return 0.0
    places, outward = along(footprint)
    is_end = _ends_of_slopes(places - INSIDE_M * outward, outward, faces, planes)
    places, outward = places[is_end], outward[is_end]
    corner = np.floor(voids[:, :2].min(axis=0)) - 1.0
    shape = tuple((np.floor(voids[:, :2].max(axis=0)) - corner + 2.0).astype(int).tolist())
    is_void = np.zeros(shape, np.bool_)
    is_void[tuple(np.floor(voids[:, :2] - corner).astype(int).T)] = True
    distance = np.arange(0.5 * STEP_M, _REACH_M, STEP_M)
    at = np.floor(places[:, None] + outward[:, None] * distance[None, :, None] - corner).astype(int)
    at = np.clip(at, 0, np.array(shape) - 1)  # the outermost cells hold no void
    hit = is_void[at[..., 0], at[..., 1]]
    first = np.argmax(hit, axis=1)
    starts = hit.any(axis=1) & (distance[first] <= max(_START_M, _START_SPACINGS * spacing_m))
    goes_on = np.logical_and.accumulate(hit | (np.arange(len(distance)) < first[:, None]), axis=1) & hit
    return float(goes_on[starts].sum()) * STEP_M * STEP_M


def unseen_left_out_m2(given: Area, modelled: Area, elsewhere: FloatArray, density_per_m2: float) -> float:
    """Area of a given footprint that a model leaves out and where no point lies, m2.

    `elsewhere` (e, 3) are the centres of the cells of 1 m wholly in the footprint that hold points, but none of the
    roof; of such cells as many are empty by chance as the density lets expect. All in local metres.
    """
    area_m2 = given.area - modelled.area
    if area_m2 < _CELL_M * _CELL_M:
        return 0.0
    left_out = shapely.difference(given, shapely.buffer(modelled, _CELL_M))
    if left_out.is_empty:
        return 0.0
    west, south, east, north = np.floor(left_out.bounds)
    x, y = np.meshgrid(np.arange(west, east + 1.0) + 0.5, np.arange(south, north + 1.0) + 0.5)
    inner = shapely.buffer(left_out, -HALF_DIAGONAL_M)
    shapely.prepare(inner)
    cells = np.count_nonzero(shapely.contains_xy(inner, x, y))
    if cells == 0:
        return 0.0
    held = np.count_nonzero(shapely.contains_xy(inner, elsewhere[:, :2])) / (1.0 - math.exp(-density_per_m2))
    return float(area_m2 * max(0.0, 1.0 - held / cells))


def along(footprint: Area) -> tuple[FloatArray, FloatArray]:
    """Places (n, 2) half a metre apart along the outer rings of an area, and the direction out of it at each."""
    rings = shapely.get_exterior_ring(shapely.get_parts(footprint))
    xy, ring_of = shapely.get_coordinates(rings, return_index=True)
    return _along(xy, ring_of)


@kernel
def _along(xy: FloatArray, ring_of: IntArray) -> tuple[FloatArray, FloatArray]:
    """The kernel of `along`: vertices (v, 2) of closed rings, with the ring of each."""
    area2, count = np.zeros(len(xy)), 0
    for v in range(len(xy) - 1):
        if ring_of[v] == ring_of[v + 1]:
            area2[ring_of[v]] += (xy[v, 0] - xy[0, 0]) * (xy[v + 1, 1] - xy[0, 1])
            area2[ring_of[v]] -= (xy[v + 1, 0] - xy[0, 0]) * (xy[v, 1] - xy[0, 1])
            count += round(math.hypot(xy[v + 1, 0] - xy[v, 0], xy[v + 1, 1] - xy[v, 1]) / STEP_M)
    places, outward = np.empty((count, 2)), np.empty((count, 2))
    count = 0
    for v in range(len(xy) - 1):
        if ring_of[v] != ring_of[v + 1]:
            continue
        dx, dy = xy[v + 1, 0] - xy[v, 0], xy[v + 1, 1] - xy[v, 1]
        length = math.hypot(dx, dy)
        n = round(length / STEP_M)
        side = 1.0 if area2[ring_of[v]] > 0.0 else -1.0
        for k in range(n):
            share = (k + 0.5) / n
            places[count, 0], places[count, 1] = xy[v, 0] + share * dx, xy[v, 1] + share * dy
            outward[count, 0], outward[count, 1] = side * dy / length, -side * dx / length
            count += 1
    return places, outward


def _ends_of_slopes(
    inside: FloatArray, outward: FloatArray, faces: Sequence[RoofFace], planes: Sequence[Plane]
) -> BoolArray:
    """Which places (n, 2) just inside an outline lie on a slope, except at its eave in the lower half of the roof."""
    ends = np.zeros(len(inside), np.bool_)
    heights = shapely.get_coordinates([face.polygon for face in faces], include_z=True)[:, 2]
    middle = 0.5 * float(heights.min() + heights.max())
    for face in faces:
        plane = planes[face.plane]
        up = np.array((plane.a, plane.b))
        rise = float(np.hypot(*up))
        if rise >= SLOPED:
            goes_on = (outward @ up / rise > _DOWNHILL) | (inside @ up + plane.c > middle)
            ends |= shapely.intersects_xy(face.polygon, inside) & goes_on
    return ends


# Not settings: they say what level with the ground means.
_OUTSIDE_M = 1.5
"""The ground is looked up so far from an outline: the sample is free of the roof."""


_LEAST_M = 3.0
"""Less of an outline is level by chance: a bank or a lower annex beside a shed."""


_LEVEL_M = 0.3
"""A step that one takes; as in `terrain.fragment_sums`."""


def level_side_share(
    footprint: Polygon | MultiPolygon, faces: Sequence[RoofFace], planes: Sequence[Plane], ground: FloatArray
) -> float:
    """Share of an outline where a level face ends at ground that is as high or higher; 0 if that is short.

    `ground` (m, 3) are samples of the terrain, on a lattice of 1 m; all in local metres.
    """
    is_level = np.array([math.hypot(plane.a, plane.b) < SLOPED for plane in planes])
    if len(ground) == 0 or not is_level.any():
        return 0.0
    places, outward = along(footprint)
    if len(places) == 0:
        return 0.0
    inside = np.column_stack((places - INSIDE_M * outward, np.zeros(len(places))))
    below, face = surface_of(faces, planes).residuals(inside)
    ends = face >= 0
    ends[ends] = is_level[np.array([one.plane for one in faces])[face[ends]]]
    terrain = _terrain_at(ground, places[ends] + _OUTSIDE_M * outward[ends])
    at_ground = np.count_nonzero(terrain >= -below[ends] - _LEVEL_M)
    return float(at_ground) / len(places) if at_ground * STEP_M >= _LEAST_M else 0.0


def _terrain_at(ground: FloatArray, places: FloatArray) -> FloatArray:
    """Elevation (n,) of the samples (m, 3) in whose cells of 1 m some places (n, 2) lie; nan where there is none."""
    corner = np.floor(ground[:, :2].min(axis=0)) - 1.0
    columns, rows = (np.floor(ground[:, :2].max(axis=0)) - corner + 2.0).astype(int).tolist()
    elevation = np.full((columns, rows), np.nan)
    column, row = np.floor(ground[:, :2] - corner).astype(int).T
    elevation[column, row] = ground[:, 2]
    column, row = np.floor(places - corner).astype(int).T
    found: FloatArray = elevation[np.clip(column, 0, columns - 1), np.clip(row, 0, rows - 1)]
    return found
