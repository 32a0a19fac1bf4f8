"""Building primitives: whole forms that a method fits to a building, roof faces in plan and the planes over them.

The gable of ten vertices and fifteen parameters comes from Zeng, Lai, Li, Mao and Liu (2008), section 2.4; the boxes of
eight vertices are its counterparts for buildings of one roof plane.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.errors import BuildingError
from pipeline.extras.papers.rectangle import (
    PlanLine,
    Rectangle,
    convex_hull,
    line_of_intersection,
    minimum_rectangle,
    rectangle_on_line,
)
from pipeline.model import FloatArray, LabelArray, Plane, PlanFace, Reason, RoofType
from pipeline.roof.partition import RoofPartition


@dataclasses.dataclass(frozen=True, kw_only=True)
class BuildingPrimitive:
    """A whole building of vertical walls over a level floor: the gable with ten vertices, or a box with eight.

    Heights are whole millimetres and so are positions; the roof planes go exactly through the two upper vertices, so
    faces that meet there have one height.
    """

    roof_type: RoofType
    """gable: vertices 1 and 2 are on the ridge, 3 to 6 on the eaves; pent: 1 and 2 on the upper edge, 3 and 4 on the
    eave; flat: 1 to 4 in any order around."""
    corners: tuple[tuple[float, float], ...]
    """Positions of the roof's vertices in plan, local metres, in the order of their numbers. Vertices 3 to 6 of a gable
    run counter-clockwise, 3 and 6 beside 1, 4 and 5 beside 2; the four of a box run counter-clockwise."""
    top_z_m: float
    """Elevation of vertices 1 and 2: z1 of the paper."""
    eave_z_m: float
    """Elevation of the other vertices of the roof: z3 of the paper."""
    ground_z_m: float
    """Elevation of the floor: z7 of the paper."""

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters as the paper counts them (15 of a gable): x1 .. , y1 .. , z1, z3 and z7 (z5 of a box)."""
        numbered = list(enumerate(self.corners, start=1))
        named = {f"x{k}": x for k, (x, _) in numbered} | {f"y{k}": y for k, (_, y) in numbered}
        floor = f"z{len(self.corners) + 1}"
        if self.roof_type is RoofType.FLAT:
            return named | {"z1": self.top_z_m, floor: self.ground_z_m}
        return named | {"z1": self.top_z_m, "z3": self.eave_z_m, floor: self.ground_z_m}

    @property
    def vertices(self) -> FloatArray:
        """All vertices, (10, 3) or (8, 3) float64: those of the roof, then those of the floor beneath the walls."""
        heights = [self.top_z_m, self.top_z_m] + [self.eave_z_m] * (len(self.corners) - 2)
        roof = [(x, y, z) for (x, y), z in zip(self.corners, heights, strict=True)]
        on_walls = self.corners[2:] if self.roof_type is RoofType.GABLE else self.corners
        return np.array(roof + [(x, y, self.ground_z_m) for x, y in on_walls])

    @property
    def faces(self) -> tuple[PlanFace, ...]:
        """The roof faces in plan, counter-clockwise; the first of a gable is to the right of 1 -> 2."""
        corners = self.corners
        if self.roof_type is not RoofType.GABLE:
            return (PlanFace(plane=0, polygon=shapely.Polygon(corners)),)
        first, second, *eave = corners
        return (
            PlanFace(plane=0, polygon=shapely.Polygon([eave[0], eave[1], second, first])),
            PlanFace(plane=1, polygon=shapely.Polygon([eave[2], eave[3], first, second])),
        )

    @property
    def planes(self) -> tuple[Plane, ...]:
        """The planes through vertices 1 and 2 and the eaves, by the numbers of the faces; without support."""
        if self.roof_type is RoofType.FLAT:
            return (Plane(a=0.0, b=0.0, c=self.top_z_m, n_points=0, rmse_m=0.0),)
        eaves = self.corners[2::2]
        return tuple(self._plane_down_to(eave) for eave in eaves)

    def _plane_down_to(self, eave: tuple[float, float]) -> Plane:
        """The plane through 1 -> 2 that has the height of the eave over a position beside it."""
        (x1, y1), (x2, y2) = self.corners[:2]
        length = math.hypot(x2 - x1, y2 - y1)
        left_x, left_y = (y1 - y2) / length, (x2 - x1) / length
        rise = (self.eave_z_m - self.top_z_m) / ((eave[0] - x1) * left_x + (eave[1] - y1) * left_y)
        a, b = rise * left_x, rise * left_y
        return Plane(a=a, b=b, c=self.top_z_m - a * x1 - b * y1, n_points=0, rmse_m=0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GableFit:
    """The way from two planes to the gable, step by step (Zeng et al. 2008, sections 2.2 to 2.4)."""

    line: PlanLine
    """The planes' line of intersection in plan; the first plane's side is to its right."""
    hulls: tuple[FloatArray, FloatArray]
    """The convex hull of each plane's points, metres."""
    rectangles: tuple[Rectangle, Rectangle]
    """The minimal rectangle of each side, as it is."""
    symmetric: tuple[Rectangle, Rectangle]
    """Both made equal by the larger one."""
    eave_z_m: tuple[float, float]
    """Elevation of either plane over its eave, half way along: their mean becomes that of the model."""
    is_valley: bool
    """True where the planes rise from the line: not a roof of this kind."""
    model: BuildingPrimitive
    """The building."""


def primitive_partition(faces: Sequence[PlanFace]) -> RoofPartition:
    """A primitive's faces, in local metres, as a partition in integer millimetres.

    Faces that touch must share their vertices to the millimetre.
    """
    polygons = tuple(shapely.transform(face.polygon, lambda xy: np.rint(xy * 1e3)) for face in faces)
    return RoofPartition(polygons=polygons, labels=np.array([face.plane for face in faces], np.int32))


def fit_gable(
    points: FloatArray,
    labels: LabelArray,
    planes: tuple[Plane, Plane],
    ground_z_m: float,
    *,
    min_side_share: float,
    margin_m: float = 0.0,
) -> GableFit:
    """The gable of two best-fit planes: rectangles on their line of intersection, both made equal by the larger one.

    Parameters
    ----------
    points : (n, 3) float64
        Local metres, whole millimetres.
    labels : (n,) int32
        0 for the points of the first plane, 1 for those of the second, -1 for others.
    min_side_share : float
        At least this share of either plane's points must lie on one side of the line, the other's on the other.
    margin_m : float
        By how much the rectangles go beyond the hulls.

    Raises
    ------
    BuildingError
        Reason ``no_partition`` where the planes are parallel, or meet beside their points.
    """
    line = line_of_intersection(planes[1], planes[0])
    if line is None:
        raise BuildingError(Reason.NO_PARTITION, "the two planes are parallel: they do not meet in a line")
    left = line.frame(points[:, :2])[:, 1]
    members = (labels == 0, labels == 1)
    shares = float(np.mean(left[members[0]] <= 0.0)), float(np.mean(left[members[1]] >= 0.0))
    is_valley = shares[0] + shares[1] < 1.0
    if is_valley:
        # the other way round, so that the first plane's side is again to the right
        line = PlanLine(origin=line.origin, direction=(0.0 - line.direction[0], 0.0 - line.direction[1]))
        shares = float(np.mean(left[members[0]] >= 0.0)), float(np.mean(left[members[1]] <= 0.0))
    if min(shares) < min_side_share:
        raise BuildingError(
            Reason.NO_PARTITION,
            f"{min(shares):.2f} of the points of a plane lie on its side of the line in which the two planes meet, "
            f"min_side_share is {min_side_share:g}",
        )
    grid = np.rint(points[:, :2] * 1e3).astype(np.int64)
    hulls = convex_hull(grid[members[0]]), convex_hull(grid[members[1]])
    right_side, left_side = rectangle_on_line(hulls[0], line, -1), rectangle_on_line(hulls[1], line, 1)
    if right_side is None or left_side is None:
        raise BuildingError(Reason.NO_PARTITION, "the points of a plane lie on the line in which the two planes meet")
    from_m = min(right_side.from_m, left_side.from_m) - margin_m
    to_m = max(right_side.to_m, left_side.to_m) + margin_m
    width_m = max(right_side.width_m, left_side.width_m) + margin_m
    symmetric = (
        Rectangle(line=line, from_m=from_m, to_m=to_m, left_from_m=-width_m, left_to_m=0.0),
        Rectangle(line=line, from_m=from_m, to_m=to_m, left_from_m=0.0, left_to_m=width_m),
    )
    middle = 0.5 * (from_m + to_m)
    ridge = 0.5 * (_height(planes[0], line.position(middle, 0.0)) + _height(planes[1], line.position(middle, 0.0)))
    eaves = _height(planes[0], line.position(middle, -width_m)), _height(planes[1], line.position(middle, width_m))
    model = BuildingPrimitive(
        roof_type=RoofType.GABLE,
        corners=_whole_mm(
            [line.position(from_m, 0.0), line.position(to_m, 0.0), *symmetric[0].corners[:2], *symmetric[1].corners[2:]]
        ),
        top_z_m=round(ridge, 3),
        eave_z_m=round(0.5 * (eaves[0] + eaves[1]), 3),
        ground_z_m=ground_z_m,
    )
    return GableFit(
        line=line,
        hulls=hulls,
        rectangles=(right_side, left_side),
        symmetric=symmetric,
        eave_z_m=eaves,
        is_valley=is_valley,
        model=model,
    )


def fit_box(
    points: FloatArray, plane: Plane, ground_z_m: float, *, flat_below_deg: float, margin_m: float = 0.0
) -> BuildingPrimitive:
    """The counterpart of the gable for one best-fit plane: the minimum rectangle around its points, flat or pent.

    Points (n, 3) are in local metres, whole millimetres. A pent roof falls along the side of the rectangle that is
    nearest to the plane's own direction, from the plane's mean elevation over the upper edge to that over the lower
    one. Raises BuildingError ``no_partition`` where the points lie on one line in plan.

    Parameters
    ----------
    flat_below_deg : float
        A plane of less slope gives a flat roof, at its elevation over the middle of the rectangle.
    margin_m : float
        By how much the rectangle goes beyond the hull.
    """
    hull = convex_hull(np.rint(points[:, :2] * 1e3).astype(np.int64))
    smallest = minimum_rectangle(hull)
    if smallest is None:
        raise BuildingError(Reason.NO_PARTITION, f"{len(points)} points lie on one line in plan: no rectangle")
    rectangle = dataclasses.replace(
        smallest,
        from_m=smallest.from_m - margin_m,
        to_m=smallest.to_m + margin_m,
        left_from_m=smallest.left_from_m - margin_m,
        left_to_m=smallest.left_to_m + margin_m,
    )
    corners = rectangle.corners
    heights = [_height(plane, corner) for corner in corners]
    if plane.slope_deg < flat_below_deg:
        level = round(sum(heights) / 4.0, 3)
        return BuildingPrimitive(
            roof_type=RoofType.FLAT, corners=_whole_mm(corners), top_z_m=level, eave_z_m=level, ground_z_m=ground_z_m
        )
    edges = [0.5 * (heights[k] + heights[(k + 1) % 4]) for k in range(4)]
    falls = [(edges[k] - edges[(k + 2) % 4]) / _distance(corners[(k + 1) % 4], corners[(k + 2) % 4]) for k in range(4)]
    upper = max(range(4), key=lambda k: falls[k])
    return BuildingPrimitive(
        roof_type=RoofType.PENT,
        # counter-clockwise 1, 2, 3, 4 with 3 beside 2: the numbers follow the ring
        corners=_whole_mm([corners[(upper + k) % 4] for k in range(4)]),
        top_z_m=round(edges[upper], 3),
        eave_z_m=round(edges[(upper + 2) % 4], 3),
        ground_z_m=ground_z_m,
    )


def _height(plane: Plane, position: tuple[float, float]) -> float:
    """Elevation of a plane."""
    return plane.a * position[0] + plane.b * position[1] + plane.c


def _distance(first: tuple[float, float], second: tuple[float, float]) -> float:
    return math.hypot(second[0] - first[0], second[1] - first[1])


def _whole_mm(positions: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Positions on the grid of the solids."""
    return tuple((round(x, 3), round(y, 3)) for x, y in positions)
