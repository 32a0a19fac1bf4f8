"""Vertical differences over the true roofs: integrals, known damage, and a naive lattice."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import roofs_by_hand as by_hand
import shapely
from roofs_by_hand import flat, gable, hip, lifted, moved, reference, shrunk, with_face

from pipeline.ruler.evaluation import residual_scores as residuals
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import subsets
from pipeline.ruler.evaluation.surface import EDGES_M, measures, score_surface
from pipeline.ruler.simulation.suburb import suburb

TRUTH = [gable("a"), hip("b", 20.0), flat("c", 40.0)]


def rows_of(models: list[RoofModel], truth: Reference, **more: float) -> list[SimpleNamespace]:
    score = score_surface(models, truth, **more)
    assert score is not None
    return by_hand.tally_rows(score.tallies, median_m=score.median_m)


def figures_of(models: list[RoofModel], truth: Reference, subset: int = 0) -> dict[str, float]:
    return by_hand.values(measures(score_surface(models, truth), subsets(truth)[subset]))


@pytest.mark.parametrize(("lift", "within"), [(0.2, 1.0), (0.21, 0.0), (-0.3, 0.0)])
def test_a_lifted_roof_is_off_by_the_lift(lift: float, within: float) -> None:
    figures = figures_of([gable("m", lift=lift)], reference(TRUTH[:1]))
    assert [figures[name] for name in ("rmse", "median")] == pytest.approx([abs(lift)] * 2, abs=0.0055)
    assert figures["bias"] == pytest.approx(lift)
    assert (figures["within_0_2m"], figures["coverage"]) == (within, 1.0)
    (row,) = rows_of([gable("m", lift=lift)], reference(TRUTH[:1]))
    assert (row.bias_m, row.rmse_m, row.median_m) == pytest.approx((lift, abs(lift), abs(lift)))


def test_a_flatter_roof_is_off_by_the_integral_over_it() -> None:
    (row,) = rows_of([gable("m", slope=0.6)], reference(TRUTH[:1]), sample_m=0.05)
    assert row.rmse_m == pytest.approx(0.1 * 4.0 / math.sqrt(3), rel=0.01)
    assert row.bias_m == pytest.approx(-0.2, rel=0.01)
    assert row.median_m == pytest.approx(0.2, rel=0.02)
    assert row.share_within == pytest.approx(0.5, abs=0.02)


def test_shrunk_footprints_cover_less_and_cannot_buy_a_better_score() -> None:
    (row,) = rows_of([shrunk(gable("m"), 0.5)], reference(TRUTH[:1]))
    share = 11.0 * 7.0 / 96.0
    assert row.coverage == row.share_within == pytest.approx(share, abs=0.01)
    assert row.rmse_m == pytest.approx(0.0, abs=1e-9)


def test_a_removed_face_and_a_dropped_building_are_misses() -> None:
    figures = figures_of([with_face(TRUTH[0], 0, None), TRUTH[1]], reference(TRUTH))
    whole = 96 + 112 + 80
    assert figures["coverage"] == figures["within_0_2m"] == pytest.approx((48 + 112) / whole, abs=0.001)
    assert figures["within_0_2m_mean"] == pytest.approx((0.5 + 1.0 + 0.0) / 3)
    assert figures["rmse"] == pytest.approx(0.0, abs=1e-9)
    row = rows_of([TRUTH[0]], reference(TRUTH))[1]
    assert (row.coverage, row.share_within, row.n_covered) == (0.0, 0.0, 0)
    assert math.isnan(row.rmse_m)
    assert math.isnan(row.bias_m)
    assert math.isnan(row.median_m)


def test_all_models_together_are_compared_and_the_upper_face_is_the_roof() -> None:
    faces = TRUTH[1].surfaces
    split = [dataclasses.replace(TRUTH[1], surfaces=(face,)) for face in faces]
    assert figures_of(split, reference(TRUTH[1:2])) == figures_of([TRUTH[1]], reference(TRUTH[1:2]))
    above = dataclasses.replace(TRUTH[1], surfaces=(lifted(faces[0], 2.0),))
    (row,) = rows_of([TRUTH[1], above], reference(TRUTH[1:2]))
    assert row.bias_m == pytest.approx(2.0 * 40 / 112, abs=0.02)
    assert row.median_m == pytest.approx(0.0, abs=1e-6)


def test_a_naive_lattice_gives_the_same_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(residuals, "ROUNDING_M", 0.0)  # no millimetre more at the eaves
    truth = by_hand.models_of_scene(suburb(21, size_m=(90.0, 90.0)))
    random = np.random.default_rng(2)
    models = [shrunk(moved(one, *random.normal(0.0, 0.3, 3)), random.uniform(0.0, 0.4)) for one in truth[:-1]]
    rows = rows_of(models, reference(truth))
    for one, row in zip(truth, rows, strict=True):
        low_x, low_y, high_x, high_y = one.footprint.bounds
        differences = []
        places = 0
        for i in range(math.floor(low_x / 0.25) - 1, math.ceil(high_x / 0.25) + 1):
            for j in range(math.floor(low_y / 0.25) - 1, math.ceil(high_y / 0.25) + 1):
                x, y = (i + 0.5) * 0.25, (j + 0.5) * 0.25
                if not shapely.intersects_xy(one.footprint, x, y):
                    continue
                places += 1
                at = np.array([x]), np.array([y])
                tops = [other.top(*at)[0] for other in models if shapely.intersects_xy(other.footprint, x, y)]
                tops = [top for top in tops if not math.isnan(top)]
                if tops:
                    differences.append(max(tops) - float(one.top(*at)[0]))
        assert row.n_points == places
        assert row.n_covered == len(differences)
        if differences:
            assert row.rmse_m == pytest.approx(math.sqrt(np.mean(np.square(differences))))
            assert row.bias_m == pytest.approx(np.mean(differences))
            assert row.median_m == pytest.approx(np.median(np.abs(differences)))
            assert row.n_within == sum(abs(one) <= 0.2 for one in differences)


def test_pooled_quantiles_follow_the_places_within_a_bin() -> None:
    truth = by_hand.models_of_scene(suburb(22, size_m=(120.0, 120.0)))
    random = np.random.default_rng(6)
    models = [moved(one, 0.0, 0.0, random.normal(0.0, 0.4)) for one in truth]
    figures = figures_of(models, reference(truth))
    rows = rows_of(models, reference(truth))
    pooled = np.concatenate([np.full(int(row.n_points), row.median_m) for row in rows])
    assert figures["median"] == pytest.approx(np.median(pooled), abs=0.006)
    assert figures["p95"] == pytest.approx(np.quantile(pooled, 0.95), abs=0.006)
    assert all(row.histogram.sum() == row.n_covered for row in rows)
    assert np.all(np.diff(EDGES_M) > 0.0)


def test_a_building_is_measured_by_its_own_roof_though_others_stand_within_its_bounds() -> None:
    row = [moved(gable(str(x), x), 0.0, 0.0, 0.0, 45.0) for x in (0.0, 12.0, 24.0)]
    rows = rows_of([row[0], moved(row[1], 0.0, 0.0, 1.0)], reference(row))
    assert [one.n_points * 0.0625 for one in rows] == pytest.approx([96.0] * 3, rel=0.01)
    assert [one.share_within for one in rows] == pytest.approx([1.0, 0.0, 0.0], abs=0.002)


def test_the_data_edge_and_subsets_choose_the_buildings() -> None:
    known = {"a": by_hand.conditions(good=True), "b": by_hand.conditions(good=False)}
    truth = reference([*TRUTH, flat("cut", 60.0, touches_data_edge=True)], conditions=known)
    models = [TRUTH[0], moved(TRUTH[1], 0.0, 0.0, 1.0), TRUTH[2]]
    assert [figures_of(models, truth, k)["bias"] for k in range(3)] == pytest.approx([112 / 288, 0.0, 1.0], abs=0.002)
    assert figures_of(models, truth)["coverage"] == 1.0


def test_without_true_faces_or_models_there_is_no_difference() -> None:
    without = reference(TRUTH, has_faces=False)
    assert score_surface(TRUTH, without) is None
    assert measures(None, subsets(without)[0]) == []
    figures = figures_of([], reference(TRUTH))
    assert figures["coverage"] == figures["within_0_2m"] == 0.0
    assert math.isnan(figures["rmse"])
    assert math.isnan(figures["median"])
