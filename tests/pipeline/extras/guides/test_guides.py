"""Given lines of roofs: faces part on them where the points allow it, eaves move the outline, wrong ones do no harm."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import shapely
from examples import examples
from faces_by_hand import plane
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, MultiPolygon
from shapely.affinity import rotate, scale, translate

from pipeline.extras.guides.guide_matching import followed, guided_outline, inner_pieces, pieces_of
from pipeline.extras.guides.guided_faces import guided_faces, misfits_of
from pipeline.model import FloatArray, Guide, GuideKind
from pipeline.roof.arrangement.arranging import arrange
from pipeline.roof.arrangement.candidate_lines import CandidateLines
from pipeline.roof.arrangement.guide_lines import NO_GUIDES, Guides, with_guides
from pipeline.roof.footprint_in_mm import footprint_in_mm
from pipeline.roof.partition import RoofPartition
from pipeline.roof.roof_settings import ArrangementSettings

SETTINGS = ArrangementSettings()
HOUSE = shapely.box(0.0, 0.0, 10.0, 8.0)
LEVELS = np.array([[0.0, 0.0, 6.0], [0.0, 0.0, 3.0]])
GABLE = np.array([[0.0, 0.7, 3.0], [0.0, -0.7, 8.6]])
"""The ridge is y = 4."""


def lattice(outline: shapely.Geometry = HOUSE, spacing_m: float = 1.0) -> FloatArray:
    """Positions over an outline, half a spacing from its box, with z = 0."""
    x0, y0, x1, y1 = outline.bounds
    x, y = np.meshgrid(
        np.arange(x0 + spacing_m / 2, x1, spacing_m), np.arange(y0 + spacing_m / 2, y1, spacing_m), indexing="ij"
    )
    return np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size)))


def on_planes(points: FloatArray, planes: FloatArray, is_second: Any) -> tuple[FloatArray, Any]:
    labels = is_second.astype(np.int32)
    own = planes[labels]
    return np.column_stack((points[:, :2], (own[:, :2] * points[:, :2]).sum(axis=1) + own[:, 2])), labels


def stepped(at_m: float = 5.0) -> tuple[FloatArray, Any]:
    """Points 1 m apart on two levels, which part where x is `at_m`."""
    points = lattice()
    return on_planes(points, LEVELS, points[:, 0] > at_m)


def drawn(
    points: FloatArray, labels: Any, planes: FloatArray, *guides: Any, distance_m: float = 0.6, may_step: bool = False
) -> RoofPartition:
    """The faces of a house with guides (x0, y0, x1, y1) that the points bear out."""
    spacing_m = math.sqrt(HOUSE.area / len(points))

    def arranged(given: Guides) -> RoofPartition:
        return arrange(points, labels, planes, footprint_in_mm(HOUSE), spacing_m, SETTINGS, 1.0, given)

    pieces = np.array(guides, float).reshape(-1, 4)
    return guided_faces(
        arranged, arranged(NO_GUIDES), points, Guides(pieces, distance_m), np.full(len(pieces), may_step), 1.0, 0.3
    )


def borders_x(partition: RoofPartition) -> list[float]:
    """Where faces part: the x of all their vertices within the house, metres."""
    x = {x / 1e3 for face in partition.polygons for x, _ in face.exterior.coords}
    return sorted(x - {0.0, 10.0})


def same_faces(one: RoofPartition, other: RoofPartition) -> bool:
    return len(one.polygons) == len(other.polygons) and all(
        a.equals(b) for a, b in zip(one.polygons, other.polygons, strict=True)
    )


@pytest.mark.parametrize("x", [4.6, 4.87, 5.3])
def test_a_step_runs_exactly_where_a_guide_says_between_the_points(x: float) -> None:
    points, labels = stepped()
    assert borders_x(drawn(points, labels, LEVELS)) == pytest.approx([5.0] * 1, abs=0.1)
    guided = drawn(points, labels, LEVELS, (x, 1.0, x, 7.0))
    assert borders_x(guided) == pytest.approx([x], abs=2e-3)
    assert len(guided.polygons) == 2


@pytest.mark.parametrize("guide", [(3.0, 1.0, 3.0, 7.0), (7.4, 1.0, 7.4, 7.0), (1.0, 2.0, 9.0, 6.0)])
def test_a_guide_far_from_its_points_changes_nothing(guide: tuple[float, ...]) -> None:
    points, labels = stepped()
    assert same_faces(drawn(points, labels, LEVELS, guide), drawn(points, labels, LEVELS))


def test_dense_points_overrule_a_guide_that_is_near() -> None:
    points = lattice(spacing_m=0.25)
    points, labels = on_planes(points, LEVELS, points[:, 0] > 5.0)
    near, far = (drawn(points, labels, LEVELS, (x, 0.0, x, 8.0), may_step=True) for x in (5.05, 5.4))
    assert borders_x(near) == pytest.approx([5.05], abs=2e-3)
    assert same_faces(far, drawn(points, labels, LEVELS))


def test_a_guide_takes_the_places_of_near_lines_that_run_its_way() -> None:
    north = np.arange(0.25, 8.0, 0.5)
    places = np.concatenate((np.column_stack((np.full(16, 5.0), north)), np.column_stack((north, np.full(16, 4.0)))))
    found = CandidateLines(
        lines=np.array([[1.0, 0.0, -5.0], [0.0, 1.0, -4.0]]),
        scores=np.array([16.0, 16.0]),
        crossing=np.zeros(2, np.int32),
        places=places,
        line_of=np.repeat(np.array([0, 1], np.int32), 16),
    )
    given = Guides(np.array([[5.3, 0.0, 5.3, 7.0], [9.0, 0.0, 9.0, 8.0]]), 0.5)
    joined = with_guides(found, given, 0.5, 1.0)
    assert joined.lines[:2] == pytest.approx(np.array([[-1.0, 0.0, 5.3], [-1.0, 0.0, 9.0]]))
    # one of the line's places is left beyond the guide's end, which does not make a line
    assert joined.line_of[:32].tolist() == [*[0] * 15, -1, *[3] * 16]
    assert (joined.line_of[32:47] == 0).all()
    assert with_guides(found, NO_GUIDES, 0.5, 1.0) is found or (
        with_guides(found, NO_GUIDES, 0.5, 1.0).line_of.tolist() == found.line_of.tolist()
    )


def test_a_wrong_guide_does_not_take_a_right_one_along() -> None:
    points, labels = stepped()
    guided = drawn(points, labels, LEVELS, (4.7, 1.0, 4.7, 7.0), (3.0, 1.0, 3.0, 7.0), (1.0, 3.3, 9.0, 3.4))
    assert borders_x(guided) == pytest.approx([4.7], abs=2e-3)


def test_guides_over_one_plane_part_nothing() -> None:
    points = lattice()
    points[:, 2] = 5.0 + 0.3 * points[:, 0]
    planes = np.array([[0.3, 0.0, 5.0]])
    labels = np.zeros(len(points), np.int32)
    assert len(drawn(points, labels, planes, (1.0, 4.0, 9.0, 4.0), (5.0, 0.5, 5.0, 7.5)).polygons) == 1


def test_planes_meet_on_the_guide_of_a_ridge_and_stay_where_it_is_too_far() -> None:
    rng = np.random.default_rng(3)
    points, labels = on_planes(lattice(), GABLE, lattice()[:, 1] > 4.0)
    points[:, 2] += rng.normal(0.0, 0.05, len(points))
    near, far = (drawn(points, labels, GABLE, (0.5, y, 9.5, y)) for y in (4.05, 4.5))
    for face, label in zip(near.polygons, near.labels, strict=True):
        ridge_y = (face.bounds[3] if label == 0 else face.bounds[1]) / 1e3
        assert ridge_y == pytest.approx(4.05, abs=2e-3)
    assert near.planes is not None
    (one, other) = (np.array(near.planes[k].coefficients) for k in (0, 1))
    assert [float((one - other) @ (x, 4.05, 1.0)) for x in (0.0, 10.0)] == pytest.approx([0.0, 0.0], abs=5e-3)
    # half a metre off, 0.7 m of height apart: the points know better, unless it is known as a step
    assert same_faces(far, drawn(points, labels, GABLE))
    step = drawn(points, labels, GABLE, (0.5, 4.5, 9.5, 4.5), may_step=True)
    assert {y for face in step.polygons for _, y in face.exterior.coords} == {0.0, 4500.0, 8000.0}


@settings(max_examples=examples(12), deadline=None)
@given(east=st.integers(-40, 40), north=st.integers(-40, 40), seed=st.integers(0, 5))
def test_guided_faces_move_with_the_scene(east: int, north: int, seed: int) -> None:
    points, labels = stepped()
    points[:, 2] += np.random.default_rng(seed).normal(0.0, 0.04, len(points))
    pieces = np.array([(4.7, 1.0, 4.7, 7.0), (2.0, 4.0, 8.0, 4.1), (4.7, 7.0, 5.2, 7.9)])
    shift = np.array([float(east), float(north)])

    def faces(moved: FloatArray, order: list[int]) -> RoofPartition:
        there = points + np.array([*moved, 0.0])
        planes = LEVELS.copy()
        outline = footprint_in_mm(translate(HOUSE, *moved))
        given = Guides(pieces[order] + np.tile(moved, 2), 0.6)
        return arrange(there, labels, planes, outline, 1.0, SETTINGS, 1.0, given)

    here, moved = faces(np.zeros(2), [0, 1, 2]), faces(shift, [0, 1, 2])
    back = [translate(face, *(-1e3 * shift)) for face in moved.polygons]
    assert all(a.equals_exact(b, 1.01) for a, b in zip(here.polygons, back, strict=True))


def guides(*lines: Any, kind: GuideKind = GuideKind.EAVE) -> list[Guide]:
    return [Guide(kind=kind, line=LineString(line)) for line in lines]


BOX_MM = MultiPolygon([shapely.box(0, 0, 10_000, 8_000)])
NO_POINTS = np.empty((0, 2), np.int64)


def test_an_edge_of_the_outline_moves_onto_the_guide_of_an_eave_and_its_neighbours_follow() -> None:
    found = guided_outline(BOX_MM, guides([(1.0, -0.3), (9.0, -0.3)]), NO_POINTS, 0.6)
    assert found.equals(MultiPolygon([shapely.box(0, -300, 10_000, 8_000)]))
    turned = guided_outline(BOX_MM, guides([(0.0, 0.0), (10.0, 0.4)]), NO_POINTS, 0.6)
    assert turned.equals(MultiPolygon([shapely.Polygon([(0, 0), (10_000, 400), (10_000, 8_000), (0, 8_000)])]))


@pytest.mark.parametrize(
    "line",
    [
        [(1.0, -0.7), (9.0, -0.7)],  # too far
        [(1.0, -0.5), (4.0, 0.5)],  # turned by 18 deg
        [(1.0, 0.2), (4.0, 0.2)],  # beside less than half of the edge
        [(12.0, 0.0), (20.0, 0.0)],  # beside none of it
    ],
)
def test_other_guides_leave_the_outline(line: Any) -> None:
    assert guided_outline(BOX_MM, guides(line), NO_POINTS, 0.6) is BOX_MM or guided_outline(
        BOX_MM, guides(line), NO_POINTS, 0.6
    ).equals(BOX_MM)


def test_only_eaves_and_lines_of_any_kind_move_the_outline() -> None:
    line = [(1.0, -0.3), (9.0, -0.3)]
    moved = {
        kind for kind in GuideKind if not guided_outline(BOX_MM, guides(line, kind=kind), NO_POINTS, 0.6).equals(BOX_MM)
    }
    assert moved == {GuideKind.EAVE, GuideKind.ANY}


def test_an_eave_does_not_cut_off_points() -> None:
    inwards = guides([(1.0, 0.5), (9.0, 0.5)])
    assert guided_outline(BOX_MM, inwards, np.array([[4000, 100]]), 0.6).equals(BOX_MM)
    # so near to the eave a point met it with a part of its beam
    assert guided_outline(BOX_MM, inwards, np.array([[4000, 400]]), 0.6).equals(
        MultiPolygon([shapely.box(0, 500, 10_000, 8_000)])
    )


def test_a_jagged_eave_becomes_one_edge() -> None:
    jagged = shapely.Polygon(
        [(0, 0), (4_000, 0), (4_000, 300), (7_000, 300), (7_000, 0), (10_000, 0), (10_000, 8_000), (0, 8_000)]
    )
    found = guided_outline(MultiPolygon([jagged]), guides([(0.0, 0.1), (10.0, 0.1)]), NO_POINTS, 0.6)
    assert found.normalize().equals_exact(MultiPolygon([shapely.box(0, 100, 10_000, 8_000)]).normalize(), 0.5)


@settings(max_examples=examples(20), deadline=None)
@given(degrees=st.integers(0, 359), east=st.integers(-30, 30), is_mirrored=st.booleans())
def test_a_guided_outline_turns_and_moves_and_mirrors_with_the_building(
    degrees: int, east: int, *, is_mirrored: bool
) -> None:
    line = LineString([(0.5, -0.3), (9.0, -0.1)])

    def changed(geometry: Any, unit: float) -> Any:
        mirrored = scale(geometry, -1.0, 1.0, origin=(0, 0)) if is_mirrored else geometry
        return translate(rotate(mirrored, degrees, origin=(0, 0)), east * unit, 0.0)

    plain = guided_outline(BOX_MM, guides(line), NO_POINTS, 0.6)
    outline = shapely.transform(changed(BOX_MM, 1e3), np.rint)
    found = guided_outline(outline, [Guide(kind=GuideKind.EAVE, line=changed(line, 1.0))], NO_POINTS, 0.6)
    assert found.symmetric_difference(changed(plain, 1e3)).area < 1e5


def test_pieces_along_the_outline_are_not_inner_ones() -> None:
    given = [*guides([(0.0, 0.05), (10.0, 0.05)]), *guides([(-1.0, 4.0), (6.0, 4.0), (6.0, 9.0)], kind=GuideKind.HIP)]
    found, may_step = inner_pieces([*given, *guides([(2.0, 2.0), (3.0, 2.0)])], BOX_MM)
    assert may_step.tolist() == [False, False, True]
    assert found[:2] == pytest.approx(np.array([[0.1, 4.0, 6.0, 4.0], [6.0, 4.0, 6.0, 7.9]]))
    assert pieces_of([LineString([(0, 0), (0.3, 0), (2, 0)])]).tolist() == [[0.3, 0.0, 2.0, 0.0]]


def test_of_very_many_pieces_the_longest_take_part() -> None:
    short = guides(*([(1.0, y), (2.0, y)] for y in np.linspace(1.0, 7.0, 60)))
    long = guides(*([(3.0, y), (6.0, y)] for y in np.linspace(1.0, 7.0, 60)))
    found, may_step = inner_pieces([*short, *long], BOX_MM)
    assert len(found) == len(may_step) == 100
    assert (found[:40, 2] == 2.0).all()
    assert (found[40:, 2] == 6.0).all()


def test_guides_are_counted_where_edges_run_along_half_of_them() -> None:
    faces = [shapely.box(0, 0, 5, 8), shapely.box(5, 0, 10, 8)]
    along, across = [(5.0, 1.0), (5.0, 7.0)], [(1.0, 4.0), (9.0, 4.0)]
    beside, elsewhere, eave = [(12.0, 0.0), (12.0, 8.0)], [(50.0, 0.0), (60.0, 0.0)], [(0.05, 0.0), (0.05, 30.0)]
    assert followed(guides(along, across, beside, elsewhere, eave), faces, 0.6) == (2, 1)
    assert followed(guides([(5.0, 4.0), (5.0, 6.0), (8.0, 6.0), (9.9, 6.0)]), faces, 0.6) == (0, 1)
    assert followed([], faces, 0.6) is None
    assert followed(guides(along), [], 0.6) is None


def test_misfits_are_shares_of_the_cap_and_whole_off_all_faces() -> None:
    partition = RoofPartition(
        polygons=(shapely.box(0, 0, 5000, 8000),), labels=np.zeros(1, np.int32), planes=(plane(0.0, 0.0, 3.0),)
    )
    points = np.array([[1.0, 1.0, 3.1], [1.0, 2.0, 9.0], [7.0, 1.0, 3.0]])
    assert misfits_of(points, partition, 0.2) == pytest.approx([0.5, 1.0, 1.0])
    assert math.isclose(misfits_of(points, dataclasses.replace(partition), 0.1)[0], 1.0)
