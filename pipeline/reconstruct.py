"""One building end to end, without I/O: from a candidate's points to closed solids and their record."""

from __future__ import annotations

import dataclasses
import math
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import PurePath

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import BuildingError
from pipeline.methods import ReconstructSettings, method_named
from pipeline.model import BuildingResult, Candidate, Plane, Reason, RoofFace, RoofType, Segmentation, Solid, Status
from pipeline.quality.residuals import summarise, vertical_residuals
from pipeline.quality.validity import check_solid
from pipeline.roof.block import block_parts, block_plane
from pipeline.roof.flush_walls import unite_flush_walls
from pipeline.roof.footprint import hull_of_points, outline
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import (
    RoofPlan,
    RoofPoints,
    arranged_faces,
    level_unsupported_faces,
    partition_roof,
    plan_forms,
    roof_points,
)
from pipeline.roof.primitives import primitive_partition
from pipeline.roof.roof_type import roof_type
from pipeline.roof.settings import RoofSettings
from pipeline.roof.solid import SolidPart, solid_parts

__all__ = ["ReconstructSettings", "failed_building", "reconstruct_building"]


def reconstruct_building(candidate: Candidate, method: str, settings: ReconstructSettings) -> BuildingResult:
    """Model one building.

    The method finds planes; the plan is cut into roof faces and extruded. Solids that fail the validity check are
    tried again with all their border vertices; what still fails becomes a block.

    Parameters
    ----------
    candidate : Candidate
        Points and terrain of one possible building.
    method : str
        One of `pipeline.methods.METHODS`.
    settings : ReconstructSettings
        For the method and for the roof.

    Returns
    -------
    BuildingResult
        Always one for a known method: a building's own faults are its status and reason, also unexpected ones
        (`internal_error`). Only a lack of memory is passed on: it says nothing about the building, and a record of it
        would differ between machines.

    Raises
    ------
    SettingsError
        For an unknown method, or settings of another method.
    MemoryError
        As it came.
    """
    segment = settings.segmentation(method_named(method))
    try:
        return _reconstruct(candidate, method, segment, settings)
    except BuildingError as error:
        return failed_building(candidate, method, error.reason, error.detail)
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001 - told in the record, with its place
        return failed_building(candidate, method, Reason.INTERNAL_ERROR, _describe(error))


def _describe(error: Exception) -> str:
    """Type, message and the innermost place of an unexpected exception."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f"{'/'.join(PurePath(frames[-1].filename).parts[-3:])}:{frames[-1].lineno}" if frames else "unknown place"
    return f"{type(error).__name__}: {error} ({place})"


def _reconstruct(
    candidate: Candidate,
    method: str,
    segment: Callable[[Candidate], Segmentation],
    settings: ReconstructSettings,
) -> BuildingResult:
    """The chain of a method's own solids, then the block."""
    bare = roof_points(candidate, settings.roof)
    plan: RoofPlan | None = None
    codes: tuple[int, ...] = ()
    try:
        segmentation = segment(candidate)
        roof = dataclasses.replace(bare, labels=segmentation.labels[bare.index])
        _require_planes(segmentation, roof)
        forms: Iterable[Callable[[], RoofPartition]]
        if segmentation.faces is not None:
            forms = (partial(primitive_partition, segmentation.faces),)
        elif not _is_arranged(method, settings.roof):
            plan = partition_roof(roof, segmentation.planes, settings.roof)
            forms = plan_forms(plan, roof, settings.roof)
        else:
            forms = _arranged_forms(roof, segmentation.planes, settings)
        parts, planes, codes = _own_solids(
            candidate, roof, forms, segmentation.planes, settings.roof, is_primitive=segmentation.faces is not None
        )
        if parts:
            own_type = segmentation.roof_type
            return _result(candidate, method, settings, parts, planes, own_type, status=Status.OK, lod="2.2")
        reason = Reason.INVALID_SOLID
        detail = f"validity codes {', '.join(map(str, codes)) or 'none'}: no form of the solid passes"
    except BuildingError as error:
        reason, detail = error.reason, error.detail
    parts, planes = _block(candidate, bare, plan, settings.roof)
    return _result(
        candidate, method, settings, parts, planes, status=Status.FALLBACK, lod="1.2", reason=reason, detail=detail,
        codes=codes,
    )  # fmt: skip


def _is_arranged(method: str, settings: RoofSettings) -> bool:
    """Whether the roof faces are cells of an arrangement."""
    return method_named(method).arranged if settings.faces == "method" else settings.faces == "arranged"


def _arranged_forms(
    roof: RoofPoints, planes: Sequence[Plane], settings: ReconstructSettings
) -> Iterator[Callable[[], RoofPartition]]:
    """The arrangement; behind it the traced faces, which are traced only where no solid of it is sound."""
    yield partial(arranged_faces, roof, planes, settings.roof, settings.plan)
    yield from plan_forms(partition_roof(roof, planes, settings.roof), roof, settings.roof)


def _require_planes(segmentation: Segmentation, roof: RoofPoints) -> None:
    """Raise where no roof point lies on a plane."""
    if len(segmentation.planes) == 0 or not (roof.labels >= 0).any():
        raise BuildingError(
            Reason.NO_PLANE, f"{len(segmentation.planes)} planes; none explains any of {len(roof.points)} roof points"
        )


def _own_solids(
    candidate: Candidate,
    roof: RoofPoints,
    forms: Iterable[Callable[[], RoofPartition]],
    planes: Sequence[Plane],
    settings: RoofSettings,
    *,
    is_primitive: bool,
) -> tuple[list[SolidPart], list[Plane], tuple[int, ...]]:
    """The first form of the method's solids that is valid throughout; no parts and all codes met where none is."""
    codes: set[int] = set()
    for form in forms:
        try:
            drawn, own_planes = form(), list(planes)
            if not is_primitive:  # a primitive is one form: with a side made level it would be another
                drawn, own_planes = level_unsupported_faces(drawn, roof, planes, candidate.ground_z_m, settings)
            parts = large_parts(solid_parts(drawn, own_planes, candidate.ground_z_m), settings.minimum_part_area_m2)
            if is_primitive:
                parts = [unite_flush_walls(part) for part in parts]
        except (BuildingError, shapely.errors.GEOSException):
            continue
        faults = {code for part in parts for code in check_solid(part.solid)}
        if parts and not faults:
            return parts, own_planes, ()
        codes |= faults
    return [], [], tuple(sorted(codes))


def large_parts(parts: list[SolidPart], minimum_area_m2: float) -> list[SolidPart]:
    """The parts that are large enough, or the largest one."""
    large = [part for part in parts if part.footprint.area >= minimum_area_m2]
    return large or sorted(parts, key=lambda part: -part.footprint.area)[:1]


def _block(
    candidate: Candidate, roof: RoofPoints, plan: RoofPlan | None, settings: RoofSettings
) -> tuple[list[SolidPart], list[Plane]]:
    """A valid block on the footprint, else on the partition's outline, else on the points' outline."""
    plane = block_plane(roof.points, candidate.ground_z_m, settings.block_height_percentile)
    if plan is None:
        unlabelled = dataclasses.replace(roof, labels=np.zeros(len(roof.points), np.int32))
        plan = partition_roof(unlabelled, [plane], settings)
    outlines = [plan.outline_mm]
    if plan.raw is not None:
        outlines.append(outline(plan.raw))
    tolerance = settings.simplification_spacings * roof.spacing_m
    hull = hull_of_points(roof.points)
    if hull is not None:
        outlines.append(MultiPolygon([shapely.transform(hull, lambda xy: np.rint(xy * 1e3))]))
    for footprint in outlines:
        for factor in (0.0, 0.5, 1.0):
            try:
                parts = block_parts(
                    footprint, plane, candidate.ground_z_m, factor * tolerance, settings.minimum_part_area_m2
                )
            except (BuildingError, shapely.errors.GEOSException):
                continue
            if not any(check_solid(part.solid) for part in parts):
                return parts, [plane]
    raise BuildingError(Reason.NO_FOOTPRINT, f"no valid block over {len(roof.points)} roof points")


def _result(
    candidate: Candidate,
    method: str,
    settings: ReconstructSettings,
    parts: Sequence[SolidPart],
    planes: Sequence[Plane],
    own_type: RoofType | None = None,
    *,
    status: Status,
    lod: str,
    reason: Reason | None = None,
    detail: str = "",
    codes: tuple[int, ...] = (),
) -> BuildingResult:
    """The record of a building with a model; planes that no face uses are left out."""
    used = sorted({face.plane for part in parts for face in part.faces})
    number = {plane: k for k, plane in enumerate(used)}
    delivered = tuple(planes[plane] for plane in used)
    faces = tuple(RoofFace(plane=number[face.plane], polygon=face.polygon) for part in parts for face in part.faces)
    solids = tuple(_renumbered(part.solid, number) for part in parts)
    footprint = _united([part.footprint for part in parts])
    summary = summarise(vertical_residuals(candidate.points, faces, delivered))
    return BuildingResult(
        building_id=candidate.building_id,
        origin=candidate.origin,
        source_id=candidate.source_id,
        status=status,
        reason=reason,
        reason_detail=detail,
        method=method,
        roof_type=own_type or roof_type(delivered, faces, solids, settings.roof_type),
        lod=lod,
        footprint=footprint,
        planes=delivered,
        faces=faces,
        solids=solids,
        validity_codes=codes,
        ground_z_m=candidate.ground_z_m,
        n_points=len(candidate.points),
        density_per_m2=len(candidate.points) / footprint.area,
        rmse_m=summary.rmse_m,
        p95_m=summary.p95_m,
        coverage=summary.coverage,
        touches_data_edge=candidate.touches_data_edge,
    )


def _renumbered(solid: Solid, number: dict[int, int]) -> Solid:
    """The solid with other plane numbers."""
    faces = tuple(dataclasses.replace(f, plane=number[f.plane]) if f.plane >= 0 else f for f in solid.faces)
    return Solid(vertices=solid.vertices, faces=faces)


def _united(footprints: Sequence[Polygon]) -> Polygon | MultiPolygon:
    """One geometry of footprints that do not overlap."""
    if len(footprints) == 1:
        return footprints[0]
    together = MultiPolygon(list(footprints))
    if together.is_valid:
        return together
    united = shapely.union_all(list(footprints), grid_size=1e-3)
    return united if isinstance(united, Polygon | MultiPolygon) else MultiPolygon(list(footprints))


def failed_building(candidate: Candidate, method: str, reason: Reason, detail: str) -> BuildingResult:
    """The record of a building without a model."""
    finite = candidate.points[np.isfinite(candidate.points).all(axis=1)]
    footprint = candidate.footprint if candidate.footprint is not None else hull_of_points(finite)
    area = footprint.area if footprint is not None else 0.0
    return BuildingResult(
        building_id=candidate.building_id,
        origin=candidate.origin,
        source_id=candidate.source_id,
        status=Status.FAILED,
        reason=reason,
        reason_detail=detail,
        method=method,
        roof_type=RoofType.NONE,
        lod="",
        footprint=footprint,
        planes=(),
        faces=(),
        solids=(),
        validity_codes=(),
        ground_z_m=candidate.ground_z_m,
        n_points=len(candidate.points),
        density_per_m2=len(candidate.points) / area if area > 0.0 else math.nan,
        rmse_m=math.nan,
        p95_m=math.nan,
        coverage=0.0,
        touches_data_edge=candidate.touches_data_edge,
    )
