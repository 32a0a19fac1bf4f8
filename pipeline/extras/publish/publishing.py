"""Publishing: a finished run as files that other programs open. The run directory is read and never changed."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.fs as pafs
import shapely

from pipeline.errors import RunError, SettingsError
from pipeline.export.cityjson import lines_of
from pipeline.export.columns import HORIZONTAL, VERTICAL
from pipeline.export.decisions import NAME as DECISIONS_NAME
from pipeline.export.folders import TERRAIN_FOLDER
from pipeline.export.geoparquet import table_batches, table_files
from pipeline.export.projection import Project, projection_to
from pipeline.extras.publish.cityjson_file import city_of
from pipeline.extras.publish_gis import pmtiles
from pipeline.extras.publish_gis.geopackage import LAYERS, SUFFIX, TILE, GeoPackage, stored_batch
from pipeline.extras.publish_gis.qml import STYLES
from pipeline.extras.publish_stac import stac
from pipeline.extras.terrain_tin.terrain_files import terrain_path
from pipeline.io import LocalStorage, SpatialReference, arrow_at, is_url, storage_at
from pipeline.io.crs_units import unit_name
from pipeline.runtime.manifest import RunManifest, RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.progress import Event, Listener, ignore

ROWS = 8192
"""Largest number of rows in memory at once."""
_COUNTED = {"buildings": "candidates", "rejected": "rejected"}
"""Tables whose rows the manifest counts, with the names of the counts."""
CITYJSON = ".city.json"
"""Ending of CityJSON files."""
_POINTS_COLLECTION = f"{stac.POINTS}/{stac.COLLECTION}"
"""The Collection of points in a catalogue."""
_SEQUENCES = "cityjson"
"""Folder of a run with its CityJSONSeq files."""


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
    target = file_outside(run_dir, out, "a GeoPackage is", SUFFIX)
    refuse_existing(target, overwrite)
    manifest = finished_run(run_dir)
    stated = stated_files(run_dir, {layer.name for layer in LAYERS})
    filesystem, place = arrow_at(run_dir)
    with (
        disk_at(target),
        LocalStorage(root=target.parent).putting(target.name) as temporary,
        # a folder, since SQLite has a journal beside the file
        tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder,
    ):
        made = GeoPackage(
            path=Path(folder, target.name),
            wkt=(manifest.crs or {}).get("wkt"),
            at=manifest.finished_at or manifest.started_at,
            facts=facts_of(manifest),
            units=_unit_names(SpatialReference.of_facts(manifest.crs)),
        )
        rows = {}
        for layer in LAYERS:
            if layer.name == DECISIONS_NAME and not _has_table(place, layer.name, filesystem):
                continue
            read = _batches(place, layer.name, layer.columns, filesystem, on_event)
            rows[layer.name] = made.write(layer, (stored_batch(batch, layer, tile) for tile, batch in read))
        made.write_styles(STYLES)
        check_complete(run_dir, manifest, rows, stated)
        refuse_existing(target, overwrite)
        made.path.replace(temporary)
    return Published(place=str(target), size_bytes=target.stat().st_size, rows=rows)


def publish_pmtiles(run_dir: str, out: str, *, overwrite: bool = False, on_event: Listener = ignore) -> Published:
    """Write the footprints of a finished run as vector tiles in one PMTiles file; it appears whole, or stays as it was.

    Raises SettingsError if `out` cannot be such a file, and RunError if it exists, if the run's CRS is unknown, if the
    run is not finished, changes meanwhile or lacks rows, or if something cannot be read or written.

    Parameters
    ----------
    run_dir : str
        The run directory, a folder or a URL.
    out : str
        The file to write, a path of this machine that ends in .pmtiles.
    overwrite : bool
        Replace an existing file.
    on_event : callable
        Gets progress: tiles.
    """
    target = file_outside(run_dir, out, "PMTiles are", pmtiles.SUFFIX)
    refuse_existing(target, overwrite)
    manifest = finished_run(run_dir)
    project = projection_to(manifest.crs, pmtiles.CRS)
    unit_m = SpatialReference.of_facts(manifest.crs).vertical_unit_m
    stated = stated_files(run_dir, {pmtiles.LAYER})
    filesystem, place = arrow_at(run_dir)
    read = 0

    def batches() -> Iterator[pa.RecordBatch]:
        nonlocal read
        for tile, batch in _batches(place, pmtiles.LAYER, pmtiles.READ, filesystem, on_event):
            read += batch.num_rows
            yield pmtiles.map_batch(batch, tile, project, unit_m)

    with (
        disk_at(target),
        LocalStorage(root=target.parent).putting(target.name) as temporary,
        tempfile.TemporaryDirectory(prefix=".gablework-", dir=target.parent) as folder,
    ):
        made = Path(folder, f"run{pmtiles.SUFFIX}")  # GDAL fails at some names, such as those with a `!`
        rows = {pmtiles.LAYER: pmtiles.write_pmtiles(made, batches(), facts_of(manifest))}
        check_complete(run_dir, manifest, {pmtiles.LAYER: read}, stated)
        refuse_existing(target, overwrite)
        made.replace(temporary)
    return Published(place=str(target), size_bytes=target.stat().st_size, rows=rows)


def publish_cityjson(run_dir: str, out: str, *, overwrite: bool = False, on_event: Listener = ignore) -> Published:
    """Write a finished run as one CityJSON file per tile, `<tile>.city.json`, in a folder, with its terrain if any.

    A new folder appears whole; in one that exists, each file does, after all are made. Nothing else in it changes.

    Raises SettingsError if `out` cannot be such a folder, and RunError if it holds CityJSON files of other tiles, or of
    these and they are not to be replaced, if the run is not finished, changes meanwhile or lacks buildings, or if
    something cannot be read or written.

    Parameters
    ----------
    run_dir : str
        The run directory, a folder or a URL.
    out : str
        The folder to write, a path of this machine.
    overwrite : bool
        Replace the files of the same tiles.
    on_event : callable
        Gets progress: tiles.
    """
    target = path_outside(run_dir, out, "CityJSON files are")
    manifest, stated = finished_run(run_dir), stated_files(run_dir, {_SEQUENCES})
    sequences, terrains = sequences_of(run_dir), terrains_of(run_dir)
    keys = {
        f"{tile}{CITYJSON}": [found[tile] for found in (sequences, terrains) if tile in found]
        for tile in sorted({*sequences, *terrains})
    }
    buildings = size = 0
    with disk_at(target), _folder(target, overwrite, keys, lambda: target.glob(f"*{CITYJSON}")) as made:
        for done, (name, of_tile) in enumerate(keys.items(), start=1):
            city = _city(run_dir, of_tile)
            buildings += sum(thing["type"] == "Building" for thing in city["CityObjects"].values())
            content = json.dumps(city, separators=(",", ":"), ensure_ascii=False).encode()
            made.put(name, content)
            size += len(content)
            on_event(Event(kind="progress", stage=_SEQUENCES, done=done, total=len(keys)))
        check_complete(run_dir, manifest, {"buildings": buildings}, stated)
    return Published(place=str(target), size_bytes=size, rows={"buildings": buildings})


def publish_stac(
    run_dir: str,
    out: str,
    *,
    overwrite: bool = False,
    name: str | None = None,
    documents: Collection[str] = tuple(stac.DOCUMENTS),
    on_event: Listener = ignore,
) -> Published:
    """Write a STAC catalogue of a finished run: a Collection, and an Item per tile that has files.

    Below it is a Collection of its points with an Item per input file, unless an older version made the run.

    A new folder appears whole; in one that exists, each file does, after all are made, and the Collection last.

    Raises SettingsError if `out` cannot be such a folder, and RunError if it holds another catalogue, or this one and
    it is not to be replaced, if the CRS is unknown, if the run is not finished, changes meanwhile or lacks files or
    rows, or if something cannot be read or written.

    Parameters
    ----------
    run_dir : str
        The run directory, a folder or a URL.
    out : str
        The folder to write, a path of this machine. Its files refer to those of the run.
    overwrite : bool
        Replace the catalogue of the same tiles.
    name : str, optional
        Id of the Collection; the name of the run directory by default.
    documents : collection of str
        Files about the whole run to list, of `stac.DOCUMENTS`, if they exist.
    on_event : callable
        Gets progress: tiles.
    """
    target = path_outside(run_dir, out, "a catalogue is")
    manifest, storage = finished_run(run_dir), storage_at(run_dir)
    project = projection_to(manifest.crs, stac.CRS)
    run = _run_of(run_dir, manifest, name)
    files = {state["tile"]: stac.listed(state["files"], state["tile"]) for state in _states(run_dir) if state["files"]}
    for tile, key in terrains_of(run_dir).items():
        files.setdefault(tile, {})[key] = hashlib.sha256(storage.get(key)).hexdigest()
    points = _point_facts(manifest)
    names = [
        *(stac.points_name(key) for key in points),
        *([_POINTS_COLLECTION] if points else []),
        *(stac.item_name(tile) for tile in files),
        stac.COLLECTION,
    ]
    href = run_dir.rstrip("/") + "/" if is_url(run_dir) else _relative(Path(run_dir).resolve(), target)
    with disk_at(target):
        _refuse_other_catalogue(target / stac.COLLECTION, href)
    with disk_at(target), _folder(target, overwrite, names, lambda: _catalogue_files(target)) as made:
        facts = []
        for done, (tile, held) in enumerate(files.items(), start=1):
            facts.append(_tile_facts(run_dir, tile, held, manifest))
            on_event(Event(kind="progress", stage="items", done=done, total=len(files)))
        if not facts:
            raise RunError(f"the run in {run_dir} has no tile with files, so there is nothing to list")
        items, rows = [], sum(tile.rows["buildings"] for tile in facts)
        size = _put_points(made, points.values(), run, project)
        for tile_facts in _derived(stac.dated(facts), points):
            item = stac.item(tile_facts, run, project, href if is_url(href) else f"../{href}")
            items.append({name: item[name] for name in ("id", "bbox", "properties")})
            size += _put_json(made, stac.item_name(tile_facts.key), item)
        listed = [document for document in documents if storage.has(document)]
        size += _put_json(made, stac.COLLECTION, stac.collection(run, items, listed, href, has_points=bool(points)))
        check_complete(run_dir, manifest, {"buildings": rows}, [name for held in files.values() for name in held])
    return Published(place=str(target), size_bytes=size, rows={"items": len(items), "points": len(points)})


def _run_of(run_dir: str, manifest: RunManifest, name: str | None) -> stac.Run:
    """What a catalogue says about a run."""
    return stac.Run(
        name=name or PurePosixPath(run_dir.rstrip("/") if is_url(run_dir) else Path(run_dir).resolve().as_posix()).name,
        version=manifest.engine_version,
        method=manifest.method,
        finished_at=manifest.finished_at or manifest.started_at,
        licence=manifest.source_licence,
        crs=manifest.crs or {},
    )


def _point_facts(manifest: RunManifest) -> dict[str, stac.PointFacts]:
    """The input files that gave points, by the ids of their Items; none in a run of an older version."""
    unit_m, found = (manifest.crs or {}).get("horizontal_unit_m", 1.0), {}
    for entry in manifest.inputs:
        file = entry.file
        if file is None or entry.bounds_m is None:
            continue
        (x0, y0, x1, y1), (left, bottom, right, top) = file.bounds_m, entry.bounds_m
        area_m2 = (x1 - x0) * (y1 - y0)
        facts = stac.PointFacts(
            name=PurePosixPath(entry.path).name,
            address=entry.path if is_url(entry.path) else None,
            size_bytes=entry.size_bytes,
            sha256=entry.sha256,
            is_digest_of_file=not (is_url(entry.path) and file.format == "copc"),  # a window of it has another digest
            format=file.format,
            count=file.n_points,
            bounds=(x0 / unit_m, y0 / unit_m, x1 / unit_m, y1 / unit_m),
            taken=(left / unit_m, bottom / unit_m, right / unit_m, top / unit_m),
            density_per_m2=file.n_points / area_m2 if area_m2 > 0.0 else None,
            acquired=file.acquired,
            dimensions=file.dimensions,
        )
        found[facts.key] = facts
    return found


def _derived(tiles: Iterable[stac.TileFacts], points: Mapping[str, stac.PointFacts]) -> Iterator[stac.TileFacts]:
    """The tiles with the inputs whose points, those that the run took, reach into their bounds."""
    keys = list(points)
    tree = shapely.STRtree([shapely.box(*facts.taken) for facts in points.values()])
    for tile in tiles:
        met = sorted(tree.query(shapely.box(*tile.bounds)).tolist())
        yield dataclasses.replace(tile, points=[keys[k] for k in met])


def _put_points(storage: LocalStorage, points: Collection[stac.PointFacts], run: stac.Run, project: Project) -> int:
    """Write the Items of the points, then their Collection; returns their size in bytes."""
    items, size = [], 0
    for facts in points:
        item = stac.points_item(facts, run, project)
        items.append({name: item[name] for name in ("id", "bbox", "properties")})
        size += _put_json(storage, stac.points_name(facts.key), item)
    return size + (_put_json(storage, _POINTS_COLLECTION, stac.points_collection(run, items)) if items else 0)


def _tile_facts(run_dir: str, tile: str, files: Mapping[str, str], manifest: RunManifest) -> stac.TileFacts:
    """Where and when the objects of a tile are; if it has none, its square on the lattice."""
    filesystem, place = arrow_at(run_dir)
    boxes, times, rows = [], [], {}
    for table, columns in (("buildings", ["acquired_from", "acquired_to", "bbox"]), ("rejected", ["bbox"])):
        rows[table] = 0
        if not any(name.startswith(f"{table}/") for name in files):  # nothing but terrain
            continue
        for batch in table_batches(place, table, columns, filesystem, [tile], ROWS):
            rows[table] += batch.num_rows
            boxes += [tuple(box.values()) for box in batch.column("bbox").to_pylist() if box]
            for name in columns[:-1]:
                times += [at for at in batch.column(name).to_pylist() if at]
    unit_m = (manifest.crs or {}).get("horizontal_unit_m", 1.0)
    boxes = boxes or [tuple(v / unit_m for v in square.bounds) for square in manifest.squares([tile])]
    if not boxes:
        raise RunError(f"the place of tile {tile} of the run in {run_dir} is unknown: run it again")
    low, high = np.min(boxes, axis=0), np.max(boxes, axis=0)
    return stac.TileFacts(
        key=tile,
        files=files,
        bounds=(float(low[0]), float(low[1]), float(high[2]), float(high[3])),
        acquired=(min(times), max(times)) if times else None,
        rows=rows,
    )


def _catalogue_files(target: Path) -> list[Path]:
    """Files in a folder that a catalogue may have written."""
    items = [path for path in target.glob("*/*.json") if path.stem == path.parent.name]
    return [*items, *target.glob(f"{stac.POINTS}/*.json"), *target.glob(stac.COLLECTION)]


def _refuse_other_catalogue(collection: Path, href: str) -> None:
    """Refuse a folder with a Collection that is not of the run at `href`; raises RunError."""
    if not collection.is_file():
        return
    try:
        held = json.loads(collection.read_text(encoding="utf-8"))["assets"]["run"]["href"]
    except (ValueError, KeyError, TypeError):
        held = "something else"
    if held != f"{href}run.json":
        raise RunError(f"{collection} is of another run or catalogue ({str(held)[:160]}): give another --out")


def _relative(run: Path, target: Path) -> str:
    """The run directory as seen from a folder, percent-encoded and ending in a slash."""
    return quote(Path(os.path.relpath(run, target)).as_posix()) + "/"


def _put_json(storage: LocalStorage, name: str, document: Mapping[str, Any]) -> int:
    """Write a document; returns its size in bytes."""
    content = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False).encode() + b"\n"
    storage.put(name, content)
    return len(content)


@contextlib.contextmanager
def _folder(
    target: Path, overwrite: bool, names: Collection[str], held: Callable[[], Iterable[Path]]
) -> Iterator[LocalStorage]:
    """A folder for files of some names, which get their place at the end; the last name is placed last.

    `held` finds the files in the folder that may be of an earlier time.
    """
    _refuse_occupied(target, overwrite, names, held())
    beside = target if target.is_dir() else target.parent
    beside.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=beside) as folder:
        made = LocalStorage(root=Path(folder, "new"))
        made.make()
        yield made
        _refuse_occupied(target, overwrite, names, held())
        if target.is_dir():
            for name in names:
                (target / name).parent.mkdir(exist_ok=True)
                made.path(name).replace(target / name)
        else:
            made.root.replace(target)


def sequences_of(run_dir: str) -> dict[str, str]:
    """The CityJSONSeq files of a run by the keys of their tiles."""
    return {
        key.split("/")[1].removeprefix(f"{TILE}="): key
        for key in storage_at(run_dir).keys(_SEQUENCES)
        if PurePosixPath(key).match(f"{_SEQUENCES}/{TILE}=*/part-0.city.jsonl")
    }


def terrains_of(run_dir: str) -> dict[str, str]:
    """The files with the terrain of a run, by the keys of their tiles."""
    return {
        key.split("/")[1].removeprefix(f"{TILE}="): key
        for key in storage_at(run_dir).keys(TERRAIN_FOLDER)
        if key == terrain_path(key.split("/")[1].removeprefix(f"{TILE}="), "city.jsonl")
    }


def _city(run_dir: str, keys: Sequence[str]) -> dict[str, Any]:
    """The CityJSON object of the sequences of one tile; raises RunError if a file is damaged."""
    sequences = [lines_of(storage_at(run_dir).get(key).decode()) for key in keys]
    try:
        return city_of(*sequences)
    except (ValueError, KeyError, TypeError) as fault:
        raise RunError(f"{keys[0]} of the run in {run_dir} is damaged ({str(fault)[:160]}): run it again") from fault


@contextlib.contextmanager
def disk_at(target: Path) -> Iterator[None]:
    """Say what cannot be read or written, as a RunError."""
    try:
        yield
    except OSError as fault:
        raise RunError(
            f"{fault.filename or target}: {fault.strerror or fault}. Free space, or give another --out"
        ) from fault


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


def file_outside(run_dir: str, out: str, what: str, suffix: str) -> Path:
    """The file to write; raises SettingsError if it cannot be a file of that format of this run."""
    target = path_outside(run_dir, out, what)
    if target.suffix.lower() != suffix:
        raise SettingsError([f"--out {out} ends in {target.suffix or 'nothing'}: give a name that ends in {suffix}"])
    return target


def path_outside(run_dir: str, out: str, what: str) -> Path:
    """A place on a disk that is not in the run directory; raises SettingsError."""
    if is_url(out):
        raise SettingsError([f"--out {out}: {what} written to a disk. Give a path of this machine, then copy it"])
    target = Path(out).resolve()
    if not is_url(run_dir) and target.is_relative_to(Path(run_dir).resolve()):
        raise SettingsError([f"--out {out} lies in the run directory, which a run replaces: give a path outside of it"])
    return target


def refuse_existing(target: Path, overwrite: bool) -> None:
    """Refuse what is there already; raises RunError."""
    if target.is_dir():
        raise RunError(f"{target} is a folder: give the name of a file")
    if target.exists() and not overwrite:
        raise RunError(f"{target} exists already: give another --out, or --overwrite to replace it")


def _refuse_occupied(target: Path, overwrite: bool, names: Collection[str], present: Iterable[Path]) -> None:
    """Refuse a folder with such files of other tiles, or with these unless they are to be replaced; RunError."""
    if target.exists() and not target.is_dir():
        raise RunError(f"{target} is a file: give the name of a folder")
    blocked = [(target / name).parent for name in names if (target / name).parent.is_file()]
    if blocked:
        raise RunError(f"{blocked[0]} is a file, where a folder must be: move it, or give another --out")
    held = sorted(path.relative_to(target).as_posix() for path in present)
    others = [name for name in held if name not in names or not (target / name).is_file()]
    if others:
        raise RunError(f"{target} holds {others[0]}, which is not of this run: give another --out")
    if held and not overwrite:
        raise RunError(f"{target} holds {held[0]} already: give another --out, or --overwrite to replace it")


def _has_table(run_dir: str, name: str, filesystem: pafs.FileSystem) -> bool:
    """Whether a run has a table: those of older versions lack some."""
    return bool(filesystem.get_file_info(f"{run_dir.rstrip('/')}/{name}").type is pafs.FileType.Directory)


def _batches(
    run_dir: str, table: str, columns: Sequence[str], filesystem: pafs.FileSystem, on_event: Listener
) -> Iterator[tuple[str, pa.RecordBatch]]:
    """The rows of a table tile by tile, with the tile."""
    tiles = [path.split("/")[-2].removeprefix(f"{TILE}=") for path in table_files(run_dir, table, filesystem)]
    for done, tile in enumerate(tiles, start=1):
        for batch in table_batches(run_dir, table, columns, filesystem, [tile], ROWS):
            yield tile, batch
        on_event(Event(kind="progress", stage=table, done=done, total=len(tiles)))


def _states(run_dir: str) -> Iterator[dict[str, Any]]:
    """The states of the tiles of a run."""
    storage = storage_at(run_dir)
    return (json.loads(storage.get(key)) for key in storage.keys("state"))


def stated_files(run_dir: str, folders: Collection[str]) -> list[str]:
    """The files in some folders of a run that the states of its tiles list."""
    return [name for state in _states(run_dir) for name in state["files"] if name.split("/")[0] in folders]


def facts_of(manifest: RunManifest) -> dict[str, str]:
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


def _unit_names(reference: SpatialReference) -> dict[str, str]:
    """The names of the units of a run's coordinates."""
    return {HORIZONTAL: unit_name(reference.horizontal_unit_m), VERTICAL: unit_name(reference.vertical_unit_m)}


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
