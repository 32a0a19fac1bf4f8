"""Cores and memory available to this process, by its affinity and its control group."""

from __future__ import annotations

import math
import os
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")


def cores(cgroup: Path = _CGROUP) -> int:
    """Cores that this process may use, at least one.

    The folder `cgroup` has the limits of the control group (version 2); a quota of two and a half cores counts as two.
    """
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, _, period = _text(cgroup / "cpu.max").partition(" ")
    if quota.isdigit() and period.isdigit() and int(period):
        count = min(count, math.floor(int(quota) / int(period)))
    return max(1, count)


def memory_bytes(cgroup: Path = _CGROUP) -> int:
    """Memory that this process may use: the machine's, or the limit of its control group."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limits = [_text(cgroup / name) for name in ("memory.max", "memory.high", "memory/memory.limit_in_bytes")]
    return min([total, *(int(limit) for limit in limits if limit.isdigit() and int(limit))])


def _text(path: Path) -> str:
    """The text of a system file; empty if it does not exist."""
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError:
        return ""
