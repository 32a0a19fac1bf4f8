"""A town of points to surfaces: the buildings are found, the trees are not, and tiles change nothing."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from whole_scene import WholeScene, seen_m, split_alone
from whole_surfaces import WholeSplit, whole_surfaces

from pipeline.model import IntArray
from pipeline.scene import WindowPoints, lattice_of
from pipeline.terrain.candidates import Surfaces, judge_surfaces, unite_levels
from pipeline.terrain.decks_and_vehicles import shape_figures
from pipeline.terrain.facets import FacetKind
from pipeline.terrain.fragment_sums import Sum
from pipeline.terrain.lattice import NO_DATA
from pipeline.terrain.surfaces import Fragments
from pipeline.terrain.terrain_settings import (
    CandidateSettings,
    ClassesInUse,
    GroundSettings,
    OutlierSettings,
    SceneSettings,
    SurfaceSettings,
    VegetationSettings,
)
from pipeline.tiling import Tile, TileGrid, Window

GROUND, TREE, BUILDING = 2, 5, 6

IGNORED = ClassesInUse()
TRUSTED = ClassesInUse(ground=True, building=True)

WHOLE = Window(x0_mm=0, y0_mm=0, x1_mm=110_000, y1_mm=110_000)

NARROW = SceneSettings(
    outliers=OutlierSettings(cube_m=1.0),
    ground=GroundSettings(
        max_window_m=4,
        trend_m=4,
        widest_m=10,
        regrowth_passes=1,
        regrowth_m=1,
        rejoin_passes=1,
        rejoin_m=2,
        bridge_m=6,
        embankment_m2=0,
    ),
    vegetation=VegetationSettings(radius_m=0.5),
    surfaces=SurfaceSettings(max_circumradius_m=4.0),
)
"""Settings that look less far than the town is wide, so that the windows of its tiles do not all see the whole town."""


def taken(points: WindowPoints, index: npt.NDArray[Any]) -> WindowPoints:
    return WindowPoints(**{f.name: getattr(points, f.name)[index] for f in dataclasses.fields(points)})


def changed(points: WindowPoints, **columns: npt.NDArray[Any]) -> WindowPoints:
    return dataclasses.replace(points, **columns)


def with_points(points: WindowPoints, more: IntArray) -> WindowPoints:
    """The points and single returns at (k, 3) further places."""
    k = len(more)
    extra = {"x_mm": more[:, 0], "y_mm": more[:, 1], "z_mm": more[:, 2]}
    extra |= {"return_number": np.ones(k, np.uint8), "return_count": np.ones(k, np.uint8)}
    return WindowPoints(
        **{
            f.name: np.concatenate(
                (getattr(points, f.name), extra.get(f.name, np.zeros(k)).astype(getattr(points, f.name).dtype))
            )
            for f in dataclasses.fields(points)
        }
    )


def split_whole(
    points: WindowPoints, classes: ClassesInUse = IGNORED, settings: SceneSettings | None = None
) -> WholeScene:
    return split_alone(points, WHOLE, WHOLE, settings or SceneSettings(), classes)


def surfaces_of(f: Fragments) -> Surfaces:
    return Surfaces(
        kind=f.kind,
        sums=f.sums,
        boxes_mm=f.boxes_mm,
        lowest_point_mm=f.lowest_point_mm,
        along_steps=f.along_steps[:, :2],
    )


def candidate_of_points(found: WholeScene) -> IntArray:
    """Leader of the candidate of every point of the window, -1 where none; the core is the window."""
    surfaces = surfaces_of(found.fragments)
    leader = unite_levels(surfaces, judge_surfaces(surfaces, CandidateSettings()), CandidateSettings())
    out = np.full(found.core_index.max() + 1, -1, np.int64)
    assigned = found.point_fragment >= 0
    out[found.core_index[assigned]] = leader[found.point_fragment[assigned]]
    return out


# -- what is found -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("classes", [IGNORED, TRUSTED])
def test_the_buildings_are_found_and_the_trees_are_not(town: Any, classes: ClassesInUse) -> None:
    candidate = candidate_of_points(split_whole(town.points, classes))
    truth = town.truth[: len(candidate)]
    leaders = np.unique(candidate[candidate >= 0])
    # the gable house, and the block that takes in the storey on it
    assert len(leaders) == 2
    assert (truth[candidate >= 0] == BUILDING).all()
    assert (candidate[truth == BUILDING] >= 0).mean() > 0.98
    (house,) = np.unique(candidate[town.house[: len(candidate)] & (candidate >= 0)])
    assert (town.house[: len(candidate)] | (candidate != house)).all()


@pytest.mark.parametrize("per_m2", [2.0, 12.0])
def test_density_does_not_decide_what_is_found(town_of: Callable[..., Any], per_m2: float) -> None:
    sample = town_of(seed=2, per_m2=per_m2)
    candidate = candidate_of_points(split_whole(sample.points))
    truth = sample.truth[: len(candidate)]
    assert len(np.unique(candidate[candidate >= 0])) == 2
    assert (truth[candidate >= 0] == BUILDING).all()
    assert (candidate[truth == BUILDING] >= 0).mean() > 0.95


def object_on_flat_ground(
    height_m: Callable[[npt.NDArray[np.float64], npt.NDArray[np.float64]], npt.NDArray[np.float64]], per_m2: float = 16
) -> tuple[npt.NDArray[np.float64], WindowPoints]:
    """Single returns over level ground, 110 m by 110 m, with 2 cm of noise; and their places in metres."""
    random = np.random.default_rng(7)
    xy = random.uniform(0.0, 109.999, (round(110 * 110 * per_m2), 2))
    z = height_m(xy[:, 0], xy[:, 1]) + random.normal(0.0, 0.02, len(xy))
    once = np.ones(len(xy), np.uint8)
    x_mm, y_mm, z_mm = np.rint(1000 * np.column_stack((xy, z))).astype(np.int64).T.copy()
    return xy, WindowPoints(
        x_mm=x_mm,
        y_mm=y_mm,
        z_mm=z_mm,
        return_number=once,
        return_count=once,
        classification=np.zeros_like(once),
    )


@pytest.mark.parametrize("has_floor", [True, False])
def test_a_terrace_with_plants_is_a_roof_and_a_thicket_is_not(*, has_floor: bool) -> None:
    """Both reach from 4 m to 5.5 m, and half of their pulses return twice; only the terrace has an even floor."""
    random = np.random.default_rng(8)

    def heights(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        clutter = random.uniform(0.0, 1.5, len(x))
        if has_floor:
            clutter[random.random(len(x)) < 0.75] = 0.0
        inside = (x >= 50) & (x < 60) & (y >= 50) & (y < 58)
        return np.where(inside, 4.0 + clutter, 0.0)

    xy, points = object_on_flat_ground(heights)
    inside = (xy[:, 0] >= 50) & (xy[:, 0] < 60) & (xy[:, 1] >= 50) & (xy[:, 1] < 58)
    # the second of two returns, so that the surface lets no pulse through and yet has several returns
    twice = np.where(inside & (random.random(len(xy)) < 0.5), 2, 1).astype(np.uint8)
    points = changed(points, return_number=twice, return_count=twice)
    found = (candidate_of_points(split_whole(points)) >= 0).nonzero()[0]
    assert inside[found].all()
    assert len(found) > 0.8 * inside.sum() if has_floor else len(found) == 0
    rough = SceneSettings(vegetation=VegetationSettings(smooth_m=0.0))
    assert (candidate_of_points(split_whole(points, settings=rough)) < 0).all()


def test_a_hedge_that_touches_a_house_is_not_part_of_it() -> None:
    def heights(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        hedge = (x >= 40) & (x < 50) & (y >= 54) & (y < 54.8)
        lean_to = (x >= 60) & (x < 63) & (y >= 52) & (y < 56)
        house = (x >= 50) & (x < 60) & (y >= 50) & (y < 58)
        return np.where(house, 3.0, np.where(lean_to, 1.8, np.where(hedge, 1.6, 0.0)))

    xy, points = object_on_flat_ground(heights)
    x, y = xy.T
    # nothing cuts the surface: no facet spans 2 m
    settings = SceneSettings(surfaces=SurfaceSettings(steep_deg=90.0, wall_deg=90.0))
    without = SceneSettings(surfaces=SurfaceSettings(steep_deg=90.0, wall_deg=90.0, thin_m=0.0))
    hedge = (x >= 41) & (x < 49) & (y >= 54.1) & (y < 54.7)
    lean_to = (x >= 60.2) & (x < 62.8) & (y >= 52.2) & (y < 55.8)
    for chosen, is_part in ((settings, False), (without, True)):
        candidate = candidate_of_points(split_whole(points, settings=chosen))
        found = np.zeros(len(x), np.bool_)
        found[: len(candidate)] = candidate >= 0
        assert found[hedge].mean() > 0.7 if is_part else found[hedge].mean() < 0.2
        assert found[lean_to].mean() > 0.95


@pytest.mark.parametrize("width_m", [8, 24, 40])
def test_a_flat_roof_up_to_twice_the_largest_window_wide_is_found(width_m: int) -> None:
    random = np.random.default_rng(width_m)
    x, y = random.integers(0, 110_000, (2, 40_000))
    low, high = 55_000 - 500 * width_m, 55_000 + 500 * width_m
    roof = (x >= low) & (x < high) & (y >= low) & (y < high)
    once = np.ones(len(x), np.uint8)
    points = WindowPoints(
        x_mm=x,
        y_mm=y,
        z_mm=np.where(roof, 8000, 0) + random.integers(-30, 31, len(x)),
        return_number=once,
        return_count=once,
        classification=np.zeros_like(once),
    )
    candidate = candidate_of_points(split_whole(points))
    assert len(np.unique(candidate[candidate >= 0])) == 1
    assert not (candidate[~roof[: len(candidate)]] >= 0).any()
    assert (candidate[roof[: len(candidate)]] >= 0).mean() > 0.995


def test_the_terrain_is_the_ground_also_under_buildings_and_trees(town: Any) -> None:
    terrain = split_whole(town.points).terrain
    column, row = np.meshgrid(np.arange(110) + 0.5, np.arange(110) + 0.5)
    truth = 1000 * (0.03 * column - 0.02 * row + 0.5 * np.sin(column / 30) * np.cos(row / 25))
    error = np.abs(terrain.elevation_mm - truth)
    assert (terrain.elevation_mm != NO_DATA).all()
    assert np.median(error) < 40
    assert np.percentile(error, 99) < 200
    assert error.max() < 500


def test_strays_far_above_and_below_are_counted_and_change_nothing(town: Any) -> None:
    random = np.random.default_rng(1)
    strays = np.column_stack((random.integers(5000, 105_000, (12, 2)), np.repeat([-180_000, 180_000], 6)))
    before, after = split_whole(town.points), split_whole(with_points(town.points, strays.astype(np.int64)))
    assert (before.outliers, after.outliers) == (0, 12)
    np.testing.assert_array_equal(after.terrain.elevation_mm, before.terrain.elevation_mm)
    np.testing.assert_array_equal(after.fragments.sums, before.fragments.sums)
    np.testing.assert_array_equal(after.core_index, before.core_index)
    np.testing.assert_array_equal(after.point_fragment, before.point_fragment)


def test_a_tile_without_points_has_no_fragments(town: Any) -> None:
    found = split_whole(taken(town.points, np.zeros(len(town.points), np.bool_)))
    assert len(found.fragments.kind) == len(found.core_index) == len(found.point_fragment) == found.outliers == 0
    assert (found.terrain.elevation_mm == NO_DATA).all()


# -- classes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("excluded", [3, 5, 9, 17])
def test_where_classes_are_trusted_excluded_ones_never_enter(town: Any, excluded: int) -> None:
    classification = town.points.classification.copy()
    part = (town.truth == BUILDING) & (np.random.default_rng(excluded).random(len(classification)) < 0.3)
    classification[part] = excluded
    points = changed(town.points, classification=classification)
    found = split_whole(points, TRUSTED)
    assigned = np.zeros(len(points), np.bool_)
    assigned[found.core_index] = found.point_fragment >= 0
    assert not assigned[classification == excluded].any()
    assert not assigned[classification == GROUND].any()
    assert assigned[classification == BUILDING].mean() > 0.9
    ignored = split_whole(points)
    entered = np.zeros(len(points), np.bool_)
    entered[ignored.core_index] = ignored.point_fragment >= 0
    assert entered[part].mean() > 0.9


def test_excluded_points_between_neutral_ones_do_not_enter_either(town: Any) -> None:
    classification = np.where(town.truth == BUILDING, 1, town.truth).astype(np.uint8)
    part = (town.truth == BUILDING) & (np.random.default_rng(9).random(len(classification)) < 0.1)
    classification[part] = TREE
    found = split_whole(changed(town.points, classification=classification), TRUSTED)
    assigned = np.zeros(len(town.points), np.bool_)
    assigned[found.core_index] = found.point_fragment >= 0
    assert not assigned[classification == TREE].any()
    assert assigned[classification == 1].mean() > 0.5


def test_a_wholly_excluded_area_is_not_a_surface(town: Any) -> None:
    classification = np.where(town.truth == BUILDING, 17, town.truth).astype(np.uint8)
    found = split_whole(changed(town.points, classification=classification), TRUSTED)
    assert not np.isin(found.fragments.kind, (FacetKind.OBJECT, FacetKind.BUILDING)).any()


@pytest.mark.parametrize("excluded", [3, 5, 9, 17])
def test_excluded_classes_never_enter_in_a_file_without_class_6_either(town: Any, excluded: int) -> None:
    classification = np.where(town.truth == BUILDING, excluded, town.truth).astype(np.uint8)
    believed = ClassesInUse(ground=True, vegetation=True)
    found = split_whole(changed(town.points, classification=classification), believed)
    assert not np.isin(found.fragments.kind, (FacetKind.OBJECT, FacetKind.BUILDING)).any()


@pytest.mark.parametrize("neutral", [0, 1, 12, 19])
def test_neutral_classes_are_judged_by_their_own_evidence(town: Any, neutral: int) -> None:
    classification = np.where(town.house, neutral, town.points.classification).astype(np.uint8)
    found = split_whole(changed(town.points, classification=classification), TRUSTED)
    candidate = candidate_of_points(found)
    (house,) = np.unique(candidate[town.house[: len(candidate)] & (candidate >= 0)])
    assert found.fragments.kind[house] == FacetKind.OBJECT
    assert (candidate[town.house[: len(candidate)]] == house).mean() > 0.95


def test_classes_that_are_not_trusted_change_nothing(town: Any) -> None:
    wrong = np.random.default_rng(3).integers(0, 20, len(town.points)).astype(np.uint8)
    here, there = split_whole(town.points), split_whole(changed(town.points, classification=wrong))
    np.testing.assert_array_equal(there.fragments.sums, here.fragments.sums)
    np.testing.assert_array_equal(there.point_fragment, here.point_fragment)


def test_trusted_ground_alone_replaces_the_filter(town: Any) -> None:
    classification = town.points.classification.copy()
    raised = (town.truth == BUILDING) & ~town.house
    classification[raised] = GROUND
    found = split_whole(changed(town.points, classification=classification), ClassesInUse(ground=True))
    # the block counts as ground where the file says so, and only the house is left
    candidate = candidate_of_points(found)
    assert len(np.unique(candidate[candidate >= 0])) == 1
    assert (candidate[raised[: len(candidate)]] == -1).all()
    assert found.terrain.measured[27, 70]
    assert found.terrain.elevation_mm[27, 70] == pytest.approx(9000, abs=100)


@pytest.mark.parametrize("building", [True, False])
def test_trusted_vegetation_is_never_part_of_a_surface(town: Any, building: bool) -> None:
    classification = town.points.classification.copy()
    classification[town.house] = TREE
    if not building:
        classification[classification == BUILDING] = 1
    classes = ClassesInUse(ground=True, building=building, vegetation=True)
    found = split_whole(changed(town.points, classification=classification), classes)
    candidate = candidate_of_points(found)
    assert (candidate[classification[: len(candidate)] == TREE] == -1).all()
    assert (candidate >= 0).any()


# -- invariants --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shift_m", [(110, 220), (-3, 17), (84_000, 447_001), (-1000, -5)])
def test_a_shift_by_whole_metres_gives_the_same_fragments_there(town: Any, shift_m: tuple[int, int]) -> None:
    dx, dy = 1000 * shift_m[0], 1000 * shift_m[1]
    moved = changed(town.points, x_mm=town.points.x_mm + dx, y_mm=town.points.y_mm + dy)
    window = Window(x0_mm=dx, y0_mm=dy, x1_mm=dx + 110_000, y1_mm=dy + 110_000)
    here = split_whole(town.points)
    there = split_alone(moved, window, window, SceneSettings(), IGNORED)
    np.testing.assert_array_equal(there.terrain.elevation_mm, here.terrain.elevation_mm)
    np.testing.assert_array_equal(there.core_index, here.core_index)
    np.testing.assert_array_equal(there.point_fragment, here.point_fragment)
    np.testing.assert_array_equal(there.fragments.kind, here.fragments.kind)
    weights = [*range(Sum.AREA_W), Sum.AREA_W, Sum.LEVEL_W, Sum.GAP_W]
    np.testing.assert_array_equal(there.fragments.sums[:, weights], here.fragments.sums[:, weights])
    for name, figure in shape_figures(here.fragments.sums).items():
        np.testing.assert_array_equal(shape_figures(there.fragments.sums)[name], figure, err_msg=name)
    np.testing.assert_array_equal(there.fragments.along_steps, here.fragments.along_steps)
    np.testing.assert_array_equal(there.fragments.crossing_keys, here.fragments.crossing_keys + [dx, dy] * 3)
    owning = here.fragments.sums[:, Sum.FACETS] > 0
    np.testing.assert_array_equal(there.fragments.boxes_mm[owning], here.fragments.boxes_mm[owning] + [dx, dy] * 2)
    holding = here.fragments.sums[:, Sum.POINTS] > 0
    lowest = here.fragments.lowest_point_mm[holding] + [dx, dy, 0]
    np.testing.assert_array_equal(there.fragments.lowest_point_mm[holding], lowest)


@pytest.mark.parametrize("classes", [IGNORED, TRUSTED])
def test_the_order_of_the_points_does_not_matter(town: Any, classes: ClassesInUse) -> None:
    order = np.random.default_rng(5).permutation(len(town.points))
    here, there = split_whole(town.points, classes), split_whole(taken(town.points, order), classes)
    np.testing.assert_array_equal(there.fragments.sums, here.fragments.sums)
    np.testing.assert_array_equal(there.fragments.lowest_point_mm, here.fragments.lowest_point_mm)
    fragment = np.full(len(town.points), -2, np.int64)
    fragment[order[there.core_index]] = there.point_fragment
    np.testing.assert_array_equal(fragment[here.core_index], here.point_fragment)


def test_the_order_of_points_at_one_place_from_different_pulses_does_not_matter() -> None:
    random = np.random.default_rng(3)
    n = 24_000
    x, y = 1000 * random.integers(20, 80, (2, n)) + 500
    tree = np.hypot(x - 50_000, y - 50_000) < 9000
    count = np.where(tree, random.integers(1, 3, n), 1).astype(np.uint8)
    points = WindowPoints(
        x_mm=x,
        y_mm=y,
        z_mm=np.where(tree, 1000 * random.integers(6, 9, n), 0),
        return_number=count,
        return_count=count,
        classification=np.zeros(n, np.uint8),
    )
    halved = SceneSettings(vegetation=VegetationSettings(pierced_share=0.5))
    here = split_whole(points, settings=halved)
    for order in (np.arange(n)[::-1], random.permutation(n)):
        there = split_whole(taken(points, order), settings=halved)
        np.testing.assert_array_equal(there.fragments.kind, here.fragments.kind)
        np.testing.assert_array_equal(there.fragments.sums, here.fragments.sums)


@given(
    x0=st.integers(-(10**9), 10**9),
    y0=st.integers(-(10**9), 10**9),
    width=st.integers(1, 10**6),
    depth=st.integers(1, 10**6),
)
def test_the_lattice_of_the_terrain_covers_its_window_and_no_more(x0: int, y0: int, width: int, depth: int) -> None:
    column0, row0, columns, rows = lattice_of(Window(x0_mm=x0, y0_mm=y0, x1_mm=x0 + width, y1_mm=y0 + depth))
    assert column0 == math.floor(x0 / 1000)
    assert row0 == math.floor(y0 / 1000)
    assert (column0 + columns - 1) * 1000 < x0 + width <= (column0 + columns) * 1000
    assert (row0 + rows - 1) * 1000 < y0 + depth <= (row0 + rows) * 1000


def test_every_stage_widens_the_support() -> None:
    base = SceneSettings()
    wider = [
        SceneSettings(outliers=OutlierSettings(cube_m=6.0)),
        SceneSettings(ground=GroundSettings(max_window_m=30)),
        SceneSettings(ground=GroundSettings(bridge_m=80)),
        SceneSettings(ground=GroundSettings(trend_m=20)),
        SceneSettings(ground=GroundSettings(widest_m=120)),
        SceneSettings(ground=GroundSettings(rejoin_m=5, rejoin_passes=5)),
        SceneSettings(surfaces=SurfaceSettings(max_circumradius_m=7.0)),
        SceneSettings(vegetation=VegetationSettings(radius_m=1.2)),
    ]
    assert all(seen_m(settings, IGNORED) > seen_m(base, IGNORED) for settings in wider)


# -- tiles -------------------------------------------------------------------------------------------------------------


def described(tile: Tile, found: WholeScene) -> WholeSplit:
    """What is united of a split."""
    return WholeSplit(tile=tile, fragments=found.fragments, starts=np.zeros(1, np.int64), keys=np.empty(0, np.int64))


def in_tiles(
    points: WindowPoints, grid: TileGrid, settings: SceneSettings, classes: ClassesInUse
) -> tuple[list[tuple[int, ...]], IntArray]:
    """Rows that describe every whole surface, sorted, and for every point the smallest point of its surface."""
    columns, rows = grid.columns_rows(points.x_mm, points.y_mm)
    tiles = sorted({Tile(c, r) for c, r in zip(columns.tolist(), rows.tolist(), strict=True)})
    splits, owners = [], []
    for tile in tiles:
        window = grid.window(tile)
        seen = np.flatnonzero(window.contains(points.x_mm, points.y_mm))
        found = split_alone(taken(points, seen), grid.core(tile), window, settings, classes)
        splits.append(described(tile, found))
        owners.append((seen[found.core_index], found.point_fragment))
    surfaces, surface_of_fragment, offsets = whole_surfaces(splits)
    whose = np.full((len(points), 3), -1, np.int64)
    for (index, fragment), offset in zip(owners, offsets[:-1], strict=True):
        held = fragment >= 0
        whose[index[held]] = surfaces.lowest_point_mm[surface_of_fragment[offset + fragment[held]]]
    described_rows = np.column_stack((surfaces.kind, surfaces.sums, surfaces.boxes_mm, surfaces.lowest_point_mm))
    steps = np.zeros((len(surfaces.kind), 2), np.int64)
    for column in (0, 1):
        np.add.at(steps[:, column], surfaces.along_steps[:, column], surfaces.along_steps[:, 2])
    owning = (surfaces.sums != 0).any(axis=1)
    return sorted(map(tuple, np.column_stack((described_rows, steps))[owning].tolist())), whose


@pytest.mark.parametrize("classes", [IGNORED, TRUSTED])
@pytest.mark.parametrize("per_m2", [4.0, 0.3])
@pytest.mark.parametrize(("size_mm", "origin_mm"), [(30_000, (0, 0)), (37_000, (-11_123, 4_567))])
def test_tiles_give_the_surfaces_of_the_whole(
    town_of: Callable[..., Any], classes: ClassesInUse, per_m2: float, size_mm: int, origin_mm: tuple[int, int]
) -> None:
    sample = town_of(seed=7, per_m2=per_m2, noise_m=0.05)
    p = sample.points
    random = np.random.default_rng(7)
    # water without returns, and strays of which some have company
    dry = ~((p.x_mm > 30_000) & (p.x_mm < 41_000) & (p.y_mm > 75_000)) | (random.random(len(p)) < 0.02)
    strays = np.column_stack((random.integers(0, 110_000, (60, 2)), random.integers(-9000, 30_000, 60)))
    points = with_points(taken(p, dry), np.repeat(strays, 3, axis=0) + random.integers(0, 900, (180, 3)))
    points = taken(points, WHOLE.contains(points.x_mm, points.y_mm))
    support_mm = math.ceil(1000 * seen_m(NARROW, classes))
    everything = TileGrid(size_mm=400_000, halo_mm=support_mm, origin_x_mm=-100_000, origin_y_mm=-100_000)
    expected, expected_owner = in_tiles(points, everything, NARROW, classes)
    grid = TileGrid(size_mm=size_mm, halo_mm=support_mm, origin_x_mm=origin_mm[0], origin_y_mm=origin_mm[1])
    found, owner = in_tiles(points, grid, NARROW, classes)
    assert len(expected) >= 5  # those of ground are none
    assert found == expected
    np.testing.assert_array_equal(owner, expected_owner)
