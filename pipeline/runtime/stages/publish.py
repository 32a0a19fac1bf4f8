"""Publish: one tile's results into the run directory, its state last."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import shapely

from pipeline import __version__
from pipeline.errors import RunCancelledError, RunError
from pipeline.export.facts import RecordContext, RejectedObject
from pipeline.export.folders import Put
from pipeline.io import LocalStorage, Storage, is_url, storage_at
from pipeline.io.storage import Puts, sha256_of
from pipeline.model import BuildingResult, Reason, Status
from pipeline.quality.detection import confidence_of_rejected
from pipeline.runtime.isolation.process_limits import BUNDLE_SUFFIX
from pipeline.runtime.run_context import ProgressUnits, RunContext
from pipeline.runtime.run_plan import Plan
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Files, InParts, Place, brief_of, brief_within, drop_outcomes, key_of
from pipeline.runtime.stages.batch_figures import BatchFigures
from pipeline.runtime.stages.cleanup import publishing
from pipeline.runtime.stages.content_digest import TABLES
from pipeline.runtime.stages.model_batch import StoredResult, stored_results
from pipeline.runtime.stages.reconstruct import QUARANTINE, Models
from pipeline.runtime.stages.sites import Joined, RejectedSite, StoredRejected
from pipeline.runtime.stages.split import Splits
from pipeline.settings import RunSettings
from pipeline.tiling import MM, Tile

if TYPE_CHECKING:  # these load Arrow, which the driver does not need
    from pipeline.export.tile import TileFiles
    from pipeline.runtime.digest import Rows


@dataclasses.dataclass(frozen=True, kw_only=True)
class PublishTask:
    """One tile."""

    tile: Tile
    run_dir: str
    scratch: Scratch
    batches: tuple[Place, ...]
    """Outcomes of the batches that modelled the buildings of this tile."""
    rejected: tuple[StoredRejected, ...]
    """Objects of this tile that are not buildings, in scratch."""
    context: RecordContext
    meshes: str
    again: bool = False
    """Whether the tile was published there before: files that it no longer has are removed."""
    empty_tables: bool = False
    """Whether to write tables without rows because the run found nothing: every run has tables."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Published:
    """The outcome of one tile."""

    tile: Tile
    n_files: int
    """Number of its files; their digests are in its state."""
    state: str = ""
    """sha256 of its state; empty where it could not be written."""
    has_tables: bool = False
    """Whether tables are among them."""
    error: str = ""
    """Why the tile failed; empty where it did not."""
    warning: str = ""
    """A fault that did not fail the tile."""


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
        confidence=confidence_of_rejected(site.verdict.reason, site.planar, site.rough),
    )


def buildings_and_rejected(stored: Sequence[StoredResult]) -> tuple[list[BuildingResult], list[RejectedObject]]:
    """The buildings among some results, and the objects that have too few points to be shown as one."""
    buildings = [entry.result for entry in stored if not entry.is_rejected]
    return buildings, [_unmodelled(entry.result) for entry in stored if entry.is_rejected]


def _unmodelled(result: BuildingResult) -> RejectedObject:
    """The record of an object with too few points for a model."""
    outline = result.footprint
    return RejectedObject(
        object_id=result.building_id,
        origin=result.origin,
        reason=Reason.TOO_FEW_POINTS,
        reason_detail=result.reason_detail,
        outline=None if outline is None else shapely.box(*outline.bounds),
        area_m2=math.nan if outline is None else outline.area,
        height_m=math.nan,
        n_points=result.n_points,
    )


def record_context(plan: Plan, settings: RunSettings) -> RecordContext:
    """The facts of a run that go into its records."""
    times = [(i.acquired_from, i.acquired_to) for i in plan.sources]
    known = [(a, b) for a, b in times if a is not None and b is not None]
    return RecordContext(
        reference=plan.reference,
        settings_hash=settings.settings_hash,
        engine_version=__version__,
        acquired_from=min((a for a, _ in known), default=None),
        acquired_to=max((b for _, b in known), default=None),
        further_lods=settings.building.further_lods,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOutput:
    """Where the results of a run go, and in which form."""

    run_dir: str
    """The run directory, a path or URL."""
    meshes: str
    """One OBJ per building, one per tile, or none."""


def publish(
    context: RunContext, settings: RunSettings, splits: Splits, joined: Joined, models: Models, output: RunOutput
) -> dict[Place, Published]:
    """Write every tile; the outcomes in their order."""
    scratch, run_dir = context.scratch, output.run_dir
    rejected: dict[Tile, list[StoredRejected]] = {}
    for listed in joined.rejected:
        rejected.setdefault(listed.figures.owner, []).append(listed)
    owners = sorted({*models.places, *rejected, *splits.places})
    records = record_context(context.plan, settings)
    stage, storage = publishing(run_dir), storage_at(run_dir)
    # scratch that ends with its run begins with an empty run directory, which need not be listed
    there = {PurePosixPath(name).stem for name in storage.keys("state")} if scratch.attempt else set()
    tasks = {}
    for tile in owners:
        task = PublishTask(
            tile=tile,
            run_dir=run_dir,
            scratch=scratch,
            batches=tuple(models.places.get(tile, ())),
            rejected=tuple(rejected.get(tile, ())),
            context=records,
            meshes=output.meshes,
            again=tile.key in there,
            empty_tables=not models.places and not rejected and tile == owners[0],
        )
        models_of_tile = models.contents.get(tile, "")
        rejected_there = sorted(listed.figures.digest for listed in task.rejected)
        key = key_of(run_dir, models_of_tile, rejected_there, records, task.meshes, task.empty_tables)
        tasks[Place(stage, tile.key, key)] = task
    # tiles that a user removed from the run directory are published again
    drop_outcomes(scratch, stage, [place for place in tasks if place.unit in there])
    units = ProgressUnits[Published](failed=lambda found: int(bool(found.error)))
    files: Files[PublishTask, Published] = Files(
        reads=_read,
        intact=is_published,
        at_once=True,
    )
    published = context.map_stored("publish", publish_tile, tasks, brief_within, units, files=files)
    for tile_key in sorted(there - {tile.key for tile in owners}):
        retire(storage, Tile.from_key(tile_key))
    for place, outcome in published.items():
        if outcome.warning:
            context.progress.warn("publish", outcome.warning)
        if outcome.error:
            context.progress.warn("publish", f"tile {outcome.tile.key} failed: {outcome.error}")
            Path(scratch.root, place.name).unlink(missing_ok=True)  # so that a resumed run tries it again
    return published


def _read(task: PublishTask) -> set[str]:
    """The folders of scratch with the models and the rejected objects of a tile."""
    return {place.folder for place in (*task.batches, *(listed.place for listed in task.rejected))}


def is_published(task: PublishTask, published: Published, _: str) -> bool:
    """Whether the state of a tile is the one that was written, and its files are those that the state names.

    Stores keep checksums of their objects themselves, so there the state is enough.
    """
    state = storage_at(task.run_dir).get(f"state/{task.tile.key}.json")
    if hashlib.sha256(state).hexdigest() != published.state:
        return False  # a rerun wrote other files
    if is_url(task.run_dir):
        return True
    storage = LocalStorage(root=Path(task.run_dir))
    return all(sha256_of(storage.path(name)) == digest for name, digest in json.loads(state)["files"].items())


def publish_tile(task: PublishTask) -> InParts[Published]:
    """Write one tile's tables, meshes and city objects, then its state; may run twice.

    Its parts are the rows of the tables, in the order of `TABLES`, for the run's digest.

    A tile that fails harms only itself: its state says so, and why. A tile that owns nothing has a state and no files.
    """
    storage = storage_at(task.run_dir)
    task.scratch.check_cancelled()
    files: dict[str, str] = {}
    rows: tuple[Rows, ...] = ()
    error = ""
    try:
        if task.batches or task.rejected or task.empty_tables:
            with storage.several(task.scratch.check_cancelled) as puts:
                written = _write(task, _meshes_first(puts))
            files, rows = dict(written.digests), _rows(written.tables)
    except RunCancelledError:
        raise
    except Exception as fault:  # noqa: BLE001 - goes into the tile's state, the manifest and the exit code
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
        stated = json.dumps(state, indent=1).encode()
        storage.put(f"state/{task.tile.key}.json", stated)
    except (RunError, OSError) as fault:
        # a tile without its state is not finished, and the manifest will say so
        return InParts(parts=(), brief=Published(tile=task.tile, n_files=0, error=error or f"its state: {fault}"))
    for name in sorted(before - files.keys()):
        storage.delete(name)
    brief = Published(
        tile=task.tile,
        n_files=len(files),
        state=hashlib.sha256(stated).hexdigest(),
        has_tables=bool(rows),
        error=error,
        warning=lost,
    )
    return InParts(parts=rows, brief=brief)


def _rows(tables: Mapping[str, Any]) -> tuple[Rows, ...]:
    """The rows of a tile's tables as the run's digest counts them."""
    from pipeline.runtime.digest import rows_of  # loads Arrow, which the driver does not need

    return tuple(rows_of(tables[name], name) for name in TABLES)


def _meshes_first(puts: Puts) -> Put:
    """Concurrent puts, except that all else waits for the meshes, which the rows of tables name."""
    waits = False

    def put(key: str, content: bytes) -> None:
        nonlocal waits
        is_mesh = key.startswith("meshes/")
        if waits and not is_mesh:
            puts.wait()
        waits = is_mesh
        puts.put(key, content)

    return put


def files_of(storage: Storage, tile: Tile) -> set[str]:
    """The files that a tile's state names; none where it has no state yet, or a damaged one."""
    key = f"state/{tile.key}.json"
    try:
        return set(json.loads(storage.get(key))["files"]) if storage.has(key) else set()
    except ValueError:
        return set()


def retire(storage: Storage, tile: Tile) -> None:
    """Remove the files of a tile that no longer owns anything, then its state."""
    for name in sorted(files_of(storage, tile)):
        storage.delete(name)
    storage.delete(f"state/{tile.key}.json")


def _write(task: PublishTask, put: Put) -> TileFiles:
    """Write the files of a tile that owns something."""
    from pipeline.export.tile import write_tile  # loads Arrow, which the driver does not need

    stored: list[StoredResult] = []
    for place in task.batches:
        stored.extend(stored_results(task.scratch, place))
    context = dataclasses.replace(task.context, facts={entry.result.building_id: entry.facts for entry in stored})
    buildings, unmodelled = buildings_and_rejected(stored)
    rejected = sorted(
        (site for listed in task.rejected for site in listed.sites(task.scratch)), key=lambda site: site.object_id
    )
    return write_tile(
        task.run_dir,
        task.tile.key,
        buildings,
        [*(rejected_object(site) for site in rejected), *unmodelled],
        context,
        meshes=task.meshes,
        put=put,
    )


def _put_bundles(task: PublishTask, storage: Storage) -> tuple[dict[str, str], str]:
    """Put the bundles of buildings that ended their process; the sha256 of each by its path, and what went wrong.

    A bundle helps to find a cause. A missing one does not fail the tile.
    """
    bundles: dict[str, str] = {}
    lost = ""
    for place in task.batches:
        figures: BatchFigures = brief_of(task.scratch, place)
        for model in figures.notable:
            bundle = Path(task.scratch.root, QUARANTINE, f"{model.building_id}{BUNDLE_SUFFIX}")
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
