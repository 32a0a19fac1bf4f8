"""A web server that does its worst: it trickles, falls silent, never ends, or says what is not true."""

import contextlib
import itertools
import socket
import threading
from collections.abc import Callable, Iterator, Mapping

BODY = b"\0" * 1_000_000
"""A body that takes days at a byte a second."""
_HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/octet-stream\r\n"


class HostileHost:
    """A server on loopback.

    Parameters
    ----------
    pause_s : float
        Seconds between the bytes of one that trickles.
    """

    def __init__(self, pause_s: float) -> None:
        self._pause_s = pause_s
        self._ended = threading.Event()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._links: set[socket.socket] = set()
        self._threads = [threading.Thread(target=self._accept)]
        self.origin = f"127.0.0.1:{self._listening.getsockname()[1]}"
        self.requests: list[str] = []
        """Targets of all requests."""
        self.sent_bytes = 0
        self._threads[0].start()

    def url(self, temper: str) -> str:
        """A file that is served with one of `TEMPERS`."""
        return f"{'https' if temper == 'handshake' else 'http'}://{self.origin}/{temper}/a.laz"

    def end(self) -> None:
        """End all connections."""
        self._ended.set()
        for one in (self._listening, *self._links):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        for thread in self._threads:
            thread.join()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                link, _ = self._listening.accept()
                self._links.add(link)
                thread = threading.Thread(target=self._answer, args=(link,))
                self._threads.append(thread)
                thread.start()

    def _answer(self, link: socket.socket) -> None:
        with contextlib.suppress(OSError), link:
            first = link.recv(65_536)
            if first[:1] == b"\x16":
                # a client of TLS: the answer to its greeting
                self.requests.append("handshake")
                self.trickle(link, b"\x16\x03\x03\x40\x00" + b"\0" * 16_384)
                return
            target = first.split(b" ", 2)[1].decode()
            self.requests.append(target)
            if first.startswith(b"HEAD ") and target.startswith("/body/"):
                # a body after it would be read as the next answer, or not, as it happens to come
                self.send(link, _HEAD + b"Content-Length: %d\r\nConnection: close\r\n\r\n" % len(BODY))
                return
            TEMPERS[target.split("/")[1]](self, link)

    def send(self, link: socket.socket, content: bytes) -> None:
        """Send bytes at once."""
        link.sendall(content)
        self.sent_bytes += len(content)

    def trickle(self, link: socket.socket, content: bytes) -> None:
        """Send bytes one by one."""
        for byte in content:
            self.send(link, bytes([byte]))
            if self._ended.wait(self._pause_s):
                return

    def wait(self) -> None:
        """Do nothing until the end."""
        self._ended.wait()


def _status_line(host: HostileHost, link: socket.socket) -> None:
    host.trickle(link, b"HTTP/1.1 200 " + b"O" * 60_000)


def _headers(host: HostileHost, link: socket.socket) -> None:
    host.send(link, _HEAD)
    host.trickle(link, b"X-Padding: " + b"x" * 60_000)


def _body(host: HostileHost, link: socket.socket) -> None:
    host.send(link, _HEAD + b"Content-Length: %d\r\n\r\n" % len(BODY))
    host.trickle(link, BODY)


def _chunks(host: HostileHost, link: socket.socket) -> None:
    host.send(link, _HEAD + b"Transfer-Encoding: chunked\r\n\r\n")
    host.trickle(link, b"1\r\nx\r\n" * 100_000)


def _redirect(host: HostileHost, link: socket.socket) -> None:
    host.send(link, b"HTTP/1.1 302 Found\r\nLocation: /body/a.laz\r\n")
    host.trickle(link, b"X-Padding: " + b"x" * 60_000)


def _silence(host: HostileHost, _link: socket.socket) -> None:
    host.wait()


def _stop(host: HostileHost, link: socket.socket) -> None:
    host.send(link, _HEAD + b"Content-Length: %d\r\n\r\n" % len(BODY) + BODY[:500])
    host.wait()


def _hints(host: HostileHost, link: socket.socket) -> None:
    while True:
        host.send(link, b"HTTP/1.1 103 Early Hints\r\nLink: </a.css>\r\n\r\n" * 1000)


def _endless_headers(host: HostileHost, link: socket.socket) -> None:
    host.send(link, _HEAD)
    for number in itertools.count():
        host.send(link, b"X-%d: " % number + b"x" * 65_536 + b"\r\n")


def _endless(host: HostileHost, link: socket.socket) -> None:
    host.send(link, _HEAD + b"Transfer-Encoding: chunked\r\n\r\n")
    while True:
        host.send(link, b"10000\r\n" + b"\0" * 0x10000 + b"\r\n")


def _busy(host: HostileHost, link: socket.socket) -> None:
    host.send(link, b"HTTP/1.1 429 Slow Down\r\nRetry-After: 86400\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")


def _short(host: HostileHost, link: socket.socket) -> None:
    host.send(link, _HEAD + b"Content-Length: 1000\r\n\r\n" + BODY[:100])


def _negative(host: HostileHost, link: socket.socket) -> None:
    host.send(link, _HEAD + b"Content-Length: -7\r\n\r\n" + BODY[:100])


TRICKLING = ("status", "headers", "body", "chunks", "redirect", "handshake")
"""Those that send a byte now and then."""
TEMPERS: Mapping[str, Callable[[HostileHost, socket.socket], None]] = {
    "status": _status_line,
    "headers": _headers,
    "body": _body,
    "chunks": _chunks,
    "redirect": _redirect,
    "silence": _silence,
    "stop": _stop,
    "hints": _hints,
    "heads": _endless_headers,
    "endless": _endless,
    "busy": _busy,
    "short": _short,
    "negative": _negative,
}
"""By the first part of the path; `handshake` is reached by TLS."""


@contextlib.contextmanager
def hostile_host(pause_s: float = 1.0) -> Iterator[HostileHost]:
    """A hostile host, until the block ends."""
    host = HostileHost(pause_s)
    try:
        yield host
    finally:
        host.end()
