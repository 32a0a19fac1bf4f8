"""Straight eaves: the outline around roof points as few straight lines, square to one another where the data allow.

The raw outline zigzags between outermost roof points. It is cut into runs by Douglas and Peucker's rule (1973); the
line through each run is fitted to all of it, so that the zigzag averages out; lines near the building's dominant
direction or square to it take that direction exactly; corners are where lines meet.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import FloatArray
from pipeline.roof.settings import RoofSettings

_PARALLEL = math.sin(math.radians(20.0))


@dataclasses.dataclass
class Run:
    """A stretch of the raw outline and the line through it."""

    first: int
    """Index of its first vertex on the ring."""
    last: int
    """Index of its last one, which is the first of the next run; may exceed the ring's length."""
    x: float
    """The line's point: centroid of the stretch."""
    y: float
    direction: float
    """Of the line along the ring, radians."""
    length: float
    """From the first to the last vertex."""


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
    straightened = []
    for polygon in outline_mm.geoms:
        dominant = dominant_direction([_runs(ring, tolerance) for ring in _rings(polygon)])
        rings = []
        for ring in _rings(polygon):
            runs = _runs(ring, tolerance)
            square_runs(runs, dominant, math.radians(settings.square_within_deg), tolerance)
            runs = _merged(ring, runs, tolerance)
            square_runs(runs, dominant, math.radians(settings.square_within_deg), tolerance)
            rings.append(_accepted(ring, _corners(ring, runs, tolerance), tolerance))
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


def _runs(ring: FloatArray, tolerance: float) -> list[Run]:
    """Cut a ring into runs that stay within the tolerance of their chords."""
    n = len(ring)
    closed = np.vstack((ring, ring[:1]))
    kept = shapely.get_coordinates(shapely.simplify(shapely.linestrings(closed), tolerance, preserve_topology=False))
    index, at = [], 0
    for x, y in kept.tolist():
        while closed[at, 0] != x or closed[at, 1] != y:
            at += 1
        index.append(at)
        at += 1
    if len(index) < 4:
        return []
    return [fitted_run(ring, a, b) for a, b in zip(index[:-1], [*index[1:-1], n], strict=True)]


def fitted_run(ring: FloatArray, first: int, last: int) -> Run:
    """The line of least squares through the stretch between two vertices, every piece by its length."""
    n = len(ring)
    path = ring[np.arange(first, last + 1) % n]
    middle = 0.5 * (path[1:] + path[:-1])
    step = path[1:] - path[:-1]
    weight = np.hypot(step[:, 0], step[:, 1])
    total = math.fsum(weight.tolist())
    cx, cy = (math.fsum((weight * middle[:, k]).tolist()) / total for k in range(2))
    dx, dy = middle[:, 0] - cx, middle[:, 1] - cy
    # second moments of pieces: their middles and their own extent
    sxx = math.fsum((weight * (dx * dx + step[:, 0] ** 2 / 12.0)).tolist())
    sxy = math.fsum((weight * (dx * dy + step[:, 0] * step[:, 1] / 12.0)).tolist())
    syy = math.fsum((weight * (dy * dy + step[:, 1] ** 2 / 12.0)).tolist())
    chord_x, chord_y = (path[-1] - path[0]).tolist()
    direction = 0.5 * math.atan2(2.0 * sxy, sxx - syy)
    if math.cos(direction) * chord_x + math.sin(direction) * chord_y < 0.0:
        direction += math.pi
    return Run(first=first, last=last, x=cx, y=cy, direction=direction, length=math.hypot(chord_x, chord_y))


def dominant_direction(rings: Sequence[Sequence[Run]]) -> float | None:
    """The direction, modulo a right angle, that most of the outline follows; None where there is none."""
    runs = [run for ring in rings for run in ring]
    weights = [run.length**2 for run in runs]
    if not runs:
        return None
    cosine = math.fsum(w * math.cos(4.0 * run.direction) for w, run in zip(weights, runs, strict=True))
    sine = math.fsum(w * math.sin(4.0 * run.direction) for w, run in zip(weights, runs, strict=True))
    if math.hypot(cosine, sine) < 0.5 * math.fsum(weights):
        return None
    return math.atan2(sine, cosine) / 4.0


def square_runs(runs: Sequence[Run], dominant: float | None, within: float, tolerance: float) -> None:
    """Give runs near the dominant direction, or square to it, that direction; short ones are less certain."""
    if dominant is None:
        return
    for run in runs:
        quarter = 0.5 * math.pi
        turns = round((run.direction - dominant) / quarter)
        off = abs(run.direction - dominant - turns * quarter)
        if off <= max(within, math.atan2(tolerance, run.length)):
            run.direction = dominant + turns * quarter


def _turn(a: Run, b: Run) -> float:
    """Angle from the one direction to the other, -pi to pi."""
    return math.remainder(b.direction - a.direction, 2.0 * math.pi)


def _merged(ring: FloatArray, runs: Sequence[Run], tolerance: float) -> list[Run]:
    """Unite neighbouring runs that lie on nearly one line."""
    merged = list(runs)
    k = 0
    while len(merged) > 4 and k < len(merged):
        a, b = merged[k], merged[(k + 1) % len(merged)]
        offset = abs(math.cos(a.direction) * (b.y - a.y) - math.sin(a.direction) * (b.x - a.x))
        if abs(_turn(a, b)) < 0.1 and offset < 0.7 * tolerance:
            last = b.last if b.last > a.first else b.last + len(ring)
            merged[k] = fitted_run(ring, a.first, last)
            del merged[(k + 1) % len(merged)]
            k = max(0, k - 1)
        else:
            k += 1
    return merged


def _corners(ring: FloatArray, runs: Sequence[Run], tolerance: float) -> list[tuple[float, float]]:
    """Where neighbouring lines meet; lines that (nearly) do not are joined by a short piece at their common vertex."""
    corners: list[tuple[float, float]] = []
    for a, b in zip([*runs[-1:], *runs[:-1]], runs, strict=True):
        vx, vy = ring[b.first % len(ring)].tolist()
        ux, uy = math.cos(a.direction), math.sin(a.direction)
        wx, wy = math.cos(b.direction), math.sin(b.direction)
        determinant = ux * wy - uy * wx
        if abs(determinant) > _PARALLEL:
            t = ((b.x - a.x) * wy - (b.y - a.y) * wx) / determinant
            x, y = a.x + t * ux, a.y + t * uy
            if math.hypot(x - vx, y - vy) <= 3.0 * tolerance:
                corners.append((x, y))
                continue
        for run in (a, b):
            t = (vx - run.x) * math.cos(run.direction) + (vy - run.y) * math.sin(run.direction)
            corners.append((run.x + t * math.cos(run.direction), run.y + t * math.sin(run.direction)))
    return corners


def _accepted(ring: FloatArray, corners: Sequence[tuple[float, float]], tolerance: float) -> FloatArray:
    """The corners as a ring where they make a sound one near the raw ring, else the raw ring."""
    if len(corners) < 3:
        return ring
    drawn = shapely.set_precision(Polygon(corners).normalize(), 1.0) if Polygon(corners).is_valid else Polygon()
    raw = Polygon(ring)
    if not isinstance(drawn, Polygon) or drawn.is_empty or len(drawn.interiors) > 0:
        return ring
    if shapely.symmetric_difference(drawn, raw).area > 0.5 * tolerance * raw.length:
        return ring
    accepted: FloatArray = shapely.get_coordinates(drawn.exterior)[:-1]
    return accepted
