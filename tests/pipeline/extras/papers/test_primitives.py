"""The model of ten vertices and its counterparts: exact from exact points, valid as solids, or refused."""

from typing import Any

import numpy as np
import pytest
import shapely
from candidates_by_hand import turned_plan

from pipeline.errors import BuildingError
from pipeline.extras.papers.flush_walls import unite_flush_walls
from pipeline.extras.papers.primitives import BuildingPrimitive, fit_box, fit_gable, primitive_partition
from pipeline.model import FloatArray, LabelArray, Plane, Reason, RoofType
from pipeline.quality.validity import check_solid
from pipeline.roof.solid import solid_parts
from pipeline.segmentation.facet_geometry import fit_plane


def turned(uv: FloatArray, degrees: float) -> FloatArray:
    return turned_plan(uv, degrees) + np.array([20.0, 30.0])


def lattice(length: float, low: float, high: float, step: float = 0.5) -> FloatArray:
    u = np.linspace(-length / 2, length / 2, round(length / step) + 1)
    v = np.linspace(low, high, round((high - low) / step) + 1)
    return np.array([(a, b) for a in u for b in v])


def gable_points(
    degrees: float,
    *,
    length: float = 14.0,
    widths: tuple[float, float] = (4.0, 4.0),
    rises: tuple[float, float] = (0.7, 0.7),
) -> tuple[FloatArray, LabelArray, tuple[Plane, Plane]]:
    """Points on two sides of a ridge at 8 m, the first side of negative v."""
    uv = lattice(length, -widths[0], widths[1])
    v = uv[:, 1]
    z = 8.0 - np.where(v < 0, -v * rises[0], v * rises[1])
    points = np.rint(np.column_stack([turned(uv, degrees), z]) * 1e3) / 1e3
    labels = (v > 0).astype(np.int32)
    return points, labels, (fit_plane(points[v <= 0]), fit_plane(points[v >= 0]))


def fit(degrees: float, **shape: Any) -> Any:
    points, labels, planes = gable_points(degrees, **shape)
    return fit_gable(points, labels, planes, 0.25, min_side_share=0.5)


def solids(model: BuildingPrimitive) -> list[Any]:
    parts = solid_parts(primitive_partition(model.faces), model.planes, model.ground_z_m)
    return [unite_flush_walls(part).solid for part in parts]


@pytest.mark.parametrize("degrees", [0.0, 23.0, 90.0, 137.0])
def test_the_gable_of_exact_points_comes_back_to_the_millimetre(degrees: float) -> None:
    model = fit(degrees).model
    assert model.top_z_m == pytest.approx(8.0, abs=1e-3)
    assert model.eave_z_m == pytest.approx(8.0 - 0.7 * 4.0, abs=2e-3)
    assert model.ground_z_m == 0.25
    uv = np.array([(-7, 0), (7, 0), (-7, -4), (7, -4), (7, 4), (-7, 4.0)])
    expected = shapely.MultiPoint(turned(uv, degrees))
    assert shapely.MultiPoint(model.corners).hausdorff_distance(expected) < 4e-3


def test_a_gable_has_the_fifteen_parameters_and_ten_vertices_of_the_paper() -> None:
    model = fit(23.0).model
    names = [f"{axis}{k}" for axis in "xy" for k in range(1, 7)] + ["z1", "z3", "z7"]
    assert sorted(model.parameters) == sorted(names)
    vertices = model.vertices
    assert vertices.shape == (10, 3)
    assert (vertices[:2, 2] == model.top_z_m).all()
    assert (vertices[2:6, 2] == model.eave_z_m).all()
    assert (vertices[6:, 2] == model.ground_z_m).all()
    assert (vertices[2:6, :2] == vertices[6:, :2]).all(), "walls are vertical"


def test_vertices_are_numbered_around_with_3_and_6_beside_1() -> None:
    corners = np.array(fit(23.0).model.corners)
    assert shapely.is_ccw(shapely.LinearRing(corners[2:]))
    assert (corners[2] + corners[5]) / 2 == pytest.approx(corners[0], abs=1e-3)
    assert (corners[3] + corners[4]) / 2 == pytest.approx(corners[1], abs=1e-3)


@pytest.mark.parametrize("degrees", [*range(0, 180, 13)])
@pytest.mark.parametrize("rise", [0.05, 0.7, 3.0])
def test_turned_anyhow_and_rounded_the_gable_is_one_valid_solid(degrees: int, rise: float) -> None:
    model = fit(float(degrees) + 0.37, rises=(rise, rise), widths=(2.5, 2.5)).model
    found = solids(model)
    assert len(found) == 1
    assert check_solid(found[0]) == ()
    assert len(found[0].vertices) == 10
    by_vertex = sorted(map(tuple, model.vertices.tolist()))
    assert np.array(sorted(map(tuple, found[0].vertices.tolist()))) == pytest.approx(
        np.array(by_vertex), abs=2e-3 + 1e-3 * rise
    )


def test_both_sides_are_made_equal_by_the_larger_one() -> None:
    steps = fit(30.0, widths=(3.0, 5.0))
    assert [r.width_m for r in steps.rectangles] == pytest.approx([3.0, 5.0], abs=0.01)
    assert [r.width_m for r in steps.symmetric] == pytest.approx([5.0, 5.0], abs=0.01)
    first, second, *eaves = np.array(steps.model.corners)
    assert np.linalg.norm(eaves[0] - first) == pytest.approx(np.linalg.norm(eaves[3] - first), abs=2e-3)
    assert np.linalg.norm(second - first) == pytest.approx(14.0, abs=0.01)


def test_the_longer_side_decides_the_length() -> None:
    points, labels, planes = gable_points(0.0)
    shorter = (labels == 1) | (points[:, 0] < 25.0)
    steps = fit_gable(points[shorter], labels[shorter], planes, 0.0, min_side_share=0.5)
    assert steps.rectangles[0].length_m < 12.2
    assert steps.rectangles[1].length_m == pytest.approx(14.0)
    assert steps.symmetric[0].length_m == steps.symmetric[1].length_m == pytest.approx(14.0)


def test_unequal_pitches_give_the_mean_of_the_two_eaves() -> None:
    steps = fit(30.0, rises=(0.5, 0.9))
    assert steps.eave_z_m == pytest.approx((6.0, 4.4), abs=0.01)
    assert steps.model.eave_z_m == pytest.approx(5.2, abs=0.01)


def test_a_margin_goes_beyond_the_points_on_all_sides() -> None:
    points, labels, planes = gable_points(15.0)
    model = fit_gable(points, labels, planes, 0.0, min_side_share=0.5, margin_m=0.4).model
    outline = shapely.Polygon(model.corners[2:])
    assert outline.area == pytest.approx(14.8 * 8.8, rel=1e-3)
    assert model.eave_z_m == pytest.approx(8 - 0.7 * 4.4, abs=3e-3)


def test_planes_that_rise_from_their_line_are_called_a_valley() -> None:
    points, labels, _ = gable_points(15.0, rises=(-0.4, -0.4))
    planes = fit_plane(points[labels == 0]), fit_plane(points[labels == 1])
    steps = fit_gable(points, labels, planes, 0.0, min_side_share=0.5)
    assert steps.is_valley
    assert steps.model.eave_z_m > steps.model.top_z_m
    assert not fit(15.0).is_valley


def test_the_first_plane_lies_to_the_right_of_the_line_and_under_the_first_face() -> None:
    for degrees in (0.0, 100.0, 200.0, 300.0):
        points, labels, planes = gable_points(degrees)
        steps = fit_gable(points, labels, planes, 0.0, min_side_share=0.5)
        assert (steps.line.frame(points[labels == 0, :2])[:, 1] <= 1e-3).all()
        for k in (0, 1):
            face = steps.model.faces[k]
            assert face.plane == k
            assert face.polygon.buffer(0.01).contains(shapely.MultiPoint(points[labels == k, :2]))
            assert steps.model.planes[k].coefficients == pytest.approx(planes[k].coefficients, abs=0.05)


def test_planes_that_meet_beside_the_building_make_no_gable() -> None:
    points, labels, _ = gable_points(0.0)
    z = np.where(labels == 0, 8.0, 7.0 - 0.05 * (points[:, 1] - 30))
    stepped = np.column_stack([points[:, :2], z])
    planes = fit_plane(stepped[labels == 0]), fit_plane(stepped[labels == 1])
    with pytest.raises(BuildingError, match=r"0\.00 of the points of a plane lie on its side") as error:
        fit_gable(stepped, labels, planes, 0.0, min_side_share=0.5)
    assert error.value.reason is Reason.NO_PARTITION


def test_parallel_planes_make_no_gable() -> None:
    points, labels, planes = gable_points(0.0)
    above = Plane(a=planes[0].a, b=planes[0].b, c=planes[0].c + 2, n_points=9, rmse_m=0.0)
    with pytest.raises(BuildingError, match="parallel"):
        fit_gable(points, labels, (planes[0], above), 0.0, min_side_share=0.5)


@pytest.mark.parametrize("degrees", [0.0, 31.0, 122.0])
def test_a_flat_roof_is_a_box_of_eight_vertices_at_its_mean_elevation(degrees: float) -> None:
    uv = lattice(9.0, -3, 3)
    points = np.rint(np.column_stack([turned(uv, degrees), np.full(len(uv), 6.5)]) * 1e3) / 1e3
    model = fit_box(points, fit_plane(points), 1.0, flat_below_deg=3.0)
    assert model.roof_type is RoofType.FLAT
    assert model.vertices.shape == (8, 3)
    assert model.top_z_m == pytest.approx(6.5)
    assert shapely.Polygon(model.corners).area == pytest.approx(54.0, rel=2e-3)
    assert sorted(model.parameters) == sorted([f"{a}{k}" for a in "xy" for k in range(1, 5)] + ["z1", "z5"])
    assert [check_solid(solid) for solid in solids(model)] == [()]


@pytest.mark.parametrize("degrees", [0.0, 31.0, 122.0, 271.0])
@pytest.mark.parametrize("along", [True, False])
def test_a_pent_roof_falls_from_its_upper_edge_to_its_eave(degrees: float, along: bool) -> None:
    uv = lattice(9.0, -3, 3)
    z = 6.0 - 0.4 * (uv[:, 0] if along else uv[:, 1])
    points = np.rint(np.column_stack([turned(uv, degrees), z]) * 1e3) / 1e3
    model = fit_box(points, fit_plane(points), 0.0, flat_below_deg=3.0)
    assert model.roof_type is RoofType.PENT
    half = 4.5 if along else 3.0
    assert (model.top_z_m, model.eave_z_m) == pytest.approx((6 + 0.4 * half, 6 - 0.4 * half), abs=3e-3)
    plane = model.planes[0]
    assert plane.coefficients == pytest.approx(fit_plane(points).coefficients, abs=0.02)
    for number, (x, y) in enumerate(model.corners):
        wanted = model.top_z_m if number < 2 else model.eave_z_m
        assert plane.a * x + plane.b * y + plane.c == pytest.approx(wanted, abs=2e-3)
    assert len(model.parameters) == 11
    assert [check_solid(solid) for solid in solids(model)] == [()]


def test_points_on_one_line_make_no_box() -> None:
    points = np.array([(x, 2 * x, 5.0) for x in range(6)])
    with pytest.raises(BuildingError, match="one line"):
        fit_box(points, Plane(a=0, b=0, c=5, n_points=6, rmse_m=0), 0.0, flat_below_deg=3.0)
