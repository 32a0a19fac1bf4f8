"""Compiling a kernel that no file has: see `pipeline.compiler.backend`. Runs with compiled kernels never load this."""

from __future__ import annotations

import functools
from typing import Any

import numba
from numba.core import cgutils, compiler, event, registry, serialize
from numba.core.runtime import rtsys
from numba.core.targetconfig import ConfigStack
from numba.core.typing import templates

from pipeline.compiler import storing
from pipeline.compiler.backend import DEPTH, KernelDispatcher, no_code, set_environments
from pipeline.compiler.frame_room import with_room_for_frames
from pipeline.compiler.store import Stored

types: Any = numba.types
_ENVIRONMENTS = "_ZN08NumbaEnv"


def _prepare() -> None:
    """Set numba up before its first compilation."""
    context = registry.cpu_target.target_context
    make_executable = context.get_executable

    def get_executable(library: Any, fndesc: Any, environment: Any) -> Any:
        """The C function of a kernel; `no_code` for one without a wrapper."""
        flags = ConfigStack.top_or_none()
        if flags is not None and flags.no_cpython_wrapper:
            return no_code()
        made = make_executable(library, fndesc, environment)
        set_environments(library, *_environments(library))
        return made

    dynamic_address = context.add_dynamic_addr

    def add_dynamic_addr(builder: Any, address: int, info: str) -> Any:
        """Put an address of this process into the code, which then cannot be stored; null for a called kernel."""
        if info == "Kernel":
            return cgutils.voidptr_t(None)
        return dynamic_address(builder, address, info)

    build = templates._OverloadFunctionTemplate._get_impl

    def get_implementation(template: Any, args: Any, kws: Any) -> Any:
        """Find a helper of numba: the same one for callers with and without a wrapper."""
        flags = ConfigStack.top_or_none()
        if flags is None or flags.no_cpython_wrapper:
            return build(template, args, kws)
        plain = flags.copy()
        plain.no_cpython_wrapper = True
        with ConfigStack().enter(plain):
            return build(template, args, kws)

    templates._OverloadFunctionTemplate._get_impl = get_implementation
    context.get_executable = get_executable
    context.add_dynamic_addr = add_dynamic_addr
    context.create_cfunc_wrapper = _no_wrapper


def _no_wrapper(*of_function: Any) -> None:
    """Make no wrapper for C, which calls no kernel."""


def _environments(library: Any) -> tuple[tuple[Any, ...], tuple[str, ...]]:
    """The environments that a library's code refers to: those with constants, and the names of the others.

    An environment refers to its module, which loading imports; numba's own modules take a tenth of a second. Most
    environments are empty, and one empty environment serves for all.
    """
    names = [v.name for v in library._final_module.global_variables if v.name.startswith(_ENVIRONMENTS)]
    found = {name: compiler.lookup_environment(name) for name in names}
    full = {name: one for name, one in found.items() if one is not None and one.consts}
    return tuple(full.values()), tuple(name for name in names if name not in full)


def _without_wrappers(flags: Any) -> Any:
    """Numba's flags for a kernel: only one that Python calls gets a wrapper."""
    flags.no_cpython_wrapper = DEPTH.value > 1
    return flags


def common_type(kind: Any) -> Any:
    """The common type of similar ones: int64 for signed integers, no literals."""
    kind = types.unliteral(kind)
    return types.int64 if isinstance(kind, types.Integer) and kind.signed else kind


def compile_kernel(own: KernelDispatcher, name: str, arguments: tuple[Any, ...], *, for_python: bool) -> None:
    """Compile a kernel for a signature and store it, unless another process has just done so."""
    with storing.claimed(name):
        if not own.load(name, arguments, for_python=for_python):
            _compile(own, name, arguments, for_python=for_python)


def _compile(own: KernelDispatcher, name: str, arguments: tuple[Any, ...], *, for_python: bool) -> None:
    """Compile the kernel and store it."""
    known = own.overloads.get(arguments)
    if known is not None:
        result = _with_wrapper(own, known)
    else:
        storing.warn_of_misfits(own.prefix)
        compiling = functools.partial(_compiled, own, arguments)
        result = compiling() if DEPTH.value else with_room_for_frames(compiling)
    own.take(arguments, result, runnable=for_python)
    library, fndesc = result.library, result.fndesc
    library._ensure_finalized()
    environments = _environments(library)
    if library.has_dynamic_globals or not all(one.can_cache() for one in environments[0]):
        return
    bitcode = library._get_module_for_linking().as_bitcode()
    fndesc.typemap = fndesc.calltypes = None
    facts = (
        fndesc,
        result.environment,
        result.signature,
        result.reload_init,
        environments,
        (fndesc.llvm_func_name, fndesc.llvm_cpython_wrapper_name),
    )
    code = library._get_compiled_object() if for_python else b""
    storing.save(name, own.fingerprint(), Stored(facts=serialize.dumps(facts), machine_code=code, bitcode=bitcode))


def _compiled(own: KernelDispatcher, arguments: tuple[Any, ...]) -> Any:
    """Numba's result for the kernel; compiles its callees, too."""
    DEPTH.value += 1
    try:
        details = {"dispatcher": own, "args": arguments, "return_type": None}
        with event.trigger_event("numba:compile", data=details):
            own._compiler._customize_flags = _without_wrappers
            return own._compiler.compile(arguments, None)
    finally:
        DEPTH.value -= 1


def _with_wrapper(own: KernelDispatcher, known: Any) -> Any:
    """Make a kernel that only kernels called so far callable from Python."""
    context = own.targetctx.subtarget(environment=known.environment, fndesc=known.fndesc, enable_nrt=True)
    library = context.codegen().create_library(known.fndesc.qualname)
    library.enable_object_caching()
    context.create_cpython_wrapper(library, known.fndesc, known.environment, None, release_gil=True)
    library.add_linking_library(known.library)
    # the wrapper releases arrays: without the code for that it runs only where something else brought it
    library.add_linking_library(rtsys.library)
    entry = context.get_executable(library, known.fndesc, known.environment)
    # numba finds a compiled function by its C function, which has changed
    own.targetctx.insert_user_function(entry, known.fndesc, [library])
    return known._replace(library=library, entry_point=entry)


_prepare()
