"""Publish: one tile's results into the run directory, its state last."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import shapely

from pipeline.errors import RunCancelledError, RunError
from pipeline.export.facts import RecordContext, RejectedObject
from pipeline.export.putting import Put
from pipeline.io import Storage, storage_at
from pipeline.io.storage import Puts
from pipeline.model import Status
from pipeline.runtime.isolation.replay_bundle import SUFFIX
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Place, told_of
from pipeline.runtime.stages.join import RejectedSite
from pipeline.runtime.stages.reconstruct import StoredResult, stored_results
from pipeline.tiling import MM, Tile

QUARANTINE = "quarantine"
"""Folder of a run directory, and of scratch, for the bundles of buildings that cost their process."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PublishTask:
    """One tile."""

    tile: Tile
    run_dir: str
    scratch: Scratch
    batches: tuple[Place, ...]
    """Outcomes of the batches that modelled the buildings of this tile."""
    rejected: tuple[RejectedSite, ...]
    """Objects of this tile that are no buildings."""
    context: RecordContext
    meshes: str
    again: bool = False
    """Whether the tile was published there before: what it no longer has is removed."""
    empty_tables: bool = False
    """Whether to write tables without rows, where nothing at all was found: every run has tables."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Published:
    """What became of one tile."""

    tile: Tile
    n_files: int
    """How many it has; their digests are in its state."""
    error: str = ""
    """Why the tile failed; empty where it did not."""
    warning: str = ""
    """What went wrong beside it."""


def rejected_object(site: RejectedSite) -> RejectedObject:
    """The record of a rejected object; its outline is the box around its facets."""
    x0, y0, x1, y1 = site.box_mm
    origin = (x0 // MM, y0 // MM)
    outline = shapely.box(
        (x0 - origin[0] * MM) / MM, (y0 - origin[1] * MM) / MM, (x1 - origin[0] * MM) / MM, (y1 - origin[1] * MM) / MM
    )
    return RejectedObject(
        object_id=site.object_id,
        origin=(float(origin[0]), float(origin[1]), 0.0),
        reason=site.verdict.reason,
        reason_detail=site.verdict.detail,
        outline=outline,
        area_m2=site.area_m2,
        height_m=site.height_m,
        n_points=site.points,
    )


def publish(task: PublishTask) -> Published:
    """Write one tile's tables, meshes and city objects, then its state; may run twice.

    A tile that fails costs only itself: its state says so, and why. A tile that owns nothing has a state and no files.

    Raises
    ------
    RunCancelledError
        The run was called off, or is over: whoever comes so late must not touch what another run may have written.
    """
    storage = storage_at(task.run_dir)
    task.scratch.check_cancelled()
    files: dict[str, str] = {}
    error = ""
    try:
        if task.batches or task.rejected or task.empty_tables:
            with storage.several(task.scratch.check_cancelled) as puts:
                files = _write(task, _tables_last(puts))
    except RunCancelledError:
        raise
    except Exception as fault:  # noqa: BLE001 - told in the tile's state, the manifest and the exit code
        error = f"{type(fault).__name__}: {fault}"
    before = files_of(storage, task.tile) if task.again else set()
    task.scratch.check_cancelled()
    bundles, lost = _put_bundles(task, storage)
    files |= bundles
    state = {
        "tile": task.tile.key,
        "state": "failed" if error else "done",
        "error": error,
        "files": files,
    }
    task.scratch.check_cancelled()
    try:
        storage.put(f"state/{task.tile.key}.json", json.dumps(state, indent=1).encode())
    except (RunError, OSError) as fault:
        # a tile without its state is not finished, which is what the manifest will say of it
        return Published(tile=task.tile, n_files=0, error=error or f"its state: {fault}")
    for name in sorted(before - files.keys()):
        storage.delete(name)
    return Published(tile=task.tile, n_files=len(files), error=error, warning=lost)


def _tables_last(puts: Puts) -> Put:
    """Puts that are under way together, but no table before all meshes are there: rows name them."""

    def put(key: str, content: bytes) -> None:
        if not key.startswith("meshes/"):
            puts.wait()
        puts.put(key, content)

    return put


def files_of(storage: Storage, tile: Tile) -> set[str]:
    """The files that a tile's state names; none where it has no state yet."""
    key = f"state/{tile.key}.json"
    return set(json.loads(storage.get(key))["files"]) if storage.has(key) else set()


def retire(storage: Storage, tile: Tile) -> None:
    """Remove what a tile published that owns nothing any more: its files, then its state."""
    for name in sorted(files_of(storage, tile)):
        storage.delete(name)
    storage.delete(f"state/{tile.key}.json")


def _write(task: PublishTask, put: Put) -> dict[str, str]:
    """Write the files of a tile that owns something; the sha256 of each by its path."""
    from pipeline.export.tile import write_tile  # with Arrow, which who hands out the tasks does not need

    stored: list[StoredResult] = []
    for place in task.batches:
        stored.extend(stored_results(task.scratch, place))
    context = dataclasses.replace(task.context, facts={entry.result.building_id: entry.facts for entry in stored})
    files = write_tile(
        task.run_dir,
        task.tile.key,
        [entry.result for entry in stored],
        [rejected_object(site) for site in task.rejected],
        context,
        meshes=task.meshes,
        put=put,
    )
    return dict(files.digests)


def _put_bundles(task: PublishTask, storage: Storage) -> tuple[dict[str, str], str]:
    """Put the bundles of buildings that cost their process; the sha256 of each by its path, and what went wrong.

    A bundle is for whoever looks for the cause: that one is missing does not cost the tile.
    """
    bundles: dict[str, str] = {}
    lost = ""
    for place in task.batches:
        for model in told_of(task.scratch, place):
            bundle = Path(task.scratch.root, QUARANTINE, f"{model.building_id}{SUFFIX}")
            if model.status != Status.FAILED.value or not bundle.is_file():
                continue
            content = bundle.read_bytes()
            try:
                storage.put(f"{QUARANTINE}/{bundle.name}", content)
            except (RunError, OSError) as fault:
                lost = f"there is no bundle of {model.building_id}: {fault}"
                continue
            bundles[f"{QUARANTINE}/{bundle.name}"] = hashlib.sha256(content).hexdigest()
    return bundles, lost
