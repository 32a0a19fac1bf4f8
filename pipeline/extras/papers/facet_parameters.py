"""The parameter space of a TIN: slope, orientation and O-distance of every facet (Hofmann et al. 2003, section 2).

Coordinates are reduced to the barycentre of the point cloud; three points of a facet make a plane, and its slope,
orientation and signed distance from the origin are one point of the space.
"""

from __future__ import annotations

import numpy as np

from pipeline.model import FloatArray, LabelArray
from pipeline.segmentation.facet_geometry import aspects_deg, facet_normals, o_distances_m, slopes_deg

SLOPE, ORIENTATION, O_DISTANCE = 0, 1, 2
"""Columns of the parameters."""


def about_barycentre(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) about their mean (section 2), and that barycentre, (3,).

    At least one point, in metres of whole millimetres; the barycentre is taken from sums of whole millimetres, so it
    does not depend on the order of the points.
    """
    barycentre = np.rint(points * 1000.0).astype(np.int64).sum(axis=0) / (1000.0 * len(points))
    return points - barycentre, barycentre


def facet_parameters(points: FloatArray, facets: LabelArray) -> FloatArray:
    """Slope, orientation and O-distance of facets over points in metres about the barycentre (sections 2 and 4).

    Returns
    -------
    (m, 3) float64
        Slope in degrees, 0 to 90; orientation, the direction of steepest descent, in degrees clockwise from north in
        [0, 360), 0 where horizontal; distance of the plane from the origin in metres, positive above it.

    Examples
    --------
    >>> roof = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 2]])
    >>> facet_parameters(roof, np.array([[0, 1, 2]], np.int32)).round(3).tolist()
    [[45.0, 180.0, 0.707]]
    """
    normals = facet_normals(np.ascontiguousarray(points), facets)
    return np.column_stack([slopes_deg(normals), aspects_deg(normals), o_distances_m(normals, points[facets[:, 0]])])


def cluster_means(parameters: FloatArray, labels: LabelArray, n_clusters: int) -> FloatArray:
    """Mean slope, orientation and O-distance of clusters, (n_clusters, 3); 0 for clusters without members.

    `parameters` (m, 3) are those of `facet_parameters`, `labels` (m,) the clusters of the facets, -1 for none. The
    orientation's mean is that of directions on a circle.
    """
    means = np.zeros((n_clusters, 3))
    for k in range(n_clusters):
        own = parameters[labels == k]
        if len(own):
            turns = np.radians(own[:, ORIENTATION])
            direction = np.degrees(np.arctan2(np.sin(turns).sum(), np.cos(turns).sum())) % 360.0
            means[k] = own[:, SLOPE].mean(), direction % 360.0, own[:, O_DISTANCE].mean()
    return means
