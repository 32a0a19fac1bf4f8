"""Roof faces: known damage costs what it should."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import roofs_by_hand as by_hand
from roofs_by_hand import (
    bent_gable,
    flat,
    gable,
    hip,
    lifted,
    moved,
    rectangle,
    reference,
    rows,
    surface,
    turned,
    with_face,
)

from pipeline.model import RoofType
from pipeline.ruler.evaluation.face_scores import DEFINITIONS, FaceScore, FaceVerdict, measures, score_faces
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.subsets import subsets
from pipeline.ruler.simulation.suburb import suburb

TRUTH = [gable("a"), hip("b", 20.0), flat("c", 40.0)]
SHARES = [one.name for one in DEFINITIONS if one.unit == "share"]


def figures(score: FaceScore, truth: Reference, subset: int = 0) -> dict[str, float]:
    return by_hand.values(measures(score, subsets(truth)[subset]))


def scored(models: list[RoofModel], truth: list[RoofModel], **more: object) -> dict[str, float]:
    known = reference(truth, **more)
    return figures(score_faces(models, known), known)


def found(models: list[RoofModel], truth: list[RoofModel]) -> list[bool]:
    return [row.found for row in rows(score_faces(models, reference(truth)).true)]


def test_a_removed_face_is_missing_and_nothing_is_wrong() -> None:
    facts = scored([TRUTH[0], with_face(TRUTH[1], 0, None), TRUTH[2]], TRUTH)
    assert facts["completeness_10m2"] == facts["completeness_all"] == pytest.approx(6 / 7)
    assert facts["correctness_10m2"] == facts["correctness_all"] == facts["correctness_area"] == 1.0
    assert facts["quality_10m2"] == pytest.approx(6 / 7)
    slanted = math.sqrt(1 + 0.7**2)
    whole = (96 + 112) * slanted + 80
    assert facts["completeness_area"] == facts["quality_area"] == pytest.approx(1 - 40 * slanted / whole)
    assert (facts["topology_1_1"], facts["topology_1_0"]) == (6, 1)


@pytest.mark.parametrize(("lift", "kept"), [(0.2, True), (0.3, True), (-0.3, True), (0.31, False), (-0.31, False)])
def test_a_flat_face_is_found_up_to_a_lift_of_0_3_m(lift: float, kept: bool) -> None:
    one = TRUTH[2]
    (row,) = rows(score_faces([with_face(one, 0, lifted(one.surfaces[0], lift))], reference([one])).true)
    assert bool(row.found) is kept
    assert row.offset_m == pytest.approx(lift)
    assert row.angle_deg == 0.0


def test_a_lift_counts_across_the_plane() -> None:
    one = TRUTH[0]
    limit = 0.3 * math.sqrt(1 + 0.7**2)
    for lift, kept in ((limit - 1e-4, True), (limit + 1e-4, False)):
        (row, _) = rows(score_faces([with_face(one, 0, lifted(one.surfaces[0], lift))], reference([one])).true)
        assert bool(row.found) is kept
        assert row.offset_m == pytest.approx(lift / math.sqrt(1 + 0.7**2))


def test_the_offset_of_a_turned_face_is_across_the_true_plane() -> None:
    one = TRUTH[0]
    face = lifted(turned(one.surfaces[0], 8.0), 0.2)
    (row, _) = rows(score_faces([with_face(one, 0, face)], reference([one])).true)
    assert row.offset_m == pytest.approx(0.2 / math.sqrt(1 + 0.7**2))


@pytest.mark.parametrize("place", [(0, 0), (1, 0), (1, 2), (2, 0)])
@pytest.mark.parametrize(("angle", "kept"), [(5.0, True), (9.99, True), (10.01, False), (11.0, False)])
def test_a_face_is_found_up_to_a_turn_of_10_deg(place: tuple[int, int], angle: float, kept: bool) -> None:
    building, face = place
    one = TRUTH[building]
    row = rows(score_faces([with_face(one, face, turned(one.surfaces[face], angle))], reference([one])).true)[face]
    assert bool(row.found) is kept
    assert row.angle_deg == pytest.approx(angle)
    assert row.offset_m == pytest.approx(0.0, abs=1e-9)


def test_a_lost_face_of_a_model_is_wrong_where_it_should_have_been() -> None:
    one = with_face(TRUTH[1], 2, turned(TRUTH[1].surfaces[2], 11.0))
    score = score_faces([TRUTH[0], one], reference(TRUTH[:2]))
    assert [row.verdict for row in rows(score.made)].count(FaceVerdict.WRONG) == 1
    (wrong,) = [row for row in rows(score.made) if row.verdict == FaceVerdict.WRONG]
    assert (wrong.building, wrong.model_id, wrong.plane_id) == (1, "b", 2)
    facts = figures(score, reference(TRUTH[:2]))
    assert facts["completeness_10m2"] == facts["correctness_10m2"] == pytest.approx(5 / 6)
    assert facts["quality_10m2"] == pytest.approx(5 / 7)
    assert facts["topology_1_1"] == 6  # how faces lie on one another does not ask for their planes


def test_faces_match_one_to_one() -> None:
    true = [flat("t", width=12.0)]
    twice = dataclasses.replace(true[0], surfaces=true[0].surfaces * 2)
    assert scored([twice], true)["correctness_10m2"] == 0.5
    halves = [flat("m", width=6.0), flat("n", 6.0, width=6.0)]
    facts = scored(halves, true)
    assert (facts["completeness_10m2"], facts["correctness_10m2"], facts["topology_1_n"]) == (1.0, 0.5, 1)
    thirds = [flat(str(x), x, width=4.0) for x in (0.0, 4.0, 8.0)]
    facts = scored(thirds, true)
    assert (facts["completeness_10m2"], facts["correctness_10m2"], facts["topology_1_n"]) == (0.0, 0.0, 1)


def test_faces_joined_and_tangled_are_counted() -> None:
    true = [flat(str(x), x, width=6.0) for x in (0.0, 6.0, 12.0)]
    facts = scored([flat("m", width=18.0)], true)
    assert [facts[f"topology_{kind}"] for kind in ("1_1", "1_n", "n_1", "n_m", "1_0", "0_1")] == [0, 0, 1, 0, 0, 0]
    across = [
        dataclasses.replace(flat(str(y)), surfaces=(surface(rectangle(0, y, 18, y + 4), (0.0, 0.0, 6.0)),))
        for y in (0.0, 4.0)
    ]
    facts = scored(across, true)
    assert [facts[f"topology_{kind}"] for kind in ("1_1", "1_n", "n_1", "n_m", "1_0", "0_1")] == [0, 0, 0, 1, 0, 0]
    facts = scored([flat("far", 200.0)], true)
    assert [facts[f"topology_{kind}"] for kind in ("1_1", "1_n", "n_1", "n_m", "1_0", "0_1")] == [0, 0, 0, 0, 3, 1]


def test_a_split_building_costs_no_faces() -> None:
    one = TRUTH[1]
    parts = [dataclasses.replace(one, building_id=str(k), surfaces=(face,)) for k, face in enumerate(one.surfaces)]
    facts = scored(parts, [one])
    assert all(facts[name.split(".")[1]] == 1.0 for name in SHARES)
    row = dataclasses.replace(TRUTH[0], surfaces=tuple(face for true in TRUTH for face in true.surfaces))
    facts = scored([row], TRUTH)  # nor does a model that joins buildings
    assert all(facts[name.split(".")[1]] == 1.0 for name in SHARES)


# ------------------------------------------------------------------------------------------------------- bent faces


def one_sided(true: RoofModel, rise: float, eave: float) -> RoofModel:
    """A bent gable modelled with one face a side."""
    sides = (
        surface(rectangle(0, 0, 12, 6), (0.0, rise, eave), 0),
        surface(rectangle(0, 6, 12, 12), (0.0, -rise, eave + 12 * rise), 1),
    )
    return dataclasses.replace(true, surfaces=sides)


def test_a_bent_face_is_found_as_one_face_and_as_two() -> None:
    true = bent_gable("t")
    known = reference([true])
    chord = (2 * 0.4 + 4 * 0.6) / 6  # from eave to ridge
    for made in (true, one_sided(true, chord, 4.0)):
        facts = scored([made], [true])
        assert all(facts[name.split(".")[1]] == 1.0 for name in SHARES)
        assert (facts["topology_1_1"], facts["topology_1_n"]) == (2, 0)
        found_of = measures(score_faces([made], known), subsets(known)[0])
        assert {one.n for one in found_of if "complete" in one.name} == {2}


@pytest.mark.parametrize(("lower", "upper", "bend"), [(0.30, 0.62, 3.0), (-0.10, 0.70, 2.0)])
def test_a_bent_face_is_found_by_its_mean_plane_where_no_piece_matches_alone(
    lower: float, upper: float, bend: float
) -> None:
    true = bent_gable("t", lower=lower, upper=upper, bend=bend)
    rest = 6.0 - bend
    rise = (bend * lower + rest * upper) / 6
    mean_z = (bend * (4.0 + lower * bend / 2) + rest * (4.0 + lower * bend + upper * rest / 2)) / 6
    made = one_sided(true, rise, mean_z - 3 * rise)
    score = score_faces([made], reference([true]))
    assert all(row.found and row.as_group and row.matched for row in rows(score.true))
    assert [row.angle_deg for row in rows(score.true)] == pytest.approx([0.0] * 4, abs=1e-9)
    assert [row.offset_m for row in rows(score.true)] == pytest.approx([0.0] * 4, abs=1e-9)
    assert [row.overlap_true for row in rows(score.true)] == pytest.approx([1.0] * 4)
    assert [row.verdict for row in rows(score.made)] == [FaceVerdict.RIGHT] * 2
    assert found([with_face(made, 0, lifted(made.surfaces[0], 0.5))], [true]) == [False, False, True, True]


def test_a_model_face_that_matches_another_face_does_not_find_a_group_too() -> None:
    single = flat("single", width=5.0)
    halves = [surface(rectangle(x, 0, x + 2.5, 8), (0.0, 0.0, 6.0), k, 0) for k, x in enumerate((5.0, 7.5))]
    group = by_hand.model("group", RoofType.FLAT, halves)
    assert found([flat("m", width=10.0)], [single, group]) == [True, False, False]
    assert found([flat("m", 3.0, width=7.0)], [single, group]) == [False, True, True]


def test_a_bent_face_needs_half_of_its_area_in_matched_pieces() -> None:
    true = bent_gable("t", bend=2.0)  # lower pieces hold a third
    assert found([with_face(true, 0, None)], [true]) == [True] * 4
    assert found([with_face(true, 1, None)], [true]) == [False, False, True, True]
    score = score_faces([with_face(true, 1, None)], reference([true]))
    assert [row.verdict for row in rows(score.made)] == [FaceVerdict.RIGHT] * 3  # a piece of a lost face is not wrong
    assert [row.matched for row in rows(score.true)] == [True, False, True, True]


def test_area_and_points_of_a_bent_face_are_summed() -> None:
    true = bent_gable("t", bend=0.5)
    points = {("t", 0): 4, ("t", 1): 7, ("t", 2): 4, ("t", 3): 6}
    score = score_faces([true], reference([true], face_points=points))
    assert [row.to_be_found for row in rows(score.true)] == [True, True, False, False]
    assert [row.n_points for row in rows(score.true)] == [4, 7, 4, 6]
    assert rows(score.true)[0].area_m2 < 10.0 < rows(score.true)[0].unit_area_m2
    assert rows(score.true)[0].unit_area_m2 == pytest.approx(rows(score.true)[0].area_m2 + rows(score.true)[1].area_m2)


# ----------------------------------------------------------------------- what need not be found, what is no fault


def test_small_faces_are_neither_right_nor_wrong() -> None:
    true = [flat("large"), flat("small", 20.0, width=3.0, depth=3.0)]
    facts = scored(true, true)
    assert (facts["completeness_10m2"], facts["correctness_10m2"], facts["completeness_all"]) == (1.0, 1.0, 1.0)
    known = reference(true)
    for models, verdicts, complete in (
        (true, [FaceVerdict.RIGHT, FaceVerdict.NEITHER], 1.0),
        ([true[0]], [FaceVerdict.RIGHT], 0.5),
        ([true[0], flat("little", 60.0, width=3.0, depth=3.0)], [FaceVerdict.RIGHT, FaceVerdict.NEITHER], 0.5),
        ([true[0], flat("more", 20.0, width=4.0, depth=3.5)], [FaceVerdict.RIGHT, FaceVerdict.NEITHER], 1.0),
        ([true[0], flat("much", 20.0, width=6.0, depth=6.0)], [FaceVerdict.RIGHT, FaceVerdict.WRONG], 0.5),
    ):
        score = score_faces(models, known)
        assert [row.verdict for row in rows(score.made)] == verdicts
        facts = {one.name: one for one in measures(score, subsets(known)[0])}
        assert facts["faces.completeness_10m2"].value == 1.0
        assert facts["faces.completeness_10m2"].n == 1
        assert facts["faces.completeness_all"].value == complete
        assert facts["faces.correctness_10m2"].value == (0.5 if FaceVerdict.WRONG in verdicts else 1.0)


def test_faces_with_too_few_points_need_not_be_found() -> None:
    points = {("a", 0): 11, ("a", 1): 10, ("c", 0): 500}
    known = reference(TRUTH, face_points=points)
    score = score_faces(TRUTH, known)
    assert [row.to_be_found for row in rows(score.true)] == [True, False, *[False] * 4, True]
    facts = {one.name: one for one in measures(score, subsets(known)[0])}
    assert (facts["faces.completeness_10m2"].value, facts["faces.completeness_10m2"].n) == (1.0, 2)
    assert (facts["faces.correctness_10m2"].value, facts["faces.correctness_10m2"].n) == (1.0, 2)
    assert facts["faces.completeness_all"].n == 7


def test_what_the_data_edge_cuts_is_neither_found_nor_wrong() -> None:
    cut = flat("cut", 20.0, touches_data_edge=True)
    known = reference([TRUTH[0], cut])
    beyond, other = flat("beyond", -99.0, touches_data_edge=True), with_face(cut, 0, lifted(cut.surfaces[0], 2.0))
    for models in (
        [TRUTH[0]],
        [TRUTH[0], beyond],
        [TRUTH[0], cut],
        [TRUTH[0], dataclasses.replace(other, touches_data_edge=False)],
    ):
        score = score_faces(models, known)
        assert [row.verdict for row in rows(score.made)[2:]] == [FaceVerdict.LEFT_OUT] * (len(models) - 1)
        facts = {one.name: one for one in measures(score, subsets(known)[0])}
        assert [facts[name].value for name in SHARES] == [1.0] * len(SHARES)
        assert facts["faces.completeness_all"].n == facts["faces.topology_1_1"].value == 2
    uncut = reference([TRUTH[0], dataclasses.replace(cut, touches_data_edge=False)])
    assert figures(score_faces([TRUTH[0], cut], uncut), uncut)["completeness_10m2"] == 1.0  # a cut model may find


def test_faces_of_models_that_call_themselves_cut_are_wrong_all_the_same() -> None:
    known = reference(TRUTH)
    lifted_all = [dataclasses.replace(one, surfaces=tuple(lifted(face, 2.0) for face in one.surfaces)) for one in TRUTH]
    tree = flat("tree", 200.0)
    plain = score_faces([*lifted_all, tree], known)
    claimed = score_faces([dataclasses.replace(one, touches_data_edge=True) for one in (*lifted_all, tree)], known)
    assert [row.verdict for row in rows(claimed.made)] == [row.verdict for row in rows(plain.made)]
    assert figures(claimed, known)["correctness_10m2"] == 0.0


def test_a_face_over_everything_is_wrong_however_far_it_goes_beyond_the_extent() -> None:
    known = reference(TRUTH)
    wide = dataclasses.replace(flat("lid").surfaces[0], polygon=by_hand.EXTENT.buffer(2_000.0))
    score = score_faces([*TRUTH, with_face(flat("lid"), 0, wide)], known)
    assert rows(score.made)[-1].verdict == FaceVerdict.WRONG


def test_a_face_elsewhere_is_wrong_only_where_the_reference_is_complete() -> None:
    far = flat("far", 200.0)
    for extent, verdict in ((by_hand.EXTENT, FaceVerdict.WRONG), (None, FaceVerdict.LEFT_OUT)):
        known = reference(TRUTH, extent=extent)
        score = score_faces([*TRUTH, far], known)
        assert rows(score.made)[-1].verdict == verdict
        assert rows(score.made)[-1].building == -1
        facts = figures(score, known)
        assert facts["correctness_10m2"] == pytest.approx(7 / 8 if extent else 1.0)
        assert facts["completeness_10m2"] == 1.0
    high = with_face(TRUTH[2], 0, lifted(TRUTH[2].surfaces[0], 3.0))
    assert rows(score_faces([high], reference(TRUTH, extent=None)).made)[0].verdict == FaceVerdict.WRONG


def test_good_and_hard_buildings_are_separate() -> None:
    truth = reference(TRUTH, conditions={name: by_hand.conditions(good=name != "b") for name in "abc"})
    raised = with_face(TRUTH[1], 1, lifted(TRUTH[1].surfaces[1], 1.0))
    score = score_faces([TRUTH[0], raised, flat("far", 200.0)], truth)
    by_subset = [figures(score, truth, number) for number in range(3)]
    for name, wanted in {
        "completeness_10m2": (5 / 7, 2 / 3, 3 / 4),
        "correctness_10m2": (5 / 7, 1.0, 3 / 4),
        "quality_10m2": (5 / 9, 2 / 3, 3 / 5),
        "topology_0_1": (1, 0, 0),
    }.items():
        assert tuple(facts[name] for facts in by_subset) == pytest.approx(wanted), name
    assert [measures(score, subset)[0].subset for subset in subsets(truth)] == ["all", "good", "hard"]


def test_without_true_faces_there_is_nothing_to_say() -> None:
    known = reference(TRUTH, has_faces=False)
    score = score_faces(TRUTH, known)
    assert score == FaceScore(true={}, made={}, components={})
    assert measures(score, subsets(known)[0]) == []


def test_no_models_find_nothing_and_are_never_wrong() -> None:
    facts = scored([], TRUTH)
    assert facts["completeness_10m2"] == facts["quality_10m2"] == facts["completeness_area"] == 0.0
    assert math.isnan(facts["correctness_10m2"])
    assert facts["topology_1_0"] == 7


# ------------------------------------------------------------------------------------------------------- invariants


@pytest.mark.parametrize(("x", "y", "turn"), [(5e5, 5.8e6, 0.0), (5e5, 5.8e6, 33.0), (-40.0, 12.0, 180.0)])
def test_the_score_does_not_change_where_the_scene_moves_or_turns(x: float, y: float, turn: float) -> None:
    random = np.random.default_rng(4)
    truth = by_hand.models_of_scene(suburb(11, size_m=(90.0, 90.0)))
    models = damaged(truth, random)
    before = score_faces(models, reference(truth, extent=None))
    after = score_faces(
        [moved(one, x, y, 7.0, turn) for one in models],
        reference([moved(one, x, y, 7.0, turn) for one in truth], extent=None),
    )
    assert [row.found for row in rows(before.true)] == [row.found for row in rows(after.true)]
    assert [row.verdict for row in rows(before.made)] == [row.verdict for row in rows(after.made)]
    assert 0 < sum(row.found for row in rows(before.true)) < len(rows(before.true))


def test_the_score_does_not_depend_on_the_order_of_models() -> None:
    truth = by_hand.models_of_scene(suburb(12, size_m=(90.0, 90.0)))
    models = damaged(truth, np.random.default_rng(5))
    known = reference(truth, extent=None)
    facts, other = figures(score_faces(models, known), known), figures(score_faces(models[::-1], known), known)
    assert facts == pytest.approx(other, nan_ok=True)


def damaged(truth: list[RoofModel], random: np.random.Generator) -> list[RoofModel]:
    """Models shifted and lifted at random, each with a turned face; some are dropped."""
    kept = [moved(one, *random.normal(0.0, 0.25, 3)) for one in truth if random.random() > 0.1]
    return [with_face(one, 0, turned(one.surfaces[0], random.uniform(-16.0, 16.0))) for one in kept]
