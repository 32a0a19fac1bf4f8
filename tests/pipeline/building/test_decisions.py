"""What a result says about the way to it: figures with their limits, and the forms that were tried."""

import dataclasses
import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.errors import BuildingError
from pipeline.methods import METHODS, ReconstructSettings
from pipeline.model import (
    BuildingResult,
    Candidate,
    Decision,
    DecisionKind,
    Guide,
    GuideKind,
    Outcome,
    Plane,
    PreparedCloud,
    Reason,
    Segmentation,
    Status,
)
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPoints
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.unsupported_faces import level_unsupported_faces


def gable(n: int = 960, seed: int = 0) -> Candidate:
    """A gable of 12 m by 8 m with the eaves at 5 m, within its footprint."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 12, n), rng.uniform(0, 8, n)
    z = 5.0 + 0.7 * np.minimum(y, 8.0 - y) + rng.normal(0, 0.02, n)
    return candidate(np.column_stack((x, y, z)), footprint=shapely.box(0, 0, 12, 8))


def forms(result: BuildingResult) -> list[Decision]:
    """The forms that were tried."""
    return [entry for entry in result.decisions if entry.kind is DecisionKind.FORM]


def check(result: BuildingResult, name: str) -> Decision:
    """The check of this name."""
    (found,) = [entry for entry in result.decisions if entry.name == name]
    return found


def outcomes(result: BuildingResult) -> list[tuple[str, str]]:
    """Name and outcome of each form."""
    return [(entry.name, entry.outcome.value) for entry in forms(result)]


def test_a_sound_roof_needs_one_form_and_its_figures_are_there() -> None:
    result = reconstruct_building(gable(), "arrangement", ReconstructSettings())
    (form,) = forms(result)
    assert (form.name, form.outcome) == ("arrangement", Outcome.CHOSEN)
    assert (form.n_faces, form.n_planes, form.levelled_share) == (len(result.faces), len(result.planes), 0.0)
    points = check(result, "roof_points")
    assert (points.value, points.limit, points.outcome) == (960, RoofSettings().min_points_in_footprint, Outcome.MET)
    assert check(result, "planes_found").value == 2
    assert check(result, "points_on_planes_share").value > 0.9
    spacing = check(result, "point_spacing_m")
    assert (spacing.value, spacing.outcome) == (result.quality.point_spacing_m, Outcome.MISSED)


def test_the_figure_that_prevents_a_model_is_missed() -> None:
    few = reconstruct_building(gable(3), "arrangement", ReconstructSettings())
    assert few.reason is Reason.TOO_FEW_POINTS
    assert few.status is Status.FAILED
    (points,) = few.decisions
    assert (points.name, points.value, points.outcome) == ("roof_points", 3, Outcome.MISSED)


def test_a_share_of_no_points_on_planes_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    flat = Plane(a=0.0, b=0.0, c=50.0, n_points=0, rmse_m=0.0)

    def nothing(cloud: PreparedCloud) -> Segmentation:
        return Segmentation(planes=(flat,), labels=np.full(len(cloud.points), -1, np.int32))

    monkeypatch.setattr(ReconstructSettings, "segmentation", lambda *_: nothing)
    result = reconstruct_building(gable(), "kmeans", ReconstructSettings())
    assert result.reason is Reason.NO_PLANE
    share = check(result, "points_on_planes_share")
    assert (share.value, share.outcome) == (0.0, Outcome.MISSED)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_says_which_form_is_delivered(method: str) -> None:
    result = reconstruct_building(gable(), method, ReconstructSettings())
    assert result.status is Status.OK
    assert forms(result)[-1].outcome is Outcome.CHOSEN
    assert forms(result)[-1].n_faces == len(result.faces)


def test_where_points_are_few_both_forms_have_the_margin_of_their_competition() -> None:
    result = reconstruct_building(gable(100), "arrangement", ReconstructSettings())
    beaten, chosen = forms(result)
    assert {beaten.name, chosen.name} == {"templates", "arrangement"}
    assert (beaten.outcome, chosen.outcome) == (Outcome.OUTDONE, Outcome.CHOSEN)
    assert chosen.bic_margin == -beaten.bic_margin == result.quality.bic_margin
    assert chosen.bic_margin > 0.0
    assert check(result, "point_spacing_m").outcome is Outcome.MET


def test_a_form_that_is_beaten_later_is_listed_with_what_it_explains(monkeypatch: pytest.MonkeyPatch) -> None:
    usual, calls = level_unsupported_faces, iter(range(100))

    def level(
        drawn: RoofPartition, roof: RoofPoints, planes: Sequence[Plane], ground_z_m: float, settings: RoofSettings
    ) -> tuple[RoofPartition, list[Plane]]:
        if next(calls) > 0:
            return usual(drawn, roof, planes, ground_z_m, settings)
        flat = Plane(a=0.0, b=0.0, c=6.4, n_points=1, rmse_m=0.0)
        return RoofPartition(polygons=drawn.polygons, labels=drawn.labels * 0 + len(planes)), [*planes, flat]

    monkeypatch.setattr("pipeline.building.drawing.level_unsupported_faces", level)
    result = reconstruct_building(gable(), "arrangement", ReconstructSettings())
    first, second = forms(result)
    assert (first.outcome, first.levelled_share, first.detail) == (Outcome.OUTDONE, 1.0, "2 faces made level")
    assert (second.outcome, second.levelled_share) == (Outcome.CHOSEN, 0.0)
    assert second.detail == "vertices 2.5 times as far apart"
    assert first.explained_share < 0.5 < second.explained_share


def test_invalid_solids_are_listed_with_their_codes_and_the_block_behind_them(monkeypatch: pytest.MonkeyPatch) -> None:
    usual, judged = check_solid, iter([(306,)] * 3)
    for name in ("building.form_search", "building.drawing", "extras.lods.levels"):
        monkeypatch.setattr(f"pipeline.{name}.check_solid", lambda solid: next(judged, None) or usual(solid))
    monkeypatch.setattr("pipeline.roof.traced_forms.traced_forms", lambda *_: iter(()))
    given = gable()
    monkeypatch.setattr("pipeline.extras.lods.levels.lower_lods", lambda *_: [])
    result = reconstruct_building(given, "arrangement", ReconstructSettings())
    codes = [entry.validity_codes for entry in forms(result)[:3]]
    assert outcomes(result)[:3] == [("arrangement", "invalid")] * 3
    assert codes == [(306,)] * 3
    assert forms(result)[-1].outcome is Outcome.CHOSEN


def test_a_model_that_is_not_delivered_is_withdrawn_and_the_block_is_chosen() -> None:
    settings = ReconstructSettings(lods=("1.2", "2.2"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.extras.lods.levels.lower_lods", lambda *_: [])
        result = reconstruct_building(gable(), "arrangement", settings)
    assert result.status is Status.FALLBACK
    assert outcomes(result) == [("arrangement", "withdrawn"), ("block", "chosen")]
    levels = [entry for entry in result.decisions if entry.kind is DecisionKind.LEVEL]
    assert [(entry.name, entry.outcome.value) for entry in levels] == [("2.2", "undrawable"), ("1.2", "undrawable")]


def test_every_level_of_detail_that_was_asked_for_is_listed() -> None:
    result = reconstruct_building(gable(), "arrangement", ReconstructSettings(lods=("1.2", "1.3", "2.2")))
    levels = [entry for entry in result.decisions if entry.kind is DecisionKind.LEVEL]
    assert [(entry.name, entry.outcome.value, entry.n_faces) for entry in levels] == [
        ("2.2", "chosen", 2),
        ("1.3", "chosen", 1),
        ("1.2", "chosen", 1),
    ]


GUIDED = {
    "extras.guides.guide_matching.guided_outline": lambda _, guides, *__: guides,
    "extras.guides.guide_matching.inner_pieces": lambda guides, *_: guides,
    "extras.guides.enclosed_planes.with_enclosed_planes": lambda *_: True,
    "roof.plan.arrange": lambda *given: len(given[-1].pieces),
    "extras.guides.guided_faces.misfits_of": lambda *_: True,
    "extras.guides.guide_matching.followed": lambda guides, *_: guides,
}
"""The steps that need guides, and whether they get any."""


@pytest.mark.parametrize("step", list(GUIDED))
@pytest.mark.parametrize("kind", [BuildingError, shapely.errors.GEOSException, IndexError])
def test_a_building_whose_guides_fail_in_any_step_is_modelled_without_them_and_says_so(
    step: str, kind: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    free = dataclasses.replace(gable(), footprint=None)
    ridge = Guide(kind=GuideKind.RIDGE, line=shapely.LineString([(1.0, 4.0), (11.0, 4.0)]))
    eave = Guide(kind=GuideKind.EAVE, line=shapely.LineString([(0.0, -0.1), (12.0, -0.1)]))
    guided = dataclasses.replace(free, guides=(ridge, eave))
    known = reconstruct_building(free, "arrangement", ReconstructSettings())
    module, _, name = step.rpartition(".")
    usual = getattr(importlib.import_module(f"pipeline.{module}"), name)

    def failing(*given: Any) -> Any:
        if GUIDED[step](*given):
            raise BuildingError(Reason.NO_PARTITION, "a fault") if kind is BuildingError else kind("a fault")
        return usual(*given)

    assert reconstruct_building(guided, "arrangement", ReconstructSettings()).guides == (2, 0)
    monkeypatch.setattr(f"pipeline.{step}", failing)
    found = reconstruct_building(guided, "arrangement", ReconstructSettings())
    first, *others = found.decisions
    assert (first.name, first.outcome) == ("guides", Outcome.UNDRAWABLE)
    assert "a fault" in first.detail
    assert tuple(map(repr, others)) == tuple(map(repr, known.decisions))
    assert repr(dataclasses.replace(found, decisions=())) == repr(dataclasses.replace(known, decisions=()))


def test_a_building_that_fails_without_its_guides_too_keeps_its_own_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    ridge = Guide(kind=GuideKind.RIDGE, line=shapely.LineString([(1.0, 4.0), (11.0, 4.0)]))
    monkeypatch.setattr("pipeline.building.record.model_quality", lambda *_, **__: 1 // 0)
    result = reconstruct_building(dataclasses.replace(gable(), guides=(ridge,)), "arrangement", ReconstructSettings())
    assert (result.status, result.reason) == (Status.FAILED, Reason.INTERNAL_ERROR)
    assert "ZeroDivisionError" in result.reason_detail
