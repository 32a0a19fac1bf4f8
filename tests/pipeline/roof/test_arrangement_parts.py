"""The steps of the arrangement: minimum cuts, and the subdivision of an outline by chords."""

import itertools

import numpy as np
import pytest
import shapely

from pipeline.model import IntArray, LabelArray
from pipeline.roof.arrangement.arranged_faces import rings_of_faces
from pipeline.roof.arrangement.candidate_lines import CandidateLines
from pipeline.roof.arrangement.minimum_cut import (
    Allowed,
    Costs,
    cost_of,
    costs_of_all,
    every_label,
    expand_labels,
    neighbour_lists,
)
from pipeline.roof.arrangement.plan_cells import (
    cell_areas_m2,
    cell_borders,
    cells_of_points,
    connected_faces,
    points_per_cell,
    unite_faces,
)
from pipeline.roof.arrangement.raster_labels import _SETTLING_ROUNDS, Limits, Raster, _framed, _settle, limits_at
from pipeline.roof.arrangement.subdivision import (
    EDGES,
    FACE,
    NEXT,
    ORIGIN,
    PREVIOUS,
    Subdivision,
    cell_at,
    insert_chord,
    insert_vertex,
    subdivide,
    subdivision_of,
)
from pipeline.roof.roof_settings import ArrangementSettings


def random_graph(seed: int, n: int, k: int) -> tuple[IntArray, LabelArray, IntArray]:
    rng = np.random.default_rng(seed)
    pairs = np.array([pair for pair in itertools.combinations(range(n), 2) if rng.random() < 0.45], np.int64)
    pairs = pairs.reshape(-1, 2)
    return rng.integers(0, 60, (n, k)), pairs, rng.integers(1, 40, len(pairs))


def cost(costs: IntArray, pairs: LabelArray, weights: IntArray, labels: LabelArray) -> int:
    apart = labels[pairs[:, 0]] != labels[pairs[:, 1]]
    return int(costs[np.arange(len(labels)), labels].sum() + weights[apart].sum())


def expanded(costs: IntArray, pairs: LabelArray, weights: IntArray, labels: LabelArray) -> LabelArray:
    labels = labels.copy()
    expand_labels(
        costs_of_all(costs), every_label(*costs.shape), neighbour_lists(len(costs), pairs, weights), labels, 20
    )
    return labels


def test_a_label_without_a_cost_of_its_own_costs_what_is_usual_at_the_node() -> None:
    costs = Costs(np.array([0, 2, 2, 3]), np.array([1, 3, 0], np.int32), np.array([5, 7, 9]), np.array([20, 30, 40]))
    found = [[cost_of(costs, node, label) for label in range(4)] for node in range(3)]
    assert found == [[20, 5, 20, 7], [30] * 4, [9, 40, 40, 40]]
    dense = np.array(found)
    stored = costs_of_all(dense)
    assert [[cost_of(stored, node, label) for label in range(4)] for node in range(3)] == found


@pytest.mark.parametrize("seed", range(25))
def test_with_two_labels_the_cost_is_the_least_of_all(seed: int) -> None:
    graph = random_graph(seed, 9, 2)
    labels = expanded(*graph, np.zeros(9, np.int32))
    every = (np.array(one, np.int32) for one in itertools.product(range(2), repeat=9))
    assert cost(*graph, labels) == min(cost(*graph, one) for one in every)


@pytest.mark.parametrize("seed", range(12))
def test_with_more_labels_no_expansion_is_left_that_costs_less(seed: int) -> None:
    graph = random_graph(seed, 8, 4)
    labels = expanded(*graph, graph[0].argmin(axis=1).astype(np.int32))
    least = cost(*graph, labels)
    for alpha, taken in itertools.product(range(4), itertools.product((False, True), repeat=8)):
        assert cost(*graph, np.where(taken, alpha, labels).astype(np.int32)) >= least


def test_a_label_that_costs_the_same_is_not_taken_and_only_allowed_nodes_take_one() -> None:
    costs = np.array([[5, 5], [5, 5]])
    labels = expanded(costs, np.array([[0, 1]]), np.array([3]), np.array([1, 1], np.int32))
    assert labels.tolist() == [1, 1]
    costs = np.array([[9, 0], [9, 0]])
    labels = np.zeros(2, np.int32)
    lists = neighbour_lists(2, np.zeros((0, 2), np.int32), np.zeros(0, np.int64))
    expand_labels(
        costs_of_all(costs), Allowed(np.array([0, 1, 1], np.int32), np.array([0, 2, 3], np.int32)), lists, labels, 5
    )
    assert labels.tolist() == [0, 1]


@pytest.mark.parametrize("seed", range(12))
def test_the_expansion_that_changes_least_is_taken_of_those_that_cost_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    costs, pairs, weights = random_graph(seed, 9, 2)
    costs, weights = costs // 12, weights // 12 + 1  # many ties
    before = rng.integers(0, 2, 9).astype(np.int32)
    allowed = Allowed(np.arange(9, dtype=np.int32), np.array([0, 0, 9], np.int32))  # only label 1 expands
    lists = neighbour_lists(9, pairs, weights)
    labels = before.copy()
    expand_labels(costs_of_all(costs), allowed, lists, labels, 1)
    moves = [np.where(taken, 1, before).astype(np.int32) for taken in itertools.product((False, True), repeat=9)]
    least = min(cost(costs, pairs, weights, one) for one in moves)
    best = [one for one in moves if cost(costs, pairs, weights, one) == least]
    assert labels.tolist() == min(best, key=lambda one: int((one != before).sum())).tolist()


@pytest.mark.parametrize("seed", range(8))
def test_cells_settle_as_if_all_were_looked_at_in_every_round(seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns, rows, k = 9, 7, 3
    place = np.flatnonzero(rng.random(columns * rows) < 0.8).astype(np.int32)
    costs = rng.integers(0, 40, (len(place), k))
    labels = rng.integers(0, k, len(place)).astype(np.int32)
    expected = {int(cell): int(label) for cell, label in zip(place, labels, strict=True)}
    for _ in range(_SETTLING_ROUNDS):
        for i, cell in enumerate(place.tolist()):
            r, c = divmod(cell, columns)
            around = [
                (expected[rr * columns + cc], 7 if (rr == r) != (cc == c) else 5)
                for rr, cc in itertools.product(range(r - 1, r + 2), range(c - 1, c + 2))
                if (rr, cc) != (r, c) and 0 <= cc < columns and rr * columns + cc in expected
            ]
            total = {
                label: int(costs[i, label]) + sum(weight for other, weight in around if other != label)
                for label in {expected[cell], *(other for other, _ in around)}
            }
            least, best = min((value, label) for label, value in total.items())
            if least < total[expected[cell]]:
                expected[cell] = best
    number = np.full(columns * rows, -1, np.int32)
    number[place] = np.arange(len(place))
    _settle(costs_of_all(costs), _framed(Raster(0.0, 0.0, 1.0, columns, rows, number, place)), 7, 5, labels)
    assert labels.tolist() == [expected[cell] for cell in place.tolist()]


def test_rings_come_by_faces_the_outer_one_first() -> None:
    xy = np.array([(0, 0), (9, 0), (9, 9), (0, 9), (3, 3), (3, 6), (6, 6), (6, 3)])
    hole_first = np.array([4, 5, 6, 7, 0, 1, 2, 3, 4, 7, 6, 5], np.int32)
    starts, owner = np.array([0, 4, 8, 12], np.int32), np.array([1, 1, 0], np.int32)
    nodes, ring_of, faces, is_sound = rings_of_faces(xy, hole_first, starts, owner, 2)
    assert is_sound
    assert faces.tolist() == [0, 1, 1]
    assert nodes.tolist() == xy[[4, 7, 6, 5, 0, 1, 2, 3, 4, 5, 6, 7]].tolist()
    assert ring_of.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    assert not rings_of_faces(xy, hole_first, starts, owner, 3)[3]
    assert not rings_of_faces(xy, hole_first[:8], starts[:3], np.array([1, 0], np.int32), 2)[3]


def test_points_are_counted_by_cell_and_those_outside_not_at_all() -> None:
    assert points_per_cell(np.array([2, 0, -1, 2]), 4).tolist() == [1, 0, 2, 0]


def square(holes: int = 0) -> Subdivision:
    """A square of 10 m with small square holes along its diagonal."""
    rings = [np.array([(0, 0), (10_000, 0), (10_000, 10_000), (0, 10_000)])]
    for hole in range(holes):
        x = 2000 + 3000 * hole
        rings.append(np.array([(x, x), (x, x + 1000), (x + 1000, x + 1000), (x + 1000, x)]))
    starts = np.arange(0, 4 * len(rings) + 1, 4)
    return subdivision_of(np.concatenate(rings), starts, np.zeros(len(rings), np.int64), 400)


def cut(*east_mm: int) -> Subdivision:
    """A square of 10 m cut from south to north."""
    plan = square()
    for x in east_mm:
        for y in (0, 10_000):
            assert insert_vertex(plan, edge_through(plan, x, y), x, y)
        north = int(plan.counts[0]) - 1
        assert insert_chord(plan, north - 1, north, cell_at(plan, x + 1.0, 5000.0), 0) == 1
    return plan


def edge_through(plan: Subdivision, x: int, y: int) -> int:
    """The half-edge with a cell to its left that runs from west to east or back through a place."""
    for h in range(plan.counts[1]):
        (x0, y0), (x1, y1) = plan.xy[plan.graph[h, ORIGIN]], plan.xy[plan.graph[h ^ 1, ORIGIN]]
        if plan.graph[h, FACE] >= 0 and y0 == y == y1 and min(x0, x1) < x < max(x0, x1):
            return h
    raise AssertionError((x, y))


def united(plan: Subdivision, misfits: IntArray, labels: LabelArray, limits: Limits) -> int:
    """The number of faces that stay, of one cell each with a hundred points."""
    pairs, weights = cell_borders(plan, 0.01, np.empty((0, 4)))
    unite_faces(plan, misfits, np.full(len(labels), 100, np.int32), pairs, weights, labels, limits)
    return connected_faces(labels, pairs)[1]


def face_limits(face_cost: int, doubtful_cost: int, min_face_width_m: float = 0.0) -> Limits:
    usual = limits_at(0.3, ArrangementSettings())
    return usual._replace(face_cost=face_cost, doubtful_cost=doubtful_cost, min_face_width_m=min_face_width_m)


def test_a_face_that_explains_too_little_joins_its_neighbour_and_another_stays() -> None:
    costs = np.array([[0, 900], [90_000, 0]])
    labels = np.array([0, 1], np.int32)
    assert united(cut(5000), costs, labels, face_limits(500, 500)) == 2
    assert united(cut(5000), costs, labels, face_limits(1_000_000, 1_000_000)) == 1


@pytest.mark.parametrize(("own_misfit", "faces"), [(0, 2), (4_000, 2), (50_000, 1)])
def test_a_face_costs_the_more_the_more_of_its_own_points_misfit_it(own_misfit: int, faces: int) -> None:
    # beside a large face a hundred points, that save thirty; half of them or more would make the face cost sixty
    costs = np.array([[0, 200_000], [30_000 + own_misfit, own_misfit]])
    assert united(cut(5000), costs, np.array([0, 1], np.int32), face_limits(16_000, 60_000)) == faces


@pytest.mark.parametrize(("width_mm", "faces"), [(300, 1), (450, 1), (550, 2), (1500, 2)])
@pytest.mark.parametrize("at_border", [True, False])
def test_a_strip_narrower_than_a_roof_joins_a_neighbour_whatever_its_points_say(
    width_mm: int, faces: int, at_border: bool
) -> None:
    plan = cut(width_mm) if at_border else cut(4000, 4000 + width_mm)
    is_strip = cell_areas_m2(plan) < 20.0
    labels = is_strip.astype(np.int32)
    # of the hundred points of a strip at the border eleven misfit it, as on a wall that the beam smears
    misfits = np.where(is_strip[:, None] == np.array([False, True]), 11_000 * at_border, 90_000)
    assert united(plan, misfits, labels, face_limits(1000, 1000, 0.5)) == (faces if at_border or faces == 1 else 3)
    assert labels[np.argmax(cell_areas_m2(plan))] == 0


@pytest.mark.parametrize(("own_misfit", "beside", "faces"), [(0, 90_000, 2), (9_000, 90_000, 2), (0, 40_000, 1)])
def test_a_parapet_stays_however_narrow(own_misfit: int, beside: int, faces: int) -> None:
    """Its long side is on the outline, its points fit it, and the roof beside it does not explain half of them."""
    plan = cut(300)
    is_strip = cell_areas_m2(plan) < 20.0
    labels = is_strip.astype(np.int32)
    misfits = np.where(is_strip[:, None] == np.array([False, True]), own_misfit, beside)
    assert united(plan, misfits, labels, face_limits(1000, 1000, 0.5)) == faces
    assert united(plan, misfits, labels, face_limits(91_000, 91_000, 0.5)) == 1


@pytest.mark.parametrize(("held", "faces"), [(0, 1), (1, 2)])
def test_a_narrow_corner_without_a_point_joins_its_neighbour_however_short(held: int, faces: int) -> None:
    plan = cut(5000)
    corner = cell_at(plan, 4900.0, 100.0)
    for x, y in ((4600, 0), (5000, 400)):
        edge = edge_through(plan, x, y) if y == 0 else edge_up(plan, x)
        assert insert_vertex(plan, edge, x, y)
    last = int(plan.counts[0])
    assert insert_chord(plan, last - 2, last - 1, corner, -1) == 1
    is_small = cell_areas_m2(plan) < 1.0
    labels, held_by = is_small.astype(np.int32), np.where(is_small, held, 100).astype(np.int32)
    misfits = np.where(is_small[:, None] == np.array([False, True]), 0, 90_000)
    pairs, weights = cell_borders(plan, 0.01, np.empty((0, 4)))
    unite_faces(plan, misfits, held_by, pairs, weights, labels, face_limits(1000, 1000, 0.5))
    assert connected_faces(labels, pairs)[1] == faces


def edge_up(plan: Subdivision, x: int) -> int:
    """The half-edge with a cell to its left that runs north along an inner border at x."""
    for h in range(plan.counts[1]):
        (x0, y0), (x1, y1) = plan.xy[plan.graph[h, ORIGIN]], plan.xy[plan.graph[h ^ 1, ORIGIN]]
        if plan.graph[h, FACE] >= 0 and x0 == x == x1 and y0 < 400 < y1:
            return h
    raise AssertionError(x)


def test_a_strip_without_a_neighbour_stays() -> None:
    xy = np.array([(0, 0), (400, 0), (400, 9000), (0, 9000), (2000, 0), (8000, 0), (8000, 9000), (2000, 9000)])
    apart = subdivision_of(xy, np.array([0, 4, 8]), np.array([0, 1]), 400)
    assert united(apart, np.zeros((2, 2), np.int64), np.array([0, 1], np.int32), face_limits(1000, 1000, 0.5)) == 2


def loops(plan: Subdivision) -> list[list[int]]:
    """All loops of half-edges; every half-edge must lie in exactly one."""
    graph, n_edges = plan.graph, plan.counts[1]
    left = set(range(n_edges))
    found = []
    while left:
        start = min(left)
        loop = [start]
        left.discard(start)
        h = int(graph[start, NEXT])
        while h != start:
            assert graph[h, FACE] == graph[start, FACE]
            assert graph[graph[h, NEXT], PREVIOUS] == h
            assert graph[h ^ 1, ORIGIN] == graph[graph[h, NEXT], ORIGIN]
            left.remove(h)
            loop.append(h)
            h = int(graph[h, NEXT])
        found.append(loop)
    return found


def test_a_chord_between_corners_makes_two_cells() -> None:
    plan = square()
    assert insert_chord(plan, 0, 2, 0, 7) == 1
    assert plan.counts.tolist() == [4, 10, 2]
    assert cell_areas_m2(plan).tolist() == [50.0, 50.0]
    assert len(loops(plan)) == 3
    assert {cell_at(plan, 9000.0, 1000.0), cell_at(plan, 1000.0, 9000.0)} == {0, 1}
    assert cell_at(plan, -5.0, 5000.0) == -1


def test_a_chord_without_room_for_its_edge_is_not_drawn() -> None:
    plan = square()
    full = plan._replace(graph=plan.graph[: plan.counts[EDGES] + 1].copy())
    assert insert_chord(full, 0, 2, 0, 7) == -1
    assert full.counts.tolist() == [4, 8, 1]


def test_a_chord_to_a_hole_makes_one_loop_of_two_and_the_next_parts_the_cell() -> None:
    plan = square(holes=1)
    assert insert_chord(plan, 0, 4, 0, 0) == 0
    assert insert_chord(plan, 6, 2, 0, 0) == 1
    assert sorted(cell_areas_m2(plan).tolist()) == [49.5, 49.5]
    loops(plan)


def test_a_hole_stays_in_the_cell_that_it_lies_in() -> None:
    plan = square(holes=1)
    assert insert_vertex(plan, 0, 6000, 0)
    assert insert_vertex(plan, 4, 6000, 10_000)
    assert insert_chord(plan, 8, 9, 0, 0) == 1
    assert sorted(cell_areas_m2(plan).tolist()) == [40.0, 59.0]
    loops(plan)


def test_a_chord_through_a_hole_is_not_drawn_and_a_vertex_close_to_another_edge_not_inserted() -> None:
    plan = square(holes=2)
    assert insert_chord(plan, 0, 2, 0, 0) == -1
    assert plan.counts.tolist() == [12, 24, 1]
    plan = square()
    assert not insert_vertex(plan, 0, 4, 0)
    assert insert_vertex(plan, 0, 40, 0)
    assert plan.counts.tolist() == [5, 10, 1]


@pytest.mark.parametrize("seed", range(30))
def test_any_lines_leave_a_planar_graph_that_fills_the_outline(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plan = square(holes=seed % 3)
    area = cell_areas_m2(plan)[0]
    n = 12
    angles = np.round(rng.uniform(0.0, np.pi, n) * (4 if seed % 2 else 1000)) / (4 if seed % 2 else 1000)
    through = rng.uniform(1.0, 9.0, (n, 2))
    lines = np.column_stack((-np.sin(angles), np.cos(angles), np.zeros(n)))
    lines[:, 2] = -(lines[:, :2] * through).sum(axis=1)
    scores, numbers = rng.uniform(0.0, 1.0, n), np.arange(n).astype(np.int32)
    subdivide(plan, CandidateLines(lines, scores, np.zeros(n, np.int32), through, numbers), 1.0, 1.0)
    xy, graph = plan.xy, plan.graph
    n_vertices, n_edges, n_cells = plan.counts.tolist()
    assert n_cells > 4
    rings = loops(plan)
    component = list(range(n_vertices))
    for h in range(0, n_edges, 2):
        a, b = component[graph[h, ORIGIN]], component[graph[h ^ 1, ORIGIN]]
        component = [a if one == b else one for one in component]
    # Euler, with a loop for every border of a cell: vertices - edges + loops = 2 components
    assert n_vertices - n_edges // 2 + len(rings) == 2 * len(set(component))
    areas = cell_areas_m2(plan)
    assert (areas > 0.0).all()
    assert areas.sum() == pytest.approx(area, abs=0.02)
    edges = shapely.linestrings([(xy[graph[h, ORIGIN]], xy[graph[h ^ 1, ORIGIN]]) for h in range(0, n_edges, 2)])
    tree = shapely.STRtree(edges)
    for a, b in tree.query(edges, predicate="intersects").T.tolist():
        if a < b:
            common = set(graph[[2 * a, 2 * a + 1], ORIGIN].tolist()) & set(graph[[2 * b, 2 * b + 1], ORIGIN].tolist())
            meeting = shapely.intersection(edges[a], edges[b])
            assert len(common) == 1
            assert shapely.get_coordinates(meeting).tolist() == [xy[common.pop()].tolist()]
    places = np.column_stack((rng.uniform(0.2, 9.8, (200, 2)), np.zeros(200)))
    cells = cells_of_points(plan, places)
    assert cells.tolist() == [cell_at(plan, x * 1e3, y * 1e3) for x, y, _ in places.tolist()]
