"""K-means of facet normals: against scikit-learn, against a plain twin, and what must not change the outcome."""

import itertools
import math

import numpy as np
import pytest
from candidates_by_hand import same_partition
from sklearn.cluster import KMeans
from sklearn.metrics import silhouette_score

from pipeline.errors import BuildingError
from pipeline.extras.papers.clustering_settings import NormalClusteringSettings
from pipeline.extras.papers.facet_smoothing import passes_for_noise, smoothed_normals
from pipeline.extras.papers.kmeans_normals import (
    choose_clusters,
    cluster_normals,
    farthest_point_start,
    kmeans,
    labels_around,
    silhouette,
)
from pipeline.model import FloatArray, LabelArray, Reason
from pipeline.tin.delaunay import triangulate

SETTINGS = NormalClusteringSettings()


def unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1)[:, None])


def directions(
    slopes_and_aspects: list[tuple[float, float]], count: int, spread: float, seed: int
) -> tuple[FloatArray, LabelArray]:
    """Unit normals around some directions, shuffled, and which of them each belongs to."""
    random = np.random.default_rng(seed)
    slope, aspect = np.radians(np.array(slopes_and_aspects)).T
    centres = np.column_stack([np.sin(slope) * np.sin(aspect), np.sin(slope) * np.cos(aspect), np.cos(slope)])
    truth = random.permutation(np.repeat(np.arange(len(centres), dtype=np.int32), count))
    return unit(centres[truth] + random.normal(0, spread, (len(truth), 3))), truth


def plain_kmeans(normals: FloatArray, weights: FloatArray, start: FloatArray) -> tuple[LabelArray, float]:
    """The same in a few lines of numpy."""
    centres, labels = start.copy(), np.full(len(normals), -1)
    while True:
        cosines = normals @ centres.T
        again = cosines.argmax(axis=1)
        if (again == labels).all():
            return labels, float((weights * (1 - cosines.max(axis=1))).sum())
        labels = again
        for k in range(len(centres)):
            if (labels == k).any():
                mean = (weights[:, None] * normals)[labels == k].sum(axis=0)
                centres[k] = mean / np.linalg.norm(mean)


FOUR = [(35.0, 0.0), (35.0, 90.0), (30.0, 180.0), (40.0, 270.0)]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("k", [2, 3, 4])
def test_clusters_that_are_distinct_are_those_of_scikit_learn_from_the_same_start(seed: int, k: int) -> None:
    normals, truth = directions(FOUR[:k], 200, 0.08, seed)
    ones = np.ones(len(normals))
    start = farthest_point_start(normals, ones, k)
    labels, _, inertia, _ = kmeans(normals, ones, start, 100)
    reference = KMeans(k, init=start, n_init=1, max_iter=100).fit(normals)
    assert same_partition(labels, reference.labels_)
    assert same_partition(labels, truth)
    # sum |n - mean|^2 = sum (1 - |mean|^2) and sum (1 - cosine) = sum (1 - |mean|), with the mean of each cluster
    lengths = np.array([np.linalg.norm(normals[labels == j].mean(axis=0)) for j in range(k)])
    counts = np.bincount(labels)
    assert reference.inertia_ == pytest.approx((counts * (1 - lengths**2)).sum())
    assert inertia == pytest.approx((counts * (1 - lengths)).sum())


@pytest.mark.parametrize("seed", range(5))
def test_where_clusters_overlap_the_inertia_is_no_worse_than_scikit_learns_best_of_twenty(seed: int) -> None:
    normals, _ = directions([(20.0, 0.0), (20.0, 180.0), (5.0, 90.0)], 150, 0.15, seed)
    ones = np.ones(len(normals))
    found = cluster_normals(normals, ones, 3, SETTINGS)
    reference = KMeans(3, n_init=20, random_state=seed).fit(normals)
    centres = unit(np.array([normals[reference.labels_ == j].sum(axis=0) for j in range(3)]))
    assert found.inertia <= 1.01 * (1.0 - (normals @ centres.T).max(axis=1)).sum()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("k", [2, 3, 5])
def test_the_silhouette_is_that_of_scikit_learn_with_the_cosine(seed: int, k: int) -> None:
    normals, _ = directions(FOUR, 40, 0.3, seed)
    ones = np.ones(len(normals))
    labels = cluster_normals(normals, ones, k, SETTINGS).labels
    with_one_alone = np.append(labels[:-1], np.int32(k))  # a cluster of one facet counts nothing
    for partition in (labels, with_one_alone):
        expected = silhouette_score(normals, partition, metric="cosine")
        assert silhouette(normals, ones, partition, int(partition.max()) + 1) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_the_kernel_does_what_its_plain_twin_does(seed: int) -> None:
    random = np.random.default_rng(seed)
    normals = unit(random.normal(0, 1, (300, 3)) + np.array([0, 0, 1.5]))
    weights = random.uniform(0.1, 5, 300)
    start = farthest_point_start(normals, weights, 4)
    labels, centres, inertia, _ = kmeans(normals, weights, start, 1000)
    expected, sum_of_distances = plain_kmeans(normals, weights, start)
    assert (labels == expected).all()
    assert inertia == pytest.approx(sum_of_distances)
    assert np.linalg.norm(centres, axis=1) == pytest.approx(1.0)


def test_every_further_round_lowers_the_inertia() -> None:
    normals = unit(np.random.default_rng(3).normal(0, 1, (400, 3)) + np.array([0, 0, 2]))
    ones = np.ones(400)
    start = farthest_point_start(normals, ones, 5)
    inertias = [kmeans(normals, ones, start, rounds)[2] for rounds in range(1, 12)]
    assert all(later <= earlier + 1e-9 for earlier, later in itertools.pairwise(inertias))
    assert inertias[-1] < inertias[0]


def test_the_order_of_the_facets_changes_only_the_order_of_the_labels() -> None:
    normals, _ = directions(FOUR, 60, 0.12, 8)
    weights = np.random.default_rng(8).uniform(0.5, 2, len(normals))
    order = np.random.default_rng(9).permutation(len(normals))
    here = cluster_normals(normals, weights, 4, SETTINGS)
    there = cluster_normals(normals[order], weights[order], 4, SETTINGS)
    assert same_partition(here.labels[order], there.labels)
    assert here.inertia == pytest.approx(there.inertia)


def test_turned_normals_give_turned_centres() -> None:
    normals, _ = directions(FOUR[:3], 60, 0.1, 5)
    ones = np.ones(len(normals))
    cos, sin = math.cos(1.1), math.sin(1.1)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
    here, there = (cluster_normals(n, ones, 3, SETTINGS) for n in (normals, normals @ turn.T))
    assert (here.labels == there.labels).all()
    assert here.centres @ turn.T == pytest.approx(there.centres, abs=1e-9)


def test_equal_similarities_go_to_the_lower_cluster() -> None:
    start = np.array([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]])
    labels, _, _, _ = kmeans(np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8]]), np.ones(2), start, 1)
    assert labels.tolist() == [0, 0]


def test_one_odd_facet_does_not_take_a_cluster_of_its_own_from_two_planes() -> None:
    normals, truth = directions([(15.0, 0.0), (15.0, 180.0)], 100, 0.03, 2)
    odd = unit(np.array([[0.94, 0.0, 0.34]]))
    both, ones = np.concatenate([normals, odd]), np.ones(201)
    alone = cluster_normals(both, ones, 2, NormalClusteringSettings(starts=1))
    of_eight = cluster_normals(both, ones, 2, SETTINGS)
    assert same_partition(of_eight.labels[:200], truth)
    assert of_eight.inertia <= alone.inertia


def test_weights_count_a_facet_as_often_as_it_is_large() -> None:
    normals, _ = directions(FOUR[:2], 30, 0.2, 4)
    weights = np.random.default_rng(0).integers(1, 4, len(normals))
    start = farthest_point_start(normals, np.ones(len(normals)), 2)
    weighted = kmeans(normals, weights.astype(np.float64), start, 50)
    repeated = kmeans(np.repeat(normals, weights, axis=0), np.ones(weights.sum()), start, 50)
    assert (np.repeat(weighted[0], weights) == repeated[0]).all()
    assert weighted[1] == pytest.approx(repeated[1])
    assert weighted[2] == pytest.approx(repeated[2])


def test_no_more_clusters_are_found_than_there_are_different_normals() -> None:
    normals = np.repeat(unit(np.array([[0.3, 0, 1], [-0.3, 0, 1.0]])), 5, axis=0)
    found = cluster_normals(normals, np.ones(10), 4, SETTINGS)
    assert len(found.centres) == 2
    assert found.inertia == pytest.approx(0.0, abs=1e-12)
    assert math.isnan(cluster_normals(normals[:5], np.ones(5), 3, SETTINGS).silhouette)


@pytest.mark.parametrize("k", [2, 3, 4])
def test_the_number_of_directions_is_found(k: int) -> None:
    normals, truth = directions(FOUR[:k], 80, 0.05, k)

    def explained(labels: LabelArray) -> float:
        # as planes would: points of facets that share a cluster with another direction are off
        pure = [label for label in np.unique(labels) if len(set(truth[labels == label])) == 1]
        return float(np.isin(labels, pure).mean())

    found = choose_clusters(normals, np.ones(len(normals)), explained, SETTINGS)
    assert same_partition(found.labels, truth)


def test_one_plane_stays_one_cluster_although_noise_can_always_be_split_and_a_given_k_is_kept() -> None:
    normals, _ = directions([(2.0, 0.0)], 200, 0.1, 1)
    assert len(choose_clusters(normals, np.ones(200), lambda _: 0.98, SETTINGS).centres) == 1
    given = NormalClusteringSettings(clusters=2)
    assert len(choose_clusters(normals, np.ones(200), lambda _: 0.0, given).centres) == 2


def test_too_much_work_is_refused_with_its_figure() -> None:
    normals, _ = directions(FOUR, 50, 0.05, 1)
    with pytest.raises(
        BuildingError, match="200 facets with 4 centres was not done after start 1 of 8, kmeans_work_limit is 1000"
    ) as error:
        cluster_normals(normals, np.ones(200), 4, NormalClusteringSettings(kmeans_work_limit=1000))
    assert error.value.reason is Reason.TOO_COMPLEX


FAN = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [-1, 0.2, 0], [0, -1, 0.0]])
FAN_FACETS = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]], np.int32)


def test_a_point_takes_the_cluster_of_most_facets_around_it() -> None:
    # the angles around the middle are 63, 106, 101 and 90 degrees
    labels = labels_around(FAN, FAN_FACETS, np.array([7, 3, 7, -1], np.int32))
    assert labels[0] == 7
    labels = labels_around(FAN, FAN_FACETS, np.array([7, 3, -1, 7], np.int32))
    assert labels[0] == 7
    labels = labels_around(FAN, FAN_FACETS, np.array([7, 3, 3, 7], np.int32))
    assert labels.tolist() == [3, 7, 7, 3, 7]


@pytest.mark.parametrize("seed", range(3))
def test_clusters_of_points_agree_with_a_plain_sum_of_sines(seed: int) -> None:
    random = np.random.default_rng(seed)
    xyz = np.column_stack([random.permutation(900)[:120] // 30, random.permutation(900)[:120] % 30, np.zeros(120)])
    xyz = np.unique(np.vstack([xyz, [[14.5, 14.5, 0.0]]]), axis=0)
    facets = triangulate(np.rint(xyz[:, :2] * 1000).astype(np.int64)).facets
    labels = random.integers(-1, 5, len(facets)).astype(np.int32)
    expected = []
    for i in range(len(xyz)):
        sines: dict[int, float] = {}
        for t in np.flatnonzero((facets == i).any(axis=1) & (labels >= 0)):
            (ux, uy), (vx, vy) = (xyz[j, :2] - xyz[i, :2] for j in facets[t] if j != i)
            sine = abs(ux * vy - uy * vx) / math.hypot(ux, uy) / math.hypot(vx, vy)
            sines[int(labels[t])] = sines.get(int(labels[t]), 0.0) + sine
        expected.append(sines)
    for found, sines in zip(labels_around(xyz, facets, labels).tolist(), expected, strict=True):
        assert sines.get(found, 0.0) == pytest.approx(max(sines.values(), default=0.0))
        assert (found == -1) == (not sines)


def test_a_point_without_a_labelled_facet_has_no_cluster() -> None:
    labels = labels_around(np.vstack([FAN, [[5, 5, 5.0]]]), FAN_FACETS, np.array([0, -1, -1, -1], np.int32))
    assert labels.tolist() == [0, 0, 0, -1, -1, -1]


def test_passes_follow_the_noise() -> None:
    assert passes_for_noise(0.0, 1.0, 6.0, 6) == 0
    assert passes_for_noise(0.05, 1.2, 6.0, 6) == 0
    assert passes_for_noise(0.05, 0.3, 6.0, 6) == 2
    assert passes_for_noise(0.2, 0.2, 6.0, 6) == 6
    assert passes_for_noise(math.nan, 0.2, 6.0, 6) == 0


def test_smoothing_leaves_normals_of_one_plane_alone_and_does_not_cross_facets_that_take_no_part() -> None:
    first, second = unit(np.array([[0.2, 0.1, 1.0], [-0.6, 0.0, 1.0]]))
    normals = np.array([first, first, [1.0, 0.0, 0.0], second])
    chain = np.array([[1, -1, -1], [0, 2, -1], [1, 3, -1], [2, -1, -1]], np.int32)
    usable = np.array([True, True, False, True])
    smooth = smoothed_normals(normals, np.array([1.0, 3.0, 50.0, 2.0]), chain, usable, 4)
    assert smooth == pytest.approx(normals)


def test_a_smoothed_normal_is_that_of_the_patch_by_its_area_vector() -> None:
    normals = unit(np.array([[0.5, 0.0, 1.0], [-0.2, 0.3, 1.0]]))
    areas = np.array([2.0, 1.0])
    pair = np.array([[1, -1, -1], [0, -1, -1]], np.int32)
    smooth = smoothed_normals(normals, areas, pair, np.ones(2, np.bool_), 1)
    together = unit((normals * areas[:, None]).sum(axis=0)[None])[0]
    assert smooth == pytest.approx(np.array([together, together]))


def test_a_sliver_along_the_hull_has_no_say() -> None:
    xyz = np.array([[0, 0, 0], [5, 0.001, 0], [10, 0, 0], [5, 4, 0.0]])
    facets = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3]], np.int32)
    assert labels_around(xyz, facets, np.array([9, 4, 4], np.int32)).tolist() == [4, 4, 4, 4]
