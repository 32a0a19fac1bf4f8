"""The deadline of a request: how long it waits for the database, and whether its client still wants the answer."""

from __future__ import annotations

import contextvars
import threading
import time
from enum import Enum, auto
from typing import Self

from service.errors import StoreBusyError


class _State(Enum):
    OPEN = auto()
    COMMITTING = auto()
    ABANDONED = auto()


class RequestDeadline:
    """One request's wait for the database. As a context manager it holds for all transactions of this thread.

    The request may be abandoned until the commit begins, and not afterwards. So an abandoned request has written
    nothing, and one that cannot be abandoned any longer gets the answer of its commit.

    Parameters
    ----------
    wait_s : float
        Seconds from now on.
    """

    def __init__(self, wait_s: float) -> None:
        self.wait_s = wait_s
        self._until_s = time.monotonic() + wait_s
        self._lock = threading.Lock()
        self._state = _State.OPEN
        self._token: contextvars.Token[RequestDeadline | None] | None = None

    def __enter__(self) -> Self:
        """Begin."""
        self._token = CURRENT.set(self)
        return self

    def __exit__(self, *raised: object) -> None:
        """End."""
        assert self._token is not None
        CURRENT.reset(self._token)

    def left_s(self) -> float:
        """Seconds that are left, for a transaction that begins.

        Raises
        ------
        StoreBusyError
            None are, or the request was abandoned.
        """
        left_s = self._until_s - time.monotonic()
        with self._lock:
            if left_s <= 0.0 or self._state is _State.ABANDONED:
                raise self.used_up()
            self._state = _State.OPEN
        return left_s

    def abandon(self) -> bool:
        """Give up; False if the commit has begun, or is done."""
        with self._lock:
            if self._state is _State.COMMITTING:
                return False
            self._state = _State.ABANDONED
            return True

    def commit(self) -> None:
        """Begin the commit.

        Raises
        ------
        StoreBusyError
            The request was abandoned.
        """
        with self._lock:
            if self._state is _State.ABANDONED:
                raise self.used_up()
            self._state = _State.COMMITTING

    def used_up(self) -> StoreBusyError:
        """The error that says so."""
        return StoreBusyError(f"the database was busy for {self.wait_s:g} s, or the client has gone")


CURRENT: contextvars.ContextVar[RequestDeadline | None] = contextvars.ContextVar("deadline", default=None)
"""The deadline of the request that this thread works for; None in a driver."""
