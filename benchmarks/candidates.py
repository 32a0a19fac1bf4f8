"""The candidates of a tile, found in this process by the stages of a run."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from pipeline.extras.footprints.given_footprints import footprints_of_run
from pipeline.io import ReadOptions
from pipeline.model import Candidate
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.monitoring.progress import Progress, ignore
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.run_plan import make_plan
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.gather import gather
from pipeline.runtime.stages.ground_stage import find_ground
from pipeline.runtime.stages.join import join
from pipeline.runtime.stages.read_inputs import read_inputs
from pipeline.runtime.stages.sites import found_sites
from pipeline.runtime.stages.split import split
from pipeline.settings import RunSettings


def found_scene(
    tiles: Sequence[str], crs: str | None, settings: RunSettings, footprints: str | None = None
) -> tuple[Candidate, ...]:
    """The candidates of point files, largest first, with given footprints if there are any."""
    plan = make_plan(tiles, ReadOptions(crs=crs), settings)
    given = footprints_of_run(footprints, plan, settings.footprints)
    with tempfile.TemporaryDirectory(prefix="gablework-") as folder:
        scratch = Scratch(str(Path(folder, "scratch")))
        scratch.create()
        context = RunContext(plan=plan, progress=Progress(ignore), executor=SerialExecutor(), scratch=scratch)
        inputs = read_inputs(context, settings, tiles, given)
        ground = find_ground(context, settings, inputs.cells)
        splits = split(context, settings, inputs.ingested, ground, given)
        roof = settings.building.roof
        found = found_sites(join(context, settings.scene, roof, splits, given).each(scratch))
        return tuple(gather(scratch, plan.grid, site, plan.gps_kind, roof)[0] for site in found.candidates)
