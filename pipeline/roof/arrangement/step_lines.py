"""Steps from the borders of coarse labels: chains of places, and the edges of their shortest description.

A border between two labels is a set of places, each half-way between two neighbouring cells. Places that follow each
other are a chain, which zigzags by the spacing of the points. Its shortest description (`outlines.description`) has few
edges, in the directions of the building where the places do not demand others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.raster_labels import Raster
from pipeline.roof.outlines.description import Prices, least_description

PRICES = Prices(edge=4.0, free=8.0, change=3.0, sharp=60.0, flat=60.0)
"""As those of an outline."""
_NOISE_SPACINGS, _NOISE_M = 0.3, 0.2
"""Standard deviation of places about their step: in point spacings, and at least."""
_FAR = 1e8
"""Above any squared distance between places, m2."""


class Border(NamedTuple):
    """The borders between cells of different labels: each a place amid two neighbours, by their pair of labels."""

    places: FloatArray
    """(m, 2) float64, metres."""
    pairs: IntArray
    """(m,) int64, low * planes + high, ascending."""
    ends: IntArray
    """(m, 2) int64, the two corners of the cells between which the border lies there, ascending."""
    corners: int
    """How many corners there are."""


@kernel
def border_places(labels: LabelArray, raster: Raster, n_planes: int) -> Border:
    """The border between cells of different labels, (n,) int32."""
    place, columns = raster.place, raster.columns
    places, ends = np.empty((2 * len(place), 2)), np.empty((2 * len(place), 2), np.int64)
    pairs = np.empty(2 * len(place), np.int64)
    m = 0
    for i in range(len(place)):
        r, c = place[i] // columns, place[i] % columns
        for step in range(2):
            if (c + 1 >= columns) if step == 0 else (r + 1 >= raster.rows):
                continue
            j = raster.number[place[i] + (1 if step == 0 else columns)]
            if j < 0 or labels[j] == labels[i]:
                continue
            places[m, 0] = raster.west + (c + 0.5 + 0.5 * (step == 0)) * raster.cell_m
            places[m, 1] = raster.south + (r + 0.5 + 0.5 * (step == 1)) * raster.cell_m
            # a column and a row of corners more than of cells
            ends[m, 1] = (r + 1) * (columns + 1) + c + 1
            ends[m, 0] = ends[m, 1] - (columns + 1 if step == 0 else 1)
            pairs[m] = np.int64(min(labels[i], labels[j])) * n_planes + max(labels[i], labels[j])
            m += 1
    order = ascending_order(pairs[:m])
    return Border(places[order], pairs[order], ends[order], (columns + 1) * (raster.rows + 1))


@kernel
def chains_of(border: Border, members: IntArray, at: IntArray) -> tuple[IntArray, IntArray]:
    """Put some places of one pair in chains along the border: places in their order, first of each chain, (c + 1,).

    A chain ends where the border ends or forks. A closed one begins at its place farthest from the middle of all. `at`
    (corners, 3) is work space, zero before and after.
    """
    m = len(members)
    order, starts = np.empty(m, np.int64), np.zeros(m + 1, np.int64)
    middle_x, middle_y = np.mean(border.places[members, 0]), np.mean(border.places[members, 1])
    # the places at each corner: two of them, and their number
    for s in range(m):
        for side in range(2):
            corner = border.ends[members[s], side]
            at[corner, min(at[corner, 2], 1)] = s
            at[corner, 2] += 1
    nearness = np.empty(m)
    for s in range(m):
        x, y = border.places[members[s], 0] - middle_x, border.places[members[s], 1] - middle_y
        nearness[s] = -x * x - y * y
        # chains with an end come first, from there
        if at[border.ends[members[s], 0], 2] != 2 or at[border.ends[members[s], 1], 2] != 2:
            nearness[s] -= _FAR
    is_left = np.ones(m, np.bool_)
    n, chains = 0, 0
    for s in ascending_order(np.rint(nearness * 1e6)):
        if not is_left[s]:
            continue
        corner = border.ends[members[s], 1]
        if at[corner, 2] != 2:
            corner = border.ends[members[s], 0]
        here = s
        while is_left[here]:
            is_left[here] = False
            order[n] = members[here]
            n += 1
            if at[corner, 2] != 2:
                break
            here = at[corner, 0] + at[corner, 1] - here
            corner = border.ends[members[here], 0] + border.ends[members[here], 1] - corner
        chains += 1
        starts[chains] = n
    for s in range(m):
        for side in range(2):
            at[border.ends[members[s], side]] = 0
    return order, starts[: chains + 1].copy()


@kernel(inline="always")
def _is_closed(border: Border, chain: IntArray) -> bool:
    """Whether a chain of places comes back to its first one."""
    one, other = border.ends[chain[0]], border.ends[chain[-1]]
    return len(chain) > 3 and bool(one[0] in (other[0], other[1]) or one[1] in (other[0], other[1]))


@kernel
def steps_of(border: Border, chain: IntArray, directions: FloatArray, spacing_m: float) -> tuple[IntArray, FloatArray]:
    """Describe a chain of at least two places by edges: where they begin and end in it, (e + 1,), and directions, (e,).

    A closed chain of n places ends in its place n, which is the first. `directions` (d,) are those of the building,
    radians.
    """
    n = len(chain)
    breaks = np.arange(n + 1 if _is_closed(border, chain) else n)
    noise_mm = 1e3 * max(_NOISE_SPACINGS * spacing_m, _NOISE_M)
    per_mm = 0.5 / (1e3 * spacing_m * noise_mm * noise_mm)
    none_met = np.full(2, np.nan)
    ends, _, angles, _ = least_description(1e3 * border.places[chain], breaks, directions, per_mm, PRICES, none_met)
    return ends, angles
