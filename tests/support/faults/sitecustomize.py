"""Faults on demand for processes under test; the product itself has none.

Put this folder on PYTHONPATH and describe the faults in GABLEWORK_FAULTS, as JSON. Python imports this file in every
process that it starts, also in workers and their children; it imports nothing of the pipeline itself.

```
{
  "crash": ["<building_id>", ...],          SIGSEGV while the building is modelled
  "abort": [...],                           abort(), as an assertion of a C library does
  "exit": [...],                            ends its process with exit code 7
  "endless": [...],                         loops forever in Python
  "endless_native": [...],                  loops forever in C and holds the interpreter's lock
  "eat_memory": [...],                      takes 32 MiB again and again
  "ask_memory": [...],                      asks for 64 TiB at once
  "raise": [...],                           ZeroDivisionError
  "chatter": [...],                         prints 32 MB to standard output, then is modelled
  "crash_gather": [...],                    SIGSEGV while its points are gathered
  "crash_once": {"ids": [...], "folder": "/f"}   SIGSEGV in the first process only, by a mark in the folder
  "pause": {"<stage>": "/folder", ...},     the stage's tasks write /folder/reached-<pid> and wait for /folder/go
  "kill": {"<stage>": "/folder", ...}       the first of the stage's tasks kills its process, by a mark in the folder
  "full": {"<stage>": "/folder", ...}       the disk is full for the stage's tasks while /folder/full exists
  "impatient": 2.0                          time-out of object stores in seconds
}
```

Buildings are named by their ids, as in an undisturbed run of the same input; `"*"` means all. Stages are ingest,
split, reconstruct and publish, and outputs in the service's driver. A stage's task pauses before it does anything.
`PYTHONPATH` must be an absolute path.
`environment()` in `tests/support/faults/asked.py` sets both variables.
"""

import errno
import functools
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

FAULTS: dict[str, Any] = json.loads(os.environ.get("GABLEWORK_FAULTS", "{}"))

STAGES = {
    "pipeline.runtime.stages.ingest": ("ingest_file", "ingest"),
    "pipeline.runtime.stages.cells_stage": ("find_cells", "cells"),
    "pipeline.runtime.stages.ground_stage": ("draw_ground", "ground"),
    "pipeline.runtime.stages.split": ("split_window", "split"),
    "pipeline.runtime.stages.reconstruct": ("model_batch", "reconstruct"),
    "pipeline.runtime.stages.publish": ("publish_tile", "publish"),
    "service.outputs.assemble": ("write_outputs", "outputs"),
}
"""The function of each stage's tasks, by its module."""

BUILDINGS = "pipeline.recipe"
"""The module that models one building."""

GATHERING = ("pipeline.runtime.stages.model_batch", "pipeline.runtime.stages.child_batch")
"""The modules that gather the points of buildings, in a worker itself and in its children."""

URLS = "pipeline.extras.remote.urls"
"""The module with the time-out of servers."""


def crash() -> None:
    """Die like a fault in native code."""
    os.kill(os.getpid(), signal.SIGSEGV)


def loop() -> None:
    """Never end, in Python. It takes no processor time, which others need; test_isolation.py has one that does."""
    while True:
        time.sleep(0.01)


def loop_natively() -> None:
    """Never end, in C, without ever letting go of the interpreter's lock."""
    import ctypes

    ctypes.PyDLL(None).sleep(2**31 - 1)


def eat_memory() -> None:
    """Take more and more, and use it."""
    held = []
    while True:
        held.append(b"\1" * 2**25)


def ask_memory() -> None:
    """Ask for what no machine has."""
    import numpy as np

    np.ones(2**43)


def fail() -> None:
    """Be a fault of the program."""
    raise ZeroDivisionError("on purpose")


def chatter() -> None:
    """Print, from Python and below it."""
    for _ in range(1000):
        print("x" * 16_000)
        os.write(1, b"y" * 16_000)


AT_MODELLING: dict[str, Callable[[], None]] = {
    "crash": crash,
    "abort": os.abort,
    "exit": lambda: os._exit(7),
    "endless": loop,
    "endless_native": loop_natively,
    "eat_memory": eat_memory,
    "ask_memory": ask_memory,
    "raise": fail,
    "chatter": chatter,
}


def first(folder: str, name: str) -> bool:
    """Whether this is the first process that asks for a name."""
    try:
        Path(folder, name).touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def meant(ids: Sequence[str], building_id: str) -> bool:
    """Whether a building is among those named."""
    return building_id in ids or ("*" in ids and building_id != "")


def at_modelling(building_id: str) -> None:
    """Do what is asked for before a building is modelled."""
    for name, happen in AT_MODELLING.items():
        if meant(FAULTS.get(name, ()), building_id):
            happen()
    once = FAULTS.get("crash_once", {"ids": []})
    if meant(once["ids"], building_id) and first(once["folder"], f"crashed-{building_id}"):
        crash()


def at_stage(stage: str) -> None:
    """Do what is asked for before a task of a stage begins."""
    folder = FAULTS.get("pause", {}).get(stage)
    if folder is not None:
        Path(folder, f"reached-{os.getpid()}").touch()
        while not Path(folder, "go").exists():
            time.sleep(0.02)
    folder = FAULTS.get("kill", {}).get(stage)
    if folder is not None and first(folder, f"killed-{stage}"):
        os.kill(os.getpid(), signal.SIGKILL)
    folder = FAULTS.get("full", {}).get(stage)
    if folder is not None and Path(folder, "full").exists():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), folder)


def before(function: Callable[..., Any], happen: Callable[..., None]) -> Callable[..., Any]:
    """A function that lets something happen first, under the same name, so that it can still be pickled by it."""

    @functools.wraps(function)
    def wrapped(*args: Any, **options: Any) -> Any:
        happen(*args)
        return function(*args, **options)

    return wrapped


def wrap(module: ModuleType) -> None:
    """Put faults before the functions of a module that was just executed."""
    if module.__name__ == BUILDINGS:
        # inside what catches a building's own exceptions
        happen = functools.partial(_of_building, at_modelling)
        module._reconstruct = before(module._reconstruct, happen)  # type: ignore[attr-defined]
        return
    if module.__name__ == URLS:
        module.READ_S = FAULTS.get("impatient", module.READ_S)  # type: ignore[attr-defined]
        return
    if module.__name__ in GATHERING:
        module.gather = before(module.gather, _gathering)  # type: ignore[attr-defined]
        return
    function, stage = STAGES[module.__name__]
    setattr(module, function, before(getattr(module, function), lambda *_: at_stage(stage)))


def _of_building(happen: Callable[[str], None], building: Any, *_: Any) -> None:
    happen(building.candidate.building_id)


def _gathering(scratch: Any, grid: Any, site: Any, *_: Any) -> None:
    if meant(FAULTS.get("crash_gather", ()), site.building_id):
        crash()


class Loader(importlib.abc.Loader):
    """Executes a module as its own loader would, then wraps it."""

    def __init__(self, loader: importlib.abc.Loader) -> None:
        self._loader = loader

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType | None:
        """As its own loader."""
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Execute and wrap."""
        self._loader.exec_module(module)
        wrap(module)


class Finder(importlib.abc.MetaPathFinder):
    """Finds the modules that are to be wrapped, once each."""

    def __init__(self) -> None:
        self._open = {*STAGES, *GATHERING, BUILDINGS, URLS}

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The spec of a module that is to be wrapped, with our loader; None for all others."""
        del path, target
        if name not in self._open:
            return None
        self._open.discard(name)
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            spec.loader = Loader(spec.loader)
        return spec


if FAULTS:
    unknown = set(FAULTS) - {*AT_MODELLING, "crash_gather", "crash_once", "pause", "kill", "full", "impatient"}
    if unknown:
        sys.exit(f"GABLEWORK_FAULTS knows no {', '.join(sorted(unknown))}")
    sys.meta_path.insert(0, Finder())
