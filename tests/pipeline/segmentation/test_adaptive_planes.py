"""Planes found with thresholds that follow noise and density."""

import math

import numpy as np
import pytest
from candidates_by_hand import turned_plan
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.geometry import nearest_neighbours, point_spacing_m
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.segmentation.adaptive_planes import DetectedPlanes, detect_planes, merge_by_f_test, noise_about
from pipeline.segmentation.mean_nodes import mean_nodes
from pipeline.segmentation.plane_regression import cluster_sums
from pipeline.segmentation.plane_settings import AdaptivePlaneSettings
from pipeline.segmentation.trial_regions import TrialLimits, local_planes, noise_of_local_planes, take_regions

LENGTH_M, WIDTH_M = 20.0, 12.0


def canonical(points: FloatArray) -> FloatArray:
    """Whole millimetres, ordered by X, Y, Z."""
    rounded = np.rint(points * 1000.0) / 1000.0
    return np.ascontiguousarray(rounded[np.lexsort((rounded[:, 2], rounded[:, 1], rounded[:, 0]))])


def strewn(density_per_m2: float, seed: int) -> FloatArray:
    """Places over the rectangle, z = 0."""
    random = np.random.default_rng(seed)
    count = round(density_per_m2 * LENGTH_M * WIDTH_M)
    return np.column_stack([random.uniform(0, LENGTH_M, count), random.uniform(0, WIDTH_M, count), np.zeros(count)])


def gable(density_per_m2: float, noise_m: float, seed: int = 0, rise: float = 0.7) -> FloatArray:
    """A gable with its ridge along x at y = 6, 12 m high."""
    points = strewn(density_per_m2, seed)
    noise = np.random.default_rng(seed + 1).normal(0, noise_m, len(points))
    points[:, 2] = 12 - rise * np.abs(points[:, 1] - WIDTH_M / 2) + noise
    return canonical(points)


def hip(density_per_m2: float, noise_m: float, seed: int = 0) -> tuple[FloatArray, LabelArray]:
    """A hip roof of equal pitches, and the true face of every point: two sides, two ends."""
    points = strewn(density_per_m2, seed)
    sides = np.column_stack([points[:, 1], WIDTH_M - points[:, 1], points[:, 0], LENGTH_M - points[:, 0]])
    noise = np.random.default_rng(seed + 1).normal(0, noise_m, len(points))
    points[:, 2] = 8 + 0.7 * sides.min(axis=1) + noise
    made = canonical(points)
    sides = np.column_stack([made[:, 1], WIDTH_M - made[:, 1], made[:, 0], LENGTH_M - made[:, 0]])
    return made, sides.argmin(axis=1).astype(np.int32)


DEFAULT = AdaptivePlaneSettings()


def detected(points: FloatArray, chosen: AdaptivePlaneSettings = DEFAULT) -> DetectedPlanes:
    return detect_planes(points, point_spacing_m(points), chosen)


def share_of_pairs_right(labels: LabelArray, truth: LabelArray) -> float:
    """Share of the points whose plane is that of most points of their true face, one plane a face."""
    right, used = 0, set()
    for face in np.unique(truth):
        held = np.bincount(labels[(truth == face) & (labels >= 0)], minlength=1)
        best = int(held.argmax())
        if best not in used:
            right += int(held[best])
            used.add(best)
    return right / len(truth)


@pytest.mark.parametrize("noise_m", [0.02, 0.10])
@pytest.mark.parametrize("density_per_m2", [0.5, 1.0, 4.0, 8.0, 16.0, 50.0])
def test_both_sides_of_a_gable_are_found_at_every_density_and_noise(density_per_m2: float, noise_m: float) -> None:
    points = gable(density_per_m2, noise_m)
    found = detected(points)
    assert len(found.coefficients) == 2
    np.testing.assert_allclose(np.sort(found.coefficients[:, 1]), [-0.7, 0.7], atol=0.06)
    np.testing.assert_allclose(found.coefficients[:, 0], 0.0, atol=0.05)
    side = (points[:, 1] > WIDTH_M / 2).astype(np.int32)
    assert share_of_pairs_right(found.labels, side) > 0.9


@pytest.mark.parametrize("density_per_m2", [2.0, 8.0, 30.0])
def test_the_ends_of_a_hip_roof_are_planes_of_their_own(density_per_m2: float) -> None:
    points, face = hip(density_per_m2, 0.04)
    found = detected(points)
    assert len(found.coefficients) == 4
    assert share_of_pairs_right(found.labels, face) > 0.93


@pytest.mark.parametrize("noise_m", [0.03, 0.06, 0.10])
@pytest.mark.parametrize("density_per_m2", [4.0, 40.0])
def test_the_noise_about_the_planes_is_that_of_the_points(density_per_m2: float, noise_m: float) -> None:
    cosine = 1 / math.hypot(1, 0.7)
    points = gable(density_per_m2, noise_m)
    found = detected(points)
    sigma_m = noise_about(points, found.labels, found.coefficients)
    assert sigma_m == pytest.approx(noise_m * cosine, rel=0.15)


def test_a_superstructure_is_found_where_points_are_dense_and_it_is_not_below_the_least_area() -> None:
    points = gable(10.0, 0.02, seed=4)
    inside = (np.abs(points[:, 0] - 10.0) < 1.2) & (np.abs(points[:, 1] - 3.0) < 1.2)
    points[inside, 2] = 11.0 + 0.02 * np.sin(37 * points[inside, 0])
    found = detected(points)
    assert len(found.coefficients) == 3
    label = np.bincount(found.labels[inside & (found.labels >= 0)]).argmax()
    a, b, c = found.coefficients[label].tolist()
    assert math.hypot(a, b) < 0.05
    assert 10 * a + 3 * b + c == pytest.approx(11.0, abs=0.03)
    assert (found.labels[inside] == label).mean() > 0.9
    assert (found.labels[~inside] == label).mean() < 0.01
    only_larger = detected(points, AdaptivePlaneSettings(min_area_m2=8.0))
    assert len(only_larger.coefficients) == 2
    assert (only_larger.labels[inside] == -1).mean() > 0.9


def test_a_porch_of_two_square_metres_beside_the_roof_is_a_plane() -> None:
    points = gable(8.0, 0.02, seed=6)
    porch = np.random.default_rng(7).uniform([LENGTH_M, 2.0, 0.0], [LENGTH_M + 1.4, 3.5, 0.0], (17, 3))
    porch[:, 2] = 5.0 + np.random.default_rng(8).normal(0, 0.03, 17)
    found = detected(canonical(np.vstack([points, porch])))
    heights = sorted(LENGTH_M * a + 0.7 * a + 2.75 * b + c for a, b, c in found.coefficients.tolist())
    assert len(heights) == 3
    assert heights[0] == pytest.approx(5.0, abs=0.03)


def test_a_flat_roof_with_gravel_and_puddles_is_one_plane() -> None:
    points = strewn(9.0, 11)
    points[:, 2] = 7 + 0.05 * np.sin(points[:, 0]) * np.cos(0.8 * points[:, 1])
    points[:, 2] += np.random.default_rng(12).normal(0, 0.02, len(points))
    found = detected(canonical(points))
    assert len(found.coefficients) == 1
    assert (found.labels == 0).mean() > 0.98


@pytest.mark.parametrize("density_per_m2", [2.0, 4.0])
def test_the_waves_of_a_roof_are_no_planes_of_their_own(density_per_m2: float) -> None:
    points = strewn(density_per_m2, 21)
    points[:, 2] = 7 + 0.2 * np.sin(2 * np.pi / 6 * points[:, 0]) * np.cos(2 * np.pi / 6 * points[:, 1])
    points[:, 2] += np.random.default_rng(22).normal(0, 0.02, len(points))
    points = canonical(points)
    narrow = AdaptivePlaneSettings(max_distance_m=DEFAULT.min_distance_m)
    assert len(detected(points, narrow).coefficients) > 8
    found = detected(points)
    assert len(found.coefficients) == 1
    assert (found.labels >= 0).mean() > 0.95


@pytest.mark.parametrize("density_per_m2", [2.0, 8.0, 30.0])
def test_a_dome_is_several_planes_and_no_swarm(density_per_m2: float) -> None:
    points = strewn(density_per_m2, 13)
    radius = np.hypot(points[:, 0] - 6, points[:, 1] - 6)
    points, radius = points[radius < 5.5], radius[radius < 5.5]
    points[:, 2] = 8 + np.sqrt(6.5**2 - radius**2) + np.random.default_rng(14).normal(0, 0.02, len(points))
    found = detected(canonical(points))
    assert 5 <= len(found.coefficients) <= 40
    assert (found.labels >= 0).mean() > 0.8


@pytest.mark.parametrize(("step_m", "planes"), [(0.0, 1), (0.4, 2)])
@pytest.mark.parametrize("density_per_m2", [6.0, 24.0])
def test_a_step_parts_two_level_roofs_and_without_it_they_are_one(
    density_per_m2: float, step_m: float, planes: int
) -> None:
    points = strewn(density_per_m2, 3)
    points[:, 2] = 7 + step_m * (points[:, 0] > 9) + np.random.default_rng(5).normal(0, 0.03, len(points))
    found = detected(canonical(points))
    assert len(found.coefficients) == planes


@pytest.mark.parametrize("seed", range(4))
def test_the_kicked_eaves_of_a_steep_roof_are_a_slope(seed: int) -> None:
    points = strewn(6.0, seed)
    points[:, 2] = 9.0 + np.maximum(0.7 * points[:, 1], 1.1 * points[:, 1] - 0.48)
    assert len(detected(canonical(points)).coefficients) == 2


def test_a_gentle_ridge_is_no_bridge() -> None:
    found = detected(gable(6.0, 0.05, rise=0.12))
    assert len(found.coefficients) == 2
    np.testing.assert_allclose(np.sort(found.coefficients[:, 1]), [-0.12, 0.12], atol=0.02)


def test_near_vertical_planes_are_not_planes() -> None:
    random = np.random.default_rng(8)
    wall = random.uniform([0, 0, 0], [20, 0.5, 0], (600, 3))
    wall[:, 2] = 12.0 * wall[:, 1] + random.normal(0, 0.03, 600)
    found = detected(canonical(wall))
    assert all(math.hypot(a, b) < math.tan(math.radians(75.0)) for a, b, _ in found.coefficients)
    assert len(detected(canonical(wall), AdaptivePlaneSettings(max_slope_deg=89.0)).coefficients) >= 1


def test_points_far_from_every_plane_have_none() -> None:
    points = gable(6.0, 0.03)
    high = np.arange(0, len(points), 97)
    points[high, 2] += 1.5
    found = detected(points)
    assert len(found.coefficients) == 2
    assert (found.labels[high] == -1).all()


@pytest.mark.parametrize("count", [0, 1, 4])
def test_too_few_points_have_no_plane(count: int) -> None:
    points = gable(0.5, 0.02)[:count]
    found = detected(points)
    assert found.coefficients.shape == (0, 3)
    assert found.labels.tolist() == [-1] * count
    assert math.isnan(noise_about(points, found.labels, found.coefficients))


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((30, 3)),
        np.column_stack([np.arange(30.0), np.zeros(30), np.zeros(30)]),
        np.random.default_rng(0).uniform(0, 30, (60, 3)),
    ],
    ids=["one place", "one line", "scattered"],
)
def test_where_nothing_is_flat_nothing_is_found(points: FloatArray) -> None:
    found = detect_planes(canonical(points), 1.0, DEFAULT)
    assert len(found.coefficients) == 0
    assert (found.labels == -1).all()


@pytest.mark.parametrize("density_per_m2", [1.0, 6.0, 20.0])
def test_every_plane_is_the_regression_of_its_points_and_has_as_many_as_asked(density_per_m2: float) -> None:
    points, _ = hip(density_per_m2, 0.05, seed=2)
    found = detected(points)
    firsts = [int(np.flatnonzero(found.labels == k)[0]) for k in range(len(found.coefficients))]
    assert firsts == sorted(firsts)
    for k, coefficients in enumerate(found.coefficients):
        members = points[found.labels == k]
        design = np.column_stack([members[:, :2], np.ones(len(members))])
        np.testing.assert_allclose(coefficients, np.linalg.lstsq(design, members[:, 2])[0], atol=1e-7)


@settings(max_examples=examples(15), deadline=None)
@given(
    seed=st.integers(0, 50),
    east=st.integers(-3000, 3000),
    north=st.integers(-3000, 3000),
    density=st.sampled_from([1.0, 5.0, 18.0]),
)
def test_whole_metres_of_shift_change_no_label(seed: int, east: int, north: int, density: float) -> None:
    points, _ = hip(density, 0.04, seed)
    spacing_m = point_spacing_m(points)
    here = detect_planes(points, spacing_m, DEFAULT)
    there = detect_planes(canonical(points + np.array([east, north, 0.0])), spacing_m, DEFAULT)
    assert (here.labels == there.labels).mean() > 0.999
    np.testing.assert_allclose(there.coefficients[:, :2], here.coefficients[:, :2], atol=2e-3)


@settings(max_examples=examples(15), deadline=None)
@given(seed=st.integers(0, 50), turn_deg=st.floats(0, 360), density=st.sampled_from([2.0, 8.0, 24.0]))
def test_a_turned_hip_roof_keeps_its_four_planes(seed: int, turn_deg: float, density: float) -> None:
    points, face = hip(density, 0.03, seed)
    turned = np.column_stack([turned_plan(points[:, :2], turn_deg), points[:, 2]])
    order = np.lexsort((turned[:, 2], turned[:, 1], turned[:, 0]))
    found = detected(np.ascontiguousarray(turned[order]))
    assert len(found.coefficients) == 4
    assert share_of_pairs_right(found.labels, face[order]) > 0.9


def test_the_same_points_give_the_same_bytes_and_stay_as_they_are() -> None:
    points = gable(12.0, 0.05, seed=9)
    before = points.copy()
    first, second = detected(points), detected(points)
    assert first.coefficients.tobytes() == second.coefficients.tobytes()
    assert first.labels.tobytes() == second.labels.tobytes()
    assert points.tobytes() == before.tobytes()


def test_points_in_another_order_give_the_same_planes() -> None:
    points = gable(3.0, 0.05, seed=9)
    order = np.random.default_rng(2).permutation(len(points))
    here, there = detected(points), detected(np.ascontiguousarray(points[order]))
    number = {int(a): int(b) for a, b in zip(here.labels[order], there.labels, strict=True)}
    assert [number[int(label)] for label in here.labels[order]] == there.labels.tolist()


def test_nodes_are_the_means_of_their_points_and_a_gap_parts_them() -> None:
    points = np.array([[0.1, 0.1, 5.0], [0.2, 0.4, 9.0], [0.3, 0.1, 5.2], [0.4, 0.2, 5.1], [-0.1, 0.2, 5.0]])
    nodes, node_of = mean_nodes(points, 0.5, 0.35)
    assert node_of.tolist() == [1, 2, 1, 1, 0]
    np.testing.assert_allclose(nodes, [[-0.1, 0.2, 5.0], [0.8 / 3, 0.4 / 3, 5.1], [0.2, 0.4, 9.0]])


def merged(points: FloatArray, labels: LabelArray, sigma_m: float) -> list[int]:
    count = int(labels.max()) + 1
    pairs: IntArray = np.array([i * count + i + 1 for i in range(count - 1)])
    return [int(k) for k in merge_by_f_test(cluster_sums(points, labels, count), pairs, sigma_m)]


def test_pieces_of_one_plane_merge_and_planes_that_differ_do_not() -> None:
    points = strewn(5.0, 1)
    points[:, 2] = 5 + 0.5 * np.maximum(points[:, 0], 10.0) + np.random.default_rng(1).normal(0, 0.05, len(points))
    labels = np.floor(points[:, 0] / 5.0).astype(np.int32)
    assert merged(points, labels, 0.05) == [0, 0, 2, 2]


def test_a_difference_within_the_noise_of_few_points_is_none() -> None:
    random = np.random.default_rng(3)
    points = random.uniform([0, 0, 0], [4, 4, 0], (16, 3))
    points[:, 2] = random.normal(0, 0.1, 16) + 0.12 * (points[:, 0] > 2)
    labels = (points[:, 0] > 2).astype(np.int32)
    assert merged(points, labels, 0.1) == [0, 0]
    assert merged(points + np.outer(labels, [0, 0, 1.0]), labels, 0.1) == [0, 1]


def test_the_noise_of_local_planes_is_that_of_the_points() -> None:
    points = gable(4.0, 0.05, rise=0.2)
    variances = local_planes(points, nearest_neighbours(points, 10)).variances
    assert noise_of_local_planes(variances, np.argsort(variances)) == pytest.approx(0.05, rel=0.2)
    assert noise_of_local_planes(np.full(3, np.inf), np.arange(3)) == 0.0


def test_the_region_with_the_greatest_gain_is_taken_first() -> None:
    points = gable(4.0, 0.02)
    points = points[(points[:, 1] < 6) | (points[:, 0] < 8)]
    neighbours = nearest_neighbours(points, 10)
    surroundings = local_planes(points, neighbours)
    labels = np.full(len(points), -1, np.int32)
    assert take_regions(surroundings, labels, 0, TrialLimits(0.1, 0.0, 20, 0.3)) == 2
    assert np.median(labels[points[:, 1] < 5]) == 0
    assert np.median(labels[points[:, 1] > 7]) == 1


def test_bounds_that_are_no_range_are_refused_together() -> None:
    with pytest.raises(SettingsError) as caught:
        AdaptivePlaneSettings(min_distance_m=0.5, min_area_m2=12.0)
    assert "use at most max_distance_m, 0.35" in str(caught.value)
    assert "use at most min_area_sparse_m2, 10" in str(caught.value)
