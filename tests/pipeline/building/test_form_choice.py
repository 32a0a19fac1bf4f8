"""Which of several sound forms of a roof is delivered."""

import types
from collections.abc import Sequence
from typing import cast

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.building import form_search
from pipeline.building.drawing import Building, DrawnModel
from pipeline.methods import ReconstructSettings
from pipeline.model import Candidate, Outcome, Plane, Reason, Status
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.roof import block, traced_forms
from pipeline.roof.named_form import ARRANGEMENT, TRACED, NamedForm
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPoints
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.solid import solid_parts
from pipeline.roof.unsupported_faces import level_unsupported_faces


def gable(seed: int = 0) -> Candidate:
    """A gable of 12 m by 8 m with the eaves at 5 m, 10 points per m2."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 12, 960), rng.uniform(0, 8, 960)
    z = 5.0 + 0.7 * np.minimum(y, 8.0 - y) + rng.normal(0, 0.02, 960)
    return candidate(np.column_stack((x, y, z)), footprint=shapely.box(0, 0, 12, 8))


def levelled_at_first(monkeypatch: pytest.MonkeyPatch, forms: int) -> list[int]:
    """Makes all faces of so many first forms level; the list holds an entry for every form that was drawn."""
    drawn_forms: list[int] = []
    usual = level_unsupported_faces

    def level(
        drawn: RoofPartition, roof: RoofPoints, planes: Sequence[Plane], ground_z_m: float, settings: RoofSettings
    ) -> tuple[RoofPartition, list[Plane]]:
        drawn_forms.append(len(drawn.polygons))
        if len(drawn_forms) > forms:
            return usual(drawn, roof, planes, ground_z_m, settings)
        flat = Plane(a=0.0, b=0.0, c=6.4, n_points=1, rmse_m=0.0)
        return RoofPartition(polygons=drawn.polygons, labels=drawn.labels * 0 + len(planes)), [*planes, flat]

    monkeypatch.setattr("pipeline.building.drawing.level_unsupported_faces", level)
    return drawn_forms


def test_a_form_that_was_made_level_gives_way_to_one_that_explains_the_points(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn_forms = levelled_at_first(monkeypatch, 1)
    result = reconstruct_building(gable(), "arrangement", ReconstructSettings())
    assert (result.status, result.lod, len(drawn_forms)) == (Status.OK, "2.2", 2)
    assert result.rmse_m < 0.05


@pytest.mark.parametrize(("share", "chosen"), [(0.81, "arrangement"), (0.9, "traced")])
def test_traced_faces_have_to_explain_what_their_number_costs(
    monkeypatch: pytest.MonkeyPatch, share: float, chosen: str
) -> None:
    shares = iter([0.8, 0.8, 0.8])
    monkeypatch.setattr("pipeline.building.drawing.goes_far", lambda *_: True)
    monkeypatch.setattr(form_search, "explained_share", lambda *_: next(shares, share))
    monkeypatch.setattr(traced_forms, "further_cost", lambda *_: 0.05)
    result = reconstruct_building(gable(), "arrangement", ReconstructSettings())
    assert [entry.name for entry in result.decisions if entry.outcome is Outcome.CHOSEN] == [chosen]


def test_a_form_is_chosen_by_what_it_explains_whatever_the_faces_before_it_cost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shares, costs = {"a": 0.90, "b": 0.95, "c": 0.93}, iter([0.03, 0.0])
    forms = {name: levelled_model() for name in shares}
    names = {id(model): name for name, model in forms.items()}
    monkeypatch.setattr(form_search, "explained_share", lambda _, model: shares[names[id(model)]])
    monkeypatch.setattr(form_search, "stays_near", lambda *_: False)
    monkeypatch.setattr(traced_forms, "further_cost", lambda *_: next(costs))
    models = [NamedForm(TRACED if name > "a" else ARRANGEMENT, lambda name=name: forms[name]) for name in shares]
    building = types.SimpleNamespace(decisions=[], roof=None, settings=types.SimpleNamespace(plan=None))
    chosen, _ = form_search.first_valid(models, cast("Building", building))
    assert chosen is forms["b"]


def levelled_model() -> DrawnModel:
    """A sound block that counts as levelled."""
    outline_mm = shapely.MultiPolygon([shapely.box(0, 0, 9_000, 9_000)])
    plane = Plane(a=0.0, b=0.0, c=6.0, n_points=9, rmse_m=0.0)
    partition = RoofPartition(polygons=tuple(outline_mm.geoms), labels=np.zeros(1, np.int32))
    return DrawnModel(lod="2.2", parts=solid_parts(partition, [plane], 0.0), planes=[plane], is_levelled=True)


def test_a_level_face_through_slopes_is_not_delivered_as_a_roof(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn_forms = levelled_at_first(monkeypatch, 1_000)
    result = reconstruct_building(gable(), "arrangement", ReconstructSettings())
    assert (result.status, result.reason, result.lod) == (Status.FALLBACK, Reason.LEVEL_THROUGH_SLOPE, "1.2")
    assert len(drawn_forms) > 2
    assert "more than 50%" in result.reason_detail


def test_a_block_that_cannot_be_drawn_gives_way_to_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(_: shapely.MultiPolygon) -> shapely.Polygon:
        raise shapely.errors.GEOSException("on purpose")

    monkeypatch.setattr(block, "_opened", opened)
    monkeypatch.setattr("pipeline.recipe.arranged_forms", lambda *_: iter(()))
    judged = iter([(306,)])
    usual = check_solid
    for name in ("building.form_search", "building.drawing", "extras.lods.levels"):
        monkeypatch.setattr(f"pipeline.{name}.check_solid", lambda solid: next(judged, None) or usual(solid))
    result = reconstruct_building(gable(), "arrangement", ReconstructSettings())
    assert (result.status, result.lod) == (Status.FALLBACK, "1.2")
    assert result.reason_detail.startswith("validity codes none")
