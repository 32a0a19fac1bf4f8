"""Disjoint sets as a forest of parents (union-find with path halving)."""

from __future__ import annotations

from pipeline.compiler import kernel
from pipeline.model import IntArray


@kernel
def root_of(parent: IntArray, node: int) -> int:
    """The representative of the set that a node is in; parent (n,) starts as 0 to n - 1."""
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@kernel
def unite(parent: IntArray, first: int, second: int) -> bool:
    """Unite the sets of two nodes; whether they were different ones."""
    a, b = root_of(parent, first), root_of(parent, second)
    parent[a] = b
    return a != b
