"""Faces to triangles: projection, bridges, ears and flips in one."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import in_cone, same_place, turn_of
from pipeline.model import IntArray
from pipeline.triangulation.edge_flips import flip_to_delaunay
from pipeline.triangulation.hole_bridges import one_chain

MILLIMETRES_PER_METRE = 1000.0

DONE = 0
NO_AREA = 1
NO_BRIDGE = 2
NO_EAR = 3


@kernel
def triangulate_rings(corners: IntArray, ring_offsets: IntArray) -> tuple[IntArray, int]:
    """Triangles (t, 3) int64 of one face, as indices into its corners, and `DONE`; or no triangle and the fault.

    `corners` (n, 3) int64 of all rings are in mm, outer ring first; `ring_offsets` (r + 1,) is where each starts, and
    n.
    """
    flat, has_area = project_along_dominant_axis(corners, ring_offsets[1])
    nothing = np.empty((0, 3), np.int64)
    if not has_area:
        return nothing, NO_AREA
    if len(flat) == 3:
        single = np.empty((1, 3), np.int64)
        single[0, 0], single[0, 1], single[0, 2] = 0, 1, 2
        return single, DONE
    chain, length = one_chain(flat, ring_offsets)
    if length == 0:
        return nothing, NO_BRIDGE
    triangles, count = clip_ears(flat, chain, length)
    if count != length - 2:
        return nothing, NO_EAR
    if len(ring_offsets) > 2:
        for t in range(count):
            for k in range(3):
                corner = triangles[t, k]
                for i in range(corner):
                    if same_place(flat, i, corner):
                        triangles[t, k] = i
                        break
    if count > 1:
        flip_to_delaunay(corners, flat, triangles, count)
    return triangles, DONE


@kernel
def area_vector(corners: IntArray, start: int, stop: int) -> tuple[int, int, int]:
    """Twice the vector area of the ring corners[start:stop] (Newell's normal), in mm2: exact."""
    x = y = z = 0
    for i in range(start + 1, stop - 1):
        ax, ay, az = (
            corners[i, 0] - corners[start, 0],
            corners[i, 1] - corners[start, 1],
            corners[i, 2] - corners[start, 2],
        )
        bx, by, bz = (
            corners[i + 1, 0] - corners[start, 0],
            corners[i + 1, 1] - corners[start, 1],
            corners[i + 1, 2] - corners[start, 2],
        )
        x += ay * bz - az * by
        y += az * bx - ax * bz
        z += ax * by - ay * bx
    return x, y, z


@kernel
def project_along_dominant_axis(corners: IntArray, outer_stop: int) -> tuple[IntArray, bool]:
    """Drop the coordinate in which the outer ring's normal is longest.

    The first `outer_stop` corners of all rings, (n, 3) int64 in mm, are the outer ring. Returns all in the plane,
    (n, 2), the outer ring counter-clockwise; and False where it encloses no area.
    """
    x, y, z = area_vector(corners, 0, outer_stop)
    flat = np.empty((len(corners), 2), np.int64)
    if abs(z) >= abs(x) and abs(z) >= abs(y):
        first, second, turn = 0, 1, z
    elif abs(y) >= abs(x):
        first, second, turn = 2, 0, y
    else:
        first, second, turn = 1, 2, x
    if turn < 0:
        first, second = second, first
    for i in range(len(corners)):
        flat[i, 0] = corners[i, first] - corners[0, first]
        flat[i, 1] = corners[i, second] - corners[0, second]
    return flat, turn != 0


@kernel
def _is_ear(flat: IntArray, chain: IntArray, before: IntArray, after: IntArray, node: int) -> bool:
    """Whether the triangle at a node of the chain is inside, holds no other corner and its cut is a true diagonal."""
    p, q = before[node], after[node]
    a, b, c = chain[p], chain[node], chain[q]
    if turn_of(flat, a, b, c) <= 0:
        return False
    if not in_cone(flat, chain[before[p]], a, b, c) or not in_cone(flat, b, c, chain[after[q]], a):
        return False
    low_x, high_x = min(flat[a, 0], flat[b, 0], flat[c, 0]), max(flat[a, 0], flat[b, 0], flat[c, 0])
    low_y, high_y = min(flat[a, 1], flat[b, 1], flat[c, 1]), max(flat[a, 1], flat[b, 1], flat[c, 1])
    other = after[q]
    while other != p:
        d = chain[other]
        other = after[other]
        if flat[d, 0] < low_x or flat[d, 0] > high_x or flat[d, 1] < low_y or flat[d, 1] > high_y:
            continue
        if same_place(flat, d, a) or same_place(flat, d, b) or same_place(flat, d, c):
            continue
        if turn_of(flat, a, b, d) >= 0 and turn_of(flat, b, c, d) >= 0 and turn_of(flat, c, a, d) >= 0:
            return False
    return True


@kernel
def clip_ears(flat: IntArray, chain: IntArray, length: int) -> tuple[IntArray, int]:
    """Triangles (length - 2, 3) of corners, and their number: fewer where no ear is left."""
    before, after = np.empty(length, np.int64), np.empty(length, np.int64)
    for i in range(length):
        before[i] = i - 1 if i else length - 1
        after[i] = i + 1 if i + 1 < length else 0
    triangles = np.empty((max(length - 2, 0), 3), np.int64)
    count, node, refused, left = 0, 0, 0, length
    while left > 3 and refused < left:
        if _is_ear(flat, chain, before, after, node):
            p, q = before[node], after[node]
            triangles[count, 0], triangles[count, 1], triangles[count, 2] = chain[p], chain[node], chain[q]
            count += 1
            left -= 1
            after[p], before[q] = q, p
            node, refused = after[q], 0
        else:
            node = after[node]
            refused += 1
    if left == 3:
        a, b, c = chain[before[node]], chain[node], chain[after[node]]
        if turn_of(flat, a, b, c) > 0:
            triangles[count, 0], triangles[count, 1], triangles[count, 2] = a, b, c
            count += 1
    return triangles, count
