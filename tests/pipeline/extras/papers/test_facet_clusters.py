"""Connected parts of clusters against scipy, points of facets and samples beside a roof against plain loops."""

import numpy as np
import pytest
from candidates_by_hand import same_partition
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, cKDTree

from pipeline.extras.papers.facet_clusters import connected_parts, labels_of_points
from pipeline.extras.papers.surrounding_ground import far_from


@pytest.mark.parametrize("seed", range(4))
def test_connected_parts_are_those_of_a_graph_library(seed: int) -> None:
    random = np.random.default_rng(seed)
    mesh = Delaunay(random.uniform(0, 10, (120, 2)))
    labels = random.integers(-1, 3, len(mesh.simplices)).astype(np.int32)
    neighbours = mesh.neighbors.astype(np.int32)
    a = np.repeat(np.arange(len(labels)), 3)
    b = neighbours.ravel()
    linked = (b >= 0) & (labels[a] >= 0) & (labels[a] == labels[b])
    graph = coo_matrix((np.ones(linked.sum()), (a[linked], b[linked])), shape=(len(labels),) * 2)
    _, expected = connected_components(graph, directed=False)
    parts = connected_parts(labels, neighbours)
    assert ((parts < 0) == (labels < 0)).all()
    inside = labels >= 0
    assert same_partition(parts[inside], expected[inside])
    assert list(dict.fromkeys(parts[inside].tolist())) == list(range(parts.max() + 1))


def test_a_point_takes_the_facet_that_absorbed_it_or_the_largest_at_its_vertex() -> None:
    facets = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]], np.int32)
    labels = labels_of_points(
        facets,
        np.array([5, 6, -1], np.int32),
        np.array([1.0, 2.0, 9.0]),
        np.array([0, 1, 2, -1, 3], np.int32),
        np.array([-1, -1, -1, -1, 1, 2], np.int32),
    )
    # Vertex 4 touches the unlabelled facet alone; the points 4 and 5 lie in the second and third facet.
    assert labels.tolist() == [6, 5, 6, -1, 6, -1]


def test_of_equal_facets_the_first_gives_the_label() -> None:
    facets = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    point = np.array([0, 1, 2, 3], np.int32)
    labels = labels_of_points(facets, np.array([7, 8], np.int32), np.ones(2), point, np.full(4, -1, np.int32))
    assert labels.tolist() == [7, 7, 7, 8]


@pytest.mark.parametrize("distance_m", [0.3, 1.0, 4.0])
def test_samples_are_far_where_a_tree_of_points_says_so(distance_m: float) -> None:
    random = np.random.default_rng(2)
    points = random.uniform(-20, 20, (300, 3))
    samples = random.uniform(-30, 30, (500, 3))
    nearest, _ = cKDTree(points[:, :2]).query(samples[:, :2])
    assert far_from(samples, points, distance_m).tolist() == (nearest > distance_m).tolist()


def test_a_sample_at_the_distance_is_near() -> None:
    assert far_from(np.array([[3.0, 4, 0], [3.0, 4.001, 0]]), np.zeros((1, 3)), 5.0).tolist() == [False, True]
