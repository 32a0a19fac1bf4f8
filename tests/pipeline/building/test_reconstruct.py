"""One building end to end: models, fallbacks, failures, and that every candidate gives a record."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate
from faces_by_hand import plane
from method_by_hand import MethodByHand
from shapely import Polygon

from pipeline.errors import BuildingError, SettingsError
from pipeline.methods import METHODS, ReconstructSettings, method_named
from pipeline.model import (
    BuildingResult,
    Candidate,
    FaceKind,
    Outcome,
    PlanFace,
    Reason,
    RoofType,
    Segmentation,
    Solid,
    Status,
)
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.roof.roof_settings import RoofSettings

Install = Callable[[Callable[[Candidate], Segmentation]], None]

DEFAULTS = ReconstructSettings()


def modelled(one: Candidate, method: str = "fuzzy-sart", settings: ReconstructSettings = DEFAULTS) -> BuildingResult:
    return reconstruct_building(one, method, settings)


def gable(n: int = 800, noise_m: float = 0.03, seed: int = 0, **fields: Any) -> Candidate:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 12, n), rng.uniform(0, 8, n)
    z = 3.0 + 0.7 * np.minimum(y, 8.0 - y) + rng.normal(0, noise_m, n)
    return candidate(np.column_stack((x, y, z)), **fields)


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Install:
    """`stub(function)` makes a segmentation function the method `stub`."""

    def install(segment: Callable[[Candidate], Segmentation]) -> None:
        method = MethodByHand(name="stub", segment=lambda cloud, _: segment(cloud.candidate))
        monkeypatch.setattr("pipeline.recipe.method_named", lambda _: method)

    return install


def one_plane(c: Candidate, *, a: float = 0.0, z: float = 5.0) -> Segmentation:
    return Segmentation(planes=(plane(a, 0.0, z),), labels=np.zeros(len(c.points), np.int32))


def no_plane(c: Candidate) -> Segmentation:
    return Segmentation(planes=(), labels=np.full(len(c.points), -1, np.int32))


@pytest.mark.parametrize("footprint", [None, shapely.box(0, 0, 12, 8)])
def test_a_gable_becomes_an_lod2_model(footprint: Polygon | None) -> None:
    c = gable(footprint=footprint, source_id="17", touches_data_edge=True)
    result = modelled(c)
    assert (result.status, result.reason, result.reason_detail) == (Status.OK, None, "")
    assert (result.lod, result.roof_type, result.method) == ("2.2", RoofType.GABLE, "fuzzy-sart")
    assert len(result.planes) == len(result.faces) == 2
    assert len(result.solids) == 1
    assert check_solid(result.solids[0]) == ()
    assert result.coverage > 0.97
    assert result.rmse_m < 0.05 < result.p95_m < 0.1
    assert result.density_per_m2 == pytest.approx(800 / result.footprint.area)
    assert (result.source_id, result.touches_data_edge, result.origin) == ("17", True, c.origin)
    assert {face.plane for face in result.faces} == {0, 1}
    used = {f.plane for f in result.solids[0].faces if f.kind is FaceKind.ROOF}
    assert used == {0, 1}


def test_the_footprint_of_the_result_is_the_plan_of_the_ground_faces() -> None:
    result = modelled(gable())
    ground = [
        shapely.Polygon(solid.vertices[list(face.rings[0]), :2], [solid.vertices[list(r), :2] for r in face.rings[1:]])
        for solid in result.solids
        for face in solid.faces
        if face.kind is FaceKind.GROUND
    ]
    assert shapely.union_all(ground).equals(result.footprint)


def test_the_same_candidate_gives_the_same_result_to_the_bit() -> None:
    first, second = (modelled(gable(seed=4)) for _ in range(2))
    assert first.planes == second.planes
    assert first.solids[0].faces == second.solids[0].faces
    assert first.solids[0].vertices.tobytes() == second.solids[0].vertices.tobytes()
    assert first.footprint.wkb == second.footprint.wkb


def test_two_buildings_of_one_candidate_are_two_solids() -> None:
    rng = np.random.default_rng(1)
    here = np.column_stack((rng.uniform(0, 8, (500, 2)), rng.normal(5, 0.02, 500)))
    result = modelled(candidate(np.vstack((here, here + np.array([14.0, 0.0, 1.0])))))
    assert result.status is Status.OK
    assert len(result.solids) == 2
    assert result.footprint.geom_type == "MultiPolygon"


@pytest.mark.parametrize("n", [0, 1, 3, 9])
def test_too_few_points_are_reported(n: int) -> None:
    points = np.column_stack((np.arange(n), np.arange(n) ** 2, np.full(n, 5.0)))
    result = modelled(candidate(points))
    assert (result.status, result.reason, result.lod) == (Status.FAILED, Reason.TOO_FEW_POINTS, "")
    assert f"{n} roof points, fewer than min_points = 10" in result.reason_detail
    assert (result.solids, result.roof_type, result.coverage) == ((), RoofType.NONE, 0.0)
    assert math.isnan(result.rmse_m)
    assert (result.footprint is None) == (n < 3)


def test_too_many_points_and_a_candidate_of_kilometres_are_too_complex() -> None:
    many = modelled(gable(n=1500), settings=ReconstructSettings(roof=RoofSettings(max_points=1000)))
    far = modelled(candidate(np.vstack((gable().points, gable().points + np.array([2500.0, 0.0, 0.0])))))
    for result in (many, far):
        assert (result.status, result.reason) == (Status.FAILED, Reason.TOO_COMPLEX)
    assert "1500 points, more than max_points = 1000" in many.reason_detail


def test_without_a_plane_there_is_a_block(stub: Install) -> None:
    stub(no_plane)
    result = modelled(gable(), "stub")
    assert (result.status, result.reason, result.lod) == (Status.FALLBACK, Reason.NO_PLANE, "1.2")
    assert result.roof_type is RoofType.FLAT
    assert check_solid(result.solids[0]) == ()
    assert result.footprint.area == pytest.approx(96.0, rel=0.1)
    assert result.planes[0].c == pytest.approx(3.0 + 0.7 * 2.8, abs=0.2)


def test_a_method_that_gives_up_leaves_a_block_with_its_reason(stub: Install) -> None:
    def give_up(_: Candidate) -> Segmentation:
        raise BuildingError(Reason.TOO_COMPLEX, "7 rounds, the limit is 6")

    stub(give_up)
    result = modelled(gable(footprint=shapely.box(0, 0, 12, 8)), "stub")
    assert (result.status, result.reason) == (Status.FALLBACK, Reason.TOO_COMPLEX)
    assert result.reason_detail == "7 rounds, the limit is 6"
    assert result.footprint.equals(shapely.box(0, 0, 12, 8))


def test_a_solid_that_stays_invalid_becomes_a_block_with_the_codes(monkeypatch: pytest.MonkeyPatch) -> None:
    def judge(solid: Solid) -> tuple[int, ...]:
        return (204, 303) if sum(face.kind is FaceKind.ROOF for face in solid.faces) > 1 else ()

    for name in ("building.form_search", "building.drawing", "extras.lods.levels"):
        monkeypatch.setattr(f"pipeline.{name}.check_solid", judge)
    result = modelled(gable())
    assert (result.status, result.reason, result.lod) == (Status.FALLBACK, Reason.INVALID_SOLID, "1.2")
    assert result.validity_codes == (204, 303)
    assert "204, 303" in result.reason_detail


def test_nothing_invalid_is_delivered_even_where_no_block_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("building.form_search", "building.drawing", "extras.lods.levels"):
        monkeypatch.setattr(f"pipeline.{name}.check_solid", lambda _: (305,))
    result = modelled(gable())
    assert (result.status, result.reason, result.solids) == (Status.FAILED, Reason.NO_FOOTPRINT, ())


def test_an_unexpected_error_is_reported_with_its_place(stub: Install) -> None:
    stub(lambda c: c.no_such_attribute)
    result = modelled(gable(), "stub")
    assert (result.status, result.reason) == (Status.FAILED, Reason.INTERNAL_ERROR)
    for part in ("AttributeError", "no_such_attribute", "test_reconstruct.py:"):
        assert part in result.reason_detail


def test_nan_coordinates_are_an_internal_error_not_a_crash() -> None:
    c = gable()
    points = c.points.copy()
    points[5] = np.nan
    result = modelled(dataclasses.replace(c, points=points))
    assert (result.status, result.reason) == (Status.FAILED, Reason.INTERNAL_ERROR)
    assert "not finite" in result.reason_detail
    assert result.footprint.area == pytest.approx(96.0, rel=0.1)


@pytest.mark.parametrize("error", [MemoryError, KeyboardInterrupt])
def test_lack_of_memory_and_interrupts_are_passed_on(stub: Install, error: type[BaseException]) -> None:
    def stop(_: Candidate) -> Segmentation:
        raise error

    stub(stop)
    with pytest.raises(error):
        modelled(gable(), "stub")


def test_points_on_one_line_or_one_place_give_a_record() -> None:
    line = np.column_stack((np.linspace(0, 9, 40), np.linspace(0, 9, 40), np.full(40, 5.0)))
    for points in (line, np.repeat([[1.0, 2.0, 5.0]], 40, axis=0), line * [1, 0, 1]):
        result = modelled(candidate(points))
        assert result.reason is not Reason.INTERNAL_ERROR, result.reason_detail
        assert all(check_solid(solid) == () for solid in result.solids)


def test_a_steep_plane_that_dips_under_the_floor_becomes_level(stub: Install) -> None:
    stub(lambda c: one_plane(c, a=1.4, z=-2.0))
    result = modelled(gable(), "stub")
    assert (result.status, result.reason) == (Status.FALLBACK, Reason.SCATTERED)  # a block explains a gable as well
    assert [entry.detail for entry in result.decisions if entry.outcome is Outcome.WITHDRAWN] != []
    assert [one.slope_deg for one in result.planes] == [0.0]
    assert result.solids[0].vertices[:, 2].min() == 0.0


def test_an_empty_footprint_and_one_away_from_the_points_give_a_record() -> None:
    empty = modelled(gable(footprint=shapely.Polygon()))
    assert (empty.status, empty.reason) == (Status.FAILED, Reason.NO_FOOTPRINT)
    away = modelled(gable(footprint=shapely.box(40, 40, 50, 50)))
    assert away.reason is not Reason.INTERNAL_ERROR
    assert all(check_solid(solid) == () for solid in away.solids)
    assert away.coverage == 0.0


@pytest.mark.parametrize("method", ["arrangement", "fuzzy-sart", "parameter-space-2d", "parameter-space-3d", "kmeans"])
def test_a_part_of_a_footprint_without_points_is_left_out_and_its_share_reported(method: str) -> None:
    house, empty = shapely.box(0, 0, 12, 8), shapely.box(30, 0, 36, 8)
    whole, part = (modelled(gable(footprint=f), method) for f in (house, shapely.MultiPolygon([house, empty])))
    assert (whole.status, whole.lod, whole.footprint_share) == (Status.OK, "2.2", pytest.approx(1.0, abs=1e-3))
    assert (part.status, part.reason, part.lod) == (Status.DOUBTFUL, Reason.NOT_SEEN, "2.2")
    assert part.footprint.equals(whole.footprint)
    assert part.footprint_share == pytest.approx(2.0 / 3.0, abs=1e-3)


def test_without_a_given_footprint_or_a_model_there_is_no_share_to_tell() -> None:
    assert math.isnan(modelled(gable(), "arrangement").footprint_share)
    failed = modelled(gable(n=2, footprint=shapely.box(0, 0, 12, 8)), "arrangement")
    assert failed.status is Status.FAILED
    assert math.isnan(failed.footprint_share)


def test_a_block_covers_the_parts_without_points_too(stub: Install) -> None:
    stub(no_plane)
    parts = shapely.MultiPolygon([shapely.box(0, 0, 12, 8), shapely.box(30, 0, 36, 8)])
    result = modelled(gable(footprint=parts), "stub")
    assert (result.lod, result.footprint_share) == ("1.2", 1.0)


def test_an_unknown_method_names_the_valid_ones_and_settings_of_another_are_refused() -> None:
    with pytest.raises(SettingsError, match="fuzzy-sart"):
        modelled(gable(), "magic")
    assert method_named("fuzzy-sart") is METHODS["fuzzy-sart"]
    with pytest.raises(SettingsError, match="RoofSettings: use FuzzySartSettings"):
        modelled(gable(), settings=ReconstructSettings(method=RoofSettings()))


def test_one_plane_over_everything_is_one_roof_face(stub: Install) -> None:
    stub(one_plane)
    result = modelled(gable(footprint=shapely.box(0, 0, 12, 8)), "stub")
    assert len(result.faces) == 1
    assert len(result.solids[0].vertices) == 8


def tent(c: Candidate) -> Segmentation:
    """The two sides of a gable of 12 x 8 m that draws its own faces, wider than its points."""
    south = shapely.box(-1.0, -1.0, 13.0, 4.0)
    north = shapely.box(-1.0, 4.0, 13.0, 9.0)
    return Segmentation(
        planes=(plane(0.0, 0.7, 3.0), plane(0.0, -0.7, 8.6)),
        labels=(c.points[:, 1] > 4.0).astype(np.int32),
        faces=(PlanFace(plane=0, polygon=south), PlanFace(plane=1, polygon=north)),
        roof_type=RoofType.PENT,
    )


def test_a_primitive_is_delivered_as_the_method_draws_and_calls_it(stub: Install) -> None:
    stub(tent)
    result = modelled(gable(), "stub")
    assert (result.status, result.lod, result.roof_type) == (Status.OK, "2.2", RoofType.PENT)
    assert result.footprint is not None
    assert result.footprint.equals(shapely.box(-1.0, -1.0, 13.0, 9.0))
    assert len(result.solids[0].vertices) == 10
    assert check_solid(result.solids[0]) == ()
    stub(lambda c: dataclasses.replace(tent(c), roof_type=None))
    assert modelled(gable(), "stub").roof_type is RoofType.GABLE


def test_a_primitive_that_makes_no_valid_solid_becomes_a_block(stub: Install) -> None:
    overlapping = tuple(PlanFace(plane=k, polygon=shapely.box(0, 0, 12, 8)) for k in (0, 1))
    stub(lambda c: dataclasses.replace(tent(c), faces=overlapping))
    result = modelled(gable(), "stub")
    assert (result.status, result.reason, result.lod) == (Status.FALLBACK, Reason.INVALID_SOLID, "1.2")
    assert check_solid(result.solids[0]) == ()
    assert result.roof_type is RoofType.FLAT
