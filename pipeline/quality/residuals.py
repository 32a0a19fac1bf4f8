"""Residuals: the vertical distance of measured points to a model's top surface."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely
from numba import njit

from pipeline.model import FloatArray, IntArray, Plane, RoofFace

_MAX_CELLS = 1_000_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResidualSummary:
    """What the residuals of a building come to."""

    rmse_m: float
    """Root mean square over the covered points; nan without any."""
    median_m: float
    """Median of the absolute residuals of the covered points; nan without any."""
    p95_m: float
    """95th percentile of the same; nan without any."""
    share_within: float
    """Share of ALL points that are covered and within the tolerance: no roof is a miss."""
    coverage: float
    """Share of points that have a roof above or below them; 0 without points."""
    n_points: int
    """All points."""


@njit(cache=True, nogil=True)
def _top_surface(
    px: FloatArray,
    py: FloatArray,
    edges: FloatArray,
    edge_starts: IntArray,
    coefficients: FloatArray,
    cell_starts: IntArray,
    cell_faces: IntArray,
    low_x: float,
    low_y: float,
    cell: float,
    columns: int,
    rows: int,
) -> FloatArray:
    """Highest face over every point, nan where there is none: crossings to the right, of the faces in the cell."""
    n = len(px)
    top = np.full(n, np.nan)
    for i in range(n):
        x = px[i]
        y = py[i]
        column = math.floor((x - low_x) / cell)
        row = math.floor((y - low_y) / cell)
        if column < 0 or row < 0 or column >= columns or row >= rows:
            continue
        k = row * columns + column
        for s in range(cell_starts[k], cell_starts[k + 1]):
            face = cell_faces[s]
            inside = False
            for e in range(edge_starts[face], edge_starts[face + 1]):
                y0 = edges[e, 1]
                y1 = edges[e, 3]
                if (y0 > y) == (y1 > y):
                    continue
                x0 = edges[e, 0]
                x1 = edges[e, 2]
                # always from the lower end, so that both faces of an edge judge alike
                if y0 > y1:
                    x0, x1 = x1, x0
                    y0, y1 = y1, y0
                if (x1 - x0) * (y - y0) - (x - x0) * (y1 - y0) > 0.0:
                    inside = not inside
            if inside:
                z = coefficients[face, 0] * x + coefficients[face, 1] * y + coefficients[face, 2]
                if not top[i] >= z:
                    top[i] = z
    return top


@njit(cache=True, nogil=True)
def _faces_of_cells(
    boxes: FloatArray, low_x: float, low_y: float, cell: float, columns: int, rows: int
) -> tuple[IntArray, IntArray]:
    """Faces whose bounding box touches a cell, cell by cell."""
    starts = np.zeros(columns * rows + 1, np.int64)
    faces = np.empty(0, np.int64)
    for turn in range(2):
        if turn == 1:
            for k in range(columns * rows):
                starts[k + 1] += starts[k]
            faces = np.empty(starts[-1], np.int64)
            filled = starts[:-1].copy()
        for f in range(len(boxes)):
            c0 = math.floor((boxes[f, 0] - low_x) / cell)
            r0 = math.floor((boxes[f, 1] - low_y) / cell)
            c1 = min(columns - 1, math.floor((boxes[f, 2] - low_x) / cell))
            r1 = min(rows - 1, math.floor((boxes[f, 3] - low_y) / cell))
            for r in range(r0, r1 + 1):
                for c in range(c0, c1 + 1):
                    if turn == 0:
                        starts[r * columns + c + 1] += 1
                    else:
                        faces[filled[r * columns + c]] = f
                        filled[r * columns + c] += 1
    return starts, faces


def top_surface(points: FloatArray, faces: Sequence[RoofFace], planes: Sequence[Plane]) -> FloatArray:
    """Elevation of the model's highest roof face over or under every point.

    Parameters
    ----------
    points : (n, 2) or (n, 3) float64
        Easting, northing in the faces' frame, metres.
    faces : sequence of RoofFace
        Roof faces; only their plan shape and plane number are used.
    planes : sequence of Plane
        The planes.

    Returns
    -------
    (n,) float64
        Metres; nan where no face covers the point.
    """
    if len(faces) == 0 or len(points) == 0:
        return np.full(len(points), np.nan)
    blocks, starts = [], [0]
    for face in faces:
        for ring in (face.polygon.exterior, *face.polygon.interiors):
            xy = shapely.get_coordinates(ring)
            blocks.append(np.hstack((xy[:-1], xy[1:])))
        starts.append(starts[-1] + _n_edges(face))
    edges = np.concatenate(blocks)
    boxes = np.array([face.polygon.bounds for face in faces])
    low_x, low_y = float(boxes[:, 0].min()), float(boxes[:, 1].min())
    width, depth = float(boxes[:, 2].max()) - low_x, float(boxes[:, 3].max()) - low_y
    cell = max(0.5, math.sqrt(width * depth / (4 * len(faces))))
    while (width / cell + 1) * (depth / cell + 1) > _MAX_CELLS:
        cell *= 2.0
    columns, rows = math.floor(width / cell) + 1, math.floor(depth / cell) + 1
    cell_starts, cell_faces = _faces_of_cells(boxes, low_x, low_y, cell, columns, rows)
    coefficients = np.array([planes[face.plane].coefficients for face in faces])
    top: FloatArray = _top_surface(
        np.ascontiguousarray(points[:, 0]),
        np.ascontiguousarray(points[:, 1]),
        edges,
        np.array(starts, np.int64),
        coefficients,
        cell_starts,
        cell_faces,
        low_x,
        low_y,
        cell,
        columns,
        rows,
    )
    return top


def _n_edges(face: RoofFace) -> int:
    return int(shapely.get_num_coordinates(face.polygon)) - 1 - len(face.polygon.interiors)


def vertical_residuals(points: FloatArray, faces: Sequence[RoofFace], planes: Sequence[Plane]) -> FloatArray:
    """Points minus top surface.

    Parameters
    ----------
    points : (n, 3) float64
        Original points, metres.
    faces : sequence of RoofFace
        The model's roof faces.
    planes : sequence of Plane
        Their planes.

    Returns
    -------
    (n,) float64
        Metres, positive above the roof; nan where no face covers the point.
    """
    residuals: FloatArray = points[:, 2] - top_surface(points, faces, planes)
    return residuals


def summarise(residuals: FloatArray, tolerance_m: float = 0.2) -> ResidualSummary:
    """Figures of a building's residuals.

    Parameters
    ----------
    residuals : (n,) float64
        From `vertical_residuals`: nan is a point without a roof.
    tolerance_m : float
        For `share_within`.

    Returns
    -------
    ResidualSummary
        Sums are exact, so that they do not depend on the order of points.

    Examples
    --------
    >>> import numpy as np
    >>> summary = summarise(np.array([0.1, -0.1, np.nan, 0.5]))
    >>> summary.share_within, summary.coverage
    (0.5, 0.75)
    """
    n = len(residuals)
    distances = np.sort(np.abs(residuals[~np.isnan(residuals)]))
    covered = len(distances)
    if covered == 0:
        return ResidualSummary(
            rmse_m=math.nan, median_m=math.nan, p95_m=math.nan, share_within=0.0, coverage=0.0, n_points=n
        )
    return ResidualSummary(
        rmse_m=math.sqrt(math.fsum((distances * distances).tolist()) / covered),
        median_m=float(np.median(distances)),
        p95_m=float(np.percentile(distances, 95.0)),
        share_within=float(np.searchsorted(distances, tolerance_m, side="right")) / n,
        coverage=covered / n,
        n_points=n,
    )
