"""One building end to end, without I/O: from a candidate's points to closed solids and their record.

The steps: prepare the points, find planes, try the forms of the model until one is valid, deliver it with its record;
a block where none is.
"""

from __future__ import annotations

import dataclasses
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import PurePath

import numpy as np
import shapely

from pipeline.building.drawing import Building, own_model
from pipeline.building.form_search import first_valid, judged, too_few_points
from pipeline.building.record import delivered, failed_building, record_of
from pipeline.errors import BuildingError
from pipeline.methods import ReconstructSettings, method_named
from pipeline.model import BuildingResult, Candidate, Decision, PreparedCloud, Reason, Segmentation, Status
from pipeline.prepared_cloud import prepare_cloud
from pipeline.registry import extra
from pipeline.roof.forms import FaceForm, arranged_forms, template_forms, undrawable
from pipeline.roof.named_form import PRIMITIVE, NamedForm
from pipeline.roof.plan import RoofPlan, RoofPoints, partition_roof, roof_points
from pipeline.roof.shaded_points import with_shaded_points

__all__ = ["ReconstructSettings", "failed_building", "reconstruct_building"]


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
        building = Building(candidate=candidate, method=method, settings=settings, roof=roof, decisions=decisions)
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
        result = extra("given_model")(candidate, method, settings, decisions, result)
    return result if result.solids else dataclasses.replace(result, decisions=tuple(decisions))


def _describe(error: Exception) -> str:
    """Type, message and the innermost place of an unexpected exception."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f"{'/'.join(PurePath(frames[-1].filename).parts[-3:])}:{frames[-1].lineno}" if frames else "unknown place"
    return f"{type(error).__name__}: {error} ({place})"


def _reconstruct(
    building: Building, cloud: PreparedCloud, segment: Callable[[PreparedCloud], Segmentation], *, is_arranged: bool
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
            forms = iter([NamedForm(PRIMITIVE, partial(extra("primitive_partition"), segmentation.faces))])
        elif is_arranged:
            roof = with_shaded_points(roof, cloud, segmentation.planes)
            if roof.footprint_mm is not None:
                elsewhere = building.candidate.elsewhere
                roof, planes = extra("with_unseen_slopes")(roof, segmentation.planes, elsewhere, settings.roof)
                segmentation = dataclasses.replace(segmentation, planes=planes)
            forms = arranged_forms(roof, segmentation.planes, settings.roof, settings.plan, building.decisions)
        else:
            from pipeline.roof.traced_forms import traced_forms

            plan = partition_roof(roof, segmentation.planes, settings.roof)
            forms = traced_forms(plan, roof, settings.roof)
        model, codes = first_valid(
            (
                NamedForm(
                    form.name,
                    partial(own_model, building, segmentation, roof, form),
                    form.detail,
                    is_last_resort=form.is_last_resort,
                )
                for form in forms
            ),
            building,
        )
        if model is not None:
            too_few = too_few_points(building, model, lack)
            if not too_few and (record := delivered(building, model)):
                return judged(building, record, plan, model)
            from pipeline.building.blocks import withdraw

            withdraw(building)
            if too_few:
                return failed_building(building.candidate, building.method, Reason.TOO_FEW_POINTS, too_few)
        codes_met = ", ".join(map(str, codes)) or "none"
        fallback = BuildingError(Reason.INVALID_SOLID, f"validity codes {codes_met}: no form of the solid passes")
    except BuildingError as error:
        fallback = error
    except shapely.errors.GEOSException as error:
        fallback = BuildingError(Reason.NO_PARTITION, f"the plan cannot be drawn: {error}")
    from pipeline.building.blocks import blocks

    block, _ = first_valid(blocks(building, plan), building)
    if block is None:
        raise BuildingError(Reason.NO_FOOTPRINT, f"no valid block over {len(building.roof.points)} roof points")
    if settings.record_lods == ("1.2",):  # the settings ask for a block
        return record_of(building, block)
    return record_of(building, block, fallback, codes)


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


def _checks(building: Building, segmentation: Segmentation, roof: RoofPoints) -> Iterator[Decision]:
    """The figures that decide which forms are tried, each with its limit."""
    n_points, coarsest_m = len(roof.labels), building.settings.roof.templates_spacing_m
    yield Decision.check("planes_found", len(segmentation.planes), 1)
    # one point is enough
    yield Decision.check("points_on_planes_share", int(np.count_nonzero(roof.labels >= 0)) / n_points, 1 / n_points)
    yield Decision.check(
        "point_spacing_m", roof.spacing_m, coarsest_m, "templates compete where points are as far apart"
    )
