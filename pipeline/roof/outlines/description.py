"""The shortest description of a ragged border: few edges, in few directions, where the border does not demand more.

The edges between two ends are found by dynamic programming over the vertices of the border and the directions that an
edge may have (Bellman 1961; Perez and Vidal 1994 for polygons). The description costs nats, by the principle of minimum
description length (Rissanen 1978): what the edges leave unexplained, the negative logarithm of a normal density, with
one independent observation per point spacing; and a price per edge, per change of direction. A start of an edge is
given up once it cannot win anywhere (Killick, Fearnhead and Eckley 2012), so the work grows little faster than the
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
def _end_price(angle: float, is_first: bool, is_last: bool, met: FloatArray, prices: Prices) -> float:
    """The price of the ends of an edge on the lines that the description begins and ends on, which have two sides."""
    price = 0.0
    for k in range(2):
        if is_first if k == 0 else is_last:
            turn = angle - met[k]
            price += _turn_price(-abs(math.cos(turn)), math.sin(turn), prices)  # no price if it is nan
    return price


@kernel(inline="always")
def _own_direction(moments: tuple[float, float, float], cx: float, cy: float) -> tuple[float, float]:
    """The angle of the line through a stretch with moments xx, xy and yy, and how far its chord goes along it."""
    sxx, sxy, syy = moments
    angle = 0.5 * math.atan2(2.0 * sxy, sxx - syy)
    along = math.cos(angle) * cx + math.sin(angle) * cy
    return angle if along >= 0.0 else angle + math.pi, along


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
    cosines, sines = np.cos(directions), np.sin(directions)
    # the best description up to each break that ends in a state; the best before an edge that begins in a state
    best = np.full((m, free + 1), np.inf)
    start = np.full((m, free + 1), -1, np.int64)
    came = np.full((m, free + 1), -1, np.int64)
    angles = np.zeros((m, free + 1))
    before = np.full((m, free + 1), np.inf)
    through = np.full((m, free + 1), -1, np.int64)
    before[0, :] = 0.0
    live = np.empty(m, np.int64)
    live[0] = 0
    alive = 1
    spare = prices.edge + prices.free + prices.change + max(prices.sharp, prices.flat)
    if not math.isnan(met[1]):  # the last edge has the price of its end, too
        spare += prices.change + max(prices.sharp, prices.flat)
    for j in range(1, m):
        reached = np.full(alive, np.inf)
        # the start that won last goes first: few of the others then need their angles
        lead = np.searchsorted(live[:alive], max(start[j - 1, free], 0))
        for turn in range(alive):
            place = lead if turn == 0 else turn - (turn <= lead)
            i = live[place]
            w = sums[j, 0] - sums[i, 0]
            if w <= 0.0:
                reached[place] = 0.0
                continue
            mx, my = (sums[j, 1] - sums[i, 1]) / w, (sums[j, 2] - sums[i, 2]) / w
            sxx = (sums[j, 3] - sums[i, 3]) / w - mx * mx
            sxy = (sums[j, 4] - sums[i, 4]) / w - mx * my
            syy = (sums[j, 5] - sums[i, 5]) / w - my * my
            cx, cy = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
            scale = w * per_mm
            for k in range(d + 1):
                state, angle, along = free, 0.0, 0.0
                if k < d:
                    off = sines[k] * sines[k] * sxx - 2.0 * sines[k] * cosines[k] * sxy + cosines[k] * cosines[k] * syy
                    along = cosines[k] * cx + sines[k] * cy
                    state = 2 * k if along >= 0.0 else 2 * k + 1
                    angle = directions[k] if along >= 0.0 else directions[k] + math.pi
                else:
                    off = 0.5 * (sxx + syy) - math.sqrt(0.25 * (sxx - syy) ** 2 + sxy * sxy)
                unexplained = before[i, state] + scale * max(off, 0.0)
                reached[place] = min(reached[place], unexplained)
                total = unexplained + (prices.edge if k < d else prices.edge + prices.free)
                if total > best[j, state]:
                    continue
                if k == d:
                    angle, along = _own_direction((sxx, sxy, syy), cx, cy)
                if abs(along) < _LEAST_PROGRESS * w:
                    continue
                last = through[i, state]
                total += _end_price(angle, i == 0, j == m - 1, met, prices)
                if i > 0 and free in (state, last):
                    bend = angle - angles[i, last]
                    total += _turn_price(math.cos(bend), math.sin(bend), prices)
                if total > best[j, state] or (total == best[j, state] and i > start[j, state]):
                    continue
                best[j, state], start[j, state], came[j, state], angles[j, state] = total, i, last, angle
        least = np.min(best[j])
        _turn(best[j], turns, before[j], through[j])
        kept = 0
        for place in range(alive):
            if reached[place] <= least + spare:
                live[kept] = live[place]
                kept += 1
        live[kept] = j
        alive = kept + 1
    state = int(np.argmin(best[m - 1]))
    ends, of_edge, along_edge = _traced_back(start, came, angles, state)
    return ends, of_edge, along_edge, best[m - 1, state]


@kernel(inline="always")
def _traced_back(
    start: IntArray, came: IntArray, angles: FloatArray, state: int
) -> tuple[IntArray, IntArray, FloatArray]:
    """The ends of the edges of the best description, the direction of each and its angle, from the last one back."""
    m, free = len(start), start.shape[1] - 1
    ends, of_edge, along_edge = np.empty(m, np.int64), np.empty(m, np.int64), np.empty(m)
    count, j = 0, m - 1
    while j > 0 and state >= 0:
        ends[count], of_edge[count], along_edge[count] = j, FREE if state == free else state // 2, angles[j, state]
        j, state = start[j, state], came[j, state]
        count += 1
    ends[count] = 0
    return ends[count::-1].copy(), of_edge[:count][::-1].copy(), along_edge[:count][::-1].copy()
