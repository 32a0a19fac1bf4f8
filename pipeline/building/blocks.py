"""Blocks, the fallback where no form of the roof is delivered."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.building.drawing import Building, DrawnModel
from pipeline.model import DecisionKind, Outcome, Plane
from pipeline.roof.block import block_forms, block_plane
from pipeline.roof.footprint import hull_of_points, outline
from pipeline.roof.named_form import BLOCK, NamedForm
from pipeline.roof.plan import RoofPlan, partition_roof
from pipeline.roof.solid import SolidPart


def blocks(building: Building, plan: RoofPlan | None) -> Iterator[NamedForm[DrawnModel]]:
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
    if hull is not None and roof.outline_mm is None:
        outlines.append(("the points' hull", MultiPolygon([shapely.transform(hull, lambda xy: np.rint(xy * 1e3))])))
    tolerance_m, least_m2 = settings.simplification_spacings * roof.spacing_m, settings.min_part_area_m2
    for words, footprint in outlines:
        for form in block_forms(footprint, plane, ground_z_m, tolerance_m, least_m2, roof.limit_mm):
            yield NamedForm(BLOCK, partial(block_model, form, plane), f"on {words}")


def block_model(form: Callable[[], list[SolidPart]], plane: Plane) -> DrawnModel:
    """The block that a form draws."""
    return DrawnModel(lod="1.2", parts=form(), planes=[plane])


def withdraw(building: Building) -> None:
    """Mark that the form that was chosen is not delivered."""
    for k in range(len(building.decisions)):
        entry = building.decisions[k]
        if entry.kind is DecisionKind.FORM and entry.outcome is Outcome.CHOSEN:
            building.decisions[k] = dataclasses.replace(entry, outcome=Outcome.WITHDRAWN)
