"""Stable sorts, much faster to compile than numpy's: by comparisons, by few keys into rows, by the digits of many."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray, LabelArray

Values = TypeVar("Values", IntArray, FloatArray)

_MANY = 64
"""Merging is faster from here on."""


@kernel
def ascending_order(keys: IntArray | FloatArray) -> IntArray:
    """Indices (n,) int64 that sort keys (n,), int64 or float64: ties by index, nan behind all numbers."""
    count = len(keys)
    order, spare = np.empty(count, np.int64), np.empty(count, np.int64)
    for i in range(count):
        order[i] = i
    width = 1
    while width < count:
        for start in range(0, count, 2 * width):
            middle, stop = min(start + width, count), min(start + 2 * width, count)
            left, right = start, middle
            for place in range(start, stop):
                takes_left = left < middle
                if takes_left and right < stop:
                    first, second = keys[order[left]], keys[order[right]]
                    takes_left = first <= second or second != second  # noqa: PLR0124 - nan
                if takes_left:
                    spare[place] = order[left]
                    left += 1
                else:
                    spare[place] = order[right]
                    right += 1
        order, spare = spare, order
        width *= 2
    return order


@kernel
def in_order(values: Values) -> Values:
    """Values (n,), int64 or float64, in ascending order."""
    order = ascending_order(values)
    ordered = np.empty_like(values)
    for i in range(len(values)):
        ordered[i] = values[order[i]]
    return ordered


@kernel(inline="always")
def sort_few(values: FloatArray) -> None:
    """Put values (n,), mostly a few dozen, in ascending order where they are: by insertion, which then is fastest."""
    if len(values) > _MANY:
        values[:] = in_order(values)
    else:
        for i in range(1, len(values)):
            moved, k = values[i], i
            while k > 0 and values[k - 1] > moved:
                values[k] = values[k - 1]
                k -= 1
            values[k] = moved


@kernel
def counting_sort(keys: LabelArray, count: int) -> tuple[LabelArray, LabelArray]:
    """Members of every key: where those of each start, (count + 1,) int32 with their number, and their indices (m,).

    `keys` (n,) has the key of every member, below `count`; members with a negative key are left out. Indices ascend
    within a key.
    """
    starts = np.zeros(count + 1, np.int32)
    for key in keys:
        if key >= 0:
            starts[key + 1] += 1
    for key in range(count):
        starts[key + 1] += starts[key]
    members = np.empty(starts[count], np.int32)
    for i in range(len(keys)):
        if keys[i] >= 0:
            members[starts[keys[i]]] = i
            starts[keys[i]] += 1
    # every start has moved to the next one's place
    for key in range(count, 0, -1):
        starts[key] = starts[key - 1]
    starts[0] = 0
    return starts, members


_DIGIT_BITS = 11


_DIGITS = 1 << _DIGIT_BITS


_KEY_BITS = 63


@kernel
def radix_order(keys: IntArray) -> LabelArray:
    """Indices (n,) int32 that sort keys (n,) int64, none of them negative: ties by index."""
    n = keys.size
    order, spare = np.empty(n, np.int32), np.empty(n, np.int32)
    highest = np.int64(0)
    for i in range(n):
        order[i] = i
        highest = max(highest, keys[i])
    ordered, spare_keys = keys.copy(), np.empty(n, np.int64)
    starts = np.empty(_DIGITS, np.int32)
    # digit by digit from the last on (Knuth, The Art of Computer Programming 3, 5.2.5): each pass keeps the order
    shift = 0
    while shift < _KEY_BITS and highest >> shift > 0:
        starts[:] = 0
        for i in range(n):
            starts[(ordered[i] >> shift) & (_DIGITS - 1)] += 1
        before = np.int32(0)
        for digit in range(_DIGITS):
            count = starts[digit]
            starts[digit] = before
            before += count
        for i in range(n):
            digit = (ordered[i] >> shift) & (_DIGITS - 1)
            place = starts[digit]
            starts[digit] += 1
            spare_keys[place], spare[place] = ordered[i], order[i]
        ordered, spare_keys = spare_keys, ordered
        order, spare = spare, order
        shift += _DIGIT_BITS
    return order
