"""How numba loads our kernels: this module and `compilation` alone use numba's internals.

A kernel that only other kernels call needs no machine code of its own: its callers link its code and optimise it
together with theirs. numba nevertheless makes machine code and wrappers for each kernel, and for its own helpers
(`np.argsort` and the like). Here code is optimised and generated only for kernels that Python calls. Compiled kernels
are stored in our own files (`pipeline.compiler.store`) under fingerprints that cover their callees. What compiles them
(`pipeline.compiler.compilation`) is loaded for the first one that no file has.

The module is written for the versions in `KNOWN`. With any other numba, or with `GABLEWORK_PLAIN_NUMBA` set, kernels
are plain `numba.njit(cache=True)`, whose files carry the same fingerprints: slower to compile, with equal results.
"""

from __future__ import annotations

import ctypes
import hashlib
import io
import os
import pickle
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core import codegen, compiler, config, registry, sigutils
from numba.core.compiler_lock import global_compiler_lock
from numba.core.environment import Environment, _rebuild_env
from numba.core.runtime import _nrt_python

from pipeline.compiler import store
from pipeline.compiler.store import PORTABLE, Stored, processor
from pipeline.registry import loaded

types: Any = numba.types
KNOWN = ("0.68.",)
"""Versions of numba whose internals this module knows."""
COMMON_OPTIONS = {"nopython": True, "nogil": True}
"""Options of all kernels."""
# set before numba makes its code generator, which reads them once
config.CPU_NAME = processor()
if config.CPU_NAME == PORTABLE:
    config.CPU_FEATURES = ""
_PLAIN = "GABLEWORK_PLAIN_NUMBA"


def is_known() -> bool:
    """Whether this module compiles kernels, not plain numba."""
    return numba.__version__.startswith(KNOWN) and not os.environ.get(_PLAIN)


def dispatcher_of(
    function: Callable[..., Any], options: Mapping[str, Any], prefix: str, fingerprint: Callable[[], bytes]
) -> Any:
    """Numba's object for a kernel's plain function; the function itself if numba is switched off (`NUMBA_DISABLE_JIT`).

    The names of the kernel's files start with `prefix`.

    Parameters
    ----------
    options : mapping
        Options beyond the common ones.
    fingerprint : callable
        Returns the kernel's fingerprint; called when a file is looked up.
    """
    if config.DISABLE_JIT:
        return function
    if not is_known():
        from pipeline.compiler.plain_numba import plain_dispatcher

        return plain_dispatcher(function, options, fingerprint, () if os.environ.get(_PLAIN) else KNOWN)
    _prepare()
    return KernelDispatcher(function, {**COMMON_OPTIONS, **options}, prefix, fingerprint)


# --------------------------------------------------------------------------------------------------- the processor


def _prepare() -> None:
    """Set numba up before its first kernel: code for every processor of this kind, and our code libraries."""
    context = registry.cpu_target.target_context
    if getattr(context, "gablework", False):
        return
    context.gablework = True
    context.codegen()._library_class = Library
    for name, address in _nrt_python.c_helpers.items():
        llvm.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


_NOTHING = Environment({})
"""Used for every empty environment."""


def no_code() -> Any:
    """A placeholder where numba wants a C function, new each time, since numba identifies functions by it.

    Calling it raises: it takes no arguments and the dictionary is empty.
    """
    return {}.popitem


def set_environments(library: Any, full: Iterable[Any], empty: Iterable[str]) -> None:
    """Point a library's loaded code to its environments.

    All code of a process shares one pointer per name. A kernel called by kernels has no constants; made callable from
    Python it has some under the same name, so an empty environment never replaces another one.
    """
    for one in full:
        library.codegen.set_env(one.env_name, one)
    for name in empty:
        address = library.codegen._engine.get_global_value_address(name)
        if not ctypes.c_void_p.from_address(address).value:
            library.codegen.set_env(name, _NOTHING)


def _environment_with(module: str, constants: list[Any], name: str) -> Any:
    """The environment of a name, with the constants of a file if it has none yet.

    numba takes an environment that this process knows as it is. It may come from a file that only kernels called, which
    another process has since made callable from Python; without the constants a call would end in a SystemError.
    """
    found = _rebuild_env(module, constants, name)
    if not found.consts:
        found.consts[:] = constants
    return found


class _FactsReader(pickle.Unpickler):
    """Reads the facts of a stored kernel."""

    def find_class(self, module: str, name: str) -> Any:
        """The object of a name; ours where numba makes environments."""
        if (module, name) == (_rebuild_env.__module__, _rebuild_env.__name__):
            return _environment_with
        return super().find_class(module, name)


class Library(codegen.JITCodeLibrary):
    """Code that is only linked until its address is needed."""

    _has_code = False
    _shared_module: Any
    _bitcode: bytes | None = None

    def finalize(self) -> None:
        """Link the code that it calls, without optimising it."""
        self._raise_if_finalized()
        seen = set()
        for library in self._linking_libraries:
            if library not in seen:
                seen.add(library)
                self._reload_init.update(library._reload_init)
                self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """The address of a function; generates its code if necessary."""
        self._ensure_finalized()
        if not self._has_code:
            self._has_code = True
            self._optimize_final_module()
            self._final_module.verify()
            # collected again, without what the optimisation removed
            self._dynamic_globals.clear()
            self._finalize_final_module()
        address: int = super().get_pointer_to_function(name)
        return address

    def load(self, stored: Stored, defined: tuple[str, ...], *, runnable: bool) -> None:
        """Take the code of a file; the machine code only if it is to run."""
        self._bitcode = stored.bitcode
        if runnable:
            self._has_code = True
            self.enable_object_caching()
            self._set_compiled_object(stored.machine_code)
            self._finalize_final_module()
            self.codegen._engine._defined_symbols.update(defined)
        else:
            self._finalized = True

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None and self._bitcode is not None:
            self._shared_module = llvm.parse_bitcode(self._bitcode)
            self._bitcode = None
        return super()._get_module_for_linking()


# ------------------------------------------------------------------------------------------------- the dispatcher


class _Depth(threading.local):
    """Nesting depth of the kernels that this thread is compiling."""

    value = 0


DEPTH = _Depth()


def _fields_in(kinds: Iterable[Any]) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """The named tuples among types, which numba identifies only by the types of their fields."""
    for kind in kinds:
        if isinstance(kind, types.BaseNamedTuple):
            one = kind.instance_class
            yield one.__module__, one.__qualname__, kind.fields
        if isinstance(kind, types.BaseTuple):
            yield from _fields_in(kind)


class KernelDispatcher(registry.CPUDispatcher):
    """numba's dispatcher with our files."""

    def __init__(
        self, function: Callable[..., Any], options: Mapping[str, Any], prefix: str, fingerprint: Callable[[], bytes]
    ) -> None:
        super().__init__(function, targetoptions=dict(options))
        self.prefix = prefix
        self.fingerprint = fingerprint
        self._callable: set[tuple[Any, ...]] = set()

    def _compilation_chain_init_hook(self) -> None:
        """Look for no extensions of numba; we use none."""

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """How another kernel calls this one: with one type per kind of number, so it is compiled once."""
        common = loaded("pipeline.compiler.compilation:common_type")
        return super().get_call_template(tuple(map(common, args)), {name: common(kind) for name, kind in kws.items()})

    def compile(self, sig: Any) -> Any:
        """Load or compile the kernel for a signature; returns its C function if Python calls it."""
        arguments, _ = sigutils.normalize_signature(sig)
        with global_compiler_lock, self._compiling_counter:
            for_python = DEPTH.value == 0
            if arguments in self.overloads and (arguments in self._callable or not for_python):
                return self.overloads[arguments].entry_point
            name = self.prefix + self._suffix(arguments)
            if not self.load(name, arguments, for_python=for_python):
                compile_kernel = loaded("pipeline.compiler.compilation:compile_kernel")
                compile_kernel(self, name, arguments, for_python=for_python)
            return self.overloads[arguments].entry_point

    @staticmethod
    def _suffix(arguments: tuple[Any, ...]) -> str:
        """Distinguishes the files of one kernel, by signature and processor."""
        processor = registry.cpu_target.target_context.codegen().magic_tuple()
        facts = repr((str(arguments), [*_fields_in(arguments)], processor))
        return hashlib.sha256(facts.encode()).hexdigest()[:16]

    def load(self, name: str, arguments: tuple[Any, ...], *, for_python: bool) -> bool:
        """Load the kernel if a suitable file of it exists.

        For another kernel only its bitcode: while that one is compiled, numba makes no function that Python can call.
        """
        stored = store.load(name, self.fingerprint(), runnable=for_python)
        if stored is None:
            return False
        facts = _FactsReader(io.BytesIO(stored.facts)).load()
        fndesc, environment, signature, reload_init, environments, defined = facts
        for initialise in reload_init:
            initialise()
        if not for_python:
            self.targetctx.refresh()
        library = self.targetctx.codegen().create_library(fndesc.qualname)
        library.load(stored, defined, runnable=for_python)
        entry = self.targetctx.get_executable(library, fndesc, environment) if for_python else no_code()
        if for_python:
            set_environments(library, *environments)
        self.take(
            arguments,
            compiler.compile_result(
                typing_context=self.typingctx,
                target_context=self.targetctx,
                entry_point=entry,
                library=library,
                fndesc=fndesc,
                environment=environment,
                signature=signature,
                objectmode=False,
                lifted=(),
                reload_init=reload_init,
                referenced_envs=environments[0],
            ),
            runnable=for_python,
        )
        self.targetctx.insert_user_function(entry, fndesc, [library])
        return True

    def take(self, arguments: tuple[Any, ...], result: Any, *, runnable: bool) -> None:
        """Know a kernel for a signature from now on."""
        self.overloads[arguments] = result
        if runnable:
            self._callable.add(arguments)
            self._insert([argument._code for argument in arguments], result.entry_point, False)
