"""Rerun: single buildings of a finished run are modelled again, after other overrides or on request.

The inputs are read again, and only the tiles around these buildings are split. Their candidates are compared with the
records of the run; where a building differs from the run, all tiles are split. All new files are written beside the
run, tile by tile, before the first of its own is touched; then each is renamed into its place.
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

import shapely

from pipeline.errors import RunError
from pipeline.export.folders import POINTS_FOLDER, TERRAIN_FOLDER
from pipeline.extras.footprints.given_footprints import GivenFootprints, footprints_of_run
from pipeline.extras.guides.given_guides import given_guides
from pipeline.extras.overrides.apply_overrides import WARNING, EntryOutcome, about_no_effect, apply_overrides
from pipeline.extras.overrides.earlier import Earlier, Record, check_outlines, check_points, earlier_run, request_of
from pipeline.extras.overrides.overrides_file import Override, read_overrides
from pipeline.extras.overrides.tile_update import updated_tile
from pipeline.io import LocalStorage
from pipeline.model import Reason, Status
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.digest import run_digest
from pipeline.runtime.expected import expected
from pipeline.runtime.isolation.preloading import loads_of
from pipeline.runtime.isolation.process_limits import BUNDLE_SUFFIX
from pipeline.runtime.manifest import PAGE, SLOWEST, RunManifest, RunStatus, SlowBuilding, write_manifest
from pipeline.runtime.monitoring.progress import Listener, Progress, ignore, never
from pipeline.runtime.request import RunRequest, input_file, plan_inputs, request_record
from pipeline.runtime.resources import Resources
from pipeline.runtime.run_context import RunContext, run_context
from pipeline.runtime.run_directory import NOTHING_FOUND, OVERRIDES, put_json
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.folder_lock import locked_results
from pipeline.runtime.scratch.location import run_scratch
from pipeline.runtime.stages.batch_figures import REJECTED, Modelled
from pipeline.runtime.stages.gather import gather
from pipeline.runtime.stages.ground_stage import cells_of_blocks, find_ground
from pipeline.runtime.stages.ingest import ingest
from pipeline.runtime.stages.ingested import Ingested, points_by_tile
from pipeline.runtime.stages.join import join
from pipeline.runtime.stages.model_batch import StoredResult
from pipeline.runtime.stages.publish import buildings_and_rejected, record_context, rejected_object
from pipeline.runtime.stages.reconstruct import QUARANTINE, Models, reconstruct
from pipeline.runtime.stages.sites import CandidateSite, FoundSites, RejectedSite
from pipeline.runtime.stages.split import Splits, split
from pipeline.runtime.stages.stored_sites import joined_of, store_sites
from pipeline.tiling import MM, Tile

AROUND_M = 30.0
"""Tiles nearer than this to a building are split. Not a setting: a building sees terrain up to 15 m away, and where
this does not suffice all tiles are split."""
_NEW = "new"
"""Folder of scratch for the files that will replace those of the run."""
_POINTS_GONE = "the points are removed, since they showed the models before the rerun: run again with --points"
_TERRAIN_GONE = "the terrain is removed, since it fits the models before the rerun: run again with --terrain tin"
_QUARANTINED = (Reason.INTERNAL_ERROR, Reason.CRASHED, Reason.TIMED_OUT, Reason.OUT_OF_MEMORY)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RerunRequest:
    """Which buildings to model again."""

    run_dir: str
    """The directory of a finished run."""
    overrides: str | None = None
    """The overrides file that replaces the run's own; None uses that."""
    only: tuple[str, ...] = ()
    """Buildings, by building_id, to model again whatever the overrides say."""
    resources: Resources = dataclasses.field(default_factory=Resources)
    """What the rerun runs with."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RerunSummary:
    """The outcome of a rerun."""

    run_dir: str
    """The directory."""
    digest: str
    """sha256 of the content, the same as for a whole run with these overrides."""
    buildings: dict[str, str]
    """Status of the buildings modelled again, by id; `rejected` for those that are not buildings now."""
    tiles: tuple[str, ...]
    """Tiles with new files."""
    tiles_split: int
    """Number of tiles that were split."""
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

    `on_event`, `executor` and `cancelled` are those of `pipeline.runtime.run.run`.

    Raises
    ------
    RunError
        The directory has no finished run of this version, its inputs changed, an id is not one of its buildings, or
        another run writes it.
    SettingsError
        The overrides have faults.
    InputError
        An input can no longer be read.
    RunCancelledError
        `cancelled` ended it; the run directory is unchanged.
    """
    with locked_results(str(earlier_run(request.run_dir).run_dir)):
        # read it again: only now is it certain that no other process writes it
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
    plan, paths = plan_inputs(dataclasses.replace(wanted, resources=request.resources), progress, cancelled, executor)
    footprints = footprints_of_run(wanted.footprints, plan, wanted.settings.footprints, wanted.footprints_layer)
    guides = None
    if wanted.guides is not None:
        guides = given_guides(wanted.guides, plan, wanted.settings.building.guides.kind_column)
    overrides = () if wanted.overrides is None else read_overrides(wanted.overrides, plan.reference, wanted.settings)
    check_outlines(earlier.manifest, wanted)
    with run_context(
        plan,
        progress,
        request.resources,
        run_scratch(str(earlier.run_dir), None),
        # a few tiles are split, which are not known yet; all inputs are read
        lambda: dataclasses.replace(expected(plan, 0), seen_points=0.0, ground_km2=()),
        loads=loads_of("reconstruct", footprints=False, method=wanted.settings.general.method),
        executor=executor,
        cancelled=cancelled,
    ) as context:
        ingested = ingest(context, paths, earlier.manifest.strip_moves_mm)
        check_points(earlier.manifest, paths, ingested)
        search = _Search(
            context=context,
            earlier=earlier,
            request=wanted,
            ingested=ingested,
            footprints=footprints,
            overrides=overrides,
            only=request.only,
        )
        found = search.found()
        for outcome in found.outcomes:
            if outcome.warning:
                progress.warn("join", outcome.warning)
        if earlier.manifest.request.get("points"):
            progress.warn("publish", _POINTS_GONE)
        if wanted.settings.general.terrain != "none":
            progress.warn("publish", _TERRAIN_GONE)
        again = joined_of(store_sites(context, "again", found.again), 0, found.splits.keys)
        models = reconstruct(context, wanted.settings, again, guides)
        modelled = list(models.each())
        new = LocalStorage(root=Path(context.scratch.root, _NEW))
        prepared = _prepared(search, found, models, new)
        context.scratch.check_cancelled()
        digest = _written(search, found, modelled, prepared, new, began)
    status = {**{m.building_id: m.status for m in modelled}, **{s.object_id: REJECTED for s in found.again.rejected}}
    seconds = time.perf_counter() - began
    progress.tell("finished", "", f"{len(found.changed)} buildings in {seconds:.1f} s")
    return RerunSummary(
        run_dir=str(earlier.run_dir),
        digest=digest,
        buildings=dict(sorted(status.items())),
        tiles=tuple(sorted(tile.key for tile in prepared)),
        tiles_split=len(found.splits.figures),
        warnings=tuple(outcome.warning for outcome in found.outcomes if outcome.warning),
        seconds=seconds,
    )


def _overrides_file(request: RerunRequest, earlier: Earlier) -> str | None:
    """The file of the overrides: the given one, else the run's own."""
    given = request.overrides or earlier.manifest.request.get("overrides")
    return None if given is None else str(given)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Found:
    """The candidates of some tiles, or of all."""

    splits: Splits
    judged: FoundSites
    """The sites that overrides concern, before them."""
    outcomes: tuple[EntryOutcome, ...]
    changed: frozenset[str]
    """Buildings to model again."""
    again: FoundSites
    """Only these, after the overrides."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Search:
    """The search for the buildings to model again."""

    context: RunContext
    earlier: Earlier
    request: RunRequest
    """The request of the run, with the new overrides."""
    ingested: Sequence[Ingested]
    footprints: GivenFootprints | None
    overrides: Sequence[Override]
    only: Collection[str]
    """Buildings to model again whatever the overrides say."""

    def found(self) -> _Found:
        """The buildings to model again, from the tiles around them, or from all tiles where those do not suffice."""
        near = self._tiles_near()
        if near is not None:
            found = self._candidates(near)
            if self._as_in_the_run(found):
                return found
        found = self._candidates(None)
        there = {site.building_id for site in found.again.candidates}
        there |= {site.object_id for site in found.again.rejected}
        if there != found.changed:
            lost = ", ".join(sorted(found.changed - there))
            raise RunError(f"{lost} cannot be found again in the inputs of {self.earlier.run_dir}. Run the whole again")
        return found

    def _candidates(self, tiles: frozenset[Tile] | None) -> _Found:
        """The candidates of some tiles; of all tiles for None."""
        context, settings = self.context, self.request.settings
        cells = cells_of_blocks(context, settings, self.ingested, self.footprints, only=tiles)
        ground = find_ground(context, settings, cells)
        splits = split(context, settings, self.ingested, ground, self.footprints, tiles)
        joined = join(context, settings.scene, settings.building.roof, splits, self.footprints)
        before = self.earlier.fingerprints
        applied = apply_overrides(
            context, settings, joined, self.overrides, self.ingested, ground, {*before, *self.only}
        )
        outcomes, sites = applied.outcomes, applied.sites
        now = {o.building_id: o.effective.fingerprint for o in outcomes if o.building_id and o.effective is not None}
        changed = frozenset({name for name in {*now, *before} if now.get(name) != before.get(name)} | set(self.only))
        return _Found(
            splits=splits,
            judged=applied.before,
            outcomes=outcomes,
            changed=changed,
            again=FoundSites(
                candidates=tuple(site for site in sites.candidates if site.building_id in changed),
                rejected=tuple(site for site in sites.rejected if site.object_id in changed),
            ),
        )

    def _tiles_near(self) -> frozenset[Tile] | None:
        """The tiles around all places named by overrides, old and new; None where a place is unknown."""
        overrides, grid = self.overrides, self.context.plan.grid
        unit = self.context.plan.reference.horizontal_unit_m
        boxes: list[tuple[float, ...]] = []
        named = {str(o.building_id) for o in overrides if o.building_id is not None}
        names = {*self.only, *self.earlier.fingerprints, *named}
        records = self.earlier.records(names, [o.source_id for o in overrides if o.source_id is not None])
        if not names <= set(records):
            return None
        boxes.extend((*o.point_m, *o.point_m) for o in overrides if o.point_m is not None)
        boxes.extend(o.footprint.bounds for o in overrides if o.footprint is not None)
        given: dict[str, list[tuple[float, ...]]] = {}
        if self.footprints is not None:
            for name, polygon in zip(self.footprints.ids, self.footprints.polygons, strict=True):
                given.setdefault(name, []).append(polygon.bounds)
        for record in records.values():
            if record.source_id in given:
                boxes.extend(given[record.source_id])
            elif record.box is not None:
                boxes.append(tuple(value * unit for value in record.box))
            else:
                return None
        margin = round(AROUND_M * MM)
        near = set()
        for tile in points_by_tile(self.ingested):
            core = grid.core(tile).grown(margin)
            square = shapely.box(core.x0_mm / MM, core.y0_mm / MM, core.x1_mm / MM, core.y1_mm / MM)
            if any(square.intersects(shapely.box(*box)) for box in boxes):
                near.add(tile)
        return frozenset(near)

    def _as_in_the_run(self, found: _Found) -> bool:
        """Whether each building to model again is the same as in the run, as far as its records show."""
        if any(outcome.building_id is None for outcome in found.outcomes):
            return False
        candidates = {site.building_id: site for site in found.judged.candidates}
        rejected = {site.object_id: site for site in found.judged.rejected}
        records = self.earlier.records(found.changed)
        for name in found.changed:
            # a building cut off at the edge of the split tiles has other points, or another id, than in the run
            site, record = candidates.get(name) or rejected.get(name), records.get(name)
            if site is None or record is None or name in self.earlier.redrawn or not self._same(record, site):
                return False
        return True

    def _same(self, record: Record, site: CandidateSite | RejectedSite) -> bool:
        """Whether a site, without overrides, is that of a record."""
        if record.points != site.points:
            return False
        if isinstance(site, RejectedSite):
            return True
        if record.input_hash is None:
            # an outline drawn with regard to others depends on these, which may reach beyond the split tiles
            return site.block is None and site.outline is None
        plan, roof = self.context.plan, self.request.settings.building.roof
        _, facts = gather(self.context.scratch, plan.grid, site, plan.gps_kind, roof)
        return facts.input_hash == record.input_hash


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Prepared:
    """The new files of a tile, complete in scratch; only their digests are in memory."""

    digests: Mapping[str, str]
    """sha256 by path relative to the run directory, hexadecimal."""
    gone: tuple[str, ...]
    """Paths of meshes that no row names now."""


def _prepared(search: _Search, found: _Found, models: Models, new: LocalStorage) -> dict[Tile, _Prepared]:
    """Write the new files of the tiles that own what was modelled again, one tile at a time, beside the run's."""
    earlier, request = search.earlier, search.request
    records = record_context(search.context.plan, request.settings)
    rejected: dict[Tile, list[RejectedSite]] = {}
    for site in found.again.rejected:
        rejected.setdefault(site.owner, []).append(site)
    owners = {site.owner for site in found.again.candidates}
    without = ((tile, list[StoredResult]()) for tile in sorted(rejected.keys() - owners))

    def prepare(tile: Tile, stored: Sequence[StoredResult]) -> _Prepared:
        buildings, unmodelled = buildings_and_rejected(stored)
        update = updated_tile(
            earlier.run_dir,
            tile.key,
            found.changed,
            buildings,
            [*(rejected_object(site) for site in rejected.get(tile, ())), *unmodelled],
            dataclasses.replace(records, facts={entry.result.building_id: entry.facts for entry in stored}),
            request.meshes,
        )
        for path, data in update.files.items():
            new.put(path, data)
        return _Prepared(digests=update.digests, gone=update.gone)

    prepared = {tile: prepare(tile, stored) for tile, stored in itertools.chain(models.stored(), without)}
    return dict(sorted(prepared.items()))


def _written(
    search: _Search,
    found: _Found,
    modelled: Sequence[Modelled],
    prepared: Mapping[Tile, _Prepared],
    new: LocalStorage,
    began: float,
) -> str:
    """Put the new files in place, each whole, and the manifest last; the digest."""
    earlier, request = search.earlier, search.request
    root = earlier.run_dir
    storage = LocalStorage(root=root)
    manifest = _manifest(earlier, request, found, modelled)
    # readers see that the directory changes, also after a power cut
    changing = dataclasses.replace(earlier.manifest, status=RunStatus.RUNNING, content_sha256=None)
    write_manifest(root, changing, storage.put)
    storage.clear((PAGE, POINTS_FOLDER, TERRAIN_FOLDER))
    try:
        for tile, update in prepared.items():
            for path in update.digests:
                with storage.putting(path) as temporary:
                    new.path(path).rename(temporary)
            _put_state(storage, tile, update)
            for path in update.gone:
                (root / path).unlink(missing_ok=True)
        _put_bundles(storage, search.context.scratch, found.changed, modelled)
        if request.overrides is not None:
            put_json(root, OVERRIDES, [outcome.as_dict() for outcome in found.outcomes])
        digest = run_digest(str(root))
    except BaseException as error:
        warnings = (*changing.warnings, f"{type(error).__name__}: {error}".removesuffix(": "))
        failed = dataclasses.replace(changing, status=RunStatus.FAILED, warnings=warnings)
        with contextlib.suppress(OSError):  # a full disk takes no manifest either, which then still says running
            write_manifest(root, failed, storage.put)
        raise
    seconds = {**earlier.manifest.timings_s, "rerun": round(time.perf_counter() - began, 3)}
    finished = dt.datetime.now(tz=dt.UTC)
    whole = dataclasses.replace(manifest, content_sha256=digest, timings_s=seconds, finished_at=finished)
    write_manifest(root, whole, storage.put)
    return digest


def _put_bundles(
    storage: LocalStorage, scratch: Scratch, changed: Collection[str], modelled: Sequence[Modelled]
) -> None:
    """Replace the bundles of an earlier fault by those of this rerun."""
    reasons = {m.building_id: m.reason for m in modelled}
    for name in sorted(changed):
        key = f"{QUARANTINE}/{name}{BUNDLE_SUFFIX}"
        made = Path(scratch.root, key)
        if reasons.get(name) in _QUARANTINED and made.is_file():
            storage.put(key, made.read_bytes())
        else:
            storage.path(key).unlink(missing_ok=True)


def _put_state(storage: LocalStorage, tile: Tile, update: _Prepared) -> None:
    """Put the tile's state with the digests of its new files."""
    key = f"state/{tile.key}.json"
    state = json.loads(storage.get(key))
    files = {path: digest for path, digest in state["files"].items() if path not in update.gone}
    state["files"] = dict(sorted({**files, **update.digests}.items()))
    storage.put(key, json.dumps(state, indent=1).encode())


def _manifest(earlier: Earlier, request: RunRequest, found: _Found, modelled: Sequence[Modelled]) -> RunManifest:
    """The manifest of the run, as if it had run with these overrides; without its digest."""
    before = Counter(record.status for record in earlier.records(found.changed).values())
    after = Counter(m.status for m in modelled)
    counts = Counter(earlier.manifest.counts)
    for status in map(str, Status):
        counts[status] += after[status] - before[status]
        counts["candidates"] += after[status] - before[status]
    counts[REJECTED] += len(found.again.rejected) + after[REJECTED] - before[REJECTED]
    counts["roof_faces"] += sum(m.faces for m in modelled) - earlier.faces(found.changed)
    old = earlier.manifest.request["overrides"]
    inputs = [entry for entry in earlier.manifest.inputs if entry.n_points is not None or entry.path != old]
    if request.overrides is not None:
        inputs.append(input_file(request.overrides))
    warnings = [text for text in earlier.manifest.warnings if not text.startswith(WARNING)]
    headline = "" if earlier.manifest.headline not in warnings else earlier.manifest.headline
    if headline.startswith(NOTHING_FOUND) and counts["candidates"]:
        warnings.remove(headline)
        headline = ""
    if without_effect := about_no_effect(found.outcomes):
        headline = without_effect
        warnings.insert(0, headline)
    warnings.extend(outcome.warning for outcome in found.outcomes if outcome.warning)
    if earlier.manifest.request.get("points"):
        warnings.append(_POINTS_GONE)
    settings = earlier.manifest.settings
    if request.settings.general.terrain != "none":
        warnings.append(_TERRAIN_GONE)
        settings = {**settings, "general": {**settings["general"], "terrain": "none"}}
        counts = Counter({name: n for name, n in counts.items() if not name.startswith("terrain_")})
    return dataclasses.replace(
        earlier.manifest,
        settings=settings,
        request={
            **earlier.manifest.request,
            "overrides": request_record(request)["overrides"],
            "points": False,
        },
        inputs=tuple(inputs),
        tiles_without_points=(),
        tiles_without_terrain=(),
        counts=dict(counts),
        slowest=_slowest(earlier, found, modelled),
        warnings=tuple(warnings),
        headline=headline,
    )


def _slowest(earlier: Earlier, found: _Found, modelled: Sequence[Modelled]) -> tuple[SlowBuilding, ...]:
    """The buildings that took longest, among those that stayed and those that were modelled again."""
    stayed = [one for one in earlier.manifest.slowest if one.building_id not in found.changed]
    again = [SlowBuilding(building_id=m.building_id, seconds=round(m.seconds, 3)) for m in modelled]
    return tuple(heapq.nlargest(SLOWEST, (*stayed, *again), key=lambda one: (one.seconds, one.building_id)))
