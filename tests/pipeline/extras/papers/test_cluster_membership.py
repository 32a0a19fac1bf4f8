"""Weights, centres, membership and the eliminations of the clusters in three dimensions."""

import dataclasses
import math

import numpy as np
import pytest

from pipeline.errors import BuildingError
from pipeline.extras.papers.cluster_membership import may_be_roof, refine_clusters, spreads
from pipeline.extras.papers.clustering_settings import ClusterMembershipSettings
from pipeline.extras.papers.facet_parameters import about_barycentre, facet_parameters
from pipeline.model import FloatArray, Reason
from pipeline.tin.delaunay import triangulate

PAPER = ClusterMembershipSettings(min_members=11)


def face(slope: float, orientation: float, distance: float, n: int, seed: int) -> FloatArray:
    random = np.random.default_rng(seed)
    noise = random.normal(0, [2.5, 5.0, 0.2], (n, 3))
    found = np.array([slope, orientation, distance]) + noise
    found[:, 1] %= 360
    return found


@pytest.mark.parametrize("slope_deg", [15.0, 30.0, 45.0])
def test_the_spreads_are_what_noise_does_to_equilateral_facets(slope_deg: float) -> None:
    """Against simulated facets of 1.2 m with 2 cm of noise."""
    random = np.random.default_rng(0)
    side, sigma = 1.2, 0.02
    turn = random.uniform(0, 2 * np.pi, 20_000)
    corners = turn[:, None] + np.array([0, 2, 4]) * np.pi / 3
    plan = side / math.sqrt(3) * np.stack([np.cos(corners), np.sin(corners)], axis=-1)
    z = plan[..., 1] * -math.tan(math.radians(slope_deg)) + random.normal(0, sigma, plan.shape[:2])
    points = np.concatenate([plan, z[..., None]], axis=-1).reshape(-1, 3)
    facets = np.arange(len(points), dtype=np.int32).reshape(-1, 3)
    parameters = facet_parameters(points, facets)
    wanted = spreads(slope_deg, side, dataclasses.replace(PAPER, height_noise_m=sigma))
    assert parameters[:, 0].std() == pytest.approx(wanted[0], rel=0.05)
    assert ((parameters[:, 1] + 180) % 360).std() == pytest.approx(wanted[1], rel=0.05)


def test_orientation_spreads_more_the_gentler_the_slope_up_to_the_whole_circle() -> None:
    turns = [spreads(slope, 1.2, PAPER)[1] for slope in (60.0, 30.0, 10.0, 5.0, 0.0)]
    assert turns == sorted(turns)
    assert turns[-1] == 180.0


def test_the_centre_lies_where_the_facets_are_dense() -> None:
    own = face(30, 90, 3, 80, 1)
    strays = np.array([[44.0, 110, 3], [45, 112, 3.2], [46, 70, 2.9]])
    refined = refine_clusters(np.concatenate([own, strays]), [np.arange(83, dtype=np.int32)], 1.2, PAPER)
    assert (np.abs(refined.centres - [[30, 90, 3]]) < [[0.8, 1.5, 0.1]]).all()
    assert (refined.labels[:80] == 0).mean() > 0.95


def test_a_facet_belongs_to_the_nearer_of_two_centres_also_across_north() -> None:
    a, b = face(30, 355, 3, 60, 1), face(30, 40, 3, 60, 2)
    coarse = [np.arange(60, dtype=np.int32), np.arange(60, 120, dtype=np.int32)]
    refined = refine_clusters(np.concatenate([a, b]), coarse, 1.2, PAPER)
    assert (refined.labels[:60] == 0).mean() > 0.9
    assert (refined.labels[60:] == 1).mean() > 0.9
    away = np.abs((np.concatenate([a, b])[:, 1] - 197.5 + 180) % 360 - 180)
    assert away[refined.labels >= 0].min() > 100


def test_clusters_with_few_members_or_much_spread_in_distance_are_none() -> None:
    wide = face(30, 90, 3, 60, 1)
    wide[:, 2] = np.linspace(-0.5, 6.5, 60)
    few = face(40, 200, 3, 9, 2)
    coarse = [np.arange(60, dtype=np.int32), np.arange(60, 69, dtype=np.int32)]
    parameters = np.concatenate([wide, few])
    generous = dataclasses.replace(PAPER, typical_o_range_m=20.0)
    assert refine_clusters(parameters, coarse, 1.2, generous).centres.shape == (0, 3)
    lenient = dataclasses.replace(generous, max_o_deviation_m=9.0, min_members=5)
    assert refine_clusters(parameters, coarse, 1.2, lenient).centres.shape == (2, 3)


def test_ground_below_the_origin_and_walls_are_no_roof() -> None:
    centres = np.array([[3.9, 0, -0.1], [3.9, 0, 0.1], [4.1, 0, -0.1], [76.0, 0, 3], [76.1, 0, 3]])
    assert may_be_roof(centres, PAPER).tolist() == [False, True, True, True, False]


def test_without_coarse_clusters_nothing_has_a_label() -> None:
    refined = refine_clusters(face(30, 90, 3, 20, 0), [], 1.2, PAPER)
    assert refined.labels.tolist() == [-1] * 20
    assert refined.centres.shape == (0, 3)


def test_a_sample_of_the_weights_gives_nearly_the_same_centre() -> None:
    own = face(30, 90, 3, 3000, 5)
    coarse = [np.arange(3000, dtype=np.int32)]
    whole = refine_clusters(own, coarse, 1.2, dataclasses.replace(PAPER, weight_sample=3000))
    part = refine_clusters(own, coarse, 1.2, dataclasses.replace(PAPER, weight_sample=200))
    assert (np.abs(whole.centres - part.centres) < [[0.2, 0.4, 0.02]]).all()


def test_beyond_the_limit_of_work_a_building_is_too_complex() -> None:
    own = face(30, 90, 3, 100, 5)
    with pytest.raises(BuildingError, match="takes 10100 comparisons, membership_work_limit is 999") as caught:
        refine_clusters(
            own, [np.arange(100, dtype=np.int32)], 1.2, dataclasses.replace(PAPER, membership_work_limit=999)
        )
    assert caught.value.reason is Reason.TOO_COMPLEX


def test_clusters_of_a_real_tin_keep_their_facets_whatever_the_order_of_the_points() -> None:
    random = np.random.default_rng(3)
    points = random.uniform(0, [14, 10, 0], (120, 3))
    points[:, 2] = 5 - np.abs(points[:, 1] - 5) * 0.6 + random.normal(0, 0.03, 120)
    points = np.rint(points * 1000) / 1000

    def labelled(order: np.ndarray) -> set[tuple[frozenset[int], int]]:
        moved = points[order]
        facets = triangulate(np.rint(moved[:, :2] * 1000).astype(np.int64)).facets
        parameters = facet_parameters(about_barycentre(moved)[0], facets)
        north = np.flatnonzero(np.abs((parameters[:, 1] + 180) % 360 - 180) < 40).astype(np.int32)
        south = np.flatnonzero(np.abs(parameters[:, 1] - 180) < 40).astype(np.int32)
        labels = refine_clusters(parameters, [north, south], 1.2, PAPER).labels
        return {(frozenset(order[f].tolist()), int(k)) for f, k in zip(facets, labels, strict=True)}

    here, there = labelled(np.arange(120)), labelled(random.permutation(120))
    assert here == there
    assert {k for _, k in here} >= {0, 1}
