"""Templates fitted to the roof points of one outline, and compared with other roof faces by BIC."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.extras.templates.parts import fit_parts, main_direction
from pipeline.extras.templates.shapes import CAP_SIGMAS, MAX_PLANES
from pipeline.extras.templates.template_drawing import draw_parts
from pipeline.model import FloatArray, LabelArray, Plane, Reason
from pipeline.roof.named_form import RankedFaces
from pipeline.roof.partition import RoofPartition

SIGMA_M = 0.1
"""Standard deviation of points about the faces of a simple model: noise, and what is too small for the density."""
_REACH_M = CAP_SIGMAS * SIGMA_M
"""A point farther from a template is not explained by it."""
MIN_POINTS = 4
"""Least points of an outline: a level has one parameter, the others confirm it."""
_POINTS_OF_PART = 3
"""Least points of a part: one more than a pent shape has parameters."""
_MIN_EXPLAINED = 0.5
"""Share of the points within three standard deviations below which templates are not a model of them."""
_SPARE_POINTS = 2
"""By how many the explained points must outnumber the parameters: many small shapes fit any points."""
_MIN_FACE_M2 = 1.0
"""A smaller face holds fewer than three points at the densities of templates."""
_STEP_M = 0.3
"""Faces that differ by more along a border meet in a step: three standard deviations of their points."""
_PARAMETERS_OF_PLANE = 3
_PARAMETERS_OF_STEP = 2
"""Degrees of freedom in the information criterion."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Templates:
    """Simple roof shapes over the parts of an outline, not yet drawn."""

    outline_mm: MultiPolygon
    """Integer millimetres."""
    direction: float
    """Direction of the frame's axis u, radians."""
    origin_m: FloatArray
    """(2,) float64, of the frame."""
    regions: FloatArray
    """(p, 4) float64, least and largest u, least and largest v of each part."""
    counts: LabelArray
    """(p,) int32, planes of each part."""
    planes: FloatArray
    """(p, 4, 3) float64, (a, b, c) of z = a u + b v + c; the roof of a part is the lowest of its planes."""
    parameters: float
    """Number of parameters of shapes and cuts."""
    residuals_m: FloatArray
    """(n,) float64, height of every point above its roof."""
    plane_of_point: LabelArray
    """(n,) int32, 4 p + k for a point over plane k of part p."""

    def faces(self, bic_margin: float = math.nan) -> RankedFaces:
        """Draw the roof faces; raises BuildingError `no_partition` where they break on the millimetre grid."""
        drawn = draw_parts(
            self.outline_mm, self.regions, self.counts, self.planes, self.direction, self.origin_m, _MIN_FACE_M2
        )
        used = np.unique(drawn.labels)
        number = np.full(MAX_PLANES * len(self.regions), -1, np.int32)
        number[used] = np.arange(len(used))
        labels = number[self.plane_of_point]
        labels[np.abs(self.residuals_m) > _REACH_M] = -1
        planes = tuple(self._plane(old, self.residuals_m[labels == new]) for new, old in enumerate(used.tolist()))
        partition = RoofPartition(polygons=drawn.polygons, labels=number[drawn.labels])
        return RankedFaces(partition=partition, planes=planes, labels=labels, bic_margin=bic_margin)

    def _plane(self, number: int, residuals_m: FloatArray) -> Plane:
        """A plane in local metres, with the number and residuals of its points."""
        a, b, c = self.planes[number // MAX_PLANES, number % MAX_PLANES].tolist()
        cos, sin = math.cos(self.direction), math.sin(self.direction)
        x_slope, y_slope = a * cos - b * sin, a * sin + b * cos
        squares = math.fsum((residuals_m**2).tolist())
        return Plane(
            a=x_slope,
            b=y_slope,
            c=c - x_slope * float(self.origin_m[0]) - y_slope * float(self.origin_m[1]),
            n_points=len(residuals_m),
            rmse_m=math.sqrt(squares / max(len(residuals_m), 1)),
        )


def fit_templates(points: FloatArray, outline_mm: MultiPolygon) -> Templates:
    """Fit flat, pent, gable, hip and half-hip roofs to the parts of an outline, of the least BIC that is found.

    Points (n, 3) see the sky and are in local metres, in a canonical order; the outline is valid, in integer
    millimetres of the same frame.

    Raises
    ------
    BuildingError
        `too_few_points` below four points, `no_plane` where the best templates explain less than half of them, or
        too few for their parameters.
    """
    if len(points) < MIN_POINTS:
        raise BuildingError(Reason.TOO_FEW_POINTS, f"{len(points)} roof points, templates take {MIN_POINTS}")
    rings = [ring for polygon in outline_mm.geoms for ring in (polygon.exterior, *polygon.interiors)]
    around = [shapely.get_coordinates(ring) * 1e-3 for ring in rings]
    origin = np.array(outline_mm.bounds[:2]) * 1e-3
    edges = np.concatenate([np.hstack((xy[:-1], xy[1:])) for xy in around])
    direction, fitted = _fit_in_frame(np.ascontiguousarray(points), edges, origin, SIGMA_M, _POINTS_OF_PART)
    parameters, parts, regions, counts, planes, residuals, plane_of = fitted
    explained = int((np.abs(residuals) <= _REACH_M).sum())
    if explained < max(_MIN_EXPLAINED * len(points), parameters + _SPARE_POINTS):
        found = f"{explained} of {len(points)} roof points with {parameters:g} parameters"
        raise BuildingError(Reason.NO_PLANE, f"templates explain only {found}")
    return Templates(
        outline_mm=outline_mm,
        direction=direction,
        origin_m=origin,
        regions=regions[:parts],
        counts=counts[:parts],
        planes=planes[:parts],
        parameters=parameters,
        residuals_m=residuals,
        plane_of_point=plane_of,
    )


@kernel
def _fit_in_frame(
    points: FloatArray, edges: FloatArray, origin: FloatArray, sigma_m: float, fewest: int
) -> tuple[float, tuple[float, int, FloatArray, LabelArray, FloatArray, FloatArray, LabelArray]]:
    """The main direction of an outline, and what `fit_parts` finds along it and across."""
    direction, framed, turned = _in_frame(points, edges, origin)
    return direction, fit_parts(framed, turned, sigma_m, fewest)


@kernel
def _in_frame(points: FloatArray, edges: FloatArray, origin: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """The main direction of an outline, and points and edges along it and across."""
    # written out: the last bits of a matrix product depend on the machine
    direction = main_direction(edges)
    cos, sin = math.cos(direction), math.sin(direction)
    framed, turned = points.copy(), edges.copy()
    for i in range(len(points)):
        x, y = points[i, 0] - origin[0], points[i, 1] - origin[1]
        framed[i, 0], framed[i, 1] = x * cos + y * sin, y * cos - x * sin
    for e in range(len(edges)):
        for end in range(0, 4, 2):
            x, y = edges[e, end] - origin[0], edges[e, end + 1] - origin[1]
            turned[e, end], turned[e, end + 1] = x * cos + y * sin, y * cos - x * sin
    return direction, framed, turned


def margin_of_templates(
    points: FloatArray, templates: Templates, partition: RoofPartition, planes: Sequence[Plane]
) -> float:
    """By how much the Bayesian information criterion of templates is below that of other roof faces.

    The criterion is the sum of min((r / sigma)^2, 9) over the points' vertical residuals r, plus the free parameters
    times ln n (Schwarz 1978, with capped errors). Points that the faces do not cover count in neither.

    `points` (n, 3) are those that the templates were fitted to; `partition` is a coverage in integer millimetres.
    """
    others = np.full(len(points), np.inf)
    x_mm, y_mm = points[:, 0] * 1e3, points[:, 1] * 1e3
    for polygon, label in zip(partition.polygons, partition.labels.tolist(), strict=True):
        shapely.prepare(polygon)
        plane = planes[label]
        over = shapely.intersects_xy(polygon, x_mm, y_mm)
        residuals = np.abs(points[over, 2] - plane.a * points[over, 0] - plane.b * points[over, 1] - plane.c)
        others[over] = np.minimum(others[over], residuals)
    covered = np.isfinite(others)
    misfits = [
        math.fsum(np.minimum((one[covered] / SIGMA_M) ** 2, CAP_SIGMAS**2).tolist())
        for one in (others, templates.residuals_m)
    ]
    return misfits[0] - misfits[1] + (parameters_of(partition, planes) - templates.parameters) * math.log(len(points))


def parameters_of(partition: RoofPartition, planes: Sequence[Plane]) -> float:
    """Free parameters of roof faces: three per plane, two (direction and place) per pair of faces that meets in a step.

    The partition is a coverage: its faces share their vertices.
    """
    beside: dict[tuple[float, ...], int] = {}
    steps: set[tuple[int, int]] = set()
    for number, polygon in enumerate(partition.polygons):
        for ring in (polygon.exterior, *polygon.interiors):
            xy = shapely.get_coordinates(ring).tolist()
            for (x0, y0), (x1, y1) in itertools.pairwise(xy):
                other = beside.pop((x1, y1, x0, y0), -1)
                if other < 0:
                    beside[x0, y0, x1, y1] = number
                    continue
                x, y = 0.5e-3 * (x0 + x1), 0.5e-3 * (y0 + y1)
                one, two = planes[partition.labels[number]], planes[partition.labels[other]]
                if abs((one.a - two.a) * x + (one.b - two.b) * y + one.c - two.c) > _STEP_M:
                    steps.add((other, number))
    count = len(set(partition.labels.tolist()))
    return float(_PARAMETERS_OF_PLANE * count + _PARAMETERS_OF_STEP * len(steps))
