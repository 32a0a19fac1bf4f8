"""Schedules in a real service over a real tile: by hand, by the clock, with the driver killed on the way."""

import datetime as dt
import json
import re
import sys
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
import sqlalchemy as sa
from processes import Program, Programs

from service.settings import ServiceSettings
from service.store import JobStore
from service.store.tables import SCHEDULES

pytestmark = pytest.mark.slow


def started(programs: Programs, state: Path) -> tuple[Program, httpx.Client]:
    """A service with its driver, and a client of it."""
    environment = {
        "GABLEWORK_WORKERS": "1",
        "GABLEWORK_DRIVER_JOBS": "1",
        "GABLEWORK_LEASE_S": "10",
        "GABLEWORK_POLL_S": "0.1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    command = [sys.executable, "-m", "service.cli", "serve", "--json", "--port", "0", "--state", str(state)]
    served = programs.start("serve", command, env=environment)
    found = served.wait_for(lambda: re.search(r'"url": *("[^"]+")', served.text), "its URL")
    return served, httpx.Client(base_url=json.loads(found[1]), timeout=60.0)


def test_a_schedule_of_every_minute_runs_by_hand_and_by_the_clock_and_survives_its_driver(
    tile: Path, programs: Programs, tmp_path: Path
) -> None:
    served, client = started(programs, tmp_path / "state")
    store = JobStore(ServiceSettings(state=tmp_path / "state").database)
    with client, store:
        upload = client.post(f"/uploads?filename={tile.name}", content=tile.read_bytes()).json()["uploadID"]
        asked = {
            "title": "every minute",
            # never due by itself while this test runs: its times are brought here
            "cron": f"* * * {(dt.datetime.now(dt.UTC).month + 5) % 12 + 1} *",
            "execute": {"inputs": {"tiles": [{"href": f"/uploads/{upload}"}]}, "outputs": {"report": {}}},
        }
        answer = client.post("/schedules", json=asked)
        assert answer.status_code == 201, answer.text
        place = f"/schedules/{answer.json()['scheduleID']}"

        def over(job_id: str) -> dict[str, Any]:
            def found() -> dict[str, Any] | None:
                job = client.get(f"/jobs/{job_id}").json()
                return job if job["status"] not in {"accepted", "running"} else None

            return served.wait_for(found, "the end of the job")

        by_hand = client.post(f"{place}/run")
        assert by_hand.status_code == 201, by_hand.text
        busy = client.post(f"{place}/run")
        assert (busy.status_code, busy.json().get("jobID")) == (409, by_hand.json()["jobID"])
        first = over(by_hand.json()["jobID"])
        assert first["status"] == "successful", first

        def bring_due() -> dt.datetime:
            """A slot that has just passed, as if the schedule were of this minute."""
            slot = store.now().replace(second=0, microsecond=0)
            with store._database.write() as connection:
                one = sa.update(SCHEDULES).values(
                    cron="* * * * *", decided_until=slot - dt.timedelta(seconds=1), next_at=slot
                )
                connection.execute(one)
            return slot

        # the driver is killed first: the slot passes while there is none, and is not lost
        driver = next(c for c in psutil.Process(served.pid).children() if "driver" in c.cmdline())
        driver.kill()
        bring_due()
        runs = served.wait_for(
            lambda: [r for r in client.get(f"{place}/runs").json()["runs"] if r["trigger"] == "clock"],
            "a run by the clock",
        )
        assert client.patch(place, json={"paused": True}).status_code == 200
        made = [run for run in runs if run["outcome"] == "submitted"]
        assert len(made) == 1
        second = over(made[0]["jobID"])
        assert (second["status"], second["title"]) == ("successful", "every minute")
        # the same points, reconstructed twice by jobs of their own
        assert second["summary"]["digest"] == first["summary"]["digest"]
        assert second["jobID"] != first["jobID"]
        assert client.get(f"/jobs/{second['jobID']}/results/report").status_code == 200
        slots = [run["slot"] for run in client.get(f"{place}/runs").json()["runs"] if run["trigger"] == "clock"]
        assert len(slots) == len(set(slots))
        listed = client.get(f"/jobs?scheduleID={place.rpartition('/')[2]}").json()["jobs"]
        assert {job["jobID"] for job in listed} == {first["jobID"], second["jobID"]}
    assert served.stop() == 0
