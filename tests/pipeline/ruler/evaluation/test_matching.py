"""Footprints match best first, one to one, as naive loops find it."""

import dataclasses

import numpy as np
import pytest
import roofs_by_hand as by_hand
import shapely
from roofs_by_hand import gable, reference

from pipeline.model import RoofType
from pipeline.ruler.evaluation.building_matching import match_footprints, one_to_one, sound_polygons
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.subsets import subsets, summed_over_units


def outlined(name: str, footprint: shapely.Geometry) -> RoofModel:
    return RoofModel(building_id=name, footprint=footprint, roof_type=RoofType.UNKNOWN, surfaces=())


def outlines(footprints: list[shapely.Geometry]) -> list[RoofModel]:
    return [outlined(str(number), one) for number, one in enumerate(footprints)]


def test_each_model_stands_for_one_building_and_the_best_overlap_wins() -> None:
    true = [shapely.box(0, 0, 10, 10), shapely.box(30, 0, 40, 10)]
    models = [shapely.box(0, 0, 10, 7), shapely.box(0, 1, 10, 10), shapely.box(33, 0, 43, 10)]
    matching = match_footprints(outlines(models), reference(outlines(true)))
    assert matching.model_of.tolist() == [1, 2]
    assert matching.reference_of.tolist() == [-1, 0, 1]
    assert matching.iou.tolist() == pytest.approx([0.9, 7 / 13])
    assert (matching.overlaps.first.tolist(), matching.overlaps.second.tolist()) == ([0, 0, 1], [0, 1, 2])


def test_an_overlap_of_exactly_one_half_is_found_and_less_is_not() -> None:
    true = [shapely.box(500_000, 5_800_000, 500_010, 5_800_010)]
    half = shapely.box(500_000, 5_800_000, 500_010, 5_800_005)
    less = shapely.box(500_000, 5_800_000, 500_010, 5_800_004.99)
    assert match_footprints(outlines([half]), reference(outlines(true))).model_of.tolist() == [0]
    assert match_footprints(outlines([less]), reference(outlines(true))).model_of.tolist() == [-1]


def test_nothing_matches_nothing() -> None:
    some = outlines([shapely.box(0, 0, 1, 1)])
    assert match_footprints([], reference(some)).model_of.tolist() == [-1]
    matching = match_footprints(some, reference([], extent=None))
    assert matching.reference_of.tolist() == [-1]
    assert matching.share_in_extent.tolist() == [0.0]
    empty = match_footprints(outlines([shapely.Polygon()]), reference(some))
    assert empty.share_on_reference.tolist() == [0.0]


def test_shares_count_overlapping_reference_buildings_once() -> None:
    true = [shapely.box(0, 0, 6, 10), shapely.box(4, 0, 8, 10)]
    models = [shapely.box(0, 0, 10, 10), shapely.box(9, 0, 12, 10), shapely.box(7, 0, 9, 10)]
    matching = match_footprints(outlines(models), reference(outlines(true), extent=shapely.box(0, 0, 11, 10)))
    assert matching.share_on_reference.tolist() == pytest.approx([0.8, 0.0, 0.5])
    assert matching.share_in_extent.tolist() == pytest.approx([1.0, 2 / 3, 1.0])
    assert matching.mostly_on.tolist() == [0, -1, 1]


def test_outlines_that_cross_themselves_count_by_what_they_enclose() -> None:
    bow_tie = shapely.Polygon([(0, 0), (4, 4), (4, 0), (0, 4)])
    (sound,) = sound_polygons([bow_tie])
    assert sound.is_valid
    assert sound.area == pytest.approx(8.0)
    matching = match_footprints(outlines([bow_tie]), reference(outlines([shapely.box(0, 0, 4, 4)])))
    assert matching.iou.tolist() == pytest.approx([0.5])


@pytest.mark.parametrize("seed", range(5))
def test_random_footprints_match_as_in_naive_loops(seed: int) -> None:
    random = np.random.default_rng(seed)

    def boxes(count: int) -> list[shapely.Geometry]:
        corner, size = random.uniform(0, 40, (count, 2)), random.uniform(4, 12, (count, 2))
        return list(shapely.box(*corner.T, *(corner + size).T))

    true, models = boxes(40), boxes(40)
    matching = match_footprints(outlines(models), reference(outlines(true)))
    pairs = []
    for t, one in enumerate(true):
        for m, other in enumerate(models):
            iou = one.intersection(other).area / one.union(other).area
            if iou >= 0.5:
                pairs.append((-iou, t, m))
    expected = [-1] * 40
    for _, t, m in sorted(pairs):
        if expected[t] < 0 and m not in expected:
            expected[t] = m
    assert matching.model_of.tolist() == expected
    assert max(expected) >= 0
    for m, other in enumerate(models):
        share = other.intersection(shapely.union_all(true)).area / other.area
        assert matching.share_on_reference[m] == pytest.approx(share)
    for t, one in enumerate(true):
        over = [m for m, other in enumerate(models) if one.intersection(other).area > 1e-6]
        assert matching.overlaps.second[matching.overlaps.first == t].tolist() == over


def test_one_to_one_takes_the_largest_and_then_the_smaller_index() -> None:
    first, second, weight = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.array([5.0, 7.0, 6.0, 7.0])
    assert one_to_one(first, second, weight).tolist() == [False, True, True, False]


def test_subsets_leave_out_what_the_data_edge_cuts() -> None:
    buildings = [gable("a"), gable("b", 20.0), gable("c", 40.0), gable("cut", 60.0, touches_data_edge=True)]
    known = {name: by_hand.conditions(good=name != "b") for name in ("a", "b", "cut")}
    everything, good, hard = subsets(reference(buildings, conditions=known))
    assert [one.name for one in (everything, good, hard)] == ["all", "good", "hard"]
    assert [one.buildings.tolist() for one in (everything, good, hard)] == [
        [True, True, True, False],
        [True, False, False, False],
        [False, True, False, False],
    ]
    assert [one.name for one in subsets(reference(buildings))] == ["all"]
    assert everything.holds(np.array([-1, 0, 3])).tolist() == [True, True, False]
    assert good.holds(np.array([-1, 0, 1])).tolist() == [False, True, False]


def test_what_stands_on_no_building_is_summed_by_model() -> None:
    buildings = [gable("a"), gable("b", 20.0), gable("cut", 40.0, touches_data_edge=True)]
    (everything,) = subsets(reference(buildings))
    sums = summed_over_units(
        everything,
        np.array([1, 1, 2, -1, -1, -1]),
        np.array([0, 0, 0, 7, 9, 7]),
        {"count": np.ones(6), "value": np.arange(6.0)},
    )
    assert sums["count"].tolist() == [0.0, 2.0, 2.0, 1.0]
    assert sums["value"].tolist() == [0.0, 1.0, 8.0, 4.0]


def test_the_order_of_models_does_not_matter() -> None:
    true = [gable("a"), gable("b", 20.0)]
    models = [by_hand.shrunk(gable("m"), 0.2), by_hand.shrunk(gable("n", 20.0), 0.4), gable("o", 20.5)]
    one = match_footprints(models, reference(true))
    other = match_footprints(models[::-1], reference(true))
    assert one.iou.tolist() == other.iou.tolist()
    assert [2 - k for k in other.model_of.tolist()] == one.model_of.tolist()
    assert dataclasses.astuple(one)[1].tolist() == dataclasses.astuple(other)[1].tolist()
