"""The clustering against a plain Python twin, and the equations against their words."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import BuildingError, SettingsError
from pipeline.extras.papers.clustering_settings import FuzzySartClusteringSettings
from pipeline.extras.papers.fuzzy_sart_clusters import (
    _Bounds,
    _degree,
    _Vectors,
    centre_of_building,
    cluster,
    facet_vectors,
)
from pipeline.model import FloatArray, Reason

coordinate = st.floats(-100, 100, allow_nan=False).filter(lambda value: abs(value) > 1e-3)
vector = st.tuples(coordinate, coordinate, coordinate)


def scalar_vdm(template: Sequence[float], vector_: Sequence[float]) -> float:
    """Eqs. 3 to 6, one number after the other."""
    t = math.sqrt(sum(value * value for value in template))
    x = math.sqrt(sum(value * value for value in vector_))
    alpha = math.acos(max(-1.0, min(1.0, sum(a * b for a, b in zip(template, vector_, strict=True)) / (t * x))))
    return min(t / x, x / t) * (math.pi - alpha) / math.pi


def plain_clustering(
    vectors: list[list[float]], areas: list[float], chosen: FuzzySartClusteringSettings
) -> tuple[list[int], list[list[float]]]:
    """The reconstruction of the learning rule, neuron by neuron in lists."""
    order = sorted(range(len(vectors)), key=lambda i: (-areas[i], i))
    modules = [math.sqrt(sum(value * value for value in v)) for v in vectors]
    neurons: list[dict[str, Any]] = []
    for _ in range(chosen.epochs_per_tau * chosen.tau_epochs):
        made = False
        for neuron in neurons:
            neuron["hits"], neuron["before"] = 0, list(neuron["t"])
        for i in order:
            if modules[i] < 1e-9:
                continue
            x = vectors[i]
            matches = sorted((-scalar_vdm(n["t"], x), k) for k, n in enumerate(neurons))
            matches = [(-m, k) for m, k in matches if -m >= chosen.vigilance]
            if not matches:
                neurons.append({"t": list(x), "age": 0, "hits": 1, "before": None})
                made = True
                continue
            winner = neurons[matches[0][1]]
            winner["hits"] += 1
            reach = chosen.neighbourhood_start * (chosen.neighbourhood_end / chosen.neighbourhood_start) ** min(
                1.0, winner["age"] / chosen.tau_epochs
            )
            for rank, (_, k) in enumerate(matches):
                if rank / reach > 12:
                    break
                rate = chosen.learning_rate_start * (chosen.learning_rate_end / chosen.learning_rate_start) ** min(
                    1.0, neurons[k]["age"] / chosen.tau_epochs
                )
                rate *= math.exp(-rank / reach)
                neurons[k]["t"] = [t + rate * (v - t) for t, v in zip(neurons[k]["t"], x, strict=True)]
        moved = max(
            (abs(a - b) for n in neurons if n["before"] for a, b in zip(n["t"], n["before"], strict=True)), default=0.0
        )
        removed = any(n["hits"] == 0 for n in neurons)
        neurons = [n for n in neurons if n["hits"]]
        for n in neurons:
            n["age"] += 1
        grown = all(n["age"] > chosen.tau_epochs for n in neurons)
        if not made and not removed and grown and moved < 1e-3 * max(modules):
            break
    labels = []
    for x, module in zip(vectors, modules, strict=True):
        degrees = [scalar_vdm(n["t"], x) for n in neurons] if module >= 1e-9 else []
        best = max(degrees, default=-1.0)
        labels.append(degrees.index(best) if best >= chosen.vigilance else -1)
    return labels, [n["t"] for n in neurons]


def noisy_normals(seed: int, count: int = 60, spread: float = 0.1) -> tuple[FloatArray, FloatArray]:
    random = np.random.default_rng(seed)
    means = np.array([[0.5, 0, 1], [-0.5, 0, 1], [0, 0.4, 1], [0, 0, 1.0]])
    normals = means[random.integers(0, 4, count)] + random.normal(0, spread, (count, 3))
    return normals / np.linalg.norm(normals, axis=1)[:, None], random.uniform(0.1, 5, count)


def degree_of_match(template: Sequence[float], other: Sequence[float], vigilance: float = 0.0) -> float:
    """What the kernel says of one neuron and one vector."""
    t, x = np.array([template], np.float64), np.array([other], np.float64)
    vectors = _Vectors(x, np.linalg.norm(x, axis=1))
    return _degree(t, np.linalg.norm(t, axis=1), 0, vectors, 0, _Bounds(vigilance, -2.0))


@settings(deadline=None)
@given(vector, vector)
def test_the_degree_of_match_is_its_scalar_twin_and_symmetric(
    template: Sequence[float], other: Sequence[float]
) -> None:
    degree = degree_of_match(template, other)
    assert degree == pytest.approx(scalar_vdm(template, other), abs=1e-12)
    assert degree == pytest.approx(degree_of_match(other, template), abs=1e-12)
    assert 0.0 <= degree <= 1.0


@pytest.mark.parametrize(
    ("template", "other", "degree"),
    [
        ([3, -4, 5], [3, -4, 5], 1.0),
        ([3, -4, 5], [-3, 4, -5], 0.0),
        ([1, 2, 2], [2, 4, 4], 0.5),  # one direction: the ratio of the modules
        ([1, 0, 0], [0, 0, 1], 0.5),  # a right angle
        ([0, 0, 0], [1, 0, 0], -1.0),
    ],
)
def test_the_degree_of_match_of_clear_cases(template: list[float], other: list[float], degree: float) -> None:
    assert degree_of_match(template, other) == pytest.approx(degree, abs=1e-7)


def test_modules_whose_ratio_is_below_the_vigilance_are_no_match() -> None:
    assert degree_of_match([1, 2, 2], [2, 4, 4], 0.51) == -1.0


@pytest.mark.parametrize(
    ("settings", "feet"),
    [
        *(({"vigilance": vigilance}, False) for vigilance in (0.7, 0.9, 0.95)),
        ({"vigilance": 0.7, "tau_epochs": 2}, True),
    ],
)
@pytest.mark.parametrize("seed", range(4))
def test_the_clustering_of_normals_and_footpoints_equals_its_plain_twin(
    seed: int, settings: dict[str, Any], feet: bool
) -> None:
    vectors, areas = noisy_normals(seed)
    if feet:
        vectors *= np.random.default_rng(seed + 100).uniform(2, 9, len(vectors))[:, None]
    chosen = FuzzySartClusteringSettings(**settings)
    found = cluster(vectors, areas, chosen)
    labels, templates = plain_clustering(vectors.tolist(), areas.tolist(), chosen)
    assert found.labels.tolist() == labels
    np.testing.assert_allclose(found.templates, templates, atol=1e-9)


@settings(max_examples=examples(20), deadline=None)
@given(st.integers(0, 10_000))
def test_every_clustered_vector_matches_its_own_neuron_best(seed: int) -> None:
    normals, areas = noisy_normals(seed, count=25)
    found = cluster(normals, areas, FuzzySartClusteringSettings(vigilance=0.9))
    for normal, label in zip(normals, found.labels, strict=True):
        degrees = [scalar_vdm(t, normal) for t in found.templates]
        assert max(degrees) < 0.9 if label < 0 else degrees[label] >= max(max(degrees) - 1e-12, 0.9 - 1e-12)


def test_two_roof_sides_give_two_clusters_at_high_vigilance_and_one_at_low() -> None:
    sides = np.array([[0.4, 0, 1], [-0.4, 0, 1]])
    normals = np.repeat(sides / np.linalg.norm(sides, axis=1)[:, None], 10, axis=0)
    areas = np.ones(20)
    apart = cluster(normals, areas, FuzzySartClusteringSettings(vigilance=0.9))
    assert apart.labels.tolist() == [0] * 10 + [1] * 10
    together = cluster(normals, areas, FuzzySartClusteringSettings(vigilance=0.7))
    assert len(together.templates) == 1


def test_a_higher_vigilance_never_gives_fewer_clusters_on_noisy_roofs() -> None:
    for seed in range(5):
        normals, areas = noisy_normals(seed)
        counts = [
            len(cluster(normals, areas, FuzzySartClusteringSettings(vigilance=v)).templates) for v in (0.7, 0.9, 0.99)
        ]
        assert counts == sorted(counts)


def test_a_zero_vector_is_an_outlier_and_no_vectors_give_no_clusters() -> None:
    found = cluster(np.array([[0.0, 0, 0], [0, 0, 1]]), np.ones(2), FuzzySartClusteringSettings())
    assert found.labels.tolist() == [-1, 0]
    nothing = cluster(np.zeros((0, 3)), np.zeros(0), FuzzySartClusteringSettings())
    assert nothing.labels.shape == (0,)
    assert nothing.templates.shape == (0, 3)


def test_more_work_than_allowed_is_reported_as_too_complex() -> None:
    normals, areas = noisy_normals(1, count=500)
    with pytest.raises(BuildingError, match="clustering_work_limit is 1000") as caught:
        cluster(normals, areas, FuzzySartClusteringSettings(clustering_work_limit=1000))
    assert caught.value.reason is Reason.TOO_COMPLEX


def test_the_centre_is_the_middle_of_the_box_in_every_dimension() -> None:
    points = np.array([[1.0, 2, 3], [5, 2, 9], [2, 8, 4]])
    assert centre_of_building(points).tolist() == [3.0, 5.0, 6.0]


def test_a_footpoint_lies_on_its_facet_plane_along_its_normal() -> None:
    random = np.random.default_rng(3)
    normals, _ = noisy_normals(3, count=20)
    centroids, centre = random.uniform(-5, 5, (20, 3)), np.array([1.0, 2, 3])
    feet = facet_vectors("footpoint", normals, centroids, centre)
    np.testing.assert_allclose(((feet + centre - centroids) * normals).sum(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(feet, normals), 0, atol=1e-12)


def test_footpoints_of_opposite_roof_sides_are_mirrored_about_the_centre() -> None:
    normals = np.array([[0.6, 0, 0.8], [-0.6, 0, 0.8]])
    feet = facet_vectors("footpoint", normals, np.array([[3.0, 0, 4], [-3.0, 0, 4]]), np.zeros(3))
    np.testing.assert_allclose(feet[0] * [-1, 1, 1], feet[1])


@pytest.mark.parametrize("low", [0.0, 1.0])
def test_scaled_spherical_vectors_fill_their_range(low: float) -> None:
    normals, _ = noisy_normals(5, count=30)
    vectors = facet_vectors("spherical_scaled", normals, normals * 7, np.array([1.0, 0, 0]), scaled_min=low)
    np.testing.assert_allclose(vectors.min(axis=0), low, atol=1e-12)
    np.testing.assert_allclose(vectors.max(axis=0), 1.0, atol=1e-12)


def test_the_branch_cut_of_the_azimuth_lies_in_its_widest_gap() -> None:
    azimuth = np.radians([-2.0, 0.0, 2.0, 40.0])
    normals = np.column_stack([0.6 * np.cos(azimuth), 0.6 * np.sin(azimuth), np.full(4, 0.8)])
    phi = facet_vectors("spherical_scaled", normals, normals, np.zeros(3))[:, 2]
    np.testing.assert_allclose(phi, np.array([0.0, 2, 4, 42]) / 42, atol=1e-9)


def test_a_dimension_without_range_is_one_constant() -> None:
    normals = np.array([[0.0, 0, 1], [0.0, 0, 1]])
    assert facet_vectors("spherical_scaled", normals, normals * 3, np.zeros(3)).tolist() == [[1.0] * 3] * 2


def test_settings_out_of_range_are_all_named_at_once() -> None:
    with pytest.raises(SettingsError, match=r"vigilance is 1\.5") as caught:
        FuzzySartClusteringSettings(vigilance=1.5, vectors="normals")
    assert len(caught.value.faults) == 2
