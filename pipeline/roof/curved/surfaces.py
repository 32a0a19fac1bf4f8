"""The surfaces of curved roofs: barrels, cones and spheres, fitted to points by their distances.

A barrel is half of a horizontal cylinder, circular or elliptic; a cone stands on a vertical axis; a dome is a sphere.
A fit begins with the roof planes, which touch the surface nearly, and ends with robust least squares of the distances
of all points (Gauss and Newton; weights of Geman and McClure).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from pipeline.model import FloatArray, LabelArray, Plane, RoofType

_REACHES_M = (1.0, 0.5, 0.25)
"""From step to step, points farther than this count less, then those beyond `_SIGMAS` standard deviations."""
_STEPS, _PATIENCE, _HOPELESS, _STILL = 14, 4, 6.0, 1e-5
"""Most steps; after some, a fit ends whose points scatter by many times what is wanted, or whose parameters rest."""
_SIGMAS = 3.0
_MAD_TO_SIGMA = 1.4826
_LEAST_SIGMA_M = 0.005
_TINY = 1e-9
_DECIMALS = 6
"""Parameters are rounded: the last bits of a sum may differ between processors."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Surface:
    """A curved surface, in the frame of its points."""

    kind: RoofType
    """Barrel, cone or dome."""
    parameters: tuple[float, ...]
    """Barrel: direction of its axis, radians from east; place of the axis across it and its elevation; half its width
    and its height, metres, one radius for a circle. Cone: apex x, y, z and slope. Dome: centre x, y, z and radius."""
    sigma_m: float
    """Robust standard deviation of the distances."""
    distances_m: FloatArray
    """(n,) float64, signed, of the points."""

    @property
    def axes(self) -> tuple[float, float]:
        """Half the width and the height of a barrel, the radius of a dome twice."""
        return self.parameters[3], self.parameters[-1]


def fitted_surfaces(points: FloatArray, planes: Sequence[Plane], labels: LabelArray, most_m: float) -> list[Surface]:
    """The surfaces of each kind about which points (n, 3), metres, near the origin, scatter by no more than `most_m`.

    `labels` (n,) are the planes of the points, -1 for none. Barrels come as circles and as ellipses.
    """
    found: list[Surface] = []
    known = points[labels >= 0]
    slopes = np.array([(plane.a, plane.b, plane.c) for plane in planes])
    weights = np.bincount(labels[labels >= 0], minlength=len(planes)).astype(np.float64)
    for kind, begin, distances in (
        (RoofType.BARREL, _first_barrel, barrel_distances),
        (RoofType.CONE, _first_cone, cone_distances),
        (RoofType.DOME, _first_sphere, sphere_distances),
    ):
        first = begin(known, slopes, weights)
        if first is None:
            continue
        one = _fitted(kind, points, distances, first, most_m)
        found.extend([one] if one is not None else [])
        if kind is RoofType.BARREL:
            starts = _ellipses(known, first if one is None else np.array(one.parameters))
            ellipses = (_fitted(kind, points, distances, start, most_m) for start in starts)
            found.extend(sorted(filter(None, ellipses), key=lambda ellipse: ellipse.sigma_m)[:1])
    return found


def barrel_distances(points: FloatArray, parameters: FloatArray) -> FloatArray:
    """Signed distances (n,) from a cylinder: exact for a circle, to first order for an ellipse."""
    azimuth, at, base, width = parameters[:4].tolist()
    height = float(parameters[-1])
    v = points[:, 1] * math.cos(azimuth) - points[:, 0] * math.sin(azimuth) - at
    w = points[:, 2] - base
    if len(parameters) < 5:
        return np.asarray(np.hypot(v, w) - width)
    out = np.maximum(np.hypot(v / width, w / height), _TINY)
    return np.asarray((out - 1.0) * out / np.maximum(np.hypot(v / width**2, w / height**2), _TINY))


def cone_distances(points: FloatArray, parameters: FloatArray) -> FloatArray:
    """Signed distances (n,) from a cone that falls from its apex."""
    x, y, top, slope = parameters.tolist()
    away = np.hypot(points[:, 0] - x, points[:, 1] - y)
    return np.asarray((points[:, 2] - top + slope * away) / math.hypot(1.0, slope))


def sphere_distances(points: FloatArray, parameters: FloatArray) -> FloatArray:
    """Signed distances (n,) from a sphere."""
    x, y, z, radius = parameters.tolist()
    flat = np.hypot(points[:, 0] - x, points[:, 1] - y)
    return np.asarray(np.hypot(flat, points[:, 2] - z) - radius)


def _first_barrel(points: FloatArray, slopes: FloatArray, weights: FloatArray) -> FloatArray | None:
    """A circular cylinder along the direction in which no plane slopes."""
    xx, xy, yy = (float(np.sum(weights * slopes[:, i] * slopes[:, j])) for i, j in ((0, 0), (0, 1), (1, 1)))
    azimuth = 0.5 * math.atan2(2.0 * xy, xx - yy) + 0.5 * math.pi
    v, z = points[:, 1] * math.cos(azimuth) - points[:, 0] * math.sin(azimuth), points[:, 2]
    solved = _solved(np.column_stack([2.0 * v, 2.0 * z, np.ones(len(v))]), v * v + z * z)
    if solved is None:
        return None
    at, base, rest = solved.tolist()
    square = rest + at * at + base * base
    return np.array([azimuth, at, base, math.sqrt(square)]) if square > 0.0 else None


def _ellipses(points: FloatArray, circle: FloatArray) -> Iterator[FloatArray]:
    """Beginnings of ellipses: that of least squares of v^2 = 2 v v0 - k z^2 + 2 k z z0 + d, and a circle."""
    azimuth, at, base, radius = circle.tolist()
    v, z = points[:, 1] * math.cos(azimuth) - points[:, 0] * math.sin(azimuth), points[:, 2]
    solved = _solved(np.column_stack([2.0 * v, -z * z, 2.0 * z, np.ones(len(v))]), v * v)
    if solved is not None and solved[1] > 0.0:
        middle, k, raised, rest = solved.tolist()
        square = rest + middle * middle + raised * raised / k
        if square > 0.0:
            yield np.array([azimuth, middle, raised / k, math.sqrt(square), math.sqrt(square / k)])
    yield np.array([azimuth, at, base, radius, radius])


def _first_cone(points: FloatArray, slopes: FloatArray, weights: FloatArray) -> FloatArray | None:
    """The apex is where the planes meet; the slope is their mean one."""
    root = np.sqrt(weights)
    across = np.column_stack([slopes[:, 0], slopes[:, 1], -np.ones(len(slopes))])
    apex = _solved(across * root[:, None], -slopes[:, 2] * root)
    slope = float(np.sum(weights * np.hypot(slopes[:, 0], slopes[:, 1])) / np.sum(weights))
    return None if apex is None or not len(points) else np.array([*apex.tolist(), slope])


def _first_sphere(points: FloatArray, slopes: FloatArray, weights: FloatArray) -> FloatArray | None:
    """The sphere of least squares of x^2 + y^2 + z^2 = 2 x x0 + 2 y y0 + 2 z z0 + d."""
    del slopes, weights
    solved = _solved(np.column_stack([2.0 * points, np.ones(len(points))]), np.sum(points * points, axis=1))
    if solved is None:
        return None
    square = float(solved[3] + np.sum(solved[:3] ** 2))
    return np.array([*solved[:3].tolist(), math.sqrt(square)]) if square > 0.0 else None


def _solved(rows: FloatArray, values: FloatArray) -> FloatArray | None:
    """The least squares of rows (n, k) times unknowns = values (n,); None where they do not determine them."""
    square = np.einsum("ij,ik->jk", rows, rows)
    size = np.sqrt(np.diag(square))
    if len(rows) < len(size) or not (size > 0.0).all():
        return None
    square = square / np.outer(size, size)
    if not np.linalg.cond(square) < 1e12:
        return None
    return np.asarray(np.linalg.solve(square, np.einsum("ij,i->j", rows, values) / size) / size)


def _fitted(
    kind: RoofType,
    points: FloatArray,
    distances: Callable[[FloatArray, FloatArray], FloatArray],
    first: FloatArray,
    most_m: float,
) -> Surface | None:
    """The robust least squares from a first surface; None where it runs away or the points scatter by more."""
    now = first.copy()
    extent = float(np.abs(points).max()) * 20.0
    for step in range(_STEPS):
        away = distances(points, now)
        sigma_m = _sigma(away)
        if step > _PATIENCE and sigma_m > _HOPELESS * most_m:
            return None
        reach = _REACHES_M[step] if step < len(_REACHES_M) else _SIGMAS * sigma_m
        weights = reach * reach / (reach * reach + away * away)
        rows = np.empty((len(points), len(now)))
        for k in range(len(now)):
            moved = now.copy()
            moved[k] += 1e-6
            rows[:, k] = (distances(points, moved) - away) * 1e6
        change = _solved(rows * weights[:, None], -away * weights)
        if change is None:
            return None
        now = now + change
        if step > _PATIENCE and np.abs(change).max() < _STILL:
            break
        if not np.isfinite(now).all() or np.abs(now).max() > extent or (now[3:] <= 0.0).any():
            return None
    parameters = np.round(now, _DECIMALS)
    away = distances(points, parameters)
    sigma_m = _sigma(away)
    if not sigma_m <= most_m:
        return None
    return Surface(kind=kind, parameters=tuple(parameters.tolist()), sigma_m=sigma_m, distances_m=away)


def _sigma(away: FloatArray) -> float:
    """Robust standard deviation of distances about 0."""
    return max(_MAD_TO_SIGMA * float(np.median(np.abs(away))), _LEAST_SIGMA_M)
