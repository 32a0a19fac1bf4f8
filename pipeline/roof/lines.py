"""Straight lines through stretches of a ragged border, and the corners where they meet."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray

Point = tuple[float, float]

_PARALLEL = math.sin(math.radians(8.0))
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
    """Whether the line, or its direction, is known otherwise than by the stretch."""
    own: float = math.nan
    """Direction of the stretch alone, radians; known where `fitted_runs` found it."""


def fitted_run(border: FloatArray, first: int, last: int) -> Run:
    """The line of least squares through the stretch between two vertices, every piece weighted by its length.

    The first vertex of a closed border (n, 2) is not repeated; `last` is greater than `first`, both are taken modulo n.
    """
    x, y, direction, length = _fit(border, first, last)
    return Run(first=first, last=last, x=x, y=y, direction=direction, length=length)


def fitted_runs(border: FloatArray, ends: IntArray) -> list[Run]:
    """The lines through the stretches between each two vertices that follow one another, (e + 1,)."""
    lines, pairs = _fits(border, ends).tolist(), itertools.pairwise(ends.tolist())
    return [Run(a, b, x, y, way, long, own=way) for (a, b), (x, y, way, long) in zip(pairs, lines, strict=True)]


@kernel
def _fits(border: FloatArray, ends: IntArray) -> FloatArray:
    """`_fit` of each stretch, (e, 4)."""
    lines = np.empty((len(ends) - 1, 4))
    for k in range(len(ends) - 1):
        lines[k, 0], lines[k, 1], lines[k, 2], lines[k, 3] = _fit(border, ends[k], ends[k + 1])
    return lines


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
def off_piece(a: FloatArray, b: FloatArray, p: FloatArray) -> float:
    """Distance of a point from the piece between two others, all (2,)."""
    ux, uy = b[0] - a[0], b[1] - a[1]
    x, y = p[0] - a[0], p[1] - a[1]
    squared = ux * ux + uy * uy
    along = (x * ux + y * uy) / squared if squared > 0.0 else 0.0
    if along <= 0.0:
        return math.sqrt(x * x + y * y)
    if along >= 1.0:
        return math.sqrt((p[0] - b[0]) ** 2 + (p[1] - b[1]) ** 2)
    return float(abs((y * ux - x * uy) / squared) * math.sqrt(squared))


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
