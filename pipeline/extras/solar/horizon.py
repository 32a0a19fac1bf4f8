"""Horizons of points among roofs, exact in each direction.

The models have no overhangs, so a direction is blocked if and only if it is below the horizon of its azimuth. Along a
ray in plan over one plane, the tangent of the elevation angle, (a + b r) / r, is monotonic in the distance r. So it is
largest where the ray crosses an edge of the face, and the horizon is that of the edges of all faces.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely

from pipeline.compiler import kernel
from pipeline.extras.solar.sectors import SECTOR_RAD, SECTORS
from pipeline.model import FloatArray, IntArray

_NEAREST_M = 1e-6
"""An edge nearer than this is under the point."""


class Obstacles(NamedTuple):
    """Edges of roofs, by building."""

    edges: FloatArray
    """(m, 6) ends x, y, z, x, y, z in metres, ordered by building."""
    starts: IntArray
    """(b + 1,) the first edge of each building, and the number of edges."""
    boxes: FloatArray
    """(b, 5) smallest x and y, largest x, y and z of each building."""


def obstacles_of(edges: FloatArray, building: IntArray) -> Obstacles:
    """Edges (m, 6) in the order of their buildings (m,) as obstacles; buildings without edges are left out."""
    starts = np.flatnonzero(np.diff(building, prepend=-1))
    low = np.minimum.reduceat(np.minimum(edges[:, :3], edges[:, 3:]), starts) if len(starts) else np.zeros((0, 3))
    high = np.maximum.reduceat(np.maximum(edges[:, :3], edges[:, 3:]), starts) if len(starts) else np.zeros((0, 3))
    return Obstacles(
        edges=np.ascontiguousarray(edges),
        starts=np.append(starts, len(edges)).astype(np.int64),
        boxes=np.ascontiguousarray(np.column_stack([low[:, :2], high])),
    )


def horizons(points: FloatArray, groups: IntArray, obstacles: Obstacles, reach_m: float) -> FloatArray:
    """Tangents of the horizon's elevation in each sector, (n, SECTORS), at least 0.

    Parameters
    ----------
    points : FloatArray
        (n, 3) points in metres.
    groups : IntArray
        (n,) ascending numbers of groups of neighbouring points, which look for obstacles together.
    obstacles : Obstacles
        Everything that may block the sky.
    reach_m : float
        Buildings whose boxes are within this distance in plan count.
    """
    if not len(points):
        return np.zeros((0, SECTORS))
    starts = np.flatnonzero(np.diff(groups, prepend=-1))
    low, high = np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)
    tree = shapely.STRtree(shapely.box(*obstacles.boxes[:, :4].T))
    # of the boxes alone; the kernel measures from each point
    group, near = tree.query(shapely.box(*(low[:, :2] - reach_m).T, *(high[:, :2] + reach_m).T))
    order = np.lexsort((near, group))
    ends = np.searchsorted(group[order], np.arange(len(starts) + 1))
    owner = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(points))))
    found: FloatArray = _horizons(
        np.ascontiguousarray(points),
        owner.astype(np.int64),
        ends.astype(np.int64),
        near[order].astype(np.int64),
        obstacles,
        float(reach_m),
    )
    return found


@kernel
def _horizons(
    points: FloatArray,
    owner: IntArray,
    near_starts: IntArray,
    near: IntArray,
    obstacles: Obstacles,
    reach_m: float,
) -> FloatArray:
    """(n, SECTORS) tangents of the horizon of points (n, 3); `near` lists the buildings near each owner of points."""
    edges, starts, boxes = obstacles
    found = np.zeros((len(points), SECTORS))
    cos, sin = np.empty(SECTORS), np.empty(SECTORS)
    for sector in range(SECTORS):
        cos[sector], sin[sector] = math.cos(sector * SECTOR_RAD), math.sin(sector * SECTOR_RAD)
    for i in range(len(points)):
        x, y, z = points[i]
        for k in range(near_starts[owner[i]], near_starts[owner[i] + 1]):
            building = near[k]
            box = boxes[building]
            aside = max(box[0] - x, x - box[2], 0.0)
            along = max(box[1] - y, y - box[3], 0.0)
            if box[4] <= z or aside * aside + along * along > reach_m * reach_m:
                continue
            for e in range(starts[building], starts[building + 1]):
                if edges[e, 2] > z or edges[e, 5] > z:
                    _raise(found[i], edges[e], (x, y, z), cos, sin)
    return found


@kernel
def _raise(
    tangents: FloatArray, edge: FloatArray, place: tuple[float, float, float], cos: FloatArray, sin: FloatArray
) -> None:
    """Raise the horizon (SECTORS,) of a place by one edge (6,), at the centres of the sectors that it covers."""
    ax, ay, az = edge[0] - place[0], edge[1] - place[1], edge[2] - place[2]
    bx, by, bz = edge[3] - place[0], edge[4] - place[1], edge[5] - place[2]
    first = math.atan2(ax, ay) / SECTOR_RAD
    last = math.atan2(bx, by) / SECTOR_RAD
    if last - first > SECTORS / 2:
        last -= SECTORS
    elif last - first < -SECTORS / 2:
        last += SECTORS
    for number in range(math.ceil(min(first, last)), math.floor(max(first, last)) + 1):
        sector = number % SECTORS
        # a + t (b - a) on the ray: its part across the ray vanishes
        across_a = ax * cos[sector] - ay * sin[sector]
        across_b = bx * cos[sector] - by * sin[sector]
        t = 0.0 if across_a == across_b else min(1.0, max(0.0, across_a / (across_a - across_b)))
        distance = (ax + t * (bx - ax)) * sin[sector] + (ay + t * (by - ay)) * cos[sector]
        if distance > _NEAREST_M:
            tangents[sector] = max(tangents[sector], (az + t * (bz - az)) / distance)
