"""The whole recipe of Zeng et al.: exact gables come back, other roofs find their way, and what must not matter."""

import dataclasses
import math
import re
import tomllib
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import shapely
from candidates_by_hand import Plane, candidate, gable_planes, hip_planes, lowest_of, moved, strewn, turned_plan
from checkout import ROOT

from pipeline.errors import BuildingError, SettingsError
from pipeline.extras.papers import kmeans
from pipeline.extras.papers.kmeans import building_top, cluster_facets
from pipeline.extras.papers.paper_settings import KMeansSettings
from pipeline.methods import METHODS, ReconstructSettings
from pipeline.model import BuildingResult, Candidate, FloatArray, Reason, RoofType, Segmentation, Status
from pipeline.prepared_cloud import prepare_cloud
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.segmentation.facet_geometry import vertical_residuals_m

PAGE = ROOT / "docs" / "methods" / "kmeans.md"
FAITHFUL = KMeansSettings.faithful()
ROBUST = KMeansSettings()
PRESETS = pytest.mark.parametrize("settings", [ROBUST, FAITHFUL], ids=["robust", "faithful"])


def segment(one: Candidate, settings: KMeansSettings) -> Segmentation:
    return kmeans.segment(prepare_cloud(one), settings)


def modelled(one: Candidate, settings: KMeansSettings) -> BuildingResult:
    return reconstruct_building(one, "kmeans", ReconstructSettings(method=settings))


def candidate_of(points: FloatArray, footprint: shapely.Polygon | None = None) -> Candidate:
    """Points on level ground at z = 0."""
    lattice = np.arange(-14.0, 15.0)
    return candidate(points, ground=np.array([(x, y, 0.0) for x in lattice for y in lattice]), footprint=footprint)


def roof(planes: Sequence[Plane], footprint: shapely.Polygon | None = None, **options: Any) -> Candidate:
    """Points strewn on the lowest of some planes over a turned rectangle."""
    usual = {"density": 2.0, "noise": 0.03, "seed": 0}
    return candidate_of(strewn(lowest_of(planes), **{**usual, **options}), footprint)


def rectangle(degrees: float, half_length: float = 7.0, half_width: float = 4.0) -> shapely.Polygon:
    u, v = half_length, half_width
    return shapely.Polygon(turned_plan(np.array([(-u, -v), (u, -v), (u, v), (-u, v)]), degrees))


def exact_gable(degrees: float, step: float = 0.5) -> Candidate:
    u, v = np.arange(-7, 7 + step / 2, step), np.arange(-4, 4 + step / 2, step)
    uv = np.array([(a, b) for a in u for b in v])
    return candidate_of(np.column_stack([turned_plan(uv, degrees), 8 - 0.7 * np.abs(uv[:, 1])]))


def outline_of(found: Segmentation) -> shapely.Polygon:
    assert found.faces is not None
    united = shapely.union_all([face.polygon for face in found.faces], grid_size=1e-3)
    assert isinstance(united, shapely.Polygon)
    return united


@pytest.mark.parametrize("degrees", [0.0, 17.0, 60.0, 90.0, 145.0])
def test_a_gable_without_noise_comes_back_exactly(degrees: float) -> None:
    one = exact_gable(degrees)
    found = segment(one, FAITHFUL)
    assert found.roof_type is RoofType.GABLE
    assert outline_of(found).symmetric_difference(rectangle(degrees)).area < 0.25
    for plane in found.planes:
        assert plane.slope_deg == pytest.approx(math.degrees(math.atan(0.7)), abs=0.1)
        assert plane.rmse_m < 0.01
    residuals = [np.abs(vertical_residuals_m(one.points, plane.coefficients)) for plane in found.planes]
    assert np.minimum(*residuals).max() < 0.02
    assert (found.labels >= 0).all()
    result = modelled(one, FAITHFUL)
    assert (result.status, result.lod, result.validity_codes) == (Status.OK, "2.2", ())
    assert [len(solid.vertices) for solid in result.solids] == [10]
    assert result.rmse_m < 0.01


@pytest.mark.parametrize("pitch_deg", [12.0, 25.0, 45.0])
@PRESETS
def test_a_noisy_gable_becomes_the_model_of_ten_vertices(settings: KMeansSettings, pitch_deg: float) -> None:
    for seed in range(5):
        result = modelled(roof(gable_planes(pitch_deg), seed=seed), settings)
        # unrefined, a plane may be so far off that the points do not support it, and the model says so
        is_off = settings is FAITHFUL and result.rmse_m > 0.1
        assert (result.status, result.reason) == ((Status.DOUBTFUL, Reason.SCATTERED) if is_off else (Status.OK, None))
        assert result.roof_type is RoofType.GABLE
        assert [len(solid.vertices) for solid in result.solids] == [10]
        assert check_solid(result.solids[0]) == ()
        # unrefined, the clusters hold points of the other side where noise turned small facets
        assert result.rmse_m < (0.15 if settings is FAITHFUL else 0.08)
        assert result.footprint is not None
        truth = rectangle(17.0)
        overlap = result.footprint.intersection(truth).area / result.footprint.union(truth).area
        assert overlap > (0.9 if settings is FAITHFUL else 0.95)


@pytest.mark.parametrize(
    ("planes", "kind", "slope_deg"),
    [
        ([(0.0, 0.0, 6.0)], RoofType.FLAT, 0.0),
        ([(0.0, 0.3, 6.0)], RoofType.PENT, 16.7),
        ([(0.3, 0, 7)], RoofType.PENT, 16.7),
    ],
)
@PRESETS
def test_one_plane_becomes_the_box_of_eight_vertices(
    settings: KMeansSettings, planes: list[Plane], kind: RoofType, slope_deg: float
) -> None:
    for seed in range(5):
        result = modelled(roof(planes, seed=seed), settings)
        assert (result.status, result.roof_type) == (Status.OK, kind)
        assert [len(solid.vertices) for solid in result.solids] == [8]
        assert result.planes[0].slope_deg == pytest.approx(slope_deg, abs=1.0)
        assert result.rmse_m < 0.1


def test_unequal_pitches_give_the_faithful_model_two_equal_sides_and_a_residual() -> None:
    one = roof(gable_planes(30.0, 45.0), noise=0.01)
    first, second = (plane.slope_deg for plane in segment(one, FAITHFUL).planes)
    assert first == pytest.approx(second, abs=0.2)
    assert modelled(one, FAITHFUL).rmse_m > 0.2, "the record says how badly a symmetric model fits"
    robust = segment(one, ROBUST)
    assert robust.faces is None, "the symmetric model does not explain the building"
    assert sorted(plane.slope_deg for plane in robust.planes) == pytest.approx([30, 45], abs=1)


def test_a_hip_roof_is_more_than_the_model_and_is_drawn_from_its_labels_and_with_k_2_it_is_a_gable() -> None:
    for seed in range(4):
        found = segment(roof(hip_planes(), seed=seed), ROBUST)
        assert (found.faces, found.roof_type, len(found.planes)) == (None, None, 4)
    assert segment(roof(hip_planes(), density=0.7), FAITHFUL).roof_type is RoofType.GABLE


def test_two_levels_of_one_direction_are_split_by_where_they_hang_together() -> None:
    random = np.random.default_rng(4)
    xy = random.uniform(-7, 7, (600, 2))
    z = np.where(xy[:, 0] < 0, 9.0, 5.0) + random.normal(0, 0.03, 600)
    found = segment(candidate_of(np.column_stack([xy, z])), ROBUST)
    assert sorted(plane.c for plane in found.planes) == pytest.approx([5, 9], abs=0.1)
    assert found.faces is None


def test_nearly_parallel_planes_that_meet_beside_the_building_are_a_labelled_block_of_the_faithful_recipe() -> None:
    random = np.random.default_rng(4)
    xy = random.uniform(-7, 7, (600, 2))
    z = np.where(xy[:, 0] < 0, 9.0, 6.0 - 0.15 * xy[:, 0]) + random.normal(0, 0.01, 600)
    one = candidate_of(np.column_stack([xy, z]))
    with pytest.raises(BuildingError, match=r"min_side_share is 0\.5") as error:
        segment(one, FAITHFUL)
    assert error.value.reason is Reason.NO_PARTITION
    result = modelled(one, FAITHFUL)
    assert (result.status, result.reason, result.lod) == (Status.FALLBACK, Reason.NO_PARTITION, "1.2")


def test_a_given_footprint_is_kept_by_the_robust_recipe_and_replaced_by_the_faithful_one() -> None:
    footprint = rectangle(17.0, 7.2, 4.2)
    one = roof(gable_planes(), footprint)
    kept = modelled(one, ROBUST)
    assert kept.footprint is not None
    assert kept.footprint.symmetric_difference(footprint).area < 0.05
    for settings in (dataclasses.replace(ROBUST, outline="rectangle"), FAITHFUL):
        assert segment(one, settings).faces is not None


@PRESETS
def test_the_outcome_moves_with_the_building_by_whole_metres(settings: KMeansSettings) -> None:
    one, shift = roof(gable_planes(), noise=0.05), np.array([1203.0, -777.0, 41.0])
    here, there = segment(one, settings), segment(moved(one, shift), settings)
    assert (here.labels == there.labels).all()
    assert here.faces is not None
    assert there.faces is not None
    before, after = (shapely.get_coordinates([face.polygon for face in found.faces]) for found in (here, there))
    assert before + shift[:2] == pytest.approx(after, abs=1e-9)


@PRESETS
def test_the_model_turns_with_the_building(settings: KMeansSettings) -> None:
    one = segment(roof(gable_planes(), turn_deg=0.0), settings)
    for degrees in (31.0, 90.0, 222.0):
        other = segment(roof(gable_planes(), turn_deg=degrees), settings)
        corners = turned_plan(shapely.get_coordinates(outline_of(one)), degrees)
        assert outline_of(other).symmetric_difference(shapely.Polygon(corners)).area < 0.5


@PRESETS
def test_the_order_of_the_points_does_not_matter(settings: KMeansSettings) -> None:
    house = roof(gable_planes(), noise=0.04)
    order = np.random.default_rng(1).permutation(len(house.points))
    shuffled = dataclasses.replace(house, points=house.points[order])
    one, other = segment(house, settings), segment(shuffled, settings)
    assert outline_of(one).symmetric_difference(outline_of(other)).area < 1e-2
    first, second = (np.array(sorted(plane.coefficients for plane in found.planes)) for found in (one, other))
    assert first == pytest.approx(second, abs=1e-3)
    sides = np.array([plane.b for plane in one.planes])[one.labels[order]]
    assert (np.sign(sides) == np.sign(np.array([plane.b for plane in other.planes])[other.labels])).mean() > 0.99


def test_the_two_clusters_of_a_gable_are_its_two_sides() -> None:
    top = building_top(prepare_cloud(roof(gable_planes(), density=1.0, noise=0.05, turn_deg=0.0)), FAITHFUL)
    labels, clusters = cluster_facets(top, FAITHFUL)
    north = top.points[top.tin.facets][:, :, 1] > top.points[:, 1].mean() + 1.0
    south = top.points[top.tin.facets][:, :, 1] < top.points[:, 1].mean() - 1.0
    sides = [np.bincount(labels[side.all(axis=1) & (labels >= 0)], minlength=2) for side in (north, south)]
    assert sides[0].argmax() != sides[1].argmax()
    assert all(side.max() > 0.95 * side.sum() for side in sides)
    assert clusters.silhouette > 0.8


def test_points_below_others_and_far_from_the_model_have_no_label() -> None:
    odd = np.array([[1.5, 2.0, 2.0], [-3.0, -2.0, 11.0]])
    with_odd = candidate_of(np.concatenate([roof(gable_planes(), turn_deg=0.0).points, odd]))
    found = segment(with_odd, FAITHFUL)
    for point in odd:
        index = np.flatnonzero((with_odd.points == point).all(axis=1))
        assert found.labels[index].tolist() == [-1]
    assert (found.labels >= 0).mean() > 0.95


@pytest.mark.parametrize(
    ("points", "message", "reason"),
    [
        (
            np.array([(0, 0, 5.0), (4, 0, 5), (0, 4, 5), (4, 4, 5)]),
            "4 of 4 points are visible from above, min_points is 6",
            Reason.TOO_FEW_POINTS,
        ),
        (np.array([(x, 2 * x, 5.0 + x) for x in range(20)]), "0 of 0 facets", Reason.NO_PLANE),
        (
            np.random.default_rng(2).uniform(-1, 1, (40, 2)) @ [[4, 0, 16], [0, 4, 0]] + [0, 0, 60],
            "not steeper than max_slope_deg, 70; clusters need 3",
            Reason.NO_PLANE,
        ),
    ],
    ids=["too few", "on one line", "walls alone"],
)
@PRESETS
def test_points_without_facets_to_cluster_are_refused(
    settings: KMeansSettings, points: FloatArray, message: str, reason: Reason
) -> None:
    with pytest.raises(BuildingError, match=message) as error:
        segment(candidate_of(points), settings)
    assert error.value.reason is reason


def test_the_presets_are_those_of_the_method() -> None:
    method = METHODS["kmeans"]
    assert method.preset("robust") == KMeansSettings()
    assert method.preset("faithful") == FAITHFUL
    assert (FAITHFUL.clusters, FAITHFUL.model, FAITHFUL.refine) == (2, "always", False)


def test_without_noise_or_a_least_distance_a_building_is_modelled_all_the_same() -> None:
    settings = KMeansSettings(min_plane_distance_m=0.0, noise_factor=0.0)
    found = segment(exact_gable(0.0), settings)
    assert len(found.planes) == 2
    assert (found.labels >= 0).all()


def test_a_rectangle_that_the_points_cannot_fill_is_refused_before_it_is_sampled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arm = np.arange(0.0, 400.0, 0.5)
    wide = np.concatenate([[(a, b) for a in arm for b in (0.0, 0.5)], [(a, b) for a in (0.0, 0.5) for b in arm[2:]]])
    cross = candidate_of(np.column_stack([wide, np.full(len(wide), 5.0)]))
    assert segment(cross, ROBUST).faces is None

    def sampled(*_: object) -> None:
        raise AssertionError("sampled")

    monkeypatch.setattr("pipeline.extras.papers.kmeans.far_from", sampled)
    assert segment(cross, ROBUST).faces is None
    with pytest.raises(AssertionError, match="sampled"):
        segment(exact_gable(0.0), ROBUST)


def test_a_distance_that_is_no_range_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"min_plane_distance_m is 0\.5: use at most max_plane_distance_m, 0\.3"):
        KMeansSettings(min_plane_distance_m=0.5)


def test_the_page_says_the_faithful_settings_exactly() -> None:
    text = PAGE.read_text()
    block = re.search(r"^```toml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert block is not None
    assert KMeansSettings(**tomllib.loads(block[1])["settings"]["kmeans"]) == FAITHFUL
