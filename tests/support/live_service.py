"""The application under a real server on a free port, for tests that speak HTTP; and small files to send."""

import contextlib
import io
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import laspy
import numpy as np
import pyproj
import uvicorn
from processes import wait_for

from service.app import create_app
from service.connections import listen, server_config
from service.keys import Scope, new_key
from service.settings import ServiceSettings
from service.store import JobStore

POINTS = b"".join(b"%d.0 %d.0 3.5\n" % (84_000 + x, 447_000 + y) for x in range(20) for y in range(20))
"""A point cloud as text, small and valid."""

DEADLINE_S = 60.0
"""For what takes a moment on a quiet machine; not a promise of speed."""


def settings_in(folder: Path, **values: Any) -> ServiceSettings:
    """Settings with the state in a folder, on loopback."""
    return ServiceSettings(state=folder / "state", **values)


@contextlib.contextmanager
def serving(settings: ServiceSettings) -> Iterator[str]:
    """The service's URL, while a server in a thread answers it."""
    listener, url = listen(settings.model_copy(update={"host": "127.0.0.1", "port": 0}))
    with listener:
        server = uvicorn.Server(server_config(create_app(settings), settings, log_level="warning", lifespan="on"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            wait_for(lambda: server.started or not thread.is_alive(), "the start of the server")
            assert server.started, "the server ended while it started"
            yield url
        finally:
            server.should_exit = True
            thread.join(DEADLINE_S)


@contextlib.contextmanager
def raw_request(url: str, line: str, body: bytes = b"", **headers: str) -> Iterator[socket.socket]:
    """A connection over which a request was sent byte by byte as it is written here: no client tidies it."""
    parts = urlsplit(url)
    with socket.create_connection((parts.hostname, parts.port), timeout=DEADLINE_S) as link:
        reported = {"Host": parts.netloc} | {name.replace("_", "-"): value for name, value in headers.items()}
        head = "".join(f"{name}: {value}\r\n" for name, value in reported.items())
        link.sendall(f"{line} HTTP/1.1\r\n{head}\r\n".encode() + body)
        yield link


def answer_to(url: str, line: str, body: bytes = b"", **headers: str) -> bytes:
    """All that the server answers to such a request."""
    answer = b""
    with raw_request(url, line, body, Connection="close", **headers) as link:
        while piece := link.recv(65_536):
            answer += piece
    return answer


def add_key(settings: ServiceSettings, scope: Scope) -> tuple[str, str]:
    """A new key in the settings' database: its id, and the header that carries it."""
    with JobStore(settings.database) as store:
        store.migrate()
        key, secret = new_key(f"a {scope} key", scope, now=store.now())
        store.add_key(key)
    return key.key_id, f"Bearer {secret}"


def las_bytes(n: int = 1000, *, crs: str | None = "EPSG:28992", compressed: bool = True) -> bytes:
    """A LAS or LAZ file with so many points around Delft."""
    rng = np.random.default_rng(7)
    header = laspy.LasHeader(version="1.2", point_format=1)
    header.scales = np.full(3, 0.01)
    header.offsets = np.array([84_000.0, 447_000.0, 0.0])
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = rng.uniform(84_000, 84_100, n), rng.uniform(447_000, 447_100, n), rng.uniform(0, 20, n)
    las.return_number = las.number_of_returns = np.ones(n, dtype=np.uint8)
    stream = io.BytesIO()
    las.write(stream, do_compress=compressed)
    return stream.getvalue()
