"""Solids over the roof faces that a form draws, and blocks."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pipeline.methods import ReconstructSettings
from pipeline.model import Candidate, Decision, Doubt, Plane, RoofType, Segmentation
from pipeline.quality.validity import check_solid
from pipeline.registry import extra
from pipeline.roof.forms import FaceForm
from pipeline.roof.named_form import RankedFaces
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPoints
from pipeline.roof.solid import LodParts, SolidPart, solid_parts
from pipeline.roof.unlike_points import contradiction_of
from pipeline.roof.unsupported_faces import cut_at_floor, goes_far, level_unsupported_faces, levelled_share_of

_MUCH_LEVELLED = 0.05
"""Share of the plan. Where faces of more than this had to be made level, other forms are drawn and compared with it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Building:
    """Common arguments of the steps for one building."""

    candidate: Candidate
    method: str
    settings: ReconstructSettings
    roof: RoofPoints
    """The roof points, without labels."""
    decisions: list[Decision]
    """Grows with what is checked and tried."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DrawnModel(LodParts):
    """A model of a building, not yet judged."""

    roof_type: RoofType | None = None
    """The type that the method names; None for the rule over the delivered planes."""
    bic_margin: float = math.nan
    """By how much its faces were better than those that they competed with; nan where they did not."""
    is_levelled: bool = False
    """True where a large part of its faces had to be made level, or where some went far or contradict the points."""
    levelled_share: float = 0.0
    """Share of the plan whose faces had to be made level."""
    cleaned: str = ""
    """What was changed on the drawn faces."""
    contradiction: Doubt | None = None
    """Why its faces are not those of its points; None if they are."""


def own_model(building: Building, segmentation: Segmentation, roof: RoofPoints, form: FaceForm) -> DrawnModel:
    """Solids over the roof faces that a form draws."""
    settings, ground_z_m = building.settings.roof, building.candidate.ground_z_m
    drawn, planes, margin = form(), segmentation.planes, math.nan
    slopes = roof
    if isinstance(drawn, RankedFaces):
        planes, margin = drawn.planes, drawn.bic_margin
        drawn, roof = drawn.partition, dataclasses.replace(roof, labels=drawn.labels)
    elif drawn.planes is not None:
        planes = drawn.planes
    known = segmentation.roof_type or drawn.roof_type
    if segmentation.faces is not None or drawn.roof_type is not None:  # one form: with a side made level, another
        parts = large_parts(solid_parts(drawn, list(planes), ground_z_m, roof.limit_mm), settings.min_part_area_m2)
        return DrawnModel(
            lod="2.2",
            parts=[extra("unite_flush_walls")(part, roof.limit_mm) for part in parts],
            planes=list(planes),
            roof_type=known,
            bic_margin=margin,
        )

    is_far = goes_far(drawn, roof, planes, ground_z_m, settings)

    def over(level: RoofPartition, extended: list[Plane]) -> DrawnModel:
        cut, cut_planes = cut_at_floor(level, extended, ground_z_m + settings.min_clearance_m)
        if (roof.index < 0).any():  # points were added on unseen sides
            cut_planes = extra("with_support_of_seen")(cut, cut_planes, roof)
        contradiction = contradiction_of(cut, cut_planes, roof, slopes, segmentation.planes)
        all_parts = solid_parts(cut, cut_planes, ground_z_m, roof.limit_mm)
        parts = large_parts(all_parts, settings.min_part_area_m2)
        levelled_share = levelled_share_of(level, len(planes))
        return DrawnModel(
            lod="2.2",
            parts=parts,
            planes=cut_planes,
            roof_type=known,
            bic_margin=margin,
            is_levelled=is_far or levelled_share > _MUCH_LEVELLED or contradiction is not None,
            levelled_share=levelled_share,
            cleaned=_cleaned(level, len(planes), cut, len(all_parts) - len(parts)),
            contradiction=contradiction,
        )

    model = over(*level_unsupported_faces(drawn, roof, planes, ground_z_m, settings))
    if sum(len(part.faces) for part in model.parts) > len(drawn.polygons) and not _is_sound(model):
        # the ends of slopes are small faces beside long ones: without them the roof may be sound
        whole = over(*level_unsupported_faces(drawn, roof, planes, ground_z_m, settings, ends=False))
        model = whole if _is_sound(whole) else model
    return model


def _is_sound(model: DrawnModel) -> bool:
    """Whether a model has solids, and all of them are valid."""
    return bool(model.parts) and not any(check_solid(part.solid) for part in model.parts)


def _cleaned(level: RoofPartition, n_planes: int, cut: RoofPartition, left_out: int) -> str:
    """What was changed on the drawn faces, in words; faces on planes beyond the first `n_planes` were made level."""
    made_level = int(np.count_nonzero(level.labels >= n_planes))
    return "; ".join(
        filter(
            None,
            (
                f"{made_level} faces made level" if made_level else "",
                "cut at the floor" if cut is not level else "",
                f"{left_out} small parts left out" if left_out else "",
            ),
        )
    )


def large_parts(parts: list[SolidPart], min_area_m2: float) -> list[SolidPart]:
    """The parts that are large enough, or the largest one."""
    large = [part for part in parts if part.footprint.area >= min_area_m2]
    return large or sorted(parts, key=lambda part: -part.footprint.area)[:1]
