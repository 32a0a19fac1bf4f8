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

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.extras.papers.clustering_settings import FuzzySartClusteringSettings
from pipeline.model import FloatArray, IntArray, LabelArray, Reason

_FLAT_RANGE = 1e-6
"""Ranges below this (metres or radians) count as none: scaling them would only blow up rounding."""
_ZERO_MODULE = 1e-9
"""A vector shorter than this has no direction: an outlier."""
_NEGLIGIBLE_RANK = 12.0
"""exp(-12) is 6e-6: a neuron that far down the ranking is not moved."""
_AT_REST = 1e-3
"""Share of the largest module below which a template has not moved: far less than clusters are apart."""
_ROUNDING = 1e-12
"""Taken off a bound of cosines, so that rounding excludes no match that is just good enough."""
_ROOM = 16
"""Neurons that there is room for at first; the room doubles."""


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
    have lived tau epochs and none moved. Outliers have the label -1; no vectors give no clusters. Raises
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


class _Vectors(NamedTuple):
    """The vectors that are clustered."""

    xyz: FloatArray
    """(n, 3) float64."""
    module: FloatArray
    """(n,) float64, their lengths."""


class _Neurons(NamedTuple):
    """The neurons, and room for more; arrays of one length."""

    template: FloatArray
    """(room, 3) float64."""
    module: FloatArray
    """(room,) float64, lengths of the templates."""
    before: FloatArray
    """(room, 3) float64, the templates at the start of the epoch."""
    age: IntArray
    """(room,) int64, epochs lived."""
    hits: IntArray
    """(room,) int64, vectors won in this epoch."""


class _Bounds(NamedTuple):
    """Matches that count."""

    vigilance: float
    min_cosine: float
    """Cosine of an angle beyond which no match reaches the vigilance: its arc cosine need not be taken."""


class _Ranking(NamedTuple):
    """The neurons that match one vector, the best first; equal ones in their order."""

    neuron: IntArray
    """(room,) int64."""
    degree: FloatArray
    """(room,) float64."""


@kernel
def _with_modules(xyz: FloatArray) -> _Vectors:
    """Vectors (n, 3) with their lengths."""
    module = np.empty(len(xyz))
    for i in range(len(xyz)):
        module[i] = math.sqrt(xyz[i, 0] * xyz[i, 0] + xyz[i, 1] * xyz[i, 1] + xyz[i, 2] * xyz[i, 2])
    return _Vectors(xyz, module)


@kernel
def _no_neurons(room: int) -> _Neurons:
    """Room for neurons."""
    return _Neurons(
        np.zeros((room, 3)), np.zeros(room), np.zeros((room, 3)), np.zeros(room, np.int64), np.zeros(room, np.int64)
    )


@kernel
def _with_neuron(neurons: _Neurons, count: int, vectors: _Vectors, i: int) -> _Neurons:
    """The `count` neurons and one made from a vector; in arrays twice as long where there was no room."""
    if count == len(neurons.age):
        wider = _no_neurons(2 * count)
        wider.template[:count] = neurons.template
        wider.module[:count] = neurons.module
        wider.before[:count] = neurons.before
        wider.age[:count] = neurons.age
        wider.hits[:count] = neurons.hits
        neurons = wider
    neurons.template[count] = vectors.xyz[i]
    neurons.module[count] = vectors.module[i]
    neurons.age[count] = 0
    neurons.hits[count] = 1
    return neurons


@kernel
def _ranked(neurons: _Neurons, count: int, vectors: _Vectors, i: int, bounds: _Bounds, ranking: _Ranking) -> int:
    """Write the neurons that match a vector to the ranking; how many there are."""
    matches = 0
    for k in range(count):
        match = _degree(neurons.template, neurons.module, k, vectors, i, bounds)
        if match >= bounds.vigilance:
            at = matches
            while at > 0 and ranking.degree[at - 1] < match:
                ranking.degree[at] = ranking.degree[at - 1]
                ranking.neuron[at] = ranking.neuron[at - 1]
                at -= 1
            ranking.degree[at] = match
            ranking.neuron[at] = k
            matches += 1
    return matches


@kernel
def _move_towards(xyz: FloatArray, neurons: _Neurons, ranked: IntArray, learning: _Learning) -> None:
    """Move the ranked neurons towards a vector (3,); those of a low rank or a high age move less."""
    template, age, tau = neurons.template, neurons.age, learning.tau
    winner = ranked[0]
    neurons.hits[winner] += 1
    reach = learning.reach_start * (learning.reach_end / learning.reach_start) ** min(1.0, age[winner] / tau)
    for rank in range(len(ranked)):
        fading = rank / reach
        if fading > _NEGLIGIBLE_RANK:
            break
        k = ranked[rank]
        rate = (
            learning.rate_start
            * (learning.rate_end / learning.rate_start) ** min(1.0, age[k] / tau)
            * math.exp(-fading)
        )
        square = 0.0
        for d in range(3):
            template[k, d] += rate * (xyz[d] - template[k, d])
            square += template[k, d] * template[k, d]
        neurons.module[k] = math.sqrt(square)


@kernel
def _end_epoch(neurons: _Neurons, count: int, count_before: int, tau: int) -> tuple[int, float, bool]:
    """Remove the neurons that won nothing, and let the others age.

    Returns how many are left, how far those moved that were there at the start, and whether all have lived `tau`
    epochs and none was removed.
    """
    moved = 0.0
    settled = True
    kept = 0
    for k in range(count):
        if k < count_before:
            for d in range(3):
                moved = max(moved, abs(neurons.template[k, d] - neurons.before[k, d]))
        if neurons.hits[k] == 0:
            settled = False
            continue
        neurons.template[kept] = neurons.template[k]
        neurons.module[kept] = neurons.module[k]
        neurons.age[kept] = neurons.age[k] + 1
        settled = settled and neurons.age[kept] > tau
        kept += 1
    return kept, moved, settled


@kernel
def _labelled(vectors: _Vectors, neurons: _Neurons, count: int, bounds: _Bounds) -> LabelArray:
    """The neuron that matches each vector best, (n,) int32; -1 where none does."""
    labels = np.full(len(vectors.module), -1, np.int32)
    for i in range(len(labels)):
        if vectors.module[i] < _ZERO_MODULE:
            continue
        best = bounds.vigilance
        for k in range(count):
            match = _degree(neurons.template, neurons.module, k, vectors, i, bounds)
            if match > best or (match == best and labels[i] < 0):
                best = match
                labels[i] = k
    return labels


@kernel
def _learn(
    xyz: FloatArray,
    order: IntArray,
    learning: _Learning,
) -> tuple[LabelArray, FloatArray, int, int]:
    """Labels, templates, epochs and comparisons; stops early once the comparisons pass the limit."""
    vectors = _with_modules(xyz)
    largest = 0.0
    for i in range(len(xyz)):
        largest = max(largest, vectors.module[i])
    bounds = _Bounds(learning.vigilance, math.cos(math.pi * (1.0 - learning.vigilance)) - _ROUNDING)
    neurons = _no_neurons(_ROOM)
    # in an epoch each vector keeps at most one neuron alive and makes at most one
    most = 2 * len(xyz)
    ranking = _Ranking(np.zeros(most, np.int64), np.zeros(most))
    count = 0
    work = 0
    epochs = 0
    for _ in range(learning.max_epochs):
        neurons.hits[:count] = 0
        neurons.before[:count] = neurons.template[:count]
        count_before = count
        made = False
        for i in order:
            if vectors.module[i] < _ZERO_MODULE:
                continue
            work += count + 1
            matches = _ranked(neurons, count, vectors, i, bounds, ranking)
            if matches == 0:
                neurons = _with_neuron(neurons, count, vectors, i)
                count += 1
                made = True
            else:
                _move_towards(xyz[i], neurons, ranking.neuron[:matches], learning)
        epochs += 1
        if work > learning.work_limit:
            return np.full(len(xyz), -1, np.int32), neurons.template[:count].copy(), epochs, work
        count, moved, settled = _end_epoch(neurons, count, count_before, learning.tau)
        if settled and not made and moved < _AT_REST * largest:
            break
    return _labelled(vectors, neurons, count, bounds), neurons.template[:count].copy(), epochs, work


@kernel(inline="always")
def _degree(
    template: FloatArray, template_module: FloatArray, k: int, vectors: _Vectors, i: int, bounds: _Bounds
) -> float:
    """VDM of neuron k and vector i (Eq. 3), or -1 where it is certain to stay below the vigilance."""
    # Both bounds are tested by multiplication first: nearly all comparisons end here.
    t_module, x_module = template_module[k], vectors.module[i]
    if t_module < _ZERO_MODULE or min(t_module, x_module) < bounds.vigilance * max(t_module, x_module):
        return -1.0
    xyz = vectors.xyz
    dot = template[k, 0] * xyz[i, 0] + template[k, 1] * xyz[i, 1] + template[k, 2] * xyz[i, 2]
    modules = t_module * x_module
    if dot < bounds.min_cosine * modules:
        return -1.0
    return float(_module_degree(t_module, x_module) * _angle_degree(dot / modules))
