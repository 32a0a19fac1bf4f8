"""Single linkage on the grid against scipy's, the paper's rules about the distance, and the cost on dense roofs."""

import numpy as np
import pytest
from candidates_by_hand import same_partition
from scipy.cluster.hierarchy import fcluster, linkage

from pipeline.errors import BuildingError, SettingsError
from pipeline.extras.papers.clustering_settings import SingleLinkageSettings
from pipeline.extras.papers.single_linkage import cluster_by_linkage, link
from pipeline.model import FloatArray, Reason


def scattered(seed: int, n: int, low: float = 0.0, high: float = 360.0) -> tuple[FloatArray, FloatArray]:
    random = np.random.default_rng(seed)
    return random.uniform(0, 90, n), random.uniform(low, high, n)


@pytest.mark.parametrize("distance", [1.0, 2.5, 4.0, 6.3, 10.0])
@pytest.mark.parametrize("n", [2, 40, 300, 900])
def test_the_clusters_are_those_of_scipy_away_from_north(n: int, distance: float) -> None:
    slope, orientation = scattered(n, n, 40.0, 320.0)
    ours, _ = link(slope, orientation, distance)
    theirs = fcluster(linkage(np.column_stack([slope, orientation]), "single"), distance, "distance")
    assert same_partition(ours, theirs)


@pytest.mark.parametrize("distance", [2.0, 4.0, 10.0])
def test_orientation_wraps_at_north_as_if_the_circle_were_cut_elsewhere(distance: float) -> None:
    slope, orientation = scattered(1, 200, 40.0, 320.0)
    cut_elsewhere, _ = link(slope, orientation, distance)
    for turn in (50.0, 123.4, 200.0, 359.0):
        assert same_partition(cut_elsewhere, link(slope, (orientation + turn) % 360.0, distance)[0])


def test_pairs_at_exactly_the_distance_are_linked_and_a_hair_further_not() -> None:
    slope = np.array([30.0, 30.0, 30.0])
    assert link(slope, np.array([357.0, 1.0, 5.5]), 4.0)[0].tolist() == [0, 0, 1]


def test_clusters_are_numbered_by_their_first_facet_whatever_the_order() -> None:
    slope, orientation = scattered(3, 150)
    labels, _ = link(slope, orientation, 5.0)
    first = [labels.tolist().index(k) for k in range(labels.max() + 1)]
    assert first == sorted(first)
    order = np.random.default_rng(0).permutation(150)
    assert same_partition(labels[order], link(slope[order], orientation[order], 5.0)[0])


def blob(slope: float, orientation: float, n: int, seed: int) -> tuple[FloatArray, FloatArray]:
    random = np.random.default_rng(seed)
    return random.normal(slope, 1.0, n), random.normal(orientation, 1.5, n) % 360.0


def test_two_roof_faces_are_two_clusters_and_strays_none() -> None:
    (a, b), (c, d) = blob(30, 90, 60, 1), blob(30, 270, 60, 2)
    strays = np.array([70.0, 65, 80]), np.array([10.0, 180, 350])
    found = cluster_by_linkage(
        np.concatenate([a, c, strays[0]]), np.concatenate([b, d, strays[1]]), SingleLinkageSettings(min_members=11)
    )
    assert found.distance_deg == 10.0
    assert found.labels.tolist() == [0] * 60 + [1] * 60 + [-1] * 3


def test_while_a_cluster_holds_most_facets_the_distance_shrinks_to_the_least() -> None:
    (a, b), (c, d) = blob(30, 90, 60, 1), blob(30, 104, 60, 2)
    slopes, orientations = np.concatenate([a, c]), np.concatenate([b, d])
    assert link(slopes, orientations, 10.0)[0].max() == 0
    found = cluster_by_linkage(slopes, orientations, SingleLinkageSettings(min_members=11))
    assert 4.0 <= found.distance_deg < 10.0
    assert set(found.labels.tolist()) - {-1} == {0, 1}
    single = cluster_by_linkage(a, b, SingleLinkageSettings(min_members=11))
    assert single.distance_deg == 4.0
    assert set(single.labels.tolist()) - {-1} == {0}


@pytest.mark.parametrize("members", [10, 11])
def test_a_cluster_needs_its_fewest_members(members: int) -> None:
    (a, b), (c, d) = blob(30, 90, members, 1), blob(50, 270, 100, 2)
    settings = SingleLinkageSettings(min_members=11, largest_cluster_share=1.0)
    labels = cluster_by_linkage(np.concatenate([a, c]), np.concatenate([b, d]), settings).labels
    assert (labels[:members] >= 0).all() == (members == 11)
    assert (labels[members:] >= 0).all()


def test_100_000_facets_of_a_dense_roof_take_no_quadratic_work() -> None:
    random = np.random.default_rng(0)
    slope = np.abs(random.normal(30, 8, 100_000)) % 90
    orientation = (random.choice([90.0, 270.0], 100_000) + random.normal(0, 20, 100_000)) % 360
    _, work = link(slope, orientation, 4.0)
    assert work < 300 * 100_000


def test_beyond_the_limit_of_work_a_building_is_too_complex() -> None:
    slope, orientation = scattered(2, 500)
    with pytest.raises(BuildingError, match="linkage_work_limit is 10") as caught:
        cluster_by_linkage(slope, orientation, SingleLinkageSettings(linkage_work_limit=10))
    assert caught.value.reason is Reason.TOO_COMPLEX


@pytest.mark.parametrize("steeper_deg", [10.01, 13.0])
def test_two_dense_directions_that_do_not_link_end_at_the_limit_and_not_after_all_their_pairs(
    steeper_deg: float,
) -> None:
    slope = np.repeat([30.0, 30.0 + steeper_deg], 3000)
    settings = SingleLinkageSettings(linkage_work_limit=1000)
    with pytest.raises(BuildingError, match=r"stood at \d{4} comparisons for 6000 facets"):
        cluster_by_linkage(slope, np.full(6000, 90.0), settings)


def test_a_least_distance_above_the_first_is_refused() -> None:
    with pytest.raises(SettingsError, match="use at most linkage_start_deg, 10"):
        SingleLinkageSettings(min_linkage_deg=12.0)
