"""Triangulation of planar faces with holes, exact on millimetres: no new vertices, no degenerate triangles.

A face is projected along the dominant axis of its normal, so that millimetre coordinates stay integers and every
orientation test is exact. Holes are joined to the outer ring by bridges, the resulting polygon is cut by ear clipping
(Meisters 1975), and edge flips make it a constrained Delaunay triangulation (Lawson 1977). The flips keep thin
triangles away from vertices that lie on a straight edge, so that rounding hardly turns the normals. Cocircular ties
go to the diagonal with the smaller coordinates, so that the result does not depend on where a ring starts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from pipeline.model import FloatArray, IntArray

MILLIMETRES_PER_METRE = 1000.0

DONE = 0
NO_AREA = 1
NO_BRIDGE = 2
NO_EAR = 3

_TIE = 1e-9
"""Relative difference of angles below which four corners count as cocircular."""

_FAULTS = {
    NO_AREA: "the outer ring encloses no area",
    NO_BRIDGE: "a hole lies outside, crosses or touches the outer ring along an edge, or runs the same way round",
    NO_EAR: "the rings cross or touch themselves",
}


def triangulate_face(vertices: FloatArray, rings: Sequence[Sequence[int]]) -> IntArray:
    """Cut a planar face into triangles of its own vertices.

    Parameters
    ----------
    vertices : (v, 3) float64
        Vertices of the solid in metres, taken to the nearest millimetre.
    rings : sequence of sequences of int
        Outer ring first, holes the other way round; vertex indices, the first not repeated.

    Returns
    -------
    (t, 3) int64
        Vertex indices, oriented as the outer ring; t = corners - 2, and two more for each hole that
        touches no other ring. No triangle has zero area.

    Raises
    ------
    ValueError
        If a ring has fewer than three vertices, the outer ring encloses no area, a hole cannot be joined to it, or no
        ear is left. Rings that cross are not always noticed: `pipeline.quality.validity` finds them.
    """
    for ring in rings:
        if len(ring) < 3:
            raise ValueError(f"a ring of {len(ring)} vertices bounds no face: give at least three")
    if len(rings) == 0:
        raise ValueError("a face has an outer ring: none is given")
    ids = np.array([index for ring in rings for index in ring], dtype=np.int64)
    offsets = np.zeros(len(rings) + 1, dtype=np.int64)
    np.cumsum([len(ring) for ring in rings], out=offsets[1:])
    corners = np.rint(np.asarray(vertices, dtype=np.float64)[ids] * MILLIMETRES_PER_METRE).astype(np.int64)
    triangles, status = triangulate_rings(corners, offsets)
    if status != DONE:
        raise ValueError(f"rings {tuple(tuple(ring) for ring in rings)} cannot be triangulated: {_FAULTS[int(status)]}")
    return ids[triangles]


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def project_along_dominant_axis(corners: IntArray, outer_stop: int) -> tuple[IntArray, bool]:
    """Drop the coordinate in which the outer ring's normal is longest.

    Parameters
    ----------
    corners : (n, 3) int64
        Corners of all rings in mm, outer ring first.
    outer_stop : int
        Number of corners of the outer ring.

    Returns
    -------
    (n, 2) int64 and bool
        Corners in the plane, the outer ring counter-clockwise; False where it encloses no area.
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


@njit(cache=True, nogil=True)
def turn_of(flat: IntArray, a: int, b: int, c: int) -> int:
    """Twice the signed area of the triangle a, b, c in mm2: positive where it turns left."""
    right, up = flat[b, 0] - flat[a, 0], flat[b, 1] - flat[a, 1]
    return int(right * (flat[c, 1] - flat[a, 1]) - up * (flat[c, 0] - flat[a, 0]))


@njit(cache=True, nogil=True)
def same_place(flat: IntArray, a: int, b: int) -> bool:
    """Whether two corners coincide."""
    return bool(flat[a, 0] == flat[b, 0] and flat[a, 1] == flat[b, 1])


@njit(cache=True, nogil=True)
def _in_cone(flat: IntArray, before: int, node: int, after: int, target: int) -> bool:
    """Whether the way from node to target starts strictly inside the polygon on the left of before, node, after."""
    left_of_first = turn_of(flat, before, node, target)
    left_of_second = turn_of(flat, node, after, target)
    if turn_of(flat, before, node, after) > 0:
        return left_of_first > 0 and left_of_second > 0
    return left_of_first > 0 or left_of_second > 0


@njit(cache=True, nogil=True)
def _blocks(flat: IntArray, a: int, b: int, p: int, q: int) -> bool:
    """Whether the edge a, b crosses the bridge p, q, or its corner a lies on the bridge between the ends."""
    if same_place(flat, a, p) or same_place(flat, a, q):
        return False
    side_a = turn_of(flat, p, q, a)
    if side_a == 0:
        along = (flat[a, 0] - flat[p, 0]) * (flat[q, 0] - flat[p, 0]) + (flat[a, 1] - flat[p, 1]) * (
            flat[q, 1] - flat[p, 1]
        )
        length = (flat[q, 0] - flat[p, 0]) ** 2 + (flat[q, 1] - flat[p, 1]) ** 2
        return bool(0 < along < length)
    side_b = turn_of(flat, p, q, b)
    if side_b == 0 or (side_a > 0) == (side_b > 0):
        return False
    side_p, side_q = turn_of(flat, a, b, p), turn_of(flat, a, b, q)
    return (side_p > 0 and side_q < 0) or (side_p < 0 and side_q > 0)


@njit(cache=True, nogil=True)
def _free_bridge(
    flat: IntArray, chain: IntArray, length: int, waiting: IntArray, stops: IntArray, p: int, q: int
) -> bool:
    """Whether the bridge p, q meets neither the chain nor a hole that waits (corners and the ends of their rings)."""
    for i in range(length):
        if _blocks(flat, chain[i], chain[(i + 1) % length], p, q):
            return False
    for ring in waiting:
        start, stop = stops[ring], stops[ring + 1]
        for i in range(start, stop):
            if _blocks(flat, i, i + 1 if i + 1 < stop else start, p, q):
                return False
    return True


@njit(cache=True, nogil=True)
def _splice(chain: IntArray, length: int, place: int, start: int, stop: int, corner: int, touching: bool) -> int:
    """Insert the hole start:stop behind chain[place], from its corner once round and back; the new length."""
    extra = stop - start if touching else stop - start + 2
    for i in range(length - 1, place, -1):
        chain[i + extra] = chain[i]
    count = stop - start
    at = place + 1
    if not touching:
        chain[at] = corner
        at += 1
    for step in range(1, count + 1):
        chain[at] = start + (corner - start + step) % count
        at += 1
    if not touching:
        chain[at] = chain[place]
    return length + extra


@njit(cache=True, nogil=True)
def _join_touching(flat: IntArray, chain: IntArray, length: int, start: int, stop: int) -> int:
    """Join the hole start:stop to the chain at a common corner; the new length, or the old where they do not touch."""
    for i in range(length):
        for corner in range(start, stop):
            if same_place(flat, chain[i], corner):
                before, after = chain[i - 1 if i else length - 1], chain[(i + 1) % length]
                if _in_cone(flat, before, chain[i], after, corner + 1 if corner + 1 < stop else start):
                    return int(_splice(chain, length, i, start, stop, corner, True))
    return length


@njit(cache=True, nogil=True)
def _join_by_bridge(
    flat: IntArray, chain: IntArray, length: int, ring_offsets: IntArray, waiting: IntArray, hole: int, corner: int
) -> int:
    """Join a hole to the chain by the shortest free bridge from its corner; the new length, or the old without one."""
    start, stop = ring_offsets[hole], ring_offsets[hole + 1]
    hole_before = corner - 1 if corner > start else stop - 1
    hole_after = corner + 1 if corner + 1 < stop else start
    tried = np.zeros(length, np.bool_)
    for _ in range(length):
        best, best_distance = -1, np.int64(0)
        for i in range(length):
            if not tried[i]:
                distance = (flat[chain[i], 0] - flat[corner, 0]) ** 2 + (flat[chain[i], 1] - flat[corner, 1]) ** 2
                if best < 0 or distance < best_distance:
                    best, best_distance = i, distance
        tried[best] = True
        node = chain[best]
        before, after = chain[best - 1 if best else length - 1], chain[(best + 1) % length]
        if (
            _in_cone(flat, before, node, after, corner)
            and _in_cone(flat, hole_before, corner, hole_after, node)
            and _free_bridge(flat, chain, length, waiting, ring_offsets, corner, node)
        ):
            return int(_splice(chain, length, best, start, stop, corner, False))
    return length


@njit(cache=True, nogil=True)
def _rightmost_corner(flat: IntArray, start: int, stop: int) -> int:
    """The corner of start:stop that lies farthest right, of several the highest."""
    best = start
    for i in range(start + 1, stop):
        if flat[i, 0] > flat[best, 0] or (flat[i, 0] == flat[best, 0] and flat[i, 1] > flat[best, 1]):
            best = i
    return best


@njit(cache=True, nogil=True)
def _one_chain(flat: IntArray, ring_offsets: IntArray) -> tuple[IntArray, int]:
    """The outer ring with all holes joined to it as one chain of corners, and its length; 0 without bridges.

    Holes that touch the chain come first, since a bridge to what a touching hole will join cuts the interior in two.
    The others come from right to left: the rightmost corner of the rightmost hole always sees a corner of the chain.
    """
    holes = len(ring_offsets) - 2
    chain = np.empty(len(flat) + 2 * holes, np.int64)
    length = ring_offsets[1]
    for i in range(length):
        chain[i] = i
    waiting = np.arange(1, holes + 1)
    while len(waiting):
        hole = waiting[0]
        joined = length
        for ring in waiting:
            joined = _join_touching(flat, chain, length, ring_offsets[ring], ring_offsets[ring + 1])
            if joined > length:
                hole = ring
                break
        if joined == length:
            corner = _rightmost_corner(flat, ring_offsets[hole], ring_offsets[hole + 1])
            for ring in waiting[1:]:
                other = _rightmost_corner(flat, ring_offsets[ring], ring_offsets[ring + 1])
                if flat[other, 0] > flat[corner, 0] or (
                    flat[other, 0] == flat[corner, 0] and flat[other, 1] > flat[corner, 1]
                ):
                    hole, corner = ring, other
            joined = _join_by_bridge(flat, chain, length, ring_offsets, waiting, hole, corner)
            if joined == length:
                return chain, 0
        length = joined
        waiting = waiting[waiting != hole]
    return chain, length


@njit(cache=True, nogil=True)
def _is_ear(flat: IntArray, chain: IntArray, before: IntArray, after: IntArray, node: int) -> bool:
    """Whether the triangle at a node of the chain is inside, holds no other corner and its cut is a true diagonal."""
    p, q = before[node], after[node]
    a, b, c = chain[p], chain[node], chain[q]
    if turn_of(flat, a, b, c) <= 0:
        return False
    if not _in_cone(flat, chain[before[p]], a, b, c) or not _in_cone(flat, b, c, chain[after[q]], a):
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


@njit(cache=True, nogil=True)
def _clip_ears(flat: IntArray, chain: IntArray, length: int) -> tuple[IntArray, int]:
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


@njit(cache=True, nogil=True)
def _apex_angle(corners: IntArray, apex: int, a: int, b: int) -> tuple[float, float]:
    """Sine and cosine, times the product of the legs, of the angle at apex between a and b, in space."""
    ux = float(corners[a, 0] - corners[apex, 0])
    uy = float(corners[a, 1] - corners[apex, 1])
    uz = float(corners[a, 2] - corners[apex, 2])
    vx = float(corners[b, 0] - corners[apex, 0])
    vy = float(corners[b, 1] - corners[apex, 1])
    vz = float(corners[b, 2] - corners[apex, 2])
    cross_x, cross_y, cross_z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return np.sqrt(cross_x * cross_x + cross_y * cross_y + cross_z * cross_z), ux * vx + uy * vy + uz * vz


@njit(cache=True, nogil=True)
def _comes_before(corners: IntArray, a: int, b: int) -> bool:
    """Whether corner a comes before b by x, then y, then z."""
    for k in range(3):
        if corners[a, k] != corners[b, k]:
            return bool(corners[a, k] < corners[b, k])
    return False


@njit(cache=True, nogil=True)
def _prefers_diagonal(corners: IntArray, a: int, c: int, b: int, d: int) -> bool:
    """Whether the quadrangle a, b, c, d is better cut from b to d than from a to c."""
    sine_b, cosine_b = _apex_angle(corners, b, a, c)
    sine_d, cosine_d = _apex_angle(corners, d, a, c)
    sine_of_sum = sine_b * cosine_d + cosine_b * sine_d
    scale = np.sqrt((sine_b * sine_b + cosine_b * cosine_b) * (sine_d * sine_d + cosine_d * cosine_d))
    if abs(sine_of_sum) > _TIE * scale:
        return bool(sine_of_sum < 0.0)
    low_now, high_now = (a, c) if _comes_before(corners, a, c) else (c, a)
    low_new, high_new = (b, d) if _comes_before(corners, b, d) else (d, b)
    if _comes_before(corners, low_new, low_now):
        return True
    return bool(not _comes_before(corners, low_now, low_new) and _comes_before(corners, high_new, high_now))


@njit(cache=True, nogil=True)
def ascending_order(keys: IntArray) -> IntArray:
    """Indices (n,) that sort int64 keys (n,), ties by index: a merge sort, much faster to compile than numpy's."""
    count = len(keys)
    order, spare = np.empty(count, np.int64), np.empty(count, np.int64)
    for i in range(count):
        order[i] = i
    width = 1
    while width < count:
        for start in range(0, count, 2 * width):
            middle, stop = start + width, start + 2 * width
            middle = min(middle, count)
            stop = min(stop, count)
            left, right = start, middle
            for place in range(start, stop):
                if left < middle and (right >= stop or keys[order[left]] <= keys[order[right]]):
                    spare[place] = order[left]
                    left += 1
                else:
                    spare[place] = order[right]
                    right += 1
        order, spare = spare, order
        width *= 2
    return order


@njit(cache=True, nogil=True)
def _neighbours(triangles: IntArray, count: int, corner_count: int) -> IntArray:
    """(count, 3) the triangle across the edge from each corner to the next; -1 at a ring."""
    keys = np.empty(3 * count, np.int64)
    for t in range(count):
        for k in range(3):
            a, b = triangles[t, k], triangles[t, (k + 1) % 3]
            keys[3 * t + k] = a * corner_count + b if a < b else b * corner_count + a
    order = ascending_order(keys)
    neighbours = np.full((count, 3), -1, np.int64)
    for i in range(1, len(keys)):
        first, second = order[i - 1], order[i]
        if keys[first] == keys[second]:
            neighbours[first // 3, first % 3] = second // 3
            neighbours[second // 3, second % 3] = first // 3
    return neighbours


@njit(cache=True, nogil=True)
def _flip(triangles: IntArray, neighbours: IntArray, t: int, k: int, other: int, m: int) -> None:
    """Turn the diagonal that edge k of triangle t shares with edge m of another."""
    a, c, b = triangles[t, k], triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
    d = triangles[other, (m + 2) % 3]
    across_cb, across_ba = neighbours[t, (k + 1) % 3], neighbours[t, (k + 2) % 3]
    across_ad, across_dc = neighbours[other, (m + 1) % 3], neighbours[other, (m + 2) % 3]
    triangles[t, 0], triangles[t, 1], triangles[t, 2] = a, d, b
    neighbours[t, 0], neighbours[t, 1], neighbours[t, 2] = across_ad, other, across_ba
    triangles[other, 0], triangles[other, 1], triangles[other, 2] = d, c, b
    neighbours[other, 0], neighbours[other, 1], neighbours[other, 2] = across_dc, across_cb, t
    if across_ad >= 0:
        for j in range(3):
            if neighbours[across_ad, j] == other:
                neighbours[across_ad, j] = t
                break
    if across_cb >= 0:
        for j in range(3):
            if neighbours[across_cb, j] == t:
                neighbours[across_cb, j] = other
                break


@njit(cache=True, nogil=True)
def _flip_to_delaunay(corners: IntArray, flat: IntArray, triangles: IntArray, count: int) -> None:
    """Flip diagonals in place until none is preferred (at most as often as there are pairs of corners)."""
    neighbours = _neighbours(triangles, count, len(flat))
    budget = len(flat) * len(flat)
    changed = True
    while changed and budget > 0:
        changed = False
        for t in range(count):
            for k in range(3):
                other = neighbours[t, k]
                if other < 0:
                    continue
                a, c, b = triangles[t, k], triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
                m = 0
                while triangles[other, m] != c:
                    m += 1
                d = triangles[other, (m + 2) % 3]
                if turn_of(flat, a, d, b) > 0 and turn_of(flat, d, c, b) > 0 and _prefers_diagonal(corners, a, c, b, d):
                    _flip(triangles, neighbours, t, k, other, m)
                    changed = True
                    budget -= 1


@njit(cache=True, nogil=True)
def triangulate_rings(corners: IntArray, ring_offsets: IntArray) -> tuple[IntArray, int]:
    """Triangulate one face from the corners of its rings.

    Parameters
    ----------
    corners : (n, 3) int64
        Corners of all rings in mm, outer ring first.
    ring_offsets : (r + 1,) int64
        Where each ring starts in corners, and n.

    Returns
    -------
    (t, 3) int64 and int
        Indices into corners, and `DONE`, or no triangle and the fault.
    """
    flat, has_area = project_along_dominant_axis(corners, ring_offsets[1])
    nothing = np.empty((0, 3), np.int64)
    if not has_area:
        return nothing, NO_AREA
    if len(flat) == 3:
        single = np.empty((1, 3), np.int64)
        single[0, 0], single[0, 1], single[0, 2] = 0, 1, 2
        return single, DONE
    chain, length = _one_chain(flat, ring_offsets)
    if length == 0:
        return nothing, NO_BRIDGE
    triangles, count = _clip_ears(flat, chain, length)
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
        _flip_to_delaunay(corners, flat, triangles, count)
    return triangles, DONE
