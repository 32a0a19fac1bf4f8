"""Fuzzy SART clustering of facet vectors (Shorter and Kasparis, section 3.2; Baraldi and Parmiggiani 1997).

The paper prints the vector degree of match (Eqs. 3 to 6), the centring (Eq. 7), the two user parameters (vigilance and
tau) and that all dimensions are scaled to one range. It prints no rule of learning, and none of the public texts on
Fuzzy SART does. This module is therefore a deterministic *reconstruction* from the words of those texts: soft-to-hard
competitive learning, with neurons made per example and removed per mini-batch.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.extras.papers.clustering_settings import FuzzySartClusteringSettings
from pipeline.model import FloatArray, LabelArray, Reason

_FLAT_RANGE = 1e-6
"""Ranges below this (metres or radians) count as none: scaling them would only blow up rounding."""
_ZERO_MODULE = 1e-9
"""A vector shorter than this has no direction: an outlier."""
_NEGLIGIBLE_RANK = 12.0
"""exp(-12) is 6e-6: a neuron that far down the ranking is not moved."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Clustering:
    """The outcome of the clustering."""

    labels: LabelArray
    """(n,) int32, neuron of every vector; -1 for outliers: zero vectors and those that match no neuron."""
    templates: FloatArray
    """(k, 3) float64, the neurons: one vector a cluster."""
    epochs: int
    """Epochs until nothing changed any more, or the limit."""


@kernel
def _module_degree(t_module: float, x_module: float) -> float:
    """MDM of Eq. 4."""
    return min(t_module / x_module, x_module / t_module)


@kernel
def _angle_degree(cosine: float) -> float:
    """ADM of Eq. 5, with alpha of Eq. 6; the cosine may leave [-1, 1] by rounding."""
    return 1.0 - math.acos(min(1.0, max(-1.0, cosine))) / math.pi


def centre_of_building(points: FloatArray) -> FloatArray:
    """The point (3,) that Eq. 7 moves to the origin: the middle of the bounding box of points (n, 3).

    They are the building *with its ground*: without it the plane of a flat or pent roof passes near the centre and its
    footpoints degenerate.
    """
    lowest = points.min(axis=0)
    return np.asarray(lowest + (points.max(axis=0) - lowest) / 2.0, dtype=np.float64)


def facet_vectors(
    kind: str, normals: FloatArray, centroids: FloatArray, centre: FloatArray, *, scaled_min: float = 0.0
) -> FloatArray:
    """The vectors that are clustered, one per facet, (m, 3): dimensionless, or metres for ``footpoint``.

    From the unit normals and the centroids of the facets, (m, 3), and the `centre_of_building`, in metres.

    Parameters
    ----------
    kind : {"unit_normal", "footpoint", "spherical_scaled"}
        ``unit_normal`` is the normal; ``footpoint`` the foot of the perpendicular from the centre to the facet's
        plane (the reading under which Figs. 6 and 7 of the paper make sense); ``spherical_scaled`` that foot as
        (r, theta, phi), each scaled to [scaled_min, 1] (the paper's literal words).
    scaled_min : float
        Lower end of the range of ``spherical_scaled``.
    """
    if kind == "unit_normal":
        return normals.copy()
    offset_m = _row_dot(centroids - centre, normals)
    footpoints = normals * offset_m[:, None]
    if kind == "footpoint":
        return footpoints
    return _scaled_spherical(footpoints, scaled_min)


def _row_dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Dot products of the rows, summed in one fixed order."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2], dtype=np.float64)


def _scaled_spherical(footpoints: FloatArray, scaled_min: float) -> FloatArray:
    """(r, theta, phi) of every vector, each dimension scaled to [scaled_min, 1]."""
    if len(footpoints) == 0:
        return footpoints.copy()
    r = np.sqrt(_row_dot(footpoints, footpoints))
    theta = np.arccos(np.clip(footpoints[:, 2] / np.maximum(r, _ZERO_MODULE), -1.0, 1.0))
    phi = np.arctan2(footpoints[:, 1], footpoints[:, 0]) % (2.0 * math.pi)
    # The branch cut of phi goes where it parts the fewest: behind the widest gap between azimuths.
    ordered = np.sort(phi)
    gaps = np.diff(np.append(ordered, ordered[0] + 2.0 * math.pi))
    phi = (phi - ordered[(int(gaps.argmax()) + 1) % len(ordered)]) % (2.0 * math.pi)
    return np.column_stack([_to_one_range(values, scaled_min) for values in (r, theta, phi)])


def _to_one_range(values: FloatArray, scaled_min: float) -> FloatArray:
    """Values scaled to [scaled_min, 1]; all 1 where they have no range."""
    low, high = float(values.min()), float(values.max())
    if high - low < _FLAT_RANGE:
        return np.ones_like(values)
    return np.asarray(scaled_min + (1.0 - scaled_min) * (values - low) / (high - low), dtype=np.float64)


def cluster(vectors: FloatArray, areas_m2: FloatArray, settings: FuzzySartClusteringSettings) -> Clustering:
    """Cluster facet vectors (n, 3), as `facet_vectors` gives them, by Fuzzy SART.

    Inputs are presented in descending area, ties by index, epoch after epoch, until no neuron was made or removed, all
    have lived tau epochs and none moved. Outliers have the label -1; without vectors there are no clusters. Raises
    BuildingError ``too_complex`` where more than ``clustering_work_limit`` comparisons would be needed.
    """
    order = np.argsort(-areas_m2, kind="stable")
    labels, templates, epochs, work = _learn(
        np.ascontiguousarray(vectors, dtype=np.float64),
        order,
        _Learning(
            vigilance=settings.vigilance,
            tau=settings.tau_epochs,
            max_epochs=settings.epochs_per_tau * settings.tau_epochs,
            rate_start=settings.learning_rate_start,
            rate_end=settings.learning_rate_end,
            reach_start=settings.neighbourhood_start,
            reach_end=settings.neighbourhood_end,
            work_limit=settings.clustering_work_limit,
        ),
    )
    if work > settings.clustering_work_limit:
        raise BuildingError(
            Reason.TOO_COMPLEX,
            f"Fuzzy SART stood at {work} comparisons of {len(vectors)} facets with {len(templates)} clusters, "
            f"clustering_work_limit is {settings.clustering_work_limit}",
        )
    return Clustering(labels=labels, templates=templates, epochs=int(epochs))


class _Learning(NamedTuple):
    """`FuzzySartClusteringSettings` as the kernel takes them."""

    vigilance: float
    tau: int
    """Epochs in which a neuron learns."""
    max_epochs: int
    rate_start: float
    rate_end: float
    reach_start: float
    reach_end: float
    """Ranks over which the learning fades, for a winner of age 0 and tau."""
    work_limit: int


@kernel
def _learn(  # noqa: C901 - the paper's algorithm in one piece: parts would be compiled apart and pass its state around
    vectors: FloatArray,
    order: npt.NDArray[np.int64],
    learning: _Learning,
) -> tuple[LabelArray, FloatArray, int, int]:
    """Labels, templates, epochs and comparisons; stops early once the comparisons pass the limit.

    It stays whole: its arrays grow as neurons are made, so that parts of it would pass all of them to and fro.
    """
    vigilance, tau, max_epochs, rate_start, rate_end, reach_start, reach_end, work_limit = learning
    n = vectors.shape[0]
    module = np.empty(n)
    largest = 0.0
    for i in range(n):
        module[i] = math.sqrt(
            vectors[i, 0] * vectors[i, 0] + vectors[i, 1] * vectors[i, 1] + vectors[i, 2] * vectors[i, 2]
        )
        largest = max(largest, module[i])
    capacity = 16
    template = np.zeros((capacity, 3))
    template_module = np.zeros(capacity)
    before = np.zeros((capacity, 3))
    age = np.zeros(capacity, np.int64)
    hits = np.zeros(capacity, np.int64)
    ranked = np.zeros(capacity, np.int64)
    degree = np.zeros(capacity)
    # An angle beyond pi (1 - V) cannot reach the vigilance: its arc cosine need not be taken.
    min_cosine = math.cos(math.pi * (1.0 - vigilance)) - 1e-12
    count = 0
    work = 0
    epochs = 0
    for _ in range(max_epochs):
        hits[:count] = 0
        before[:count] = template[:count]
        count_before = count
        made = False
        for i in order:
            if module[i] < _ZERO_MODULE:
                continue
            work += count + 1
            matches = 0
            for k in range(count):
                match = _degree(template, template_module, k, vectors, module, i, min_cosine, vigilance)
                if match >= vigilance:
                    at = matches
                    while at > 0 and degree[at - 1] < match:
                        degree[at] = degree[at - 1]
                        ranked[at] = ranked[at - 1]
                        at -= 1
                    degree[at] = match
                    ranked[at] = k
                    matches += 1
            if matches == 0:
                if count == capacity:
                    template = np.concatenate((template, np.zeros((capacity, 3))))
                    template_module = np.concatenate((template_module, np.zeros(capacity)))
                    before = np.concatenate((before, np.zeros((capacity, 3))))
                    age = np.concatenate((age, np.zeros(capacity, np.int64)))
                    hits = np.concatenate((hits, np.zeros(capacity, np.int64)))
                    ranked = np.concatenate((ranked, np.zeros(capacity, np.int64)))
                    degree = np.concatenate((degree, np.zeros(capacity)))
                    capacity *= 2
                template[count] = vectors[i]
                template_module[count] = module[i]
                age[count] = 0
                hits[count] = 1
                count += 1
                made = True
                continue
            winner = ranked[0]
            hits[winner] += 1
            reach = reach_start * (reach_end / reach_start) ** min(1.0, age[winner] / tau)
            for rank in range(matches):
                fading = rank / reach
                if fading > _NEGLIGIBLE_RANK:
                    break
                k = ranked[rank]
                rate = rate_start * (rate_end / rate_start) ** min(1.0, age[k] / tau) * math.exp(-fading)
                square = 0.0
                for d in range(3):
                    template[k, d] += rate * (vectors[i, d] - template[k, d])
                    square += template[k, d] * template[k, d]
                template_module[k] = math.sqrt(square)
        epochs += 1
        if work > work_limit:
            break
        moved = 0.0
        removed = False
        grown = True
        kept = 0
        for k in range(count):
            if k < count_before:
                for d in range(3):
                    moved = max(moved, abs(template[k, d] - before[k, d]))
            if hits[k] == 0:
                removed = True
                continue
            template[kept] = template[k]
            template_module[kept] = template_module[k]
            age[kept] = age[k] + 1
            grown = grown and age[kept] > tau
            kept += 1
        count = kept
        if not made and not removed and grown and moved < 1e-3 * largest:
            break
    labels = np.full(n, -1, np.int32)
    if work > work_limit:
        return labels, template[:count].copy(), epochs, work
    for i in range(n):
        if module[i] < _ZERO_MODULE:
            continue
        best = vigilance
        for k in range(count):
            match = _degree(template, template_module, k, vectors, module, i, min_cosine, vigilance)
            if match > best or (match == best and labels[i] < 0):
                best = match
                labels[i] = k
    return labels, template[:count].copy(), epochs, work


@kernel
def _degree(
    template: FloatArray,
    template_module: FloatArray,
    k: int,
    vectors: FloatArray,
    module: FloatArray,
    i: int,
    min_cosine: float,
    vigilance: float,
) -> float:
    """VDM of neuron k and vector i (Eq. 3), or -1 where it is certain to stay below the vigilance."""
    # Both bounds are tested by multiplication first: nearly all comparisons end here.
    t_module = template_module[k]
    x_module = module[i]
    if t_module < _ZERO_MODULE or min(t_module, x_module) < vigilance * max(t_module, x_module):
        return -1.0
    dot = template[k, 0] * vectors[i, 0] + template[k, 1] * vectors[i, 1] + template[k, 2] * vectors[i, 2]
    modules = t_module * x_module
    if dot < min_cosine * modules:
        return -1.0
    return float(_module_degree(t_module, x_module) * _angle_degree(dot / modules))
