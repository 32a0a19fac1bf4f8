"""Sums that are rounded once: the same in any order, as `math.fsum` (Shewchuk 1997)."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray

_USUAL_PARTS = 64
"""Parts of a sum do not overlap, but may have few bits each of the 2100 that finite numbers have."""


@kernel
def exact_sum(values: FloatArray) -> float:
    """The sum of finite values (n,), rounded to the nearest float; what is summed on the way must not overflow."""
    parts = np.empty(_USUAL_PARTS)
    count = 0
    for value in values:
        high, kept = value, 0
        for k in range(count):
            other = parts[k]
            if abs(high) < abs(other):
                high, other = other, high
            total = high + other
            low = other - (total - high)
            if low != 0.0:
                parts[kept] = low
                kept += 1
            high = total
        if kept == len(parts):
            parts = np.concatenate((parts, np.empty(kept)))
        parts[kept] = high
        count = kept + 1
    # parts ascend: add them from the largest down until one is lost in rounding
    rounded: float = 0.0
    lost = 0.0
    while count > 0 and lost == 0.0:
        count -= 1
        before = rounded
        rounded = before + parts[count]
        lost = parts[count] - (rounded - before)
    # a half is rounded to even unless smaller parts decide it
    if count > 0 and parts[count - 1] != 0.0 and (lost < 0.0) == (parts[count - 1] < 0.0):
        twice = 2.0 * lost
        if (rounded + twice) - rounded == twice:
            rounded += twice
    return rounded
