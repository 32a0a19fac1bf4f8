"""The decorator of all kernels. numba is imported when the first kernel runs, not before."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import operator
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, overload

from pipeline.compiler import store
from pipeline.compiler.fingerprint import Kerneled, fingerprint
from pipeline.compiler.processor import processor


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
    def fingerprint(self) -> bytes:
        """A hash of all that the machine code depends on but for signature and processor, 32 bytes."""
        return hashlib.sha256(_versions() + fingerprint(self.py_func, self.options, _source_of)).digest()

    @property
    def prefix(self) -> str:
        """With which the names of its files begin."""
        place = f"{sys.implementation.cache_tag}-{os.uname().machine}-{processor()}"
        return f"{self.py_func.__module__}.{self.py_func.__qualname__}.{place}-"

    @property
    def is_compiled(self) -> bool:
        """Whether there is a file of it, of whatever signature; numba is not asked."""
        return is_off() or store.is_kept(self.prefix, self.fingerprint)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Numba's own object; the function itself where numba is switched off."""
        from pipeline.compiler.backend import dispatcher_of

        return dispatcher_of(self.py_func, self.options, self.prefix, lambda: self.fingerprint)

    # numba's object is called without a frame of Python between: buildings call kernels by the hundred
    __call__ = property(operator.attrgetter("dispatcher"))

    @property
    def targetoptions(self) -> Mapping[str, Any]:
        """Where numba looks for `inline`."""
        return self.options

    @property
    def _numba_type_(self) -> Any:
        """What numba takes for the type of this kernel in another one."""
        return self.dispatcher._numba_type_

    def __reduce__(self) -> str:
        """Kernels travel by name."""
        return self.py_func.__qualname__


def is_off() -> bool:
    """Whether nothing is to be compiled, as numba reads `NUMBA_DISABLE_JIT`."""
    return os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")


@functools.cache
def _versions() -> bytes:
    """What tells versions of numba and llvmlite apart, without importing them."""
    told = b""
    for name in ("numba", "llvmlite"):
        found = importlib.util.find_spec(name)
        assert found is not None
        assert found.origin is not None
        told += Path(found.origin).with_name("_version.py").read_bytes()
    return told


def _source_of(value: Any) -> Kerneled | None:
    return (value.py_func, value.options) if isinstance(value, Kernel) else None


Function = TypeVar("Function", bound=Callable[..., Any])


@overload
def kernel(function: Function) -> Function: ...


@overload
def kernel(*, fastmath: set[str]) -> Callable[[Function], Function]: ...


@overload
def kernel(*, inline: Literal["always"]) -> Callable[[Function], Function]: ...


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Have numba compile a function; used bare, or with one option.

    Parameters
    ----------
    function : callable
        It calls nothing but other kernels and what numba knows.
    fastmath : set of str
        Liberties with floating point that LLVM may take.
    inline : {'always'}
        Its lines become lines of the kernels that call it, and it is not compiled itself: for a few lines with one or
        two callers. LLVM makes the same of either, but a kernel costs a tenth of a second to compile.
    """
    if function is None:
        return lambda decorated: Kernel(decorated, options)
    return Kernel(function, options)
