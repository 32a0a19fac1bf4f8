"""Roof edges and corners against true wireframes whose figures are known by hand."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from roofs_by_hand import ORIGIN, flat, gable, lifted, model, rectangle, reference, surface

from pipeline.errors import InputError
from pipeline.model import FaceKind, RoofType, Solid, SolidFace
from pipeline.ruler.evaluation.chapters import chapters
from pipeline.ruler.evaluation.evaluate import Evaluation, evaluate
from pipeline.ruler.evaluation.measure import Group
from pipeline.ruler.evaluation.models import ModelSet, RoofModel
from pipeline.ruler.evaluation.reading.wireframe_files import Wireframe, WireframeSet, read_wireframes
from pipeline.ruler.evaluation.wireframe_network import drawn_segments, network, roof_segments
from pipeline.ruler.evaluation.wireframe_scores import matched_corners, score_wireframes

Ends = list[tuple[int, int]]
SQUARE: Ends = [(0, 1), (1, 2), (2, 3), (3, 0)]


def drawn(name: str, vertices: Any, edges: Ends) -> Wireframe:
    """A wireframe by coordinates about ORIGIN."""
    xyz = np.array(vertices, np.float64) + ORIGIN
    return Wireframe(building_id=name, vertices=xyz, edges=np.array(edges, np.int64))


def rectangle_at(name: str, x: float = 0.0, *, width: float = 10.0, z: float = 6.0) -> Wireframe:
    """The outline of `flat`: 10 x 8 m, 36 m of edges."""
    return drawn(name, [(*xy, z) for xy in rectangle(x, 0, x + width, 8)], SQUARE)


def moved(wireframe: Wireframe, x: float) -> Wireframe:
    return dataclasses.replace(wireframe, vertices=wireframe.vertices + np.array([x, 0.0, 0.0]))


def gable_at(name: str) -> Wireframe:
    """The edges of `gable`: eaves, rakes and ridge."""
    eaves = [(0, 0, 4), (12, 0, 4), (12, 8, 4), (0, 8, 4)]
    rakes = [(0, 4), (3, 4), (1, 5), (2, 5)]
    return drawn(name, [*eaves, (0, 4, 6.8), (12, 4, 6.8)], [(0, 1), (2, 3), (4, 5), *rakes])


def judged(models: list[RoofModel], wireframes: list[Wireframe], **more: Any) -> Evaluation:
    made = ModelSet(name="m", kind="obj", path=".", models=tuple(models))
    return evaluate(made, wireframes=WireframeSet(name="w.json", wireframes=tuple(wireframes)), **more)


def figures(evaluation: Evaluation) -> dict[str, float]:
    found = {
        one.name.removeprefix("wireframes."): one.value for one in evaluation.measures if ".board_" not in one.name
    }
    return {name: value for name, value in found.items() if "." not in name}


def board(evaluation: Evaluation) -> dict[str, float]:
    """The figures of the Building3D board."""
    found = [one for one in evaluation.measures if one.name.startswith("wireframes.board_")]
    return {one.name.removeprefix("wireframes.board_"): one.value for one in found}


def counts(models: list[RoofModel]) -> tuple[float, int]:
    """Metres of edge and number of corners of one building."""
    made = network(roof_segments(models, [0] * len(models)))
    return float(np.linalg.norm(np.diff(made.edges, axis=1), axis=2).sum()), len(made.corners)


def test_the_same_roof_is_perfect() -> None:
    evaluation = judged([flat("a"), gable("b", 20.0)], [rectangle_at("a"), moved(gable_at("b"), 20.0)])
    found = figures(evaluation)
    assert len(found) == 1 + 2 * (3 * 3 + 1)
    assert all(value == pytest.approx(1.0) for value in found.values())
    assert evaluation.notes == ()
    rows = evaluation.tables["wireframes"].to_pylist()
    rake = math.hypot(4.0, 2.8)
    assert [row["true_edges_m"] for row in rows] == pytest.approx([36.0, 36.0 + 4 * rake])
    assert [(row["true_corners"], row["model_corners"]) for row in rows] == [(4, 4), (6, 6)]
    assert [row["model_ids"] for row in rows] == [["a"], ["b"]]


def test_an_edge_that_is_0_4_m_away_is_right_at_half_a_metre_only() -> None:
    found = figures(judged([flat("m", width=10.4)], [rectangle_at("a")]))
    # Three places of 0.1 m at each end of the true edge are within 0.3 m of the edges beside it.
    assert found["edge_recall_0_3m"] == pytest.approx((36.0 - 8.0 + 0.6) / 36.0)
    assert found["edge_precision_0_3m"] == pytest.approx((36.8 - 8.0 - 0.2) / 36.8)
    assert found["edge_ratio"] == pytest.approx(36.8 / 36.0)
    assert found["corner_recall_0_3m"] == found["corner_f1_0_3m"] == 0.5
    at_half_a_metre = {name: value for name, value in found.items() if name.endswith("_0_5m")}
    assert list(at_half_a_metre.values()) == pytest.approx([1.0] * 6)


def test_distances_are_in_space() -> None:
    roof = flat("m")
    higher = dataclasses.replace(roof, surfaces=(lifted(roof.surfaces[0], 0.4),))
    found = figures(judged([higher], [rectangle_at("a")]))
    for name in ("edge_recall", "edge_precision", "edge_f1", "corner_recall", "corner_precision", "corner_f1"):
        assert [found[f"{name}_{at}"] for at in ("0_3m", "0_5m", "1m")] == pytest.approx([0.0, 1.0, 1.0])


def test_f1_is_the_harmonic_mean() -> None:
    step = [surface(rectangle(0, 0, 5, 8), (0.0, 0.0, 6.0), 0), surface(rectangle(5, 0, 10, 8), (0.0, 0.0, 8.0), 1)]
    found = figures(judged([model("m", RoofType.COMBINATION, step)], [rectangle_at("a")]))
    assert found["corner_recall_0_5m"] == 0.5
    assert found["corner_precision_0_5m"] == 0.25
    assert found["corner_f1_0_5m"] == pytest.approx(1.0 / 3.0)
    assert found["corner_ratio"] == 2.0


def test_edges_between_faces_of_one_plane_do_not_count() -> None:
    def halves(rise: float) -> list[RoofModel]:
        left, right = rectangle(0, 0, 5, 8), rectangle(5, 0, 10, 8)
        faces = [surface(left, (0.1, 0.0, 6.0), 0), surface(right, (0.1, 0.0, 6.0 + rise), 1)]
        return [model("m", RoofType.PENT, faces)]

    whole = counts([model("m", RoofType.PENT, [surface(rectangle(0, 0, 10, 8), (0.1, 0.0, 6.0))])])
    assert counts(halves(0.0)) == (pytest.approx(whole[0]), 4)
    length, corners = counts(halves(0.05))
    assert (length, corners) == (pytest.approx(whole[0] + 16.0), 8)
    # Cut out of the middle, the hole and the piece in it vanish as well.
    around = shapely.Polygon(rectangle(0, 0, 10, 8), [rectangle(2, 2, 4, 4)])
    faces = [
        surface(list(around.exterior.coords), (0.1, 0.0, 6.0), 0),
        surface(rectangle(2, 2, 4, 4), (0.1, 0.0, 6.0), 1),
    ]
    hole = shapely.Polygon(faces[0].polygon.exterior, [faces[1].polygon.exterior])
    assert counts([model("m", RoofType.PENT, [dataclasses.replace(faces[0], polygon=hole), faces[1]])]) == (
        pytest.approx(whole[0]),
        4,
    )


def test_two_models_of_one_plane_over_one_wireframe_have_no_edge_between_them() -> None:
    parts = [flat("m", width=4.0), flat("n", 4.0, width=6.0)]
    evaluation = judged(parts, [rectangle_at("a")])
    assert all(value == pytest.approx(1.0) for value in figures(evaluation).values())
    assert evaluation.tables["wireframes"]["model_ids"].to_pylist() == [["m", "n"]]


@pytest.mark.parametrize("as_solid", [False, True])
def test_triangles_count_as_the_polygon_that_they_were_cut_from(as_solid: bool) -> None:
    corners = [(0, 0), (10, 0), (10, 8), (0, 8)]
    made = flat("m")
    if as_solid:
        vertices = np.array([(*xy, z) for z in (0.0, 6.0) for xy in corners])
        walls = [((k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k),) for k in range(4)]
        faces = [SolidFace(rings=rings, kind=FaceKind.WALL, plane=-1) for rings in (*walls, ((3, 2, 1, 0),))]
        faces += [SolidFace(rings=(ring,), kind=FaceKind.ROOF, plane=0) for ring in ((4, 5, 6), (4, 6, 7))]
        made = dataclasses.replace(made, solids=(Solid(vertices=vertices, faces=tuple(faces)),), solid_origin=ORIGIN)
    else:
        rings = [[corners[k] for k in ring] for ring in ((0, 1, 2), (0, 2, 3))]
        made = model("m", RoofType.FLAT, [surface(ring, (0.0, 0.0, 6.0), k) for k, ring in enumerate(rings)])
    assert counts([made]) == (pytest.approx(36.0), 4)


def test_a_split_straight_edge_makes_no_corner() -> None:
    ring = [(0, 0), (4, 0), (10, 0), (10, 8), (0, 8)]
    roof = model("m", RoofType.FLAT, [surface(ring, (0.0, 0.0, 6.0))])
    split = drawn("a", [(*xy, 6.0) for xy in ring], [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0)])
    assert len(network(drawn_segments(split, 0)).corners) == 4
    assert all(value == pytest.approx(1.0) for value in figures(judged([roof], [split])).values())


@pytest.mark.parametrize(("degrees", "corners"), [(3.0, 2), (5.0, 3)])
def test_a_corner_turns_by_more_than_4_degrees(degrees: float, corners: int) -> None:
    turned = (10 + 10 * math.cos(math.radians(degrees)), 0, 10 * math.sin(math.radians(degrees)))
    made = network(drawn_segments(drawn("a", [(0, 0, 0), (10, 0, 0), turned], [(0, 1), (1, 2)]), 0))
    assert len(made.corners) == corners  # both ends, and the turn


def test_three_edges_make_a_corner_even_if_one_was_drawn_without_a_vertex_there() -> None:
    vertices = [(0, 0, 5), (10, 0, 5), (5, 0, 5), (5, 4, 5)]
    split = network(drawn_segments(drawn("a", vertices, [(0, 2), (2, 1), (2, 3)]), 0))
    through = network(drawn_segments(drawn("a", vertices, [(0, 1), (2, 3)]), 0))
    twice = network(drawn_segments(drawn("a", vertices, [(0, 1), (1, 0), (2, 3), (2, 1)]), 0))
    for made in (split, through, twice):
        assert len(made.corners) == 4
        assert float(np.linalg.norm(np.diff(made.edges, axis=1), axis=2).sum()) == pytest.approx(14.0)


def test_a_cluster_of_corners_counts_once() -> None:
    true = np.zeros((1, 3))
    cluster = np.array([[0.0, 0.1, 0.0], [0.05, 0.0, 0.0], [0.0, 0.0, 0.2]])
    true_found, made_found = matched_corners(true, cluster, 0.5)
    assert true_found.tolist() == [True]
    assert made_found.tolist() == [False, True, False]


def test_corners_are_paired_as_often_as_possible() -> None:
    true, made = (np.array([[x, 0.0, 0.0] for x in places]) for places in ([0.0, 0.6], [0.25, -0.4]))
    for order in itertools.permutations(range(2)):  # the nearest pair alone would leave two corners without a partner
        assert all(side.all() for side in matched_corners(true[list(order)], made, 0.5))
    assert [side.sum() for side in matched_corners(true, made, 0.3)] == [1, 1]
    assert [side.tolist() for side in matched_corners(true, made[:0], 0.5)] == [[False, False], []]


def test_a_building_without_a_model_is_missed() -> None:
    evaluation = judged([flat("m"), flat("far", 300.0)], [rectangle_at("a"), rectangle_at("b", 40.0)])
    found = figures(evaluation)
    assert found["with_model"] == found["edge_recall_1m"] == found["corner_recall_1m"] == 0.5
    assert found["edge_precision_0_3m"] == found["corner_precision_0_3m"] == pytest.approx(1.0)
    assert found["edge_f1_0_5m"] == pytest.approx(2.0 / 3.0)
    missed = evaluation.tables["wireframes"].to_pylist()[1]
    assert (missed["model_ids"], missed["has_model"], missed["model_edges_m"]) == ([], False, 0.0)
    assert (missed["edge_recall_0_5m"], missed["edge_precision_0_5m"], missed["edge_f1_0_5m"]) == (0.0, None, 0.0)
    assert any("1 of the 2 models" in note for note in evaluation.notes)
    low, high = next((one.low, one.high) for one in evaluation.measures if one.name == "wireframes.edge_recall_0_5m")
    assert (low, high) == (0.0, pytest.approx(1.0))


def test_no_model_at_all_scores_zero() -> None:
    found = figures(judged([], [rectangle_at("a")]))
    assert found["with_model"] == found["edge_recall_1m"] == found["edge_f1_1m"] == found["corner_f1_1m"] == 0.0
    assert math.isnan(found["edge_precision_1m"])
    elsewhere = judged([flat("far", 300.0)], [rectangle_at("a")])
    assert any("None of the models stands on a wireframe" in note for note in elsewhere.notes)


def test_rows_do_not_depend_on_how_they_are_divided() -> None:
    houses = [rectangle_at("a"), rectangle_at("b", 10.0, z=7.0)]
    apart = [flat("m"), flat("n", 10.0, z=7.0)]
    assert all(value == pytest.approx(1.0) for value in figures(judged(apart, houses)).values())
    block = model("block", RoofType.COMBINATION, [one.surfaces[0] for one in apart])
    evaluation = judged([block], houses)
    assert all(value == pytest.approx(1.0) for value in figures(evaluation).values())
    rows = evaluation.tables["wireframes"].to_pylist()
    assert [(row["model_ids"], row["has_model"]) for row in rows] == [(["block"], True), ([], True)]
    # One plane over both: the wall between them is missed, and nothing is wrong.
    level = judged([flat("block", width=20.0)], [rectangle_at("a"), rectangle_at("b", 10.0)])
    found = figures(level)
    assert found["edge_precision_0_3m"] == pytest.approx(1.0)
    assert found["edge_recall_0_3m"] == pytest.approx((64.0 - 8.0 + 0.6) / 64.0)
    assert found["corner_recall_0_5m"] == pytest.approx(4.0 / 6.0)
    # Two models over both: the wall counts, though the planes are one.
    both = figures(judged([flat("m"), flat("n", 10.0)], [rectangle_at("a"), rectangle_at("b", 10.0)]))
    assert all(value == pytest.approx(1.0) for value in both.values())


def test_models_of_given_outlines_belong_to_the_wireframe_of_their_id() -> None:
    houses = [rectangle_at("a"), rectangle_at("b", 10.0)]
    shed = flat("shed", 7.0, width=3.0)
    assert score_wireframes([shed], houses).model_ids[0] == ("shed",)
    over = flat("m", 6.0, width=5.0, source_id="b")  # mostly on a, but drawn as b
    assert list(score_wireframes([over], houses).model_ids) == [(), ("m",)]
    elsewhere = flat("m", source_id="b")  # an id by chance: another place
    assert list(score_wireframes([elsewhere], houses).model_ids) == [("m",), ()]


def test_neighbours_that_reach_over_are_not_judged() -> None:
    score = score_wireframes([flat("m"), flat("neighbour", 9.5)], [rectangle_at("a")])
    assert score.model_ids[0] == ("m",)
    assert score.elsewhere == 1


def test_the_order_of_the_models_does_not_matter() -> None:
    houses = [rectangle_at("a"), rectangle_at("b", 10.0), moved(gable_at("c"), 30.0)]
    made = [flat("m", width=10.3), flat("n", 10.3, z=6.2), gable("o", 30.2, slope=0.75)]
    first = figures(judged(made, houses))
    assert all(figures(judged(list(order), houses)) == first for order in itertools.permutations(made))
    assert 0.0 < first["edge_f1_0_3m"] < 1.0


def test_a_wireframe_with_a_gap_still_has_a_place() -> None:
    open_ends = drawn("a", [(0, 0, 6), (10, 0, 6), (10, 8, 6), (0, 8, 6), (0, 0.4, 6)], [*SQUARE[:3], (3, 4)])
    assert score_wireframes([flat("m")], [open_ends]).model_ids[0] == ("m",)
    angle = drawn("a", [(0, 0, 6), (10, 0, 6), (10, 8, 6)], [(0, 1), (1, 2)])
    assert score_wireframes([flat("m")], [angle]).model_ids[0] == ("m",)


def test_wireframes_go_with_any_reference_and_show_by_building() -> None:
    evaluation = judged([flat("m")], [rectangle_at("a")], reference=reference([flat("t")]))
    assert evaluation.measure("faces.completeness_10m2").value == 1.0
    assert evaluation.measure("wireframes.edge_f1_0_5m").value == pytest.approx(1.0)
    chapter = next(one for one in chapters(evaluation) if one.group is Group.WIREFRAMES)
    assert [table.rows[0][0] for table in chapter.tables] == ["a", "a"]
    assert chapter.tables[0].rows[0][1:] == ("36", "36", "100.00 %", "100.00 %", "100.00 %")


# -------------------------------------------------------------------------------------------------------------- reading


def test_json_and_obj_hold_the_same_wireframes(tmp_path: Path) -> None:
    vertices, edges = [[0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [4.0, 3.0, 6.5]], [[0, 1], [1, 2]]
    (tmp_path / "w.json").write_text(
        json.dumps({"b": {"v": vertices, "e": edges}, "a": {"v": vertices, "e": [[0, 2]]}})
    )
    lines = ["# drawn", "o a", *(f"v {x} {y} {z}" for x, y, z in vertices), "l 1 3", "o b", "l 1/1 2 -1", "f 1 2 3"]
    (tmp_path / "w.obj").write_text("\n".join(lines))
    folder = tmp_path / "single"
    folder.mkdir()
    for name, ends in (("a", "l 1 3"), ("b", "l 1 2\nl 2 3")):
        (folder / f"{name}.obj").write_text("\n".join([*(f"v {x} {y} {z}" for x, y, z in vertices), ends]))
    for path in (tmp_path / "w.json", tmp_path / "w.obj", folder):
        found = read_wireframes(path)
        assert [one.building_id for one in found.wireframes] == ["a", "b"]
        assert found.notes == ()
        ends = [np.sort(one.vertices[one.edges].reshape(-1, 6), axis=0).tolist() for one in found.wireframes]
        assert ends == [
            [[0.0, 0.0, 5.0, 4.0, 3.0, 6.5]],
            [[0.0, 0.0, 5.0, 4.0, 0.0, 5.0], [4.0, 0.0, 5.0, 4.0, 3.0, 6.5]],
        ]


def test_edges_without_length_and_empty_buildings_are_noted(tmp_path: Path) -> None:
    place = tmp_path / "w.json"
    vertices = [[0, 0, 5], [4, 0, 5]]
    place.write_text(json.dumps({"a": {"v": vertices, "e": [[0, 1], [1, 1]]}, "b": {"v": vertices, "e": []}}))
    found = read_wireframes(place)
    assert [one.edges.tolist() for one in found.wireframes] == [[[0, 1]]]
    assert ["1 edges" in found.notes[0], "1 buildings" in found.notes[1]] == [True, True]


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("w.json", "{", ("line 1",)),
        ("w.json", "[1]", ("no ids of buildings",)),
        ("w.json", '{"a": {"v": []}}', ("'a'", "no lists v and e")),
        ("w.json", '{"a": {"v": [[0, 0]], "e": []}}', ("vertex 0 of building 'a'", "[0, 0]", "three numbers")),
        ("w.json", '{"a": {"v": [[0, 0, "5"]], "e": []}}', ("'5'", "three numbers")),
        ("w.json", '{"a": {"v": [[0, 0, NaN]], "e": []}}', ("nan", "finite")),
        ("w.json", '{"a": {"v": [[0, 0, 1e9]], "e": []}}', ("1000000000.0", "in metres")),
        ("w.json", '{"a": {"v": [[0, 0, 5]], "e": [[0, 1]]}}', ("edge 0 of building 'a'", "[0, 1]", "1 vertices")),
        ("w.json", '{"a": {"v": [[0, 0, 5]], "e": [[0, 0, 0]]}}', ("[0, 0, 0]", "two vertices")),
        ("w.json", '{"a": {"v": [], "e": []}, "a": {"v": [], "e": []}}', ("'a' is there twice",)),
        ("w.json", "{}", ("no edges", "Give JSON")),
        ("w.obj", "v 0 0 5\nv 1 0 5\nl 1 3", ("line 3", "vertex 3", "2 are there")),
        ("w.obj", "v 0 0 x", ("line 1", "'x'")),
        ("w.obj", "v 0 0", ("line 1", "three numbers")),
        ("w.obj", "v 0 0 5\nl 1", ("line 2", "two are needed")),
        ("w.obj", "v 0 0 5\nv 1 0 5\nv 1 1 5\nf 1 2 3", ("no edges", "`l` lines")),
        ("w.gpkg", "", ("'.gpkg'", "Give JSON")),
    ],
)
def test_bad_files_are_refused_with_the_value_and_the_fix(
    tmp_path: Path, name: str, text: str, said: tuple[str, ...]
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        read_wireframes(tmp_path / name)
    assert name in str(caught.value)
    assert [part for part in said if part not in str(caught.value)] == []
    assert caught.value.fix


def test_nothing_there_and_empty_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing is there"):
        read_wireframes(tmp_path / "w.json")
    with pytest.raises(InputError, match="no OBJ file"):
        read_wireframes(tmp_path)


def test_the_board_sees_no_fault_in_the_same_roof() -> None:
    found = board(judged([flat("a"), gable("b", 20.0)], [rectangle_at("a"), moved(gable_at("b"), 20.0)]))
    assert found.pop("corner_offset") == pytest.approx(0.0, abs=1e-9)
    assert found == pytest.approx(dict.fromkeys(found, 1.0))
    assert len(found) == 6


@pytest.mark.parametrize(
    ("width", "right", "offset"),
    # The farthest true corner is sqrt(41) m from the middle, so a tenth is 0.64 m.
    [(10.6, 1.0, 0.3 / math.sqrt(41)), (10.7, 0.5, 0.0)],
)
def test_the_board_measures_relative_to_the_size_of_the_building(width: float, right: float, offset: float) -> None:
    found = board(judged([flat("m", width=width)], [rectangle_at("a")]))
    assert found["corner_precision"] == found["corner_recall"] == right
    assert found["edge_f1"] == (1.0 if right == 1.0 else 0.25)  # else of the four edges the one at x = 0
    assert found["corner_offset"] == pytest.approx(offset)


def test_on_the_board_corners_may_be_right_without_their_edges() -> None:
    cross = drawn("a", [(0, 0, 6), (10, 0, 6), (10, 8, 6), (0, 8, 6)], [(0, 2), (1, 3)])
    found = board(judged([flat("m")], [cross]))
    assert (found["edge_precision"], found["edge_recall"]) == (0.0, 0.0)
    assert (found["corner_precision"], found["corner_recall"], found["corner_offset"]) == (1.0, 1.0, 0.0)


def test_the_board_joins_stretches_that_go_straight_on() -> None:
    ring = [(0, 0), (3, 0), (7, 0), (10, 0), (10, 8), (0, 8)]
    found = board(judged([model("m", RoofType.FLAT, [surface(ring, (0.0, 0.0, 6.0))])], [rectangle_at("a")]))
    assert (found["edge_precision"], found["edge_recall"], found["corner_precision"]) == (1.0, 1.0, 1.0)


def test_on_the_board_a_building_without_a_model_costs_recall_alone() -> None:
    found = board(judged([flat("m")], [rectangle_at("a"), moved(rectangle_at("b"), 50.0)]))
    assert (found["edge_precision"], found["edge_recall"]) == (1.0, 0.5)
    assert found["corner_f1"] == pytest.approx(2 / 3)
    nothing = board(judged([], [rectangle_at("a")]))
    assert (nothing["edge_recall"], nothing["edge_f1"], math.isnan(nothing["edge_precision"])) == (0.0, 0.0, True)
