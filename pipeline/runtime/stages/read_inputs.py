"""Read inputs: the points of all inputs by tile, with flight strips that do not fit moved to their common mean."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import InputError
from pipeline.io import shown
from pipeline.methods import method_named
from pipeline.model import IntArray
from pipeline.registry import extra
from pipeline.runtime.request import RunRequest
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.run_plan import Plan
from pipeline.runtime.scratch.outcomes import (
    DamagedError,
    OutcomeTask,
    Place,
    brief_of,
    drop_outcomes,
    key_of,
    run_and_store,
    whole,
)
from pipeline.runtime.stages.ground_stage import BlockCells, cells_of_blocks
from pipeline.runtime.stages.ingest import ingest, tasks_of
from pipeline.runtime.stages.ingested import Ingested, slices_in
from pipeline.settings import RunSettings
from pipeline.terrain.flight_passes import Strip, passes_of
from pipeline.terrain.strip_moves import moves_of, offsets_of, strips_warning, surfaces_warning
from pipeline.terrain.survey_strips import NO_ROWS, Rows, counted, rows_of

if TYPE_CHECKING:
    from pipeline.extras.footprints.given_footprints import GivenFootprints
    from pipeline.extras.guides.given_guides import GivenGuides
    from pipeline.extras.overrides.overrides_file import Override

_STRIPS = "strips"
"""The stage under which it is stored how strips that were moved differ in the files."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inputs:
    """The points of a run."""

    ingested: Sequence[Ingested]
    """What each input held, in the order of the paths."""
    cells: BlockCells
    """What was found of the points of each tile."""
    moves_mm: Mapping[Strip, int]
    """By how much each flight strip was moved up, of those that share an id also 0; empty where all fit."""


def read_inputs(
    context: RunContext, settings: RunSettings, paths: Sequence[str], footprints: GivenFootprints | None
) -> Inputs:
    """Read all inputs; again, with whole strips moved, if these lie too far above one another or share an id.

    A later run of the same inputs in one work folder knows the moves before it reads, so that nothing is read again.
    Raises EmptyInputError and InconsistentInputError as `ingest` does, InputError as `cells_of_blocks` does.
    """
    general, scene = settings.general, settings.scene
    key = key_of([place.name for place in tasks_of(context, paths)], general.classes, scene.outliers)
    place = Place(_STRIPS, "rows", key)
    found: Inputs | None = None
    differ = _stored(context, place)
    if differ is None:
        found = _read(context, settings, paths, {}, footprints)
        rows = counted(np.concatenate([NO_ROWS, *(rows_of(cells.strips) for cells in found.cells.cells.values())]))
        differ = rows, slices_in(found.ingested)
    moves_mm = moves_of(*differ, scene.strips)
    apart = offsets_of(*differ, scene.strips)
    if apart:
        context.progress.warn("cells", strips_warning(apart, moves_mm))
    if doubled := surfaces_warning(*differ, scene.strips):
        context.progress.warn("cells", doubled)
    if found is not None and not moves_mm:
        return found
    if found is not None:
        drop_outcomes(context.scratch, _STRIPS, [])
        work = OutcomeTask(
            function=whole, task=differ, place=place, scratch=context.scratch, brief=whole, stage="cells"
        )
        run_and_store(work)
    return _read(context, settings, paths, moves_mm, footprints)


def _read(
    context: RunContext,
    settings: RunSettings,
    paths: Sequence[str],
    moves_mm: Mapping[Strip, int],
    footprints: GivenFootprints | None,
) -> Inputs:
    """Read all inputs with some strips moved up and separated."""
    ingested = ingest(context, paths, moves_mm)
    # once they are moved and separated, passes fit
    passes = () if moves_mm else passes_of(slices_in(ingested))
    cells = cells_of_blocks(context, settings, ingested, footprints, passes=passes)
    return Inputs(ingested=ingested, cells=cells, moves_mm=moves_mm)


def _stored(context: RunContext, place: Place) -> tuple[Rows, IntArray] | None:
    """How the strips of these inputs differ, if an earlier run moved them; None if it is not stored, or damaged."""
    if not context.scratch.has(place.name):
        return None
    try:
        differ: tuple[Rows, IntArray] = brief_of(context.scratch, place)
    except DamagedError:
        return None
    return differ


def footprints_for(request: RunRequest, plan: Plan) -> GivenFootprints | None:
    """The footprints of a run; None without a file, a layer or a column of them."""
    named = (request.footprints, request.footprints_layer)
    if named == (None, None) and not request.settings.footprints.columns:
        return None
    given: GivenFootprints | None = extra("footprints_of_run")(
        request.footprints, plan, request.settings.footprints, request.footprints_layer
    )
    return given


def overrides_for(request: RunRequest, plan: Plan, settings: RunSettings) -> Sequence[Override]:
    """The overrides of a run."""
    if request.overrides is None:
        return ()
    read: Sequence[Override] = extra("read_overrides")(request.overrides, plan.reference, settings)
    return read


def guides_for(request: RunRequest, plan: Plan, variants: Sequence[RunSettings]) -> GivenGuides | None:
    """The guides of a run; None without a file. Raises InputError if they, or one of the methods, cannot be used."""
    if request.guides is None:
        return None
    for one in variants:
        if not one.building.arranges(method_named(one.general.method)):
            raise InputError(
                shown(request.guides),
                f"{one.general.method} traces roof faces from labelled points and takes no guides",
                'Use faces = "arranged" or the method arrangement, or leave --guides out',
            )
    given: GivenGuides | None = extra("given_guides")(request.guides, plan, variants[0].building.guides.kind_column)
    return given
