"""Assembles the outputs of a finished run: one pass over its tiles, one tile in memory at a time."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.export.folders import POINTS_FOLDER
from pipeline.export.point_files import TILESET
from pipeline.io.storage import LocalStorage
from service.features.index import NAME as INDEX_NAME
from service.features.index import TABLES, RowIndex
from service.outputs.catalogue import Catalogue, ResultsCrs, stored_outputs
from service.outputs.files import write_moved_tileset, zip_files
from service.outputs.kinds import ON_REQUEST, OUTPUTS, chosen

if TYPE_CHECKING:
    from service.features.writing import IndexWriter
    from service.outputs.merged_cityjson import MergedCityJson
    from service.outputs.merged_table import MergedTable

Progress = Callable[[int, int], None]
"""Gets the number of finished tiles and of all tiles. An exception from it ends the work and leaves no partial file."""

_STRICT: Mapping[str, Any] = {"ensure_ascii": False, "allow_nan": False}
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
    def cityjson(self) -> str:
        """Its CityJSONSeq file."""
        return f"cityjson/tile={self.key}/part-0.city.jsonl"

    def table(self, name: str) -> str:
        """Its file of a table."""
        return f"{name}/tile={self.key}/part-0.parquet"

    @property
    def meshes(self) -> list[str]:
        """Its OBJ files, by name."""
        return sorted(name for name in self.files if name.startswith("meshes/"))


def write_outputs(
    run_dir: Path, out_dir: Path, wanted: Sequence[str] | None = None, on_progress: Progress = _nothing
) -> None:
    """Write the outputs of a finished run, and the index of its buildings.

    Every file gets its name when it is complete, and the catalogue comes last. Writing again gives the same bytes. One
    tile is in memory at a time.

    Parameters
    ----------
    run_dir : Path
        A run directory whose run ended.
    out_dir : Path
        Folder to write into; made if it is missing.
    wanted : sequence of str, optional
        Ids of `OUTPUTS`; all by default. Those of `ON_REQUEST` count if their files are there.
    on_progress : callable
        Gets the number of finished tiles and of all tiles.

    Raises
    ------
    NoSuchOutputError
        `wanted` holds an unknown id.
    RunError
        The run did not end, or its files are damaged.
    OSError
        The folder cannot be written.
    """
    from pipeline.errors import RunError
    from pipeline.runtime.manifest import NAME as MANIFEST
    from pipeline.runtime.manifest import RunStatus
    from pipeline.runtime.manifest_reading import read_manifest
    from service.features.coordinates import RunCrs
    from service.outputs.report import report

    names = {kind.output_id for kind in chosen(wanted)}
    status = read_manifest(run_dir).status
    if status not in {RunStatus.FINISHED, RunStatus.INCOMPLETE}:
        raise RunError(f"{run_dir} is {status.value}: outputs need a finished run")
    manifest = json.loads((run_dir / MANIFEST).read_text(encoding="utf-8"))
    tiles, failed_tiles = published_tiles(run_dir)
    with contextlib.ExitStack() as stack:
        sinks = _Sinks(stack, run_dir, out_dir, tiles, names, manifest)
        for done, tile in enumerate(tiles):
            on_progress(done, len(tiles))
            sinks.add(tile)
    on_progress(len(tiles), len(tiles))
    index = RowIndex(out_dir / INDEX_NAME)
    crs = ResultsCrs.of(RunCrs.of_run(manifest["crs"]))
    if "geojson" in names:
        _write_geojson(index, out_dir, crs)
    if "report" in names:
        found = json.dumps(report(manifest, index, crs, failed_tiles, run_dir), indent=2, **_STRICT)
        LocalStorage(root=out_dir).put(OUTPUTS["report"].filename, f"{found}\n".encode())
    has_models = index.figure("SELECT count(*) FROM buildings WHERE lod IS NOT NULL")
    if has_models and not any(tile.meshes for tile in tiles):
        # the run was requested without meshes
        names.discard("meshes")
        (out_dir / OUTPUTS["meshes"].filename).unlink(missing_ok=True)
    if "tileset" in names and (run_dir / POINTS_FOLDER / TILESET).is_file():
        # from jobs/ID/results/tileset to jobs/ID/points
        write_moved_tileset(run_dir / POINTS_FOLDER / TILESET, out_dir / OUTPUTS["tileset"].filename, "../points")
    else:
        names.discard("tileset")
        (out_dir / OUTPUTS["tileset"].filename).unlink(missing_ok=True)
    # these were written before, those that the request named
    names -= {name for name in names & ON_REQUEST if not (out_dir / OUTPUTS[name].filename).is_file()}
    n_buildings = index.totals("buildings").n
    Catalogue(outputs=stored_outputs(out_dir, chosen(names)), crs=crs, n_buildings=n_buildings).write(out_dir)


def _write_geojson(index: RowIndex, out_dir: Path, crs: ResultsCrs) -> None:
    """Write the footprints of all buildings, in the order of the tiles; in degrees if their CRS is known."""
    from service.features.pages import collected, feature_texts

    members: dict[str, Any] = {} if crs.is_known else {"coordRefSys": None, "note": _UNKNOWN}
    if crs.vertical_unit_m is not None:
        members["verticalUnitM"] = crs.vertical_unit_m
    features = feature_texts(
        index, "buildings", range(index.totals("buildings").n), None if crs.is_known else lambda shapes: shapes
    )
    with LocalStorage(root=out_dir).putting(OUTPUTS["geojson"].filename) as path, path.open("wb") as stream:
        stream.writelines(collected(members, features))


def published_tiles(run_dir: Path) -> tuple[list[RunTile], dict[str, str]]:
    """The tiles of a run that own something, in an order that keeps neighbours together, and errors of failed tiles.

    A tile writes its state last, so the files that the state lists exist.
    """
    tiles, failed = [], {}
    for path in (run_dir / "state").glob("*.json"):
        state = json.loads(path.read_text(encoding="utf-8"))
        if state["state"] != "done":
            failed[state["tile"]] = state["error"]
        elif state["files"]:
            tiles.append(RunTile(key=state["tile"], files=tuple(state["files"])))
    return sorted(tiles, key=lambda tile: (z_order(tile.key), tile.key)), failed


def z_order(tile_key: str) -> int:
    """Position of a tile on the Z-order curve: successive rows of a file are near each other.

    Examples
    --------
    >>> sorted(["x0_y1", "x1_y1", "x1_y0", "x0_y0", "x-1_y0"], key=z_order)
    ['x-1_y0', 'x0_y0', 'x1_y0', 'x0_y1', 'x1_y1']
    """
    column, _, row = tile_key.removeprefix("x").partition("_y")
    # lattices lie far within 2^31 tiles of their origin
    x, y = int(column) + 2**31, int(row) + 2**31
    return sum(((x >> bit & 1) << (2 * bit)) | ((y >> bit & 1) << (2 * bit + 1)) for bit in range(33))


class _Sinks:
    """The files that one pass over the tiles writes."""

    def __init__(
        self,
        stack: contextlib.ExitStack,
        run_dir: Path,
        out_dir: Path,
        tiles: Sequence[RunTile],
        names: set[str],
        manifest: Mapping[str, Any],
    ) -> None:
        from service.features.coordinates import RunCrs
        from service.features.writing import IndexWriter
        from service.outputs.merged_cityjson import MergedCityJson, read_header
        from service.outputs.merged_table import MergedTable

        storage = LocalStorage(root=out_dir)

        def file(name: str) -> Path:
            path: Path = stack.enter_context(storage.putting(name))
            return path

        self._run_dir = run_dir
        crs = RunCrs.of_run(manifest["crs"])
        projjson = None if crs.whole is None else crs.whole.to_json_dict()
        self._tables: dict[str, MergedTable] = {}
        for name in TABLES:
            if name in names:
                sources = [run_dir / tile.table(name) for tile in tiles]
                self._tables[name] = stack.enter_context(
                    MergedTable(file(OUTPUTS[name].filename), name, sources, projjson)
                )
        self._city: MergedCityJson | None = None
        if "cityjson" in names:
            stream = stack.enter_context(file(OUTPUTS["cityjson"].filename).open("wb"))
            self._headers = {tile.key: read_header(run_dir / tile.cityjson) for tile in tiles}
            self._city = MergedCityJson(stream, list(self._headers.values()))
        self._archive: zipfile.ZipFile | None = None
        if "meshes" in names:
            self._archive = stack.enter_context(zipfile.ZipFile(file(OUTPUTS["meshes"].filename), "w"))
        licence = manifest.get("source_licence") or ""
        self._index: IndexWriter = stack.enter_context(IndexWriter(file(INDEX_NAME), manifest["crs"], licence))

    def add(self, tile: RunTile) -> None:
        """Write one tile to all files."""
        from pipeline.export.folders import TERRAIN_FOLDER
        from pipeline.export.solid_geometry import SHAPE_COLUMNS
        from service.outputs.merged_table import read_tile

        for name in TABLES:
            table = read_tile(self._run_dir / tile.table(name))
            if name in self._tables:
                self._tables[name].add(tile.key, table)
            left_out = [column for column in SHAPE_COLUMNS if column in table.column_names]
            self._index.add(name, tile.key, table.drop_columns(left_out).to_pylist())
        if self._archive is not None:
            terrain = sorted((self._run_dir / TERRAIN_FOLDER / f"tile={tile.key}").glob("part-*"))
            names = [path.relative_to(self._run_dir).as_posix() for path in terrain]
            zip_files(self._archive, self._run_dir, [*tile.meshes, *names])
        if self._city is not None:
            with (self._run_dir / tile.cityjson).open("rb") as stream:
                next(stream)
                for line in stream:
                    self._city.add(self._headers[tile.key], line.rstrip(b"\n"))
