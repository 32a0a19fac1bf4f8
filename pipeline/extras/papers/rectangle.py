"""Rectangles in plan: on the line in which two planes meet, or the smallest around points (Zeng et al. 2008, 2.3).

The outline of a regular building is made of rectangles: each holds the convex hull of the points of its plane.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray, Plane


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanLine:
    """A directed line in plan. Metres along it are counted from `origin`, metres to its left are positive."""

    origin: tuple[float, float]
    """A point of the line, metres."""
    direction: tuple[float, float]
    """Unit vector."""

    def frame(self, xy: FloatArray) -> FloatArray:
        """Metres along the line and to its left, (n, 2) float64, of positions (n, 2) in plan."""
        (x, y), (u, v) = self.origin, self.direction
        dx, dy = xy[:, 0] - x, xy[:, 1] - y
        return np.column_stack([dx * u + dy * v, dy * u - dx * v])

    def position(self, along_m: float, left_m: float) -> tuple[float, float]:
        """The position in plan of metres along the line and to its left."""
        (x, y), (u, v) = self.origin, self.direction
        return x + along_m * u - left_m * v, y + along_m * v + left_m * u


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rectangle:
    """A rectangle in plan with two sides along a line."""

    line: PlanLine
    """One of its sides lies on this line where `left_from_m` or `left_to_m` is 0."""
    from_m: float
    """Where it begins along the line."""
    to_m: float
    """Where it ends along the line."""
    left_from_m: float
    """Where it begins across the line, metres to the left."""
    left_to_m: float
    """Where it ends across the line."""

    @property
    def length_m(self) -> float:
        """Extent along the line."""
        return self.to_m - self.from_m

    @property
    def width_m(self) -> float:
        """Extent across the line."""
        return self.left_to_m - self.left_from_m

    @property
    def area_m2(self) -> float:
        """Area in plan."""
        return self.length_m * self.width_m

    @property
    def corners(self) -> tuple[tuple[float, float], ...]:
        """The four corners, counter-clockwise from the beginning of the right side."""
        along = (self.from_m, self.to_m, self.to_m, self.from_m)
        left = (self.left_from_m, self.left_from_m, self.left_to_m, self.left_to_m)
        return tuple(self.line.position(a, w) for a, w in zip(along, left, strict=True))


def line_of_intersection(first: Plane, second: Plane) -> PlanLine | None:
    """Where two planes meet, in plan; None for parallel planes.

    The first plane is the lower one to the left of the line. The origin is the foot of the perpendicular from (0, 0).

    Examples
    --------
    >>> left = Plane(a=0.0, b=-1.0, c=8.0, n_points=3, rmse_m=0.0)
    >>> right = Plane(a=0.0, b=1.0, c=2.0, n_points=3, rmse_m=0.0)
    >>> line_of_intersection(left, right)
    PlanLine(origin=(0.0, 3.0), direction=(1.0, 0.0))
    """
    a, b, c = first.a - second.a, first.b - second.b, first.c - second.c
    gradient = math.hypot(a, b)
    if gradient == 0.0:
        return None
    # a x + b y + c = 0; the difference falls to the left: its gradient points right, the line runs a quarter turn on
    return PlanLine(
        origin=(0.0 - a * c / gradient**2, 0.0 - b * c / gradient**2), direction=(0.0 - b / gradient, a / gradient)
    )


def convex_hull(xy_mm: IntArray) -> FloatArray:
    """The exact convex hull of positions (n, 2) on whole millimetres, at least one; extent below 1,000 km.

    Vertices (h, 2) in metres, counter-clockwise from the smallest (x, y), without positions on its edges. Two where all
    lie on one line, one where all are one.
    """
    return _hull(np.ascontiguousarray(xy_mm[np.lexsort((xy_mm[:, 1], xy_mm[:, 0]))])) / 1e3


@kernel
def _hull(ordered: IntArray) -> IntArray:
    """Andrew's monotone chain over positions sorted by x, then y."""
    n = ordered.shape[0]
    chain = np.empty((2 * n + 1, 2), np.int64)
    size = 0
    for turn in range(2):
        least = max(size, 1)
        for s in range(n):
            p = ordered[s] if turn == 0 else ordered[n - 1 - s]
            while size > least:
                ux = chain[size - 1, 0] - chain[size - 2, 0]
                uy = chain[size - 1, 1] - chain[size - 2, 1]
                if ux * (p[1] - chain[size - 2, 1]) - uy * (p[0] - chain[size - 2, 0]) > 0:
                    break
                size -= 1
            if size == 0 or chain[size - 1, 0] != p[0] or chain[size - 1, 1] != p[1]:
                chain[size] = p
                size += 1
    if size > 1 and chain[size - 1, 0] == chain[0, 0] and chain[size - 1, 1] == chain[0, 1]:
        size -= 1
    return chain[:size].copy()


def rectangle_on_line(hull: FloatArray, line: PlanLine, side: int) -> Rectangle | None:
    """The minimal rectangle on a line that holds the part of a convex hull on one side of it.

    The hull (h, 2) is counter-clockwise, in metres; `side` is 1 for the left of the line, -1 for the right. None where
    the hull has no area there.
    """
    part = _beyond(np.ascontiguousarray(line.frame(hull)), float(side))
    if len(part) == 0:
        return None
    width_m = float((part[:, 1] * side).max())
    from_m, to_m = float(part[:, 0].min()), float(part[:, 0].max())
    if width_m <= 0.0 or to_m <= from_m:
        return None
    low, high = (0.0, width_m) if side > 0 else (-width_m, 0.0)
    return Rectangle(line=line, from_m=from_m, to_m=to_m, left_from_m=low, left_to_m=high)


@kernel
def _beyond(ring: FloatArray, side: float) -> FloatArray:
    """The part of a convex ring with a second coordinate of this sign (or 0), cut at 0 (Sutherland and Hodgman)."""
    h = ring.shape[0]
    part = np.empty((2 * h, 2))
    size = 0
    for k in range(h):
        p = ring[k]
        q = ring[(k + 1) % h]
        here = side * p[1]
        there = side * q[1]
        if here >= 0.0:
            part[size] = p
            size += 1
        if (here < 0.0 < there) or (there < 0.0 < here):
            share = here / (here - there)
            part[size, 0] = p[0] + share * (q[0] - p[0])
            part[size, 1] = 0.0
            size += 1
    return part[:size].copy()


def minimum_rectangle(hull: FloatArray) -> Rectangle | None:
    """The rectangle of least area around a convex hull: one side lies on an edge of it (Freeman and Shapira 1975).

    Found with rotating calipers (Toussaint 1983): all edges in one turn. The hull (h, 2) is counter-clockwise, in
    metres. The first edge counts among equal areas (to 1e-9 of them). None for fewer than three vertices.
    """
    if len(hull) < 3:
        return None
    edge, to_m, width_m, from_m = _calipers(np.ascontiguousarray(hull))
    (x, y), (x1, y1) = hull[edge].tolist(), hull[(edge + 1) % len(hull)].tolist()
    length = math.hypot(x1 - x, y1 - y)
    line = PlanLine(origin=(x, y), direction=((x1 - x) / length, (y1 - y) / length))
    return Rectangle(line=line, from_m=from_m, to_m=to_m, left_from_m=0.0, left_to_m=width_m)


@kernel
def _along(hull: FloatArray, edge: int, u: float, v: float, k: int) -> float:
    """Metres of vertex k along an edge of unit direction (u, v)."""
    p = hull[k % hull.shape[0]]
    return float((p[0] - hull[edge, 0]) * u + (p[1] - hull[edge, 1]) * v)


@kernel
def _across(hull: FloatArray, edge: int, u: float, v: float, k: int) -> float:
    """Metres of vertex k to the left of an edge of unit direction (u, v)."""
    p = hull[k % hull.shape[0]]
    return float((p[1] - hull[edge, 1]) * u - (p[0] - hull[edge, 0]) * v)


@kernel
def _calipers(hull: FloatArray) -> tuple[int, float, float, float]:
    """The best edge, and the rectangle's end along it, its width and its beginning along it."""
    h = hull.shape[0]
    foremost = 1
    highest = 1
    rearmost = 1
    best = (0, 0.0, 0.0, 0.0)
    least = np.inf
    for edge in range(h):
        dx = hull[(edge + 1) % h, 0] - hull[edge, 0]
        dy = hull[(edge + 1) % h, 1] - hull[edge, 1]
        length = math.sqrt(dx * dx + dy * dy)
        u = dx / length
        v = dy / length
        # the three calipers only ever go on, in this order, as the edge turns
        foremost = max(foremost, edge + 1)
        while _along(hull, edge, u, v, foremost + 1) > _along(hull, edge, u, v, foremost):
            foremost += 1
        highest = max(highest, foremost)
        while _across(hull, edge, u, v, highest + 1) > _across(hull, edge, u, v, highest):
            highest += 1
        rearmost = max(rearmost, highest)
        while _along(hull, edge, u, v, rearmost + 1) < _along(hull, edge, u, v, rearmost):
            rearmost += 1
        to_m = _along(hull, edge, u, v, foremost)
        width_m = _across(hull, edge, u, v, highest)
        from_m = _along(hull, edge, u, v, rearmost)
        area = (to_m - from_m) * width_m
        if area < least * (1.0 - 1e-9):
            least = area
            best = (edge, to_m, width_m, from_m)
    return best
