"""One building end to end, without I/O: from a candidate's points to closed solids and their record."""

from __future__ import annotations

import contextlib
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
from pipeline.model import (
    BuildingResult,
    Candidate,
    LodModel,
    Plane,
    Reason,
    RoofFace,
    RoofType,
    Segmentation,
    Solid,
    Status,
)
from pipeline.quality.model_quality import DRAWN_OUTLINE_SPACINGS, TOLERANCE_M, model_quality
from pipeline.quality.residuals import summarise, surface_of, vertical_residuals
from pipeline.quality.validity import check_solid
from pipeline.roof.block import block_forms, block_plane
from pipeline.roof.flush_walls import unite_flush_walls
from pipeline.roof.footprint import hull_of_points, outline, simpler_outlines
from pipeline.roof.lower_lods import LodParts, lower_lods
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import (
    RoofPlan,
    RoofPoints,
    arranged_faces,
    drawn_outline,
    level_unsupported_faces,
    partition_roof,
    plan_forms,
    roof_points,
)
from pipeline.roof.primitives import primitive_partition
from pipeline.roof.roof_type import roof_type
from pipeline.roof.settings import RoofSettings
from pipeline.roof.solid import SolidPart, solid_parts
from pipeline.roof.templates.fitting import MAX_POINTS, RankedFaces, Templates, fit_templates, margin_of_templates
from pipeline.roof.voids import without_voids

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
    is_arranged = settings.arranges(method_named(method))
    bare = roof_points(candidate, settings.roof)
    plan: RoofPlan | None = None
    codes: tuple[int, ...] = ()
    try:
        segmentation, lack = _segmented(candidate, segment, bare)
        roof = dataclasses.replace(bare, labels=segmentation.labels[bare.index])
        forms: Iterable[_Form]
        if lack is not None:
            if not is_arranged or len(roof.points) > MAX_POINTS:
                raise lack
            forms = _template_forms(roof, lack, settings.roof)
        elif segmentation.faces is not None:
            forms = (partial(primitive_partition, segmentation.faces),)
        elif not is_arranged:
            plan = partition_roof(roof, segmentation.planes, settings.roof)
            forms = _traced_forms(plan, roof, settings.roof)
        else:
            forms = _arranged_forms(roof, segmentation.planes, settings)
        parts, planes, codes, margin = _own_solids(
            candidate, roof, forms, segmentation.planes, settings.roof, settings.plan.residual_cap_m,
            is_primitive=segmentation.faces is not None,
        )  # fmt: skip
        if parts:
            few = len(roof.points) < settings.roof.min_points
            unlikely = few or (lack is not None and roof.spacing_m < settings.roof.templates_spacing_m)
            share = _explained_share(roof, parts, planes, settings.plan.residual_cap_m) if unlikely else 1.0
            if share < _FEW_EXPLAINED:
                if lack is not None and not few:
                    raise lack
                told = f"{share:.0%} of {len(roof.points)} roof points lie on a roof, less than {_FEW_EXPLAINED:.0%}"
                fewest = f"where there are fewer than min_points = {settings.roof.min_points}"
                return failed_building(candidate, method, Reason.TOO_FEW_POINTS, f"{told}, {fewest}")
            deliver = partial(_result, candidate, method, settings, roof=roof, status=Status.OK, bic_margin=margin)
            own_type = segmentation.roof_type
            if settings.lods == ("2.2",):
                return deliver(parts, planes, own_type, lod="2.2")
            detailed = LodParts(lod="2.2", parts=parts, planes=planes)
            models = lower_lods(
                detailed, roof.points, candidate.ground_z_m, settings.roof, settings.lods, lambda s: not check_solid(s)
            )
            if models and models[0].lod == settings.lods[-1]:
                if models[0] is not detailed:  # level parts tell nothing of the roof's type
                    own_type = deliver(parts, planes, own_type, lod="2.2").roof_type
                finest, *coarser = models
                if finest.lod != detailed.lod:  # what competed is not what is delivered
                    deliver = partial(deliver, bic_margin=math.nan)
                record = deliver(finest.parts, finest.planes, own_type, lod=finest.lod)
                return dataclasses.replace(record, coarser=tuple(_lod_model(model) for model in coarser))
        reason = Reason.INVALID_SOLID
        detail = f"validity codes {', '.join(map(str, codes)) or 'none'}: no form of the solid passes"
    except BuildingError as error:
        reason, detail = error.reason, error.detail
    except shapely.errors.GEOSException as error:
        reason, detail = Reason.NO_PARTITION, f"the plan cannot be drawn: {error}"
    parts, planes = _block(candidate, bare, plan, settings.roof)
    if settings.lods == ("1.2",):  # a block is what was asked for
        return _result(candidate, method, settings, parts, planes, roof=bare, status=Status.OK, lod="1.2")
    return _result(
        candidate, method, settings, parts, planes, roof=bare, status=Status.FALLBACK, lod="1.2",
        reason=reason, detail=detail, codes=codes,
    )  # fmt: skip


_WIDER_CLEARANCES = (2.5, 4.0)
"""Times the usual distances between an arrangement's vertices, where these made no sound solid."""

_MUCH_LEVELLED = 0.05
"""Share of the plan: where faces of more than this had to be made level, other forms are drawn and held against it."""

_AROUND_M, _FAR_M = 1.0, 1.0
"""Points so near to a face in plan tell how high it may be, give or take this."""

_Form = Callable[[], RoofPartition | RankedFaces]
"""Draws roof faces: over the planes of the segmentation, or over planes of their own."""


def _arranged_forms(roof: RoofPoints, planes: Sequence[Plane], settings: ReconstructSettings) -> Iterator[_Form]:
    """The arrangement; behind it coarser ones and the traced faces, drawn only where no solid of it is sound.

    Where points are few, templates compete with the arrangement: the better go first, worse ones last of all. Given
    outlines of many short edges are made simpler before faces are traced: those are drawn back to be sound.
    """
    outline_mm = drawn_outline(roof, settings.roof)
    if roof.footprint_mm is not None:
        outline_mm = without_voids(outline_mm, roof.points, roof.spacing_m, settings.roof)
    first, last = _best_forms(roof, planes, outline_mm, settings)
    yield from first
    # many planes that meet nearly in one point: with more room between its vertices the solid is sound
    for clearance in _WIDER_CLEARANCES:
        yield partial(arranged_faces, roof, planes, outline_mm, settings.plan, clearance)
    if roof.footprint_mm is not None:
        for simpler in simpler_outlines(outline_mm):
            yield from _best_forms(roof, planes, simpler, settings)[0]
    try:
        plan = partition_roof(roof, planes, settings.roof)
    except BuildingError:
        if not last:
            raise
    else:
        yield from _traced_forms(plan, roof, settings.roof)
    yield from last


def _traced_forms(plan: RoofPlan, roof: RoofPoints, settings: RoofSettings) -> Iterator[_Form]:
    """The traced faces; behind them the same within simpler outlines, where the outline is given."""
    yield from plan_forms(plan, roof, settings)
    if roof.footprint_mm is not None:
        for simpler in simpler_outlines(plan.outline_mm):
            yield from plan_forms(dataclasses.replace(plan, outline_mm=simpler), roof, settings)


def _best_forms(
    roof: RoofPoints, planes: Sequence[Plane], outline_mm: MultiPolygon, settings: ReconstructSettings
) -> tuple[tuple[_Form, ...], tuple[_Form, ...]]:
    """The arrangement within an outline, and where points are few the templates: what goes first, what last."""
    arranged = partial(arranged_faces, roof, planes, outline_mm, settings.plan)
    if roof.spacing_m < settings.roof.templates_spacing_m or len(roof.points) > MAX_POINTS:
        return (arranged,), ()
    return _ranked_forms(roof, planes, outline_mm, arranged)


def _ranked_forms(
    roof: RoofPoints, planes: Sequence[Plane], outline_mm: MultiPolygon, arranged: Callable[[], RoofPartition]
) -> tuple[tuple[_Form, ...], tuple[_Form, ...]]:
    """The arrangement and the templates, those of them that can be had: what goes first, what last."""
    templates: Templates | None = None
    with contextlib.suppress(BuildingError, shapely.errors.GEOSException):
        templates = fit_templates(roof.points, outline_mm)
    if templates is None:
        return (arranged,), ()
    try:
        drawn = arranged()
    except (BuildingError, shapely.errors.GEOSException):
        return (templates.faces,), ()
    drawn_planes = drawn.planes or tuple(planes)
    margin = margin_of_templates(roof.points, templates, drawn, drawn_planes)
    own = RankedFaces(partition=drawn, planes=drawn_planes, labels=roof.labels, bic_margin=-margin)
    form = partial(templates.faces, margin)
    return ((form, lambda: own), ()) if margin > 0.0 else ((lambda: own,), (form,))


def _template_forms(roof: RoofPoints, lack: BuildingError, settings: RoofSettings) -> Iterator[_Form]:
    """The templates alone, where no planes were found; raises that lack where they explain too little."""
    try:
        outline_mm = drawn_outline(roof, settings)
        templates = fit_templates(roof.points, outline_mm)
    except (BuildingError, shapely.errors.GEOSException):
        raise lack from None
    yield templates.faces
    if roof.footprint_mm is not None:
        for simpler in simpler_outlines(outline_mm):
            with contextlib.suppress(BuildingError, shapely.errors.GEOSException):
                yield fit_templates(roof.points, simpler).faces


def _segmented(
    candidate: Candidate, segment: Callable[[Candidate], Segmentation], roof: RoofPoints
) -> tuple[Segmentation, BuildingError | None]:
    """The segmentation, and what it lacks where no roof point lies on a plane."""
    try:
        segmentation = segment(candidate)
    except BuildingError as error:
        return Segmentation(planes=(), labels=np.full(len(candidate.points), -1, np.int32)), error
    if len(segmentation.planes) == 0 or not (segmentation.labels[roof.index] >= 0).any():
        found = f"{len(segmentation.planes)} planes; none explains any of {len(roof.points)} roof points"
        return segmentation, BuildingError(Reason.NO_PLANE, found)
    return segmentation, None


def _own_solids(
    candidate: Candidate,
    roof: RoofPoints,
    forms: Iterable[_Form],
    planes: Sequence[Plane],
    settings: RoofSettings,
    within_m: float,
    *,
    is_primitive: bool,
) -> tuple[list[SolidPart], list[Plane], tuple[int, ...], float]:
    """The first form of the method's solids that is valid throughout; no parts and all codes met where none is.

    A form that had to make a large face level waits: it is taken unless a later one explains more roof points. Of
    those the first is taken whose faces stay near the points, else the one that explains most. The last is by how much
    its faces were better than those that they competed with, nan where they did not.
    """
    codes: set[int] = set()
    waiting: tuple[list[SolidPart], list[Plane], float] | None = None
    share = 0.0
    remaining = iter(forms)
    while True:
        try:
            form = next(remaining, None)
        except (BuildingError, shapely.errors.GEOSException):
            if not codes and waiting is None:
                raise
            form = None  # what was drawn before tells more
        if form is None:
            break
        try:
            drawn, own_planes, labelled, margin = form(), list(planes), roof, math.nan
            if isinstance(drawn, RankedFaces):
                own_planes, margin = list(drawn.planes), drawn.bic_margin
                drawn, labelled = drawn.partition, dataclasses.replace(roof, labels=drawn.labels)
            elif drawn.planes is not None:
                own_planes = list(drawn.planes)
            is_levelled = False
            if not is_primitive:  # a primitive is one form: with a side made level it would be another
                level, own_planes = level_unsupported_faces(drawn, labelled, own_planes, candidate.ground_z_m, settings)
                is_levelled = _is_much_changed(drawn, level)
                drawn = level
            parts = large_parts(solid_parts(drawn, own_planes, candidate.ground_z_m), settings.min_part_area_m2)
            if is_primitive:
                parts = [unite_flush_walls(part) for part in parts]
        except (BuildingError, shapely.errors.GEOSException):
            continue
        faults = {code for part in parts for code in check_solid(part.solid)}
        codes |= faults
        if not parts or faults:
            continue
        if waiting is None and not is_levelled:
            return parts, own_planes, (), margin
        explained = _explained_share(roof, parts, own_planes, within_m)
        if waiting is None or explained > share:
            waiting, share = (parts, own_planes, margin), explained
            if not is_levelled and _stays_near(parts, roof):
                break
    if waiting is None:
        return [], [], tuple(sorted(codes)), math.nan
    return *waiting[:2], (), waiting[2]


def _is_much_changed(drawn: RoofPartition, level: RoofPartition) -> bool:
    """Whether faces of more than a small share of the plan have another plane."""
    areas = shapely.area(np.array(drawn.polygons, object))
    return bool(areas[drawn.labels != level.labels].sum() > _MUCH_LEVELLED * areas.sum())


def _stays_near(parts: Sequence[SolidPart], roof: RoofPoints) -> bool:
    """Whether no corner of a roof face lies far above or below all points in the face and around it."""
    faces = [face.polygon for part in parts for face in part.faces]
    x, y, z = roof.points.T
    for face in faces:
        around = z[shapely.intersects_xy(face.buffer(_AROUND_M), x, y)]
        corners = shapely.get_coordinates(face, include_z=True)[:, 2]
        if len(around) and (corners.max() > around.max() + _FAR_M or corners.min() < around.min() - _FAR_M):
            return False
    return True


def large_parts(parts: list[SolidPart], min_area_m2: float) -> list[SolidPart]:
    """The parts that are large enough, or the largest one."""
    large = [part for part in parts if part.footprint.area >= min_area_m2]
    return large or sorted(parts, key=lambda part: -part.footprint.area)[:1]


def _block(
    candidate: Candidate, roof: RoofPoints, plan: RoofPlan | None, settings: RoofSettings
) -> tuple[list[SolidPart], list[Plane]]:
    """A valid block on the footprint, else on the partition's outline, else on the points' outline."""
    plane = block_plane(roof.points, candidate.ground_z_m, settings.block_height_percentile)
    if plan is None and roof.footprint_mm is not None:
        outlines = [roof.footprint_mm]
    else:
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
        for form in block_forms(footprint, plane, candidate.ground_z_m, tolerance, settings.min_part_area_m2):
            try:
                parts = form()
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
    roof: RoofPoints,
    status: Status,
    lod: str,
    reason: Reason | None = None,
    detail: str = "",
    codes: tuple[int, ...] = (),
    bic_margin: float = math.nan,
) -> BuildingResult:
    """The record of a building with a model; planes that no face uses are left out."""
    used = sorted({face.plane for part in parts for face in part.faces})
    number = {plane: k for k, plane in enumerate(used)}
    delivered = tuple(planes[plane] for plane in used)
    faces = tuple(RoofFace(plane=number[face.plane], polygon=face.polygon) for part in parts for face in part.faces)
    solids = tuple(_renumbered(part.solid, number) for part in parts)
    footprint = _united([part.footprint for part in parts])
    surface = surface_of(faces, delivered)
    top, face_of_point = surface.at(candidate.points[:, 0], candidate.points[:, 1])
    residuals = candidate.points[:, 2] - top
    summary = summarise(residuals, TOLERANCE_M)
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
        footprint_share=math.nan if roof.footprint_mm is None else footprint.area / (roof.footprint_mm.area * 1e-6),
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
        quality=model_quality(
            candidate.points,
            surface,
            residuals,
            face_of_point,
            summary,
            faces,
            delivered,
            solids,
            spacing_m=roof.spacing_m,
            outline_sigma_m=0.0 if candidate.footprint is not None else roof.spacing_m * DRAWN_OUTLINE_SPACINGS,
            is_planar=lod == "2.2",
            bic_margin=bic_margin,
        ),
        touches_data_edge=candidate.touches_data_edge,
    )


_FEW_EXPLAINED = 0.75
"""Share of its roof points that a model has to explain where they are fewer than usual, or show no plane though they
are dense: a tree would make a roof, too."""


def _explained_share(roof: RoofPoints, parts: Sequence[SolidPart], planes: Sequence[Plane], within_m: float) -> float:
    """Share of the roof points that lie near the roof faces, vertically."""
    faces = [RoofFace(plane=face.plane, polygon=face.polygon) for part in parts for face in part.faces]
    return float(np.mean(np.abs(vertical_residuals(roof.points, faces, planes)) <= within_m))


def _lod_model(model: LodParts) -> LodModel:
    """A coarser model as it is delivered."""
    return LodModel(lod=model.lod, planes=tuple(model.planes), solids=tuple(part.solid for part in model.parts))


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
