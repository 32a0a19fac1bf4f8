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

from pipeline.compiler import kernel
from pipeline.model import FloatArray

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
    return _as_runs(_split(border, tolerance, closed))


def merge(border: FloatArray, runs: Sequence[Run], tolerance: float, *, closed: bool) -> list[Run]:
    """Unite neighbouring runs while one line passes within the tolerance of all their vertices, the best pair first.

    Vertices and tolerance are as for `split`; exact runs stay, and of a closed border at least three runs.
    """
    least = 3 if closed else 1
    if len(runs) <= least:
        return list(runs)
    rows = [(run.first, run.last, run.x, run.y, run.direction, run.length, run.exact) for run in runs]
    return _as_runs(_merge(border, np.array(rows, np.float64), tolerance, least))


def _as_runs(rows: FloatArray) -> list[Run]:
    """Runs from rows of their fields, (r, 7)."""
    return [
        Run(first=int(first), last=int(last), x=x, y=y, direction=direction, length=length, exact=bool(exact))
        for first, last, x, y, direction, length, exact in rows.tolist()
    ]


@kernel
def _fitted_row(border: FloatArray, first: int, last: int) -> tuple[float, float, float, float, float, float, float]:
    """The fields of `fitted_run`."""
    x, y, direction, length = _fit(border, first, last)
    return float(first), float(last), x, y, direction, length, 0.0


@kernel
def _split(border: FloatArray, tolerance: float, closed: bool) -> FloatArray:
    """The kernel of `split`, a row of fields per run (r, 7): the farthest vertex ends a run if it is too far."""
    n = len(border)
    count = n if closed else n - 1
    ends = np.zeros(count + 1, np.bool_)
    ends[0] = ends[count] = True
    starts, stops = np.empty(count + 1, np.int64), np.empty(count + 1, np.int64)
    starts[0], stops[0] = 0, count
    left = 1
    while left > 0:
        left -= 1
        i, j = starts[left], stops[left]
        farthest, at = -1.0, i
        for k in range(i + 1, j):
            off = off_piece(border[i], border[j % n], border[k])
            if off > farthest:
                farthest, at = off, k
        if farthest > tolerance:
            ends[at] = True
            # no more than `count` pieces wait, as each is a part of its own
            starts[left], stops[left] = i, at
            starts[left + 1], stops[left + 1] = at, j
            left += 2
    kept = np.flatnonzero(ends)
    if closed and len(kept) < 4:
        return np.empty((0, 7))
    rows = np.empty((len(kept) - 1, 7))
    for r in range(len(rows)):
        rows[r] = _fitted_row(border, kept[r], kept[r + 1])
    return rows


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


@kernel
def _merge(border: FloatArray, runs: FloatArray, tolerance: float, least: int) -> FloatArray:
    """The kernel of `merge`, rows of fields (r, 7); of a closed border at least three runs stay, of an open one one."""
    closed = least > 1
    count = len(runs)
    merged, pairs, offs = runs.copy(), np.empty((count, 7)), np.full(count, np.inf)
    for k in range(count):
        offs[k] = _off_united(border, merged, k, closed, pairs[k])
    while count > least:
        k = int(np.argmin(offs[:count]))
        if offs[k] > tolerance:
            break
        merged[k] = pairs[k]
        following = (k + 1) % count
        for i in range(following, count - 1):
            merged[i], pairs[i], offs[i] = merged[i + 1], pairs[i + 1], offs[i + 1]
        count -= 1
        k -= following < k
        for i in (k, (k - 1) % count):
            offs[i] = _off_united(border, merged[:count], i, closed, pairs[i])
    return merged[:count].copy()


@kernel
def _off_united(border: FloatArray, runs: FloatArray, k: int, closed: bool, united: FloatArray) -> float:
    """How far vertices are from the line of a run and its successor, whose fields `united` takes; else infinite."""
    a, b = runs[k], runs[(k + 1) % len(runs)]
    if a[6] != 0.0 or b[6] != 0.0 or (k + 1 == len(runs) and not closed):
        return np.inf
    last = int(b[1]) + (len(border) if b[1] <= a[0] else 0)
    united[:] = _fitted_row(border, int(a[0]), last)
    return _off_line(border, int(a[0]), last, united[2], united[3], united[4])


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
