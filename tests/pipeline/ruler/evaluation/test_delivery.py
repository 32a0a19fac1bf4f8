"""Delivery: what buildings got, which models stand where no building is, which split or join."""

import dataclasses
import math

import pytest
import roofs_by_hand as by_hand
from roofs_by_hand import flat, gable, hip, reference

from pipeline.model import Status
from pipeline.ruler.evaluation.building_matching import match_footprints
from pipeline.ruler.evaluation.delivery import Delivered, Stands, measures, record_measures, score_delivery
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import subsets

TRUTH = [gable("a"), hip("b", 20.0), flat("c", 40.0), gable("d", 60.0)]


def stands(models: list[RoofModel], truth: Reference) -> list[Stands]:
    return score_delivery(models, truth, match_footprints(models, truth)).models["stands"].tolist()


def figures_of(models: list[RoofModel], truth: Reference, subset: int = 0) -> dict[str, float]:
    delivery = score_delivery(models, truth, match_footprints(models, truth))
    return by_hand.values(measures(delivery, subsets(truth)[subset]))


def test_blocks_and_gaps_are_distinguished() -> None:
    models = [
        TRUTH[0],
        dataclasses.replace(TRUTH[1], status=Status.FALLBACK, lod="1.2"),
        dataclasses.replace(TRUTH[2], lod="1.3"),
    ]
    truth = reference(TRUTH)
    delivery = score_delivery(models, truth, match_footprints(models, truth))
    assert delivery.buildings["delivered"].tolist() == [
        Delivered.LOD2,
        Delivered.BLOCK,
        Delivered.BLOCK,
        Delivered.NOTHING,
    ]
    figures = figures_of(models, truth)
    assert (figures["lod2"], figures["block"], figures["nothing"]) == (0.25, 0.5, 0.25)


def test_a_model_where_no_building_is_is_false_where_the_reference_is_complete() -> None:
    tree, corner = flat("tree", 200.0), flat("corner", 66.1, width=12.0)  # 5.9 of its 12 m are on a building
    truth = reference(TRUTH)
    assert stands([*TRUTH, tree, corner], truth)[4:] == [Stands.FALSE, Stands.FALSE]
    figures = figures_of([*TRUTH, tree, corner], truth)
    assert (figures["false_models"], figures["correctness"]) == (2, pytest.approx(4 / 6))
    assert figures["lod2"] == 1.0
    assert stands([*TRUTH, tree], reference(TRUTH, extent=None))[4] == Stands.LEFT_OUT
    assert figures_of([*TRUTH, tree], reference(TRUTH, extent=None))["correctness"] == 1.0
    at_edge = flat("at the edge", -99.0, touches_data_edge=True)  # the extent begins at -100
    assert stands([at_edge, *TRUTH], truth)[0] == Stands.LEFT_OUT


def test_no_model_is_excused_by_what_it_says_of_itself() -> None:
    truth = reference(TRUTH)
    tree = flat("tree", 200.0, touches_data_edge=True)
    half = flat("half", 0.0, width=5.0, depth=4.0, touches_data_edge=True)
    assert stands([tree, half], truth) == [Stands.FALSE, Stands.PART]
    unclaimed = flat("at the edge", -99.0)
    assert stands([unclaimed], truth) == [Stands.FALSE]


def test_one_model_over_everything_is_false_and_joins_all_buildings() -> None:
    truth = reference(TRUTH)
    for name, grown in (("inside", -1.0), ("beyond", 2_000.0)):
        footprint = by_hand.EXTENT.buffer(grown)
        giant = dataclasses.replace(flat(name), footprint=footprint)
        assert stands([giant], truth) == [Stands.FALSE]
        figures = figures_of([giant], truth)
        assert (figures["correctness"], figures["false_models"], figures["joined"]) == (0.0, 1, 1.0)
        assert stands([giant], reference(TRUTH, extent=None)) == [Stands.LEFT_OUT]


def test_a_building_in_parts_of_which_none_stands_for_it_is_split() -> None:
    thirds = [flat(str(x), 40.0 + 10.0 * x / 3.0, width=10.0 / 3.0) for x in range(3)]
    figures = figures_of(thirds, reference([flat("c", 40.0)]))
    assert (figures["split"], figures["nothing"], figures["part_models"]) == (1.0, 1.0, 3)


def test_parts_of_a_building_are_no_false_models() -> None:
    truth = reference(TRUTH)
    halves = [dataclasses.replace(TRUTH[0], surfaces=(face,), footprint=face.polygon) for face in TRUTH[0].surfaces]
    assert stands([*halves, *TRUTH[1:]], truth)[:2] == [Stands.FOR_BUILDING, Stands.PART]
    figures = figures_of([*halves, *TRUTH[1:]], truth)
    assert (figures["split"], figures["part_models"], figures["false_models"]) == (0.25, 1, 0)
    assert (figures["lod2"], figures["correctness"]) == (1.0, 1.0)


def test_a_model_over_several_buildings_joins_them() -> None:
    true = [flat(str(x), x) for x in (0.0, 10.0, 20.0)]
    truth = reference([*true, flat("alone", 50.0)])
    row = flat("row", width=30.0)
    delivery = score_delivery([row], truth, match_footprints([row], truth))
    assert delivery.models["stands"].tolist() == [Stands.JOINS]
    assert delivery.models["covers"].tolist() == [3]
    assert delivery.buildings["joined"].tolist() == [True, True, True, False]
    figures = figures_of([row], truth)
    assert (figures["joined"], figures["joining_models"], figures["nothing"]) == (0.75, 1, 1.0)
    pair = flat("pair", 4.0, width=15.9)  # half of the first and nearly all of the second
    figures = figures_of([pair], truth)
    assert (figures["joined"], figures["lod2"], figures["joining_models"]) == (0.5, 0.25, 1)


def test_a_row_of_parts_and_a_joining_model_in_random_order_count_the_same() -> None:
    truth = reference(TRUTH)
    models = [flat("x", 200.0), *TRUTH[1:], gable("y", 3.0)]
    assert figures_of(models, truth) == figures_of(models[::-1], truth)


def test_what_the_data_edge_cuts_does_not_count() -> None:
    cut = gable("cut", 80.0, touches_data_edge=True)
    truth = reference([*TRUTH, cut])
    assert figures_of(TRUTH, truth)["lod2"] == 1.0
    part = flat("part", 80.0, width=3.0)
    assert stands([*TRUTH, part], truth)[4] == Stands.LEFT_OUT
    assert stands([*TRUTH, cut], truth)[4] == Stands.FOR_BUILDING
    assert figures_of([*TRUTH, cut], truth) == figures_of(TRUTH, truth)


def test_false_models_are_in_no_subset_but_all() -> None:
    known = {one.building_id: by_hand.conditions(good=one.building_id != "d") for one in TRUTH}
    truth = reference(TRUTH, conditions=known)
    models = [*TRUTH[:3], flat("tree", 200.0), flat("corner", 66.1, width=12.0)]
    everything, good, hard = (figures_of(models, truth, subset) for subset in range(3))
    assert [one["false_models"] for one in (everything, good, hard)] == [2, 0, 0]
    assert [one["lod2"] for one in (everything, good, hard)] == [0.75, 1.0, 0.0]
    assert math.isnan(hard["correctness"])


def test_records_are_counted_without_any_reference() -> None:
    models = [TRUTH[0], TRUTH[1], dataclasses.replace(TRUTH[2], status=Status.FALLBACK)]
    made = ModelSet(name="m", kind="run", path=".", models=tuple(models), failed=(TRUTH[3],))
    figures = {one.name: one for one in record_measures(made)}
    assert {name: one.value for name, one in figures.items()} == {
        "delivery.records_ok": 0.5,
        "delivery.records_doubtful": 0.0,
        "delivery.records_fallback": 0.25,
        "delivery.records_failed": 0.25,
    }
    assert {one.n for one in figures.values()} == {4}
    nothing = record_measures(ModelSet(name="m", kind="run", path=".", models=()))
    assert all(math.isnan(one.value) and one.n == 0 for one in nothing)
