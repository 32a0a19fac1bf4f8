"""Sloping roofs over round outlines: given with edges of decimetres, they are models of LoD2.2 all the same."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.model import BuildingResult, Candidate, FloatArray, Status
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.settings import RunSettings

Heights = Callable[[FloatArray, FloatArray], FloatArray]

ROOFS: dict[str, Heights] = {
    "flat": lambda u, _: np.full(len(u), 5.0),
    "pent": lambda u, _: 5.0 + 0.3 * u,
    "gable": lambda u, _: 6.0 - 0.6 * np.abs(u),
    "pyramid": lambda u, v: 7.0 - 0.6 * np.maximum(np.abs(u), np.abs(v)),
}


def circle(radius_m: float, corners: int) -> shapely.Polygon:
    angle = np.linspace(0.0, math.tau, corners, endpoint=False)
    return shapely.Polygon(np.round(radius_m * np.column_stack((np.cos(angle), np.sin(angle))), 3))


def tower(outline: shapely.Polygon, heights: Heights, density_per_m2: float) -> Candidate:
    """Points over a roof whose own axes are turned by 0.3 rad, given its outline."""
    rng = np.random.default_rng(0)
    low_x, low_y, high_x, high_y = outline.bounds
    n = int(density_per_m2 * (high_x - low_x) * (high_y - low_y))
    x, y = rng.uniform((low_x, low_y), (high_x, high_y), (n, 2)).T
    inside = shapely.contains_xy(outline, x, y)
    x, y = x[inside], y[inside]
    u, v = x * math.cos(0.3) + y * math.sin(0.3), y * math.cos(0.3) - x * math.sin(0.3)
    points = np.column_stack((x, y, heights(u, v) + rng.normal(0.0, 0.02, len(x))))
    return candidate(points, origin=(0.0, 0.0, 0.0), footprint=outline)


def modelled(one: Candidate, method: str = "arrangement", preset: str = "robust") -> BuildingResult:
    settings = RunSettings.from_mapping({"method": method, "preset": preset})
    return reconstruct_building(one, method, settings.building)


def assert_whole(result: BuildingResult, outline: shapely.Polygon) -> None:
    assert (result.status, result.lod, result.reason) == (Status.OK, "2.2", None)
    assert [code for solid in result.solids for code in check_solid(solid)] == []
    assert result.footprint is not None
    roof_m2 = math.fsum(face.polygon.area for face in result.faces)
    assert roof_m2 == pytest.approx(result.footprint.area, rel=1e-6)
    assert roof_m2 == pytest.approx(outline.area, rel=1e-3)
    assert shapely.hausdorff_distance(result.footprint, outline, densify=0.1) < 0.03


@pytest.mark.parametrize("roof", ROOFS)
@pytest.mark.parametrize("corners", [64, 128, 256])
@pytest.mark.parametrize("radius_m", [1.5, 3.0, 5.0, 8.0])
def test_a_round_tower_keeps_its_roof_and_its_area(radius_m: float, corners: int, roof: str) -> None:
    outline = circle(radius_m, corners)
    for density_per_m2 in (2.0, 10.0):
        assert_whole(modelled(tower(outline, ROOFS[roof], density_per_m2)), outline)


@pytest.mark.parametrize(
    ("method", "preset", "radius_m"),
    [
        *((method, "robust", 3.0) for method in ("fuzzy-sart", "parameter-space-2d", "parameter-space-3d", "kmeans")),
        ("fuzzy-sart", "faithful", 1.5),  # a traced roof has a simpler outline before it is a block
    ],
)
def test_so_it_does_by_the_other_methods(method: str, preset: str, radius_m: float) -> None:
    outline = circle(radius_m, 256)
    assert_whole(modelled(tower(outline, ROOFS["pent"], 10.0), method, preset), outline)


def test_few_points_on_a_round_tower_are_a_simple_shape() -> None:
    outline = circle(1.5, 256)
    one = tower(outline, ROOFS["pent"], 10.0)
    for n in (5, 12):
        assert_whole(modelled(dataclasses.replace(one, points=one.points[:: len(one.points) // n][:n])), outline)


def test_the_corners_of_straight_walls_beside_a_round_one_stay() -> None:
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 256)
    apse = [(8.0 + 2.0 * math.cos(a), 2.0 + 2.0 * math.sin(a)) for a in angle.tolist()]
    outline = shapely.Polygon([(0.0, 0.0), *apse, (0.0, 4.0)])
    result = modelled(tower(outline, ROOFS["pent"], 10.0))
    assert_whole(result, outline)
    assert result.footprint is not None
    corners = {tuple(xy) for xy in shapely.get_coordinates(result.footprint).tolist()}
    assert {(0.0, 0.0), (0.0, 4.0)} <= corners
