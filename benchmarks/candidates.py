"""The candidates of a tile, found in this process by the stages of a run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from pipeline.io import ReadOptions
from pipeline.io.gps_time import GpsTimeKind
from pipeline.model import Candidate
from pipeline.runtime.events import ignore
from pipeline.runtime.gather import gather
from pipeline.runtime.plan import make_plan
from pipeline.runtime.scratch import Scratch
from pipeline.runtime.serial import SerialExecutor
from pipeline.runtime.stages import Progress, Stages
from pipeline.settings import RunSettings


def candidates_of(tiles: Sequence[str], crs: str | None, settings: RunSettings) -> Iterator[Candidate]:
    """The candidates of point files, as a run finds them, largest first."""
    plan = make_plan(tiles, ReadOptions(crs=crs), settings)
    kinds = {info.gps_time_kind for info in plan.sources}
    kind = kinds.pop() if len(kinds) == 1 else GpsTimeKind.NONE
    with tempfile.TemporaryDirectory(prefix="gablework-") as folder:
        scratch = Scratch(str(Path(folder, "scratch")))
        scratch.create()
        stages = Stages(
            settings=settings,
            meshes="none",
            plan=plan,
            progress=Progress(ignore),
            executor=SerialExecutor(),
            scratch=scratch,
        )
        splits = stages.split(stages.ingest(tiles), None)
        for site in stages.join(splits, None, plan.sources[0].reference).candidates:
            yield gather(scratch, plan.grid, site, kind)[0]
