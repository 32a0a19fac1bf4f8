"""Many clients for minutes: what is lost or doubled, how long a call takes.

    python -m benchmarks.service_soak [--minutes 10] [--pollers 500] [--uploads 50] [--state DIR] [--tile FILE]
        [--megabytes 20]

Each of the clients that upload sends the tile with an Idempotency-Key, waits until its job has ended and begins again;
an answer that is lost is asked for again with the same key. As soon as there is a job, the others ask for the status
of one once a second. Jobs model a small window of the tile, so that the service, not the modelling, is under load.
When the time is over, all jobs must end, each exactly once. Every refusal must be a problem document that says when to
come again, and the API process must stay below 250 MiB. The tests of the service let its parts fail.
"""

from __future__ import annotations

import argparse
import asyncio
import concurrent.futures
import contextlib
import dataclasses
import json
import multiprocessing
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import laspy
import numpy as np

TILE = Path(__file__).resolve().parents[2] / "shared" / "data" / "ahn3" / "delft_east.laz"
MAX_API_MIB = 250.0
"""Limit of the API process."""
PAUSE_S = 1.0
"""Seconds that a poller waits between two calls."""
POINTS_IN_WINDOW = 8_000
LAST_JOBS_S = 900.0
"""How long the last jobs may take."""
LATER = {409, 429, 503, 507}
"""Refusals that pass; 409 while the first of two requests with one key is under way."""
GOES_ON = {"accepted", "running"}


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


def large_tile(source: Path, folder: Path, megabytes: int) -> tuple[Path, str]:
    """The points of a tile, over and over, as LAS of some size; and a small window in its middle."""
    cloud = laspy.read(source)
    wanted = megabytes * 10**6 // cloud.header.point_format.size
    cloud.points = cloud.points[np.arange(wanted) % len(cloud.points)]
    path = folder / "tile.las"
    cloud.write(path)
    middle = [np.median(cloud.x), np.median(cloud.y)]
    far = np.maximum(abs(cloud.x - middle[0]), abs(cloud.y - middle[1]))
    half = float(np.partition(far, POINTS_IN_WINDOW)[POINTS_IN_WINDOW])
    return path, ",".join(f"{v:.2f}" for v in (middle[0] - half, middle[1] - half, middle[0] + half, middle[1] + half))


@dataclasses.dataclass
class Seen:
    """What the clients of one process saw."""

    jobs: list[str] = dataclasses.field(default_factory=list)
    """Ids of the jobs that were made."""
    calls_s: list[float] = dataclasses.field(default_factory=list)
    """Seconds from each request for a status to its answer."""
    uploads_s: list[float] = dataclasses.field(default_factory=list)
    """Seconds from a tile's first byte to its job, with all refusals."""
    refusals: Counter[str] = dataclasses.field(default_factory=Counter)
    """Refusals by status and type."""
    lost_answers: int = 0
    """Requests whose connection broke."""
    faults: list[str] = dataclasses.field(default_factory=list)
    """What must not happen."""


class Uploaders:
    """Clients that send a tile as a job, wait until the job has ended and begin again."""

    def __init__(self, url: str, tile: Path, bbox: str, current: Connection) -> None:
        self._url, self._tile, self._current = url, tile, current
        self._fields = {"crs": "EPSG:28992", "bbox": bbox, "meshes": "none"}
        self._over = asyncio.Event()
        self.seen = Seen()

    def _refused(self, answer: httpx.Response) -> float:
        """Seconds to wait after a refusal, which must say why and until when."""
        try:
            problem = answer.json()
        except ValueError:
            problem = {}
        is_explained = problem.get("detail") and answer.status_code in LATER and "retry-after" in answer.headers
        if not is_explained:
            self.seen.faults.append(f"{answer.status_code} without a reason or Retry-After: {answer.text[:200]}")
        self.seen.refusals[f"{answer.status_code} {problem.get('type', '')}"] += 1
        return float(answer.headers.get("retry-after", 1.0))

    async def _ask(self, client: httpx.AsyncClient, job: str | None) -> dict[str, Any] | None:
        """The status of a job, or a new one, asked for until there is an answer and no refusal.

        None if the time is over with a refusal: it has left nothing behind.
        """
        key = {"Idempotency-Key": f'"{uuid.uuid4()}"'}
        while True:
            try:
                if job is None:
                    with self._tile.open("rb") as stream:
                        form = {"tile": (self._tile.name, stream)}
                        answer = await client.post("/jobs", files=form, data=self._fields, headers=key)
                else:
                    answer = await client.get(f"/jobs/{job}")
            except httpx.TransportError:
                self.seen.lost_answers += 1
                await asyncio.sleep(1.0)
                continue
            if answer.is_success:
                return answer.json()
            pause_s = self._refused(answer)
            if self._over.is_set():
                return None
            await _rest(self._over, min(pause_s, 30.0))

    async def _upload(self, client: httpx.AsyncClient, number: int) -> None:
        while not self._over.is_set():
            began = time.perf_counter()
            made = await self._ask(client, None)
            if made is None:
                return
            job = made["jobID"]
            self.seen.uploads_s.append(time.perf_counter() - began)
            self.seen.jobs.append(job)
            self._current.send((number, job))
            status = "accepted"
            while status in GOES_ON and not self._over.is_set():
                await _rest(self._over, 2.0)
                status = (await self._ask(client, job) or {}).get("status", "")

    async def run(self, seconds: float, uploads: int) -> None:
        """All at once, until the time is over."""
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=None)
        async with httpx.AsyncClient(base_url=self._url, timeout=120.0, limits=limits) as client:
            tasks = [asyncio.create_task(self._upload(client, number)) for number in range(uploads)]
            await asyncio.sleep(seconds)
            self._over.set()
            await asyncio.gather(*tasks)


class Pollers:
    """Clients that ask for the status of a job once a second."""

    def __init__(self, url: str, current: Connection) -> None:
        self._url, self._current = url, current
        self._jobs: dict[int, str] = {}
        self._over = asyncio.Event()
        self.seen = Seen()

    def _learn(self) -> None:
        """Take the news of which jobs there are."""
        while self._current.poll():
            number, self._jobs[number] = self._current.recv()

    async def _poll(self, number: int, pollers: int) -> None:
        await asyncio.sleep(PAUSE_S * number / pollers)
        poller = Poller(self._url)
        while not self._over.is_set():
            if not self._jobs:
                await _rest(self._over, PAUSE_S)
                continue
            job = list(self._jobs.values())[number % len(self._jobs)]
            began = time.perf_counter()
            try:
                status = await poller.get(f"/jobs/{job}")
            except (OSError, asyncio.IncompleteReadError, ValueError) as error:
                self.seen.faults.append(f"poll: {error!r}")
                poller.close()
                poller = Poller(self._url)
                status = 0
            self.seen.calls_s.append(time.perf_counter() - began)
            if status != 200:
                self.seen.refusals[f"{status} to a poll"] += 1
            await _rest(self._over, max(0.0, PAUSE_S - (time.perf_counter() - began)))
        poller.close()

    async def run(self, seconds: float, pollers: int) -> None:
        """All at once, until the time is over."""
        asyncio.get_running_loop().add_reader(self._current.fileno(), self._learn)
        tasks = [asyncio.create_task(self._poll(number, pollers)) for number in range(pollers)]
        await asyncio.sleep(seconds)
        self._over.set()
        await asyncio.gather(*tasks)


async def _rest(over: asyncio.Event, seconds: float) -> None:
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(over.wait(), seconds)


def clients(url: str, tile: Path, bbox: str, options: argparse.Namespace) -> tuple[Seen, Seen]:
    """What those that upload and those that poll saw.

    They have a process each: a poll must not wait for a client that is busy with another's upload.
    """
    seconds = 60.0 * options.minutes
    news, current = multiprocessing.Pipe(duplex=False)
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, spawn) as pool:
        uploading = pool.submit(_upload_all, url, tile, bbox, current, seconds, options.uploads)
        polling = Pollers(url, news)
        asyncio.run(polling.run(seconds, options.pollers))
        return uploading.result(), polling.seen


def _upload_all(url: str, tile: Path, bbox: str, current: Connection, seconds: float, uploads: int) -> Seen:
    uploading = Uploaders(url, tile, bbox, current)
    asyncio.run(uploading.run(seconds, uploads))
    return uploading.seen


def ended(url: str, jobs: list[str]) -> tuple[Counter[str], list[str]]:
    """How all jobs ended, and what is lost or doubled."""
    until = time.monotonic() + LAST_JOBS_S
    while True:
        listed: dict[str, str] = {}
        n_listed, page = 0, f"{url}/jobs?limit=1000"
        while page:
            document = httpx.get(page, timeout=60.0).json()
            n_listed += len(document["jobs"])
            listed |= {job["jobID"]: job["status"] for job in document["jobs"]}
            page = next((link["href"] for link in document["links"] if link["rel"] == "next"), "")
        waiting = [job for job, status in listed.items() if status in GOES_ON]
        if not waiting or time.monotonic() > until:
            break
        time.sleep(2.0)
    faults = [f"{job} did not end" for job in waiting]
    faults += [f"{job} is lost" for job in set(jobs) - set(listed)]
    if n_listed != len(jobs) or len(set(jobs)) != len(jobs):
        faults.append(f"{len(jobs)} jobs were answered, {len(set(jobs))} different; {n_listed} are listed")
    for job in (job for job, status in listed.items() if status == "failed"):
        message = httpx.get(f"{url}/jobs/{job}", timeout=60.0).json().get("message")
        print(f"{job} failed: {message}", file=sys.stderr)
    return Counter(listed.values()), faults


def main() -> int:
    """Load a service; 1 if something is lost, doubled, too large or refused without a reason."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--pollers", type=int, default=500)
    parser.add_argument("--uploads", type=int, default=50)
    parser.add_argument("--state", type=Path, help="a folder for everything; default a temporary one")
    parser.add_argument("--tile", type=Path, default=TILE)
    parser.add_argument("--megabytes", type=int, default=20)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="gablework-soak-", dir=options.state) as folder:
        tile, bbox = large_tile(options.tile, Path(folder), options.megabytes)
        with serving(Path(folder) / "state") as (url, pid):
            cpu_before_s = cpu_s(pid)
            uploading, polling = clients(url, tile, bbox, options)
            api_cpu_s = cpu_s(pid) - cpu_before_s
            _, peak = peak_mib(pid)
            ends, faults = ended(url, uploading.jobs)
            faults += uploading.faults + polling.faults
    if peak > MAX_API_MIB:
        faults.append(f"the API process took {peak:.0f} MiB, {MAX_API_MIB:.0f} are allowed")
    cuts = statistics.quantiles(polling.calls_s, n=100)
    spread = (cuts[49], cuts[94], cuts[98], max(polling.calls_s))
    figures = {
        "machine": f"{os.cpu_count()} cores",
        "jobs": f"{len(uploading.jobs)} with {tile.name} of {options.megabytes} MB: {json.dumps(dict(ends))}",
        "longest upload, with its refusals": f"{max(uploading.uploads_s):.1f} s",
        "status calls": f"{len(polling.calls_s)} of {options.pollers} pollers in {options.minutes:g} min",
        "status p50, p95, p99, max": f"{', '.join(f'{1e3 * s:.0f}' for s in spread)} ms",
        "refusals": json.dumps(dict(uploading.refusals + polling.refusals)),
        "answers that did not come": str(uploading.lost_answers),
        "API": f"{peak:.0f} MiB at most, {api_cpu_s:.0f} s of processor time",
        "lost, doubled or unexplained": "; ".join(faults[:20]) or "nothing",
    }
    for name, value in figures.items():
        print(f"{name:34} {value}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
