"""Rasters of a run: terrain, surface and height above the terrain, tile by tile, and one mosaic of each."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.extras.classify.elevation_rasters import FILL_M, closed, columns_of, filled, highest_in_cells, terrain_at
from pipeline.extras.classify.point_classes import PIT_REACH_MM, noise_of
from pipeline.extras.classify.raster_files import BLOCK, Cells, RasterLattice, write_cog
from pipeline.io import LocalStorage, SpatialReference
from pipeline.io.crs_units import unit_name
from pipeline.model import BoolArray
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.window_points import Surroundings, load_window, surroundings_of
from pipeline.scene import WindowPoints
from pipeline.terrain.ground import slopes_of
from pipeline.terrain.lattice import CELL_MM, height_above
from pipeline.tiling import MM, Tile, TileGrid

FOLDER = "rasters"
RASTERS = {
    "terrain": "elevation of the terrain (DTM)",
    "surface": "elevation of the surface (DSM)",
    "height": "height of the surface above the terrain (nDSM)",
}
"""What is written, as `<name>.tif`."""


def default_cell(unit_m: float) -> float:
    """Side of a raster cell where none is asked for: half a metre, or the next whole unit of the CRS above it.

    >>> default_cell(1.0), default_cell(0.3048)
    (0.5, 2.0)
    """
    return 0.5 if unit_m >= 0.5 else float(math.ceil(0.5 / unit_m))


@dataclasses.dataclass(frozen=True, kw_only=True)
class RasterTask:
    """One tile."""

    tile: Tile
    """The tile; it need not hold points."""
    grid: TileGrid
    """The lattice of tiles."""
    lattice: RasterLattice
    """That of the raster."""
    scratch: Scratch
    """Points and terrain in, cells out."""
    vertical_unit_m: float
    """Metres a unit of the values."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MosaicTask:
    """One raster of all tiles."""

    name: str
    """One of `RASTERS`."""
    tiles: tuple[Tile, ...]
    """All that were drawn."""
    lattice: RasterLattice
    """Where the cells are."""
    scratch: Scratch
    """The tiles' cells."""
    out: str
    """Folder of the outcome."""
    reference: SpatialReference
    """CRS and units."""


def with_neighbours(tiles: set[Tile]) -> list[Tile]:
    """The tiles and those around them: a gap that is closed may lie in a tile without points."""
    return sorted({Tile(t.column + i, t.row + j) for t in tiles for i in (-1, 0, 1) for j in (-1, 0, 1)})


def draw_tile(task: RasterTask) -> Tile:
    """Draw terrain, surface and height in the cells whose centres a tile owns, in units of the CRS; returns the tile.

    The cells are in scratch under `rasters/<tile>/<block>/`.
    """
    task.scratch.check_cancelled()
    core, lattice = task.grid.core(task.tile), task.lattice
    reach = math.ceil(FILL_M * MM / lattice.side_mm)
    see_mm = math.ceil((reach + 2) * lattice.side_mm) + 2 * FILL_M * MM + 2 * CELL_MM
    halo_mm = see_mm + PIT_REACH_MM
    loaded = load_window(task.scratch, dataclasses.replace(task.grid, halo_mm=halo_mm), task.tile)
    points = loaded.points
    around = surroundings_of(task.scratch, task.grid, core.grown(halo_mm))
    x, y, z = points.x_mm, points.y_mm, points.z_mm
    slope = slopes_of(around.elevation_mm)
    noise = noise_of(
        x,
        y,
        height_above(x, y, z, around.elevation_mm, around.column0, around.row0),
        -height_above(x, y, np.zeros_like(z), slope, around.column0, around.row0),
        ~loaded.kept,
    )
    shown = points.take(np.flatnonzero(~noise))
    filled_cells = closed(around.occupied, FILL_M)
    left, right = max(lattice.first(core.x0_mm), lattice.column0), lattice.first(core.x1_mm)
    low, high = max(lattice.first(core.y0_mm), lattice.row0), lattice.first(core.y1_mm)
    right, high = min(right, lattice.column0 + lattice.columns), min(high, lattice.row0 + lattice.rows)
    for column0 in range(left, right, BLOCK):
        for row0 in range(low, high, BLOCK):
            task.scratch.check_cancelled()
            shape = min(BLOCK, high - row0), min(BLOCK, right - column0)
            arrays = _draw_block(task, shown, around, filled_cells, (column0, row0), shape)
            task.scratch.put_arrays(f"{FOLDER}/{task.tile.key}/{column0}_{row0}", arrays)
    return task.tile


def _draw_block(
    task: RasterTask,
    points: WindowPoints,
    around: Surroundings,
    known_cells: BoolArray,
    corner: tuple[int, int],
    shape: tuple[int, int],
) -> dict[str, npt.NDArray[Any]]:
    """Terrain, surface and height of a block of cells, southernmost row first, and its corner."""
    side = task.lattice.side_mm
    reach = math.ceil(FILL_M * MM / side)
    margin = reach + 1
    (column0, row0), (rows, columns) = corner, shape
    x = np.rint((np.arange(column0, column0 + columns) + 0.5) * side).astype(np.int64)
    y = np.rint((np.arange(row0, row0 + rows) + 0.5) * side).astype(np.int64)
    terrain = terrain_at(x, y, around.elevation_mm, around.column0, around.row0)
    known = known_cells[np.ix_(y // CELL_MM - around.row0, x // CELL_MM - around.column0)]
    tops = highest_in_cells(
        columns_of(points.x_mm, side) - column0 + margin,
        columns_of(points.y_mm, side) - row0 + margin,
        points.z_mm,
        (rows + 2 * margin, columns + 2 * margin),
    )
    surface = filled(tops, np.pad(known, margin), reach)[margin : margin + rows, margin : margin + columns]
    unit_mm = task.vertical_unit_m * MM
    return {
        "terrain": (np.where(known, terrain, np.nan) / unit_mm).astype(np.float32),
        "surface": (np.where(known, surface, np.nan) / unit_mm).astype(np.float32),
        "height": (np.where(known, surface - terrain, np.nan) / unit_mm).astype(np.float32),
        "corner": np.array([column0, row0], np.int64),
    }


def write_mosaic(task: MosaicTask) -> str:
    """Write one raster of all tiles; its path."""
    reference = task.reference
    crs = reference.crs
    if task.name == "height" and crs is not None:
        crs = reference.horizontal_crs  # heights above ground are in no vertical datum
    storage = LocalStorage(root=Path(task.out))
    key = f"{task.name}.tif"
    with storage.putting(key) as temporary:
        write_cog(
            temporary,
            task.scratch.path(FOLDER, f"{task.name}.tif"),
            task.lattice,
            _windows(task),
            crs_wkt=None if crs is None else crs.to_wkt("WKT2_2019"),
            description=RASTERS[task.name],
            unit=unit_name(reference.vertical_unit_m),
        )
    return str(storage.path(key))


def _windows(task: MosaicTask) -> Iterator[tuple[int, int, Cells]]:
    """All blocks, northernmost first."""
    blocks = [
        (tuple(task.scratch.array(name, "corner").tolist()), name)
        for tile in task.tiles
        for name in _blocks(task.scratch, tile)
    ]
    for (column, row), name in sorted(blocks, key=lambda entry: (-entry[0][1], entry[0][0])):
        task.scratch.check_cancelled()
        yield column, row, task.scratch.array(name, task.name, mapped=True)


def _blocks(scratch: Scratch, tile: Tile) -> list[str]:
    """The names of a tile's blocks."""
    name = f"{FOLDER}/{tile.key}"
    return [f"{name}/{path.name}" for path in Path(scratch.root, name).glob("*_*")]
