"""Kernels compiled ahead of their first call, in several processes.

`kernels.json` lists the kernels and signatures that Python calls, grouped by command; their callees are compiled with
them. A process waits for a kernel that another one is compiling (`storing.claimed`), so none is compiled twice. A
kernel that the list lacks is compiled at its first call.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from pipeline.compiler import store, storing
from pipeline.compiler.kernel import Kernel, is_off, kernel_named
from pipeline.errors import RunError

LIST = Path(__file__).with_name("kernels.json")
"""Written by `make kernels`."""
_START_S, _KILOBYTE_S = 2.0, 0.006
"""Seconds until the processes work, and processor seconds per kilobyte of code: docs/results/start_up.md."""
_KNOWN_SHARE = 0.3
"""Share of the work from which on it shows its own pace: before, the heaviest kernels are under way."""
_TICK_S, _SAY_S = 0.2, 2.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Listed:
    """A kernel that Python calls, with one signature."""

    kernel: str
    """Its name, `module:function`."""
    arguments: list[Any]
    """Types of its arguments, as `pipeline.compiler.signatures` writes them."""
    weight: int
    """Size of its code in kilobytes, a measure of its compile time."""


def groups() -> list[str]:
    """Keys of the list of kernels."""
    return list(json.loads(LIST.read_text(encoding="utf-8")))


def listed(groups: Iterable[str] | None = None) -> list[Listed]:
    """The kernels of some groups (default all), the heaviest first, each once; raises KeyError for an unknown group."""
    found = json.loads(LIST.read_text(encoding="utf-8"))
    kernels = [Listed(kernel=k, arguments=a, weight=w) for name in groups or found for k, a, w in found[name]]
    return sorted(kernels, key=lambda one: -one.weight)


def about_s(kernels: Iterable[Listed], processes: int) -> float:
    """About how many seconds of the clock so many processes need to compile kernels; 0 without any."""
    weight = sum(one.weight for one in kernels)
    return _START_S + _KILOBYTE_S * weight / max(1, processes) if weight else 0.0


def compile_kernels(
    kernels: Iterable[Listed],
    processes: int,
    on_progress: Callable[[int, int, float], None] | None = None,
    *,
    cancelled: Callable[[], bool] = lambda: False,
    start: Callable[[], None] | None = None,
) -> int:
    """Compile those `listed` kernels that are not compiled yet; returns how many were compiled or loaded.

    `on_progress` gets the numbers of finished and of all kernels, and an estimate of the seconds left: whenever one is
    finished, and every two seconds, since the heaviest take long and come first. `start` is called first in each
    process. Once `cancelled` returns True nothing more is begun, and what runs is not waited for.
    """
    from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait  # most commands compile nothing
    from multiprocessing import get_context

    waiting = list(kernels)
    whole = sum(one.weight for one in waiting) or 1
    about, began = about_s(waiting, processes), time.perf_counter()
    done = weight = 0
    said = began
    pool = ProcessPoolExecutor(min(processes, len(waiting)) or 1, mp_context=get_context("spawn"), initializer=start)
    pending = {pool.submit(_compile, one) for one in waiting}
    try:
        while pending and not cancelled():
            ended, pending = wait(pending, _TICK_S, FIRST_COMPLETED)
            done, weight = done + len(ended), weight + sum(future.result() for future in ended)
            now = time.perf_counter()
            if on_progress is not None and (ended or now - said >= _SAY_S):
                share, said = weight / whole, now
                left_s = (1.0 - share) * max(about, (now - began) / max(share, _KNOWN_SHARE))
                on_progress(done, len(waiting), left_s)
    finally:
        pool.shutdown(wait=not pending, cancel_futures=True)
    return done


def _compile(one: Listed) -> int:
    """Compile or load a kernel in this process; returns its weight."""
    from numba.core.errors import NumbaError

    from pipeline.compiler.signatures import from_json

    kernel = kernel_named(one.kernel)
    if not is_off():
        # types of an old list may not fit: such a kernel is compiled when it is called, which takes longer
        with contextlib.suppress(NumbaError, TypeError):
            kernel.dispatcher.compile(tuple(from_json(kind) for kind in one.arguments))
    return one.weight


def ship(folder: Path) -> int:
    """Copy all compiled kernels of this version to a folder for a package; returns the number of files.

    Raises RunError if no kernel is compiled: numba is unknown or switched off; or if the folder cannot be written.
    """

    def is_current(name: str, fingerprint: bytes) -> bool:
        try:
            kernel = kernel_named(":".join(name.rsplit(".", 1)))
        except (ImportError, AttributeError):
            return False
        return isinstance(kernel, Kernel) and kernel.fingerprint == fingerprint

    try:
        shipped = storing.ship(folder, is_current)
    except OSError as error:
        raise RunError(f"{folder} cannot be written: {error.strerror or error}. Give another --into") from error
    if not shipped:
        raise RunError(
            f"{store.folder_of_kernels()} has no compiled kernel: warm up with the numba of the locks and without "
            "GABLEWORK_PLAIN_NUMBA and NUMBA_DISABLE_JIT"
        )
    return shipped


def write_list(groups: dict[str, list[Listed]], path: Path = LIST) -> None:
    """Write the list, one kernel per line to make changes easy to see."""
    parts = []
    for name, kernels in groups.items():
        rows = sorted(json.dumps((one.kernel, one.arguments, one.weight)) for one in kernels)
        parts.append(f"{json.dumps(name)}: [\n" + ",\n".join(rows) + "\n]")
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")
