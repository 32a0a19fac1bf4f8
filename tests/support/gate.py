"""A proxy between a client and a service that cuts connections after counted bytes, or holds them up."""

import contextlib
import socket
import threading
from collections.abc import Iterator
from urllib.parse import urlsplit


class Gate:
    """Passes bytes on until its allowance is used up; then it cuts all connections, or holds the bytes back.

    Parameters
    ----------
    url : str
        The service.
    """

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._upstream = (parts.hostname, parts.port)
        self._changed = threading.Condition()
        self._left: dict[bool, float] = {False: float("inf"), True: float("inf")}
        self._is_shut = False
        self._links: list[socket.socket] = []
        self.passed_bytes = 0
        """Bytes of clients that were passed on."""
        self.passed_back_bytes = 0
        """Bytes of the service that were passed back."""
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def allow(self, count: float, *, back: bool = False) -> None:
        """Pass on so many more bytes of clients, or back to them, then hold back what comes."""
        with self._changed:
            self._left[back] = count
            self._changed.notify_all()

    def wait_until_used_up(self, deadline_s: float, *, back: bool = False) -> None:
        """Wait until the allowance is used up."""
        with self._changed:
            assert self._changed.wait_for(lambda: self._left[back] == 0, deadline_s), "too few bytes came"

    def lead_to(self, url: str) -> None:
        """Lead new connections to another service."""
        parts = urlsplit(url)
        self._upstream = (parts.hostname, parts.port)

    def cut(self) -> None:
        """End all connections."""
        with self._changed:
            links, self._links = self._links, []
            self._changed.notify_all()
        for link in links:
            with contextlib.suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()

    def shut(self, is_shut: bool) -> None:
        """Refuse all new connections, or no longer."""
        self._is_shut = is_shut

    def close(self) -> None:
        """End everything."""
        with contextlib.suppress(OSError):
            # wakes the thread that accepts
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.cut()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            if self._is_shut:
                client.close()
                continue
            service = socket.create_connection(self._upstream)
            with self._changed:
                self._links += [client, service]
            threading.Thread(target=self._pass_on, args=(client, service), daemon=True).start()
            threading.Thread(target=self._pass_back, args=(service, client), daemon=True).start()

    def _pass_on(self, client: socket.socket, service: socket.socket) -> None:
        self._pass(client, service, client, back=False)

    def _pass_back(self, service: socket.socket, client: socket.socket) -> None:
        self._pass(service, client, client, back=True)

    def _pass(self, source: socket.socket, sink: socket.socket, client: socket.socket, *, back: bool) -> None:
        with contextlib.suppress(OSError):
            while piece := source.recv(65_536):
                while piece:
                    with self._changed:
                        self._changed.wait_for(lambda: self._left[back] > 0 or client not in self._links)
                        if client not in self._links:
                            return
                        count = int(min(self._left[back], len(piece)))
                        self._left[back] -= count
                        if back:
                            self.passed_back_bytes += count
                        else:
                            self.passed_bytes += count
                        self._changed.notify_all()
                    sink.sendall(piece[:count])
                    piece = piece[count:]
            sink.shutdown(socket.SHUT_WR)


@contextlib.contextmanager
def gate_before(url: str) -> Iterator[Gate]:
    """A gate before a service."""
    gate = Gate(url)
    try:
        yield gate
    finally:
        gate.close()
