"""Reconstruct: all candidates are modelled, in batches of some seconds each."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.model import Status
from pipeline.registry import extra
from pipeline.runtime.monitoring.logs import LOG
from pipeline.runtime.monitoring.measurement import TALLIES, Part, slow_building_s
from pipeline.runtime.run_context import ProgressUnits, RunContext
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Files, Place, drop_outcomes, key_of, keys_of, result_of
from pipeline.runtime.stages.batch_figures import LOST, BatchFigures, Counted, Modelled
from pipeline.runtime.stages.model_batch import Batch, BatchTask, StoredResult, figures_of, models_here, stored_results
from pipeline.runtime.stages.sites import Joined, folders_around
from pipeline.settings import RunSettings
from pipeline.tiling import Tile

if TYPE_CHECKING:
    from pipeline.extras.guides.given_guides import GivenGuides
    from pipeline.extras.overrides.overrides_file import Override, OwnModelling

QUARANTINE = "quarantine"
"""Folder of a run directory, and of scratch, for the bundles of buildings that ended their process."""
_DIGEST_BITS = 160


@dataclasses.dataclass(frozen=True, kw_only=True)
class Models:
    """All candidates, modelled."""

    places: Mapping[Tile, Sequence[Place]]
    """Where the outcomes of the batches are stored, by owner tile."""
    scratch: Scratch
    """The run's scratch."""
    contents: Mapping[Tile, str]
    """Digest of all that is published of each tile's models, whichever batches they came in."""
    counted: Counted
    """The counts of all models."""

    def each(self) -> Iterator[Modelled]:
        """The figures of each building, tile after tile, read one batch at a time."""
        for places in self.places.values():
            for place in places:
                batch: Batch = result_of(self.scratch, place)
                yield from batch.modelled

    def stored(self) -> Iterator[tuple[Tile, list[StoredResult]]]:
        """The models themselves, one owner tile at a time."""
        for tile, places in self.places.items():
            yield tile, [entry for place in places for entry in stored_results(self.scratch, place)]


def models_stage(settings: RunSettings) -> str:
    """The stage under which models by these settings are stored."""
    return stage_of_models(settings.settings_hash)


def stage_of_models(settings_hash: str) -> str:
    """The stage under which models by settings with this hash are stored."""
    return f"models-{settings_hash[:16]}"


def reconstruct(
    context: RunContext,
    settings: RunSettings,
    joined: Joined,
    guides: GivenGuides | None = None,
    *,
    compared: bool = False,
) -> Models:
    """Model all candidates, the batches of most points first; seconds may be compared with those of other methods."""
    scratch, plan = context.scratch, context.plan
    stage, method = models_stage(settings), settings.general.method
    limits, gps_kind = context.isolation, plan.gps_kind
    alike = key_of(method, settings.building, gps_kind, limits, plan.grid)
    tasks: dict[Place, BatchTask] = {}
    places: dict[Tile, list[Place]] = {}
    earlier: dict[Tile, tuple[Place, ...]] = {}
    for group in joined.groups:
        owner, figures = group.figures.owner, group.figures
        if owner not in earlier:
            earlier[owner] = tuple(Place(stage, owner.key, key) for key in keys_of(scratch, stage, owner.key))
        own = _own(figures.overridden, settings)
        near = () if guides is None else guides.near(figures.tiles, plan.grid)
        key = key_of(alike, figures.digest, joined.around(figures.tiles), own, *near)
        place = Place(stage, owner.key, key)
        places.setdefault(owner, []).append(place)
        tasks[place] = BatchTask(
            group=group,
            method=method,
            settings=settings.building,
            grid=plan.grid,
            scratch=scratch,
            gps_kind=gps_kind,
            isolation=limits,
            quarantine=str(Path(scratch.root, QUARANTINE)),
            reference=plan.reference,
            own=own,
            guides=near,
            earlier=earlier[owner],
            compared=compared,
            slow_s=slow_building_s(),
        )
    largest_first = sorted(tasks.items(), key=lambda item: -item[1].group.figures.points)

    made = 0

    def tell(batch: BatchFigures) -> None:
        nonlocal made
        made += batch.count - batch.reused
        for model in batch.notable:
            _tell(context, model)

    units = ProgressUnits[BatchFigures](
        total=joined.candidates,
        done=operator.attrgetter("count"),
        failed=operator.attrgetter("failed"),
        parts=lambda batch: _traced(batch.notable),
    )
    files: Files[BatchTask, BatchFigures] = Files(
        reads=lambda task: folders_around(task.group, task.grid),
        leaves=lambda task, _: [Place(stage, task.group.figures.owner.key, "").folder],
        intact=_is_intact,
    )
    found = context.map_stored("reconstruct", model_batch, dict(largest_first), figures_of, units, tell, files)
    contents: dict[Tile, str] = {}
    for tile, made_in in sorted(places.items()):
        # a sum, so that it does not matter which batches they came in
        content = sum(found[place].content for place in made_in) % 2**_DIGEST_BITS
        contents[tile] = key_of(content, sum(found[place].count for place in made_in))
    # only now: models whose input did not change are taken from the earlier batches
    drop_outcomes(scratch, stage, tasks)
    counted = Counted.of(found.values(), made)
    return Models(places=dict(sorted(places.items())), scratch=scratch, contents=contents, counted=counted)


def _is_intact(task: BatchTask, figures: BatchFigures, _: str) -> bool:
    """Whether the bundles that a batch left in the quarantine are whole."""
    from pipeline.runtime.stages.lost_buildings import bundles_are_whole

    return bundles_are_whole(task.quarantine, figures)


def _own(overridden: Sequence[tuple[str, Override]], settings: RunSettings) -> dict[str, OwnModelling]:
    """Method and settings of the buildings that have their own, by building_id."""
    if not overridden:
        return {}
    return {building_id: extra("own_modelling")(override, settings) for building_id, override in overridden}


def _tell(context: RunContext, model: Modelled) -> None:
    """Tell logs of a building that failed, or whose process ended before it was modelled in another one."""
    facts = {"building": model.building_id, "tile": model.owner.key}
    if model.retried:
        context.progress.detail("reconstruct", f"modelled again in a fresh process: {model.retried}", **facts)
    if model.status == Status.FAILED.value:
        reason = model.reason or ""
        message = f"failed: {reason}" + (f": {model.detail}" if model.detail else "")
        context.progress.detail("reconstruct", message, reason=reason, seconds=round(model.seconds, 3), **facts)


def _traced(models: Sequence[Modelled]) -> Iterator[Part]:
    """The buildings of a batch that get a span: slow ones, and those that ended their process or met a fault of ours.

    A city has a million buildings, and most take milliseconds.
    """
    for model in models:
        is_lost = model.reason in LOST
        if not model.reused and (is_lost or model.seconds >= slow_building_s()):
            facts = {"building_id": model.building_id, "status": model.status, "reason": model.reason}
            yield Part(
                name="building",
                began_s=model.ended_s - model.seconds,
                ended_s=model.ended_s,
                error=model.reason if is_lost else None,
                facts=facts | {"points": model.points, "faces": model.faces},
            )


def model_batch(task: BatchTask) -> Batch:
    """Model a batch; raises OSError if scratch cannot be read or written, RunError if children cannot be started."""
    try:
        sites = task.group.sites(task.scratch)
        if task.isolation is None:
            packed = dict(models_here(task, sites))
        else:
            from pipeline.runtime.stages.child_batch import models_in_child

            packed = dict(models_in_child(task, sites, task.isolation))
    except OSError:
        task.scratch.check_cancelled()  # the scratch of a run that is over is gone
        raise
    each = [packed[index] for index in range(len(sites))]
    for model in each:
        building = model.modelled
        TALLIES.building(building.status, building.reason)
        if building.reason in LOST:
            facts = {"building": building.building_id, "tile": building.owner.key, "reason": building.reason}
            LOG.warning("a building is lost", extra={**facts, "seconds": round(building.seconds, 3)})
    return Batch(
        modelled=tuple(model.modelled for model in each),
        stored={model.modelled.building_id: (model.made_from, model.stored) for model in each},
        compared=task.compared,
        slow_s=task.slow_s,
    )
