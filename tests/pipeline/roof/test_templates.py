"""Templates: simple roof shapes over the parts of an outline, for few points."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon

from pipeline.errors import BuildingError
from pipeline.extras.templates.fitting import fit_templates, margin_of_templates, parameters_of
from pipeline.extras.templates.parts import main_direction
from pipeline.extras.templates.shapes import best_shape, height, misfit, robust_line
from pipeline.extras.templates.template_drawing import lower_piece
from pipeline.model import FloatArray, Plane, Reason, Solid
from pipeline.quality.validity import check_solid
from pipeline.roof.footprint_in_mm import footprint_in_mm
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import solid_parts

ExactRoofs = Callable[..., Any]
Volume = Callable[[Solid], float]

FACES = {"flat": 1, "pent": 1, "gable": 2, "hip": 4, "stepped": 2}
SHED = footprint_in_mm(shapely.box(0.0, 0.0, 6.0, 4.0))


def edges_of(polygon: Polygon) -> FloatArray:
    xy = shapely.get_coordinates(polygon)
    return np.column_stack((xy[:-1], xy[1:]))


@pytest.mark.parametrize("turn_deg", [0.0, 31.0, 77.0])
@pytest.mark.parametrize("kind", FACES)
def test_a_sparse_roof_gets_its_faces_and_one_valid_solid_of_about_the_true_volume(
    exact_roof: ExactRoofs, volume: Volume, kind: str, turn_deg: float
) -> None:
    roof = exact_roof(kind, turn_deg=turn_deg, density=0.6, noise_m=0.03, with_footprint=True, seed=2)
    faces = fit_templates(roof.candidate.points, footprint_in_mm(roof.footprint)).faces()
    assert len(faces.partition.polygons) == FACES[kind]
    assert sum(polygon.area for polygon in faces.partition.polygons) == pytest.approx(1e6 * roof.footprint.area, 1e-3)
    (part,) = solid_parts(faces.partition, faces.planes, 0.0)
    assert check_solid(part.solid) == ()
    assert volume(part.solid) == pytest.approx(roof.volume_m3, rel=0.04)


def test_points_keep_the_plane_that_they_lie_on_and_outliers_have_none(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("gable", density=0.8, with_footprint=True)
    points = roof.candidate.points.copy()
    points[3, 2] += 2.0
    faces = fit_templates(points, footprint_in_mm(roof.footprint)).faces()
    assert faces.labels[3] == -1
    for label, (x, y, z) in zip(faces.labels.tolist(), points.tolist(), strict=True):
        if label >= 0:
            plane = faces.planes[label]
            assert plane.a * x + plane.b * y + plane.c == pytest.approx(z, abs=0.3)
    assert [plane.n_points for plane in faces.planes] == np.bincount(faces.labels[faces.labels >= 0]).tolist()


def test_a_gable_with_a_lower_annex_is_cut_at_the_step(volume: Volume) -> None:
    outline = shapely.box(0.0, 0.0, 14.0, 8.0)
    rng = np.random.default_rng(5)
    xy = np.rint(rng.uniform((0, 0), (14, 8), (60, 2)) * 1e3) / 1e3
    z = np.where(xy[:, 0] < 10.0, 9.0 - 0.8 * np.abs(xy[:, 1] - 4.0), 3.0)
    faces = fit_templates(np.column_stack((xy, z)), footprint_in_mm(outline)).faces()
    assert len(faces.partition.polygons) == 3
    level = [polygon for polygon, k in zip(faces.partition.polygons, faces.partition.labels, strict=True)
             if faces.planes[k].slope_deg < 1.0]  # fmt: skip
    assert [polygon.bounds[0] * 1e-3 for polygon in level] == [pytest.approx(10.0, abs=0.7)]
    (part,) = solid_parts(faces.partition, faces.planes, 0.0)
    assert check_solid(part.solid) == ()
    assert volume(part.solid) == pytest.approx(10 * 8 * 7.4 + 4 * 8 * 3.0, rel=0.05)


def test_a_courtyard_stays_open(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("courtyard", density=0.5, with_footprint=True)
    faces = fit_templates(roof.candidate.points, footprint_in_mm(roof.footprint)).faces()
    assert sum(polygon.area for polygon in faces.partition.polygons) == pytest.approx(1e6 * roof.footprint.area, 1e-4)


def test_an_outline_of_many_vertices_gets_the_faces_of_one_with_few() -> None:
    xy = np.random.default_rng(2).uniform((0, 0), (12, 8), (60, 2))
    points = np.column_stack((xy, 9.0 - 0.6 * np.abs(xy[:, 1] - 4.0)))
    few = footprint_in_mm(shapely.box(0.0, 0.0, 12.0, 8.0))
    many = shapely.MultiPolygon([shapely.segmentize(polygon, 50.0) for polygon in few.geoms])
    assert shapely.get_num_coordinates(many) > 700
    one, other = (fit_templates(points, outline).faces() for outline in (few, many))
    assert [polygon.area for polygon in other.partition.polygons] == [pytest.approx(48e6, rel=1e-3)] * 2
    assert [plane.coefficients for plane in other.planes] == [
        pytest.approx(plane.coefficients, abs=1e-6) for plane in one.planes
    ]


def test_four_points_tell_a_flat_roof() -> None:
    points = np.array([(1.0, 1.0, 3.0), (5.0, 1.0, 3.02), (1.0, 3.0, 2.97), (4.0, 3.5, 3.01)])
    faces = fit_templates(points, SHED).faces()
    assert [plane.slope_deg for plane in faces.planes] == [0.0]
    assert faces.planes[0].c == pytest.approx(3.0, abs=0.02)


def test_fewer_than_four_points_are_too_few() -> None:
    with pytest.raises(BuildingError) as caught:
        fit_templates(np.array([(1.0, 1.0, 3.0), (5.0, 1.0, 3.0), (1.0, 3.0, 3.0)]), SHED)
    assert caught.value.reason is Reason.TOO_FEW_POINTS


def test_scattered_points_have_no_template() -> None:
    points = np.random.default_rng(1).uniform((0, 0, 2), (6, 4, 20), (12, 3))
    with pytest.raises(BuildingError, match="templates explain only") as caught:
        fit_templates(points, SHED)
    assert caught.value.reason is Reason.NO_PLANE


@settings(max_examples=examples(25), deadline=None)
@given(
    seed=st.integers(0, 10_000), shift=st.tuples(st.integers(-500, 500), st.integers(-500, 500), st.integers(0, 100))
)
def test_a_roof_that_is_moved_keeps_its_faces(seed: int, shift: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(seed)
    xy = np.rint(rng.uniform((0, 0), (10, 8), (30, 2)) * 1e3) / 1e3
    points = np.column_stack((xy, np.rint((8.0 - 0.7 * np.abs(xy[:, 1] - 4.0)) * 1e3) / 1e3))
    outline = shapely.box(0.0, 0.0, 10.0, 8.0)
    here = fit_templates(points, footprint_in_mm(outline))
    moved = shapely.affinity.translate(outline, *shift[:2])
    there = fit_templates(points + np.array(shift, float), footprint_in_mm(moved))
    assert here.counts.tolist() == there.counts.tolist()
    assert there.residuals_m == pytest.approx(here.residuals_m, abs=1e-6)


def test_the_margin_is_the_difference_of_both_criteria() -> None:
    """Against a flat roof through the middle of a gable, by hand."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.5, 10.0), np.arange(0.5, 8.0)))
    points = np.column_stack((x, y, 8.0 - 0.5 * np.abs(y - 4.0)))
    templates = fit_templates(points, footprint_in_mm(shapely.box(0.0, 0.0, 10.0, 8.0)))
    assert templates.counts.tolist() == [2]
    assert templates.parameters == 2.0
    flat = RoofPartition(polygons=(shapely.box(0, 0, 10_000, 8_000),), labels=np.zeros(1, np.int32))
    level = Plane(a=0.0, b=0.0, c=7.0, n_points=0, rmse_m=0.0)
    wrong = np.minimum(((points[:, 2] - 7.0) / 0.1) ** 2, 9.0).sum()
    assert margin_of_templates(points, templates, flat, [level]) == pytest.approx(wrong + math.log(80), abs=1e-6)


def test_points_beside_the_other_faces_count_in_neither_criterion() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.5, 10.0), np.arange(0.5, 8.0)))
    points = np.column_stack((x, y, np.full(80, 4.0)))
    templates = fit_templates(points, footprint_in_mm(shapely.box(0.0, 0.0, 10.0, 8.0)))
    level = Plane(a=0.0, b=0.0, c=4.0, n_points=0, rmse_m=0.0)
    half = RoofPartition(polygons=(shapely.box(0, 0, 5_000, 8_000),), labels=np.zeros(1, np.int32))
    assert margin_of_templates(points, templates, half, [level]) == pytest.approx(2 * math.log(80))


@pytest.mark.parametrize(("kind", "parameters"), [("flat", 3), ("gable", 6), ("hip", 12), ("stepped", 8)])
def test_other_faces_have_three_parameters_a_plane_and_two_a_step(
    exact_roof: ExactRoofs, kind: str, parameters: int
) -> None:
    roof = exact_roof(kind, density=10.0, with_footprint=True)
    drawn = roof.drawn()
    assert parameters_of(drawn, roof.planes) == parameters


@pytest.mark.parametrize("degrees", [-44.0, -10.0, 0.0, 30.0])
def test_the_main_direction_is_that_of_the_longest_walls(degrees: float) -> None:
    wing = Polygon([(0, 0), (12, 0), (12, 6), (6, 6), (6, 9), (3, 11), (0, 11)])
    turned = shapely.affinity.rotate(wing, degrees, origin=(0, 0))
    assert math.degrees(main_direction(edges_of(turned))) == pytest.approx(degrees, abs=1e-6)


def test_the_walls_tell_the_main_direction_of_an_outline_with_a_round_end_of_a_thousand_edges() -> None:
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 1001)
    hall = [(0.0, 0.0), *((12.0 + 4.0 * math.cos(a), 4.0 + 4.0 * math.sin(a)) for a in angle.tolist()), (0.0, 8.0)]
    turned = shapely.affinity.rotate(Polygon(hall), 20.0, origin=(0, 0))
    assert math.degrees(main_direction(edges_of(turned))) == pytest.approx(20.0, abs=0.2)


def test_only_the_longest_edges_of_an_outline_tell_its_main_direction() -> None:
    """64 edges of one direction, and of another one many more that are shorter: what they add up to does not count."""
    long = np.array([[0.0, k, 2.0, k] for k in range(64)])
    short = np.array([[0.0, k, 0.9, k + 0.9] for k in range(200)])
    assert main_direction(np.concatenate((short, long)).astype(np.float64)) == pytest.approx(0.0, abs=1e-9)


def test_a_robust_line_goes_past_a_third_of_outliers() -> None:
    t = np.linspace(0.0, 10.0, 30)
    z = 2.0 + 0.5 * t
    z[::3] += 3.0
    c, s = robust_line(t, z, 0.15, False)
    assert c == pytest.approx(2.0, abs=0.03)
    assert s == pytest.approx(0.5, abs=0.01)


def test_a_line_through_points_at_one_place_is_level() -> None:
    c, s = robust_line(np.full(5, 3.0), np.full(5, 7.0), 0.1, False)
    assert c == pytest.approx(7.0)
    assert s == 0.0


def test_a_ridge_off_the_middle_takes_one_more_parameter() -> None:
    box = np.array([0.0, 12.0, 0.0, 8.0])
    xy = np.random.default_rng(0).uniform((0, 0), (12, 8), (40, 2))
    for ridge, parameters in ((4.0, 2), (3.2, 3)):
        points = np.column_stack((xy, 9.0 - 0.6 * np.abs(xy[:, 1] - ridge)))
        cost, found, count, planes = best_shape(points, box, 0.1, math.log(40), True)
        assert (found, count) == (parameters, 2)
        assert cost == pytest.approx(parameters * math.log(40), abs=0.1)
        assert misfit(planes, count, points, 0.1) == pytest.approx(0.0, abs=0.1)


def test_a_gable_of_two_pitches_takes_four_parameters() -> None:
    xy = np.random.default_rng(3).uniform((0, 0), (12, 8), (50, 2))
    points = np.column_stack((xy, 9.0 - np.where(xy[:, 1] < 5.0, 0.4 * (5.0 - xy[:, 1]), 0.9 * (xy[:, 1] - 5.0))))
    _, parameters, count, planes = best_shape(points, np.array([0.0, 12.0, 0.0, 8.0]), 0.1, math.log(50), True)
    assert (parameters, count) == (4, 2)
    assert sorted(planes[:2, 1].tolist()) == [pytest.approx(-0.9, abs=0.02), pytest.approx(0.4, abs=0.02)]


def test_the_pieces_of_an_envelope_fill_their_rectangle_and_are_lowest_there() -> None:
    planes = np.array([(0.0, 0.6, 3.0), (0.0, -0.6, 7.8), (0.6, 0.0, 3.0), (-0.6, 0.0, 11.4)])
    region = np.array([0.0, 14.0, 0.0, 8.0])
    pieces = [Polygon(lower_piece(region, planes, k)) for k in range(4)]
    assert sum(piece.area for piece in pieces) == pytest.approx(14.0 * 8.0)
    for k, piece in enumerate(pieces):
        place = piece.representative_point()
        assert height(planes, 4, place.x, place.y)[1] == k


def test_a_plane_that_is_nowhere_lowest_has_no_piece() -> None:
    planes = np.array([(0.0, 0.0, 3.0), (0.0, 0.0, 4.0)])
    assert lower_piece(np.array([0.0, 1.0, 0.0, 1.0]), planes, 1).shape == (0, 2)
