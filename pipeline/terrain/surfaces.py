"""Wall facets cut the TIN; what stays connected is a surface, or a fragment of one at a tile's border.

Facets whose elevation difference MX_zdiff reaches 2 m are walls (Shorter and Kasparis, section 3.1).
The facets that remain are united over shared edges, ground with ground and object with object, and
each fragment carries integer sums that add up over tile borders. Only whole surfaces are judged
(`terrain.candidates`), so the answer does not depend on the tiles.
"""

from __future__ import annotations

import dataclasses
import math
from enum import IntEnum

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, KindArray, LabelArray, Tin
from pipeline.terrain.facets import (
    classify_facets,
    facet_keys,
    label_fragments,
    label_vertices,
    marks,
    with_vertex,
)
from pipeline.terrain.point_assignment import AssignmentLimits, CorePoints, LabelledTin, assign_points
from pipeline.terrain.settings import SurfaceSettings


class Sum(IntEnum):
    """Columns of the sums of a fragment; all add up over tile borders."""

    FACETS = 0
    AREA2 = 1
    """Twice the plan area, mm2."""
    VERTICES = 2
    HEIGHT = 3
    """Heights of the vertices above the terrain, mm."""
    PLANAR = 4
    """Vertices with planar surroundings."""
    ROUGH = 5
    """Vertices with rough surroundings."""
    BOUNDARY = 6
    """Length of the outline in plan, mm."""
    WALL = 7
    """Length of the outline that touches walls (MX_zdiff >= 2 m), mm."""
    WALL_TOP = 8
    """Length of the outline that lies at the upper half of its wall, mm."""
    STEP = 9
    """Length of the outline that touches steps, mm."""
    WALLS = 10
    """Number of wall facets along the outline."""
    WALLS_Z_MX = 11
    """Sum of their highest vertices Z_mx, mm."""
    WALLS_OWN_Z = 12
    """Sum of the fragment's own elevation at them, mm."""
    POINTS = 13
    CANOPY = 14
    """Earlier returns well above the fragment."""
    HEIGHT2 = 15
    """Squared heights of the vertices above the terrain, mm2."""


N_SUMS = len(Sum)


@kernel
def sum_fragments(
    x: IntArray,
    y: IntArray,
    z: IntArray,
    height: IntArray,
    planar: KindArray,
    facets: LabelArray,
    neighbours: LabelArray,
    kinds: KindArray,
    label: LabelArray,
    vertex_label: LabelArray,
    count: int,
    core: tuple[int, int, int, int],
    wall_mm: int,
) -> tuple[IntArray, IntArray, IntArray]:
    """Sums of the fragments over what the core owns, bounding boxes, and their lengths along steps.

    A facet is owned through its smallest (x, y) vertex, a vertex through itself.
    """
    x0, y0, x1, y1 = core
    sums = np.zeros((count, N_SUMS), np.int64)
    boxes = np.empty((count, 4), np.int64)
    boxes[:, 0] = boxes[:, 1] = 2**62
    boxes[:, 2] = boxes[:, 3] = -(2**62)
    capacity = 1024
    along = np.empty((capacity, 3), np.int64)
    n_along = 0
    for f in range(facets.shape[0]):
        fragment = label[f]
        if fragment < 0:
            continue
        k = 0
        for q in range(1, 3):
            v, w = facets[f, q], facets[f, k]
            if x[v] < x[w] or (x[v] == x[w] and y[v] < y[w]):
                k = q
        v = facets[f, k]
        if not (x0 <= x[v] < x1 and y0 <= y[v] < y1):
            continue
        a, b, c = facets[f, 0], facets[f, 1], facets[f, 2]
        sums[fragment, 0] += 1
        sums[fragment, 1] += (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])
        boxes[fragment, 0] = min(boxes[fragment, 0], x[a], x[b], x[c])
        boxes[fragment, 1] = min(boxes[fragment, 1], y[a], y[b], y[c])
        boxes[fragment, 2] = max(boxes[fragment, 2], x[a], x[b], x[c])
        boxes[fragment, 3] = max(boxes[fragment, 3], y[a], y[b], y[c])
        for q in range(3):
            g = neighbours[f, q]
            if g >= 0 and kinds[g] == kinds[f]:
                continue
            v, w = facets[f, (q + 1) % 3], facets[f, (q + 2) % 3]
            dx, dy = x[v] - x[w], y[v] - y[w]
            length = np.int64(round(math.sqrt(float(dx * dx + dy * dy))))
            sums[fragment, 6] += length
            if g < 0 or kinds[g] == 0:
                continue
            ga, gb, gc = facets[g, 0], facets[g, 1], facets[g, 2]
            top = max(z[ga], z[gb], z[gc])
            foot = min(z[ga], z[gb], z[gc])
            if top - foot >= wall_mm:
                sums[fragment, 7] += length
                sums[fragment, 10] += 1
                sums[fragment, 11] += top
                own = (z[v] + z[w]) // 2
                sums[fragment, 12] += own
                if 2 * own >= top + foot:
                    sums[fragment, 8] += length
            if kinds[g] == 5 and kinds[f] != 5:
                sums[fragment, 9] += length
                if n_along == capacity:
                    grown = np.empty((2 * capacity, 3), np.int64)
                    for m in range(capacity):
                        grown[m, 0], grown[m, 1], grown[m, 2] = along[m, 0], along[m, 1], along[m, 2]
                    along = grown
                    capacity *= 2
                along[n_along, 0] = fragment
                along[n_along, 1] = label[g]
                along[n_along, 2] = length
                n_along += 1
    for v in range(x.size):
        fragment = vertex_label[v]
        if fragment >= 0 and x0 <= x[v] < x1 and y0 <= y[v] < y1:
            sums[fragment, 2] += 1
            sums[fragment, 3] += height[v]
            sums[fragment, 15] += np.int64(height[v]) * height[v]
            if planar[v] == 1:
                sums[fragment, 4] += 1
            elif planar[v] == 0:
                sums[fragment, 5] += 1
    return sums, boxes, along[:n_along].copy()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fragments:
    """The surface fragments of one tile: small descriptors that add up over tile borders."""

    kind: KindArray
    """(k,) int8, FacetKind of each fragment."""
    sums: IntArray
    """(k, N_SUMS) int64, columns as in Sum."""
    boxes_mm: IntArray
    """(k, 4) int64, xmin, ymin, xmax, ymax of the owned facets; xmin > xmax where none is owned."""
    lowest_point_mm: IntArray
    """(k, 3) int64, lexicographically smallest assigned point; 2^62 where there is none."""
    crossing_keys: IntArray
    """(j, 6) int64, facets that another tile may see too, by their vertices from the smallest on."""
    crossing_fragment: LabelArray
    """(j,) int32, the fragment of each crossing facet."""
    along_steps: IntArray
    """(s, 3) int64, fragment, step fragment, shared length in mm."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneVertices:
    """Thinned points with what is known of them; arrays of one length v, absolute mm."""

    x_mm: IntArray
    y_mm: IntArray
    z_mm: IntArray
    height_mm: IntArray
    """Height above the terrain."""
    kind: KindArray
    """VertexKind."""
    planar: KindArray
    """1 planar surroundings, 0 rough, -1 unknown."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScenePoints:
    """The points that the core owns; arrays of one length n, absolute mm."""

    x_mm: IntArray
    y_mm: IntArray
    z_mm: IntArray
    height_mm: IntArray
    """Height above the terrain."""
    last: BoolArray
    """Last return of its pulse."""
    allowed: KindArray
    """By the trusted classes: 0 may not belong to a building, 2 is building, 1 anything else."""


def fragments_of(
    tin: Tin,
    vertices: SceneVertices,
    points: ScenePoints,
    core: tuple[int, int, int, int],
    settings: SurfaceSettings,
    *,
    canopy_m: float,
    ground_m: float,
) -> tuple[Fragments, LabelArray]:
    """Cut a scene's TIN by its walls and describe the fragments.

    Parameters
    ----------
    tin : Tin
        Delaunay TIN of the vertices, exact within 4 circumradii around the core.
    vertices : SceneVertices
        The vertices.
    points : ScenePoints
        All points of the core, to be assigned to fragments.
    core : tuple of int
        x0, y0, x1, y1 of the tile in mm, half-open.
    settings : SurfaceSettings
        What cuts.
    canopy_m, ground_m : float
        Least height of canopy above a surface, and of an object above the terrain.

    Returns
    -------
    Fragments
        Sums and keys.
    (n,) int32
        Fragment of every point, -1 where none.
    """
    x, y, z = vertices.x_mm, vertices.y_mm, vertices.z_mm
    kinds = classify_facets(
        x, y, z, vertices.height_mm, vertices.kind, tin.facets,
        settings.max_circumradius_m * 1000.0,
        round(settings.wall_m * 1000),
        math.tan(math.radians(min(settings.steep_deg, 89.99))),
        round(settings.steep_m * 1000),
        round(settings.step_height_m * 1000),
    )  # fmt: skip
    far_mm = settings.far_mm
    near, shared = marks(x, y, tin.facets, kinds, core, far_mm)
    considered = with_vertex(tin.facets, near)
    label, fragment_kind = label_fragments(kinds, tin.neighbours, considered)
    vertex_label = label_vertices(x, y, tin.facets, kinds, label)
    sums, boxes, along = sum_fragments(
        x, y, z, vertices.height_mm, vertices.planar, tin.facets, tin.neighbours, kinds, label, vertex_label,
        len(fragment_kind), core, round(settings.wall_m * 1000),
    )  # fmt: skip
    lowest = np.full((len(fragment_kind), 3), 2**62, np.int64)
    point_fragment = assign_points(
        CorePoints(points.x_mm, points.y_mm, points.z_mm, points.height_mm, points.last, points.allowed),
        LabelledTin(x, y, z, tin.facets, tin.neighbours, kinds, label, vertex_label, fragment_kind),
        AssignmentLimits(round(settings.reach_m * 1000), round(canopy_m * 1000), round(ground_m * 1000), far_mm),
        sums,
        lowest,
    )
    crossing = np.flatnonzero((label >= 0) & with_vertex(tin.facets, shared))
    return (
        Fragments(
            kind=fragment_kind,
            sums=sums,
            boxes_mm=boxes,
            lowest_point_mm=lowest,
            crossing_keys=facet_keys(x, y, tin.facets, crossing),
            crossing_fragment=label[crossing],
            along_steps=along,
        ),
        point_fragment,
    )
