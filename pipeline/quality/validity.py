"""Validity of solids by the rules of ISO 19107, with the codes and default tolerances of val3dity.

=====  ================================================================================================
Code   Fault
=====  ================================================================================================
101    ring of fewer than three vertices
102    consecutive vertices of a ring coincide (within the snapping tolerance)
104    ring crosses or touches itself, encloses no area, or is 8,000 times longer than wide
201    rings of a face cross, overlap or touch off their vertices
202    two rings of a face are the same
203    a vertex is farther from the face's least-squares plane than the tolerance
204    two triangles of a face have normals that differ by more than the tolerance, however it is projected
205    rings that touch cut the interior of a face in two
206    a hole lies outside the outer ring
207    a hole lies in a hole
208    a hole runs the same way round as the outer ring
300    a face without any of the faults above cannot be triangulated
301    fewer than four faces
302    an edge has one face: the shell is not watertight
303    an edge has more than two faces, or the faces at a vertex form more than one umbrella
305    the faces form more than one component
306    faces meet anywhere but in their common vertices and edges
307    two neighbours run along their edge in the same direction: one of them faces inward
405    the shell as a whole faces inward
=====  ================================================================================================

The codes of the format (103), of inner shells (401 to 404) and of groups of solids (5xx, 6xx) cannot arise: rings
close by themselves, and a `Solid` has one shell. The faults are judged in stages: rings and polygons of every face;
the shell if all faces are sound; self-intersection if the shell is; orientation if there is none. A face shows its
first fault. References: Ledoux (2013), On the validation of solids represented with the international standards for
geographic information; Ledoux (2018), val3dity: validation of 3D GIS primitives according to the international
standards.
"""

from __future__ import annotations

import math
from itertools import accumulate, chain

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import comes_before
from pipeline.kernels.sorting import ascending_order
from pipeline.kernels.union_find import root_of
from pipeline.model import BoolArray, IntArray, Solid
from pipeline.parameters import Parameters, parameter
from pipeline.quality.planarity import bends_where_it_is_straight, fitted_plane, in_fitted_plane, min_cosine_of_normals
from pipeline.quality.rings import RING_SELF_INTERSECTION, polygon_code
from pipeline.quality.self_intersection import shell_intersects_itself
from pipeline.quality.shell import is_sound_shell, six_volumes
from pipeline.triangulation.face_triangles import (
    DONE,
    MILLIMETRES_PER_METRE,
    area_vector,
    project_along_dominant_axis,
    triangulate_rings,
)

TOO_FEW_POINTS = 101
CONSECUTIVE_POINTS_SAME = 102
NON_PLANAR_DISTANCE = 203
NON_PLANAR_NORMALS = 204
NOT_VALID_2_MANIFOLD = 300
TOO_FEW_POLYGONS = 301
SHELL_SELF_INTERSECTION = 306
WRONG_ORIENTATION_SHELL = 405

_CODE_LIMIT = 406
_MIN_SLENDERNESS = 1.2e-4
"""Narrower faces, such as a wall of 2 mm under a ridge of 40 m, are lines to a validator that fits planes in floating
point: of 600 slabs val3dity 2.6 finds half of those below 9e-5 faulty, a tenth at 1e-4, none above 1.2e-4."""


class ValidityTolerances(Parameters):
    """How exactly a solid has to keep the rules; the defaults are val3dity's."""

    snap_m: float = parameter(
        0.001, "Vertices up to this distance apart count as one.", unit="m", minimum=0.0, maximum=0.1
    )
    planarity_m: float = parameter(
        0.01, "Largest distance of a vertex to the plane of its face.", unit="m", minimum=0.0, maximum=1.0
    )
    normals_deg: float = parameter(
        20.0, "Largest angle between the normals of two triangles of a face.", unit="deg", minimum=0.0, maximum=90.0
    )


DEFAULT_TOLERANCES = ValidityTolerances()


def check_solid(solid: Solid, tolerances: ValidityTolerances = DEFAULT_TOLERANCES) -> tuple[int, ...]:
    """The codes of a solid's faults, ascending, each once; empty for a valid solid.

    Vertices are taken to the nearest millimetre; unused ones do not matter. A pair of vertices exactly as far apart as
    the snapping tolerance is judged both as one vertex and as two, and the codes of both verdicts are given.
    """
    vertices = np.ascontiguousarray(np.rint(solid.vertices * MILLIMETRES_PER_METRE), dtype=np.int64)
    rings = [ring for face in solid.faces for ring in face.rings]
    ring_vertices = np.array(list(chain.from_iterable(rings)), np.int64)
    ring_offsets = np.array([0, *accumulate(map(len, rings))])
    face_offsets = np.array([0, *accumulate(len(face.rings) for face in solid.faces)])
    planarity_mm = tolerances.planarity_m * MILLIMETRES_PER_METRE
    min_cosine = math.cos(math.radians(tolerances.normals_deg))
    snap_mm = tolerances.snap_m * MILLIMETRES_PER_METRE
    found = _faults(vertices, ring_vertices, ring_offsets, face_offsets, snap_mm, planarity_mm, min_cosine)
    return tuple(np.flatnonzero(found).tolist())


@kernel
def _faults(
    vertices: IntArray,
    ring_vertices: IntArray,
    ring_offsets: IntArray,
    face_offsets: IntArray,
    snap_mm: float,
    planarity_mm: float,
    min_cosine: float,
) -> BoolArray:
    """(406,) bool, True at the codes of the faults of a solid, by either verdict on pairs at the snapping tolerance."""
    joined, apart, differ = _snap(vertices, ring_vertices, snap_mm)
    found = np.zeros(_CODE_LIMIT, np.bool_)
    for verdict in range(2 if differ else 1):
        ids = joined if verdict == 0 else apart
        _find_faults(vertices, ids, ring_offsets, face_offsets, planarity_mm, min_cosine, found)
    return found


@kernel
def _snap(vertices: IntArray, ring_vertices: IntArray, snap_mm: float) -> tuple[IntArray, IntArray, bool]:
    """Snapped vertices of all corners: pairs at the tolerance joined; pairs at the tolerance apart; whether it matters.

    Vertices within the tolerance are one, and so are chains of them.
    """
    count = len(vertices)
    is_used = np.zeros(count, np.bool_)
    for vertex in ring_vertices:
        is_used[vertex] = True
    order = ascending_order(vertices[:, 0].copy())
    parents = np.empty((2, count), np.int64)
    for vertex in range(count):
        parents[0, vertex] = parents[1, vertex] = vertex
    limit = snap_mm * snap_mm
    differ = False
    for i in range(count):
        p = order[i]
        if not is_used[p]:
            continue
        for j in range(i + 1, count):
            q = order[j]
            dx = vertices[q, 0] - vertices[p, 0]
            if dx > snap_mm:
                break
            dy, dz = vertices[q, 1] - vertices[p, 1], vertices[q, 2] - vertices[p, 2]
            distance = float(dx * dx + dy * dy + dz * dz)
            if distance > limit or not is_used[q]:
                continue
            is_within = distance < limit or distance == 0.0
            differ = differ or not is_within
            for verdict in range(2 if is_within else 1):
                # the first by x, y, z represents all
                parent = parents[verdict]
                a, b = root_of(parent, p), root_of(parent, q)
                if comes_before(vertices, b, a):
                    a, b = b, a
                parent[b] = a
    joined, apart = np.empty_like(ring_vertices), np.empty_like(ring_vertices)
    for corner in range(len(ring_vertices)):
        joined[corner] = root_of(parents[0], ring_vertices[corner])
        apart[corner] = root_of(parents[1], ring_vertices[corner])
    return joined, apart, differ


@kernel
def _face_code(corners: IntArray, ids: IntArray, rings: IntArray, planarity_mm: float) -> int:
    """The first fault of a face's rings, 0 where there is none: corners in mm, their vertices, ring offsets."""
    for r in range(len(rings) - 1):
        if rings[r + 1] - rings[r] < 3:
            return TOO_FEW_POINTS
    for r in range(len(rings) - 1):
        for i in range(rings[r], rings[r + 1]):
            if ids[i] == ids[i + 1 if i + 1 < rings[r + 1] else rings[r]]:
                return CONSECUTIVE_POINTS_SAME
    if len(corners) == 3:
        x, y, z = area_vector(corners, 0, 3)
        return RING_SELF_INTERSECTION if x == 0 and y == 0 and z == 0 else 0
    distance_mm, slenderness, _ = fitted_plane(corners)
    if distance_mm > planarity_mm:
        return NON_PLANAR_DISTANCE
    if slenderness < _MIN_SLENDERNESS:
        return RING_SELF_INTERSECTION
    flat, has_area = project_along_dominant_axis(corners, rings[1])
    return int(polygon_code(flat, ids, rings)) if has_area else RING_SELF_INTERSECTION


@kernel
def _is_folded(corners: IntArray, rings: IntArray, cut: IntArray, min_cosine: float) -> bool:
    """Whether two triangles of a face have normals too far apart: of its triangulation, or of that in its fitted plane.

    val3dity triangulates in the fitted plane. Where corners lie on one line but for the rounding to millimetres, it
    depends on the projection which of them bulge outwards, and with it whether a sliver of any normal is cut off there.
    """
    if min_cosine_of_normals(corners, cut, min_cosine) < min_cosine:
        return True
    _, _, axes = fitted_plane(corners)
    if not bends_where_it_is_straight(corners, rings, axes, min_cosine):
        return False
    in_plane, status = triangulate_rings(in_fitted_plane(corners, axes), rings)
    return status != DONE or min_cosine_of_normals(corners, in_plane, min_cosine) < min_cosine


@kernel(inline="always")
def _faces_are_sound(
    corners: IntArray,
    ids: IntArray,
    ring_offsets: IntArray,
    face_offsets: IntArray,
    planarity_mm: float,
    found: BoolArray,
) -> bool:
    """Set found[code] for the first fault of every face; whether there is none."""
    sound = True
    for f in range(len(face_offsets) - 1):
        rings = ring_offsets[face_offsets[f] : face_offsets[f + 1] + 1]
        code = TOO_FEW_POINTS
        if len(rings) >= 2:
            start, stop = rings[0], rings[-1]
            code = _face_code(corners[start:stop], ids[start:stop], rings - start, planarity_mm)
        if code:
            found[code] = True
            sound = False
    return sound


@kernel
def _find_faults(
    vertices: IntArray,
    ids: IntArray,
    ring_offsets: IntArray,
    face_offsets: IntArray,
    planarity_mm: float,
    min_cosine: float,
    found: BoolArray,
) -> None:
    """Set found[code] for the faults of a solid whose corners `ids` are snapped vertices."""
    corners = np.empty((len(ids), 3), np.int64)
    for i in range(len(ids)):
        for k in range(3):
            corners[i, k] = vertices[ids[i], k]
    faces = len(face_offsets) - 1
    if not _faces_are_sound(corners, ids, ring_offsets, face_offsets, planarity_mm, found):
        return
    sound = True
    triangles = np.empty((len(ids) + 2 * len(ring_offsets), 3), np.int64)
    face_of = np.empty(len(triangles), np.int64)
    count = 0
    for f in range(faces):
        rings = ring_offsets[face_offsets[f] : face_offsets[f + 1] + 1]
        start, stop = rings[0], rings[-1]
        cut, status = triangulate_rings(corners[start:stop], rings - start)
        if status != DONE:
            found[NOT_VALID_2_MANIFOLD] = True
            sound = False
            continue
        if len(cut) > 1 and _is_folded(corners[start:stop], rings - start, cut, min_cosine):
            found[NON_PLANAR_NORMALS] = True
            sound = False
        for t in range(len(cut)):
            for k in range(3):
                triangles[count, k] = ids[start + cut[t, k]]
            face_of[count] = f
            count += 1
    if not sound:
        return
    if faces < 4:
        found[TOO_FEW_POLYGONS] = True
        return
    triangles = triangles[:count]
    if not is_sound_shell(triangles, len(vertices), found):
        return
    if shell_intersects_itself(vertices, triangles, face_of):
        found[SHELL_SELF_INTERSECTION] = True
    elif six_volumes(vertices, triangles) <= 0.0:
        found[WRONG_ORIENTATION_SHELL] = True
