"""The block that the attributes of a given footprint describe, where its points make no model."""

from __future__ import annotations

import dataclasses
import math
from functools import partial

import numpy as np

from pipeline.building.blocks import block_model
from pipeline.building.drawing import Building
from pipeline.building.form_search import first_valid
from pipeline.building.record import record_of
from pipeline.errors import BuildingError
from pipeline.extras.footprints.given_heights import given_block
from pipeline.methods import ReconstructSettings
from pipeline.model import BuildingResult, Candidate, Decision, Reason
from pipeline.roof.block import block_forms
from pipeline.roof.forms import UNDRAWABLE
from pipeline.roof.named_form import BLOCK, NamedForm
from pipeline.roof.plan import RoofPoints

_GIVEN_TOLERANCE_M = 0.5
"""Largest change to an outline that is hard to draw, for a block without points, whose spacing would decide."""


def given_model(
    candidate: Candidate, method: str, settings: ReconstructSettings, decisions: list[Decision], failed: BuildingResult
) -> BuildingResult:
    """The block that the attributes of its footprint give a building that failed; else its record, which says why.

    The few points that it may have do not count: the block does not come from them, so its accuracy is unknown.
    """
    lack, roof = (
        BuildingError(failed.reason or Reason.NO_FOOTPRINT, failed.reason_detail),
        RoofPoints.none(candidate.footprint),
    )
    building = Building(
        candidate=dataclasses.replace(candidate, points=np.zeros((0, 3))),
        method=method,
        settings=settings,
        roof=roof,
        decisions=decisions,
    )
    try:
        given = given_block(building.candidate, lack)
        assert roof.footprint_mm is not None
        least_m2 = building.settings.roof.min_part_area_m2
        forms = block_forms(roof.footprint_mm, given.plane, given.ground_z_m, _GIVEN_TOLERANCE_M, least_m2)
        blocks = (NamedForm(BLOCK, partial(block_model, form, given.plane), given.words) for form in forms)
        block, _ = first_valid(blocks, building)
        if block is None:
            raise BuildingError(lack.reason, f"{lack.detail}; no block on the footprint is valid")
    except UNDRAWABLE as error:
        fault = error if isinstance(error, BuildingError) else BuildingError(lack.reason, f"{lack.detail}; {error}")
        return dataclasses.replace(failed, reason=fault.reason, reason_detail=fault.detail)
    record = record_of(building, block, BuildingError(Reason.HEIGHT_GIVEN, f"{lack.detail}; {given.words}"))
    return dataclasses.replace(
        record,
        ground_z_m=given.ground_z_m,
        height_source=given.height_source,
        ground_source=given.ground_source,
        n_points=failed.n_points,
        density_per_m2=failed.n_points / record.footprint.area if record.footprint else math.nan,
        coverage=math.nan,
    )
