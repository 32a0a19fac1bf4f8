"""A face with holes as one chain of corners: every hole is joined at a common corner or by a bridge."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import in_cone, same_place, turn_of
from pipeline.model import IntArray


@kernel
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


@kernel
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


@kernel
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


@kernel
def _join_touching(flat: IntArray, chain: IntArray, length: int, start: int, stop: int) -> int:
    """Join the hole start:stop to the chain at a common corner; the new length, or the old where they do not touch."""
    for i in range(length):
        for corner in range(start, stop):
            if same_place(flat, chain[i], corner):
                before, after = chain[i - 1 if i else length - 1], chain[(i + 1) % length]
                if in_cone(flat, before, chain[i], after, corner + 1 if corner + 1 < stop else start):
                    return int(_splice(chain, length, i, start, stop, corner, True))
    return length


@kernel
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
            in_cone(flat, before, node, after, corner)
            and in_cone(flat, hole_before, corner, hole_after, node)
            and _free_bridge(flat, chain, length, waiting, ring_offsets, corner, node)
        ):
            return int(_splice(chain, length, best, start, stop, corner, False))
    return length


@kernel
def _rightmost_corner(flat: IntArray, start: int, stop: int) -> int:
    """The corner of start:stop that lies farthest right, of several the highest."""
    best = start
    for i in range(start + 1, stop):
        if flat[i, 0] > flat[best, 0] or (flat[i, 0] == flat[best, 0] and flat[i, 1] > flat[best, 1]):
            best = i
    return best


@kernel
def one_chain(flat: IntArray, ring_offsets: IntArray) -> tuple[IntArray, int]:
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
        left = 0
        for ring in waiting:
            if ring != hole:
                waiting[left] = ring
                left += 1
        waiting = waiting[:left]
    return chain, length
