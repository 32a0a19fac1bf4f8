"""Nodes of dense points: means of cells, one for each stack of points."""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order
from pipeline.model import FloatArray, LabelArray


@kernel
def mean_nodes(points: FloatArray, cell_m: float, gap_m: float) -> tuple[FloatArray, LabelArray]:
    """Means of the points of every lattice cell, one for each stack of points that a vertical gap parts from others.

    From points (n, 3), metres; gaps part them from the height `gap_m` on. Returns the nodes (m, 3), by cell in x and y,
    in a cell the lowest first, and the node of every point, (n,) int32.
    """
    n = len(points)
    row = np.empty(n, np.int64)
    first_row, last_row = math.floor(points[0, 1] / cell_m), math.floor(points[0, 1] / cell_m)
    for i in range(n):
        row[i] = math.floor(points[i, 1] / cell_m)
        first_row, last_row = min(first_row, row[i]), max(last_row, row[i])
    cell = np.empty(n, np.int64)
    for i in range(n):
        cell[i] = math.floor(points[i, 0] / cell_m) * (last_row + 1 - first_row) + (row[i] - first_row)
    order = ascending_order(cell)
    nodes = np.zeros((n, 3))
    node_of = np.empty(n, np.int32)
    count = 0
    begin = 0
    while begin < n:
        end = begin + 1
        while end < n and cell[order[end]] == cell[order[begin]]:
            i = order[end]
            q = end
            while q > begin and points[order[q - 1], 2] > points[i, 2]:
                order[q] = order[q - 1]
                q -= 1
            order[q] = i
            end += 1
        held = 0
        for q in range(begin, end):
            i = order[q]
            if held > 0 and points[i, 2] - points[order[q - 1], 2] > gap_m:
                for axis in range(3):
                    nodes[count, axis] /= held
                count += 1
                held = 0
            node_of[i] = count
            for axis in range(3):
                nodes[count, axis] += points[i, axis]
            held += 1
        for axis in range(3):
            nodes[count, axis] /= held
        count += 1
        begin = end
    return nodes[:count].copy(), node_of
