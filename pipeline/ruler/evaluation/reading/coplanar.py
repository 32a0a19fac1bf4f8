"""Faces that are parts of one plane: a triangulated roof counts as the polygons that it was cut from."""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import solve_plane_moments
from pipeline.kernels.sorting import ascending_order, counting_sort
from pipeline.model import FloatArray, IntArray, LabelArray

DISTANCE_M = 0.01
"""Vertices up to this far from a plane lie in it."""
ANGLE_DEG = 0.1
"""Normals up to this angle apart are the same. A narrow face may differ more: as far as `DISTANCE_M` tilts it."""

_MIN_UP = 1e-9
"""Numerical guard: faces whose unit normals have a smaller z are vertical and stay apart."""


@kernel
def face_vectors(xyz: FloatArray, corners: IntArray, ring_offsets: IntArray, face_rings: IntArray) -> FloatArray:
    """Area vectors of faces (Newell), (f, 3) m2: the direction is the normal, the length the area less the holes'.

    Vertices `xyz` (v, 3) are in metres, about a nearby origin; `corners` (c,) are the vertices of all rings, one ring
    after the other, which start at `ring_offsets` (r + 1,). Faces start in the rings at `face_rings` (f + 1,), the
    outer ring first, holes the other way round.
    """
    vectors = np.zeros((len(face_rings) - 1, 3))
    for f in range(len(vectors)):
        for r in range(face_rings[f], face_rings[f + 1]):
            p = corners[ring_offsets[r]] if ring_offsets[r] < ring_offsets[r + 1] else 0
            for k in range(ring_offsets[r] + 1, ring_offsets[r + 1] - 1):
                q, s = corners[k], corners[k + 1]
                ux, uy, uz = xyz[q, 0] - xyz[p, 0], xyz[q, 1] - xyz[p, 1], xyz[q, 2] - xyz[p, 2]
                vx, vy, vz = xyz[s, 0] - xyz[p, 0], xyz[s, 1] - xyz[p, 1], xyz[s, 2] - xyz[p, 2]
                vectors[f, 0] += 0.5 * (uy * vz - uz * vy)
                vectors[f, 1] += 0.5 * (uz * vx - ux * vz)
                vectors[f, 2] += 0.5 * (ux * vy - uy * vx)
    return vectors


@kernel
def _neighbours(
    corners: IntArray, ring_offsets: IntArray, face_rings: IntArray, vertices: int
) -> tuple[LabelArray, IntArray]:
    """Faces that share an edge with each face: offsets (f + 1,) and faces, a face once for every common edge."""
    keys = np.empty(len(corners), np.int64)
    owner = np.empty(len(corners), np.int64)
    faces = len(face_rings) - 1
    for f in range(faces):
        for r in range(face_rings[f], face_rings[f + 1]):
            for k in range(ring_offsets[r], ring_offsets[r + 1]):
                following = k + 1 if k + 1 < ring_offsets[r + 1] else ring_offsets[r]
                a, b = min(corners[k], corners[following]), max(corners[k], corners[following])
                keys[k] = a * vertices + b
                owner[k] = f
    order = ascending_order(keys)
    # Every pair of faces at an edge, both ways: the first pass counts, the second one writes.
    beside, others = np.empty(0, np.int32), np.empty(0, np.int64)
    for writes in (False, True):
        count = 0
        start = 0
        while start < len(order):
            stop = start + 1
            while stop < len(order) and keys[order[stop]] == keys[order[start]]:
                stop += 1
            for i in range(start, stop):
                for j in range(start, stop):
                    if owner[order[i]] != owner[order[j]]:
                        if writes:
                            beside[count], others[count] = owner[order[i]], owner[order[j]]
                        count += 1
            start = stop
        if not writes:
            beside, others = np.empty(count, np.int32), np.empty(count, np.int64)
    offsets, members = counting_sort(beside, faces)
    ordered = np.empty(len(members), np.int64)
    for m in range(len(members)):
        ordered[m] = others[members[m]]
    return offsets, ordered


@kernel
def _min_cosine(xyz: FloatArray, corners: IntArray, area: float, distance_m: float, angle_deg: float) -> float:
    """Cosine of the largest angle that a face may have to a plane that it lies in: what a small error explains."""
    extent = 0.0
    for axis in range(3):
        low, high = xyz[corners[0], axis], xyz[corners[0], axis]
        for k in range(len(corners)):
            low, high = min(low, xyz[corners[k], axis]), max(high, xyz[corners[k], axis])
        extent += (high - low) ** 2
    width = 2.0 * area / math.sqrt(extent) if extent > 0.0 else 0.0
    explained = math.atan2(distance_m, width)
    return math.cos(max(math.radians(angle_deg), explained))


@kernel(inline="always")
def _upward_normals(vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lengths (f,) of area vectors (f, 3), and their unit vectors (f, 3), turned upwards; zero without an area."""
    areas, normals = np.empty(len(vectors)), np.zeros((len(vectors), 3))
    for f in range(len(vectors)):
        areas[f] = math.sqrt(vectors[f, 0] ** 2 + vectors[f, 1] ** 2 + vectors[f, 2] ** 2)
        if areas[f] > 0.0:
            scale = (1.0 if vectors[f, 2] >= 0.0 else -1.0) / areas[f]
            for axis in range(3):
                normals[f, axis] = vectors[f, axis] * scale
    return areas, normals


@kernel(inline="always")
def _lie_in(xyz: FloatArray, corners: IntArray, plane: tuple[float, float, float], up: float, limit_m: float) -> bool:
    """Whether vertices lie within a distance of the plane z = a x + b y + c; `up` is the z of its unit normal."""
    a, b, c = plane
    inside = True
    for k in range(len(corners)):
        x, y, z = xyz[corners[k], 0], xyz[corners[k], 1], xyz[corners[k], 2]
        if abs(z - a * x - b * y - c) * up > limit_m:
            inside = False
            break
    return inside


@kernel
def coplanar_regions(
    xyz: FloatArray,
    corners: IntArray,
    ring_offsets: IntArray,
    face_rings: IntArray,
    vectors: FloatArray,
    planes: IntArray,
    distance_m: float,
    angle_deg: float,
) -> IntArray:
    """Regions of faces that share edges and lie in one plane, grown from the largest; each new face refits the plane.

    Faces are given as for `face_vectors`, with one vertex per place. The direction of their area vectors (f, 3) does
    not matter; faces with different `planes` (f,) stay apart. Returns the number of the region of each face, (f,), in
    the order of growing.
    """
    areas, normals = _upward_normals(vectors)
    offsets, others = _neighbours(corners, ring_offsets, face_rings, len(xyz))
    labels = np.full(len(vectors), -1, np.int64)
    queue = np.empty(len(vectors), np.int64)
    count = 0
    for seed in ascending_order(-areas):
        if labels[seed] >= 0:
            continue
        labels[seed] = count
        queue[0] = seed
        read, written = 0, 1
        a, b, c = 0.0, 0.0, 0.0
        n, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
        sxx, sxy, syy, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0
        joining = seed
        while normals[seed, 2] > _MIN_UP:
            if joining >= 0:
                for k in range(ring_offsets[face_rings[joining]], ring_offsets[face_rings[joining + 1]]):
                    x, y, z = xyz[corners[k], 0], xyz[corners[k], 1], xyz[corners[k], 2]
                    n += 1.0
                    sx, sy, sz = sx + x, sy + y, sz + z
                    sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
                    sxz, syz = sxz + x * z, syz + y * z
                if joining == seed:
                    a, b = -normals[seed, 0] / normals[seed, 2], -normals[seed, 1] / normals[seed, 2]
                else:
                    a, b = solve_plane_moments(
                        sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n, sxz - sx * sz / n, syz - sy * sz / n
                    )
                c = (sz - a * sx - b * sy) / n
                joining = -1
            if read == written:
                break
            face = queue[read]
            up = 1.0 / math.sqrt(1.0 + a * a + b * b)
            for q in range(offsets[face], offsets[face + 1]):
                other = others[q]
                if labels[other] >= 0 or planes[other] != planes[seed] or normals[other, 2] <= _MIN_UP:
                    continue
                own = corners[ring_offsets[face_rings[other]] : ring_offsets[face_rings[other + 1]]]
                cosine = (normals[other, 2] - a * normals[other, 0] - b * normals[other, 1]) * up
                fits = _lie_in(xyz, own, (a, b, c), up, distance_m)
                if fits and cosine >= _min_cosine(xyz, own, areas[other], distance_m, angle_deg):
                    labels[other] = count
                    queue[written] = other
                    written += 1
                    joining = other
                    break
            if joining < 0:
                read += 1
        count += 1
    return labels
