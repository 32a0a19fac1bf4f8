"""The record of a building: its model at the levels of detail that are asked for, or why there is none."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pipeline.building.drawing import Building, DrawnModel
from pipeline.errors import BuildingError
from pipeline.methods import OVERHANGS
from pipeline.model import BuildingResult, Candidate, HeightSource, Reason, RoofFace, Status
from pipeline.quality.model_quality import drawn_outline_sigma_m, model_quality
from pipeline.registry import extra
from pipeline.roof.footprint import hull_of_points
from pipeline.roof.plan import wall_outline, walls_of
from pipeline.roof.roof_type import roof_type
from pipeline.roof.solid import renumbered, united
from pipeline.terrain.roof_patches import has_directions


def record_of(
    building: Building, model: DrawnModel, fallback: BuildingError | None = None, codes: tuple[int, ...] = ()
) -> BuildingResult:
    """The record of a building with valid solids; planes that no face uses are left out.

    `fallback` is why the model is a block, None where it is the requested model; `codes` are those of the faults that
    kept the method's own solids from delivery.
    """
    candidate, roof = building.candidate, building.roof
    used = sorted({face.plane for part in model.parts for face in part.faces})
    number = {plane: k for k, plane in enumerate(used)}
    planes = tuple(model.planes[plane] for plane in used)
    faces = tuple(face for part in model.parts for face in part.faces)
    solids = tuple(part.solid for part in model.parts)
    if used != list(range(len(used))):
        faces = tuple(RoofFace(plane=number[face.plane], polygon=face.polygon) for face in faces)
        solids = tuple(renumbered(solid, number) for solid in solids)
    footprint = united([part.footprint for part in model.parts])
    guides = None
    if candidate.guides:
        with extra("guide_steps")():
            guides = extra("followed")(candidate.guides, [face.polygon for face in faces], roof.guide_distance_m)
    residuals, quality = model_quality(
        candidate.points,
        faces,
        planes,
        solids,
        spacing_m=roof.spacing_m,
        outline_sigma_m=0.0 if candidate.footprint is not None else drawn_outline_sigma_m(footprint, len(roof.points)),
        is_planar=model.lod >= "2",
        bic_margin=model.bic_margin,
    )
    if model.lod >= "2" and has_directions(np.reshape([plane.normal for plane in planes], (-1, 3))):
        from pipeline.quality.bent_roofs import is_curved_roof

        quality = dataclasses.replace(quality, is_curved=is_curved_roof(planes, faces, solids, model.roof_type))
    walls = walls_of(footprint, roof, building.settings.roof)
    overhangs = None
    if OVERHANGS in building.settings.lods:
        overhangs = extra("overhangs_of")(building, model, walls)
    boxes = None
    if building.settings.roof.superstructures and model.lod == "2.2":
        boxes = extra("boxes_of")(building, faces, planes, footprint, quality.noise_m)
    return BuildingResult(
        building_id=candidate.building_id,
        origin=candidate.origin,
        source_id=candidate.source_id,
        status=Status.OK if fallback is None else Status.FALLBACK,
        reason=None if fallback is None else fallback.reason,
        reason_detail="" if fallback is None else fallback.detail,
        method=building.method,
        roof_type=model.roof_type or roof_type(planes, faces, solids, building.settings.roof_type),
        lod=model.lod,
        footprint=footprint,
        footprint_share=math.nan if roof.footprint_mm is None else footprint.area / (roof.footprint_mm.area * 1e-6),
        planes=planes,
        faces=faces,
        solids=solids,
        validity_codes=codes,
        ground_z_m=candidate.ground_z_m,
        height_source=HeightSource.POINTS,
        ground_source=candidate.ground_source,
        n_points=len(candidate.points),
        density_per_m2=len(candidate.points) / footprint.area,
        rmse_m=residuals.rmse_m,
        p95_m=residuals.p95_m,
        coverage=residuals.coverage,
        quality=quality,
        touches_data_edge=candidate.touches_data_edge,
        strip_offset_m=candidate.strip_offset_m,
        ground_noise_m=candidate.ground_noise_m,
        walls=wall_outline(walls),
        overhangs=overhangs,
        boxes=boxes,
        guides=guides,
        decisions=tuple(building.decisions),
    )


def delivered(building: Building, model: DrawnModel) -> BuildingResult | None:
    """The record of a model at the levels of detail that the settings ask for; None where the finest is not valid."""
    if building.settings.record_lods == (model.lod,):
        return record_of(building, model)
    result: BuildingResult | None = extra("at_levels")(building, model)
    return result


def failed_building(candidate: Candidate, method: str, reason: Reason, detail: str) -> BuildingResult:
    """The record of a building without a model."""
    finite = candidate.points[np.isfinite(candidate.points).all(axis=1)]
    footprint = candidate.footprint if candidate.footprint is not None else hull_of_points(finite)
    area = footprint.area if footprint is not None else 0.0
    return BuildingResult(
        building_id=candidate.building_id,
        origin=candidate.origin,
        source_id=candidate.source_id,
        status=Status.FAILED,
        reason=reason,
        reason_detail=detail,
        method=method,
        footprint=footprint,
        ground_z_m=candidate.ground_z_m,
        ground_source=candidate.ground_source,
        n_points=len(candidate.points),
        density_per_m2=len(candidate.points) / area if area > 0.0 else math.nan,
        touches_data_edge=candidate.touches_data_edge,
        strip_offset_m=candidate.strip_offset_m,
        ground_noise_m=candidate.ground_noise_m,
    )
