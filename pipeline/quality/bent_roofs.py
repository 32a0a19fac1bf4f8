"""Whether planes that were found follow a curve: what is said of roofs that are neither barrel nor cone nor dome."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pipeline.model import Plane, RoofFace, RoofType, Solid
from pipeline.roof.roof_sides import folds
from pipeline.terrain.roof_patches import MIN_TURN, cosine, has_directions

MAX_TURN_DEG = 26.0
"""Planes that meet in a ridge of this angle go on one another in a curve; hips of 18 deg and gables of 13 deg turn by
more."""
MIN_SHARE = 0.5
"""Share of the roof's plan area."""
SLIVER_HEIGHT_M = 0.5
"""Planes meet across a wall that is nowhere higher, as for the roof types."""


def is_curved_roof(
    planes: Sequence[Plane], faces: Sequence[RoofFace], solids: Sequence[Solid], known: RoofType | None = None
) -> bool:
    """Whether most of a roof is one surface that bends steadily outwards, which the `known` type may say.

    Planes that meet in a ridge with a small turn belong to one surface; it is curved where its planes have at least
    five directions, and it is most of the roof.
    """
    if known is not None and known.is_curved:
        return True
    normals = np.array([plane.normal for plane in planes])
    if not has_directions(normals):
        return False
    least = math.cos(math.radians(MAX_TURN_DEG))
    ridges, _ = folds(planes, solids, SLIVER_HEIGHT_M)
    surface = list(range(len(planes)))
    for p, q in sorted(ridges):
        if p < q and least <= cosine(normals[p], normals[q]) <= MIN_TURN:
            one, other = surface[p], surface[q]
            surface = [one if number == other else number for number in surface]
    areas = [0.0] * len(planes)
    for face in faces:
        areas[face.plane] += face.polygon.area
    for number in sorted(set(surface)):
        members = [p for p in range(len(planes)) if surface[p] == number]
        share = math.fsum(areas[p] for p in members)
        if share >= MIN_SHARE * math.fsum(areas) and has_directions(normals[members]):
            return True
    return False
