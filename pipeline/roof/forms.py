"""The forms that the roof faces of a building can take, the preferred one first.

A form is a function that draws the faces when it is called: a later one costs nothing where an earlier one is valid.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from functools import partial

import shapely
from shapely import MultiPolygon

from pipeline.errors import BuildingError
from pipeline.model import Decision, DecisionKind, Outcome, Plane
from pipeline.registry import extra
from pipeline.roof.bending_planes import may_be_curved
from pipeline.roof.named_form import ARRANGEMENT, MOST_TEMPLATE_POINTS, SIMPLER, TEMPLATES, NamedForm, RankedFaces
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPoints, arranged_faces, drawn_outline, partition_roof
from pipeline.roof.roof_settings import ArrangementSettings, RoofSettings

FaceForm = NamedForm[RoofPartition | RankedFaces]
"""Draws roof faces, over the planes of the segmentation or over planes of their own."""

UNDRAWABLE = (BuildingError, shapely.errors.GEOSException)
"""Raised by a form that cannot be drawn."""

_WIDER_CLEARANCES = (2.5, 4.0)
"""Times the usual distances between an arrangement's vertices. Not settings: tried only where the usual distances made
no valid solid."""


def arranged_forms(
    roof: RoofPoints,
    planes: Sequence[Plane],
    settings: RoofSettings,
    costs: ArrangementSettings,
    decisions: list[Decision],
) -> Iterator[FaceForm]:
    """The arrangement; behind it coarser ones and the traced faces, drawn only where no solid of it is valid.

    A curved surface goes before it where one describes the roof better. Where points are few, templates compete with
    the arrangement: the better go first, worse ones last of all. Given outlines of many short edges are made simpler
    before faces are traced: those are drawn back to be valid. What lost undrawn is added to `decisions`.
    """
    outline_mm = drawn_outline(roof, settings)
    if roof.footprint_mm is not None:
        outline_mm = extra("without_voids")(outline_mm, roof.points, roof.spacing_m, settings)
    elif roof.guides:
        with extra("guide_steps")():
            outline_mm = extra("guided_outline")(outline_mm, roof.guides, roof.xy_mm, roof.guide_distance_m)
    if not roof.guides and may_be_curved(planes, roof.labels):
        from pipeline.roof.curved.curved_form import curved_forms

        yield from curved_forms(roof, planes, outline_mm, decisions)
    first, last = _competing_forms(roof, planes, outline_mm, settings, costs, decisions)
    yield from first
    # many planes that meet nearly in one point: with more room between its vertices the solid is valid
    for clearance in _WIDER_CLEARANCES:
        wider = partial(arranged_faces, roof, planes, outline_mm, costs, clearance)
        yield NamedForm(ARRANGEMENT, wider, f"vertices {clearance:g} times as far apart")
    if roof.footprint_mm is not None:
        from pipeline.roof.footprint_in_mm import simpler_outlines

        for simpler in simpler_outlines(outline_mm):
            yield from _competing_forms(roof, planes, simpler, settings, costs, decisions, SIMPLER)[0]
    try:
        plan = partition_roof(roof, planes, settings)
    except BuildingError:
        if not last:
            raise
    else:
        from pipeline.roof.traced_forms import traced_forms

        yield from traced_forms(plan, roof, settings)
    yield from last


def template_forms(roof: RoofPoints, lack: BuildingError, settings: RoofSettings) -> Iterator[FaceForm]:
    """The templates alone, where no planes were found; raises `lack` where there are no templates either."""
    if len(roof.points) > MOST_TEMPLATE_POINTS:
        raise lack
    fit_templates = extra("fit_templates")

    try:
        outline_mm = drawn_outline(roof, settings)
        templates = fit_templates(roof.points, outline_mm)
    except UNDRAWABLE:
        raise lack from None
    yield NamedForm(TEMPLATES, templates.faces)
    if roof.footprint_mm is not None:
        from pipeline.roof.footprint_in_mm import simpler_outlines

        for simpler in simpler_outlines(outline_mm):
            with contextlib.suppress(*UNDRAWABLE):
                yield NamedForm(TEMPLATES, fit_templates(roof.points, simpler).faces, SIMPLER)


def _competing_forms(
    roof: RoofPoints,
    planes: Sequence[Plane],
    outline_mm: MultiPolygon,
    settings: RoofSettings,
    costs: ArrangementSettings,
    decisions: list[Decision],
    within: str = "",
) -> tuple[tuple[FaceForm, ...], tuple[FaceForm, ...]]:
    """The arrangement within an outline and, where points are few, the templates: what goes first, what last."""
    arranged = partial(arranged_faces, roof, planes, outline_mm, costs)
    alone = (NamedForm(ARRANGEMENT, arranged, within),), ()
    if roof.spacing_m < settings.templates_spacing_m or len(roof.points) > MOST_TEMPLATE_POINTS:
        return alone
    try:
        templates = extra("fit_templates")(roof.points, outline_mm)
    except UNDRAWABLE as error:
        decisions.append(undrawable(TEMPLATES, error))
        return alone
    try:
        drawn = arranged()
    except UNDRAWABLE as error:
        decisions.append(undrawable(ARRANGEMENT, error))
        return (NamedForm(TEMPLATES, templates.faces, within),), ()
    drawn_planes = drawn.planes or tuple(planes)
    margin = extra("margin_of_templates")(roof.points, templates, drawn, drawn_planes)
    own = RankedFaces(partition=drawn, planes=drawn_planes, labels=roof.labels, bic_margin=-margin)
    form: FaceForm = NamedForm(TEMPLATES, partial(templates.faces, margin), within)
    own_form: FaceForm = NamedForm(ARRANGEMENT, lambda: own, within)
    beaten = (ARRANGEMENT, -margin) if margin > 0.0 else (TEMPLATES, margin)
    decisions.append(
        Decision(
            kind=DecisionKind.FORM, name=beaten[0], outcome=Outcome.OUTDONE, detail=within, bic_margin=beaten[1],
            n_faces=len(drawn.polygons) if margin > 0.0 else None,
        )
    )  # fmt: skip
    return ((form, own_form), ()) if margin > 0.0 else ((own_form,), (form,))


def undrawable(name: str, error: Exception, detail: str = "") -> Decision:
    """The entry of a form that cannot be drawn."""
    why = error.detail if isinstance(error, BuildingError) else str(error)
    words = f"{detail}: {why}" if detail else why
    return Decision(kind=DecisionKind.FORM, name=name, outcome=Outcome.UNDRAWABLE, detail=words)
