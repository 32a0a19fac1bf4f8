"""The bounds of points in plan."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import IntArray


@kernel
def bounds_of(xy: IntArray) -> tuple[IntArray, IntArray]:
    """The lowest and the highest x and y of at least one point (n, 2): two arrays (2,).

    numpy takes many times longer along the first axis of such an array.
    """
    x0, y0 = xy[0, 0], xy[0, 1]
    x1, y1 = x0, y0
    for i in range(1, len(xy)):
        x0, x1 = min(x0, xy[i, 0]), max(x1, xy[i, 0])
        y0, y1 = min(y0, xy[i, 1]), max(y1, xy[i, 1])
    return np.array([x0, y0]), np.array([x1, y1])
