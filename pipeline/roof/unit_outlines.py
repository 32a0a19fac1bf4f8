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
from pipeline.roof.footprint import polygons_of
from pipeline.roof.plan import partition_roof, roof_points
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.traced_forms import FORMS, draw_clipped


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
        partition = draw_clipped(plan, roof, settings, FORMS[0])
    except (BuildingError, shapely.errors.GEOSException):
        return [None] * count
    parts: list[list[shapely.Polygon]] = [[] for _ in range(count)]
    for polygon, unit in zip(partition.polygons, partition.labels.tolist(), strict=True):
        parts[unit].append(polygon)
    return [_united(polygons) for polygons in parts]


def _levels(candidate: Candidate, units: LabelArray, count: int) -> list[Plane]:
    """A level plane at the median height of every unit: they cross nowhere, and the higher one is known."""
    levels = []
    for unit in range(count):
        z = np.sort(candidate.points[units == unit, 2])
        levels.append(Plane(a=0.0, b=0.0, c=float(z[len(z) // 2]), n_points=len(z), rmse_m=0.0))
    return levels


def _united(polygons: list[shapely.Polygon]) -> MultiPolygon | None:
    """The parts of one unit in metres; None where there are none."""
    if not polygons:
        return None
    whole = polygons_of(shapely.union_all(polygons, grid_size=1.0))
    return shapely.transform(MultiPolygon(whole), lambda xy: xy * 1e-3) if whole else None
