"""What the driver logs: plain lines for people, or one JSON object a line, with the job and the attempt."""

from __future__ import annotations

import logging

from pipeline.runtime.monitoring import logs
from pipeline.runtime.monitoring.logs import JsonLines, PlainLines

__all__ = ["JsonLines", "PlainLines", "configure", "quieten"]


def configure(*, as_json: bool) -> None:
    """Let the driver's own lines go to standard error with their facts, whatever the program does with others."""
    logs.configure(as_json=as_json)
    quieten()


def quieten() -> None:
    """Only warnings of the libraries; again when Dask was loaded, since it sets its own levels."""
    for chatty in ("alembic", "distributed"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
