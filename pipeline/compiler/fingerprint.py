"""The fingerprint of a kernel: a hash of everything that its machine code depends on.

It covers the kernel's bytecode and constants, the values of the globals that it names, and the same of every kernel
that it calls, directly or not. Comments, docstrings, blank lines and edits elsewhere in a file do not change it; an
edit of a callee in another file does. numba itself looks only at the kernel's own file.
"""

from __future__ import annotations

import enum
import hashlib
import inspect
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

_PLAIN = (int, float, complex, str, bytes, bool, type(None), np.generic, np.dtype)


def fingerprint(function: Callable[..., Any], options: Mapping[str, Any], source_of: SourceOf) -> bytes:
    """The fingerprint of a kernel's plain function and its options, 32 bytes.

    It is equal for equal code on every machine with the same minor version of Python, whose bytecode it hashes.
    `source_of` returns function and options of a kernel, and None for any other value.
    """
    found: dict[str, bytes] = {}
    waiting: list[Kerneled] = [(function, options)]
    while waiting:
        one, with_options = waiting.pop()
        name = f"{one.__module__}.{one.__qualname__}"
        if name not in found:
            if one not in _KNOWN:
                own = _Own(source_of)
                own.add(repr(sorted(with_options.items())), *_of_function(one, own))
                _KNOWN[one] = (own.digest(), tuple(own.calls))
            found[name], calls = _KNOWN[one]
            waiting.extend(calls)
    whole = hashlib.sha256()
    for name in sorted(found):
        whole.update(name.encode() + b"\0" + found[name])
    return whole.digest()


Kerneled = tuple[Callable[..., Any], Mapping[str, Any]]
SourceOf = Callable[[Any], Kerneled | None]


_KNOWN: dict[Callable[..., Any], tuple[bytes, tuple[Kerneled, ...]]] = {}
"""Hash of the own code and callees of each function: many kernels share callees."""


class _Own:
    """The hash of one kernel's own code, and the kernels that it names."""

    def __init__(self, source_of: SourceOf) -> None:
        self._hash = hashlib.sha256()
        self._source_of = source_of
        self.calls: list[Kerneled] = []

    def add(self, *texts: str) -> None:
        for text in texts:
            self._hash.update(text.encode() + b"\0")

    def digest(self) -> bytes:
        return self._hash.digest()

    def value(self, value: Any) -> str:
        """A text that changes whenever the value may compile to different code."""
        kernel = self._source_of(value)
        if kernel is not None:
            self.calls.append(kernel)
            return f"kernel {kernel[0].__module__}.{kernel[0].__qualname__}"
        if isinstance(value, enum.Enum):
            return f"{type(value).__qualname__}.{value.name}={value.value!r}"
        if isinstance(value, _PLAIN):
            return f"{type(value).__name__} {value!r}"
        if value is Ellipsis:
            return "..."
        if isinstance(value, slice):
            return f"slice({self.value((value.start, value.stop, value.step))})"
        if isinstance(value, tuple | frozenset):
            items = sorted(map(repr, value)) if isinstance(value, frozenset) else map(self.value, value)
            return f"{type(value).__qualname__}({', '.join(items)})"
        if isinstance(value, np.ndarray):
            return f"array {value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
        if isinstance(value, types.ModuleType):
            return f"module {value.__name__}"
        if isinstance(value, enum.EnumMeta):
            members: dict[str, Any] = {name: value[name].value for name in value.__members__}
            return f"enum {value.__module__}.{value.__qualname__} {members!r}"
        if isinstance(value, type):
            fields = (getattr(value, "_fields", ()), getattr(value, "_field_defaults", {}))
            return f"class {value.__module__}.{value.__qualname__} {fields!r}"
        if inspect.isfunction(value):
            return "\0".join(_of_function(value, self))
        if callable(value):
            return f"callable {getattr(value, '__module__', '')}.{getattr(value, '__qualname__', value)!s}"
        return f"{type(value).__qualname__} of {_file_hash(value)}"


def _of_function(function: Callable[..., Any], own: _Own) -> Iterator[str]:
    """The texts to hash for a function: code, defaults, closure and the globals that it names."""
    code = function.__code__
    names: set[str] = set()
    yield from _of_code(code, own, names, documented=function.__doc__)
    for value in (*(function.__defaults__ or ()), *(cell.cell_contents for cell in function.__closure__ or ())):
        yield own.value(value)
    known = function.__globals__
    for name in sorted(names & known.keys()):
        yield f"{name}={own.value(known[name])}"
        if isinstance(known[name], types.ModuleType) and known[name].__name__.startswith("pipeline"):
            for attribute in sorted(names & vars(known[name]).keys()):
                yield f"{name}.{attribute}={own.value(getattr(known[name], attribute))}"


def _of_code(code: types.CodeType, own: _Own, names: set[str], documented: str | None = None) -> Iterator[str]:
    """The texts to hash for compiled Python: neither its place in the file nor its docstring."""
    names.update(code.co_names)
    yield f"{code.co_code.hex()} {code.co_flags} {code.co_argcount}"
    yield repr((code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars))
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _of_code(constant, own, names)
        elif documented is None or constant != documented:
            yield own.value(constant)


def _file_hash(value: Any) -> str:
    """The hash of the file that defines a value's class, for values of any other kind."""
    return hashlib.sha256(Path(inspect.getfile(type(value))).read_bytes()).hexdigest()
