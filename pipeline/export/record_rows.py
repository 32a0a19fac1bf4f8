"""Records: one row a candidate, a roof plane, a rejected object, with the schemas that every reader relies on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.export.columns import COLUMNS, schema_of
from pipeline.export.dimensions import Dimensions, dimensions
from pipeline.export.facts import CandidateFacts, RecordContext, RejectedObject
from pipeline.export.solid_geometry import WALL_OUTLINE, solid_columns
from pipeline.export.stored_coordinates import SpatialReference, crs_coordinates, crs_elevation, crs_geometry, decimals
from pipeline.model import BuildingResult, ModelQuality, Plane
from pipeline.quality.detection import confidence_of

_SAYS_BUILDING = frozenset({"accept", "footprint"})
"""Overrides by which a user says that an object is a building."""

BUILDINGS = schema_of(COLUMNS["buildings"])
"""One row per candidate."""

PLANES = schema_of(COLUMNS["planes"])
"""One row per roof plane.

`coefficients` are in CRS units, with (a, b, c) of unit length there. `o_distance_m` is the plane's signed distance
above that origin in metres; slope and aspect are true angles, also where the horizontal and the vertical unit differ.
"""

REJECTED = schema_of(COLUMNS["rejected"])
"""One row per object that was judged not to be a building: its id is made as a building's, `geometry` is its box."""

KEYS: Mapping[str, tuple[str, ...]] = {
    "buildings": ("building_id",),
    "planes": ("building_id", "plane_id"),
    "rejected": ("object_id",),
}
"""The columns that order each table and name its rows."""
SCHEMAS: Mapping[str, pa.Schema] = {"buildings": BUILDINGS, "planes": PLANES, "rejected": REJECTED}
"""The schema of each table of a run directory."""


def _or_none(value: float, digits: int = 3) -> float | None:
    """A rounded figure; None where there is none, so that readers' means and sums are of the known ones."""
    return round(float(value), digits) + 0.0 if math.isfinite(value) else None


def _geometry(
    polygon: Polygon | MultiPolygon | None, origin: tuple[float, float, float], reference: SpatialReference
) -> bytes | None:
    """A polygon as ISO WKB in CRS units; None of nothing and of the empty polygon."""
    if polygon is None or polygon.is_empty:
        return None
    wkb: bytes = shapely.to_wkb(crs_geometry(polygon, origin, reference), flavor="iso")
    return wkb


def building_row(result: BuildingResult, context: RecordContext, *, mesh_path: str | None = None) -> dict[str, Any]:
    """The row of a candidate: the columns of `BUILDINGS`, in their order.

    Figures that are unknown (nan) and those of a model that does not exist become None.
    """
    measured = dimensions(result.solids)
    facts = context.facts.get(result.building_id) or CandidateFacts(
        acquired_from=context.acquired_from, acquired_to=context.acquired_to
    )
    footprint = result.footprint if result.footprint is not None and not result.footprint.is_empty else None
    modelled = bool(result.solids)
    return {
        "building_id": result.building_id,
        "source_id": result.source_id,
        "source_attributes": facts.source_attributes,
        "status": result.status.value,
        "reason": None if result.reason is None else result.reason.value,
        "reason_detail": result.reason_detail,
        "overridden": facts.overridden,
        "method": result.method,
        "roof_type": result.roof_type.value,
        "geometry": _geometry(shapely.force_2d(footprint), result.origin, context.reference),
        "lod": result.lod or None,
        **solid_columns(result, context.reference),
        **_elevations(result, measured, context.reference),
        "height_m": _or_none(measured.ridge_z_m - result.ground_z_m),
        "height_source": None if result.height_source is None else result.height_source.value,
        "footprint_area_m2": None if footprint is None else _or_none(footprint.area),
        "footprint_share": _or_none(result.footprint_share, 4),
        "roof_area_m2": _or_none(measured.roof_area_m2) if modelled else None,
        "volume_m3": _or_none(measured.volume_m3) if modelled else None,
        "n_points": result.n_points,
        "density_per_m2": _or_none(result.density_per_m2),
        "through_share": _or_none(facts.through_share, 4),
        "detection_confidence": _confidence(result, facts),
        "n_planes": len(result.planes),
        "rmse_m": _or_none(result.rmse_m),
        "p95_m": _or_none(result.p95_m),
        "coverage": _or_none(result.coverage, 4),
        **_quality(result.quality),
        "valid": modelled,
        "validity_codes": list(result.validity_codes),
        "touches_data_edge": result.touches_data_edge,
        "strip_offset_m": _or_none(result.strip_offset_m),
        "ground_noise_m": _or_none(result.ground_noise_m),
        **_walls(result, context.reference),
        "n_boxes": None if result.boxes is None else len(result.boxes),
        "guides_followed": None if result.guides is None else result.guides[0],
        "guides_not_followed": None if result.guides is None else result.guides[1],
        "acquired_from": facts.acquired_from,
        "acquired_to": facts.acquired_to,
        "mesh_path": mesh_path,
        "input_hash": facts.input_hash,
        "settings_hash": facts.settings_hash or context.settings_hash,
        "engine_version": context.engine_version,
    }


def _confidence(result: BuildingResult, facts: CandidateFacts) -> float | None:
    """How probably it is a building; None without a model, and where a footprint or the user says that it is one."""
    if result.source_id is not None or _SAYS_BUILDING & set((facts.overridden or "").split(", ")):
        return None
    return _or_none(confidence_of(result))


def _quality(quality: ModelQuality) -> dict[str, float | bool | None]:
    """How well the points support the model; None of what they cannot tell."""
    return {
        "point_spacing_m": _or_none(quality.point_spacing_m),
        "noise_m": _or_none(quality.noise_m),
        "share_within_0_2m": _or_none(quality.share_within, 4),
        "share_below_roof": _or_none(quality.share_below_roof, 4),
        "unexplained_m2": _or_none(quality.unexplained_m2),
        "extrapolated_share": _or_none(quality.extrapolated_share, 4),
        "largest_hole_m": _or_none(quality.largest_hole_m),
        "ridge_z_sigma_m": _or_none(quality.ridge_z_sigma_m),
        "outline_sigma_m": _or_none(quality.outline_sigma_m),
        "bic_margin": _or_none(quality.bic_margin),
        "is_curved": quality.is_curved,
    }


def _walls(result: BuildingResult, reference: SpatialReference) -> dict[str, bytes | float | str | None]:
    """The walls beneath the footprint and the overhangs over them; None where they are not known."""
    walls, overhangs = result.walls, result.overhangs
    return {
        WALL_OUTLINE: None if walls is None else _geometry(walls.outline, result.origin, reference),
        "overhang_m": None if walls is None else _or_none(walls.overhang_m),
        "overhang_sigma_m": None if walls is None else _or_none(walls.overhang_sigma_m),
        "overhang_source": None if overhangs is None or overhangs.source is None else overhangs.source.value,
        "lod23_reason": None if overhangs is None or overhangs.reason is None else overhangs.reason.value,
    }


def _elevations(
    result: BuildingResult, measured: Dimensions, reference: SpatialReference
) -> dict[str, float | str | None]:
    """The elevation columns in the CRS's vertical unit."""
    columns = ("ground_z", "eave_z", "ridge_z", "h_min", "h_50p", "h_70p", "h_max")
    local = (result.ground_z_m, measured.eave_z_m, measured.ridge_z_m, *measured.roof_z_m)
    ground, *roof = (
        (name, None if math.isnan(z) else crs_elevation(z, result.origin, reference))
        for name, z in zip(columns, local, strict=True)
    )
    source = None if result.ground_source is None else result.ground_source.value
    return dict([ground, ("ground_source", source), *roof])


def plane_rows(result: BuildingResult, context: RecordContext) -> list[dict[str, Any]]:
    """The rows of a building's roof planes: the columns of `PLANES`; several faces make a MultiPolygon."""
    reference = context.reference
    origin = crs_coordinates(np.zeros((1, 3)), result.origin, reference)[0]
    rows = []
    for index, plane in enumerate(result.planes):
        faces = [face.polygon for face in result.faces if face.plane == index]
        geometry = faces[0] if len(faces) == 1 else MultiPolygon(faces)
        plan_area = sum(face.area for face in faces)
        rows.append(
            {
                "building_id": result.building_id,
                "plane_id": index,
                "geometry": _geometry(geometry, result.origin, reference),
                "slope_deg": round(plane.slope_deg, 4),
                "aspect_deg": round(plane.aspect_deg, 4) % 360.0,
                "o_distance_m": round(plane.o_distance_m, 3) + 0.0,
                "origin_x": float(origin[0]),
                "origin_y": float(origin[1]),
                "origin_z": float(origin[2]),
                "coefficients": list(_coefficients(plane, reference)),
                "area_m2": round(plan_area / math.cos(math.radians(plane.slope_deg)), 3),
                "n_points": plane.n_points,
                "rmse_m": _or_none(plane.rmse_m),
                "extrapolated": plane.n_points == 0 and not result.roof_type.is_curved,
            }
        )
    return rows


def _coefficients(plane: Plane, reference: SpatialReference) -> tuple[float, float, float, float]:
    """Unit normal (up) and offset of a plane about its origin, in CRS units."""
    horizontal, vertical = reference.horizontal_unit_m, reference.vertical_unit_m
    # z v = a (x h) + b (y h) + c, divided by v: a, b scale by h / v and c by 1 / v.
    rise_x, rise_y, level = plane.a * horizontal / vertical, plane.b * horizontal / vertical, plane.c / vertical
    scale = 1.0 / math.sqrt(1.0 + rise_x * rise_x + rise_y * rise_y)
    return (
        round(-rise_x * scale, 9) + 0.0,
        round(-rise_y * scale, 9) + 0.0,
        round(scale, 9),
        round(-level * scale, decimals(vertical)) + 0.0,
    )


def rejected_row(rejected: RejectedObject, context: RecordContext) -> dict[str, Any]:
    """The row of a rejected object: the columns of `REJECTED`, in their order."""
    outline = None if rejected.outline is None else shapely.force_2d(rejected.outline)
    return {
        "object_id": rejected.object_id,
        "reason": rejected.reason.value,
        "reason_detail": rejected.reason_detail,
        "geometry": _geometry(outline, rejected.origin, context.reference),
        "area_m2": _or_none(rejected.area_m2),
        "height_m": _or_none(rejected.height_m),
        "n_points": rejected.n_points,
        "detection_confidence": _or_none(rejected.confidence, 4),
        "settings_hash": context.settings_hash,
        "engine_version": context.engine_version,
    }
