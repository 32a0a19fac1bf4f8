"""Wall facets cut the TIN; facets that stay connected are a surface, or a fragment of one at a tile's border.

Facets whose elevation difference MX_zdiff reaches 2 m are walls (Shorter and Kasparis, section 3.1). The other facets
are united over shared edges, ground with ground and object with object, and each fragment carries integer sums that add
up over tile borders. Only whole surfaces are judged (`terrain.candidates`): the result does not depend on the tiles.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pipeline.model import IntArray, KindArray, LabelArray, Tin
from pipeline.terrain.facets import (
    FacetLimits,
    LabelledTin,
    SceneVertices,
    classify_facets,
    facet_keys,
    label_fragments,
    label_vertices,
    marks,
    with_vertex,
)
from pipeline.terrain.fragment_sums import Core, sum_fragments
from pipeline.terrain.point_assignment import AssignmentLimits, ScenePoints, assign_points
from pipeline.terrain.terrain_settings import SurfaceSettings

_SAME_M = 0.2
"""Farthest that an undecided point lies from the surface of a building that it belongs to. Not a setting: it is the
least step between two roofs (`min_step_m`), and far above the noise of a scanner."""


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


def fragments_of(
    tin: Tin,
    vertices: SceneVertices,
    points: ScenePoints,
    core: Core,
    settings: SurfaceSettings,
    *,
    canopy_m: float,
    ground_m: float,
) -> tuple[Fragments, LabelArray]:
    """Cut a scene's TIN by its walls to fragments, and assign every point to one, (n,) int32, -1 for none.

    Parameters
    ----------
    tin : Tin
        Delaunay TIN of the vertices, exact within 4 circumradii around the core.
    points : ScenePoints
        All points of the core, to be assigned to fragments.
    core : tuple of int
        x0, y0, x1, y1 of the tile in mm, half-open.
    canopy_m, ground_m : float
        Least height of canopy above a surface, and of an object above the terrain.
    """
    x, y = vertices.x_mm, vertices.y_mm
    wall_mm = round(settings.wall_m * 1000)
    limits = FacetLimits(
        max_circumradius_mm=settings.max_circumradius_m * 1000.0,
        wall_mm=wall_mm,
        wall_slope=math.tan(math.radians(min(settings.wall_deg, settings.steep_deg, 89.99))),
        steep_slope=math.tan(math.radians(min(settings.steep_deg, 89.99))),
        steep_mm=round(settings.steep_m * 1000),
        step_height_mm=round(settings.step_height_m * 1000),
    )
    kinds = classify_facets(vertices, tin.facets, limits)
    far_mm = settings.far_mm
    near, shared = marks(x, y, tin.facets, kinds, core, far_mm)
    label, fragment_kind = label_fragments(kinds, tin.neighbours, with_vertex(tin.facets, near))
    vertex_label = label_vertices(x, y, tin.facets, kinds, label)
    labelled = LabelledTin(tin.facets, tin.neighbours, kinds, label, vertex_label, fragment_kind)
    sums, boxes, along = sum_fragments(vertices, labelled, core, wall_mm)
    lowest = np.full((len(fragment_kind), 3), 2**62, np.int64)
    reach, same, canopy, ground = (round(1000 * m) for m in (settings.reach_m, _SAME_M, canopy_m, ground_m))
    reaches = AssignmentLimits(reach, same, canopy, ground, far_mm)
    point_fragment = assign_points(points, vertices, labelled, reaches, sums, lowest)
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
