"""How well points support a model: what is unexplained, holes, the ridge's standard deviation, curved roofs."""

import dataclasses
import math

import numpy as np
import pytest
import shapely
from examples import examples
from faces_by_hand import level, partition_of, plane
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import FloatArray, ModelQuality, Plane
from pipeline.quality.bent_roofs import is_curved_roof
from pipeline.quality.model_quality import model_quality
from pipeline.quality.ridge_height import _weights
from pipeline.quality.unseen_roof import Raster, _nearest_squares
from pipeline.roof.solid import SolidPart, solid_parts
from pipeline.segmentation.facet_geometry import fit_plane

Modelled = tuple[list[SolidPart], list[Plane]]


def modelled(shapes: list[shapely.Polygon], planes: list[Plane]) -> Modelled:
    """Solids over faces in plan, metres."""
    return solid_parts(partition_of(shapes), planes, 0.0), planes


def flat_roof(width: float, depth: float) -> Modelled:
    return modelled([shapely.box(0, 0, width, depth)], [level(5.0)])


def measured(
    points: FloatArray, model: Modelled, *, outline_sigma_m: float = 0.0, is_planar: bool = True
) -> ModelQuality:
    parts, planes = model
    faces = [face for part in parts for face in part.faces]
    given = {"spacing_m": 0.5, "outline_sigma_m": outline_sigma_m, "is_planar": is_planar}
    return model_quality(points, faces, planes, [part.solid for part in parts], **given)[1]


def lattice(width: float, depth: float, step: float = 0.5) -> FloatArray:
    """Places in the middles of square cells."""
    x, y = np.meshgrid(np.arange(step / 2, width, step), np.arange(step / 2, depth, step), indexing="ij")
    return np.column_stack((x.ravel(), y.ravel()))


def flat_points(width: float, depth: float, z: float) -> FloatArray:
    xy = lattice(width, depth)
    return np.column_stack((xy, np.full(len(xy), z)))


def test_points_on_the_roof_leave_nothing_unexplained() -> None:
    quality = measured(flat_points(10, 8, 5.0), flat_roof(10, 8))
    assert (quality.share_within, quality.unexplained_m2, quality.noise_m) == (1.0, 0.0, 0.0)
    assert quality.largest_hole_m < 1.0
    assert (quality.is_curved, math.isnan(quality.bic_margin)) == (False, True)


def test_a_part_of_the_roof_that_points_contradict_is_unexplained_but_no_hole() -> None:
    points = flat_points(20, 10, 5.0)
    points[points[:, 0] > 10.0, 2] += 0.5
    quality = measured(points, flat_roof(20, 10))
    assert quality.share_within == 0.5
    assert quality.unexplained_m2 == pytest.approx(100.0 - 10.0 * 0.5, abs=5.0)  # less the reach of the points beside
    assert quality.largest_hole_m < 1.0


def test_a_hole_is_reported_by_its_diameter_and_area_and_ground_seen_through_it_fills_it_but_explains_nothing() -> None:
    points = flat_points(20, 20, 5.0)
    court = np.hypot(points[:, 0] - 10.0, points[:, 1] - 10.0) <= 4.0
    empty = measured(points[~court], flat_roof(20, 20))
    points[court, 2] = 0.0
    with_ground = measured(points, flat_roof(20, 20))
    for quality in (empty, with_ground):
        assert quality.unexplained_m2 == pytest.approx(math.pi * (4.0 - 0.75) ** 2, rel=0.15)
    assert empty.largest_hole_m == pytest.approx(8.0, abs=0.8)
    assert empty.share_within == 1.0
    assert with_ground.largest_hole_m < 1.0


def test_a_roof_away_from_all_points_says_nothing() -> None:
    quality = measured(flat_points(5, 5, 5.0) + np.array([50.0, 0.0, 0.0]), flat_roof(5, 5))
    assert quality.share_within == 0.0
    assert all(math.isnan(v) for v in (quality.noise_m, quality.unexplained_m2, quality.ridge_z_sigma_m))


def test_a_block_has_neither_noise_nor_a_ridge() -> None:
    quality = measured(flat_points(5, 5, 5.3), flat_roof(5, 5), is_planar=False)
    assert math.isnan(quality.noise_m)
    assert math.isnan(quality.ridge_z_sigma_m)
    assert quality.unexplained_m2 == pytest.approx(25.0)


def test_noise_is_that_of_the_points_whatever_stands_on_the_roof() -> None:
    points = flat_points(40, 40, 5.0)
    points[:, 2] += np.random.default_rng(1).normal(0.0, 0.05, len(points))
    points[::10, 2] += 3.0
    assert measured(points, flat_roof(40, 40)).noise_m == pytest.approx(0.05, rel=0.2)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=examples(30), deadline=None)
def test_the_nearest_point_of_every_cell_is_that_of_a_plain_search_to_a_tenth_of_a_cell(seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns, rows, cell = int(rng.integers(1, 30)), int(rng.integers(1, 30)), 0.4
    points = rng.uniform(0, 1, (int(rng.integers(1, 60)), 3)) * [columns * cell, rows * cell, 9.0]
    residuals = rng.uniform(-0.4, 0.4, len(points))
    residuals[rng.uniform(size=len(points)) < 0.2] = np.nan
    found = _nearest_squares(points, residuals, 0.2, Raster(0.0, 0.0, cell, columns, rows))[:, 1]
    x = np.tile((np.arange(columns) + 0.5) * cell, rows)
    y = np.repeat((np.arange(rows) + 0.5) * cell, columns)
    near = points[np.abs(residuals) <= 0.2]
    if len(near) == 0:
        assert np.isinf(found).all()
        return
    exact = np.min(np.hypot(x[:, None] - near[:, 0], y[:, None] - near[:, 1]), axis=1)
    assert (np.sqrt(found) >= exact - 1e-9).all()
    assert (np.sqrt(found) <= exact + cell).all()
    assert np.mean(np.sqrt(found) - exact) <= 0.1 * cell


# ------------------------------------------------------------------------------------------------------ the ridge


def gable_points(
    rng: np.random.Generator, n: int, noise_m: float, rise: tuple[float, float] = (0.7, -0.7)
) -> FloatArray:
    """A gable over 12 x 8 m, its ridge at y = 4 and z = 6."""
    x, y = rng.uniform(0, 12, n), rng.uniform(0, 8, n)
    z = 6.0 + np.where(y < 4.0, rise[0], rise[1]) * (y - 4.0)
    return np.column_stack((x, y, z + rng.normal(0.0, noise_m, n)))


def fitted_gable(points: FloatArray) -> Modelled:
    """Planes of the points of each side, and the faces up to the line where they cross."""
    south, north = fit_plane(points[points[:, 1] < 4.0]), fit_plane(points[points[:, 1] >= 4.0])

    def crossing(x: float) -> float:
        return ((north.c - south.c) + (north.a - south.a) * x) / (south.b - north.b)

    west, east = crossing(0.0), crossing(12.0)
    sides = [[(0, 0), (12, 0), (12, east), (0, west)], [(0, west), (12, east), (12, 8), (0, 8)]]
    return modelled([shapely.Polygon(side) for side in sides], [south, north])


def highest(model: Modelled) -> float:
    return max(float(part.solid.vertices[:, 2].max()) for part in model[0])


@pytest.mark.parametrize(("n", "noise_m", "rise"), [(60, 0.1, (0.7, -0.7)), (400, 0.15, (0.4, -0.9))])
def test_two_of_three_ridges_are_as_near_to_the_truth_as_the_sigma_says(
    n: int, noise_m: float, rise: tuple[float, float]
) -> None:
    rng, normalised = np.random.default_rng(7), []
    for _ in range(300):
        points = gable_points(rng, n, noise_m, rise)
        model = fitted_gable(points)
        normalised.append(abs(highest(model) - 6.0) / measured(points, model).ridge_z_sigma_m)
    assert 0.60 <= np.mean(np.array(normalised) <= 1.0) <= 0.76
    assert np.mean(np.array(normalised) <= 2.0) >= 0.90


def test_more_points_and_less_noise_make_a_ridge_better_known() -> None:
    def sigma(n: int, noise_m: float) -> float:
        points = gable_points(np.random.default_rng(3), n, noise_m)
        return measured(points, fitted_gable(points)).ridge_z_sigma_m

    assert sigma(100, 0.1) > 1.5 * sigma(1000, 0.1) > 2.0 * sigma(10_000, 0.1)
    assert sigma(100, 0.1) > 1.5 * sigma(100, 0.05)
    assert sigma(100_000, 0.01) == pytest.approx(0.004, abs=0.0005)


def test_the_border_of_two_strips_on_a_roof_makes_its_ridge_less_known_and_what_all_points_share_does_not() -> None:
    points = gable_points(np.random.default_rng(5), 2000, 0.02)
    lifted = points + np.array([0.0, 0.0, 0.4])
    shifted = np.where(points[:, :1] > 8.0, points + np.array([0.0, 0.0, 0.1]), points)
    sigma, of_lifted, of_shifted = (measured(p, fitted_gable(p)).ridge_z_sigma_m for p in (points, lifted, shifted))
    assert of_shifted > 2.0 * sigma
    assert of_lifted == pytest.approx(sigma, abs=1e-3)


def test_the_top_edge_of_a_pent_roof_is_as_uncertain_as_its_outline_is_steep() -> None:
    xy = lattice(10, 8)
    points = np.column_stack((xy, 3.0 + 0.5 * xy[:, 1]))
    model = modelled([shapely.box(0, 0, 10, 8)], [plane(0.0, 0.5, 3.0)])
    assert measured(points, model).ridge_z_sigma_m == pytest.approx(0.004)
    assert measured(points, model, outline_sigma_m=0.2).ridge_z_sigma_m == pytest.approx(math.hypot(0.1, 0.004))


def test_an_error_of_the_outline_does_not_move_a_ridge() -> None:
    points = gable_points(np.random.default_rng(2), 400, 0.03)
    model = fitted_gable(points)
    exact, drawn = (measured(points, model, outline_sigma_m=sigma).ridge_z_sigma_m for sigma in (0.0, 0.2))
    assert drawn == pytest.approx(exact, rel=0.05)


def test_a_plane_of_three_points_has_no_sigma() -> None:
    points = np.array([[1.0, 1.0, 5.0], [4.0, 1.0, 5.0], [1.0, 4.0, 5.0]])
    assert math.isnan(measured(points, flat_roof(5, 5)).ridge_z_sigma_m)


@given(st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), min_size=1, max_size=6))
@settings(max_examples=examples(200), deadline=None)
def test_the_weights_of_planes_leave_the_least_gradient(gradients: list[tuple[float, float]]) -> None:
    weights, left = _weights(gradients)
    hull = shapely.MultiPoint(gradients).convex_hull
    assert min(weights) >= -1e-9
    assert math.fsum(weights) == pytest.approx(1.0)
    mean = np.array(weights) @ np.array(gradients)
    assert left == pytest.approx(float(np.hypot(*mean)), abs=1e-9)
    assert left == pytest.approx(hull.distance(shapely.Point(0.0, 0.0)), abs=1e-6)


# --------------------------------------------------------------------------------------------------- curved roofs


def along_a_curve(slopes_deg: list[float], width: float = 1.5) -> Modelled:
    """Strips of one width after another, each with its slope: z rises by it along y."""
    shapes, planes, z = [], [], 5.0
    for k, slope in enumerate(slopes_deg):
        rise = math.tan(math.radians(slope))
        shapes.append(shapely.box(0, k * width, 20, (k + 1) * width))
        planes.append(plane(0.0, rise, z - rise * k * width))
        z += rise * width
    return modelled(shapes, planes)


def is_curved(model: Modelled) -> bool:
    parts, planes = model
    return is_curved_roof(planes, [face for part in parts for face in part.faces], [part.solid for part in parts])


def test_a_barrel_is_curved() -> None:
    assert is_curved(along_a_curve([50, 30, 10, -10, -30, -50]))
    assert is_curved(along_a_curve([20, 10, 0, -10, -20]))


@pytest.mark.parametrize(
    ("name", "slopes_deg"),
    [
        ("gable", [40, -40]),
        ("gambrel", [60, 25, -25, -60]),
        ("mansard with a flat top", [70, 20, 0, -20, -70]),
        ("sawtooth", [30, 30, 30, 30, 30, 30]),
        ("valleys", [-30, -15, 0, 15, 30]),
        ("folded", [10, -10, 10, -10, 10, -10]),
    ],
)
def test_roofs_of_few_directions_or_of_sharp_or_hollow_folds_are_not(name: str, slopes_deg: list[float]) -> None:
    assert not is_curved(along_a_curve(slopes_deg)), name


def pyramid(sides: int, rise: float, radius: float = 6.0) -> Modelled:
    """A roof of so many equal sides about the point (10, 10, 5 + rise * radius)."""
    angles = [2.0 * math.pi * k / sides for k in range(sides)]
    corners = [(10 + radius * math.cos(t), 10 + radius * math.sin(t)) for t in angles]
    shapes, planes = [], []
    for k in range(sides):
        shapes.append(shapely.Polygon([(10, 10), corners[k], corners[(k + 1) % sides]]))
        middle = angles[k] + math.pi / sides
        a, b = -rise * math.cos(middle), -rise * math.sin(middle)
        planes.append(plane(a, b, 5.0 + rise * radius - 10 * a - 10 * b))
    return modelled(shapes, planes)


def test_a_cone_is_curved_and_a_hip_roof_of_any_slope_is_not() -> None:
    assert is_curved(pyramid(16, 0.8))
    assert not any(is_curved(pyramid(4, rise)) for rise in (0.1, 0.2, 0.4, 0.8))


def test_a_barrel_over_a_small_part_of_a_flat_roof_does_not_make_it_curved() -> None:
    parts, planes = along_a_curve([20, 10, 0, -10, -20])
    faces = [face for part in parts for face in part.faces]
    wide = dataclasses.replace(faces[0], plane=5, polygon=shapely.box(0, 20, 60, 60))
    assert not is_curved_roof([*planes, level(3.0)], [*faces, wide], [part.solid for part in parts])
