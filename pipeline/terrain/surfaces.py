"""Wall facets cut the TIN; what stays connected is a surface, or a fragment of one at a tile's border.

Facets whose elevation difference MX_zdiff reaches 2 m are walls (Shorter and Kasparis, section 3.1).
The facets that remain are united over shared edges, ground with ground and object with object, and
each fragment carries integer sums that add up over tile borders. Only whole surfaces are judged
(`terrain.candidates`), so the answer does not depend on the tiles.
"""

from __future__ import annotations

import dataclasses
import math
from enum import IntEnum

import numpy as np
from numba import njit

from pipeline.model import BoolArray, IntArray, KindArray, LabelArray, Tin
from pipeline.parameters import Parameters, parameter


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


class VertexKind(IntEnum):
    """What a vertex of the scene's TIN is."""

    GROUND = 0
    OBJECT = 1
    BUILDING = 2
    EXCLUDED = 3
    """Vegetation, water or a bridge by the file's trusted classes."""


class Sum(IntEnum):
    """Columns of the sums of a fragment; all add up over tile borders."""

    FACETS = 0
    AREA2 = 1
    """Twice the plan area, mm2."""
    VERTICES = 2
    HEIGHT = 3
    """Heights of the vertices above the terrain, mm."""
    PLANAR = 4
    """Vertices with planar surroundings."""
    ROUGH = 5
    """Vertices with rough surroundings."""
    BOUNDARY = 6
    """Length of the outline in plan, mm."""
    WALL = 7
    """Length of the outline that touches walls (MX_zdiff >= 2 m), mm."""
    WALL_TOP = 8
    """Length of the outline that lies at the upper half of its wall, mm."""
    STEP = 9
    """Length of the outline that touches steps, mm."""
    WALLS = 10
    """Number of wall facets along the outline."""
    WALLS_Z_MX = 11
    """Sum of their highest vertices Z_mx, mm."""
    WALLS_OWN_Z = 12
    """Sum of the fragment's own elevation at them, mm."""
    POINTS = 13
    CANOPY = 14
    """Earlier returns well above the fragment."""


N_SUMS = len(Sum)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SurfaceSettings(Parameters):
    """How the TIN is thinned and cut."""

    thinning_m: float = parameter(
        0.5, "Side of the cells of which one point each enters the scene's TIN.", unit="m", minimum=0.1, maximum=5.0
    )
    max_circumradius_m: float = parameter(
        6.0, "Facets with a wider circumcircle bridge a gap in the data.", unit="m", minimum=1.0, maximum=30.0
    )
    wall_m: float = parameter(2.0, "MX_zdiff from which a facet is a wall.", unit="m", minimum=0.5, maximum=10.0)
    steep_deg: float = parameter(
        70.0, "Facets steeper than this cut too, from steep_m on.", unit="deg", minimum=45.0, maximum=90.0
    )
    steep_m: float = parameter(
        1.0, "Least elevation difference of a facet that cuts by its slope.", unit="m", minimum=0.2, maximum=10.0
    )
    step_height_m: float = parameter(
        2.0, "A wall whose foot stands this high above the terrain is a step.", unit="m", minimum=0.5, maximum=20.0
    )
    reach_m: float = parameter(
        1.0,
        "Points closer than this in elevation to a surface belong to it.",
        unit="m",
        minimum=0.1,
        maximum=5.0,
    )

    @property
    def support_m(self) -> float:
        """How far a fragment's facets look: two facets and their circumcircles."""
        return 4.0 * self.max_circumradius_m + 2.0 * self.thinning_m


@njit(cache=True, nogil=True)
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
    squares = np.empty(3)
    for f in range(m):
        a, b, c = facets[f, 0], facets[f, 1], facets[f, 2]
        ux, uy, vx, vy = x[b] - x[a], y[b] - y[a], x[c] - x[a], y[c] - y[a]
        area2 = ux * vy - uy * vx
        wx, wy = x[c] - x[b], y[c] - y[b]
        squares[0] = ux * ux + uy * uy
        squares[1] = vx * vx + vy * vy
        squares[2] = wx * wx + wy * wy
        squares.sort()  # one order of multiplication, whichever vertex comes first
        if squares[0] * squares[1] * squares[2] > 4.0 * (float(area2) * area2) * max_radius_mm * max_radius_mm:
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
        elif kind[a] == kind[b] and kind[b] == kind[c]:
            out[f] = FacetKind.BUILDING if kind[a] == 2 else FacetKind.OBJECT
        else:
            out[f] = FacetKind.BORDER
    return out


@njit(cache=True, nogil=True)
def _marks(
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


@njit(cache=True, nogil=True)
def _with_vertex(facets: LabelArray, marked: BoolArray) -> BoolArray:
    """Mask of the facets with at least one marked vertex."""
    out = np.empty(facets.shape[0], np.bool_)
    for f in range(facets.shape[0]):
        out[f] = marked[facets[f, 0]] or marked[facets[f, 1]] or marked[facets[f, 2]]
    return out


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def label_vertices(x: IntArray, y: IntArray, facets: LabelArray, kinds: KindArray, label: LabelArray) -> LabelArray:
    """Fragment of every vertex: that of its largest object or building facet; -1 where there is none.

    Equal areas are decided by the smallest centroid, so that all tiles agree.
    """
    n = x.size
    out = np.full(n, -1, np.int32)
    best_area = np.zeros(n, np.int64)
    best_x = np.zeros(n, np.int64)
    best_y = np.zeros(n, np.int64)
    for f in range(facets.shape[0]):
        if label[f] < 0 or (kinds[f] != 3 and kinds[f] != 4):
            continue
        a, b, c = facets[f, 0], facets[f, 1], facets[f, 2]
        area2 = (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])
        cx, cy = x[a] + x[b] + x[c], y[a] + y[b] + y[c]
        for k in range(3):
            v = facets[f, k]
            better = out[v] < 0 or area2 > best_area[v]
            if not better and area2 == best_area[v]:
                better = cx < best_x[v] or (cx == best_x[v] and cy < best_y[v])
            if better:
                out[v] = label[f]
                best_area[v] = area2
                best_x[v] = cx
                best_y[v] = cy
    return out


@njit(cache=True, nogil=True)
def sum_fragments(
    x: IntArray,
    y: IntArray,
    z: IntArray,
    height: IntArray,
    planar: KindArray,
    facets: LabelArray,
    neighbours: LabelArray,
    kinds: KindArray,
    label: LabelArray,
    vertex_label: LabelArray,
    count: int,
    core: tuple[int, int, int, int],
    wall_mm: int,
) -> tuple[IntArray, IntArray, IntArray]:
    """Sums of the fragments over what the core owns, bounding boxes, and their lengths along steps.

    A facet is owned through its smallest (x, y) vertex, a vertex through itself.
    """
    x0, y0, x1, y1 = core
    sums = np.zeros((count, N_SUMS), np.int64)
    boxes = np.empty((count, 4), np.int64)
    boxes[:, 0] = boxes[:, 1] = 2**62
    boxes[:, 2] = boxes[:, 3] = -(2**62)
    capacity = 1024
    along = np.empty((capacity, 3), np.int64)
    n_along = 0
    for f in range(facets.shape[0]):
        fragment = label[f]
        if fragment < 0:
            continue
        k = 0
        for q in range(1, 3):
            v, w = facets[f, q], facets[f, k]
            if x[v] < x[w] or (x[v] == x[w] and y[v] < y[w]):
                k = q
        v = facets[f, k]
        if not (x0 <= x[v] < x1 and y0 <= y[v] < y1):
            continue
        a, b, c = facets[f, 0], facets[f, 1], facets[f, 2]
        sums[fragment, 0] += 1
        sums[fragment, 1] += (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])
        boxes[fragment, 0] = min(boxes[fragment, 0], x[a], x[b], x[c])
        boxes[fragment, 1] = min(boxes[fragment, 1], y[a], y[b], y[c])
        boxes[fragment, 2] = max(boxes[fragment, 2], x[a], x[b], x[c])
        boxes[fragment, 3] = max(boxes[fragment, 3], y[a], y[b], y[c])
        for q in range(3):
            g = neighbours[f, q]
            if g >= 0 and kinds[g] == kinds[f]:
                continue
            v, w = facets[f, (q + 1) % 3], facets[f, (q + 2) % 3]
            dx, dy = x[v] - x[w], y[v] - y[w]
            length = np.int64(round(math.sqrt(float(dx * dx + dy * dy))))
            sums[fragment, 6] += length
            if g < 0 or kinds[g] == 0:
                continue
            ga, gb, gc = facets[g, 0], facets[g, 1], facets[g, 2]
            top = max(z[ga], z[gb], z[gc])
            foot = min(z[ga], z[gb], z[gc])
            if top - foot >= wall_mm:
                sums[fragment, 7] += length
                sums[fragment, 10] += 1
                sums[fragment, 11] += top
                own = (z[v] + z[w]) // 2
                sums[fragment, 12] += own
                if 2 * own >= top + foot:
                    sums[fragment, 8] += length
            if kinds[g] == 5 and kinds[f] != 5:
                sums[fragment, 9] += length
                if n_along == capacity:
                    grown = np.empty((2 * capacity, 3), np.int64)
                    grown[:capacity] = along
                    along = grown
                    capacity *= 2
                along[n_along, 0] = fragment
                along[n_along, 1] = label[g]
                along[n_along, 2] = length
                n_along += 1
    for v in range(x.size):
        fragment = vertex_label[v]
        if fragment >= 0 and x0 <= x[v] < x1 and y0 <= y[v] < y1:
            sums[fragment, 2] += 1
            sums[fragment, 3] += height[v]
            if planar[v] == 1:
                sums[fragment, 4] += 1
            elif planar[v] == 0:
                sums[fragment, 5] += 1
    return sums, boxes, along[:n_along].copy()


@njit(cache=True, nogil=True)
def _facet_containing(
    px: int, py: int, start: int, x: IntArray, y: IntArray, facets: LabelArray, neighbours: LabelArray
) -> tuple[int, int]:
    """Walk to the facet that contains a point, -1 outside the hull; and the edge it lies on, -1 if inside."""
    f = start
    came_from = -1
    for _ in range(4 * facets.shape[0] + 8):
        moved = False
        on_edge = -1
        for q in range(3):
            v, w = facets[f, (q + 1) % 3], facets[f, (q + 2) % 3]
            side = (x[w] - x[v]) * (py - y[v]) - (y[w] - y[v]) * (px - x[v])
            if side < 0:
                g = neighbours[f, q]
                if g == came_from and g >= 0:
                    # both sides negative cannot be in a valid TIN; take another way if there is one
                    continue
                if g < 0:
                    return -1, -1
                came_from = f
                f = g
                moved = True
                break
            if side == 0:
                on_edge = q
        if not moved:
            return f, on_edge
    return -1, -1


@njit(cache=True, nogil=True)
def _nearest_vertex(px: int, py: int, pz: int, x: IntArray, y: IntArray, z: IntArray, far_mm: int) -> int:
    """Nearest vertex in plan within far_mm, equal distances by elevation, then by coordinates; -1 where none.

    The vertices come sorted by (x, y).
    """
    best = -1
    best_distance, best_dz = far_mm * far_mm + 1, np.int64(0)
    for v in range(np.searchsorted(x, px - far_mm), x.size):
        if x[v] > px + far_mm:
            break
        distance = (px - x[v]) ** 2 + (py - y[v]) ** 2
        if distance > best_distance:
            continue
        dz = abs(pz - z[v])
        if distance < best_distance or dz < best_dz:
            best = v
            best_distance = distance
            best_dz = dz
    return best


@njit(cache=True, nogil=True)
def assign_points(
    px: IntArray,
    py: IntArray,
    pz: IntArray,
    above_ground: IntArray,
    last: BoolArray,
    allowed: KindArray,
    x: IntArray,
    y: IntArray,
    z: IntArray,
    facets: LabelArray,
    neighbours: LabelArray,
    kinds: KindArray,
    label: LabelArray,
    vertex_label: LabelArray,
    fragment_kind: KindArray,
    reach_mm: int,
    canopy_mm: int,
    ground_mm: int,
    far_mm: int,
    sums: IntArray,
    lowest_point: IntArray,
) -> LabelArray:
    """Fragment of every point of the core, int32 (n,), -1 where none; fills the columns POINTS and CANOPY of sums.

    A point belongs to the surface of the facet around it, or at walls and borders to that of the vertex
    nearest in elevation. `allowed` is 0 for points that the trusted classes exclude, 2 for building, else 1.
    """
    n = px.size
    out = np.full(n, -1, np.int32)
    m = facets.shape[0]
    if m == 0 or n == 0:
        return out
    # a start near each point: one facet a cell of 4 m
    cell = 4000
    column0, row0 = x.min() // cell, y.min() // cell
    columns, rows = x.max() // cell - column0 + 1, y.max() // cell - row0 + 1
    hint = np.full(columns * rows, -1, np.int32)
    for f in range(m):
        v = facets[f, 0]
        hint[(y[v] // cell - row0) * columns + x[v] // cell - column0] = f
    previous = 0
    for i in range(n):
        if allowed[i] == 0 or above_ground[i] < ground_mm:
            continue
        c, r = px[i] // cell - column0, py[i] // cell - row0
        start = previous
        if 0 <= c < columns and 0 <= r < rows and hint[r * columns + c] >= 0:
            start = hint[r * columns + c]
        f, on_edge = _facet_containing(px[i], py[i], start, x, y, facets, neighbours)
        if f >= 0:
            previous = f
        at_vertex = -1
        for q in range(3):
            if f >= 0:
                v = facets[f, q]
                if x[v] == px[i] and y[v] == py[i]:
                    at_vertex = v
        if at_vertex < 0 and f >= 0 and on_edge >= 0:
            # on an edge: the facet that is no gap, else the one with the smaller opposite vertex, whichever way we came
            g = neighbours[f, on_edge]
            if g >= 0 and kinds[g] != 0:
                v = facets[f, on_edge]
                k = 0
                while neighbours[g, k] != f:
                    k += 1
                w = facets[g, k]
                if kinds[f] == 0 or x[w] < x[v] or (x[w] == x[v] and y[w] < y[v]):
                    f = g
        fragment = -1
        if f < 0 or (kinds[f] == 0 and at_vertex < 0):
            # facets across gaps differ from tile to tile: only the nearest vertex is sure
            v = _nearest_vertex(px[i], py[i], pz[i], x, y, z, far_mm)
            if v >= 0 and abs(pz[i] - z[v]) <= reach_mm:
                fragment = vertex_label[v]
        elif at_vertex >= 0:
            if abs(pz[i] - z[at_vertex]) <= reach_mm:
                fragment = vertex_label[at_vertex]
        elif kinds[f] == 3 or kinds[f] == 4:
            k = 0
            for q in range(1, 3):
                v, w = facets[f, q], facets[f, k]
                if x[v] < x[w] or (x[v] == x[w] and y[v] < y[w]):
                    k = q
            a, b, c3 = facets[f, k], facets[f, (k + 1) % 3], facets[f, (k + 2) % 3]
            ux, uy, uz = x[b] - x[a], y[b] - y[a], z[b] - z[a]
            vx, vy, vz = x[c3] - x[a], y[c3] - y[a], z[c3] - z[a]
            det = float(ux * vy - uy * vx)
            gx, gy = float(uz * vy - vz * uy) / det, float(ux * vz - vx * uz) / det
            over = float(pz[i] - z[a]) - gx * (px[i] - x[a]) - gy * (py[i] - y[a])
            if abs(over) <= reach_mm:
                fragment = label[f]
            elif over > canopy_mm and not last[i]:
                sums[label[f], 14] += 1
        else:
            best = reach_mm + 1
            best_distance = np.int64(2**62)
            for q in range(3):
                v = facets[f, q]
                if vertex_label[v] < 0:
                    continue
                dz = abs(pz[i] - z[v])
                distance = (px[i] - x[v]) ** 2 + (py[i] - y[v]) ** 2
                if dz < best or (dz == best and distance < best_distance):
                    best = dz
                    best_distance = distance
                    fragment = vertex_label[v]
            if best > reach_mm:
                fragment = -1
        if fragment < 0 or (fragment_kind[fragment] != 3 and fragment_kind[fragment] != 4):
            continue
        if fragment_kind[fragment] == 4 and allowed[i] != 2:
            continue
        out[i] = fragment
        sums[fragment, 13] += 1
        p = lowest_point[fragment]
        if px[i] < p[0] or (px[i] == p[0] and (py[i] < p[1] or (py[i] == p[1] and pz[i] < p[2]))):
            p[0], p[1], p[2] = px[i], py[i], pz[i]
    return out


@njit(cache=True, nogil=True)
def facet_keys(x: IntArray, y: IntArray, facets: LabelArray, chosen: IntArray) -> IntArray:
    """Coordinates (k, 6) of the vertices of the chosen facets, from the smallest on, counter-clockwise.

    The same facet gives the same coordinates in every tile that sees it: that is how fragments of one
    surface find each other.
    """
    keys = np.empty((chosen.size, 6), np.int64)
    for i in range(chosen.size):
        f = chosen[i]
        k = 0
        for q in range(1, 3):
            v, w = facets[f, q], facets[f, k]
            if x[v] < x[w] or (x[v] == x[w] and y[v] < y[w]):
                k = q
        for q in range(3):
            v = facets[f, (k + q) % 3]
            keys[i, 2 * q] = x[v]
            keys[i, 2 * q + 1] = y[v]
    return keys


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fragments:
    """The surface fragments of one tile: small descriptors that add up over tile borders."""

    kind: KindArray
    """(k,) int8, FacetKind of each fragment."""
    sums: IntArray
    """(k, N_SUMS) int64, columns as in Sum."""
    boxes_mm: IntArray
    """(k, 4) int64, xmin, ymin, xmax, ymax of the owned facets; xmin > xmax where none is owned."""
    lowest_point_mm: IntArray
    """(k, 3) int64, lexicographically smallest assigned point; 2^62 where there is none."""
    crossing_keys: IntArray
    """(j, 6) int64, facets that another tile may see too, by their vertices from the smallest on."""
    crossing_fragment: LabelArray
    """(j,) int32, the fragment of each crossing facet."""
    along_steps: IntArray
    """(s, 3) int64, fragment, step fragment, shared length in mm."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneVertices:
    """Thinned points with what is known of them; arrays of one length v, absolute mm."""

    x_mm: IntArray
    y_mm: IntArray
    z_mm: IntArray
    height_mm: IntArray
    """Height above the terrain."""
    kind: KindArray
    """VertexKind."""
    planar: KindArray
    """1 planar surroundings, 0 rough, -1 unknown."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScenePoints:
    """The points that the core owns; arrays of one length n, absolute mm."""

    x_mm: IntArray
    y_mm: IntArray
    z_mm: IntArray
    height_mm: IntArray
    """Height above the terrain."""
    last: BoolArray
    """Last return of its pulse."""
    allowed: KindArray
    """By the trusted classes: 0 may not belong to a building, 2 is building, 1 anything else."""


def fragments_of(
    tin: Tin,
    vertices: SceneVertices,
    points: ScenePoints,
    core: tuple[int, int, int, int],
    settings: SurfaceSettings,
    *,
    canopy_m: float,
    ground_m: float,
) -> tuple[Fragments, LabelArray]:
    """Cut a scene's TIN by its walls and describe the fragments.

    Parameters
    ----------
    tin : Tin
        Delaunay TIN of the vertices, exact within 4 circumradii around the core.
    vertices : SceneVertices
        The vertices.
    points : ScenePoints
        All points of the core, to be assigned to fragments.
    core : tuple of int
        x0, y0, x1, y1 of the tile in mm, half-open.
    settings : SurfaceSettings
        What cuts.
    canopy_m, ground_m : float
        Least height of canopy above a surface, and of an object above the terrain.

    Returns
    -------
    Fragments
        Sums and keys.
    (n,) int32
        Fragment of every point, -1 where none.
    """
    x, y, z = vertices.x_mm, vertices.y_mm, vertices.z_mm
    kinds = classify_facets(
        x, y, z, vertices.height_mm, vertices.kind, tin.facets,
        settings.max_circumradius_m * 1000.0,
        round(settings.wall_m * 1000),
        math.tan(math.radians(min(settings.steep_deg, 89.99))),
        round(settings.steep_m * 1000),
        round(settings.step_height_m * 1000),
    )  # fmt: skip
    far_mm = round(2 * settings.thinning_m * 1000)
    near, shared = _marks(x, y, tin.facets, kinds, core, far_mm)
    considered = _with_vertex(tin.facets, near)
    label, fragment_kind = label_fragments(kinds, tin.neighbours, considered)
    vertex_label = label_vertices(x, y, tin.facets, kinds, label)
    sums, boxes, along = sum_fragments(
        x, y, z, vertices.height_mm, vertices.planar, tin.facets, tin.neighbours, kinds, label, vertex_label,
        len(fragment_kind), core, round(settings.wall_m * 1000),
    )  # fmt: skip
    lowest = np.full((len(fragment_kind), 3), 2**62, np.int64)
    point_fragment = assign_points(
        points.x_mm, points.y_mm, points.z_mm, points.height_mm, points.last, points.allowed,
        x, y, z, tin.facets, tin.neighbours, kinds, label, vertex_label, fragment_kind,
        round(settings.reach_m * 1000), round(canopy_m * 1000), round(ground_m * 1000),
        far_mm, sums, lowest,
    )  # fmt: skip
    crossing = np.flatnonzero((label >= 0) & _with_vertex(tin.facets, shared))
    return (
        Fragments(
            kind=fragment_kind,
            sums=sums,
            boxes_mm=boxes,
            lowest_point_mm=lowest,
            crossing_keys=facet_keys(x, y, tin.facets, crossing),
            crossing_fragment=label[crossing],
            along_steps=along,
        ),
        point_fragment,
    )
