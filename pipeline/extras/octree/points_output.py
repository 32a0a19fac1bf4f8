"""Points: those of all tiles as 3D Tiles over the models, each tile by a task, then the coarse nodes above them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from pipeline.export.folders import POINTS_FOLDER
from pipeline.extras.classify.label import LabelTask, SitesNear, label_halo_m, neighbourhood
from pipeline.extras.octree.coarse_points import coarse_levels, write_coarse_points
from pipeline.extras.octree.coarse_terrain import terrain_spacing
from pipeline.extras.octree.point_files import INDEX
from pipeline.extras.octree.tile_points import PointsTask, TilePoints, write_tile_points
from pipeline.io import storage_at
from pipeline.runtime.run_context import ProgressUnits, RunContext
from pipeline.runtime.run_plan import window_bytes
from pipeline.runtime.scratch.outcomes import Files, Place, brief_within, drop_outcomes, key_of
from pipeline.runtime.stages.cleanup import writing_points
from pipeline.runtime.stages.ingested import Ingested, classes_in_use, points_by_tile
from pipeline.runtime.stages.reconstruct import Models
from pipeline.runtime.stages.sites import Joined
from pipeline.runtime.stages.split import Splits
from pipeline.runtime.stages.window_points import folders_of
from pipeline.settings import RunSettings
from pipeline.tiling import MM


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointsOutput:
    """What the points of a run are made of, beside its candidates and models."""

    run_dir: str
    """The run directory, a path or URL."""
    splits: Splits
    """All tiles."""
    ingested: Sequence[Ingested]
    """What the inputs held."""
    given: bool
    """Whether footprints were given."""


def write_points(
    context: RunContext, settings: RunSettings, joined: Joined, models: Models, output: PointsOutput
) -> tuple[str, ...]:
    """Write the points of all tiles, then the nodes above them, then the root; the keys of tiles that failed."""
    scratch, storage = context.scratch, storage_at(output.run_dir)
    stage = writing_points(output.run_dir)
    there: set[str] = set()
    if scratch.attempt:
        found = (key.split("/") for key in storage.keys(POINTS_FOLDER))
        there = {key[1] for key in found if len(key) == 3 and key[2] == INDEX}
    tasks = _tasks(context, settings, joined, models, output)
    tasks = {
        Place(stage, place.unit, place.key): dataclasses.replace(task, again=place.unit in there)
        for place, task in tasks.items()
    }
    # points that a user removed from the run directory are written again
    drop_outcomes(scratch, stage, [place for place in tasks if place.unit in there])
    units = ProgressUnits[TilePoints](failed=lambda one: int(bool(one.error)))
    files: Files[PointsTask, TilePoints] = Files(reads=_read, results=True)
    written = context.map_stored("octree", write_tile_points, tasks, brief_within, units, files=files)
    failed = {place: tile for place, tile in written.items() if tile.error}
    for place, tile in failed.items():
        context.progress.warn("octree", f"the points of tile {tile.tile.key} could not be written: {tile.error}")
        scratch.path(place.name).unlink(missing_ok=True)  # so that a resumed run tries it again
    good = {place: tile for place, tile in written.items() if not tile.error}
    wanted = {place.unit for place in good}
    if good:
        wanted |= write_coarse_points(context, good, sorted(output.splits.places), output.run_dir)
    for key in storage.keys(POINTS_FOLDER) if there else []:
        # the tasks of tiles have removed what they no longer have
        if key not in wanted and key.split("/")[1] not in wanted:
            storage.delete(key)
    return tuple(sorted(tile.tile.key for tile in failed.values()))


def _read(task: PointsTask) -> set[str]:
    """The folders of scratch with the points, the terrain and the models that a tile's points need."""
    label = task.label
    near = label.grid.tiles_over(neighbourhood(label.tile, label.grid, label.settings).grown(label.grid.size_mm))
    listed = (*label.buildings, *label.rejected)
    folders = {folder for one in listed for folder in (one.place.folder, *one.figures.folders)}
    return folders_of(near) | folders | {place.folder for place in task.batches}


def _tasks(
    context: RunContext, settings: RunSettings, joined: Joined, models: Models, output: PointsOutput
) -> dict[Place, PointsTask]:
    """One task per tile; their places lack the stage."""
    scratch, grid, splits = context.scratch, context.plan.grid, output.splits
    classes, _ = classes_in_use(output.ingested, trust=settings.general.classes == "trust")
    sites = SitesNear.of(joined)
    counts = points_by_tile(output.ingested)
    seen = dataclasses.replace(grid, halo_mm=math.ceil(label_halo_m(settings.scene) * MM))
    above, spacing = coarse_levels(list(splits.places)), terrain_spacing(splits.places, grid)
    tasks = {}
    for tile in sorted(splits.places):
        near = tuple(grid.tiles_over(neighbourhood(tile, grid, settings.scene)))
        owners = sorted({group.figures.owner for group in sites.groups.get(tile, ())})
        task = PointsTask(
            label=LabelTask(
                tile=tile,
                grid=grid,
                settings=settings.scene,
                classes=classes,
                given=output.given or classes.building,
                scratch=scratch,
                buildings=sites.groups_in(near),
                rejected=sites.rejected_in(near),
            ),
            run_dir=output.run_dir,
            batches=tuple(place for owner in owners for place in models.places[owner]),
            above=above,
            terrain_spacing=spacing,
            memory_bytes=window_bytes(seen, tile, counts),
        )
        label = task.label
        listed = sorted(one.figures.digest for one in (*label.buildings, *label.rejected))
        what = (label.settings, label.classes, label.given, listed)
        around = [splits.keys.get(other, "") for other in near]
        modelled = [models.contents[owner] for owner in owners]
        key = key_of(output.run_dir, tile, grid, what, modelled, above, spacing, around)
        tasks[Place("", tile.key, key)] = task
    return tasks
