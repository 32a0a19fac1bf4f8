"""A binary heap in arrays: at its top is the entry of the smallest key, of equal keys that of the smallest rank."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray


class Heap(NamedTuple):
    """Entries of a heap and room for more; its user knows how many it holds."""

    keys: FloatArray
    """(room,) float64."""
    ranks: IntArray
    """(room,) int64."""
    items: IntArray
    """(room,) int64, whatever belongs to each entry."""


@kernel(inline="always")
def heap_with_room(room: int) -> Heap:
    """An empty heap."""
    return Heap(np.empty(room), np.empty(room, np.int64), np.empty(room, np.int64))


@kernel(inline="always")
def _comes_first(heap: Heap, i: int, key: float, rank: int) -> bool:
    """Whether entry i comes before one of that key and rank."""
    return bool(heap.keys[i] < key or (heap.keys[i] == key and heap.ranks[i] < rank))


@kernel
def heap_push(heap: Heap, held: int, key: float, rank: int, item: int) -> Heap:
    """Put an entry into a heap that holds so many; the heap, a larger one where there was no room."""
    if held == len(heap.keys):
        grown = heap_with_room(2 * held + 16)
        for i in range(held):
            grown.keys[i], grown.ranks[i], grown.items[i] = heap.keys[i], heap.ranks[i], heap.items[i]
        heap = grown
    keys, ranks, items = heap.keys, heap.ranks, heap.items
    i = held
    while i > 0:
        parent = (i - 1) >> 1
        if not (key < keys[parent] or (key == keys[parent] and rank < ranks[parent])):
            break
        keys[i], ranks[i], items[i] = keys[parent], ranks[parent], items[parent]
        i = parent
    keys[i], ranks[i], items[i] = key, rank, item
    return heap


@kernel
def heap_pop(heap: Heap, held: int) -> None:
    """Remove the top of a heap that holds so many entries."""
    keys, ranks, items = heap.keys, heap.ranks, heap.items
    last = held - 1
    key, rank, item = keys[last], ranks[last], items[last]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= last:
            break
        if child + 1 < last and _comes_first(heap, child + 1, keys[child], ranks[child]):
            child += 1
        if not _comes_first(heap, child, key, rank):
            break
        keys[i], ranks[i], items[i] = keys[child], ranks[child], items[child]
        i = child
    keys[i], ranks[i], items[i] = key, rank, item
