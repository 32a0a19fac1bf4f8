"""Tasks of some items each, by how many points these have."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

Item = TypeVar("Item")


def in_groups(sized: Iterable[tuple[Item, int]], most: int) -> list[list[Item]]:
    """Items in their order, as many a group as together have at most so many points; a larger one is alone.

    >>> in_groups([("a", 9), ("b", 2), ("c", 1), ("d", 3)], 5)
    [['a'], ['b', 'c'], ['d']]
    """
    groups: list[list[Item]] = []
    points = 0
    for item, size in sized:
        if not groups or points + size > most:
            groups.append([])
            points = 0
        groups[-1].append(item)
        points += size
    return groups
