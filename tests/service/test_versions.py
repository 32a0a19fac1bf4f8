"""Processes of two versions over one database: the older one is refused, and no job is lost."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from command_line import app
from driver_bench import Bench
from migrated import with_tables
from processes import wait_for
from typer.testing import CliRunner

from service import migrations
from service.jobs import JobStatus
from service.store import JobStore

if TYPE_CHECKING:
    from conftest import LocalService


def revise(store: JobStore, revision: str) -> None:
    """Set the revision that the database names, as a migration by another version does."""
    with store._database.engine.begin() as connection:
        connection.exec_driver_sql(f"UPDATE alembic_version SET version_num = '{revision}'")
    # readers look once a second; here at once
    store._database._looked_s = float("-inf")


def test_an_api_of_an_older_version_says_that_a_newer_one_has_its_database(local_service: LocalService) -> None:
    client, job = local_service.client, local_service.waiting()
    local_service.store.migrate()
    revise(local_service.store, "9999")
    for answer in (
        client.post("/processes/echo/execution", json={"inputs": {"message": "hello"}}),
        client.delete(f"/jobs/{job.job_id}"),
        client.get(f"/jobs/{job.job_id}"),
    ):
        assert (answer.status_code, answer.json()["type"]) == (503, "urn:gablework:problem:database-newer")
        assert "newer version" in answer.json()["detail"]
        assert "Retry-After" in answer.headers
    assert client.get("/healthz").status_code == 200
    ready = client.get("/readyz")
    assert (ready.status_code, "newer version" in ready.text) == (503, True)
    revise(local_service.store, migrations.head())
    assert client.get(f"/jobs/{job.job_id}").json()["status"] == "accepted"


def test_a_driver_of_an_older_version_lets_its_job_go_and_a_newer_one_takes_it(bench: Bench) -> None:
    job, _ = bench.under_way(lease_s=1.0)
    revise(bench.store, "9999")
    # its heartbeat is refused, so its run is cancelled when the lease has ended
    wait_for(lambda: not bench.folder.attempt(job.job_id, 1).exists(), "the end of the attempt")
    assert bench.script.runs == 1
    revise(bench.store, migrations.head())
    done = bench.over(job)
    assert (done.status, done.attempt, done.lost_attempts) == (JobStatus.SUCCESSFUL, 2, 1)


@pytest.mark.parametrize("words", [("serve", "--port", "0"), ("keys", "list")])
def test_a_command_of_an_older_version_refuses_the_database_of_a_newer_one(
    tmp_path: Path, words: tuple[str, ...]
) -> None:
    with JobStore(with_tables(f"sqlite:///{tmp_path / 'service.db'}")) as store:
        revise(store, "9999")
    before = (tmp_path / "service.db").read_bytes()
    found = CliRunner().invoke(app, [*words, "--state", str(tmp_path)])
    assert found.exit_code == 4
    said = " ".join(found.stderr.split())
    assert "is of a newer version of gablework (revision 9999" in said
    assert "update this one, or restore a backup" in said
    assert (tmp_path / "service.db").read_bytes() == before
