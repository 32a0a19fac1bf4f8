"""Kernels compiled before a job that needs them, in words: a first job that compiled silently would seem to hang."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from pipeline.runtime.monitoring.measurement import cores
from pipeline.runtime.monitoring.progress import Event, Listener

if TYPE_CHECKING:
    from pipeline.compiler.warm_up import Listed

STAGE = "compile"
"""The stage of these events."""


def compile_listed(on_event: Listener, kernels: Sequence[Listed], cancelled: Callable[[], bool]) -> None:
    """Compile kernels on all cores, and send what is compiled and how long it takes.

    Where kernels cannot be stored or a process dies, a warning is sent: each process then compiles what it calls.
    """
    from pipeline.compiler import store, storing
    from pipeline.compiler.backend import is_known  # loads numba
    from pipeline.compiler.warm_up import about_s, compile_kernels
    from pipeline.runtime.isolation.child_main import end_with_parent

    if not is_known():  # plain numba stores what it compiles by itself, as it is called
        return
    seconds = about_s(kernels, cores())
    if not storing.can_save():
        message = (
            f"compiled kernels cannot be stored in {store.folder_of_kernels()}: each process compiles its own, "
            f"about {seconds:.0f} s. Set NUMBA_CACHE_DIR to a folder"
        )
        on_event(Event(kind="warning", stage=STAGE, message=message))
        return

    def on_progress(done: int, total: int, left_s: float) -> None:
        left = f"compiling, once, about {left_s:.0f} s left" if done < total else ""
        on_event(Event(kind="progress", stage=STAGE, done=done, total=total, message=left))

    message = f"compiling, once, about {seconds:.0f} s"
    on_event(Event(kind="stage", stage=STAGE, total=len(kernels), message=message))
    start = functools.partial(end_with_parent, os.getpid())
    from concurrent.futures.process import BrokenProcessPool

    try:
        compile_kernels(kernels, cores(), on_progress, cancelled=cancelled, start=start)
    except (BrokenProcessPool, OSError) as error:
        message = f"kernels were not compiled ahead ({error}): they are compiled as they are called, which takes longer"
        on_event(Event(kind="warning", stage=STAGE, message=message))
