"""The octree of points: every point in one node, even samples, the same nodes in any order."""

import itertools

import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.extras.octree import point_octree
from pipeline.extras.octree.point_octree import CELL_BITS, Cube, Octree, octree_of

pytestmark = pytest.mark.slow

CUBE = Cube(corner_mm=(-3_000, 5_000, 0), side_mm=250_000)


def scene(n: int, side_mm: int = 250_000) -> np.ndarray:
    """Points of a street: a rough ground, and a few roofs above it."""
    rng = np.random.default_rng(1)
    xy = rng.integers(0, side_mm, (n, 2))
    z = rng.integers(0, 300, n) + np.where((xy // 20_000).sum(axis=1) % 3 == 0, 7_000, 0)
    return np.column_stack((xy, z)) + np.array(CUBE.corner_mm)


def no_ties(n: int) -> np.ndarray:
    return np.zeros(n, np.int64)


def all_points(tree: Octree) -> list[int]:
    return sorted(np.concatenate([no_ties(0), *(node.index for node in tree.nodes), *tree.above]).tolist())


def twin(
    xyz: np.ndarray, cube: Cube, above: int, capacity: int, few: int
) -> tuple[dict[str, set[int]], list[set[int]]]:
    """The rule of the octree, point by point."""
    bits = point_octree._BITS
    places = [
        tuple(
            ((int(value) - corner) << bits) // cube.side_mm for value, corner in zip(point, cube.corner_mm, strict=True)
        )
        for point in xyz
    ]
    left = set(range(len(xyz)))

    def code(i: int) -> int:
        return sum(((places[i][axis] >> b) & 1) << (3 * b + axis) for b in range(bits) for axis in range(3))

    def sample(of: set[int], cell_bits: int) -> set[int]:
        shift = bits - cell_bits
        middle = (1 << shift) >> 1
        best: dict[tuple[int, ...], tuple[int, int, int]] = {}
        for i in of:
            cell = tuple(place >> shift for place in places[i])
            away = sum((place % (1 << shift) - middle) ** 2 for place in places[i])
            best[cell] = min(best.get(cell, (away, code(i), i)), (away, code(i), i))
        return {i for *_, i in best.values()}

    shares = []
    for k in range(above, 0, -1):
        shares.append(sample(left, CELL_BITS - k))
        left -= shares[-1]
    nodes: dict[str, set[int]] = {}

    def divide(path: str, own: set[int]) -> None:
        level = len(path) - 1
        if not own:
            return
        if len(own) <= capacity:
            nodes[path] = own
            return
        nodes[path] = sample(own, level + CELL_BITS)
        groups: dict[int, set[int]] = {}
        for i in own - nodes[path]:
            groups.setdefault(code(i) >> (3 * (bits - level - 1)) & 7, set()).add(i)
        for octant, members in groups.items():
            if len(members) < few:
                nodes[path] |= members
            else:
                divide(f"{path}{octant}", members)

    divide("r", left)
    return nodes, shares[::-1]


@pytest.mark.parametrize("above", [0, 2])
def test_the_nodes_are_those_of_a_slow_twin(above: int) -> None:
    rng = np.random.default_rng(5)
    clumps = np.repeat(scene(8), 400, axis=0) + rng.integers(-900, 900, (3_200, 3))
    low, high = np.array(CUBE.corner_mm), np.array(CUBE.corner_mm) + CUBE.side_mm - 1
    xyz = np.unique(np.clip(np.vstack((clumps, scene(2_000))), low, high), axis=0)
    tree = octree_of(xyz, no_ties(len(xyz)), CUBE, above, capacity=100)
    nodes, shares = twin(xyz, CUBE, above, 100, 100)
    assert {node.path: set(node.index.tolist()) for node in tree.nodes} == nodes
    assert [set(index.tolist()) for index in tree.above] == shares
    assert len(nodes) > 20


@given(st.integers(0, 2**32 - 1), st.integers(0, 300), st.integers(0, CELL_BITS), st.integers(1, 50))
@settings(max_examples=examples(60), deadline=None)
def test_every_point_is_in_exactly_one_node(seed: int, n: int, above: int, capacity: int) -> None:
    rng = np.random.default_rng(seed)
    side = int(rng.choice([3, 40, 1_000, 250_000]))  # in the smallest cube most points share a place
    cube = Cube(corner_mm=(7, -9, 0), side_mm=side)
    xyz = rng.integers(0, side, (n, 3)) + np.array(cube.corner_mm)
    tree = octree_of(xyz, rng.integers(0, 3, n), cube, above, capacity)
    assert all_points(tree) == list(range(n))
    assert all(len(node.index) for node in tree.nodes)
    paths = [node.path for node in tree.nodes]
    assert all(node.parent in paths[:number] for number, node in enumerate(tree.nodes) if node.parent)
    assert len(set(paths)) == len(paths)


def test_the_nodes_do_not_depend_on_the_order_of_the_points() -> None:
    xyz = np.repeat(scene(3_000, 40_000), 2, axis=0)  # each place twice, with different attributes
    ties = np.tile([4, 9], len(xyz) // 2)
    order = np.random.default_rng(3).permutation(len(xyz))

    def content(points: np.ndarray, carried: np.ndarray) -> list[tuple[str, bytes, bytes]]:
        tree = octree_of(points, carried, CUBE, 1, capacity=400)
        return [(node.path, points[node.index].tobytes(), carried[node.index].tobytes()) for node in tree.nodes]

    assert content(xyz, ties) == content(xyz[order], ties[order])


def test_boxes_hold_the_points_of_a_node_and_of_all_below_it() -> None:
    xyz = scene(20_000, 90_000)
    nodes = {node.path: node for node in octree_of(xyz, no_ties(len(xyz)), CUBE, capacity=1_000).nodes}
    for node in nodes.values():
        assert (xyz[node.index] >= node.low_mm).all()
        assert (xyz[node.index] <= node.high_mm).all()
        if node.parent:
            assert (node.low_mm >= nodes[node.parent].low_mm).all()
            assert (node.high_mm <= nodes[node.parent].high_mm).all()
            assert node.spacing_m < nodes[node.parent].spacing_m
    leaves = nodes.keys() - {node.parent for node in nodes.values()}
    assert {nodes[path].spacing_m for path in leaves} == {0.0}


def test_each_level_is_an_even_sample_of_the_whole_scene() -> None:
    xyz = scene(300_000)
    tree = octree_of(xyz, no_ties(len(xyz)), CUBE, above=2)
    cell_mm = CUBE.side_mm / 2**CELL_BITS
    for sample, side_mm in ((tree.nodes[0].index, cell_mm), (tree.above[0], 2 * cell_mm), (tree.above[1], 4 * cell_mm)):
        columns, counts = np.unique(((xyz - CUBE.corner_mm) / side_mm).astype(int)[sample], axis=0, return_counts=True)
        assert counts.max() == 1
        # nearly all cells that hold points are sampled; finer samples lose those whose only points lie above them
        held = len(np.unique(((xyz - CUBE.corner_mm) / side_mm).astype(int), axis=0))
        assert len(columns) > 0.9 * held


def test_nodes_have_a_size_that_suits_a_request() -> None:
    xyz = scene(600_000)
    sizes = [len(node.index) for node in octree_of(xyz, no_ties(len(xyz)), CUBE).nodes]
    assert max(sizes) <= point_octree.CAPACITY + 8 * point_octree.FEW
    assert np.median(sizes) > 10_000


def test_more_levels_above_than_a_cell_has_bits_are_refused() -> None:
    with pytest.raises(ValueError, match="above is 8: use 0 to 7"):
        octree_of(scene(3), no_ties(3), CUBE, above=8)


def test_octants_are_numbered_by_east_north_and_up() -> None:
    side = 1 << 21
    cube = Cube(corner_mm=(0, 0, 0), side_mm=side)
    corners = np.array(list(itertools.product((0, side - 1), repeat=3)))
    xyz = np.repeat(corners, 3, axis=0)
    xyz[1::3, 0] ^= 1
    xyz[2::3, 1] ^= 1
    tree = octree_of(xyz, no_ties(len(xyz)), cube, capacity=2)
    below = {node.path: xyz[node.index] // (side // 2) for node in tree.nodes if len(node.path) == 2}
    assert len(below) == 8
    for path, halves in below.items():
        assert {tuple(half) for half in halves.tolist()} == {tuple(int(path[1]) >> axis & 1 for axis in range(3))}
