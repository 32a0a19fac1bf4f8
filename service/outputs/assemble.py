"""Assembles the outputs of a finished run, each by a function of its own, with one tile in memory at a time."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.export.folders import POINTS_FOLDER, TERRAIN_FOLDER
from pipeline.extras.octree.point_files import TILESET
from pipeline.io.storage import LocalStorage
from service.features.index import NAME as INDEX_NAME
from service.features.index import RowIndex
from service.outputs.catalogue import Catalogue, ResultsCrs, stored_outputs
from service.outputs.kinds import OUTPUTS, chosen
from service.outputs.output_files import zip_files

if TYPE_CHECKING:
    from service.features.feature_crs import RunCrs

Progress = Callable[[int, int], None]
"""Gets how much is done, and of how much. An exception from it ends the work and leaves no file."""

_UNKNOWN = (
    "The coordinate reference system of the tiles is unknown or local: these coordinates are theirs, not WGS 84. "
    "Give `crs` with the job to get degrees."
)


def _nothing(done: int, total: int) -> None:
    del done, total


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunTile:
    """One published tile of a run."""

    key: str
    """Its key, such as x85_y447."""
    files: tuple[str, ...]
    """Its files, relative to the run directory."""

    @property
    def meshes(self) -> list[str]:
        """Its OBJ files, by name."""
        return sorted(name for name in self.files if name.startswith("meshes/"))


def write_outputs(
    run_dir: Path, out_dir: Path, wanted: Sequence[str] | None = None, on_progress: Progress = _nothing
) -> None:
    """Write the outputs of a finished run, and its index.

    The files get their names when all are complete, and the catalogue comes last. Writing again gives the same bytes.

    Parameters
    ----------
    run_dir : Path
        A run directory whose run ended.
    out_dir : Path
        Folder to write into; made if it is missing.
    wanted : sequence of str, optional
        Ids of `OUTPUTS`; all by default. Those of `ON_REQUEST` count if their files are there.
    on_progress : callable
        Gets how much is done, and of how much.

    Raises
    ------
    NoSuchOutputError
        `wanted` holds an unknown id.
    RunError
        The run did not end, or its files are damaged.
    OSError
        The folder cannot be written.
    """
    from pyarrow.fs import LocalFileSystem

    from pipeline.errors import RunError
    from pipeline.runtime.manifest import NAME as MANIFEST
    from pipeline.runtime.manifest import RunStatus
    from pipeline.runtime.manifest_reading import read_manifest
    from service.features.feature_crs import RunCrs
    from service.features.feature_writing import write_index

    kinds = chosen(wanted)
    known = read_manifest(run_dir)
    if known.status not in {RunStatus.FINISHED, RunStatus.INCOMPLETE}:
        raise RunError(f"{run_dir} is {known.status.value}: outputs need a finished run")
    tiles, failed_tiles = published_tiles(run_dir)
    storage = LocalStorage(root=out_dir)
    with contextlib.ExitStack() as stack:
        path = stack.enter_context(storage.putting(INDEX_NAME))
        work = _Work(
            run_dir=run_dir,
            tiles=tiles,
            failed_tiles=failed_tiles,
            manifest=json.loads((run_dir / MANIFEST).read_text(encoding="utf-8")),
            crs=RunCrs.of_run(known.crs),
            index=RowIndex(path),
            total=len(tiles) * (1 + sum(kind.output_id in _BY_TILE for kind in kinds)),
            on_progress=on_progress,
        )
        write_index(path, str(run_dir), LocalFileSystem(), known, (tile.key for tile in work.each()))
        absent = work.absent()
        for kind in kinds:
            if kind.output_id in _WRITERS and kind.output_id not in absent:
                _WRITERS[kind.output_id](work, stack.enter_context(storage.putting(kind.filename)), kind.output_id)
        n_buildings = work.index.totals("buildings").n
    on_progress(work.total, work.total)
    for name in absent:
        (out_dir / OUTPUTS[name].filename).unlink(missing_ok=True)
    # those on request were written before
    there = [kind for kind in kinds if (out_dir / kind.filename).is_file()]
    Catalogue(outputs=stored_outputs(out_dir, there), crs=ResultsCrs.of(work.crs), n_buildings=n_buildings).write(
        out_dir
    )


def published_tiles(run_dir: Path) -> tuple[list[RunTile], dict[str, str]]:
    """The tiles of a run that own something, in an order that keeps neighbours together, and errors of failed tiles.

    A tile writes its state last, so the files that the state lists exist.
    """
    from service.features.feature_writing import in_z_order

    tiles, failed = {}, {}
    for path in (run_dir / "state").glob("*.json"):
        state = json.loads(path.read_text(encoding="utf-8"))
        if state["state"] != "done":
            failed[state["tile"]] = state["error"]
        elif state["files"]:
            tiles[state["tile"]] = RunTile(key=state["tile"], files=tuple(state["files"]))
    return [tiles[key] for key in in_z_order(tiles)], failed


@dataclasses.dataclass(kw_only=True)
class _Work:
    """A run whose outputs are written."""

    run_dir: Path
    tiles: Sequence[RunTile]
    failed_tiles: Mapping[str, str]
    manifest: Mapping[str, Any]
    crs: RunCrs
    index: RowIndex
    total: int
    on_progress: Progress
    done: int = 0

    def each(self) -> Iterator[RunTile]:
        """The tiles, whose number is reported."""
        for tile in self.tiles:
            self.on_progress(self.done, self.total)
            yield tile
            self.done += 1

    def file(self, folder: str, tile: RunTile, name: str) -> Path:
        """A file of a tile."""
        return self.run_dir / folder / f"tile={tile.key}" / name

    def absent(self) -> list[str]:
        """Outputs for which the request of the run left out the files."""
        has_models = self.index.figure("SELECT count(*) FROM buildings WHERE lod IS NOT NULL")
        has_points = (self.run_dir / POINTS_FOLDER / TILESET).is_file()
        lacks_meshes = has_models and not any(tile.meshes for tile in self.tiles)
        return [*(["meshes"] if lacks_meshes else []), *([] if has_points else ["tileset"])]


def _table(work: _Work, path: Path, name: str) -> None:
    from service.outputs.merged_table import merge_tables, united_metadata

    part = "part-0.parquet"
    projjson = None if work.crs.whole is None else work.crs.whole.to_json_dict()
    geo = united_metadata(name, (work.file(name, tile, part) for tile in work.tiles), projjson)
    merge_tables(path, name, ((tile.key, work.file(name, tile, part)) for tile in work.each()), geo)


def _cityjson(work: _Work, path: Path, name: str) -> None:
    from service.outputs.merged_cityjson import merge_cityjson

    part = "part-0.city.jsonl"
    sources = [work.file(name, tile, part) for tile in work.tiles]
    merge_cityjson(path, sources, (work.file(name, tile, part) for tile in work.each()))


def _meshes(work: _Work, path: Path, _: str) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for tile in work.each():
            terrain = sorted((work.run_dir / TERRAIN_FOLDER / f"tile={tile.key}").glob("part-*"))
            names = [found.relative_to(work.run_dir).as_posix() for found in terrain]
            zip_files(archive, work.run_dir, [*tile.meshes, *names])


def _tileset(work: _Work, path: Path, _: str) -> None:
    from pipeline.export.tileset import moved_tileset

    # from jobs/ID/results/tileset to jobs/ID/points
    path.write_bytes(moved_tileset((work.run_dir / POINTS_FOLDER / TILESET).read_bytes(), "../points"))


def _geojson(work: _Work, path: Path, _: str) -> None:
    """Write the footprints of all buildings, in degrees if their CRS is known."""
    from service.features.pages import collected, feature_texts

    members: dict[str, Any] = {} if work.crs.is_known else {"coordRefSys": None, "note": _UNKNOWN}
    if work.crs.vertical_unit_m is not None:
        members["verticalUnitM"] = work.crs.vertical_unit_m
    positions = range(work.index.totals("buildings").n)
    texts = feature_texts(work.index, "buildings", positions, None if work.crs.is_known else lambda shapes: shapes)
    with path.open("wb") as stream:
        stream.writelines(collected(members, texts))


def _report(work: _Work, path: Path, _: str) -> None:
    from service.outputs.report import report

    found = report(work.manifest, work.index, ResultsCrs.of(work.crs), work.failed_tiles, work.run_dir)
    text = json.dumps(found, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    path.write_text(text, encoding="utf-8")


_BY_TILE: Mapping[str, Callable[[_Work, Path, str], None]] = {
    "buildings": _table,
    "planes": _table,
    "rejected": _table,
    "meshes": _meshes,
    "cityjson": _cityjson,
}
_WRITERS = {**_BY_TILE, "tileset": _tileset, "geojson": _geojson, "report": _report}
"""The functions that write outputs, by their ids; those that are made on request are written by `published`."""
