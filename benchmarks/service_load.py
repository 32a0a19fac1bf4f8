"""Many uploads at once beside many pollers, against a separate `gablework serve`.

    python benchmarks/service_load.py [--tile FILE] [--uploads 50] [--pollers 200] [--with-driver]

Sends the tile as many jobs at once while pollers request the status of the submitted jobs. Checks that no job and
no upload is lost or doubled and that every stored file has the SHA-256 of the tile; reports the peak memory of the API
process (the kernel's own high-water mark) and the duration of the status calls. Fails above the limits of the design.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hashlib
import json
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx

TILE = Path(__file__).resolve().parents[2] / "shared" / "data" / "ahn3" / "delft_east.laz"
MAX_API_MIB = 250.0
"""Limit of the API process."""
PAUSE_S = 1.0
"""Seconds that a poller waits between two calls."""
REST_S = 5.0
"""Seconds that the pollers go on when the last upload is through."""


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


class Load:
    """The clients."""

    def __init__(self, url: str, tile: Path) -> None:
        self._url = url
        self._tile = tile
        self.jobs: list[str] = []
        self.calls_s: list[float] = []
        self.uploads_s: list[float] = []
        self.faults: list[str] = []
        self._over = asyncio.Event()

    async def submit(self, client: httpx.AsyncClient) -> None:
        """Send the tile as a job."""
        began = time.perf_counter()
        with self._tile.open("rb") as stream:
            form = {"tile": (self._tile.name, stream)}
            answer = await client.post("/jobs", files=form, data={"crs": "EPSG:28992"})
        self.uploads_s.append(time.perf_counter() - began)
        if answer.status_code == 201:
            self.jobs.append(answer.json()["jobID"])
        else:
            self.faults.append(f"upload: {answer.status_code} {answer.text[:200]}")

    async def poll(self, number: int) -> None:
        """Ask for a job's status, or for the list while there is none, until all is over."""
        await asyncio.sleep(PAUSE_S * (number % 20) / 20.0)
        poller = Poller(self._url)
        while not self._over.is_set():
            path = f"/jobs/{self.jobs[number % len(self.jobs)]}" if self.jobs else "/jobs?limit=10"
            began = time.perf_counter()
            status = await poller.get(path)
            self.calls_s.append(time.perf_counter() - began)
            if status != 200:
                self.faults.append(f"poll: {status}")
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._over.wait(), PAUSE_S)
        poller.close()

    async def run(self, uploads: int, pollers: int) -> None:
        """All at once; the pollers start first and end last."""
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=None)
        client = httpx.AsyncClient(base_url=self._url, timeout=600.0, limits=limits)
        polling = [asyncio.create_task(self.poll(number)) for number in range(pollers)]
        await asyncio.sleep(PAUSE_S)
        async with client:
            await asyncio.gather(*(self.submit(client) for _ in range(uploads)))
        await asyncio.sleep(REST_S)
        self._over.set()
        await asyncio.gather(*polling)


def stored_faults(url: str, state: Path, jobs: list[str], sha256: str) -> list[str]:
    """What is lost or doubled."""
    faults = []
    listed = [job["jobID"] for job in httpx.get(f"{url}/jobs?limit=1000", timeout=60.0).json()["jobs"]]
    if len(set(jobs)) != len(jobs) or sorted(listed) != sorted(jobs):
        faults.append(f"{len(jobs)} jobs were answered, {len(set(jobs))} different; {len(listed)} are listed")
    files = [path for path in (state / "uploads").rglob("*") if path.is_file()]
    digests = {hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    if len(files) != len(jobs) or digests != {sha256}:
        faults.append(f"{len(files)} files for {len(jobs)} jobs, {len(digests)} different contents")
    tiles = [
        tile["href"]
        for job in jobs
        for tile in httpx.get(f"{url}/jobs/{job}", timeout=60.0).json()["request"]["inputs"]["tiles"]
    ]
    reported = {httpx.get(tile, timeout=60.0).json()["sha256"] for tile in tiles}
    if len(set(tiles)) != len(jobs) or reported != {sha256}:
        faults.append(f"{len(set(tiles))} uploads for {len(jobs)} jobs, reported with the hashes {sorted(reported)}")
    return faults


def main() -> int:
    """Load a service; 1 where something is lost, doubled or too large."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tile", type=Path, default=TILE)
    parser.add_argument("--uploads", type=int, default=50)
    parser.add_argument("--pollers", type=int, default=200)
    parser.add_argument("--with-driver", action="store_true", help="let a driver work on the jobs meanwhile")
    options = parser.parse_args()
    sha256 = hashlib.sha256(options.tile.read_bytes()).hexdigest()
    with tempfile.TemporaryDirectory(prefix="gablework-load-") as folder:
        state = Path(folder) / "state"
        with serving(state, *([] if options.with_driver else ["--no-driver"])) as (url, pid):
            at_rest, _ = peak_mib(pid)
            load = Load(url, options.tile)
            others = os.getloadavg()[0]
            began, cpu_before_s = time.perf_counter(), cpu_s(pid)
            asyncio.run(load.run(options.uploads, options.pollers))
            seconds, api_cpu_s = time.perf_counter() - began, cpu_s(pid) - cpu_before_s
            after, peak = peak_mib(pid)
            faults = [*load.faults, *stored_faults(url, state, load.jobs, sha256)]
    if peak > MAX_API_MIB:
        faults.append(f"the API process took {peak:.0f} MiB, {MAX_API_MIB:.0f} are allowed")
    cuts = statistics.quantiles(load.calls_s, n=100)
    figures: dict[str, Any] = {
        "machine": f"{os.cpu_count()} cores, {others:.1f} busy processes before",
        "uploads": f"{len(load.jobs)} of {options.uploads}, {options.tile.stat().st_size} bytes each",
        "slowest upload": f"{max(load.uploads_s):.1f} s",
        "status calls": f"{len(load.calls_s)} of {options.pollers} pollers in {seconds:.0f} s",
        "status p50 / p95 / max": f"{cuts[49] * 1e3:.0f} / {cuts[94] * 1e3:.0f} / {max(load.calls_s) * 1e3:.0f} ms",
        "API at rest / after / peak": f"{at_rest:.0f} / {after:.0f} / {peak:.0f} MiB",
        "API processor time": f"{api_cpu_s:.1f} s, {100.0 * api_cpu_s / seconds:.0f} % of a core",
        "lost or doubled": "; ".join(faults) or "nothing",
    }
    for name, value in figures.items():
        print(f"{name:28} {value}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
