"""The socket that the API listens on, and how long a connection may be silent."""

from __future__ import annotations

import asyncio
import socket
from typing import Any

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.errors import StartUpError
from service.settings import ServiceSettings

KEEP_ALIVE_S = 75
"""Seconds that an idle connection stays open after an answer: longer than at proxies, which should close it first."""

HEAD_S = 20.0
"""Seconds that a client gets for the head of a request, from the connection or the head's first byte on."""

BODY_S = 120.0
"""Seconds without a byte of the body after which a client counts as gone."""

CLOSING_S = 10
"""Seconds that requests get to finish when the process must end."""


def listen(settings: ServiceSettings) -> tuple[socket.socket, str]:
    """The socket of the service's address, and its URL; port 0 takes a free one.

    Raises
    ------
    StartUpError
        The address is not available.
    """
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        listening = socket.create_server((settings.host, settings.port), family=family, backlog=2048)
    except OSError as error:
        raise StartUpError(
            f"cannot listen on {settings.host} port {settings.port}: {error.strerror or error}; choose another --port"
        ) from error
    # Connections inherit it. Without it the end of an answer waits for the client's acknowledgement, some 40 ms.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    host = f"[{settings.host}]" if family is socket.AF_INET6 else settings.host
    return listening, f"http://{host}:{listening.getsockname()[1]}"


def server_config(app: FastAPI, settings: ServiceSettings, **values: Any) -> uvicorn.Config:
    """The server's configuration; `values` override it."""
    defaults: dict[str, Any] = {
        "http": TimedConnection,
        "log_config": None,
        "access_log": False,
        "server_header": False,
        "timeout_keep_alive": KEEP_ALIVE_S,
        "timeout_graceful_shutdown": CLOSING_S,
        "root_path": settings.root_path.rstrip("/"),
    }
    return uvicorn.Config(app, **(defaults | values))


class TimedConnection(H11Protocol):
    """A connection that is closed if its client is silent; the server itself limits only the time between requests."""

    _silence: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first request."""
        super().connection_made(transport)
        self._wait_at_most(HEAD_S)

    def data_received(self, data: bytes) -> None:
        """Take bytes. A head must be complete in time, and a body must not stop."""
        super().data_received(data)
        state = self.conn.their_state
        if state is h11.SEND_BODY:
            self._wait_at_most(BODY_S)
        elif state is not h11.IDLE:
            self._end_waiting()
        elif self._silence is None and self._has_part_of_head():
            self._wait_at_most(HEAD_S)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the time limit."""
        self._end_waiting()
        super().connection_lost(exc)

    def _has_part_of_head(self) -> bool:
        return bool(self.conn.trailing_data[0])

    def _wait_at_most(self, seconds: float) -> None:
        self._end_waiting()
        self._silence = self.loop.call_later(seconds, self._give_up)

    def _end_waiting(self) -> None:
        if self._silence is not None:
            self._silence.cancel()
            self._silence = None

    def _give_up(self) -> None:
        """Close the connection, unless this side does not read or already answers."""
        self._silence = None
        state = self.conn.their_state
        if state is h11.SEND_BODY and self.flow.read_paused:
            self._wait_at_most(BODY_S)
        elif state in {h11.IDLE, h11.SEND_BODY}:
            self.transport.close()
