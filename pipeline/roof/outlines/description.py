"""The shortest description of a ragged border: few edges, in few directions, where the border does not demand more.

The edges between two ends are found by dynamic programming over the vertices of the border and the directions that an
edge may have (Bellman 1961; Perez and Vidal 1994 for polygons). The description costs nats, by the principle of minimum
description length (Rissanen 1978): what the edges leave unexplained, the negative logarithm of a normal density, with
one independent observation per point spacing; and a price per edge, per change of direction. A start of an edge is
given up once it can hardly win (Killick, Fearnhead and Eckley 2012), so the work grows little faster than the
border. A turn at an edge in a direction of its own is priced for the best edge before it, chosen without that turn.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray

FREE = -1
"""The direction of an edge that follows the border alone."""


class Prices(NamedTuple):
    """What a description pays, in nats."""

    edge: float
    """For an edge: two numbers say where it is and where it ends."""
    free: float
    """For an edge in a direction of its own."""
    change: float
    """Where two edges meet that are neither parallel nor square to one another."""
    sharp: float
    """For an inner angle below 63 degrees."""
    flat: float
    """For a turn of less than 12 degrees: the noise of the lines moves such a corner far."""


SHARP = math.cos(math.radians(180.0 - 63.0))
_FLAT = math.sin(math.radians(12.0))
_SQUARE = math.sin(math.radians(81.0))
_LEAST_PROGRESS = 0.3
"""The chord of an edge is at least this share of the border along it, in the edge's direction."""
_DETOUR = 5.0
"""Where turns are paid already, starts may cost so many edges more: near a new start an edge may not get on."""


@kernel
def _moments(border: FloatArray, breaks: IntArray) -> FloatArray:
    """Length and first and second moments of the border from its first break to each, (m, 6)."""
    n, m = len(border), len(breaks)
    sums = np.zeros((m, 6))
    x0, y0 = border[breaks[0] % n, 0], border[breaks[0] % n, 1]
    for k in range(1, m):
        sums[k] = sums[k - 1]
        for i in range(breaks[k - 1], breaks[k]):
            ax, ay = border[i % n, 0] - x0, border[i % n, 1] - y0
            bx, by = border[(i + 1) % n, 0] - x0, border[(i + 1) % n, 1] - y0
            ux, uy = bx - ax, by - ay
            w = math.sqrt(ux * ux + uy * uy)
            mx, my = 0.5 * (ax + bx), 0.5 * (ay + by)
            sums[k, 0] += w
            sums[k, 1] += w * mx
            sums[k, 2] += w * my
            sums[k, 3] += w * (mx * mx + ux * ux / 12.0)
            sums[k, 4] += w * (mx * my + ux * uy / 12.0)
            sums[k, 5] += w * (my * my + uy * uy / 12.0)
    return sums


@kernel(inline="always")
def _turn_price(cosine: float, sine: float, prices: Prices) -> float:
    """The price of a turn from one edge to the next that are not parallel by definition."""
    price = 0.0
    if abs(sine) < _SQUARE:
        price += prices.change
    if cosine < SHARP:
        price += prices.sharp
    elif abs(sine) < _FLAT:
        price += prices.flat
    return price


@kernel
def _turns(directions: FloatArray, prices: Prices) -> FloatArray:
    """The price of every turn between two given directions, each in both senses, (2 d + 1, 2 d + 1).

    State 2 k is direction k, 2 k + 1 its reverse; the last is a free one, whose turns are priced where they are known.
    """
    d = len(directions)
    turns = np.zeros((2 * d + 1, 2 * d + 1))
    for a in range(2 * d):
        for b in range(2 * d):
            if a // 2 == b // 2:  # parallel edges are one, or have one between them
                turns[a, b] = np.inf
            else:
                angle = directions[b // 2] - directions[a // 2] + math.pi * ((b % 2) - (a % 2))
                turns[a, b] = _turn_price(math.cos(angle), math.sin(angle), prices)
    return turns


@kernel(inline="always")
def _end_price(way: tuple[float, float], line: float, prices: Prices) -> float:
    """The price of an end of an edge, a unit vector, on a line with a direction, which has two sides; 0 for nan."""
    ux, uy = math.cos(line), math.sin(line)
    return _turn_price(-abs(ux * way[0] + uy * way[1]), ux * way[1] - uy * way[0], prices)


@kernel(inline="always")
def _own_direction(sxx: float, sxy: float, syy: float, root: float) -> tuple[float, float]:
    """The unit vector along a stretch with some moments, `root` the difference of its principal ones."""
    half = 0.5 * (sxx - syy) / root if root > 0.0 else 0.5
    return math.sqrt(max(0.5 + half, 0.0)), math.copysign(math.sqrt(max(0.5 - half, 0.0)), sxy)


@kernel(inline="always")
def _kept(live: IntArray, costs: FloatArray, most: float) -> int:
    """Leave out the starts that cost more than the most; the number of those that stay, and one that may follow."""
    kept = 0
    for p in range(len(costs)):
        live[kept] = live[p]
        kept += costs[p] <= most
    return kept + 1


@kernel(inline="always")
def _turn(best: FloatArray, turns: FloatArray, before: FloatArray, through: IntArray) -> None:
    """Fill in the best description before an edge in each state (2 d + 1,), and the state of the edge before it."""
    for b in range(len(best)):
        for a in range(len(best)):
            total = best[a] + turns[a, b]
            if total < before[b]:
                before[b], through[b] = total, a


@kernel
def least_description(
    border: FloatArray, breaks: IntArray, directions: FloatArray, per_mm: float, prices: Prices, met: FloatArray
) -> tuple[IntArray, IntArray, FloatArray, float]:
    """The edges from the first break of a border to the last that are described shortest.

    Parameters
    ----------
    border : (n, 2) float64
        Vertices in millimetres; those of a closed border once, its breaks go on behind n.
    breaks : (m,) int64
        Vertices at which edges may end, ascending, m >= 2.
    directions : (d,) float64
        Directions that edges share, modulo half a turn, radians.
    per_mm : float
        Nats per millimetre of the border and square millimetre of its distance from the edge.
    prices : Prices
        What edges and turns cost.
    met : (2,) float64
        Directions of the lines on which the first edge begins and the last one ends, radians; nan where there is none.

    Returns
    -------
    tuple
        The breaks between edges by their number, (e + 1,); the direction of each, FREE for its own, (e,); its angle
        along the border, radians, (e,); the length of the description, nats.
    """
    m, d = len(breaks), len(directions)
    free = 2 * d
    xy = border[breaks % len(border)]
    sums = _moments(border, breaks)
    turns = _turns(directions, prices)
    # along each direction the places, across it the first and second moments
    ux, uy = np.cos(directions).reshape(-1, 1), np.sin(directions).reshape(-1, 1)
    along, across = ux * xy[:, 0] + uy * xy[:, 1], ux * sums[:, 2] - uy * sums[:, 1]
    squares = ux * ux * sums[:, 5] - 2.0 * ux * uy * sums[:, 4] + uy * uy * sums[:, 3]
    # the best description up to each break that ends in a state; the best before an edge that begins in a state
    best = np.full((m, free + 1), np.inf)
    start = np.full((m, free + 1), -1, np.int64)
    came = np.full((m, free + 1), -1, np.int64)
    ways = np.zeros((m, free + 1, 2))
    before = np.full((m, free + 1), np.inf)
    through = np.full((m, free + 1), -1, np.int64)
    before[0, :] = 0.0
    # the starts of edges that may still win, by direction and without one, and what they cost up to here
    live, alive = np.zeros((d + 1, m), np.int64), np.ones(d + 1, np.int64)
    costs = np.empty((d + 1, m))
    # with another start one turn may cost less, and the end, where it has a price
    spare = (2 - math.isnan(met[1])) * (prices.change + max(prices.sharp, prices.flat))
    paid = _DETOUR * prices.edge
    for j in range(1, m):
        for k in range(d + 1):
            # the start that won last goes first: few of the others then need more than their costs
            state = 2 * k + (best[j - 1, min(2 * k + 1, free)] < best[j - 1, 2 * k])
            lead = np.searchsorted(live[k, : alive[k]], max(start[j - 1, state], 0))
            for turn in range(alive[k]):
                p = lead if turn == 0 else turn - (turn <= lead)
                i = live[k, p]
                w = sums[j, 0] - sums[i, 0]
                if w <= 0.0:
                    costs[k, p] = 0.0
                    continue
                if k < d:
                    way, mean = along[k, j] - along[k, i], across[k, j] - across[k, i]
                    vx, vy = ux[k, 0], uy[k, 0]
                    state = 2 * k if way >= 0.0 else 2 * k + 1
                    off = squares[k, j] - squares[k, i] - mean * mean / w
                    costs[k, p] = before[i, state] + per_mm * max(off, 0.0)
                    total = costs[k, p] + prices.edge
                    if total > best[j, state] or abs(way) < _LEAST_PROGRESS * w:
                        continue
                else:
                    mx, my, a_w = sums[j, 1] - sums[i, 1], sums[j, 2] - sums[i, 2], 1.0 / w
                    sxx = sums[j, 3] - sums[i, 3] - mx * mx * a_w
                    sxy = sums[j, 4] - sums[i, 4] - mx * my * a_w
                    syy = sums[j, 5] - sums[i, 5] - my * my * a_w
                    root = math.sqrt((sxx - syy) * (sxx - syy) + 4.0 * sxy * sxy)
                    costs[k, p] = before[i, free] + per_mm * max(0.5 * (sxx + syy - root), 0.0)
                    state = free
                    total = costs[k, p] + (prices.edge + prices.free)
                    if total > best[j, free]:
                        continue
                    vx, vy = _own_direction(sxx, sxy, syy, root)
                    way = vx * (xy[j, 0] - xy[i, 0]) + vy * (xy[j, 1] - xy[i, 1])
                    if abs(way) < _LEAST_PROGRESS * w:
                        continue
                if way < 0.0:
                    vx, vy = -vx, -vy
                last = through[i, state]
                if i == 0:
                    total += _end_price((vx, vy), met[0], prices)
                elif free in (state, last):
                    bx, by = ways[i, last, 0], ways[i, last, 1]
                    total += _turn_price(bx * vx + by * vy, bx * vy - by * vx, prices)
                if j == m - 1:
                    total += _end_price((vx, vy), met[1], prices)
                if total > best[j, state] or (total == best[j, state] and i > start[j, state]):
                    continue
                best[j, state], start[j, state], came[j, state] = total, i, last
                ways[j, state, 0], ways[j, state, 1] = vx, vy
        _turn(best[j], turns, before[j], through[j])
        for k in range(d + 1):
            one, other = 2 * k, min(2 * k + 1, free)
            most = max(
                before[j, one] + (spare if free in (one, through[j, one]) else paid),
                before[j, other] + (spare if free in (other, through[j, other]) else paid),
            )
            alive[k] = _kept(live[k], costs[k, : alive[k]], most)
            live[k, alive[k] - 1] = j
    state = int(np.argmin(best[m - 1]))
    ends, of_edge, along_edge = _traced_back(start, came, ways, directions, state)
    return ends, of_edge, along_edge, best[m - 1, state]


@kernel(inline="always")
def _traced_back(
    start: IntArray, came: IntArray, ways: FloatArray, directions: FloatArray, state: int
) -> tuple[IntArray, IntArray, FloatArray]:
    """The ends of the edges of the best description, the direction of each and its angle, from the last one back."""
    m, free = len(start), start.shape[1] - 1
    ends, of_edge, along_edge = np.empty(m, np.int64), np.empty(m, np.int64), np.empty(m)
    count, j = 0, m - 1
    while j > 0 and state >= 0:
        ends[count], of_edge[count] = j, FREE if state == free else state // 2
        if state == free:
            along_edge[count] = math.atan2(ways[j, state, 1], ways[j, state, 0])
        else:
            along_edge[count] = directions[state // 2] + (math.pi if state % 2 else 0.0)
        j, state = start[j, state], came[j, state]
        count += 1
    ends[count] = 0
    return ends[count::-1].copy(), of_edge[:count][::-1].copy(), along_edge[:count][::-1].copy()
