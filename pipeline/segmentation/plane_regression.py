"""Best-fit planes z = b0 + b1 x + b2 y by least squares (Shorter and Kasparis, Eqs. 8 to 14), from sums per cluster.

The regression needs ten sums over the points of a cluster. The sums of a union are the sums of its two clusters, so
merging does not read the points again. They are added in the order of the points, so the planes do not depend on a
linear algebra library.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import add_to_sums, solve_plane_moments
from pipeline.model import FloatArray, LabelArray, Plane

N_SUMS = 10
"""n, x, y, z, xx, xy, yy, xz, yz, zz."""
_MIN_WIDTH_RATIO = 1e-3
"""A cluster narrower than this share of its length is a line: it holds no plane."""
_MIN_VARIANCE_M2 = 1e-9
"""Below this the points coincide in plan."""


@kernel
def add_point(sums: FloatArray, points: FloatArray, i: int) -> None:
    """Add point i to the ten sums of a cluster, in place."""
    add_to_sums(sums, points[i, 0], points[i, 1], points[i, 2])
    sums[9] += points[i, 2] * points[i, 2]


@kernel
def cluster_sums(points: FloatArray, labels: LabelArray, n_clusters: int) -> FloatArray:
    """The sums of Eq. 14 for every cluster: (n_clusters, 10) float64; labels below 0 are skipped."""
    sums = np.zeros((n_clusters, N_SUMS))
    for i in range(labels.size):
        k = labels[i]
        if k < 0:
            continue
        add_point(sums[k], points, i)
    return sums


@kernel
def best_fit_plane(sums: FloatArray) -> tuple[float, float, float, bool]:
    """The solution (b1, b2, b0) of Eq. 14 and whether there is one.

    Fewer than three points, points on one line in plan or in one place have none: they come back as the horizontal
    plane of their mean elevation and False.
    """
    n = sums[0]
    if n < 1.0:
        return 0.0, 0.0, 0.0, False
    x = sums[1] / n
    y = sums[2] / n
    z = sums[3] / n
    xx = sums[4] / n - x * x
    xy = sums[5] / n - x * y
    yy = sums[6] / n - y * y
    determinant = xx * yy - xy * xy
    spread = xx + yy
    if n < 3.0 or spread < _MIN_VARIANCE_M2 or determinant < (_MIN_WIDTH_RATIO * spread) ** 2:
        return 0.0, 0.0, z, False
    xz = sums[7] / n - x * z
    yz = sums[8] / n - y * z
    a, b = solve_plane_moments(xx, xy, yy, xz, yz)
    return a, b, z - a * x - b * y, True


@kernel
def mean_square_residual(sums: FloatArray, a: float, b: float, c: float) -> float:
    """SSE of Eq. 10 over n, for any plane, from the sums; vertical, square metres, never negative."""
    sse = (
        sums[9]
        + a * a * sums[4]
        + b * b * sums[6]
        + c * c * sums[0]
        + 2.0 * (a * b * sums[5] + a * c * sums[1] + b * c * sums[2])
        - 2.0 * (a * sums[7] + b * sums[8] + c * sums[3])
    )
    return float(max(0.0, sse / sums[0]))


@kernel
def height_above(points: FloatArray, i: int, a: float, b: float, c: float) -> float:
    """Vertical distance of point i above a plane, metres; negative below it."""
    return float(points[i, 2] - a * points[i, 0] - b * points[i, 1] - c)


@kernel
def has_company(
    points: FloatArray, neighbours: LabelArray, j: int, a: float, b: float, c: float, reach: float, share: float
) -> bool:
    """Whether at least a share of the neighbours of point j lies within a vertical reach of a plane."""
    known = 0
    near = 0
    for q in range(neighbours.shape[1]):
        other = neighbours[j, q]
        if other >= 0:
            known += 1
            near += abs(height_above(points, other, a, b, c)) <= reach
    return bool(near >= share * known)


@kernel
def cosine_of_slope(a: float, b: float) -> float:
    """Turns a vertical distance to the plane into a perpendicular one (Eq. 1)."""
    return 1.0 / math.sqrt(1.0 + a * a + b * b)


def describe_planes(points: FloatArray, planes: FloatArray, labels: LabelArray) -> tuple[Plane, ...]:
    """Planes with their support: count and root mean square vertical residual of the points that carry their label.

    Points (n, 3) are metres with original elevations, planes (k, 3) their (a, b, c), labels (n,) -1 for none.
    """
    planes = np.ascontiguousarray(planes, dtype=np.float64).reshape(-1, 3)
    support = _support(points, planes, labels).tolist()
    return tuple(
        Plane(a=a, b=b, c=c, n_points=int(count), rmse_m=rmse_m)
        for (a, b, c), (count, rmse_m) in zip(planes.tolist(), support, strict=True)
    )


@kernel
def _support(points: FloatArray, planes: FloatArray, labels: LabelArray) -> FloatArray:
    """Number of each plane's points and root mean square of their vertical residuals, 0 of none, (k, 2)."""
    sums = cluster_sums(points, labels, len(planes))
    support = np.zeros((len(planes), 2))
    for k in range(len(planes)):
        if sums[k, 0] > 0.0:
            support[k, 0] = sums[k, 0]
            support[k, 1] = math.sqrt(mean_square_residual(sums[k], planes[k, 0], planes[k, 1], planes[k, 2]))
    return support
