"""How well the points support a delivered model: noise, what is unexplained, holes in the data, the ridge's height.

All figures follow from the points and the delivered faces alone, so they are the same for every method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from pipeline.model import BoolArray, FloatArray, LabelArray, ModelQuality, Plane, RoofFace, Solid
from pipeline.quality.curved_roof import is_curved_roof
from pipeline.quality.residuals import ResidualSummary, TopSurface
from pipeline.quality.ridge_height import ridge_height_sigma_m

TOLERANCE_M = 0.2
"""A point within this vertical distance of the roof is explained by it."""
GAP_SPACINGS = 1.5
"""A place farther than this from all points is seen by none: of points strewn at random one place in a thousand is."""
DRAWN_OUTLINE_SPACINGS = 0.2
"""Standard deviation in plan of a drawn outline: pent roofs of the simulated suites, whose ridge is their outline."""
_MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute values."""
_LEAST_CELL_M = 0.25
"""Places on the roof are looked at on a raster of one point spacing, or of this where points are denser."""
_MOST_CELLS = 20_000
"""Halls of more cells are looked at more coarsely."""


def model_quality(
    points: FloatArray,
    surface: TopSurface,
    residuals: FloatArray,
    face_of_point: LabelArray,
    summary: ResidualSummary,
    faces: Sequence[RoofFace],
    planes: Sequence[Plane],
    solids: Sequence[Solid],
    *,
    spacing_m: float,
    outline_sigma_m: float,
    is_planar: bool,
    bic_margin: float = math.nan,
) -> ModelQuality:
    """Measure a delivered model by its points.

    Parameters
    ----------
    points : (n, 3) float64
        All points of the candidate, local metres.
    surface : TopSurface
        Of the faces.
    residuals : (n,) float64
        Points minus top surface, metres; nan where there is no roof.
    face_of_point : (n,) int32
        The face that each point was held against; -1 for none.
    summary : ResidualSummary
        Of these residuals, with `TOLERANCE_M`.
    faces, planes, solids : sequences
        The model.
    spacing_m : float
        Typical distance of neighbouring points in plan.
    outline_sigma_m : float
        Standard deviation of the outline's place in plan; 0 where it was given.
    is_planar : bool
        Whether the faces follow the roof's planes (LoD2). What a block leaves is the roof's form, not noise, and the
        top of a block is no ridge: both are then nan.
    bic_margin : float
        By how much the chosen form is better than the next one; nan where none competed.

    Returns
    -------
    ModelQuality
        nan where there are no points to tell.
    """
    unexplained, hole = _seen(points, surface, residuals, faces, spacing_m)
    noise = sigma = math.nan
    if is_planar:
        noise = _MAD_TO_SIGMA * summary.median_m
        owner = np.array([face.plane for face in faces], np.int32)
        plane_of_point = np.where(face_of_point >= 0, owner[face_of_point], np.int32(-1)).astype(np.int32)
        reach = max(TOLERANCE_M, 3.0 * noise)
        sigma = ridge_height_sigma_m(points, residuals, plane_of_point, reach, planes, solids, outline_sigma_m)
    return ModelQuality(
        point_spacing_m=spacing_m,
        noise_m=noise,
        share_within=summary.share_within if summary.n_points else math.nan,
        unexplained_m2=unexplained,
        largest_hole_m=hole,
        ridge_z_sigma_m=sigma,
        bic_margin=bic_margin,
        is_curved=is_planar and is_curved_roof(planes, faces, solids),
    )


def _seen(
    points: FloatArray, surface: TopSurface, residuals: FloatArray, faces: Sequence[RoofFace], spacing_m: float
) -> tuple[float, float]:
    """Area of roof without points near it, m2, and the diameter of the largest circle on it without any point, m."""
    if np.isnan(residuals).all() or not spacing_m > 0.0:
        return math.nan, math.nan
    low_x, low_y, high_x, high_y = surface.bounds
    cell = max(_LEAST_CELL_M, spacing_m, math.sqrt((high_x - low_x) * (high_y - low_y) / _MOST_CELLS))
    raster = (low_x, low_y, cell, math.floor((high_x - low_x) / cell) + 1, math.floor((high_y - low_y) / cell) + 1)
    on_roof = surface.face(*_middles(*raster)) >= 0
    places, unseen, square = _unseen(points, residuals, on_roof, *raster, TOLERANCE_M, GAP_SPACINGS * spacing_m)
    if places == 0:
        return math.nan, math.nan
    return unseen / places * math.fsum(face.polygon.area for face in faces), 2.0 * math.sqrt(square)


@njit(cache=True, nogil=True)
def _middles(low_x: float, low_y: float, cell: float, columns: int, rows: int) -> tuple[FloatArray, FloatArray]:
    """Middles of a raster's cells, line by line, x and y, (rows * columns,) metres."""
    x = np.empty(rows * columns)
    y = np.empty(rows * columns)
    for row in range(rows):
        for column in range(columns):
            x[row * columns + column] = low_x + (column + 0.5) * cell
            y[row * columns + column] = low_y + (row + 0.5) * cell
    return x, y


@njit(cache=True, nogil=True)
def _unseen(
    points: FloatArray,
    residuals: FloatArray,
    on_roof: BoolArray,
    low_x: float,
    low_y: float,
    cell: float,
    columns: int,
    rows: int,
    tolerance_m: float,
    gap_m: float,
) -> tuple[int, int, float]:
    """Cells on the roof, those of them far from all points on it, and the largest squared distance to any point, m2."""
    any_point = _nearest_squares(points, residuals, np.inf, low_x, low_y, cell, columns, rows)
    explained = _nearest_squares(points, residuals, tolerance_m, low_x, low_y, cell, columns, rows)
    places = 0
    unseen = 0
    largest = 0.0
    for k in range(len(on_roof)):
        if on_roof[k]:
            places += 1
            unseen += explained[k] > gap_m * gap_m
            largest = max(largest, any_point[k])
    return places, unseen, largest


@njit(cache=True, nogil=True)
def _nearest_squares(
    points: FloatArray,
    residuals: FloatArray,
    tolerance_m: float,
    low_x: float,
    low_y: float,
    cell: float,
    columns: int,
    rows: int,
) -> FloatArray:
    """Squared distance in plan from every cell's middle to the nearest point that is so near to a roof above or below.

    Each cell keeps the point nearest to its middle, and cells hand theirs on to their neighbours, in two sweeps of the
    raster with two of each line (Danielsson 1980): distances are too large by less than a cell, most not at all.
    (rows * columns,) m2; infinite without points.
    """
    squares = np.full(rows * columns, np.inf)
    nearest_x = np.full(rows * columns, np.inf)
    nearest_y = np.full(rows * columns, np.inf)
    for i in range(len(points)):
        if abs(residuals[i]) <= tolerance_m:
            x, y = (points[i, 0] - low_x) / cell, (points[i, 1] - low_y) / cell
            column = min(max(math.floor(x), 0), columns - 1)
            row = min(max(math.floor(y), 0), rows - 1)
            _offer(x, y, column, row, row * columns + column, squares, nearest_x, nearest_y)
    for sweep in range(2):
        for line in range(rows):
            row = line if sweep == 0 else rows - 1 - line
            before = row - 1 if sweep == 0 else row + 1
            first = row * columns
            if 0 <= before < rows:
                for column in range(columns):
                    j = before * columns + column
                    _offer(nearest_x[j], nearest_y[j], column, row, first + column, squares, nearest_x, nearest_y)
            for column in range(1, columns):
                j = first + column - 1
                _offer(nearest_x[j], nearest_y[j], column, row, first + column, squares, nearest_x, nearest_y)
            for column in range(columns - 2, -1, -1):
                j = first + column + 1
                _offer(nearest_x[j], nearest_y[j], column, row, first + column, squares, nearest_x, nearest_y)
    return squares * (cell * cell)


@njit(cache=True, nogil=True)
def _offer(
    x: float, y: float, column: int, row: int, k: int, squares: FloatArray, nearest_x: FloatArray, nearest_y: FloatArray
) -> None:
    """Take a point, in cells, for cell k where it is nearer to its middle than the one that it has."""
    dx, dy = x - (column + 0.5), y - (row + 0.5)
    square = dx * dx + dy * dy
    if square < squares[k]:
        squares[k] = square
        nearest_x[k] = x
        nearest_y[k] = y
