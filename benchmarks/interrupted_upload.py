"""A large resumable upload that is interrupted again and again: the bytes that were sent, relative to its size.

    python benchmarks/interrupted_upload.py [--megabytes 2000] [--interruptions 10] [--state DIR] [--syncs]

Writes a LAS file, starts `gablework serve` and sends the file by tus. Each interruption is one of: the client resets
the connection, the client falls silent with an open connection, the server is killed and started again. Then the client
asks for the offset and continues there. Bytes count as sent when they have left the client's system (Linux reports
that), whether they were received or not. With `--syncs` it measures how long writing takes for different intervals of
syncing instead.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import datetime as dt
import fcntl
import hashlib
import itertools
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import laspy
import numpy as np
import pyproj

from service import resumable
from service.files import StateFolder
from service.uploads import BLOCK_BYTES

PIECE_BYTES = 1 << 18
CHUNK_POINTS = 1_000_000
TUS = {"Tus-Resumable": "1.0.0"}
WAYS = ("reset", "silent", "killed server")
"""Ways in which a request ends, in turn."""
SIOCOUTQNSD = 0x894B
"""Linux: asks for the bytes of a socket that are not sent yet."""
RETRY_S = 0.2
"""Seconds before the client asks again."""


class Served:
    """A service on a port of its own, which can be killed and started again."""

    def __init__(self, state: Path) -> None:
        with socket.socket() as listener:
            listener.bind(("127.0.0.1", 0))
            self._port = listener.getsockname()[1]
        self.url = f"http://127.0.0.1:{self._port}"
        self._state = state
        self.start()

    def start(self) -> None:
        """Start it and wait for an answer."""
        command = [sys.executable, "-c", "from service.cli import main; main()", "serve", "--no-driver"]
        command += ["--port", str(self._port), "--state", str(self._state)]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        while True:
            with contextlib.suppress(httpx.TransportError):
                httpx.get(f"{self.url}/healthz").raise_for_status()
                return
            if self._process.poll() is not None:
                sys.exit("the service did not start")
            time.sleep(RETRY_S)

    def kill(self) -> None:
        """End it as a crash would."""
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()


def write_las(path: Path, size_bytes: int) -> None:
    """A LAS file of about so many bytes; incompressible where that matters."""
    header = laspy.LasHeader(version="1.2", point_format=1)
    header.scales = np.full(3, 0.01)
    header.add_crs(pyproj.CRS.from_epsg(28992))
    points = laspy.ScaleAwarePointRecord.zeros(CHUNK_POINTS, header=header)
    rng = np.random.default_rng(7)
    for name in ("X", "Y", "Z"):
        points[name] = rng.integers(0, 10_000_000, CHUNK_POINTS)
    left = size_bytes // header.point_format.size
    with laspy.open(path, mode="w", header=header) as writer:
        while left > 0:
            writer.write_points(points[: min(left, CHUNK_POINTS)])
            left -= CHUNK_POINTS


def offset_of(url: str) -> tuple[int, float]:
    """The offset, and the seconds until the service said it."""
    begun = time.perf_counter()
    while True:
        with contextlib.suppress(httpx.TransportError):
            answer = httpx.head(url, headers=TUS, timeout=300.0)
            if answer.status_code != httpx.codes.LOCKED:
                answer.raise_for_status()
                return int(answer.headers["Upload-Offset"]), time.perf_counter() - begun
        time.sleep(RETRY_S)


@contextlib.contextmanager
def patching(url: str, offset: int, length: int) -> Iterator[socket.socket]:
    """A connection with the head of a request."""
    parts = urlsplit(url)
    lines = [f"PATCH {parts.path} HTTP/1.1", f"Host: {parts.netloc}", "Tus-Resumable: 1.0.0"]
    lines += ["Content-Type: application/offset+octet-stream", f"Upload-Offset: {offset}", f"Content-Length: {length}"]
    with socket.create_connection((parts.hostname, parts.port), timeout=300.0) as link:
        link.sendall("\r\n".join([*lines, "", ""]).encode())
        yield link


def send(link: socket.socket, path: Path, begin: int, end: int) -> int:
    """Send a part of the file; the bytes that the system took."""
    sent = 0
    with path.open("rb") as stream:
        stream.seek(begin)
        while sent < end - begin:
            piece = memoryview(stream.read(min(PIECE_BYTES, end - begin - sent)))
            while piece:
                taken = link.send(piece)
                sent += taken
                piece = piece[taken:]
    return sent


def unsent(link: socket.socket) -> int:
    """Bytes that still wait in this system."""
    (count,) = struct.unpack("i", fcntl.ioctl(link, SIOCOUTQNSD, bytes(4)))
    return int(count)


def interrupted(served: Served, path: Path, interruptions: int) -> None:
    """Send the file with interruptions and print what it cost."""
    size = path.stat().st_size
    metadata = f"filename {base64.b64encode(path.name.encode()).decode()}"
    made = httpx.post(
        f"{served.url}/uploads/tus", headers={**TUS, "Upload-Length": str(size), "Upload-Metadata": metadata}
    )
    made.raise_for_status()
    url, sent, begun = made.headers["Location"], 0, time.perf_counter()
    rng = np.random.default_rng(11)
    cuts = np.sort(rng.integers(size // 50, size, interruptions))
    silent: list[socket.socket] = []
    for way, cut in zip(itertools.cycle(WAYS), cuts.tolist(), strict=False):
        at, _ = offset_of(url)
        with patching(url, at, size - at) as link:
            more = send(link, path, at, max(cut, at))
            # those of a silent client still go out
            more -= 0 if way == "silent" else unsent(link)
            sent += more
            if way == "reset":
                link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            elif way == "silent":
                silent.append(link.dup())
            else:
                served.kill()
        if way == "killed server":
            served.start()
        kept, waited_s = offset_of(url)
        lost = at + more - kept
        print(f"{way:14} {more / 1e6:8.1f} MB sent, {lost / 1e6:6.2f} MB lost, offset after {waited_s:.2f} s")
    at, _ = offset_of(url)
    with patching(url, at, size - at) as link:
        sent += send(link, path, at, size)
        last = time.perf_counter()
        assert b" 204 " in link.recv(65_536).split(b"\r\n")[0]
    done = time.perf_counter()
    print(f"last answer {done - last:.1f} s after the last byte; {done - begun:.1f} s in all")
    stored = httpx.get(url.replace("/tus/", "/")).raise_for_status().json()
    with path.open("rb") as stream:
        assert stored["sha256"] == hashlib.file_digest(stream, "sha256").hexdigest(), "the stored file differs"
    print(f"sent / size = {sent / size:.4f} for {size / 1e6:.0f} MB and {interruptions} interruptions")
    for link in silent:
        link.close()


def sync_times(state: Path, size_bytes: int) -> None:
    """Print the time to store so many bytes for different intervals of syncing."""
    folder = StateFolder(state)
    folder.make()
    block = os.urandom(BLOCK_BYTES)
    for megabytes in (0.25, 1, 4, 16, 64, 256, 10**6):
        resumable.SYNC_BYTES = int(megabytes * 2**20)
        promise = resumable.Promise(
            upload_id=resumable.new_id(), owner=None, filename="a.las", size_bytes=size_bytes, sha256=None, metadata=""
        )
        soon = dt.datetime.now(dt.UTC) + dt.timedelta(hours=1)
        resumable.create(folder, promise, soon, most=10)
        held = resumable.Unfinished(folder, promise)
        held.recover()
        begun = time.perf_counter()
        held.begin(soon, is_checked=False)
        for _ in range(size_bytes // BLOCK_BYTES):
            held.write(block)
        held.end()
        seconds = time.perf_counter() - begun
        held.remove()
        held.close()
        print(f"synced every {megabytes:>8g} MiB: {size_bytes / seconds / 1e6:6.0f} MB/s")


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--megabytes", type=int, default=2000)
    parser.add_argument("--interruptions", type=int, default=10)
    parser.add_argument("--state", type=Path, help="folder on the disk to be measured; default a temporary one")
    parser.add_argument("--syncs", action="store_true", help="measure the intervals of syncing")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.state) as folder:
        state = Path(folder) / "state"
        if given.syncs:
            sync_times(state, given.megabytes * 1_000_000)
            return
        path = Path(folder) / "large.las"
        write_las(path, given.megabytes * 1_000_000)
        served = Served(state)
        try:
            interrupted(served, path, given.interruptions)
        finally:
            served.kill()


if __name__ == "__main__":
    main()
