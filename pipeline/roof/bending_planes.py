"""Whether roof planes may belong to one curved surface, by their directions alone: most roofs end here at once."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pipeline.model import LabelArray, Plane

_ONE_DIRECTION = math.cos(math.radians(3.0))
_MOST, _FEWEST, _AROUND = 0.8, 3, 5
"""Share of the points that the largest directions hold; how many do on a barrel, on a cone: two on a gable, four on a
hip roof, also on an L."""
_LEVEL_ALONG, _LARGE, _MOST_TURN_DEG = 0.05, 0.04, 35.0
"""Slope of the planes of a barrel along its axis; the turn from one large plane to the next, by its share of points."""
_TOUCHING_M = 0.15
"""Distance of the planes of a curve from a sphere that they touch; a cone's has radius 0, one of many in a barrel."""
_ROUNDS, _LEAST = 4, 1e-9
"""Rounds of robust least squares; what is added to its squares, since planes of one tent touch many spheres."""


def may_be_curved(planes: Sequence[Plane], labels: LabelArray) -> bool:
    """Whether most points lie on planes that slope along one line, or touch one sphere; `labels` (n,), -1 for none."""
    if len(planes) < _FEWEST:
        return False
    counts = np.bincount(labels[labels >= 0], minlength=len(planes))
    normals, left, held = np.array([plane.normal for plane in planes]), counts.copy(), [0]
    while left.any():
        near = np.sum(normals * normals[np.argmax(left)], axis=1) > _ONE_DIRECTION
        held.append(int(left[near].sum()))
        left[near] = 0
    needed = 1 + int(np.count_nonzero(np.cumsum(sorted(held)[::-1]) < _MOST * counts.sum()))
    if needed < _FEWEST:
        return False
    share = counts / counts.sum()
    a, b, c = np.array([plane.coefficients for plane in planes]).T
    size = np.sqrt(1.0 + a * a + b * b)
    if needed < _AROUND:  # a sphere touches any three or four planes
        xx, yy, xy = (float(np.sum(share * one * other)) for one, other in ((a, a), (b, b), (a, b)))
        across = 0.5 * math.atan2(2.0 * xy, xx - yy)
        along = float(np.sum(share * (b * math.cos(across) - a * math.sin(across)) ** 2))
        slopes = (a * math.cos(across) + b * math.sin(across))[share >= _LARGE]
        turns = np.diff(np.sort(np.degrees(np.arctan(slopes))))
        return along < _LEVEL_ALONG**2 and bool(turns.max(initial=0.0) <= _MOST_TURN_DEG)
    touching, weights = np.column_stack([a, b, -np.ones(len(a)), -size]) / size[:, None], share
    for _ in range(_ROUNDS):
        square = np.einsum("i,ij,ik->jk", weights, touching, touching) + _LEAST * np.eye(4)
        sphere = np.linalg.solve(square, -np.einsum("i,ij,i->j", weights, touching, c / size))
        away = np.abs(np.sum(touching * sphere, axis=1) + c / size)
        weights = share / (1.0 + (away / _TOUCHING_M) ** 2)
    return float(share[away < _TOUCHING_M].sum()) >= _MOST
