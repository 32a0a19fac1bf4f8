"""The stages of a run, each a map of a plain function over tasks, or a step of the driver."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TypeVar

import shapely

from pipeline import __version__
from pipeline.errors import EmptyInputError, InconsistentInputError
from pipeline.export.records import RecordContext
from pipeline.io import SpatialReference
from pipeline.io.footprints import read_footprints
from pipeline.io.gps_time import GpsTimeKind
from pipeline.runtime.events import Event, EventKind, Listener
from pipeline.runtime.executors import Executor
from pipeline.runtime.ingest import Ingested, IngestTask, ingest, spread_m
from pipeline.runtime.join import Joined, RejectedSite, join, join_footprints
from pipeline.runtime.modelling import BatchTask, Footprints, Modelled, batches, model_batch
from pipeline.runtime.plan import Plan
from pipeline.runtime.publish import PublishTask, publish
from pipeline.runtime.scratch import Scratch
from pipeline.runtime.split import Split, SplitTask, split
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS, ClassesInUse
from pipeline.settings import RunSettings
from pipeline.tiling import MM, Tile

Task = TypeVar("Task")
Result = TypeVar("Result")

_LINE_SPREAD_M = 0.05
_FOOTPRINTS = "footprints.pickle"


class Progress:
    """What a run learns about itself: timings, peak memory, warnings; all of it told to the listener.

    Parameters
    ----------
    listener : callable
        Gets the events.
    """

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self.timings: dict[str, float] = {}
        self.task_seconds: dict[str, float] = {}
        self.peaks: dict[str, int] = {}
        self.warnings: list[str] = []

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
        done = 0
        self.tell("stage", name, total=whole)
        results = []
        for measured in executor.map(name, function, tasks):
            results.append(measured.result)
            self.peaks[measured.process] = max(self.peaks.get(measured.process, 0), measured.peak_bytes)
            self.task_seconds[name] = self.task_seconds.get(name, 0.0) + measured.seconds
            done += weight(measured.result)
            self.tell("progress", name, done=done, total=whole)
        self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - started
        return results


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stages:
    """The stages of one run, each a map over tasks or a step of the driver."""

    settings: RunSettings
    footprints_path: str | None
    meshes: str
    plan: Plan
    progress: Progress
    executor: Executor
    scratch: Scratch

    def ingest(self, paths: Sequence[str]) -> list[Ingested]:
        """Bucket all points by tile, and look at what they are."""
        tasks = [
            IngestTask(index=k, path=path, options=self.plan.options, grid=self.plan.grid, scratch=self.scratch)
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
                paths[0], f"no usable point is left ({told or 'none in the files'})", "Check --bbox, --aoi and classes"
            )
        spread = spread_m(ingested)
        if spread < _LINE_SPREAD_M:
            raise InconsistentInputError(
                paths[0],
                f"all {kept} points lie on one line (they stray {spread:.3f} m from it)",
                "Check the columns and the scale of the file",
            )
        return ingested

    def read_footprints(self, reference: SpatialReference) -> Footprints | None:
        """The given footprints, stored for the workers."""
        if self.footprints_path is None:
            return None
        found = read_footprints(self.footprints_path, reference)
        for warning in found.warnings:
            self.progress.warn("split", warning)
        low_x, low_y = min(i.bounds_m[0] for i in self.plan.sources), min(i.bounds_m[1] for i in self.plan.sources)
        high_x, high_y = max(i.bounds_m[3] for i in self.plan.sources), max(i.bounds_m[4] for i in self.plan.sources)
        box = shapely.box(low_x, low_y, high_x, high_y)
        inside = [k for k, polygon in enumerate(found.polygons) if polygon.intersects(box)]
        if len(inside) < len(found.polygons):
            self.progress.warn(
                "split", f"{len(found.polygons) - len(inside)} of {len(found.polygons)} footprints lie off the data"
            )
        # one order, whatever the file's: overlaps are decided by it
        inside.sort(key=lambda k: (found.polygons[k].bounds, found.ids[k]))
        footprints = Footprints(
            polygons=tuple(found.polygons[k] for k in inside), ids=tuple(found.ids[k] for k in inside)
        )
        self.scratch.put_object(_FOOTPRINTS, footprints)
        return footprints

    def split(self, ingested: Sequence[Ingested], footprints: Footprints | None) -> list[Split]:
        """Fragments of all tiles."""
        histogram: Counter[int] = Counter()
        tiles: Counter[Tile] = Counter()
        for found in ingested:
            histogram.update(found.classes)
            tiles.update(found.points_by_tile)
        trust = self.settings.general.classes == "trust"
        classes = ClassesInUse(
            ground=trust and histogram[GROUND_CLASS] > 0, building=trust and histogram[BUILDING_CLASS] > 0
        )
        tasks = [
            SplitTask(
                tile=tile,
                grid=self.plan.grid,
                settings=self.settings.scene,
                classes=classes,
                scratch=self.scratch,
                footprints=None if footprints is None else _FOOTPRINTS,
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

    def join(self, splits: Sequence[Split], footprints: Footprints | None, reference: SpatialReference) -> Joined:
        """Whole surfaces, judged."""
        started = time.perf_counter()
        self.progress.tell("stage", "join", total=1)
        crs_name = f"EPSG:{reference.epsg}" if reference.epsg is not None else reference.name
        if footprints is None:
            joined = join(splits, self.plan.grid, self.settings.scene.candidates, crs_name)
        else:
            corners = []
            for number, polygon in enumerate(footprints.polygons):
                x, y = min(map(tuple, shapely.get_coordinates(polygon).tolist()))
                corners.append((round(x * MM), round(y * MM), number))
            joined = join_footprints(splits, self.plan.grid, corners, crs_name)
        self.progress.timings["join"] = time.perf_counter() - started
        self.progress.tell("progress", "join", done=1, total=1, message=f"{len(joined.candidates)} candidates")
        return joined

    def reconstruct(self, joined: Joined, footprints: Footprints | None) -> list[Modelled]:
        """All candidates, largest first."""
        kinds = {info.gps_time_kind for info in self.plan.sources}
        kind = kinds.pop() if len(kinds) == 1 else GpsTimeKind.NONE
        tasks = [
            BatchTask(
                number=number,
                sites=sites,
                method=self.settings.general.method,
                settings=self.settings.building,
                grid=self.plan.grid,
                scratch=self.scratch,
                footprints=None if footprints is None else _FOOTPRINTS,
                gps_kind=kind,
            )
            for number, sites in enumerate(batches(joined.candidates))
        ]
        parts = self.progress.stage(
            self.executor, "reconstruct", model_batch, tasks, weight=len, total=len(joined.candidates)
        )
        return [building for part in parts for building in part]

    def publish(
        self, joined: Joined, modelled: Sequence[Modelled], reference: SpatialReference, run_dir: str
    ) -> list[str]:
        """Write every tile that owns something; their keys."""
        batch_of = {
            site.building_id: number for number, sites in enumerate(batches(joined.candidates)) for site in sites
        }
        numbers: dict[Tile, set[int]] = {}
        for building in modelled:
            numbers.setdefault(building.owner, set()).add(batch_of[building.building_id])
        rejected: dict[Tile, list[RejectedSite]] = {}
        for site in joined.rejected:
            rejected.setdefault(site.owner, []).append(site)
        owners = sorted({*numbers, *rejected})
        times = [(i.acquired_from, i.acquired_to) for i in self.plan.sources]
        known = [(a, b) for a, b in times if a is not None and b is not None]
        context = RecordContext(
            reference=reference,
            settings_hash=self.settings.settings_hash,
            engine_version=__version__,
            acquired_from=min((a for a, _ in known), default=None),
            acquired_to=max((b for _, b in known), default=None),
        )
        tasks = [
            PublishTask(
                tile=tile,
                run_dir=run_dir,
                scratch=self.scratch,
                batches=tuple(sorted(numbers.get(tile, ()))),
                rejected=tuple(rejected.get(tile, ())),
                context=context,
                meshes=self.meshes,
            )
            for tile in owners
        ]
        published = self.progress.stage(self.executor, "publish", publish, tasks)
        return sorted(p.tile.key for p in published)
