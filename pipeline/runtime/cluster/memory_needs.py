"""How much memory a task needs, and what workers say they have: Dask's abstract resource `MEMORY`, in bytes.

A worker announces what a task of it may take, in its own process or in the one for buildings beside it: `gablework
worker` and embedded workers their memory limit, a plain `dask worker` by `--resources MEMORY=8e9`. Tasks that need much
declare it; Dask then never gives a worker more than it announced at once. What all workers of a node announce together
must fit into the node, so that two giants on one node fit, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RESOURCE = "MEMORY"
"""The resource's name."""
DECLARED_FROM_BYTES = 2**29
"""Smaller needs are not declared: every worker has so much for each of its threads, or could do nothing."""
BUILDING_BASE_BYTES = 280 * 2**20
"""Of a process that models buildings, before the first one."""
BUILDING_BYTES_PER_POINT = 10_000
"""Peak above it, bytes a point. Measured by `benchmarks/giant_memory.py`: 300 for flat halls, 1,000 to 3,600 for
saw-tooth roofs, 8,300 to 9,700 for roofs full of things: the number of faces decides, which nobody knows before. So
this is the upper edge, and the limit of a building's process the bound."""
WINDOW_BASE_BYTES = 300 * 2**20
"""Of a worker, before the first split."""


def building_bytes(points: int, limit_bytes: int | None = None) -> int:
    """What a building's process may come to take.

    Parameters
    ----------
    points : int
        Of the building.
    limit_bytes : int, optional
        At which its process is ended.

    Examples
    --------
    >>> [round(building_bytes(points) / 2**30, 1) for points in (1_000, 50_000, 1_000_000)]
    [0.3, 0.7, 9.6]
    >>> building_bytes(1_000_000, 4 * 2**30) == 4 * 2**30
    True
    """
    need = BUILDING_BASE_BYTES + BUILDING_BYTES_PER_POINT * points
    return need if limit_bytes is None else min(need, limit_bytes)


def declared_bytes(task: object) -> int:
    """What a task declares: its `memory_bytes`; 0 where it has none, or too little to be worth it."""
    need = int(getattr(task, "memory_bytes", 0))
    return need if need >= DECLARED_FROM_BYTES else 0


def announced_bytes(workers: Mapping[str, Mapping[str, Any]]) -> list[int]:
    """What each worker announces that announces anything, from the `workers` of a scheduler's identity.

    >>> announced_bytes({"a": {"resources": {"MEMORY": 8e9}}, "b": {"resources": {}}, "c": {}})
    [8000000000]
    """
    told = ((worker.get("resources") or {}).get(RESOURCE, 0.0) for worker in workers.values())
    return [int(value) for value in told if value > 0]
