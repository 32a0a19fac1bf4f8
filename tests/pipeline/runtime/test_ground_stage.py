"""Cells and ground: blocks give the terrain of one window, whatever the tiles, the files and their order."""

import dataclasses
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from whole_scene import seen_m, terrain_of

from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages import ground_stage as ground
from pipeline.runtime.stages.cells_stage import CellsTask, TileCells, find_cells
from pipeline.runtime.stages.ground_stage import GroundTask, TileGround, draw_ground, terrain_of_window, terrain_window
from pipeline.runtime.stages.window_points import PointState, load_window, surroundings_of
from pipeline.scene import WindowPoints
from pipeline.terrain.lattice import NO_DATA
from pipeline.terrain.terrain_settings import APRON_M, ClassesInUse, GroundSettings, OutlierSettings, SceneSettings
from pipeline.tiling import MM, Tile, TileGrid, Window

SIDE_M = 130
MORPHOLOGICAL = GroundSettings(
    max_window_m=4,
    trend_m=4,
    widest_m=10,
    regrowth_passes=1,
    regrowth_m=1,
    rejoin_passes=1,
    rejoin_m=2,
    bridge_m=6,
    embankment_m2=0,
)
HIERARCHICAL = GroundSettings(
    filter="hierarchical", seed_cell_m=8, level_ratio=8, passes=1, min_reach_m=3, bridge_m=5, clump_m=1
)
"""Both look less far than the scene is wide."""
SETTINGS = SceneSettings(outliers=OutlierSettings(cube_m=2.0, min_neighbours=3), ground=MORPHOLOGICAL)
CLASSES = ClassesInUse()


def hilly(seed: int = 3) -> npt.NDArray[np.void]:
    """Hilly points with houses, some points twice, and birds above."""
    random = np.random.default_rng(seed)
    n = 4 * SIDE_M * SIDE_M
    points = np.zeros(n, POINT)
    points["x"], points["y"] = random.integers(0, SIDE_M * MM, (2, n))
    x, y = points["x"] / MM, points["y"] / MM
    z = 3.0 * np.sin(x / 25.0) * np.cos(y / 31.0) + 0.02 * random.standard_normal(n)
    z[(x % 40 < 11) & (y % 33 < 8)] += 6.0
    points["z"] = np.rint(z * MM)
    points["z"][:25] += 90_000
    points["return_count"] = 1 + (random.random(n) < 0.1)
    points["return_number"] = 1
    points["gps_time"] = random.uniform(0.0, 1.0, n)
    points["source"] = random.integers(1, 3, n)
    return np.concatenate((points, points[::50]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """The outcome of both stages."""

    scratch: Scratch
    grid: TileGrid
    cells: dict[Tile, TileCells]
    tiles: dict[Tile, TileGround]


def found_in(
    folder: Path,
    points: npt.NDArray[np.void],
    grid: TileGrid,
    block: int,
    *,
    files: int = 1,
    backwards: bool = False,
    settings: SceneSettings = SETTINGS,
) -> Found:
    """Run both stages over points in some files."""
    reach_mm = int(np.ceil(settings.ground_support_m(CLASSES) * MM))
    scratch = Scratch(str(folder))
    scratch.create()
    columns, rows = grid.columns_rows(points["x"], points["y"])
    tiles = sorted({Tile(c, r) for c, r in zip(columns.tolist(), rows.tolist(), strict=True)})
    for tile in tiles:
        own = points[(columns == tile.column) & (rows == tile.row)]
        for number, part in enumerate(np.array_split(own[::-1] if backwards else own, files)):
            part.tofile(scratch.path("points", tile.key, f"{number}.bin"))
    cells = {}
    for tile in tiles:
        task = CellsTask(tile=tile, grid=grid, classes=CLASSES, scratch=scratch)
        cells[tile] = find_cells(task, settings.outliers)
    blocks: dict[tuple[int, int], list[Tile]] = {}
    for tile in tiles:
        blocks.setdefault((tile.column // block, tile.row // block), []).append(tile)
    drawn = {}
    for own_tiles in blocks.values():
        seen = {
            other
            for tile in own_tiles
            for other in grid.tiles_over(grid.core(tile).grown(APRON_M * MM + reach_mm))
            if other in cells
        }
        task_of_block = GroundTask(
            tiles=tuple(own_tiles),
            seen=tuple(sorted(seen)),
            grid=grid,
            reach_mm=reach_mm,
            trusted=False,
            scratch=scratch,
        )
        drawn |= {one.tile: one for one in draw_ground(task_of_block, settings.ground)}
    return Found(scratch=scratch, grid=grid, cells=cells, tiles=drawn)


GRIDS = [
    (TileGrid(size_mm=50_000, halo_mm=10_000), 1),
    (TileGrid(size_mm=31_700, halo_mm=10_000, origin_x_mm=-11_111, origin_y_mm=7_777), 2),
    (TileGrid(size_mm=400_000, halo_mm=10_000, origin_x_mm=-90_000, origin_y_mm=-90_000), 1),
]


@pytest.mark.parametrize("filter_settings", [MORPHOLOGICAL, HIERARCHICAL], ids=lambda one: one.filter)
@pytest.mark.parametrize(("grid", "block"), GRIDS)
def test_the_terrain_is_that_of_one_window(
    grid: TileGrid, block: int, filter_settings: GroundSettings, tmp_path: Path
) -> None:
    points, settings = hilly(), dataclasses.replace(SETTINGS, ground=filter_settings)
    found = found_in(tmp_path, points, grid, block, settings=settings)
    unique = np.unique(points)
    window = Window(x0_mm=0, y0_mm=0, x1_mm=SIDE_M * MM, y1_mm=SIDE_M * MM)
    whole = WindowPoints(
        x_mm=unique["x"].astype(np.int64),
        y_mm=unique["y"].astype(np.int64),
        z_mm=unique["z"].astype(np.int64),
        return_number=unique["return_number"],
        return_count=unique["return_count"],
        classification=unique["classification"],
    )
    assert seen_m(settings, CLASSES) < SIDE_M
    expected, kept = terrain_of(whole, window.grown(50 * MM), settings, CLASSES)
    around = surroundings_of(found.scratch, grid, window)
    inner = (slice(50, 50 + SIDE_M), slice(50, 50 + SIDE_M))
    np.testing.assert_array_equal(around.elevation_mm, expected.elevation_mm[inner])
    assert (around.elevation_mm != NO_DATA).mean() > 0.9
    occupied = np.zeros((SIDE_M, SIDE_M), np.bool_)
    occupied[whole.y_mm[kept] // MM, whole.x_mm[kept] // MM] = True
    np.testing.assert_array_equal(around.occupied, occupied)
    assert sum(cells.duplicates for cells in found.cells.values()) == len(points) - len(unique)
    assert sum(cells.outliers for cells in found.cells.values()) == (~kept).sum() == 25


def test_neither_files_nor_the_order_of_points_matter(tmp_path: Path) -> None:
    points, (grid, block) = hilly(), GRIDS[1]
    one = found_in(tmp_path / "one", points, grid, block)
    other = found_in(tmp_path / "other", points, grid, block, files=3, backwards=True)
    # which of equal points stays depends on the order, what is found does not
    assert [dataclasses.replace(cells, states=0) for cells in other.cells.values()] == [
        dataclasses.replace(cells, states=0) for cells in one.cells.values()
    ]
    assert other.tiles == one.tiles
    for tile in one.cells:
        here, there = load_window(one.scratch, grid, tile), load_window(other.scratch, grid, tile)
        places = []
        for loaded in (here, there):
            xyz = np.column_stack((loaded.points.x_mm, loaded.points.y_mm, loaded.points.z_mm, loaded.kept))
            places.append(xyz[np.lexsort(xyz.T)])
            assert (loaded.core["x"] == loaded.points.x_mm[: len(loaded.core)]).all()
        np.testing.assert_array_equal(places[0], places[1])


def test_a_window_has_every_point_once_and_knows_the_outliers(tmp_path: Path) -> None:
    points, (grid, block) = hilly(), GRIDS[0]
    found = found_in(tmp_path, points, grid, block, files=2)
    tile = Tile(1, 1)
    loaded, unique, window = load_window(found.scratch, grid, tile), np.unique(points), grid.window(tile)
    assert len(loaded.points) == window.contains(unique["x"], unique["y"]).sum()
    assert len(loaded.core) == grid.core(tile).contains(unique["x"], unique["y"]).sum()
    np.testing.assert_array_equal(loaded.kept, loaded.points.z_mm < 50_000)
    states = found.scratch.array(f"cells/{tile.key}", "states")
    assert set(np.unique(states).tolist()) >= {PointState.DUPLICATE, PointState.KEPT}


def test_only_changed_terrain_within_reach_names_another_split(tmp_path: Path) -> None:
    """A pit in the middle of a tile concerns its own split; one near its border that of the neighbour, too."""
    grid = TileGrid(size_mm=65_000, halo_mm=10_000)
    points = hilly()
    before = found_in(tmp_path / "before", points, grid, 1)

    def split_again(x_m: float, y_m: float) -> set[Tile]:
        near = np.hypot(points["x"] / MM - x_m, points["y"] / MM - y_m) < 4.0
        raised = points.copy()
        raised["z"][near] -= 300
        after = found_in(tmp_path / f"{x_m:g}", raised, grid, 1)
        seen = [ground.Ground(cells=found.cells, tiles=found.tiles) for found in (before, after)]
        return {
            tile
            for tile in before.tiles
            if repr(terrain_of_window(seen[0], grid, tile)) != repr(terrain_of_window(seen[1], grid, tile))
        }

    assert split_again(30.0, 30.0) == {Tile(0, 0)}
    assert split_again(61.0, 30.0) == {Tile(0, 0), Tile(1, 0)}
    window = terrain_window(grid, Tile(0, 0))
    assert window.x1_mm > grid.window(Tile(0, 0)).x1_mm
