"""Backups of a service: its database and the files that the database names, made while the service runs.

A backup is a folder like the state folder, with a mark beside: `backup.json`. A further backup into the same folder
copies only what is new. The database comes last and replaces the one before, and what it no longer names goes after
that. If a backup is interrupted, the folder still holds the one before.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import fcntl
import json
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pipeline import __version__
from pipeline.errors import RunError
from service import migrations
from service.errors import StartUpError
from service.files import SO_FAR, StateFolder, folder_fault, is_id, make_private_file
from service.resumable import PREFIX, copy_unfinished
from service.store import JobStore

DATABASE = "service.db"
"""Name of the copy of the database."""
MARK = "backup.json"
"""Name of the file that marks the folder of a backup."""
ROUNDS = 20
"""Maximum number of copies of the database in one backup; another one is made if files vanish meanwhile."""
_PARTIAL = ".partial-"
_SHOWN = 5
"""Folders that a message names."""
_NEW = ".new.db"

Say = Callable[[str], None]
"""Shows one sentence about the progress."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Report:
    """The content of a backup."""

    made: dt.datetime
    """When the database was copied, by its own clock."""
    jobs: dict[str, int]
    """Number of jobs by status."""
    uploads: int
    """Number of finished uploads."""
    unfinished_uploads: int
    """Number of resumable uploads of which a part had arrived."""
    copied_bytes: int
    """Bytes of the files that were copied now; the others were there already."""
    missing: tuple[str, ...]
    """Folders that the database names and that the state folder does not have."""

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {**dataclasses.asdict(self), "made": self.made.isoformat(), "missing": list(self.missing)}

    @property
    def sentence(self) -> str:
        """The content in one sentence."""
        jobs = ", ".join(f"{count} {status}" for status, count in sorted(self.jobs.items())) or "none"
        return f"jobs: {jobs}; uploads: {self.uploads} and {self.unfinished_uploads} unfinished"


def back_up(store: JobStore, folder: StateFolder, target: Path, say: Say) -> Report:
    """Copy the database and all files that it names, while the service runs.

    Files of jobs that are not over are left out: such a job runs again.

    Parameters
    ----------
    store : JobStore
        The database.
    folder : StateFolder
        The files.
    target : Path
        A folder that is empty or absent, or one of an earlier backup.
    say : callable
        Shows the progress.

    Raises
    ------
    StartUpError
        The target cannot hold a backup.
    StoreError
        The database does not answer, or has other tables.
    RunError
        The backup cannot be written; an earlier one in the folder is still whole.
    """
    _check_target(folder, target)
    with _in_our_words(f"the backup in {target}"), _alone(target):
        place = StateFolder(target)
        place.make()
        new = target / _NEW
        copied, gone = 0, set[str]()
        for _ in range(ROUNDS):
            unfinished = _copy_all_unfinished(folder, place)
            new.unlink(missing_ok=True)
            made = store.now()
            store.copy_to(new)
            named, missing = _named(new), set[str]()
            say(f"{len(named)} folders belong to the database of {made:%Y-%m-%d %H:%M:%S} UTC")
            for name in named:
                size = _copied(name, folder.root, target)
                copied += size or 0
                if size is None:
                    missing.add(name)
            # what vanished was removed from the database before: a newer copy does not name it
            if missing <= gone:
                break
            gone |= missing
        finished = {Path(name).name for name in named}
        unfinished = [upload_id for upload_id in unfinished if upload_id not in finished]
        report = Report(
            made=made,
            jobs=_jobs(new),
            uploads=sum(name.startswith("uploads/") for name in named),
            unfinished_uploads=len(unfinished),
            copied_bytes=copied,
            missing=tuple(sorted(missing)),
        )
        # everything is on the disk before the database names it
        os.sync()
        new.replace(target / DATABASE)
        _mark(target, report.as_dict())
        _remove_others(place, {*named, *(f"uploads/{PREFIX}{upload_id}" for upload_id in unfinished)})
    return report


def restore(source: Path, folder: StateFolder, database: str, say: Say) -> tuple[Report, int]:
    """Make a service from a backup. It must not run yet, and its database must be new.

    Parameters
    ----------
    source : Path
        The folder of the backup.
    folder : StateFolder
        The state folder, empty or absent; what an interrupted restore left there is used.
    database : str
        SQLAlchemy's URL of the database: absent, or without any rows.
    say : callable
        Shows the progress.

    Returns
    -------
    tuple of Report and int
        The content of the backup; how many of its jobs were running and now wait again.

    Raises
    ------
    StartUpError
        The backup is not whole or has lost folders, or there is a service already.
    StoreError
        The database does not answer, or the backup is of a newer version.
    RunError
        The state folder cannot be written.
    """
    report = _report(source)
    with JobStore(database) as store, _in_our_words(f"the state folder {folder.root}"):
        _check_is_new(store, folder, source)
        named = [name for name in _named(source / DATABASE) if name not in report.missing]
        # before anything is copied, which may take hours
        _check_has_all(source, [name for name in named if not (source / name).is_dir()])
        folder.make()
        unfinished = [f"uploads/{path.name}" for path in (source / "uploads").glob(f"{PREFIX}*")]
        _check_has_all(source, [name for name in [*named, *unfinished] if _copied(name, source, folder.root) is None])
        new = folder.root / _NEW
        for path in (new, *(new.with_name(new.name + ending) for ending in ("-wal", "-shm"))):
            path.unlink(missing_ok=True)
        make_private_file(new)
        shutil.copyfile(source / DATABASE, new)
        with JobStore(f"sqlite:///{new}") as copy:
            copy.migrate()
            freed = copy.free_running(report.made)
        say("all files are in place")
        os.sync()
        if store.path is None:
            store.migrate()
            store.load(new)
            new.unlink()
        else:
            store.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            shutil.move(new, store.path)
    return report, freed


# --- what is copied


def _rows(database: Path, query: str) -> list[Any]:
    """The rows of a query to a SQLite file, which is only read."""
    with contextlib.closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as connection:
        return connection.execute(query).fetchall()


def _named(database: Path) -> list[str]:
    """The folders that a database of any revision names: results of successful jobs, and finished uploads."""
    jobs = _rows(database, "SELECT job_id, attempt FROM jobs WHERE status = 'successful'")
    uploads = _rows(database, "SELECT upload_id FROM uploads")
    return sorted(
        [*(f"jobs/{job}/attempt-{number}" for job, number in jobs), *(f"uploads/{one}" for (one,) in uploads)]
    )


def _jobs(database: Path) -> dict[str, int]:
    return dict(_rows(database, "SELECT status, count(*) FROM jobs GROUP BY status"))


def _stored(backup: Path) -> set[str]:
    """The folders that a backup or a state folder holds."""
    jobs = {f"jobs/{path.parent.name}/{path.name}" for path in backup.glob("jobs/*/*")}
    return jobs | {f"uploads/{path.name}" for path in backup.glob("uploads/*")}


def _copied(name: str, source_root: Path, target_root: Path) -> int | None:
    """Copy a folder that no longer changes, unless it is there; the copied bytes, or None without such a folder.

    The buildings that a job had so far are left out: they are not results, and the janitor may remove them now.
    """
    source, target = source_root / name, target_root / name
    left_out = {SO_FAR} if name.startswith("jobs/") else set[str]()
    try:
        before = _content(source, left_out)
        if target.is_dir() and _content(target) == before:
            return 0
        target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        partial = target.with_name(f"{_PARTIAL}{target.name}")
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(
            source, partial, symlinks=True, ignore=lambda place, _: left_out if Path(place) == source else ()
        )
    except (FileNotFoundError, shutil.Error):
        if source.is_dir():
            raise
        return None
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)
    return sum(size for size, _ in before.values())


def _content(folder: Path, left_out: Iterable[str] = ()) -> dict[str, tuple[int, int]]:
    """Bytes and time of every file in a folder, by its relative path, without those in some of its own folders.

    Raises
    ------
    FileNotFoundError
        The folder is missing or is being removed.
    """
    found: dict[str, tuple[int, int]] = {}
    folder.stat()
    for place, folders, names in os.walk(folder):
        if Path(place) == folder:
            folders[:] = [name for name in folders if name not in left_out]
        for name in names:
            stat = os.lstat(os.path.join(place, name))  # noqa: PTH118 - folders have thousands of files
            found[os.path.relpath(os.path.join(place, name), folder)] = (stat.st_size, stat.st_mtime_ns)  # noqa: PTH118
    return found


def _copy_all_unfinished(folder: StateFolder, target: StateFolder) -> list[str]:
    """Copy the unfinished uploads again; the ids of those that were there.

    Each replaces its earlier copy when it is whole: the backup before may be the one that is restored.
    """
    found = []
    for path in sorted(folder.uploads.glob(f"{PREFIX}*")):
        upload_id = path.name.removeprefix(PREFIX)
        whole, partial = target.uploads / path.name, target.uploads / f"{_PARTIAL}{path.name}"
        shutil.rmtree(partial, ignore_errors=True)
        if is_id(upload_id) and copy_unfinished(path, partial):
            shutil.rmtree(whole, ignore_errors=True)
            partial.rename(whole)
            found.append(upload_id)
    return found


def _remove_others(backup: StateFolder, named: Iterable[str]) -> None:
    """Remove from a backup what its database no longer names, and what an interrupted backup left."""
    wanted = set(named)
    for name in _stored(backup.root) - wanted:
        shutil.rmtree(backup.root / name, ignore_errors=True)
    jobs = {name.split("/")[1] for name in wanted if name.startswith("jobs/")}
    for path in backup.jobs.iterdir():
        if path.name not in jobs:
            shutil.rmtree(path, ignore_errors=True)


# --- the folders


def _check_target(folder: StateFolder, target: Path) -> None:
    """Refuse a folder that holds something else, or that lies in the state folder."""
    root, place = folder.root.resolve(), target.resolve()
    if place == root or root in place.parents or place in root.parents:
        raise StartUpError(f"the backup would go to {target}, and the state folder is {folder.root}: keep them apart")
    if not folder.root.is_dir():
        fault = "is not a folder" if folder.root.exists() else "does not exist"
        raise StartUpError(f"the state folder {folder.root} {fault}: give that of the service with --state")
    target_fault = folder_fault(target)
    if target_fault is not None:
        raise StartUpError(f"the backup cannot go to {target}: {target_fault}. Name another folder with --to")
    if target.is_dir() and not (target / MARK).exists() and any(target.iterdir()):
        raise StartUpError(f"{target} holds other files, and no backup: name an empty folder, or one of a backup")


@contextlib.contextmanager
def _alone(target: Path) -> Iterator[None]:
    """Mark the folder, and keep other backups out of it."""
    target.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not (target / MARK).exists():
        _mark(target, {})
    descriptor = os.open(target, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StartUpError(f"another backup goes to {target}: wait until it has ended") from None
        yield
    finally:
        os.close(descriptor)


def _mark(target: Path, report: dict[str, Any]) -> None:
    new = target / f"{MARK}.new"
    new.write_text(json.dumps({"gablework": __version__, **report}, indent=1))
    new.replace(target / MARK)


def _report(source: Path) -> Report:
    """The content of a backup.

    Raises
    ------
    StartUpError
        It is not one, or it was interrupted before it was whole.
    """
    if not (source / MARK).is_file():
        raise StartUpError(f"{source} is not a backup: it has no {MARK}, which `gablework backup` writes")
    stored = json.loads((source / MARK).read_text())
    version = stored.pop("gablework")
    if not stored or not (source / DATABASE).is_file():
        raise StartUpError(f"the backup in {source} was interrupted before it was whole: use another one")
    ((revision,),) = _rows(source / DATABASE, "SELECT version_num FROM alembic_version")
    if revision not in migrations.known():
        raise StartUpError(
            f"the backup in {source} is of a newer version of gablework ({version}, revision {revision}): restore it "
            "with that one"
        )
    return Report(**stored | {"made": dt.datetime.fromisoformat(stored["made"]), "missing": tuple(stored["missing"])})


def _check_is_new(store: JobStore, folder: StateFolder, source: Path) -> None:
    """Refuse to restore over a service, or into something that cannot be a folder."""
    fault = folder_fault(folder.root)
    if fault is not None:
        raise StartUpError(f"the service cannot be restored into {folder.root}: {fault}. Name another one with --state")
    if store.path is not None and store.path.exists():
        raise StartUpError(f"there is a database {store.path}: restore into a new state folder, or move this one away")
    if store.path is None:
        store.migrate()
        if not store.is_empty:
            raise StartUpError("the database holds a service already: make an empty one for the restored service")
    foreign = sorted(name for name in _stored(folder.root) - _stored(source) if _PARTIAL not in name)
    if foreign:
        raise StartUpError(
            f"{folder.root} has {len(foreign)} folders that the backup does not have, such as {foreign[0]}: restore "
            "into an empty folder"
        )


def _check_has_all(source: Path, absent: Sequence[str]) -> None:
    """Refuse a backup that has lost folders.

    Raises
    ------
    StartUpError
        Some are absent.
    """
    if absent:
        shown = ", ".join(absent[:_SHOWN]) + (f" and {len(absent) - _SHOWN} more" if len(absent) > _SHOWN else "")
        raise StartUpError(
            f"the backup in {source} has lost {len(absent)} folders that its database names: {shown}. Use another "
            f'backup, copy them from one, or name them under "missing" in {source / MARK} to restore without them'
        )


@contextlib.contextmanager
def _in_our_words(what: str) -> Iterator[None]:
    """Faults of the disk as our own.

    Raises
    ------
    RunError
        A file cannot be read or written.
    """
    try:
        yield
    except shutil.Error as error:
        first = error.args[0][0]
        raise RunError(f"{what} cannot be completed: {first[2]} ({len(error.args[0])} files)") from error
    except OSError as error:
        raise RunError(f"{what} cannot be completed: {error}") from error
