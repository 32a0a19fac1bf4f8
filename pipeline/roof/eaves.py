"""Straight eaves: the outline around roof points as few straight lines, square to one another where the data allow.

The raw outline zigzags between outermost roof points. It is cut into runs; the line through each is fitted to all of
it, so that the zigzag averages out; lines near the building's dominant direction or square to it take that direction
exactly; corners are where lines meet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import FloatArray
from pipeline.roof.lines import Point, corners, dominant_direction, merge, split, square
from pipeline.roof.settings import RoofSettings


def straighten(outline_mm: MultiPolygon, spacing_m: float, settings: RoofSettings) -> MultiPolygon:
    """Draw an outline with straight lines.

    Parameters
    ----------
    outline_mm : MultiPolygon
        The raw outline, integer millimetres.
    spacing_m : float
        Point spacing; the tolerances are multiples of it.
    settings : RoofSettings
        `eave_tolerance_spacings`, `square_within_deg`.

    Returns
    -------
    MultiPolygon
        Integer millimetres, valid. Rings that would cross, or move too much area, stay raw.
    """
    tolerance = max(settings.eave_tolerance_spacings * spacing_m, 0.2) * 1e3
    within = math.radians(settings.square_within_deg)
    straightened = []
    for polygon in outline_mm.geoms:
        borders = _rings(polygon)
        runs_of = [merge(ring, split(ring, tolerance, closed=True), tolerance, closed=True) for ring in borders]
        dominant = dominant_direction([run for runs in runs_of for run in runs])
        rings = []
        for ring, runs in zip(borders, runs_of, strict=True):
            square(runs, dominant, within, tolerance)
            places = corners(ring, runs, 3.0 * tolerance, closed=True) if runs else []
            rings.append(_accepted(ring, places, tolerance))
        drawn = Polygon(rings[0], rings[1:])
        straightened.append(drawn if drawn.is_valid else polygon)
    result = MultiPolygon(straightened)
    return result if result.is_valid else outline_mm


def _rings(polygon: Polygon) -> list[FloatArray]:
    """Vertices of the rings, the first not repeated, each starting at its vertex farthest from the centroid."""
    rings = []
    for line in (polygon.exterior, *polygon.interiors):
        xy = shapely.get_coordinates(line)[:-1]
        away = ((xy - xy.mean(axis=0)) ** 2).sum(axis=1)
        rings.append(np.roll(xy, -int(np.argmax(np.rint(away))), axis=0))
    return rings


def _accepted(ring: FloatArray, places: Sequence[Point], tolerance: float) -> FloatArray:
    """The corners as a ring where they make a sound one near the raw ring, else the raw ring."""
    if len(places) < 3:
        return ring
    drawn = shapely.set_precision(Polygon(places).normalize(), 1.0) if Polygon(places).is_valid else Polygon()
    raw = Polygon(ring)
    if not isinstance(drawn, Polygon) or drawn.is_empty or len(drawn.interiors) > 0:
        return ring
    if shapely.symmetric_difference(drawn, raw).area > 0.5 * tolerance * raw.length:
        return ring
    accepted: FloatArray = shapely.get_coordinates(drawn.exterior)[:-1]
    return accepted
