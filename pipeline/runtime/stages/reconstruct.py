"""Reconstruct: all candidates are modelled, in batches of some seconds each."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from pipeline.model import Status
from pipeline.runtime.monitoring.tracing import Part, slow_building_s
from pipeline.runtime.overrides.overrides_file import own_modelling
from pipeline.runtime.run_context import ProgressUnits, RunContext
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.kept_files import Files
from pipeline.runtime.scratch.outcomes import FOLDER, Place, brief_of, drop_outcomes, key_of, keys_of
from pipeline.runtime.stages.model_batch import (
    LOST,
    Batch,
    BatchTask,
    Modelled,
    StoredResult,
    bundles_are_whole,
    model_batch,
    stored_results,
)
from pipeline.runtime.stages.sites import CandidateSite, Joined, by_owner, folders_around
from pipeline.settings import RunSettings
from pipeline.tiling import Tile

QUARANTINE = "quarantine"
"""Folder of a run directory, and of scratch, for the bundles of buildings that ended their process."""
_POINTS_PER_BATCH = 20_000
_MAX_PER_BATCH = 64


@dataclasses.dataclass(frozen=True, kw_only=True)
class Models:
    """All candidates, modelled."""

    places: Mapping[Tile, Sequence[Place]]
    """Where the outcomes of the batches are stored, by owner tile."""
    scratch: Scratch
    """The run's scratch."""
    contents: Mapping[Tile, str]
    """Digest of all that is published of each tile's models, whichever batches they came in."""
    made: int
    """Number of models made now; the others were taken from earlier runs, since none of their input changed."""

    def each(self) -> Iterator[Modelled]:
        """The figures of each building, tile after tile, read one batch at a time."""
        for places in self.places.values():
            for place in places:
                yield from brief_of(self.scratch, place)

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


def reconstruct(context: RunContext, settings: RunSettings, joined: Joined, *, compared: bool = False) -> Models:
    """Model all candidates, the batches of most points first; seconds may be compared with those of other methods."""
    scratch, plan = context.scratch, context.plan
    stage, method = models_stage(settings), settings.general.method
    limits = context.isolation
    alike = key_of(method, settings.building, plan.gps_kind, limits, plan.grid)
    tasks: dict[Place, BatchTask] = {}
    places: dict[Tile, list[Place]] = {}
    for tile, candidates in sorted(by_owner(joined.candidates).items()):
        earlier = tuple(Place(stage, tile.key, key) for key in keys_of(scratch, stage, tile.key))
        for sites in batches(candidates):
            own = {
                site.building_id: own_modelling(site.override, settings)
                for site in sites
                if site.override is not None and site.override.remodels
            }
            place = Place(stage, tile.key, key_of(alike, sites, joined.around(sites, plan.grid), own))
            places.setdefault(tile, []).append(place)
            tasks[place] = BatchTask(
                sites=sites,
                method=method,
                settings=settings.building,
                grid=plan.grid,
                scratch=scratch,
                gps_kind=plan.gps_kind,
                isolation=limits,
                quarantine=str(Path(scratch.root, QUARANTINE)),
                reference=plan.reference,
                own=own,
                earlier=earlier,
                compared=compared,
            )
    largest_first = sorted(tasks.items(), key=lambda item: -sum(site.points for site in item[1].sites))
    made = 0

    def count(models: Sequence[Modelled]) -> None:
        nonlocal made
        made += sum(not model.reused for model in models)
        for model in models:
            _tell(context, model)

    brief: Callable[[Batch], tuple[Modelled, ...]] = operator.attrgetter("modelled")
    units = ProgressUnits[tuple[Modelled, ...]](
        total=len(joined.candidates), done=len, failed=_failed_of, parts=_traced
    )
    files: Files[BatchTask, tuple[Modelled, ...]] = Files(
        reads=lambda task: folders_around(task.sites, task.grid),
        leaves=lambda task, _: [f"{FOLDER}/{stage}/{task.sites[0].owner.key}"],
        intact=bundles_are_whole,
    )
    briefs = context.map_stored("reconstruct", model_batch, dict(largest_first), brief, units, count, files)
    contents = {
        tile: key_of(sorted(model.content for place in made_in for model in briefs[place]))
        for tile, made_in in places.items()
    }
    # only now: models whose input did not change are taken from the earlier batches
    drop_outcomes(scratch, stage, tasks)
    return Models(places=places, scratch=scratch, contents=contents, made=made)


def _tell(context: RunContext, model: Modelled) -> None:
    """Tell logs of a building that failed, or whose process ended before it was modelled in another one."""
    facts = {"building": model.building_id, "tile": model.owner.key}
    if model.retried:
        context.progress.detail("reconstruct", f"modelled again in a fresh process: {model.retried}", **facts)
    if model.status == Status.FAILED.value:
        reason = model.reason or ""
        message = f"failed: {reason}" + (f": {model.detail}" if model.detail else "")
        context.progress.detail("reconstruct", message, reason=reason, seconds=round(model.seconds, 3), **facts)


def _failed_of(models: Sequence[Modelled]) -> int:
    """Number of failed buildings of a batch."""
    return sum(model.status == Status.FAILED.value for model in models)


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


def batches(sites: Sequence[CandidateSite]) -> list[tuple[CandidateSite, ...]]:
    """Group the candidates of a tile, which come largest first, to batches of some seconds each.

    >>> from pipeline.runtime.stages.sites import CandidateSite
    >>> site = lambda n: CandidateSite(building_id=str(n), owner=Tile(0, 0), ranges=(), points=n)
    >>> [len(b) for b in batches([site(30_000), site(14_000), site(5_000), site(4_000), site(10)])]
    [1, 2, 2]
    """
    groups: list[tuple[CandidateSite, ...]] = []
    current: list[CandidateSite] = []
    points = 0
    for site in sites:
        if current and (points + site.points > _POINTS_PER_BATCH or len(current) == _MAX_PER_BATCH):
            groups.append(tuple(current))
            current, points = [], 0
        current.append(site)
        points += site.points
    if current:
        groups.append(tuple(current))
    return groups
