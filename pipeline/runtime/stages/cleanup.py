"""Removal of outdated files from a scratch folder that outlives its runs.

A task leaves files beside its outcome. Before a stage starts, such files are removed where they have no wanted outcome:
those of interrupted tasks, and of inputs that changed or are gone. Files with a wanted outcome stay.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import FOLDER, DamagedError, Place, brief_of, drop_outcomes, key_of
from pipeline.runtime.stages.ingested import Ingested
from pipeline.runtime.stages.sites import UNITS

OVERRIDDEN = "overridden"
"""The stage under which sites are stored after overrides."""
REDRAWN = "redrawn-"
"""How the folders of scratch begin with the points in other footprints of some buildings."""


def clear_points(scratch: Scratch, wanted: Iterable[Place]) -> None:
    """Remove the outcomes of ingest that are not wanted, then the buckets of points without an outcome."""
    wanted = list(wanted)
    drop_outcomes(scratch, "ingest", wanted)
    tiles_of: dict[str, set[str]] = {}
    for place in wanted:
        if scratch.has(place.name):
            try:
                found: Ingested = brief_of(scratch, place)
            except DamagedError:
                continue  # its file is read again
            tiles_of[place.unit] = {tile.key for tile in found.points_by_tile}
    for bucket in Path(scratch.root, "points").glob("*/*"):
        part = bucket.name.removesuffix(".bin")
        if bucket.parent.name not in tiles_of.get(part, ()):
            bucket.unlink(missing_ok=True)


def clear_tiles(scratch: Scratch, folder: str, wanted: Iterable[Place], keys: Collection[str] | None = None) -> None:
    """Remove the outcomes of a stage that are not wanted, and the files of tiles that it no longer has.

    `keys` are those of its tiles; by default its tasks are by tile.
    """
    wanted = list(wanted)
    drop_outcomes(scratch, folder, wanted)
    tiles = {place.unit for place in wanted} if keys is None else keys
    for tile in Path(scratch.root, folder).glob("*"):
        if tile.name not in tiles:
            shutil.rmtree(tile, ignore_errors=True)


def clear_units(scratch: Scratch, wanted: Collection[str]) -> None:
    """Remove the points of units except those in some folders of scratch."""
    for tile in Path(scratch.root, UNITS).glob("*"):
        for folder in tile.glob("*"):
            if f"{UNITS}/{tile.name}/{folder.name}" not in wanted:
                shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # one that is not empty
            tile.rmdir()


def tidy(scratch: Scratch, models: Collection[str], run_dirs: Sequence[str], *, overridden: bool) -> None:
    """Remove what a finished run no longer needs: models by other settings, sites after overrides that are gone.

    `models` are the stages under which its models are stored, `run_dirs` where it published.
    """
    written = (publishing, writing_points, writing_terrain)
    published = {stage_of(run_dir) for run_dir in run_dirs for stage_of in written}
    for stage in Path(scratch.root, FOLDER).glob("*"):
        by_others = stage.name.startswith("models-") and stage.name not in models
        if by_others or (stage.name.startswith(("publish-", "points-", "terrain-")) and stage.name not in published):
            shutil.rmtree(stage, ignore_errors=True)
    if not overridden:
        for pattern in (OVERRIDDEN, f"{REDRAWN}*"):
            for folder in (*Path(scratch.root).glob(pattern), *Path(scratch.root, FOLDER).glob(pattern)):
                shutil.rmtree(folder, ignore_errors=True)


def publishing(run_dir: str) -> str:
    """The stage under which the outcomes of publishing into a run directory are stored."""
    return f"publish-{key_of(run_dir)}"


def writing_points(run_dir: str) -> str:
    """The stage under which the outcomes of the points of a run directory are stored."""
    return f"points-{key_of(run_dir)}"


def writing_terrain(run_dir: str) -> str:
    """The stage under which the outcomes of the terrain of a run directory are stored."""
    return f"terrain-{key_of(run_dir)}"
