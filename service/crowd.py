"""The open connections of a process: how many there may be, and which one goes when there are too many."""

from __future__ import annotations

import logging
import resource
from collections import Counter
from http import HTTPStatus
from typing import Protocol

from starlette.types import ASGIApp, Receive, Scope, Send

from service.problems import Kind, answer
from service.rate_limits import counted_as
from service.settings import ServiceSettings

SPARE = 32
"""Connections above a limit that are taken, to answer /healthz and to say why nothing else is answered."""
HEALTH = "/healthz"
"""Path that is always answered."""
FULL = Kind(status=503, type_uri="about:blank", title=HTTPStatus(503).phrase)
"""The answer to a request over a connection above a limit."""
RETRY_AFTER_S = 5

_log = logging.getLogger("gablework.service")


class Member(Protocol):
    """A connection."""

    def give_way(self) -> None:
        """End, for the sake of another connection."""


class Crowd:
    """The connections that are open.

    A new one above the limit ends the one that has been idle longest. If none is idle, up to `SPARE` more are taken:
    they get an answer to /healthz, and 503 to all else. Further ones end at once. Above the limit of one address no
    idle connection ends: only its own clients suffer.

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
        self._refused: set[Member] = set()

    @property
    def count(self) -> int:
        """Number of open connections."""
        return len(self._addresses)

    def enter(self, member: Member, address: str) -> bool:
        """Count a new connection; False if it must end at once."""
        if self.count >= self.most and self._idle:
            longest = next(iter(self._idle))
            self.leave(longest)
            longest.give_way()
        address = counted_as(address)
        above = max(self.count + 1 - self.most, self._counts[address] + 1 - self._most_per_address)
        if above > SPARE:
            return False
        self._addresses[member] = address
        self._counts[address] += 1
        if above > 0:
            if not self._refused:
                _log.warning("too many connections: %d, of them %d from %s", self.count, self._counts[address], address)
            self._refused.add(member)
        return True

    def leave(self, member: Member) -> None:
        """Count a connection no longer."""
        address = self._addresses.pop(member, None)
        self._idle.pop(member, None)
        self._refused.discard(member)
        if address is not None:
            self._counts[address] -= 1
            if not self._counts[address]:
                del self._counts[address]

    def idles(self, member: Member) -> None:
        """Note that a connection waits for a request."""
        if member in self._addresses:
            self._idle[member] = None

    def works(self, member: Member) -> None:
        """Note that a connection has a request."""
        self._idle.pop(member, None)

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
