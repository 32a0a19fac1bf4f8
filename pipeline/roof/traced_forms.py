"""Roof faces whose borders are traced between labelled points: ways to draw them, the preferred one first."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import BuildingError
from pipeline.model import Reason
from pipeline.roof.borders import straighten_borders
from pipeline.roof.footprint import polygons_of
from pipeline.roof.footprint_in_mm import simpler_outlines
from pipeline.roof.named_form import SIMPLER, TRACED, NamedForm
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPlan, RoofPoints, min_face_area
from pipeline.roof.roof_settings import ArrangementSettings, RoofSettings
from pipeline.roof.simplification import simplify_partition, unite_close_vertices
from pipeline.roof.solid import SolidPart


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
            yield NamedForm(TRACED, raw, f"up to the raw outline, {form.words}", is_last_resort=clipped)


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
        partition = straighten_borders(partition, plan.planes, roof.spacing_m)
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


def further_cost(
    before: Sequence[SolidPart], after: Sequence[SolidPart], roof: RoofPoints, costs: ArrangementSettings
) -> float:
    """Share of the roof points that the further faces and borders of a model cost, as they do in an arrangement."""
    cost = 0.0
    for sign, parts in ((1.0, after), (-1.0, before)):
        faces = [face.polygon for part in parts for face in part.faces]
        borders_m = 0.5 * math.fsum(face.length for face in faces)
        cost += sign * (costs.face_cost * len(faces) + costs.border_cost * borders_m / roof.spacing_m)
    return max(cost, 0.0) / len(roof.points)


def clip_partition(partition: RoofPartition, footprint_mm: MultiPolygon, min_area_m2: float) -> RoofPartition:
    """The part of a partition inside a footprint in integer millimetres.

    The partition reaches beyond it wherever there is roof. Pieces below `min_area_m2` join the neighbour with the
    longest border, or go where they have none. Raises BuildingError `no_partition` where nothing is left.
    """
    shapely.prepare(footprint_mm)
    polygons = np.array(partition.polygons, dtype=object)
    inside = shapely.contains_properly(footprint_mm, polygons)
    pieces: list[Polygon] = []
    labels: list[int] = []
    for polygon, label, whole in zip(polygons, partition.labels.tolist(), inside, strict=True):
        for piece in [polygon] if whole else polygons_of(shapely.intersection(polygon, footprint_mm, grid_size=1.0)):
            pieces.append(piece)
            labels.append(label)
    pieces, labels = _absorb_small(pieces, labels, min_area_m2 * 1e6)
    if not pieces:
        raise BuildingError(Reason.NO_PARTITION, "no roof face lies inside the footprint")
    return RoofPartition(polygons=tuple(pieces), labels=np.array(labels, np.int32))


def _absorb_small(pieces: list[Polygon], labels: list[int], min_area_mm2: float) -> tuple[list[Polygon], list[int]]:
    """Unite pieces that are too small with a neighbour, smallest first."""
    alive = [True] * len(pieces)
    small = [k for k in range(len(pieces)) if pieces[k].area < min_area_mm2]
    if not small:
        return pieces, labels
    tree = shapely.STRtree(pieces)
    for k in sorted(small, key=lambda k: (pieces[k].area, k)):
        if pieces[k].area >= min_area_mm2:
            continue
        longest, into = 0.0, -1
        for j in sorted(tree.query(pieces[k]).tolist()):
            if j == k or not alive[j]:
                continue
            border = shapely.intersection(pieces[k], pieces[j], grid_size=1.0).length
            if border > longest:
                longest, into = border, j
        alive[k] = False
        if into >= 0:
            united = shapely.union(pieces[k], pieces[into], grid_size=1.0)
            if isinstance(united, Polygon):
                pieces[into] = united
    kept = [k for k in range(len(pieces)) if alive[k]]
    return [pieces[k] for k in kept], [labels[k] for k in kept]
