"""The processor that kernels are compiled for."""

from __future__ import annotations

import os

GENERIC = "generic"
"""Any of this machine's architecture. Such code is as fast as that for the very processor, gives the same last bits on
all of them, and its files can be carried from machine to machine."""


def processor() -> str:
    """LLVM's name of the processor, `GENERIC` unless `NUMBA_CPU_NAME` says otherwise."""
    return os.environ.get("NUMBA_CPU_NAME") or GENERIC
