"""Sums that are rounded once, so that they do not depend on the order of their terms."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray

_MAX_PARTIALS = 64
"""Floating-point numbers that do not overlap fit so often into the range of exponents: 2,100 bits of 53 each."""


@kernel
def exact_sum(values: FloatArray) -> float:
    """The sum of finite values (n,), as `math.fsum` has it: exact partial sums (Shewchuk 1997), rounded at the end."""
    partials = np.empty(_MAX_PARTIALS)
    count = 0
    for value in values:
        total, kept = value, 0
        for k in range(count):
            larger, smaller = total, partials[k]
            if abs(larger) < abs(smaller):
                larger, smaller = smaller, larger
            total = larger + smaller
            lost = smaller - (total - larger)
            if lost != 0.0:
                partials[kept] = lost
                kept += 1
        partials[kept] = total
        count = kept + 1
    total = lost = 0.0
    while count > 0 and lost == 0.0:
        count -= 1
        before = total
        total = before + partials[count]
        lost = partials[count] - (total - before)
    # halfway between two numbers, the rest decides
    if count > 0 and lost != 0.0 and (partials[count - 1] > 0.0 if lost > 0.0 else partials[count - 1] < 0.0):
        before = total
        total = before + 2.0 * lost
        if total - before != 2.0 * lost:
            total = before
    return float(total)
