"""Faces that are parts of one plane: a triangulated roof counts as the polygons that it was cut from."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import chain, count, pairwise
from typing import NamedTuple

from pipeline.kernels.normal_equations import solve_plane_moments

DISTANCE_M = 0.01
"""Vertices up to this far from a plane lie in it."""
ANGLE_DEG = 0.1
"""Normals up to this angle apart are the same. A narrow face may differ more: as far as `DISTANCE_M` tilts it."""

Point = Sequence[float]
"""x, y, z in metres, about a nearby origin."""
Rings = Sequence[Sequence[int]]
"""Numbers of vertices: the outer ring first, holes the other way round."""

_MIN_UP = 1e-9
"""Numerical guard: faces whose unit normals have a smaller z are vertical and stay apart."""


def area_vector(xyz: Sequence[Point], rings: Rings) -> tuple[float, float, float]:
    """Area vector of a face (Newell), m2: the direction is the normal, the length the area less the holes'."""
    x, y, z = 0.0, 0.0, 0.0
    for ring in rings:
        px, py, pz = xyz[ring[0]] if ring else (0.0, 0.0, 0.0)
        spokes = [(xyz[k][0] - px, xyz[k][1] - py, xyz[k][2] - pz) for k in ring[1:]]
        for (ux, uy, uz), (vx, vy, vz) in pairwise(spokes):
            x += 0.5 * (uy * vz - uz * vy)
            y += 0.5 * (uz * vx - ux * vz)
            z += 0.5 * (ux * vy - uy * vx)
    return x, y, z


def _neighbours(faces: Sequence[Rings]) -> list[list[int]]:
    """Faces that share an edge with each face, one once for every common edge, in the order of the edges."""
    owners: dict[tuple[int, int], list[int]] = {}
    for number, rings in enumerate(faces):
        for ring in rings:
            for a, b in zip(ring, (*ring[1:], *ring[:1]), strict=True):
                owners.setdefault((min(a, b), max(a, b)), []).append(number)
    beside: list[list[int]] = [[] for _ in faces]
    for edge in sorted(owners):
        for one in owners[edge]:
            beside[one].extend(other for other in owners[edge] if other != one)
    return beside


class _Face(NamedTuple):
    """A face with its normal turned upwards."""

    corners: list[Point]
    area: float
    normal: Point
    min_cosine: float
    """Cosine of the largest angle that it may have to a plane that it lies in: what a small error explains."""


def _face(xyz: Sequence[Point], rings: Rings, vector: Point) -> _Face:
    x, y, z = vector
    area = math.sqrt(x * x + y * y + z * z)
    scale = (1.0 if z >= 0.0 else -1.0) / area if area > 0.0 else 0.0
    corners = [xyz[k] for k in chain.from_iterable(rings)]
    spans = [max(axis) - min(axis) for axis in zip(*corners, strict=True)]
    extent = math.sqrt(sum(span * span for span in spans))
    width = 2.0 * area / extent if extent > 0.0 else 0.0
    min_cosine = math.cos(max(math.radians(ANGLE_DEG), math.atan2(DISTANCE_M, width)))
    return _Face(corners, area, (x * scale, y * scale, z * scale), min_cosine)


class _Plane:
    """A plane z = a x + b y + c that is fitted anew to each face that joins; it starts with the normal of the first."""

    def __init__(self, face: _Face) -> None:
        self.sums = [0.0] * 9
        self.a, self.b = -face.normal[0] / face.normal[2], -face.normal[1] / face.normal[2]
        self._add(face.corners)

    def _add(self, corners: Iterable[Point]) -> None:
        n, sx, sy, sz, sxx, sxy, syy, sxz, syz = self.sums
        for x, y, z in corners:
            n, sx, sy, sz = n + 1.0, sx + x, sy + y, sz + z
            sxx, sxy, syy, sxz, syz = sxx + x * x, sxy + x * y, syy + y * y, sxz + x * z, syz + y * z
        self.sums = [n, sx, sy, sz, sxx, sxy, syy, sxz, syz]
        self.c = (sz - self.a * sx - self.b * sy) / n
        self.up = 1.0 / math.sqrt(1.0 + self.a * self.a + self.b * self.b)

    def join(self, face: _Face) -> None:
        """Fit it to the vertices of another face, too."""
        self._add(face.corners)
        n, sx, sy, sz, sxx, sxy, syy, sxz, syz = self.sums
        self.a, self.b = solve_plane_moments(
            sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n, sxz - sx * sz / n, syz - sy * sz / n
        )
        self._add(())

    def has(self, face: _Face) -> bool:
        """Whether a face lies in it."""
        a, b, c, up = self.a, self.b, self.c, self.up
        if face.normal[2] <= _MIN_UP or any(abs(z - a * x - b * y - c) * up > DISTANCE_M for x, y, z in face.corners):
            return False
        return (face.normal[2] - a * face.normal[0] - b * face.normal[1]) * up >= face.min_cosine


def coplanar_regions(
    xyz: Sequence[Point], faces: Sequence[Rings], vectors: Sequence[Point], planes: Sequence[int]
) -> list[int]:
    """Regions of faces that share edges and lie in one plane, grown from the largest; each new face refits the plane.

    Faces have one vertex per place. The direction of their area vectors does not matter; faces with different `planes`
    stay apart. Returns the number of the region of each face, in the order of growing.
    """
    shapes = [_face(xyz, rings, vector) for rings, vector in zip(faces, vectors, strict=True)]
    beside = _neighbours(faces)
    labels = [-1] * len(faces)
    numbers = count()
    for seed in sorted(range(len(faces)), key=lambda face: -shapes[face].area):
        if labels[seed] >= 0:
            continue
        labels[seed] = next(numbers)
        if shapes[seed].normal[2] <= _MIN_UP:
            continue
        plane = _Plane(shapes[seed])
        region = [seed]
        for face in region:
            while True:
                free = (other for other in beside[face] if labels[other] < 0 and planes[other] == planes[seed])
                joining = next((other for other in free if plane.has(shapes[other])), None)
                if joining is None:
                    break
                labels[joining] = labels[seed]
                region.append(joining)
                plane.join(shapes[joining])
    return labels
