"""Edge flips (Lawson 1977): triangles of a face become its constrained Delaunay triangulation.

Angles are measured in space. Cocircular ties go to the diagonal with the smaller coordinates, so that the result does
not depend on where a ring starts.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import comes_before, turn_of
from pipeline.kernels.sorting import ascending_order
from pipeline.model import IntArray

_TIE = 1e-9
"""Relative difference of angles below which four corners count as cocircular."""


@kernel
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


@kernel(inline="always")
def _prefers_diagonal(corners: IntArray, a: int, c: int, b: int, d: int) -> bool:
    """Whether the quadrangle a, b, c, d is better cut from b to d than from a to c."""
    sine_b, cosine_b = _apex_angle(corners, b, a, c)
    sine_d, cosine_d = _apex_angle(corners, d, a, c)
    sine_of_sum = sine_b * cosine_d + cosine_b * sine_d
    scale = np.sqrt((sine_b * sine_b + cosine_b * cosine_b) * (sine_d * sine_d + cosine_d * cosine_d))
    if abs(sine_of_sum) > _TIE * scale:
        return bool(sine_of_sum < 0.0)
    low_now, high_now = (a, c) if comes_before(corners, a, c) else (c, a)
    low_new, high_new = (b, d) if comes_before(corners, b, d) else (d, b)
    if comes_before(corners, low_new, low_now):
        return True
    return bool(not comes_before(corners, low_now, low_new) and comes_before(corners, high_new, high_now))


@kernel
def edges_in_order(triangles: IntArray, count: int, corner_count: int) -> tuple[IntArray, IntArray]:
    """Keys (3 count,) of the undirected edges of triangles, by 3 * triangle + corner, and the order that sorts them."""
    keys = np.empty(3 * count, np.int64)
    for t in range(count):
        for k in range(3):
            a, b = triangles[t, k], triangles[t, (k + 1) % 3]
            keys[3 * t + k] = a * corner_count + b if a < b else b * corner_count + a
    return keys, ascending_order(keys)


@kernel
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


@kernel
def flip_to_delaunay(corners: IntArray, flat: IntArray, triangles: IntArray, count: int) -> None:
    """Flip diagonals in place until none is preferred (at most as often as there are pairs of corners)."""
    keys, order = edges_in_order(triangles, count, len(flat))
    # the triangle across the edge from each corner to the next; -1 at a ring
    neighbours = np.full((count, 3), -1, np.int64)
    for i in range(1, len(keys)):
        first, second = order[i - 1], order[i]
        if keys[first] == keys[second]:
            neighbours[first // 3, first % 3] = second // 3
            neighbours[second // 3, second % 3] = first // 3
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
