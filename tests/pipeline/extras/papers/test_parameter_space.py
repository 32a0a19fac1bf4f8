"""Both recipes on roofs whose planes are known: the leaves of the trees, the primitive, and what must not matter."""

import dataclasses
import math
import re
import tomllib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from candidates_by_hand import TURNS, Matrix, candidate, moved, strewn, turned
from checkout import ROOT

from pipeline.errors import BuildingError, SettingsError
from pipeline.extras.papers.paper_settings import ParameterSpace2dSettings, ParameterSpace3dSettings
from pipeline.extras.papers.parameter_space import segment_2d, segment_3d
from pipeline.methods import METHODS
from pipeline.model import Candidate, FloatArray, Reason, RoofType, Segmentation
from pipeline.prepared_cloud import prepare_cloud
from pipeline.settings import RunSettings

Height = Callable[[FloatArray, FloatArray], FloatArray]
Segment = Callable[[Candidate], Segmentation]

RECIPES: dict[str, Segment] = {
    "2d faithful": lambda one: segment_2d(prepare_cloud(one), ParameterSpace2dSettings.faithful()),
    "3d faithful": lambda one: segment_3d(prepare_cloud(one), ParameterSpace3dSettings.faithful()),
    "2d robust": lambda one: segment_2d(prepare_cloud(one), ParameterSpace2dSettings()),
    "3d robust": lambda one: segment_3d(prepare_cloud(one), ParameterSpace3dSettings()),
}
FAITHFUL = [name for name in RECIPES if "faithful" in name]
ROBUST = [name for name in RECIPES if "robust" in name]


def candidate_of(points: FloatArray, *, slope: float = 0.0) -> Candidate:
    """Points with terrain on a 1 m lattice beneath and 12 m around."""
    low, high = np.floor(points[:, :2].min(axis=0)) - 12, np.ceil(points[:, :2].max(axis=0)) + 12
    x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    z = slope * x.ravel() + np.random.default_rng(9).normal(0, 0.03, x.size)
    ground = np.rint(np.column_stack([x.ravel(), y.ravel(), z]) * 1000) / 1000
    return candidate(points, ground=ground, ground_z_m=float(z.min()))


def roof(height: Height, *, slope: float = 0.0, **options: Any) -> Candidate:
    """Points strewn over a turned rectangle, heights by its own axes u and v."""
    usual = {"width": 10.0, "density": 1.0, "noise": 0.04, "seed": 0}
    return candidate_of(strewn(height, **{**usual, **options}), slope=slope)


def gable(pitch_deg: float = 35.0, **options: Any) -> Candidate:
    rise = math.tan(math.radians(pitch_deg))
    return roof(lambda u, v: 9 - rise * np.abs(v) + 0 * u, **options)


def pent(pitch_deg: float = 20.0, **options: Any) -> Candidate:
    rise = math.tan(math.radians(pitch_deg))
    return roof(lambda u, v: 7 + rise * v + 0 * u, **options)


def hip(**options: Any) -> Candidate:
    return roof(lambda u, v: 9 - 0.7 * np.maximum(np.abs(v), np.abs(u) - 3), length=18.0, width=12.0, **options)


def two_gables(**options: Any) -> Candidate:
    """Two parallel ridges 12 m apart: their faces are alike in slope and orientation."""
    return roof(lambda u, v: 9 - 0.7 * np.abs(np.abs(v) - 6) + 0 * u, width=24.0, **options)


@pytest.mark.parametrize("recipe", ["3d faithful", *ROBUST])
@pytest.mark.parametrize("seed", range(4))
def test_a_gable_gives_two_planes_of_its_slope(recipe: str, seed: int) -> None:
    found = RECIPES[recipe](gable(seed=seed))
    assert found.roof_type == (RoofType.GABLE if recipe in FAITHFUL else None)
    assert len(found.planes) == 2
    # by membership the points along ridge and eaves go to either side, as the paper says of its groups
    tolerance = 4.0 if recipe in FAITHFUL else 1.5
    assert all(plane.slope_deg == pytest.approx(35, abs=tolerance) for plane in found.planes)
    assert (found.labels >= 0).mean() > 0.9


def test_in_two_dimensions_terrain_and_roof_grow_together_more_often_than_in_three() -> None:
    """The paper's main result: without the O-distance a roof face and the ground are one snake of facets."""

    def right(recipe: str) -> int:
        return sum(RECIPES[recipe](gable(seed=seed)).roof_type is RoofType.GABLE for seed in range(10))

    assert 1 <= right("2d faithful") < right("3d faithful") == 10


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_pent_roof_on_level_terrain_is_one_plane(recipe: str) -> None:
    found = RECIPES[recipe](pent(25.0))
    assert found.roof_type == (RoofType.PENT if recipe in FAITHFUL else None)
    assert [plane.slope_deg for plane in found.planes] == [pytest.approx(25, abs=1.0)]


def test_sloping_terrain_spoils_a_pent_roof_in_two_dimensions_and_not_in_three() -> None:
    one = pent(25.0, slope=0.2)
    assert RECIPES["2d faithful"](one).roof_type is RoofType.UNKNOWN
    assert RECIPES["3d faithful"](one).roof_type is RoofType.PENT


def test_parallel_gables_are_separated_in_three_dimensions_alone() -> None:
    one = two_gables(density=1.5)
    flat, deep = RECIPES["2d faithful"](one), RECIPES["3d faithful"](one)
    assert (flat.roof_type, len(flat.planes)) == (RoofType.GABLE, 2)
    assert (deep.roof_type, len(deep.planes)) == (RoofType.COMBINATION, 4)


@pytest.mark.parametrize("recipe", ROBUST)
def test_region_growing_says_parallel_gables_apart_in_any_case(recipe: str) -> None:
    found = RECIPES[recipe](two_gables(density=1.5))
    assert len(found.planes) == 4
    assert {round(plane.slope_deg / 35) for plane in found.planes} == {1}


@pytest.mark.parametrize("recipe", FAITHFUL)
def test_no_tree_calls_a_roof_hip(recipe: str) -> None:
    types = {RECIPES[recipe](hip(seed=seed)).roof_type for seed in range(4)}
    assert RoofType.HIP not in types


def test_a_hip_roof_has_four_planes_by_region_growing_in_three_dimensions() -> None:
    right = sum(len(RECIPES["3d robust"](hip(seed=seed)).planes) == 4 for seed in range(6))
    assert right >= 5


@pytest.mark.parametrize("recipe", ROBUST)
def test_a_flat_roof_is_one_plane_where_terrain_is_left_out(recipe: str) -> None:
    found = RECIPES[recipe](roof(lambda u, v: 6 + 0 * u + 0 * v, density=2.0))
    assert len(found.planes) == 1
    assert found.planes[0].slope_deg < 1.0


@pytest.mark.parametrize("choice", ["keep", "drop", "leave_out"])
def test_clusters_of_terrain_and_walls_carry_no_plane_whatever_becomes_of_them(choice: str) -> None:
    cloud, chosen = prepare_cloud(gable(slope=0.2)), {"ground_clusters": choice, "point_groups": "membership"}
    flat = segment_2d(cloud, ParameterSpace2dSettings(**chosen))
    for found in (flat, segment_3d(cloud, ParameterSpace3dSettings(**chosen))):
        assert all(25 < plane.slope_deg < 45 for plane in found.planes if plane.n_points > 20)
        assert sum(plane.n_points > 20 for plane in found.planes) == 2


@pytest.mark.parametrize("recipe", RECIPES)
def test_moved_by_whole_metres_the_labels_stay_the_same(recipe: str) -> None:
    shift = np.array([1203.0, -777.0, 41.0])
    here, there = RECIPES[recipe](hip()), RECIPES[recipe](moved(hip(), shift))
    assert here.labels.tolist() == there.labels.tolist()
    assert here.roof_type == there.roof_type
    for a, b in zip(here.planes, there.planes, strict=True):
        np.testing.assert_allclose([a.a, a.b], [b.a, b.b], atol=1e-12)
        assert a.c + shift[2] == pytest.approx(b.c + b.a * shift[0] + b.b * shift[1], abs=1e-6)


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("matrix", TURNS)
def test_mirrored_or_turned_by_90_degrees_planes_and_type_are_the_same(recipe: str, matrix: Matrix) -> None:
    one = gable(seed=2)
    other, order = turned(one, matrix)
    here, there = RECIPES[recipe](one), RECIPES[recipe](other)
    assert here.roof_type == there.roof_type
    gradients = sorted((np.array([plane.a, plane.b]) @ np.array(matrix).T).round(1).tolist() for plane in here.planes)
    assert gradients == sorted([round(plane.a, 1), round(plane.b, 1)] for plane in there.planes)
    # four terrain samples on a common circle are cut along either diagonal, and boxes have borders
    agreed = [
        (np.append(p, -1)[here.labels[order]] == there.labels).mean()
        for p in (np.arange(len(here.planes)), np.arange(len(here.planes))[::-1])
    ]
    assert max(agreed) > 0.9


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_order_of_points_before_they_are_sorted_does_not_matter_and_twice_gives_the_same_bits(recipe: str) -> None:
    one = hip(seed=3)
    shuffled = candidate(np.random.default_rng(0).permutation(one.points))
    again = dataclasses.replace(one, points=shuffled.points, ground=one.ground[::-1])
    first, second, third = (RECIPES[recipe](c) for c in (one, one, again))
    assert first.planes == second.planes == third.planes
    assert first.labels.tobytes() == second.labels.tobytes() == third.labels.tobytes()


@pytest.mark.parametrize("recipe", RECIPES)
def test_points_beneath_the_roof_take_no_part(recipe: str) -> None:
    points = gable().points
    facade = np.column_stack([points[::7, :2] + 0.1, np.linspace(0.5, 3.5, len(points[::7]))])
    both = candidate_of(np.concatenate([points, facade]))
    found = RECIPES[recipe](both)
    assert (found.labels[both.points[:, 2] < 3.6] == -1).all()
    assert (found.labels[both.points[:, 2] >= 3.6] >= 0).mean() > 0.85


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_roof_without_terrain_samples_is_segmented_too(recipe: str) -> None:
    bare = dataclasses.replace(gable(seed=1), ground=np.zeros((0, 3)))
    assert len(RECIPES[recipe](bare).planes) == 2


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("seed", range(2))
def test_every_plane_has_points_and_every_label_a_plane(recipe: str, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-6, 6, (300, 3)) * np.array([1, 1, 0.15]) + np.array([0, 0, 6])
    found = RECIPES[recipe](candidate_of(points))
    assert set(found.labels.tolist()) - {-1} == set(range(len(found.planes)))
    counted = np.bincount(found.labels[found.labels >= 0], minlength=len(found.planes)).tolist()
    assert [plane.n_points for plane in found.planes] == counted


@pytest.mark.parametrize("recipe", RECIPES)
def test_too_few_visible_points_are_reported_with_their_number(recipe: str) -> None:
    with pytest.raises(BuildingError, match="3 of 3 points are visible from above, at least 4") as caught:
        RECIPES[recipe](candidate_of(np.array([[0.0, 0, 5], [1, 0, 5], [0, 1, 5]])))
    assert caught.value.reason is Reason.TOO_FEW_POINTS
    empty = dataclasses.replace(gable(), points=np.zeros((0, 3)))
    with pytest.raises(BuildingError, match="0 of 0 points"):
        RECIPES[recipe](empty)


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize(
    "xy",
    [np.zeros((30, 2)), np.column_stack([np.arange(30.0), np.zeros(30)]), np.column_stack([np.arange(30.0)] * 2)],
    ids=["one place", "one line", "a diagonal"],
)
def test_points_that_hold_no_plane_give_none(recipe: str, xy: FloatArray) -> None:
    points = np.column_stack([xy * 0.3, 5 + 0.01 * np.arange(30)])
    found = RECIPES[recipe](candidate_of(points))
    assert found.planes == ()
    assert (found.labels == -1).all()


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_candidate_wider_than_a_tin_is_too_complex(recipe: str) -> None:
    points = gable().points
    wide = dataclasses.replace(gable(), points=np.concatenate([points, points + np.array([3000.0, 0, 0])]))
    with pytest.raises(BuildingError, match="extends over 30") as caught:
        RECIPES[recipe](wide)
    assert caught.value.reason is Reason.TOO_COMPLEX


def test_beyond_the_limits_of_work_a_building_is_too_complex() -> None:
    with pytest.raises(BuildingError, match="linkage_work_limit is 5"):
        segment_2d(prepare_cloud(gable()), ParameterSpace2dSettings(linkage_work_limit=5))
    with pytest.raises(BuildingError, match="membership_work_limit is 5"):
        segment_3d(prepare_cloud(gable()), ParameterSpace3dSettings(membership_work_limit=5))


def test_the_faithful_settings_hold_the_papers_figures() -> None:
    flat, deep = ParameterSpace2dSettings.faithful(), ParameterSpace3dSettings.faithful()
    assert (flat.min_members, flat.min_linkage_deg, flat.largest_cluster_share) == (11, 4.0, 0.8)
    assert (flat.min_slope_deg, flat.max_slope_deg) == (7.0, 75.0)
    assert (deep.box_slope_deg, deep.box_orientation_deg, deep.box_o_distance_m) == (7.0, 10.0, 2.0)
    assert (deep.max_o_deviation_m, deep.ground_below_deg, deep.wall_above_deg) == (1.3, 4.0, 76.0)
    for settings in (flat, deep):
        assert (settings.ground_clusters, settings.point_groups, settings.type_from) == ("keep", "membership", "tree")
    assert METHODS["parameter-space-2d"].preset("faithful") == flat
    assert METHODS["parameter-space-3d"].preset("faithful") == deep


def test_contradicting_settings_of_all_stages_are_named_at_once() -> None:
    with pytest.raises(SettingsError) as caught:
        ParameterSpace2dSettings(min_linkage_deg=12.0, min_growing_m=0.5, point_groups="chance", min_members=0)
    assert len(caught.value.faults) == 4


def test_the_page_of_the_methods_says_the_literal_forms() -> None:
    page = (ROOT / "docs" / "methods" / "parameter_space.md").read_text()
    blocks = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    forms = [RunSettings.from_mapping(tomllib.loads(block)["settings"]).building.method for block in blocks]
    assert forms == [ParameterSpace2dSettings.faithful(), ParameterSpace3dSettings.faithful()]


@pytest.mark.slow
def test_a_city_block_of_100_000_points_is_segmented_whole() -> None:
    house = gable(density=7.0).points
    copies = [house + np.array([24.0 * i, 20.0 * j, 0]) for i in range(11) for j in range(10)]
    block = candidate_of(np.concatenate(copies))
    for recipe in ROBUST:
        found = RECIPES[recipe](block)
        assert len(found.labels) > 90_000
        assert (found.labels >= 0).mean() > 0.8


@pytest.mark.parametrize(
    ("segment", "settings"), [(segment_2d, ParameterSpace2dSettings()), (segment_3d, ParameterSpace3dSettings())]
)
@pytest.mark.parametrize("rise", [0.0, 0.05, 0.5])
def test_a_roof_without_any_noise_is_one_plane(segment: Any, settings: Any, rise: float) -> None:
    steps = np.arange(0.25, 10.0, 0.5)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    found = segment(prepare_cloud(candidate(np.column_stack((x, y, 6.0 + rise * x)))), settings)
    assert len(found.planes) == 1
    assert found.planes[0].a == pytest.approx(rise, abs=1e-3)
    assert (found.labels == 0).all()
