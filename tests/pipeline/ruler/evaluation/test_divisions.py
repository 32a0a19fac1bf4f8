"""Rows of houses: a right division is found, a wrong one is judged as before."""

import dataclasses
import itertools

import numpy as np
import pytest
import shapely
from damaged_suburb import model_set
from roofs_by_hand import flat, gable, reference

from pipeline.model import Status
from pipeline.ruler.evaluation.delivery import Stands
from pipeline.ruler.evaluation.divisions import MIN_PART_IOU, whole_models
from pipeline.ruler.evaluation.evaluate import Evaluation, evaluate
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.score_tables import ROLES

WALLS = (0.0, 6.0, 12.0, 18.0, 24.0)
DEPTH_M = 8.0


def row(walls: tuple[float, ...], name: str = "m", **more: object) -> list[RoofModel]:
    """Flat roofs of other elevations between walls."""
    return [
        flat(f"{name}{k}", low, width=high - low, depth=DEPTH_M, z=6.0 + k % 3, **more)  # type: ignore[arg-type]
        for k, (low, high) in enumerate(itertools.pairwise(walls))
    ]


HOUSES = row(WALLS, "house", source_id="row")
ALONE = gable("alone", 60.0)
TRUTH = reference([*HOUSES, ALONE])


def judged(models: list[RoofModel]) -> Evaluation:
    return evaluate(model_set([*models, ALONE]), TRUTH)


def figure(evaluation: Evaluation, name: str) -> float:
    return evaluation.measure(name).value


@pytest.mark.parametrize(
    "walls",
    [WALLS, (0.0, 12.0, 24.0), (0.0, 6.0, 18.0, 24.0), (0.3, 6.5, 12.0, 17.6, 24.2), (0.0, 24.0)],
    ids=["houses", "pairs", "one pair", "nearly", "one"],
)
def test_a_row_is_found_however_whole_houses_are_put_together(walls: tuple[float, ...]) -> None:
    found = judged(row(walls))
    for name, value in (("lod2", 1.0), ("nothing", 0.0), ("split", 0.0), ("joined", 0.0), ("part_models", 0.0)):
        assert figure(found, f"delivery.{name}") == value, name
    assert figure(found, "footprints.iou_from_90") == 1.0
    rows = {one["building_id"]: one for one in found.tables["buildings"].to_pylist()}
    assert rows["house0"]["model_ids"] == [f"m{k}" for k in range(len(walls) - 1)]
    assert rows["house0"]["model_id"] == "m0"
    assert set(found.tables["models"]["role"].to_pylist()) == {ROLES[Stands.FOR_BUILDING]}
    assert len(found.tables["models"]) == len(walls)
    assert any("1 block is divided rightly" in note for note in found.notes) == (len(walls) > 2)


@pytest.mark.parametrize(
    "walls",
    [
        (0.0, 3.0, 9.0, 15.0, 21.0, 24.0),
        (0.0, 6.0, 9.0, 12.0, 18.0, 24.0),
        (0.0, 6.0, 12.0, 16.5, 24.0),
        (0.0, 8.0, 16.0, 24.0),
        (0.0, 9.0, 24.0),
        (0.0, 2.0, 4.0, 6.0, 12.0, 18.0, 24.0),
    ],
    ids=["half a house off", "one house cut", "one wall off", "thirds", "through a house", "slices"],
)
def test_a_wrong_division_is_judged_as_if_there_were_no_right_ones(walls: tuple[float, ...]) -> None:
    """The row is one block, and each model stands alone, so nothing that is divided wrongly counts for more."""
    models = row(walls)
    assert whole_models(models, TRUTH).models == tuple(models)
    found = judged(models)
    best = max(high - low for low, high in itertools.pairwise(walls)) / 24.0
    assert figure(found, "delivery.lod2") == (1.0 if best >= 0.5 else 0.5)
    assert figure(found, "delivery.split") == 0.5
    assert figure(found, "delivery.part_models") == len(models) - (best >= 0.5)
    assert not any("divided rightly" in note for note in found.notes)


def test_a_wall_may_be_off_until_its_parts_no_longer_agree_with_their_houses() -> None:
    least = 6.0 * MIN_PART_IOU  # width of a part of one house, when the wall moves into it
    for width, right in ((least + 0.01, True), (least - 0.01, False)):
        models = row((0.0, width, 24.0))
        assert (len(whole_models(models, TRUTH).models) == 1) is right


def test_the_weakest_part_says_what_was_delivered() -> None:
    models = row(WALLS)
    models[2] = dataclasses.replace(models[2], status=Status.FALLBACK, lod="1.2")
    found = judged(models)
    assert (figure(found, "delivery.lod2"), figure(found, "delivery.block")) == (0.5, 0.5)
    status = {one["model_id"]: one["status"] for one in found.tables["models"].to_pylist()}
    assert status == {"alone": "ok", "m0": "ok", "m1": "ok", "m2": "fallback", "m3": "ok"}


def test_a_house_without_a_model_costs_its_area_as_for_an_undivided_row() -> None:
    divided, whole = judged(row(WALLS)[1:]), judged(row((6.0, 24.0)))
    for name in ("delivery.lod2", "footprints.iou_mean", "footprints.area_bias_median", "surface.coverage"):
        assert figure(divided, name) == pytest.approx(figure(whole, name))
    assert figure(divided, "delivery.lod2") == 1.0
    few = judged(row(WALLS)[:1])
    assert figure(few, "delivery.nothing") == 0.5


def test_two_models_of_one_house_are_no_division() -> None:
    models = [*row(WALLS), dataclasses.replace(row(WALLS)[1], building_id="again")]
    assert whole_models(models, TRUTH).divided == 0


def test_the_order_of_models_and_houses_changes_nothing() -> None:
    models, houses = row(WALLS), list(TRUTH.buildings)
    wholes = whole_models(models, TRUTH)
    for seed in range(3):
        random = np.random.default_rng(seed)
        shuffled = [models[k] for k in random.permutation(len(models))]
        other = whole_models(shuffled, reference([houses[k] for k in random.permutation(len(houses))]))
        assert [set(names) for names in other.names] == [set(names) for names in wholes.names]
        assert shapely.equals(other.models[0].footprint, wholes.models[0].footprint)


def test_houses_are_judged_one_by_one_without_blocks() -> None:
    found = evaluate(model_set(row((0.0, 12.0, 24.0))), reference(HOUSES), blocks=False)
    assert figure(found, "delivery.joined") == 1.0
    assert found.notes == ()


def test_nothing_at_all_can_be_whole() -> None:
    assert whole_models([], TRUTH).models == ()
    models = row(WALLS)
    assert whole_models(models, reference([])).models == tuple(models)
    nowhere = [dataclasses.replace(one, footprint=shapely.Polygon()) for one in models]
    assert whole_models(nowhere, TRUTH).divided == 0
