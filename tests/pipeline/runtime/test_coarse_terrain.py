"""The coarse terrain beside the points: each node once, whatever the tiles."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.extras.octree.coarse_terrain import MOST_NODES, terrain_document, terrain_part, terrain_spacing
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.window_points import NO_POINT
from pipeline.terrain.lattice import NO_DATA
from pipeline.tiling import MM, Tile, TileGrid, Window

EAST, NORTH = 84_000, 447_000
APRON = 3
BOUNDS = Window(
    x0_mm=EAST * MM + 400, y0_mm=NORTH * MM + 600, x1_mm=(EAST + 57) * MM + 400, y1_mm=(NORTH + 58) * MM + 600
)
"""Those of the points."""


def hill(column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Elevation in mm of the cells of a made-up hill, without data in one corner."""
    height = 10_000 + 137 * (column - EAST) - 61 * (row - NORTH)
    return np.where((column < EAST + 5) & (row < NORTH + 7), NO_DATA, height).astype(np.int32)


def document(folder: Path, grid: TileGrid, spacing: int) -> bytes:
    """The file of 60 by 60 m of the hill, which begin 10 m before a multiple of the tiles' sides."""
    scratch = Scratch(str(folder))
    scratch.create()
    first = grid.tile_of(EAST * MM, NORTH * MM)
    last = grid.tile_of((EAST + 59) * MM, (NORTH + 59) * MM)
    tiles = [Tile(c, r) for c in range(first.column, last.column + 1) for r in range(first.row, last.row + 1)]
    for tile in tiles:
        core = grid.core(tile)
        column0, row0 = core.x0_mm // MM - APRON, core.y0_mm // MM - APRON
        side = grid.size_mm // MM + 2 * APRON + 1
        rows, columns = np.mgrid[row0 : row0 + side, column0 : column0 + side]
        inside = (columns >= EAST) & (columns < EAST + 60) & (rows >= NORTH) & (rows < NORTH + 60)
        arrays = {
            "terrain": np.where(inside, hill(columns, rows), NO_DATA).astype(np.int32),
            "off": np.where(inside, 0, NO_POINT).astype(np.int16),
            "corner": np.array([column0, row0]),
        }
        scratch.put_arrays(f"ground/{tile.key}", arrays)
    parts = [terrain_part(scratch, grid, tile, spacing) for tile in tiles]
    return terrain_document(parts, spacing, BOUNDS)


@pytest.mark.parametrize("spacing", [1, 2, 4])
def test_every_node_is_there_once_with_the_elevation_of_its_cell(tmp_path: Path, spacing: int) -> None:
    found = json.loads(document(tmp_path, TileGrid(size_mm=20_000, halo_mm=0), spacing))
    (west, south), step = found["origin_m"], found["spacing_m"]
    rows, columns = len(found["elevations"]), {len(row) for row in found["elevations"]}
    assert step == spacing
    known = 0
    for i, row in enumerate(found["elevations"]):
        for k, value in enumerate(row):
            column, line = int(west + k * step), int(south + i * step)
            is_inside = EAST <= column < EAST + 60 and NORTH <= line < NORTH + 60
            expected = int(hill(np.array(column), np.array(line))) if is_inside else NO_DATA
            assert value == (None if expected == NO_DATA else round(expected / 10)), (column, line)
            known += value is not None
    assert known > 2500 / spacing**2
    # the bounds lie between the outer nodes, within one spacing of them
    assert len(columns) == 1
    last = (west + (max(columns) - 1) * step, south + (rows - 1) * step)
    low, high = (BOUNDS.x0_mm, BOUNDS.y0_mm), (BOUNDS.x1_mm, BOUNDS.y1_mm)
    for axis, first in enumerate((west, south)):
        assert 0.0 <= low[axis] / MM - first < step
        assert 0.0 <= last[axis] - high[axis] / MM < step


@pytest.mark.parametrize(
    "grid", [TileGrid(size_mm=30_000, halo_mm=0), TileGrid(size_mm=7_300, halo_mm=0, origin_x_mm=450)]
)
def test_the_file_does_not_depend_on_the_tiles(tmp_path: Path, grid: TileGrid) -> None:
    usual = TileGrid(size_mm=20_000, halo_mm=0)
    assert document(tmp_path / "one", grid, 2) == document(tmp_path / "other", usual, 2)


def test_a_city_has_no_more_nodes_than_a_viewer_needs() -> None:
    grid = TileGrid(size_mm=250_000, halo_mm=0)
    for tiles in (1, 2, 3, 8, 40, 400):
        spacing = terrain_spacing([Tile(0, 0), Tile(tiles - 1, 0)], grid)
        nodes = 250 * tiles / spacing
        assert nodes <= MOST_NODES
        assert spacing == 1 or nodes > MOST_NODES / 2
