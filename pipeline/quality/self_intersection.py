"""Self-intersection of a shell (code 306): exact tests of triangle pairs on integer millimetres.

Two triangles of different faces may have in common what they share as vertices: nothing, a vertex or an edge. Every
further point, also mere touching, is an intersection. Candidate pairs come from a sweep over bounding boxes.

Orientation tests are determinants of 3 x 3 differences, which need up to 80 bits: the normal is split into a high and
a low part, so that no sum leaves an int64 for solids of up to 60 km. (Integers must not wrap: the compiler relies on
signed sums that do not overflow.)
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import segments_meet, turn_of
from pipeline.kernels.sorting import ascending_order
from pipeline.model import IntArray

_LOW_BITS = 20  # products are split here, so that each half fits into 64 bits
_LOW_MASK = (1 << _LOW_BITS) - 1


@kernel
def side_of_plane(vertices: IntArray, a: int, b: int, c: int, d: int) -> int:
    """Sign of the volume of the tetrahedron a, b, c, d: positive where d is on the side of the normal of a, b, c."""
    ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    wx, wy, wz = vertices[d, 0] - vertices[a, 0], vertices[d, 1] - vertices[a, 1], vertices[d, 2] - vertices[a, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    high = (nx >> _LOW_BITS) * wx + (ny >> _LOW_BITS) * wy + (nz >> _LOW_BITS) * wz
    low = (nx & _LOW_MASK) * wx + (ny & _LOW_MASK) * wy + (nz & _LOW_MASK) * wz
    high += low >> _LOW_BITS
    if high < 0:
        return -1
    return 1 if high > 0 or (low & _LOW_MASK) > 0 else 0


@kernel
def _in_plane(vertices: IntArray, a: int, b: int, c: int, p: int, q: int) -> IntArray:
    """Five vertices (5, 2) as seen along the axis along which the triangle a, b, c shows the largest area."""
    ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    nx, ny, nz = abs(uy * vz - uz * vy), abs(uz * vx - ux * vz), abs(ux * vy - uy * vx)
    x, y = 1, 2
    if nz >= nx and nz >= ny:
        x, y = 0, 1
    elif ny >= nx:
        x, y = 2, 0
    flat = np.empty((5, 2), np.int64)
    for i, vertex in enumerate((a, b, c, p, q)):
        flat[i, 0], flat[i, 1] = vertices[vertex, x], vertices[vertex, y]
    return flat


@kernel
def segment_meets_triangle(vertices: IntArray, p: int, q: int, a: int, b: int, c: int) -> bool:
    """Whether the closed segment p, q and the closed triangle a, b, c have a point in common."""
    side_p, side_q = side_of_plane(vertices, a, b, c, p), side_of_plane(vertices, a, b, c, q)
    if side_p * side_q > 0:
        return False
    if side_p == 0 and side_q == 0:
        flat = _in_plane(vertices, a, b, c, p, q)
        positive, negative = True, True
        for i in range(3):
            side = turn_of(flat, i, (i + 1) % 3, 3)
            positive, negative = positive and side >= 0, negative and side <= 0
            if segments_meet(flat, 3, 4, i, (i + 1) % 3):
                return True
        return positive or negative
    first = side_of_plane(vertices, p, q, a, b)
    second = side_of_plane(vertices, p, q, b, c)
    if first * second < 0:
        return False
    third = side_of_plane(vertices, p, q, c, a)
    return first * third >= 0 and second * third >= 0


@kernel
def triangles_intersect(vertices: IntArray, first: IntArray, second: IntArray) -> bool:
    """Whether two triangles (three vertex indices each) meet anywhere but in the vertices and edge that they share."""
    shared = 0
    i_shared = j_shared = i_alone = j_alone = 0
    for i in range(3):
        for j in range(3):
            if first[i] == second[j]:
                shared += 1
                i_shared, j_shared = i, j
    if shared == 3:
        return True
    if shared == 2:
        for i in range(3):
            if first[i] != second[0] and first[i] != second[1] and first[i] != second[2]:
                i_alone = i
            if second[i] != first[0] and second[i] != first[1] and second[i] != first[2]:
                j_alone = i
        a, b, c, d = first[(i_alone + 1) % 3], first[(i_alone + 2) % 3], first[i_alone], second[j_alone]
        if side_of_plane(vertices, a, b, c, d) != 0:
            return False
        flat = _in_plane(vertices, a, b, c, d, d)
        return (turn_of(flat, 0, 1, 2) > 0) == (turn_of(flat, 0, 1, 3) > 0)
    if shared == 1:
        p, q = first[(i_shared + 1) % 3], first[(i_shared + 2) % 3]
        r, s = second[(j_shared + 1) % 3], second[(j_shared + 2) % 3]
        return segment_meets_triangle(vertices, p, q, second[0], second[1], second[2]) or segment_meets_triangle(
            vertices, r, s, first[0], first[1], first[2]
        )
    for k in range(3):
        if segment_meets_triangle(vertices, first[k], first[(k + 1) % 3], second[0], second[1], second[2]):
            return True
        if segment_meets_triangle(vertices, second[k], second[(k + 1) % 3], first[0], first[1], first[2]):
            return True
    return False


@kernel
def shell_intersects_itself(vertices: IntArray, triangles: IntArray, face_of: IntArray) -> bool:
    """Whether triangles (t, 3) of different faces intersect; ends at the first pair.

    They index vertices (v, 3) in mm; none is degenerate. `face_of` (t,) is the face of each.
    """
    count = len(triangles)
    low, high = np.empty((count, 3), np.int64), np.empty((count, 3), np.int64)
    for t in range(count):
        for k in range(3):
            a, b, c = vertices[triangles[t, 0], k], vertices[triangles[t, 1], k], vertices[triangles[t, 2], k]
            low[t, k], high[t, k] = min(a, b, c), max(a, b, c)
    least, most = low[0].copy(), low[0].copy()
    for t in range(count):
        for k in range(2):
            least[k], most[k] = min(least[k], low[t, k]), max(most[k], low[t, k])
    # the plan axis along which the boxes spread farther
    along = 0 if most[0] - least[0] >= most[1] - least[1] else 1
    across = 1 - along
    order = ascending_order(low[:, along].copy())
    for i in range(count):
        t = order[i]
        for j in range(i + 1, count):
            s = order[j]
            if low[s, along] > high[t, along]:
                break
            if (
                low[s, across] <= high[t, across]
                and high[s, across] >= low[t, across]
                and low[s, 2] <= high[t, 2]
                and high[s, 2] >= low[t, 2]
                and face_of[s] != face_of[t]
                and triangles_intersect(vertices, triangles[t], triangles[s])
            ):
                return True
    return False
