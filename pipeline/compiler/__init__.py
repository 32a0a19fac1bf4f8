"""Kernels: functions that numba compiles to machine code."""

from pipeline.compiler.kernel import Kernel, kernel

__all__ = ["Kernel", "kernel"]
