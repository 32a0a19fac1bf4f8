"""Outlines around few points: where points lie far apart, their ring says little about directions, the points more.

Points of a roof lie anywhere in its outline, and none outside. So among outlines in all directions that one is most
likely whose area is least, at n ln(area) nats for n points, where points that it leaves outside cost what their
distance is worth, and edges what they cost in a description.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import shapely
from shapely import Polygon

from pipeline.compiler import kernel
from pipeline.model import FloatArray
from pipeline.roof.edge_position import EdgePoints
from pipeline.roof.lines import Run
from pipeline.roof.outlines.description import SHARP
from pipeline.roof.outlines.exterior import FEWEST, MOVED, PRICES, Ring, described, pairs_of, ring_of, runs_of

_OFF_MM = 120.0
"""Standard deviation of a point about the edge that it lies outside of."""
_MOST = 8.0
"""Most that a point outside costs, nats: it may be no roof."""
_STEP = math.radians(5.0)
"""Between the directions that are tried, modulo a right angle."""


def of_few_points(ring: Ring, points: EdgePoints, noise_mm: float, least_mm: float) -> FloatArray | None:
    """The likeliest ring around few points: as described, or in two directions of any; no edge shorter than some."""
    raw, spacing_mm = Polygon(ring.border), points.spacing_mm
    area_mm2, most_mm2 = raw.area, 4.0 * MOVED * noise_mm * raw.length
    xy_mm = points.xy_mm.astype(np.float64)
    xy_mm = xy_mm[shapely.contains_xy(shapely.buffer(raw, spacing_mm), xy_mm)]
    per_mm = 0.5 / (spacing_mm * noise_mm * noise_mm)
    square = PRICES._replace(free=PRICES.sharp)
    ways = described([ring], spacing_mm, noise_mm)
    for angle in np.arange(0.0, 0.5 * math.pi, _STEP).tolist():
        ways.append((ring.border, runs_of(ring, pairs_of([angle]), per_mm, square)[0]))
    drawings: list[tuple[float, FloatArray]] = []
    for along, runs in ways:
        for run in runs:
            shift = envelope_mm(run, xy_mm, area_mm2, 1.5 * spacing_mm)
            run.x += shift * math.sin(run.direction)
            run.y -= shift * math.cos(run.direction)
        found = ring_of(along, runs, least_mm, most_mm2) if len(runs) >= FEWEST else None
        if found is not None:
            free = sum(not run.exact for run in runs)
            cost = PRICES.edge * len(found) + PRICES.free * free + PRICES.sharp * sharp_corners(found)
            drawings.append((cost, found))
    return likeliest(drawings, xy_mm, spacing_mm)


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


def likeliest(drawings: Iterable[tuple[float, FloatArray]], xy_mm: FloatArray, spacing_mm: float) -> FloatArray | None:
    """The ring of least cost among some with the cost of their edges; points (n, 2); None where there are none."""
    best, least = None, math.inf
    places = shapely.points(xy_mm)
    for cost, ring in drawings:
        polygon = shapely.polygons(ring)
        area = float(shapely.area(polygon))
        if area <= 0.0 or not shapely.is_valid(polygon):
            continue
        off = shapely.distance(places, polygon)
        total = cost + len(xy_mm) * math.log(area / spacing_mm**2)
        total += float(np.minimum(0.5 * (off / _OFF_MM) ** 2, _MOST).sum())
        if total < least:
            best, least = ring, total
    return best
