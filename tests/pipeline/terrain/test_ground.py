"""The ground stage: pits, local planes, heights, ground points; nothing depends on where the window ends."""

import dataclasses
import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import map_coordinates

from pipeline.terrain import ground
from pipeline.terrain.ground import Terrain, ground_of, ground_on, ground_points, slopes_of
from pipeline.terrain.lattice import CELL_MM, NO_DATA, height_above, lowest_per_cell
from pipeline.terrain.pits import without_pits
from pipeline.terrain.reach import CLUMP_CELLS, GAP_CELLS, PIT_CELLS
from pipeline.terrain.terrain_settings import GroundSettings

Grid = npt.NDArray[np.int32]
Points = npt.NDArray[np.int64]

SMALL = GroundSettings(
    max_window_m=3,
    trend_m=4,
    widest_m=12,
    regrowth_passes=1,
    regrowth_m=1,
    rejoin_passes=1,
    rejoin_m=2,
    bridge_m=6,
    embankment_m2=0,
)
"""Looks 57 m far."""

FAR = dataclasses.replace(SMALL, bridge_m=20, rejoin_passes=4)
"""Draws terrain from farther away than ground that rejoined by planes carries it."""

BANKS = dataclasses.replace(
    SMALL, max_window_m=9, residual_window_m=9, widest_m=0, rejoin_passes=0, berm_passes=1, embankment_m2=200
)
"""Looks farthest where it judges embankments."""

elevations = st.integers(-3000, 3000)
grids = arrays(np.int32, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=elevations)


def with_gaps(grid: Grid, seed: int, share: float = 0.4) -> Grid:
    holes = np.random.default_rng(seed).random(grid.shape) < share
    return np.where(holes, NO_DATA, grid).astype(np.int32)


def one_point_a_cell(columns: int, rows: int, z_mm: npt.ArrayLike, column0: int = 0, row0: int = 0) -> Points:
    """A point at the centre of every cell, `z_mm` by row and column."""
    c, r = np.meshgrid(np.arange(columns) + column0, np.arange(rows) + row0)
    z = np.broadcast_to(np.asarray(z_mm, np.int64), (rows, columns))
    return np.column_stack((c.ravel() * CELL_MM + 500, r.ravel() * CELL_MM + 500, z.ravel())).astype(np.int64)


def terrain_under(
    points: Points,
    window: tuple[int, int, int, int],
    filter_settings: GroundSettings | None = None,
    *,
    trusted: bool = False,
) -> Terrain:
    x, y, z = (np.ascontiguousarray(points[:, k]) for k in range(3))
    usable = np.ones(len(points), np.bool_)
    return ground_of(x, y, z, usable, window, filter_settings or GroundSettings(), trusted=trusted)


def wild_points(random: np.random.Generator, columns: int, rows: int, *, per_cell: float = 1.2) -> Points:
    """Rolling terrain with houses, gaps and a few strays below, at random positions."""
    n = round(columns * rows * per_cell)
    x, y = random.integers(0, columns * 1000, n), random.integers(0, rows * 1000, n)
    z = 2000 * np.sin(x / 17_000) + 0.1 * y + random.normal(0, 30, n)
    house = (x // 9000 + 2 * (y // 7000)) % 5 == 0
    z = z + np.where(house, 6000, 0)
    strays = random.random(n) < 0.003
    z = np.where(strays, z - 9000, z)
    away = (x // 5000) % 6 + (y // 4000) % 7 > 1
    return np.column_stack((x, y, np.rint(z)))[away].astype(np.int64)


# -- lowest points and pits --------------------------------------------------------------------------------------------


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(0, 80))
def test_the_lowest_used_point_of_a_cell_is_kept(seed: int, n: int) -> None:
    random = np.random.default_rng(seed)
    x, y, z = random.integers(-4000, 4000, (3, n))
    used = random.random(n) < 0.7
    lowest = lowest_per_cell(x, y, z, used, -3, -2, 6, 5)
    expected = np.full((5, 6), NO_DATA, np.int64)
    for px, py, pz, wanted in zip(x.tolist(), y.tolist(), z.tolist(), used.tolist(), strict=True):
        c, r = px // 1000 + 3, py // 1000 + 2
        if wanted and 0 <= c < 6 and 0 <= r < 5:
            expected[r, c] = min(expected[r, c], pz)
    np.testing.assert_array_equal(lowest, expected)


@pytest.mark.parametrize("cells", [[(10, 10)], [(10, 10), (10, 11)], [(10, 10), (9, 11), (12, 10)]])
def test_a_pit_of_up_to_three_cells_is_cleared(cells: list[tuple[int, int]]) -> None:
    z = np.full((20, 20), 5000)
    for r, c in cells:
        z[r, c] = 2000
    terrain = terrain_under(one_point_a_cell(20, 20, z), (0, 0, 20, 20))
    assert not any(terrain.measured[r, c] for r, c in cells)
    assert terrain.measured.sum() == 400 - len(cells)
    assert (terrain.elevation_mm == 5000).all()


def test_a_ditch_of_a_whole_row_is_no_pit() -> None:
    z = np.full((20, 20), 5000)
    z[10, :] = 2000
    cleaned = without_pits(z.astype(np.int32), 1000)
    # at the data's edge the ditch has but two neighbours of its own depth: there it looks like a pit
    np.testing.assert_array_equal(cleaned[:, 1:-1], z[:, 1:-1])


@settings(deadline=None)
@given(grid=grids, seed=st.integers(0, 100))
def test_pits_agree_with_a_plain_loop(grid: Grid, seed: int) -> None:
    lowest = with_gaps(grid, seed)
    expected = lowest.copy()
    for r, c in np.argwhere(lowest != NO_DATA):
        block = lowest[max(r - 2, 0) : r + 3, max(c - 2, 0) : c + 3].astype(np.int64)
        around = np.sort(block[block != NO_DATA])
        others = np.delete(around, np.searchsorted(around, lowest[r, c]))
        if len(others) > 2 and (others - lowest[r, c] <= 1000).sum() <= 2:
            expected[r, c] = NO_DATA
    np.testing.assert_array_equal(without_pits(lowest, 1000), expected)


# -- terrain -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(12, 9), (30, 24), (40, 40)])
def test_the_terrain_under_a_block_on_flat_ground_is_the_ground(size: tuple[int, int]) -> None:
    random = np.random.default_rng(5)
    width, depth = size
    z = 3200 + random.integers(-20, 21, (100, 100))
    z[30 : 30 + depth, 30 : 30 + width] += 8000
    terrain = terrain_under(one_point_a_cell(100, 100, z), (0, 0, 100, 100))
    assert not terrain.measured[30 : 30 + depth, 30 : 30 + width].any()
    assert terrain.measured.sum() == 100 * 100 - width * depth
    assert np.abs(terrain.elevation_mm - 3200).max() <= 50


@pytest.mark.parametrize("aspect_deg", [0.0, 90.0, 180.0, 270.0])
def test_a_plane_slope_of_15_degrees_survives(aspect_deg: float) -> None:
    fall = math.tan(math.radians(15.0))
    c, r = np.meshgrid(np.arange(80) + 0.5, np.arange(80) + 0.5)
    along = c * math.cos(math.radians(aspect_deg)) + r * math.sin(math.radians(aspect_deg))
    z = np.rint(1000 * fall * along).astype(np.int64)
    terrain = terrain_under(one_point_a_cell(80, 80, z), (0, 0, 80, 80))
    assert terrain.measured.all()
    assert np.abs(terrain.elevation_mm - z).max() <= 2


def test_a_house_on_a_slope_of_10_degrees_is_cut_off_and_the_slope_is_drawn_under_it() -> None:
    c, _ = np.meshgrid(np.arange(90) + 0.5, np.arange(90) + 0.5)
    slope = np.rint(1000 * math.tan(math.radians(10.0)) * c).astype(np.int64)
    z = slope.copy()
    z[40:50, 40:52] = slope[40:50, 40:52].max() + 5000
    terrain = terrain_under(one_point_a_cell(90, 90, z), (0, 0, 90, 90))
    assert not terrain.measured[40:50, 40:52].any()
    error = np.abs(terrain.elevation_mm - slope)
    assert error.max() <= 30
    assert error[terrain.measured].max() <= 1


@pytest.mark.parametrize("turns", range(4))
def test_the_terrain_reaches_the_brow_of_a_sparse_scarp_and_no_lone_bump(turns: int) -> None:
    # a scarp of 4 m; a plane through few cells passes far below its brow
    random = np.random.default_rng(3)
    c = np.arange(80)
    z = np.rot90(np.broadcast_to(np.clip((c - 40) * 1000, 0, 4000), (80, 80)), turns)
    bump = (20, 30)
    kept = random.random((80, 80)) < 0.3
    lowest = np.where(kept, z, NO_DATA).astype(np.int32)
    lowest[bump] += 900 if lowest[bump] != NO_DATA else 0
    is_ground = lowest != NO_DATA
    whole = (slice(0, 80), slice(0, 80))
    with_brow = ground._terrain(lowest, (is_ground, is_ground), 20, 1.0, whole, (4, 250.0))
    without = ground._terrain(lowest, (is_ground, is_ground), 20, 1.0, whole)
    brow = is_ground & (np.rot90(np.broadcast_to((c == 44) | (c == 45), (80, 80)), turns))
    assert np.max((lowest - without)[brow]) > 500
    assert np.max((lowest - with_brow)[brow]) <= 250
    changed = with_brow != without
    np.testing.assert_array_equal(with_brow[changed], lowest[changed])
    assert not changed[bump]


def test_sparse_points_on_a_scarp_are_ground_up_to_its_brow() -> None:
    # at 0.2 points per m2, where the planes of the smallest squares cut the brow off
    random = np.random.default_rng(1)
    n = 2880
    x, y = random.integers(0, 120_000, (2, n))
    z = np.clip((x - 60_000) * 0.9, 0, 5400).astype(np.int64)
    points = np.column_stack((x, y, z)).astype(np.int64)
    found = ground_points(x, y, z, terrain_under(points, (0, 0, 120, 120)), GroundSettings())
    brow = (abs(x - 66_000) < 3000) & (y > 10_000) & (y < 110_000)
    assert found[brow].all()


def test_local_planes_agree_with_least_squares_of_numpy() -> None:
    random = np.random.default_rng(9)
    lowest = (random.integers(-200, 200, (26, 31)) + 90 * np.arange(31)).astype(np.int32)
    is_ground = random.random(lowest.shape) < 0.22
    is_ground[:10, 12:24] = False
    bridge = 6
    slope = 0.15
    terrain = ground._terrain(lowest, (is_ground, is_ground), bridge, slope, (slice(0, 26), slice(0, 31)))
    fitted = 0
    for r, c in np.ndindex(lowest.shape):
        for half in (1, 2, 4, 6):
            box = (slice(max(r - half, 0), r + half + 1), slice(max(c - half, 0), c + half + 1))
            rows, columns = np.nonzero(is_ground[box])
            scatter = np.cov(np.stack((rows, columns)), bias=True) if len(rows) > 1 else np.zeros((2, 2))
            carries = len(rows) >= 5 and np.linalg.det(scatter) > 0.05 * np.trace(scatter) ** 2
            if carries or (len(rows) >= 5 and is_ground[r, c]):
                break
        rows, columns = np.nonzero(is_ground[box])
        z = lowest[box][is_ground[box]].astype(np.float64)
        if len(z) == 0:
            assert terrain[r, c] == NO_DATA
            continue
        dx, dy = columns + box[1].start - c, rows + box[0].start - r
        expected = z.mean()
        if carries:
            design = np.column_stack((dx, dy, np.ones(len(z))))
            slack = slope * 1000 * math.hypot(dx.mean(), dy.mean())
            expected = np.clip(np.linalg.lstsq(design, z, rcond=None)[0][2], z.mean() - slack, z.mean() + slack)
            fitted += 1
        assert terrain[r, c] == pytest.approx(expected, abs=0.51)
    assert fitted > 500


def test_terrain_ends_at_the_bridge() -> None:
    z = np.full((60, 60), 1000)
    points = one_point_a_cell(60, 60, z)
    points = points[points[:, 0] < 10_000]
    terrain = terrain_under(points, (0, 0, 60, 60), GroundSettings(bridge_m=8, max_window_m=5, widest_m=0))
    assert (terrain.elevation_mm[:, :18] == 1000).all()
    assert (terrain.elevation_mm[:, 18:] == NO_DATA).all()


def test_points_that_may_not_be_ground_leave_no_trace() -> None:
    random = np.random.default_rng(11)
    points = wild_points(random, 40, 40)
    x, y, z = (np.ascontiguousarray(points[:, k]) for k in range(3))
    usable = random.random(len(points)) < 0.6
    window = (0, 0, 40, 40)
    masked = ground_of(x, y, z, usable, window, SMALL, trusted=False)
    alone = terrain_under(points[usable], window, SMALL)
    np.testing.assert_array_equal(masked.elevation_mm, alone.elevation_mm)
    np.testing.assert_array_equal(masked.measured, alone.measured)


def test_no_points_give_no_terrain() -> None:
    terrain = terrain_under(np.empty((0, 3), np.int64), (5, 5, 4, 3))
    assert terrain.elevation_mm.shape == (3, 4)
    assert (terrain.elevation_mm == NO_DATA).all()
    assert not terrain.measured.any()


def test_where_classes_are_trusted_the_filter_only_interpolates() -> None:
    z = np.full((40, 40), 1000)
    z[10:20, 10:20] = 7000
    z[30, 30] = -4000
    points = one_point_a_cell(40, 40, z)
    missing = (points[:, 0] // 1000 == 5) & (points[:, 1] // 1000 == 5)
    terrain = terrain_under(points[~missing], (0, 0, 40, 40), trusted=True)
    assert terrain.measured.sum() == 40 * 40 - 1
    assert not terrain.measured[5, 5]
    assert terrain.elevation_mm[5, 5] == 1000
    assert (terrain.elevation_mm[12:18, 12:18] == 7000).all()
    assert terrain.elevation_mm[30, 30] < 1000


@pytest.mark.parametrize("trusted", [False, True])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("per_cell", "chosen"), [(1.2, SMALL), (0.08, SMALL), (0.03, FAR)])
def test_the_terrain_does_not_depend_on_the_window_beyond_its_support(
    seed: int, per_cell: float, chosen: GroundSettings, trusted: bool
) -> None:
    points = wild_points(np.random.default_rng(seed), 240, 230, per_cell=per_cell)
    whole = terrain_under(points, (0, 0, 240, 230), chosen, trusted=trusted)
    column0, row0, columns, rows = 23 + seed, 19, 190, 188
    inside = (points[:, 0] // 1000 >= column0) & (points[:, 0] // 1000 < column0 + columns)
    inside &= (points[:, 1] // 1000 >= row0) & (points[:, 1] // 1000 < row0 + rows)
    part = terrain_under(points[inside], (column0, row0, columns, rows), chosen, trusted=trusted)
    margin = math.ceil(chosen.trusted_support_m if trusted else chosen.support_m)
    inner = (slice(margin, rows - margin), slice(margin, columns - margin))
    same = (slice(row0 + margin, row0 + rows - margin), slice(column0 + margin, column0 + columns - margin))
    assert part.elevation_mm[inner].size > 300
    np.testing.assert_array_equal(part.elevation_mm[inner], whole.elevation_mm[same])
    np.testing.assert_array_equal(part.measured[inner], whole.measured[same])
    np.testing.assert_array_equal(part.slope_mm[inner], whole.slope_mm[same])
    if not trusted:
        assert 0.01 < part.measured[inner].mean() < 0.9


def test_ground_with_embankments_does_not_depend_on_the_window_beyond_its_support() -> None:
    random = np.random.default_rng(6)
    xy = random.uniform(0, 360, (40_000, 2))
    away = (xy[:, 0] - xy[:, 1]) / math.sqrt(2) % 50.0
    # dams with a wall on one side
    z = np.where(away < 10.0, 0.0, np.clip(29.0 - away, 0.0, 7.0)) + random.normal(0.0, 0.03, len(xy))
    points = np.rint(1000 * np.column_stack((xy, z))).astype(np.int64)
    whole = terrain_under(points, (0, 0, 360, 360), BANKS)
    without = terrain_under(points, (0, 0, 360, 360), dataclasses.replace(BANKS, embankment_m2=0))
    margin = math.ceil(BANKS.support_m)
    for column0, row0 in ((13, 11), (21, 30)):
        columns, rows = 320, 322
        inside = (points[:, 0] // 1000 >= column0) & (points[:, 0] // 1000 < column0 + columns)
        inside &= (points[:, 1] // 1000 >= row0) & (points[:, 1] // 1000 < row0 + rows)
        part = terrain_under(points[inside], (column0, row0, columns, rows), BANKS)
        inner = (slice(margin, rows - margin), slice(margin, columns - margin))
        same = (slice(row0 + margin, row0 + rows - margin), slice(column0 + margin, column0 + columns - margin))
        assert (whole.measured[same] & ~without.measured[same]).sum() > 100
        np.testing.assert_array_equal(part.elevation_mm[inner], whole.elevation_mm[same])
        np.testing.assert_array_equal(part.measured[inner], whole.measured[same])


@pytest.mark.parametrize("trusted", [False, True])
@pytest.mark.parametrize("per_cell", [1.2, 0.08])
def test_terrain_drawn_where_it_is_wanted_is_that_of_the_whole_window(per_cell: float, trusted: bool) -> None:
    points = wild_points(np.random.default_rng(11), 90, 80, per_cell=per_cell)
    points = points[points[:, 0] > 7_000]  # the part with data begins elsewhere than the window
    window = (0, 0, 90, 80)
    x, y, z = (np.ascontiguousarray(points[:, k]) for k in range(3))
    usable = np.ones(len(points), np.bool_)
    whole = ground_of(x, y, z, usable, window, SMALL, trusted=trusted)
    inner = (slice(30, 47), slice(23, 64))
    lowest = lowest_per_cell(x, y, z, usable, *window)
    drawn, measured = ground_on(lowest, window[:2], SMALL, trusted=trusted, wanted=inner)
    np.testing.assert_array_equal(drawn[inner], whole.elevation_mm[inner])
    np.testing.assert_array_equal(measured[inner], whole.measured[inner])
    assert (drawn != NO_DATA).sum() < (whole.elevation_mm != NO_DATA).sum() / 2


WANTED = dataclasses.replace(SMALL, regrowth_passes=3, rejoin_passes=3, berm_passes=2)
"""Ground joins from far away, and no other step looks much farther."""


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("chosen", [SMALL, WANTED, FAR, BANKS])
def test_steps_that_work_only_around_the_wanted_part_find_its_terrain(chosen: GroundSettings, seed: int) -> None:
    random = np.random.default_rng(seed)
    points = wild_points(random, 260, 250, per_cell=(1.2, 0.3)[seed % 2])
    x, y, z = (np.ascontiguousarray(points[:, k]) for k in range(3))
    lowest = lowest_per_cell(x, y, z, np.ones(len(points), np.bool_), 0, 0, 260, 250)
    whole, _ = ground_on(lowest, (0, 0), chosen, trusted=False)
    for row, column in random.integers(90, 150, (12, 2)).tolist():
        part = (slice(row, row + 8), slice(column, column + 9))
        drawn, _ = ground_on(lowest, (0, 0), chosen, trusted=False, wanted=part)
        np.testing.assert_array_equal(drawn[part], whole[part])


@pytest.mark.parametrize("chosen", [SMALL, WANTED, FAR, BANKS, GroundSettings(), GroundSettings(bridge_m=80)])
def test_the_support_is_that_of_the_openings_and_of_what_joins_after_them(chosen: GroundSettings) -> None:
    openings = chosen._openings_support_m
    assert chosen.support_m == openings + chosen.joining_support_m(chosen.reach_m) + 4
    assert openings >= chosen.second_support_m + 2 * chosen.max_window_m + 2 * GAP_CELLS + PIT_CELLS
    steps = (2 * GAP_CELLS, 2 * chosen.second_window_m, 2 * chosen.trend_m, CLUMP_CELLS)
    assert chosen.second_support_m == sum(steps)


def test_the_support_covers_both_openings_the_trend_between_them_and_the_bridge() -> None:
    for window_m, trend_m, bridge_m in ((2, 4, 4), (20, 12, 24), (30, 20, 60)):
        chosen = GroundSettings(
            max_window_m=window_m, residual_window_m=window_m, trend_m=trend_m, bridge_m=bridge_m, widest_m=0
        )
        assert chosen.support_m >= 2 + 4 * window_m + 2 * trend_m + bridge_m + 2
    wide = GroundSettings(widest_m=160)
    assert wide.support_m >= 2 + 160 + 80 + 2
    many, few = (GroundSettings(rejoin_passes=passes, embankment_m2=0) for passes in (6, 5))
    assert many.support_m == few.support_m + 2 * few.rejoin_m
    many, few = (GroundSettings(berm_passes=passes, embankment_m2=0) for passes in (4, 3))
    assert many.support_m == few.support_m + few.regrowth_m
    # a block of 48 m, a link of 6 m, a pass of berms of 3 m: 1 m more than rejoining by planes and three passes
    assert GroundSettings().support_m == few.support_m + 1 == 200


@pytest.mark.parametrize("shift", [(-8, 4), (84_000, 447_000), (-1000, -2000)])
def test_a_shift_by_whole_coarse_cells_shifts_the_terrain_bit_for_bit(shift: tuple[int, int]) -> None:
    points = wild_points(np.random.default_rng(21), 50, 45)
    before = terrain_under(points, (0, 0, 50, 45), SMALL)
    moved = points + np.array([shift[0] * 1000, shift[1] * 1000, 0])
    after = terrain_under(moved, (shift[0], shift[1], 50, 45), SMALL)
    np.testing.assert_array_equal(after.elevation_mm, before.elevation_mm)
    np.testing.assert_array_equal(after.measured, before.measured)


def test_swapping_easting_and_northing_transposes_the_terrain() -> None:
    points = wild_points(np.random.default_rng(22), 50, 45)
    before = terrain_under(points, (0, 0, 50, 45), SMALL)
    after = terrain_under(points[:, [1, 0, 2]], (0, 0, 45, 50), SMALL)
    np.testing.assert_array_equal(after.measured.T, before.measured)
    np.testing.assert_allclose(after.elevation_mm.T, before.elevation_mm, atol=1)


def test_the_order_of_the_points_does_not_matter() -> None:
    random = np.random.default_rng(23)
    points = wild_points(random, 50, 45)
    before = terrain_under(points, (0, 0, 50, 45), SMALL)
    after = terrain_under(random.permutation(points), (0, 0, 50, 45), SMALL)
    np.testing.assert_array_equal(after.elevation_mm, before.elevation_mm)


# -- heights -----------------------------------------------------------------------------------------------------------


def test_heights_agree_with_bilinear_interpolation_of_scipy() -> None:
    random = np.random.default_rng(13)
    terrain = random.integers(-2000, 2000, (30, 40)).astype(np.int32)
    n = 2000
    x = random.integers(-7000 + 500, -7000 + 39_500, n)
    y = random.integers(3000 + 500, 3000 + 29_500, n)
    z = random.integers(-9000, 9000, n)
    places = np.stack(((y - 3000 - 500) / 1000.0, (x + 7000 - 500) / 1000.0))
    surface = map_coordinates(terrain.astype(np.float64), places, order=1)
    np.testing.assert_allclose(height_above(x, y, z, terrain, -7, 3), z - surface, atol=0.51)


def test_heights_agree_with_a_slow_twin_where_cells_are_missing() -> None:
    random = np.random.default_rng(14)
    terrain = with_gaps(random.integers(-2000, 2000, (8, 9)).astype(np.int32), 2, 0.5)
    n = 600
    x, y, z = random.integers(-2000, 11_000, n), random.integers(-2000, 10_000, n), random.integers(-99, 99, n)
    heights = height_above(x, y, z, terrain, 0, 0)
    unknown = 0
    for px, py, pz, height in zip(x.tolist(), y.tolist(), z.tolist(), heights.tolist(), strict=True):
        weights, values = [], []
        for r, c in np.argwhere(terrain != NO_DATA):
            w = max(0.0, 1 - abs(px - 500 - 1000 * c) / 1000) * max(0.0, 1 - abs(py - 500 - 1000 * r) / 1000)
            weights.append(w)
            values.append(float(terrain[r, c]))
        if sum(weights) > 1e-9:
            assert height == pytest.approx(pz - np.average(values, weights=weights), abs=0.51)
        else:
            unknown += 1
            assert height == NO_DATA
    assert 0 < unknown < n


def test_a_point_at_the_centre_of_a_cell_stands_on_that_cell() -> None:
    terrain = np.array([[100, 900], [NO_DATA, 400]], np.int32)
    x, y = np.array([500, 1500, 500, 1500]), np.array([500, 500, 1500, 1500])
    assert height_above(x, y, np.full(4, 1000), terrain, 0, 0).tolist() == [900, 100, NO_DATA, 600]


# -- ground points -----------------------------------------------------------------------------------------------------


def test_slopes_are_central_differences_and_one_sided_at_the_edge_of_what_is_known() -> None:
    random = np.random.default_rng(15)
    terrain = with_gaps(random.integers(-2000, 2000, (12, 10)).astype(np.int32), 3, 0.2)
    known = np.where(terrain == NO_DATA, np.nan, terrain.astype(np.float64))

    def rise(line: npt.NDArray[np.float64], k: int) -> float:
        near = [j for j in (k - 1, k + 1) if 0 <= j < len(line) and not np.isnan(line[j])]
        low, high = (min((*near, k)), max((*near, k)))
        return float(line[high] - line[low]) / max(high - low, 1)

    slopes = slopes_of(terrain)
    for r, c in np.ndindex(terrain.shape):
        expected = 0.0 if terrain[r, c] == NO_DATA else math.hypot(rise(known[:, c], r), rise(known[r], c))
        assert slopes[r, c] == pytest.approx(expected, abs=0.51)


@pytest.mark.parametrize("slope_deg", [0.0, 20.0, 45.0])
def test_the_tolerance_grows_with_the_slope(slope_deg: float) -> None:
    fall = math.tan(math.radians(slope_deg))
    c, _ = np.meshgrid(np.arange(40) + 0.5, np.arange(40) + 0.5)
    terrain = terrain_under(one_point_a_cell(40, 40, np.rint(1000 * fall * c)), (0, 0, 40, 40), trusted=True)
    chosen = GroundSettings(tolerance_m=0.5, tolerance_slope=1.0)
    x, y = np.full(3, 20_000), np.full(3, 20_000)
    limit = 500 + 1000 * fall
    z = np.rint(20_000 * fall + np.array([-9000, limit - 5, limit + 5])).astype(np.int64)
    assert ground_points(x, y, z, terrain, chosen).tolist() == [True, True, False]


def test_with_the_hierarchical_filter_the_tolerance_is_the_same_everywhere() -> None:
    c, _ = np.meshgrid(np.arange(40) + 0.5, np.arange(40) + 0.5)
    terrain = terrain_under(one_point_a_cell(40, 40, np.rint(1000 * c)), (0, 0, 40, 40), trusted=True)
    place = np.full(2, 20_000)
    z = np.array([20_495, 20_505])
    assert ground_points(place, place, z, terrain, GroundSettings(filter="hierarchical")).tolist() == [True, False]


def test_points_without_terrain_are_no_ground() -> None:
    z = np.full((10, 10), 1000)
    terrain = terrain_under(one_point_a_cell(10, 10, z), (0, 0, 200, 10))
    assert (terrain.elevation_mm[:, 90:] == NO_DATA).all()
    place = np.array([5_000, 150_000])
    assert ground_points(place, np.full(2, 5_000), np.full(2, 1000), terrain, GroundSettings()).tolist() == [
        True,
        False,
    ]
