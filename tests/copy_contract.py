"""What backups, restores and updates need of every database: the same tests for SQLite and PostgreSQL."""

import datetime as dt
import stat
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from store_contract import DatabaseContract, claim, happened, ids, running, submit, upload

from service import migrations
from service.errors import LeaseLostError, StoreNewerError
from service.jobs import JobStatus
from service.keys import Scope, new_key
from service.store import JobStore
from service.store.tables import METADATA


def every_row(store: JobStore) -> dict[str, list[tuple[Any, ...]]]:
    """The content of all tables."""
    with store._database.read() as connection:
        tables = METADATA.sorted_tables
        found = {table.name: [tuple(row) for row in connection.execute(sa.select(table))] for table in tables}
    return {name: sorted(rows, key=repr) for name, rows in found.items()}


class CopyContract(DatabaseContract):
    """What a store does when it is copied, restored or updated, whatever the database."""

    def test_a_copy_has_every_row_and_can_be_loaded_into_an_empty_database(
        self, store: JobStore, tmp_path: Path
    ) -> None:
        held = running(store)
        store.record(held, [happened("stage", stage="split", message="na\u00efve \u2713")])
        submit(store, bbox=(0.1, 1e-17, 2.0, 1e300))
        sent = upload(store)
        key, _ = new_key("mine", Scope.ADMIN, now=store.now(), lasting=dt.timedelta(days=1))
        store.add_key(key)
        before = every_row(store)
        assert store.is_empty is False
        store.copy_to(tmp_path / "copy.db")
        assert stat.S_IMODE((tmp_path / "copy.db").stat().st_mode) == 0o600
        submit(store)
        assert len(every_row(store)["jobs"]) == 3
        with store._database.write() as connection:
            for table in reversed(METADATA.sorted_tables):
                connection.execute(sa.delete(table))
        assert store.is_empty
        store.load(tmp_path / "copy.db")
        assert every_row(store) == before
        assert store.upload(sent.upload_id) == sent
        assert store.keys() == [key]

    def test_jobs_that_ran_when_the_copy_was_made_wait_again_and_no_attempt_is_lost(self, store: JobStore) -> None:
        held, waiting = running(store), submit(store)
        unwanted = claim(store, "b") if submit(store, priority=1) else None
        assert unwanted is not None
        store.dismiss(unwanted.job_id)
        last = store.events(held.job_id)[-1].sequence
        made = dt.datetime(2026, 3, 1, 12, 30, tzinfo=dt.UTC)
        assert store.free_running(made) == 2
        freed = store.get(held.job_id)
        assert (freed.status, freed.attempt, freed.lost_attempts) == (JobStatus.ACCEPTED, 1, 0)
        assert "backup of 2026-03-01 12:30:00" in freed.message
        assert store.get(unwanted.job_id).status is JobStatus.DISMISSED
        assert store.events(held.job_id)[-1].sequence > last + 1000
        # a driver of before no longer holds it
        with pytest.raises(LeaseLostError):
            store.succeed(held, message="", summary={})
        assert {claim(store).job_id, claim(store).job_id} == {held.job_id, waiting.job_id}

    def test_a_process_stops_where_a_newer_version_migrates_its_database(self, store: JobStore) -> None:
        held, waiting = running(store), submit(store)
        with store._database.write() as connection:
            connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
        # what writes looks at once, what only reads within a second
        writing = (lambda: submit(store), lambda: store.succeed(held, message="", summary={}), lambda: claim(store))
        for write in writing:
            with pytest.raises(StoreNewerError, match="revision 9999, this version knows"):
                write()
        store._database._looked_s = float("-inf")
        with pytest.raises(StoreNewerError, match="9999"):
            store.get(waiting.job_id)
        # nothing was lost: the older version again, from before the update
        with store._database.engine.begin() as connection:
            connection.exec_driver_sql(f"UPDATE alembic_version SET version_num = '{migrations.head()}'")
        assert store.get(held.job_id).status is JobStatus.RUNNING
        assert ids(store) == {held.job_id, waiting.job_id}
