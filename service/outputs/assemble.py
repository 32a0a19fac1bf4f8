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
from pipeline.extras.octree.point_files import TILESET
from service.outputs.catalogue import NAME as CATALOGUE_NAME
from service.outputs.catalogue import Catalogue, StoredOutput
from service.outputs.kinds import ON_REQUEST, OUTPUTS, chosen

if TYPE_CHECKING:
    from service.outputs.building_index import BuildingIndexFile
    from service.outputs.footprints import FeatureCollectionFile, Wgs84Transformation
    from service.outputs.merged_cityjson import MergedCityJson
    from service.outputs.merged_table import MergedTable
    from service.outputs.report import Tally

Progress = Callable[[int, int], None]
"""Gets the number of finished tiles and of all tiles. An exception from it ends the work and leaves no partial file."""

_TABLES = ("buildings", "planes", "rejected")


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
    def decisions(self) -> str | None:
        """Its file of decisions; None in a run that recorded none."""
        name = self.table("decisions")
        return name if name in self.files else None

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
        Ids of `OUTPUTS`; all by default. The file of features and the index are always written: the service needs
        them for single buildings. Those of `ON_REQUEST` count if their files are there.
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
    from pipeline.io.storage import LocalStorage, sha256_of
    from service.outputs.footprints import Wgs84Transformation
    from service.outputs.report import report, report_bytes

    names = {kind.output_id for kind in chosen(wanted)}
    manifest = _manifest(run_dir)
    tiles, failed_tiles = published_tiles(run_dir)
    to_wgs84 = Wgs84Transformation.of_run(manifest["crs"])
    storage = LocalStorage(root=out_dir)
    with contextlib.ExitStack() as stack:
        sinks = _Sinks(stack, storage, run_dir, tiles, names, to_wgs84)
        for done, tile in enumerate(tiles):
            on_progress(done, len(tiles))
            sinks.add(tile)
        tally = sinks.tally
    on_progress(len(tiles), len(tiles))
    if "report" in names:
        found = report(manifest, tally, to_wgs84.crs, failed_tiles, run_dir)
        storage.put(OUTPUTS["report"].filename, report_bytes(found))
    if tally.modelled and not any(tile.meshes for tile in tiles):
        # the run was requested without meshes
        names.discard("meshes")
        (out_dir / OUTPUTS["meshes"].filename).unlink(missing_ok=True)
    if not ("tileset" in names and _write_tileset(run_dir, out_dir / OUTPUTS["tileset"].filename)):
        # the request left out the points
        names.discard("tileset")
        (out_dir / OUTPUTS["tileset"].filename).unlink(missing_ok=True)
    # these were written before, those that the request named
    names -= {name for name in names & ON_REQUEST if not (out_dir / OUTPUTS[name].filename).is_file()}
    stored = {}
    for kind in chosen(names):
        path = out_dir / kind.filename
        stored[kind.output_id] = StoredOutput(size_bytes=path.stat().st_size, sha256=sha256_of(path))
    catalogue = Catalogue(outputs=stored, crs=to_wgs84.crs, n_buildings=tally.buildings)
    storage.put(CATALOGUE_NAME, catalogue.to_json().encode())


def _write_tileset(run_dir: Path, path: Path) -> bool:
    """Write the root tileset of the points for its place among the results; False if there is none."""
    root = run_dir / POINTS_FOLDER / TILESET
    if not root.is_file():
        return False
    tileset = json.loads(root.read_bytes())
    waiting = [tileset["root"]]
    for node in waiting:
        if "content" in node:
            # from jobs/ID/results/tileset to jobs/ID/points
            node["content"]["uri"] = f"../points/{node['content']['uri']}"
        waiting.extend(node.get("children", ()))
    path.write_text(json.dumps(tileset, separators=(",", ":"), ensure_ascii=False), encoding="utf-8")
    return True


def _manifest(run_dir: Path) -> Mapping[str, Any]:
    """The content of run.json of a finished run.

    Raises
    ------
    RunError
        The run did not end, or does not exist.
    """
    from pipeline.errors import RunError
    from pipeline.runtime.manifest import NAME, RunStatus
    from pipeline.runtime.manifest_reading import read_manifest

    status = read_manifest(run_dir).status
    if status not in {RunStatus.FINISHED, RunStatus.INCOMPLETE}:
        raise RunError(f"{run_dir} is {status.value}: outputs need a finished run")
    found: Mapping[str, Any] = json.loads((run_dir / NAME).read_text(encoding="utf-8"))
    return found


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
        storage: Any,
        run_dir: Path,
        tiles: Sequence[RunTile],
        names: set[str],
        to_wgs84: Wgs84Transformation,
    ) -> None:
        from service.outputs.building_index import NAME as INDEX_NAME
        from service.outputs.building_index import BuildingIndexFile
        from service.outputs.footprints import FeatureCollectionFile
        from service.outputs.merged_cityjson import MergedCityJson, read_header
        from service.outputs.merged_table import MergedTable
        from service.outputs.report import Tally

        def file(name: str) -> Path:
            path: Path = stack.enter_context(storage.putting(name))
            return path

        self._run_dir = run_dir
        self._to_wgs84 = to_wgs84
        self.tally: Tally = Tally()
        self._headers = {tile.key: read_header(run_dir / tile.cityjson) for tile in tiles}
        self._tables: dict[str, MergedTable] = {}
        for name in _TABLES:
            if name in names:
                sources = [run_dir / tile.table(name) for tile in tiles]
                self._tables[name] = stack.enter_context(
                    MergedTable(file(OUTPUTS[name].filename), name, sources, to_wgs84.projjson)
                )
        self._city: MergedCityJson | None = None
        if "cityjson" in names:
            stream = stack.enter_context(file(OUTPUTS["cityjson"].filename).open("wb"))
            self._city = MergedCityJson(stream, list(self._headers.values()))
        self._archive: zipfile.ZipFile | None = None
        if "meshes" in names:
            self._archive = stack.enter_context(zipfile.ZipFile(file(OUTPUTS["meshes"].filename), "w"))
        self._index: BuildingIndexFile = stack.enter_context(BuildingIndexFile(file(INDEX_NAME)))
        stream = stack.enter_context(file(OUTPUTS["geojson"].filename).open("wb"))
        self._features: FeatureCollectionFile = stack.enter_context(
            contextlib.closing(FeatureCollectionFile(stream, to_wgs84.crs))
        )

    def add(self, tile: RunTile) -> None:
        """Write one tile to all files."""
        from pipeline.export.folders import TERRAIN_FOLDER
        from pipeline.export.solid_geometry import SHAPE_COLUMNS
        from service.outputs.footprints import feature_texts
        from service.outputs.merged_table import read_tile
        from service.outputs.meshes import zip_files

        tables = {name: read_tile(self._run_dir / tile.table(name)) for name in _TABLES}
        for name, table in self._tables.items():
            table.add(tile.key, tables[name])
        if self._archive is not None:
            terrain = sorted((self._run_dir / TERRAIN_FOLDER / f"tile={tile.key}").glob("part-*"))
            names = [path.relative_to(self._run_dir).as_posix() for path in terrain]
            zip_files(self._archive, self._run_dir, [*tile.meshes, *names])
        places = self._add_cityjson(tile)
        planes: dict[str, list[dict[str, Any]]] = {}
        for plane in tables["planes"].drop_columns(["geometry", "bbox"]).to_pylist():
            planes.setdefault(plane.pop("building_id"), []).append(plane)
            self.tally.planes += 1
        decisions: dict[str, list[dict[str, Any]]] = {}
        if tile.decisions is not None:
            for entry in read_tile(self._run_dir / tile.decisions).to_pylist():
                decisions.setdefault(entry.pop("building_id"), []).append(entry)
        self.tally.count_rejected(tables["rejected"].column("reason").to_pylist())
        rows = [{**row, "tile": tile.key} for row in tables["buildings"].drop_columns(list(SHAPE_COLUMNS)).to_pylist()]
        for feature in feature_texts(rows, self._to_wgs84):
            start = self._features.add(feature)
            self._index.add(
                record=feature.record,
                feature=(start, len(feature.text), feature.geometry_start, feature.geometry_size),
                native=feature.native,
                city=places[feature.building_id],
                planes=planes.get(feature.building_id, ()),
                decisions=decisions.get(feature.building_id, ()),
                bounds=feature.bounds,
                bounds_deg=feature.bounds_deg,
            )
            self.tally.count_building(feature.record, has_geometry=feature.bounds_deg is not None)

    def _add_cityjson(self, tile: RunTile) -> dict[str, tuple[int, int]]:
        """Write the tile's features; start and size of each building's line in the tile's own file."""
        from service.outputs.merged_cityjson import features

        places = {}
        for place, line in features(self._run_dir / tile.cityjson):
            places[place.building_id] = (place.start, place.size)
            if self._city is not None:
                self._city.add(self._headers[tile.key], line)
        return places
