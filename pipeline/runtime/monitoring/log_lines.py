"""How log lines are written in a process of gablework: plain or JSON, on standard error."""

from __future__ import annotations

import datetime as dt
import functools
import logging
import sys
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any

from pipeline.runtime.monitoring.logs import LOG, NAME, facts_of

_CHATTY = ("alembic", "distributed")
"""Libraries that log only warnings and errors in a process of gablework. Dask sets its own levels when it is loaded, so
a level set earlier would not last."""


def formatter(*, as_json: bool) -> logging.Formatter:
    """The format of lines with their facts: one JSON object per line, or plain."""
    return _json_lines() if as_json else PlainLines()


@functools.cache
def _json_lines() -> logging.Formatter:
    from pythonjsonlogger.json import JsonFormatter  # here, as most processes log plain lines or none

    class JsonLines(JsonFormatter):
        """One JSON object per line; of the facts of libraries only those of `FACTS`."""

        def add_fields(self, log_data: dict[str, Any], record: logging.LogRecord, message_dict: dict[str, Any]) -> None:
            at = dt.datetime.fromtimestamp(record.created, dt.UTC).isoformat(timespec="milliseconds")
            log_data |= {
                "at": at,
                "level": record.levelname.lower(),
                "logger": record.name,
                "message": record.getMessage(),
            }
            log_data |= facts_of(record)
            if record.exc_info:
                log_data["exception"] = message_dict["exc_info"]

    return JsonLines(json_default=str)


class PlainLines(logging.Formatter):
    """A plain line, with an exception below it."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s%(facts)s")

    def format(self, record: logging.LogRecord) -> str:
        """Format the record, its facts in brackets."""
        facts = [f"{name} {value}" for name, value in facts_of(record).items()]
        record.facts = f" [{', '.join(facts)}]" if facts else ""
        return super().format(record)


def configure(*, as_json: bool, name: str = NAME, also: tuple[str, ...] = ()) -> None:
    """Send the lines of a logger to standard error with their facts, whatever the program does with other loggers.

    Lines are plain or one JSON object each. By default the logger is that of all of gablework. The loggers of the
    libraries in `also` are formatted in the same way; their levels stay.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(formatter(as_json=as_json))
    for one in (name, *also):
        logger = logging.getLogger(one)
        logger.handlers = [handler]
        logger.propagate = False
    logging.getLogger(name).setLevel(logging.INFO)


class _QuietLibraries(logging.Filter):
    """Drops the informative lines of chatty libraries."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the line is shown."""
        return record.levelno >= logging.WARNING or record.name.partition(".")[0] not in _CHATTY


def log_everything_as_json() -> Callable[[], None]:
    """Write all lines of this process as JSON to standard error; returns what restores the logging of before.

    This includes lines of libraries, also of those loaded later, Python's warnings, and uncaught exceptions of any
    thread. It is for processes of gablework, never for one that imports it as a library.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(formatter(as_json=True))
    handler.addFilter(_QuietLibraries())
    root = logging.getLogger()
    loggers = (root, *map(logging.getLogger, (NAME, "distributed", "py.warnings")))
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
    LOG.critical("an uncaught exception: %s", error or kind.__name__, exc_info=(kind, error, trace))


def _log_fault_of_thread(fault: threading.ExceptHookArgs) -> None:
    if fault.exc_type is SystemExit:
        return
    name = "a thread" if fault.thread is None else f"the thread {fault.thread.name}"
    error = fault.exc_type() if fault.exc_value is None else fault.exc_value
    LOG.critical(
        "%s ended with an exception: %s",
        name,
        error or fault.exc_type.__name__,
        exc_info=(fault.exc_type, error, fault.exc_traceback),
    )


@functools.cache
def configure_as_json() -> None:
    """Log JSON in a worker, once, whatever program started it."""
    configure(as_json=True, also=("distributed",))
