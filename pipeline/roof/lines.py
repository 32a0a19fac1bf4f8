"""Straight lines through stretches of a ragged border.

A border is cut into runs by Douglas and Peucker's rule (1973). Its chords end at the extremes of the zigzag, so
neighbouring runs are united again while one line of least squares passes near all their vertices.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.compiler import kernel
from pipeline.model import FloatArray

Point = tuple[float, float]

_PARALLEL = math.sin(math.radians(20.0))
"""Lines that meet at a smaller angle have no certain corner: their noise moves it by several tolerances."""


@dataclasses.dataclass
class Run:
    """A stretch of a border and the line through it."""

    first: int
    """Index of its first vertex on the border."""
    last: int
    """Index of its last one, which is the first of the next run; may exceed the length of a closed border."""
    x: float
    """The line's point: centroid of the stretch."""
    y: float
    direction: float
    """Direction of the line along the border, radians."""
    length: float
    """From the first to the last vertex."""
    exact: bool = False
    """Whether the line is known otherwise than by the stretch."""


def fitted_run(border: FloatArray, first: int, last: int) -> Run:
    """The line of least squares through the stretch between two vertices, every piece weighted by its length.

    The first vertex of a closed border (n, 2) is not repeated; `last` is greater than `first`, both are taken modulo n.
    """
    x, y, direction, length = _fit(border, first, last)
    return Run(first=first, last=last, x=x, y=y, direction=direction, length=length)


@kernel
def _fit(border: FloatArray, first: int, last: int) -> tuple[float, float, float, float]:
    """Centroid x, y, direction and chord of a stretch, from second moments of its pieces' middles and extents."""
    n = len(border)
    x0, y0 = border[first % n, 0], border[first % n, 1]
    total = 0.0
    cx = 0.0
    cy = 0.0
    for turn in range(2):
        sxx = 0.0
        sxy = 0.0
        syy = 0.0
        for i in range(first, last):
            ax, ay = border[i % n, 0] - x0, border[i % n, 1] - y0
            bx, by = border[(i + 1) % n, 0] - x0, border[(i + 1) % n, 1] - y0
            ux, uy = bx - ax, by - ay
            weight = math.sqrt(ux * ux + uy * uy)
            mx, my = 0.5 * (ax + bx) - cx, 0.5 * (ay + by) - cy
            if turn == 0:
                total += weight
                sxx += weight * mx
                syy += weight * my
            else:
                sxx += weight * (mx * mx + ux * ux / 12.0)
                sxy += weight * (mx * my + ux * uy / 12.0)
                syy += weight * (my * my + uy * uy / 12.0)
        if total == 0.0:
            return x0, y0, 0.0, 0.0
        if turn == 0:
            cx = sxx / total
            cy = syy / total
    direction = 0.5 * math.atan2(2.0 * sxy, sxx - syy)
    chord_x, chord_y = border[last % n, 0] - x0, border[last % n, 1] - y0
    if math.cos(direction) * chord_x + math.sin(direction) * chord_y < 0.0:
        direction += math.pi
    return cx + x0, cy + y0, direction, math.sqrt(chord_x * chord_x + chord_y * chord_y)


@kernel
def _off_line(border: FloatArray, first: int, last: int, x: float, y: float, direction: float) -> float:
    """Largest distance of a stretch's vertices from a line, in the unit of the coordinates."""
    ux, uy = math.cos(direction), math.sin(direction)
    largest = 0.0
    for i in range(first, last + 1):
        k = i % len(border)
        largest = max(largest, abs(ux * (border[k, 1] - y) - uy * (border[k, 0] - x)))
    return largest


def split(border: FloatArray, tolerance: float, *, closed: bool) -> list[Run]:
    """Cut a border into runs whose vertices lie within the tolerance, in the unit of the coordinates, of their chords.

    The first vertex of a closed border (n, 2), whose last is joined to it, is not repeated, and a run starts there.
    Such a border has at least three runs, or none.
    """
    path = np.vstack((border, border[:1])) if closed else border
    kept = shapely.get_coordinates(shapely.simplify(shapely.linestrings(path), tolerance, preserve_topology=False))
    index, at = [], 0
    for x, y in kept.tolist():
        while path[at, 0] != x or path[at, 1] != y:
            at += 1
        index.append(at)
        at += 1
    index[-1] = len(path) - 1
    if closed and len(index) < 4:
        return []
    return [fitted_run(border, first, last) for first, last in itertools.pairwise(index)]


def merge(border: FloatArray, runs: Sequence[Run], tolerance: float, *, closed: bool) -> list[Run]:
    """Unite neighbouring runs while one line passes within the tolerance of all their vertices, the best pair first.

    Vertices and tolerance are as for `split`; exact runs stay, and of a closed border at least three runs.
    """
    merged = list(runs)
    least = 3 if closed else 1

    def united(k: int) -> tuple[float, Run] | None:
        a, b = merged[k], merged[(k + 1) % len(merged)]
        if a.exact or b.exact or len(merged) <= least or (k + 1 == len(merged) and not closed):
            return None
        last = b.last if b.last > a.first else b.last + len(border)
        run = fitted_run(border, a.first, last)
        off: float = _off_line(border, run.first, run.last, run.x, run.y, run.direction)
        return off, run

    pairs = [united(k) for k in range(len(merged))]
    while True:
        off, k = min(((pair[0], k) for k, pair in enumerate(pairs) if pair is not None), default=(math.inf, -1))
        pair = pairs[k] if k >= 0 else None
        if pair is None or off > tolerance or len(merged) <= least:
            return merged
        merged[k] = pair[1]
        following = (k + 1) % len(merged)
        del merged[following], pairs[following]
        if following < k:
            k -= 1
        for j in {k, (k - 1) % len(merged)}:
            pairs[j] = united(j)


def dominant_direction(runs: Sequence[Run]) -> float | None:
    """The direction, modulo a right angle, that most of the runs' squared length follows; None where there is none."""
    weights = [run.length**2 for run in runs]
    cosine = math.fsum(w * math.cos(4.0 * run.direction) for w, run in zip(weights, runs, strict=True))
    sine = math.fsum(w * math.sin(4.0 * run.direction) for w, run in zip(weights, runs, strict=True))
    if not runs or math.hypot(cosine, sine) < 0.5 * math.fsum(weights):
        return None
    return math.atan2(sine, cosine) / 4.0


def square(runs: Sequence[Run], dominant: float | None, within: float, tolerance: float) -> None:
    """Give runs near the dominant direction (radians), or square to it, that direction, in place; exact ones stay.

    "Near" is `within`, radians, or for short runs, which are less certain, the tolerance over their length.
    """
    if dominant is None:
        return
    quarter = 0.5 * math.pi
    for run in runs:
        turns = round((run.direction - dominant) / quarter)
        off = abs(run.direction - dominant - turns * quarter)
        if not run.exact and off <= max(within, math.atan2(tolerance, run.length)):
            run.direction = dominant + turns * quarter


def crossing(a: Run, b: Run) -> Point | None:
    """Where two lines meet; None where they are nearly parallel."""
    ux, uy = math.cos(a.direction), math.sin(a.direction)
    wx, wy = math.cos(b.direction), math.sin(b.direction)
    determinant = ux * wy - uy * wx
    if abs(determinant) < _PARALLEL:
        return None
    t = ((b.x - a.x) * wy - (b.y - a.y) * wx) / determinant
    return a.x + t * ux, a.y + t * uy


def projected(point: Point, run: Run) -> Point:
    """The nearest point of a line."""
    ux, uy = math.cos(run.direction), math.sin(run.direction)
    t = (point[0] - run.x) * ux + (point[1] - run.y) * uy
    return run.x + t * ux, run.y + t * uy


def corners(border: FloatArray, runs: Sequence[Run], reach: float, *, closed: bool) -> list[Point]:
    """Where neighbouring lines meet.

    Lines that meet nowhere, or farther than `reach` from the vertex between their runs, are joined there by a short
    piece square to them. The first corner of a closed border is that of the last run and the first.
    """
    pairs = list(itertools.pairwise(runs))
    if closed:
        pairs.insert(0, (runs[-1], runs[0]))
    found: list[Point] = []
    for a, b in pairs:
        x, y = border[b.first % len(border)].tolist()
        corner = crossing(a, b)
        if corner is not None and math.dist(corner, (x, y)) <= reach:
            found.append(corner)
        else:
            found.extend((projected((x, y), a), projected((x, y), b)))
    return found
