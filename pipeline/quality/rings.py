"""Rings and polygons of a face, projected to integer millimetres: every test is exact (ISO 19107, codes 104 to 208)."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import same_ray, segments_meet, turn_of
from pipeline.kernels.union_find import root_of, unite
from pipeline.model import IntArray

RING_SELF_INTERSECTION = 104
INTERSECTION_RINGS = 201
DUPLICATED_RINGS = 202
POLYGON_INTERIOR_DISCONNECTED = 205
INNER_RING_OUTSIDE = 206
INNER_RINGS_NESTED = 207
ORIENTATION_RINGS_SAME = 208

_OUTSIDE, _INSIDE, _BOTH = 0, 1, 2


@kernel
def twice_ring_area(flat: IntArray, start: int, stop: int) -> int:
    """Twice the signed area of the ring start:stop in mm2, positive counter-clockwise."""
    area = 0
    for i in range(start + 1, stop - 1):
        area += turn_of(flat, start, i, i + 1)
    return area


@kernel
def ring_is_simple(flat: IntArray, start: int, stop: int) -> bool:
    """Whether the ring start:stop encloses an area and neither crosses nor touches itself."""
    count = stop - start
    if twice_ring_area(flat, start, stop) == 0:
        return False
    for i in range(count):
        a, b = start + i, start + (i + 1) % count
        if same_ray(flat, b, a, start + (i + 2) % count):
            return False
        last = count - 1 if i == 0 else count
        for j in range(i + 2, last):
            if segments_meet(flat, a, b, start + j, start + (j + 1) % count):
                return False
    return True


@kernel
def _same_ring(ids: IntArray, a: int, a_stop: int, b: int, b_stop: int) -> bool:
    """Whether two rings have the same vertices in the same or the opposite order."""
    count = a_stop - a
    if b_stop - b != count:
        return False
    for shift in range(count):
        if ids[b + shift] == ids[a]:
            ahead = back = True
            for i in range(count):
                ahead = ahead and ids[b + (shift + i) % count] == ids[a + i]
                back = back and ids[b + (shift - i) % count] == ids[a + i]
            return ahead or back
    return False


@kernel
def _rings_cross(flat: IntArray, ids: IntArray, a: int, a_stop: int, b: int, b_stop: int) -> bool:
    """Whether edges of two rings have more in common than a vertex of both."""
    for i in range(a, a_stop):
        p, q = i, i + 1 if i + 1 < a_stop else a
        for j in range(b, b_stop):
            r, s = j, j + 1 if j + 1 < b_stop else b
            if not segments_meet(flat, p, q, r, s):
                continue
            if ids[p] == ids[r] or ids[q] == ids[s] or ids[p] == ids[s] or ids[q] == ids[r]:
                common, far, other_far = p, q, s
                if ids[q] == ids[s]:
                    common, far, other_far = q, p, r
                elif ids[p] == ids[s]:
                    common, far, other_far = p, q, r
                elif ids[q] == ids[r]:
                    common, far, other_far = q, p, s
                if not same_ray(flat, common, far, other_far):
                    continue
            return True
    return False


@kernel
def _side_of_ring(flat: IntArray, a: int, a_stop: int, b: int, b_stop: int) -> int:
    """Where the edges of ring a lie to ring b, which they do not cross: outside, inside or both, by their middles."""
    inside = outside = 0
    for i in range(a, a_stop):
        ahead = i + 1 if i + 1 < a_stop else a
        x, y = flat[i, 0] + flat[ahead, 0], flat[i, 1] + flat[ahead, 1]
        crossings = 0
        for j in range(b, b_stop):
            k = j + 1 if j + 1 < b_stop else b
            x0, y0, x1, y1 = 2 * flat[j, 0], 2 * flat[j, 1], 2 * flat[k, 0], 2 * flat[k, 1]
            if (y0 > y) != (y1 > y):
                turn = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
                if (turn > 0) == (y1 > y0):
                    crossings += 1
        if crossings % 2 == 1:
            inside += 1
        else:
            outside += 1
    if inside and outside:
        return _BOTH
    return _INSIDE if inside else _OUTSIDE


@kernel
def _touches_enclose_a_part(ids: IntArray, ring_offsets: IntArray) -> bool:
    """Whether rings that touch at vertices cut the interior: their graph (rings and common vertices) has a cycle."""
    rings = len(ring_offsets) - 1
    corners = len(ids)
    parent = np.arange(rings + corners)
    ring_of = np.empty(corners, np.int64)
    for r in range(rings):
        for i in range(ring_offsets[r], ring_offsets[r + 1]):
            ring_of[i] = r
    for i in range(corners):
        for j in range(i):
            if ids[j] == ids[i]:
                if root_of(parent, rings + j) == rings + j:
                    unite(parent, rings + j, ring_of[j])
                if not unite(parent, rings + j, ring_of[i]):
                    return True
                break
    return False


@kernel(inline="always")
def _place_of_inner_rings(flat: IntArray, ring_offsets: IntArray) -> int:
    """The fault of inner rings that do not lie within the outer ring, or not outside one another; else 0."""
    rings = len(ring_offsets) - 1
    for r in range(1, rings):
        side = _side_of_ring(flat, ring_offsets[r], ring_offsets[r + 1], 0, ring_offsets[1])
        if side != _INSIDE:
            return INTERSECTION_RINGS if side == _BOTH else INNER_RING_OUTSIDE
    for r in range(1, rings):
        for s in range(1, rings):
            if r != s:
                side = _side_of_ring(flat, ring_offsets[r], ring_offsets[r + 1], ring_offsets[s], ring_offsets[s + 1])
                if side != _OUTSIDE:
                    return INTERSECTION_RINGS if side == _BOTH else INNER_RINGS_NESTED
    return 0


@kernel
def polygon_code(flat: IntArray, ids: IntArray, ring_offsets: IntArray) -> int:
    """The first fault of a polygon whose plane is known: 0, or a code of 104 and 201 to 208 without 203, 204.

    `flat` (n, 2) are the corners of all rings in mm, projected so that the outer ring is counter-clockwise; `ids` (n,)
    their vertices; `ring_offsets` (r + 1,) where each ring starts, and n; the outer ring comes first. A ring that
    touches another off its vertices counts as crossing, since no neighbour could share such an edge.
    """
    rings = len(ring_offsets) - 1
    for r in range(rings):
        if not ring_is_simple(flat, ring_offsets[r], ring_offsets[r + 1]):
            return RING_SELF_INTERSECTION
    if rings == 1:
        return 0
    for r in range(1, rings):
        if twice_ring_area(flat, ring_offsets[r], ring_offsets[r + 1]) > 0:
            return ORIENTATION_RINGS_SAME
    for r in range(rings):
        for s in range(r):
            if _same_ring(ids, ring_offsets[s], ring_offsets[s + 1], ring_offsets[r], ring_offsets[r + 1]):
                return DUPLICATED_RINGS
            if _rings_cross(flat, ids, ring_offsets[s], ring_offsets[s + 1], ring_offsets[r], ring_offsets[r + 1]):
                return INTERSECTION_RINGS
    code = _place_of_inner_rings(flat, ring_offsets)
    if code:
        return code
    return POLYGON_INTERIOR_DISCONNECTED if _touches_enclose_a_part(ids, ring_offsets) else 0
