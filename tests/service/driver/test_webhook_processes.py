"""Webhooks of a real service: its driver is killed while it sends, to a receiver that fails at random."""

import json
import re
import sys
import threading
from collections import Counter
from pathlib import Path

import httpx
import psutil
import pytest
from processes import LONG_S, Program, Programs
from webhook_receiver import Received, failing, receiving

pytestmark = pytest.mark.slow

JOBS = 24
KILLED_AT = (10, 40, 80)
"""Numbers of the messages during which the driver is killed."""


class Trap:
    """A receiver that fails at random, and that keeps some messages without an answer until it is set free."""

    def __init__(self) -> None:
        self._answer = failing(20)
        self._lock = threading.Lock()
        self._count = 0
        self.reached = threading.Event()
        self.free = threading.Event()

    def __call__(self, message: Received) -> int | None:
        with self._lock:
            self._count += 1
            is_held = self._count in KILLED_AT
        if is_held:
            self.reached.set()
            assert self.free.wait(LONG_S)
            self.free.clear()
        return self._answer(message)


@pytest.fixture(params=["sqlite", "postgres"])
def database(request: pytest.FixtureRequest) -> dict[str, str]:
    """The variable that names the database; none for SQLite in the state folder."""
    if request.param == "sqlite":
        return {}
    return {"GABLEWORK_DATABASE_URL": request.getfixturevalue("postgres_url")}


def test_a_driver_that_is_killed_while_it_sends_loses_no_message(
    programs: Programs, tmp_path: Path, database: dict[str, str], scheduler: str
) -> None:
    trap = Trap()
    with receiving(trap) as receiver:
        environment = {
            "GABLEWORK_SCHEDULER": scheduler,
            "GABLEWORK_DRIVER_JOBS": "2",
            "GABLEWORK_LEASE_S": "10",
            "GABLEWORK_POLL_S": "0.05",
            "GABLEWORK_WEBHOOK_HOSTS": json.dumps([receiver.origin]),
            "GABLEWORK_WEBHOOK_PAUSE_S": "0.0001",
            "OPENBLAS_NUM_THREADS": "1",
            **database,
        }
        state = tmp_path / "state"
        command = [sys.executable, "-m", "service.cli", "serve", "--json", "--port", "0", "--state", str(state)]
        served: Program = programs.start("serve", command, env=environment)
        found = served.wait_for(lambda: re.search(r'"url": *("[^"]+")', served.text), "its URL")
        with httpx.Client(base_url=json.loads(found[1]), timeout=60.0) as client:
            every = ["job.accepted", "job.running", "job.successful", "job.failed", "job.dismissed"]
            made = client.post("/webhooks", json={"url": f"{receiver.url}/all", "events": every}).json()
            own = client.get("/webhooks/secret").json()["secret"]
            subscriber = {"successUri": f"{receiver.url}/done", "failedUri": f"{receiver.url}/done"}
            jobs = set()
            for number in range(JOBS):
                asked = {"inputs": {"message": f"hello {number}"}, "subscriber": subscriber}
                answer = client.post("/processes/echo/execution", json=asked)
                assert answer.status_code == 201, answer.text
                jobs.add(answer.json()["jobID"])
            for _ in KILLED_AT:
                served.wait_for(trap.reached.is_set, "a message that is being sent")
                trap.reached.clear()
                driver = next(c for c in psutil.Process(served.pid).children() if "driver" in c.cmdline())
                driver.kill()
                driver.wait(LONG_S)
                trap.free.set()

            def is_sent() -> list[dict[str, str]] | None:
                running = client.get("/jobs?status=accepted,running&limit=1").json()["jobs"]
                waiting = client.get("/webhooks/deliveries?state=waiting&limit=1").json()["deliveries"]
                return (
                    None if running or waiting else client.get("/webhooks/deliveries?limit=1000").json()["deliveries"]
                )

            sent = served.wait_for(is_sent, "the end of all deliveries", interval_s=0.2)
            assert {one["state"] for one in sent} == {"delivered"}
            times = Counter(message.id for message in receiver.received)
            lost = [
                attempt
                for again in (one for one, count in times.items() if count > 1)
                for attempt in client.get(f"/webhooks/deliveries/{again}").json()["attempts"]
                if attempt.get("error") == "the driver ended during this attempt"
            ]
        assert len(lost) >= len(KILLED_AT)
        accepted = {message.id for message in receiver.accepted}
        assert accepted == {one["deliveryID"] for one in sent}
        by_type = {kind: {one["jobID"] for one in sent if one["type"] == kind} for kind in every}
        assert by_type["job.accepted"] == jobs
        assert by_type["job.successful"] | by_type["job.failed"] == jobs
        assert {one["jobID"] for one in sent if "webhookID" not in one} == jobs
        for message in receiver.received:
            secret = made["secret"] if message.path == "/all" else own
            assert message.verify(secret) is not None, message
        cut = len(receiver.cut)
        print(f"{len(sent)} deliveries, {len(receiver.received)} attempts, {len(lost)} lost, {cut} cut short")
    assert served.stop() == 0
