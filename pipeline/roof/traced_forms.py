"""Roof faces whose borders are traced between labelled points: ways to draw them, the preferred one first."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial

import shapely
from shapely import MultiPolygon

from pipeline.roof.borders import straighten_borders
from pipeline.roof.footprint import clip_partition, polygons_of, simpler_outlines
from pipeline.roof.named_form import SIMPLER, TRACED, NamedForm
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPlan, RoofPoints, min_face_area
from pipeline.roof.settings import RoofSettings
from pipeline.roof.simplification import simplify_partition, unite_close_vertices


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanForm:
    """One way to draw the final plan: the forms are tried one after another until the solid is valid."""

    straight: bool = False
    """Whether borders are straightened."""
    simplification: float
    """Times the simplification of the settings."""
    shrink_mm: float
    """By how much the footprint is drawn back, so that it passes by vertices that it touched."""
    unite_mm: float
    """Clipped vertices closer than this are one."""

    @property
    def words(self) -> str:
        """How it differs from others."""
        drawn_back = f", drawn back {self.shrink_mm:g} mm" if self.shrink_mm else ""
        borders = "straight borders" if self.straight else f"borders simplified {self.simplification:g} times"
        return f"{borders}{drawn_back}, vertices within {self.unite_mm:g} mm united"


FORMS = (
    PlanForm(straight=True, simplification=1.0, shrink_mm=0.0, unite_mm=10.0),
    PlanForm(straight=True, simplification=1.0, shrink_mm=7.0, unite_mm=2.5),
    PlanForm(simplification=1.0, shrink_mm=0.0, unite_mm=10.0),
    PlanForm(simplification=1.0, shrink_mm=0.0, unite_mm=2.5),
    PlanForm(simplification=1.0, shrink_mm=7.0, unite_mm=2.5),
    PlanForm(simplification=0.4, shrink_mm=16.0, unite_mm=2.5),
    PlanForm(simplification=0.1, shrink_mm=29.0, unite_mm=2.5),
    PlanForm(simplification=0.0, shrink_mm=0.0, unite_mm=0.0),
)
"""From the one that is wanted to the one that is most likely to succeed."""

RAW_FORMS = (
    PlanForm(simplification=0.5, shrink_mm=0.0, unite_mm=0.0),
    PlanForm(simplification=0.1, shrink_mm=0.0, unite_mm=0.0),
    PlanForm(simplification=0.0, shrink_mm=0.0, unite_mm=0.0),
)
"""The same for faces up to the raw outline."""


def plan_forms(plan: RoofPlan, roof: RoofPoints, settings: RoofSettings) -> Iterator[NamedForm[RoofPartition]]:
    """Ways to draw the final plan, the best first; each raises `no_partition` where it cannot be drawn."""
    clipped = plan.raw is None or settings.straight_eaves
    if clipped:
        for form in FORMS:
            yield NamedForm(TRACED, partial(draw_clipped, plan, roof, settings, form), form.words)
    if plan.raw is not None:
        for form in RAW_FORMS if clipped else (FORMS[0], *RAW_FORMS):
            tolerance = form.simplification * settings.simplification_spacings * roof.spacing_m
            raw = partial(simplify_partition, plan.raw, tolerance)
            yield NamedForm(TRACED, raw, f"up to the raw outline, {form.words}")


def draw_clipped(plan: RoofPlan, roof: RoofPoints, settings: RoofSettings, form: PlanForm) -> RoofPartition:
    """Clip the faces of `partition_roof` by the outline and simplify the borders between them, in integer millimetres.

    Raises BuildingError `no_partition` where this form cannot be drawn.
    """
    outline_mm = plan.outline_mm
    if form.shrink_mm > 0.0:
        drawn_back = shapely.set_precision(shapely.buffer(outline_mm, -form.shrink_mm, join_style="mitre"), 1.0)
        outline_mm = MultiPolygon(polygons_of(drawn_back))
    partition = clip_partition(plan.faces, outline_mm, min_face_area(roof, settings))
    if form.straight and settings.straight_borders:
        partition = straighten_borders(partition, plan.planes, roof.spacing_m, settings)
    tolerance = form.simplification * settings.simplification_spacings * roof.spacing_m
    return unite_close_vertices(simplify_partition(partition, tolerance, outline_too=False), form.unite_mm)


def traced_forms(plan: RoofPlan, roof: RoofPoints, settings: RoofSettings) -> Iterator[NamedForm[RoofPartition]]:
    """The traced faces; behind them the same within simpler outlines, where the outline is given."""
    yield from plan_forms(plan, roof, settings)
    if roof.footprint_mm is not None:
        for simpler in simpler_outlines(plan.outline_mm):
            simpler_plan = dataclasses.replace(plan, outline_mm=simpler)
            for form in plan_forms(simpler_plan, roof, settings):
                yield dataclasses.replace(form, detail=f"{form.detail}, {SIMPLER}")
