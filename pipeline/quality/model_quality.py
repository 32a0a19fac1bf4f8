"""How well the points support a delivered model: noise, what is unexplained, holes in the data, the ridge's height.

All figures follow from the points and the delivered faces alone, so they are the same for every method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.model import FloatArray, ModelQuality, Plane, RoofFace, Solid
from pipeline.quality.residuals import ResidualSummary, TopSurface, summarise, surface_of
from pipeline.quality.ridge_height import ridge_height_sigma_m
from pipeline.quality.roof_returns import MAD_TO_SIGMA, TOLERANCE_M, roof_returns
from pipeline.quality.unseen_roof import Raster

GAP_SPACINGS = 1.5
"""A place farther than this from all points is seen by none: of points strewn at random one place in a thousand is."""
EXTRAPOLATED_SPACINGS = 2.0
"""A part of the roof farther than this from all points was drawn by what lies beside it, and by the footprint."""
_STRIP_POINTS, _LEAST_OUTLINE_M = 1.7, 0.02
"""The place of an edge is known to the strip along it that holds so many points (`outline_shapes`, dev seeds)."""
_MIN_CELL_M = 0.25
"""Places on the roof are looked at on a raster of one point spacing, or of this where points are denser."""
_MAX_CELLS = 20_000
"""Halls of more cells are looked at more coarsely."""


def drawn_outline_sigma_m(outline: shapely.Geometry, n_points: int) -> float:
    """Standard deviation in plan of the edges of an outline drawn around points, metres; an area of metres.

    >>> [round(drawn_outline_sigma_m(shapely.box(0, 0, 10, 10), n), 2) for n in (30, 150, 800)]
    [0.57, 0.12, 0.03]
    """
    rings = shapely.get_rings(shapely.get_parts(shapely.simplify(outline, 0.01)))
    edge_m = shapely.length(rings).sum() / (shapely.get_num_coordinates(rings) - 1).sum()
    return math.hypot(_STRIP_POINTS * outline.area / n_points / edge_m, _LEAST_OUTLINE_M)


def model_quality(
    points: FloatArray,
    faces: Sequence[RoofFace],
    planes: Sequence[Plane],
    solids: Sequence[Solid],
    *,
    spacing_m: float,
    outline_sigma_m: float,
    is_planar: bool,
    bic_margin: float = math.nan,
) -> tuple[ResidualSummary, ModelQuality]:
    """Measure a delivered model by all points (n, 3) of its candidate, local metres.

    `spacing_m` is the typical distance of neighbouring points in plan, `outline_sigma_m` the standard deviation of the
    outline's place in plan, 0 if it was given. `is_planar` says that the faces follow the roof's planes (LoD2):
    residuals of a block are the roof's form, not noise, and the top of a block is not a ridge, so both figures are nan.

    The summary, with `TOLERANCE_M`, is of the roof returns. Figures are nan if no points say anything; `bic_margin` is
    passed on.
    """
    surface = surface_of(faces, planes)
    residuals, face_of_point = surface.residuals(points)
    summary = summarise(residuals[roof_returns(points, residuals, spacing_m)], TOLERANCE_M)
    unexplained = extrapolated = hole = math.nan
    if summary.coverage > 0.0 and spacing_m > 0.0:
        area_m2 = math.fsum(face.polygon.area for face in faces)
        unexplained, extrapolated, hole = _seen(points, surface, residuals, area_m2, spacing_m)
    noise = sigma = math.nan
    if is_planar:
        noise = MAD_TO_SIGMA * summary.median_m
        # -1, no face, takes the last one: no plane
        plane_of_point = np.array([*(face.plane for face in faces), -1], np.int32)[face_of_point]
        reach = max(TOLERANCE_M, 3.0 * noise)
        sigma = ridge_height_sigma_m(points, residuals, plane_of_point, reach, planes, solids, outline_sigma_m)
    return summary, ModelQuality(
        point_spacing_m=spacing_m,
        noise_m=noise,
        share_within=summary.share_within if summary.n_points else math.nan,
        share_below_roof=1.0 - summary.n_points / len(points) if len(points) else math.nan,
        unexplained_m2=unexplained,
        extrapolated_share=extrapolated,
        largest_hole_m=hole,
        ridge_z_sigma_m=sigma,
        outline_sigma_m=outline_sigma_m if outline_sigma_m > 0.0 else math.nan,
        bic_margin=bic_margin,
    )


def _seen(
    points: FloatArray, surface: TopSurface, residuals: FloatArray, area_m2: float, spacing_m: float
) -> tuple[float, float, float]:
    """Area of roof without points near it, m2, its share far from all, and the largest circle without any, m across."""
    low_x, low_y, high_x, high_y = surface.bounds
    cell = max(_MIN_CELL_M, spacing_m, math.sqrt((high_x - low_x) * (high_y - low_y) / _MAX_CELLS))
    columns, rows = math.floor((high_x - low_x) / cell) + 1, math.floor((high_y - low_y) / cell) + 1
    raster = Raster(low_x, low_y, cell, columns, rows)
    gaps_m = (GAP_SPACINGS * spacing_m, EXTRAPOLATED_SPACINGS * spacing_m)
    places, unseen, far, square = surface.seen(points, residuals, raster, TOLERANCE_M, gaps_m)
    if places == 0:
        return math.nan, math.nan, math.nan
    return unseen / places * area_m2, far / places, 2.0 * math.sqrt(square)
