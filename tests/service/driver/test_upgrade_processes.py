"""A state folder of version 0.2.0 with jobs in flight: this version migrates it and finishes every job."""

import datetime as dt
import hashlib
import json
import re
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from alembic import command
from processes import Programs, program

from pipeline.schedule import Cron
from service import migrations
from service.files import StateFolder
from service.jobs import JobStatus
from service.store import JobStore

pytestmark = pytest.mark.slow

DEADLINE_S = 300.0
OLD = "0003"
"""The revision of version 0.2.0."""
SECRET = "gw_" + "0" * 43
FINISHED, RUNNING, QUEUED, UPLOAD, SCHEDULE, KEY = (letter * 32 for letter in "abcdef")
REPORT = b'{"n_buildings": 1}\n'


class OldState:
    """What version 0.2.0 left when it was stopped; rows are as that version wrote them, whatever the code is today."""

    def __init__(self, folder: Path, url: str, tile: Path) -> None:
        self.folder = StateFolder(folder)
        self.folder.make()
        self._tile = tile
        with JobStore(url) as store:
            if store._database.path is not None:
                store._database.path.touch()
            with store._database.write() as connection:
                config = migrations._config()
                config.attributes["connection"] = connection
                command.upgrade(config, OLD)
                self._now = dt.datetime.now(dt.UTC).replace(microsecond=0)
                is_sqlite = store._database.is_sqlite
                for name, rows in self._rows().items():
                    table = sa.Table(name, sa.MetaData(), autoload_with=connection)
                    for row in rows:
                        # SQLite has times in UTC without a zone
                        stored = {key: _naive(value) if is_sqlite else value for key, value in row.items()}
                        connection.execute(sa.insert(table).values(**stored))
        self._write_files()

    def _rows(self) -> dict[str, list[dict[str, Any]]]:
        begun = self._now - dt.timedelta(hours=2)
        content = self._tile.read_bytes()
        upload = {"upload_id": UPLOAD, "owner": KEY, "filename": self._tile.name, "size_bytes": len(content)}
        upload |= {"sha256": hashlib.sha256(content).hexdigest(), "created_at": begun}
        # older than its time: jobs need it
        upload |= {"expires_at": self._now - dt.timedelta(hours=1), "preflight": {"kind": "points", "format": "laz"}}
        key = {"key_id": KEY, "name": "old", "digest": hashlib.sha256(SECRET.encode()).hexdigest()}
        key |= {"scopes": ["read", "submit", "admin"], "created_at": begun, "revoked_at": None}
        over = {"status": "successful", "attempt": 1, "progress": 100, "stage": "outputs", "started_at": begun}
        over |= {"finished_at": begun + dt.timedelta(minutes=1), "duration_ms": 60_000, "message": "1 building: 1 ok"}
        over |= {"summary": {"engine_version": "0.2.0", "digest": "0" * 64, "statuses": {"ok": 1}}}
        held = {"status": "running", "attempt": 1, "progress": 15, "stage": "split", "started_at": begun}
        held |= {"lease_owner": "old-driver-1", "lease_until": begun + dt.timedelta(minutes=5), "message": "runs"}
        jobs = [
            self._job(FINISHED, begun, **over),
            self._job(RUNNING, begun + dt.timedelta(minutes=1), **held),
            self._job(QUEUED, begun + dt.timedelta(minutes=2)),
        ]
        events = [
            {"job_id": job["job_id"], "sequence": number, "at": begun, "kind": "status", "status": status, "stage": ""}
            | {"done": 0, "total": 0, "progress": 0, "message": "waits"}
            for job in jobs
            for number, status in enumerate(["accepted", "running", "successful"][: job["last_event"]], start=1)
        ]
        needed = [{"job_id": job["job_id"], "upload_id": UPLOAD} for job in jobs]
        return {
            "keys": [key],
            "uploads": [upload],
            "jobs": jobs,
            "job_events": events,
            "job_uploads": needed,
            "schedules": [self._schedule(begun)],
            "schedule_uploads": [{"schedule_id": SCHEDULE, "upload_id": UPLOAD}],
        }

    def _request(self) -> dict[str, Any]:
        """A request without the members that came later."""
        stored: dict[str, Any] = {"process_id": "reconstruct", "tiles": [{"kind": "upload", "value": UPLOAD}]}
        stored |= {"footprints": None, "crs": None, "vertical_unit": None, "bbox": None, "methods": []}
        stored |= {"settings": {"method": "arrangement", "preset": "robust"}, "meshes": "building", "licence": None}
        return stored | {"outputs": None, "title": None}

    def _job(self, job_id: str, at: dt.datetime, **values: Any) -> dict[str, Any]:
        row = {"job_id": job_id, "owner": KEY, "process_id": "reconstruct", "request": self._request()}
        row |= {"status": "accepted", "priority": 0, "message": "waits", "progress": 0, "stage": "", "created_at": at}
        row |= {"updated_at": at, "dismiss_requested": False, "attempt": 0, "lost_attempts": 0, "schedule_id": None}
        row |= values
        return row | {"last_event": {"accepted": 1, "running": 2, "successful": 3}[row["status"]]}

    def _schedule(self, at: dt.datetime) -> dict[str, Any]:
        due = Cron("@yearly", "Europe/Amsterdam").next_time(self._now)
        row = {"schedule_id": SCHEDULE, "owner": KEY, "title": "every year", "cron": "@yearly", "version": 1}
        row |= {"time_zone": "Europe/Amsterdam", "process_id": "reconstruct", "request": self._request(), "priority": 0}
        row |= {"missed": "run-latest", "grace_s": 300.0, "overlap": "skip", "is_paused": False, "created_at": at}
        row |= {"updated_at": at, "decided_until": self._now, "next_at": due, "waiting_slot": None, "last_number": 0}
        return row | {"submitted": 0, "skipped": 0, "missed_slots": 0, "failed": 0}

    def _write_files(self) -> None:
        place = self.folder.upload(UPLOAD)
        place.mkdir()
        (place / self._tile.name).write_bytes(self._tile.read_bytes())
        outputs = self.folder.outputs(FINISHED, 1)
        outputs.mkdir(parents=True)
        (outputs / "report.json").write_bytes(REPORT)
        listed = {"report": {"size_bytes": len(REPORT), "sha256": hashlib.sha256(REPORT).hexdigest()}}
        crs = {"name": None, "uri": None, "to_wgs84": None, "accuracy_m": None}
        catalogue = {"outputs": listed, "crs": crs, "n_buildings": 1, "runs": []}
        (outputs / "outputs.json").write_text(json.dumps(catalogue))
        # what the killed driver had begun
        self.folder.inputs(RUNNING, 1).mkdir(parents=True)
        (self.folder.inputs(RUNNING, 1) / "half.laz").write_bytes(b"half")


def _naive(value: Any) -> Any:
    return value.replace(tzinfo=None) if isinstance(value, dt.datetime) else value


@pytest.mark.parametrize("database", ["sqlite", "postgres"])
def test_jobs_of_an_earlier_version_are_finished_by_this_one(
    programs: Programs, tmp_path: Path, tile: Path, database: str, request: pytest.FixtureRequest
) -> None:
    state = tmp_path / "state"
    named = request.getfixturevalue("postgres_url") if database == "postgres" else None
    url = named or f"sqlite:///{state / 'service.db'}"
    old = OldState(state, url, tile)
    environment = {
        "GABLEWORK_STATE": str(state),
        "GABLEWORK_WORKERS": "1",
        "GABLEWORK_DRIVER_JOBS": "1",
        "GABLEWORK_POLL_S": "0.1",
        "OPENBLAS_NUM_THREADS": "1",
        **({} if named is None else {"GABLEWORK_DATABASE_URL": named}),
    }
    served = programs.start("serve", [str(program("gablework")), "serve", "--json", "--port", "0"], env=environment)
    found = served.wait_for(lambda: re.search(r'"url": *"([^"]+)"', served.text), "its URL")
    headers = {"Authorization": f"Bearer {SECRET}"}
    with httpx.Client(base_url=found[1], timeout=60.0, headers=headers) as client:
        listed = {job["jobID"]: job["status"] for job in client.get("/jobs").raise_for_status().json()["jobs"]}
        assert listed.keys() == {FINISHED, RUNNING, QUEUED}
        assert client.get("/readyz").status_code == 200
        assert client.get(f"/jobs/{FINISHED}/results/report").content == REPORT
        schedule = client.get(f"/schedules/{SCHEDULE}").raise_for_status().json()
        assert schedule["cron"] == "@yearly"
        assert schedule["nextTimes"]

        def are_over() -> bool:
            states = [client.get(f"/jobs/{job}").json() for job in (RUNNING, QUEUED)]
            assert all(one["status"] in {"accepted", "running", "successful"} for one in states), states
            return all(one["status"] == "successful" for one in states)

        served.wait_for(are_over, "the end of its jobs", DEADLINE_S)
        # members that came later work for old jobs, too
        kept = client.patch(f"/jobs/{FINISHED}", json={"keep": True})
        assert kept.status_code == 200, kept.text
    with JobStore(url) as store:
        store.check()
        jobs = {job: store.get(job) for job in (FINISHED, RUNNING, QUEUED)}
        messages = [event.message for event in store.events(RUNNING)]
    found_jobs = [(jobs[job].status, jobs[job].attempt, jobs[job].lost_attempts) for job in jobs]
    done = JobStatus.SUCCESSFUL
    assert found_jobs == [(done, 1, 0), (done, 2, 1), (done, 1, 0)]
    assert any("driver old-driver-1 was silent" in message for message in messages)
    digests = {job: (jobs[job].summary or {})["digest"] for job in jobs}
    assert digests[RUNNING] == digests[QUEUED] != digests[FINISHED] == "0" * 64
    # the upload has lived as long as jobs needed it
    assert old.folder.upload(UPLOAD).is_dir()
    assert served.stop() == 0
