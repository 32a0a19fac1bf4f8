"""The terrain of each tile as triangles with the floors of buildings cut out, one task per tile.

The run makes it; it cannot be published from the run directory, since only scratch holds the ground.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from pipeline.errors import RunCancelledError, RunError
from pipeline.export.folders import TERRAIN_FOLDER
from pipeline.export.stored_coordinates import SpatialReference, one_unit
from pipeline.extras.terrain_tin.terrain_files import in_crs, terrain_lines, terrain_obj, terrain_path
from pipeline.extras.terrain_tin.terrain_tin import BESIDE_MM, REACH_M, Outline, TerrainMesh, terrain_mesh
from pipeline.io import storage_at
from pipeline.model import BuildingResult, FaceKind
from pipeline.runtime.run_context import ProgressUnits, RunContext
from pipeline.runtime.run_plan import WINDOW_BASE_BYTES
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Files, InParts, Place, brief_within, drop_outcomes, key_of, part_of, whole
from pipeline.runtime.stages.cleanup import writing_terrain
from pipeline.runtime.stages.ground_stage import Ground
from pipeline.runtime.stages.model_batch import stored_results
from pipeline.runtime.stages.reconstruct import Models
from pipeline.runtime.stages.window_points import GROUND_FOLDER, surroundings_of
from pipeline.settings import RunSettings
from pipeline.tiling import MM, Tile, TileGrid, Window

_BYTES_PER_CELL = 150
_FLOORS = "floors"


@dataclasses.dataclass(frozen=True, kw_only=True)
class FloorsTask:
    """The floors of the buildings of one tile: small, and read by the tiles around it, too."""

    scratch: Scratch
    """Models in."""
    batches: tuple[Place, ...]
    """Outcomes of the batches that modelled them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TerrainTask:
    """One tile."""

    tile: Tile
    """The tile."""
    grid: TileGrid
    """The lattice."""
    run_dir: str
    """The run directory, a path or URL."""
    scratch: Scratch
    """Terrain and models in."""
    floors: tuple[Place, ...]
    """Outcomes with the floors of the tiles of which a building reaches into this one, or beside it."""
    reference: SpatialReference
    """CRS and units of the files."""
    tolerance_m: float
    """How far the triangles may be off."""
    obj: bool
    """Whether to write OBJ, too."""
    memory_bytes: int = 0
    """Estimated peak memory of the process."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class TileTerrain:
    """The terrain of a tile as the driver knows it."""

    tile: Tile
    """The tile."""
    triangles: int = 0
    """Their number."""
    cells: int = 0
    """Cells of the terrain that count."""
    squares_mm2: float = 0.0
    """Sum of their squared vertical errors."""
    max_error_mm: float = 0.0
    """The largest."""
    error: str = ""
    """Why it could not be written; empty where it was."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TerrainOutcome:
    """The terrain of a run."""

    counts: dict[str, int]
    """Triangles, cells that count, and their errors in mm, for run.json."""
    failed: tuple[str, ...]
    """Keys of the tiles whose terrain could not be written."""


def write_terrain(
    context: RunContext, settings: RunSettings, ground: Ground, models: Models, run_dir: str, meshes: str
) -> TerrainOutcome:
    """Write the terrain of all tiles."""
    scratch, storage = context.scratch, storage_at(run_dir)
    stage, there = writing_terrain(run_dir), set[str]()
    if scratch.attempt:
        there = {key for key in storage.keys(TERRAIN_FOLDER) if not key.rpartition("/")[2].startswith(".")}
    floors = _floors_reaching(context, models)
    tasks = {}
    for tile in sorted(ground.tiles):
        owners = floors.get(tile, [])
        task = _task(context, settings, [place for _, place in owners], tile, run_dir, meshes)
        seen = [ground.tiles[other].zones for other in _around(task.grid, tile, REACH_M) if other in ground.tiles]
        near = [models.contents[owner] for owner, _ in owners]
        key = key_of(run_dir, tile, task.grid, task.tolerance_m, task.obj, task.reference, seen, near)
        tasks[Place(stage, tile.key, key)] = task
    # terrain that a user removed from the run directory is written again
    drop_outcomes(scratch, stage, [place for place, task in tasks.items() if there.issuperset(_paths(task))])
    units = ProgressUnits[TileTerrain](failed=lambda one: int(bool(one.error)))
    files: Files[TerrainTask, TileTerrain] = Files(reads=_read)
    written = context.map_stored("terrain", write_tile_terrain, tasks, whole, units, files=files)
    for place, one in written.items():
        if one.error:
            context.progress.warn("terrain", f"the terrain of tile {one.tile.key} could not be written: {one.error}")
            scratch.path(place.name).unlink(missing_ok=True)  # so that a resumed run tries it again
            for name in there.intersection(_paths(tasks[place])):
                try:
                    storage.delete(name)  # of an earlier run: it would not fit the models
                except (OSError, RunError) as fault:
                    context.progress.warn("terrain", f"{name} of an earlier run remains: {fault}")
    wanted = {name for task in tasks.values() for name in _paths(task)}
    for name in sorted(there - wanted):
        storage.delete(name)
    good = [one for one in written.values() if not one.error]
    return TerrainOutcome(counts=_counts(good), failed=tuple(one.tile.key for one in written.values() if one.error))


def _floors_reaching(context: RunContext, models: Models) -> dict[Tile, list[tuple[Tile, Place]]]:
    """The tiles of which a building reaches into each tile, or beside it, and where their floors are stored.

    A building is stored by the tile of its smallest point, and may be wider than several tiles.
    """
    scratch, grid = context.scratch, context.plan.grid
    tasks = {
        tile: (
            Place(_FLOORS, tile.key, key_of(models.contents[tile])),
            FloorsTask(scratch=scratch, batches=tuple(places)),
        )
        for tile, places in models.places.items()
    }
    drop_outcomes(scratch, _FLOORS, [place for place, _ in tasks.values()])
    files: Files[FloorsTask, tuple[Window, ...]] = Files(reads=lambda task: {place.folder for place in task.batches})
    boxes = context.map_stored("terrain", store_floors, dict(tasks.values()), brief_within, files=files, quiet=True)
    reaching: dict[Tile, list[tuple[Tile, Place]]] = {}
    for owner, (place, _) in sorted(tasks.items()):
        for box in boxes[place]:
            for tile in grid.tiles_over(box.grown(BESIDE_MM)):
                reaching.setdefault(tile, []).append((owner, place))
    return reaching


def store_floors(task: FloorsTask) -> InParts[tuple[Window, ...]]:
    """The floors of the buildings of one tile; the brief is the box around them, none without floors."""
    found = [
        floor
        for place in task.batches
        for entry in stored_results(task.scratch, place)
        if not entry.is_rejected
        for floor in floors_of(entry.result)
    ]
    if not found:
        return InParts(brief=(), parts=(found,))
    corners = np.concatenate([ring for floor in found for ring in floor.rings])
    (x0, y0), (x1, y1) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    return InParts(brief=(Window(x0_mm=x0, y0_mm=y0, x1_mm=x1, y1_mm=y1),), parts=(found,))


def _around(grid: TileGrid, tile: Tile, metres: int) -> list[Tile]:
    return list(grid.tiles_over(grid.core(tile).grown(metres * MM)))


def _task(
    context: RunContext, settings: RunSettings, floors: Sequence[Place], tile: Tile, run_dir: str, meshes: str
) -> TerrainTask:
    grid = context.plan.grid
    return TerrainTask(
        tile=tile,
        grid=grid,
        run_dir=run_dir,
        scratch=context.scratch,
        floors=tuple(floors),
        reference=context.plan.reference,
        tolerance_m=settings.general.terrain_tolerance_m,
        obj=meshes != "none",
        memory_bytes=WINDOW_BASE_BYTES + _BYTES_PER_CELL * (grid.size_mm // MM + 2 * REACH_M) ** 2,
    )


def _read(task: TerrainTask) -> set[str]:
    """The folders of scratch with the terrain and the models that a tile's terrain needs."""
    ground = {f"{GROUND_FOLDER}/{tile.key}" for tile in _around(task.grid, task.tile, REACH_M)}
    return ground | {place.folder for place in task.floors}


def _paths(task: TerrainTask) -> list[str]:
    """The files of a tile."""
    return [terrain_path(task.tile.key, ending) for ending in ("city.jsonl", *(("obj",) if task.obj else ()))]


def _counts(tiles: Sequence[TileTerrain]) -> dict[str, int]:
    cells, squares = sum(one.cells for one in tiles), sum(one.squares_mm2 for one in tiles)
    return {
        "terrain_triangles": sum(one.triangles for one in tiles),
        "terrain_cells": cells,
        "terrain_rms_error_mm": round(math.sqrt(squares / cells)) if cells else 0,
        "terrain_max_error_mm": round(max((one.max_error_mm for one in tiles), default=0.0)),
    }


def write_tile_terrain(task: TerrainTask) -> TileTerrain:
    """Write the terrain of one tile; may run twice. A tile that fails harms only itself: the outcome says why."""
    try:
        return _written(task)
    except RunCancelledError:
        raise
    except Exception as fault:  # noqa: BLE001 - goes into the warnings, the manifest and the exit code
        task.scratch.check_cancelled()
        return TileTerrain(tile=task.tile, error=f"{type(fault).__name__}: {fault}")


def _written(task: TerrainTask) -> TileTerrain:
    task.scratch.check_cancelled()
    core, storage = task.grid.core(task.tile), storage_at(task.run_dir)
    around = surroundings_of(task.scratch, task.grid, core.grown(REACH_M * MM))
    mesh = terrain_mesh(
        core,
        around.elevation_mm,
        around.occupied,
        (around.column0, around.row0),
        [floor for place in task.floors for floor in part_of(task.scratch, place, 0)],
        task.tolerance_m * MM,
    )
    task.scratch.check_cancelled()
    if len(mesh.triangles):
        for name, content in zip(_paths(task), _contents(task, mesh, core), strict=False):
            storage.put(name, content.encode())
    else:
        for name in _paths(task):
            storage.delete(name)
    return TileTerrain(
        tile=task.tile,
        triangles=len(mesh.triangles),
        cells=mesh.n_cells,
        squares_mm2=mesh.squares_mm2,
        max_error_mm=mesh.max_error_mm,
    )


def _contents(task: TerrainTask, mesh: TerrainMesh, core: Window) -> tuple[str, ...]:
    """The contents of a tile's files."""
    origin_mm = np.array([core.x0_mm // MM * MM, core.y0_mm // MM * MM, 0])
    east, north, _ = (origin_mm / MM).tolist()
    local = (mesh.vertices_mm - origin_mm) / MM
    reference = one_unit(task.reference)
    terrain = in_crs(local, (east, north, 0.0), mesh.triangles, reference)
    attributes = {
        "tolerance_m": task.tolerance_m,
        "max_error_m": round(mesh.max_error_mm / MM, 3),
        "rms_error_m": round(math.sqrt(mesh.squares_mm2 / max(mesh.n_cells, 1)) / MM, 3),
    }
    lines = "".join(f"{line}\n" for line in terrain_lines(terrain, task.tile.key, attributes, reference))
    if not task.obj:
        return (lines,)
    own = in_crs(local, (east, north, 0.0), mesh.triangles, task.reference)
    return lines, terrain_obj(own, task.tile.key, task.reference)


def floors_of(result: BuildingResult) -> list[Outline]:
    """The floors of a building's solids in absolute millimetres."""
    origin_mm = np.rint(np.array(result.origin) * MM).astype(np.int64)
    found: list[Outline] = []
    for solid in result.solids:
        vertices = np.rint(solid.vertices * MM).astype(np.int64) + origin_mm
        found.extend(
            Outline(
                rings=tuple(vertices[list(ring), :2] for ring in face.rings), z_mm=int(vertices[face.rings[0][0], 2])
            )
            for face in solid.faces
            if face.kind is FaceKind.GROUND
        )
    return found
