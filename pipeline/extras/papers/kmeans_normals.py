"""K-means of facet normals with the cosine as similarity (Zeng, Lai, Li, Mao and Liu 2008, section 2.1).

The facets of a TIN over one roof plane have similar normals, facets over another plane different ones: k-means with
"the cosine of [the] angle between normal vectors" groups them. The centre of a cluster is the direction of the sum of
its normals, which is what maximises the sum of cosines, so every round lowers the inertia, the sum of 1 - cosine.

The paper states neither the start nor the number of clusters. Here the start is deterministic, and the silhouette
judges the number: with the cosine distance the mean distance of a facet to a whole cluster is one minus its product
with the mean normal, so the silhouette is exact at the cost of one product per facet and cluster.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.extras.papers.clustering_settings import NormalClusteringSettings
from pipeline.kernels.sorting import counting_sort
from pipeline.model import FloatArray, LabelArray, Reason

_EQUAL_INERTIA = 1e-9
"""Starts whose inertia differs by less than this share of it ended in the same clusters."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FacetClusters:
    """Facets by direction."""

    labels: LabelArray
    """(m,) int32, cluster of every facet."""
    centres: FloatArray
    """(k, 3) float64, unit vectors, one a cluster; a cluster may have no facets."""
    inertia: float
    """Weighted sum of 1 - cosine between facets and their centres."""
    silhouette: float
    """Weighted mean silhouette with the cosine distance, -1 to 1; nan for one cluster."""
    rounds: int
    """Rounds until nothing changed."""


def cluster_normals(
    normals: FloatArray, weights: FloatArray, k: int, settings: NormalClusteringSettings
) -> FacetClusters:
    """K-means of unit normals (m, 3), at least one, with weights above 0, from farthest-point starts.

    The start with the least inertia counts, the first of equal ones; the numbers of the clusters follow it. There
    are fewer than `k` clusters where there are fewer different normals. Raises BuildingError ``too_complex`` where the
    products of facets with centres pass the limit.
    """
    normals, weights = np.ascontiguousarray(normals), np.ascontiguousarray(weights)
    farthest = farthest_point_start(normals, weights, k + settings.starts - 1)
    k = min(k, len(farthest))
    starts = max(1, len(farthest) - k + 1)
    best: tuple[LabelArray, FloatArray, float, int] | None = None
    products = 0
    for first in range(starts):
        allowed = (settings.kmeans_work_limit - products) // (len(normals) * k)
        max_rounds = min(settings.kmeans_rounds, allowed)
        found = kmeans(normals, weights, farthest[first : first + k], max_rounds) if max_rounds > 0 else None
        if found is None or found[3] == allowed < settings.kmeans_rounds:
            raise BuildingError(
                Reason.TOO_COMPLEX,
                f"k-means of {len(normals)} facets with {k} centres was not done after start {first + 1} of {starts}, "
                f"kmeans_work_limit is {settings.kmeans_work_limit}",
            )
        products += found[3] * len(normals) * k
        if best is None or found[2] < best[2] * (1.0 - _EQUAL_INERTIA):
            best = found
    assert best is not None
    labels, centres, inertia, rounds = best
    return FacetClusters(
        labels=labels,
        centres=centres,
        inertia=inertia,
        silhouette=silhouette(normals, weights, labels, len(centres)),
        rounds=rounds,
    )


def choose_clusters(
    normals: FloatArray,
    weights: FloatArray,
    explained: Callable[[LabelArray], float],
    settings: NormalClusteringSettings,
) -> FacetClusters:
    """K-means with the `clusters` of the settings, or for 0 with the k that the facets speak for.

    That has the largest sum of the silhouette and `residual_weight` times the share explained, of equal ones the
    smaller k. `explained` gives the share of points, 0 to 1, that lie on the planes of the clusters of labels (m,).
    Arguments and errors are otherwise those of `cluster_normals`.
    """
    if settings.clusters > 0:
        return cluster_normals(normals, weights, settings.clusters, settings)
    best, highest = cluster_normals(normals, weights, 1, settings), -math.inf
    for k in range(1, min(settings.max_clusters, len(normals)) + 1):
        clusters = cluster_normals(normals, weights, k, settings)
        if len(clusters.centres) < k:
            break
        apart = settings.one_cluster_silhouette if k == 1 else clusters.silhouette
        score = apart + settings.residual_weight * explained(clusters.labels)
        if score > highest:
            best, highest = clusters, score
    return best


@kernel
def farthest_point_start(normals: FloatArray, weights: FloatArray, k: int) -> FloatArray:
    """The first centres: the normal farthest from the mean direction, then always the one farthest from all chosen.

    Unit normals (m, 3) give centres (j, 3), j <= k: as many as there are different normals. Weights count for the mean
    direction. Equal distances: the lower index.
    """
    mean = np.zeros(3)
    for i in range(normals.shape[0]):
        for c in range(3):
            mean[c] += weights[i] * normals[i, c]
    nearest = np.full(normals.shape[0], -np.inf)
    chosen = np.empty((k, 3))
    centre = mean
    for j in range(k):
        lowest = np.inf
        farthest = -1
        for i in range(normals.shape[0]):
            cosine = normals[i, 0] * centre[0] + normals[i, 1] * centre[1] + normals[i, 2] * centre[2]
            if j == 0:
                similarity = cosine
            else:
                nearest[i] = max(nearest[i], cosine)
                similarity = nearest[i]
            if similarity < lowest:
                lowest = similarity
                farthest = i
        if j > 0 and lowest >= 1.0 - 1e-12:
            return chosen[:j].copy()
        chosen[j] = normals[farthest]
        centre = chosen[j]
    return chosen


@kernel
def kmeans(
    normals: FloatArray, weights: FloatArray, start: FloatArray, max_rounds: int
) -> tuple[LabelArray, FloatArray, float, int]:
    """Rounds of assignment to the most similar centre and of new centres, until no facet changes or for `max_rounds`.

    Unit normals (m, 3) have weights above 0; `start` (k, 3) are unit vectors.

    Returns
    -------
    labels : (m,) int32
        Cluster with the largest cosine, of equal ones the lowest.
    centres : (k, 3) float64
        Unit vectors; a cluster that lost all its facets keeps its centre.
    inertia : float
        Weighted sum of 1 - cosine.
    rounds : int
        Rounds done.
    """
    m, k = normals.shape[0], start.shape[0]
    centres = start.copy()
    labels = np.full(m, -1, np.int32)
    sums = np.empty((k, 3))
    inertia = 0.0
    rounds = 0
    for _ in range(max_rounds):
        rounds += 1
        changed = False
        inertia = 0.0
        sums[:] = 0.0
        for i in range(m):
            best = -2.0
            label = 0
            for j in range(k):
                cosine = normals[i, 0] * centres[j, 0] + normals[i, 1] * centres[j, 1] + normals[i, 2] * centres[j, 2]
                if cosine > best:
                    best = cosine
                    label = j
            if labels[i] != label:
                labels[i] = label
                changed = True
            inertia += weights[i] * (1.0 - best)
            for c in range(3):
                sums[label, c] += weights[i] * normals[i, c]
        if not changed:
            break
        for j in range(k):
            length = math.sqrt(sums[j, 0] ** 2 + sums[j, 1] ** 2 + sums[j, 2] ** 2)
            if length > 0.0:
                for c in range(3):
                    centres[j, c] = sums[j, c] / length
    return labels, centres, inertia, rounds


@kernel
def silhouette(normals: FloatArray, weights: FloatArray, labels: LabelArray, k: int) -> float:
    """Weighted mean silhouette (Rousseeuw 1987) with the distance 1 - cosine, -1 to 1, of unit normals (m, 3).

    A facet of weight 2 counts as two facets in one place, but one of them. `labels` (m,) are from 0 to k - 1. A cluster
    of one facet counts 0; the result is nan where fewer than two clusters have facets.
    """
    sums = np.zeros((k, 3))
    totals = np.zeros(k)
    counts = np.zeros(k, np.int64)
    for i in range(labels.size):
        totals[labels[i]] += weights[i]
        counts[labels[i]] += 1
        for c in range(3):
            sums[labels[i], c] += weights[i] * normals[i, c]
    if (counts > 0).sum() < 2:
        return math.nan
    total = 0.0
    weight = 0.0
    for i in range(labels.size):
        own = labels[i]
        weight += weights[i]
        if counts[own] < 2:
            continue
        within = 0.0
        beside = np.inf
        for j in range(k):
            if counts[j] == 0:
                continue
            cosines = normals[i, 0] * sums[j, 0] + normals[i, 1] * sums[j, 1] + normals[i, 2] * sums[j, 2]
            # distances to all facets of the cluster together; that to itself is 0
            together = max(0.0, totals[j] - cosines)
            if j == own:
                within = together / (totals[j] - weights[i])
            else:
                beside = min(beside, together / totals[j])
        larger = max(within, beside)
        if larger > 0.0:
            total += weights[i] * (beside - within) / larger
    return total / weight


@kernel
def labels_around(xyz: FloatArray, facets: LabelArray, facet_labels: LabelArray) -> LabelArray:
    """Cluster of every point: the one that most facets around the point belong to, by the sines of their angles there.

    The sine of the angle in plan is near 0 for slivers, such as a TIN has along its hull: their normals point anywhere.
    Points (n, 3) are the vertices of the facets, whose labels (m,) are -1 for none. Equal sums: the cluster of the
    facet that comes first; -1 where no labelled facet touches the point.
    """
    n = xyz.shape[0]
    vertices = np.empty(3 * len(facets), np.int32)
    for t in range(len(facets)):
        for k in range(3):
            vertices[3 * t + k] = facets[t, k]
    start, corner = counting_sort(vertices, n)
    most = -1
    for label in facet_labels:
        most = max(most, label)
    together = np.zeros(most + 1)
    labels = np.full(n, -1, np.int32)
    for i in range(n):
        for q in range(start[i], start[i + 1]):
            label = facet_labels[corner[q] // 3]
            if label >= 0:
                together[label] += _sine_in_plan(xyz, facets, corner[q] // 3, corner[q] % 3)
        largest = -1.0
        for q in range(start[i], start[i + 1]):
            label = facet_labels[corner[q] // 3]
            if label >= 0 and together[label] > largest:
                largest = together[label]
                labels[i] = label
        for q in range(start[i], start[i + 1]):
            label = facet_labels[corner[q] // 3]
            if label >= 0:
                together[label] = 0.0
    return labels


@kernel
def _sine_in_plan(xyz: FloatArray, facets: LabelArray, t: int, k: int) -> float:
    """Sine of the angle of a facet at one of its corners, in plan."""
    p = facets[t, k]
    q = facets[t, (k + 1) % 3]
    r = facets[t, (k + 2) % 3]
    ux = xyz[q, 0] - xyz[p, 0]
    uy = xyz[q, 1] - xyz[p, 1]
    vx = xyz[r, 0] - xyz[p, 0]
    vy = xyz[r, 1] - xyz[p, 1]
    return float(abs(ux * vy - uy * vx) / math.sqrt((ux * ux + uy * uy) * (vx * vx + vy * vy)))
