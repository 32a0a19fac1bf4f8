"""Terrain samples that lie beside a building, not beneath it: a TIN of both would shatter the roof."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import counting_sort
from pipeline.model import BoolArray, FloatArray


@kernel
def far_from(samples: FloatArray, points: FloatArray, distance_m: float) -> BoolArray:
    """Which samples (m, 3) have none of the points (n, 3), at least one, within a distance above 0 in plan; metres."""
    x_min, y_min, x_max, y_max = np.inf, np.inf, -np.inf, -np.inf
    for i in range(len(points)):
        x_min, y_min = min(x_min, points[i, 0]), min(y_min, points[i, 1])
        x_max, y_max = max(x_max, points[i, 0]), max(y_max, points[i, 1])
    columns, rows = int((x_max - x_min) / distance_m) + 1, int((y_max - y_min) / distance_m) + 1
    cell = np.empty(len(points), np.int32)
    for i in range(len(points)):
        cell[i] = int((points[i, 1] - y_min) / distance_m) * columns + int((points[i, 0] - x_min) / distance_m)
    start, order = counting_sort(cell, columns * rows)
    far = np.ones(samples.shape[0], np.bool_)
    for s in range(samples.shape[0]):
        x = samples[s, 0]
        y = samples[s, 1]
        column = int(np.floor((x - x_min) / distance_m))
        row = int(np.floor((y - y_min) / distance_m))
        left = max(column - 1, 0)
        right = min(column + 1, columns - 1)
        if left > right:
            continue
        for r in range(max(row - 1, 0), min(row + 1, rows - 1) + 1):
            for q in range(start[r * columns + left], start[r * columns + right + 1]):
                dx = points[order[q], 0] - x
                dy = points[order[q], 1] - y
                if dx * dx + dy * dy <= distance_m * distance_m:
                    far[s] = False
                    break
            if not far[s]:
                break
    return far
