"""Disjoint sets as a forest of parents (union-find with path halving); the smallest member stands for a set."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import IntArray, LabelArray


@kernel
def root_of(parent: IntArray, node: int) -> int:
    """The smallest member of the set that a node is in; parent (n,) int64 starts as 0 to n - 1."""
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@kernel
def unite(parent: IntArray, first: int, second: int) -> bool:
    """Unite the sets of two nodes; whether they were different ones."""
    if parent[first] == parent[second]:
        return False  # mostly: it saves two ways to the root
    a, b = root_of(parent, first), root_of(parent, second)
    parent[max(a, b)] = min(a, b)
    return a != b


@kernel
def numbered_sets(parent: IntArray) -> tuple[LabelArray, int]:
    """The set of every node, (n,) int32, numbered by their smallest members; how many there are."""
    sets = np.empty(len(parent), np.int32)
    count = 0
    for node in range(len(parent)):
        # parents are smaller than their children, so the parent's number is known
        if parent[node] == node:
            sets[node] = count
            count += 1
        else:
            sets[node] = sets[parent[node]]
    return sets, count


@kernel
def _united(count: int, one: IntArray, other: IntArray) -> IntArray:
    """Kernel of `united`."""
    parent = np.arange(count)
    for i in range(len(one)):
        unite(parent, one[i], other[i])
    for node in range(count):
        parent[node] = parent[parent[node]]
    return parent


def united(count: int, one: IntArray | LabelArray, other: IntArray | LabelArray) -> IntArray:
    """Smallest member (count,) int64 of the set of each of `count` elements, after uniting `one[i]` and `other[i]`.

    Examples
    --------
    >>> united(4, np.array([0, 3]), np.array([2, 3])).tolist()
    [0, 1, 0, 3]
    """
    return _united(count, np.ascontiguousarray(one, np.int64), np.ascontiguousarray(other, np.int64))
