"""The shell as a mesh: closed, 2-manifold, connected, consistently oriented (ISO 19107, codes 302 to 307).

Faces enter as their triangles, so that an inner ring which touches the outer one is judged by the interior between
them. An edge is manifold where exactly two triangles run along it in opposite directions; a vertex, where its
triangles form one umbrella.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.union_find import root_of, unite
from pipeline.model import BoolArray, IntArray
from pipeline.triangulation.edge_flips import edges_in_order

SHELL_NOT_CLOSED = 302
NON_MANIFOLD_CASE = 303
MULTIPLE_CONNECTED_COMPONENTS = 305
POLYGON_WRONG_ORIENTATION = 307


@kernel
def is_sound_shell(triangles: IntArray, vertex_count: int, found: BoolArray) -> bool:
    """Whether the mesh is a 2-manifold without border; sets found[code] for every fault: 302, 303, 305, 307.

    Triangles (t, 3) of all faces index vertices below `vertex_count`; none uses a vertex twice.
    """
    keys, order = edges_in_order(triangles, len(triangles), vertex_count)
    component = np.arange(len(triangles))
    umbrella = np.arange(3 * len(triangles))
    manifold = True
    start = 0
    while start < len(keys):
        stop = start + 1
        while stop < len(keys) and keys[order[stop]] == keys[order[start]]:
            stop += 1
        first = order[start]
        for i in range(start + 1, stop):
            unite(component, first // 3, order[i] // 3)
        if stop - start == 1:
            found[SHELL_NOT_CLOSED] = True
            manifold = False
        elif stop - start > 2:
            found[NON_MANIFOLD_CASE] = True
            manifold = False
        else:
            t, k, s, m = first // 3, first % 3, order[start + 1] // 3, order[start + 1] % 3
            if triangles[t, k] == triangles[s, m]:
                found[POLYGON_WRONG_ORIENTATION] = True
                manifold = False
            else:
                unite(umbrella, 3 * t + k, 3 * s + (m + 1) % 3)
                unite(umbrella, 3 * t + (k + 1) % 3, 3 * s + m)
        start = stop
    sound = manifold
    for t in range(len(triangles)):
        if root_of(component, t) != root_of(component, 0):
            found[MULTIPLE_CONNECTED_COMPONENTS] = True
            sound = False
    if not manifold:
        return False
    umbrella_of = np.full(vertex_count, -1)
    for t in range(len(triangles)):
        for k in range(3):
            root = root_of(umbrella, 3 * t + k)
            vertex = triangles[t, k]
            if umbrella_of[vertex] < 0:
                umbrella_of[vertex] = root
            elif umbrella_of[vertex] != root:
                found[NON_MANIFOLD_CASE] = True
                sound = False
    return sound


@kernel
def six_volumes(vertices: IntArray, triangles: IntArray) -> float:
    """Six times the volume that the triangles enclose in mm3, positive where they face outward."""
    total = 0.0
    x0, y0, z0 = vertices[triangles[0, 0], 0], vertices[triangles[0, 0], 1], vertices[triangles[0, 0], 2]
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = float(vertices[a, 0] - x0), float(vertices[a, 1] - y0), float(vertices[a, 2] - z0)
        bx, by, bz = float(vertices[b, 0] - x0), float(vertices[b, 1] - y0), float(vertices[b, 2] - z0)
        cx, cy, cz = float(vertices[c, 0] - x0), float(vertices[c, 1] - y0), float(vertices[c, 2] - z0)
        total += ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    return total
