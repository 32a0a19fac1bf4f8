"""A receiver of webhooks on a free port, which answers as a test says; and checks of what it got."""

import contextlib
import json
import random
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from standardwebhooks.webhooks import Webhook

Answer = Callable[["Received"], int | None]
"""The status for a message; None closes the connection without an answer."""


@dataclass
class Received:
    """A message as it came."""

    path: str
    headers: dict[str, str]
    body: bytes

    @property
    def id(self) -> str:
        return self.headers["webhook-id"]

    @property
    def document(self) -> Any:
        return json.loads(self.body)

    def verify(self, secret: str) -> Any:
        """The document, if an independent implementation accepts the signature."""
        return Webhook(secret).verify(self.body, self.headers)


@dataclass
class Receiver:
    """What came, and what is answered."""

    url: str = ""
    answer: Answer = lambda _message: 204
    headers: dict[str, str] = field(default_factory=dict)
    """Headers of the answers."""
    received: list[Received] = field(default_factory=list)
    accepted: list[Received] = field(default_factory=list)
    """Those that were answered with 2xx."""

    cut: list[tuple[int, int]] = field(default_factory=list)
    """Bytes that came and bytes that were announced, of messages that ended early."""

    @property
    def origin(self) -> str:
        """An entry of `webhook_hosts`."""
        return self.url


def failing(seed: int, share: float = 0.4) -> Answer:
    """Fails at random: with a status, or without an answer."""
    chance, lock = random.Random(seed), threading.Lock()

    def answer(_message: Received) -> int | None:
        with lock:
            return chance.choice([500, 503, 429, 302, None]) if chance.random() < share else 200

    return answer


@contextlib.contextmanager
def receiving(answer: Answer | None = None) -> Iterator[Receiver]:
    """A receiver that listens."""
    receiver = Receiver()
    if answer is not None:
        receiver.answer = answer

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            length = int(self.headers["content-length"])
            body = self.rfile.read(length)
            if len(body) < length:
                # the sender was killed before it had sent all
                receiver.cut.append((len(body), length))
                self.close_connection = True
                return
            message = Received(self.path, {name.lower(): value for name, value in self.headers.items()}, body)
            receiver.received.append(message)
            status = receiver.answer(message)
            if status is None:
                self.close_connection = True
                return
            if 200 <= status < 300:
                receiver.accepted.append(message)
            self.send_response(status)
            for name, value in receiver.headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", "0")
            # the sender leaves without reading further, or was killed
            with contextlib.suppress(OSError):
                self.end_headers()

        def log_message(self, *_words: object) -> None:
            """Write nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        receiver.url = f"http://127.0.0.1:{server.server_address[1]}"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        try:
            yield receiver
        finally:
            server.shutdown()
            thread.join()
