"""Outlines around few points: where points lie far apart, their ring says little about directions, the points more.

Points of a roof lie anywhere in its outline, and none outside. So among outlines in all directions that one is most
likely whose area is least, at n ln(area) nats for n points, where points that it leaves outside cost what their
distance is worth, and edges what they cost in a description.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
import shapely
from shapely import Polygon

from pipeline.compiler import kernel
from pipeline.model import FloatArray
from pipeline.roof.edge_position import EdgePoints
from pipeline.roof.lines import Run
from pipeline.roof.outlines.description import SHARP, Prices

_OFF_MM = 120.0
"""Standard deviation of a point about the edge that it lies outside of."""
_MOST = 8.0
"""Most that a point outside costs, nats: it may be no roof."""
_FARTHEST = 3.0
"""Point spacings by which a corner may lie outside of the ring before."""
_STEP = math.radians(5.0)
"""Between the directions that are tried."""


def directions() -> FloatArray:
    """The directions that are tried, modulo a right angle, radians."""
    return np.arange(0.0, 0.5 * math.pi, _STEP)


def envelope_mm(run: Run, xy_mm: FloatArray, area_mm2: float, out_mm: float) -> float:
    """How far to the right a line lies best along its stretch: millimetres, from points (n, 2) to its left and right.

    Moving it outwards costs area, n ln(area) in all; a point that it leaves outside costs its squared distance.
    """
    ux, uy = math.cos(run.direction), math.sin(run.direction)
    return _envelope(xy_mm, (run.x, run.y), (ux, uy), run.length, area_mm2, out_mm)


@kernel
def _envelope(
    xy: FloatArray,
    at: tuple[float, float],
    way: tuple[float, float],
    length: float,
    area: float,
    out: float,
) -> float:
    """The same for a line through a place, with its direction as a unit vector."""
    offs = np.empty(len(xy))
    count = 0
    for k in range(len(xy)):
        dx, dy = xy[k, 0] - at[0], xy[k, 1] - at[1]
        off, along = dx * way[1] - dy * way[0], dx * way[0] + dy * way[1]
        if abs(along) <= 0.5 * length and abs(off) <= out:
            offs[count] = off
            count += 1
    if count == 0 or length == 0.0:
        return 0.0
    a_mm = len(xy) * length / area
    beside = np.sort(offs[:count])[::-1]
    best, least = 0.0, np.inf
    for off in beside:
        outside = 0.0
        for farther in beside:
            if farther <= off:
                break
            beyond = (farther - off) / _OFF_MM
            outside += min(0.5 * (beyond * beyond), _MOST)
        if a_mm * off + outside < least:
            best, least = off, a_mm * off + outside
    # the edge lies beyond its outermost point by the mean way to the next one
    return float(best + min(1.0 / a_mm, 0.5 * out))


def sharp_corners(ring: FloatArray) -> int:
    """The number of inner angles below 63 degrees of a ring (n, 2)."""
    edges = ring - np.roll(ring, 1, axis=0)
    cosine = (edges * np.roll(edges, -1, axis=0)).sum(axis=1)
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    return int(np.count_nonzero(cosine < SHARP * lengths * np.roll(lengths, -1)))


def likeliest(
    ways: Iterable[tuple[FloatArray, list[Run]]],
    drawn: Callable[[FloatArray, list[Run]], FloatArray | None],
    raw: Polygon,
    points: EdgePoints,
    prices: Prices,
) -> FloatArray | None:
    """The ring of least cost among those that are drawn with some edges of a border, after the points moved them.

    `raw` is the ring before; None where none can be drawn.
    """
    best, least, spacing_mm = None, math.inf, points.spacing_mm
    xy_mm = points.xy_mm.astype(np.float64)
    xy_mm = xy_mm[shapely.contains_xy(shapely.buffer(raw, spacing_mm), xy_mm)]
    places = shapely.points(xy_mm)
    for border, runs in ways:
        for run in runs:
            shift = envelope_mm(run, xy_mm, raw.area, 1.5 * spacing_mm)
            run.x += shift * math.sin(run.direction)
            run.y -= shift * math.cos(run.direction)
        ring = drawn(border, runs)
        polygon = None if ring is None else shapely.polygons(ring)
        if ring is None or polygon is None or polygon.area <= 0.0 or not polygon.is_valid:
            continue
        total = prices.edge * len(ring) + prices.free * sum(not run.exact for run in runs)
        total += len(xy_mm) * math.log(polygon.area / spacing_mm**2)
        if total >= least or shapely.distance(shapely.points(ring), raw).max() > _FARTHEST * spacing_mm:
            continue
        off = shapely.distance(places, polygon)
        total += prices.sharp * sharp_corners(ring) + float(np.minimum(0.5 * (off / _OFF_MM) ** 2, _MOST).sum())
        if total < least:
            best, least = ring, total
    return best
