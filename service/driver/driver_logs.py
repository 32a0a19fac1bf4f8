"""Log lines of the driver, plain or JSON, with the job and the attempt."""

from __future__ import annotations

import logging

from pipeline.runtime.monitoring import log_lines


def configure(*, as_json: bool) -> None:
    """Log the driver's own lines with their fields to standard error, independent of all other loggers."""
    log_lines.configure(as_json=as_json)
    quieten()


def quieten() -> None:
    """Let libraries log only warnings. Call this again after Dask was loaded, which sets its own levels."""
    for chatty in ("alembic", "distributed"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
