"""A finished run as what publishes it reads it, and the files and folders that are made of it.

The run directory is read and never changed. What is made appears whole, or stays what it was.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipeline.errors import RunError, SettingsError
from pipeline.export.folders import TERRAIN_FOLDER
from pipeline.export.geoparquet import table_batches, table_files
from pipeline.io import LocalStorage, SpatialReference, arrow_at, is_url, storage_at
from pipeline.runtime.manifest import RunManifest, RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.progress import Event, Listener

ROWS = 8192
"""Largest number of rows in memory at once."""
SEQUENCES = "cityjson"
"""Folder of a run with its CityJSONSeq files."""
_COUNTED = {"buildings": "candidates", "rejected": "rejected"}
"""Tables whose rows the manifest counts, with the names of the counts."""
_SEQUENCE = re.compile(rf"({SEQUENCES}|{TERRAIN_FOLDER})/tile=(?P<tile>[^/]+)/part-0\.city\.jsonl")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Published:
    """What was written."""

    place: str
    """The file or the folder."""
    size_bytes: int
    """Size of all that was written."""
    rows: Mapping[str, int]
    """Rows of each layer, in the order of the file; of CityJSON, the buildings."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """More that a user may want to know."""
        return ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class FinishedRun:
    """A finished run, as it was when publishing it began."""

    place: str
    """Its directory, a folder or a URL."""
    manifest: RunManifest
    """Its manifest."""
    stated: Sequence[str]
    """The files that are read, as the states of its tiles list them."""

    @classmethod
    def at(cls, run_dir: str, folders: Collection[str]) -> FinishedRun:
        """The run of which files in some folders are read; raises RunError if there is none, or it is not finished."""
        manifest = read_manifest(run_dir)
        if manifest.status is RunStatus.INCOMPLETE:
            failed = ", ".join(manifest.failed_tiles[:3]) + (", ..." if len(manifest.failed_tiles) > 3 else "")
            raise RunError(
                f"the run in {run_dir} is incomplete: {len(manifest.failed_tiles)} of {len(manifest.tiles)} tiles "
                f"failed ({failed}), so what is published would have holes. Run it again"
            )
        if manifest.status is not RunStatus.FINISHED:
            raise RunError(
                f"the run in {run_dir} is {manifest.status.value}, not finished: run it to its end, then publish"
            )
        names = (name for state in states_of(run_dir) for name in state["files"])
        return cls(
            place=run_dir, manifest=manifest, stated=[name for name in names if name.partition("/")[0] in folders]
        )

    @property
    def reference(self) -> SpatialReference:
        """Its CRS."""
        return SpatialReference.of_facts(self.manifest.crs)

    @property
    def facts(self) -> dict[str, str]:
        """What files say about the run."""
        manifest = self.manifest
        facts = {
            "engine_version": manifest.engine_version,
            "method": manifest.method,
            "settings_hash": manifest.settings_hash,
            "content_sha256": manifest.content_sha256,
            "source_licence": manifest.source_licence,
            "finished_at": None if manifest.finished_at is None else manifest.finished_at.isoformat(),
        }
        return {name: value for name, value in facts.items() if value}

    def batches(self, table: str, columns: Sequence[str], on_event: Listener) -> Iterator[tuple[str, pa.RecordBatch]]:
        """The rows of a table tile by tile, with the tile."""
        filesystem, place = arrow_at(self.place)
        tiles = [path.split("/")[-2].removeprefix("tile=") for path in table_files(place, table, filesystem)]
        for done, tile in enumerate(tiles, start=1):
            for batch in table_batches(place, table, columns, filesystem, [tile], ROWS):
                yield tile, batch
            on_event(Event(kind="progress", stage=table, done=done, total=len(tiles)))

    def check(self, rows: Mapping[str, int]) -> None:
        """Refuse a run that changed while it was read, or that lacks files or rows of tables; raises RunError."""
        check_complete(self.place, self.manifest, rows, self.stated)


def states_of(run_dir: str) -> Iterator[dict[str, Any]]:
    """The states of the tiles of a run."""
    storage = storage_at(run_dir)
    return (json.loads(storage.get(key)) for key in storage.keys("state"))


def sequences_of(run_dir: str, folder: str = SEQUENCES) -> dict[str, str]:
    """The CityJSONSeq files of a run by the keys of their tiles; those in `TERRAIN_FOLDER` are its terrain."""
    found = map(_SEQUENCE.fullmatch, storage_at(run_dir).keys(folder))
    return {one["tile"]: one[0] for one in found if one is not None}


def check_complete(run_dir: str, manifest: RunManifest, rows: Mapping[str, int], stated: Collection[str]) -> None:
    """Refuse a run that changed while it was read, or that lacks files or rows; raises RunError."""
    if read_manifest(run_dir) != manifest:
        raise RunError(f"the run in {run_dir} changed while it was published: publish it again when it is finished")
    storage = storage_at(run_dir)
    lost = [name for name in stated if not storage.has(name)]
    if lost:
        raise RunError(f"{lost[0]} of the run in {run_dir} is gone, and {len(lost) - 1} files more: run it again")
    for layer, count in _COUNTED.items():
        expected = manifest.counts.get(count) if layer in rows else None
        if expected is not None and rows[layer] != expected:
            raise RunError(
                f"{layer} of {run_dir} has {rows[layer]} rows, but run.json counts {expected}: files were lost or "
                "added since. Run it again"
            )


@contextlib.contextmanager
def disk_at(target: Path) -> Iterator[None]:
    """Say what cannot be read or written, as a RunError."""
    try:
        yield
    except OSError as fault:
        raise RunError(
            f"{fault.filename or target}: {fault.strerror or fault}. Free space, or give another --out"
        ) from fault


def file_outside(run_dir: str, out: str, suffix: str, overwrite: bool) -> Path:
    """The file to write.

    Raises SettingsError if it cannot be a file of that ending of this run, and RunError if it is there already.
    """
    target = path_outside(run_dir, out)
    if target.suffix.lower() != suffix:
        raise SettingsError([f"--out {out} ends in {target.suffix or 'nothing'}: give a name that ends in {suffix}"])
    _refuse_existing(target, overwrite)
    return target


def path_outside(run_dir: str, out: str) -> Path:
    """A place on a disk that is not in the run directory; raises SettingsError."""
    if is_url(out):
        raise SettingsError([f"--out {out} is not on a disk. Give a path of this machine, then copy what is written"])
    target = Path(out).resolve()
    if not is_url(run_dir) and target.is_relative_to(Path(run_dir).resolve()):
        raise SettingsError([f"--out {out} lies in the run directory, which a run replaces: give a path outside of it"])
    return target


def _refuse_existing(target: Path, overwrite: bool) -> None:
    """Refuse what is there already; raises RunError."""
    if target.is_dir():
        raise RunError(f"{target} is a folder: give the name of a file")
    if target.exists() and not overwrite:
        raise RunError(f"{target} exists already: give another --out, or --overwrite to replace it")


@contextlib.contextmanager
def new_file(target: Path, overwrite: bool) -> Iterator[Path]:
    """A file for the caller to write, in a folder of its own, that becomes the target when the block ends."""
    with (
        disk_at(target),
        LocalStorage(root=target.parent).putting(target.name) as temporary,
        # writers have files beside theirs, and GDAL fails at some names, such as those with a `!`
        tempfile.TemporaryDirectory(prefix=".gablework-", dir=target.parent) as folder,
    ):
        made = Path(folder, f"run{target.suffix.lower()}")
        yield made
        _refuse_existing(target, overwrite)
        made.replace(temporary)


@contextlib.contextmanager
def new_files(
    target: Path, overwrite: bool, names: Collection[str], held: Callable[[], Iterable[Path]]
) -> Iterator[LocalStorage]:
    """A folder for files of some names, which get their place at the end; the last name is placed last.

    A new folder appears whole; in one that exists, each file does, after all are made. Nothing else in it changes.
    `held` finds the files in the folder that may be of an earlier time.
    """

    def refuse() -> None:
        refuse_occupied(target, overwrite, held(), "this run", lambda name: name in names and (target / name).is_file())
        blocked = [(target / name).parent for name in names if (target / name).parent.is_file()]
        if blocked:
            raise RunError(f"{blocked[0]} is a file, where a folder must be: move it, or give another --out")

    with disk_at(target):
        refuse()
        beside = target if target.is_dir() else target.parent
        beside.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=beside) as folder:
            made = LocalStorage(root=Path(folder, "new"))
            made.make()
            yield made
            refuse()
            if target.is_dir():
                for name in names:
                    (target / name).parent.mkdir(exist_ok=True)
                    made.path(name).replace(target / name)
            else:
                made.root.replace(target)


def refuse_occupied(
    target: Path, overwrite: bool, present: Iterable[Path], whose: str, is_own: Callable[[str], bool]
) -> None:
    """Refuse a folder that holds something else than it may, or that unless it is to be replaced; raises RunError."""
    if target.exists() and not target.is_dir():
        raise RunError(f"{target} is a file: give the name of a folder")
    held = sorted(path.relative_to(target).as_posix() for path in present)
    others = [name for name in held if not is_own(name)]
    if others:
        raise RunError(f"{target} holds {others[0]}, which is not of {whose}: give another --out")
    if held and not overwrite:
        raise RunError(f"{target} holds {held[0]} already: give another --out, or --overwrite to replace it")
