"""The candidates of a tile, found in this process by the stages of a run."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from pipeline.io import ReadOptions
from pipeline.model import Candidate
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.monitoring.events import ignore
from pipeline.runtime.monitoring.progress import Progress
from pipeline.runtime.plan import make_plan
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.gather import gather
from pipeline.runtime.stages.given_footprints import footprints_of_run
from pipeline.runtime.stages.ground import find_ground
from pipeline.runtime.stages.join import join
from pipeline.runtime.stages.read_inputs import read_inputs
from pipeline.runtime.stages.sites import RejectedSite, found_sites
from pipeline.runtime.stages.split import split
from pipeline.settings import RunSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class FoundScene:
    """What ingest, split and join make of point files."""

    candidates: tuple[Candidate, ...]
    """Largest first."""
    rejected: tuple[RejectedSite, ...]
    """Objects that were judged to be no building."""
    small_fragments: int
    """Surfaces below the size of an object."""
    points: int
    """Points without duplicates."""
    seconds: Mapping[str, float]
    """Wall-clock time by stage: ingest, split, join, outline."""


def found_scene(
    tiles: Sequence[str], crs: str | None, settings: RunSettings, footprints: str | None = None
) -> FoundScene:
    """The stages of point files up to the join, serially in this process, with given footprints if there are any."""
    plan = make_plan(tiles, ReadOptions(crs=crs), settings)
    given = footprints_of_run(footprints, plan, settings.footprints)
    progress = Progress(ignore)
    with tempfile.TemporaryDirectory(prefix="gablework-") as folder:
        scratch = Scratch(str(Path(folder, "scratch")))
        scratch.create()
        context = RunContext(plan=plan, progress=progress, executor=SerialExecutor(), scratch=scratch)
        inputs = read_inputs(context, settings, tiles, given)
        ingested, ground = inputs.ingested, find_ground(context, settings, inputs.cells)
        splits = split(context, settings, ingested, ground, given)
        roof = settings.building.roof
        joined = join(context, settings.scene, roof, splits, given)
        found = found_sites(joined.each(scratch))
        return FoundScene(
            candidates=tuple(gather(scratch, plan.grid, site, plan.gps_kind, roof)[0] for site in found.candidates),
            rejected=found.rejected,
            small_fragments=joined.small_fragments,
            points=sum(found.points for found in splits.figures),
            seconds=progress.timings,
        )


def candidates_of(tiles: Sequence[str], crs: str | None, settings: RunSettings) -> Iterator[Candidate]:
    """The candidates of point files, as a run finds them, largest first."""
    yield from found_scene(tiles, crs, settings).candidates
