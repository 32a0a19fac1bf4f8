"""Facets of a scene's TIN: what they are, and which of them neighbouring tiles see too.

Facets whose elevation difference MX_zdiff reaches 2 m are walls (Shorter and Kasparis, section 3.1). What remains is
united over shared edges, ground with ground and object with object. All decisions use exact integers, or floats in one
order, so that every tile that sees a facet says the same of it.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, KindArray, LabelArray


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
    """All vertices are building by the file's trusted classes."""
    STEP = 5
    """A wall between two levels that both stand well above the ground."""
    CROWN = 6
    """Some vertex has rough surroundings, as crowns of trees have; no vertex is ground."""


class VertexKind(IntEnum):
    """What a vertex of the scene's TIN is."""

    GROUND = 0
    OBJECT = 1
    BUILDING = 2
    EXCLUDED = 3
    """Vegetation, water or a bridge by the file's trusted classes."""
    CROWN = 4
    """Stands above the ground among rough surroundings."""


@kernel
def classify_facets(
    x: IntArray,
    y: IntArray,
    z: IntArray,
    height: IntArray,
    kind: KindArray,
    facets: LabelArray,
    max_radius_mm: float,
    wall_mm: int,
    steep_slope: float,
    steep_mm: int,
    step_mm: int,
) -> KindArray:
    """Kind of every facet, int8 (m,), from vertices in mm; steep_slope is rise over run."""
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
        if least * middle * most > 4.0 * (float(area2) * area2) * max_radius_mm * max_radius_mm:
            out[f] = FacetKind.VOID
            continue
        z_difference = max(z[a], z[b], z[c]) - min(z[a], z[b], z[c])
        ground = (kind[a] == 0) + (kind[b] == 0) + (kind[c] == 0)
        excluded = kind[a] == 3 or kind[b] == 3 or kind[c] == 3
        if ground == 3:
            out[f] = FacetKind.GROUND if z_difference < wall_mm else FacetKind.BORDER
            continue
        if ground > 0 or excluded:
            out[f] = FacetKind.BORDER
            continue
        cuts = z_difference >= wall_mm
        if not cuts and z_difference >= steep_mm:
            # slope by integer cross products: the facet's normal is (nx, ny, area2)
            uz, vz = z[b] - z[a], z[c] - z[a]
            nx, ny = uy * vz - uz * vy, uz * vx - ux * vz
            steep = float(area2) * steep_slope
            cuts = float(nx) * nx + float(ny) * ny > steep * steep
        if cuts:
            high = min(height[a], height[b], height[c]) >= step_mm
            out[f] = FacetKind.STEP if high else FacetKind.BORDER
        elif kind[a] == kind[b] and kind[b] == kind[c] and kind[a] != 4:
            out[f] = FacetKind.BUILDING if kind[a] == 2 else FacetKind.OBJECT
        elif kind[a] != 2 and kind[b] != 2 and kind[c] != 2:
            out[f] = FacetKind.CROWN
        else:
            out[f] = FacetKind.BORDER
    return out


@kernel
def marks(
    x: IntArray, y: IntArray, facets: LabelArray, kinds: KindArray, core: tuple[int, int, int, int], far_mm: int
) -> tuple[BoolArray, BoolArray]:
    """Masks of the vertices that the core's points may refer to, and of those that another tile's may refer to too.

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
        if kinds[f] == 0:
            continue
        a, b, c = facets[f, 0], facets[f, 1], facets[f, 2]
        west, east = min(x[a], x[b], x[c]), max(x[a], x[b], x[c])
        south, north = min(y[a], y[b], y[c]), max(y[a], y[b], y[c])
        if east >= x0 and west < x1 and north >= y0 and south < y1:
            near[a] = near[b] = near[c] = True
        if not (west >= x0 and east < x1 and south >= y0 and north < y1):
            shared[a] = shared[b] = shared[c] = True
    return near, shared


def with_vertex(facets: LabelArray, marked: BoolArray) -> BoolArray:
    """Mask of the facets with at least one marked vertex."""
    found: BoolArray = marked[facets[:, 0]] | marked[facets[:, 1]] | marked[facets[:, 2]]
    return found


@kernel
def label_fragments(kinds: KindArray, neighbours: LabelArray, considered: BoolArray) -> tuple[LabelArray, KindArray]:
    """Fragment of every considered facet of a surface kind (-1 for others), and the kind of each fragment."""
    m = kinds.size
    label = np.full(m, -1, np.int32)
    stack = np.empty(m, np.int32)
    kind_of = np.empty(m, np.int8)
    count = 0
    for f in range(m):
        if label[f] >= 0 or not considered[f] or kinds[f] < 2:
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
        if label[f] < 0 or (kinds[f] != 3 and kinds[f] != 4 and kinds[f] != 6):
            continue
        solid = kinds[f] != 6
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

    The same facet gives the same coordinates in every tile that sees it: that is how fragments of one
    surface find each other.
    """
    corners = facets[chosen]
    first = np.lexsort((y[corners], x[corners]), axis=1)[:, :1]
    corners = np.take_along_axis(corners, (first + np.arange(3)) % 3, axis=1)
    keys: IntArray = np.stack((x[corners], y[corners]), axis=2).reshape(-1, 6)
    return keys
