"""A separate `gablework serve`, what it takes of the machine, and a client that polls it; for `service_soak.py`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit


@contextlib.contextmanager
def serving(state: Path, *options: str) -> Iterator[tuple[str, int]]:
    """URL and process id of a service."""
    # all clients share an address here: the limits of one address are not what is measured
    limits = {"GABLEWORK_RATE_LIMIT": "1000000/minute", "GABLEWORK_MAX_CONNECTIONS_PER_ADDRESS": "10000"}
    environment = os.environ | limits | {"GABLEWORK_DRAIN_S": "0"}
    command = [sys.executable, "-m", "service.cli", "serve", "--json", "--port", "0", "--state", str(state), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        reported = ""
        while not reported.rstrip().endswith("}"):
            line = process.stdout.readline()
            if not line:
                raise SystemExit(f"serve ended with {process.wait()}")
            reported += line
        try:
            yield json.loads(reported)["url"], process.pid
        finally:
            process.send_signal(signal.SIGTERM)


def peak_mib(pid: int) -> tuple[float, float]:
    """Resident memory of a process in MiB: now, and at its highest."""
    status = Path(f"/proc/{pid}/status").read_text()
    now, peak = (int(re.search(rf"{name}:\s+(\d+) kB", status)[1]) / 1024 for name in ("VmRSS", "VmHWM"))  # type: ignore[index]
    return now, peak


def cpu_s(pid: int) -> float:
    """Processor seconds that a process took so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Poller:
    """One client with one connection, written by hand: hundreds of them must not be what is measured."""

    def __init__(self, url: str) -> None:
        self._host = urlsplit(url)
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def get(self, path: str) -> int:
        """The status of an answer, once all of it is here."""
        if self._streams is None:
            self._streams = await asyncio.open_connection(self._host.hostname, self._host.port)
        reader, writer = self._streams
        writer.write(f"GET {path} HTTP/1.1\r\nHost: {self._host.netloc}\r\n\r\n".encode())
        head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
        await reader.readexactly(int(head.partition("content-length: ")[2].partition("\r\n")[0]))
        return int(head.split(" ", 2)[1])

    def close(self) -> None:
        """Close the connection."""
        if self._streams is not None:
            self._streams[1].close()
