"""Read inputs: the points of all inputs by tile, with flight strips that do not fit moved to their common mean."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from pipeline.runtime.run_context import RunContext
from pipeline.runtime.stages.ground import BlockCells, cells_of_blocks
from pipeline.runtime.stages.ingest import ingest
from pipeline.runtime.stages.ingested import Ingested
from pipeline.settings import RunSettings
from pipeline.terrain.survey_strips import moves_of, offsets_of, rows_of, strips_warning


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inputs:
    """The points of a run."""

    ingested: Sequence[Ingested]
    """What each input held, in the order of the paths."""
    cells: BlockCells
    """What was found of the points of each tile."""
    moves_mm: Mapping[int, int]
    """By how much each flight strip was moved up; empty where all fit."""


def read_inputs(context: RunContext, settings: RunSettings, paths: Sequence[str], *, footprints: bool) -> Inputs:
    """Read all inputs; again, with whole strips moved, if these lie too far above one another.

    Raises EmptyInputError and InconsistentInputError as `ingest` does, InputError as `cells_of_blocks` does.
    """
    ingested = ingest(context, paths)
    cells = cells_of_blocks(context, settings, ingested, footprints=footprints)
    rows = [rows_of(found.strips) for found in cells.cells.values()]
    moves_mm = moves_of(rows, settings.scene.strips)
    apart = offsets_of(rows, settings.scene.strips)
    if apart:
        context.progress.warn("cells", strips_warning(apart, moves_mm))
    if moves_mm:
        ingested = ingest(context, paths, moves_mm, again=True)
        cells = cells_of_blocks(context, settings, ingested, footprints=footprints, again=True)
    return Inputs(ingested=ingested, cells=cells, moves_mm=moves_mm)
