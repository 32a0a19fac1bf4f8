"""Lines of a tile cut at their crossings: nodes 2 mm apart, the same for neighbours."""

import itertools

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.extras.terrain_tin.noding import APART_MM, Lines, noded
from pipeline.model import IntArray

SIDE, BEYOND = 100, 50
Ring = list[tuple[int, int]]
NO_DATA_EDGES = shapely.linestrings(np.empty((0, 2, 2)))


def rings_of(*rings: Ring) -> Lines:
    return np.array([shapely.linearrings(ring) for ring in rings], dtype=object)


def distances(nodes: IntArray) -> list[float]:
    return [float(np.hypot(*(a - b))) for a, b in itertools.combinations(nodes, 2)]


def moved(ring: Ring, shift: tuple[int, int]) -> Ring:
    return [(x - shift[0], y - shift[1]) for x, y in ring]


PLACES = st.one_of(st.integers(SIDE - 4, SIDE + 4), st.integers(-20, 2 * SIDE + 20))
TRIANGLES = st.lists(st.tuples(PLACES, PLACES), min_size=3, max_size=3, unique=True).filter(
    lambda ring: shapely.Polygon(ring).area > 20
)


@settings(max_examples=examples(100), deadline=None)
@given(st.lists(TRIANGLES, min_size=1, max_size=4))
def test_nodes_are_apart_and_edges_meet_at_nodes_only(rings: list[Ring]) -> None:
    found = noded(SIDE, BEYOND, NO_DATA_EDGES, rings_of(*rings))
    assert min(distances(found.nodes)) >= APART_MM
    edges = shapely.linestrings(found.nodes[found.edges].astype(np.float64))
    for (a, first), (b, second) in itertools.combinations(zip(found.edges.tolist(), edges, strict=True), 2):
        common = [shapely.Point(found.nodes[node]) for node in set(a) & set(b)]
        assert len(common) < 2
        assert shapely.intersection(first, second).equals(shapely.union_all(common))


@settings(max_examples=examples(100), deadline=None)
@given(st.lists(TRIANGLES, min_size=1, max_size=4))
def test_neighbours_have_the_same_nodes_on_their_border(rings: list[Ring]) -> None:
    tiles = [
        noded(SIDE, BEYOND, NO_DATA_EDGES, rings_of(*(moved(ring, (SIDE * i, 0)) for ring in rings))) for i in (0, 1)
    ]
    left, right = (tile.nodes[tile.nodes[:, 0] == at, 1] for tile, at in zip(tiles, (SIDE, 0), strict=True))
    assert left.tolist() == right.tolist()


@pytest.mark.parametrize(
    ("ring", "expected"),
    [
        ([(20, 20), (60, 20), (60, 60), (20, 60)], (20, 20)),
        ([(1, 20), (60, 20), (60, 60), (1, 60)], (1, 20)),
        ([(21, 30), (60, 0), (20, 0), (20, 30)], (20, 30)),
        ([(1, 1), (-30, 50), (50, -30)], (0, 0)),
        ([(20, 1), (0, -30), (60, -30)], (19, 0)),
        ([(31, 41), (60, 41), (60, 60), (31, 60)], (30, 40)),
    ],
    ids=["far from all", "beside the border", "the smaller one", "at a corner", "over the border", "at a data edge"],
)
def test_the_corner_of_the_tile_stays_then_the_border_then_data_edges(ring: Ring, expected: tuple[int, int]) -> None:
    data_edges = shapely.linestrings([[(30, 40), (30, 20)], [(30, 40), (10, 40)]])
    found = noded(SIDE, BEYOND, data_edges, rings_of(ring))
    assert tuple(found.nodes[np.hypot(*(found.nodes - ring[0]).T).argmin()].tolist()) == expected
    assert min(distances(found.nodes)) >= APART_MM
    assert expected in {tuple(place) for place in shapely.get_coordinates(found.outlines).tolist()}


def test_outlines_without_close_nodes_stay_as_they_are() -> None:
    rings = rings_of([(20, 20), (60, 21), (59, 61)], [(60, 21), (90, 30), (59, 61)], [(-20, 70), (30, 75), (-20, 80)])
    assert shapely.equals_exact(noded(SIDE, BEYOND, NO_DATA_EDGES, rings).outlines, rings).all()


def test_tiles_around_a_corner_agree_on_an_outline_beside_it() -> None:
    ring = [(90, 67), (110, 127), (150, 67)]  # crosses the border a millimetre beside the corner
    for shift in itertools.product((0, SIDE), repeat=2):
        found = noded(SIDE, BEYOND, NO_DATA_EDGES, rings_of(moved(ring, shift)))
        assert (SIDE - shift[0], SIDE - shift[1]) in {
            tuple(place) for place in shapely.get_coordinates(found.outlines).tolist()
        }


def test_a_corner_of_an_outline_stays_rather_than_a_crossing() -> None:
    over_a_wall: Ring = [(50, 50), (40, 10), (60, 10)]
    found = noded(SIDE, BEYOND, NO_DATA_EDGES, rings_of(over_a_wall, [(5, 49), (90, 49), (90, 80), (5, 80)]))
    near = found.nodes[np.hypot(*(found.nodes - (50, 50)).T) < 4]
    assert near.tolist() == [[50, 50]]
