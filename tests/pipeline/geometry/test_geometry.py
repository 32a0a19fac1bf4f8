"""Facets, planes, rings and neighbourhoods."""

import math

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import geometry
from pipeline.model import FloatArray
from pipeline.segmentation import facet_geometry


def roof(a: float, b: float, c: float, n: int, noise_m: float, seed: int, side_m: float = 10.0) -> FloatArray:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, side_m, (n, 2))
    z = a * xy[:, 0] + b * xy[:, 1] + c + rng.normal(0, noise_m, n)
    return np.round(np.column_stack((xy, z)), 3)


# ---------------------------------------------------------------------------------------------------------- facets


def test_a_facet_of_45_degrees_that_falls_to_the_east_has_its_slope_aspect_and_area() -> None:
    xyz = np.array([[0.0, 0, 1], [1, 0, 0], [1, 1, 0]])
    facets = np.array([[0, 1, 2]], np.int32)
    normals = facet_geometry.facet_normals(xyz, facets)
    np.testing.assert_allclose(normals, [[math.sqrt(0.5), 0, math.sqrt(0.5)]])
    np.testing.assert_allclose(facet_geometry.slopes_deg(normals), [45])
    np.testing.assert_allclose(facet_geometry.aspects_deg(normals), [90])
    np.testing.assert_allclose(facet_geometry.facet_areas_m2(xyz, facets), [math.sqrt(0.5)])
    np.testing.assert_allclose(facet_geometry.facet_centroids(xyz, facets), [[2 / 3, 1 / 3, 1 / 3]])
    np.testing.assert_allclose(facet_geometry.o_distances_m(normals, xyz[:1]), [math.sqrt(0.5)])


def test_normals_point_up_whichever_way_the_facet_turns() -> None:
    xyz = np.random.default_rng(0).uniform(-5, 5, (30, 3))
    facets = np.random.default_rng(1).permuted(np.tile(np.arange(30, dtype=np.int32), (40, 1)), axis=1)[:, :3]
    normals = facet_geometry.facet_normals(xyz, facets)
    assert (normals[:, 2] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    np.testing.assert_allclose(normals, facet_geometry.facet_normals(xyz, facets[:, ::-1]), atol=1e-12)
    expected = np.cross(xyz[facets[:, 1]] - xyz[facets[:, 0]], xyz[facets[:, 2]] - xyz[facets[:, 0]])
    np.testing.assert_allclose(facet_geometry.facet_areas_m2(xyz, facets), 0.5 * np.linalg.norm(expected, axis=1))


def test_a_vertical_facet_has_90_degrees_and_one_without_area_a_null_normal() -> None:
    xyz = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [2, 0, 0]])
    facets = np.array([[0, 1, 2], [0, 1, 3]], np.int32)
    np.testing.assert_array_equal(facet_geometry.facet_normals(xyz, facets)[1], [0, 0, 0])
    np.testing.assert_array_equal(facet_geometry.slopes_deg(facet_geometry.facet_normals(xyz, facets)), [90, 90])


@pytest.mark.parametrize(
    ("a", "b", "aspect"), [(0, -1, 0), (-1, 0, 90), (0, 1, 180), (1, 0, 270), (0, 0, 0), (1, -1, 315)]
)
def test_aspects_follow_the_compass_and_agree_with_the_plane(a: float, b: float, aspect: float) -> None:
    plane = facet_geometry.fit_plane(np.array([[0.0, 0, 0], [1, 0, a], [0, 1, b], [1, 1, a + b]]))
    assert plane.aspect_deg == pytest.approx(aspect)
    np.testing.assert_allclose(facet_geometry.aspects_deg(np.array([plane.normal])), [aspect], atol=1e-9)
    np.testing.assert_allclose(facet_geometry.slopes_deg(np.array([plane.normal])), [plane.slope_deg])


def test_the_o_distance_of_facets_is_that_of_their_plane() -> None:
    points = roof(0.3, -0.2, 7.0, 3, 0.0, seed=1) @ np.eye(3)
    plane = facet_geometry.fit_plane(points)
    normals = facet_geometry.facet_normals(points, np.array([[0, 1, 2]], np.int32))
    np.testing.assert_allclose(facet_geometry.o_distances_m(normals, points[:1]), [plane.o_distance_m])


# ---------------------------------------------------------------------------------------------------------- planes


def test_the_plane_fit_agrees_with_lstsq() -> None:
    for seed in range(20):
        points = roof(0.7, -0.4, 12.0, 5 + 10 * seed, 0.1, seed)
        design = np.column_stack((points[:, :2], np.ones(len(points))))
        expected, _, _, _ = np.linalg.lstsq(design, points[:, 2])
        plane = facet_geometry.fit_plane(points)
        np.testing.assert_allclose(plane.coefficients, expected, rtol=1e-9, atol=1e-9)
        residuals = facet_geometry.vertical_residuals_m(points, plane.coefficients)
        assert plane.rmse_m == pytest.approx(math.sqrt(float((residuals**2).mean())), rel=1e-9)
        assert plane.n_points == len(points)


def test_far_from_the_origin_the_fit_loses_no_more_than_a_tenth_of_a_millimetre() -> None:
    points = roof(0.5, 0.25, 3.0, 200, 0.02, seed=4)
    here = facet_geometry.fit_plane(points)
    far = facet_geometry.fit_plane(points + np.array([84_000.0, 447_000.0, 0.0]))
    assert (far.a, far.b) == pytest.approx((here.a, here.b), abs=1e-9)
    moved_c = here.c - here.a * 84_000.0 - here.b * 447_000.0
    assert far.c == pytest.approx(moved_c, abs=1e-4)


def test_turning_the_points_turns_the_plane() -> None:
    points = roof(0.5, 0.2, 3.0, 80, 0.05, seed=7)
    turned = points[:, [1, 0, 2]] * [-1, 1, 1]  # 90 degrees counter-clockwise
    plane, other = facet_geometry.fit_plane(points), facet_geometry.fit_plane(turned)
    assert other.coefficients == pytest.approx((-plane.b, plane.a, plane.c))
    assert other.slope_deg == pytest.approx(plane.slope_deg)


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (3.0, 4.0), (-7.0, 1.0)])
def test_collinear_points_give_the_plane_that_is_level_across_their_line(direction: tuple[float, float]) -> None:
    t = np.linspace(0, 2, 9)
    points = np.round(np.column_stack((t * direction[0], t * direction[1], 5 + t)), 3)
    plane = facet_geometry.fit_plane(points)
    assert plane.a * -direction[1] + plane.b * direction[0] == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(facet_geometry.vertical_residuals_m(points, plane.coefficients), 0, atol=1e-9)


def test_one_position_gives_a_horizontal_plane_at_the_mean_height() -> None:
    plane = facet_geometry.fit_plane(np.array([[4.0, 5, 1], [4, 5, 3]]))
    assert plane.coefficients == (0.0, 0.0, 2.0)
    assert plane.rmse_m == 1.0


def test_without_points_the_fit_refuses() -> None:
    with pytest.raises(ValueError, match="no points"):
        facet_geometry.fit_plane(np.empty((0, 3)))


def test_residuals_are_vertical() -> None:
    assert facet_geometry.vertical_residuals_m(np.array([[0.0, 0, 2]]), (1.0, 0.0, 0.0))[0] == 2.0


# -------------------------------------------------------------------------------------------------- neighbourhoods


def slow_neighbours(points: FloatArray, k: int) -> list[list[int]]:
    rows = []
    for i, p in enumerate(points):
        order = sorted(
            (sum((a - b) ** 2 for a, b in zip(q, p, strict=True)), j) for j, q in enumerate(points) if j != i
        )
        row = [j for _, j in order[:k]]
        rows.append(row + [-1] * (k - len(row)))
    return rows


@settings(max_examples=examples(150), deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(0, 6)] * 3), min_size=1, max_size=25),
    st.integers(0, 6),
    st.sampled_from([None, 0.3, 1.0, 50.0]),
    st.sampled_from([2, 3]),
)
def test_neighbours_equal_the_slow_search_with_all_ties(
    lattice: list[tuple[int, ...]], k: int, cell_size_m: float | None, dimensions: int
) -> None:
    points = np.array(lattice, float)[:, :dimensions]
    found = geometry.nearest_neighbours(points, k, cell_size_m)
    assert found.dtype == np.int32
    assert found.tolist() == slow_neighbours(points, k)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_neighbours_agree_with_the_kd_tree_of_scipy(dimensions: int) -> None:
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(3)
    points = np.concatenate((rng.uniform(0, 100, (3_000, 3)), rng.normal(50, 0.5, (1_000, 3)), [[5_000.0, 0, 0]]))
    points = points[:, :dimensions]
    _, expected = cKDTree(points).query(points, k=10)
    np.testing.assert_array_equal(geometry.nearest_neighbours(points, 9), expected[:, 1:])
    np.testing.assert_array_equal(geometry.nearest_neighbours(points, 9, 0.5), expected[:, 1:])


def test_neighbours_do_not_hang_on_points_at_one_place_or_on_a_line() -> None:
    assert (geometry.nearest_neighbours(np.zeros((50, 3)), 3)[10:] == [0, 1, 2]).all()
    line = np.column_stack((np.arange(200) * 100.0, np.zeros(200)))
    assert geometry.nearest_neighbours(line, 2)[5].tolist() == [4, 6]


def test_the_search_refuses_wrong_arguments_by_value() -> None:
    with pytest.raises(ValueError, match="shape"):
        geometry.nearest_neighbours(np.zeros((3, 4)), 2)
    with pytest.raises(ValueError, match="k is -1"):
        geometry.nearest_neighbours(np.zeros((3, 2)), -1)
    with pytest.raises(ValueError, match="cell_size_m is 0"):
        geometry.nearest_neighbours(np.zeros((3, 2)), 1, 0.0)


@pytest.mark.parametrize("density", [0.77, 8.0, 40.0])
def test_the_spacing_of_strewn_points_is_one_over_the_root_of_their_density(density: float) -> None:
    for seed in range(4):
        points = np.random.default_rng(seed).uniform(0, 40, (int(1600 * density), 2))
        assert geometry.point_spacing_m(points) * math.sqrt(density) == pytest.approx(1, rel=0.08)


def test_the_spacing_is_robust_against_a_distant_cluster_and_holds_on_lattices() -> None:
    points = np.random.default_rng(0).uniform(0, 40, (3_000, 2))
    with_tree = np.concatenate((points, np.random.default_rng(1).uniform(0, 1, (600, 2)) + 500))
    assert geometry.point_spacing_m(with_tree) == pytest.approx(geometry.point_spacing_m(points), rel=0.15)
    lattice = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0)), -1).reshape(-1, 2)
    assert geometry.point_spacing_m(lattice) == pytest.approx(0.9, abs=0.02)
    assert geometry.point_spacing_m(3 * lattice) == pytest.approx(3 * geometry.point_spacing_m(lattice))


def test_spacing_and_noise_of_too_few_points_are_nan() -> None:
    assert math.isnan(geometry.point_spacing_m(np.zeros((1, 3))))
    assert geometry.point_spacing_m(np.array([[0.0, 0, 0], [0, 2, 0]])) > 0
    assert math.isnan(facet_geometry.noise_sigma_m(np.zeros((3, 3))))


@pytest.mark.parametrize("sigma_m", [0.02, 0.05, 0.10])
def test_the_noise_of_a_gable_is_recovered(sigma_m: float) -> None:
    found = []
    for seed in range(10):
        west, east = roof(0.6, 0, 3, 300, sigma_m, seed), roof(-0.6, 0, 15, 300, sigma_m, seed + 100)
        found.append(facet_geometry.noise_sigma_m(np.concatenate((west, east + np.array([10.0, 0, 0])))))
    assert np.mean(found) == pytest.approx(sigma_m, rel=0.12)


def test_noise_is_recovered_from_as_few_as_six_points() -> None:
    found = [facet_geometry.noise_sigma_m(roof(0.2, 0.1, 0, 6, 0.1, seed)) ** 2 for seed in range(400)]
    assert 0.05 < math.sqrt(np.mean(found)) < 0.30


def test_trees_beside_a_roof_do_not_raise_its_noise_beyond_half() -> None:
    tree = np.random.default_rng(5).uniform(0, 6, (150, 3)) + np.array([30.0, 0, 0])
    both = np.concatenate((roof(0.4, 0.1, 5, 500, 0.05, seed=1), tree))
    assert facet_geometry.noise_sigma_m(both) < 0.075


def slow_top_visible(points: FloatArray) -> list[bool]:
    mm = [tuple(round(v * 1000) for v in p) for p in points]
    return [not any((q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 <= 500**2 and q[2] - p[2] > 1100 for q in mm) for p in mm]


@settings(max_examples=examples(100), deadline=None)
@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30), st.integers(0, 40)), min_size=1, max_size=40))
def test_top_visible_equals_the_slow_definition(lattice: list[tuple[int, int, int]]) -> None:
    points = np.array(lattice) * 0.1
    assert geometry.top_visible(points).tolist() == slow_top_visible(points)


def test_limits_of_top_visible_are_met_to_the_millimetre() -> None:
    below = [7.0, 7.0, 2.0]
    assert geometry.top_visible(np.array([below, [7.5, 7.0, 3.1]])).tolist() == [True, True]
    assert geometry.top_visible(np.array([below, [7.5, 7.0, 3.101]])).tolist() == [False, True]
    assert geometry.top_visible(np.array([below, [7.501, 7.0, 9.0]])).tolist() == [True, True]
    assert geometry.top_visible(np.empty((0, 3))).tolist() == []


def test_order_and_place_do_not_change_what_is_visible() -> None:
    points = np.round(np.random.default_rng(2).uniform(0, 8, (2_000, 3)), 3)
    visible = geometry.top_visible(points)
    order = np.random.default_rng(3).permutation(len(points))
    np.testing.assert_array_equal(geometry.top_visible(points[order]), visible[order])
    np.testing.assert_array_equal(geometry.top_visible(points + np.array([1_000.0, -2_000.0, 30.0])), visible)


@settings(max_examples=examples(200), deadline=None)
@given(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 12), st.integers(0, 30)), min_size=2, max_size=40))
def test_a_place_is_surrounded_if_it_lies_inside_the_hull_of_the_points_that_hide_it(
    lattice: list[tuple[int, int, int]],
) -> None:
    places, points = np.array(lattice[:1]) * 0.1, np.array(lattice[1:]) * 0.1
    mm = np.rint((points - places) * 1000.0).astype(int)
    squares = mm[:, 0] ** 2 + mm[:, 1] ** 2
    hiding = mm[(squares > 0) & (squares <= 500**2) & (mm[:, 2] > 1100)]
    hull = shapely.convex_hull(shapely.multipoints(hiding[:, :2]))
    expected = hull.geom_type == "Polygon" and bool(shapely.contains_properly(hull, shapely.Point(0, 0)))
    assert geometry.surrounded(places, points).tolist() == [expected]


def test_only_higher_points_within_the_radius_surround_a_place_also_beyond_the_others() -> None:
    ring = np.array([(x, y, 2.0) for x, y in ((0.3, 0.3), (-0.3, 0.3), (0.0, -0.3))])
    places = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 0.9), (0.0, 0.4, 0.0), (-9.0, 9.0, 0.0)])
    assert geometry.surrounded(places, ring).tolist() == [True, False, False, False]
    assert geometry.surrounded(places, ring * np.array([2.0, 2.0, 1.0])).tolist() == [False] * 4
    above = np.vstack((ring, [(0.0, 0.0, 5.0)]))
    assert geometry.surrounded(places[:1], above).tolist() == [True]


def test_the_spacing_over_the_area_is_that_of_the_points_where_they_lie_evenly() -> None:
    random = np.random.default_rng(5)
    for count, size in ((60, (6.0, 9.0)), (2000, (20.0, 30.0)), (4000, (200.0, 3.0))):
        points = random.uniform((0, 0), size, (count, 2))
        assert geometry.spacing_over_area_m(points) == geometry.point_spacing_m(points)
    assert math.isnan(geometry.spacing_over_area_m(np.zeros((1, 3))))


def test_the_spacing_over_the_area_is_that_of_most_of_the_area() -> None:
    random = np.random.default_rng(6)
    sparse, dense = random.uniform((0, 0), (30, 20), (600, 2)), random.uniform((0, 8), (30, 13), (2400, 2))
    both = np.concatenate((sparse, dense))
    assert geometry.point_spacing_m(both) == pytest.approx(1 / math.sqrt(17), rel=0.1)
    assert geometry.spacing_over_area_m(both) == pytest.approx(1.0, rel=0.1)
    assert geometry.spacing_over_area_m(both[np.random.default_rng(7).permutation(len(both))]) == (
        geometry.spacing_over_area_m(both)
    )
