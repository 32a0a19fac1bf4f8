"""What backups, restores and updates need of every database: the same tests for SQLite and PostgreSQL."""

import datetime as dt
import stat
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from store_contract import DatabaseContract, claim, happened, ids, running, submit, upload

from service import migrations
from service.backup import back_up, restore
from service.errors import LeaseLostError, StartUpError, StoreNewerError
from service.files import StateFolder
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

    def test_a_restored_database_has_every_row(self, store: JobStore, url: str, tmp_path: Path) -> None:
        held = running(store)
        store.record(held, [happened("stage", stage="split", message="na\u00efve \u2713")])
        store.succeed(held, message="done", summary={})
        sent = upload(store)
        key, _ = new_key("mine", Scope.ADMIN, now=store.now(), lasting=dt.timedelta(days=1))
        store.add_key(key)
        before, folder = every_row(store), StateFolder(tmp_path / "state")
        folder.make()
        # the files of the job were removed by hand
        report = back_up(url, folder, tmp_path / "backup")
        assert report.missing == (f"jobs/{held.job_id}/attempt-1", f"uploads/{sent.upload_id}")
        assert stat.S_IMODE((tmp_path / "backup" / "service.db").stat().st_mode) == 0o600
        elsewhere = f"sqlite:///{tmp_path / 'elsewhere' / 'service.db'}"
        assert restore(tmp_path / "backup", StateFolder(tmp_path / "elsewhere"), elsewhere) == (report, 0)
        with JobStore(elsewhere) as copy:
            assert every_row(copy) == before
        # and back into a database of the first kind
        if store._database.path is None:
            with pytest.raises(StartUpError, match="holds a service already"):
                restore(tmp_path / "backup", StateFolder(tmp_path / "again"), url)
            with store._database.write() as connection:
                for table in reversed(METADATA.sorted_tables):
                    connection.execute(sa.delete(table))
            restore(tmp_path / "backup", StateFolder(tmp_path / "again"), url)
            assert every_row(store) == before
        assert store.keys() == [key]

    def test_jobs_that_ran_when_the_copy_was_made_wait_again_and_no_attempt_is_lost(
        self, store: JobStore, url: str, tmp_path: Path
    ) -> None:
        held, waiting = running(store), submit(store, bbox=(0.1, 1e-17, 2.0, 1e300))
        unwanted = claim(store, "b") if submit(store, priority=1) else None
        assert unwanted is not None
        store.dismiss(unwanted.job_id)
        last = store.events(held.job_id)[-1].sequence
        folder, restored = StateFolder(tmp_path / "state"), StateFolder(tmp_path / "restored")
        folder.make()
        back_up(url, folder, tmp_path / "backup")
        assert restore(tmp_path / "backup", restored, f"sqlite:///{restored.root}/service.db")[1] == 2
        with JobStore(f"sqlite:///{restored.root}/service.db") as copy:
            freed = copy.get(held.job_id)
            assert (freed.status, freed.attempt, freed.lost_attempts) == (JobStatus.ACCEPTED, 1, 0)
            assert "restored from a backup" in freed.message
            assert copy.get(unwanted.job_id).status is JobStatus.DISMISSED
            assert copy.events(held.job_id)[-1].sequence > last + 1000
            # a driver of before no longer holds it
            with pytest.raises(LeaseLostError):
                copy.succeed(held, message="", summary={})
            assert {claim(copy).job_id, claim(copy).job_id} == {held.job_id, waiting.job_id}
            assert copy.get(waiting.job_id).request == waiting.request

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
