"""Clusters of the facets of a TIN: their connected parts and their points."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, LabelArray


@kernel
def connected_parts(labels: LabelArray, neighbours: LabelArray) -> LabelArray:
    """Number the parts of equal label that hang together over edges, (m,) int32, by their first facets.

    `labels` (m,) and the facets across the edges, `neighbours` (m, 3), are -1 for none and at the hull. Facets with the
    label -1 keep it.
    """
    parts = np.full(labels.size, -1, np.int32)
    stack = np.empty(labels.size, np.int32)
    count = 0
    for seed in range(labels.size):
        if labels[seed] < 0 or parts[seed] >= 0:
            continue
        parts[seed] = count
        stack[0] = seed
        top = 1
        while top > 0:
            top -= 1
            t = stack[top]
            for k in range(3):
                other = neighbours[t, k]
                if other >= 0 and parts[other] < 0 and labels[other] == labels[t]:
                    parts[other] = count
                    stack[top] = other
                    top += 1
        count += 1
    return parts


@kernel
def labels_of_points(
    facets: LabelArray,
    facet_labels: LabelArray,
    areas_m2: FloatArray,
    vertex_point: LabelArray,
    facet_of_point: LabelArray,
) -> LabelArray:
    """Cluster of every point: that of the facet that absorbed it, or of the largest labelled facet at its vertex.

    The result is (n,) int32, -1 where no labelled facet holds or touches the point.

    Parameters
    ----------
    facets : (m, 3) int32
        Vertex indices.
    facet_labels : (m,) int32
        Cluster of every facet, -1 for none.
    areas_m2 : (m,) float64
        Equal areas: the facet with the smaller index.
    vertex_point : (v,) int32
        Point at every vertex, -1 where there is none.
    facet_of_point : (n,) int32
        Facet that holds a point that is not a vertex, else -1.
    """
    labels = np.full(facet_of_point.size, -1, np.int32)
    largest = np.zeros(facet_of_point.size)
    for i in range(facet_of_point.size):
        if facet_of_point[i] >= 0:
            labels[i] = facet_labels[facet_of_point[i]]
    for t in range(facets.shape[0]):
        if facet_labels[t] < 0:
            continue
        for k in range(3):
            i = vertex_point[facets[t, k]]
            if i >= 0 and areas_m2[t] > largest[i]:
                largest[i] = areas_m2[t]
                labels[i] = facet_labels[t]
    return labels
