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
from service.disk import has_no_space
from service.errors import NoSpaceError, NoSuchCollectionError, NoSuchOutputError, ResultNotReadyError, StartUpError
from service.features.index import GONE, TABLES, RowIndex

if TYPE_CHECKING:
    import pyarrow.fs as pafs

    from pipeline.runtime.manifest import RunManifest
    from service.features.feature_crs import RunCrs

_log = logging.getLogger("gablework.service")
_TRUST_S = 5.0
"""Seconds for which a run at a URL is not asked whether it changed."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_LIKE_A_JOB = re.compile(r"[0-9a-f]{32}")


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


def published_runs(entries: Sequence[str], state: Path) -> Mapping[str, PublishedRun]:
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
    found: dict[str, PublishedRun] = {}
    for entry in entries:
        name, given, place = entry.partition("=")
        if not given or "/" in name:
            place, name = entry, entry.rstrip("/").rpartition("/")[2]
        fix = "give NAME=RUN with a name of letters, digits, - and _"
        if not _NAME.fullmatch(name) or _LIKE_A_JOB.fullmatch(name):
            raise StartUpError(f"the published run {entry!r} would have the name {name!r}: {fix}")
        if name in found:
            raise StartUpError(f"two published runs have the name {name!r}: {fix}")
        found[name] = PublishedRun(name, place, state / "features")
    return found


@dataclasses.dataclass(frozen=True, kw_only=True)
class OpenRun:
    """A run whose tables are collections, ready to be read.

    Raises
    ------
    NoSuchCollectionError
        Its CRS is unknown or local, so its features have no place on the globe.
    """

    name: str
    """First part of the ids of its collections: the published name, or the job, or JOB.METHOD of a comparison."""
    version: str
    """Differs for another state of the run."""
    index: RowIndex
    """Its rows."""
    is_job: bool = False
    """Whether it belongs to a job."""

    def __post_init__(self) -> None:
        if not self.crs.is_known:
            found = "unknown" if self.crs.name is None else f"local ({self.crs.name})"
            raise NoSuchCollectionError(
                f"the coordinate reference system of run {self.name} is {found}, so its features have no place on the "
                "globe and cannot be a collection: model it again with --crs"
            )

    @functools.cached_property
    def crs(self) -> RunCrs:
        """Its CRS, and those of answers."""
        from service.features.feature_crs import RunCrs

        return RunCrs.of_run(self.index.facts["crs"])

    def collection_id(self, table: str) -> str:
        """The id of the collection of a table."""
        return f"{self.name}.{table}"


class PublishedRun:
    """A run that the operator publishes.

    Parameters
    ----------
    name : str
        Its name.
    place : str
        The run directory, a path or a URL; no answer shows it.
    folder : Path
        The folder of indexes.
    """

    def __init__(self, name: str, place: str, folder: Path) -> None:
        self.name, self.place = name, place
        self._folder = folder
        self._lock = threading.Lock()
        self._held: tuple[float, tuple[Any, ...], OpenRun] | None = None

    def opened(self) -> OpenRun:
        """The run in its present state, whose index is made if there is none.

        Raises
        ------
        NoSuchCollectionError
            Its CRS is unknown, or it cannot be read.
        ResultNotReadyError
            It is not finished, or is being replaced.
        """
        from pipeline.io import arrow_at, is_url
        from pipeline.runtime.manifest import NAME as MANIFEST_NAME

        with self._lock:
            held, now_s = self._held, time.monotonic()
            if held is not None and is_url(self.place) and now_s - held[0] < _TRUST_S:
                return held[2]
            try:
                filesystem, place = arrow_at(self.place)
                info = filesystem.get_file_info(f"{place.rstrip('/')}/{MANIFEST_NAME}")
                state = (info.mtime_ns, info.size)
                is_same = held is not None and held[1] == state
                opened = held[2] if held is not None and is_same else self._read(filesystem, place, state)
            except (RunError, OSError) as error:
                # the log has the cause, since it can name a folder
                _log.warning("run %s at %s cannot be read: %s", self.name, self.place, error)
                problem = f"files of run {self.name} are gone or damaged; the log of the service says which"
                raise NoSuchCollectionError(problem) from error
            self._held = (now_s, state, opened)
            return opened

    def _read(self, filesystem: pafs.FileSystem, place: str, state: tuple[Any, ...]) -> OpenRun:
        from pipeline.runtime.manifest import RunStatus
        from pipeline.runtime.manifest_reading import read_manifest

        manifest = read_manifest(place, filesystem)
        if manifest.status is not RunStatus.FINISHED:
            raise ResultNotReadyError(
                f"run {self.name} is {manifest.status.value}, not finished: complete it, or wait until it is replaced"
            )
        facts = (self.place, manifest.content_sha256, manifest.finished_at, *state)
        version = hashlib.sha256(repr(facts).encode()).hexdigest()[:24]
        path = self._folder / f"{self.name}-{version}.sqlite"
        if not path.is_file():
            _write(path, place, filesystem, manifest)
            for old in path.parent.glob(f"{self.name}-{'?' * len(version)}.sqlite"):
                if old != path:
                    old.unlink(missing_ok=True)
        return OpenRun(name=self.name, version=version, index=RowIndex(path))


_UNREADABLE = "files of this job are gone or damaged; the log of the service says which"
_making: dict[Path, threading.Lock] = {}
"""A lock per index that is missing: one thread makes it."""


def job_index(index: Path, run_dir: Path) -> RowIndex:
    """The index of a finished job; made if an older version of the program has left none.

    Raises
    ------
    NoSuchOutputError
        The job's files are gone, or cannot be read; the log has the cause of the latter.
    NoSpaceError
        The disk is full.
    """
    if index.is_file():
        return RowIndex(index)
    from pipeline.io import arrow_at
    from pipeline.runtime.manifest_reading import read_manifest

    with _making.setdefault(index, threading.Lock()):
        try:
            if not index.is_file():
                filesystem, place = arrow_at(str(run_dir))
                _write(index, place, filesystem, read_manifest(place, filesystem))
        except (RunError, OSError) as error:
            if not run_dir.is_dir():
                raise NoSuchOutputError(GONE) from error
            if has_no_space(error):
                raise NoSpaceError("the disk is full: there is no room for the index of the buildings") from error
            _log.warning("the buildings of %s cannot be indexed: %s", run_dir, error)
            raise NoSuchOutputError(_UNREADABLE) from error
    return RowIndex(index)


def _write(index: Path, place: str, filesystem: pafs.FileSystem, manifest: RunManifest) -> None:
    """Write the index of a run; the file appears whole."""
    from pipeline.io.storage import LocalStorage
    from service.features.feature_writing import write_index

    with LocalStorage(root=index.parent).putting(index.name) as path:
        write_index(path, place, filesystem, manifest)


def check_published(runs: Mapping[str, PublishedRun]) -> None:
    """Read each published run once, and make its index.

    Raises
    ------
    StartUpError
        One is not a finished run, or its coordinate reference system is unknown.
    """
    for run in runs.values():
        try:
            run.opened()
        except (NoSuchCollectionError, ResultNotReadyError) as error:
            behind = next(itertools.islice(causes(error), 1, None), error)
            raise StartUpError(f"the run {run.place} cannot be published: {behind}") from error
