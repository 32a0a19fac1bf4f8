"""Log lines of the driver, plain or JSON, with the job and the attempt."""

from __future__ import annotations

import logging

from pipeline.runtime.monitoring import logs


def configure(*, as_json: bool) -> None:
    """Send the driver's own lines to standard error with their facts, whatever the program does with other loggers."""
    logs.configure(as_json=as_json)
    quieten()


def quieten() -> None:
    """Let libraries log only warnings; call again after Dask was loaded, as it sets its own levels."""
    for chatty in ("alembic", "distributed"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
