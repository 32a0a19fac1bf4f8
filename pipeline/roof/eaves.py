"""Straight eaves: the outline around roof points as few straight lines, square to one another where the data allow.

The raw outline zigzags between outermost roof points. It is cut into runs; the line through each is fitted to all of
it, so that the zigzag averages out; lines near a dominant direction of the building or square to it take that direction
exactly; each line is moved to where the points along it put the edge; corners are where lines meet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon
from shapely.geometry.polygon import orient

from pipeline.compiler import kernel
from pipeline.model import FloatArray
from pipeline.roof.edge_position import EdgePoints, mixed_pulse_reach_mm, outward_shift_mm
from pipeline.roof.footprint import polygons_of
from pipeline.roof.lines import Point, Run, corners, merge, split
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.snapped_rings import differ_by_more, on_grid, snapped_ring

_FACTORS = (1.0, 0.6, 0.35)
"""Multiples of the tolerance: a ring that cannot be drawn with few lines is tried with more."""
_FINEST_M = 0.2
"""Smallest tolerance with those factors: no survey shows finer details of an eave."""
_FIRST_SHARE = 0.4
_OTHER_SHARE = 0.2
"""Least share of the squared lengths for a dominant direction: see `dominant_directions`."""
_SURELY_SQUARE = math.radians(2.0)
"""A long line this near to a dominant direction takes it: its direction is not known better."""
_MOVED = 0.4
"""Most area between the raw outline and the lines: this part of the tolerance times the outline's length."""


def straighten(
    outline_mm: MultiPolygon, spacing_m: float, settings: RoofSettings, points: EdgePoints | None = None
) -> MultiPolygon:
    """Draw an outline with straight lines, valid in integer millimetres; a ring that moves too much area stays raw.

    The tolerances are multiples of the point spacing. With the roof points every line that is long enough moves to the
    edge that they show, and the outline is drawn back by what mixed pulses add; without them lines stay amid the raw
    zigzag.
    """
    reach_mm = 0.0 if points is None else mixed_pulse_reach_mm(outline_mm, points)
    raw = _drawn_back(outline_mm, reach_mm)
    straightened: list[Polygon] = []
    for part in raw:
        outer, *holes = _straight_rings(part, spacing_m, settings, points, reach_mm)
        drawn = Polygon(outer, holes)
        if not drawn.is_valid:
            # a hole that crosses the outside cuts into it
            cut = shapely.difference(
                Polygon(outer), shapely.union_all([Polygon(hole) for hole in holes]), grid_size=1.0
            )
            drawn = max(polygons_of(cut), key=lambda piece: piece.area, default=orient(part))
        straightened.append(drawn)
    result = MultiPolygon(straightened)
    if not result.is_valid:
        result = MultiPolygon(polygons_of(shapely.union_all(straightened, grid_size=1.0)))
    return result if result.is_valid and not result.is_empty else MultiPolygon(raw)


def _drawn_back(outline_mm: MultiPolygon, reach_mm: float) -> list[Polygon]:
    """Every part smaller by a distance all around; one that would vanish or fall apart stays."""
    parts: list[Polygon] = list(outline_mm.geoms)
    if reach_mm <= 0.0:
        return parts
    smaller = [polygons_of(on_grid(shapely.buffer(part, -reach_mm, join_style="mitre"))) for part in parts]
    drawn = [pieces[0] if len(pieces) == 1 else part for pieces, part in zip(smaller, parts, strict=True)]
    return drawn if len(drawn) == 1 or MultiPolygon(drawn).is_valid else parts


def _straight_rings(
    polygon: Polygon, spacing_m: float, settings: RoofSettings, points: EdgePoints | None, reach_mm: float
) -> list[FloatArray]:
    """The rings of one part with straight lines; a ring that cannot be drawn so stays raw."""
    borders = _rings(polygon)
    rings: list[FloatArray | None] = [None] * len(borders)
    within = math.radians(settings.square_within_deg)
    for factor in _FACTORS:
        tolerance_m = max(settings.eave_tolerance_spacings * spacing_m, settings.min_eave_tolerance_m)
        tolerance = max(factor * tolerance_m, _FINEST_M) * 1e3
        runs_of = [merge(ring, split(ring, tolerance, closed=True), tolerance, closed=True) for ring in borders]
        dominant = dominant_directions([run for runs in runs_of for run in runs], within)
        for k, (ring, runs) in enumerate(zip(borders, runs_of, strict=True)):
            if rings[k] is None and runs:
                _take_directions(runs, dominant, within, tolerance)
                if points is not None:
                    _take_positions(ring, runs, points, reach_mm)
                rings[k] = _accepted(ring, corners(ring, runs, 1.5 * tolerance, closed=True), tolerance)
        if all(ring is not None for ring in rings):
            break
    return [raw if ring is None else ring for raw, ring in zip(borders, rings, strict=True)]


def dominant_directions(runs: Sequence[Run], within: float) -> list[float]:
    """The directions, modulo a right angle, that the walls of a building follow, the one with most walls first.

    All in radians. Lines closer than `within` to a direction, or to the one square to it, follow it. A direction counts
    with the squared lengths of its lines: the first holds at least 40 % of them all, more than a round outline gives
    any direction (2 / 7.5 at 12 degrees), each other one 20 %.
    """
    left = list(runs)
    whole = math.fsum(run.length**2 for run in runs)
    found: list[float] = []
    while left and whole > 0.0:
        best, members = 0.0, []
        for run in left:
            near = [other for other in left if abs(off_square(other.direction, run.direction)) <= within]
            weight = math.fsum(other.length**2 for other in near)
            if weight > best * (1.0 + 1e-9):
                best, members, about = weight, near, run.direction
        if best < (_OTHER_SHARE if found else _FIRST_SHARE) * whole:
            break
        off = math.fsum(run.length**2 * off_square(run.direction, about) for run in members)
        found.append(about + off / best)
        left = [run for run in left if all(run is not member for member in members)]
    return found


def off_square(direction: float, dominant: float) -> float:
    """By how much a direction differs from the nearest one along or square to another, radians."""
    return math.remainder(direction - dominant, 0.5 * math.pi)


def _take_directions(runs: Sequence[Run], dominant: Sequence[float], within: float, tolerance: float) -> None:
    """Give runs near a dominant direction, or square to it, that direction.

    A short run is less certain: it may be off by the tolerance over its length. A long one is more certain: turned into
    the direction it must stay within the tolerance at its ends, or be off by no more than 2 degrees.
    """
    for run in runs:
        offs = [off_square(run.direction, direction) for direction in dominant]
        off = min(offs, key=abs, default=math.inf)
        most = max(within, math.atan2(tolerance, run.length))
        if abs(off) <= min(most, max(_SURELY_SQUARE, math.atan2(2.0 * tolerance, run.length))):
            run.direction -= off


def _take_positions(ring: FloatArray, runs: Sequence[Run], points: EdgePoints, reach_mm: float) -> None:
    """Move runs to where the points along them put the edge; runs that are too short stay."""
    for run in runs:
        shift = outward_shift_mm(ring, run, points, reach_mm)
        if shift is not None:
            shift = min(max(shift, -points.spacing_mm), points.spacing_mm)
            run.x += shift * math.sin(run.direction)
            run.y -= shift * math.cos(run.direction)


def _rings(polygon: Polygon) -> list[FloatArray]:
    """Vertices of the rings, the first not repeated, each starting at its vertex farthest from the centroid.

    The roof is on the left of all of them.
    """
    lines = (polygon.exterior, *polygon.interiors)
    return [_turned(shapely.get_coordinates(line)[:-1], k > 0) for k, line in enumerate(lines)]


@kernel
def _turned(ring: FloatArray, is_hole: bool) -> FloatArray:
    """A ring (n, 2) that turns left, or right as a hole, and starts at the vertex farthest from their centroid."""
    n = len(ring)
    twice_area, mean_x, mean_y = 0.0, 0.0, 0.0
    for k in range(n):
        following = (k + 1) % n
        twice_area += ring[k, 0] * ring[following, 1] - ring[following, 0] * ring[k, 1]
        mean_x, mean_y = mean_x + ring[k, 0], mean_y + ring[k, 1]
    mean_x, mean_y = mean_x / n, mean_y / n
    start, farthest = 0, -1.0
    turned = ring.copy() if (twice_area >= 0.0) != is_hole else np.concatenate((ring[:1], ring[:0:-1]))
    for k in range(n):
        x, y = turned[k, 0] - mean_x, turned[k, 1] - mean_y
        away = np.rint(x * x + y * y)
        if away > farthest:
            start, farthest = k, away
    return np.concatenate((turned[start:], turned[:start]))


def _accepted(ring: FloatArray, places: Sequence[Point], tolerance: float) -> FloatArray | None:
    """The corners as a ring where they make a sound one near the raw ring; small loops at corners are cut off."""
    if len(places) < 3:
        return None
    drawn = snapped_ring(np.array(places))
    if len(drawn) == 0:
        sound = shapely.make_valid(Polygon(places), method="structure", keep_collapsed=False)
        parts = [part for polygon in polygons_of(sound) for part in polygons_of(shapely.set_precision(polygon, 1.0))]
        if not parts:
            return None
        drawn = shapely.get_coordinates(max(parts, key=lambda part: part.area).exterior)[:-1]
    return None if differ_by_more(drawn, ring, _MOVED * tolerance * Polygon(ring).length) else drawn
