"""What a scratch folder that outlives its runs holds no longer for a reason, removed before it can do harm.

A task leaves files beside its outcome. Whatever is there without the outcome that vouches for it - of a task that was
cut off, of an input that changed or is gone - goes before the stage starts; whatever is there with its outcome stays.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import FOLDER, Keeper, Place, key_of, told_of
from pipeline.runtime.stages.ingest import Ingested
from pipeline.runtime.stages.join import Joined


def drop_stale(scratch: Scratch, stage: str, wanted: Iterable[Place]) -> None:
    """Remove the outcomes of a stage that are not wanted."""
    keys: dict[str, set[str]] = {}
    for place in wanted:
        keys.setdefault(place.unit, set()).add(place.key)
    keeper = Keeper(scratch)
    for unit in keeper.units(stage):
        keeper.drop_others(stage, unit, keys.get(unit, ()))


def clear_points(scratch: Scratch, wanted: Iterable[Place]) -> None:
    """Remove buckets of points that no wanted outcome of an ingest vouches for, after those outcomes themselves."""
    wanted = list(wanted)
    drop_stale(scratch, "ingest", wanted)
    tiles_of: dict[str, set[str]] = {}
    for place in wanted:
        if scratch.has(place.name):
            found: Ingested = told_of(scratch, place)
            tiles_of[place.unit] = {tile.key for tile in found.points_by_tile}
    for bucket in Path(scratch.root, "points").glob("*/*"):
        part = bucket.name.removesuffix(".bin")
        if bucket.parent.name not in tiles_of.get(part, ()):
            bucket.unlink(missing_ok=True)


def clear_tiles(scratch: Scratch, folder: str, wanted: Iterable[Place]) -> None:
    """Remove the outcomes of splits that are not wanted, and the files of tiles that are split no more."""
    wanted = list(wanted)
    drop_stale(scratch, folder, wanted)
    tiles = {place.unit for place in wanted}
    for tile in Path(scratch.root, folder).glob("*"):
        if tile.name not in tiles:
            shutil.rmtree(tile, ignore_errors=True)


def tidy(scratch: Scratch, joined: Joined, models: Collection[str], run_dirs: Sequence[str]) -> None:
    """Remove what a finished run has no more use for: models by other settings, points of units that are no more.

    Parameters
    ----------
    scratch : Scratch
        Of the run.
    joined : Joined
        Its candidates.
    models : collection of str
        Stages of its models.
    run_dirs : sequence of str
        Where it published.
    """
    published = {publishing(run_dir) for run_dir in run_dirs}
    for stage in Path(scratch.root, FOLDER).glob("*"):
        by_others = stage.name.startswith("models-") and stage.name not in models
        if by_others or (stage.name.startswith("publish-") and stage.name not in published):
            shutil.rmtree(stage, ignore_errors=True)
    blocks = {site.block for site in joined.candidates}
    for folder in Path(scratch.root, "units").glob("*"):
        if folder.name not in blocks:
            shutil.rmtree(folder, ignore_errors=True)


def publishing(run_dir: str) -> str:
    """The stage under which is kept what was published into a run directory."""
    return f"publish-{key_of(run_dir)}"
