"""Runs that are served: those that the operator publishes, and those of finished jobs, each with its index."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import logging
import re
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import RunError, causes
from service.errors import NoSuchCollectionError, NoSuchOutputError, ResultNotReadyError, StartUpError
from service.features.index import GONE, TABLES, RowIndex

if TYPE_CHECKING:
    from service.features.coordinates import RunCrs

_log = logging.getLogger("gablework.service")
_TRUST_S = 5.0
"""Seconds for which a run at a URL is not asked whether it changed."""
_OPEN_RUNS = 64
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_LIKE_A_JOB = re.compile(r"[0-9a-f]{32}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ServedRun:
    """A run whose tables are collections."""

    name: str
    """First part of the ids of its collections: the published name, or the job, or JOB.METHOD of a comparison."""
    place: str
    """The run directory, a path or a URL; no answer shows it."""
    index: Path
    """Its index, if it belongs to a job: such a run never changes; else the folder of indexes."""
    is_job: bool
    """Whether it belongs to a job."""


def split_id(collection_id: str) -> tuple[str, str]:
    """The name of the run and the table of a collection's id.

    Raises
    ------
    NoSuchCollectionError
        There is no such table.
    """
    name, _, table = collection_id.rpartition(".")
    if not name or table not in TABLES:
        raise NoSuchCollectionError(
            f"there is no collection {collection_id[:80]!r}: an id is RUN.TABLE with a table of {', '.join(TABLES)}; "
            "/collections lists all"
        )
    return name, table


def published_runs(entries: Sequence[str], state: Path) -> Mapping[str, ServedRun]:
    """The runs of the setting `publish` by their names, in the given order.

    Parameters
    ----------
    entries : sequence of str
        Run directories or their URLs, each as RUN or NAME=RUN; without a name the last part of the path is the name.
    state : Path
        The state folder, which holds their indexes.

    Raises
    ------
    StartUpError
        A name cannot be part of a URL, can be the id of a job, or is given twice.

    Examples
    --------
    >>> list(published_runs(["/srv/models_2024/", "old=s3://city/models"], Path("state")))
    ['models_2024', 'old']
    """
    found: dict[str, ServedRun] = {}
    for entry in entries:
        name, given, place = entry.partition("=")
        if not given or "/" in name:
            place, name = entry, entry.rstrip("/").rpartition("/")[2]
        fix = "give NAME=RUN with a name of letters, digits, - and _"
        if not _NAME.fullmatch(name) or _LIKE_A_JOB.fullmatch(name):
            raise StartUpError(f"the published run {entry!r} would have the name {name!r}: {fix}")
        if name in found:
            raise StartUpError(f"two published runs have the name {name!r}: {fix}")
        found[name] = ServedRun(name=name, place=place, index=state / "features", is_job=False)
    return found


@dataclasses.dataclass(frozen=True, kw_only=True)
class OpenRun:
    """A served run, ready to be read."""

    run: ServedRun
    """The run."""
    version: str
    """Differs for another state of the run."""
    index: RowIndex
    """Its rows."""

    @property
    def licence(self) -> str | None:
        """Licence of its source data."""
        return self.index.facts["licence"] or None

    @functools.cached_property
    def crs(self) -> RunCrs:
        """Its CRS, and those of answers."""
        from service.features.coordinates import RunCrs

        return RunCrs.of_run(self.index.facts["crs"])

    def collection_id(self, table: str) -> str:
        """The id of the collection of a table."""
        return f"{self.run.name}.{table}"


_open: dict[str, tuple[float, tuple[Any, ...], OpenRun]] = {}
_locks: dict[str, threading.Lock] = {}
_guard = threading.Lock()


def job_index(index: Path, run_dir: Path) -> RowIndex:
    """The index of a finished job; made if an older version of the program has left none.

    Raises
    ------
    NoSuchOutputError
        The job's files are gone.
    """
    if not index.is_file():
        with _locked(str(index)):
            if not index.is_file():
                _write(index, str(run_dir))
    return RowIndex(index)


def _locked(key: str) -> threading.Lock:
    with _guard:
        return _locks.setdefault(key, threading.Lock())


def _write(index: Path, run_dir: str) -> None:
    from pipeline.io import arrow_at
    from pipeline.runtime.manifest_reading import read_manifest

    try:
        filesystem, place = arrow_at(run_dir)
        _write_whole(index, place, filesystem, read_manifest(place, filesystem))
    except (RunError, OSError) as error:
        raise NoSuchOutputError(GONE) from error


def _write_whole(index: Path, place: str, filesystem: Any, manifest: Any) -> None:
    """Write the index of a run; the file appears whole."""
    from pipeline.io.storage import LocalStorage
    from service.features.writing import write_index

    with LocalStorage(root=index.parent).putting(index.name) as path:
        write_index(path, place, filesystem, manifest)


def open_run(run: ServedRun) -> OpenRun:
    """Open a run as collections. Its index is made if there is none for its present state.

    Raises
    ------
    NoSuchCollectionError
        Its CRS is unknown, or it cannot be read.
    ResultNotReadyError
        A published run is not finished, or is being replaced.
    """
    if run.is_job:
        index = job_index(run.index, Path(run.place))
        return _with_place(OpenRun(run=run, version=run.name, index=index))
    from pipeline.io import arrow_at, is_url
    from pipeline.runtime.manifest import NAME as MANIFEST_NAME

    key = f"{run.name} {run.place}"
    with _locked(key):
        held = _open.get(key)
        now_s = time.monotonic()
        if held is not None and is_url(run.place) and now_s - held[0] < _TRUST_S:
            return held[2]
        try:
            filesystem, place = arrow_at(run.place)
            info = filesystem.get_file_info(f"{place.rstrip('/')}/{MANIFEST_NAME}")
            state = (info.mtime_ns, info.size)
            opened = held[2] if held is not None and held[1] == state else _opened(run, filesystem, place, state)
        except (RunError, OSError) as error:
            # the log has the cause, since it can name a folder
            _log.warning("run %s at %s cannot be read: %s", run.name, run.place, error)
            problem = f"files of run {run.name} are gone or damaged; the log of the service says which"
            raise NoSuchCollectionError(problem) from error
        with _guard:
            _open[key] = (now_s, state, opened)
            for old in list(_open)[:-_OPEN_RUNS]:
                del _open[old]
        return opened


def _opened(run: ServedRun, filesystem: Any, place: str, state: tuple[Any, ...]) -> OpenRun:
    from pipeline.runtime.manifest import RunStatus
    from pipeline.runtime.manifest_reading import read_manifest

    manifest = read_manifest(place, filesystem)
    if manifest.status is not RunStatus.FINISHED:
        raise ResultNotReadyError(
            f"run {run.name} is {manifest.status.value}, not finished: complete it, or wait until it is replaced"
        )
    facts = (run.place, manifest.content_sha256, manifest.finished_at, *state)
    version = hashlib.sha256(repr(facts).encode()).hexdigest()[:24]
    path = run.index / f"{run.name}-{version}.sqlite"
    if not path.is_file():
        _write_whole(path, place, filesystem, manifest)
        for old in path.parent.glob(f"{run.name}-{'?' * len(version)}.sqlite"):
            if old != path:
                old.unlink(missing_ok=True)
    return _with_place(OpenRun(run=run, version=version, index=RowIndex(path)))


def _with_place(opened: OpenRun) -> OpenRun:
    """A run whose features have a place on the globe; raises NoSuchCollectionError for any other."""
    if not opened.crs.is_known:
        found = "unknown" if opened.crs.name is None else f"local ({opened.crs.name})"
        raise NoSuchCollectionError(
            f"the coordinate reference system of run {opened.run.name} is {found}, so its features have no place on "
            "the globe and cannot be a collection: model it again with --crs"
        )
    return opened


def check_published(runs: Mapping[str, ServedRun]) -> None:
    """Read each published run once, and make its index.

    Raises
    ------
    StartUpError
        One is not a finished run, or its coordinate reference system is unknown.
    """
    for run in runs.values():
        try:
            open_run(run)
        except (NoSuchCollectionError, ResultNotReadyError) as error:
            behind = next(itertools.islice(causes(error), 1, None), error)
            raise StartUpError(f"the run {run.place} cannot be published: {behind}") from error
