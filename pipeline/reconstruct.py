"""One building end to end, without I/O: from a candidate's points to closed solids and their record.

The steps: prepare the points, find planes, try the forms of the model until one is valid, deliver it with its record;
a block where none is.
"""

from __future__ import annotations

import dataclasses
import math
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import PurePath

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.errors import BuildingError
from pipeline.methods import LODS, OVERHANGS, ReconstructSettings, method_named
from pipeline.model import (
    BuildingResult,
    Candidate,
    Decision,
    DecisionKind,
    Doubt,
    HeightSource,
    LodModel,
    NoOverhang,
    Outcome,
    Overhangs,
    OverhangSource,
    Plane,
    PreparedCloud,
    Reason,
    RoofFace,
    RoofType,
    Segmentation,
    Solid,
    Status,
)
from pipeline.prepared_cloud import prepare_cloud
from pipeline.quality.detection import confidence_of
from pipeline.quality.model_quality import DRAWN_OUTLINE_SPACINGS, model_quality
from pipeline.quality.residuals import vertical_residuals
from pipeline.quality.support import NOT_OF_FORM, NOT_OF_ROOF, doubt_of, support_of
from pipeline.quality.validity import check_solid
from pipeline.roof.block import block_forms, block_plane
from pipeline.roof.facades import Walls
from pipeline.roof.floor_cut import cut_at_floor
from pipeline.roof.flush_walls import unite_flush_walls
from pipeline.roof.footprint import footprint_in_mm, hull_of_points, outline
from pipeline.roof.forms import UNDRAWABLE, FaceForm, arranged_forms, template_forms, traced_forms, undrawable
from pipeline.roof.given_heights import given_block
from pipeline.roof.guides import followed, guide_steps
from pipeline.roof.lower_lods import LodParts, lower_lods
from pipeline.roof.named_form import BLOCK, PRIMITIVE, NamedForm
from pipeline.roof.overhangs import UndrawableError, floor_m2, overhanging_solids
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import (
    RoofPlan,
    RoofPoints,
    partition_roof,
    roof_points,
    wall_outline,
    walls_of,
)
from pipeline.roof.primitives import primitive_partition
from pipeline.roof.roof_type import roof_type
from pipeline.roof.shaded_points import with_shaded_points
from pipeline.roof.solid import SolidPart, renumbered, solid_parts, united
from pipeline.roof.templates.fitting import RankedFaces
from pipeline.roof.unlike_points import contradiction_of, stays_near
from pipeline.roof.unseen_slopes import with_support_of_seen, with_unseen_slopes
from pipeline.roof.unsupported_faces import goes_far, level_unsupported_faces, levelled_share_of
from pipeline.roof.wider_eaves import wider_parts

__all__ = ["ReconstructSettings", "failed_building", "reconstruct_building"]

_MUCH_LEVELLED = 0.05
"""Share of the plan. Where faces of more than this had to be made level, other forms are drawn and compared with it."""
_LEAST_BEYOND_M2 = 0.05
"""Less is what rounding adds to a footprint."""
_FEW_EXPLAINED = 0.75
"""Share of its roof points that a model has to explain where they are fewer than usual, or show no plane though they
are dense: a tree would make a roof, too."""
_GIVEN_TOLERANCE_M = 0.5
"""Largest change to an outline that is hard to draw, for a block without points, whose spacing would decide."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Building:
    """Common arguments of the steps for one building."""

    candidate: Candidate
    method: str
    settings: ReconstructSettings
    roof: RoofPoints
    """The roof points, without labels."""
    decisions: list[Decision]
    """Grows with what is checked and tried."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Model(LodParts):
    """A model of a building, not yet judged."""

    roof_type: RoofType | None = None
    """The type that the method names; None for the rule over the delivered planes."""
    bic_margin: float = math.nan
    """By how much its faces were better than those that they competed with; nan where they did not."""
    is_levelled: bool = False
    """True where a large part of its faces had to be made level, or where some went far or contradict the points."""
    levelled_share: float = 0.0
    """Share of the plan whose faces had to be made level."""
    cleaned: str = ""
    """What was changed on the drawn faces."""
    contradiction: Doubt | None = None
    """Why its faces are not those of its points; None if they are."""


def reconstruct_building(candidate: Candidate, method: str, settings: ReconstructSettings) -> BuildingResult:
    """Model one building by one of `pipeline.methods.METHODS`.

    The method finds planes; the plan is cut into roof faces and extruded. The first form whose solids are valid is
    delivered, and a block where none is. There is always a result for a known method: a building's own faults are its
    status and reason, also unexpected ones (`internal_error`). A building whose guides may be at fault is modelled
    without them, and its decisions say so. Only a lack of memory is passed on: it says nothing
    about the building, and a record of it would differ between machines.

    Raises
    ------
    SettingsError
        For an unknown method, or settings of another method.
    MemoryError
        As it came.
    """
    entry = method_named(method)
    segment, is_arranged = settings.segmentation(entry), settings.arranges(entry)
    decisions: list[Decision] = []
    try:
        cloud = prepare_cloud(candidate, settings.roof.max_points)
        roof = roof_points(cloud, settings.roof, decisions)
        if candidate.guides:
            distance_m = settings.guides.distance_of(roof.spacing_m)
            roof = dataclasses.replace(roof, guides=candidate.guides, guide_distance_m=distance_m)
        building = _Building(candidate=candidate, method=method, settings=settings, roof=roof, decisions=decisions)
        result = _reconstruct(building, cloud, segment, is_arranged=is_arranged)
    except BuildingError as error:
        result = failed_building(candidate, method, error.reason, error.detail)
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001 - the record holds it, with its place
        result = failed_building(candidate, method, Reason.INTERNAL_ERROR, _describe(error))
    if candidate.guides and result.reason is Reason.INTERNAL_ERROR:
        without_guides = reconstruct_building(dataclasses.replace(candidate, guides=()), method, settings)
        fault = undrawable("guides", RuntimeError(result.reason_detail))
        return dataclasses.replace(without_guides, decisions=(fault, *without_guides.decisions))
    if result.status is Status.FAILED and result.reason is not Reason.INTERNAL_ERROR and candidate.given is not None:
        without = dataclasses.replace(candidate, points=np.zeros((0, 3)))
        blind = _Building(
            candidate=without,
            method=method,
            settings=settings,
            roof=RoofPoints.none(candidate.footprint),
            decisions=decisions,
        )
        result = _given_model(blind, result)
    return result if result.solids else dataclasses.replace(result, decisions=tuple(decisions))


def _describe(error: Exception) -> str:
    """Type, message and the innermost place of an unexpected exception."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f"{'/'.join(PurePath(frames[-1].filename).parts[-3:])}:{frames[-1].lineno}" if frames else "unknown place"
    return f"{type(error).__name__}: {error} ({place})"


def _reconstruct(
    building: _Building, cloud: PreparedCloud, segment: Callable[[PreparedCloud], Segmentation], *, is_arranged: bool
) -> BuildingResult:
    """The first valid form of the method's own model, else the first valid block."""
    settings = building.settings
    plan: RoofPlan | None = None
    codes: tuple[int, ...] = ()
    try:
        segmentation, lack = _segmented(cloud, segment, building.roof)
        roof = dataclasses.replace(building.roof, labels=segmentation.labels[building.roof.index])
        building.decisions.extend(_checks(building, segmentation, roof))
        if lack is not None:
            if not is_arranged:
                raise lack
            forms: Iterator[FaceForm] = template_forms(roof, lack, settings.roof)
        elif segmentation.faces is not None:
            forms = iter([NamedForm(PRIMITIVE, partial(primitive_partition, segmentation.faces))])
        elif is_arranged:
            roof = with_shaded_points(roof, cloud, segmentation.planes)
            roof, planes = with_unseen_slopes(roof, segmentation.planes, building.candidate.elsewhere, settings.roof)
            segmentation = dataclasses.replace(segmentation, planes=planes)
            forms = arranged_forms(roof, segmentation.planes, settings.roof, settings.plan, building.decisions)
        else:
            plan = partition_roof(roof, segmentation.planes, settings.roof)
            forms = traced_forms(plan, roof, settings.roof)
        model, codes = _first_valid(
            (
                NamedForm(form.name, partial(_own_model, building, segmentation, roof, form), form.detail)
                for form in forms
            ),
            building,
        )
        if model is not None:
            if too_few := _too_few_points(building, model, lack):
                _withdraw(building)
                return failed_building(building.candidate, building.method, Reason.TOO_FEW_POINTS, too_few)
            if record := _delivered(building, model):
                return _judged(building, record, plan, model)
            _withdraw(building)
        codes_met = ", ".join(map(str, codes)) or "none"
        fallback = BuildingError(Reason.INVALID_SOLID, f"validity codes {codes_met}: no form of the solid passes")
    except BuildingError as error:
        fallback = error
    except shapely.errors.GEOSException as error:
        fallback = BuildingError(Reason.NO_PARTITION, f"the plan cannot be drawn: {error}")
    block, _ = _first_valid(_blocks(building, plan), building)
    if block is None:
        raise BuildingError(Reason.NO_FOOTPRINT, f"no valid block over {len(building.roof.points)} roof points")
    if settings.record_lods == ("1.2",):  # the settings ask for a block
        return _record(building, block)
    return _record(building, block, fallback, codes)


def _segmented(
    cloud: PreparedCloud, segment: Callable[[PreparedCloud], Segmentation], roof: RoofPoints
) -> tuple[Segmentation, BuildingError | None]:
    """The segmentation, and what it lacks where no roof point lies on a plane."""
    try:
        segmentation = segment(cloud)
    except BuildingError as error:
        return Segmentation(planes=(), labels=np.full(len(cloud.points), -1, np.int32)), error
    if len(segmentation.planes) == 0 or not (segmentation.labels[roof.index] >= 0).any():
        found = f"{len(segmentation.planes)} planes; none explains any of {len(roof.points)} roof points"
        return segmentation, BuildingError(Reason.NO_PLANE, found)
    return segmentation, None


def _checks(building: _Building, segmentation: Segmentation, roof: RoofPoints) -> Iterator[Decision]:
    """The figures that decide which forms are tried, each with its limit."""
    n_points, coarsest_m = len(roof.labels), building.settings.roof.templates_spacing_m
    yield Decision.check("planes_found", len(segmentation.planes), 1)
    # one point is enough
    yield Decision.check("points_on_planes_share", int(np.count_nonzero(roof.labels >= 0)) / n_points, 1 / n_points)
    yield Decision.check(
        "point_spacing_m", roof.spacing_m, coarsest_m, "templates compete where points are as far apart"
    )


def _withdraw(building: _Building) -> None:
    """Mark that the form that was chosen is not delivered."""
    for k in range(len(building.decisions)):
        entry = building.decisions[k]
        if entry.kind is DecisionKind.FORM and entry.outcome is Outcome.CHOSEN:
            building.decisions[k] = dataclasses.replace(entry, outcome=Outcome.WITHDRAWN)


def _first_valid(models: Iterable[NamedForm[_Model]], building: _Building) -> tuple[_Model | None, tuple[int, ...]]:
    """The first model that is valid throughout, or None and the codes of all faults.

    A model with a large face made level waits: it is taken unless a later one explains more roof points. Of those the
    first is taken whose faces stay near the points, else the one that explains most.
    """
    decisions = building.decisions
    codes: set[int] = set()
    waiting, share, at = None, 0.0, -1
    remaining = iter(models)
    while True:
        try:
            form = next(remaining, None)
        except UNDRAWABLE as error:
            decisions.append(undrawable("further", error))
            if not codes and waiting is None:
                raise
            form = None  # the forms before it say more about the building
        if form is None:
            if waiting is not None:
                decisions[at] = dataclasses.replace(decisions[at], outcome=Outcome.CHOSEN)
            return waiting, () if waiting is not None else tuple(sorted(codes))
        try:
            model = form()
        except UNDRAWABLE as error:
            decisions.append(undrawable(form.name, error, form.detail))
            continue
        faults = {code for part in model.parts for code in check_solid(part.solid)}
        codes |= faults
        if not model.parts or faults:
            decisions.append(_tried(form, model, Outcome.INVALID, codes=tuple(sorted(faults))))
            continue
        if waiting is None and not model.is_levelled:
            decisions.append(_tried(form, model, Outcome.CHOSEN))
            return model, ()
        explained = _explained_share(building, model)
        decisions.append(_tried(form, model, Outcome.OUTDONE, explained=explained))
        if waiting is None or explained > share:
            waiting, share, at = model, explained, len(decisions) - 1
            if not model.is_levelled and stays_near(model.parts, building.roof):
                decisions[at] = dataclasses.replace(decisions[at], outcome=Outcome.CHOSEN)
                return model, ()


def _tried(
    form: NamedForm[_Model],
    model: _Model,
    outcome: Outcome,
    *,
    explained: float = math.nan,
    codes: tuple[int, ...] = (),
) -> Decision:
    """The entry of a form that was drawn."""
    faces = [face.plane for part in model.parts for face in part.faces]
    return Decision(
        kind=DecisionKind.FORM,
        name=form.name,
        outcome=outcome,
        detail="; ".join(filter(None, (form.detail, model.cleaned, "" if faces else "no roof face is left"))),
        n_faces=len(faces),
        n_planes=len(set(faces)),
        levelled_share=model.levelled_share,
        explained_share=explained,
        bic_margin=model.bic_margin,
        validity_codes=codes,
    )


def _own_model(building: _Building, segmentation: Segmentation, roof: RoofPoints, form: FaceForm) -> _Model:
    """Solids over the roof faces that a form draws."""
    settings, ground_z_m = building.settings.roof, building.candidate.ground_z_m
    drawn, planes, margin = form(), segmentation.planes, math.nan
    slopes = roof
    if isinstance(drawn, RankedFaces):
        planes, margin = drawn.planes, drawn.bic_margin
        drawn, roof = drawn.partition, dataclasses.replace(roof, labels=drawn.labels)
    elif drawn.planes is not None:
        planes = drawn.planes
    if segmentation.faces is not None:  # a primitive is one form: with a side made level it would be another
        parts = large_parts(solid_parts(drawn, list(planes), ground_z_m), settings.min_part_area_m2)
        return _Model(
            lod="2.2",
            parts=[unite_flush_walls(part) for part in parts],
            planes=list(planes),
            roof_type=segmentation.roof_type,
            bic_margin=margin,
        )

    is_far = goes_far(drawn, roof, planes, ground_z_m, settings)

    def over(level: RoofPartition, extended: list[Plane]) -> _Model:
        cut, cut_planes = cut_at_floor(level, extended, ground_z_m + settings.min_clearance_m)
        cut_planes = with_support_of_seen(cut, cut_planes, roof)
        contradiction = contradiction_of(cut, cut_planes, roof, slopes, segmentation.planes)
        all_parts = solid_parts(cut, cut_planes, ground_z_m)
        parts = large_parts(all_parts, settings.min_part_area_m2)
        levelled_share = levelled_share_of(level, len(planes))
        return _Model(
            lod="2.2",
            parts=parts,
            planes=cut_planes,
            roof_type=segmentation.roof_type,
            bic_margin=margin,
            is_levelled=is_far or levelled_share > _MUCH_LEVELLED or contradiction is not None,
            levelled_share=levelled_share,
            cleaned=_cleaned(level, len(planes), cut, len(all_parts) - len(parts)),
            contradiction=contradiction,
        )

    model = over(*level_unsupported_faces(drawn, roof, planes, ground_z_m, settings))
    if sum(len(part.faces) for part in model.parts) > len(drawn.polygons) and not _is_sound(model):
        # the ends of slopes are small faces beside long ones: without them the roof may be sound
        whole = over(*level_unsupported_faces(drawn, roof, planes, ground_z_m, settings, ends=False))
        model = whole if _is_sound(whole) else model
    return model


def _is_sound(model: _Model) -> bool:
    """Whether a model has solids, and all of them are valid."""
    return bool(model.parts) and not any(check_solid(part.solid) for part in model.parts)


def _cleaned(level: RoofPartition, n_planes: int, cut: RoofPartition, left_out: int) -> str:
    """What was changed on the drawn faces, in words; faces on planes beyond the first `n_planes` were made level."""
    made_level = int(np.count_nonzero(level.labels >= n_planes))
    return "; ".join(
        filter(
            None,
            (
                f"{made_level} faces made level" if made_level else "",
                "cut at the floor" if cut is not level else "",
                f"{left_out} small parts left out" if left_out else "",
            ),
        )
    )


def large_parts(parts: list[SolidPart], min_area_m2: float) -> list[SolidPart]:
    """The parts that are large enough, or the largest one."""
    large = [part for part in parts if part.footprint.area >= min_area_m2]
    return large or sorted(parts, key=lambda part: -part.footprint.area)[:1]


def _too_few_points(building: _Building, model: _Model, lack: BuildingError | None) -> str:
    """The measured figure where few points do not explain a model, else empty; raises `lack` where points are dense."""
    settings, n = building.settings.roof, len(building.roof.points)
    are_few = n < settings.min_points
    if not are_few and (lack is None or not building.roof.spacing_m < settings.templates_spacing_m):
        return ""
    share = _explained_share(building, model)
    building.decisions.append(Decision.check("explained_share", share, _FEW_EXPLAINED))
    if share >= _FEW_EXPLAINED:
        return ""
    if lack is not None and not are_few:
        raise lack
    found = f"{share:.0%} of {n} roof points lie on a roof, less than {_FEW_EXPLAINED:.0%}"
    return f"{found}, where there are fewer than min_points = {settings.min_points}"


def _explained_share(building: _Building, model: _Model) -> float:
    """Share of the roof points that lie near the roof faces, vertically."""
    faces = [RoofFace(plane=face.plane, polygon=face.polygon) for part in model.parts for face in part.faces]
    residuals = vertical_residuals(building.roof.points, faces, model.planes)
    return float(np.mean(np.abs(residuals) <= building.settings.plan.residual_cap_m))


def _judged(building: _Building, record: BuildingResult, plan: RoofPlan | None, model: _Model) -> BuildingResult:
    """A model as `ok` or `doubtful`, or a block that explains the points as well; a coarser model by its finest."""
    settings, is_finest = building.settings.support, record.lod == LODS[-1]
    finest = record if is_finest else _record(building, model)
    doubt = model.contradiction if is_finest else None
    doubt = doubt or doubt_of(support_of(finest, building.candidate), settings)
    if not is_finest:  # a coarser model does not claim to lie on its points
        record = dataclasses.replace(record, replaced_confidence=confidence_of(finest))
    if doubt is None or not (is_finest or doubt.reason in NOT_OF_ROOF):
        return record
    if not is_finest or doubt.reason in NOT_OF_FORM:
        return record.doubted(doubt)
    _withdraw(building)
    block, _ = _first_valid(_blocks(building, plan), building)
    if block is not None:
        fallback = _record(building, block, BuildingError(doubt.reason, doubt.words))
        if fallback.quality.share_within >= record.quality.share_within - settings.block_loss:
            return dataclasses.replace(fallback, replaced_confidence=confidence_of(record))
    return record.doubted(doubt)


def _delivered(building: _Building, model: _Model) -> BuildingResult | None:
    """The record of a model at the levels of detail that the settings ask for; None where the finest is not valid."""
    settings, lods = building.settings, building.settings.record_lods
    if lods == (model.lod,):
        return _record(building, model)
    models = lower_lods(
        model, building.roof.points, building.candidate.ground_z_m, settings.roof, lods,
        lambda solid: not check_solid(solid),
    )  # fmt: skip
    building.decisions.extend(_levels(lods, models))
    if not models or models[0].lod != lods[-1]:
        return None
    finest, *coarser = models
    if finest is not model:  # level parts say nothing about the roof's type, and nothing competed with them
        own_type = _record(building, model).roof_type
        model = _Model(lod=finest.lod, parts=finest.parts, planes=finest.planes, roof_type=own_type)
    return dataclasses.replace(_record(building, model), coarser=tuple(_lod_model(one) for one in coarser))


def _levels(lods: Sequence[str], models: Sequence[LodParts]) -> Iterator[Decision]:
    """Which of the levels of detail that were asked for were reached, the finest first."""
    reached = {model.lod: model for model in models}
    for lod in reversed(lods):
        faces = [face.plane for part in reached[lod].parts for face in part.faces] if lod in reached else None
        yield Decision(
            kind=DecisionKind.LEVEL,
            name=lod,
            outcome=Outcome.UNDRAWABLE if faces is None else Outcome.CHOSEN,
            detail="no form of its solids is valid" if faces is None else "",
            n_faces=None if faces is None else len(faces),
            n_planes=None if faces is None else len(set(faces)),
        )


def _blocks(building: _Building, plan: RoofPlan | None) -> Iterator[NamedForm[_Model]]:
    """Blocks on the footprint, else on the partition's outline; behind them those on the points' outline."""
    roof, settings, ground_z_m = building.roof, building.settings.roof, building.candidate.ground_z_m
    plane = block_plane(roof.points, ground_z_m, settings.block_height_percentile)
    if plan is None and roof.footprint_mm is not None:
        outlines = [("the footprint", roof.footprint_mm)]
    else:
        if plan is None:
            unlabelled = dataclasses.replace(roof, labels=np.zeros(len(roof.points), np.int32))
            plan = partition_roof(unlabelled, [plane], settings)
        outlines = [("the outline", plan.outline_mm)]
        if plan.raw is not None:
            outlines.append(("the raw outline", outline(plan.raw)))
    hull = hull_of_points(roof.points)
    if hull is not None:
        outlines.append(("the points' hull", MultiPolygon([shapely.transform(hull, lambda xy: np.rint(xy * 1e3))])))
    tolerance_m, least_m2 = settings.simplification_spacings * roof.spacing_m, settings.min_part_area_m2
    for words, footprint in outlines:
        for form in block_forms(footprint, plane, ground_z_m, tolerance_m, least_m2):
            yield NamedForm(BLOCK, partial(_block_model, form, plane), f"on {words}")


def _given_model(building: _Building, failed: BuildingResult) -> BuildingResult:
    """The block that the attributes of its footprint give a building that failed; else its record, which says why.

    The few points that it may have do not count: the block does not come from them, so its accuracy is unknown.
    """
    lack, roof = BuildingError(failed.reason or Reason.NO_FOOTPRINT, failed.reason_detail), building.roof
    try:
        given = given_block(building.candidate, lack)
        assert roof.footprint_mm is not None
        least_m2 = building.settings.roof.min_part_area_m2
        forms = block_forms(roof.footprint_mm, given.plane, given.ground_z_m, _GIVEN_TOLERANCE_M, least_m2)
        blocks = (NamedForm(BLOCK, partial(_block_model, form, given.plane), given.words) for form in forms)
        block, _ = _first_valid(blocks, building)
        if block is None:
            raise BuildingError(lack.reason, f"{lack.detail}; no block on the footprint is valid")
    except UNDRAWABLE as error:
        fault = error if isinstance(error, BuildingError) else BuildingError(lack.reason, f"{lack.detail}; {error}")
        return dataclasses.replace(failed, reason=fault.reason, reason_detail=fault.detail)
    record = _record(building, block, BuildingError(Reason.HEIGHT_GIVEN, f"{lack.detail}; {given.words}"))
    return dataclasses.replace(
        record,
        ground_z_m=given.ground_z_m,
        height_source=given.height_source,
        ground_source=given.ground_source,
        n_points=failed.n_points,
        density_per_m2=failed.n_points / record.footprint.area if record.footprint else math.nan,
        coverage=math.nan,
    )


def _block_model(form: Callable[[], list[SolidPart]], plane: Plane) -> _Model:
    """The block that a form draws."""
    return _Model(lod="1.2", parts=form(), planes=[plane])


def _record(
    building: _Building, model: _Model, fallback: BuildingError | None = None, codes: tuple[int, ...] = ()
) -> BuildingResult:
    """The record of a building with valid solids; planes that no face uses are left out.

    `fallback` is why the model is a block, None where it is the requested model; `codes` are those of the faults that
    kept the method's own solids from delivery.
    """
    candidate, roof = building.candidate, building.roof
    used = sorted({face.plane for part in model.parts for face in part.faces})
    number = {plane: k for k, plane in enumerate(used)}
    planes = tuple(model.planes[plane] for plane in used)
    faces = tuple(face for part in model.parts for face in part.faces)
    solids = tuple(part.solid for part in model.parts)
    if used != list(range(len(used))):
        faces = tuple(RoofFace(plane=number[face.plane], polygon=face.polygon) for face in faces)
        solids = tuple(renumbered(solid, number) for solid in solids)
    footprint = united([part.footprint for part in model.parts])
    with guide_steps():
        guides = followed(candidate.guides, [face.polygon for face in faces], roof.guide_distance_m)
    residuals, quality = model_quality(
        candidate.points,
        faces,
        planes,
        solids,
        spacing_m=roof.spacing_m,
        outline_sigma_m=0.0 if candidate.footprint is not None else roof.spacing_m * DRAWN_OUTLINE_SPACINGS,
        is_planar=model.lod == "2.2",
        bic_margin=model.bic_margin,
    )
    walls = walls_of(footprint, roof, building.settings.roof)
    overhangs = _overhangs(building, model, walls) if OVERHANGS in building.settings.lods else None
    return BuildingResult(
        building_id=candidate.building_id,
        origin=candidate.origin,
        source_id=candidate.source_id,
        status=Status.OK if fallback is None else Status.FALLBACK,
        reason=None if fallback is None else fallback.reason,
        reason_detail="" if fallback is None else fallback.detail,
        method=building.method,
        roof_type=model.roof_type or roof_type(planes, faces, solids, building.settings.roof_type),
        lod=model.lod,
        footprint=footprint,
        footprint_share=math.nan if roof.footprint_mm is None else footprint.area / (roof.footprint_mm.area * 1e-6),
        planes=planes,
        faces=faces,
        solids=solids,
        validity_codes=codes,
        ground_z_m=candidate.ground_z_m,
        height_source=HeightSource.POINTS,
        ground_source=candidate.ground_source,
        n_points=len(candidate.points),
        density_per_m2=len(candidate.points) / footprint.area,
        rmse_m=residuals.rmse_m,
        p95_m=residuals.p95_m,
        coverage=residuals.coverage,
        quality=quality,
        touches_data_edge=candidate.touches_data_edge,
        strip_offset_m=candidate.strip_offset_m,
        ground_noise_m=candidate.ground_noise_m,
        walls=wall_outline(walls),
        overhangs=overhangs,
        guides=guides,
        decisions=tuple(building.decisions),
    )


def _overhangs(building: _Building, model: _Model, walls: Walls | None) -> Overhangs:
    """The model in LoD2.3 beside a valid one, or why there is none; how it ended is added to the decisions."""
    solids: tuple[Solid, ...] = ()
    source = reason = None
    detail = ""
    try:
        source, drawn = _with_overhangs(building, model, walls)
    except UndrawableError as error:
        reason, detail = error.reason, f"{error.reason}: {error}"
    else:
        used = sorted({face.plane for part in model.parts for face in part.faces})
        solids = tuple(renumbered(solid, {plane: k for k, plane in enumerate(used)}) for solid in drawn)
    planes = [face.plane for solid in solids for face in solid.faces if face.plane >= 0]
    building.decisions.append(
        Decision(
            kind=DecisionKind.LEVEL,
            name=OVERHANGS,
            outcome=Outcome.CHOSEN if solids else Outcome.UNDRAWABLE,
            detail=detail,
            n_faces=len(planes) if solids else None,
            n_planes=len(set(planes)) if solids else None,
        )
    )
    return Overhangs(solids=solids, source=source, reason=reason)


def _with_overhangs(building: _Building, model: _Model, walls: Walls | None) -> tuple[OverhangSource, Sequence[Solid]]:
    """Solids with overhangs for the parts of a model, and where the overhangs come from.

    Raises UndrawableError where there are none or they cannot be drawn.
    """
    settings, ground_z_m, facades = building.settings.roof, building.candidate.ground_z_m, building.roof.facades
    if model.lod != "2.2":
        raise UndrawableError(NoOverhang.NO_LOD22, "the model is a block")
    parts, least_m = model.parts, settings.min_overhang_m
    if walls is None:
        source, given_m = OverhangSource.GIVEN, settings.beyond_footprint_m
        if facades is None or given_m <= 0.0:
            raise UndrawableError(NoOverhang.FOOTPRINT_GIVEN, "beyond_footprint_m is 0")
        if given_m < least_m:
            raise UndrawableError(NoOverhang.OVERHANG_TOO_SMALL, f"{given_m:.3f} m, less than {least_m:g} m")
        walls_mm = footprint_in_mm(united([part.footprint for part in parts]))
        parts = wider_parts(parts, model.planes, facades, given_m, ground_z_m)
    else:
        source = OverhangSource.USUAL if math.isnan(walls.overhang_m) else OverhangSource.SEEN
        if source is OverhangSource.USUAL and settings.usual_overhang_m <= 0.0:
            raise UndrawableError(NoOverhang.NO_WALL_SEEN, "usual_overhang_m is 0")
        if source is OverhangSource.USUAL and walls.widest_m <= 0.0:
            raise UndrawableError(NoOverhang.NO_OPEN_GROUND, "no line has open ground before it")
        if walls.counted_m <= 0.0:
            raise UndrawableError(NoOverhang.OVERHANG_TOO_SMALL, f"{walls.widest_m:.3f} m, less than {least_m:g} m")
        walls_mm = walls.overhung_mm
    solids = overhanging_solids(
        parts, model.planes, walls_mm, settings.overhang_thickness_m, ground_z_m + settings.min_clearance_m,
        lambda solid: not check_solid(solid),
    )  # fmt: skip
    if source is OverhangSource.GIVEN:
        beyond_m2 = math.fsum(map(floor_m2, solids)) - math.fsum(floor_m2(part.solid) for part in model.parts)
        if beyond_m2 > _LEAST_BEYOND_M2:
            raise UndrawableError(NoOverhang.TOO_LOW, f"{beyond_m2:.2f} m2 of walls would be beyond the footprint")
    return source, solids


def _lod_model(model: LodParts) -> LodModel:
    """A coarser model as it is delivered."""
    return LodModel(lod=model.lod, planes=tuple(model.planes), solids=tuple(part.solid for part in model.parts))


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
        footprint=footprint,
        ground_z_m=candidate.ground_z_m,
        ground_source=candidate.ground_source,
        n_points=len(candidate.points),
        density_per_m2=len(candidate.points) / area if area > 0.0 else math.nan,
        touches_data_edge=candidate.touches_data_edge,
        strip_offset_m=candidate.strip_offset_m,
        ground_noise_m=candidate.ground_noise_m,
    )
