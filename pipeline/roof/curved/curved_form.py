"""Whether a roof is curved, and its facets: a barrel, a cone or a dome competes with the planes that were found.

A surface takes the place of the planes if it describes the points better: the squares of its distances, in the noise,
and its parameters cost less than those of the planes (Bayesian information criterion), its distances are the noise and
no more, and nearly all of the roof lies on it. It has to turn by much and in all directions that its name promises.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.errors import BuildingError
from pipeline.model import Decision, DecisionKind, FloatArray, Outcome, Plane, Reason, RoofType
from pipeline.roof.curved.facets import cut_to, facets_of
from pipeline.roof.curved.surfaces import Surface, fitted_surfaces
from pipeline.roof.named_form import ARRANGEMENT, CURVED, NamedForm
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPoints

_LEAST_TOLERANCE_M, _MOST_TOLERANCE_M = 0.01, 0.05
"""Facets follow the surface as nearly as its points do, those of a dome less nearly, within these limits."""
_BOTH_WAYS = 1.5
"""Times that tolerance on a dome, whose facets leave it in two directions."""
_MOST_SIGMAS = 3.0
"""Farther points are not of the surface; each costs no more than one at this distance."""
_LEAST_ON_IT = 0.85
"""Share of the roof points."""
_AS_NOISY = 1.25
"""Most times the noise of the points about their planes that they may lie about the surface."""
_LEAST_TURN_DEG, _LEAST_SLOPE_DEG = 20.0, 10.0
"""Least turn of a barrel or dome over its points, least slope of a cone: roofs that undulate are level."""
_SECTORS, _LEAST_SECTORS = 12, 9
"""Sectors around the middle of a cone or dome, and how many of them must hold points."""
_PLANE_TERMS, _KIND_TERMS = 4, 1
"""Parameters of each plane, with one for its borders, and of the choice between surfaces."""
_TURNS = (0.0, 0.37, 0.73)
"""Shares of a sector by which the facets are turned, one after the other until the solid is valid."""


def curved_forms(
    roof: RoofPoints, planes: Sequence[Plane], outline_mm: MultiPolygon, decisions: list[Decision]
) -> Iterator[NamedForm[RoofPartition]]:
    """The facets of the surface that describes the roof better than its planes; none where no surface does.

    What the planes lost by is added to `decisions`.
    """
    shift = np.floor(roof.points.mean(axis=0))
    near = roof.points - shift
    moved = [dataclasses.replace(one, c=one.c + one.a * shift[0] + one.b * shift[1] - shift[2]) for one in planes]
    sigma_m, of_planes_m = _about_planes(near, moved, roof)
    fitted = fitted_surfaces(near, moved, roof.labels, _AS_NOISY * sigma_m)
    found = [one for one in fitted if _is_whole(one, near, outline_mm, shift)]
    if not found:
        return
    noise_m = min(one.sigma_m for one in found)  # all are counted in the noise of the best one
    costs = [_cost(one.distances_m, noise_m, len(one.parameters) + _KIND_TERMS) for one in found]
    cost, surface = min(costs), found[costs.index(min(costs))]
    margin = _cost(of_planes_m, noise_m, _PLANE_TERMS * len(planes)) - cost
    if margin <= 0.0:
        return
    decisions.append(Decision(kind=DecisionKind.FORM, name=ARRANGEMENT, outcome=Outcome.OUTDONE, bic_margin=-margin))
    wanted_m = surface.sigma_m * (_BOTH_WAYS if surface.kind is RoofType.DOME else 1.0)
    tolerance_m = min(max(wanted_m, _LEAST_TOLERANCE_M), _MOST_TOLERANCE_M)
    for turn in _TURNS:
        words = f"{_words(surface)}; facets within {tolerance_m:.3f} m"
        yield NamedForm(CURVED, partial(_faces, surface, outline_mm, near, shift, tolerance_m, turn), words)


def _about_planes(near: FloatArray, planes: Sequence[Plane], roof: RoofPoints) -> tuple[float, FloatArray]:
    """Robust noise of the points about their planes, and the distance (n,) of each; infinite for points without."""
    coefficients = np.array([plane.coefficients for plane in planes])
    a, b, c = coefficients[roof.labels].T
    away = (near[:, 2] - a * near[:, 0] - b * near[:, 1] - c) / np.sqrt(1.0 + a * a + b * b)
    away = np.where(roof.labels >= 0, away, np.inf)
    known = np.abs(away[roof.labels >= 0])
    free = len(known) / max(len(known) - 3 * len(planes), 1)  # a plane follows some of the noise
    return 1.4826 * float(np.median(known)) * math.sqrt(free), away


def _cost(away_m: FloatArray, noise_m: float, terms: int) -> float:
    """The information criterion of distances (n,) and a number of parameters."""
    squares = np.minimum((away_m / noise_m) ** 2, _MOST_SIGMAS**2)
    return float(np.sum(squares)) + terms * math.log(len(away_m))


def _is_whole(surface: Surface, near: FloatArray, outline_mm: MultiPolygon, shift: FloatArray) -> bool:
    """Whether nearly all points lie on a surface, which turns by much, all around its middle if it has one."""
    on_it = np.abs(surface.distances_m) <= _MOST_SIGMAS * surface.sigma_m
    if np.mean(on_it) < _LEAST_ON_IT:
        return False
    points = near[on_it]
    if surface.kind is not RoofType.CONE and np.median(points[:, 2]) <= surface.parameters[2]:
        return False  # it hangs
    if surface.kind is RoofType.BARREL:
        azimuth, at, base, *_ = surface.parameters
        width, height = surface.axes
        v = points[:, 1] * math.cos(azimuth) - points[:, 0] * math.sin(azimuth) - at
        slopes = np.degrees(np.arctan2(v * height * height, np.maximum(points[:, 2] - base, 1e-9) * width * width))
        low, high = np.quantile(slopes, (0.02, 0.98))
        return bool(high - low >= _LEAST_TURN_DEG)
    x, y, *_ = surface.parameters
    dx, dy = points[:, 0] - x, points[:, 1] - y
    sector = np.floor((np.arctan2(dy, dx) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(np.int64)
    if len(np.unique(sector)) < _LEAST_SECTORS:
        return False
    if not shapely.contains_xy(outline_mm, (x + shift[0]) * 1e3, (y + shift[1]) * 1e3):
        return False
    if surface.kind is RoofType.CONE:
        return bool(math.degrees(math.atan(surface.parameters[3])) >= _LEAST_SLOPE_DEG)
    reach = min(1.0, float(np.quantile(np.hypot(dx, dy), 0.98)) / surface.parameters[3])
    return 2.0 * math.degrees(math.asin(reach)) >= _LEAST_TURN_DEG


def _words(surface: Surface) -> str:
    """Its name and dimensions."""
    sigma = f"points within {surface.sigma_m:.3f} m"
    if surface.kind is RoofType.CONE:
        return f"cone of {math.degrees(math.atan(surface.parameters[3])):.1f} deg, {sigma}"
    if surface.kind is RoofType.DOME:
        return f"dome of radius {surface.parameters[3]:.2f} m, {sigma}"
    width, height = surface.axes
    size = (
        f"radius {width:.2f} m" if len(surface.parameters) < 5 else f"half width {width:.2f} m, height {height:.2f} m"
    )
    return f"barrel of {size}, axis at {math.degrees(math.pi / 2 - surface.parameters[0]) % 180.0:.1f} deg, {sigma}"


def _faces(
    surface: Surface,
    outline_mm: MultiPolygon,
    near: FloatArray,
    shift: FloatArray,
    tolerance_m: float,
    turn: float,
) -> RoofPartition:
    """The facets within an outline."""
    dx, dy, dz = shift.tolist()
    moved_mm = shapely.transform(outline_mm, lambda xy: xy - shift[:2] * 1e3)
    facets = facets_of(surface, shapely.get_coordinates(moved_mm) * 1e-3, tolerance_m, turn)
    pieces, of_piece = cut_to(moved_mm, facets)
    if not pieces:
        raise BuildingError(Reason.NO_PARTITION, "no facet lies in the outline")
    used, labels = np.unique(of_piece, return_inverse=True)
    places = shapely.points(near[:, :2] * 1e3)
    piece, point = shapely.STRtree(places).query(pieces, predicate="contains")
    planes = []
    for k, facet in enumerate(used.tolist()):
        a, b, c = facets[facet].plane
        x, y, z = near[point[labels[piece] == k]].T
        away = z - a * x - b * y - c
        rmse_m = math.sqrt(float(np.mean(away * away))) if len(away) else surface.sigma_m
        planes.append(Plane(a=a, b=b, c=c + dz - a * dx - b * dy, n_points=len(away), rmse_m=rmse_m))
    moved = shapely.transform(pieces, lambda xy: xy + shift[:2] * 1e3)
    partition = RoofPartition(polygons=tuple(moved), labels=labels.astype(np.int32), planes=tuple(planes))
    return dataclasses.replace(partition, roof_type=surface.kind)
