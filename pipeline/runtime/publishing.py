"""Publishing: a finished run as files that other programs open. The run directory is read and never changed."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.fs as pafs

from pipeline.errors import RunError, SettingsError
from pipeline.export.cityjson_file import city_of
from pipeline.export.decisions import NAME as DECISIONS_NAME
from pipeline.export.geopackage import LAYERS, SUFFIX, TILE, GeoPackage, Layer, stored_batch
from pipeline.export.geoparquet import table_batches, table_files
from pipeline.export.qml import STYLES
from pipeline.io import LocalStorage, arrow_at, is_url, storage_at
from pipeline.runtime.manifest import RunManifest, RunStatus, read_manifest
from pipeline.runtime.monitoring.events import Event, Listener, ignore

ROWS = 8192
"""Largest number of rows in memory at once."""
_COUNTED = {"buildings": "candidates", "rejected": "rejected"}
"""Tables whose rows the manifest counts, with the names of the counts."""
CITYJSON = ".city.json"
"""Ending of CityJSON files."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Published:
    """What was written."""

    place: str
    """The file or the folder."""
    size_bytes: int
    """Size of all that was written."""
    rows: Mapping[str, int]
    """Rows of each layer, in the order of the file; of CityJSON, the buildings."""


def publish_geopackage(run_dir: str, out: str, *, overwrite: bool = False, on_event: Listener = ignore) -> Published:
    """Write a finished run as a GeoPackage, tile by tile; the file appears whole, or stays what it was.

    Raises SettingsError if `out` cannot be such a file, and RunError if it exists, if the run is not finished, changes
    meanwhile or lacks rows, or if something cannot be read or written.

    Parameters
    ----------
    run_dir : str
        The run directory, a folder or a URL.
    out : str
        The file to write, a path of this machine that ends in .gpkg.
    overwrite : bool
        Replace an existing file.
    on_event : callable
        Gets progress: tiles of each layer.
    """
    target = _target(run_dir, out)
    _refuse_existing(target, overwrite)
    manifest = finished_run(run_dir)
    filesystem, place = arrow_at(run_dir)
    with (
        LocalStorage(root=target.parent).putting(target.name) as temporary,
        # a folder, since SQLite has a journal beside the file
        tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder,
    ):
        made = GeoPackage(
            path=Path(folder, target.name),
            wkt=(manifest.crs or {}).get("wkt"),
            at=manifest.finished_at or manifest.started_at,
            facts=_facts(manifest),
        )
        rows = {}
        for layer in LAYERS:
            batches = _batches(place, layer, filesystem, on_event)
            if batches is not None:
                rows[layer.name] = made.write(layer, batches)
        made.write_styles(STYLES)
        _check_complete(run_dir, manifest, rows)
        _refuse_existing(target, overwrite)
        made.path.replace(temporary)
    return Published(place=str(target), size_bytes=target.stat().st_size, rows=rows)


def publish_cityjson(run_dir: str, out: str, *, overwrite: bool = False, on_event: Listener = ignore) -> Published:
    """Write a finished run as one CityJSON file per tile, `<tile>.city.json`; the folder appears whole.

    Raises SettingsError if `out` cannot be such a folder, and RunError if it holds something, if the run is not
    finished, changes meanwhile or lacks buildings, or if something cannot be read or written.

    Parameters
    ----------
    run_dir : str
        The run directory, a folder or a URL.
    out : str
        The folder to write, a path of this machine.
    overwrite : bool
        Replace a folder of CityJSON files.
    on_event : callable
        Gets progress: tiles.
    """
    target = _path_outside(run_dir, out, "CityJSON files are")
    _refuse_occupied(target, overwrite)
    manifest, storage = finished_run(run_dir), storage_at(run_dir)
    keys = storage.keys("cityjson")
    buildings = size = 0
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
        made = LocalStorage(root=Path(folder, "new"))
        made.make()
        for done, key in enumerate(keys, start=1):
            city = city_of(storage.get(key).decode().splitlines())
            buildings += sum(thing["type"] == "Building" for thing in city["CityObjects"].values())
            content = json.dumps(city, separators=(",", ":"), ensure_ascii=False).encode()
            made.put(key.split("/")[-2].removeprefix(f"{TILE}=") + CITYJSON, content)
            size += len(content)
            on_event(Event(kind="progress", stage="cityjson", done=done, total=len(keys)))
        _check_complete(run_dir, manifest, {"buildings": buildings})
        _refuse_occupied(target, overwrite)
        if target.exists():
            target.replace(Path(folder, "old"))
        made.root.replace(target)
    return Published(place=str(target), size_bytes=size, rows={"buildings": buildings})


def finished_run(run_dir: str) -> RunManifest:
    """The manifest of a finished run; raises RunError if there is none, or the run is not finished."""
    manifest = read_manifest(run_dir)
    if manifest.status is RunStatus.INCOMPLETE:
        failed = ", ".join(manifest.failed_tiles[:3]) + (", ..." if len(manifest.failed_tiles) > 3 else "")
        raise RunError(
            f"the run in {run_dir} is incomplete: {len(manifest.failed_tiles)} of {len(manifest.tiles)} tiles failed "
            f"({failed}), so what is published would have holes. Run it again"
        )
    if manifest.status is not RunStatus.FINISHED:
        raise RunError(
            f"the run in {run_dir} is {manifest.status.value}, not finished: run it to its end, then publish"
        )
    return manifest


def _target(run_dir: str, out: str) -> Path:
    """The file to write; raises SettingsError if it cannot be a GeoPackage of this run."""
    target = _path_outside(run_dir, out, "a GeoPackage is")
    if target.suffix.lower() != SUFFIX:
        raise SettingsError([f"--out {out} ends in {target.suffix or 'nothing'}: give a name that ends in {SUFFIX}"])
    return target


def _path_outside(run_dir: str, out: str, what: str) -> Path:
    """A place on a disk that is not in the run directory; raises SettingsError."""
    if is_url(out):
        raise SettingsError([f"--out {out}: {what} written to a disk. Give a path of this machine, then copy it"])
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


def _refuse_occupied(target: Path, overwrite: bool) -> None:
    """Refuse a folder with other things than CityJSON files, and these unless they are to be replaced; raises RunError.

    What a user keeps beside them is never removed.
    """
    if target.exists() and not target.is_dir():
        raise RunError(f"{target} is a file: give the name of a folder")
    held = sorted(path.name for path in target.iterdir()) if target.exists() else []
    others = [name for name in held if not name.endswith(CITYJSON)]
    if others:
        raise RunError(f"{target} holds {others[0]}, which is no CityJSON file of a run: give another --out")
    if held and not overwrite:
        raise RunError(f"{target} holds CityJSON files already: give another --out, or --overwrite to replace them")


def _batches(
    run_dir: str, layer: Layer, filesystem: pafs.FileSystem, on_event: Listener
) -> Iterator[pa.RecordBatch] | None:
    """The rows of a layer tile by tile; None where runs of older versions lack the table."""
    if layer.name == DECISIONS_NAME:
        folder = filesystem.get_file_info(f"{run_dir.rstrip('/')}/{layer.name}")
        if folder.type is not pafs.FileType.Directory:
            return None
    tiles = [path.split("/")[-2].removeprefix(f"{TILE}=") for path in table_files(run_dir, layer.name, filesystem)]

    def batches() -> Iterator[pa.RecordBatch]:
        for done, tile in enumerate(tiles, start=1):
            for batch in table_batches(run_dir, layer.name, layer.columns, filesystem, [tile], ROWS):
                yield stored_batch(batch, layer, tile)
            on_event(Event(kind="progress", stage=layer.name, done=done, total=len(tiles)))

    return batches()


def _facts(manifest: RunManifest) -> dict[str, str]:
    """What the file says about the run."""
    facts = {
        "engine_version": manifest.engine_version,
        "method": manifest.method,
        "settings_hash": manifest.settings_hash,
        "content_sha256": manifest.content_sha256,
        "source_licence": manifest.source_licence,
        "finished_at": None if manifest.finished_at is None else manifest.finished_at.isoformat(),
    }
    return {name: value for name, value in facts.items() if value}


def _check_complete(run_dir: str, manifest: RunManifest, rows: Mapping[str, int]) -> None:
    """Refuse a run that changed while it was read, or that lacks rows; raises RunError."""
    if read_manifest(run_dir) != manifest:
        raise RunError(f"the run in {run_dir} changed while it was published: publish it again when it is finished")
    for layer, count in _COUNTED.items():
        expected = manifest.counts.get(count) if layer in rows else None
        if expected is not None and rows[layer] != expected:
            raise RunError(
                f"{layer} of {run_dir} has {rows[layer]} rows, but run.json counts {expected}: files were lost or "
                "added since. Run it again"
            )
