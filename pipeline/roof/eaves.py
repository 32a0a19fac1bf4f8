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
from pipeline.roof.footprint import polygons_of
from pipeline.roof.lines import Point, corners, dominant_direction, merge, split, square
from pipeline.roof.settings import RoofSettings

_FACTORS = (1.0, 0.6, 0.35)
"""Times the tolerance: what cannot be drawn with few lines is tried with more."""

_MOVED = 0.4
"""Most area between the raw outline and the lines: this part of the tolerance times the outline's length."""


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
        Integer millimetres, valid. A ring that would move too much area stays raw.
    """
    straightened: list[Polygon] = []
    for polygon in outline_mm.geoms:
        outer, *holes = _straight_rings(polygon, spacing_m, settings)
        drawn = Polygon(outer, holes)
        if not drawn.is_valid:
            # a hole that crosses the outside cuts into it
            cut = shapely.difference(
                Polygon(outer), shapely.union_all([Polygon(hole) for hole in holes]), grid_size=1.0
            )
            drawn = max(polygons_of(cut), key=lambda part: part.area, default=polygon)
        straightened.append(drawn)
    result = MultiPolygon(straightened)
    if not result.is_valid:
        result = MultiPolygon(polygons_of(shapely.union_all(straightened, grid_size=1.0)))
    return result if result.is_valid and not result.is_empty else outline_mm


def _straight_rings(polygon: Polygon, spacing_m: float, settings: RoofSettings) -> list[FloatArray]:
    """The rings of one part with straight lines; a ring that will not be drawn so stays raw."""
    borders = _rings(polygon)
    rings: list[FloatArray | None] = [None] * len(borders)
    within = math.radians(settings.square_within_deg)
    for factor in _FACTORS:
        tolerance = max(factor * settings.eave_tolerance_spacings * spacing_m, 0.2) * 1e3
        runs_of = [merge(ring, split(ring, tolerance, closed=True), tolerance, closed=True) for ring in borders]
        dominant = dominant_direction([run for runs in runs_of for run in runs])
        for k, (ring, runs) in enumerate(zip(borders, runs_of, strict=True)):
            if rings[k] is None and runs:
                square(runs, dominant, within, tolerance)
                rings[k] = _accepted(ring, corners(ring, runs, 3.0 * tolerance, closed=True), tolerance)
        if all(ring is not None for ring in rings):
            break
    return [raw if ring is None else ring for raw, ring in zip(borders, rings, strict=True)]


def _rings(polygon: Polygon) -> list[FloatArray]:
    """Vertices of the rings, the first not repeated, each starting at its vertex farthest from the centroid."""
    rings = []
    for line in (polygon.exterior, *polygon.interiors):
        xy = shapely.get_coordinates(line)[:-1]
        away = ((xy - xy.mean(axis=0)) ** 2).sum(axis=1)
        rings.append(np.roll(xy, -int(np.argmax(np.rint(away))), axis=0))
    return rings


def _accepted(ring: FloatArray, places: Sequence[Point], tolerance: float) -> FloatArray | None:
    """The corners as a ring where they make a sound one near the raw ring; small loops at corners are cut off."""
    if len(places) < 3:
        return None
    drawn = shapely.make_valid(Polygon(places), method="structure", keep_collapsed=False)
    parts = [part for polygon in polygons_of(drawn) for part in polygons_of(shapely.set_precision(polygon, 1.0))]
    raw = Polygon(ring)
    if not parts:
        return None
    largest = Polygon(max(parts, key=lambda part: part.area).exterior)
    if shapely.symmetric_difference(largest, raw).area > _MOVED * tolerance * raw.length:
        return None
    accepted: FloatArray = shapely.get_coordinates(largest.exterior)[:-1]
    return accepted
