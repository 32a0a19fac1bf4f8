"""An S3 server for tests, and a proxy in front of it that fails as a script says, and counts."""

import contextlib
import dataclasses
import http.client
import logging
import re
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self

SECRET = "wJalrXUtnFEMI-not-a-real-key"
"""The secret key of the tests: it must be found nowhere."""
HOP_BY_HOP = {"connection", "transfer-encoding", "keep-alive", "content-length", "date", "server"}
SLOW_DOWN = b"<?xml version='1.0'?><Error><Code>SlowDown</Code><Message>Reduce your request rate.</Message></Error>"
DENIED = b"<?xml version='1.0'?><Error><Code>AccessDenied</Code><Message>Access Denied</Message></Error>"


def environment(endpoint: str) -> dict[str, str]:
    """What a process needs to know of a server."""
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_REGION": "us-east-1",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
        "AWS_CONFIG_FILE": "/dev/null",
        "AWS_SHARED_CREDENTIALS_FILE": "/dev/null",
    }


@contextlib.contextmanager
def moto_server() -> Iterator[str]:
    """Moto's S3 server in threads of this process; its URL."""
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        yield f"http://{host}:{port}"
    finally:
        server.stop()


@dataclasses.dataclass(frozen=True)
class Request:
    """What the script is asked about."""

    number: int
    """From 1, over all requests."""
    method: str
    path: str
    """With bucket and key, and the query."""


Script = Callable[[Request], str]
"""What is to become of a request: `pass`, or one of those of `FaultyProxy`."""


@dataclasses.dataclass
class FaultyProxy:
    """Passes requests on to a server, or not.

    | word | what happens |
    | --- | --- |
    | `pass` | it is passed on and answered |
    | `busy` | 503 with the code SlowDown; the server never sees it |
    | `denied` | 403; the server never sees it |
    | `cut` | the connection is closed; the server never sees it |
    | `lost` | it is passed on, and the connection is closed in place of the answer |
    | `half` | it is passed on, and the connection is closed after half of the answer |
    | `silent` | it is passed on, and nothing is said until the client goes away |
    | `late` | it is passed on, and answered after a quarter of a second |
    """

    target: str
    script: Script = lambda _: "pass"
    seen: list[tuple[Request, str]] = dataclasses.field(default_factory=list)
    """Every request and what became of it."""
    endpoint: str = ""
    _lock: threading.Lock = dataclasses.field(default_factory=threading.Lock)

    def __enter__(self) -> Self:
        proxy = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle_one(self) -> None:
                proxy._handle(self)

            do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = handle_one  # noqa: N815 - the library's names

            def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the library's name
                del format, args

        class Server(ThreadingHTTPServer):
            daemon_threads = True

            def handle_error(self, request: Any, client_address: Any) -> None:
                del request, client_address  # clients that went away are what is tested

        self._server = Server(("127.0.0.1", 0), Handler)
        self.endpoint = f"http://127.0.0.1:{self._server.server_address[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def reset(self) -> None:
        """Pass everything, and begin to count."""
        self.script = lambda _: "pass"
        self.seen = []

    def count(self, what: str = "", method: str = "", path: str = "") -> int:
        """How many requests of a kind came: by what became of them, their method, a part of their path."""
        return sum(
            (not what or reported == what)
            and (not method or r.method == method)
            and re.search(path, r.path) is not None
            for r, reported in self.seen
        )

    def _handle(self, client: BaseHTTPRequestHandler) -> None:
        body = _body(client)
        with self._lock:
            request = Request(len(self.seen) + 1, client.command, client.path)
            what = self.script(request)
            self.seen.append((request, what))
        client.close_connection = True
        if what == "cut":
            return
        if what in {"busy", "denied"}:
            status, text = (503, SLOW_DOWN) if what == "busy" else (403, DENIED)
            _answer(client, status, [("Content-Type", "application/xml")], text)
            return
        status, headers, content, length = self._passed_on(client, body)
        if what == "lost" or (what == "half" and client.command == "HEAD"):
            return  # what has no body is not cut in half
        if what == "silent":
            client.connection.recv(1)  # until the client closes its end
            return
        if what == "late":
            time.sleep(0.25)
        if what == "half":
            _answer(client, status, headers, content[: len(content) // 2], promised=len(content))
            return
        client.close_connection = False
        _answer(client, status, headers, content, promised=length)

    def _passed_on(
        self, client: BaseHTTPRequestHandler, body: bytes
    ) -> tuple[int, list[tuple[str, str]], bytes, int | None]:
        host, _, port = self.target.rpartition("://")[2].partition(":")
        connection = http.client.HTTPConnection(host, int(port))
        headers = {k: v for k, v in client.headers.items() if k.lower() not in {"expect", "transfer-encoding"}}
        connection.request(client.command, client.path, body=body, headers=headers)
        response = connection.getresponse()
        content = response.read()
        kept = [(k, v) for k, v in response.getheaders() if k.lower() not in HOP_BY_HOP]
        reported = response.getheader("Content-Length")
        connection.close()
        return response.status, kept, content, int(reported) if client.command == "HEAD" and reported else None


def _body(client: BaseHTTPRequestHandler) -> bytes:
    if "chunked" not in client.headers.get("Transfer-Encoding", ""):
        return client.rfile.read(int(client.headers.get("Content-Length", 0)))
    parts = []
    while size := int(client.rfile.readline().split(b";")[0], 16):
        parts.append(client.rfile.read(size))
        client.rfile.readline()
    client.rfile.readline()
    return b"".join(parts)


def _answer(
    client: BaseHTTPRequestHandler,
    status: int,
    headers: list[tuple[str, str]],
    content: bytes,
    promised: int | None = None,
) -> None:
    client.send_response(status)
    for name, value in headers:
        client.send_header(name, value)
    client.send_header("Content-Length", str(len(content) if promised is None else promised))
    client.end_headers()
    if client.command != "HEAD":
        client.wfile.write(content)
    client.wfile.flush()
