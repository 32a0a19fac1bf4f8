"""One face of a solid to triangles, with faults in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.model import FloatArray, IntArray
from pipeline.triangulation.face_triangles import (
    DONE,
    MILLIMETRES_PER_METRE,
    NO_AREA,
    NO_BRIDGE,
    NO_EAR,
    triangulate_rings,
)

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
