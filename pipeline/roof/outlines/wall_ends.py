"""Where the walls of a block end: on what they meet first, the outline or another wall, square to it or at its corner.

What an end leaves beside it is a corner of two units. A wall that meets an edge at an acute angle makes a wedge of one
of them, and one that ends close to a corner a tip.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray
from pipeline.roof.lines import Run, corners, crossing, off_piece
from pipeline.roof.outlines.description import SHARP, Prices

PRICES = Prices(edge=6.0, free=14.0, change=4.0, sharp=60.0, flat=60.0)
"""A wall inside a block is seen less well than an outline: it costs more to bend it."""
_NOISE_SPACINGS, _NOISE_M = 0.8, 0.4
"""Standard deviation of the border between two units about their wall: in point spacings, and at least."""
_BEYOND_SPACINGS, _BEYOND_M = 1.0, 0.5
"""How far beyond the outline borders are followed, and walls reach beyond their borders."""
_FAR_SPACINGS, _FAR_M = 8.0, 6.0
"""How far a wall is continued until it meets something."""
_OVERSHOOT_MM = 5.0
"""Walls end this far beyond what they meet: the lines must cross."""

Met = tuple[float, int] | None
"""What the end of a wall meets: how far from the vertex before that end, millimetres, and the number of the piece."""


class Obstacles(NamedTuple):
    """What walls can end on."""

    pieces: FloatArray
    """(m, 4) the edges of the outline, then those of all walls: both ends of each, millimetres."""
    wall: IntArray
    """(m,) the wall of each; -1 for the outline."""


@dataclasses.dataclass(frozen=True)
class Scale:
    """Lengths that follow from the point spacing, millimetres."""

    spacing_mm: float
    """The point spacing."""
    noise_mm: float
    """Standard deviation of a border about its wall."""
    beyond_mm: float
    """How far walls reach beyond their borders."""
    far_mm: float
    """How far they are continued at most."""

    @classmethod
    def of(cls, spacing_m: float) -> Scale:
        """The lengths at a point spacing."""
        shares = (
            (1.0, 0.0), (_NOISE_SPACINGS, _NOISE_M), (_BEYOND_SPACINGS, _BEYOND_M), (_FAR_SPACINGS, _FAR_M),
        )  # fmt: skip
        return cls(*(1e3 * max(share * spacing_m, least_m) for share, least_m in shares))

    @property
    def per_mm(self) -> float:
        """Nats by which points speak against moving an edge, per millimetre of it and square millimetre of the way."""
        return 0.5 / (self.spacing_mm * self.noise_mm**2)


@dataclasses.dataclass(frozen=True)
class Wall:
    """A border between units and the edges that describe it."""

    border: FloatArray
    """(n, 2), millimetres."""
    directions: FloatArray
    """Those of the outline nearby, radians."""
    runs: list[Run]
    """Its edges."""

    def line(self, scale: Scale) -> FloatArray:
        """Its vertices (n, 2), both ends reaching beyond the border."""
        ends = []
        for run, place, sense in ((self.runs[0], self.border[0], -1.0), (self.runs[-1], self.border[-1], 1.0)):
            ux, uy = math.cos(run.direction), math.sin(run.direction)
            way = (place[0] - run.x) * ux + (place[1] - run.y) * uy + sense * scale.beyond_mm
            ends.append((run.x + way * ux, run.y + way * uy))
        between = corners(self.border, self.runs, math.inf, closed=False)
        return np.array([ends[0], *between, ends[1]])


def obstacles_of(edges: FloatArray, lines: Sequence[FloatArray]) -> Obstacles:
    """What walls with some lines (n, 2) can end on: the edges of the outline (e, 4), and the other walls."""
    pieces = [edges, *(np.column_stack((line[:-1], line[1:])) for line in lines)]
    return Obstacles(np.concatenate(pieces), np.repeat(np.arange(-1, len(lines)), [len(piece) for piece in pieces]))


@kernel
def directions_beside(places: FloatArray, obstacles: Obstacles, number: int) -> FloatArray:
    """The directions of the obstacles nearest to some places (n, 2), radians, which are not the wall of a number."""
    pieces, wall = obstacles
    found = np.full(len(places), np.nan)
    for k in range(len(places)):
        least = np.inf
        for p in range(len(pieces)):
            if wall[p] != number:
                off = off_piece(pieces[p, :2], pieces[p, 2:], places[k])
                if off < least:
                    least, found[k] = off, math.atan2(pieces[p, 3] - pieces[p, 1], pieces[p, 2] - pieces[p, 0])
    return found


def met(line: FloatArray, number: int, obstacles: Obstacles, scale: Scale) -> tuple[Met, Met]:
    """What the first end of the wall of a number meets nearest to the end of its border, and what the last one."""
    first, last = (
        (way, piece) if piece >= 0 else None
        for way, piece in _met(line, number, obstacles, scale.beyond_mm, scale.far_mm)
    )
    return first, last


@kernel
def _met(
    line: FloatArray, number: int, obstacles: Obstacles, beyond: float, far: float
) -> tuple[tuple[float, int], tuple[float, int]]:
    """The kernel of `met`; piece -1 for nothing."""
    return (
        _met_from(line[1], line[0], len(line) == 2, number, obstacles, beyond, far),
        _met_from(line[-2], line[-1], len(line) == 2, number, obstacles, beyond, far),
    )


@kernel
def _met_from(
    start: FloatArray, end: FloatArray, is_alone: bool, number: int, obstacles: Obstacles, beyond: float, far: float
) -> tuple[float, int]:
    """The place on the ray from the vertex before an end at which it meets an obstacle, and which; -1 for none."""
    pieces, wall = obstacles
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    at, piece = np.nan, -1
    if length == 0.0:
        return at, piece
    vx, vy = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    border_end = length - beyond
    # the first edge of several may end where it begins, at a corner on the outline
    nearest = max(0.1 * length if is_alone else -_OVERSHOOT_MM, border_end - 2.0 * beyond)
    for p in range(len(pieces)):
        ux, uy = pieces[p, 2] - pieces[p, 0], pieces[p, 3] - pieces[p, 1]
        det = vx * uy - vy * ux
        if wall[p] == number or not abs(det) > 1e-9:
            continue
        dx, dy = pieces[p, 0] - start[0], pieces[p, 1] - start[1]
        t, u = (dx * uy - dy * ux) / det, (dx * vy - dy * vx) / det
        if 0.0 <= u <= 1.0 and nearest < t <= border_end + far and not abs(t - border_end) >= abs(at - border_end):
            at, piece = t, p
    return at, piece


def end_outside(runs: list[Run], outline_mm: MultiPolygon) -> None:
    """Leave out the edges behind the corners at which a wall has left the outline."""
    for first, second in ((0, 1), (-1, -2)):
        while len(runs) > 1:
            corner = crossing(runs[first], runs[second])
            if corner is None or shapely.contains_xy(outline_mm, *corner):
                break
            del runs[first]


def without_stubs(wall: Wall, ends: tuple[Met, Met], scale: Scale) -> None:
    """Leave out edges at the ends of a wall that would be continued farther than they are long."""
    line = wall.line(scale)
    for end, before, one in ((0, 1, ends[0]), (-1, -2, ends[1])):
        border_end = float(np.hypot(*(line[end] - line[before]))) - scale.beyond_mm
        most = max(wall.runs[end].length, scale.beyond_mm)
        if len(wall.runs) > 1 and (one is None or one[0] - border_end > most):
            del wall.runs[end]


def put_through_corner(wall: Wall, ends: tuple[Met, Met], scale: Scale, edges: FloatArray) -> None:
    """Move the ends of a wall to the corners of the outline, edges (e, 4), beside the places where they meet it.

    An end moves if its points speak less against it than an edge costs, and if no angle at the corner is sharp. A
    wall of one edge moves to one corner, the nearer one.
    """
    moves: dict[int, tuple[float, Run]] = {}
    for end, sense in ((0, 1.0), (-1, -1.0)):
        run, one = wall.runs[end], ends[end]
        if one is None or one[1] >= len(edges):
            continue
        ux, uy = math.cos(run.direction), math.sin(run.direction)
        for x, y in edges[one[1]].reshape(2, 2).tolist():
            off = ux * (y - run.y) - uy * (x - run.x)
            if scale.per_mm * run.length * off * off >= PRICES.edge or _is_sharp(x, y, sense * ux, sense * uy, edges):
                continue
            if id(run) not in moves or abs(off) < abs(moves[id(run)][0]):
                moves[id(run)] = off, run
    for off, run in moves.values():
        run.x -= off * math.sin(run.direction)
        run.y += off * math.cos(run.direction)


@kernel
def _is_sharp(x: float, y: float, ux: float, uy: float, edges: FloatArray) -> bool:
    """Whether a wall that goes from a corner in a direction has a sharp angle with an edge (e, 4) that is there."""
    for e in range(len(edges)):
        for k in range(2):
            if edges[e, 2 * k] == x and edges[e, 2 * k + 1] == y:
                away_x, away_y = edges[e, 2 - 2 * k] - x, edges[e, 3 - 2 * k] - y
                if away_x * ux + away_y * uy > -SHARP * math.hypot(away_x, away_y):
                    return True
    return False


def ended(line: FloatArray, number: int, obstacles: Obstacles, scale: Scale) -> FloatArray:
    """A wall whose ends lie on what they meet."""
    result = line.copy()
    for one, end, before in zip(met(line, number, obstacles, scale), (0, -1), (1, -2), strict=True):
        if one is not None:
            way = line[end] - line[before]
            result[end] = line[before] + (one[0] + _OVERSHOOT_MM) / float(np.hypot(*way)) * way
    return result
