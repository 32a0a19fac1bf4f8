"""Memory needs of tasks and memory of workers: Dask's abstract resource `MEMORY`, in bytes.

A worker announces the memory that its tasks may take, in its process or in the child for buildings: `gablework worker`
and embedded workers announce their memory limit, a plain `dask worker` uses `--resources MEMORY=8e9`. Tasks that
need much declare it; Dask then never gives a worker more than it announced. The announcements of all workers on a node
together must fit into its memory, as two giants may run there at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RESOURCE = "MEMORY"
"""The resource's name."""
DECLARED_FROM_BYTES = 2**29
"""Smaller needs are not declared: every usable worker has this much per thread."""
BUILDING_BASE_BYTES = 280 * 2**20
"""Memory of a process that models buildings, before the first one."""
BUILDING_BYTES_PER_POINT = 2_000
"""Peak above it, in bytes per point. Measured at commit 3d991134: 390 to 430 for flat halls, up to 490 for
saw-tooth roofs, 580 to 1,070 for roofs full of things. It depends on the number of faces, which is unknown before, so
this is twice the maximum; the limit of a building's process bounds it."""


def building_bytes(points: int, limit_bytes: int | None = None) -> int:
    """Estimated peak memory of a building's process.

    Examples
    --------
    >>> [round(building_bytes(points) / 2**30, 1) for points in (1_000, 50_000, 1_000_000)]
    [0.3, 0.4, 2.1]
    >>> building_bytes(4_000_000, 4 * 2**30) == 4 * 2**30
    True
    """
    need = BUILDING_BASE_BYTES + BUILDING_BYTES_PER_POINT * points
    return need if limit_bytes is None else min(need, limit_bytes)


def declared_bytes(task: object) -> int:
    """The declared need of a task: its `memory_bytes`, or 0 if it has none or a small one."""
    need = int(getattr(task, "memory_bytes", 0))
    return need if need >= DECLARED_FROM_BYTES else 0


def announced_bytes(workers: Mapping[str, Mapping[str, Any]]) -> list[int]:
    """Memory of each worker that announces any, from the `workers` of a scheduler's identity.

    >>> announced_bytes({"a": {"resources": {"MEMORY": 8e9}}, "b": {"resources": {}}, "c": {}})
    [8000000000]
    """
    announced = ((worker.get("resources") or {}).get(RESOURCE, 0.0) for worker in workers.values())
    return [int(value) for value in announced if value > 0]
