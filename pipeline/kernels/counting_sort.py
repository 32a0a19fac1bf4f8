"""Counting sort: members by their keys in compressed rows (CSR)."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import LabelArray


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
