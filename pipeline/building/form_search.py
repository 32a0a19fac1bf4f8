"""The search for a form of the roof whose solids are valid, and whether its model is `ok`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import numpy as np

from pipeline.building.drawing import Building, DrawnModel
from pipeline.building.record import record_of
from pipeline.errors import BuildingError
from pipeline.methods import LODS, MAIN_ROOF
from pipeline.model import BuildingResult, Decision, DecisionKind, Outcome, RoofFace
from pipeline.quality.detection import confidence_of
from pipeline.quality.residuals import vertical_residuals
from pipeline.quality.support import NOT_OF_FORM, NOT_OF_ROOF, doubt_of, support_of
from pipeline.quality.validity import check_solid
from pipeline.roof.forms import UNDRAWABLE, undrawable
from pipeline.roof.named_form import TRACED, NamedForm
from pipeline.roof.plan import RoofPlan
from pipeline.roof.unlike_points import stays_near

_FEW_EXPLAINED = 0.75
"""Share of its roof points that a model has to explain where they are fewer than usual, or show no plane though they
are dense: a tree would make a roof, too."""


def first_valid(
    models: Iterable[NamedForm[DrawnModel]], building: Building
) -> tuple[DrawnModel | None, tuple[int, ...]]:
    """The first model that is valid throughout, or None and the codes of all faults.

    A model with a large face made level waits: it is taken unless a later one explains more roof points than its
    further faces cost. Of those the first is taken whose faces stay near the points, else the one that explains most.
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
        if form.is_last_resort and waiting is not None:
            continue
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
        explained = explained_share(building, model)
        decisions.append(_tried(form, model, Outcome.OUTDONE, explained=explained))
        is_mended = waiting is not None and waiting.contradiction is not None and model.contradiction is None
        cost = 0.0
        if waiting is not None and form.name == TRACED and share >= _FEW_EXPLAINED and not is_mended:
            from pipeline.roof.traced_forms import further_cost

            cost = further_cost(waiting.parts, model.parts, building.roof, building.settings.plan)
        if waiting is None or explained - cost > share:
            waiting, share, at = model, explained, len(decisions) - 1
            if not model.is_levelled and stays_near(model.parts, building.roof):
                remaining = iter(())


def _tried(
    form: NamedForm[DrawnModel],
    model: DrawnModel,
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


def too_few_points(building: Building, model: DrawnModel, lack: BuildingError | None) -> str:
    """The measured figure where few points do not explain a model, else empty; raises `lack` where points are dense."""
    settings, n = building.settings.roof, len(building.roof.points)
    are_few = n < settings.min_points
    if not are_few and (lack is None or not building.roof.spacing_m < settings.templates_spacing_m):
        return ""
    share = explained_share(building, model)
    building.decisions.append(Decision.check("explained_share", share, _FEW_EXPLAINED))
    if share >= _FEW_EXPLAINED:
        return ""
    if lack is not None and not are_few:
        raise lack
    found = f"{share:.0%} of {n} roof points lie on a roof, less than {_FEW_EXPLAINED:.0%}"
    return f"{found}, where there are fewer than min_points = {settings.min_points}"


def explained_share(building: Building, model: DrawnModel) -> float:
    """Share of the roof points that lie near the roof faces, vertically."""
    faces = [RoofFace(plane=face.plane, polygon=face.polygon) for part in model.parts for face in part.faces]
    residuals = vertical_residuals(building.roof.points, faces, model.planes)
    return float(np.mean(np.abs(residuals) <= building.settings.plan.residual_cap_m))


def judged(building: Building, record: BuildingResult, plan: RoofPlan | None, model: DrawnModel) -> BuildingResult:
    """A model as `ok` or `doubtful`, or a block that explains the points as well; a coarser model by its finest."""
    settings, is_finest = building.settings.support, record.lod == LODS[-1]
    has_slopes = record.lod >= MAIN_ROOF  # coarser models do not claim to lie on their points
    finest = record if is_finest else record_of(building, model)
    doubt = model.contradiction if has_slopes else None
    doubt = doubt or doubt_of(support_of(finest, building.candidate), settings)
    if not is_finest:
        record = dataclasses.replace(record, replaced_confidence=confidence_of(finest))
    if doubt is None or not (has_slopes or doubt.reason in NOT_OF_ROOF):
        return record
    if not is_finest or doubt.reason in NOT_OF_FORM:
        return record.doubted(doubt)
    from pipeline.building.blocks import blocks, withdraw

    withdraw(building)
    block, _ = first_valid(blocks(building, plan), building)
    if block is not None:
        fallback = record_of(building, block, BuildingError(doubt.reason, doubt.words))
        if fallback.quality.share_within >= record.quality.share_within - settings.block_loss:
            return dataclasses.replace(fallback, replaced_confidence=confidence_of(record))
    return record.doubted(doubt)
