"""Ground: the terrain of a run, found once over the cells of all tiles, in blocks.

The filter looks 200 m far. Over the cells of a block of a kilometre or two that costs little; a tile that looked for
its own ground would read several times its own points instead.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.model import BoolArray
from pipeline.registry import extra
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.run_plan import check_windows, ground_bytes, split_grid, tiles_per_block
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Files, Place, key_of, whole
from pipeline.runtime.stages.cells_stage import TileCells, digests_of, find_all_cells
from pipeline.runtime.stages.cleanup import clear_tiles
from pipeline.runtime.stages.ingested import Ingested, classes_in_use, points_by_tile
from pipeline.runtime.stages.tile_content import ZoneSums, content_of_window, zone_sums_of
from pipeline.runtime.stages.window_points import CELLS_FOLDER, GROUND_FOLDER, NO_POINT, distances_to_terrain
from pipeline.scene import lattice_of
from pipeline.settings import RunSettings
from pipeline.terrain.flight_passes import Strip
from pipeline.terrain.ground import ground_on
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations
from pipeline.terrain.reach import ROOFS_ALONE_CELLS
from pipeline.terrain.terrain_settings import APRON_M, ClassesInUse, GroundSettings
from pipeline.tiling import MM, Tile, TileGrid, Window

if TYPE_CHECKING:
    from pipeline.extras.footprints.given_footprints import GivenFootprints, Outline

_ABOUT_ROOFS_ALONE = (
    "no points lie around given footprints with points on {} m2: the points there count as roof, not ground, and a "
    "floor without terrain beside it is assumed"
)
_ROOFS_MM = ROOFS_ALONE_CELLS * CELL_MM
"""How far beyond the filter's reach given footprints are judged."""
_SLOPE_CELLS = 3
"""Cells beyond a point that its height and slope depend on, with one to spare."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroundTask:
    """One block."""

    tiles: tuple[Tile, ...]
    """Its tiles with points."""
    seen: tuple[Tile, ...]
    """All tiles with points that its filter sees, its own among them."""
    grid: TileGrid
    """The lattice of the plan, whose halo is how far points matter to the split of a tile."""
    reach_mm: int
    """How far an elevation looks."""
    trusted: bool
    """The cells hold ground by the classes of the file."""
    scratch: Scratch
    """Cells in, terrain out."""
    outlines: tuple[Outline, ...] = ()
    """The given footprints around; empty where the ground is not found in the points alone."""
    memory_bytes: int = 0
    """Estimated peak memory of the process."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class TileGround:
    """The terrain of a tile as the driver knows it."""

    tile: Tile
    """The tile."""
    zones: bytes
    """Its terrain and which cells hold points, zone by zone: the bytes of a `ZoneSums`, with such cells for points."""
    roofs_alone: int
    """Cells of the core with points, in footprints around which nothing was seen."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ground:
    """The ground of a run; its terrain is in scratch."""

    cells: Mapping[Tile, TileCells]
    """What was found of the points of each tile."""
    tiles: Mapping[Tile, TileGround]
    """The terrain of each tile."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BlockCells:
    """The cells of a run, and the blocks over which the ground is found."""

    blocks: Mapping[tuple[int, int], Sequence[Tile]]
    """The tiles of each block, by its column and row."""
    seen: Mapping[tuple[int, int], tuple[Tile, ...]]
    """The tiles with points that the filter of each block sees."""
    drawn: Collection[Tile]
    """All tiles of the blocks."""
    cells: Mapping[Tile, TileCells]
    """What was found of the points of each tile."""
    reach_mm: int
    """How far an elevation looks."""
    classes: ClassesInUse
    """Which of the file's classes are believed."""
    outlines: Sequence[Outline]
    """The given footprints, where the ground is found in the points alone."""


def cells_of_blocks(
    context: RunContext,
    settings: RunSettings,
    ingested: Sequence[Ingested],
    footprints: GivenFootprints | None,
    only: Collection[Tile] | None = None,
    passes: tuple[Strip, ...] = (),
) -> BlockCells:
    """The cells of all tiles, or of some and of what their splits see; `passes` as for `find_all_cells`.

    Raises InputError if the points of a tile do not fit into a worker, now that they are counted.
    """
    grid, scene = context.plan.grid, settings.scene
    classes, _ = classes_in_use(ingested, trust=settings.general.classes == "trust")
    outlines = () if footprints is None or classes.ground else footprints.polygons
    reach_mm = math.ceil(scene.ground_support_m(classes) * MM)
    seen_mm = reach_mm + (_ROOFS_MM if outlines else 0)
    points = points_by_tile(ingested)
    split_lattice = split_grid(context.plan, settings, footprints=footprints is not None)
    check_windows(context.plan, split_lattice, points, context.executor.memory_limit_bytes)
    drawn = set(points)
    if only is not None:
        drawn &= {other for tile in only for other in grid.tiles_over(terrain_window(grid, tile))}
    blocks: dict[tuple[int, int], list[Tile]] = {}
    side = tiles_per_block(grid.size_mm)
    for tile in sorted(drawn):
        blocks.setdefault((tile.column // side, tile.row // side), []).append(tile)
    seen = {
        name: tuple(tile for tile in grid.tiles_over(_around(grid, tiles).grown(seen_mm)) if tile in points)
        for name, tiles in blocks.items()
    }
    wanted = {tile for tiles in seen.values() for tile in tiles}
    cells = find_all_cells(context, scene.outliers, ingested, classes, wanted, passes)
    return BlockCells(
        blocks=blocks, seen=seen, drawn=drawn, cells=cells, reach_mm=reach_mm, classes=classes, outlines=outlines
    )


def find_ground(context: RunContext, settings: RunSettings, found: BlockCells) -> Ground:
    """The ground of the blocks whose cells were found."""
    grid, scene = context.plan.grid, settings.scene
    cells, classes, reach_mm, seen = found.cells, found.classes, found.reach_mm, found.seen
    duplicates, outliers = (sum(getattr(c, name) for c in cells.values()) for name in ("duplicates", "outliers"))
    if duplicates:
        context.progress.warn("cells", f"{duplicates} duplicated points were dropped")
    if outliers:
        context.progress.warn("cells", f"{outliers} gross outliers were left out")
    alike = key_of(grid, scene.ground, classes.ground)
    tree = shapely.STRtree(found.outlines)
    tasks = {}
    for (column, row), tiles in found.blocks.items():
        around = seen[column, row]
        window = _around(grid, tiles).grown(reach_mm)
        wide = window.grown(_ROOFS_MM)
        edges_m = (edge / MM for edge in (wide.x0_mm, wide.y0_mm, wide.x1_mm, wide.y1_mm))
        outlines = tuple(found.outlines[k] for k in sorted(tree.query(shapely.box(*edges_m)).tolist()))
        key = key_of(alike, [tile.key for tile in tiles], digests_of(cells, around), outlines)
        tasks[Place(GROUND_FOLDER, f"x{column}_y{row}", key)] = GroundTask(
            tiles=tuple(tiles),
            seen=around,
            grid=grid,
            reach_mm=reach_mm,
            trusted=classes.ground,
            scratch=context.scratch,
            outlines=outlines,
            memory_bytes=ground_bytes(window, scene.ground),
        )
    clear_tiles(context.scratch, GROUND_FOLDER, tasks, {tile.key for tile in found.drawn})
    function = functools.partial(draw_ground, settings=scene.ground)
    files: Files[GroundTask, tuple[TileGround, ...]] = Files(reads=_read, leaves=_left, intact=is_intact)
    drawn = context.map_stored("ground", function, tasks, whole, files=files)
    alone = sum(one.roofs_alone for tiles in drawn.values() for one in tiles)
    if alone:
        context.progress.warn("ground", _ABOUT_ROOFS_ALONE.format(alone))
    return Ground(cells=cells, tiles={one.tile: one for tiles in drawn.values() for one in tiles})


def _read(task: GroundTask) -> list[str]:
    """The folders of scratch with the cells that a block sees."""
    return [f"{CELLS_FOLDER}/{tile.key}" for tile in task.seen]


def _left(task: GroundTask, _: Sequence[TileGround]) -> list[str]:
    """The folders of scratch with the terrain of a block."""
    return [f"{GROUND_FOLDER}/{tile.key}" for tile in task.tiles]


def is_intact(task: GroundTask, found: Sequence[TileGround], folder: str) -> bool:
    """Whether the terrain of a tile in a folder of scratch is as it was stored."""
    (zones,) = (one.zones for one in found if f"{GROUND_FOLDER}/{one.tile.key}" == folder)
    tile = Tile.from_key(folder.rpartition("/")[2])
    elevations, off_mm, corner = (task.scratch.array(folder, name) for name in ("terrain", "off", "corner"))
    column0, row0, columns, rows = lattice_of(task.grid.core(tile).grown(APRON_M * MM))
    is_in_place = corner.tolist() == [column0, row0] and elevations.shape == off_mm.shape == (rows, columns)
    return is_in_place and _zones(elevations, off_mm, task.grid).tobytes() == zones


def terrain_window(grid: TileGrid, tile: Tile) -> Window:
    """Where the split of a tile needs terrain."""
    return grid.window(tile).grown(_SLOPE_CELLS * CELL_MM)


def _around(grid: TileGrid, tiles: Sequence[Tile]) -> Window:
    """The cores of some tiles and their aprons, as one rectangle."""
    cores = [grid.core(tile) for tile in tiles]
    return Window(
        x0_mm=min(core.x0_mm for core in cores),
        y0_mm=min(core.y0_mm for core in cores),
        x1_mm=max(core.x1_mm for core in cores),
        y1_mm=max(core.y1_mm for core in cores),
    ).grown(APRON_M * MM)


def draw_ground(task: GroundTask, settings: GroundSettings) -> tuple[TileGround, ...]:
    """Find the ground of a block and store the terrain of its tiles.

    In scratch under `ground/<tile>/` are `terrain`, `off` and `corner`: the elevations of the core and an apron around
    it, how far the lowest points lie above them, and the column and row of the first cell. The apron lets a candidate
    at the data's edge see terrain whose own tile holds no point and so is never made. Where aprons overlap they agree.
    """
    task.scratch.check_cancelled()
    inside = _around(task.grid, task.tiles)
    wide = ROOFS_ALONE_CELLS if task.outlines else 0
    lowest, occupied, corner = _cells_in(task, inside.grown(task.reach_mm + wide * CELL_MM))
    column0, row0, columns, rows = lattice_of(inside)
    alone = np.zeros_like(occupied)
    if task.outlines:
        alone = extra("roofs_alone")(lowest, occupied, corner, task.outlines)
        lowest[alone] = NO_DATA
        inner = (slice(wide, -wide), slice(wide, -wide))
        lowest, occupied, alone = lowest[inner], occupied[inner], alone[inner]
        corner = (corner[0] + wide, corner[1] + wide)
    wanted = (
        slice(row0 - corner[1], row0 - corner[1] + rows),
        slice(column0 - corner[0], column0 - corner[0] + columns),
    )
    task.scratch.check_cancelled()
    terrain, _ = ground_on(lowest, corner, settings, trusted=task.trusted, wanted=wanted)
    return tuple(_stored(task, tile, (terrain, lowest, occupied, alone), corner) for tile in task.tiles)


def _cells_in(task: GroundTask, window: Window) -> tuple[Elevations, BoolArray, tuple[int, int]]:
    """Lowest points and occupied cells of a window, from those of its tiles, and its first column and row."""
    column0, row0, columns, rows = lattice_of(window)
    lowest = np.full((rows, columns), NO_DATA, np.int32)
    occupied = np.zeros((rows, columns), np.bool_)
    for tile in task.seen:
        c, r, wide, high = lattice_of(task.grid.core(tile))
        c, r = c - column0, r - row0
        left, right, low, top = max(c, 0), min(c + wide, columns), max(r, 0), min(r + high, rows)
        if left >= right or low >= top:
            continue
        ours, theirs = (slice(low, top), slice(left, right)), (slice(low - r, top - r), slice(left - c, right - c))
        name = f"{CELLS_FOLDER}/{tile.key}"
        # tiles share the cells across their border
        np.minimum(lowest[ours], task.scratch.array(name, "lowest", mapped=True)[theirs], out=lowest[ours])
        occupied[ours] |= task.scratch.array(name, "occupied", mapped=True)[theirs]
    return lowest, occupied, (column0, row0)


def _stored(
    task: GroundTask,
    tile: Tile,
    found: tuple[Elevations, Elevations, BoolArray, BoolArray],
    corner: tuple[int, int],
) -> TileGround:
    """Store the terrain of a tile, `found` of its block: terrain, lowest points, cells with points, roofs alone."""
    terrain, lowest, occupied, alone = found
    column0, row0, columns, rows = lattice_of(task.grid.core(tile).grown(APRON_M * MM))
    part = (slice(row0 - corner[1], row0 - corner[1] + rows), slice(column0 - corner[0], column0 - corner[0] + columns))
    elevations = np.ascontiguousarray(terrain[part])
    off_mm = distances_to_terrain(lowest[part], occupied[part], elevations)
    place = np.array([column0, row0], np.int64)
    task.scratch.put_arrays(f"{GROUND_FOLDER}/{tile.key}", {"terrain": elevations, "off": off_mm, "corner": place})
    core = task.grid.core(tile)
    # of the cells that tiles share, the south-western corner says whose they are
    own = tuple(
        slice(-(-low // CELL_MM) - first, -(-high // CELL_MM) - first)
        for low, high, first in ((core.y0_mm, core.y1_mm, corner[1]), (core.x0_mm, core.x1_mm, corner[0]))
    )
    return TileGround(
        tile=tile,
        zones=_zones(elevations, off_mm, task.grid).tobytes(),
        roofs_alone=int(np.count_nonzero(alone[own] & occupied[own])),
    )


def _zones(elevations: Elevations, off_mm: npt.NDArray[np.int16], grid: TileGrid) -> ZoneSums:
    """Cells that are known or hold points, and digest of these, by zone: (3, 3, 3) uint64, by column and row."""
    # the apron, a cell that the core's edge may cut, and what the splits of neighbours see: farther than later stages
    width = APRON_M + 1 + math.ceil((grid.halo_mm + _SLOPE_CELLS * CELL_MM) / CELL_MM)
    cuts = []
    for size in elevations.shape:
        low = min(width, size)
        cuts.append((0, low, max(size - width, low), size))
    zones = np.zeros((3, 3, 3), np.uint64)
    for row in range(3):
        for column in range(3):
            zone = (slice(*cuts[0][row : row + 2]), slice(*cuts[1][column : column + 2]))
            part, off = elevations[zone], off_mm[zone]
            digest = hashlib.blake2b(f"{part.shape}".encode() + part.tobytes() + off.tobytes(), digest_size=16)
            cells = np.count_nonzero((part != NO_DATA) | (off != NO_POINT))
            zones[column, row] = (cells, *np.frombuffer(digest.digest(), np.uint64))
    return zones


def terrain_of_window(ground: Ground, grid: TileGrid, tile: Tile) -> list[object]:
    """The terrain that the split of a tile and all later stages see, for their keys."""
    # neighbours count by zones where these lie apart, which some more metres make sure
    apart = dataclasses.replace(grid, halo_mm=grid.halo_mm + 2 * _SLOPE_CELLS * CELL_MM)
    seen = {
        other: zone_sums_of(ground.tiles[other].zones)
        for other in grid.tiles_over(terrain_window(grid, tile))
        if other in ground.tiles
    }
    return content_of_window(seen, apart, terrain_window(grid, tile), tile)
