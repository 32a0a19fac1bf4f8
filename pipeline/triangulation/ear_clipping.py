"""Ear clipping (Meisters 1975): a chain of corners is cut into triangles, exactly."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import in_cone, same_place, turn_of
from pipeline.model import IntArray


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
