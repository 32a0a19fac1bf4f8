"""Publishing a finished run as 3D Tiles 1.1: a folder with a tileset for CesiumJS and other globes."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import NothingToShowError, RunError
from pipeline.export.cityjson import lines_of
from pipeline.export.columns import ELEVATIONS
from pipeline.export.folders import TERRAIN_FOLDER
from pipeline.export.geoparquet import table_batches
from pipeline.export.glb import Frame, SolidMesh, solid_mesh
from pipeline.extras.publish.finished_run import (
    ROWS,
    SEQUENCES,
    FinishedRun,
    Published,
    disk_at,
    path_outside,
    refuse_occupied,
    sequences_of,
)
from pipeline.extras.publish_3dtiles.globe import Geodesy, geodesy
from pipeline.extras.publish_3dtiles.globe_glb import (
    Content,
    Placed,
    block_feature,
    globe_glb,
    local_axes,
    placed,
    region_of,
)
from pipeline.extras.publish_3dtiles.globe_terrain import PlacedTerrain, placed_terrain, terrain_glb
from pipeline.extras.publish_3dtiles.globe_tileset import (
    LEAST_ERROR_M,
    Branch,
    Node,
    blocks_of,
    globe_tileset,
    grown,
    terrain_node,
)
from pipeline.extras.publish_3dtiles.property_table import BLOCK_COLUMNS, COLUMNS, TILE, StoredColumn
from pipeline.extras.terrain_tin.terrain_files import TerrainTriangles, read_terrain
from pipeline.io import LocalStorage, arrow_at, storage_at
from pipeline.io.crs import SpatialReference
from pipeline.model import FloatArray
from pipeline.runtime.manifest_reading import city_unit_m
from pipeline.runtime.monitoring.progress import Event, Listener, ignore
from pipeline.tiling import Tile

NAME = "tileset.json"
"""The file to open."""
TERRAIN_NAME = "terrain.json"
"""The tileset of the terrain, if the run has any."""
_BLOCKS, _MODELS, _SKYLINES, _TERRAIN = "blocks", "models", "skylines", "terrain"
_MADE = frozenset({NAME, TERRAIN_NAME, _BLOCKS, _MODELS, _SKYLINES, _TERRAIN})
"""All that a folder may hold to be replaced."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PublishedTileset(Published):
    """What was written, and how it was placed on the globe."""

    georeference: Mapping[str, Any]
    """`pipeline.extras.publish_3dtiles.globe.Geodesy.facts`."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """How it was placed."""
        facts = self.georeference
        accuracy = "unknown" if facts["accuracy_m"] is None else f"{facts['accuracy_m']:g} m"
        added = "" if facts["geoid_height_m"] is None else f" ({facts['geoid_height_m']:+g} m)"
        return f"{facts['transformation']}, accuracy {accuracy}", f"heights: {facts['heights']}{added}"


def publish_3dtiles(
    run_dir: str,
    out: str,
    *,
    overwrite: bool = False,
    geoid_height_m: float | None = None,
    on_event: Listener = ignore,
) -> PublishedTileset:
    """Write a finished run as 3D Tiles in a folder, tile by tile; parameters and errors as in `publishing.Form`.

    If the run has terrain, a second tileset beside the first shows it. `geoid_height_m` is the height of the geoid
    above the ellipsoid, added to all elevations. An earlier tileset is replaced as a whole. Raises RunError if the CRS
    is unknown, and NothingToShowError without a model.
    """
    target = path_outside(run_dir, out)
    run = FinishedRun.at(run_dir, {SEQUENCES, "buildings"})
    manifest, reference = run.manifest, run.reference
    way = geodesy(reference, geoid_height_m)
    keys = {Tile.from_key(name): key for name, key in sequences_of(run_dir).items()}
    with disk_at(target):
        _refuse_occupied(target, overwrite)
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
            made = LocalStorage(root=Path(folder, "new"))
            made.make()
            tiles = _Tiles(run_dir, reference, city_unit_m(manifest.crs), way, made, on_event, len(keys), {})
            tree = grown(sorted(keys), lambda tile: tiles.leaf(tile, keys[tile]), tiles.skyline) if keys else None
            run.check({"buildings": tiles.counts.get("buildings", 0)})
            if tree is None:
                raise NothingToShowError(
                    f"no building of the run in {run_dir} has a model, so there is nothing to show"
                )
            extras = {**way.facts, "content_sha256": manifest.content_sha256, "licence": manifest.source_licence}
            terrain = tiles.terrain()
            if terrain:
                made.put(TERRAIN_NAME, globe_tileset(Branch(nodes=terrain, blocks=(), buildings=0), extras))
                extras["terrain"] = TERRAIN_NAME
            made.put(NAME, globe_tileset(tree, extras))
            size = sum(path.stat().st_size for path in made.root.rglob("*") if path.is_file())
            _refuse_occupied(target, overwrite)
            if target.exists():
                target.replace(Path(folder, "old"))
            made.root.replace(target)
    rows = {"buildings": tiles.counts["buildings"], "models": tree.buildings}
    if terrain:
        rows["tiles of terrain"] = len(terrain)
    return PublishedTileset(place=str(target), size_bytes=size, rows=rows, georeference=way.facts)


def _refuse_occupied(target: Path, overwrite: bool) -> None:
    """Refuse a folder with other files than a tileset's, or with one unless it is to be replaced; raises RunError."""
    held = target.iterdir() if target.is_dir() else ()
    refuse_occupied(target, overwrite, held, "a tileset", _MADE.__contains__)


@dataclasses.dataclass(frozen=True)
class _Tiles:
    """Reads tiles of the run, and stores contents."""

    run_dir: str
    reference: SpatialReference
    city_m: float
    geodesy: Geodesy
    made: LocalStorage
    on_event: Listener
    total: int
    counts: dict[str, int]

    @property
    def units_m(self) -> tuple[float, float, float]:
        """Metres per unit of the axes of the run's CityJSON."""
        return self.reference.horizontal_unit_m, self.reference.horizontal_unit_m, self.city_m

    def leaf(self, tile: Tile, key: str) -> Branch | None:
        """A tile's models and, above them, its blocks; None if it has no models."""
        records = self._records(tile)
        self.counts["buildings"] = self.counts.get("buildings", 0) + len(records)
        self.counts["tiles"] = self.counts.get("tiles", 0) + 1
        try:
            models, blocks = self._meshes(key, records)
            branch = self._branch(tile, placed(models, self.geodesy), placed(blocks, self.geodesy)) if models else None
        except (ValueError, KeyError, TypeError, IndexError) as fault:
            raise self._misplaced(key, fault) from fault
        self.on_event(Event(kind="progress", stage="3dtiles", done=self.counts["tiles"], total=self.total))
        return branch

    def _misplaced(self, key: str, fault: Exception) -> RunError:
        problem = f"{key} of the run in {self.run_dir} cannot be placed on the globe ({str(fault)[:160]})"
        return RunError(f"{problem}: run it again")

    def _records(self, tile: Tile) -> dict[str, dict[str, Any]]:
        """The records of a tile by their ids, elevations in metres."""
        filesystem, place = arrow_at(self.run_dir)
        names = [column.name for column in COLUMNS if column.name != TILE]
        batches = table_batches(place, "buildings", names, filesystem, [tile.key], ROWS)
        rows = (row for batch in batches for row in batch.to_pylist())
        return {row["building_id"]: {**row, **self._elevations_m(row), TILE: tile.key} for row in rows}

    def _elevations_m(self, row: Mapping[str, Any]) -> dict[str, float]:
        """The elevations of a record in metres, as all else on a globe."""
        unit_m = self.reference.vertical_unit_m
        known = {name: row[name] for name in ELEVATIONS["buildings"] if row[name] is not None}
        return {} if unit_m == 1.0 else {name: round(value * unit_m, 3) for name, value in known.items()}

    def _meshes(self, key: str, records: Mapping[str, Mapping[str, Any]]) -> tuple[_Meshes, _Meshes]:
        """The models of a tile, and the blocks in their place, with their records."""
        heading, *features = map(json.loads, lines_of(storage_at(self.run_dir).get(key).decode()))
        frame = Frame.of(heading["transform"], self.units_m)
        models: _Meshes = []
        blocks: _Meshes = []
        for feature in features:
            mesh = solid_mesh(feature, frame, None)
            if mesh is None:
                continue
            record = records[feature["id"]]
            block = solid_mesh(block_feature(feature, frame, record["h_70p"] / self.units_m[2]), frame, None)
            models.append((record, mesh))
            if block is not None:
                blocks.append(({column.name: record[column.name] for column in BLOCK_COLUMNS}, block))
        return models, blocks

    def _branch(self, tile: Tile, models: Sequence[Placed], blocks: Sequence[Placed]) -> Branch:
        """The nodes of a tile."""
        region = region_of([*models, *blocks])
        fine = self._store(f"{_MODELS}/{tile.key}.glb", models, COLUMNS, region)
        coarse = self._store(f"{_BLOCKS}/{tile.key}.glb", blocks, BLOCK_COLUMNS, region)
        away = [max(m.record["h_max"] - m.record["h_70p"], m.record["h_70p"] - m.record["h_min"]) for m in models]
        error_m = round(max(LEAST_ERROR_M, *away), 3)
        child = Node(region=region, error_m=0.0, uri=fine.uri, matrix=fine.matrix)
        node = Node(region=region, error_m=error_m, uri=coarse.uri, matrix=coarse.matrix, children=(child,))
        return Branch(nodes=(node,), blocks=blocks_of(blocks), buildings=len(models))

    def terrain(self) -> tuple[Node, ...]:
        """Store the terrain of all tiles that have some; their nodes."""
        keys = {Tile.from_key(name): key for name, key in sequences_of(self.run_dir, TERRAIN_FOLDER).items()}
        found = []
        for done, tile in enumerate(sorted(keys), start=1):
            lines = lines_of(storage_at(self.run_dir).get(keys[tile]).decode())
            try:
                placed = self._terrain(read_terrain(lines))
            except (ValueError, KeyError, TypeError, IndexError) as fault:
                raise self._misplaced(keys[tile], fault) from fault
            matrix = local_axes(placed.region)
            content = Content(uri=f"{_TERRAIN}/{tile.key}.glb", matrix=matrix)
            self.made.put(content.uri, terrain_glb(placed, matrix))
            found.append(terrain_node(content, placed.region))
            self.on_event(Event(kind="progress", stage="terrain", done=done, total=len(keys)))
        return tuple(found)

    def _terrain(self, read: TerrainTriangles) -> PlacedTerrain:
        """The terrain of a tile on the globe."""
        return placed_terrain(read.vertices * self.units_m, read.triangles, self.geodesy)

    def skyline(self, name: str, blocks: Sequence[Placed], region: FloatArray) -> Content:
        """Store the largest blocks of a square of tiles."""
        return self._store(f"{_SKYLINES}/{name}.glb", blocks, BLOCK_COLUMNS, region)

    def _store(
        self, uri: str, buildings: Sequence[Placed], columns: Sequence[StoredColumn], region: FloatArray
    ) -> Content:
        """Store buildings about a region."""
        matrix = local_axes(region)
        self.made.put(uri, globe_glb(buildings, columns, matrix))
        return Content(uri=uri, matrix=matrix)


_Meshes = list[tuple[Mapping[str, Any], SolidMesh]]
