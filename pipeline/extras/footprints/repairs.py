"""Repairs invalid polygons from untrusted files, within a limit of work.

A star of 101 corners has 5100 crossings and takes GEOS eight seconds; one of 301 corners takes hours. The work is
therefore estimated beforehand from the number of crossings. It depends on the polygons alone, never on time.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

PAIRS_LIMIT = 25_000_000
"""Maximum work of exact repairs of one file, which is seconds: for each polygon the square of its crossings and rings,
since the polygon is put together again from all its pieces at each level of nesting."""
SIMPLE_LIMIT = 200_000
"""Maximum number of crossings, and of rings by their weight, of simple repairs of one file: seconds as well."""
EDGES_LIMIT = 2_000_000
"""Maximum number of edges of a polygon whose crossings are counted."""
LOOKS_LIMIT = 5_000_000
"""Maximum number of pairs of edges of one polygon, neighbours aside, whose boxes meet; each is looked at."""
LOOKS_OF_FILE = 20_000_000
"""The same for all invalid polygons of one file."""
_RING_WEIGHT = 3
"""Crossings that cost as much as a ring."""
_AT_ONCE = 8_000_000
"""Pairs that a query may give at most."""


@dataclasses.dataclass(kw_only=True)
class Repairs:
    """Repairs the polygons of one file, one after the other, until its limits are used up."""

    pairs: int = PAIRS_LIMIT
    """Left of `PAIRS_LIMIT`."""
    simple: int = SIMPLE_LIMIT
    """Left of `SIMPLE_LIMIT`."""
    looks: int = LOOKS_OF_FILE
    """Left of `LOOKS_OF_FILE`."""

    def of(self, polygon: Polygon | MultiPolygon) -> list[Polygon] | None:
        """The areas of an invalid polygon; empty if there are none, None if finding them is too much work.

        A polygon of many crossings is repaired in the simple way: what its rings go round is inside.
        """
        rings = shapely.get_rings(shapely.get_parts(polygon))
        limit = min(self.looks, LOOKS_LIMIT)
        count = crossings(rings, limit)
        self.looks -= limit if count is None else count.looks
        if count is None:
            return None
        work = count.crossings + _RING_WEIGHT * len(rings)
        if work**2 <= self.pairs:
            self.pairs -= work**2
            valid = shapely.make_valid(polygon)
        elif work <= self.simple:
            self.simple -= work
            valid = shapely.make_valid(polygon, method="structure", keep_collapsed=False)
        else:
            return None
        parts = shapely.get_parts(shapely.get_parts(valid)).tolist()
        return [part for part in parts if isinstance(part, Polygon) and part.area > 0.0]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Count:
    """How often lines meet."""

    crossings: int
    """Pairs of edges that meet, neighbours aside."""
    looks: int
    """Pairs of edges whose boxes meet, neighbours aside: each was looked at."""


def crossings(
    lines: npt.NDArray[np.object_], looks_limit: int = LOOKS_LIMIT, *, only_proper: bool = False
) -> Count | None:
    """How often the edges of (n,) lines or rings meet, themselves or each other; None if counting is too much work.

    With `only_proper` edges that touch do not count: polygons side by side have many of these.

    >>> bow_tie = shapely.linearrings([[0, 0], [2, 2], [2, 0], [0, 2]])
    >>> crossings(np.array([bow_tie]))
    Count(crossings=1, looks=1)
    """
    xy, line = shapely.get_coordinates(lines, return_index=True)
    begin = np.flatnonzero(line[1:] == line[:-1])
    begin = begin[(xy[begin] != xy[begin + 1]).any(axis=1)]
    n = len(begin)
    if n > EDGES_LIMIT:
        return None
    edges = shapely.linestrings(np.stack([xy[begin], xy[begin + 1]], axis=1))
    tree = shapely.STRtree(edges)
    looks = met = 0
    step = max(1, _AT_ONCE // max(n, 1))
    for first in range(0, n, step):
        one, other = tree.query(edges[first : first + step])
        one += first
        # the next edge of a ring meets this one in their common corner
        later = (other > one) & ~_joined(xy, begin, one, other)
        one, other = one[later], other[later]
        looks += len(one)
        if looks > looks_limit:
            return None
        meet = shapely.crosses if only_proper else shapely.intersects
        met += int(np.count_nonzero(meet(edges[one], edges[other])))
    return Count(crossings=met, looks=looks)


def _joined(
    xy: npt.NDArray[np.float64],
    begin: npt.NDArray[np.int64],
    one: npt.NDArray[np.int64],
    other: npt.NDArray[np.int64],
) -> npt.NDArray[np.bool_]:
    """Which pairs of edges join end to start and go on, so that they meet in that corner alone, or in one more."""
    forth = (xy[begin[one] + 1] == xy[begin[other]]).all(axis=1)
    back = (xy[begin[other] + 1] == xy[begin[one]]).all(axis=1)
    joined: npt.NDArray[np.bool_] = forth | back
    return joined
