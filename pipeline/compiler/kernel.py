"""The decorator of all kernels. numba is imported when the first kernel runs, not before."""

from __future__ import annotations

import functools
import hashlib
import importlib
import importlib.util
import operator
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, overload

from pipeline.compiler import store
from pipeline.compiler.fingerprint import Kerneled, fingerprint
from pipeline.compiler.store import processor


class Kernel:
    """A function that numba compiles when it is first called.

    Kernels call each other by name, as plain functions do; numba sees the kernel behind each name.

    Parameters
    ----------
    function : callable
        The function to compile.
    options : mapping
        Options of `numba.njit` beyond the common ones.
    """

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self.options = dict(options)

    @functools.cached_property
    def fingerprint(self) -> bytes:
        """A hash of everything that the machine code depends on except signature and processor, 32 bytes."""
        return hashlib.sha256(_versions() + fingerprint(self.py_func, self.options, _source_of)).digest()

    @property
    def prefix(self) -> str:
        """Start of the names of its files."""
        place = f"{sys.implementation.cache_tag}-{os.uname().machine}-{processor()}"
        return f"{self.py_func.__module__}.{self.py_func.__qualname__}.{place}-"

    @property
    def is_compiled(self) -> bool:
        """Whether a file of it exists, for any signature; does not import numba."""
        return is_off() or store.is_stored(self.prefix, self.fingerprint)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Numba's own object; the function itself if numba is switched off."""
        from pipeline.compiler.backend import dispatcher_of

        return dispatcher_of(self.py_func, self.options, self.prefix, lambda: self.fingerprint)

    # calls numba's object without a Python frame in between: a building makes hundreds of calls
    __call__ = property(operator.attrgetter("dispatcher"))

    @property
    def targetoptions(self) -> Mapping[str, Any]:
        """Options that numba reads for `inline`."""
        return self.options

    @property
    def _numba_type_(self) -> Any:
        """The type that numba gives this kernel inside another one."""
        return self.dispatcher._numba_type_

    def __reduce__(self) -> str:
        """Pickle a kernel by name."""
        return self.py_func.__qualname__


def kernel_named(name: str) -> Kernel:
    """A kernel by its name, `module:function`; raises AttributeError or ModuleNotFoundError if there is none."""
    module, function = name.split(":")
    found: Kernel = getattr(importlib.import_module(module), function)
    return found


def is_off() -> bool:
    """Whether compilation is switched off, as numba reads `NUMBA_DISABLE_JIT`."""
    return os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")


@functools.cache
def _versions() -> bytes:
    """The version files of numba and llvmlite, read without importing the packages."""
    content = b""
    for name in ("numba", "llvmlite"):
        found = importlib.util.find_spec(name)
        assert found is not None
        assert found.origin is not None
        content += Path(found.origin).with_name("_version.py").read_bytes()
    return content


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
    """Let numba compile a function; used bare, or with one option.

    Parameters
    ----------
    function : callable
        Calls only other kernels and functions that numba knows.
    fastmath : set of str
        Liberties with floating point that LLVM may take.
    inline : {'always'}
        Copies its lines into the kernels that call it; it is not compiled itself. For a few lines with one or two
        callers. LLVM makes the same code either way, but a kernel costs a tenth of a second to compile.
    """
    if function is None:
        return lambda decorated: Kernel(decorated, options)
    return Kernel(function, options)
