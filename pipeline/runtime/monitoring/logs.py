"""Log lines with ids: plain for people, or one JSON object a line; of the driver of a run, of workers, of the service.

All of gablework's lines go to loggers below `gablework`. As a library it prints none of them; a process that is ours
calls `configure`. Facts stand beside the message: those that the line itself has (`extra=`), and those of what is under
way (`about`): a worker thus names run, stage and tile of the task at hand, also where the line comes from deep inside.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import functools
import json
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from types import MappingProxyType, TracebackType
from typing import Any

from pipeline.errors import SettingsError

FACTS = (
    *("job", "attempt", "driver", "reference"),
    *("schedule", "run", "stage", "tile", "batch", "building", "reason"),
    *("seconds", "memory_bytes", "done", "total", "failed"),
)
"""What a line may tell beside its message, in this order."""
VARIABLE = "GABLEWORK_LOG_JSON"
"""Environment variable that makes workers and commands log JSON; the service's setting has the same name."""

_NAME = "gablework"
_CHATTY = ("alembic", "distributed")
"""Libraries of whose lines a process of ours shows warnings and errors only; Dask sets its own levels as it loads, so
that a level set before would not last."""
_UNDER_WAY: ContextVar[Mapping[str, object]] = ContextVar("gablework facts", default=MappingProxyType({}))

LOG = logging.getLogger(f"{_NAME}.run")
"""Of runs and their tasks."""
logging.getLogger(_NAME).addHandler(logging.NullHandler())


_KEY_TOLD = 12
"""Digits of a batch's key that are told: enough to find it in scratch."""


@contextlib.contextmanager
def about(**facts: object) -> Iterator[None]:
    """Let all lines of this thread tell some facts, until the end of the block; None and "" are left out."""
    known = {name: value for name, value in facts.items() if value not in (None, "")}
    token = _UNDER_WAY.set({**_UNDER_WAY.get(), **known})
    try:
        yield
    finally:
        _UNDER_WAY.reset(token)


def facts_of_task(task: object) -> dict[str, object]:
    """The ids that a task of a run carries: the run by the name of its scratch folder, its tile, its batch."""
    place, task = getattr(task, "place", None), getattr(task, "task", task)
    run = getattr(getattr(task, "scratch", None), "name", None)
    tile = getattr(getattr(task, "tile", None), "key", None)
    batch = None
    if place is not None and hasattr(task, "sites"):
        tile, batch = place.unit, place.key[:_KEY_TOLD]
    return {"run": run, "tile": tile, "batch": batch}


def facts_of(record: logging.LogRecord) -> dict[str, Any]:
    """The facts of a line: its own before those of what is under way."""
    under_way = _UNDER_WAY.get()
    found = {name: getattr(record, name, under_way.get(name)) for name in FACTS}
    return {name: value for name, value in found.items() if value is not None}


class JsonLines(logging.Formatter):
    """One JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        """The record with its facts; an exception with its traceback."""
        told = {
            "at": dt.datetime.fromtimestamp(record.created, dt.UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        told |= facts_of(record)
        if record.exc_info:
            told["exception"] = self.formatException(record.exc_info)
        return json.dumps(told, default=str)


class PlainLines(logging.Formatter):
    """One line for people; an exception below it."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s%(told)s")

    def format(self, record: logging.LogRecord) -> str:
        """The record with its facts in brackets."""
        facts = [f"{name} {value}" for name, value in facts_of(record).items()]
        record.told = f" [{', '.join(facts)}]" if facts else ""
        return super().format(record)


def configure(*, as_json: bool, name: str = _NAME, also: tuple[str, ...] = ()) -> None:
    """Let the lines of a logger go to standard error with their facts, whatever the program does with others.

    Parameters
    ----------
    as_json : bool
        One JSON object a line in place of plain lines.
    name : str
        The logger; all of gablework's by default.
    also : tuple of str
        Loggers of libraries that speak in the same way; their levels stay.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if as_json else PlainLines())
    for one in (name, *also):
        logger = logging.getLogger(one)
        logger.handlers = [handler]
        logger.propagate = False
    logging.getLogger(name).setLevel(logging.INFO)


class _NoChatter(logging.Filter):
    """Lets pass what is ours, and what libraries say that is of interest."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the line is shown."""
        return record.levelno >= logging.WARNING or record.name.partition(".")[0] not in _CHATTY


def let_all_speak_json() -> Callable[[], None]:
    """Make all lines of this process JSON on standard error, whoever writes them.

    Those of libraries, also of such as are loaded later; Python's warnings; and faults that nobody catches, of any
    thread. For processes that are ours, never for one that imports this program as a library.

    Returns
    -------
    callable
        Undoes it.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    handler.addFilter(_NoChatter())
    root = logging.getLogger()
    loggers = (root, *map(logging.getLogger, (_NAME, "distributed", "py.warnings")))
    before = [(logger, logger.handlers, logger.propagate, logger.level) for logger in loggers]
    hooks = sys.excepthook, threading.excepthook
    for logger in loggers:
        logger.handlers, logger.propagate = [], True
    # Dask adds a handler of its own as it loads, unless the root logger has one
    root.handlers = [handler]
    logging.captureWarnings(True)
    sys.excepthook, threading.excepthook = _log_fault, _log_fault_of_thread
    configure(as_json=True)

    def undo() -> None:
        logging.captureWarnings(False)
        sys.excepthook, threading.excepthook = hooks
        for logger, handlers, propagates, level in before:
            logger.handlers, logger.propagate = handlers, propagates
            logger.setLevel(level)

    return undo


def _log_fault(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    LOG.critical("a fault that nobody caught: %s", error or kind.__name__, exc_info=(kind, error, trace))


def _log_fault_of_thread(fault: threading.ExceptHookArgs) -> None:
    if fault.exc_type is SystemExit:
        return
    name = "a thread" if fault.thread is None else f"the thread {fault.thread.name}"
    error = fault.exc_type() if fault.exc_value is None else fault.exc_value
    LOG.critical(
        "%s ended by a fault: %s",
        name,
        error or fault.exc_type.__name__,
        exc_info=(fault.exc_type, error, fault.exc_traceback),
    )


def wants_json() -> bool:
    """Whether the environment asks for JSON lines.

    Raises
    ------
    SettingsError
        The variable is neither yes nor no.
    """
    given = os.environ.get(VARIABLE, "").strip().lower()
    if given in {"1", "true", "yes", "on"}:
        return True
    if given in {"", "0", "false", "no", "off"}:
        return False
    raise SettingsError([f"{VARIABLE} is {given!r}: use 1 or 0"])


@functools.cache
def configure_once() -> None:
    """Configure a worker that the environment tells to log JSON, whatever program started it."""
    if wants_json():
        configure(as_json=True, also=("distributed",))
