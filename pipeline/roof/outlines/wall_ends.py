"""Where the walls of a block end: on what they meet first, the outline or another wall, square to it or at its corner.

What an end leaves beside it is a corner of two units. A wall that meets an edge at an acute angle makes a wedge of one
of them, and one that ends close to a corner a tip.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.model import FloatArray
from pipeline.roof.lines import Run, corners, crossing
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

Met = tuple[float, FloatArray] | None
"""What the end of a wall meets: how far from the vertex before that end, millimetres, and where it begins and ends."""


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

    def against(self, run: Run, off_mm: FloatArray) -> FloatArray:
        """How much the points of an edge speak against moving it sideways, by this far each (n,), in nats."""
        return run.length / (2.0 * self.spacing_mm * self.noise_mm**2) * off_mm * off_mm


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


def obstacles_of(edges: FloatArray, lines: Sequence[FloatArray], number: int) -> FloatArray:
    """What a wall can end on: the edges of the outline and of all other walls, both ends of each, (m, 4)."""
    others = [np.column_stack((line[:-1], line[1:])) for k, line in enumerate(lines) if k != number]
    return np.concatenate((edges, *others))


def directions_beside(places: FloatArray, obstacles: FloatArray) -> FloatArray:
    """The directions of the obstacles (m, 4) nearest to some places (n, 2), radians."""
    pieces = shapely.linestrings(obstacles.reshape(-1, 2, 2))
    nearest = obstacles[[int(np.argmin(shapely.distance(point, pieces))) for point in shapely.points(places)]]
    return np.arctan2(nearest[:, 3] - nearest[:, 1], nearest[:, 2] - nearest[:, 0])


def met(line: FloatArray, obstacles: FloatArray, scale: Scale) -> tuple[Met, Met]:
    """What the first end of a wall meets nearest to the end of its border, and what the last one; None for nothing."""
    found: list[Met] = []
    for end, before in ((0, 1), (-1, -2)):
        way = line[end] - line[before]
        length = float(np.hypot(*way))
        if length == 0.0:
            found.append(None)
            continue
        way /= length
        border_end = length - scale.beyond_mm
        # the places on the ray from the vertex before at which it meets an obstacle
        ux, uy = obstacles[:, 2] - obstacles[:, 0], obstacles[:, 3] - obstacles[:, 1]
        det = way[0] * uy - way[1] * ux
        dx, dy = obstacles[:, 0] - line[before, 0], obstacles[:, 1] - line[before, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            t, u = (dx * uy - dy * ux) / det, (dx * way[1] - dy * way[0]) / det
        meets = (np.abs(det) > 1e-9) & (u >= 0.0) & (u <= 1.0) & (t <= border_end + scale.far_mm)
        # the first edge of several may end where it begins, at a corner on the outline
        meets &= t > max(0.1 * length if len(line) == 2 else -_OVERSHOOT_MM, border_end - 2.0 * scale.beyond_mm)
        nearest = int(np.argmin(np.where(meets, np.abs(t - border_end), np.inf)))
        found.append((float(t[nearest]), obstacles[nearest]) if meets[nearest] else None)
    return found[0], found[1]


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
        if one is None or not (edges == one[1]).all(axis=1).any():
            continue
        ux, uy = math.cos(run.direction), math.sin(run.direction)
        for corner in one[1].reshape(2, 2):
            off = ux * (corner[1] - run.y) - uy * (corner[0] - run.x)
            starts, stops = ((edges[:, k : k + 2] == corner).all(axis=1) for k in (0, 2))
            away = np.concatenate((edges[starts, 2:] - corner, edges[stops, :2] - corner))
            is_sharp = sense * (away @ (ux, uy)) > -SHARP * np.hypot(away[:, 0], away[:, 1])
            if is_sharp.any() or scale.against(run, off) >= PRICES.edge:
                continue
            if id(run) not in moves or abs(off) < abs(moves[id(run)][0]):
                moves[id(run)] = off, run
    for off, run in moves.values():
        run.x -= off * math.sin(run.direction)
        run.y += off * math.cos(run.direction)


def ended(line: FloatArray, obstacles: FloatArray, scale: Scale) -> FloatArray:
    """A wall whose ends lie on what they meet."""
    result = line.copy()
    for one, end, before in zip(met(line, obstacles, scale), (0, -1), (1, -2), strict=True):
        if one is not None:
            way = line[end] - line[before]
            result[end] = line[before] + (one[0] + _OVERSHOOT_MM) / float(np.hypot(*way)) * way
    return result
