"""The socket that the API listens on, and how long its connections wait for clients that are slow or silent."""

from __future__ import annotations

import asyncio
import enum
import fcntl
import functools
import math
import socket
import struct
import termios
from http import HTTPStatus
from typing import Any

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.crowd import Crowd
from service.errors import StartUpError
from service.pace import Pace, look_s
from service.problems import MEDIA_TYPE, Kind, document
from service.settings import ServiceSettings

KEEP_ALIVE_S = 75
"""Seconds that an idle connection stays open after an answer: longer than at proxies, which should close it first."""

CLOSING_S = 10
"""Seconds that requests get to finish when the process must end."""

TOO_SLOW = Kind(status=408, type_uri="about:blank", title=HTTPStatus(408).phrase)
"""A request that does not arrive."""


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
    # The system ends a connection whose client takes nothing of what was sent: also an event stream, between events.
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, math.ceil(settings.slow_s * 1000.0))
    host = f"[{settings.host}]" if family is socket.AF_INET6 else settings.host
    return listening, f"http://{host}:{listening.getsockname()[1]}"


def server_config(app: FastAPI, settings: ServiceSettings, **values: Any) -> uvicorn.Config:
    """The server's configuration; `values` override it."""
    defaults: dict[str, Any] = {
        "http": functools.partial(TimedConnection, settings=settings, crowd=Crowd(settings)),
        "log_config": None,
        "access_log": False,
        "server_header": False,
        "timeout_keep_alive": KEEP_ALIVE_S,
        "timeout_graceful_shutdown": CLOSING_S,
        "root_path": settings.root_path.rstrip("/"),
    }
    return uvicorn.Config(app, **(defaults | values))


class Awaited(enum.Enum):
    """What a connection waits for."""

    NOTHING = "nothing of its client; the server itself limits the time between requests"
    HEAD = "the head of a request"
    BODY = "the body of a request"
    REST = "the rest of a body whose request is answered already"


class TimedConnection(H11Protocol):
    """A connection that is closed if its client is too slow or silent.

    Every wait is looked at again and again, so that no way from one to the next is without a limit.

    Parameters
    ----------
    settings : ServiceSettings
        The limits.
    crowd : Crowd
        The connections of this process.
    """

    def __init__(self, *args: Any, settings: ServiceSettings, crowd: Crowd, **values: Any) -> None:
        super().__init__(*args, **values)
        self._settings = settings
        self._crowd = crowd
        self._look_s = look_s(settings.max_head_s, settings.silent_s, settings.slow_s)
        self._next_look: asyncio.TimerHandle | None = None
        self._awaited = Awaited.NOTHING
        self._since_s = self._heard_s = 0.0
        self._pace = Pace.of(settings, 0.0)
        self._reading: Pace | None = None
        """The pace at which the client reads, while an answer waits for it."""
        self._unread = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a connection, or end it at once if there are far too many."""
        super().connection_made(transport)
        if not self._crowd.enter(self, self.client[0] if self.client else ""):
            transport.abort()
            return
        self.app = self._crowd.app_for(self, self.app)
        self._follow()
        self._next_look = self.loop.call_later(self._look_s, self._look)

    def data_received(self, data: bytes) -> None:
        """Take bytes."""
        self._heard_s = self.loop.time()
        super().data_received(data)
        self._follow()
        self._pace.took(len(data), self._heard_s)

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._follow()

    def pause_writing(self) -> None:
        """Watch the client while it does not read."""
        super().pause_writing()
        self._unread = self._outstanding()
        self._reading = Pace.of(self._settings, self.loop.time())

    def resume_writing(self) -> None:
        """Watch no longer."""
        super().resume_writing()
        self._reading = None

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._crowd.leave(self)
        if self._next_look is not None:
            self._next_look.cancel()
        super().connection_lost(exc)

    def give_way(self) -> None:
        """End this connection, which waits for a request, for the sake of another one."""
        self.transport.close()

    def _follow(self) -> None:
        """Notice what is awaited now; its time begins with it."""
        before, self._awaited = self._awaited, self._awaits()
        if self._awaited is not before:
            self._since_s = self.loop.time()
            self._heard_s = max(self._heard_s, self._since_s)
            self._pace = Pace.of(self._settings, self._since_s)
        if self.conn.their_state is h11.IDLE:
            self._crowd.idles(self)
        else:
            self._crowd.works(self)

    def _awaits(self) -> Awaited:
        state = self.conn.their_state
        if state is h11.IDLE and (self.cycle is None or self.conn.trailing_data[0]):
            return Awaited.HEAD
        # not while this side is slow, or has yet to ask for the body
        if state is h11.SEND_BODY and not self.flow.read_paused and not self.conn.they_are_waiting_for_100_continue:
            return Awaited.REST if self.cycle.response_complete else Awaited.BODY
        return Awaited.NOTHING

    def _look(self) -> None:
        """End the connection if its client is slower than allowed, or look again later."""
        self._next_look = self.loop.call_later(self._look_s, self._look)
        self._follow()
        now_s = self.loop.time()
        if self._reading is not None:
            before, self._unread = self._unread, self._outstanding()
            self._reading.took(max(0, before - self._unread), now_s)
            if self._reading.is_slow(now_s):
                # not `close`, which waits until the client has read all
                self.transport.abort()
                return
        fault = self._fault(now_s)
        if fault is not None and not self.transport.is_closing():
            self._refuse(fault)

    def _fault(self, now_s: float) -> str | None:
        """Why the client is too slow; None if it is not."""
        limits = self._settings
        if self._awaited is Awaited.HEAD and now_s - self._since_s > limits.max_head_s:
            return f"the head of the request did not arrive within {limits.max_head_s:g} s"
        if self._awaited is Awaited.REST and now_s - self._since_s > limits.slow_s:
            return "the request is answered already"
        if self._awaited in {Awaited.BODY, Awaited.REST} and now_s - self._heard_s > limits.silent_s:
            return f"no byte of the body arrived within {limits.silent_s:g} s"
        if self._awaited is Awaited.BODY and self._pace.is_slow(now_s):
            return f"the body came with less than {limits.min_bytes_per_s:g} bytes per second over {limits.slow_s:g} s"
        return None

    def _refuse(self, fault: str) -> None:
        """Close the connection; say why if a request has begun and has no answer yet."""
        has_begun = self.conn.trailing_data[0] or self.conn.their_state is h11.SEND_BODY
        if has_begun and self.conn.our_state in {h11.IDLE, h11.SEND_RESPONSE}:
            if self._awaited is Awaited.BODY:
                # the application learns that its client is gone, and sends nothing any more
                self.cycle.disconnected = True
                self.cycle.message_event.set()
            path = self.scope["path"] if self._awaited is Awaited.BODY else ""
            problem = document(TOO_SLOW, f"{fault}: send it again, faster", path)
            content = problem.model_dump_json(by_alias=True, exclude_defaults=True).encode()
            headers = {"Content-Type": MEDIA_TYPE, "Content-Length": str(len(content)), "Connection": "close"}
            status = TOO_SLOW.status
            for event in (
                h11.Response(status_code=status, headers=list(headers.items()), reason=TOO_SLOW.title.encode()),
                h11.Data(data=content),
                h11.EndOfMessage(),
            ):
                self.transport.write(self.conn.send(event))
        self.transport.close()

    def _outstanding(self) -> int:
        """Bytes of answers that the client's system has not taken yet."""
        held = self.transport.get_write_buffer_size()
        link = self.transport.get_extra_info("socket")
        if link is None:
            return held
        (sent,) = struct.unpack("i", fcntl.ioctl(link.fileno(), termios.TIOCOUTQ, bytes(struct.calcsize("i"))))
        return held + int(sent)
