"""Edges, corners and directions of outlines, and blocks of outlines that touch."""

from __future__ import annotations

import numpy as np
import shapely

from pipeline.model import BoolArray, FloatArray
from pipeline.ruler.evaluation.building_matching import Geometries, sound_polygons

STRAIGHT_M = 0.05
"""A corner that is closer to the line of its neighbours is not one."""
ALONG_DEG = 5.0
"""An edge follows a direction, or its perpendicular, up to this angle."""
_HALF_GAP_M = 0.15
"""Half of the widest gap between outlines of one block: drawn outlines of neighbours do not meet exactly."""


def ring_of(outline: shapely.Geometry, straight_m: float = STRAIGHT_M) -> FloatArray:
    """The corners of the exterior of a polygon, (k, 2), none on a straight edge; fewer than 3 if it is empty."""
    ring: FloatArray = shapely.get_coordinates(shapely.get_exterior_ring(shapely.simplify(outline, straight_m)))
    return ring[:-1]


def edges_of(ring: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit vectors (k, 2), lengths (k,) and directions (k,) of the edges from each corner of a ring to the next."""
    along = np.roll(ring, -1, axis=0) - ring
    length = np.hypot(along[:, 0], along[:, 1])
    return along / length[:, None], length, directions(along)


def directions(along: FloatArray) -> FloatArray:
    """Directions of vectors (k, 2) in degrees from 0 to 90: an edge and its perpendicular have one."""
    return np.degrees(np.arctan2(along[:, 1], along[:, 0])) % 90.0


def off(direction: FloatArray, other: FloatArray | float, period_deg: float = 90.0) -> FloatArray:
    """Angle between directions, degrees."""
    apart: FloatArray = np.abs(direction - other) % period_deg
    return np.minimum(apart, period_deg - apart)


def main_direction(direction: FloatArray, length: FloatArray) -> float:
    """The direction of the edge that most of the length follows; the first of equal ones."""
    return float(direction[np.argmax([length[off(direction, one) <= ALONG_DEG].sum() for one in direction])])


def turns(units: FloatArray) -> FloatArray:
    """By how many degrees each corner turns, (k,), from 0 (straight on) to 180, from the unit vectors of the edges."""
    cosine = (units * np.roll(units, 1, axis=0)).sum(axis=1)
    turn: FloatArray = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return turn


def united_blocks(outlines: Geometries) -> Geometries:
    """The outlines with gaps of up to 0.3 m closed, united: one polygon for all that touch, (b,)."""
    wider = shapely.buffer(np.append(outlines, shapely.Polygon()), _HALF_GAP_M, join_style="mitre")
    closed = shapely.buffer(shapely.union_all(wider), -_HALF_GAP_M, join_style="mitre")
    parts = [
        max(shapely.get_parts(one), key=shapely.area)
        for one in sound_polygons(shapely.get_parts(closed))
        if one.area > 0.0
    ]
    blocks = np.empty(len(parts), object)
    blocks[:] = parts
    return blocks


def is_near(places: FloatArray, heading: FloatArray, edges: FloatArray, most_m: float) -> BoolArray:
    """Which places (s, 2) have one of some edges (e, 2, 2) near that runs along their heading (s,), degrees."""
    if not len(edges):
        return np.zeros(len(places), np.bool_)
    place, edge = shapely.STRtree(shapely.linestrings(edges)).query(
        shapely.points(places), predicate="dwithin", distance=most_m
    )
    along = edges[:, 1] - edges[:, 0]
    runs = np.degrees(np.arctan2(along[:, 1], along[:, 0]))
    found = np.zeros(len(places), np.bool_)
    found[place[off(heading[place], runs[edge], 180.0) <= ALONG_DEG]] = True
    return found
