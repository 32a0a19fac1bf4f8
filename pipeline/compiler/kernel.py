"""The decorator of all kernels. numba is imported when the first kernel runs, not before."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, overload


class Kernel:
    """A function that numba compiles when it is first called.

    Kernels call each other by name, as plain functions do; numba sees the kernel behind each name.

    Parameters
    ----------
    function : callable
        What is to be compiled.
    options : mapping
        Options of `numba.njit` beyond the common ones.
    """

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self.options = dict(options)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Numba's own object; the function itself where numba is switched off."""
        import numba

        return numba.njit(cache=True, nogil=True, **self.options)(self.py_func)

    def __call__(self, *arguments: Any) -> Any:
        """The function's value."""
        return self.dispatcher(*arguments)

    @property
    def _numba_type_(self) -> Any:
        """What numba takes for the type of this kernel in another one."""
        return self.dispatcher._numba_type_

    def __reduce__(self) -> str:
        """Kernels travel by name."""
        return self.py_func.__qualname__


Function = TypeVar("Function", bound=Callable[..., Any])


@overload
def kernel(function: Function) -> Function: ...


@overload
def kernel(*, fastmath: set[str]) -> Callable[[Function], Function]: ...


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Have numba compile a function; used bare, or with `fastmath`.

    Parameters
    ----------
    function : callable
        It calls nothing but other kernels and what numba knows.
    fastmath : set of str
        Liberties with floating point that LLVM may take.
    """
    if function is None:
        return lambda decorated: Kernel(decorated, options)
    return Kernel(function, options)
