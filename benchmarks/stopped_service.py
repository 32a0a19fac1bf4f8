"""How soon a service stops what it must stop: dismissals, SIGTERM, and attempts that stand still.

    python -m benchmarks.stopped_service TILE [--stages ingest split ...] [--rows dismissed ended stopped]

Starts `gablework serve` as a user does and submits jobs with the tile. A row each:

- dismissed: DELETE of a job in each stage, until its status is `dismissed`.
- ended: SIGTERM with four jobs of different kinds, once the first is in the stage, until all processes have ended; then
  the service starts again, and all jobs must succeed. The stages that the next attempts repeated are listed: those that
  had ended before.
- stopped: SIGSTOP of the process of an attempt in the stage split, with `GABLEWORK_STALL_S` at 20, until the job is in
  its next attempt.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import httpx
import psutil

STAGES = ["inputs", "ingest", "split", "reconstruct", "publish", "outputs"]
STALL_S = 20.0
LIMIT_S = 900.0
"""Seconds after which a row is given up."""
CHILD = "gablework-child"


class Service:
    """One service with its state, which outlives its processes."""

    def __init__(self, folder: Path, **settings: object) -> None:
        self._environment = os.environ | {f"GABLEWORK_{name}".upper(): str(value) for name, value in settings.items()}
        self._folder = folder
        self._process: subprocess.Popen[str] | None = None
        self.client = httpx.Client(timeout=60.0)

    def start(self) -> None:
        """Start it, and wait until it answers."""
        command = [sys.executable, "-m", "service.cli", "serve", "--port", "0", "--state", str(self._folder)]
        self._process = subprocess.Popen(
            command, env=self._environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self._process.stdout is not None
        url = re.search(r"http://\S+", self._process.stdout.readline())
        assert url is not None, "the service does not start"
        self.client.base_url = url[0]

    def end(self) -> float:
        """Send SIGTERM; seconds until it and all that it started has ended."""
        assert self._process is not None
        tree = psutil.Process(self._process.pid).children(recursive=True)
        began_s = time.perf_counter()
        self._process.send_signal(signal.SIGTERM)
        self._process.wait(LIMIT_S)
        psutil.wait_procs(tree, LIMIT_S)
        return time.perf_counter() - began_s

    def attempts(self) -> list[psutil.Process]:
        """The processes of attempts: children of the server that the driver forks them from."""
        assert self._process is not None
        found = []
        for process in psutil.Process(self._process.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                # those that model buildings are below a worker
                above = [parent.name() for parent in process.parents()]
                if process.name() == CHILD and not any(name.startswith("gablework-work") for name in above):
                    found.append(process)
        return found

    def upload(self, tile: Path) -> str:
        """Send a tile; its URL."""
        with tile.open("rb") as stream:
            answer = self.client.post("/uploads", files={"file": (tile.name, stream)})
        base = str(self.client.base_url).rstrip("/")
        return f"{base}/uploads/{answer.raise_for_status().json()['uploadID']}"

    def submit(self, process: str, inputs: Mapping[str, Any]) -> str:
        """Start a job; its id."""
        answer = self.client.post(f"/processes/{process}/execution", json={"inputs": inputs})
        return str(answer.raise_for_status().json()["jobID"])

    def job(self, job_id: str) -> dict[str, Any]:
        """The status of a job; one that was over when it was deleted is removed."""
        answer = self.client.get(f"/jobs/{job_id}")
        if answer.status_code == httpx.codes.NOT_FOUND:
            return {"status": "removed"}
        found: dict[str, Any] = answer.raise_for_status().json()
        return found

    def is_over(self, job_id: str) -> bool:
        """Whether a job has ended, in any way."""
        return self.job(job_id)["status"] in {"successful", "failed", "dismissed", "removed"}

    def log(self, job_id: str) -> str:
        """The log of a job as text."""
        return self.client.get(f"/jobs/{job_id}/log", params={"f": "text", "limit": 2000}).raise_for_status().text

    def wait(self, what: Callable[[], bool], pause_s: float = 0.05) -> float:
        """Wait until something is so; the seconds that it took."""
        began_s = time.perf_counter()
        while not what():
            if time.perf_counter() - began_s > LIMIT_S:
                raise SystemExit("given up")
            time.sleep(pause_s)
        return time.perf_counter() - began_s


@contextlib.contextmanager
def running(**settings: object) -> Iterator[Service]:
    """A service with a state folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        service = Service(Path(folder), **settings)
        service.start()
        try:
            yield service
        finally:
            service.end()


def is_in(service: Service, job_id: str, stage: str) -> Callable[[], bool]:
    """Whether a job has begun a stage."""
    return lambda: f", {stage}: " in service.log(job_id) or service.is_over(job_id)


def dismissed(tile: Path, stages: list[str]) -> None:
    """The row of dismissals."""
    with running(poll_s=0.5) as service:
        href = service.upload(tile)
        for stage in stages:
            job_id = service.submit("reconstruct", {"tiles": [{"href": href}]})
            service.wait(is_in(service, job_id, stage))
            began_s = time.perf_counter()
            service.client.delete(f"/jobs/{job_id}")
            service.wait(lambda job_id=job_id: service.is_over(job_id))  # type: ignore[misc]
            took_s = time.perf_counter() - began_s
            # it may have ended by itself just before
            print(f"DELETE in {stage}: {service.job(job_id)['status']} after {took_s:.2f} s")


def stage_lines(text: str, attempt: int) -> tuple[set[str], set[str]]:
    """The stages that an attempt ended, and those that it found done before, by the job's log."""
    ended = set(re.findall(rf"attempt {attempt}, (\w+): done", text))
    before = set(re.findall(rf"attempt {attempt}, (\w+): (\d+) of \2 tasks were done before", text))
    return ended, {stage for stage, _ in before}


def ended(tile: Path, stages: list[str], **settings: object) -> None:
    """The row of SIGTERM."""
    for stage in stages:
        with running(driver_jobs=4, **settings) as service:
            tiles = [{"href": service.upload(tile)}]
            jobs = {
                "reconstruct": service.submit("reconstruct", {"tiles": tiles, "publish": ["geopackage"]}),
                "classify": service.submit("classify", {"tiles": tiles}),
                "compare": service.submit("compare", {"tiles": tiles, "methods": ["arrangement", "kmeans"]}),
                "echo": service.submit("echo", {"message": "here", "delay": 30}),
            }
            service.wait(is_in(service, jobs["reconstruct"], stage))
            took_s = service.end()
            service.start()
            service.wait(lambda: all(map(service.is_over, jobs.values())), 0.5)  # noqa: B023
            print(f"SIGTERM in {stage}: all ended after {took_s:.1f} s")
            for name, job_id in jobs.items():
                text = service.log(job_id)
                first, _ = stage_lines(text, 1)
                second, found = stage_lines(text, 2)
                again = sorted((first & second) - found - {"inputs", "plan"})
                print(f"  {name}: {service.job(job_id)['status']}, repeated: {', '.join(again) or 'nothing'}")


def stopped(tile: Path) -> None:
    """The row of attempts that stand still."""
    with running(stall_s=STALL_S) as service:
        job_id = service.submit("reconstruct", {"tiles": [{"href": service.upload(tile)}]})
        service.wait(is_in(service, job_id, "split"))
        (process,) = service.attempts()
        process.suspend()
        took_s = service.wait(lambda: "attempt 2: running" in service.log(job_id))
        service.wait(lambda: service.is_over(job_id))
        print(f"SIGSTOP of an attempt: next attempt after {took_s:.1f} s, {service.job(job_id)['status']}")


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tile", type=Path)
    parser.add_argument(
        "--stages", nargs="+", default=["inputs", "ingest", "split", "reconstruct", "publish", "outputs"]
    )
    parser.add_argument("--rows", nargs="+", default=["dismissed", "ended", "stopped"])
    parser.add_argument("--drain-s", type=float, default=30.0)
    given = parser.parse_args()
    if "dismissed" in given.rows:
        dismissed(given.tile, given.stages)
    if "ended" in given.rows:
        ended(given.tile, given.stages, drain_s=given.drain_s)
    if "stopped" in given.rows:
        stopped(given.tile)


if __name__ == "__main__":
    main()
