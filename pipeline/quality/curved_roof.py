"""Curved roofs (domes, barrels), which LoD2 models as many planes whose normals turn steadily."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pipeline.model import Plane, RoofFace, Solid
from pipeline.roof.roof_type import folds

Normal = tuple[float, float, float]
"""A unit vector that points up."""

MIN_TURN_DEG = 3.0
MAX_TURN_DEG = 26.0
"""Planes that meet in a ridge of this angle go on one another in a curve; hips of 18 deg and gables of 13 deg turn by
more."""
_MIN_TURN_COSINE = math.cos(math.radians(MIN_TURN_DEG))
_MAX_TURN_COSINE = math.cos(math.radians(MAX_TURN_DEG))
MIN_NORMALS = 5
"""Directions of a curve. Hip roofs, also those on an L, have four; a mansard's break is a larger turn."""
MIN_SHARE = 0.5
"""Share of the roof's plan area."""
SLIVER_HEIGHT_M = 0.5
"""Planes meet across a wall that is nowhere higher, as for the roof types."""


def is_curved_roof(planes: Sequence[Plane], faces: Sequence[RoofFace], solids: Sequence[Solid]) -> bool:
    """Whether most of a roof is one surface that bends steadily outwards.

    Planes that meet in a ridge with a small turn belong to one surface; it is curved where its planes have at least
    five directions (`MIN_NORMALS`), and it is most of the roof.
    """
    if len(planes) < MIN_NORMALS:
        return False
    normals = [plane.normal for plane in planes]
    if not _has_directions(normals):
        return False
    ridges, _ = folds(planes, solids, SLIVER_HEIGHT_M)
    surface = list(range(len(planes)))
    for p, q in sorted(ridges):
        if p < q and _MAX_TURN_COSINE <= _cosine(normals[p], normals[q]) <= _MIN_TURN_COSINE:
            one, other = surface[p], surface[q]
            surface = [one if number == other else number for number in surface]
    areas = [0.0] * len(planes)
    for face in faces:
        areas[face.plane] += face.polygon.area
    for number in sorted(set(surface)):
        members = [p for p in range(len(planes)) if surface[p] == number]
        share = math.fsum(areas[p] for p in members)
        if share >= MIN_SHARE * math.fsum(areas) and _has_directions([normals[p] for p in members]):
            return True
    return False


def _cosine(one: Normal, other: Normal) -> float:
    """Cosine of the angle between two unit normals."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _has_directions(normals: Sequence[Normal]) -> bool:
    """Whether there are so many normals as a curve has of which no two are nearer than the least turn.

    Each is kept where those before it allow it.
    """
    kept: list[Normal] = []
    for normal in normals:
        if all(_cosine(normal, other) <= _MIN_TURN_COSINE for other in kept):
            kept.append(normal)
            if len(kept) == MIN_NORMALS:
                return True
    return False
