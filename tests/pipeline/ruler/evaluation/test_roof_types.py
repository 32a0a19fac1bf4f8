"""Roof types and the paper's outcomes: each damage moves a building into the class that it should."""

import dataclasses
import math

import numpy as np
import pytest
import roofs_by_hand as by_hand
from roofs_by_hand import flat, gable, hip, lifted, reference, turned, with_face

from pipeline.model import RoofType
from pipeline.ruler.evaluation.building_matching import match_footprints
from pipeline.ruler.evaluation.face_scores import score_faces
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.roof_types import (
    Outcome,
    confusion,
    measures,
    outcome,
    outcome_tables,
    score_roof_types,
)
from pipeline.ruler.evaluation.subsets import Columns, subsets

TRUTH = [gable("a"), hip("b", 20.0), flat("c", 40.0), gable("d", 60.0)]


def scored(models: list[RoofModel], truth: Reference) -> Columns:
    return score_roof_types(models, truth, match_footprints(models, truth), score_faces(models, truth))


def outcomes(models: list[RoofModel], **more: object) -> list[Outcome]:
    return scored(models, reference(TRUTH, **more))["outcome"].tolist()


def figures_of(models: list[RoofModel], truth: Reference) -> dict[str, float]:
    return by_hand.values(measures(scored(models, truth), subsets(truth)[0]))


def replaced(place: int, one: RoofModel) -> list[RoofModel]:
    return [*TRUTH[:place], one, *TRUTH[place + 1 :]]


def test_a_lost_face_makes_a_building_passable_and_too_many_make_it_false() -> None:
    b = TRUTH[1]
    assert outcomes(replaced(1, with_face(b, 3, None)))[1] is Outcome.PASSABLE
    assert outcomes(replaced(1, with_face(with_face(b, 3, None), 2, None)))[1] is Outcome.PASSABLE
    assert outcomes(replaced(1, with_face(with_face(with_face(b, 3, None), 2, None), 1, None)))[1] is Outcome.FALSE
    assert outcomes(replaced(0, with_face(TRUTH[0], 0, turned(TRUTH[0].surfaces[0], 11.0))))[0] is Outcome.PASSABLE


def test_a_wrong_face_more_makes_a_building_passable_but_a_small_one_does_not() -> None:
    for size, verdict in ((5.0, Outcome.PASSABLE), (3.0, Outcome.CORRECT)):
        dormer = by_hand.surface(by_hand.rectangle(2, 1, 2 + size, 4), (0.0, 0.0, 9.0), 2)
        more = dataclasses.replace(TRUTH[0], surfaces=(*TRUTH[0].surfaces, dormer))
        assert outcomes(replaced(0, more)) == [verdict, *[Outcome.CORRECT] * 3]
        rows = scored(replaced(0, more), reference(TRUTH))
        assert rows["faces_wrong"].tolist() == [int(size == 5.0), 0, 0, 0]


def test_a_wrong_type_is_passable_and_in_the_confusion() -> None:
    models = replaced(0, dataclasses.replace(TRUTH[0], roof_type=RoofType.HIP))
    truth = reference(TRUTH)
    rows = scored(models, truth)
    assert rows["outcome"].tolist() == [Outcome.PASSABLE, *[Outcome.CORRECT] * 3]
    assert confusion(rows, subsets(truth)[0]) == {
        (RoofType.FLAT, RoofType.FLAT): 1,
        (RoofType.GABLE, RoofType.GABLE): 1,
        (RoofType.GABLE, RoofType.HIP): 1,
        (RoofType.HIP, RoofType.HIP): 1,
    }
    figures = figures_of(models, truth)
    assert figures["accuracy"] == figures["accuracy_found"] == 0.75
    by_chance = (1 * 1 + 2 * 1 + 1 * 2) / 16
    assert figures["kappa"] == pytest.approx((0.75 - by_chance) / (1 - by_chance))


def test_a_dropped_building_is_false_and_of_no_type() -> None:
    truth = reference(TRUTH)
    rows = scored(TRUTH[1:], truth)
    assert rows["outcome"][0] is Outcome.FALSE
    assert confusion(rows, subsets(truth)[0])[RoofType.GABLE, RoofType.NONE] == 1
    figures = figures_of(TRUTH[1:], truth)
    assert (figures["false"], figures["accuracy"], figures["accuracy_found"]) == (0.25, 0.75, 1.0)


def test_a_split_building_keeps_its_faces_but_has_no_type() -> None:
    halves = [dataclasses.replace(TRUTH[0], surfaces=(face,), footprint=face.polygon) for face in TRUTH[0].surfaces]
    (row, *_) = by_hand.rows(scored([*halves, *TRUTH[1:]], reference(TRUTH)))
    assert (row.faces_to_find, row.faces_found, row.faces_wrong) == (2, 2, 0)
    assert row.model == 0  # a half of exactly one half stands for it
    assert row.outcome is Outcome.CORRECT
    less = [dataclasses.replace(one, footprint=one.footprint.buffer(-0.1)) for one in halves]
    (row, *_) = by_hand.rows(scored([*less, *TRUTH[1:]], reference(TRUTH)))
    assert (row.model, row.model_type, row.outcome) == (-1, RoofType.NONE, Outcome.PASSABLE)


def test_the_verdict_by_its_rule_for_all_small_numbers() -> None:
    for wanted in range(6):
        for found in range(wanted + 1):
            for wrong in range(3):
                for right in (True, False):
                    if found == wanted and not wrong and right:
                        expected = Outcome.CORRECT
                    elif wanted and found / wanted >= 0.5:
                        expected = Outcome.PASSABLE
                    else:
                        expected = Outcome.FALSE
                    assert outcome(wanted, found, wrong, type_right=right) is expected


def test_a_building_without_a_face_to_be_found_is_judged_by_its_type() -> None:
    points = {("a", 0): 3, ("a", 1): 3} | {(one.building_id, k): 99 for one in TRUTH[1:] for k in range(4)}
    truth = reference(TRUTH, face_points=points)
    assert scored(TRUTH, truth)["outcome"][0] is Outcome.CORRECT
    assert scored(TRUTH[1:], truth)["outcome"][0] is Outcome.FALSE


def test_the_table_of_the_paper_counts_by_type_and_by_shape() -> None:
    known = {
        "a": by_hand.conditions(good=True, shape="gable"),
        "b": by_hand.conditions(good=True, shape="bent_hip"),
        "c": by_hand.conditions(good=False, shape="flat"),
        "d": by_hand.conditions(good=False, shape="unequal_gable"),
    }
    truth = reference(TRUTH, conditions=known)
    rows = scored([TRUTH[0], with_face(TRUTH[1], 0, lifted(TRUTH[1].surfaces[0], 2.0)), TRUTH[3]], truth)
    (types, shapes), good, _ = (outcome_tables(rows, subset) for subset in subsets(truth))
    assert [tuple(row.values())[1:] for row in types] == [
        ("flat", 0, 0, 1),
        ("pent", 0, 0, 0),
        ("gable", 2, 0, 0),
        ("hip", 0, 1, 0),
        ("combination", 0, 0, 0),
        ("all", 2, 1, 1),
    ]
    assert [tuple(row.values()) for row in shapes] == [
        ("all", "bent_hip", 0, 1, 0),
        ("all", "flat", 0, 0, 1),
        ("all", "gable", 1, 0, 0),
        ("all", "unequal_gable", 1, 0, 0),
    ]
    assert [tuple(row.values()) for kind in good for row in kind if sum(list(row.values())[2:])] == [
        ("good", "gable", 1, 0, 0),
        ("good", "hip", 0, 1, 0),
        ("good", "all", 1, 1, 0),
        ("good", "bent_hip", 0, 1, 0),
        ("good", "gable", 1, 0, 0),
    ]


def test_what_the_data_edge_cuts_does_not_count() -> None:
    truth = reference([*TRUTH, gable("cut", 80.0, touches_data_edge=True)])
    figures = figures_of(TRUTH, truth)
    assert (figures["correct"], figures["accuracy"]) == (1.0, 1.0)
    assert sum(confusion(scored(TRUTH, truth), subsets(truth)[0]).values()) == 4


def test_kappa_is_that_of_a_naive_count() -> None:
    random = np.random.default_rng(3)
    kinds = [RoofType.FLAT, RoofType.GABLE, RoofType.HIP, RoofType.COMBINATION]
    true = [gable(str(k), 20.0 * k) for k in range(25)]
    truth = [dataclasses.replace(one, roof_type=kinds[random.integers(4)]) for one in true]
    said = [one.roof_type if random.random() < 0.5 else kinds[random.integers(4)] for one in truth[:20]]
    models = [dataclasses.replace(one, roof_type=kind) for one, kind in zip(truth, said, strict=False)]
    figures = figures_of(models, reference(truth))
    pairs = [(one.roof_type, models[k].roof_type if k < 20 else RoofType.NONE) for k, one in enumerate(truth)]
    agreed = sum(a == b for a, b in pairs) / 25
    chance = sum(sum(a == kind for a, _ in pairs) * sum(b == kind for _, b in pairs) for kind in RoofType) / 625
    assert figures["kappa"] == pytest.approx((agreed - chance) / (1 - chance))
    assert figures["accuracy"] == agreed


def test_without_true_faces_or_models_little_is_said() -> None:
    without = reference(TRUTH, has_faces=False)
    assert scored(TRUTH, without) == {}
    assert measures({}, subsets(without)[0]) == []
    figures = figures_of([], reference(TRUTH))
    assert (figures["false"], figures["accuracy"], figures["kappa"]) == (1.0, 0.0, 0.0)
    assert math.isnan(figures["accuracy_found"])
