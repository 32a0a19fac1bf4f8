"""The stages of a run, each a map of a plain function over tasks, or a step of the driver."""

from __future__ import annotations

import dataclasses
import json
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar
from uuid import uuid4

import shapely
from shapely import MultiPolygon, Polygon

from pipeline import __version__
from pipeline.errors import EmptyInputError, InconsistentInputError
from pipeline.export.facts import RecordContext
from pipeline.io import SpatialReference, shown, storage_at
from pipeline.io.footprints import read_footprints
from pipeline.io.gps_time import GpsTimeKind
from pipeline.model import Status
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.isolation.isolated_items import IsolationLimits
from pipeline.runtime.overrides.overrides_file import Override, own_modelling
from pipeline.runtime.plan import Plan, check_windows, split_grid, window_bytes
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Keeper, Place, key_of, result_of, told_of, whole
from pipeline.runtime.stages.apply_overrides import EntryOutcome, accepts, layers_of, outcomes_of, overridden
from pipeline.runtime.stages.cleanup import clear_points, clear_tiles, drop_stale, publishing
from pipeline.runtime.stages.ingest import Ingested, IngestTask, ingest, part_of, spread_m
from pipeline.runtime.stages.join import CandidateSite, Joined, PointRange, RejectedSite, join, join_footprints
from pipeline.runtime.stages.outline import draw_outlines, outline_tasks
from pipeline.runtime.stages.progress import Progress
from pipeline.runtime.stages.publish import QUARANTINE, Published, PublishTask, publish, retire
from pipeline.runtime.stages.reconstruct import (
    BatchTask,
    Modelled,
    StoredResult,
    batches,
    model_batch,
    stored_results,
    told_of_batch,
)
from pipeline.runtime.stages.reconstruct_tasks import divide, unit_tasks
from pipeline.runtime.stages.split import Split, SplitTask, SplitTold, split, told_of_split
from pipeline.runtime.stages.tile_content import ZoneSums, content_of_window, zone_sums_of
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS
from pipeline.settings import RunSettings
from pipeline.terrain.scene_settings import ClassesInUse
from pipeline.terrain.settings import CandidateSettings
from pipeline.tiling import MM, Tile, TileGrid, Window

Task = TypeVar("Task")
Result = TypeVar("Result")
Told = TypeVar("Told")

MODELS = "models"
"""Begins the names of the stages under which models are kept; the settings follow."""
_LINE_SPREAD_M = 0.05
_ISSUES_TOLD = 10
"""Unusable or repaired footprints that are warned of one by one; the run directory lists them all."""
_CLASSIFIED_SHARE = 0.05
"""Least share of ground points (class 2) from which a file counts as classified."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GivenFootprints:
    """Given outlines that meet the data, in an order that does not depend on the file's."""

    polygons: tuple[Polygon | MultiPolygon, ...]
    """In metres of the CRS."""
    ids: tuple[str, ...]
    """Their own ids."""
    attributes: tuple[str, ...]
    """Their columns, each as the text of a JSON object."""
    warnings: tuple[str, ...]
    """What is odd but usable."""
    report: dict[str, Any]
    """How many were read, used, repaired and left out, and every fault one by one, as `footprints.json` has them."""


def given_footprints(path: str, plan: Plan) -> GivenFootprints:
    """Read the footprints of a run.

    Parameters
    ----------
    path : str
        A vector file.
    plan : Plan
        Tells where data are wanted: the inputs' bounds, cut by --bbox and --aoi.

    Raises
    ------
    InputError
        The file cannot be used.
    """
    area = shapely.union_all([shapely.box(*i.bounds_m[:2], *i.bounds_m[3:5]) for i in plan.sources])
    unit = plan.sources[0].reference.horizontal_unit_m
    if plan.options.bbox is not None:
        area &= shapely.box(*(v * unit for v in plan.options.bbox))
    if plan.options.aoi is not None:
        area &= shapely.transform(plan.options.aoi, lambda xy: xy * unit)
    found = read_footprints(path, plan.sources[0].reference, area=area)
    shapely.prepare(area)  # of many inputs it has many corners, and is asked once a footprint
    inside = [k for k, polygon in enumerate(found.polygons) if area.intersects(polygon)]
    # a fault far from the data is none of this run's; one without a place may be
    issues = [i for i in found.issues if i.bounds_m is None or shapely.box(*i.bounds_m).intersects(area)]
    warnings = [*found.warnings, *(str(issue) for issue in issues[:_ISSUES_TOLD])]
    if len(issues) > _ISSUES_TOLD:
        warnings.append(f"{len(issues) - _ISSUES_TOLD} more faults of footprints, each in footprints.json of a run")
    polygons = len(found.polygons) + found.elsewhere
    if len(inside) < polygons:
        warnings.append(f"{polygons - len(inside)} of {polygons} footprints lie off the data")
    # overlaps are decided by this order
    inside.sort(key=lambda k: (found.polygons[k].bounds, found.ids[k]))
    return GivenFootprints(
        polygons=tuple(found.polygons[k] for k in inside),
        ids=tuple(found.ids[k] for k in inside),
        attributes=tuple(json.dumps(found.attributes[k], ensure_ascii=False) for k in inside),
        warnings=tuple(warnings),
        report={
            "path": shown(path),
            "used": len(inside),
            "off_the_data": polygons - len(inside),
            "repaired": sum(issue.action != "left out" for issue in issues),
            "left_out": sum(issue.action == "left out" for issue in issues),
            "issues": [dataclasses.asdict(issue) for issue in issues],
        },
    )


def points_by_tile(ingested: Sequence[Ingested]) -> Counter[Tile]:
    """Points of each tile over all inputs."""
    tiles: Counter[Tile] = Counter()
    for found in ingested:
        tiles.update(found.points_by_tile)
    return tiles


def classes_in_use(ingested: Sequence[Ingested], *, trust: bool) -> tuple[ClassesInUse, str]:
    """Which classes are believed, and a sentence on why.

    Ground and buildings are believed only where every input is classified: in each at least 5 % of the points are
    ground. A file with stray codes, or one that was never classified, is not taken at its word.
    """
    if not trust:
        return ClassesInUse(), ""
    bare = [
        found.path
        for found in ingested
        if found.classes and found.classes.get(GROUND_CLASS, 0) < _CLASSIFIED_SHARE * sum(found.classes.values())
    ]
    if bare:
        some = len(bare) < len(ingested) or any(
            found.classes.get(code, 0) for found in ingested for code in (GROUND_CLASS, BUILDING_CLASS)
        )
        told = "the inputs have no classes" if not some else f"{len(bare)} of {len(ingested)} inputs are not classified"
        return ClassesInUse(), f"{told}: ground and buildings are found in the points alone"
    buildings = any(found.classes.get(BUILDING_CLASS, 0) for found in ingested)
    return ClassesInUse(ground=True, building=buildings), ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Splits:
    """All tiles, split."""

    told: tuple[SplitTold, ...]
    """Their figures."""
    places: Mapping[Tile, Place]
    """Where their descriptors are kept."""
    keys: Mapping[Tile, str]
    """Digest of what lies in and around each tile: equal where nothing that comes after sees a difference."""
    numbers: Mapping[Tile, Sequence[int]]
    """Of each tile the numbers of the given footprints that meet it; empty where none were given."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JoinTask:
    """All tiles, to be joined."""

    scratch: Scratch
    places: tuple[Place, ...]
    """Where their descriptors are kept."""
    grid: TileGrid
    settings: CandidateSettings
    crs_name: str


def joined_of(task: JoinTask) -> Joined:
    """What `join` makes of the tiles, read one after the other."""
    described = (result_of(task.scratch, place) for place in task.places)
    return join(described, task.grid, task.settings, task.crs_name)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Models:
    """All candidates, modelled."""

    places: Mapping[Tile, Sequence[Place]]
    """Where the outcomes are kept, by owner tile."""
    scratch: Scratch
    """Where that is."""
    made: int
    """How many were modelled now; the others were taken from before, since nothing that they are made from changed."""

    def each(self) -> Iterator[Modelled]:
        """What is told of each, tile after tile; nothing is held."""
        for places in self.places.values():
            for place in places:
                yield from told_of(self.scratch, place)

    def stored(self) -> Iterator[tuple[Tile, list[StoredResult]]]:
        """The models themselves, one owner tile at a time."""
        for tile, places in self.places.items():
            yield tile, [entry for place in places for entry in stored_results(self.scratch, place)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stages:
    """The stages of one run, each a map over tasks or a step of the driver."""

    settings: RunSettings
    meshes: str
    plan: Plan
    progress: Progress
    executor: Executor
    scratch: Scratch
    isolation: IsolationLimits | None = None
    """Limits of the supervised children that model buildings; None models in the workers themselves."""
    compared: bool = False
    """Whether there are several variants, whose seconds are told side by side."""

    def ingest(self, paths: Sequence[str]) -> list[Ingested]:
        """Bucket all points by tile, and look at what they are; in the order of the paths."""
        known = {info.path: info for info in self.plan.sources}
        tasks = {}
        for path in paths:
            task = IngestTask(
                part=part_of(path),
                path=path,
                options=self.plan.options,
                grid=self.plan.grid,
                scratch=self.scratch,
                known=known[shown(path)],
            )
            file = known[shown(path)]
            # what nobody can tell to be the same is read again
            written = file.modified_ns or uuid4().hex
            key = key_of(path, file.file_size, written, task.options, task.grid)
            tasks[Place("ingest", task.part, key)] = task
        clear_points(self.scratch, tasks)
        ingested = list(self.progress.kept(self.executor, "ingest", ingest, tasks, self.scratch, whole).values())
        for found in ingested:
            for warning in found.warnings:
                self.progress.warn("ingest", f"{shown(found.path)}: {warning}")
        kept = sum(sum(found.points_by_tile.values()) for found in ingested)
        if kept == 0:
            causes = Counter[str]()
            for found in ingested:
                causes.update(found.dropped)
            lost = ", ".join(f"{count} {cause}" for cause, count in causes.items() if count)
            raise EmptyInputError(
                shown(paths[0]),
                f"no usable point is left ({lost or 'none in the files'})",
                "Check --bbox and --aoi; points that are withheld or of the noise classes 7 and 18 are never used",
            )
        spread = spread_m(ingested)
        if spread < _LINE_SPREAD_M:
            raise InconsistentInputError(
                shown(paths[0]),
                f"all {kept} points lie on one line (they stray {spread:.3f} m from it)",
                "Check the columns and the scale of the file",
            )
        return ingested

    def split(
        self, ingested: Sequence[Ingested], footprints: GivenFootprints | None, only: Collection[Tile] | None = None
    ) -> Splits:
        """Fragments of all tiles, or of some only."""
        tiles = points_by_tile(ingested)
        classes, told = classes_in_use(ingested, trust=self.settings.general.classes == "trust")
        grid = split_grid(self.plan, self.settings, classes, footprints=footprints is not None)
        check_windows(self.plan, grid, tiles, self.executor.memory_limit_bytes)
        if only is not None:
            tiles = Counter({tile: points for tile, points in tiles.items() if tile in only})
        if told:
            self.progress.warn("split", told)
        polygons = () if footprints is None else footprints.polygons
        numbers_of = {} if footprints is None else self._numbers_of(tiles, polygons)
        # the fullest first, so that no long task is left for the end
        order = [tile for tile, _ in sorted(tiles.items(), key=lambda item: (-item[1], item[0]))]
        given = {tile: None if footprints is None else tuple(polygons[k] for k in numbers_of[tile]) for tile in order}
        splits = self._splits("split", "tiles", given, grid, classes, ingested, numbers_of)
        duplicates, outliers = sum(s.duplicates for s in splits.told), sum(s.outliers for s in splits.told)
        if duplicates:
            self.progress.warn("split", f"{duplicates} duplicated points were dropped")
        if outliers:
            self.progress.warn("split", f"{outliers} gross outliers were left out")
        return splits

    def _splits(
        self,
        stage: str,
        folder: str,
        given: Mapping[Tile, tuple[Polygon | MultiPolygon, ...] | None],
        grid: TileGrid,
        classes: ClassesInUse,
        ingested: Sequence[Ingested],
        numbers_of: Mapping[Tile, Sequence[int]],
    ) -> Splits:
        """Split some tiles, each with its footprints."""
        content = content_by_tile(ingested)
        points = points_by_tile(ingested)
        held = {tile: content_of_window(content, self.plan.grid, self.plan.grid.window(tile), tile) for tile in given}
        tasks = {}
        for tile, outlines in given.items():
            task = SplitTask(
                tile=tile,
                grid=grid,
                settings=self.settings.scene,
                classes=classes,
                scratch=self.scratch,
                footprints=outlines,
                folder=folder,
                memory_bytes=window_bytes(grid, tile, points),
            )
            key = key_of(tile, grid, task.settings, classes, outlines, folder, held[tile])
            tasks[Place(folder, tile.key, key)] = task
        clear_tiles(self.scratch, folder, tasks)
        found = self.progress.kept(self.executor, stage, split, tasks, self.scratch, told_of_split)
        outcomes = {told.tile: told.outcome for told in found.values()}
        keys = {}
        for tile in outcomes:
            core = grid.core(tile)
            around = [(other.key, outcomes.get(other, "")) for other in grid.tiles_over(core.grown(grid.size_mm))]
            keys[tile] = key_of(around, held[tile])
        return Splits(
            told=tuple(found.values()),
            places={told.tile: place for place, told in found.items()},
            keys=keys,
            numbers=numbers_of,
        )

    def _numbers_of(self, tiles: Collection[Tile], polygons: Sequence[Polygon | MultiPolygon]) -> dict[Tile, list[int]]:
        """The polygons, by number, that meet each tile."""
        tree = shapely.STRtree(polygons)
        numbers: dict[Tile, list[int]] = {}
        for tile in tiles:
            core = self.plan.grid.core(tile)
            box = shapely.box(core.x0_mm / MM, core.y0_mm / MM, core.x1_mm / MM, core.y1_mm / MM)
            numbers[tile] = sorted(int(k) for k in tree.query(box))
        return numbers

    def override(
        self, joined: Joined, overrides: Sequence[Override], ingested: Sequence[Ingested]
    ) -> tuple[Joined, tuple[EntryOutcome, ...]]:
        """The candidates after the user's overrides, and what became of each entry."""
        started = time.perf_counter()
        outcomes = outcomes_of(overrides, joined, self.scratch, self.plan.grid)
        redrawn: dict[str, tuple[PointRange, ...]] = {}
        for number, layer in enumerate(layers_of(outcomes)):
            redrawn |= self._redrawn(layer, ingested, f"redrawn-{number}")
        changed = overridden(joined, outcomes, redrawn, self.scratch)
        timings = self.progress.timings
        timings["join"] = timings.get("join", 0.0) + time.perf_counter() - started - timings.get("redraw", 0.0)
        return changed, outcomes

    def _redrawn(
        self, layer: Sequence[EntryOutcome], ingested: Sequence[Ingested], folder: str
    ) -> dict[str, tuple[PointRange, ...]]:
        """The points inside the other footprints of some buildings, by building_id; kept in a folder of the scratch."""
        named = [(str(o.building_id), o.effective.footprint) for o in layer if o.effective and o.effective.footprint]
        classes, _ = classes_in_use(ingested, trust=self.settings.general.classes == "trust")
        if accepts(layer):
            # the user knows better than the classes, which say that there is no building
            classes = dataclasses.replace(classes, building=False)
        polygons = [polygon for _, polygon in named]
        grid = split_grid(self.plan, self.settings, classes, footprints=True)
        numbers_of = {
            tile: numbers for tile, numbers in self._numbers_of(points_by_tile(ingested), polygons).items() if numbers
        }
        given = {tile: tuple(polygons[k] for k in numbers) for tile, numbers in sorted(numbers_of.items())}
        splits = self._splits("redraw", folder, given, grid, classes, ingested, numbers_of)
        sites = join_footprints(
            self._descriptors(splits), self.plan.grid, splits.numbers, polygons, [name for name, _ in named], ""
        ).candidates
        return {
            str(site.source_id): tuple(dataclasses.replace(part, folder=folder) for part in site.ranges)
            for site in sites
        }

    def _descriptors(self, splits: Splits) -> Iterator[Split]:
        """The descriptors of all tiles, read one after the other."""
        return (result_of(self.scratch, place) for _, place in sorted(splits.places.items(), key=itemgetter(0)))

    def join(self, splits: Splits, footprints: GivenFootprints | None, reference: SpatialReference) -> Joined:
        """Whole surfaces, judged."""
        started = time.perf_counter()
        self.progress.tell("stage", "join", total=1)
        crs_name = f"EPSG:{reference.epsg}" if reference.epsg is not None else reference.name
        if footprints is None:
            task = JoinTask(
                scratch=self.scratch,
                places=tuple(place for _, place in sorted(splits.places.items(), key=itemgetter(0))),
                grid=self.plan.grid,
                settings=self.settings.scene.candidates,
                crs_name=crs_name,
            )
            joined = self.executor.run_step("join", joined_of, task, self.progress.watch)
            joined = self._divided(dataclasses.replace(joined, keys=splits.keys), crs_name)
        else:
            joined = join_footprints(
                self._descriptors(splits),
                self.plan.grid,
                splits.numbers,
                footprints.polygons,
                footprints.ids,
                crs_name,
                footprints.attributes,
            )
            joined = dataclasses.replace(joined, keys=splits.keys)
        self.progress.timings["join"] = time.perf_counter() - started
        self.progress.tell("progress", "join", done=1, total=1, message=f"{len(joined.candidates)} candidates")
        return joined

    def _divided(self, joined: Joined, crs_name: str) -> Joined:
        """The candidates with their units told apart; part of the join, so no stage of its own."""
        settings = self.settings.scene.units
        if settings.split == "nothing":
            return joined
        tasks = {}
        for tile, candidates in by_owner(joined.candidates).items():
            for task in unit_tasks(candidates, settings, self.plan.grid, self.scratch, crs_name):
                key = key_of(settings, crs_name, task.sites, self._around(joined, task.sites))
                tasks[Place("units", tile.key, key)] = task
        drop_stale(self.scratch, "units", tasks)
        divided = self.progress.kept(self.executor, "join", divide, tasks, self.scratch, whole, quiet=True)
        sites = [site for found in divided.values() for site in found]
        return dataclasses.replace(joined, candidates=tuple(sorted(sites, key=lambda c: (-c.points, c.building_id))))

    def _around(self, joined: Joined, sites: Sequence[CandidateSite]) -> list[str]:
        """Digests of what lies in and around the tiles of some candidates."""
        tiles = {part.tile for site in sites for part in site.ranges}
        for site in sites:
            for area in (site.footprint, site.outline):
                if area is not None and not area.is_empty:
                    x0, y0, x1, y1 = (round(value * MM) for value in area.bounds)
                    window = Window(x0_mm=x0, y0_mm=y0, x1_mm=x1 + 1, y1_mm=y1 + 1)
                    tiles.update(self.plan.grid.tiles_over(window))
        return [joined.keys.get(tile, "") for tile in sorted(tiles)]

    def outline(self, joined: Joined) -> Joined:
        """The candidates with the outlines of touching units, drawn together."""
        settings = self.settings.building.roof
        tasks = {}
        for tile, units in blocks_by_tile(joined.candidates).items():
            for task in outline_tasks(units, settings, self.plan.grid, self.scratch):
                sites = [site for block in task.blocks for site in block]
                key = key_of(settings, task.blocks, self._around(joined, sites))
                tasks[Place("outline", tile.key, key)] = task
        drop_stale(self.scratch, "outline", tasks)
        drawn = self.progress.kept(self.executor, "outline", draw_outlines, tasks, self.scratch, whole)
        outlines: dict[str, MultiPolygon] = {}
        for found in drawn.values():
            outlines |= found.outlines
        for warning in sorted(warning for found in drawn.values() for warning in found.warnings):
            self.progress.warn("outline", warning)
        outlined = (
            dataclasses.replace(site, outline=outlines.get(site.building_id)) if site.block is not None else site
            for site in joined.candidates
        )
        return dataclasses.replace(joined, candidates=tuple(outlined))

    def reconstruct(self, joined: Joined) -> Models:
        """All candidates, the batches of most points first."""
        keeper = Keeper(self.scratch)
        method, settings = self.settings.general.method, self.settings.building
        stage = f"{MODELS}-{self.settings.settings_hash[:16]}"
        tasks: dict[Place, BatchTask] = {}
        places: dict[Tile, list[Place]] = {}
        for tile, candidates in sorted(by_owner(joined.candidates).items()):
            earlier = tuple(Place(stage, tile.key, key) for key in sorted(keeper.keys(stage, tile.key)))
            for sites in batches(candidates):
                own = {
                    site.building_id: own_modelling(site.override, self.settings)
                    for site in sites
                    if site.override is not None and site.override.remodels
                }
                limits = self.isolation
                around = self._around(joined, sites)
                key = key_of(sites, around, method, settings, own, self.gps_kind, limits, self.plan.grid)
                place = Place(stage, tile.key, key)
                places.setdefault(tile, []).append(place)
                tasks[place] = BatchTask(
                    sites=sites,
                    method=method,
                    settings=settings,
                    grid=self.plan.grid,
                    scratch=self.scratch,
                    gps_kind=self.gps_kind,
                    isolation=limits,
                    quarantine=str(Path(self.scratch.root, QUARANTINE)),
                    reference=self.plan.sources[0].reference,
                    own=own,
                    earlier=earlier,
                    compared=self.compared,
                )
        largest_first = sorted(tasks.items(), key=lambda item: -sum(site.points for site in item[1].sites))
        made = 0

        def count(models: Sequence[Modelled]) -> None:
            nonlocal made
            made += sum(not model.reused for model in models)

        self.progress.kept(
            self.executor,
            "reconstruct",
            model_batch,
            dict(largest_first),
            self.scratch,
            told_of_batch,
            weight=len,
            total=len(joined.candidates),
            failures=_failed_of,
            landed_here=count,
        )
        # only now: batches of before are what models are taken from where their input did not change
        drop_stale(self.scratch, stage, tasks)
        return Models(places=places, scratch=self.scratch, made=made)

    def record_context(self, reference: SpatialReference) -> RecordContext:
        """Facts of the run for its records."""
        times = [(i.acquired_from, i.acquired_to) for i in self.plan.sources]
        known = [(a, b) for a, b in times if a is not None and b is not None]
        return RecordContext(
            reference=reference,
            settings_hash=self.settings.settings_hash,
            engine_version=__version__,
            acquired_from=min((a for a, _ in known), default=None),
            acquired_to=max((b for _, b in known), default=None),
            coarser_lods=self.settings.building.lods[:-1],
        )

    @property
    def gps_kind(self) -> GpsTimeKind:
        """Whether the GPS times of all inputs tell dates."""
        kinds = {info.gps_time_kind for info in self.plan.sources}
        return kinds.pop() if len(kinds) == 1 else GpsTimeKind.NONE

    def publish(
        self, splits: Splits, joined: Joined, models: Models, reference: SpatialReference, run_dir: str
    ) -> list[Published]:
        """Write every tile; what became of each, in their order."""
        rejected: dict[Tile, list[RejectedSite]] = {}
        for site in joined.rejected:
            rejected.setdefault(site.owner, []).append(site)
        owners = sorted({*models.places, *rejected, *splits.places})
        context = self.record_context(reference)
        stage = publishing(run_dir)
        storage = storage_at(run_dir)
        # a folder of scratch that ends with its run begins with an empty run directory, which need not be listed
        there = {PurePosixPath(name).stem for name in storage.keys("state")} if self.scratch.attempt else set()
        tasks = {}
        for tile in owners:
            task = PublishTask(
                tile=tile,
                run_dir=run_dir,
                scratch=self.scratch,
                batches=tuple(models.places.get(tile, ())),
                rejected=tuple(rejected.get(tile, ())),
                context=context,
                meshes=self.meshes,
                again=tile.key in there,
                empty_tables=not models.places and not rejected and tile == owners[0],
            )
            key = key_of(run_dir, task.batches, task.rejected, _told_context(context), task.meshes, task.empty_tables)
            tasks[Place(stage, tile.key, key)] = task
        # what somebody removed from the run directory is published again
        drop_stale(self.scratch, stage, [place for place in tasks if place.unit in there])
        published = self.progress.kept(
            self.executor, "publish", publish, tasks, self.scratch, whole, failures=lambda told: int(bool(told.error))
        )
        for tile_key in sorted(there - {tile.key for tile in owners}):
            retire(storage, Tile.from_key(tile_key))
        for place, outcome in published.items():
            if outcome.warning:
                self.progress.warn("publish", outcome.warning)
            if outcome.error:
                self.progress.warn("publish", f"tile {outcome.tile.key} failed: {outcome.error}")
                Path(self.scratch.root, place.name).unlink(missing_ok=True)  # to be tried again by whoever goes on
        return list(published.values())


def _failed_of(models: Sequence[Modelled]) -> int:
    """How many buildings of a batch failed."""
    return sum(model.status == Status.FAILED.value for model in models)


def _told_context(context: RecordContext) -> tuple[object, ...]:
    """What of a run goes into its records."""
    return (
        context.reference,
        context.settings_hash,
        context.engine_version,
        context.acquired_from,
        context.acquired_to,
        context.coarser_lods,
    )


def content_by_tile(ingested: Sequence[Ingested]) -> dict[Tile, ZoneSums]:
    """What points each tile holds, over all inputs."""
    content: dict[Tile, ZoneSums] = {}
    for found in ingested:
        for tile, stored in found.content.items():
            sums = zone_sums_of(stored)
            content[tile] = content[tile] + sums if tile in content else sums
    return content


def by_owner(sites: Sequence[CandidateSite]) -> dict[Tile, list[CandidateSite]]:
    """Candidates by the tile that publishes them, in their order."""
    found: dict[Tile, list[CandidateSite]] = {}
    for site in sites:
        found.setdefault(site.owner, []).append(site)
    return found


def blocks_by_tile(sites: Sequence[CandidateSite]) -> dict[Tile, list[CandidateSite]]:
    """Units by the first of the tiles that own some of their block, in their order."""
    home: dict[str, Tile] = {}
    for site in sites:
        if site.block is not None:
            home[site.block] = min(home.get(site.block, site.owner), site.owner)
    found: dict[Tile, list[CandidateSite]] = {}
    for site in sites:
        if site.block is not None:
            found.setdefault(home[site.block], []).append(site)
    return found
