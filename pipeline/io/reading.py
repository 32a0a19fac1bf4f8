"""The time limit of an input: how long may pass without any more of it being read.

Readers report each piece (`moved`). A child process passes that on to its supervisor, which ends it after the limit,
whatever holds it (`runtime.isolation`). A process that reads by itself sets an alarm and ends its own reading; an alarm
is noticed as soon as Python runs, so it ends waiting for a disk, and loops of Python, but no loop of a library.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from types import FrameType
from typing import NoReturn

from pipeline.errors import UnreadableInputError
from pipeline.options import ResourceOptions

_limit_s: ContextVar[float] = ContextVar("input_timeout_s", default=ResourceOptions.input_timeout_s)
_listener: Callable[[], object] | None = None
"""What hears of progress: the alarm of this process, or the report to its supervisor."""
_watcher: Callable[[], None] | None = None
"""What hears of it besides, in a process that is watched and has an alarm all the same."""


def moved() -> None:
    """Report that some more of an input was read."""
    if _listener is not None:
        _listener()
    if _watcher is not None:
        _watcher()


def stalled(path: str, limit_s: float) -> UnreadableInputError:
    """The error for an input that could not be read any further."""
    return UnreadableInputError(
        path,
        f"nothing more of it could be read for {limit_s:g} s",
        "Check the disk or the network that it is on, and the file; --input-timeout sets the limit",
    )


def set_input_timeout(seconds: float) -> None:
    """Set the limit of all inputs that this thread reads from now on."""
    _limit_s.set(seconds)


@contextlib.contextmanager
def heard_by(listener: Callable[[], object]) -> Iterator[None]:
    """Let progress in the block be heard by someone who watches this process; no alarm is set. A context manager."""
    global _listener  # noqa: PLW0603 - a process reads one input at a time
    before, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = before


@contextlib.contextmanager
def seen_by(watcher: Callable[[], None]) -> Iterator[None]:
    """Let progress in the block be seen by someone who watches this process, beside its alarms. A context manager."""
    global _watcher  # noqa: PLW0603 - as above
    before, _watcher = _watcher, watcher
    try:
        yield
    finally:
        _watcher = before


@contextlib.contextmanager
def one_input(path: str) -> Iterator[None]:
    """Read an input in the block, within the limit between two pieces; a context manager.

    Does nothing within another one, in a process that is watched, in a thread that is not the main one, and where the
    alarm of the process has another use. Raises UnreadableInputError once nothing was read for as long as the limit.
    """
    limit_s = _limit_s.get()
    if _watcher is not None:
        _watcher()
    free = (
        _listener is None
        and threading.current_thread() is threading.main_thread()
        and hasattr(signal, "setitimer")
        and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
    )
    if not free:
        yield
        return

    def end(_number: int, _frame: FrameType | None) -> NoReturn:
        raise stalled(path, limit_s)

    def begin_anew() -> None:
        signal.setitimer(signal.ITIMER_REAL, limit_s)

    signal.signal(signal.SIGALRM, end)
    try:
        with heard_by(begin_anew):
            begin_anew()
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
