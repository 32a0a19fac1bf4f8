"""The open connections of a process: how many there may be, and which one goes when there are too many."""

from __future__ import annotations

import logging
import math
import resource
import time
from collections import Counter, defaultdict
from http import HTTPStatus
from typing import Protocol

from starlette.types import ASGIApp, Receive, Scope, Send

from service.problems import Kind, answer
from service.rate_limits import counted_as
from service.settings import ServiceSettings

SPARE = 32
"""Connections above the limit that are taken, to answer /healthz and to say why nothing else is answered."""
HEALTH = "/healthz"
"""Path that is always answered."""
FULL = Kind(status=503, type_uri="about:blank", title=HTTPStatus(503).phrase)
"""The answer to a request over a connection above a limit."""
RETRY_AFTER_S = 5
WARNINGS_S = 60.0
"""Seconds between warnings of too many connections."""

_log = logging.getLogger("gablework.service")


class Member(Protocol):
    """A connection."""

    def give_way(self) -> None:
        """End, for the sake of another connection."""


class Crowd:
    """The connections that are open.

    A new one above a limit ends the one that has been idle longest; above that of its address, one of that address. If
    none is idle, the new one gets an answer to /healthz, and 503 to all else. Such a connection is soon over or idle,
    so there is always room for one that asks for /healthz.

    Parameters
    ----------
    settings : ServiceSettings
        The limits.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        self.most = settings.max_connections
        """Maximum number of connections; half of the files of a process are left for all else."""
        if files != resource.RLIM_INFINITY:
            self.most = max(1, min(self.most, files // 2))
        self._most_per_address = settings.max_connections_per_address
        self._addresses: dict[Member, str] = {}
        self._counts: Counter[str] = Counter()
        self._idle: dict[Member, None] = {}
        """Idle connections, longest first."""
        self._idle_of: defaultdict[str, dict[Member, None]] = defaultdict(dict)
        """The same by address."""
        self._refused: set[Member] = set()
        self._next_warning_s = -math.inf

    @property
    def count(self) -> int:
        """Number of open connections."""
        return len(self._addresses)

    def enter(self, member: Member, address: str) -> bool:
        """Count a new connection; False if it must end at once."""
        address = counted_as(address)
        if self._counts[address] >= self._most_per_address:
            self._make_way(self._idle_of[address])
        if self.count >= self.most:
            self._make_way(self._idle)
        if self.count >= self.most + SPARE:
            return False
        self._addresses[member] = address
        self._counts[address] += 1
        if self.count > self.most or self._counts[address] > self._most_per_address:
            self._refused.add(member)
            self._warn(address)
        return True

    def _warn(self, address: str) -> None:
        """Say that there are too many, now and then: a client that opens many must not fill the log."""
        now_s = time.monotonic()
        if now_s >= self._next_warning_s:
            self._next_warning_s = now_s + WARNINGS_S
            _log.warning("too many connections: %d, of them %d from %s", self.count, self._counts[address], address)

    def _make_way(self, idle: dict[Member, None]) -> None:
        """End the connection that has been idle longest, if there is one."""
        longest = next(iter(idle), None)
        if longest is not None:
            self.leave(longest)
            longest.give_way()

    def leave(self, member: Member) -> None:
        """Count a connection no longer."""
        self.works(member)
        self._refused.discard(member)
        address = self._addresses.pop(member, None)
        if address is not None:
            self._counts[address] -= 1
            if not self._counts[address]:
                del self._counts[address]
                self._idle_of.pop(address, None)

    def idles(self, member: Member) -> None:
        """Note that a connection waits for a request."""
        if member in self._addresses:
            self._idle[member] = self._idle_of[self._addresses[member]][member] = None

    def works(self, member: Member) -> None:
        """Note that a connection has a request."""
        if self._idle.pop(member, member) is None:
            del self._idle_of[self._addresses[member]][member]

    def app_for(self, member: Member, app: ASGIApp) -> ASGIApp:
        """The application that answers a new connection."""
        if member not in self._refused:
            return app

        async def refuse(scope: Scope, receive: Receive, send: Send) -> None:
            path = scope.get("path", "").removeprefix(scope.get("root_path", ""))
            if path == HEALTH:
                await app(scope, receive, send)
                return
            detail = (
                f"{self.count} connections are open, the limits are {self.most} and {self._most_per_address} per "
                "address: close some, or try again later"
            )
            headers = {"Retry-After": str(RETRY_AFTER_S), "Connection": "close"}
            await answer(FULL, detail, scope["path"], (), headers)(scope, receive, send)

        return refuse
