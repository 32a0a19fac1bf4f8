"""The points of a tile that count in given footprints, and the footprint that holds each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import BoolArray, IntArray
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS, WindowPoints, never_roof
from pipeline.terrain.ground import Terrain, ground_points
from pipeline.terrain.terrain_settings import ClassesInUse, GroundSettings
from pipeline.tiling import MM, TileGrid

_STRIPS = 2**16 - 1
"""Strips of a tile in which the points of footprints are looked for; their numbers fit two bytes."""


def above_ground(
    points: WindowPoints, index: IntArray, terrain: Terrain, classes: ClassesInUse, settings: GroundSettings
) -> BoolArray:
    """Whether each of the points at `index` counts inside a footprint.

    Where class 6 is believed its points count, else all above the ground that are not of a class that is never roof.
    """
    if classes.building:
        is_building: BoolArray = points.classification[index] == BUILDING_CLASS
        return is_building
    above = ~ground_points(points.x_mm[index], points.y_mm[index], points.z_mm[index], terrain, settings)
    if classes.ground:
        above &= points.classification[index] != GROUND_CLASS
    if classes.roofs:
        above |= points.classification[index] == BUILDING_CLASS
    return above & ~never_roof(points.classification[index], classes)


def inside_footprints(
    points: WindowPoints,
    index: IntArray,
    above: BoolArray,
    footprints: Sequence[Polygon | MultiPolygon],
    grid: TileGrid,
) -> IntArray:
    """The footprint that holds each of the points at `index`, -1 where none does or the point does not count."""
    owner = np.full(len(index), -1, np.int64)
    inner = np.flatnonzero(above)
    if len(inner) == 0:
        return owner
    # sort by strips of the tile, as many as two bytes can number: numpy then sorts stably by radix
    west = int(points.x_mm[index[inner]].min())
    strip_mm = grid.size_mm // _STRIPS + 1
    strip = (points.x_mm[index[inner]] - west) // strip_mm
    order = np.argsort(strip.astype(np.uint16), kind="stable")
    from_west, strip = inner[order], strip[order]
    x, y = points.x_mm[index[from_west]], points.y_mm[index[from_west]]
    # the first wins where footprints overlap, whatever the tile
    for number, polygon in reversed(list(enumerate(footprints))):
        x0, y0, x1, y1 = (round(v * MM) for v in polygon.bounds)
        first = np.searchsorted(strip, (x0 - 1 - west) // strip_mm, side="left")
        last = np.searchsorted(strip, (x1 + 1 - west) // strip_mm, side="right")
        near = first + np.flatnonzero((y[first:last] >= y0 - 1) & (y[first:last] <= y1 + 1))
        if len(near):
            shapely.prepare(polygon)
            inside = shapely.contains_xy(polygon, x[near] / MM, y[near] / MM)
            owner[from_west[near[inside]]] = number
    return owner
