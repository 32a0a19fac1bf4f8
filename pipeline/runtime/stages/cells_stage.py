"""Cells: the points of each tile are judged once, and the lowest of them that may be ground found for each cell of 1 m.

Duplicates and outliers are marked for all later stages, so that none of them has to look for these again. The ground
filter sees the cells only: four bytes each, however dense the points are.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import BoolArray, ByteArray, FloatArray, IntArray
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.run_plan import points_bytes
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Files, Place, key_of, whole
from pipeline.runtime.stages.cleanup import clear_tiles
from pipeline.runtime.stages.ingested import Ingested, content_by_tile, points_by_tile
from pipeline.runtime.stages.tile_content import content_of_window
from pipeline.runtime.stages.window_points import CELLS_FOLDER, PointState, bucket, bucket_paths
from pipeline.scene import WindowPoints, lattice_of, usable_as_ground
from pipeline.spatial_hash import first_of_each
from pipeline.terrain.flight_passes import Strip
from pipeline.terrain.lattice import NO_DATA, lowest_per_cell
from pipeline.terrain.outliers import dense_enough
from pipeline.terrain.survey_strips import SQUARE_MM, compared_strips
from pipeline.terrain.terrain_settings import ClassesInUse, OutlierSettings
from pipeline.tiling import MM, Tile, TileGrid, Window


@dataclasses.dataclass(frozen=True, kw_only=True)
class CellsTask:
    """One tile."""

    tile: Tile
    """The tile."""
    grid: TileGrid
    """The lattice."""
    classes: ClassesInUse
    """Which of the file's classes are believed."""
    scratch: Scratch
    """Points in, cells out."""
    passes: tuple[Strip, ...] = ()
    """Passes of flight strips that are compared with one another, too."""
    memory_bytes: int = 0
    """Estimated peak memory of the process; 0 if unknown."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class TileCells:
    """What a tile held."""

    tile: Tile
    """The tile."""
    duplicates: int
    """Exact duplicates of other points."""
    outliers: int
    """Gross outliers among the others."""
    outcome: str
    """Digest of the cells."""
    states: int
    """CRC-32 of the states of its points."""
    strips: bytes
    """How its flight strips differ: the bytes of the rows of `compared_strips`."""


def find_all_cells(
    context: RunContext,
    settings: OutlierSettings,
    ingested: Sequence[Ingested],
    classes: ClassesInUse,
    tiles: Iterable[Tile],
    passes: tuple[Strip, ...],
) -> dict[Tile, TileCells]:
    """The cells of some tiles with points, the fullest first."""
    grid, points, content = context.plan.grid, points_by_tile(ingested), content_by_tile(ingested)
    # the marks of points are in the order of the buckets, which equal points do not imply
    files: dict[Tile, list[tuple[tuple[str, ...], str]]] = {}
    for found in ingested:
        for tile in found.points_by_tile:
            files.setdefault(tile, []).append((found.parts, found.sha256))
    alike = key_of(grid, settings, classes, passes)
    tasks = {}
    for tile in sorted(tiles, key=lambda tile: (-points[tile], tile)):
        seen = content_of_window(content, grid, grid.window(tile), tile)
        key = key_of(alike, tile, sorted(files[tile]), seen)
        tasks[Place(CELLS_FOLDER, tile.key, key)] = CellsTask(
            tile=tile,
            grid=grid,
            classes=classes,
            scratch=context.scratch,
            passes=passes,
            memory_bytes=points_bytes(points[tile], max(points[other] for other in grid.tiles_over(grid.window(tile)))),
        )
    clear_tiles(context.scratch, CELLS_FOLDER, tasks)
    function = functools.partial(find_cells, settings=settings)
    stored: Files[CellsTask, TileCells] = Files(reads=_read, leaves=_left, intact=is_intact)
    found_cells = context.map_stored("cells", function, tasks, whole, files=stored)
    return {cells.tile: cells for cells in found_cells.values()}


def _read(task: CellsTask) -> list[str]:
    """The folders of scratch with the points that a tile's cells depend on."""
    return [f"points/{tile.key}" for tile in task.grid.tiles_over(task.grid.window(task.tile))]


def _left(task: CellsTask, _: TileCells) -> list[str]:
    """The folder of scratch with a tile's cells."""
    return [f"{CELLS_FOLDER}/{task.tile.key}"]


def find_cells(task: CellsTask, settings: OutlierSettings) -> TileCells:
    """Mark the points of a tile and find its cells.

    In scratch under `cells/<tile>/` are `states`, a `PointState` for each point of the buckets in their order, and two
    rasters over the cells that the tile meets: `lowest` and `occupied`, without outliers. A cell across a border is in
    the rasters of both tiles, each with its own points.
    """
    task.scratch.check_cancelled()
    core, scratch = task.grid.core(task.tile), task.scratch
    parts = [bucket(path) for path in bucket_paths(scratch, task.tile)]
    own, first = _columns_of(parts, core)
    del parts
    around = _around(task, core.grown(max(SQUARE_MM, math.ceil(settings.support_m * MM))))
    x, y, z = (np.concatenate([columns[axis] for columns in (own, *around)]) for axis in range(3))
    number, time, source, returns = (np.concatenate([columns[k] for columns in (own, *around)]) for k in (3, 4, 5, 7))
    strips = compared_strips((x, y, z), (number, returns), source, time, core, task.passes)
    task.scratch.check_cancelled()
    n = len(own[0])
    kept = dense_enough(x, y, z, settings)[:n]
    states = np.full(len(first), PointState.DUPLICATE, np.uint8)
    states[first] = np.where(kept, PointState.KEPT, PointState.OUTLIER)
    points = WindowPoints(
        x_mm=own[0], y_mm=own[1], z_mm=own[2], return_number=own[3], return_count=own[7], classification=own[6]
    )
    lattice = lattice_of(core)
    usable = usable_as_ground(points, kept, task.classes)
    rasters: dict[str, npt.NDArray[np.int32] | BoolArray] = {
        "lowest": lowest_per_cell(points.x_mm, points.y_mm, points.z_mm, usable, *lattice),
        "occupied": lowest_per_cell(points.x_mm, points.y_mm, points.z_mm, kept, *lattice) != NO_DATA,
    }
    scratch.put_arrays(f"{CELLS_FOLDER}/{task.tile.key}", {"states": states, **rasters})
    return TileCells(
        tile=task.tile,
        duplicates=len(first) - n,
        outliers=int(n - np.count_nonzero(kept)),
        outcome=_digest_of(*rasters.values()),
        states=zlib.crc32(states.data),
        strips=strips.tobytes(),
    )


def _digest_of(*rasters: npt.NDArray[Any]) -> str:
    digest = hashlib.sha256()
    for raster in rasters:
        digest.update(np.ascontiguousarray(raster).data)
    return digest.hexdigest()


def is_intact(task: CellsTask, found: TileCells, folder: str) -> bool:
    """Whether what was found of a tile is in a folder of scratch as it was stored."""
    rasters = (task.scratch.array(folder, name) for name in ("lowest", "occupied"))
    states = task.scratch.array(folder, "states")
    return _digest_of(*rasters) == found.outcome and zlib.crc32(states.data) == found.states


def _around(task: CellsTask, window: Window) -> list[Columns]:
    """The points of other tiles in a window, without duplicates."""
    others = [bucket_paths(task.scratch, other) for other in task.grid.tiles_over(window) if other != task.tile]
    return [_columns_of([bucket(path) for path in paths], window)[0] for paths in others if paths]


Columns: TypeAlias = tuple[
    IntArray,
    IntArray,
    IntArray,
    ByteArray,
    FloatArray,
    npt.NDArray[np.uint16],
    ByteArray,
    ByteArray,
]
"""x, y, z in mm, return number, GPS time, source, class, return count: as `first_of_each` takes them."""


@kernel
def _columns_inside(records: npt.NDArray[np.void], x0: int, y0: int, x1: int, y1: int) -> Columns:
    """Columns of the (n,) records with x0 <= x < x1 and y0 <= y < y1 in mm, in the order of the records."""
    size = records.size
    # room for all records, though only what is written takes memory: records are wide, and this reads them once
    x, y, z = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    return_number, return_count = np.empty(size, np.uint8), np.empty(size, np.uint8)
    classification, source, gps_time = np.empty(size, np.uint8), np.empty(size, np.uint16), np.empty(size, np.float64)
    n = 0
    for i in range(size):
        point = records[i]
        if x0 <= point.x < x1 and y0 <= point.y < y1:
            x[n], y[n], z[n] = point.x, point.y, point.z
            return_number[n], return_count[n] = point.return_number, point.return_count
            classification[n], source[n], gps_time[n] = point.classification, point.source, point.gps_time
            n += 1
    return x[:n], y[:n], z[:n], return_number[:n], gps_time[:n], source[:n], classification[:n], return_count[:n]


def _columns_of(parts: Sequence[npt.NDArray[np.void]], window: Window) -> tuple[Columns, BoolArray]:
    """Points in a window of one tile's buckets, one of each set of equal points; and which of them stayed.

    Equal points share a tile, so duplicates are looked for tile by tile.
    """
    found = [_columns_inside(part, window.x0_mm, window.y0_mm, window.x1_mm, window.y1_mm) for part in parts]
    columns: Columns = found[0] if len(found) == 1 else tuple(map(np.concatenate, zip(*found, strict=True)))  # type: ignore[assignment]
    kept = first_of_each(*columns)
    if not kept.all():
        columns = tuple(column[kept] for column in columns)  # type: ignore[assignment]
    return columns, kept


def digests_of(cells: Mapping[Tile, TileCells], tiles: Iterable[Tile]) -> list[tuple[str, str]]:
    """Names and digests of the cells of some tiles, those without points left out."""
    return [(tile.key, cells[tile].outcome) for tile in sorted(tiles) if tile in cells]
