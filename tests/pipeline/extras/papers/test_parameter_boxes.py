"""Coarse clusters in boxes: dense neighbours grow together, layers do not, doubles are merged."""

from collections import Counter

import numpy as np
import pytest

from pipeline.errors import BuildingError
from pipeline.extras.papers.clustering_settings import ParameterBoxSettings
from pipeline.extras.papers.parameter_boxes import coarse_clusters
from pipeline.model import FloatArray, Reason

PAPER = ParameterBoxSettings(dense_box_facets=5)


def spread(slope: float, orientation: float, distance: float, n: int, seed: int, width: float = 1.0) -> FloatArray:
    random = np.random.default_rng(seed)
    return np.column_stack(
        [
            random.normal(slope, 3.0 * width, n),
            random.normal(orientation, 6.0 * width, n) % 360,
            random.normal(distance, 0.3 * width, n),
        ]
    )


def plain_groups(parameters: FloatArray, shift: float, least: int) -> list[frozenset[int]]:
    """Components of dense boxes of one grid, by repeated joining of neighbours."""
    box = [(int(s // 7), int(o // 10), int((d / 2 + shift) // 1)) for s, o, d in parameters]
    counts = Counter(box)
    dense = {b for b, n in counts.items() if n > max(least, len(parameters) / len(counts))}
    groups = [{b} for b in dense]

    def near(a: tuple[int, int, int], b: tuple[int, int, int]) -> bool:
        turn = abs(a[1] - b[1])
        return a[2] == b[2] and abs(a[0] - b[0]) <= 1 and min(turn, 36 - turn) <= 1

    while True:
        pair = next(
            ((g, h) for g in groups for h in groups if g is not h and any(near(a, b) for a in g for b in h)), None
        )
        if pair is None:
            return sorted(frozenset(i for i, b in enumerate(box) if b in g) for g in groups)
        groups.remove(pair[1])
        pair[0].update(pair[1])


@pytest.mark.parametrize("seed", range(5))
def test_without_merging_the_groups_are_those_of_both_grids(seed: int) -> None:
    faces = [spread(30, 355, 3, 90, seed), spread(32, 175, 2.5, 90, seed + 10), spread(15, 90, -1, 60, seed + 20)]
    clutter = np.random.default_rng(seed).uniform([0, 0, -6], [90, 360, 6], (150, 3))
    parameters = np.clip(np.concatenate([*faces, clutter]), [0, 0, -9], [89.9, 359.99, 9])
    apart = ParameterBoxSettings(dense_box_facets=5, double_share=1.0)
    found = Counter(frozenset(group.tolist()) for group in coarse_clusters(parameters, apart))
    wanted = Counter(plain_groups(parameters, 0.0, 5) + plain_groups(parameters, 0.5, 5))
    assert found == wanted


@pytest.mark.parametrize("distance", [0.0, 0.5, 1.0, 1.5, 2.0, -3.0])
def test_a_roof_face_is_one_cluster_wherever_the_borders_of_the_layers_lie(distance: float) -> None:
    clusters = coarse_clusters(spread(30, 90, distance, 200, 1, 0.5), PAPER)
    assert len(clusters) == 1
    assert len(clusters[0]) > 150


def test_parallel_faces_3_m_apart_are_two_clusters() -> None:
    lower, upper = spread(30, 90, 1.0, 120, 1, 0.6), spread(30, 90, 4.0, 120, 2, 0.6)
    clusters = coarse_clusters(np.concatenate([lower, upper]), PAPER)
    assert len(clusters) == 2
    assert {(group < 120).mean() for group in clusters} == {0.0, 1.0}


def test_a_face_across_north_is_one_cluster() -> None:
    assert len(coarse_clusters(spread(30, 0.0, 1.0, 200, 4), PAPER)) == 1


def test_a_box_at_the_threshold_is_none_and_one_above_stands_alone() -> None:
    def box(n: int) -> FloatArray:
        return np.tile([[30.0, 95.0, 1.0]], (n, 1))

    stray = np.array([[80.0, 200.0, 9.0]])
    assert coarse_clusters(np.concatenate([box(5), stray]), PAPER) == ()
    assert [group.tolist() for group in coarse_clusters(np.concatenate([box(6), stray]), PAPER)] == [list(range(6))]


def test_turned_by_whole_boxes_the_clusters_are_the_same() -> None:
    parameters = np.concatenate([spread(30, 90, 1, 100, 1), spread(30, 270, 1, 100, 2)])
    turned = parameters.copy()
    turned[:, 1] = (turned[:, 1] + 130) % 360
    assert {tuple(g) for g in coarse_clusters(parameters, PAPER)} == {tuple(g) for g in coarse_clusters(turned, PAPER)}


def test_without_facets_there_is_no_cluster() -> None:
    assert coarse_clusters(np.zeros((0, 3)), PAPER) == ()


def test_more_clusters_than_the_limit_are_too_complex() -> None:
    centres = np.random.default_rng(0).uniform([0, 0, -9], [89, 359, 9], (120, 3))
    parameters = np.repeat(centres, [8, 1] * 60, axis=0)
    with pytest.raises(BuildingError, match="max_coarse_clusters is 10") as caught:
        coarse_clusters(parameters, ParameterBoxSettings(max_coarse_clusters=10))
    assert caught.value.reason is Reason.TOO_COMPLEX
