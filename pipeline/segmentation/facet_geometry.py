"""Facets and the planes of their points, as the papers' methods measure them: normals, slopes, areas, noise.

Planes are z = a x + b y + c. Equations are those of Shorter & Kasparis.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.geometry import nearest_neighbours
from pipeline.kernels.normal_equations import moments_of, solve_plane_moments
from pipeline.model import BoolArray, FloatArray, LabelArray, Plane
from pipeline.segmentation.plane_regression import best_fit_plane, cluster_sums

_LOWER_QUARTILE_CHI2 = (math.nan, 0.10153, 0.57536, 1.21253, 1.92256, 2.67460, 3.45460)
"""Lower quartile of the chi-squared distribution with 0 to 6 degrees of freedom."""


@kernel
def facet_normals(xyz: FloatArray, facets: LabelArray) -> FloatArray:
    """Unit normals of facets, (m, 3), pointing up: z is never negative; (0, 0, 0) for a facet without area."""
    normals = np.zeros((len(facets), 3))
    for t in range(len(facets)):
        i, j, k = facets[t, 0], facets[t, 1], facets[t, 2]
        ux, uy, uz = xyz[j, 0] - xyz[i, 0], xyz[j, 1] - xyz[i, 1], xyz[j, 2] - xyz[i, 2]
        vx, vy, vz = xyz[k, 0] - xyz[i, 0], xyz[k, 1] - xyz[i, 1], xyz[k, 2] - xyz[i, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        if length > 0.0:
            if nz < 0.0:
                length = -length
            normals[t, 0] = nx / length
            normals[t, 1] = ny / length
            normals[t, 2] = nz / length
    return normals


def slopes_deg(normals: FloatArray) -> FloatArray:
    """Slope of each unit normal, (m,) float64: 0 horizontal, 90 vertical (and for the null normal of no area)."""
    return np.degrees(np.arctan2(np.hypot(normals[:, 0], normals[:, 1]), normals[:, 2])) + np.where(
        (normals == 0.0).all(axis=1), 90.0, 0.0
    )


def aspects_deg(normals: FloatArray) -> FloatArray:
    """Direction of steepest descent of each upward normal, (m,) float64 clockwise from north in [0, 360); flat: 0."""
    aspects = np.degrees(np.arctan2(normals[:, 0], normals[:, 1])) % 360.0
    flat = (normals[:, 0] == 0.0) & (normals[:, 1] == 0.0)
    return np.where(flat | (aspects >= 360.0), 0.0, aspects)


@kernel
def facet_areas_m2(xyz: FloatArray, facets: LabelArray) -> FloatArray:
    """Surface area of every facet, (m,) float64, square metres."""
    areas = np.empty(len(facets))
    for t in range(len(facets)):
        i, j, k = facets[t, 0], facets[t, 1], facets[t, 2]
        ux, uy, uz = xyz[j, 0] - xyz[i, 0], xyz[j, 1] - xyz[i, 1], xyz[j, 2] - xyz[i, 2]
        vx, vy, vz = xyz[k, 0] - xyz[i, 0], xyz[k, 1] - xyz[i, 1], xyz[k, 2] - xyz[i, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        areas[t] = 0.5 * math.sqrt(nx * nx + ny * ny + nz * nz)
    return areas


def facet_centroids(xyz: FloatArray, facets: LabelArray) -> FloatArray:
    """Centroid of every facet, (m, 3) float64."""
    return (xyz[facets[:, 0]] + xyz[facets[:, 1]] + xyz[facets[:, 2]]) / 3.0


def o_distances_m(normals: FloatArray, points: FloatArray) -> FloatArray:
    """Signed distance from the origin to the planes through points, (m,) float64.

    Positive where the plane is above the origin (Hofmann et al. 2003). For facets pass their upward unit normals and
    any one vertex each, (m, 3).
    """
    return normals[:, 0] * points[:, 0] + normals[:, 1] * points[:, 1] + normals[:, 2] * points[:, 2]


@kernel
def fit_plane_coefficients(points: FloatArray, index: LabelArray) -> tuple[float, float, float, float]:
    """Least-squares plane z = a x + b y + c of some points (Eqs. 8 to 14), for use in compiled code.

    `index` (k,), at least one, says which of the points (n, 3). Returns a, b, c and the sum of squared vertical
    residuals in m2 (Eq. 10). Collinear points: `solve_plane_moments`.
    """
    found = moments_of(points, index)
    a, b = solve_plane_moments(found.xx, found.xy, found.yy, found.xz, found.yz)
    sse = 0.0
    for i in index:
        residual = points[i, 2] - found.z - a * (points[i, 0] - found.x) - b * (points[i, 1] - found.y)
        sse += residual * residual
    return a, b, found.z - a * found.x - b * found.y, sse


def fit_plane(points: FloatArray) -> Plane:
    """Least-squares plane z = a x + b y + c of points (n, 3) (Shorter & Kasparis, Eqs. 8 to 14).

    Points collinear in plan give the plane that is level across their line; a single position a horizontal one. Raises
    ValueError without points.

    Examples
    --------
    >>> fit_plane(np.array([[0.0, 0, 1], [1, 0, 1.5], [0, 1, 1], [1, 1, 1.5]])).coefficients
    (0.5, 0.0, 1.0)
    """
    if len(points) == 0:
        raise ValueError("no points to fit a plane to")
    a, b, c, sse = fit_plane_coefficients(np.ascontiguousarray(points), np.arange(len(points), dtype=np.int32))
    return Plane(a=a, b=b, c=c, n_points=len(points), rmse_m=math.sqrt(sse / len(points)))


def vertical_residuals_m(points: FloatArray, coefficients: tuple[float, float, float]) -> FloatArray:
    """Height of points above the plane (a, b, c), (n,) float64 metres, signed."""
    a, b, c = coefficients
    return points[:, 2] - (a * points[:, 0] + b * points[:, 1] + c)


@kernel
def _local_plane_sse(points: FloatArray, neighbours: LabelArray) -> FloatArray:
    """Sum of squared vertical residuals of each point and its neighbours to their own plane, (n,) m2."""
    n, k = neighbours.shape
    sse = np.empty(n)
    index = np.empty(k + 1, np.int32)
    for i in range(n):
        index[0] = i
        index[1:] = neighbours[i]
        sse[i] = fit_plane_coefficients(points, index)[3]
    return sse


def noise_sigma_m(points: FloatArray) -> float:
    """Robust standard deviation of the vertical noise, from the planes of nine neighbouring points each.

    The lower quartile over all points of the local root mean square residual, scaled by what it is for normal noise:
    neighbourhoods across edges and in trees are the upper part of the distribution and do not count. In metres; nan for
    fewer than four points.
    """
    freedom = min(9, len(points)) - 3
    if freedom < 1:
        return math.nan
    xyz = np.ascontiguousarray(points, dtype=np.float64)
    neighbours = nearest_neighbours(xyz[:, :2], freedom + 2)
    quartile = float(np.percentile(_local_plane_sse(xyz, neighbours), 25.0))
    return math.sqrt(quartile / _LOWER_QUARTILE_CHI2[freedom])


def kept_clusters(labels: LabelArray, values: FloatArray, kept: BoolArray) -> tuple[LabelArray, FloatArray]:
    """The clusters `kept` (k,), renumbered in their order: labels, -1 for none, and the values (k, ...) of each."""
    number = np.full(len(kept) + 1, -1, np.int32)
    number[:-1][kept] = np.arange(int(kept.sum()), dtype=np.int32)
    return number[labels], values[kept]


def best_fit_planes(
    points: FloatArray, labels: LabelArray, n_clusters: int, min_points: int = 0
) -> tuple[FloatArray, LabelArray]:
    """Planes (a, b, c) of the clusters that have one and enough points, (k, 3), and the labels renumbered."""
    sums = cluster_sums(points, labels, n_clusters)
    fits = [best_fit_plane(row) for row in sums]
    kept = np.array([fit[3] and row[0] >= min_points for fit, row in zip(fits, sums, strict=True)], np.bool_)
    labels, planes = kept_clusters(labels, np.array([fit[:3] for fit in fits]).reshape(-1, 3), kept)
    return planes, labels
