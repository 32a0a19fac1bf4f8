"""The hierarchical ground filter: what it cuts off, its tests by slow twins, and how far it looks."""

import itertools
import math

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import Delaunay

from pipeline.errors import SettingsError
from pipeline.extras.hierarchical_filter.hierarchical_filter import _lowest_of_cells, _without_clumps, join_planes
from pipeline.extras.hierarchical_filter.tin_densification import join_facets
from pipeline.terrain.ground import Terrain, ground_of
from pipeline.terrain.lattice import NO_DATA
from pipeline.terrain.pits import without_pits
from pipeline.terrain.planar_fitting import plane_around, plane_sums
from pipeline.terrain.terrain_settings import GroundSettings

Grid = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]

HIERARCHICAL = GroundSettings(filter="hierarchical")
SMALL = GroundSettings(filter="hierarchical", seed_cell_m=9, level_ratio=3, passes=1, min_reach_m=4, bridge_m=6)


def terrain_under(lowest: Grid, settings: GroundSettings = HIERARCHICAL, corner: tuple[int, int] = (0, 0)) -> Terrain:
    """The terrain where each cell with data holds one point at its centre; `corner` is column0, row0."""
    rows, columns = np.nonzero(lowest != NO_DATA)
    return ground_of(
        (columns + corner[0]) * 1000 + 500,
        (rows + corner[1]) * 1000 + 500,
        lowest[rows, columns].astype(np.int64),
        np.ones(len(rows), np.bool_),
        (*corner, lowest.shape[1], lowest.shape[0]),
        settings,
        trusted=False,
    )


def hills(rows: int, columns: int, *, slope: float, noise_mm: float = 40.0, seed: int = 0) -> Grid:
    """A slope with hills of 3 m on it."""
    r, c = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    z = 1000 * slope * c + 3000 * np.sin(c / 12.0) * np.cos(r / 15.0)
    rough: Grid = np.rint(z + np.random.default_rng(seed).normal(0, noise_mm, z.shape)).astype(np.int32)
    return rough


def houses(grid: Grid, boxes: tuple[tuple[int, int, int, int], ...], height_mm: int = 6000) -> Mask:
    """Put flat roofs at row, column, depth, width on a grid; the mask of them."""
    mask = np.zeros(grid.shape, np.bool_)
    for r, c, depth, width in boxes:
        part = slice(r, r + depth), slice(c, c + width)
        grid[part] = grid[part].max() + height_mm
        mask[part] = True
    return mask


def thinned(grid: Grid, share: float, seed: int = 1) -> Grid:
    """The grid with data in a share of its cells."""
    return np.where(np.random.default_rng(seed).random(grid.shape) < share, grid, NO_DATA).astype(np.int32)


# -- what it finds -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [0.0, 0.15, 0.4])
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_houses_on_hills_are_cut_off_and_the_hills_are_kept(slope: float, share: float) -> None:
    bare = hills(150, 160, slope=slope)
    grid = bare.copy()
    roofs = houses(grid, ((20, 30, 10, 12), (60, 70, 14, 9), (100, 40, 18, 22), (30, 120, 8, 8)))
    terrain = terrain_under(thinned(grid, share))
    filled = thinned(grid, share) != NO_DATA
    assert not terrain.measured[roofs].any()
    assert terrain.measured[filled & ~roofs].mean() > 0.97
    off = np.abs(terrain.elevation_mm - bare)
    assert np.percentile(off[~roofs], 99) < 500
    assert np.median(off[roofs]) < 700


def test_a_hall_of_60_by_90_metres_between_the_seeds_is_cut_off() -> None:
    grid = hills(200, 220, slope=0.02, noise_mm=20.0)
    # a hall that covers no whole cell of 48 m: rows 48 to 96 reach beyond it
    roofs = houses(grid, ((60, 70, 60, 90),), 9000)
    assert not terrain_under(grid).measured[roofs].any()


def test_single_low_outliers_and_clumps_of_them_are_no_ground() -> None:
    grid = hills(120, 120, slope=0.1)
    low = np.zeros(grid.shape, np.bool_)
    for r, c, side in ((20, 20, 1), (40, 71, 2), (80, 30, 3), (91, 91, 3)):
        low[r : r + side, c : c + side] = True
    clean = terrain_under(grid)
    grid[low] -= 7000
    terrain = terrain_under(grid)
    assert not terrain.measured[low].any()
    assert terrain.measured[~low].mean() > 0.99
    assert np.abs(terrain.elevation_mm - clean.elevation_mm).max() < 300


def test_a_yard_of_12_metres_within_a_block_is_ground() -> None:
    grid = np.zeros((140, 140), np.int32)
    roofs = houses(grid, ((50, 50, 40, 40),), 12_000)
    yard = slice(64, 76), slice(64, 76)
    grid[yard] = 0
    roofs[yard] = False
    terrain = terrain_under(grid)
    assert terrain.measured[yard].all()
    assert not terrain.measured[roofs].any()


@pytest.mark.parametrize("cells", [0, 1, 2, 4])
def test_few_or_no_points_are_no_error(cells: int) -> None:
    grid = np.full((30, 40), NO_DATA, np.int32)
    for k in range(cells):
        grid[5, 7 + k] = 1000
    terrain = terrain_under(grid)
    assert terrain.measured.sum() == cells
    assert set(np.unique(terrain.elevation_mm)) <= {1000, int(NO_DATA)}


# -- the steps, by slow twins ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("corner", [(0, 0), (-7, 13), (84_321, 447_001)])
@pytest.mark.parametrize("size", [1, 3, 10])
def test_the_lowest_of_each_cell_agrees_with_a_plain_loop(size: int, corner: tuple[int, int]) -> None:
    grid = thinned(np.random.default_rng(4).integers(0, 30, (23, 31)).astype(np.int32), 0.6)
    best: dict[tuple[int, int], tuple[int, int, int]] = {}
    for r, c in np.argwhere(grid != NO_DATA).tolist():
        cell = (r + corner[1]) // size, (c + corner[0]) // size
        best[cell] = min(best.get(cell, (2**40, 0, 0)), (int(grid[r, c]), r, c))
    found = _lowest_of_cells(grid, size, *corner)
    assert set(map(tuple, np.argwhere(found).tolist())) == {(r, c) for _, r, c in best.values()}


def test_clumps_in_cells_of_1_m_are_pits_of_four() -> None:
    grid = thinned(np.random.default_rng(5).integers(0, 2500, (30, 30)).astype(np.int32), 0.7)
    cleared = _without_clumps(grid, 1, -3, 8, 1000)
    np.testing.assert_array_equal(cleared, without_pits(grid, 1000, 3))
    assert ((cleared == NO_DATA) & (grid != NO_DATA)).any()


def test_of_a_cell_only_what_is_too_deep_is_cleared() -> None:
    grid = np.zeros((21, 21), np.int32)
    grid[10, 9:11] = -5000
    cleared = _without_clumps(grid, 3, 0, 0, 1000)
    np.testing.assert_array_equal(cleared, np.where(grid < 0, NO_DATA, grid))


@pytest.mark.parametrize("seed", range(3))
def test_facets_judge_as_a_slow_twin_on_the_triangulation_of_scipy_does(seed: int) -> None:
    random = np.random.default_rng(seed)
    z = (hills(40, 45, slope=0.1, seed=seed) + random.integers(0, 1500, (40, 45))).astype(np.int32)
    # no four vertices on a circle, nor points on an edge, would need an agreed tie: those of scipy are left out below
    ground = random.random(z.shape) < 0.04
    asked = ~ground & (random.random(z.shape) < 0.7)
    reach, limits = 9, (900.0, 150.0, math.sin(math.radians(12.0)))
    joined, judged = join_facets(z, ground, asked, reach, limits)
    vertices = np.argwhere(ground)[:, ::-1].astype(np.float64)
    tin = Delaunay(vertices)
    compared = 0
    for r, c in np.argwhere(asked).tolist():
        simplex = int(tin.find_simplex([c, r]))
        if simplex < 0:
            assert not judged[r, c]
            continue
        corners = vertices[tin.simplices[simplex]]
        at = np.column_stack((corners, [z[int(y), int(x)] for x, y in corners]))
        matrix = np.column_stack((corners, np.ones(3)))
        weights = np.linalg.solve(matrix.T, np.array([c, r, 1.0]))
        a, b, o = corners[1] - corners[0], corners[2] - corners[0], corners[0]
        centre = o + np.linalg.solve(2 * np.array([a, b]), np.array([a @ a, b @ b]))
        radius = float(np.linalg.norm(centre - o))
        others = np.linalg.norm(vertices - centre, axis=1)
        if weights.min() < 1e-6 or (others < radius + 1e-6).sum() > 3:
            continue
        within = max(abs(centre[0] - c), abs(centre[1] - r)) + radius
        if abs(within - reach) < 1e-6:
            continue
        compared += 1
        assert judged[r, c] == (within <= reach)
        if not judged[r, c]:
            assert not joined[r, c]
            continue
        scaled = at * np.array([1000.0, 1000.0, 1.0])
        normal = np.cross(scaled[1] - scaled[0], scaled[2] - scaled[0])
        normal *= np.sign(normal[2]) / np.linalg.norm(normal)
        point = np.array([1000.0 * c, 1000.0 * r, z[r, c]])
        distance = float(normal @ (point - scaled[0]))
        sines = [distance / float(np.linalg.norm(point - v)) for v in scaled]
        small = distance <= limits[1] or max(sines) <= limits[2]
        assert joined[r, c] == (distance <= 0 or (distance <= limits[0] and small))
    assert compared > 100


def test_planes_agree_with_least_squares_of_numpy() -> None:
    random = np.random.default_rng(8)
    z = random.integers(-500, 500, (30, 26)).astype(np.int32)
    used = random.random(z.shape) < 0.2
    sums = plane_sums(z, used)
    carried = 0
    for r, c in itertools.product(range(30), range(26)):
        cells, level, across, along, carries = plane_around(sums, r, c, 4)
        box = slice(max(r - 4, 0), r + 5), slice(max(c - 4, 0), c + 5)
        y, x = np.nonzero(used[box])
        assert cells == len(x)
        if not carries:
            continue
        carried += 1
        design = np.column_stack((x + box[1].start - c, y + box[0].start - r, np.ones(len(x))))
        expected = np.linalg.lstsq(design, z[box][used[box]].astype(np.float64), rcond=None)[0]
        np.testing.assert_allclose((across, along, level), expected, atol=1e-6)
    assert carried > 600


def test_beyond_the_hull_a_slope_goes_on_and_a_step_does_not() -> None:
    z = np.rint(400.0 * np.arange(40) + np.zeros((20, 40))).astype(np.int32)
    z[:, 33:] += 3000
    ground = np.zeros(z.shape, np.bool_)
    ground[:, :30] = True
    asked = ~ground
    joined = np.zeros_like(ground)
    join_planes(z, ground, asked, joined, 8, (500.0, 200.0, 0.1))
    assert joined[:, 30:33].all()
    assert not joined[:, 33:].any()


# -- how far it looks --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [1.0, 0.25, 0.04])
@pytest.mark.parametrize("seed", range(4))
def test_the_ground_does_not_depend_on_the_window_beyond_the_support(seed: int, share: float) -> None:
    random = np.random.default_rng(seed)
    grid = hills(190, 200, slope=0.1, seed=seed)
    boxes = [(*random.integers(0, 180, 2), *random.integers(4, 14, 2)) for _ in range(60)]
    houses(grid, tuple((int(r), int(c), int(d), int(w)) for r, c, d, w in boxes), 4000)
    grid[random.random(grid.shape) < 0.01] -= 6000
    grid[40:70, 90:120] = NO_DATA
    grid = thinned(grid, share, seed)
    whole = terrain_under(grid, SMALL, (1000, -2000))
    margin = math.ceil(SMALL.support_m)
    r0, c0, rows, columns = 31 + seed, 27, 125 + seed, 140
    part = terrain_under(np.ascontiguousarray(grid[r0 : r0 + rows, c0 : c0 + columns]), SMALL, (1000 + c0, r0 - 2000))
    inner = slice(margin, rows - margin), slice(margin, columns - margin)
    same = slice(r0 + margin, r0 + rows - margin), slice(c0 + margin, c0 + columns - margin)
    assert part.measured[inner].size > 1000
    np.testing.assert_array_equal(part.measured[inner], whole.measured[same])
    np.testing.assert_array_equal(part.elevation_mm[inner], whole.elevation_mm[same])


def test_without_the_support_a_window_decides_otherwise() -> None:
    grid = hills(120, 120, slope=0.1)
    houses(grid, ((30, 30, 20, 30), (70, 60, 25, 25)), 5000)
    whole = terrain_under(grid, SMALL)
    part = terrain_under(np.ascontiguousarray(grid[40:, 40:]), SMALL, (40, 40))
    assert (part.measured != whole.measured[40:, 40:]).any()


def test_the_support_is_the_sum_of_the_steps() -> None:
    reaches = [level.reach for level in HIERARCHICAL.levels()]
    assert reaches == [48, 12, 12, 12, 12, 8, 8, 8, 8]
    assert [level.cell for level in HIERARCHICAL.levels()] == [12, 3, 3, 3, 3, 1, 1, 1, 1]
    # pits of 1 m and of 3 m, a cell of seeds, the passes, the planes under objects and their margin
    assert HIERARCHICAL.support_m == 2 + (3 * 3 - 1) + 47 + 128 + 32 + 4
    assert HIERARCHICAL.support_m < 250
    assert GroundSettings().support_m <= 200


@pytest.mark.parametrize("shift", [(48, -96), (84_000 - 84_000 % 48, 480_000)])
def test_a_shift_by_whole_seed_cells_shifts_the_ground_bit_for_bit(shift: tuple[int, int]) -> None:
    grid = hills(90, 80, slope=0.2)
    houses(grid, ((30, 30, 12, 10),))
    before, after = terrain_under(thinned(grid, 0.5)), terrain_under(thinned(grid, 0.5), corner=shift)
    np.testing.assert_array_equal(after.measured, before.measured)
    np.testing.assert_array_equal(after.elevation_mm, before.elevation_mm)


def test_an_unknown_filter_names_the_known_ones() -> None:
    with pytest.raises(SettingsError, match="filter is 'tin': use one of morphological, hierarchical"):
        GroundSettings(filter="tin")


def test_a_filter_that_looks_too_far_is_refused() -> None:
    with pytest.raises(
        SettingsError, match=r"filter looks .* m far, by seed_cell_m 96, level_ratio 2, passes 8: use fewer"
    ):
        GroundSettings(filter="hierarchical", seed_cell_m=96, level_ratio=2, passes=8)
    assert GroundSettings(seed_cell_m=96, level_ratio=2, passes=8).support_m == GroundSettings().support_m
    with pytest.raises(SettingsError, match="level_ratio is 1: use 2 to 8"):
        GroundSettings(filter="hierarchical", level_ratio=1)


def test_a_roof_that_fills_a_cut_cell_is_no_seed() -> None:
    grid = hills(110, 140, slope=0.05)
    # the data end two metres into a cell of seeds of 48 m, within a roof
    roofs = houses(grid, ((40, 84, 40, 14), (90, 10, 20, 30)), 5000)
    grid, roofs = np.ascontiguousarray(grid[:, :98]), roofs[:, :98]
    grid[:40, 96:] = NO_DATA
    grid[80:, 96:] = NO_DATA
    terrain = terrain_under(grid)
    assert not terrain.measured[roofs].any()
    assert terrain.measured[(grid != NO_DATA) & ~roofs].mean() > 0.99
