"""The processor that kernels are compiled for."""

from __future__ import annotations

import os

_BASELINES = {"x86_64": "x86-64-v2"}
"""What numpy's own packages require, too: SSE4.2, all such processors since 2009."""
PORTABLE = _BASELINES.get(os.uname().machine, "generic")
"""Any processor of this architecture that numpy runs on. Such code gives the same last bits on all of them, and its
files can be copied from machine to machine. Code for the exact processor is hardly faster."""


def processor() -> str:
    """LLVM's name of the processor: `NUMBA_CPU_NAME`, or `PORTABLE`."""
    return os.environ.get("NUMBA_CPU_NAME") or PORTABLE
