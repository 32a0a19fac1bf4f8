"""What the driver logs: plain lines for people, or one JSON object a line, with the job and the attempt."""

from __future__ import annotations

import datetime as dt
import json
import logging
import sys

_FACTS = ("job", "attempt", "driver", "reference")


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
        told |= {name: value for name in _FACTS if (value := getattr(record, name, None)) is not None}
        if record.exc_info:
            told["exception"] = self.formatException(record.exc_info)
        return json.dumps(told, default=str)


class PlainLines(logging.Formatter):
    """One line for people; an exception below it."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s%(told)s")

    def format(self, record: logging.LogRecord) -> str:
        """The record with its facts in brackets."""
        facts = [f"{name} {value}" for name in _FACTS if (value := getattr(record, name, None)) is not None]
        record.told = f" [{', '.join(facts)}]" if facts else ""
        return super().format(record)


def configure(*, as_json: bool) -> None:
    """Let the driver's own lines go to standard error with their facts, whatever the program does with others."""
    logger = logging.getLogger("gablework.driver")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if as_json else PlainLines())
    logger.handlers = [handler]
    logger.propagate = False
    logger.setLevel(logging.INFO)
    quieten()


def quieten() -> None:
    """Only warnings of the libraries; again when Dask was loaded, since it sets its own levels."""
    for chatty in ("alembic", "distributed"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
