"""Residuals: the vertical distance of measured points to a model's top surface."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.geometry import corners_of_rings
from pipeline.kernels.exact_sum import exact_sum
from pipeline.kernels.sorting import counting_sort
from pipeline.model import FloatArray, IntArray, LabelArray, Plane, RoofFace
from pipeline.quality.unseen_roof import Raster, middles_of_cells, unseen_cells

_MAX_CELLS = 1_000_000
"""Cells of the raster over a roof: bounds the memory."""
_FAR_M = 1.0
"""Of the farthest tenth of the points no distance counts more than this, unless the other nine tenths reach farther."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResidualSummary:
    """Figures of the residuals of a building."""

    rmse_m: float
    """Root mean square over the covered points; nan without any. A chimney does not decide: no distance counts more
    than 1 m, or than the 90th percentile if that is larger."""
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


class _Faces(NamedTuple):
    """Many planar faces in a local frame, and which of them lie in each cell of a grid."""

    origin_x: float
    origin_y: float
    """Origin of the frame, metres."""
    planes: FloatArray
    """(n, 3) float64."""
    edges: FloatArray
    """(e, 4) float64, x and y of both ends, face by face."""
    edge_starts: IntArray
    """(n + 1,) int64."""
    boxes: FloatArray
    """(n, 4) float64, west, south, east, north."""
    cell_starts: LabelArray
    """(rows * columns + 1,) int32."""
    cell_faces: IntArray
    """(m,) int64, faces by cells."""
    low_x: float
    low_y: float
    high_x: float
    high_y: float
    """Bounds of the boxes."""
    cell: float
    columns: int
    rows: int
    tolerance: float
    """A place that no face covers takes a face whose border is this near, metres."""


@kernel
def _is_inside(x: float, y: float, edges: FloatArray, first: int, last: int) -> bool:
    """Whether an odd number of edges is crossed to the right of a place."""
    inside = False
    for e in range(first, last):
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
    return inside


@kernel
def _is_near(x: float, y: float, edges: FloatArray, first: int, last: int, limit: float) -> bool:
    """Whether an edge passes within a distance of a place."""
    for e in range(first, last):
        x0 = edges[e, 0]
        y0 = edges[e, 1]
        dx = edges[e, 2] - x0
        dy = edges[e, 3] - y0
        length = dx * dx + dy * dy
        along = 0.0
        if length > 0.0:
            along = min(1.0, max(0.0, ((x - x0) * dx + (y - y0) * dy) / length))
        dx = x - x0 - along * dx
        dy = y - y0 - along * dy
        if dx * dx + dy * dy <= limit * limit:
            return True
    return False


@kernel
def _top_surface(px: FloatArray, py: FloatArray, faces: _Faces) -> tuple[FloatArray, LabelArray]:
    """Highest face over every point and its number, nan and -1 where there is none."""
    edges, edge_starts, boxes, planes = faces.edges, faces.edge_starts, faces.boxes, faces.planes
    cell_starts, tolerance = faces.cell_starts, faces.tolerance
    n = len(px)
    top = np.full(n, np.nan)
    number = np.full(n, -1, np.int32)
    for i in range(n):
        x = px[i] - faces.origin_x
        y = py[i] - faces.origin_y
        column = math.floor((x - faces.low_x) / faces.cell)
        row = math.floor((y - faces.low_y) / faces.cell)
        if column < 0 or row < 0 or column >= faces.columns or row >= faces.rows:
            continue
        k = row * faces.columns + column
        for turn in range(2):
            for s in range(cell_starts[k], cell_starts[k + 1]):
                face = faces.cell_faces[s]
                if x < boxes[face, 0] or y < boxes[face, 1] or x > boxes[face, 2] or y > boxes[face, 3]:
                    continue
                first, last = edge_starts[face], edge_starts[face + 1]
                if turn == 0:
                    hit = _is_inside(x, y, edges, first, last)
                else:
                    hit = _is_near(x, y, edges, first, last, tolerance)
                if hit:
                    z = planes[face, 0] * x + planes[face, 1] * y + planes[face, 2]
                    if not top[i] >= z:
                        top[i] = z
                        number[i] = face
            if number[i] >= 0 or tolerance <= 0.0:
                break
    return top, number


@kernel
def _residuals(points: FloatArray, faces: _Faces) -> tuple[FloatArray, LabelArray]:
    """The kernel of `TopSurface.residuals`."""
    top, number = _top_surface(points[:, 0].copy(), points[:, 1].copy(), faces)
    return points[:, 2] - top, number


@kernel
def _laid_out(
    xy: FloatArray,
    ring_of: IntArray,
    face_of_ring: IntArray,
    planes: FloatArray,
    origin: tuple[float, float],
    tolerance: float,
) -> _Faces:
    """Faces with planes (n, 3) in a frame with this origin, by cells.

    Vertices `xy` (v, 2), metres, come ring after ring, each closed; `ring_of` (v,) is their ring, `face_of_ring` (r,)
    the face of each ring, ascending. Faces without a ring are in no cell. Boxes are widened by `tolerance`.
    """
    n = len(planes)
    edges = np.empty((len(xy), 4))
    edge_starts = np.zeros(n + 1, np.int64)
    boxes = np.empty((n, 4))
    boxes[:, :2], boxes[:, 2:] = np.inf, -np.inf
    m = 0
    for v in range(len(xy)):
        face = face_of_ring[ring_of[v]]
        x, y = xy[v, 0] - origin[0], xy[v, 1] - origin[1]
        box = boxes[face]
        box[0], box[1], box[2], box[3] = min(box[0], x), min(box[1], y), max(box[2], x), max(box[3], y)
        if v > 0 and ring_of[v - 1] == ring_of[v]:
            edges[m, 0], edges[m, 1] = xy[v - 1, 0] - origin[0], xy[v - 1, 1] - origin[1]
            edges[m, 2], edges[m, 3] = x, y
            edge_starts[face + 1] = m + 1
            m += 1
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for f in range(n):
        edge_starts[f + 1] = max(edge_starts[f + 1], edge_starts[f])
        if boxes[f, 0] <= boxes[f, 2]:
            boxes[f, 0], boxes[f, 1] = boxes[f, 0] - tolerance, boxes[f, 1] - tolerance
            boxes[f, 2], boxes[f, 3] = boxes[f, 2] + tolerance, boxes[f, 3] + tolerance
            low_x, low_y = min(low_x, boxes[f, 0]), min(low_y, boxes[f, 1])
            high_x, high_y = max(high_x, boxes[f, 2]), max(high_y, boxes[f, 3])
    width, depth = high_x - low_x, high_y - low_y
    cell = max(0.5, math.sqrt(width * depth / (4 * n)))
    while (width / cell + 1) * (depth / cell + 1) > max(_MAX_CELLS, 8 * n):
        cell *= 2.0
    columns, rows = math.floor(width / cell) + 1, math.floor(depth / cell) + 1
    # every face in every cell that its box meets; the second turn writes what the first one counted
    cells, face_of = np.empty(0, np.int32), np.empty(0, np.int32)
    for turn in range(2):
        m = 0
        for f in range(n):
            if not boxes[f, 0] <= boxes[f, 2]:
                continue
            c0 = math.floor((boxes[f, 0] - low_x) / cell)
            r0 = math.floor((boxes[f, 1] - low_y) / cell)
            c1 = min(columns - 1, math.floor((boxes[f, 2] - low_x) / cell))
            r1 = min(rows - 1, math.floor((boxes[f, 3] - low_y) / cell))
            for r in range(r0, r1 + 1):
                for c in range(c0, c1 + 1):
                    if turn == 1:
                        cells[m], face_of[m] = r * columns + c, f
                    m += 1
        if turn == 0:
            cells, face_of = np.empty(m, np.int32), np.empty(m, np.int32)
    starts, members = counting_sort(cells, columns * rows)
    faces = np.empty(len(members), np.int64)
    for s in range(len(members)):
        faces[s] = face_of[members[s]]
    return _Faces(
        origin[0], origin[1], planes, edges[: edge_starts[n]].copy(), edge_starts, boxes, starts, faces,
        low_x, low_y, high_x, high_y, cell, columns, rows, tolerance,
    )  # fmt: skip


@kernel
def _seen(
    points: FloatArray,
    residuals: FloatArray,
    raster: Raster,
    tolerance_m: float,
    gaps_m: tuple[float, float],
    faces: _Faces,
) -> tuple[int, int, int, float]:
    """The kernel of `TopSurface.seen`."""
    x, y = middles_of_cells(raster)
    _, number = _top_surface(x, y, faces)
    return unseen_cells(points, residuals, number >= 0, raster, tolerance_m, gaps_m[0], gaps_m[1])


class TopSurface:
    """The highest of many planar faces: built once, queried at any number of places.

    Coordinates are taken relative to a corner in whole metres, which is exact: nothing is lost at 1e6 m. A place on
    the border of two faces belongs to exactly one of them; of faces of one height the first counts.

    Elevations in the polygons, which are in metres, are not looked at. The plane of each is
    z = a (x - origin_x) + b (y - origin_y) + c + origin_z, by coefficients (n, 3) and origins (n, 3), (0, 0, 0) by
    default. A place that no face covers takes the highest face whose border is as near as `tolerance_m`: with
    coordinates rounded to 1 mm, two faces that meet leave gaps. `corner` is the place of the local frame; whole metres
    at the lower left of all faces by default.
    """

    def __init__(
        self,
        polygons: Sequence[Polygon | MultiPolygon],
        coefficients: FloatArray,
        origins: FloatArray | None = None,
        *,
        tolerance_m: float = 0.0,
        corner: tuple[float, float] | None = None,
    ) -> None:
        n = len(polygons)
        xy, ring, face_of_ring = corners_of_rings(polygons)
        self._empty = len(xy) == 0
        if self._empty:
            return
        self._corner = (float(np.floor(xy[:, 0].min())), float(np.floor(xy[:, 1].min()))) if corner is None else corner
        planes = np.array(coefficients, dtype=np.float64).reshape(n, 3)
        if origins is not None:
            shift = np.asarray(origins, dtype=np.float64)
            planes[:, 2] += (
                shift[:, 2]
                + planes[:, 0] * (self._corner[0] - shift[:, 0])
                + planes[:, 1] * (self._corner[1] - shift[:, 1])
            )
        elif self._corner != (0.0, 0.0):
            planes[:, 2] += planes[:, 0] * self._corner[0] + planes[:, 1] * self._corner[1]
        self._faces = _laid_out(xy, ring, face_of_ring, planes, self._corner, tolerance_m)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest x, smallest y, largest x, largest y of all faces, metres; nan without any."""
        if self._empty:
            return math.nan, math.nan, math.nan, math.nan
        (east, north), faces = self._corner, self._faces
        return faces.low_x + east, faces.low_y + north, faces.high_x + east, faces.high_y + north

    def at(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, LabelArray]:
        """Elevation of the highest face at places x, y, each (n,) finite metres, and its index into the polygons.

        Both are (n,); nan and -1 where no face is.
        """
        if self._empty or len(x) == 0:
            return np.full(len(x), np.nan), np.full(len(x), -1, np.int32)
        x, y = np.ascontiguousarray(x, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
        return _top_surface(x, y, self._faces)

    def residuals(self, points: FloatArray) -> tuple[FloatArray, LabelArray]:
        """Points (n, 3) minus this surface, (n,) m, nan outside all faces; and the face at each, as `at`."""
        if self._empty or len(points) == 0:
            return np.full(len(points), np.nan), np.full(len(points), -1, np.int32)
        return _residuals(np.ascontiguousarray(points, dtype=np.float64), self._faces)

    def seen(
        self,
        points: FloatArray,
        residuals: FloatArray,
        raster: Raster,
        tolerance_m: float,
        gaps_m: tuple[float, float],
    ) -> tuple[int, int, int, float]:
        """How much of the faces points are near to, by the cells of a raster.

        Points (n, 3) are in metres; residuals (n,) are points minus this surface, nan outside all faces. A point
        is on the surface up to `tolerance_m` vertically. `gaps_m` are the distances in plan from which a cell is far
        from points on the surface, and from all over or under it.

        Returns the cells with a face at their middle, those of them far from all points on the surface, those far from
        all points over or under it, and the largest squared distance in plan of one of them to such a point, m2;
        infinite without points.
        """
        if self._empty:
            return 0, 0, 0, 0.0
        points = np.ascontiguousarray(points, dtype=np.float64)
        return _seen(points, residuals, raster, tolerance_m, gaps_m, self._faces)

    def elevation(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Elevation of the highest face at places, (n,) float64; nan where there is none."""
        return self.at(x, y)[0]

    def face(self, x: FloatArray, y: FloatArray) -> LabelArray:
        """Number of the highest face at places, (n,) int32; -1 where there is none."""
        return self.at(x, y)[1]


def plan_index(polygons: Sequence[Polygon | MultiPolygon]) -> TopSurface:
    """Which of many polygons holds a place: `face` of the result; the first where several do.

    Borders are judged as those of roof faces are.
    """
    return TopSurface(polygons, np.zeros((len(polygons), 3)))


def surface_of(faces: Sequence[RoofFace], planes: Sequence[Plane]) -> TopSurface:
    """The top surface of a model's roof faces, about its local origin; numbers are those of the faces."""
    coefficients = np.array([planes[face.plane].coefficients for face in faces]).reshape(-1, 3)
    return TopSurface([face.polygon for face in faces], coefficients, corner=(0.0, 0.0))


def vertical_residuals(points: FloatArray, faces: Sequence[RoofFace], planes: Sequence[Plane]) -> FloatArray:
    """Original points (n, 3) minus top surface of a model, (n,) m: positive above it, nan where no face covers."""
    return surface_of(faces, planes).residuals(points)[0]


def _quantile(ascending: FloatArray, share: float) -> float:
    """Quantile of sorted values, linear between two of them; numpy's costs more than all else of a summary."""
    place = share * (len(ascending) - 1)
    low = math.floor(place)
    high = min(low + 1, len(ascending) - 1)
    return float(ascending[low]) + (place - low) * float(ascending[high] - ascending[low])


@kernel
def _distances(residuals: FloatArray, tolerance_m: float, limit_m: float) -> tuple[FloatArray, float, int]:
    """The absolute residuals of the covered points, the sum of their squares, and how many are within the tolerance.

    Squares are of at most the limit.
    """
    distances = np.empty(len(residuals))
    covered = within = 0
    for residual in residuals:
        if not math.isnan(residual):
            distances[covered] = abs(residual)
            within += distances[covered] <= tolerance_m
            covered += 1
    distances = distances[:covered]
    limited = np.minimum(distances, limit_m)
    return distances, exact_sum(limited * limited), within


def summarise(residuals: FloatArray, tolerance_m: float = 0.2) -> ResidualSummary:
    """Figures of the `vertical_residuals` (n,) of a building; `tolerance_m` is that of `share_within`.

    Sums are exact, so they do not depend on the order of points.

    >>> import numpy as np
    >>> summary = summarise(np.array([0.1, -0.1, np.nan, 0.5]))
    >>> summary.share_within, summary.coverage
    (0.5, 0.75)
    """
    n = len(residuals)
    distances, squares, within = _distances(residuals, tolerance_m, _FAR_M)
    distances.sort()
    covered = len(distances)
    if covered == 0:
        return ResidualSummary(
            rmse_m=math.nan, median_m=math.nan, p95_m=math.nan, share_within=0.0, coverage=0.0, n_points=n
        )
    nine_tenths_m = float(distances[covered - covered // 10 - 1])
    if nine_tenths_m > _FAR_M:
        _, squares, _ = _distances(residuals, tolerance_m, nine_tenths_m)
    return ResidualSummary(
        rmse_m=math.sqrt(squares / covered),
        median_m=_quantile(distances, 0.5),
        p95_m=_quantile(distances, 0.95),
        share_within=within / n,
        coverage=covered / n,
        n_points=n,
    )
