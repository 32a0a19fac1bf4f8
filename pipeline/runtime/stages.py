"""The stages of a run, each a map of a plain function over tasks, or a step of the driver."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, TypeVar

import shapely
from shapely import MultiPolygon, Polygon

from pipeline import __version__
from pipeline.errors import EmptyInputError, InconsistentInputError
from pipeline.export.records import RecordContext
from pipeline.io import SpatialReference
from pipeline.io.footprints import read_footprints
from pipeline.io.gps_time import GpsTimeKind
from pipeline.runtime.events import Event, EventKind, Listener, Watch
from pipeline.runtime.executors import Executor
from pipeline.runtime.ingest import Ingested, IngestTask, ingest, spread_m
from pipeline.runtime.isolation import IsolationLimits
from pipeline.runtime.join import CandidateSite, Joined, PointRange, RejectedSite, join, join_footprints
from pipeline.runtime.modelling import BatchTask, Modelled, StoredResult, batches, model_batch, stored_results
from pipeline.runtime.outlines import draw_outlines, outline_tasks
from pipeline.runtime.overrides import Override, own_modelling
from pipeline.runtime.overriding import EntryOutcome, accepts, layers_of, outcomes_of, overridden
from pipeline.runtime.plan import Plan, check_windows, split_grid
from pipeline.runtime.publish import PublishTask, publish
from pipeline.runtime.scratch import Scratch
from pipeline.runtime.split import Split, SplitTask, split
from pipeline.runtime.units import divide, unit_tasks
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS, ClassesInUse
from pipeline.settings import RunSettings
from pipeline.tiling import MM, Tile

Task = TypeVar("Task")
Result = TypeVar("Result")

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
            "path": path,
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
        found.index
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


class Progress:
    """What a run learns about itself: timings, peak memory, warnings; all of it told to the listener.

    Parameters
    ----------
    listener : callable
        Gets the events.
    watch : Watch
        Handed to the executor with every map.
    """

    def __init__(self, listener: Listener, watch: Watch | None = None) -> None:
        self._listener = listener
        self.watch = watch or Watch(listener=listener)
        self.timings: dict[str, float] = {}
        self.peaks: dict[str, int] = {}
        self.warnings: list[str] = []
        self._part, self._parts, self._label = 0, 1, ""

    def part(self, number: int, parts: int, label: str) -> Progress:
        """The progress of one of several equal parts of what follows: a copy that knows what was before.

        Parameters
        ----------
        number : int
            Which part, from 0.
        parts : int
            Of how many; done and total of a stage count all of them, one after the other.
        label : str
            What messages call it.
        """
        own = Progress(self._listener, self.watch)
        own.timings, own.peaks, own.warnings = dict(self.timings), dict(self.peaks), list(self.warnings)
        own._part, own._parts, own._label = number, parts, label
        return own

    def tell(self, kind: EventKind, stage: str, message: str = "", done: int = 0, total: int = 0) -> None:
        """Send an event."""
        self._listener(Event(kind=kind, stage=stage, done=done, total=total, message=message))

    def warn(self, stage: str, message: str) -> None:
        """Keep and send a warning."""
        if message not in self.warnings:
            self.warnings.append(message)
            self.tell("warning", stage, message)

    def stage(
        self,
        executor: Executor,
        name: str,
        function: Callable[[Task], Result],
        tasks: Sequence[Task],
        weight: Callable[[Result], int] = lambda _: 1,
        total: int | None = None,
    ) -> list[Result]:
        """Run a stage's tasks and report its progress in units of `weight`."""
        started = time.perf_counter()
        whole = len(tasks) if total is None else total
        done, all_parts = self._part * whole, self._parts * whole
        self.tell("stage", name, self._label, done=done, total=all_parts)
        results = []
        # closed at once where the listener raises, so that no task goes on for nobody
        with contextlib.closing(executor.map(name, function, tasks, self.watch)) as running:
            for measured in running:
                results.append(measured.result)
                self.peaks[measured.process] = max(self.peaks.get(measured.process, 0), measured.peak_bytes)
                done += weight(measured.result)
                self.tell("progress", name, done=done, total=all_parts)
        self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - started
        return results


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
    quarantine: str = ""
    """Folder for the bundles of buildings that cost their process; empty keeps none."""
    variant: int = 0
    """Which of the run's variants this is: keeps their models apart in scratch."""
    compared: bool = False
    """Whether there are several variants, whose seconds are told side by side."""

    def ingest(self, paths: Sequence[str]) -> list[Ingested]:
        """Bucket all points by tile, and look at what they are."""
        known = {info.path: info for info in self.plan.sources}
        tasks = [
            IngestTask(
                index=k,
                path=path,
                options=self.plan.options,
                grid=self.plan.grid,
                scratch=self.scratch,
                known=known.get(path),
            )
            for k, path in enumerate(paths)
        ]
        ingested = sorted(self.progress.stage(self.executor, "ingest", ingest, tasks), key=lambda found: found.index)
        for found in ingested:
            for warning in found.warnings:
                self.progress.warn("ingest", f"{paths[found.index]}: {warning}")
        kept = sum(sum(found.points_by_tile.values()) for found in ingested)
        if kept == 0:
            causes = Counter[str]()
            for found in ingested:
                causes.update(found.dropped)
            told = ", ".join(f"{count} {cause}" for cause, count in causes.items() if count)
            raise EmptyInputError(
                paths[0],
                f"no usable point is left ({told or 'none in the files'})",
                "Check --bbox and --aoi; points that are withheld or of the noise classes 7 and 18 are never used",
            )
        spread = spread_m(ingested)
        if spread < _LINE_SPREAD_M:
            raise InconsistentInputError(
                paths[0],
                f"all {kept} points lie on one line (they stray {spread:.3f} m from it)",
                "Check the columns and the scale of the file",
            )
        return ingested

    def split(
        self, ingested: Sequence[Ingested], footprints: GivenFootprints | None, only: Collection[Tile] | None = None
    ) -> list[Split]:
        """Fragments of all tiles, or of some only."""
        tiles = points_by_tile(ingested)
        classes, told = classes_in_use(ingested, trust=self.settings.general.classes == "trust")
        grid = split_grid(self.plan, self.settings, classes, footprints=footprints is not None)
        check_windows(self.plan, grid, tiles, self.executor.memory_limit_bytes)
        if only is not None:
            tiles = Counter({tile: points for tile, points in tiles.items() if tile in only})
        if told:
            self.progress.warn("split", told)
        numbers_of = {} if footprints is None else self._numbers_of(tiles, footprints.polygons)
        tasks = [
            SplitTask(
                tile=tile,
                grid=grid,
                settings=self.settings.scene,
                classes=classes,
                scratch=self.scratch,
                footprints=None if footprints is None else tuple((k, footprints.polygons[k]) for k in numbers_of[tile]),
            )
            # the fullest first, so that no long task is left for the end
            for tile, _ in sorted(tiles.items(), key=lambda item: (-item[1], item[0]))
        ]
        splits = self.progress.stage(self.executor, "split", split, tasks)
        duplicates, outliers = sum(s.duplicates for s in splits), sum(s.outliers for s in splits)
        if duplicates:
            self.progress.warn("split", f"{duplicates} duplicated points were dropped")
        if outliers:
            self.progress.warn("split", f"{outliers} gross outliers were left out")
        return splits

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
        numbers_of = self._numbers_of(points_by_tile(ingested), polygons)
        tasks = [
            SplitTask(
                tile=tile,
                grid=grid,
                settings=self.settings.scene,
                classes=classes,
                scratch=self.scratch,
                footprints=tuple((k, polygons[k]) for k in numbers),
                folder=folder,
            )
            for tile, numbers in sorted(numbers_of.items())
            if numbers
        ]
        splits = self.progress.stage(self.executor, "redraw", split, tasks)
        sites = join_footprints(splits, self.plan.grid, polygons, [name for name, _ in named], "").candidates
        return {
            str(site.source_id): tuple(dataclasses.replace(part, folder=folder) for part in site.ranges)
            for site in sites
        }

    def join(self, splits: Sequence[Split], footprints: GivenFootprints | None, reference: SpatialReference) -> Joined:
        """Whole surfaces, judged."""
        started = time.perf_counter()
        self.progress.tell("stage", "join", total=1)
        crs_name = f"EPSG:{reference.epsg}" if reference.epsg is not None else reference.name
        if footprints is None:
            joined = self._divided(join(splits, self.plan.grid, self.settings.scene.candidates, crs_name), crs_name)
        else:
            joined = join_footprints(
                splits, self.plan.grid, footprints.polygons, footprints.ids, crs_name, footprints.attributes
            )
        self.progress.timings["join"] = time.perf_counter() - started
        self.progress.tell("progress", "join", done=1, total=1, message=f"{len(joined.candidates)} candidates")
        return joined

    def _divided(self, joined: Joined, crs_name: str) -> Joined:
        """The candidates with their units told apart; part of the join, so no stage of its own."""
        settings = self.settings.scene.units
        if settings.split == "nothing":
            return joined
        tasks = unit_tasks(joined.candidates, settings, self.plan.grid, self.scratch, crs_name)
        sites: list[CandidateSite] = []
        with contextlib.closing(self.executor.map("join", divide, tasks, self.progress.watch)) as running:
            for measured in running:
                sites.extend(measured.result)
                peaks = self.progress.peaks
                peaks[measured.process] = max(peaks.get(measured.process, 0), measured.peak_bytes)
        return dataclasses.replace(joined, candidates=tuple(sorted(sites, key=lambda c: (-c.points, c.building_id))))

    def outline(self, joined: Joined) -> Joined:
        """The candidates with the outlines of touching units, drawn together."""
        tasks = outline_tasks(joined.candidates, self.settings.building.roof, self.plan.grid, self.scratch)
        outlines: dict[str, MultiPolygon] = {}
        warnings: list[str] = []
        for drawn in self.progress.stage(self.executor, "outline", draw_outlines, tasks):
            outlines |= drawn.outlines
            warnings.extend(drawn.warnings)
        for warning in sorted(warnings):
            self.progress.warn("outline", warning)
        sites = (
            dataclasses.replace(site, outline=outlines.get(site.building_id)) if site.block is not None else site
            for site in joined.candidates
        )
        return dataclasses.replace(joined, candidates=tuple(sites))

    def reconstruct(self, joined: Joined) -> list[Modelled]:
        """All candidates, largest first."""
        tasks = [
            BatchTask(
                number=number,
                sites=sites,
                method=self.settings.general.method,
                settings=self.settings.building,
                grid=self.plan.grid,
                scratch=self.scratch,
                gps_kind=self.gps_kind,
                isolation=self.isolation,
                quarantine=self.quarantine,
                reference=self.plan.sources[0].reference,
                own={
                    site.building_id: own_modelling(site.override, self.settings)
                    for site in sites
                    if site.override is not None and site.override.remodels
                },
                compared=self.compared,
            )
            for number, sites in self._numbered(joined)
        ]
        parts = self.progress.stage(
            self.executor, "reconstruct", model_batch, tasks, weight=len, total=len(joined.candidates)
        )
        return [building for part in parts for building in part]

    def _numbered(self, joined: Joined) -> list[tuple[int, tuple[CandidateSite, ...]]]:
        """The batches of this variant, by numbers that no other variant uses."""
        groups = batches(joined.candidates)
        return list(enumerate(groups, start=self.variant * len(groups)))

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

    def stored(self, joined: Joined) -> Iterator[tuple[Tile, list[StoredResult]]]:
        """The models of all candidates, after `reconstruct`, one owner tile at a time."""
        numbers: dict[Tile, list[int]] = {}
        for number, sites in self._numbered(joined):
            for tile in {site.owner for site in sites}:
                numbers.setdefault(tile, []).append(number)
        for tile in sorted(numbers):
            yield tile, [entry for number in numbers[tile] for entry in stored_results(self.scratch, tile, number)]

    @property
    def gps_kind(self) -> GpsTimeKind:
        """Whether the GPS times of all inputs tell dates."""
        kinds = {info.gps_time_kind for info in self.plan.sources}
        return kinds.pop() if len(kinds) == 1 else GpsTimeKind.NONE

    def publish(
        self,
        splits: Sequence[Split],
        joined: Joined,
        modelled: Sequence[Modelled],
        reference: SpatialReference,
        run_dir: str,
    ) -> tuple[list[str], list[str]]:
        """Write every tile; the keys of all, and of those that failed."""
        batch_of = {site.building_id: number for number, sites in self._numbered(joined) for site in sites}
        numbers: dict[Tile, set[int]] = {}
        for building in modelled:
            numbers.setdefault(building.owner, set()).add(batch_of[building.building_id])
        rejected: dict[Tile, list[RejectedSite]] = {}
        for site in joined.rejected:
            rejected.setdefault(site.owner, []).append(site)
        owners = sorted({*numbers, *rejected, *(s.tile for s in splits)})
        context = self.record_context(reference)
        tasks = [
            PublishTask(
                tile=tile,
                run_dir=run_dir,
                scratch=self.scratch,
                batches=tuple(sorted(numbers.get(tile, ()))),
                rejected=tuple(rejected.get(tile, ())),
                context=context,
                meshes=self.meshes,
                empty_tables=not numbers and not rejected and tile == owners[0],
            )
            for tile in owners
        ]
        published = self.progress.stage(self.executor, "publish", publish, tasks)
        failed = sorted(p.tile.key for p in published if p.error)
        for p in published:
            if p.error:
                self.progress.warn("publish", f"tile {p.tile.key} failed: {p.error}")
        return sorted(p.tile.key for p in published), failed
