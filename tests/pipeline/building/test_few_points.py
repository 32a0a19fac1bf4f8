"""Buildings with few points: templates compete with the arrangement, and stand in where there are no planes."""

import dataclasses
import math

import candidates_by_hand as by_hand
import numpy as np
import pytest
import shapely

from pipeline.methods import ReconstructSettings
from pipeline.model import BuildingResult, Candidate, FloatArray, Reason, RoofType, Status
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.roof.roof_settings import RoofSettings

HOUSE = shapely.box(0.0, 0.0, 12.0, 8.0)


def candidate(points: FloatArray, outline: shapely.Polygon | None = HOUSE) -> Candidate:
    return by_hand.candidate(points, building_id="house", origin=(0.0, 0.0, 0.0), footprint=outline)


def hip_points(n: int, seed: int = 0) -> FloatArray:
    """Over a hip roof of 40 % all around, its ridge at 4.6 m."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform((0.0, 0.0), (12.0, 8.0), (n, 2)).T
    z = 3.0 + 0.4 * np.minimum(np.minimum(x, 12.0 - x), np.minimum(y, 8.0 - y))
    return np.column_stack((x, y, z + rng.normal(0.0, 0.02, n)))


def modelled(one: Candidate, roof: RoofSettings | None = None) -> BuildingResult:
    return reconstruct_building(one, "arrangement", ReconstructSettings(roof=roof or RoofSettings()))


@pytest.mark.parametrize("seed", range(4))
def test_thirty_points_tell_a_hip_roof_with_its_ridge(seed: int) -> None:
    result = modelled(candidate(hip_points(30, seed)))
    assert (result.status, result.lod, result.roof_type) == (Status.OK, "2.2", RoofType.HIP)
    assert len(result.faces) == 4
    assert [check_solid(solid) for solid in result.solids] == [()]
    top = max(float(solid.vertices[:, 2].max()) for solid in result.solids)
    assert top == pytest.approx(4.6, abs=0.15)
    assert sum(face.polygon.area for face in result.faces) == pytest.approx(HOUSE.area, rel=1e-3)


def test_the_record_says_by_how_much_the_template_was_better_where_it_competes() -> None:
    assert modelled(candidate(hip_points(30))).quality.bic_margin > 0.0
    dense, left_out = modelled(candidate(hip_points(600))), RoofSettings(templates_spacing_m=100.0)
    for result in (dense, modelled(candidate(hip_points(30)), left_out)):
        assert math.isnan(result.quality.bic_margin)


def test_six_points_are_a_flat_roof_in_a_given_footprint_alone() -> None:
    points = np.array([(1, 1, 3.0), (6, 2, 3.03), (11, 1, 2.98), (2, 7, 3.01), (7, 6, 3.0), (11, 7, 2.99)])
    result, without = modelled(candidate(points)), modelled(candidate(points, outline=None))
    assert (result.status, result.lod, result.roof_type) == (Status.OK, "2.2", RoofType.FLAT)
    assert result.planes[0].c == pytest.approx(3.0, abs=0.03)
    assert (without.status, without.reason) == (Status.FAILED, Reason.TOO_FEW_POINTS)


def test_scattered_points_become_a_block_and_keep_their_reason() -> None:
    points = np.random.default_rng(3).uniform((0, 0, 2), (12, 8, 20), (12, 3))
    result = modelled(candidate(points))
    assert (result.status, result.lod, result.reason) == (Status.FALLBACK, "1.2", Reason.NO_PLANE)


@pytest.mark.parametrize("density", [20, 40, 80])
def test_what_was_modelled_before_changes_nothing(density: int) -> None:
    points = hip_points(density)
    one = modelled(candidate(points))
    modelled(candidate(hip_points(70, seed=5)))
    other = modelled(candidate(points))
    assert one.solids[0].faces == other.solids[0].faces
    assert np.array_equal(one.solids[0].vertices, other.solids[0].vertices)


def test_points_that_no_face_can_be_made_of_become_a_block_on_the_given_outline() -> None:
    points = np.array([(1, 1, 4.0), (11, 1, 9.0), (6, 7, 6.0), (2, 6, 13.0)]) + np.array([40.0, 0.0, 0.0])
    result = modelled(candidate(points))
    assert (result.status, result.lod, result.reason) == (Status.FALLBACK, "1.2", Reason.TOO_FEW_POINTS)
    assert result.footprint is not None
    assert result.footprint.area == pytest.approx(HOUSE.area, rel=1e-3)


def test_an_outline_of_kilometres_is_too_complex_and_a_block() -> None:
    points = hip_points(600)
    far = shapely.MultiPolygon([HOUSE, shapely.affinity.translate(HOUSE, 20_000.0, 20_000.0)])
    result = modelled(dataclasses.replace(candidate(points), footprint=far))
    assert (result.status, result.lod, result.reason) == (Status.FALLBACK, "1.2", Reason.TOO_COMPLEX)
    assert "more than 1900 m" in result.reason_detail
