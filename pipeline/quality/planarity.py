"""Planarity of a face: distances to its least-squares plane (code 203), normals of its triangles (code 204)."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order
from pipeline.model import FloatArray, IntArray

_SWEEPS = 12
"""Jacobi sweeps: four reach machine precision for a 3 x 3 matrix, the others cost nothing then."""
MICROMETRES_PER_MILLIMETRE = 1e3
_LARGEST = 5e8  # coordinates stay below it: a wider face uses a coarser unit


@kernel
def _principal_axes(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (3,) and unit eigenvectors, the columns of (3, 3), of a symmetric matrix: cyclic Jacobi rotations.

    The smallest comes first.
    """
    axes = np.zeros((3, 3))
    axes[0, 0] = axes[1, 1] = axes[2, 2] = 1.0
    for _ in range(_SWEEPS):
        rest = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if rest <= 1e-18 * (matrix[0, 0] + matrix[1, 1] + matrix[2, 2]):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
                    continue
                theta = (matrix[q, q] - matrix[p, p]) / (2.0 * matrix[p, q])
                sign = 1.0 if theta >= 0.0 else -1.0
                tangent = sign / (abs(theta) + np.sqrt(theta * theta + 1.0))
                cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
                sine = tangent * cosine
                for k in range(3):
                    kp, kq = matrix[k, p], matrix[k, q]
                    matrix[k, p], matrix[k, q] = cosine * kp - sine * kq, sine * kp + cosine * kq
                for k in range(3):
                    pk, qk = matrix[p, k], matrix[q, k]
                    matrix[p, k], matrix[q, k] = cosine * pk - sine * qk, sine * pk + cosine * qk
                for k in range(3):
                    kp, kq = axes[k, p], axes[k, q]
                    axes[k, p], axes[k, q] = cosine * kp - sine * kq, sine * kp + cosine * kq
    diagonal = np.empty(3)
    for k in range(3):
        diagonal[k] = matrix[k, k]
    order = ascending_order(diagonal)
    values, sorted_axes = np.empty(3), np.empty((3, 3))
    for m in range(3):
        values[m] = diagonal[order[m]]
        for k in range(3):
            sorted_axes[k, m] = axes[k, order[m]]
    return values, sorted_axes


@kernel
def fitted_plane(corners: IntArray) -> tuple[float, float, FloatArray]:
    """The least-squares plane of a face, by the corners (n, 3) of all its rings in mm.

    Returns the largest distance of a corner to the plane, mm; how far the corners spread across the face in the plane,
    over how far they spread along it; and (3, 3) with the columns unit normal, direction across, direction along.
    """
    count = len(corners)
    centre = np.zeros(3)
    for i in range(count):
        for k in range(3):
            centre[k] += float(corners[i, k] - corners[0, k])
    for k in range(3):
        centre[k] /= count
    covariance = np.zeros((3, 3))
    for i in range(count):
        for k in range(3):
            at_k = float(corners[i, k] - corners[0, k]) - centre[k]
            for m in range(3):
                covariance[k, m] += at_k * (float(corners[i, m] - corners[0, m]) - centre[m])
    values, axes = _principal_axes(covariance)
    largest = 0.0
    for i in range(count):
        distance = 0.0
        for k in range(3):
            distance += (float(corners[i, k] - corners[0, k]) - centre[k]) * axes[k, 0]
        largest = max(largest, abs(distance))
    return largest, np.sqrt(max(values[1], 0.0) / values[2]) if values[2] > 0.0 else 0.0, axes


@kernel
def bends_where_it_is_straight(corners: IntArray, ring_offsets: IntArray, axes: FloatArray, min_cosine: float) -> bool:
    """Whether three consecutive corners of a ring span a triangle that is tilted against the face.

    Corners that lie nearly on one line do, by the rounding of their coordinates to millimetres.
    """
    for r in range(len(ring_offsets) - 1):
        start, stop = ring_offsets[r], ring_offsets[r + 1]
        for i in range(start, stop):
            before = i - 1 if i > start else stop - 1
            after = i + 1 if i + 1 < stop else start
            x, y, z = _unit_normal(corners, before, i, after)
            if abs(x * axes[0, 0] + y * axes[1, 0] + z * axes[2, 0]) < min_cosine:
                return True
    return False


@kernel
def in_fitted_plane(corners: IntArray, axes: FloatArray) -> IntArray:
    """Corners (n, 3) projected onto their least-squares plane: micrometres across and along it, and 0.

    Coarser in faces of more than a kilometre, so that products of two fit into 64 bits.
    """
    extent = 1.0
    for i in range(len(corners)):
        for k in range(3):
            extent = max(extent, abs(float(corners[i, k] - corners[0, k])))
    scale = min(MICROMETRES_PER_MILLIMETRE, _LARGEST / extent)
    flat = np.zeros((len(corners), 3), np.int64)
    for i in range(len(corners)):
        for m in range(2):
            place = 0.0
            for k in range(3):
                place += float(corners[i, k] - corners[0, k]) * axes[k, 1 + m]
            flat[i, m] = round(place * scale)
    return flat


@kernel
def _unit_normal(corners: IntArray, a: int, b: int, c: int) -> tuple[float, float, float]:
    """Unit normal of a triangle."""
    ux = float(corners[b, 0] - corners[a, 0])
    uy = float(corners[b, 1] - corners[a, 1])
    uz = float(corners[b, 2] - corners[a, 2])
    vx = float(corners[c, 0] - corners[a, 0])
    vy = float(corners[c, 1] - corners[a, 1])
    vz = float(corners[c, 2] - corners[a, 2])
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = np.sqrt(x * x + y * y + z * z)
    return (x / length, y / length, z / length) if length > 0.0 else (0.0, 0.0, 0.0)


@kernel
def min_cosine_of_normals(corners: IntArray, triangles: IntArray, enough: float) -> float:
    """Cosine of the largest angle between the normals of any two triangles of a face; 1 for a plane.

    Triangles (t, 3) index corners (n, 3) in mm; none is degenerate. The search ends at a cosine below `enough`.
    """
    count = len(triangles)
    normals = np.empty((count, 3))
    for t in range(count):
        normals[t, 0], normals[t, 1], normals[t, 2] = _unit_normal(
            corners, triangles[t, 0], triangles[t, 1], triangles[t, 2]
        )
    least = 1.0
    for t in range(count):
        for s in range(t):
            cosine = normals[t, 0] * normals[s, 0] + normals[t, 1] * normals[s, 1] + normals[t, 2] * normals[s, 2]
            least = min(least, cosine)
        if least < enough:
            break
    return least
