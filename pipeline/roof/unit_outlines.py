"""Outlines of touching units, drawn together: two of them share one line.

Drawn one by one, each unit ends at its own outermost points, which leaves a slit between two houses of a row. Therefore
the outline is drawn around all units of a candidate, as if they were one building, and divided among them as a roof is
divided among its planes: half-way between the points on either side, in straight lines.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.errors import BuildingError
from pipeline.model import Candidate, LabelArray, Plane
from pipeline.prepared_cloud import prepare_cloud
from pipeline.roof.outlines.walls import divided
from pipeline.roof.plan import partition_roof, roof_points
from pipeline.roof.roof_settings import RoofSettings


def unit_outlines(candidate: Candidate, units: LabelArray, settings: RoofSettings) -> list[MultiPolygon | None]:
    """Draw the outlines of the units of one candidate, in local metres on the millimetre grid; (n,) units from 0.

    They share borders and do not overlap. None for a unit without a part of the plan, and for all where no plan can be
    drawn: such units are drawn one by one.
    """
    count = int(units.max(initial=-1)) + 1
    try:
        bare = roof_points(prepare_cloud(candidate, settings.max_points), settings)
        roof = dataclasses.replace(bare, labels=np.ascontiguousarray(units[bare.index], np.int32))
        plan = partition_roof(roof, _levels(candidate, units, count), settings)
        parts = divided(plan.faces, plan.outline_mm, roof.xy_mm, roof.labels, roof.spacing_m)
    except (BuildingError, shapely.errors.GEOSException):
        return [None] * count
    return [_in_metres(parts[unit]) if unit in parts else None for unit in range(count)]


def _levels(candidate: Candidate, units: LabelArray, count: int) -> list[Plane]:
    """A level plane at the median height of every unit: they cross nowhere, and the higher one is known."""
    levels = []
    for unit in range(count):
        z = np.sort(candidate.points[units == unit, 2])
        levels.append(Plane(a=0.0, b=0.0, c=float(z[len(z) // 2]), n_points=len(z), rmse_m=0.0))
    return levels


def _in_metres(shape_mm: MultiPolygon) -> MultiPolygon:
    drawn: MultiPolygon = shapely.transform(shape_mm, lambda xy: xy * 1e-3)
    return drawn
