"""Sides of a roof that no pulse reached: they continue the seen side, or end it; nothing rises above the points."""

import math

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.methods import ReconstructSettings
from pipeline.model import BuildingResult, Candidate, FloatArray, Reason, RoofType, Status
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building

LENGTH_M, WIDTH_M, EAVE_M, SLOPE = 12.0, 8.0, 5.0, 0.75
RIDGE_M = EAVE_M + SLOPE * WIDTH_M / 2.0
SHAPES = ("flat", "gable", "hip", "pent")


def heights(shape: str, x: FloatArray, y: FloatArray) -> FloatArray:
    """Elevations of a roof of 12 m by 8 m."""
    across, along = np.minimum(y, WIDTH_M - y), np.minimum(x, LENGTH_M - x)
    rise = {"flat": 0.0 * y, "gable": across, "hip": np.minimum(across, along), "pent": y}[shape]
    return EAVE_M + SLOPE * rise


def turned(xy: FloatArray, turn_deg: float) -> FloatArray:
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    return np.column_stack((xy[:, 0] * cos - xy[:, 1] * sin, xy[:, 0] * sin + xy[:, 1] * cos)) + 60.0


def half_seen(
    shape: str = "gable",
    *,
    seen_m: float = 4.0,
    tilt: float = 0.0,
    turn_deg: float = 0.0,
    density: float = 9.0,
    seed: int = 0,
) -> Candidate:
    """A roof of 12 m by 8 m in its footprint, seen up to a line across its slopes that may be tilted."""
    rng = np.random.default_rng(seed)
    n = round(density * LENGTH_M * WIDTH_M)
    x, y = rng.uniform(0.0, LENGTH_M, n), rng.uniform(0.0, WIDTH_M, n)
    z = heights(shape, x, y) + rng.normal(0.0, 0.02, n)
    seen = y < seen_m + tilt * (x - LENGTH_M / 2.0)
    outline = shapely.transform(
        shapely.box(0.0, 0.0, LENGTH_M, WIDTH_M), lambda xy: turned(np.asarray(xy), turn_deg).round(3)
    )
    return candidate(np.column_stack((turned(np.column_stack((x, y)), turn_deg), z))[seen], footprint=outline)


def modelled(one: Candidate) -> BuildingResult:
    result = reconstruct_building(one, "arrangement", ReconstructSettings())
    assert all(check_solid(solid) == () for solid in result.solids)
    return result


def top_m(result: BuildingResult) -> float:
    return max(float(solid.vertices[:, 2].max()) for solid in result.solids)


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, 90.0, 201.0])
@pytest.mark.parametrize(("seen_m", "tilt"), [(3.0, 0.0), (3.97, 0.0), (3.5, 0.12), (3.6, -0.1)])
def test_the_far_slope_of_a_gable_is_the_mirror_image_of_the_seen_one(
    seen_m: float, tilt: float, turn_deg: float
) -> None:
    result = modelled(half_seen(seen_m=seen_m, tilt=tilt, turn_deg=turn_deg, seed=round(100.0 * seen_m)))
    assert (result.roof_type, len(result.faces)) == (RoofType.GABLE, 2)
    assert (result.status, result.reason) in {(Status.OK, None), (Status.DOUBTFUL, Reason.NOT_SEEN)}
    assert top_m(result) == pytest.approx(RIDGE_M, abs=0.1)
    assert result.footprint_share == pytest.approx(1.0, abs=1e-3)
    assert result.rmse_m < 0.05


@pytest.mark.parametrize("density", [0.8, 3.0, 25.0])
def test_the_density_of_the_points_does_not_matter(density: float) -> None:
    result = modelled(half_seen(seen_m=3.6, density=density, seed=3))
    assert (result.status, result.roof_type) == (Status.OK, RoofType.GABLE)
    assert top_m(result) == pytest.approx(RIDGE_M, abs=0.25)


def test_what_was_not_seen_is_labelled() -> None:
    result = modelled(half_seen(seen_m=4.0))
    assert 0.35 < result.quality.extrapolated_share < 0.5
    seen, far = sorted(result.planes, key=lambda plane: -plane.n_points)
    assert seen.n_points > 300
    assert (far.n_points, far.rmse_m) == (0, 0.0)
    whole = modelled(half_seen(seen_m=9.0))
    assert whole.quality.extrapolated_share == 0.0
    assert min(plane.n_points for plane in whole.planes) > 300
    assert math.isfinite(result.quality.ridge_z_sigma_m)


def test_hips_that_were_half_seen_go_on() -> None:
    result = modelled(half_seen("hip", seen_m=4.0, density=16.0))
    assert (result.status, result.roof_type) == (Status.OK, RoofType.HIP)
    assert top_m(result) == pytest.approx(RIDGE_M, abs=0.15)
    # the eaves of all sides lie at one height
    corners = np.concatenate([shapely.get_coordinates(face.polygon, include_z=True) for face in result.faces])
    on_outline = shapely.distance(shapely.points(corners[:, :2]), result.footprint.exterior) < 0.01
    assert corners[on_outline, 2] == pytest.approx(EAVE_M, abs=0.2)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seen_m", [2.6, 4.4, 5.0, 6.0, 7.0])
def test_no_face_rises_above_the_points_or_the_ridge(shape: str, seen_m: float) -> None:
    one = half_seen(shape, seen_m=seen_m, tilt=0.05, turn_deg=17.0, seed=7)
    result = modelled(one)
    beyond_m = 3.0 * 0.02 + SLOPE * 2.0 * result.quality.point_spacing_m
    highest_m = float(one.points[:, 2].max()) + beyond_m
    assert top_m(result) <= max(highest_m, RIDGE_M + 0.1 if shape != "flat" else 0.0)


@pytest.mark.parametrize("seen_m", [5.5, 6.3, 7.2])
def test_a_slope_that_goes_on_past_the_middle_ends_level_behind_its_points(seen_m: float) -> None:
    result = modelled(half_seen("pent", seen_m=seen_m, seed=1))
    assert result.status is Status.OK
    assert result.rmse_m < 0.05
    slopes = sorted(round(plane.slope_deg) for plane in result.planes)
    assert slopes in ([37], [0, 37])
    level = [plane for plane in result.planes if plane.slope_deg == 0.0]
    assert all(plane.n_points == 0 for plane in level)


def test_a_yard_that_was_seen_is_not_roof() -> None:
    one = half_seen(seen_m=4.0)
    columns, rows = np.meshgrid(np.arange(60.5, 72.0), np.arange(64.5, 68.0))
    yard = np.column_stack((columns.ravel(), rows.ravel(), np.zeros(columns.size)))
    result = modelled(candidate(one.points, footprint=one.footprint, elsewhere=yard))
    assert result.status is Status.OK
    assert len([plane for plane in result.planes if plane.slope_deg > 1.0]) == 1
    beyond_m = 0.06 + SLOPE * 2.0 * result.quality.point_spacing_m
    assert top_m(result) <= float(one.points[:, 2].max()) + beyond_m


def test_a_strip_at_the_eave_does_not_show_how_high_the_ridge_is() -> None:
    one = half_seen(seen_m=1.2, density=20.0)
    result = modelled(one)
    assert top_m(result) <= float(one.points[:, 2].max()) + 0.06 + SLOPE * 2.0 * result.quality.point_spacing_m


def test_the_order_of_points_does_not_matter_and_the_place_neither() -> None:
    one = half_seen(seen_m=3.7, turn_deg=40.0)
    first = modelled(one)
    shift = np.array([4_000.0, 7_000.0, 100.0])
    footprint = shapely.transform(one.footprint, lambda xy: xy + shift[:2])
    other = modelled(candidate(one.points + shift, footprint=footprint, ground_z_m=100.0))
    assert [solid.vertices.shape for solid in other.solids] == [solid.vertices.shape for solid in first.solids]
    assert other.solids[0].vertices - shift == pytest.approx(first.solids[0].vertices, abs=0.002)
