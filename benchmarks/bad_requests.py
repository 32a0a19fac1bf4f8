"""Requests that must be refused, many at once and for long: how long the event loop stands still, what memory stays.

    python -m benchmarks.bad_requests [--at-once 40] [--soak 10000] [--database-url URL]

A server process of the API has a probe in its event loop, which notes how late it wakes, and how long the process
itself worked meanwhile: on a busy machine others take the rest. First a burst of bodies with
80,000 unknown inputs (869 kB) arrives, as often as `--repeat` says; another process asks for /healthz meanwhile. Then
come the requests of the soak: a mixture of bodies, forms, queries and headers that are refused. Fails above the limits
of the design: 50 ms, and a tenth more memory than before.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import uvicorn

from benchmarks.service_load import Poller, peak_mib

MAX_LATE_S = 0.05
"""Longest time for which a burst may hold up the event loop."""
MAX_GROWTH = 1.1
"""Memory after the requests, relative to before."""
PROBE_S = 0.002
"""Seconds that the probe sleeps."""
UNKNOWN = json.dumps({"inputs": dict.fromkeys((f"k{n}" for n in range(80_000)), 1)}, separators=(",", ":")).encode()
"""The body of the burst."""
JSON = {"Content-Type": "application/json"}
EXECUTION = "/processes/reconstruct/execution"


def serve(state: Path, database_url: str | None) -> None:
    """Answer until the input ends; each line of the input is answered with the longest delay since the last one."""
    from service.app import create_app
    from service.connections import listen, server_config
    from service.settings import ServiceSettings

    settings = ServiceSettings(state=state, database_url=database_url, port=0, rate_limit="10000000/minute")
    listening, url = listen(settings)
    server = uvicorn.Server(server_config(create_app(settings), settings, log_level="error"))
    asyncio.run(_with_probe(server, listening, url))


async def _with_probe(server: uvicorn.Server, listening: Any, url: str) -> None:
    loop = asyncio.get_running_loop()
    late_s = worked_s = 0.0

    async def probe() -> None:
        nonlocal late_s, worked_s
        while True:
            began, worked_before_s = loop.time(), time.process_time()
            await asyncio.sleep(PROBE_S)
            late_s = max(late_s, loop.time() - began - PROBE_S)
            worked_s = max(worked_s, time.process_time() - worked_before_s)

    def asked() -> None:
        nonlocal late_s, worked_s
        if not sys.stdin.readline():
            server.should_exit = True
            return
        print(late_s, worked_s, flush=True)
        late_s = worked_s = 0.0

    probing = asyncio.ensure_future(probe())
    serving = asyncio.ensure_future(server.serve(sockets=[listening]))
    while not server.started:
        await asyncio.sleep(0.05)
    loop.add_reader(sys.stdin.fileno(), asked)
    print(url, flush=True)
    await serving
    probing.cancel()


def bad_requests() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Without end: method, path and arguments of requests that are refused."""
    names = {f"k{n}": n for n in range(900)}
    deep = "[" * 90 + "]" * 90
    outlines = {"type": "FeatureCollection", "features": [[[0.5, 0.5]] * 20] * 200}
    bodies: list[bytes] = [
        UNKNOWN,
        json.dumps({"inputs": names}).encode(),
        json.dumps({"inputs": {"tiles": [{"href": 1}] * 900}}).encode(),
        json.dumps({"inputs": {"tiles": "x", "settings": {"candidates": names}}}).encode(),
        json.dumps({"inputs": {"tiles": 7, "footprints": outlines}}).encode(),
        json.dumps({"inputs": {"tiles": ["A" * 40_001]}, "outputs": names}).encode(),
        f'{{"inputs": {{"tiles": {deep}}}}}'.encode(),
        b"[" * 50_000,
        b'{"inputs": {"tiles": [' + b"1" * 5_000 + b"]}}",
        b"[" + b"[]," * 200_000 + b"1]",
        b'{"inputs": ',
    ]
    forms = [{"settings": json.dumps(names), "crs": "x"}, {"outputs": ",".join(names), "tile": "/srv/a.laz"}, names]
    queries = ["&".join(f"k{n}=1" for n in range(5_000)), "status=" + "x," * 10_000, "datetime=" + "/" * 9_000]
    for number in itertools.count():
        yield "POST", EXECUTION, {"content": bodies[number % len(bodies)], "headers": JSON}
        yield "POST", "/schedules", {"content": bodies[(number + 3) % len(bodies)], "headers": JSON}
        files = {name: (None, str(value)) for name, value in forms[number % len(forms)].items()}
        yield "POST", "/jobs", {"files": files}
        yield "GET", f"/jobs?{queries[number % len(queries)]}", {}
        yield "GET", f"/jobs/{number:032x}", {"headers": {"Accept": "a/b;q=0.1," * 4_000}}


async def _send(
    url: str, requests: Iterator[tuple[str, str, dict[str, Any]]], number: int, at_once: int
) -> Counter[int]:
    """Send so many requests, some at once; the statuses of their answers."""
    found: Counter[int] = Counter()
    chosen = itertools.islice(requests, number)
    async with httpx.AsyncClient(base_url=url, timeout=120.0, limits=httpx.Limits(max_connections=at_once)) as client:

        async def one_after_another() -> None:
            for method, path, arguments in chosen:
                answer = await client.request(method, path, **arguments)
                found[answer.status_code] += 1
                if not 400 <= answer.status_code < 500 or len(answer.content) > 100_000:
                    raise SystemExit(f"{answer.status_code} with {len(answer.content)} bytes: {answer.text[:500]}")

        await asyncio.gather(*(one_after_another() for _ in range(at_once)))
    return found


async def _watched(url: str, options: argparse.Namespace) -> tuple[Counter[int], list[float]]:
    """A burst, and the seconds that /healthz took meanwhile."""
    taken: list[float] = []
    poller = Poller(url)

    async def watch() -> None:
        while True:
            began = time.perf_counter()
            await poller.get("/healthz")
            taken.append(time.perf_counter() - began)
            await asyncio.sleep(PROBE_S)

    watching = asyncio.ensure_future(watch())
    command = [sys.executable, "-m", "benchmarks.bad_requests", "--burst", url, "--at-once", str(options.at_once)]
    sending = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)
    reported, _ = await sending.communicate()
    watching.cancel()
    poller.close()
    if sending.returncode:
        raise SystemExit(reported.decode())
    return Counter({int(status): n for status, n in json.loads(reported).items()}), taken


def main() -> int:
    """Send bad requests; 1 where they hold up others, or memory stays."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--at-once", type=int, default=40)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--soak", type=int, default=10_000)
    parser.add_argument("--database-url")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--burst", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        serve(options.serve, options.database_url)
        return 0
    if options.burst is not None:
        burst = itertools.repeat(("POST", EXECUTION, {"content": UNKNOWN, "headers": JSON}))
        print(json.dumps(asyncio.run(_send(options.burst, burst, options.at_once, options.at_once))))
        return 0
    with tempfile.TemporaryDirectory(prefix="gablework-bad-") as folder:
        command = [sys.executable, "-m", "benchmarks.bad_requests", "--serve", folder]
        command += ["--database-url", options.database_url] if options.database_url else []
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            url = process.stdout.readline().strip()
            try:
                faults = _measure(process, url, options)
            finally:
                process.stdin.close()
    print(f"{'held up, or grown':28} {'; '.join(faults) or 'no'}")
    return 1 if faults else 0


def _measure(process: subprocess.Popen[str], url: str, options: argparse.Namespace) -> list[str]:
    assert process.stdin is not None
    assert process.stdout is not None

    def late() -> tuple[float, float]:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write("\n")
        process.stdin.flush()
        late_s, worked_s = map(float, process.stdout.readline().split())
        return late_s, worked_s

    asyncio.run(_send(url, bad_requests(), 200, 4))  # what is loaded on demand is not what grows
    before, _ = peak_mib(process.pid)
    late()
    delays, worked, polls, statuses = list[float](), list[float](), list[float](), Counter[int]()
    for _ in range(options.repeat):
        found, taken = asyncio.run(_watched(url, options))
        statuses += found
        polls += taken
        late_s, worked_s = late()
        delays.append(late_s)
        worked.append(worked_s)
    after_bursts, peak = peak_mib(process.pid)
    began = time.perf_counter()
    soaked = asyncio.run(_send(url, bad_requests(), options.soak, 8))
    seconds = time.perf_counter() - began
    after_soak, soak_peak = peak_mib(process.pid)
    soak_late_s, soak_worked_s = late()
    figures = {
        "machine": f"{os.cpu_count()} cores, {os.getloadavg()[0]:.1f} busy processes",
        "bursts": f"{options.repeat} of {options.at_once} bodies of {len(UNKNOWN)} bytes: {json.dumps(statuses)}",
        "event loop late at most": f"{', '.join(f'{1e3 * s:.0f}' for s in delays)} ms; median "
        f"{1e3 * statistics.median(delays):.0f} ms; of its own work at most {1e3 * max(worked):.0f} ms",
        "/healthz p50 / p99 / max": f"{1e3 * statistics.median(polls):.1f} / "
        f"{1e3 * statistics.quantiles(polls, n=100)[98]:.1f} / {1e3 * max(polls):.1f} ms",
        "memory before / after / peak": f"{before:.0f} / {after_bursts:.0f} / {peak:.0f} MiB",
        "soak": f"{options.soak} requests in {seconds:.0f} s: {json.dumps(soaked)}",
        "memory after / peak": f"{after_soak:.0f} / {soak_peak:.0f} MiB",
        "late at most": f"{1e3 * soak_late_s:.0f} ms, of its own work {1e3 * soak_worked_s:.0f} ms",
    }
    for name, value in figures.items():
        print(f"{name:28} {value}")
    faults = []
    if statistics.median(delays) > MAX_LATE_S:
        faults.append(f"the event loop was late by {1e3 * statistics.median(delays):.0f} ms")
    for name, mib in (("the bursts", after_bursts), ("the soak", after_soak)):
        if mib > MAX_GROWTH * before:
            faults.append(f"{name} left {mib - before:.0f} MiB")
    return faults


if __name__ == "__main__":
    sys.exit(main())
