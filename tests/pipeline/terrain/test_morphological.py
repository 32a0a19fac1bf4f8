"""The morphological ground filter: openings by octagons, two passes, wide objects, regrowth, and what they cut."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import binary_dilation, generate_binary_structure, grey_dilation, grey_erosion

from pipeline.terrain.lattice import NO_DATA
from pipeline.terrain.morphological import closed_gaps, leaning_planes, morphological_ground, regrown, without_clumps
from pipeline.terrain.openings import cut_off, dilate_back, erode_once, framed
from pipeline.terrain.rejoining import rejoined
from pipeline.terrain.terrain_settings import GroundSettings
from pipeline.terrain.wide_objects import wide_objects, with_corners

Grid = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]

grids = arrays(np.int32, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.integers(-3000, 3000))


def octagon(radius: int) -> Mask:
    """The structuring element, by dilations of scipy."""
    mask = np.zeros((2 * radius + 1, 2 * radius + 1), np.bool_)
    mask[radius, radius] = True
    for number in range(1, radius + 1):
        square = number * 29 // 70 > (number - 1) * 29 // 70
        mask = binary_dilation(mask, generate_binary_structure(2, 2 if square else 1))
    return mask


def with_gaps(grid: Grid, seed: int, share: float = 0.4) -> Grid:
    holes = np.random.default_rng(seed).random(grid.shape) < share
    return np.where(holes, NO_DATA, grid).astype(np.int32)


def coordinates(rows: int, columns: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    c, r = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    return c, r


def millimetres(z_m: npt.NDArray[np.float64], noise_mm: float = 0.0, seed: int = 0) -> Grid:
    noise = np.random.default_rng(seed).normal(0.0, noise_mm, z_m.shape) if noise_mm else 0.0
    return np.rint(1000 * z_m + noise).astype(np.int32)


def ground_cells(lowest: Grid, chosen: GroundSettings | None = None) -> Mask:
    found: Mask = morphological_ground(lowest, (0, 0), chosen or GroundSettings())[0]
    return found


# -- openings ----------------------------------------------------------------------------------------------------------


def test_the_elements_are_octagons_that_grow_by_a_cell_and_are_nearly_round() -> None:
    for radius in (5, 12, 20, 26):
        mask = octagon(radius)
        assert mask[0].any()
        assert not mask[0, 0]
        assert mask.sum() == pytest.approx(math.pi * (radius + 0.5) ** 2, rel=0.12)
        np.testing.assert_array_equal(mask, mask[::-1])
        np.testing.assert_array_equal(mask, mask.T)


def opened_by(surface: Grid, radius: int) -> Grid:
    """Opening of a surface by an octagon of a radius in cells; NO_DATA where the surface has none."""
    eroded = framed(surface)
    opened = eroded.copy()
    for number in range(1, radius + 1):
        erode_once(eroded, number)
    dilate_back(surface, eroded, opened, radius)
    out = surface.copy()
    known = surface != NO_DATA
    out[known] = opened[1:-1, 1:-1][known]
    return out


@settings(deadline=None)
@given(grid=grids, radius=st.integers(1, 9))
def test_an_opening_of_full_data_is_that_of_scipy(grid: Grid, radius: int) -> None:
    element = octagon(radius)
    eroded = grey_erosion(grid, footprint=element, mode="constant", cval=2**30)
    np.testing.assert_array_equal(
        opened_by(grid, radius), grey_dilation(eroded, footprint=element, mode="constant", cval=-(2**30))
    )


@settings(deadline=None)
@given(grid=grids, radius=st.integers(1, 4), seed=st.integers(0, 100))
def test_elements_are_centred_on_data_and_see_nothing_else(grid: Grid, radius: int, seed: int) -> None:
    values = with_gaps(grid, seed)
    element = octagon(radius)

    def extreme(source: Grid, pick: str) -> Grid:
        out = np.full(source.shape, NO_DATA, np.int32)
        for r, c in np.argwhere(values != NO_DATA):
            near = [
                source[r + dr, c + dc]
                for dr, dc in np.argwhere(element) - radius
                if 0 <= r + dr < source.shape[0] and 0 <= c + dc < source.shape[1]
            ]
            data = np.array([v for v in near if v != NO_DATA])
            out[r, c] = getattr(data, pick)()
        return out

    np.testing.assert_array_equal(opened_by(values, radius), extreme(extreme(values, "min"), "max"))


@settings(deadline=None)
@given(grid=grids, radius=st.integers(1, 5), seed=st.integers(0, 100))
def test_an_opening_lies_below_its_data_and_opening_again_changes_nothing(grid: Grid, radius: int, seed: int) -> None:
    values = with_gaps(grid, seed)
    once = opened_by(values, radius)
    assert (once <= values).all()
    np.testing.assert_array_equal(opened_by(once, radius), once)


def test_what_is_cut_off_is_what_a_step_takes_more_than_its_limit_and_the_last_such_step_is_given() -> None:
    random = np.random.default_rng(7)
    values = random.integers(0, 500, (60, 50)).astype(np.int32)
    values[20:32, 10:30] += 6000
    values[40:43, 40:43] += 900
    base = random.integers(0, 400, values.shape).astype(np.int32)
    expected = np.zeros(values.shape, np.uint8)
    before = values
    for radius in range(1, 10):
        after = opened_by(values, radius)
        expected[before - after > base + 100.0 * radius] = radius
        before = after
    found = cut_off(values, base, 100.0, 9)
    np.testing.assert_array_equal(found, expected)
    assert (found[20:32, 10:30] > 0).all()


# -- gaps, trend, clumps, regrowth -------------------------------------------------------------------------------------


def test_gaps_are_closed_from_their_rims_and_no_farther() -> None:
    lowest = np.full((30, 40), NO_DATA, np.int32)
    lowest[:, :10] = 1000
    lowest[:, 16:20] = 2500
    closed = closed_gaps(lowest, 4)
    np.testing.assert_array_equal(closed[:, :10], lowest[:, :10])
    assert (np.diff(closed[15, 9:17].astype(np.int64)) >= 0).all()
    assert len(set(closed[15, 9:17].tolist())) > 3
    assert (closed[:, 20:24] == 2500).all()
    assert (closed[:, 24:] == NO_DATA).all()


def test_a_wall_in_a_gap_stays_a_wall_and_keeps_its_place() -> None:
    lowest = np.full((30, 40), NO_DATA, np.int32)
    lowest[:, :10] = 1000
    lowest[:, 16:] = 6000
    lowest[12:16, 19:22] = NO_DATA
    closed = closed_gaps(lowest, 4)
    np.testing.assert_array_equal(closed[:, :13], np.full((30, 13), 1000))
    np.testing.assert_array_equal(closed[:, 13:], np.full((30, 27), 6000))


def test_a_narrow_street_between_sparse_roofs_stays_as_wide_as_it_is() -> None:
    random = np.random.default_rng(2)
    lowest = np.full((60, 60), NO_DATA, np.int32)
    seen = random.random(lowest.shape) < 0.3
    c, _ = coordinates(60, 60)
    street = np.abs(c - 30) < 4
    lowest[seen] = np.where(street, 0, 8000)[seen]
    closed = closed_gaps(lowest, 4)
    assert set(np.unique(closed[closed != NO_DATA]).tolist()) == {0, 8000}
    assert 7 * 60 <= (closed == 0).sum() <= 11 * 60


def test_the_trend_of_a_plane_is_the_plane_also_beside_the_edge_of_the_ground() -> None:
    c, r = coordinates(60, 70)
    lowest = millimetres(0.4 * c - 0.3 * r)
    used = c > 20
    level, slope = leaning_planes(lowest, used, 8, 16)
    assert np.abs(level - lowest)[:, 12:].max() <= 1
    assert np.abs(slope[:, 12:] - 500).max() <= 1
    assert (leaning_planes(lowest, np.zeros_like(used), 8, 16)[0] == NO_DATA).all()


def test_a_clump_of_low_outliers_is_cleared_and_a_courtyard_is_not() -> None:
    lowest = np.zeros((60, 60), np.int32)
    lowest[20:23, 30:33] = -8000
    level, slope = np.zeros_like(lowest), np.zeros_like(lowest)
    cleared = without_clumps(lowest, level, slope, 4000)
    assert (cleared[20:23, 30:33] == NO_DATA).all()
    assert (cleared != NO_DATA).sum() == 60 * 60 - 9
    # in a courtyard the trend is the courtyard
    yard = np.full((60, 60), 9000, np.int32)
    yard[20:28, 30:38] = 0
    np.testing.assert_array_equal(without_clumps(yard, level, slope, 4000), yard)


def test_what_lies_level_with_ground_beside_it_joins_pass_by_pass() -> None:
    lowest = np.zeros((20, 30), np.int32)
    lowest[:, 25:] = 3000
    ground = np.zeros(lowest.shape, np.bool_)
    ground[:, :10] = True
    barred = np.zeros(lowest.shape, np.bool_)
    barred[5, 10] = True
    for passes in (0, 1, 3):
        found = regrown(lowest, ground, barred, passes, (3, 200, 0.0, 0.4))
        expected = np.arange(30) < 10 + 3 * passes
        np.testing.assert_array_equal(found[10:], np.broadcast_to(expected, (10, 30)))
        assert not found[5, 10]
        assert not found[:, 25:].any()


def test_only_the_nearest_ground_says_what_is_level_and_a_rise_per_metre_lets_gentle_slopes_join() -> None:
    c, _ = coordinates(20, 40)
    lowest = millimetres(np.where(c < 20, 0.0, 0.25 * (c - 20)))
    lowest[:, :17] = -5000
    ground = c < 20
    barred = np.zeros(lowest.shape, np.bool_)
    for rise_mm, joined in ((0.0, 21), (100.0, 24)):
        found = regrown(lowest, ground, barred, 3, (3, 200, rise_mm, 0.4))
        np.testing.assert_array_equal(found, c < joined)


@pytest.mark.parametrize("turns", [0, 1])
def test_a_berm_on_the_brow_of_a_quarry_is_ground_and_a_wall_there_is_not(turns: int) -> None:
    c, r = coordinates(120, 160)
    plateau = np.where(c < 80, 20.0, 2.0)
    berm = (c > 74) & (c < 80)
    wall = berm & (c > 76) & (r > 60)
    low = np.where(berm & (r < 60), plateau + 0.2 * (c - 74), np.where(wall, plateau + 1.5, plateau))
    lowest = np.rot90(millimetres(low, 30.0), turns).copy()
    lowest[(np.arange(lowest.shape[0]) % 2 == 1)[:, None] | (np.arange(lowest.shape[1]) % 2 == 1)] = NO_DATA
    known = lowest != NO_DATA
    mound = np.rot90(berm & (r < 56), turns) & known
    found, without = (ground_cells(lowest, GroundSettings(berm_passes=passes)) for passes in (3, 0))
    assert without[mound].mean() < 0.8
    assert found[mound].mean() > 0.95
    assert not found[np.rot90(wall & (r > 64), turns) & known].any()


@pytest.mark.parametrize("turns", [0, 1])
def test_a_brow_joins_the_plateau_behind_it_and_a_roof_over_the_slope_joins_nothing(turns: int) -> None:
    c, r = coordinates(60, 80)
    slope = np.where(c < 40, 0.3 * c, 12.0 - 0.8 * (c - 40))
    roof = (np.abs(r - 30) < 6) & (np.abs(c - 20) < 5)
    lowest = np.rot90(millimetres(np.where(roof, 11.0, slope)), turns).copy()
    lost = np.rot90(roof | (np.abs(c - 40) < 6), turns)
    brow = np.rot90(~roof & (np.abs(c - 40) < 6), turns)
    nothing = np.zeros(lowest.shape, np.bool_)
    found = rejoined(lowest, ~lost, nothing, 3, (3, 250.0))
    assert found[brow].all()
    assert not found[np.rot90(roof, turns)].any()
    assert not rejoined(lowest, ~lost, lost, 3, (3, 250.0))[lost].any()


def test_a_pass_of_rejoining_looks_two_half_sides_far() -> None:
    lowest = np.zeros((30, 60), np.int32)
    ground = np.zeros(lowest.shape, np.bool_)
    ground[:, :20] = True
    nothing = np.zeros_like(ground)
    seen = rejoined(lowest, ground, nothing, 1, (3, 250.0))
    assert seen.any(axis=0).argmin() - 20 in range(1, 7)
    cropped = rejoined(lowest[:, 14:].copy(), ground[:, 14:].copy(), nothing[:, 14:].copy(), 1, (3, 250.0))
    np.testing.assert_array_equal(cropped[:, 6:], seen[:, 20:])
    assert rejoined(lowest, nothing, nothing, 3, (3, 250.0)).sum() == 0


# -- wide objects ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn_deg", [0.0, 25.0, 45.0])
@pytest.mark.parametrize("corner", [(0, 0), (3, -7)])
def test_a_hall_of_100_metres_is_a_wide_object_and_a_hill_as_high_is_none(
    turn_deg: float, corner: tuple[int, int]
) -> None:
    c, r = coordinates(330, 330)
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    u, v = cos * (c - 100) + sin * (r - 100), -sin * (c - 100) + cos * (r - 100)
    hall = (np.abs(u) < 50) & (np.abs(v) < 50)
    hill = 25.0 * np.exp(-((c - 240) ** 2 + (r - 240) ** 2) / (2 * 25.0**2))
    z = np.where(hall, 12.0, 0.02 * c + hill)
    found = wide_objects(millimetres(z), corner, 20, 52, 120.0)
    assert found[hall].mean() > 0.97
    assert not found[~hall].any()


def test_a_trench_beside_a_narrow_strip_of_data_makes_no_object_of_it() -> None:
    lowest = np.zeros((14, 60), np.int32)
    lowest[:, 4:10] = -6000
    assert not wide_objects(lowest, (0, 0), 20, 52, 120.0).any()


def test_the_corner_of_a_hall_is_a_wide_object_where_the_first_openings_cut_it_off() -> None:
    lowest = np.zeros((40, 40), np.int32)
    lowest[10:30, 10:30] = 4000
    lowest[12, 28] = 3000
    wide = np.zeros(lowest.shape, np.bool_)
    wide[10:30, 10:26] = True
    first = np.zeros(lowest.shape, np.uint8)
    first[10:20, 26:32] = 9
    found = with_corners(lowest, wide, first)
    expected = wide.copy()
    expected[10:20, 26:29] = True
    expected[12, 28] = False
    np.testing.assert_array_equal(found, expected)


# -- the whole filter --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("slope_deg", "share"), [(0.0, 0.0), (15.0, 0.0), (30.0, 0.0), (45.0, 0.0), (0.0, 0.8), (15.0, 0.8), (30.0, 0.8)]
)
def test_a_plane_slope_is_all_ground_dense_and_sparse(slope_deg: float, share: float) -> None:
    c, r = coordinates(130, 130)
    z = math.tan(math.radians(slope_deg)) * (0.8 * c + 0.6 * r)
    lowest = with_gaps(millimetres(z, 40.0), 1, share)
    found = ground_cells(lowest)
    assert found[lowest != NO_DATA].mean() > 0.97


@pytest.mark.parametrize("size", [(6, 6), (12, 9), (38, 30), (100, 60), (100, 100)])
def test_a_block_is_cut_off_whole_and_the_ground_around_it_stays(size: tuple[int, int]) -> None:
    c, r = coordinates(220, 220)
    block = (np.abs(c - 110) < size[0] / 2) & (np.abs(r - 110) < size[1] / 2)
    found = ground_cells(millimetres(np.where(block, 12.0, 0.03 * c), 20.0))
    assert not found[block].any()
    assert found[~block].mean() > 0.99


def test_a_hall_that_the_edge_or_corner_of_the_data_cuts_is_no_ground_to_its_own_corner() -> None:
    c, r = coordinates(200, 200)
    at_edge, at_corner = (c < 45) & (np.abs(r - 100) < 40), (c + r < 25 * math.sqrt(2)) & (c - r < 12 * math.sqrt(2))
    for hall, height, slope in ((at_edge, 9.0, 0.02), (at_corner, 3.4, 0.01)):
        found = ground_cells(millimetres(np.where(hall, height, slope * r), 20.0))
        assert found[hall].mean() < 0.02
        assert found[~hall].mean() > 0.99


def test_hills_dams_and_cuttings_stay_ground_and_terraces_to_their_rims() -> None:
    c, r = coordinates(260, 260)
    hill = 20.0 * np.exp(-((c - 70) ** 2 + (r - 70) ** 2) / (2 * 22.0**2))
    dam = 6.0 - np.clip((np.abs(c - 180 - 0.15 * r) - 6.0) / 1.5, 0.0, 6.0)
    cutting = -4.0 + np.clip((np.abs(r - 215) - 5.0) / 1.5, 0.0, 4.0)
    found = ground_cells(millimetres(hill + np.where(c > 120, dam, 0.0) + cutting, 30.0))
    assert found.mean() > 0.99
    assert ground_cells(millimetres(2.0 * np.floor(c / 12.0) + 0.05 * c, 30.0)).mean() > 0.97


def test_a_house_and_low_bushes_on_a_slope_of_30_degrees_are_not_ground() -> None:
    random = np.random.default_rng(3)
    c, r = coordinates(150, 150)
    slope = math.tan(math.radians(30.0)) * c
    house = (np.abs(c - 75) < 6) & (np.abs(r - 75) < 5)
    bush = (random.random(c.shape) < 0.04) & ~house
    z = np.where(house, slope[75, 75] + 7.0, slope) + np.where(bush, random.uniform(1.2, 3.0, c.shape), 0.0)
    found = ground_cells(millimetres(z, 30.0))
    assert not found[house].any()
    assert found[bush].mean() < 0.03
    assert found[~house & ~bush].mean() > 0.98


def test_a_spur_of_a_plateau_that_narrows_grows_back_from_the_plateau() -> None:
    c, r = coordinates(220, 260)
    spur = (c > 80) & (np.abs(r - 110) < 10 + 0.6 * (c - 80))
    lowest = millimetres(np.where(spur, 7.0, 0.0), 20.0)
    chosen = [GroundSettings(rejoin_passes=passes, berm_passes=0) for passes in (0, 1, 2)]
    kept = [ground_cells(lowest, settings)[spur].mean() for settings in chosen]
    assert kept[0] < kept[1] < kept[2]
    found, steady = morphological_ground(lowest, (0, 0), GroundSettings())
    np.testing.assert_array_equal(steady, ground_cells(lowest, chosen[0]))
    assert found[steady].all()


def test_low_outliers_and_clumps_of_them_change_nothing_but_their_own_cells() -> None:
    random = np.random.default_rng(5)
    c, r = coordinates(200, 200)
    block = (np.abs(c - 100) < 15) & (np.abs(r - 100) < 12)
    z = np.where(block, 8.0, 2.0 * np.sin(c / 30.0))
    low = np.zeros(c.shape, np.bool_)
    for row, column in random.integers(10, 185, (12, 2)):
        low[row : row + 2, column : column + 3] = True
    low &= ~block
    clean, dirty = millimetres(z, 20.0), millimetres(np.where(low, z - 12.0, z), 20.0)
    before, after = ground_cells(clean), ground_cells(dirty)
    assert not after[low].any()
    assert (before == after)[~low].mean() > 0.998


def test_a_bridge_is_no_ground_between_its_ends() -> None:
    c, r = coordinates(180, 180)
    valley = -8.0 * np.clip((40.0 - np.abs(c - 90)) / 15.0, 0.0, 1.0)
    deck = (np.abs(r - 90) < 5) & (np.abs(c - 90) < 36)
    found = ground_cells(millimetres(np.where(deck, 0.0, valley), 20.0))
    middle = deck & (np.abs(c - 90) < 25)
    assert not found[middle].any()
    assert found[~deck].mean() > 0.98


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_turning_the_scene_by_right_angles_turns_the_ground(turns: int) -> None:
    random = np.random.default_rng(8)
    c, r = coordinates(120, 120)
    z = 3.0 * np.sin(c / 20.0) + np.where((c // 15 + r // 11) % 4 == 0, 6.0, 0.0) + random.normal(0, 0.1, c.shape)
    lowest = with_gaps(millimetres(z), 4)
    chosen = GroundSettings(widest_m=0)
    np.testing.assert_array_equal(
        np.rot90(ground_cells(lowest, chosen), turns), ground_cells(np.rot90(lowest, turns).copy(), chosen)
    )


def test_no_data_gives_no_ground() -> None:
    assert not ground_cells(np.full((20, 20), NO_DATA, np.int32)).any()


def test_a_cell_joins_ground_in_the_corners_of_its_largest_square_up_to_the_limit_there() -> None:
    ground = np.zeros((9, 9), np.bool_)
    ground[np.ix_((1, 7), (1, 7))] = True
    for height, joins in ((424, True), (425, False)):
        lowest = np.full((9, 9), NO_DATA, np.int32)
        lowest[ground], lowest[4, 4] = 0, height
        found = regrown(lowest, ground, np.zeros_like(ground), 1, (3, 0, 100.0, 0.5))
        assert found[4, 4] == joins  # 100 mm per metre over the diagonal of three cells
