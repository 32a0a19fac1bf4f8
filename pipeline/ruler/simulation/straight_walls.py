"""One wall per straight run: neighbouring walls of one vertical plane become one face.

Corners in the middle of the resulting straight edges are removed. Rounding to millimetres moves them off the line, and
a triangulation could make triangles of any tilt from them.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.model import FaceKind, FloatArray, Solid, SolidFace

_ONE_LINE_M = 0.0015
"""Corners up to this far from a line in plan lie on it: millimetres of rounding."""
_ON_EDGE_M = 0.005
"""The same for vertices and edges in space."""

Ring = tuple[int, ...]


def with_straight_walls(solid: Solid) -> Solid:
    """The same closed body, vertices in whole millimetres, with fewer walls and vertices; walls must have no holes."""
    walls: list[Ring | None] = [face.rings[0] for face in solid.faces if face.kind is FaceKind.WALL]
    owner = {edge: k for k, ring in enumerate(walls) if ring is not None for edge in _edges(ring)}
    for a, b in sorted(owner):
        # Owners change while walls grow.
        first, second = owner.get((a, b), -1), owner.get((b, a), -1)
        if a > b or min(first, second) < 0 or first == second or _apart(solid.vertices, a, b) > 0.0:
            continue
        keep, drop = min(first, second), max(first, second)
        ring, other = walls[keep], walls[drop]
        if ring is None or other is None or not _in_line(solid.vertices, (*ring, *other)):
            continue
        joined = _joined(ring, other)
        if joined is None:
            continue
        for edge in (*_edges(ring), *_edges(other)):
            owner.pop(edge, None)
        owner.update(dict.fromkeys(_edges(joined), keep))
        walls[keep], walls[drop] = joined, None
    faces = [face for face in solid.faces if face.kind is not FaceKind.WALL]
    at = sum(face.kind is FaceKind.ROOF for face in faces)
    faces[at:at] = [SolidFace(rings=(ring,), kind=FaceKind.WALL) for ring in walls if ring is not None]
    return _without_needless_vertices(solid.vertices, faces)


def _edges(ring: Ring) -> list[tuple[int, int]]:
    return list(zip(ring, ring[1:] + ring[:1], strict=True))


def _apart(vertices: FloatArray, a: int, b: int) -> float:
    """Distance of two vertices in plan."""
    return math.hypot(vertices[a, 0] - vertices[b, 0], vertices[a, 1] - vertices[b, 1])


def _in_line(vertices: FloatArray, corners: Ring) -> bool:
    """Whether vertices lie on one line in plan."""
    plan = vertices[list(corners), :2]
    start = plan[np.argmax(np.hypot(*(plan - plan[0]).T))]
    away = plan - start
    end = away[np.argmax(np.hypot(*away.T))]
    return bool(np.abs(away[:, 0] * end[1] - away[:, 1] * end[0]).max() <= _ONE_LINE_M * math.hypot(*end))


def _joined(ring: Ring, other: Ring) -> Ring | None:
    """The ring around two faces that share edges; None where that is not one simple ring."""
    edges = {*_edges(ring), *_edges(other)}
    follower: dict[int, int] = {}
    for a, b in sorted(edges):
        if (b, a) not in edges:
            if a in follower:
                return None
            follower[a] = b
    start = min(follower)
    joined = [start]
    while (vertex := follower[joined[-1]]) != start:
        joined.append(vertex)
    return tuple(joined) if len(joined) == len(follower) else None


def _without_needless_vertices(vertices: FloatArray, faces: list[SolidFace]) -> Solid:
    """Remove unused vertices and those in the middle of an edge of two faces."""
    around: dict[int, set[int]] = {}
    for face in faces:
        for ring in face.rings:
            for a, b in _edges(ring):
                around.setdefault(a, set()).add(b)
                around.setdefault(b, set()).add(a)
    needless = {vertex for vertex, ends in around.items() if len(ends) == 2 and _on_edge(vertices, vertex, *ends)}
    kept = sorted(set(around) - needless)
    number = {vertex: k for k, vertex in enumerate(kept)}
    shorter = [
        SolidFace(
            rings=tuple(tuple(number[vertex] for vertex in ring if vertex in number) for ring in face.rings),
            kind=face.kind,
            plane=face.plane,
        )
        for face in faces
    ]
    return Solid(vertices=vertices[kept], faces=tuple(shorter))


def _on_edge(vertices: FloatArray, vertex: int, start: int, end: int) -> bool:
    """Whether a vertex lies between two others."""
    to_end, to_vertex = vertices[end] - vertices[start], vertices[vertex] - vertices[start]
    away = np.cross(to_end, to_vertex)
    length = math.sqrt(float(to_end @ to_end))
    along = float(to_end @ to_vertex)
    return math.sqrt(float(away @ away)) <= _ON_EDGE_M * length and 0.0 < along < length * length
