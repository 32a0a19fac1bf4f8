"""Costs and lengths of the arrangement at a density of points."""

from __future__ import annotations

from typing import NamedTuple

from pipeline.roof.arrangement.raster_labels import COST_SCALE
from pipeline.roof.settings import ArrangementSettings


class Limits(NamedTuple):
    """`ArrangementSettings` at a density of points."""

    cell_m: float
    points_per_m2: float
    cap_m: float
    """Residual from which a point is unexplained."""
    cost_per_m: float
    """Unexplained points that a metre of border must save."""
    face_cost: int
    """Cost of a face that all its points fit, thousandths of a point."""
    doubtful_cost: int
    """Cost of a face that half of its points misfit, thousandths of a point."""
    min_face_width_m: float
    """Slivers that are narrower are not faces."""
    line_length_m: float
    line_reach_m: float
    corner_cost: float
    """Points that a corner must save."""
    corner_gap_m: float
    corner_reach_m: float
    plane_shift_m: float
    overshoot_m: float
    """How far a plane may go above or below the points."""
    clearance: float
    """Times the usual distances that vertices keep from each other."""


def limits_at(spacing_m: float, settings: ArrangementSettings, clearance: float = 1.0) -> Limits:
    """The limits at a typical distance of neighbouring points in plan."""
    points_per_m2 = 1.0 / spacing_m**2
    face_cost, doubtful_cost = settings.costs_of_face(points_per_m2)
    return Limits(
        cell_m=settings.raster_cell_of(spacing_m),
        points_per_m2=points_per_m2,
        cap_m=settings.residual_cap_m,
        cost_per_m=settings.border_cost / spacing_m,
        face_cost=round(face_cost * COST_SCALE),
        doubtful_cost=round(doubtful_cost * COST_SCALE),
        min_face_width_m=settings.min_face_width_m,
        line_length_m=settings.line_length_m,
        line_reach_m=max(settings.line_reach_m, spacing_m),
        corner_cost=settings.corner_share * face_cost,
        corner_gap_m=settings.corner_gap_m,
        corner_reach_m=settings.corner_reach_m,
        plane_shift_m=settings.plane_shift_m,
        overshoot_m=max(settings.overshoot_m, spacing_m),
        clearance=clearance,
    )
