"""The processor that kernels are compiled for."""

from __future__ import annotations

import os

GENERIC = "generic"
"""Any processor of this architecture. Such code is as fast as code for the exact processor, gives the same last bits on
all of them, and its files can be copied from machine to machine."""


def processor() -> str:
    """LLVM's name of the processor: `NUMBA_CPU_NAME`, or `GENERIC`."""
    return os.environ.get("NUMBA_CPU_NAME") or GENERIC
