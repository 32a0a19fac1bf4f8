"""A real service is backed up while it works, loses everything, and goes on from its backup."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import httpx
import pytest
from faults import asked
from processes import PostgresServer, Program, Programs, program, wait_for
from webhook_receiver import Receiver, receiving

from pipeline.runtime.digest import run_digest
from service.files import StateFolder
from service.jobs import JobStatus
from service.store import JobStore

pytestmark = pytest.mark.slow

DEADLINE_S = 300.0
GABLEWORK = str(program("gablework"))
EVERY = ["job.accepted", "job.running", "job.successful", "job.failed", "job.dismissed"]


class Place:
    """A state folder, a database, and a service over them."""

    def __init__(
        self, folder: Path, database: str | None, scheduler: str, receiver: Receiver, programs: Programs
    ) -> None:
        self.state = folder
        self._database = database
        self._programs = programs
        self.environment = {
            "GABLEWORK_STATE": str(folder),
            "GABLEWORK_SCHEDULER": scheduler,
            "GABLEWORK_DRIVER_JOBS": "1",
            "GABLEWORK_POLL_S": "0.1",
            "GABLEWORK_WEBHOOK_HOSTS": json.dumps([receiver.origin]),
            "OPENBLAS_NUM_THREADS": "1",
            **({} if database is None else {"GABLEWORK_DATABASE_URL": database}),
        }

    def serve(self, name: str) -> tuple[Program, httpx.Client]:
        """A running service, and a client of it."""
        served = self._programs.start(name, [GABLEWORK, "serve", "--json", "--port", "0"], env=self.environment)
        found = served.wait_for(lambda: re.search(r'"url": *"([^"]+)"', served.text), "its URL")
        return served, httpx.Client(base_url=found[1], timeout=60.0)

    def run(self, *words: str) -> dict[str, Any]:
        """What a command prints as JSON."""
        done = subprocess.run(
            [GABLEWORK, *words, "--json"],
            env={**os.environ, **self.environment},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    @property
    def store(self) -> JobStore:
        return JobStore(self._database or f"sqlite:///{self.state / 'service.db'}")


@pytest.fixture(params=[("sqlite", "postgres"), ("postgres", "sqlite")], ids="-to-".join)
def databases(request: pytest.FixtureRequest) -> tuple[str | None, str | None]:
    """The database of the service and that of the restored one; None is SQLite in the state folder."""
    server: PostgresServer = request.getfixturevalue("postgres_server")
    first, second = (None if kind == "sqlite" else server.create_database() for kind in request.param)
    return first, second


@pytest.fixture(scope="module")
def gate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the file `go`, without which tasks wait where they split."""
    return tmp_path_factory.mktemp("gate")


@pytest.fixture(scope="module")
def held_workers(lasting: Programs, scheduler: str, gate: Path) -> str:
    """The scheduler of one worker, whose tasks the gate holds.

    All services use it, one after the other: most of a small job's time would go into starting workers.
    """
    faults = asked.environment(pause={"split": str(gate)})
    lasting.start("worker", [GABLEWORK, "worker", "--scheduler", scheduler], env=faults | {"OPENBLAS_NUM_THREADS": "1"})
    return scheduler


def execute(client: httpx.Client, upload: str, key: str) -> str:
    inputs = {"inputs": {"tiles": [{"href": f"/uploads/{upload}"}]}}
    answer = client.post("/processes/reconstruct/execution", json=inputs, headers={"Idempotency-Key": key})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["jobID"])


def over(client: httpx.Client, served: Program, job: str) -> None:
    def is_over() -> bool:
        status = client.get(f"/jobs/{job}").json()
        assert status["status"] in {"accepted", "running", "successful"}, status
        return status["status"] == "successful"

    served.wait_for(is_over, f"the end of {job}", DEADLINE_S, interval_s=0.1)


def results(client: httpx.Client, job: str) -> dict[str, bytes]:
    """All outputs of a job, byte by byte."""
    listed = client.get(f"/jobs/{job}/results").json()
    return {name: client.get(f"/jobs/{job}/results/{name}").content for name in listed}


def test_a_service_that_lost_everything_goes_on_from_a_backup_that_was_made_while_it_worked(
    programs: Programs,
    tmp_path: Path,
    tile: Path,
    databases: tuple[str | None, str | None],
    held_workers: str,
    gate: Path,
) -> None:
    backup, content = tmp_path / "backup", tile.read_bytes()
    (gate / "go").touch()
    with receiving() as receiver:
        first = Place(tmp_path / "first", databases[0], held_workers, receiver, programs)
        served, client = first.serve("first")
        client.post("/webhooks", json={"url": f"{receiver.url}/all", "events": EVERY}).raise_for_status()
        upload = client.post("/uploads", params={"filename": tile.name}, content=content).json()["uploadID"]
        slow = {
            "cron": "0 3 * * *",
            "timeZone": "UTC",
            "processID": "echo",
            "execute": {"inputs": {"message": "hello"}},
        }
        schedule = client.post("/schedules", json=slow)
        assert schedule.status_code == 201, schedule.text
        finished = execute(client, upload, "finished")
        over(client, served, finished)
        before = results(client, finished)
        (gate / "go").unlink()
        for mark in gate.glob("reached-*"):
            mark.unlink()
        running, queued = execute(client, upload, "running"), execute(client, upload, "queued")
        served.wait_for(lambda: any(gate.glob("reached-*")), "a task that splits", DEADLINE_S)
        # its messages, all of which the backup knows as delivered
        known = {"accepted": {finished, running, queued}, "running": {finished, running}, "successful": {finished}}
        sent = [f"job.{status}" for status, jobs in known.items() for _ in jobs]

        def types() -> list[str]:
            return sorted(message.document["type"] for message in receiver.accepted)

        served.wait_for(lambda: types() == sorted(sent), "its messages")
        served.wait_for(
            lambda: client.get("/webhooks/deliveries?state=waiting").json()["deliveries"] == [],
            "their end in the database",
        )

        report = first.run("backup", "--to", str(backup))
        assert report["jobs"] == {"accepted": 1, "running": 1, "successful": 1}
        assert (report["uploads"], report["missing"]) == (1, [])

        lost = execute(client, upload, "afterwards")
        client.close()
        served.kill()
        for child in served.children():
            wait_for(lambda child=child: not child.is_running(), "the end of its processes")
        shutil.rmtree(first.state)
        (gate / "go").touch()

        second = Place(tmp_path / "second", databases[1], held_workers, receiver, programs)
        assert second.run("restore", str(backup))["waitingAgain"] == 1
        served, client = second.serve("second")
        with client:
            for job in (running, queued):
                over(client, served, job)
            assert {job["jobID"] for job in client.get("/jobs").json()["jobs"]} == {finished, running, queued}
            assert client.get(f"/jobs/{lost}").status_code == 404
            assert results(client, finished) == before

            with second.store as store:
                jobs = [store.get(job) for job in (finished, running, queued)]
                sequences = [event.sequence for event in store.events(running)]
            assert {job.summary["digest"] for job in jobs if job.summary} == {jobs[0].summary["digest"]}
            assert [(job.status, job.attempt, job.lost_attempts) for job in jobs] == [
                (JobStatus.SUCCESSFUL, 1, 0),
                (JobStatus.SUCCESSFUL, 2, 0),
                (JobStatus.SUCCESSFUL, 1, 0),
            ]
            folder = StateFolder(second.state)
            assert {run_digest(folder.run(job.job_id, job.attempt)) for job in jobs} == {jobs[0].summary["digest"]}
            # a client that saw event n misses none that came after the restore
            assert sequences == sorted(set(sequences))
            assert sequences[-1] > 1_000_000

            # the same requests make nothing twice, a lost one is made again
            assert execute(client, upload, "running") == running
            assert execute(client, upload, "afterwards") not in {finished, running, queued, lost}
            assert client.get(f"/schedules/{schedule.json()['scheduleID']}").json()["nextTimes"]

            def announced(kind: str) -> list[str]:
                every = [message.document for message in receiver.accepted]
                return [one["data"]["jobID"] for one in every if one["type"] == kind]

            served.wait_for(lambda: {running, queued} <= set(announced("job.successful")), "the messages of the end")
            # what was delivered before is not sent again
            assert announced("job.successful").count(finished) == 1
        assert served.stop() == 0
