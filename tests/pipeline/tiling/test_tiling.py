"""The lattice: every point has one owner, whatever the sign of its coordinates."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.tiling import Tile, TileGrid, Window

coordinates = st.integers(-3_000_000_000, 3_000_000_000)
origins = st.integers(-1_000_000, 1_000_000)
sizes = st.integers(1000, 500_000)
small_grids = st.builds(
    TileGrid,
    size_mm=st.integers(1000, 9000),
    halo_mm=st.integers(0, 20_000),
    origin_x_mm=st.integers(-20_000, 20_000),
    origin_y_mm=st.integers(-20_000, 20_000),
)


def grid_of(size_mm: int, origin_x_mm: int = 0, origin_y_mm: int = 0, halo_mm: int = 0) -> TileGrid:
    return TileGrid(size_mm=size_mm, halo_mm=halo_mm, origin_x_mm=origin_x_mm, origin_y_mm=origin_y_mm)


def holds(window: Window, x_mm: int, y_mm: int) -> bool:
    return bool(window.contains(np.array([x_mm]), np.array([y_mm]))[0])


@given(x=coordinates, y=coordinates, size=sizes, origin_x=origins, origin_y=origins)
def test_the_owner_holds_its_point_and_none_of_its_eight_neighbours_does(
    x: int, y: int, size: int, origin_x: int, origin_y: int
) -> None:
    grid = grid_of(size, origin_x, origin_y)
    owner = grid.tile_of(x, y)
    around = [Tile(owner.column + dc, owner.row + dr) for dc in (-1, 0, 1) for dr in (-1, 0, 1)]
    assert [tile for tile in around if holds(grid.core(tile), x, y)] == [owner]


@pytest.mark.parametrize("column", [-3, -1, 0, 1, 447])
@pytest.mark.parametrize("row", [-2, 0, 5])
def test_a_corner_belongs_to_the_tile_that_begins_there(column: int, row: int) -> None:
    grid = grid_of(7000, 123, -456)
    core = grid.core(Tile(column, row))
    assert grid.tile_of(core.x0_mm, core.y0_mm) == Tile(column, row)
    assert grid.tile_of(core.x0_mm - 1, core.y0_mm) == Tile(column - 1, row)
    assert grid.tile_of(core.x1_mm, core.y1_mm) == Tile(column + 1, row + 1)
    assert grid.tile_of(core.x1_mm - 1, core.y1_mm - 1) == Tile(column, row)


@given(grid=small_grids, points=st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=20))
def test_many_points_have_the_owners_that_each_has_alone(grid: TileGrid, points: list[tuple[int, int]]) -> None:
    x, y = np.array(points, np.int64).T
    columns, rows = grid.columns_rows(x, y)
    assert columns.dtype == rows.dtype == np.int64
    assert [Tile(c, r) for c, r in zip(columns.tolist(), rows.tolist(), strict=True)] == [
        grid.tile_of(px, py) for px, py in points
    ]


@given(column=st.integers(-10_000, 10_000), row=st.integers(-10_000, 10_000))
def test_a_key_names_its_tile(column: int, row: int) -> None:
    tile = Tile(column, row)
    assert Tile.from_key(tile.key) == tile
    assert not tile.key.lstrip("-").isdigit()


@pytest.mark.parametrize("key", ["", "85_447", "x85_y", "x85y447", "x1.5_y2", "x85_y447/", " x85_y447", "x--1_y2"])
def test_an_invalid_key_is_refused_by_name(key: str) -> None:
    with pytest.raises(ValueError, match="not a tile key: use one such as x85_y447"):
        Tile.from_key(key)


@given(
    grid=small_grids,
    x0=st.integers(-30_000, 30_000),
    y0=st.integers(-30_000, 30_000),
    width=st.integers(1, 40_000),
    depth=st.integers(1, 40_000),
)
def test_tiles_over_a_window_are_exactly_those_whose_cores_meet_it(
    grid: TileGrid, x0: int, y0: int, width: int, depth: int
) -> None:
    window = Window(x0_mm=x0, y0_mm=y0, x1_mm=x0 + width, y1_mm=y0 + depth)
    found = list(grid.tiles_over(window))
    assert found == sorted(set(found))
    meeting = 0
    for tile in found:
        core = grid.core(tile)
        overlap_x = min(core.x1_mm, window.x1_mm) - max(core.x0_mm, window.x0_mm)
        overlap_y = min(core.y1_mm, window.y1_mm) - max(core.y0_mm, window.y0_mm)
        assert overlap_x > 0
        assert overlap_y > 0
        meeting += overlap_x * overlap_y
    # the cores do not overlap: their shares of the window fill it, so no tile is missing
    assert meeting == width * depth


@given(grid=small_grids, column=st.integers(-50, 50), row=st.integers(-50, 50))
def test_a_window_is_the_core_and_the_halo_on_all_sides(grid: TileGrid, column: int, row: int) -> None:
    core, window = grid.core(Tile(column, row)), grid.window(Tile(column, row))
    assert (core.x1_mm - core.x0_mm, core.y1_mm - core.y0_mm) == (grid.size_mm, grid.size_mm)
    assert window == Window(
        x0_mm=core.x0_mm - grid.halo_mm,
        y0_mm=core.y0_mm - grid.halo_mm,
        x1_mm=core.x1_mm + grid.halo_mm,
        y1_mm=core.y1_mm + grid.halo_mm,
    )
    assert window == core.grown(grid.halo_mm)
    assert Tile(column, row) in set(grid.tiles_over(window))


@given(
    grid=small_grids,
    dx=st.integers(-5, 5),
    dy=st.integers(-5, 5),
    x=st.integers(-(10**6), 10**6),
    y=st.integers(0, 10**6),
)
def test_a_shift_by_whole_tiles_shifts_the_owner(grid: TileGrid, dx: int, dy: int, x: int, y: int) -> None:
    owner = grid.tile_of(x, y)
    shifted = grid.tile_of(x + dx * grid.size_mm, y + dy * grid.size_mm)
    assert shifted == Tile(owner.column + dx, owner.row + dy)


def test_a_window_is_half_open() -> None:
    window = Window(x0_mm=-5, y0_mm=10, x1_mm=5, y1_mm=20)
    x, y = np.array([-5, -6, 4, 5, 0, 0, 0]), np.array([10, 10, 19, 19, 20, 9, 15])
    assert window.contains(x, y).tolist() == [True, False, True, False, False, False, True]


@pytest.mark.parametrize("size_mm", [999, 1, 0, -5000])
def test_a_tile_below_one_metre_is_refused_with_its_size(size_mm: int) -> None:
    with pytest.raises(SettingsError, match=rf"tile_size_m is {size_mm / 1000:g}: use at least 1 m"):
        TileGrid(size_mm=size_mm, halo_mm=0)


def test_a_tile_of_one_metre_is_allowed() -> None:
    assert TileGrid(size_mm=1000, halo_mm=0).tile_of(-1, 999) == Tile(-1, 0)
