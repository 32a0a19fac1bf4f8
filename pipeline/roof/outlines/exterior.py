"""The outline around roof points: the polygon that explains the edge of the points with the shortest description.

The raw outline zigzags between outermost roof points. Its shortest description (`description.py`) has few edges, in few
directions: those that the outline itself shows, each with the one square to it, are taken one by one while the
description gets shorter. Each edge is then moved to where the points along it put the edge of the roof; corners are
where edges meet.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon
from shapely.geometry.polygon import orient

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray
from pipeline.roof.edge_position import EdgePoints, mixed_pulse_reach_mm, outward_shift_mm
from pipeline.roof.footprint import polygons_of
from pipeline.roof.lines import Run, corners, crossing, fitted_runs, projected
from pipeline.roof.outlines.description import FREE, SHARP, Prices, least_description
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.snapped_rings import differ_by_more, on_grid, snapped_ring

PRICES = Prices(edge=4.0, free=8.0, change=3.0, sharp=60.0, flat=60.0)
"""What is saved must be worth it: at these prices a step of a wall is drawn that is as deep as the points show well."""
_FREE_ALONE = 1.0
"""The price of a direction of its own while no common direction is known."""
_SYSTEM = 7.0
"""The price of a pair of common directions, square to one another, nats."""
_SYSTEMS = 3
"""Most such pairs."""
_BREAK_SPACINGS = 0.45
"""Edges end at vertices that are this far apart at least."""
_FACTORS = (1.0, 0.6, 0.35)
"""Times the noise: an outline that cannot be drawn with few edges is tried with more."""
_FEW_POINTS, _FEW_SPACING_M, _FEWEST_POINTS = 150, 2.0, 30
"""So few points, so far apart, show directions badly, and fewer anywhere: outlines in all directions are compared."""
_FEWEST, _FEW_BREAKS = 4, 60
"""A ring of so few breaks has four edges at least."""
_APART = math.radians(8.0)
"""Two pairs of common directions differ by more."""
_ABOUT = math.radians(12.0)
"""Edges that differ by less from a common direction make it more exact."""
_PEAK = math.radians(2.5)
"""How far directions of edges scatter about a common one."""
_LEAST_PEAK = 0.05
"""Least weight of a direction that is tried, as a share of that of the first."""
_VOTERS = 400
"""The longest edges alone are asked for directions: the time grows with the square of their number."""
_TRIED = 5
"""Most directions that are tried."""
_NEAREST, _EVENEST, _EVEN_POWER = 0.47, 1.6, 1.5
"""Median distance of random points from the nearest other one, in spacings; of evenly spread ones it is larger. As many
times as it is, to this power, the noise of an outline is smaller, down to that of a lattice (in simulations)."""
_NOISE_OF_SIZE = 0.035
"""Small houses show finer edges: their least noise is this part of the square root of their area."""
_LEAST_SPACINGS, _LEAST_M = 0.75, 0.3
"""Shorter edges are left out: in point spacings, and at least."""
_MOVED = 1.2
"""Most area between the raw outline and the edges: this many standard deviations of it times its length."""
_SAME = math.cos(math.radians(3.0))
_QUARTER = 0.5 * math.pi
NONE_MET = np.full(2, np.nan)
"""A closed border, or one that ends on nothing."""


@dataclasses.dataclass(frozen=True)
class _Ring:
    """A ring of the raw outline."""

    border: FloatArray
    """(n, 2) its vertices, millimetres, the roof on the left."""
    breaks: IntArray
    """(m,) where edges may end; the last is the first again, behind n."""


def straighten(
    outline_mm: MultiPolygon, spacing_m: float, settings: RoofSettings, points: EdgePoints | None = None
) -> MultiPolygon:
    """Draw an outline with straight edges, valid in integer millimetres; a ring that moves too much area stays raw.

    With the roof points every edge that is long enough moves to where they show it, and the outline is drawn back by
    what mixed pulses add; without them edges stay amid the raw zigzag.
    """
    reach_mm = 0.0 if points is None else mixed_pulse_reach_mm(outline_mm, points)
    raw = _drawn_back(outline_mm, reach_mm)
    straightened: list[Polygon] = []
    noise_m = settings.outline_noise_spacings * spacing_m / _evenness(outline_mm, points)
    for part in raw:
        outer, *holes = _straight_rings(part, spacing_m, (noise_m, settings.min_outline_noise_m), points, reach_mm)
        drawn = Polygon(outer, holes)
        if not drawn.is_valid:
            # a hole that crosses the outside cuts into it
            cut = shapely.difference(
                Polygon(outer), shapely.union_all([Polygon(hole) for hole in holes]), grid_size=1.0
            )
            straightened += polygons_of(cut) or [orient(part)]
            continue
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
    polygon: Polygon, spacing_m: float, noise_m: tuple[float, float], points: EdgePoints | None, reach_mm: float
) -> list[FloatArray]:
    """The rings of one part with straight edges; a ring that cannot be drawn so stays raw.

    The noise of the raw rings follows from the points, but is the second figure at least on large buildings.
    """
    borders = _rings(polygon)
    drawn: list[FloatArray | None] = [None] * len(borders)
    least_mm = min(max(_NOISE_OF_SIZE * math.sqrt(polygon.area), 100.0), noise_m[1] * 1e3)
    noise_mm = max(noise_m[0] * 1e3, least_mm)
    rings = [_Ring(border, breaks_of(border, _BREAK_SPACINGS * spacing_m * 1e3)) for border in borders]
    least = max(_LEAST_SPACINGS * spacing_m, _LEAST_M) * 1e3
    if points is not None and len(points.xy_mm) <= (_FEW_POINTS if spacing_m >= _FEW_SPACING_M else _FEWEST_POINTS):
        drawn[0] = _of_few_points(rings[0], points, noise_mm, least)
    for factor in _FACTORS:
        if all(ring is not None for ring in drawn):
            break
        for k, (border, runs) in enumerate(described(rings, spacing_m * 1e3, factor * noise_mm)):
            if drawn[k] is None and len(runs) > 2:
                beside_mm = _MOVED * Polygon(border).length
                drawn[k] = _ring_of(border, runs, least, beside_mm * noise_mm)
                if drawn[k] is not None and points is not None:
                    _take_positions(border, runs, points, reach_mm)
                    moved = _ring_of(border, runs, least, beside_mm * (noise_mm + points.spacing_mm))
                    drawn[k] = drawn[k] if moved is None else moved
    return [raw if ring is None else ring for raw, ring in zip(borders, drawn, strict=True)]


def _evenness(outline_mm: MultiPolygon, points: EdgePoints | None) -> float:
    """By how much the noise of an outline is smaller than with points at random (Clark and Evans 1954), 1 to 2."""
    if points is None:
        return 1.0
    # neighbours are missed at borders, so few points seem to lie farther apart than they do
    spacing_mm = min(points.spacing_mm, math.sqrt(outline_mm.area / len(points.xy_mm)))
    return math.pow(min(max(points.nearest_mm / (_NEAREST * spacing_mm), 1.0), _EVENEST), _EVEN_POWER)


def _of_few_points(ring: _Ring, points: EdgePoints, noise_mm: float, least_mm: float) -> FloatArray | None:
    """The likeliest ring around few points: as described, or in two directions of any."""
    from pipeline.roof.outlines.few_points import directions, likeliest

    raw, per_mm = Polygon(ring.border), 0.5 / (points.spacing_mm * noise_mm * noise_mm)
    ways, square = described([ring], points.spacing_mm, noise_mm), PRICES._replace(free=PRICES.sharp)
    ways += [(ring.border, _runs(ring, pairs_of([angle]), per_mm, square)[0]) for angle in directions().tolist()]

    def drawn(border: FloatArray, runs: Sequence[Run]) -> FloatArray | None:
        return _ring_of(border, runs, least_mm, 4.0 * _MOVED * noise_mm * raw.length) if len(runs) >= _FEWEST else None

    return likeliest(ways, drawn, raw, points, PRICES)


def described(rings: Sequence[_Ring], spacing_mm: float, noise_mm: float) -> list[tuple[FloatArray, list[Run]]]:
    """The edges of some rings, which share their directions: those of the shortest description of all of them.

    With the vertices of each ring, which begins anew at a corner.
    """
    per_mm = 0.5 / (spacing_mm * noise_mm * noise_mm)
    alone = PRICES._replace(free=_FREE_ALONE)
    none = np.empty(0)
    runs = [_runs(ring, none, per_mm, alone)[0] for ring in rings]
    rings = [_begun_at_a_corner(ring, own) for ring, own in zip(rings, runs, strict=True)]
    tried = peaks_of([run for own in runs for run in own])
    found = [_runs(ring, none, per_mm, PRICES) for ring in rings]
    least, best = math.fsum(cost for _, cost in found), [own for own, _ in found]
    systems: list[float] = []
    while len(systems) < _SYSTEMS:
        better: tuple[float, list[float], list[list[Run]]] | None = None
        for angle in tried:
            if any(abs(off_square(angle, system)) < _APART for system in systems):
                continue
            more = [*systems, angle]
            for is_last in (False, True):
                found = [_runs(ring, pairs_of(more), per_mm, PRICES) for ring in rings]
                cost = math.fsum(own_cost for _, own_cost in found) + _SYSTEM * len(more)
                if better is None or cost < better[0]:
                    better = cost, more, [own for own, _ in found]
                if not is_last:
                    more = _more_exact(more, [run for own, _ in found for run in own if run.exact])
        if better is None or better[0] >= least:
            break
        least, systems, best = better
    for k, own in enumerate(best):
        if len(own) > 2 and math.cos(own[0].direction - own[-1].direction) < SHARP:
            # a spike where the ring begins is the only one without a price
            rings[k] = _begun_at_a_corner(rings[k], own)
            best[k] = _runs(rings[k], pairs_of(systems), per_mm, PRICES)[0]
        ring = rings[k]
        if len(best[k]) < _FEWEST and len(ring.breaks) <= _FEW_BREAKS:
            # a few points never show a triangle: it is the cheapest way to cut the corners of a rectangle
            longest = max(best[k], key=lambda run: run.length).direction if best[k] else 0.0
            best[k] = _runs(ring, pairs_of([longest]), per_mm, PRICES._replace(free=PRICES.sharp))[0]
    return [(ring.border, own) for ring, own in zip(rings, best, strict=True)]


def _runs(
    ring: _Ring, directions: FloatArray, per_mm: float, prices: Prices, met: FloatArray = NONE_MET
) -> tuple[list[Run], float]:
    """The edges of a ring, and the length of their description."""
    ends, of_edge, angles, cost = least_description(ring.border, ring.breaks, directions, per_mm, prices, met)
    runs = fitted_runs(ring.border, ring.breaks[ends])
    for run, index, angle in zip(runs, of_edge.tolist(), angles.tolist(), strict=True):
        run.direction, run.exact = angle, index != FREE
    return runs, cost


def described_chain(
    border: FloatArray,
    directions: FloatArray,
    spacing_mm: float,
    noise_mm: float,
    prices: Prices,
    met: FloatArray = NONE_MET,
) -> list[Run]:
    """The edges of an open border (n, 2), of which `directions` are common to others; `met` as it is described."""
    step = _BREAK_SPACINGS * spacing_mm
    breaks = breaks_of(border, step)[:-1]
    breaks = np.append(breaks[:-1] if len(breaks) > 1 else breaks, len(border) - 1)
    per_mm = 0.5 / (spacing_mm * noise_mm * noise_mm)
    return _runs(_Ring(border=border, breaks=breaks), directions, per_mm, prices, met)[0]


def pairs_of(systems: Sequence[float]) -> FloatArray:
    """Every direction, and the one square to it."""
    return np.array([angle + turn for angle in systems for turn in (0.0, _QUARTER)])


def off_square(direction: float, dominant: float) -> float:
    """By how much a direction differs from the nearest one along or square to another, radians."""
    return math.remainder(direction - dominant, _QUARTER)


def peaks_of(runs: Sequence[Run], most: int = _TRIED) -> list[float]:
    """Directions, modulo a right angle, that most of the squared length of some edges has, the first with most."""
    longest = sorted(runs, key=lambda run: -run.length)[:_VOTERS]
    angles, weights = np.array([(run.direction, run.length**2) for run in longest]).reshape(-1, 2).T
    found: list[float] = []
    first = 0.0
    while len(angles) and len(found) < most and weights.sum() > 0.0:
        off = angles[:, None] - angles[None, :]
        off -= _QUARTER * np.rint(off / _QUARTER)
        near = weights[:, None] * np.exp(-0.5 * (off / _PEAK) ** 2)
        votes = near.sum(axis=0)
        best = int(np.argmax(votes))
        first = first or votes[best]
        if votes[best] < _LEAST_PEAK * first:
            break
        is_here = np.abs(off[:, best]) < _APART
        share = near[is_here, best]
        found.append(float(angles[best] + (off[is_here, best] * share).sum() / share.sum()))
        angles, weights = angles[~is_here], weights[~is_here]
    return found


def _more_exact(systems: Sequence[float], runs: Sequence[Run]) -> list[float]:
    """The directions as the borders along their edges have them, on average."""
    offs: list[list[tuple[float, float]]] = [[] for _ in systems]
    for run in runs:
        k = min(range(len(systems)), key=lambda k: abs(off_square(run.direction, systems[k])))
        off = off_square(run.own, systems[k])
        if abs(off) < _ABOUT:
            offs[k].append((off, run.length**3))
    return [
        system + (math.fsum(off * w for off, w in of) / math.fsum(w for _, w in of) if of else 0.0)
        for system, of in zip(systems, offs, strict=True)
    ]


@kernel
def breaks_of(border: FloatArray, step: float) -> IntArray:
    """Numbers of vertices of a ring (n, 2), ascending from 0 to n, each a step or more from the one before."""
    n = len(border)
    breaks = np.empty(n + 1, np.int64)
    breaks[0], count = 0, 1
    for k in range(1, n):
        dx, dy = border[k, 0] - border[breaks[count - 1], 0], border[k, 1] - border[breaks[count - 1], 1]
        if dx * dx + dy * dy >= step * step:
            breaks[count] = k
            count += 1
    breaks[count] = n
    return breaks[: count + 1].copy()


def _begun_at_a_corner(ring: _Ring, runs: Sequence[Run]) -> _Ring:
    """The same ring from its clearest corner on: where a description begins, it has a corner."""
    if len(runs) < 3:
        return ring
    # where the ring begins now there is an end of an edge, but perhaps no corner
    clear = [abs(math.sin(b.direction - a.direction)) * min(a.length, b.length) for a, b in itertools.pairwise(runs)]
    first = runs[1 + max(range(len(clear)), key=clear.__getitem__)].first % len(ring.border)
    n = len(ring.border)
    turned = np.sort((ring.breaks[:-1] - first) % n)
    return _Ring(border=np.concatenate((ring.border[first:], ring.border[:first])), breaks=np.append(turned, n))


def _take_positions(border: FloatArray, runs: Sequence[Run], points: EdgePoints, reach_mm: float) -> None:
    """Move edges to where the points along them put them; one that is too short moves as the others do on average."""
    shifts = [outward_shift_mm(border, run, points, reach_mm) for run in runs]
    known = sorted(shift for shift in shifts if shift is not None)
    usual = known[len(known) // 2] if known else 0.0
    for run, own in zip(runs, shifts, strict=True):
        shift = min(max(usual if own is None else own, -points.spacing_mm), points.spacing_mm)
        run.x += shift * math.sin(run.direction)
        run.y -= shift * math.cos(run.direction)


def without_short(border: FloatArray, runs: Sequence[Run], least_mm: float) -> list[Run]:
    """The edges of a closed border without those that are shorter between their corners, the shortest first.

    Where the neighbours of such an edge are parallel, they are one edge; where they would meet in a spike, it stays.
    """
    left = list(runs)
    while len(left) > 4:
        lengths = [
            math.inf
            if math.cos(left[(k + 1) % len(left)].direction - left[k - 1].direction) < SHARP
            else _length_between(border, left, k)
            for k in range(len(left))
        ]
        k = min(range(len(left)), key=lengths.__getitem__)
        if lengths[k] >= least_mm:
            break
        before, after = left[k - 1], left[(k + 1) % len(left)]
        if math.cos(after.direction - before.direction) > _SAME:
            if len(left) < 6:
                break
            a, b = before.length, after.length
            before.x, before.y = (before.x * a + after.x * b) / (a + b), (before.y * a + after.y * b) / (a + b)
            before.direction = before.direction if a >= b else after.direction
            before.last, before.length = after.last + (len(border) if after.last <= before.first else 0), a + b
            left = [run for run in left if run is not left[k] and run is not after]
        else:
            del left[k]
    return left


def _length_between(border: FloatArray, runs: Sequence[Run], k: int) -> float:
    """The length of an edge from its first corner to its last one, along its direction."""
    before, run, after = runs[k - 1], runs[k], runs[(k + 1) % len(runs)]
    start = crossing(before, run) or projected(tuple(border[run.first % len(border)].tolist()), run)
    end = crossing(run, after) or projected(tuple(border[run.last % len(border)].tolist()), run)
    return (end[0] - start[0]) * math.cos(run.direction) + (end[1] - start[1]) * math.sin(run.direction)


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


def _ring_of(border: FloatArray, runs: Sequence[Run], least_mm: float, most_mm2: float) -> FloatArray | None:
    """A sound ring through the corners of edges, if no more lies between it and the raw one; loops at corners go."""
    copies = [Run(**vars(run)) for run in runs]
    places = corners(border, without_short(border, copies, least_mm), math.inf, closed=True)
    if len(places) < 3:
        return None
    drawn = snapped_ring(np.array(places))
    if len(drawn) == 0:
        sound = shapely.make_valid(Polygon(places), method="structure", keep_collapsed=False)
        parts = [part for polygon in polygons_of(sound) for part in polygons_of(shapely.set_precision(polygon, 1.0))]
        if not parts:
            return None
        drawn = shapely.get_coordinates(max(parts, key=lambda part: part.area).exterior)[:-1]
    return None if differ_by_more(drawn, border, most_mm2) else drawn
