"""Ground and plants that are seen through a roof of glass, where a few points lie on a square metre.

Each point of a greenhouse shows the roof or what is beneath it by chance, whatever its neighbours show. Alleys, yards
and the ground around houses are places: there a low point has low neighbours. So a low vertex lies under glass if the
vertices of level roofs surround it, if most of the surrounded vertices of roofs near it have a low one among their
nearest, and if low vertices keep no company of their own. Crowns, through which pulses pass by chance as well, are
rough.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, KindArray, LabelArray
from pipeline.terrain.binning import points_by_cell
from pipeline.terrain.facets import SceneVertices, VertexKind

# Not settings: they say what glass is, in neighbours.
REACH_MM = 4000
"""Farther vertices are not neighbours."""
SQUARE_MM, NEAR = 2000, 2
"""Side of the squares that collect what is found, and how many of them around one are judged together."""
_AROUND = 8
"""The nearest vertices of roofs, which surround a vertex or do not."""
_AT_EDGES = 24
"""As many surround what lies under the edges of a roof that is known to be of glass."""
_FEWEST_AROUND = 5
"""Fewer surround nothing."""
_NEAREST = 6
"""The nearest vertices of any kind: where 30 % of the pulses go through, seven in eight roof vertices have a low one
among as many."""
_FEWEST_NEAR = 32
"""Vertices within reach, two for 3 m2: where there are fewer, houses are mixed with what surrounds them."""
_MOST_POINTS = 48
"""Points in a square, on average: where there are more, the squares of `terrain.glass` hold enough."""
_MIXED_SHARE = 0.6
"""Surrounded vertices of roofs that have a low one among their nearest. A sixth of the pulses make as many."""
_COMPANY = 0.35
"""How much of the way from chance to keeping to itself the low vertices may have gone."""
_LEVEL_SHARE = 0.8
"""Share of the vertices at the height of roofs whose surroundings are planar."""
_FEWEST, _FEWEST_LOW = 12, 8
"""Surrounded vertices of roofs, and low ones: fewer show nothing."""
_BELOW_MM = 1000
"""How far what is seen through a roof lies below it at least."""


class _Part(IntEnum):
    """What a vertex is."""

    OTHER = 0
    """Higher than ground and plants, and rough or of unknown surroundings."""
    LOW = 1
    """Below the height of roofs."""
    ROOF = 2
    """At the height of roofs, with planar surroundings, or building by its class."""


class _Found(IntEnum):
    """Columns of what is counted in a square."""

    HIGH = 0
    """All vertices at the height of roofs."""
    ROOF = 1
    INNER_ROOF = 2
    """Surrounded by others of roofs."""
    MIXED = 3
    """Those with a low one, itself surrounded, among their nearest."""
    LOW = 4
    """Surrounded low ones."""
    LOW_NEIGHBOURS = 5
    """Nearest vertices of these that are surrounded and low."""
    NEIGHBOURS = 6
    """Nearest vertices of these that are surrounded."""


_COLUMNS = len(_Found)


class _Cells(NamedTuple):
    """Vertices by square cells as wide as the reach."""

    x_mm: IntArray
    y_mm: IntArray
    start: LabelArray
    members: LabelArray
    column0: int
    row0: int
    columns: int
    rows: int


@kernel
def _nearest(v: int, cells: _Cells, wanted: BoolArray, found: IntArray) -> tuple[int, int]:
    """Fill `found` with the wanted vertices nearest to v, without v itself; how many, and how many of any kind near it.

    Equal distances by number: vertices come sorted by (x, y).
    """
    x, y = cells.x_mm, cells.y_mm
    distance = np.empty(found.size, np.int64)
    count, within = 0, 0
    c, r = x[v] // REACH_MM - cells.column0, y[v] // REACH_MM - cells.row0
    for rr in range(max(r - 1, 0), min(r + 2, cells.rows)):
        first = rr * cells.columns
        for m in range(cells.start[first + max(c - 1, 0)], cells.start[first + min(c + 1, cells.columns - 1) + 1]):
            w = cells.members[m]
            away = (x[w] - x[v]) ** 2 + (y[w] - y[v]) ** 2
            if away > REACH_MM * REACH_MM:
                continue
            within += 1
            if not wanted[w] or w == v:
                continue
            k = min(count, found.size - 1)
            if count == found.size and (away > distance[k] or (away == distance[k] and w > found[k])):
                continue
            while k > 0 and (away < distance[k - 1] or (away == distance[k - 1] and w < found[k - 1])):
                distance[k], found[k] = distance[k - 1], found[k - 1]
                k -= 1
            distance[k], found[k] = away, w
            count = min(count + 1, found.size)
    return count, within


@kernel
def _are_around(v: int, cells: _Cells, around: IntArray) -> bool:
    """Whether no straight line through vertex v has all of some others on one side."""
    x, y = cells.x_mm, cells.y_mm
    for i in around:
        ux, uy = x[i] - x[v], y[i] - y[v]
        is_open = True
        for j in around:
            if ux * (y[j] - y[v]) - uy * (x[j] - x[v]) > 0:
                is_open = False
        if is_open:
            return False
    return True


@kernel
def _inner(vertices: SceneVertices, part: KindArray, cells: _Cells, sparse: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Which vertices (v,), low ones and those of roofs, lie among the nearest ones of roofs, and among more of them.

    None where points are dense.
    """
    n = part.size
    inner, covered = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    is_roof, around = np.zeros(n, np.bool_), np.empty(_AT_EDGES, np.int64)
    for v in range(n):
        is_roof[v] = part[v] == _Part.ROOF
    for v in range(n):
        if part[v] == _Part.OTHER or not sparse[v]:
            continue
        count, within = _nearest(v, cells, is_roof, around)
        if count < _FEWEST_AROUND or within < _FEWEST_NEAR:
            continue
        near = min(count, _AROUND)
        if part[v] == _Part.LOW:
            rise = 0
            for w in around[:near]:
                rise += vertices.z_mm[w] - vertices.z_mm[v]
            if rise < near * _BELOW_MM:
                continue
        inner[v] = _are_around(v, cells, around[:near])
        covered[v] = inner[v] or _are_around(v, cells, around[:count])
    return inner, covered


@kernel
def _count(
    part: KindArray, inner: BoolArray, cells: _Cells, corner: tuple[int, int], shape: tuple[int, int]
) -> IntArray:
    """What the squares (rows, columns, C) hold, columns as in `_Found`."""
    out = np.zeros((shape[0], shape[1], _COLUMNS), np.int64)
    every, near = np.ones(part.size, np.bool_), np.empty(_NEAREST, np.int64)
    for v in range(part.size):
        square = out[cells.y_mm[v] // SQUARE_MM - corner[0], cells.x_mm[v] // SQUARE_MM - corner[1]]
        square[_Found.HIGH] += part[v] != _Part.LOW
        square[_Found.ROOF] += part[v] == _Part.ROOF
        if not inner[v]:
            continue
        count, _ = _nearest(v, cells, every, near)
        low, known = 0, 0
        for w in near[:count]:
            known += inner[w]
            low += inner[w] and part[w] == _Part.LOW
        if part[v] == _Part.ROOF:
            square[_Found.INNER_ROOF] += 1
            square[_Found.MIXED] += low > 0
        else:
            square[_Found.LOW] += 1
            square[_Found.LOW_NEIGHBOURS] += low
            square[_Found.NEIGHBOURS] += known
    return out


@kernel
def _glass(squares: IntArray) -> BoolArray:
    """Which squares (rows, columns) lie under glass, by those around each."""
    rows, columns = squares.shape[0], squares.shape[1]
    out = np.zeros((rows, columns), np.bool_)
    for r in range(rows):
        for c in range(columns):
            s = np.zeros(_COLUMNS, np.int64)
            for rr in range(max(r - NEAR, 0), min(r + NEAR + 1, rows)):
                for cc in range(max(c - NEAR, 0), min(c + NEAR + 1, columns)):
                    s += squares[rr, cc]
            share = s[_Found.LOW] / max(s[_Found.LOW] + s[_Found.INNER_ROOF], 1)
            company = s[_Found.LOW_NEIGHBOURS] / max(s[_Found.NEIGHBOURS], 1)
            out[r, c] = (
                s[_Found.INNER_ROOF] >= _FEWEST
                and s[_Found.LOW] >= _FEWEST_LOW
                and s[_Found.ROOF] >= _LEVEL_SHARE * s[_Found.HIGH]
                and s[_Found.MIXED] >= _MIXED_SHARE * s[_Found.INNER_ROOF]
                and company <= share + _COMPANY * (1.0 - share)
            )
    return out


@kernel
def _parts(vertices: SceneVertices, least_mm: int) -> KindArray:
    """`_Part` of each vertex."""
    out = np.empty(len(vertices.x_mm), np.int8)
    for v in range(out.size):
        kind = vertices.kind[v]
        # not what was joined to a building: whether far vertices are, another tile decides
        may_be = kind == VertexKind.OBJECT or kind == VertexKind.JOINED  # noqa: PLR1714 - compiled
        if kind == VertexKind.BUILDING or (may_be and vertices.planar[v] > 0 and vertices.height_mm[v] >= least_mm):
            out[v] = _Part.ROOF
        elif kind == VertexKind.GROUND or vertices.height_mm[v] < least_mm:
            out[v] = _Part.LOW
        else:
            out[v] = _Part.OTHER
    return out


@kernel
def _where_sparse(
    cells: _Cells, points: tuple[IntArray, IntArray], used: BoolArray, corner: tuple[int, int], shape: tuple[int, int]
) -> BoolArray:
    """Which vertices (v,) lie where few points, of those that may be ground or roof, lie around."""
    rows, columns = shape
    sums = np.zeros((rows + 1, columns + 1), np.int64)
    for i in range(used.size):
        r, c = points[1][i] // SQUARE_MM - corner[0], points[0][i] // SQUARE_MM - corner[1]
        if used[i] and 0 <= r < rows and 0 <= c < columns:
            sums[r + 1, c + 1] += 1
    for r in range(rows):
        for c in range(columns):
            sums[r + 1, c + 1] += sums[r, c + 1] + sums[r + 1, c] - sums[r, c]
    out = np.zeros(cells.x_mm.size, np.bool_)
    most = _MOST_POINTS * (2 * NEAR + 1) ** 2
    for v in range(out.size):
        r, c = cells.y_mm[v] // SQUARE_MM - corner[0], cells.x_mm[v] // SQUARE_MM - corner[1]
        south, north = max(r - NEAR, 0), min(r + NEAR + 1, rows)
        west, east = max(c - NEAR, 0), min(c + NEAR + 1, columns)
        out[v] = sums[north, east] - sums[south, east] - sums[north, west] + sums[south, west] <= most
    return out


def are_low(vertices: SceneVertices, least_mm: int) -> BoolArray:
    """Which vertices (v,) are lower than roofs: ground and plants."""
    low: BoolArray = _parts(vertices, least_mm) == _Part.LOW
    return low


def under_sparse_glass(
    vertices: SceneVertices, x_mm: IntArray, y_mm: IntArray, used: BoolArray, least_mm: int
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Which vertices (v,) lie in squares of glass, which low ones of them under it, and which points (n,) in squares.

    Parameters
    ----------
    vertices : SceneVertices
        Thinned points with their kinds and how planar their surroundings are, at least one, sorted by (x, y).
    x_mm, y_mm, used : (n,)
        All points, and which of them may be ground or roof.
    least_mm : int
        Height from which a vertex may be of a roof.
    """
    x, y = vertices.x_mm, vertices.y_mm
    part = _parts(vertices, least_mm)
    corner = (int(y.min()) // SQUARE_MM, int(x.min()) // SQUARE_MM)
    shape = (int(y.max()) // SQUARE_MM - corner[0] + 1, int(x.max()) // SQUARE_MM - corner[1] + 1)
    cells = _Cells(x, y, *points_by_cell(x, y, np.ones(len(x), np.bool_), REACH_MM))
    inner, covered = _inner(vertices, part, cells, _where_sparse(cells, (x_mm, y_mm), used, corner, shape))
    glass = _glass(_count(part, inner, cells, corner, shape))
    at = glass[y // SQUARE_MM - corner[0], x // SQUARE_MM - corner[1]]
    r, c = y_mm // SQUARE_MM - corner[0], x_mm // SQUARE_MM - corner[1]
    inside = (r >= 0) & (r < shape[0]) & (c >= 0) & (c < shape[1])
    inside[inside] = glass[r[inside], c[inside]]
    return at, at & covered & (part == _Part.LOW), inside
