"""Rerun: single buildings of a finished run again, after other overrides or on request; all others stay untouched.

The inputs are read again and only the tiles around these buildings are split. What is found there is held against the
records of the run: where a building is not the one that the run had, all tiles are split. All files are written, tile
by tile, beside the run before the first of its own is touched; then each is renamed into its place.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import heapq
import itertools
import json
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from uuid import uuid4

import shapely

from pipeline.errors import RunError
from pipeline.export.tile_update import updated_tile
from pipeline.io import LocalStorage
from pipeline.model import Reason
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.cluster.tls import TlsFiles
from pipeline.runtime.digest import run_digest
from pipeline.runtime.earlier import (
    REJECTED,
    Earlier,
    Record,
    check_outlines,
    check_points,
    earlier_run,
    request_of,
)
from pipeline.runtime.engine import executor_for
from pipeline.runtime.expected import expected
from pipeline.runtime.isolation.isolated_items import IsolationLimits
from pipeline.runtime.isolation.preloading import loads_of
from pipeline.runtime.isolation.replay_bundle import SUFFIX
from pipeline.runtime.manifest import PAGE, SLOWEST, RunManifest, RunStatus, SlowBuilding, write_manifest
from pipeline.runtime.monitoring.events import Listener, Watch, ignore, never
from pipeline.runtime.overrides.overrides_file import Override, read_overrides
from pipeline.runtime.plan import check_memory
from pipeline.runtime.run import (
    OVERRIDES,
    RunRequest,
    calling_off,
    plan_inputs,
    put_json,
    told_file,
    told_request,
)
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.folder_lock import held_results
from pipeline.runtime.scratch.location import SCRATCH, remove_folder
from pipeline.runtime.stages.apply_overrides import WARNING, EntryOutcome
from pipeline.runtime.stages.gather import gather
from pipeline.runtime.stages.ingest import Ingested
from pipeline.runtime.stages.join import CandidateSite, Joined, RejectedSite
from pipeline.runtime.stages.progress import Progress
from pipeline.runtime.stages.publish import QUARANTINE, rejected_object
from pipeline.runtime.stages.reconstruct import Modelled, StoredResult
from pipeline.runtime.stages.stages import GivenFootprints, Models, Splits, Stages, given_footprints, points_by_tile
from pipeline.tiling import MM, Tile

AROUND_M = 30.0
"""Tiles that come nearer than this to a building are split: it sees terrain up to 15 m away."""
_NEW = "new"
"""In scratch, the files that will take the place of the run's."""
_QUARANTINED = (Reason.INTERNAL_ERROR, Reason.CRASHED, Reason.TIMED_OUT, Reason.OUT_OF_MEMORY)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RerunRequest:
    """What is to be done again."""

    run_dir: str
    """The directory of a finished run."""
    overrides: str | None = None
    """The overrides file that takes the place of the run's own; None keeps that."""
    only: tuple[str, ...] = ()
    """Buildings, by building_id, that are modelled again whatever the overrides say."""
    workers: int | None = None
    """Processes of the embedded cluster; 0 runs serially in this process, None leaves it to the estimate."""
    scheduler: str | None = None
    """Address of a Dask scheduler that takes the place of the embedded cluster."""
    tls: TlsFiles | None = None
    """Certificates for the cluster's traffic; by default those of the environment."""
    isolation: IsolationLimits | None = None
    """Limits of the supervised children that model buildings; None models them in the workers themselves."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RerunSummary:
    """What came out."""

    run_dir: str
    """The directory."""
    digest: str
    """sha256 of the content, as of a whole run with these overrides."""
    buildings: dict[str, str]
    """Status by id of the buildings that were made again; `rejected` of those that are none now."""
    tiles: tuple[str, ...]
    """Tiles whose files were written anew."""
    tiles_split: int
    """Tiles that were split for it."""
    warnings: tuple[str, ...]
    """What was odd but usable."""
    seconds: float
    """Wall-clock time."""


def rerun(
    request: RerunRequest,
    on_event: Listener = ignore,
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
) -> RerunSummary:
    """Model again the buildings whose overrides changed, and those that are named.

    Parameters
    ----------
    request : RerunRequest
        What is to be done.
    on_event : callable
        Gets an `Event` for every stage, step and warning.
    executor : Executor, optional
        Where tasks run; by default what the request asks for.
    cancelled : callable
        Asked several times a second, from another thread; once it is true the rerun ends as soon as it can.

    Returns
    -------
    RerunSummary
        What was made again; the digest is that of a whole run with these overrides.

    Raises
    ------
    RunError
        The directory holds no finished run of this version, its inputs changed, an id is none of its buildings, or
        another run writes it.
    SettingsError
        The overrides hold faults.
    InputError
        An input cannot be read any more.
    RunCancelledError
        `cancelled` called it off; the run directory is as it was.
    """
    with held_results(str(earlier_run(request.run_dir).run_dir)):
        # as it is now that nobody else writes it
        return _rerun(request, earlier_run(request.run_dir), on_event, executor, cancelled)


def _rerun(
    request: RerunRequest,
    earlier: Earlier,
    on_event: Listener,
    executor: Executor | None,
    cancelled: Callable[[], bool],
) -> RerunSummary:
    began = time.perf_counter()
    progress = Progress(on_event)
    progress.tell("run", "plan", f"rerun in {request.run_dir}")
    wanted = dataclasses.replace(request_of(earlier.manifest), overrides=_overrides_file(request, earlier))
    known = earlier.records(request.only)
    unknown = [name for name in request.only if name not in known or known[name].status == REJECTED]
    if unknown:
        raise RunError(f"{', '.join(unknown)}: no building of {earlier.run_dir}. Give ids of its buildings table")
    plan, paths = plan_inputs(wanted, wanted.settings, progress)
    footprints = None if wanted.footprints is None else given_footprints(wanted.footprints, plan)
    reference = plan.sources[0].reference
    overrides = () if wanted.overrides is None else read_overrides(wanted.overrides, reference, wanted.settings)
    check_outlines(earlier.manifest, wanted)
    scratch_dir = earlier.run_dir / SCRATCH
    remove_folder(scratch_dir)
    scratch = Scratch(str(scratch_dir / uuid4().hex))
    engine = executor or executor_for(
        workers=request.workers,
        scheduler=request.scheduler,
        local_directory=str(scratch_dir / "dask"),
        # a few tiles are split for it; they are not known yet, and all inputs are read
        work=dataclasses.replace(expected(plan, 0), seen_points=0.0),
        tls=request.tls,
        loads=loads_of("reconstruct", footprints=False, method=wanted.settings.general.method),
    )
    scratch.create()
    try:
        with calling_off(scratch, cancelled) as called_off, engine:
            progress.watch = Watch(cancelled=called_off, stop=scratch.cancel, listener=on_event)
            engine.prepare("plan", progress.watch)
            check_memory(plan, engine.memory_limit_bytes)
            stages = Stages(
                settings=wanted.settings,
                meshes=wanted.meshes,
                plan=plan,
                progress=progress,
                executor=engine,
                scratch=scratch,
                isolation=request.isolation,
            )
            try:
                ingested = stages.ingest(paths)
                check_points(earlier.manifest, paths, ingested)
                found = _found(stages, earlier, ingested, footprints, overrides, request.only)
                for outcome in found.outcomes:
                    if outcome.warning:
                        progress.warn("join", outcome.warning)
                models = stages.reconstruct(found.again)
                modelled = list(models.each())
                new = LocalStorage(root=Path(scratch.root, _NEW))
                prepared = _prepared(stages, earlier, found, models, wanted.meshes, new)
            except BaseException:
                scratch.cancel()
                raise
            scratch.check_cancelled()
            digest = _written(earlier, wanted, found, modelled, prepared, new, scratch, began)
    finally:
        remove_folder(scratch_dir)
    status = {**{m.building_id: m.status for m in modelled}, **{s.object_id: "rejected" for s in found.again.rejected}}
    seconds = time.perf_counter() - began
    progress.tell("finished", "", f"{len(found.changed)} buildings in {seconds:.1f} s")
    return RerunSummary(
        run_dir=str(earlier.run_dir),
        digest=digest,
        buildings=dict(sorted(status.items())),
        tiles=tuple(sorted(tile.key for tile in prepared)),
        tiles_split=len(found.splits.told),
        warnings=tuple(outcome.warning for outcome in found.outcomes if outcome.warning),
        seconds=seconds,
    )


def _overrides_file(request: RerunRequest, earlier: Earlier) -> str | None:
    """The file of the overrides: the given one, else the run's own."""
    given = request.overrides or earlier.manifest.request.get("overrides")
    return None if given is None else str(given)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Found:
    """What the split of some tiles, or of all, found."""

    splits: Splits
    judged: Joined
    """Before the overrides."""
    outcomes: tuple[EntryOutcome, ...]
    changed: frozenset[str]
    """Buildings that are to be made again."""
    again: Joined
    """These alone, after the overrides."""


def _found(
    stages: Stages,
    earlier: Earlier,
    ingested: Sequence[Ingested],
    footprints: GivenFootprints | None,
    overrides: Sequence[Override],
    only: Collection[str],
) -> _Found:
    """The buildings to be made again, from the tiles around them, or from all where those do not suffice."""
    near = _tiles_near(stages, earlier, ingested, footprints, overrides, only)
    if near is not None:
        found = _join(stages, earlier, ingested, footprints, overrides, only, near)
        if _as_in_the_run(stages, earlier, found):
            return found
    found = _join(stages, earlier, ingested, footprints, overrides, only, None)
    there = {site.building_id for site in found.again.candidates} | {site.object_id for site in found.again.rejected}
    if there != found.changed:
        lost = ", ".join(sorted(found.changed - there))
        raise RunError(f"{lost} cannot be found again in the inputs of {earlier.run_dir}. Run the whole again")
    return found


def _join(
    stages: Stages,
    earlier: Earlier,
    ingested: Sequence[Ingested],
    footprints: GivenFootprints | None,
    overrides: Sequence[Override],
    only: Collection[str],
    tiles: frozenset[Tile] | None,
) -> _Found:
    reference = stages.plan.sources[0].reference
    splits = stages.split(ingested, footprints, tiles)
    judged = stages.outline(stages.join(splits, footprints, reference))
    joined, outcomes = stages.override(judged, overrides, ingested)
    now = {o.building_id: o.effective.fingerprint for o in outcomes if o.building_id and o.effective is not None}
    names = {*now, *earlier.fingerprints}
    changed = frozenset({name for name in names if now.get(name) != earlier.fingerprints.get(name)} | set(only))
    return _Found(
        splits=splits,
        judged=judged,
        outcomes=outcomes,
        changed=changed,
        again=dataclasses.replace(
            joined,
            candidates=tuple(site for site in joined.candidates if site.building_id in changed),
            rejected=tuple(site for site in joined.rejected if site.object_id in changed),
        ),
    )


def _tiles_near(
    stages: Stages,
    earlier: Earlier,
    ingested: Sequence[Ingested],
    footprints: GivenFootprints | None,
    overrides: Sequence[Override],
    only: Collection[str],
) -> frozenset[Tile] | None:
    """The tiles around all places that overrides, old and new, speak of; None where a place is not known."""
    unit = stages.plan.sources[0].reference.horizontal_unit_m
    boxes: list[tuple[float, ...]] = []
    names = {*only, *earlier.fingerprints, *(str(o.building_id) for o in overrides if o.building_id is not None)}
    records = earlier.records(names, [o.source_id for o in overrides if o.source_id is not None])
    if not names <= set(records):
        return None
    boxes.extend((*o.point_m, *o.point_m) for o in overrides if o.point_m is not None)
    boxes.extend(o.footprint.bounds for o in overrides if o.footprint is not None)
    given = {} if footprints is None else dict(zip(footprints.ids, footprints.polygons, strict=True))
    for record in records.values():
        if record.source_id in given:
            boxes.append(given[record.source_id].bounds)
        elif record.box is not None:
            boxes.append(tuple(value * unit for value in record.box))
        else:
            return None
    margin = round(AROUND_M * MM)
    near = set()
    for tile in points_by_tile(ingested):
        core = stages.plan.grid.core(tile).grown(margin)
        square = shapely.box(core.x0_mm / MM, core.y0_mm / MM, core.x1_mm / MM, core.y1_mm / MM)
        if any(square.intersects(shapely.box(*box)) for box in boxes):
            near.add(tile)
    return frozenset(near)


def _as_in_the_run(stages: Stages, earlier: Earlier, found: _Found) -> bool:
    """Whether each building to be made again is known to be what the run had there."""
    if any(outcome.building_id is None for outcome in found.outcomes):
        return False
    candidates = {site.building_id: site for site in found.judged.candidates}
    rejected = {site.object_id: site for site in found.judged.rejected}
    records = earlier.records(found.changed)
    for name in found.changed:
        # of a building that is cut off where the split tiles end, neither points nor id are those of the run
        site, record = candidates.get(name) or rejected.get(name), records.get(name)
        if site is None or record is None or name in earlier.redrawn or not _same(stages, record, site):
            return False
    return True


def _same(stages: Stages, record: Record, site: CandidateSite | RejectedSite) -> bool:
    """Whether a site, without overrides, is that of a record."""
    if record.points != site.points:
        return False
    if isinstance(site, RejectedSite):
        return True
    if record.input_hash is None:
        # the outline of a unit hangs on all units of its block, which may reach beyond the split tiles
        return site.block is None
    at_walls = stages.settings.building.roof.at_walls
    _, facts = gather(stages.scratch, stages.plan.grid, site, stages.gps_kind, beside=at_walls)
    return facts.input_hash == record.input_hash


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Prepared:
    """The new files of a tile, whole, in scratch: only their digests are held."""

    digests: Mapping[str, str]
    """sha256 by path relative to the run directory, hexadecimal."""
    gone: tuple[str, ...]
    """Paths of meshes that no row names any more."""


def _prepared(
    stages: Stages, earlier: Earlier, found: _Found, models: Models, meshes: str, new: LocalStorage
) -> dict[Tile, _Prepared]:
    """Write the new files of the tiles that own what was made again, one tile at a time, beside the run's."""
    context = stages.record_context(stages.plan.sources[0].reference)
    rejected: dict[Tile, list[RejectedSite]] = {}
    for site in found.again.rejected:
        rejected.setdefault(site.owner, []).append(site)
    owners = {site.owner for site in found.again.candidates}
    without = ((tile, list[StoredResult]()) for tile in sorted(rejected.keys() - owners))

    def prepare(tile: Tile, stored: Sequence[StoredResult]) -> _Prepared:
        update = updated_tile(
            earlier.run_dir,
            tile.key,
            found.changed,
            [entry.result for entry in stored],
            [rejected_object(site) for site in rejected.get(tile, ())],
            dataclasses.replace(context, facts={entry.result.building_id: entry.facts for entry in stored}),
            meshes,
        )
        for path, data in update.files.items():
            new.put(path, data)
        return _Prepared(digests=update.digests, gone=update.gone)

    prepared = {tile: prepare(tile, stored) for tile, stored in itertools.chain(models.stored(), without)}
    return dict(sorted(prepared.items()))


def _written(
    earlier: Earlier,
    request: RunRequest,
    found: _Found,
    modelled: Sequence[Modelled],
    prepared: Mapping[Tile, _Prepared],
    new: LocalStorage,
    scratch: Scratch,
    began: float,
) -> str:
    """Put the new files in place, each whole, and the manifest last; the digest."""
    root = earlier.run_dir
    storage = LocalStorage(root=root)
    manifest = _manifest(earlier, request, found, modelled)
    # whoever reads now, or after a power cut, sees that the directory is being changed
    changing = dataclasses.replace(earlier.manifest, status=RunStatus.RUNNING, content_sha256=None)
    write_manifest(root, changing, storage.put)
    storage.clear((PAGE,))
    try:
        for tile, update in prepared.items():
            for path in update.digests:
                with storage.putting(path) as temporary:
                    new.path(path).rename(temporary)
            _put_state(storage, tile, update)
            for path in update.gone:
                (root / path).unlink(missing_ok=True)
        _put_bundles(storage, scratch, found.changed, modelled)
        if request.overrides is not None:
            put_json(root, OVERRIDES, [outcome.as_dict() for outcome in found.outcomes])
        digest = run_digest(str(root))
    except BaseException as error:
        told = (*changing.warnings, f"{type(error).__name__}: {error}".removesuffix(": "))
        with contextlib.suppress(OSError):  # a full disk takes no manifest either: then it says running
            write_manifest(root, dataclasses.replace(changing, status=RunStatus.FAILED, warnings=told), storage.put)
        raise
    seconds = {**earlier.manifest.timings_s, "rerun": round(time.perf_counter() - began, 3)}
    finished = dt.datetime.now(tz=dt.UTC)
    whole = dataclasses.replace(manifest, content_sha256=digest, timings_s=seconds, finished_at=finished)
    write_manifest(root, whole, storage.put)
    return digest


def _put_bundles(
    storage: LocalStorage, scratch: Scratch, changed: Collection[str], modelled: Sequence[Modelled]
) -> None:
    """The bundles of the buildings that met a fault this time, in place of those of an earlier one."""
    told = {m.building_id: m.reason for m in modelled}
    for name in sorted(changed):
        key = f"{QUARANTINE}/{name}{SUFFIX}"
        made = Path(scratch.root, key)
        if told.get(name) in _QUARANTINED and made.is_file():
            storage.put(key, made.read_bytes())
        else:
            storage.path(key).unlink(missing_ok=True)


def _put_state(storage: LocalStorage, tile: Tile, update: _Prepared) -> None:
    """The tile's state with the digests of its new files."""
    key = f"state/{tile.key}.json"
    state = json.loads(storage.get(key))
    files = {path: digest for path, digest in state["files"].items() if path not in update.gone}
    state["files"] = dict(sorted({**files, **update.digests}.items()))
    storage.put(key, json.dumps(state, indent=1).encode())


def _manifest(earlier: Earlier, request: RunRequest, found: _Found, modelled: Sequence[Modelled]) -> RunManifest:
    """The manifest of the run as if it had been made with these overrides; without its digest."""
    before = Counter(record.status for record in earlier.records(found.changed).values())
    after = Counter(m.status for m in modelled)
    counts = Counter(earlier.manifest.counts)
    for status in ("ok", "fallback", "failed"):
        counts[status] += after[status] - before[status]
        counts["candidates"] += after[status] - before[status]
    counts[REJECTED] += len(found.again.rejected) - before[REJECTED]
    counts["roof_faces"] += sum(m.faces for m in modelled) - earlier.faces(found.changed)
    old = earlier.manifest.request["overrides"]
    inputs = [entry for entry in earlier.manifest.inputs if entry.n_points is not None or entry.path != old]
    if request.overrides is not None:
        inputs.append(told_file(request.overrides))
    warnings = [text for text in earlier.manifest.warnings if not text.startswith(WARNING)]
    warnings.extend(outcome.warning for outcome in found.outcomes if outcome.warning)
    return dataclasses.replace(
        earlier.manifest,
        request={**earlier.manifest.request, "overrides": told_request(request)["overrides"]},
        inputs=tuple(inputs),
        counts=dict(counts),
        slowest=_slowest(earlier, found, modelled),
        warnings=tuple(warnings),
    )


def _slowest(earlier: Earlier, found: _Found, modelled: Sequence[Modelled]) -> tuple[SlowBuilding, ...]:
    """Those that took longest, of the buildings that stayed and of those that were modelled again."""
    stayed = [one for one in earlier.manifest.slowest if one.building_id not in found.changed]
    again = [SlowBuilding(building_id=m.building_id, seconds=round(m.seconds, 3)) for m in modelled]
    return tuple(heapq.nlargest(SLOWEST, (*stayed, *again), key=lambda one: (one.seconds, one.building_id)))
