"""Backups of the state folder: what is copied, what a later backup adds and removes, what is refused."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import sqlite3
from pathlib import Path

import pytest
from command_line import app
from copy_contract import every_row
from live_service import POINTS
from store_contract import claim
from typer.testing import CliRunner

from pipeline.errors import RunError
from service.backup import MARK, Report, back_up, restore
from service.errors import StartUpError
from service.files import StateFolder
from service.jobs import InputReference, Job, JobRequest, JobStatus, Upload
from service.resumable import Promise, Unfinished, create, find, new_id
from service.store import JobStore


def invoke(*words: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command."""
    result = CliRunner().invoke(app, list(words))
    return result.exit_code, result.stdout, result.stderr


def quiet(_sentence: str) -> None:
    """Shows nothing."""


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
        return self.store.create(asked, owner=None, max_queued=1000, max_queued_per_key=1000)

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

    def unfinished(self, content: bytes) -> str:
        """A resumable upload of which some bytes have arrived, while its request goes on."""
        upload_id, now = new_id(), self.store.now()
        promise = Promise(
            upload_id=upload_id, owner=None, filename="b.xyz", size_bytes=len(POINTS), sha256=None, metadata=""
        )
        create(self.folder, promise, now, most=10)
        request = Unfinished(self.folder, promise)
        request.recover()
        request.begin(now, is_checked=False)
        request.write(content)
        request.end()
        request.begin(now, is_checked=False)
        request.write(b"not on the disk yet")
        return upload_id

    def back_up(self) -> Report:
        return back_up(self.store, self.folder, self.target, quiet)

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
    (site.folder.uploads / ".tmp-1").mkdir()
    report = site.back_up()
    assert report.jobs == {"running": 1, "successful": 1}
    assert (report.uploads, report.unfinished_uploads, report.missing) == (1, 0, ())
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
    report, freed = restore(site.target, folder, url, quiet)
    assert (report.jobs, freed) == ({"running": 1, "successful": 1}, 1)
    assert site.paths(folder.root) == site.paths(site.folder.root)
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


def test_a_further_backup_copies_what_is_new_and_removes_what_is_gone(site: Site) -> None:
    old, kept = site.finished("old"), site.finished("kept")
    assert site.back_up().copied_bytes == len("old") + len("kept")
    copy = site.target / "jobs" / kept.job_id / "attempt-1" / "outputs" / "buildings.parquet"
    inode = copy.stat().st_ino
    site.store.remove(old.job_id)
    shutil.rmtree(site.folder.job(old.job_id))
    new = site.finished("new")
    assert site.back_up().copied_bytes == len("new")
    assert copy.stat().st_ino == inode
    assert {path.name for path in (site.target / "jobs").iterdir()} == {kept.job_id, new.job_id}


def test_the_buildings_that_a_job_had_so_far_are_left_out_and_may_vanish_meanwhile(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = site.finished()
    so_far = site.folder.so_far(job.job_id, 1)
    so_far.mkdir()
    (so_far / "a.arrow").write_text("so far")
    (site.folder.outputs(job.job_id, 1) / "so-far").write_text("an output of that name")
    copytree = shutil.copytree

    def after_the_janitor(*arguments: object, **options: object) -> object:
        shutil.rmtree(so_far, ignore_errors=True)
        return copytree(*arguments, **options)

    # one that an earlier version has copied goes
    copied = site.target / "jobs" / job.job_id / "attempt-1" / "so-far"
    shutil.copytree(so_far, copied)
    (site.target / MARK).write_text("{}")
    monkeypatch.setattr("shutil.copytree", after_the_janitor)
    report = site.back_up()
    assert report.copied_bytes == len("models") + len("an output of that name")
    assert {path.name for path in copied.parent.iterdir()} == {"outputs"}
    assert (copied.parent / "outputs" / "so-far").read_text() == "an output of that name"
    monkeypatch.undo()
    so_far.mkdir()
    (so_far / "a.arrow").write_text("so far")
    assert site.back_up().copied_bytes == 0


def test_results_that_differ_from_those_of_an_earlier_backup_replace_them(site: Site) -> None:
    job = site.finished("before")
    site.back_up()
    # the service was restored from elsewhere, and the job ran again under the same number
    path = site.folder.outputs(job.job_id, 1) / "buildings.parquet"
    path.write_text("after!")
    site.back_up()
    assert (site.target / path.relative_to(site.folder.root)).read_text() == "after!"


def test_what_is_removed_while_the_backup_is_made_is_not_named_by_its_database(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone, stays = site.finished("gone"), site.finished("stays")
    copy_to, copies = site.store.copy_to, []

    def then_remove(path: Path) -> None:
        copy_to(path)
        copies.append(path)
        if len(copies) == 1:
            site.store.remove(gone.job_id)
            shutil.rmtree(site.folder.job(gone.job_id))

    monkeypatch.setattr(site.store, "copy_to", then_remove)
    report = site.back_up()
    assert len(copies) == 2
    assert (report.jobs, report.missing) == ({"successful": 1}, ())
    assert {path.name for path in (site.target / "jobs").iterdir()} == {stays.job_id}


def test_results_that_someone_removed_by_hand_are_reported_and_the_rest_is_saved(site: Site, tmp_path: Path) -> None:
    gone, stays = site.finished("gone"), site.finished("stays")
    shutil.rmtree(site.folder.job(gone.job_id))
    words = ("--to", str(site.target), "--state", str(site.folder.root))
    code, _, warned = invoke("backup", *words)
    assert code == 0
    assert f"jobs/{gone.job_id}/attempt-1 is in the database and not in the state folder" in warned
    folder = StateFolder(tmp_path / "restored")
    code, _, warned = invoke("restore", str(site.target), "--state", str(folder.root))
    assert code == 0
    assert f"jobs/{gone.job_id}/attempt-1 was lost before the backup was made" in " ".join(warned.split())
    assert [path.name for path in folder.jobs.iterdir()] == [stays.job_id]


def test_a_backup_that_has_lost_results_is_refused_before_anything_is_copied(site: Site, tmp_path: Path) -> None:
    gone, upload = site.finished("gone"), site.uploaded()
    site.finished("stays")
    site.back_up()
    shutil.rmtree(site.target / "jobs" / gone.job_id)
    shutil.rmtree(site.target / "uploads" / upload.upload_id)
    folder = StateFolder(tmp_path / "restored")
    database = folder.root / "service.db"
    with pytest.raises(StartUpError, match=r"lost 2 folders .*: (.*)\. Use another backup, .* \"missing\"") as refused:
        restore(site.target, folder, f"sqlite:///{database}", quiet)
    lost = [f"jobs/{gone.job_id}/attempt-1", f"uploads/{upload.upload_id}"]
    assert ", ".join(lost) in str(refused.value)
    assert not folder.root.exists()
    # the way out that the message names
    mark = json.loads((site.target / MARK).read_text())
    (site.target / MARK).write_text(json.dumps(mark | {"missing": lost}))
    report, _ = restore(site.target, folder, f"sqlite:///{database}", quiet)
    assert report.missing == tuple(lost)
    assert database.exists()


def test_results_that_a_backup_loses_while_it_is_restored_stop_the_restore(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = site.finished()
    site.back_up()
    mkdir = StateFolder.make

    def then_lose(folder: StateFolder) -> None:
        mkdir(folder)
        shutil.rmtree(site.target / "jobs" / job.job_id)

    monkeypatch.setattr(StateFolder, "make", then_lose)
    folder = StateFolder(tmp_path / "restored")
    with pytest.raises(StartUpError, match=f"lost 1 folders .*{job.job_id}"):
        restore(site.target, folder, f"sqlite:///{folder.root / 'service.db'}", quiet)
    assert not (folder.root / "service.db").exists()


def test_an_unfinished_upload_goes_on_at_the_last_byte_that_was_on_the_disk(site: Site, tmp_path: Path) -> None:
    upload_id = site.unfinished(POINTS[:100])
    assert site.back_up().unfinished_uploads == 1
    folder = StateFolder(tmp_path / "restored")
    restore(site.target, folder, f"sqlite:///{folder.root / 'service.db'}", quiet)
    request = Unfinished(folder, find(folder, upload_id, None))
    request.recover()
    assert request.offset == 100
    assert request.path.read_bytes() == POINTS[:100]
    request.close()


def test_an_interrupted_copy_of_an_unfinished_upload_leaves_the_one_before(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    upload_id = site.unfinished(POINTS[:100])
    site.back_up()

    def full(*_arguments: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        # after the file was copied, and before it is known how many of its bytes count
        patch.setattr("service.resumable._write_progress", full)
        with pytest.raises(RunError, match="No space left"):
            site.back_up()
    folder = StateFolder(tmp_path / "restored")
    restore(site.target, folder, f"sqlite:///{folder.root / 'service.db'}", quiet)
    assert [path.name for path in folder.uploads.iterdir()] == [f".tus-{upload_id}"]
    request = Unfinished(folder, find(folder, upload_id, None))
    request.recover()
    assert request.offset == 100
    request.close()
    # a later backup removes what is left
    site.back_up()
    assert [path.name for path in (site.target / "uploads").iterdir()] == [f".tus-{upload_id}"]


def test_a_backup_is_marked_as_whole_only_when_its_database_is_in_place(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.finished()
    replace = Path.replace

    def full(path: Path, target: Path) -> Path:
        if target.name == "service.db":
            raise OSError(28, "No space left on device")
        return replace(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        with pytest.raises(RunError, match="No space left"):
            site.back_up()
    assert set(json.loads((site.target / MARK).read_text())) == {"gablework"}
    site.back_up()
    assert json.loads((site.target / MARK).read_text())["jobs"] == {"successful": 1}


def test_an_interrupted_backup_leaves_the_one_before_whole(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = site.finished("first")
    site.back_up()
    site.store.remove(first.job_id)
    shutil.rmtree(site.folder.job(first.job_id))
    second = site.finished("second")

    def full(*_arguments: object, **_options: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("shutil.copytree", full)
        with pytest.raises(RunError, match="No space left"):
            site.back_up()
    folder = StateFolder(tmp_path / "restored")
    url = f"sqlite:///{folder.root / 'service.db'}"
    restore(site.target, folder, url, quiet)
    with JobStore(url) as store:
        assert store.get(first.job_id).status is JobStatus.SUCCESSFUL
    assert (folder.outputs(first.job_id, 1) / "buildings.parquet").read_text() == "first"
    site.back_up()
    assert [path.name for path in (site.target / "jobs").iterdir()] == [second.job_id]


def test_an_interrupted_restore_is_continued(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site.finished("one"), site.finished("two")
    site.back_up()
    folder = StateFolder(tmp_path / "restored")
    url, copied = f"sqlite:///{folder.root / 'service.db'}", []
    copytree = shutil.copytree

    def once(*arguments: object, **options: object) -> None:
        if copied:
            raise OSError(28, "No space left on device")
        copied.append(copytree(*arguments, **options))

    with monkeypatch.context() as patch:
        patch.setattr("shutil.copytree", once)
        with pytest.raises(RunError, match="No space left"):
            restore(site.target, folder, url, quiet)
    assert not (folder.root / "service.db").exists()
    restore(site.target, folder, url, quiet)
    assert site.paths(folder.root) == site.paths(site.folder.root)


def test_a_database_of_an_earlier_version_is_saved_as_it_is_and_migrated_when_it_is_restored(
    site: Site, tmp_path: Path
) -> None:
    from alembic import command
    from schedule_store_contract import migrate

    job = site.finished()
    with site.store._database.write() as connection:
        migrate(connection, command.downgrade, "0003")
    site.back_up()
    with sqlite3.connect(site.target / "service.db") as connection:
        assert connection.execute("SELECT version_num FROM alembic_version").fetchone() == ("0003",)
    folder = StateFolder(tmp_path / "restored")
    url = f"sqlite:///{folder.root / 'service.db'}"
    restore(site.target, folder, url, quiet)
    with JobStore(url) as store:
        store.check()
        assert store.get(job.job_id).status is JobStatus.SUCCESSFUL


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
            back_up(site.store, site.folder, target, quiet)
    assert [path.name for path in other.iterdir()] == ["a.jpg"]
    code, _, complaint = invoke("backup", "--to", str(site.target), "--state", str(tmp_path / "nowhere"))
    assert code == 2
    assert "does not exist: give that of the service with --state" in complaint


def test_two_backups_into_one_folder_do_not_mix(site: Site) -> None:
    site.back_up()
    descriptor = os.open(site.target, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        with pytest.raises(StartUpError, match="another backup"):
            site.back_up()
    finally:
        os.close(descriptor)


def test_a_restore_over_a_service_or_from_something_else_is_refused(site: Site, tmp_path: Path) -> None:
    site.finished()
    site.back_up()
    with pytest.raises(StartUpError, match="there is a database"):
        restore(site.target, site.folder, site.url, quiet)
    other = StateFolder(tmp_path / "other")
    (other.jobs / ("f" * 32) / "attempt-1").mkdir(parents=True)
    with pytest.raises(StartUpError, match="folders that the backup does not have"):
        restore(site.target, other, f"sqlite:///{other.root / 'service.db'}", quiet)
    for source in (site.folder.root, tmp_path / "nowhere"):
        with pytest.raises(StartUpError, match="is not a backup"):
            restore(source, StateFolder(tmp_path / "new"), "sqlite:////nowhere/a.db", quiet)
    (site.target / "service.db").rename(tmp_path / "kept.db")
    with pytest.raises(StartUpError, match="interrupted"):
        restore(site.target, StateFolder(tmp_path / "new"), "sqlite:////nowhere/a.db", quiet)


def test_a_backup_of_a_newer_version_is_refused(site: Site, tmp_path: Path) -> None:
    site.back_up()
    with sqlite3.connect(site.target / "service.db") as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    with pytest.raises(StartUpError, match=r"newer version of gablework .*9999"):
        restore(site.target, StateFolder(tmp_path / "new"), f"sqlite:///{tmp_path / 'new' / 'service.db'}", quiet)


def test_the_commands_print_what_they_did(site: Site, tmp_path: Path) -> None:
    site.finished()
    code, shown, _ = invoke("backup", "--to", str(site.target), "--state", str(site.folder.root), "--json")
    assert code == 0
    assert json.loads(shown)["jobs"] == {"successful": 1}
    code, shown, _ = invoke("restore", str(site.target), "--state", str(tmp_path / "new"))
    assert code == 0
    assert "jobs: 1 successful; uploads: 0 and 0 unfinished; 0 running jobs wait again" in " ".join(shown.split())
