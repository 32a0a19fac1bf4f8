"""The facets of a scene's TIN: their kinds, and which ones neighbouring tiles see, too.

Facets whose elevation difference MX_zdiff reaches 2 m are walls (Shorter and Kasparis, section 3.1). The other facets
are united over shared edges, ground with ground and object with object. All decisions use exact integers, or floats in
one order: every tile that sees a facet decides the same.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, KindArray, LabelArray

_GAP_SPACINGS = 5.0
"""A wide facet is no surface if its circumradius is this many times the distance from each corner to the second nearest
vertex.

Not a setting: among randomly scattered points one circumradius in a million is that large.
"""


class FacetKind(IntEnum):
    """What a facet of the scene's TIN is."""

    VOID = 0
    """Too wide a gap between points: no surface."""
    BORDER = 1
    """Ground meets object, or a wall that reaches the ground."""
    GROUND = 2
    """All vertices are ground."""
    OBJECT = 3
    """All vertices stand above the ground; nothing else is known."""
    BUILDING = 4
    """All vertices are building by the file's trusted classes, or joined to it."""
    STEP = 5
    """A wall between two levels that both stand well above the ground."""
    CROWN = 6
    """Some vertex has rough surroundings, as crowns of trees have; no vertex is ground."""
    SEAM = 7
    """Building goes on, by a vertex that was joined to it, in what nothing is known of."""


class VertexKind(IntEnum):
    """What a vertex of the scene's TIN is."""

    GROUND = 0
    OBJECT = 1
    BUILDING = 2
    EXCLUDED = 3
    """Vegetation, water or a bridge by the file's trusted classes."""
    CROWN = 4
    """Stands above the ground among rough surroundings."""
    JOINED = 5
    """Undecided by its class, and on one plane with building around it."""


class OnRoof(IntEnum):
    """Where an undecided vertex lies."""

    NO = 0
    """On no roof."""
    BESIDE = 1
    """Between vertices of a roof, off its plane by less than the reach: a chimney, a strip that does not fit."""
    YES = 2
    """On the plane of a roof."""


class SceneVertices(NamedTuple):
    """Thinned points of a scene, the vertices of its TIN; arrays of one length v, absolute mm."""

    x_mm: IntArray
    y_mm: IntArray
    z_mm: IntArray
    height_mm: IntArray
    """Height above the terrain."""
    kind: KindArray
    """VertexKind."""
    planar: KindArray
    """2 smooth surroundings, 1 planar, 0 rough, -1 unknown."""


class FacetLimits(NamedTuple):
    """What makes a facet a gap or a wall; settings of `SurfaceSettings` in mm."""

    max_circumradius_mm: float
    wall_mm: int
    """MX_zdiff from which a facet is a wall, unless it is flatter than `wall_slope`."""
    wall_slope: float
    """Least rise over run of a wall."""
    steep_slope: float
    """Rise over run from which a facet cuts too, if it is `steep_mm` high."""
    steep_mm: int
    step_height_mm: int
    """Height above the terrain of the foot of a wall that is a step."""


class LabelledTin(NamedTuple):
    """The TIN of a scene, whose facets and vertices belong to fragments of surfaces."""

    facets: LabelArray
    """(m, 3) int32, vertices counter-clockwise."""
    neighbours: LabelArray
    """(m, 3) int32, the facet opposite each vertex; -1 at the hull."""
    kinds: KindArray
    """(m,) int8, FacetKind."""
    label: LabelArray
    """(m,) int32, fragment of each facet; -1 for none."""
    vertex_label: LabelArray
    """(v,) int32, fragment of each vertex; -1 for none."""
    fragment_kind: KindArray
    """(f,) int8, FacetKind."""


@kernel(inline="always")
def stands_up(kind: int) -> bool:
    """Whether a FacetKind is one of objects, whose vertices all stand above the ground, and not a step."""
    return kind == FacetKind.OBJECT or kind == FacetKind.BUILDING or kind == FacetKind.CROWN  # noqa: PLR1714 - compiled


@kernel(inline="always")
def connects(kind: int) -> bool:
    """Whether a FacetKind is one of steps and seams, along which surfaces may be one building."""
    return kind == FacetKind.STEP or kind == FacetKind.SEAM  # noqa: PLR1714 - compiled


@kernel(inline="always")
def first_corner(x: IntArray, y: IntArray, facets: LabelArray, f: int) -> int:
    """Which corner of facet f, 0 to 2, is its smallest vertex by (x, y)."""
    k = 0
    for q in range(1, 3):
        v, w = facets[f, q], facets[f, k]
        if x[v] < x[w] or (x[v] == x[w] and y[v] < y[w]):
            k = q
    return k


@kernel
def _bridges_gap(x: IntArray, y: IntArray, corners: tuple[int, int, int], radius_mm: float) -> bool:
    """Whether each corner has two other vertices far nearer than the circumradius; vertices come sorted by (x, y)."""
    near_mm = int(radius_mm / _GAP_SPACINGS)
    for v in corners:
        found = 0
        for step in (-1, 1):
            w = v + step
            while 0 <= w < x.size and abs(x[w] - x[v]) <= near_mm:
                found += (x[w] - x[v]) ** 2 + (y[w] - y[v]) ** 2 <= near_mm * near_mm
                w += step
        if found < 2:
            return False
    return True


@kernel(inline="always")
def _kind_above(a: int, b: int, c: int) -> int:
    """FacetKind of a facet that no wall cuts, by the kinds of its vertices, none of which is ground or excluded."""
    buildings, joined, crowns = 0, 0, 0
    for kind in (a, b, c):
        buildings += kind == VertexKind.BUILDING
        joined += kind == VertexKind.JOINED
        crowns += kind == VertexKind.CROWN
    if buildings + joined == 3:
        return FacetKind.BUILDING
    if buildings + joined > 0:
        return FacetKind.SEAM if joined > 0 and crowns == 0 else FacetKind.BORDER
    return FacetKind.CROWN if crowns > 0 else FacetKind.OBJECT


@kernel
def classify_facets(vertices: SceneVertices, facets: LabelArray, limits: FacetLimits) -> KindArray:
    """FacetKind of every facet (m, 3), int8 (m,): by circumradius, MX_zdiff, slope and the kinds of the vertices."""
    x, y, z, height, kind, _ = vertices
    max_radius_mm = limits.max_circumradius_mm
    m = facets.shape[0]
    out = np.empty(m, np.int8)
    for f in range(m):
        a, b, c = facets[f, 0], facets[f, 1], facets[f, 2]
        ux, uy, vx, vy = x[b] - x[a], y[b] - y[a], x[c] - x[a], y[c] - y[a]
        area2 = ux * vy - uy * vx
        wx, wy = x[c] - x[b], y[c] - y[b]
        u2, v2, w2 = float(ux * ux + uy * uy), float(vx * vx + vy * vy), float(wx * wx + wy * wy)
        # one order of multiplication, whichever vertex comes first
        least, most = min(u2, v2, w2), max(u2, v2, w2)
        middle = max(min(u2, v2), min(max(u2, v2), w2))
        whole = 4.0 * (float(area2) * area2)
        radius2 = least * middle * most
        if radius2 > whole * max_radius_mm * max_radius_mm:
            out[f] = FacetKind.VOID
            continue
        z_difference = max(z[a], z[b], z[c]) - min(z[a], z[b], z[c])
        ground = (kind[a] == VertexKind.GROUND) + (kind[b] == VertexKind.GROUND) + (kind[c] == VertexKind.GROUND)
        excluded = kind[a] == VertexKind.EXCLUDED or kind[b] == VertexKind.EXCLUDED or kind[c] == VertexKind.EXCLUDED
        if ground == 3:
            out[f] = FacetKind.GROUND if z_difference < limits.wall_mm else FacetKind.BORDER
            continue
        if ground > 0 or excluded:
            out[f] = FacetKind.BORDER
            continue
        cuts = False
        if z_difference >= limits.steep_mm:
            # slope by integer cross products: the facet's normal is (nx, ny, area2)
            uz, vz = z[b] - z[a], z[c] - z[a]
            nx, ny = uy * vz - uz * vy, uz * vx - ux * vz
            steep = float(area2) * (limits.wall_slope if z_difference >= limits.wall_mm else limits.steep_slope)
            cuts = float(nx) * nx + float(ny) * ny > steep * steep
        if cuts:
            high = min(height[a], height[b], height[c]) >= limits.step_height_mm
            out[f] = FacetKind.STEP if high else FacetKind.BORDER
        elif 4.0 * radius2 > whole * max_radius_mm * max_radius_mm and _bridges_gap(
            x, y, (a, b, c), math.sqrt(radius2 / whole)
        ):
            out[f] = FacetKind.VOID
        else:
            out[f] = _kind_above(kind[a], kind[b], kind[c])
    return out


@kernel
def marks(
    x: IntArray, y: IntArray, facets: LabelArray, kinds: KindArray, core: tuple[int, int, int, int], far_mm: int
) -> tuple[BoolArray, BoolArray]:
    """Masks (v,) of the vertices that points of the core may refer to, and of those that points of other tiles may.

    Points refer to the vertices of the facet around them and to vertices within far_mm. Facets across gaps do not
    count, since they differ from tile to tile.
    """
    x0, y0, x1, y1 = core
    n = x.size
    near = np.empty(n, np.bool_)
    shared = np.empty(n, np.bool_)
    for v in range(n):
        near[v] = x0 - far_mm <= x[v] < x1 + far_mm and y0 - far_mm <= y[v] < y1 + far_mm
        shared[v] = not (x0 + far_mm <= x[v] < x1 - far_mm and y0 + far_mm <= y[v] < y1 - far_mm)
    for f in range(facets.shape[0]):
        if kinds[f] == FacetKind.VOID:
            continue
        a, b, c = facets[f, 0], facets[f, 1], facets[f, 2]
        west, east = min(x[a], x[b], x[c]), max(x[a], x[b], x[c])
        south, north = min(y[a], y[b], y[c]), max(y[a], y[b], y[c])
        if east >= x0 and west < x1 and north >= y0 and south < y1:
            near[a] = near[b] = near[c] = True
        if not (west >= x0 and east < x1 and south >= y0 and north < y1):
            shared[a] = shared[b] = shared[c] = True
    return near, shared


@kernel
def with_vertex(facets: LabelArray, marked: BoolArray) -> BoolArray:
    """Mask of the facets with at least one marked vertex."""
    found = np.empty(facets.shape[0], np.bool_)
    for f in range(facets.shape[0]):
        found[f] = marked[facets[f, 0]] or marked[facets[f, 1]] or marked[facets[f, 2]]
    return found


@kernel
def label_fragments(kinds: KindArray, neighbours: LabelArray, considered: BoolArray) -> tuple[LabelArray, KindArray]:
    """Fragment of every considered facet above the ground (-1 for others), and the kind of each fragment."""
    m = kinds.size
    label = np.full(m, -1, np.int32)
    stack = np.empty(m, np.int32)
    kind_of = np.empty(m, np.int8)
    count = 0
    for f in range(m):
        if label[f] >= 0 or not considered[f] or kinds[f] <= FacetKind.GROUND:
            continue
        label[f] = count
        kind_of[count] = kinds[f]
        stack[0] = f
        top = 1
        while top > 0:
            top -= 1
            g = stack[top]
            for k in range(3):
                h = neighbours[g, k]
                if h >= 0 and label[h] < 0 and considered[h] and kinds[h] == kinds[f]:
                    label[h] = count
                    stack[top] = h
                    top += 1
        count += 1
    return label, kind_of[:count].copy()


@kernel
def label_vertices(x: IntArray, y: IntArray, facets: LabelArray, kinds: KindArray, label: LabelArray) -> LabelArray:
    """Fragment of every vertex: that of its largest object or building facet, else crown; -1 where there is none.

    Equal areas are decided by the smallest centroid, so that all tiles agree.
    """
    n = x.size
    out = np.full(n, -1, np.int32)
    on_solid = np.zeros(n, np.bool_)
    best_area = np.zeros(n, np.int64)
    best_x = np.zeros(n, np.int64)
    best_y = np.zeros(n, np.int64)
    for f in range(facets.shape[0]):
        if label[f] < 0 or not stands_up(kinds[f]):
            continue
        solid = kinds[f] != FacetKind.CROWN
        a, b, c = facets[f, 0], facets[f, 1], facets[f, 2]
        area2 = (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])
        cx, cy = x[a] + x[b] + x[c], y[a] + y[b] + y[c]
        for k in range(3):
            v = facets[f, k]
            better = out[v] < 0 or area2 > best_area[v]
            if not better and area2 == best_area[v]:
                better = cx < best_x[v] or (cx == best_x[v] and cy < best_y[v])
            if out[v] >= 0 and solid != on_solid[v]:
                better = solid
            if better:
                out[v] = label[f]
                on_solid[v] = solid
                best_area[v] = area2
                best_x[v] = cx
                best_y[v] = cy
    return out


def facet_keys(x: IntArray, y: IntArray, facets: LabelArray, chosen: IntArray) -> IntArray:
    """Coordinates (k, 6) of the vertices of the chosen facets, from the smallest on, counter-clockwise.

    A facet has the same coordinates in every tile that sees it: fragments of one surface are matched by them.
    """
    corners = facets[chosen]
    first = np.lexsort((y[corners], x[corners]), axis=1)[:, :1]
    corners = np.take_along_axis(corners, (first + np.arange(3)) % 3, axis=1)
    keys: IntArray = np.stack((x[corners], y[corners]), axis=2).reshape(-1, 6)
    return keys
