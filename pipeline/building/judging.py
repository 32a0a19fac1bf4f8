"""Whether a valid model is `ok`."""

from __future__ import annotations

import dataclasses

from pipeline.building.drawing import Building, DrawnModel, blocks
from pipeline.building.form_search import first_valid, withdraw
from pipeline.building.record import record_of
from pipeline.errors import BuildingError
from pipeline.methods import LODS
from pipeline.model import BuildingResult
from pipeline.quality.detection import confidence_of
from pipeline.quality.support import NOT_OF_FORM, NOT_OF_ROOF, doubt_of, support_of
from pipeline.roof.plan import RoofPlan


def judged(building: Building, record: BuildingResult, plan: RoofPlan | None, model: DrawnModel) -> BuildingResult:
    """A model as `ok` or `doubtful`, or a block that explains the points as well; a coarser model by its finest."""
    settings, is_finest = building.settings.support, record.lod == LODS[-1]
    finest = record if is_finest else record_of(building, model)
    doubt = model.contradiction if is_finest else None
    doubt = doubt or doubt_of(support_of(finest, building.candidate), settings)
    if not is_finest:  # a coarser model does not claim to lie on its points
        record = dataclasses.replace(record, replaced_confidence=confidence_of(finest))
    if doubt is None or not (is_finest or doubt.reason in NOT_OF_ROOF):
        return record
    if not is_finest or doubt.reason in NOT_OF_FORM:
        return record.doubted(doubt)
    withdraw(building)
    block, _ = first_valid(blocks(building, plan), building)
    if block is not None:
        fallback = record_of(building, block, BuildingError(doubt.reason, doubt.words))
        if fallback.quality.share_within >= record.quality.share_within - settings.block_loss:
            return dataclasses.replace(fallback, replaced_confidence=confidence_of(record))
    return record.doubted(doubt)
