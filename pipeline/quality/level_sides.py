"""Sides of a level roof where the ground stands as high: so a deck or a terrace on a slope looks, seldom a house.

From above, only this differs between a house and a terrace with retaining walls. A garage in a slope looks the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from scipy.spatial import cKDTree
from shapely import MultiPolygon, Polygon

from pipeline.model import FloatArray, Plane, RoofFace
from pipeline.quality.unseen_sides import INSIDE_M, SLOPED, along

# Not settings: they say what level with the ground means.
_OUTSIDE_M = 1.5
"""The ground is looked up so far from an outline: the sample is free of the roof."""
_NEAR_M = 1.0
"""No sample of the terrain is farther from its place than the side of a cell."""
_LEVEL_M = 0.3
"""A step that one takes; as in `terrain.fragment_sums`."""


def level_side_share(
    footprint: Polygon | MultiPolygon, faces: Sequence[RoofFace], planes: Sequence[Plane], ground: FloatArray
) -> float:
    """Share of an outline where a level face ends at ground that is as high or higher.

    `ground` (m, 3) are samples of the terrain, on a lattice of 1 m; all in local metres.
    """
    places, outward = along(footprint)
    if len(places) == 0 or len(ground) == 0:
        return 0.0
    inside = places - INSIDE_M * outward
    roof = np.full(len(places), np.inf)
    for face in faces:
        plane = planes[face.plane]
        if math.hypot(plane.a, plane.b) < SLOPED:
            own = shapely.intersects_xy(face.polygon, inside)
            roof[own] = plane.a * inside[own, 0] + plane.b * inside[own, 1] + plane.c
    distance, nearest = cKDTree(ground[:, :2]).query(places + _OUTSIDE_M * outward)
    is_level = (distance <= _NEAR_M) & (ground[nearest, 2] >= roof - _LEVEL_M)
    return float(is_level.mean())
