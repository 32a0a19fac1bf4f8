"""Which surface each point of the full cloud belongs to, found in the TIN of the thinned one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, KindArray, LabelArray


@kernel
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


@kernel
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


class CorePoints(NamedTuple):
    """Points of a tile's core."""

    x: IntArray
    y: IntArray
    z: IntArray
    above_ground: IntArray
    """(n,) int64, millimetres all."""
    last: BoolArray
    """(n,) bool, last returns."""
    allowed: KindArray
    """(n,) int8, 0 for points that the trusted classes exclude, 2 for building, else 1."""


class LabelledTin(NamedTuple):
    """A TIN whose facets and vertices belong to fragments of surfaces."""

    x: IntArray
    y: IntArray
    z: IntArray
    """(v,) int64, vertices, millimetres."""
    facets: LabelArray
    neighbours: LabelArray
    """(m, 3) int32."""
    kinds: KindArray
    """(m,) int8."""
    label: LabelArray
    vertex_label: LabelArray
    """(m,) and (v,) int32, fragments; -1 for none."""
    fragment_kind: KindArray
    """(f,) int8."""


class AssignmentLimits(NamedTuple):
    """Millimetres: how far points belong to a surface, from where on they are canopy, lie above ground, are far off."""

    reach: int
    canopy: int
    ground: int
    far: int


@kernel
def assign_points(
    points: CorePoints, surfaces: LabelledTin, limits: AssignmentLimits, sums: IntArray, lowest_point: IntArray
) -> LabelArray:
    """Fragment of every point of the core, int32 (n,), -1 where none; fills the columns POINTS and CANOPY of sums.

    A point belongs to the surface of the facet around it, or at walls and borders to that of the vertex
    nearest in elevation. `lowest_point` (f, 3) int64 gets the smallest point of each fragment.
    """
    px, py, pz, above_ground, last, allowed = points
    x, y, z, facets, neighbours, kinds, label, vertex_label, fragment_kind = surfaces
    reach_mm, canopy_mm, ground_mm, far_mm = limits
    n = px.size
    out = np.full(n, -1, np.int32)
    m = facets.shape[0]
    if m == 0 or n == 0:
        return out
    # a start near each point: one facet a cell of 1 m, where there is none that of the cell before
    cell = 1000
    column0, row0 = x.min() // cell, y.min() // cell
    columns, rows = x.max() // cell - column0 + 1, y.max() // cell - row0 + 1
    hint = np.full(columns * rows, -1, np.int32)
    for f in range(m):
        v = facets[f, 0]
        hint[(y[v] // cell - row0) * columns + x[v] // cell - column0] = f
    for k in range(1, hint.size):
        if hint[k] < 0:
            hint[k] = hint[k - 1]
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
        if fragment < 0 or (
            fragment_kind[fragment] != 3 and fragment_kind[fragment] != 4 and fragment_kind[fragment] != 6
        ):
            continue
        if fragment_kind[fragment] == 4 and allowed[i] != 2:
            continue
        out[i] = fragment
        sums[fragment, 13] += 1
        p = lowest_point[fragment]
        if px[i] < p[0] or (px[i] == p[0] and (py[i] < p[1] or (py[i] == p[1] and pz[i] < p[2]))):
            p[0], p[1], p[2] = px[i], py[i], pz[i]
    return out
