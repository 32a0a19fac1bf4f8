"""Kernels compiled in numba's own way, where its version is unknown or `GABLEWORK_PLAIN_NUMBA` is set."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numba


def plain_dispatcher(
    function: Callable[..., Any],
    options: Mapping[str, Any],
    fingerprint: Callable[[], bytes],
    known: tuple[str, ...],
) -> Any:
    """Numba's object for a kernel's plain function; warns once if this version is not one of those `known`."""
    if known:
        _warn_unknown(known)
    made = numba.njit(cache=True, nogil=True, **options)(function)
    # instead of a stamp of the kernel's own file: an edited callee counts, too
    made._cache._cache_file._source_stamp = fingerprint().hex()
    return made


@functools.cache
def _warn_unknown(known: tuple[str, ...]) -> None:
    """Warn once that everything is slower to compile."""
    warnings.warn(
        f"gablework does not know numba {numba.__version__} (it knows {', '.join(known)}x): kernels are compiled in "
        "numba's own way, which takes three times as long, and none that were compiled ahead are loaded",
        RuntimeWarning,
        stacklevel=3,
    )
