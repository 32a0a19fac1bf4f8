"""Barrels, cones and domes become facets of one surface, near to it, planar and closed; roofs of planes do not."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate
from shapely import MultiPolygon, Polygon

from pipeline.methods import ReconstructSettings
from pipeline.model import BuildingResult, DecisionKind, FloatArray, Outcome, Plane, RoofType, Status
from pipeline.quality.detection import confidence_of
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.roof.curved.facets import STEEPEST_DEG, cut_to, facets_of
from pipeline.roof.curved.surfaces import Surface, barrel_distances, cone_distances, fitted_surfaces, sphere_distances
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import solid_parts

Roof = Callable[[FloatArray, FloatArray], FloatArray]
ROUND = shapely.Point(0.0, 0.0).buffer(6.0, quad_segs=16)
BOX = shapely.box(-8.0, -5.0, 8.0, 5.0)


def barrel(width: float, height: float, turn_deg: float = 25.0) -> Roof:
    def z(x: FloatArray, y: FloatArray) -> FloatArray:
        turn = math.radians(turn_deg)
        v = y * math.cos(turn) - x * math.sin(turn)
        return 4.0 + height * np.sqrt(np.maximum(1.0 - (v / width) ** 2, 0.0))

    return z


def cone(slope: float) -> Roof:
    return lambda x, y: 10.0 - slope * np.hypot(x, y)


def sphere(radius: float) -> Roof:
    return lambda x, y: 10.0 - radius + np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0.0))


def pyramid(sides: int, slope: float) -> Roof:
    angles = 2.0 * np.pi * np.arange(sides) / sides + 0.2

    def z(x: FloatArray, y: FloatArray) -> FloatArray:
        return 10.0 - slope * np.max([x * math.cos(a) + y * math.sin(a) for a in angles], axis=0)

    return z


def turned(outline: Polygon, turn_deg: float = 25.0) -> Polygon:
    return shapely.affinity.rotate(outline, turn_deg, origin=(0.0, 0.0))


def points_on(roof: Roof, outline: Polygon, per_m2: float = 8.0, noise_m: float = 0.02, seed: int = 1) -> FloatArray:
    rng = np.random.default_rng(seed)
    low_x, low_y, high_x, high_y = outline.bounds
    n = round(per_m2 * (high_x - low_x) * (high_y - low_y))
    x, y = rng.uniform(low_x, high_x, n), rng.uniform(low_y, high_y, n)
    inside = shapely.contains_xy(outline, x, y)
    x, y = x[inside], y[inside]
    return np.column_stack((x, y, roof(x, y) + rng.normal(0.0, noise_m, len(x))))


def modelled(roof: Roof, outline: Polygon, method: str = "arrangement", **survey: float) -> BuildingResult:
    one = candidate(points_on(roof, outline, **survey) + np.array([20.0, 20.0, 0.0]))
    return reconstruct_building(one, method, ReconstructSettings())


CURVES = {
    "barrel": (barrel(7.0, 7.0), turned(BOX), RoofType.BARREL),
    "half a cylinder": (barrel(5.0, 5.0), turned(BOX), RoofType.BARREL),
    "elliptic barrel": (barrel(5.5, 3.0), turned(BOX), RoofType.BARREL),
    "cone": (cone(0.8), ROUND, RoofType.CONE),
    "dome": (sphere(6.3), ROUND, RoofType.DOME),
    "cap": (sphere(11.0), ROUND, RoofType.DOME),
    "cap over a square": (sphere(11.0), shapely.box(-6.0, -6.0, 6.0, 6.0), RoofType.DOME),
}


@pytest.mark.parametrize("method", ["arrangement", "fuzzy-sart"])
@pytest.mark.parametrize("name", CURVES)
def test_a_curved_roof_has_its_name_and_facets_at_the_noise(name: str, method: str) -> None:
    roof, outline, kind = CURVES[name]
    result = modelled(roof, outline, method)
    assert (result.status, result.roof_type) == (Status.OK, kind)
    assert result.quality.is_curved
    assert result.quality.noise_m < 1.35 * 0.02
    assert all(check_solid(solid) == () for solid in result.solids)
    (chosen,) = [one for one in result.decisions if one.kind is DecisionKind.FORM and one.outcome is Outcome.CHOSEN]
    assert chosen.name == "curved"
    assert chosen.detail.startswith(kind.value)
    assert "facets within 0.0" in chosen.detail


def gable(slope: float) -> Roof:
    return lambda x, y: 8.0 - slope * np.abs(y) + 0.0 * x


def gambrel(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.minimum(8.0 - 0.4 * np.abs(y), 9.5 - 1.2 * np.abs(y)) + 0.0 * x


def hip(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.minimum(8.0 - 0.7 * np.abs(y), 8.0 + 0.7 * (3.0 - np.abs(x)))


def mansard(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.minimum(7.0, 9.0 - 0.9 * np.maximum(np.abs(x) - 3.0, np.abs(y)))


def waves(x: FloatArray, y: FloatArray) -> FloatArray:
    return 6.0 + 0.05 * np.sin(x) + 0.0 * y


def hanging(x: FloatArray, y: FloatArray) -> FloatArray:
    return 16.0 - np.sqrt(100.0 - y**2) + 0.0 * x


def nearly_level(x: FloatArray, y: FloatArray) -> FloatArray:
    return 6.0 - 0.002 * x**2 + 0.0 * y


PLANES = {
    "gable": gable(0.7),
    "flat gable": gable(0.15),
    "gambrel": gambrel,
    "hip": hip,
    "mansard": mansard,
    "waves": waves,
    "nearly level": nearly_level,
    "hanging": hanging,
    "hexagonal pyramid": pyramid(6, 0.8),
    "octagonal pyramid": pyramid(8, 0.8),
}


@pytest.mark.parametrize("noise_m", [0.01, 0.04])
@pytest.mark.parametrize("name", PLANES)
def test_a_roof_of_planes_is_not_curved(name: str, noise_m: float) -> None:
    result = modelled(PLANES[name], turned(BOX, 0.0), noise_m=noise_m)
    assert not result.roof_type.is_curved
    assert "curved" not in {one.name for one in result.decisions}


SURFACES = {
    "barrel": ((0.4, 0.7, 2.0, 7.0), RoofType.BARREL, barrel_distances),
    "elliptic barrel": ((0.4, 0.2, 2.0, 6.0, 4.0), RoofType.BARREL, barrel_distances),
    "cone": ((0.3, -0.2, 12.0, 0.9), RoofType.CONE, cone_distances),
    "steep cone": ((0.3, -0.2, 20.0, 1.6), RoofType.CONE, cone_distances),
    "dome": ((0.3, -0.2, 4.0, 9.0), RoofType.DOME, sphere_distances),
}
OUTLINES = {
    "box": turned(shapely.box(-5.0, -4.0, 5.0, 4.0), 31.0),
    "round": shapely.Point(0.0, 0.0).buffer(5.0, quad_segs=12),
    "notched": shapely.box(-5.0, -4.0, 5.0, 4.0).difference(shapely.box(2.0, 1.0, 6.0, 5.0)),
    "with a yard": shapely.box(-5.0, -4.0, 5.0, 4.0).difference(shapely.box(1.0, 1.0, 3.0, 3.0)),
}


def surface(name: str) -> Surface:
    parameters, kind, _ = SURFACES[name]
    return Surface(kind=kind, parameters=parameters, sigma_m=0.02, distances_m=np.zeros(0))


@pytest.mark.parametrize("tolerance_m", [0.01, 0.05])
@pytest.mark.parametrize("name", SURFACES)
def test_facets_are_planar_and_within_the_tolerance(name: str, tolerance_m: float) -> None:
    parameters, _, distances = SURFACES[name]
    outline = shapely.get_coordinates(OUTLINES["round"])
    rng = np.random.default_rng(2)
    for facet in facets_of(surface(name), outline, tolerance_m, 0.37):
        a, b, c = facet.plane
        corners = np.array(facet.corners)
        assert corners[:, 2] == pytest.approx(a * corners[:, 0] + b * corners[:, 1] + c, abs=1e-6)
        if math.hypot(a, b) > math.tan(math.radians(STEEPEST_DEG - 5.0)):
            continue
        weights = rng.dirichlet(np.ones(len(corners)), 50)
        inner = weights @ corners
        inner = inner[np.hypot(inner[:, 0], inner[:, 1]) < 5.0]
        assert np.abs(distances(inner, np.array(parameters))).max(initial=0.0) < 1.15 * tolerance_m


@pytest.mark.parametrize("place", OUTLINES)
@pytest.mark.parametrize("name", SURFACES)
def test_facets_fill_an_outline_and_close_a_valid_solid(name: str, place: str) -> None:
    outline_mm = shapely.transform(OUTLINES[place], lambda xy: np.rint(xy * 1e3))
    outline_mm = MultiPolygon([outline_mm])
    found = []
    for turn in (0.0, 0.37, 0.73):
        facets = facets_of(surface(name), shapely.get_coordinates(outline_mm) * 1e-3, 0.03, turn)
        pieces, of_piece = cut_to(outline_mm, facets)
        assert shapely.coverage_is_valid(pieces)
        assert shapely.area(pieces).sum() == pytest.approx(outline_mm.area, abs=2e4)
        planes = [Plane(a=a, b=b, c=c, n_points=0, rmse_m=0.02) for a, b, c in (one.plane for one in facets)]
        partition = RoofPartition(polygons=tuple(pieces), labels=np.array(of_piece, np.int32))
        parts = solid_parts(partition, planes, -60.0)
        assert len(parts) == 1
        found.append([code for part in parts for code in check_solid(part.solid)])
    assert [] in found


@pytest.mark.parametrize("name", SURFACES)
def test_a_fit_finds_the_parameters_again(name: str) -> None:
    parameters, kind, distances = SURFACES[name]
    rng = np.random.default_rng(4)
    xy = rng.uniform(-4.0, 4.0, (900, 2))
    low, high = np.full(len(xy), parameters[2] if kind is not RoofType.CONE else -20.0), np.full(len(xy), 40.0)
    for _ in range(60):  # the distance grows with the elevation
        z = 0.5 * (low + high)
        is_above = distances(np.column_stack((xy, z)), np.array(parameters)) > 0.0
        low, high = np.where(is_above, low, z), np.where(is_above, z, high)
    points = np.column_stack((xy, z))
    planes, labels = tangents(points, parameters, distances)
    found = fitted_surfaces(points, planes, labels, 0.01)
    wanted = np.array(parameters)
    (best,) = [one for one in found if one.kind is kind and len(one.parameters) == len(wanted)]
    got = np.array(best.parameters)
    if kind is RoofType.BARREL:
        got[0] %= math.pi
    assert got == pytest.approx(wanted, abs=1e-3)


def tangents(
    points: FloatArray, parameters: tuple[float, ...], distances: Callable[[FloatArray, FloatArray], FloatArray]
) -> tuple[list[Plane], FloatArray]:
    """Planes that touch a surface at nine of its points, and the nearest of them for each point."""
    steps = np.eye(3) * 1e-6
    at = points[::100]
    planes = []
    for place in at:
        gx, gy, gz = (distances((place + step)[None, :], np.array(parameters))[0] for step in steps)
        a, b = -gx / gz, -gy / gz
        planes.append(Plane(a=a, b=b, c=place[2] - a * place[0] - b * place[1], n_points=100, rmse_m=0.02))
    away = np.hypot(points[:, None, 0] - at[None, :, 0], points[:, None, 1] - at[None, :, 1])
    return planes, away.argmin(axis=1).astype(np.int32)


def test_a_curved_roof_in_a_given_footprint_keeps_the_outline() -> None:
    outline = turned(BOX)
    footprint = shapely.transform(outline, lambda xy: xy + 20.0)
    points = points_on(barrel(7.0, 7.0), outline) + np.array([20.0, 20.0, 0.0])
    result = reconstruct_building(candidate(points, footprint=footprint), "arrangement", ReconstructSettings())
    assert result.roof_type is RoofType.BARREL
    assert result.footprint is not None
    assert result.footprint.symmetric_difference(footprint).area < 0.05


def test_a_curve_is_one_surface_for_the_figures_that_count_faces() -> None:
    result = modelled(sphere(6.3), ROUND)
    assert len(result.faces) > 50
    planar = dataclasses.replace(result, roof_type=RoofType.COMBINATION)
    assert confidence_of(result) > 0.9 > confidence_of(planar)


def test_a_small_dome_about_which_points_scatter_as_about_a_crown_is_no_certain_building() -> None:
    dome = modelled(sphere(6.3), ROUND)
    crown = dataclasses.replace(
        dome,
        footprint=shapely.Point(0.0, 0.0).buffer(3.5),
        quality=dataclasses.replace(dome.quality, noise_m=0.115),
    )
    assert confidence_of(crown) < 0.5 < confidence_of(dome)
