"""Footprints: known damage moves overlap and area by what geometry says."""

import dataclasses
import math

import numpy as np
import pytest
import roofs_by_hand as by_hand
import shapely
from roofs_by_hand import flat, gable, hip, reference, shrunk

from pipeline.ruler.evaluation.building_matching import match_footprints
from pipeline.ruler.evaluation.footprints import measures, score_footprints
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import Columns, subsets

TRUTH = [gable("a"), hip("b", 20.0), flat("c", 40.0)]


def scored(models: list[RoofModel], truth: Reference) -> Columns:
    return score_footprints(models, truth, match_footprints(models, truth))


def figures_of(models: list[RoofModel], truth: Reference) -> dict[str, float]:
    return by_hand.values(measures(scored(models, truth), subsets(truth)[0]))


@pytest.mark.parametrize("metres", [0.5, 0.2, -0.3])
def test_a_shrunk_footprint_loses_what_geometry_says(metres: float) -> None:
    models = [shrunk(one, metres) for one in TRUTH]
    rows = scored(models, reference(TRUTH))
    for row, (a, b) in zip(by_hand.rows(rows), ((12, 8), (14, 8), (10, 8)), strict=True):
        ratio = (a - 2 * metres) * (b - 2 * metres) / (a * b)
        assert (row.iou, row.iou_together) == pytest.approx([min(ratio, 1 / ratio)] * 2)
        assert row.area_bias == pytest.approx(ratio - 1)
        assert row.outline_offset_m == pytest.approx(-metres)
    figures = figures_of(models, reference(TRUTH))
    assert figures["offset_median"] == pytest.approx(-metres)
    assert figures["iou_mean"] == pytest.approx(rows["iou"].mean())
    assert figures["iou_median"] == pytest.approx(np.median(rows["iou"]))


def test_the_offset_is_exact_for_outlines_with_corners_that_turn_in_and_with_courts() -> None:
    outline = shapely.Polygon([(0, 0), (20, 0), (20, 8), (9, 8), (9, 15), (0, 15)], [[(2, 2), (2, 5), (6, 5), (6, 2)]])
    true = [dataclasses.replace(TRUTH[0], footprint=outline)]
    for metres in (-0.4, 0.7):
        made = [dataclasses.replace(TRUTH[0], footprint=outline.buffer(metres, join_style="mitre"))]
        assert scored(made, reference(true))["outline_offset_m"][0] == pytest.approx(metres)


def test_shares_change_at_their_limits() -> None:
    true = [flat("t", width=10.0, depth=10.0)]
    for width, reached in ((4.9, 0), (5.0, 1), (7.9, 1), (8.0, 2), (8.9, 2), (9.0, 3)):
        figures = figures_of([flat("m", width=width, depth=10.0)], reference(true))
        assert [figures[f"iou_from_{limit}"] for limit in (50, 80, 90)] == [1.0] * reached + [0.0] * (3 - reached)


def test_parts_of_a_split_building_are_put_together_but_neighbours_are_not() -> None:
    true = [flat("t", width=12.0), flat("u", 12.0, width=12.0)]
    thirds = [flat(str(x), x, width=4.0) for x in (0.0, 4.0, 8.0)]
    neighbour = flat("n", 11.9, width=12.1)  # its edge leans over
    first, second = by_hand.rows(scored([*thirds, neighbour], reference(true)))
    assert (first.iou, first.models_over) == (0.0, 3)
    assert first.iou_together == pytest.approx(1.0)
    assert (second.models_over, second.iou_together) == (1, pytest.approx(12 / 12.1))
    joined = scored([flat("both", width=24.0)], reference(true))
    assert joined["iou_together"].tolist() == pytest.approx([0.5, 0.5])


def test_the_data_edge_and_subsets_choose_the_buildings() -> None:
    known = {"a": by_hand.conditions(good=True), "b": by_hand.conditions(good=False)}
    truth = reference([*TRUTH, flat("cut", 60.0, touches_data_edge=True)], conditions=known)
    rows = scored([TRUTH[0], shrunk(TRUTH[1], 0.5), TRUTH[2]], truth)
    everything, good, hard = ({one.name: one for one in measures(rows, subset)} for subset in subsets(truth))
    assert [one["footprints.iou_mean"].n for one in (everything, good, hard)] == [3, 1, 1]
    assert good["footprints.iou_mean"].value == 1.0
    assert hard["footprints.iou_mean"].value == pytest.approx(13 * 7 / 112)


def test_intervals_hold_the_median_and_narrow_with_the_number_of_buildings() -> None:
    random = np.random.default_rng(9)
    widths = []
    for count in (20, 200):
        true = [flat(str(k), 20.0 * k) for k in range(count)]
        models = [shrunk(one, random.uniform(0.0, 0.6)) for one in true]
        rows = scored(models, reference(true))
        (median,) = [one for one in measures(rows, subsets(reference(true))[0]) if one.name == "footprints.iou_median"]
        assert median.low <= median.value == np.median(rows["iou"]) <= median.high
        widths.append(median.high - median.low)
    assert 0.0 < widths[1] < 0.6 * widths[0]


def test_nothing_against_nothing_is_undefined() -> None:
    truth = reference([])
    assert len(scored([], truth)["iou"]) == 0
    assert all(math.isnan(one.value) and one.n == 0 for one in measures(scored([], truth), subsets(truth)[0]))
