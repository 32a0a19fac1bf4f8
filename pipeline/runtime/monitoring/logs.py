"""Log lines with ids, plain or JSON, from the driver of a run, from workers and from the service.

All lines of gablework go to loggers below `gablework`. As a library it prints none of them; a process of gablework
calls `configure` of `log_lines.py`. A line has facts beside its message: its own (`extra=`), and those of the current
work (`about`). A worker thus names run, stage and tile of the current task in every line.
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from types import MappingProxyType
from typing import Any

from pipeline.errors import SettingsError

FACTS = (
    *("job", "attempt", "driver", "reference"),
    *("schedule", "run", "stage", "tile", "batch", "building", "reason"),
    *("seconds", "memory_bytes", "done", "total", "failed"),
)
"""Facts that a line may have beside its message, in this order."""
VARIABLE = "GABLEWORK_LOG_JSON"
"""Environment variable that makes workers and commands log JSON; the service's setting has the same name."""

NAME = "gablework"
_CURRENT: ContextVar[Mapping[str, object]] = ContextVar("gablework facts", default=MappingProxyType({}))
_KEY_DIGITS = 12
"""Logged digits of a batch's key: enough to find it in scratch."""

LOG = logging.getLogger(f"{NAME}.run")
"""Logger of runs and their tasks."""
logging.getLogger(NAME).addHandler(logging.NullHandler())


@contextlib.contextmanager
def about(**facts: object) -> Iterator[None]:
    """Add facts to all lines of this thread until the end of the block; None and "" are left out."""
    known = {name: value for name, value in facts.items() if value not in (None, "")}
    token = _CURRENT.set({**_CURRENT.get(), **known})
    try:
        yield
    finally:
        _CURRENT.reset(token)


def facts_of_task(task: object) -> dict[str, object]:
    """The ids of a run's task: the name of the run's scratch folder, the tile, the batch."""
    place, task = getattr(task, "place", None), getattr(task, "task", task)
    run = getattr(getattr(task, "scratch", None), "name", None)
    tile = getattr(getattr(task, "tile", None), "key", None)
    batch = None
    if place is not None and hasattr(task, "group"):
        tile, batch = place.unit, place.key[:_KEY_DIGITS]
    return {"run": run, "tile": tile, "batch": batch}


def facts_of(record: logging.LogRecord) -> dict[str, Any]:
    """The facts of a line: its own facts override those of the current work."""
    current = _CURRENT.get()
    found = {name: getattr(record, name, current.get(name)) for name in FACTS}
    return {name: value for name, value in found.items() if value is not None}


def wants_json() -> bool:
    """Whether the environment asks for JSON lines; raises SettingsError if the variable is neither yes nor no."""
    given = os.environ.get(VARIABLE, "").strip().lower()
    if given in {"1", "true", "yes", "on"}:
        return True
    if given in {"", "0", "false", "no", "off"}:
        return False
    raise SettingsError([f"{VARIABLE} is {given!r}: use 1 or 0"])
