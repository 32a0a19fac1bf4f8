"""From labelled points to a partition of the plan: labels everywhere, a TIN, marching triangles, the footprint."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.geometry import bounds_of, nearest_distance, spacing_over_area_m
from pipeline.model import (
    BoolArray,
    Candidate,
    Decision,
    FloatArray,
    Guide,
    IntArray,
    LabelArray,
    Plane,
    PreparedCloud,
    Reason,
    WallOutline,
)
from pipeline.registry import extra
from pipeline.roof.arrangement.arranging import arrange
from pipeline.roof.arrangement.guide_lines import NO_GUIDES, Guides
from pipeline.roof.edge_position import EdgePoints, mixed_pulse_reach_mm
from pipeline.roof.footprint import outline
from pipeline.roof.labelling import continue_crossings, empty_samples, fill_labels
from pipeline.roof.outlines.exterior import straighten
from pipeline.roof.partition import OUTSIDE, MinAreas, RoofPartition, absorb_small_regions, march
from pipeline.roof.roof_settings import ArrangementSettings, RoofSettings
from pipeline.tin.delaunay import triangulate

if TYPE_CHECKING:
    from pipeline.extras.lods.facades import FacadePoints, Walls

_PITCH_SPACINGS = 1.2
"""Pitch of the samples in empty places, in point spacings: about as dense as the points."""
_MIN_PITCH_MM = 50
"""Least pitch of these samples."""
_MIN_SPACING_M, _MAX_SPACING_M = 0.1, 3.0
"""Limits of the point spacing: duplicates make it tiny, a few points in a wide footprint huge."""
_MARGIN_SPACINGS = 4.0
"""Margin around the points, in point spacings: room for the eave and for samples beyond it."""
_MAX_EXTENT_M = 1900.0
"""Largest extent that the triangulation takes, less the frame around it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofPoints:
    """The points of a candidate that see the sky and lie above the floor."""

    points: FloatArray
    """(n, 3) float64, local metres."""
    xy_mm: IntArray
    """(n, 2) int64, millimetres, ascending by x, then y; every position once, the highest point of each."""
    index: IntArray
    """(n,) int64, which of the candidate's points they are."""
    labels: LabelArray
    """(n,) int32, plane of every point; -1 where the segmentation gave none."""
    split: BoolArray
    """(n,) bool, True where the pulse went on to a lower return."""
    spacing_m: float
    """Typical distance of neighbours in plan."""
    nearest_m: float
    """Median distance from the nearest one."""
    footprint_mm: MultiPolygon | None
    """The given footprint in integer millimetres."""
    outline_mm: MultiPolygon | None = None
    """The outline that was drawn with regard to touching units and candidates; integer millimetres."""
    limit_mm: MultiPolygon | None = None
    """The same with vertices that hardly bend it, which others have, too: solids stay within it."""
    guides: tuple[Guide, ...] = ()
    """Given lines, local metres."""
    guide_distance_m: float = 0.0
    """How far lines and edges may lie from a guide that takes their place."""
    facades: FacadePoints | None = None
    """Points that show the walls beneath; None where no wall is asked for."""

    @classmethod
    def none(cls, footprint: Polygon | MultiPolygon | None) -> RoofPoints:
        """No points in a given footprint, in local metres; their spacing is nan."""
        return cls(
            points=np.zeros((0, 3)),
            xy_mm=np.zeros((0, 2), np.int64),
            index=np.zeros(0, np.int64),
            labels=np.zeros(0, np.int32),
            split=np.zeros(0, np.bool_),
            spacing_m=math.nan,
            nearest_m=math.nan,
            footprint_mm=_in_mm(footprint),
        )


def roof_points(cloud: PreparedCloud, settings: RoofSettings, decisions: list[Decision] | None = None) -> RoofPoints:
    """Select the roof points of a candidate, in its order, without labels; their number is added to `decisions`.

    Raises BuildingError `too_few_points` or `no_footprint`.
    """
    candidate = cloud.candidate
    index = cloud.highest
    points = candidate.points.take(index, axis=0)
    least_z_m = candidate.ground_z_m + settings.min_roof_height_m if candidate.footprint is None else -math.inf
    is_above = points[:, 2] >= least_z_m
    if not is_above.all():
        index, points = index[is_above], points[is_above]
    name, fewest = "min_points", settings.min_points
    if candidate.footprint is not None and settings.min_points_in_footprint < fewest:
        name, fewest = "min_points_in_footprint", settings.min_points_in_footprint
    if decisions is not None:
        decisions.append(Decision.check("roof_points", len(index), fewest))
    if len(index) < fewest:
        raise BuildingError(Reason.TOO_FEW_POINTS, f"{len(index)} roof points, fewer than {name} = {fewest}")
    limit_mm = None
    if candidate.outline is not None and not candidate.guides:  # guides change it
        from pipeline.roof.within_outline import limit_in_mm

        limit_mm = limit_in_mm(candidate.outline)
    xy_mm = cloud.points_mm.take(index, axis=0)[:, :2] + (cloud.shift_m[:2] * 1e3).astype(np.int64)
    return RoofPoints(
        points=points,
        xy_mm=xy_mm,
        index=index,
        labels=np.full(len(index), -1, np.int32),
        split=_are_among(xy_mm, candidate.split_returns),
        spacing_m=min(max(spacing_over_area_m(points), _MIN_SPACING_M), _MAX_SPACING_M),
        nearest_m=nearest_distance(points),
        footprint_mm=_in_mm(candidate.footprint),
        limit_mm=limit_mm,
        outline_mm=_in_mm(candidate.outline),
        facades=_facades(candidate, points) if settings.at_walls or settings.finds_walls else None,
    )


def _in_mm(footprint: Polygon | MultiPolygon | None) -> MultiPolygon | None:
    """A given or drawn footprint in integer millimetres."""
    if footprint is None:
        return None
    from pipeline.roof.footprint_in_mm import footprint_in_mm

    return footprint_in_mm(footprint)


def _facades(candidate: Candidate, points: FloatArray) -> FacadePoints:
    """The points that show the walls beneath a roof with some points (n, 3)."""
    facades: FacadePoints = extra("FacadePoints").of(
        candidate.beside, candidate.beside_later, points, candidate.ground, candidate.ground_z_m
    )
    return facades


@kernel
def _are_among(xy_mm: IntArray, others: FloatArray) -> BoolArray:
    """Which of the positions, (n, 2) mm and ascending by x, then y, are those of other points (m, 3), metres."""
    among = np.zeros(len(xy_mm), np.bool_)
    for i in range(len(others)):
        x, y = int(np.rint(others[i, 0] * 1e3)), int(np.rint(others[i, 1] * 1e3))
        low, high = 0, len(xy_mm)
        while low < high:
            middle = (low + high) // 2
            if xy_mm[middle, 0] < x or (xy_mm[middle, 0] == x and xy_mm[middle, 1] < y):
                low = middle + 1
            else:
                high = middle
        if low < len(xy_mm) and xy_mm[low, 0] == x and xy_mm[low, 1] == y:
            among[low] = True
    return among


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofPlan:
    """The roof faces in plan before they get their final outline."""

    faces: RoofPartition
    """Continued beyond the outline, to be clipped by it."""
    planes: tuple[Plane, ...]
    """The planes that the labels of the faces number."""
    outline_mm: MultiPolygon
    """The given footprint, or the outline around the roof points; integer millimetres."""
    raw: RoofPartition | None
    """Without a given footprint: the faces up to the raw outline."""


def partition_roof(roof: RoofPoints, planes: Sequence[Plane], settings: RoofSettings) -> RoofPlan:
    """Cut the plan into roof faces, neither clipped nor simplified: see `draw_plan`.

    With a footprint the faces are continued beyond it, to be clipped: so the walls will stand exactly on it. Without
    one the eave lies between roof points and the empty places around them; straightened, it serves as a footprint. At
    least one roof point has a label. Raises BuildingError `no_partition` where nothing is left, `too_complex` beyond
    1.9 km.
    """
    return _traced_plan(roof, planes, settings, continued=True)


def _traced_plan(roof: RoofPoints, planes: Sequence[Plane], settings: RoofSettings, *, continued: bool) -> RoofPlan:
    """The plan of `partition_roof`; where only its outline is wanted, faces need not be `continued` beyond it."""
    given = roof.footprint_mm
    margin = round(_MARGIN_SPACINGS * roof.spacing_m * 1e3)
    low, high = bounds_of(np.ascontiguousarray(roof.xy_mm))
    low, high = low - margin, high + margin
    if given is not None:
        bounds = np.rint(given.bounds).astype(np.int64)
        low, high = np.minimum(low, bounds[:2] - margin), np.maximum(high, bounds[2:] + margin)
    _require_extent(float((high - low).max()) * 1e-3)
    pitch = max(_MIN_PITCH_MM, round(_PITCH_SPACINGS * roof.spacing_m * 1e3))
    gap_m = settings.gap_spacings * roof.spacing_m
    samples = empty_samples(roof.xy_mm, low, high, pitch, gap_m, margin if given is None else math.inf)
    frame = _frame(low, high, margin)
    xy_mm = np.concatenate((roof.xy_mm, samples, frame))
    tin = triangulate(xy_mm)
    coefficients = np.array([plane.coefficients for plane in planes], np.float64).reshape(len(planes), 3)
    n, m = len(roof.xy_mm), len(samples)
    labels = np.full(len(xy_mm), OUTSIDE, np.int32)
    labels[:n] = fill_labels(roof.xy_mm, roof.labels)
    known = np.zeros(len(xy_mm), np.bool_)
    known[:n] = roof.labels >= 0
    counted = np.zeros(len(xy_mm), np.int32)
    if given is None:
        counted[: n + m] = 1
    else:
        from pipeline.roof.footprint_in_mm import in_footprint
        from pipeline.roof.nearest_points import nearest_points

        counted[: n + m] = in_footprint(given, xy_mm[: n + m])
        # beyond the footprint the faces go on, within it they close gaps that are not too wide
        nearest, distance_m = nearest_points(roof.xy_mm, samples)
        follows = (counted[n : n + m] == 0) | (distance_m <= settings.void_distance_m)
        labels[n : n + m][follows] = labels[nearest[follows]]
    z = np.zeros(len(xy_mm))
    z[:n] = roof.points[:, 2]
    x, y = np.ascontiguousarray(xy_mm[:, 0]), np.ascontiguousarray(xy_mm[:, 1])
    area = min_face_area(roof, settings)
    step_offset_m = settings.step_offset_spacings * roof.spacing_m
    labels = continue_crossings(x, y, tin.facets, labels, known, coefficients)
    min_areas = MinAreas(area, settings.min_void_m2)
    labels = absorb_small_regions(x, y, z, tin.facets, labels, counted, coefficients, min_areas)
    partition = march(xy_mm, tin, labels, coefficients, settings.outside_fraction, step_offset_m)
    if given is not None:
        return RoofPlan(planes=tuple(planes), faces=partition, outline_mm=given, raw=None)
    around = outline(partition)
    if not settings.straight_eaves and roof.outline_mm is None:
        return RoofPlan(planes=tuple(planes), faces=partition, outline_mm=around, raw=partition)
    faces = partition
    if continued:
        from pipeline.roof.nearest_points import nearest_points

        labels[:n] = fill_labels(roof.xy_mm, labels[:n])
        outside = np.flatnonzero(labels[n : n + m] < 0)
        nearest, _ = nearest_points(roof.xy_mm, samples[outside])
        labels[n + outside] = labels[nearest]
        labels = continue_crossings(x, y, tin.facets, labels, known, coefficients)
        faces = march(xy_mm, tin, labels, coefficients, settings.outside_fraction, step_offset_m)
    drawn = roof.outline_mm
    if drawn is None:
        edge_points = EdgePoints.of(roof.xy_mm, roof.split, roof.spacing_m, roof.nearest_m)
        drawn = straighten(around, roof.spacing_m, settings, edge_points)
        if roof.facades is not None and settings.at_walls:
            reach_m = 1e-3 * mixed_pulse_reach_mm(around, edge_points)
            drawn = extra("walls_beneath")(drawn, roof.facades, reach_m, settings.usual_overhang_m).outline_mm
    # what was drawn with regard to others must not go beyond it
    raw = partition if roof.outline_mm is None else None
    return RoofPlan(planes=tuple(planes), faces=faces, outline_mm=drawn, raw=raw)


def drawn_outline(roof: RoofPoints, settings: RoofSettings) -> MultiPolygon:
    """The outline of a building, integer millimetres: given, drawn with regard to others, or drawn around its points.

    Raises BuildingError as `partition_roof`.
    """
    if roof.footprint_mm is not None:
        _require_extent(float(np.ptp(shapely.get_coordinates(roof.footprint_mm), axis=0).max()) * 1e-3)
        return roof.footprint_mm
    if roof.outline_mm is not None:
        return roof.outline_mm
    z = np.sort(roof.points[:, 2])
    level = Plane(a=0.0, b=0.0, c=float(z[len(z) // 2]), n_points=len(z), rmse_m=0.0)
    unlabelled = dataclasses.replace(roof, labels=np.zeros(len(roof.points), np.int32))
    return _traced_plan(unlabelled, [level], settings, continued=False).outline_mm


def walls_of(footprint: Polygon | MultiPolygon, roof: RoofPoints, settings: RoofSettings) -> Walls | None:
    """The walls beneath a footprint at the eaves, local metres; None where they are not asked for."""
    if roof.facades is None or roof.footprint_mm is not None or not settings.finds_walls:
        return None
    from pipeline.roof.footprint_in_mm import footprint_in_mm

    eaves_mm = footprint_in_mm(footprint)
    reach_mm = mixed_pulse_reach_mm(eaves_mm, EdgePoints.of(roof.xy_mm, roof.split, roof.spacing_m, roof.nearest_m))
    walls: Walls | None = extra("walls_beneath")(
        eaves_mm, roof.facades, 1e-3 * reach_mm, settings.usual_overhang_m, settings.min_overhang_m
    )
    return walls


def wall_outline(walls: Walls | None) -> WallOutline | None:
    """Walls as they are recorded; None where none is seen."""
    if walls is None or math.isnan(walls.overhang_m):
        return None
    drawn = shapely.transform(walls.outline_mm, lambda xy: xy * 1e-3)
    return WallOutline(outline=drawn, overhang_m=walls.overhang_m, overhang_sigma_m=walls.overhang_sigma_m)


def _require_extent(extent_m: float) -> None:
    """Raise `too_complex` for a plan that is wider than what can be triangulated, or laid out in rasters."""
    if extent_m > _MAX_EXTENT_M:
        raise BuildingError(Reason.TOO_COMPLEX, f"extends over {extent_m:.0f} m, more than {_MAX_EXTENT_M:.0f} m")


def arranged_faces(
    roof: RoofPoints,
    planes: Sequence[Plane],
    outline_mm: MultiPolygon,
    costs: ArrangementSettings,
    clearance: float = 1.0,
) -> RoofPartition:
    """The plan as an arrangement of the lines in which planes meet, and of guides that the points bear out.

    Raises BuildingError `no_partition` where the outline cannot be filled, GuideError where only guides prevent it.
    """
    coefficients = np.array([plane.coefficients for plane in planes], np.float64).reshape(len(planes), 3)

    labels = roof.labels

    def arranged(guides: Guides) -> RoofPartition:
        return arrange(roof.points, labels, coefficients, outline_mm, roof.spacing_m, costs, clearance, guides)

    free = arranged(NO_GUIDES)
    if not roof.guides:
        return free
    with extra("guide_steps")():
        pieces, may_step = extra("inner_pieces")(roof.guides, outline_mm)
        guides = Guides(pieces, roof.guide_distance_m)
        coefficients, labels = extra("with_enclosed_planes")(
            roof.points, labels, coefficients, pieces, outline_mm, costs
        )
        beside_m = max(guides.distance_m, roof.spacing_m)
        followed: RoofPartition = extra("guided_faces")(
            arranged, free, roof.points, guides, may_step, beside_m, costs.residual_cap_m
        )
        return followed


def min_face_area(roof: RoofPoints, settings: RoofSettings) -> float:
    """Area in m2 under which a roof face joins a neighbour."""
    return max(settings.min_face_area_m2, settings.min_face_spacings2 * roof.spacing_m**2)


def _frame(low: IntArray, high: IntArray, margin: int) -> IntArray:
    """Eight points far around: the hull of the triangulation."""
    x = [int(low[0]) - margin, int(low[0] + high[0]) // 2, int(high[0]) + margin * 2]
    y = [int(low[1]) - margin, int(low[1] + high[1]) // 2, int(high[1]) + margin * 2]
    bulge = margin // 2
    return np.array(
        [
            (x[0], y[0]),
            (x[1], y[0] - bulge),
            (x[2], y[0]),
            (x[2] + bulge, y[1]),
            (x[2], y[2]),
            (x[1], y[2] + bulge),
            (x[0], y[2]),
            (x[0] - bulge, y[1]),
        ],
        np.int64,
    )
