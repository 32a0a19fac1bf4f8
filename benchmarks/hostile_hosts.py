"""Hosts and clients that are slow on purpose, against `gablework serve`: how long each keeps a slot or a connection.

    python benchmarks/hostile_hosts.py [--tempers body,headers] [--cancel-after 3] [--only hosts|cancel|clients|flood]

- hosts: for each temper of `tests/hostile_host.py` a job whose tile is at such a host (a byte a second), and the
  seconds until it has ended and a job that waited for its slot runs. The driver has one slot.
- cancel: the same, but the job is dismissed by DELETE a few seconds after it began.
- clients: connections that send a head, a body or nothing, or read an answer, a byte a second; and an upload with 2 kB
  per second, which must live.
- flood: more connections than the service takes, half of them in the middle of a body, and how long /healthz takes.

All of it stays on loopback.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from hostile_host import TRICKLING, HostileHost, hostile_host

TEMPERS = (*TRICKLING, "silence", "stop", "hints", "heads", "busy")
LOOK_S = 0.05
LONGEST_S = 400.0
"""Seconds after which a wait counts as endless."""
SLOW_BYTES_PER_S = 2000
SLOW_UPLOAD_S = 130
FLOOD = 2000
OVER = {"successful", "failed", "dismissed"}


@contextlib.contextmanager
def serving(state: Path, hosts: list[str]) -> Iterator[str]:
    """The URL of a service with one slot that may fetch from the hosts."""
    environment = os.environ | {
        "GABLEWORK_INPUT_HOSTS": json.dumps(hosts),
        "GABLEWORK_DRIVER_JOBS": "1",
        "GABLEWORK_DRAIN_S": "0",
        "GABLEWORK_WORKERS": "1",
    }
    command = [sys.executable, "-m", "service.cli", "serve", "--json", "--port", "0", "--state", str(state)]
    log = (state.parent / "serve.log").open("w")
    with log, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment) as process:
        assert process.stdout is not None
        reported = ""
        while not reported.rstrip().endswith("}"):
            line = process.stdout.readline()
            if not line:
                raise SystemExit(f"serve ended with {process.wait()}")
            reported += line
        try:
            yield json.loads(reported)["url"]
        finally:
            process.send_signal(signal.SIGTERM)


def until(condition: Callable[[], bool]) -> float:
    """Seconds until a condition holds."""
    began_s = time.monotonic()
    while not condition():
        if time.monotonic() - began_s > LONGEST_S:
            return float("inf")
        time.sleep(LOOK_S)
    return time.monotonic() - began_s


class Jobs:
    """The jobs of a service."""

    def __init__(self, url: str) -> None:
        self._client = httpx.Client(base_url=url, timeout=30.0)

    def submit(self, tile: str) -> str:
        """A new job with a tile; its id."""
        document = {"inputs": {"tiles": [{"href": tile}]}}
        answer = self._client.post(
            "/processes/reconstruct/execution", json=document, headers={"Prefer": "respond-async"}
        )
        answer.raise_for_status()
        job_id: str = answer.json()["jobID"]
        return job_id

    def job(self, job_id: str) -> dict[str, Any]:
        """A job as it is now."""
        found: dict[str, Any] = self._client.get(f"/jobs/{job_id}").json()
        return found

    def is_over(self, job_id: str) -> bool:
        """Whether a job has ended."""
        return self.job(job_id)["status"] in OVER

    def has_begun(self, job_id: str) -> bool:
        """Whether a job has left the queue."""
        return self.job(job_id)["status"] != "accepted"

    def dismiss(self, job_id: str) -> None:
        """Dismiss a job."""
        self._client.delete(f"/jobs/{job_id}").raise_for_status()


def measured_hosts(url: str, host: HostileHost, tempers: list[str], cancel_after_s: float | None) -> None:
    """Print how long each host keeps the slot."""
    jobs = Jobs(url)
    for temper in tempers:
        before = len(host.requests)
        job = jobs.submit(host.url(temper))
        waiting = jobs.submit(f"http://{host.origin}/short/a.laz")
        began_s = until(lambda: len(host.requests) > before)  # noqa: B023 - called before the next turn
        assert not jobs.has_begun(waiting), "the driver has more than one slot"
        if cancel_after_s is not None:
            time.sleep(cancel_after_s)
        since_s = time.monotonic()
        if cancel_after_s is not None:
            jobs.dismiss(job)
        until(lambda: jobs.is_over(job))  # noqa: B023
        over_s = time.monotonic() - since_s
        until(lambda: jobs.has_begun(waiting))  # noqa: B023
        free_s = time.monotonic() - since_s
        found = jobs.job(job)
        detail = str(found.get("exception", {}).get("detail", ""))
        what = "from DELETE" if cancel_after_s is not None else "from its first request"
        print(
            f"{temper:10s} asked after {began_s:4.1f} s; {what}: over {over_s:6.2f} s, slot free {free_s:6.2f} s; "
            f"{found['status']}: {detail[:150]}",
            flush=True,
        )
        jobs.dismiss(waiting)
        until(lambda: jobs.is_over(waiting))  # noqa: B023


def measured_clients(url: str) -> None:
    """Print how long the service lets each kind of client stay."""
    place = urlsplit(url)
    post = (
        f"POST /uploads?filename=a.xyz HTTP/1.1\r\nHost: {place.netloc}\r\nContent-Length: 100000000\r\n\r\n".encode()
    )
    get = f"GET /openapi.json HTTP/1.1\r\nHost: {place.netloc}\r\n".encode()
    clients: dict[str, tuple[bytes, bytes, float]] = {
        # what is sent at once, what follows, and with how many bytes per second
        "sends nothing": (b"", b"", 0.0),
        "sends a head, 1 B/s": (get[:40], b"X" * 10_000, 1.0),
        "sends a body, 1 B/s": (post, b"1" * 10_000, 1.0),
        "sends a body, 500 B/s": (post, b"1" * 1_000_000, 500.0),
        "stops in a body": (post + b"1 2 3\n", b"", 0.0),
        f"sends a body, {SLOW_BYTES_PER_S} B/s": (post, b"1" * SLOW_BYTES_PER_S * SLOW_UPLOAD_S, SLOW_BYTES_PER_S),
    }

    def run(name: str, first: bytes, rest: bytes, rate: float) -> None:
        began_s = time.monotonic()
        with socket.create_connection((place.hostname, place.port)) as link:
            link.sendall(first)
            link.settimeout(0.0)
            answer, sent, closed = b"", 0, False
            while not closed and time.monotonic() - began_s < SLOW_UPLOAD_S:
                try:
                    piece = link.recv(65_536)
                    answer, closed = answer + piece, not piece
                except BlockingIOError:
                    due = int(rate * (time.monotonic() - began_s))
                    if due > sent:
                        sent += link.send(rest[sent:due]) if rest[sent:due] else 0
                    time.sleep(0.2)
                except ConnectionError:
                    closed = True
        line = answer.partition(b"\r\n")[0].decode() or "no answer"
        print(
            f"{name:25s} {'closed' if closed else 'still open'} after {time.monotonic() - began_s:6.1f} s; {line}",
            flush=True,
        )

    threads = [threading.Thread(target=run, args=(name, *values)) for name, values in clients.items()]
    for thread in threads:
        thread.start()
    slowest = 0.0
    while any(thread.is_alive() for thread in threads):
        began_s = time.monotonic()
        httpx.get(f"{url}/healthz").raise_for_status()
        slowest = max(slowest, time.monotonic() - began_s)
        time.sleep(0.5)
    print(f"/healthz meanwhile: {1e3 * slowest:.0f} ms at most")


def measured_flood(url: str) -> None:
    """Print how long /healthz takes beside more connections than the service takes."""
    place = urlsplit(url)
    post = (
        f"POST /uploads?filename=a.xyz HTTP/1.1\r\nHost: {place.netloc}\r\nContent-Length: 100000000\r\n\r\n1".encode()
    )
    with contextlib.ExitStack() as stack:
        ended = 0
        for number in range(FLOOD):
            try:
                link = stack.enter_context(socket.create_connection((place.hostname, place.port)))
                link.sendall(post if number % 2 else b"GET /")
            except OSError:
                ended += 1
        took_s = []
        for _ in range(50):
            began_s = time.monotonic()
            httpx.get(f"{url}/healthz").raise_for_status()
            took_s.append(time.monotonic() - began_s)
        other = httpx.get(f"{url}/jobs").status_code
    median_s = statistics.median(took_s)
    print(f"{FLOOD} connections, {ended} ended while they were opened; /jobs answers {other}")
    print(f"/healthz 50 times: median {1e3 * median_s:.0f} ms, {1e3 * max(took_s):.0f} ms at most")


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tempers", default=",".join(TEMPERS))
    parser.add_argument("--cancel-after", type=float, default=3.0, metavar="S")
    parser.add_argument("--only", choices=("hosts", "cancel", "clients", "flood"))
    options = parser.parse_args()
    tempers = options.tempers.split(",")
    with hostile_host() as host, tempfile.TemporaryDirectory() as folder:
        state = Path(folder, "state")
        with serving(state, [host.origin, f"http://{host.origin}"]) as url:
            if options.only in {None, "cancel"}:
                measured_hosts(url, host, tempers, options.cancel_after)
            if options.only in {None, "clients"}:
                measured_clients(url)
            if options.only in {None, "flood"}:
                measured_flood(url)
            if options.only in {None, "hosts"}:
                measured_hosts(url, host, tempers, None)


if __name__ == "__main__":
    main()
