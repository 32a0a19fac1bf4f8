"""Planarity of a face: distances to its least-squares plane (code 203), normals of its triangles (code 204)."""

from __future__ import annotations

import numpy as np
from numba import njit

from pipeline.model import FloatArray, IntArray

_SWEEPS = 12
"""Jacobi sweeps: four reach machine precision for a 3 x 3 matrix, the others cost nothing then."""


@njit(cache=True, nogil=True)
def _smallest_axis(matrix: FloatArray) -> tuple[float, float, float]:
    """Unit eigenvector of the smallest eigenvalue of a symmetric 3 x 3 matrix, by cyclic Jacobi rotations."""
    axes = np.eye(3)
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
    least = 0
    for k in range(1, 3):
        if matrix[k, k] < matrix[least, least]:
            least = k
    return axes[0, least], axes[1, least], axes[2, least]


@njit(cache=True, nogil=True)
def distance_to_plane(corners: IntArray) -> float:
    """The largest distance in mm of corners (n, 3) to their least-squares plane; 0 for three corners."""
    count = len(corners)
    if count <= 3:
        return 0.0
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
    x, y, z = _smallest_axis(covariance)
    largest = 0.0
    for i in range(count):
        distance = abs(
            (float(corners[i, 0] - corners[0, 0]) - centre[0]) * x
            + (float(corners[i, 1] - corners[0, 1]) - centre[1]) * y
            + (float(corners[i, 2] - corners[0, 2]) - centre[2]) * z
        )
        largest = max(largest, distance)
    return largest


@njit(cache=True, nogil=True)
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
    return x / length, y / length, z / length


@njit(cache=True, nogil=True)
def least_cosine_of_normals(corners: IntArray, triangles: IntArray, enough: float) -> float:
    """Cosine of the largest angle between the normals of any two triangles of a face.

    Parameters
    ----------
    corners : (n, 3) int64
        Corners of the face in mm.
    triangles : (t, 3) int64
        Indices into corners; no triangle is degenerate.
    enough : float
        The search ends once the cosine is below this threshold.

    Returns
    -------
    float
        1 for a plane; some value below `enough` where there is one.
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
