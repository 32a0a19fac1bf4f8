"""What a child process reports of the item at work while it goes on."""

from __future__ import annotations

import time
from collections.abc import Callable

_REPORT_S = 1.0
_send: Callable[[], None] | None = None
"""Reports that the item at work goes on; None in other processes."""
_reported_s = 0.0


def item_begins(send: Callable[[], None]) -> None:
    """Note how progress of the item that begins is reported."""
    global _send  # noqa: PLW0603 - a child has one item at work
    _send = send


def report_progress() -> None:
    """Report to the supervisor that the item at work goes on, at most once a second; nothing outside of a child."""
    global _reported_s  # noqa: PLW0603 - as above
    now = time.monotonic()
    if _send is not None and now - _reported_s >= _REPORT_S:
        _reported_s = now
        _send()
