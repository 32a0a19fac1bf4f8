"""Backups of the state folder: what is copied, what a later backup adds and removes, what is refused."""

from __future__ import annotations

import fcntl
import json
import shutil
import sqlite3
from pathlib import Path

import pytest
from command_line import app
from copy_contract import every_row
from live_service import POINTS
from migrated import add_old_job, at_revision
from store_contract import claim
from typer.testing import CliRunner

from pipeline.errors import RunError
from service import backup
from service.backup import MARK, Report, back_up, restore
from service.errors import StartUpError, StoreNewerError
from service.files import StateFolder
from service.jobs import InputReference, Job, JobRequest, JobStatus, Upload
from service.resumable import new_id
from service.store import JobStore
from service.store.database import Database


def invoke(*words: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command."""
    result = CliRunner().invoke(app, list(words))
    return result.exit_code, result.stdout, result.stderr


class Site:
    """A state folder whose jobs have results, and its backup."""

    def __init__(self, folder: Path) -> None:
        self.folder = StateFolder(folder / "state")
        self.folder.make()
        self.target = folder / "backup"
        self.url = f"sqlite:///{self.folder.root / 'service.db'}"
        self.store = JobStore(self.url)
        self.store.migrate()

    def waiting(self, upload: Upload | None = None) -> Job:
        kind, value = ("path", "/srv/a.laz") if upload is None else ("upload", upload.upload_id)
        asked = JobRequest(tiles=(InputReference(kind=kind, value=value),))
        return self.store.create(asked, owner=None)

    def finished(self, content: str = "models") -> Job:
        self.waiting()
        job = claim(self.store)
        outputs = self.folder.outputs(job.job_id, job.attempt)
        outputs.mkdir(parents=True)
        (outputs / "buildings.parquet").write_text(content)
        self.store.succeed(job, message="done", summary={"digest": "d"})
        return job

    def uploaded(self) -> Upload:
        now = self.store.now()
        one = Upload(
            upload_id=new_id(),
            owner=None,
            filename="a.xyz",
            size_bytes=len(POINTS),
            sha256="0",
            created_at=now,
            expires_at=now,
        )
        self.folder.upload(one.upload_id).mkdir()
        (self.folder.upload(one.upload_id) / "a.xyz").write_bytes(POINTS)
        self.store.add_upload(one)
        return one

    def back_up(self) -> Report:
        return back_up(self.url, self.folder, self.target)

    def paths(self, root: Path) -> dict[str, bytes]:
        """All files below a folder except its database and its mark."""
        files = {str(path.relative_to(root)): path for path in root.rglob("*") if path.is_file()}
        return {name: path.read_bytes() for name, path in files.items() if "/" in name}


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_a_backup_holds_what_the_database_names_and_no_more(site: Site) -> None:
    job, upload = site.finished(), site.uploaded()
    site.waiting(upload)
    held = claim(site.store)
    site.folder.inputs(held.job_id, 1).mkdir(parents=True)
    (site.folder.inputs(held.job_id, 1) / "a.laz").write_text("half a file")
    for other in (".tmp-1", f".tus-{'a' * 32}"):
        (site.folder.uploads / other).mkdir()
    # what a job had so far is not a result, and the janitor may remove it now
    site.folder.so_far(job.job_id, 1).mkdir()
    (site.folder.so_far(job.job_id, 1) / "a.arrow").write_text("so far")
    report = site.back_up()
    assert report.jobs == {"running": 1, "successful": 1}
    assert (report.uploads, report.missing) == (1, ())
    assert site.paths(site.target) == {
        f"jobs/{job.job_id}/attempt-1/outputs/buildings.parquet": b"models",
        f"uploads/{upload.upload_id}/a.xyz": POINTS,
    }
    for private in (site.target, site.target / "jobs", site.target / "service.db"):
        assert private.stat().st_mode & 0o077 == 0


def test_a_restored_service_is_the_one_that_was_backed_up_except_that_nothing_runs(site: Site, tmp_path: Path) -> None:
    done, upload = site.finished(), site.uploaded()
    waiting = site.waiting(upload)
    held = claim(site.store)
    before = every_row(site.store)
    site.back_up()
    folder = StateFolder(tmp_path / "restored")
    url = f"sqlite:///{folder.root / 'service.db'}"
    report, freed = restore(site.target, folder, url)
    assert (report.jobs, freed) == ({"running": 1, "successful": 1}, 1)
    assert site.paths(folder.root) == site.paths(site.target)
    with JobStore(url) as store:
        after = every_row(store)
        changed = {name for name in before if before[name] != after[name]}
        assert changed == {"jobs", "job_events", "job_log"}
        assert store.get(done.job_id) == site.store.get(done.job_id)
        assert store.get(waiting.job_id).status is JobStatus.ACCEPTED
        again = claim(store)
        assert (again.job_id, again.attempt) == (held.job_id, 2)
    assert (folder.root / "service.db").stat().st_mode & 0o077 == 0
    # the backup was only read
    assert {path.name for path in site.target.iterdir()} == {"service.db", MARK, "jobs", "uploads"}


def test_results_that_differ_from_those_of_an_earlier_backup_replace_them(site: Site) -> None:
    job = site.finished("before")
    site.back_up()
    # the service was restored from elsewhere, and the job ran again under the same number
    path = site.folder.outputs(job.job_id, 1) / "buildings.parquet"
    path.write_text("after!")
    site.back_up()
    assert (site.target / path.relative_to(site.folder.root)).read_text() == "after!"


def test_a_database_of_an_earlier_version_is_saved_as_it_is_and_migrated_when_it_is_restored(
    site: Site, tmp_path: Path
) -> None:
    site.store.close()
    for left in site.folder.root.glob("service.db*"):
        left.unlink()
    with JobStore(site.url) as store, at_revision(store, "0003") as connection:
        job_id = add_old_job(connection, JobRequest(tiles=()), status="successful")
    site.back_up()
    with sqlite3.connect(site.target / "service.db") as connection:
        assert connection.execute("SELECT version_num FROM alembic_version").fetchone() == ("0003",)
    folder = StateFolder(tmp_path / "restored")
    url = f"sqlite:///{folder.root / 'service.db'}"
    restore(site.target, folder, url)
    with JobStore(url) as store:
        store.check()
        assert store.get(job_id).status is JobStatus.SUCCESSFUL


def test_places_that_cannot_hold_a_backup_are_refused(site: Site, tmp_path: Path) -> None:
    other = tmp_path / "photographs"
    other.mkdir()
    (other / "a.jpg").write_text("dear")
    (tmp_path / "file").write_text("")
    for target, words in (
        (other, "holds other files"),
        (site.folder.root, "keep them apart"),
        (site.folder.root / "backup", "keep them apart"),
        (tmp_path, "keep them apart"),
        (tmp_path / "file", "not a folder"),
    ):
        with pytest.raises(StartUpError, match=words):
            back_up(site.url, site.folder, target)
    assert [path.name for path in other.iterdir()] == ["a.jpg"]
    code, _, complaint = invoke("backup", "--to", str(site.target), "--state", str(tmp_path / "nowhere"))
    assert code == 2
    assert "does not exist: give that of the service with --state" in complaint


def test_a_restore_over_a_service_or_from_something_else_is_refused(site: Site, tmp_path: Path) -> None:
    site.finished()
    site.back_up()
    with pytest.raises(StartUpError, match="there is a database"):
        restore(site.target, site.folder, site.url)
    other = StateFolder(tmp_path / "other")
    (other.jobs / ("f" * 32) / "attempt-1").mkdir(parents=True)
    with pytest.raises(StartUpError, match="folders that the backup does not have"):
        restore(site.target, other, f"sqlite:///{other.root / 'service.db'}")
    for source in (site.folder.root, tmp_path / "nowhere"):
        with pytest.raises(StartUpError, match="is not a whole backup"):
            restore(source, StateFolder(tmp_path / "new"), "sqlite:////nowhere/a.db")
    (site.target / "service.db").rename(tmp_path / "kept.db")
    with pytest.raises(StartUpError, match="is not a whole backup"):
        restore(site.target, StateFolder(tmp_path / "new"), "sqlite:////nowhere/a.db")


def test_a_further_backup_copies_what_is_new_and_removes_what_is_gone(site: Site) -> None:
    old, kept = site.finished("old"), site.finished("kept")
    site.back_up()
    copy = site.target / "jobs" / kept.job_id / "attempt-1" / "outputs" / "buildings.parquet"
    inode = copy.stat().st_ino
    site.store.remove(old.job_id)
    shutil.rmtree(site.folder.job(old.job_id))
    new = site.finished("new")
    site.back_up()
    assert copy.stat().st_ino == inode
    assert {path.name for path in (site.target / "jobs").iterdir()} == {kept.job_id, new.job_id}


def test_what_is_removed_while_the_backup_is_made_is_not_named_by_its_database(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone, stays = site.finished("gone"), site.finished("stays")
    copy, copies = backup._copy_database, []

    def then_remove(database: Database, path: Path) -> None:
        copy(database, path)
        copies.append(path)
        if len(copies) == 1:
            site.store.remove(gone.job_id)
            shutil.rmtree(site.folder.job(gone.job_id))

    monkeypatch.setattr(backup, "_copy_database", then_remove)
    report = site.back_up()
    assert len(copies) == 2
    assert (report.jobs, report.missing) == ({"successful": 1}, ())
    assert {path.name for path in (site.target / "jobs").iterdir()} == {stays.job_id}


def test_results_that_are_lost_are_reported_and_the_rest_is_saved_and_restored(site: Site, tmp_path: Path) -> None:
    gone, stays = site.finished("gone"), site.finished("stays")
    shutil.rmtree(site.folder.job(gone.job_id))
    code, shown, warned = invoke("backup", "--to", str(site.target), "--state", str(site.folder.root), "--json")
    assert code == 0
    assert f"jobs/{gone.job_id}/attempt-1 is in the database and not in the state folder" in warned
    assert json.loads(shown)["jobs"] == {"successful": 2}
    folder = StateFolder(tmp_path / "restored")
    code, shown, warned = invoke("restore", str(site.target), "--state", str(folder.root))
    assert code == 0
    assert "jobs: 2 successful; uploads: 0; 0 running jobs wait again" in " ".join(shown.split())
    assert f"jobs/{gone.job_id}/attempt-1 is in the database and not in the backup" in " ".join(warned.split())
    assert [path.name for path in folder.jobs.iterdir()] == [stays.job_id]


@pytest.mark.parametrize("broken", ["shutil.copy2", "os.sync"])
def test_an_interrupted_backup_leaves_the_one_before_whole(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    first = site.finished("first")
    site.back_up()
    site.store.remove(first.job_id)
    shutil.rmtree(site.folder.job(first.job_id))
    second = site.finished("second")

    def full(*_arguments: object, **_options: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(broken, full)
        with pytest.raises(RunError, match="No space left"):
            site.back_up()
    folder = StateFolder(tmp_path / "restored")
    restore(site.target, folder, f"sqlite:///{folder.root / 'service.db'}")
    with JobStore(f"sqlite:///{folder.root / 'service.db'}") as store:
        assert store.get(first.job_id).status is JobStatus.SUCCESSFUL
    assert (folder.outputs(first.job_id, 1) / "buildings.parquet").read_text() == "first"
    site.back_up()
    assert [path.name for path in (site.target / "jobs").iterdir()] == [second.job_id]


def test_an_interrupted_restore_is_continued(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site.finished("one"), site.finished("two")
    site.back_up()
    folder = StateFolder(tmp_path / "restored")
    url, copied = f"sqlite:///{folder.root / 'service.db'}", []
    copy2 = shutil.copy2

    def once(*arguments: object) -> None:
        if copied:
            raise OSError(28, "No space left on device")
        copied.append(copy2(*arguments))

    with monkeypatch.context() as patch:
        patch.setattr("shutil.copy2", once)
        with pytest.raises(RunError, match="No space left"):
            restore(site.target, folder, url)
    assert not (folder.root / "service.db").exists()
    restore(site.target, folder, url)
    assert site.paths(folder.root) == site.paths(site.folder.root)


def test_two_backups_into_one_folder_do_not_mix(site: Site) -> None:
    site.back_up()
    with (site.target / MARK).open() as mark:
        fcntl.flock(mark, fcntl.LOCK_EX)
        with pytest.raises(StartUpError, match="another backup"):
            site.back_up()


def test_a_backup_of_a_newer_version_is_refused_before_anything_else_is_copied(site: Site, tmp_path: Path) -> None:
    site.finished()
    site.back_up()
    with sqlite3.connect(site.target / "service.db") as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    with pytest.raises(StoreNewerError, match=r"newer version of gablework .*9999"):
        restore(site.target, StateFolder(tmp_path / "new"), f"sqlite:///{tmp_path / 'new' / 'service.db'}")
    assert not any((tmp_path / "new" / "jobs").iterdir())
