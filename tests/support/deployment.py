"""The whole service as real processes on the loopback, which tests kill and restart."""

import contextlib
import dataclasses
import json
import os
import signal
import sqlite3
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import httpx
import psutil
from faults import asked
from processes import LONG_S, Program, Programs, free_port, lives, program, wait_for

from pipeline.runtime.digest import run_digest
from service.files import StateFolder
from service.jobs import Job, JobEvent, JobStatus
from service.settings import ServiceSettings
from service.store import JobStore

STAGES = ("ingest", "split", "reconstruct", "publish", "outputs")
"""Stages in which a job can be held: the first four in tasks on the workers, the last in the driver."""


@dataclasses.dataclass(frozen=True)
class Ended:
    """A finished job, from its store and its folder."""

    job: Job
    events: Sequence[JobEvent]
    run: Path
    """The last attempt's run directory."""
    digest: str
    """Digest of the run's content, computed from its files; empty without a run."""
    buildings: Mapping[str, tuple[str, str]]
    """Status and reason of every building."""

    @property
    def ends(self) -> int:
        """Number of its final events."""
        return sum(event.status is not None and event.status.is_over for event in self.events)

    @property
    def seconds(self) -> float:
        """Time from submission to the end."""
        return (self.job.finished_at - self.job.created_at).total_seconds()


class Gates:
    """Stages in which tasks wait until the gate opens: one folder each, as `tests/support/faults` reads it."""

    def __init__(self, folder: Path) -> None:
        self._folders = {stage: folder / stage for stage in STAGES}
        for path in self._folders.values():
            path.mkdir(parents=True)
        self.open()

    @property
    def asked(self) -> dict[str, str]:
        """Faults for the environment."""
        return {stage: str(path) for stage, path in self._folders.items()}

    def close(self, stage: str) -> None:
        """Hold the tasks of a stage from now on."""
        folder = self._folders[stage]
        for mark in folder.glob("reached-*"):
            mark.unlink()
        (folder / "go").unlink()

    def open(self, *stages: str) -> None:
        """Open the gates of all or some stages."""
        for stage in stages or STAGES:
            (self._folders[stage] / "go").touch()

    def reached(self, stage: str) -> int | None:
        """The id of a process that waits in a stage."""
        for mark in sorted(self._folders[stage].glob("reached-*")):
            pid = int(mark.name.removeprefix("reached-"))
            with contextlib.suppress(psutil.NoSuchProcess):
                if lives(psutil.Process(pid)):
                    return pid
        return None


class Deployment:
    """A scheduler, workers, a driver and an API over one state folder, which lies in a folder of the test.

    `faults` are further ones, as `support/faults` understands them; `variables` are further settings of the service.
    """

    def __init__(
        self,
        programs: Programs,
        folder: Path,
        faults: Mapping[str, Any] | None = None,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        self._programs = programs
        self.gates = Gates(folder / "gates")
        self._ports = {"scheduler": free_port(), "api": free_port()}
        self._state = folder / "state"
        self._state.mkdir()
        self._environment = {
            "GABLEWORK_STATE": str(self._state),
            "GABLEWORK_SCHEDULER": self.scheduler_address,
            "GABLEWORK_LEASE_S": "3",
            "GABLEWORK_POLL_S": "0.1",
            # one job is struck in every stage
            "GABLEWORK_MAX_ATTEMPTS": str(len(STAGES) + 2),
            "GABLEWORK_PORT": str(self._ports["api"]),
            "OPENBLAS_NUM_THREADS": "1",
            **(variables or {}),
            **asked.environment(pause=self.gates.asked, **(faults or {})),
        }
        self._database = ServiceSettings(state=self._state).database
        self._store = JobStore(self._database)
        self._gablework = str(program("gablework"))
        self.running: dict[str, Program] = {}
        self.gone: set[str] = set()
        """Programs that the supervisor does not restart."""
        self.replaced: list[Program] = []
        """Programs that still run beside their replacements."""
        self.submitted: set[str] = set()
        """The ids of all jobs."""

    @property
    def scheduler_address(self) -> str:
        return f"tcp://127.0.0.1:{self._ports['scheduler']}"

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._ports['api']}"

    # --- programs ----------------------------------------------------------------------------------------------------

    def start(self, name: str) -> Program:
        """Start scheduler, worker-N, driver or api; also again."""
        port = str(self._ports["scheduler"])
        commands = {
            "scheduler": [str(program("dask")), "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"],
            "worker": [self._gablework, "worker", "--scheduler", self.scheduler_address],
            "driver": [self._gablework, "driver"],
            "api": [self._gablework, "serve", "--no-driver"],
        }
        self.gone.discard(name)
        one = self._programs.start(name, commands[name.partition("-")[0]], env=self._environment)
        self.running[name] = one
        return one

    def start_all(self, *, workers: int = 2) -> None:
        """Start everything and wait until it answers."""
        for name in ("scheduler", "api", "driver", *(f"worker-{k + 1}" for k in range(workers))):
            self.start(name)
        self.settle()

    @property
    def workers(self) -> list[str]:
        return [name for name in self.running if name.startswith("worker")]

    def supervise(self) -> None:
        """Restart dead programs, as a supervisor does, except those in `gone`."""
        for name, one in list(self.running.items()):
            if not one.alive and name not in self.gone:
                self.start(name)

    def settle(self) -> None:
        """Open all gates, restart everything, and wait until it answers."""
        self.gates.open()
        self.restore()

    def restore(self) -> None:
        """Restart everything, and wait until it answers and the scheduler knows all workers."""
        from distributed import Client

        self.gone.clear()
        self.supervise()
        self.running["scheduler"].wait_for_port(self._ports["scheduler"])
        self.running["api"].wait_for_port(self._ports["api"])

        def complete() -> bool:
            self.supervise()
            try:
                with Client(self.scheduler_address, timeout=LONG_S, set_as_default=False) as client:
                    return len(client.scheduler_info(n_workers=-1)["workers"]) == len(self.workers)
            except OSError:
                return False

        wait_for(complete, f"{len(self.workers)} workers", interval_s=0.5)

    def worker_of(self, pid: int) -> str:
        """The name of the worker to which a process belongs."""
        for name in self.workers:
            one = self.running[name]
            if one.alive and pid in {one.pid, *(child.pid for child in one.children())}:
                return name
        raise LookupError(f"process {pid} belongs to no worker")

    def freeze(self, name: str) -> Program:
        """Stop a program with SIGSTOP, at a moment when it does not hold the database's lock."""
        one = self.running[name]
        database = self._database.removeprefix("sqlite:///")

        def frozen_without_lock() -> bool:
            one.process.send_signal(signal.SIGSTOP)
            wait_for(lambda: psutil.Process(one.pid).status() == psutil.STATUS_STOPPED, f"{name} to be frozen")
            with contextlib.closing(sqlite3.connect(database, timeout=1.0, isolation_level=None)) as connection:
                try:
                    connection.execute("begin immediate")
                    connection.execute("rollback")
                except sqlite3.OperationalError:
                    one.process.send_signal(signal.SIGCONT)
                    return False
            return True

        wait_for(frozen_without_lock, f"{name} to be frozen without the lock")
        return one

    # --- jobs --------------------------------------------------------------------------------------------------------

    def submit(self, tile: Path, settings: Mapping[str, Any], title: str = "") -> str:
        """Send a tile; returns the job's id."""
        with tile.open("rb") as stream:
            files, data = {"tile": (tile.name, stream)}, {"settings": json.dumps(settings), "title": title}
            answer = httpx.post(f"{self.url}/jobs", files=files, data=data, timeout=LONG_S)
        assert answer.status_code == 201, answer.text
        job_id: str = answer.json()["jobID"]
        self.submitted.add(job_id)
        return job_id

    def status(self, job_id: str) -> str | None:
        """The API's answer; None while it does not answer."""
        try:
            answer = httpx.get(f"{self.url}/jobs/{job_id}", timeout=LONG_S)
        except httpx.TransportError:
            return None
        assert answer.status_code == 200, answer.text
        status: str = answer.json()["status"]
        return status

    def job(self, job_id: str) -> Job:
        return self._store.get(job_id)

    def events(self, job_id: str) -> list[JobEvent]:
        return self._store.events(job_id, limit=10_000)

    def held(self, job_id: str, stage: str) -> int:
        """Wait until a job is held in a stage, restarting dead programs; returns a waiting process."""

        def reached() -> int | None:
            self.supervise()
            job = self.job(job_id)
            assert not job.status.is_over, f"the job ended before {stage}: {job.status}, {job.message}"
            return self.gates.reached(stage)

        return wait_for(reached, f"the stage {stage}")

    def ended(self, job_id: str) -> Ended:
        """Wait until a job is over, restarting dead programs."""

        def over() -> bool:
            self.supervise()
            return self.status(job_id) in {"successful", "failed", "dismissed"}

        wait_for(over, f"the end of job {job_id}", 2 * LONG_S, interval_s=0.25)
        job = self.job(job_id)
        run = StateFolder(self._state).run(job_id, job.attempt)
        good = job.status is JobStatus.SUCCESSFUL
        return Ended(
            job=job,
            events=self.events(job_id),
            run=run,
            digest=run_digest(str(run)) if good else "",
            buildings=_buildings(run) if good else {},
        )


def _buildings(run: Path) -> dict[str, tuple[str, str]]:
    import pyarrow.dataset as ds

    table = ds.dataset(run / "buildings", format="parquet").to_table(columns=["building_id", "status", "reason"])
    return {row["building_id"]: (row["status"], row["reason"] or "") for row in table.to_pylist()}


def kill_process(pid: int) -> None:
    """SIGKILL one process and wait until it is gone."""
    try:
        process = psutil.Process(pid)
        os.kill(pid, signal.SIGKILL)
    except (psutil.NoSuchProcess, ProcessLookupError):
        return
    wait_for(lambda: not lives(process), f"the end of process {pid}")
