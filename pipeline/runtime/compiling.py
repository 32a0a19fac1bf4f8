"""Kernels that a job lacks here, and their compilation before it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.runtime.cluster.compiled_kernels import kernels_are_compiled
from pipeline.runtime.monitoring.measurement import cores
from pipeline.runtime.monitoring.progress import Listener, never

if TYPE_CHECKING:
    from pipeline.compiler.warm_up import Listed

RECONSTRUCT = ("reconstruct",)
"""Group of kernels of a run by the default method."""
_METHOD = "arrangement"
"""The default method."""


def kernel_groups(*, method: str | None = None, points: bool = False, terrain: str | None = None) -> tuple[str, ...]:
    """Groups of kernels that a run calls: other methods have their own, and so have points and terrain."""
    others = {"compare": method not in {None, _METHOD}, "classify": points, "terrain": terrain not in {None, "none"}}
    return (*RECONSTRUCT, *(name for name, needed in others.items() if needed))


def missing_kernels(groups: Collection[str] = RECONSTRUCT) -> list[Listed]:
    """Kernels of some groups that are to be compiled here.

    A few kernels stand for each group, since looking at all would import most of the science. If one of them is not
    compiled all of its group count: loading what is there takes no time.
    """
    if lacking := [name for name in groups if not _is_compiled(name)]:
        from pipeline.compiler.warm_up import listed

        return [one for name in lacking for one in listed([name])]
    return []


def _is_compiled(group: str) -> bool:
    """Whether the kernels of a group are compiled: of most runs by their own, else the first and the last to be."""
    if group in RECONSTRUCT:
        return kernels_are_compiled()
    from pipeline.compiler.kernel import kernel_named
    from pipeline.compiler.warm_up import listed

    kernels = listed([group])
    return all(kernel_named(one.kernel).is_compiled for one in (kernels[0], kernels[-1]))


def compiling_s(groups: Collection[str] = RECONSTRUCT) -> float:
    """About how many seconds a job of some groups of kernels first compiles; 0 if all are compiled."""
    from pipeline.compiler.warm_up import about_s

    return about_s(missing_kernels(groups), cores())


def compile_for(
    on_event: Listener,
    groups: Collection[str],
    inputs: Sequence[str],
    files: Iterable[str | None] = (),
    *,
    scheduler: str | None,
) -> None:
    """As `compile_first`, unless workers of a scheduler compile; but first look for the files of a job.

    Raises InputError for inputs or other files of this machine that are not there: this must not take minutes.
    """
    if scheduler is not None or not missing_kernels(groups):
        return
    from pipeline.io import find_inputs, is_url
    from pipeline.io.formats import first_bytes

    find_inputs(inputs)
    for file in files:
        if file is not None and not is_url(file):
            first_bytes(Path(file))
    compile_first(on_event, groups)


def compile_first(
    on_event: Listener, groups: Collection[str] = RECONSTRUCT, *, cancelled: Callable[[], bool] = never
) -> None:
    """Compile what some groups of kernels lack; nothing is sent if all is compiled."""
    if kernels := missing_kernels(groups):
        from pipeline.runtime.compile_listed import compile_listed

        compile_listed(on_event, kernels, cancelled)
