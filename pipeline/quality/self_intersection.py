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
from pipeline.model import IntArray
from pipeline.triangulation.edge_flips import ascending_order

_LOW_BITS = 20
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
def _dominant_plane(vertices: IntArray, a: int, b: int, c: int) -> tuple[int, int]:
    """The two axes in which the triangle a, b, c shows the largest area."""
    ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    nx, ny, nz = abs(uy * vz - uz * vy), abs(uz * vx - ux * vz), abs(ux * vy - uy * vx)
    if nz >= nx and nz >= ny:
        return 0, 1
    return (2, 0) if ny >= nx else (1, 2)


@kernel
def _turn(vertices: IntArray, x: int, y: int, a: int, b: int, c: int) -> int:
    """Twice the signed area of a, b, c as seen in the axes x and y."""
    right, up = vertices[b, x] - vertices[a, x], vertices[b, y] - vertices[a, y]
    return int(right * (vertices[c, y] - vertices[a, y]) - up * (vertices[c, x] - vertices[a, x]))


@kernel
def _coplanar_segments_meet(vertices: IntArray, x: int, y: int, p: int, q: int, a: int, b: int) -> bool:
    """Whether the closed segments p, q and a, b of one plane meet, as seen in the axes x and y."""
    for axis in (x, y):
        if max(vertices[p, axis], vertices[q, axis]) < min(vertices[a, axis], vertices[b, axis]) or max(
            vertices[a, axis], vertices[b, axis]
        ) < min(vertices[p, axis], vertices[q, axis]):
            return False
    side_a, side_b = _turn(vertices, x, y, p, q, a), _turn(vertices, x, y, p, q, b)
    if (side_a > 0 and side_b > 0) or (side_a < 0 and side_b < 0):
        return False
    side_p, side_q = _turn(vertices, x, y, a, b, p), _turn(vertices, x, y, a, b, q)
    return not ((side_p > 0 and side_q > 0) or (side_p < 0 and side_q < 0))


@kernel
def _in_triangle(vertices: IntArray, x: int, y: int, a: int, b: int, c: int, p: int) -> bool:
    """Whether p of the triangle's plane is within it or on its boundary, as seen in the axes x and y."""
    first, second, third = (
        _turn(vertices, x, y, a, b, p),
        _turn(vertices, x, y, b, c, p),
        _turn(vertices, x, y, c, a, p),
    )
    return (first >= 0 and second >= 0 and third >= 0) or (first <= 0 and second <= 0 and third <= 0)


@kernel
def segment_meets_triangle(vertices: IntArray, p: int, q: int, a: int, b: int, c: int) -> bool:
    """Whether the closed segment p, q and the closed triangle a, b, c have a point in common."""
    side_p, side_q = side_of_plane(vertices, a, b, c, p), side_of_plane(vertices, a, b, c, q)
    if side_p * side_q > 0:
        return False
    if side_p == 0 and side_q == 0:
        x, y = _dominant_plane(vertices, a, b, c)
        return (
            _in_triangle(vertices, x, y, a, b, c, p)
            or _coplanar_segments_meet(vertices, x, y, p, q, a, b)
            or _coplanar_segments_meet(vertices, x, y, p, q, b, c)
            or _coplanar_segments_meet(vertices, x, y, p, q, c, a)
        )
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
        x, y = _dominant_plane(vertices, a, b, c)
        return (_turn(vertices, x, y, a, b, c) > 0) == (_turn(vertices, x, y, a, b, d) > 0)
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
def _longest_plan_axis(low: IntArray) -> int:
    """0 where the lower corners of boxes (n, 3) spread farther in x than in y, else 1."""
    least_x = most_x = low[0, 0]
    least_y = most_y = low[0, 1]
    for i in range(1, len(low)):
        least_x, most_x = min(least_x, low[i, 0]), max(most_x, low[i, 0])
        least_y, most_y = min(least_y, low[i, 1]), max(most_y, low[i, 1])
    return 0 if most_x - least_x >= most_y - least_y else 1


@kernel
def shell_intersects_itself(vertices: IntArray, triangles: IntArray, face_of: IntArray) -> bool:
    """Whether triangles of different faces intersect.

    Parameters
    ----------
    vertices : (v, 3) int64
        Coordinates in mm.
    triangles : (t, 3) int64
        Vertex indices; no triangle is degenerate.
    face_of : (t,) int64
        The face of each triangle; triangles of one face are not tested against one another.

    Returns
    -------
    bool
        True at the first pair that intersects.
    """
    count = len(triangles)
    low, high = np.empty((count, 3), np.int64), np.empty((count, 3), np.int64)
    for t in range(count):
        for k in range(3):
            a, b, c = vertices[triangles[t, 0], k], vertices[triangles[t, 1], k], vertices[triangles[t, 2], k]
            low[t, k], high[t, k] = min(a, b, c), max(a, b, c)
    along = _longest_plan_axis(low)
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
