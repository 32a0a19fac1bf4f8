"""Faces in a plane: corners projected along the dominant axis of the normal, where millimetres stay integers."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import IntArray


@kernel
def area_vector(corners: IntArray, start: int, stop: int) -> tuple[int, int, int]:
    """Twice the vector area of the ring corners[start:stop] (Newell's normal), in mm2: exact."""
    x = y = z = 0
    for i in range(start + 1, stop - 1):
        ax, ay, az = (
            corners[i, 0] - corners[start, 0],
            corners[i, 1] - corners[start, 1],
            corners[i, 2] - corners[start, 2],
        )
        bx, by, bz = (
            corners[i + 1, 0] - corners[start, 0],
            corners[i + 1, 1] - corners[start, 1],
            corners[i + 1, 2] - corners[start, 2],
        )
        x += ay * bz - az * by
        y += az * bx - ax * bz
        z += ax * by - ay * bx
    return x, y, z


@kernel
def project_along_dominant_axis(corners: IntArray, outer_stop: int) -> tuple[IntArray, bool]:
    """Drop the coordinate in which the outer ring's normal is longest.

    The first `outer_stop` corners of all rings, (n, 3) int64 in mm, are the outer ring. Returns all in the plane,
    (n, 2), the outer ring counter-clockwise; and False where it encloses no area.
    """
    x, y, z = area_vector(corners, 0, outer_stop)
    flat = np.empty((len(corners), 2), np.int64)
    if abs(z) >= abs(x) and abs(z) >= abs(y):
        first, second, turn = 0, 1, z
    elif abs(y) >= abs(x):
        first, second, turn = 2, 0, y
    else:
        first, second, turn = 1, 2, x
    if turn < 0:
        first, second = second, first
    for i in range(len(corners)):
        flat[i, 0] = corners[i, first] - corners[0, first]
        flat[i, 1] = corners[i, second] - corners[0, second]
    return flat, turn != 0
