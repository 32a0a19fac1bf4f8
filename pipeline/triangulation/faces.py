"""Faces to triangles: projection, bridges, ears and flips in one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import same_place
from pipeline.model import FloatArray, IntArray
from pipeline.triangulation.ear_clipping import clip_ears
from pipeline.triangulation.edge_flips import flip_to_delaunay
from pipeline.triangulation.hole_bridges import one_chain
from pipeline.triangulation.projection import project_along_dominant_axis

MILLIMETRES_PER_METRE = 1000.0

DONE = 0
NO_AREA = 1
NO_BRIDGE = 2
NO_EAR = 3

_FAULTS = {
    NO_AREA: "the outer ring encloses no area",
    NO_BRIDGE: "a hole lies outside, crosses or touches the outer ring along an edge, or runs the same way round",
    NO_EAR: "the rings cross or touch themselves",
}


def triangulate_face(vertices: FloatArray, rings: Sequence[Sequence[int]]) -> IntArray:
    """Cut a planar face into triangles of its own vertices.

    Parameters
    ----------
    vertices : (v, 3) float64
        Vertices of the solid in metres, taken to the nearest millimetre.
    rings : sequence of sequences of int
        Outer ring first, holes the other way round; vertex indices, the first not repeated.

    Returns
    -------
    (t, 3) int64
        Vertex indices, oriented as the outer ring; t = corners - 2, and two more for each hole that
        touches no other ring. No triangle has zero area.

    Raises
    ------
    ValueError
        If a ring has fewer than three vertices, the outer ring encloses no area, a hole cannot be joined to it, or no
        ear is left. Rings that cross are not always noticed: `pipeline.quality.validity` finds them.
    """
    for ring in rings:
        if len(ring) < 3:
            raise ValueError(f"a ring of {len(ring)} vertices bounds no face: give at least three")
    if len(rings) == 0:
        raise ValueError("a face has an outer ring: none is given")
    ids = np.array([index for ring in rings for index in ring], dtype=np.int64)
    offsets = np.zeros(len(rings) + 1, dtype=np.int64)
    np.cumsum([len(ring) for ring in rings], out=offsets[1:])
    corners = np.rint(np.asarray(vertices, dtype=np.float64)[ids] * MILLIMETRES_PER_METRE).astype(np.int64)
    triangles, status = triangulate_rings(corners, offsets)
    if status != DONE:
        raise ValueError(f"rings {tuple(tuple(ring) for ring in rings)} cannot be triangulated: {_FAULTS[int(status)]}")
    return ids[triangles]


@kernel
def triangulate_rings(corners: IntArray, ring_offsets: IntArray) -> tuple[IntArray, int]:
    """Triangles (t, 3) int64 of one face, as indices into its corners, and `DONE`; or no triangle and the fault.

    `corners` (n, 3) int64 of all rings are in mm, outer ring first; `ring_offsets` (r + 1,) is where each starts, and
    n.
    """
    flat, has_area = project_along_dominant_axis(corners, ring_offsets[1])
    nothing = np.empty((0, 3), np.int64)
    if not has_area:
        return nothing, NO_AREA
    if len(flat) == 3:
        single = np.empty((1, 3), np.int64)
        single[0, 0], single[0, 1], single[0, 2] = 0, 1, 2
        return single, DONE
    chain, length = one_chain(flat, ring_offsets)
    if length == 0:
        return nothing, NO_BRIDGE
    triangles, count = clip_ears(flat, chain, length)
    if count != length - 2:
        return nothing, NO_EAR
    if len(ring_offsets) > 2:
        for t in range(count):
            for k in range(3):
                corner = triangles[t, k]
                for i in range(corner):
                    if same_place(flat, i, corner):
                        triangles[t, k] = i
                        break
    if count > 1:
        flip_to_delaunay(corners, flat, triangles, count)
    return triangles, DONE
