"""Sides of a level roof where the ground stands as high: so a deck or a terrace on a slope looks, seldom a house.

From above, only this differs between a house and a terrace with retaining walls. A garage in a slope looks the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from shapely import MultiPolygon, Polygon

from pipeline.model import FloatArray, Plane, RoofFace
from pipeline.quality.residuals import surface_of
from pipeline.quality.unseen_sides import INSIDE_M, SLOPED, STEP_M, along

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
