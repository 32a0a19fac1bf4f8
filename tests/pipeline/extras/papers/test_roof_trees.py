"""Both decision trees, leaf by leaf, as sections 3.3 and 4.2 print them."""

import numpy as np
import pytest

from pipeline.extras.papers.clustering_settings import RoofTreeSettings
from pipeline.extras.papers.roof_trees import classify_2d, classify_3d, opposite_pairs, plausible_slopes
from pipeline.model import RoofType

TREE = RoofTreeSettings()
Cluster = tuple[float, float, float]


def kinds(*clusters: Cluster, settings: RoofTreeSettings = TREE) -> tuple[RoofType, RoofType]:
    """What the trees in two and in three dimensions say."""
    centres = np.array(clusters).reshape(-1, 3)
    return classify_2d(centres, settings).roof_type, classify_3d(centres, settings).roof_type


@pytest.mark.parametrize(
    ("clusters", "wanted"),
    [
        ((), RoofType.NONE),
        (((20.0, 100.0, 3.0),), RoofType.PENT),
        (((7.0, 100.0, 3.0),), RoofType.PENT),
        (((6.9, 100.0, 3.0),), RoofType.FLAT),
        (((30.0, 10.0, 3.0), (30.0, 190.0, 3.0)), RoofType.GABLE),
        (((30.0, 10.0, 3.0), (45.0, 209.0, 3.0)), RoofType.GABLE),
        (((30.0, 10.0, 3.0), (30.0, 211.0, 3.0)), RoofType.UNKNOWN),
        (((30.0, 350.0, 3.0), (30.0, 170.0, 3.0), (25.0, 80.0, 3.0)), RoofType.GABLE),
        (((30.0, 10.0, 3.0), (45.0, 190.0, 3.0), (25.0, 80.0, 3.0)), RoofType.UNKNOWN),
        (((30.0, 10.0, 3.0), (30.0, 190.0, 3.0), (28.0, 100.0, 3.0), (28.0, 281.0, 3.0)), RoofType.COMBINATION),
        (((30.0, 10.0, 3.0), (30.0, 190.0, 3.0), (31.0, 12.0, 5.0), (31.0, 191.0, 5.0)), RoofType.COMBINATION),
    ],
)
def test_clusters_above_the_origin_are_the_same_leaf_of_both_trees(
    clusters: tuple[Cluster, ...], wanted: RoofType
) -> None:
    assert kinds(*clusters) == (wanted, wanted)


def test_a_single_cluster_below_the_origin_is_no_pent_roof_in_three_dimensions() -> None:
    assert kinds((20.0, 100.0, -0.5)) == (RoofType.PENT, RoofType.UNKNOWN)


def test_sloping_terrain_below_hides_a_pent_roof_only_where_nothing_may_be_left_beside_it() -> None:
    clusters = ((20.0, 100.0, 4.0), (12.0, 210.0, -1.0))
    assert kinds(*clusters) == (RoofType.UNKNOWN, RoofType.PENT)
    strict = RoofTreeSettings(pent_beside="nothing")
    assert kinds(*clusters, settings=strict) == (RoofType.UNKNOWN, RoofType.UNKNOWN)


def test_there_is_no_leaf_for_a_hip_roof() -> None:
    hip = tuple((35.0, turn, 4.0) for turn in (5.0, 95.0, 185.0, 275.0))
    assert kinds(*hip) == (RoofType.COMBINATION, RoofType.COMBINATION)


def test_a_cluster_is_in_one_pair_at_most_and_the_best_pair_comes_first() -> None:
    centres = np.array([[30.0, 0, 1], [30, 195, 1], [30, 181, 1], [30, 10, 1]])
    assert opposite_pairs(centres, TREE, 10.0) == ((0, 2), (1, 3))


def test_turning_the_scene_changes_no_leaf() -> None:
    clusters = np.array([[30.0, 10, 3], [32, 185, 3], [28, 100, 3], [20, 320, 2]])
    types = set()
    for turn in range(0, 360, 15):
        turned = clusters.copy()
        turned[:, 1] = (turned[:, 1] + turn) % 360
        types.add((classify_2d(turned, TREE).roof_type, classify_3d(turned, TREE).roof_type))
    assert types == {(RoofType.GABLE, RoofType.GABLE)}


def test_slopes_are_plausible_between_both_bounds() -> None:
    centres = np.array([[6.9, 0, 0], [7.0, 0, 0], [75.0, 0, 0], [75.1, 0, 0]])
    assert plausible_slopes(centres, 7.0, 75.0).tolist() == [False, True, True, False]
