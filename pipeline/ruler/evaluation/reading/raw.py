"""Faces over vertices as readers of foreign files pass them on."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from pipeline.kernels.union_find import united
from pipeline.model import FaceKind, FloatArray

MILLIMETRES_PER_METRE = 1000.0
FARTHEST_M = 1e8
"""Coordinates beyond this are not metres of a projected CRS."""

Rings = tuple[tuple[int, ...], ...]
"""Vertex indices: outer ring first; the first vertex of a ring is not repeated."""


class RawFace(NamedTuple):
    """A polygon of the file."""

    rings: Rings
    """Counter-clockwise seen from outside, holes clockwise; not all files comply."""
    kind: FaceKind | None
    """Its kind in the file; None if unknown: then the normal decides."""
    plane: int = -1
    """Number of its roof plane in files of this program; -1 if unknown."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RawPart:
    """One geometry of a building."""

    xyz: FloatArray
    """(v, 3) float64, absolute metres; only vertices that its faces use."""
    faces: tuple[RawFace, ...]
    is_solid: bool
    """True if they are meant to close a solid."""


def raw_part(vertices: FloatArray, faces: Iterable[RawFace], *, is_solid: bool) -> RawPart:
    """A part with only those of many vertices (n, 3) that its faces use.

    Raises ValueError if a face names a missing vertex, or one beyond `FARTHEST_M`.
    """
    listed = tuple(faces)
    used = sorted(set(chain.from_iterable(ring for face in listed for ring in face.rings)))
    if used and not 0 <= used[0] <= used[-1] < len(vertices):
        wrong = used[0] if used[0] < 0 else used[-1]
        raise ValueError(f"a face names vertex {wrong}, there are {len(vertices)}")
    place = {index: k for k, index in enumerate(used)}
    xyz = vertices[used] if used else np.empty((0, 3))
    if not (np.abs(xyz) <= FARTHEST_M).all():
        raise ValueError(f"a coordinate is farther than {FARTHEST_M:g} m from the origin")
    return RawPart(
        xyz=xyz,
        faces=tuple(
            RawFace(tuple(tuple([place[index] for index in ring]) for ring in face.rings), face.kind, face.plane)
            for face in listed
        ),
        is_solid=is_solid,
    )


def is_closed(vertices: FloatArray, faces: Iterable[Rings]) -> bool:
    """Whether every edge occurs equally often in both directions: no hole in the surface, neighbours oriented alike.

    Vertices (v, 3) in metres that agree to the millimetre are one.
    """
    names = _welded(vertices)
    balance: dict[tuple[int, int], int] = {}
    for rings in faces:
        for ring in rings:
            first = names[ring[-1]] if ring else -1
            for index in ring:
                second = names[index]
                if first < second:
                    balance[first, second] = balance.get((first, second), 0) + 1
                elif second < first:
                    balance[second, first] = balance.get((second, first), 0) - 1
                first = second
    return bool(balance) and not any(balance.values())


def _welded(vertices: FloatArray) -> list[int]:
    """A number for every vertex, the same for vertices in one place."""
    places: dict[tuple[int, ...], int] = {}
    keys = np.rint(vertices * MILLIMETRES_PER_METRE).astype(np.int64).tolist()
    return [places.setdefault(tuple(key), len(places)) for key in keys]


def connected(part: RawPart) -> list[RawPart]:
    """The connected pieces of a part, in the order of their first faces.

    Edges with shared vertices count first, so bodies with vertices of their own stay apart where they touch. Pieces
    that are not closed are then connected by edges in one place, since some files repeat the vertices of every face.
    """
    closed: list[list[int]] = []
    rest: list[list[int]] = []
    for numbers in _by_edges(part.faces, range(len(part.xyz))):
        whole = is_closed(part.xyz, (part.faces[number].rings for number in numbers))
        (closed if whole else rest).append(numbers)
    left = sorted(number for numbers in rest for number in numbers)
    again = _by_edges([part.faces[number] for number in left], _welded(part.xyz))
    pieces = sorted([*closed, *([left[number] for number in numbers] for numbers in again)])
    if len(pieces) == 1:
        return [part]
    return [raw_part(part.xyz, [part.faces[number] for number in piece], is_solid=part.is_solid) for piece in pieces]


def _by_edges(faces: Sequence[RawFace], names: Sequence[int]) -> list[list[int]]:
    """Faces connected by common edges; vertices with one name are one."""
    seen: dict[tuple[int, int], int] = {}
    pairs = []
    for number, face in enumerate(faces):
        for ring in face.rings:
            for a, b in zip(ring, (*ring[1:], ring[0]), strict=True):
                edge = (min(names[a], names[b]), max(names[a], names[b]))
                pairs.append((seen.setdefault(edge, number), number))
    return grouped(len(faces), pairs)


def grouped(count: int, pairs: Iterable[Sequence[int]]) -> list[list[int]]:
    """Numbers below count connected by pairs: sorted groups in the order of their first members.

    >>> grouped(4, [(0, 2), (3, 3)])
    [[0, 2], [1], [3]]
    """
    one, other = np.fromiter(chain.from_iterable(pairs), np.int64).reshape(-1, 2).T
    groups: dict[int, list[int]] = {}
    for number, first in enumerate(united(count, one, other).tolist()):
        groups.setdefault(first, []).append(number)
    return list(groups.values())


KIND_OF_WORD: Mapping[str, FaceKind] = {
    "roof": FaceKind.ROOF,
    "wall": FaceKind.WALL,
    "facade": FaceKind.WALL,
    "ground": FaceKind.GROUND,
    "floor": FaceKind.GROUND,
    "base": FaceKind.GROUND,
}
"""Words in the names of groups and materials, and the kind of face that they mean."""


def kind_in_name(name: str) -> FaceKind | None:
    """The kind of face that the name of a group or material means; None without a clear one."""
    lowered = name.lower()
    kinds = {kind for word, kind in KIND_OF_WORD.items() if word in lowered}
    return kinds.pop() if len(kinds) == 1 else None
