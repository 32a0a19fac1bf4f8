"""Many webhooks, some of them slow, beside a steady flow of jobs, against a separate `gablework serve`.

    python -m benchmarks.webhook_load [--webhooks 400] [--jobs 150] [--rate 1] [--events ends|status] [--minutes 10]

Four keys make the webhooks. A quarter of the receivers is slow: half of these answer after 8 s, the others never. So
many jobs per second are submitted, which do nothing (process `echo`). Each receiver is a port of this process with a
path per webhook. Reports the time from the event, as the message states it, to its arrival at the quick receivers; the
most rows that waited, and the size of the database at its end. Fails if a quick receiver misses the end of a job, or
above the limits of the design.
"""

from __future__ import annotations

import argparse
import asyncio
import datetime as dt
import json
import os
import re
import sqlite3
import statistics
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import httpx
import psutil  # type: ignore[import-untyped]

from benchmarks.service_load import cpu_s, serving
from service.keys import Scope, new_key
from service.settings import ServiceSettings
from service.store import JobStore

OWNERS = 4
SLOW_SHARE = 0.25
SLOW_S = 8.0
"""Seconds after which every second slow receiver answers; the others never do."""
MAX_P95_S = 5.0
MAX_ROWS = 10_000
"""Limits of the design."""
EVENTS = {
    "ends": ["job.successful", "job.failed", "job.dismissed"],
    "status": ["job.accepted", "job.running", "job.successful", "job.failed", "job.dismissed"],
}
ANSWER = b"HTTP/1.1 204 No Content\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
_LENGTH = re.compile(rb"content-length: *(\d+)", re.IGNORECASE)
_MESSAGE = re.compile(rb'"type":"([a-z.]+)","timestamp":"([^"]+)".*?"jobID":"([0-9a-f]+)"')


class Receivers:
    """Two ports: a quick one and a slow one."""

    def __init__(self) -> None:
        self.latencies_s: list[float] = []
        self.slow = 0
        self.busy = 0
        """Submissions that were refused for now, since the database was busy."""
        self.got: Counter[tuple[str, str, str]] = Counter()
        """Messages by path, event and job, at quick receivers."""

    async def quick(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Note the time and answer."""
        path, body = await _request(reader)
        found = _MESSAGE.search(body)
        assert found is not None, body[:200]
        at = dt.datetime.fromisoformat(found[2].decode())
        self.latencies_s.append((dt.datetime.now(dt.UTC) - at).total_seconds())
        self.got[path, found[1].decode(), found[3].decode()] += 1
        writer.write(ANSWER)
        writer.close()

    async def slow_one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer late, or wait until the sender gives up."""
        path, _ = await _request(reader)
        self.slow += 1
        if int(path.rpartition("/")[2]) % 2:
            await reader.read()
        else:
            await asyncio.sleep(SLOW_S)
            writer.write(ANSWER)
        writer.close()


async def _request(reader: asyncio.StreamReader) -> tuple[str, bytes]:
    head = await reader.readuntil(b"\r\n\r\n")
    length = _LENGTH.search(head)
    assert length is not None, head
    return head.split(b" ", 2)[1].decode(), await reader.readexactly(int(length[1]))


class Rows:
    """What the database holds, looked at from beside."""

    def __init__(self, state: Path) -> None:
        self._state = state
        self.most_waiting = 0

    def look(self) -> dict[str, int]:
        """Deliveries by state, and the events."""
        with sqlite3.connect(f"file:{self._state / 'service.db'}?mode=ro", uri=True, timeout=30.0) as connection:
            found = dict(connection.execute("SELECT state, count(*) FROM webhook_deliveries GROUP BY state").fetchall())
            found["events"] = connection.execute("SELECT count(*) FROM webhook_events").fetchone()[0]
            found["paused"] = connection.execute("SELECT count(paused_at) FROM webhooks").fetchone()[0]
        connection.close()
        self.most_waiting = max(self.most_waiting, found.get("waiting", 0))
        return found

    @property
    def mib(self) -> float:
        """Size of the database with its log."""
        return sum(path.stat().st_size for path in self._state.glob("service.db*")) / 2**20


async def load(url: str, keys: list[str], receivers: Receivers, rows: Rows, options: argparse.Namespace) -> list[str]:
    """Make the webhooks, submit the jobs, wait until all quick receivers have all; what is missing."""
    quick = await asyncio.start_server(receivers.quick, "127.0.0.1", options.quick_port, backlog=1024)
    slow = await asyncio.start_server(receivers.slow_one, "127.0.0.1", options.slow_port, backlog=1024)
    slow_number = round(options.webhooks * SLOW_SHARE)
    clients = [
        httpx.AsyncClient(base_url=url, timeout=60.0, headers={"Authorization": f"Bearer {key}"}) for key in keys
    ]
    paths = []
    for number in range(options.webhooks):
        is_slow = number < slow_number
        port, path = (options.slow_port, "/slow") if is_slow else (options.quick_port, "/quick")
        document = {"url": f"http://127.0.0.1:{port}{path}/{number}", "events": EVENTS[options.events]}
        answer = await clients[number % OWNERS].post("/webhooks", json=document)
        assert answer.status_code == 201, answer.text
        paths += [] if is_slow else [f"{path}/{number}"]
    jobs: list[str] = []
    began = time.monotonic()
    for number in range(options.jobs):
        await asyncio.sleep(max(0.0, began + number / options.rate - time.monotonic()))
        asked = {"inputs": {"message": f"hello {number}"}}
        while (
            answer := await clients[number % OWNERS].post("/processes/echo/execution", json=asked)
        ).status_code == 503:
            receivers.busy += 1
            await asyncio.sleep(float(answer.headers["Retry-After"]))
        assert answer.status_code == 201, answer.text
        jobs.append(answer.json()["jobID"])
        if number % 5 == 0:
            print(f"{number:4} jobs, {len(receivers.latencies_s):6} messages, {rows.look()}", file=sys.stderr)
    wanted = {(path, "job.successful", job) for path in paths for job in jobs}
    until = time.monotonic() + 60.0 * options.minutes
    while not wanted <= receivers.got.keys() and time.monotonic() < until:
        await asyncio.sleep(1.0)
        rows.look()
    missing = len(wanted - receivers.got.keys())
    for client in clients:
        await client.aclose()
    quick.close()
    slow.close()
    return [f"{missing} ends of jobs are missing at quick receivers"] if missing else []


def make_keys(state: Path) -> list[str]:
    """A key per owner, made before the service starts."""
    keys = []
    with JobStore(ServiceSettings(state=state).database) as store:
        store.migrate()
        for number in range(OWNERS):
            key, text = new_key(f"owner {number}", Scope.ADMIN, now=store.now())
            store.add_key(key)
            keys.append(text)
    return keys


def main() -> int:
    """Load a service; 1 where a message is missing or a limit is not kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--webhooks", type=int, default=400)
    parser.add_argument("--jobs", type=int, default=150)
    parser.add_argument("--rate", type=float, default=1.0, help="jobs per second")
    parser.add_argument("--events", choices=EVENTS, default="ends")
    parser.add_argument("--minutes", type=float, default=10.0, help="to wait for the last messages")
    parser.add_argument("--quick-port", type=int, default=39_201)
    parser.add_argument("--slow-port", type=int, default=39_202)
    options = parser.parse_args()
    origins = [f"http://127.0.0.1:{port}" for port in (options.quick_port, options.slow_port)]
    os.environ |= {"GABLEWORK_WEBHOOK_HOSTS": json.dumps(origins), "GABLEWORK_MAX_QUEUED_PER_KEY": "1000"}
    with tempfile.TemporaryDirectory(prefix="gablework-webhooks-") as folder:
        state = Path(folder) / "state"
        state.mkdir()
        keys = make_keys(state)
        receivers, rows = Receivers(), Rows(state)
        others = os.getloadavg()[0]
        with serving(state) as (url, pid):
            began = time.perf_counter()
            faults = asyncio.run(load(url, keys, receivers, rows, options))
            seconds = time.perf_counter() - began
            driver_s = sum(cpu_s(child.pid) for child in psutil.Process(pid).children())
            api_s, own_s, found = cpu_s(pid), time.process_time(), rows.look()
            mib = rows.mib
    cuts = statistics.quantiles(receivers.latencies_s, n=100)
    if cuts[94] > MAX_P95_S:
        faults.append(f"p95 of delivery is {cuts[94]:.1f} s, {MAX_P95_S:g} s are allowed")
    if rows.most_waiting > MAX_ROWS:
        faults.append(f"{rows.most_waiting} rows waited, {MAX_ROWS} are allowed")
    figures: dict[str, Any] = {
        "machine": f"{os.cpu_count()} cores, {others:.1f} busy processes before",
        "webhooks / jobs / events": f"{options.webhooks} / {options.jobs}, {options.rate:g} per s / {options.events}",
        "quick p50 / p95 / p99 / max": f"{cuts[49]:.2f} / {cuts[94]:.2f} / {cuts[98]:.2f} / "
        f"{max(receivers.latencies_s):.2f} s",
        "messages": f"{len(receivers.latencies_s)} quick, {receivers.slow} slow in {seconds:.0f} s, "
        f"{sum(count - 1 for count in receivers.got.values())} came again",
        "submissions put off": receivers.busy,
        "rows waiting at most": rows.most_waiting,
        "database at the end": f"{mib:.1f} MiB, {found}",
        "processor s": f"driver {driver_s:.1f}, API {api_s:.1f}, receivers and clients {own_s:.1f}",
        "faults": "; ".join(faults) or "none",
    }
    for name, value in figures.items():
        print(f"{name:28} {value}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
