"""Curved roofs among the patches of a candidate: domes, cones and barrels, each of one quadric surface.

Patches on a curve meet in folds that run anywhere, so the rules for borders between planes would separate them. A
sphere, an ellipsoid, a cone and a cylinder are quadrics: the zeros of a polynomial of second degree in x, y and z.
Patches that bend outwards from one to the next, in many directions, are one roof if one quadric runs through them all.
Two planes are a quadric, too; the number of directions distinguishes a curve from those.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.terrain.roof_patches import MIN_TURN, Borders, GrownPatches, Patches, cosine, has_directions

# Not settings: they say what a curved surface is, as those of patches say what a plane is.
_MAX_TURN = math.cos(math.radians(60.0))
"""Cosine of the angle between patches that follow each other on a curve: a larger angle is an edge."""
_MIN_BEND_M = 0.02
"""A plane passes over the middle of the next patch of a curve, by at least this."""
_NEAR_MM = 120.0
"""A vertex this near to a surface lies on it: four times the noise of a survey without offsets of strips."""
_GOES_ON_MM = 300.0
"""The same for patches beside those through which a surface was fitted."""
_ON_SURFACE = 0.9
"""Share of the vertices of a curved roof that lie on its surface."""
_JOINING = 0.7
"""Share of the vertices of a patch that lie on a surface which goes on over it."""
_LEAST_M2 = 12.0
"""A smaller curve is a part of a roof: a bay, a turret."""
_ROUNDS = 12
"""Rings of patches around the first: bounds the work."""
_FITS = 6
"""Fits of a quadric, each with the distances of the one before as weights."""
_STEPS = 12
"""Steps of the inverse iteration: the least of ten eigenvalues is far below the next one where there is a surface."""
_TERMS = 10


@kernel
def _monomials(x: float, y: float, z: float, out: FloatArray) -> None:
    """Fill in the ten terms of a quadric at a place."""
    out[0], out[1], out[2] = x * x, y * y, z * z
    out[3], out[4], out[5] = x * y, x * z, y * z
    out[6], out[7], out[8], out[9] = x, y, z, 1.0


@kernel
def _distance(q: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Distance of a place from a quadric, to first order, and the length of the gradient, which divides the value."""
    value = q[0] * x * x + q[1] * y * y + q[2] * z * z + q[3] * x * y + q[4] * x * z + q[5] * y * z
    value += q[6] * x + q[7] * y + q[8] * z + q[9]
    gx = 2.0 * q[0] * x + q[3] * y + q[4] * z + q[6]
    gy = 2.0 * q[1] * y + q[3] * x + q[5] * z + q[7]
    gz = 2.0 * q[2] * z + q[4] * x + q[5] * y + q[8]
    gradient = max(math.sqrt(gx * gx + gy * gy + gz * gz), 1e-12)
    return abs(value) / gradient, gradient


@kernel
def _least_eigenvector(matrix: FloatArray) -> FloatArray:
    """Eigenvector of the least eigenvalue of a positive matrix (10, 10), by inverse iteration on its factors."""
    n = len(matrix)
    trace = 0.0
    for i in range(n):
        trace += matrix[i, i]
    factor = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j] + (1e-12 * trace if i == j else 0.0)
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(max(total, 1e-15 * trace)) if i == j else total / factor[j, j]
    vector = np.empty(n)
    for i in range(n):
        vector[i] = 1.0 + 0.1 * i  # along no axis
    for _ in range(_STEPS):
        for i in range(n):
            for k in range(i):
                vector[i] -= factor[i, k] * vector[k]
            vector[i] /= factor[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                vector[i] -= factor[k, i] * vector[k]
            vector[i] /= factor[i, i]
        length = 0.0
        for i in range(n):
            length += vector[i] * vector[i]
        for i in range(n):
            vector[i] /= math.sqrt(length)
    return vector


@kernel
def _framed(xyz: FloatArray, fitted: BoolArray) -> tuple[FloatArray, float, int]:
    """Places (n, 3) about the mean of the `fitted` ones, in a unit that none of these exceeds; unit; number."""
    centre, count = np.zeros(3), 0
    for i in range(len(xyz)):
        if fitted[i]:
            count += 1
            for axis in range(3):
                centre[axis] += xyz[i, axis]
    scale = 1.0
    framed = np.empty(xyz.shape)
    for i in range(len(xyz)):
        for axis in range(3):
            framed[i, axis] = xyz[i, axis] - centre[axis] / max(count, 1)
            if fitted[i]:
                scale = max(scale, abs(framed[i, axis]))
    for i in range(len(xyz)):
        for axis in range(3):
            framed[i, axis] /= scale
    return framed, scale, count


@kernel
def _weighted_sums(framed: FloatArray, fitted: BoolArray, q: FloatArray, reach: float) -> FloatArray:
    """Sums of the products of the terms over the fitted places, (10, 10); with weights if a quadric is known.

    `reach` is negative if none is. Values are divided by their gradients, so they are distances to first order (Taubin
    1991), and places farther than the reach count less (weights of Geman and McClure).
    """
    sums, terms = np.zeros((_TERMS, _TERMS)), np.empty(_TERMS)
    for i in range(len(framed)):
        if not fitted[i]:
            continue
        x, y, z = framed[i]
        _monomials(x, y, z, terms)
        weight = 1.0
        if reach > 0.0:
            away, gradient = _distance(q, x, y, z)
            weight = (reach * reach / (reach * reach + away * away)) ** 2 / max(gradient * gradient, 1e-6)
        for k in range(_TERMS):
            for m in range(k + 1):
                sums[k, m] += weight * terms[k] * terms[m]
    for k in range(_TERMS):
        for m in range(k):
            sums[m, k] = sums[k, m]
    return sums


@kernel
def _distances_from_quadric(xyz: FloatArray, fitted: BoolArray, near: float) -> FloatArray:
    """Distance (n,) of all places (n, 3) from the quadric that most of the `fitted` ones lie near; unit that of places.

    From fit to fit the distance that counts as far halves, down to `near`. Infinite where too few places are fitted.
    """
    out = np.full(len(xyz), np.inf)
    framed, scale, count = _framed(xyz, fitted)
    if count < 2 * _TERMS:
        return out
    q, reach = np.zeros(_TERMS), -1.0
    for fit in range(_FITS):
        q = _least_eigenvector(_weighted_sums(framed, fitted, q, reach))
        reach = near / scale * 2.0 ** (_FITS - 2 - fit)
    for i in range(len(framed)):
        out[i] = scale * _distance(q, framed[i, 0], framed[i, 1], framed[i, 2])[0]
    return out


def curved_surfaces(grown: GrownPatches, patches: Patches, borders: Borders, normals: FloatArray) -> LabelArray:
    """The curved surface of each patch of a roof, (k,) int32 as the number of one of its patches; -1 for none.

    `normals` (k, 3) are of unit length. Roofs with too few directions for a curve are for the caller to leave out.
    """
    count = len(patches.areas_m2)
    surface = np.full(count, -1, np.int32)
    beside = _bending(patches, borders, normals)
    xyz = np.column_stack(grown.vertices[:3]).astype(np.float64)
    held = np.bincount(patches.of_vertex, minlength=count)
    for seed in np.argsort(-patches.areas_m2, kind="stable").tolist():
        if surface[seed] >= 0 or len(beside.get(seed, ())) < 2:
            continue
        members = _grown_surface(seed, beside, xyz, patches.of_vertex, held)
        members = {k for k in members if surface[k] < 0}
        if _is_curve(sorted(members), normals, xyz, patches):
            surface[sorted(members)] = min(members)
    return surface


def _bending(patches: Patches, borders: Borders, normals: FloatArray) -> dict[int, set[int]]:
    """The patches beside each one towards which the roof bends outwards as a curve may."""
    beside: dict[int, set[int]] = {}
    for p, q in zip(borders.first.tolist(), borders.second.tolist(), strict=True):
        if not _MAX_TURN <= cosine(normals[p], normals[q]) <= MIN_TURN:
            continue
        over = min(_above(patches, p, q), _above(patches, q, p))
        if over >= _MIN_BEND_M:
            beside.setdefault(p, set()).add(q)
            beside.setdefault(q, set()).add(p)
    return beside


def _above(patches: Patches, p: int, q: int) -> float:
    """By how many metres the plane of one patch passes over the middle of another."""
    x, y, z = patches.centres_m[q].tolist()
    a, b = patches.slopes[p].tolist()
    return float(a * x + b * y + patches.levels_mm[p] / 1000.0 - z)


def _grown_surface(
    seed: int, beside: dict[int, set[int]], xyz: FloatArray, of_vertex: LabelArray, held: IntArray
) -> set[int]:
    """Patches on one quadric around a first one, ring by ring as long as they lie near that of those before.

    A quadric goes on less exactly than it fits; the patches that do not lie on the last one are left out in the end.
    """

    def lying(around: set[int], reach_mm: float) -> set[int]:
        is_member = np.zeros(len(held), np.bool_)
        is_member[sorted(members)] = True
        away = _distances_from_quadric(xyz, is_member[of_vertex], _NEAR_MM)
        near = np.bincount(of_vertex, away <= reach_mm, minlength=len(held))
        return {k for k in around if near[k] >= _JOINING * held[k]}

    members = {seed, *beside[seed]}
    for _ in range(_ROUNDS):
        joined = lying(members.union(*(beside[k] for k in members)), _GOES_ON_MM)
        if seed not in joined:
            return set()
        if joined == members:
            break
        members = joined
    return lying(members, _NEAR_MM)


def _is_curve(members: list[int], normals: FloatArray, xyz: FloatArray, patches: Patches) -> bool:
    """Whether patches are one curved surface: large, of many directions, and nearly all of it on one quadric."""
    if not members or patches.areas_m2[members].sum() < _LEAST_M2 or not has_directions(normals[members]):
        return False
    inside = np.isin(patches.of_vertex, members)
    away = _distances_from_quadric(xyz, inside, _NEAR_MM)
    return bool(np.mean(away[inside] <= _NEAR_MM) >= _ON_SURFACE)
