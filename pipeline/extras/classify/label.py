"""Labelling: the class of every point of a tile, in the order in which ingest bucketed each input's points.

A bucket has the points of one input in one tile, in the order of the file. A second pass over the file meets them in
the same order, so one class per point is all that is stored: no index, no sorting.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from uuid import uuid4

import numpy as np
import numpy.typing as npt

from pipeline.extras.classify.point_classes import PointClass, PointEvidence, classes_of, index_of_each, support_m
from pipeline.model import BoolArray, ByteArray, IntArray, Reason
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages.sites import Joined, PointRange, StoredGroup, StoredRejected
from pipeline.runtime.stages.window_points import (
    LoadedWindow,
    bucket_paths,
    load_window,
    surroundings_of,
    terrain_around,
)
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS, VEGETATION_CLASSES, WindowPoints
from pipeline.terrain.ground import ground_points
from pipeline.terrain.lattice import height_above
from pipeline.terrain.terrain_settings import ClassesInUse, SceneSettings
from pipeline.tiling import MM, Tile, TileGrid, Window

FOLDER = "classes"


@dataclasses.dataclass(frozen=True, kw_only=True)
class LabelTask:
    """One tile."""

    tile: Tile
    """The tile."""
    grid: TileGrid
    """The lattice."""
    settings: SceneSettings
    """Outliers, ground and vegetation."""
    classes: ClassesInUse
    """Which of the file's classes are believed."""
    given: bool
    """Buildings are known by footprints or classes: no point leaves or joins them for its own evidence alone."""
    scratch: Scratch
    """Points and terrain in, classes out."""
    buildings: tuple[StoredGroup, ...]
    """The candidates that lie in a tile that the tile's neighbourhood meets, among others."""
    rejected: tuple[StoredRejected, ...] = ()
    """The bridges there, among other rejected objects."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Labelled:
    """What a tile held."""

    tile: Tile
    """The tile."""
    points: dict[int, int]
    """Points by class, duplicates included."""


def label_halo_m(settings: SceneSettings) -> float:
    """How far the classes of a tile look beyond its core."""
    return support_m(settings.vegetation)


def neighbourhood(tile: Tile, grid: TileGrid, settings: SceneSettings) -> Window:
    """What the labelling of a tile sees."""
    return grid.core(tile).grown(math.ceil(label_halo_m(settings) * MM))


def label(task: LabelTask) -> Labelled:
    """Classify the points of a tile.

    The classes are in scratch under `classes/<tile>/<input>.bin`, one byte per point of the bucket.
    """
    found = classes_of_tile(task)
    counts: Counter[int] = Counter()
    for path in bucket_paths(task.scratch, task.tile):
        records = np.fromfile(path, POINT)
        labels = found.of(records)
        histogram = np.bincount(labels)
        counts.update({int(code): int(histogram[code]) for code in np.flatnonzero(histogram)})
        target = class_path(task.scratch, task.tile, path.name)
        temporary = target.with_name(f".{target.name}.{uuid4().hex}.part")
        labels.tofile(temporary)
        temporary.replace(target)
    return Labelled(tile=task.tile, points=dict(counts))


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileClasses:
    """The classes of a tile's points."""

    core: npt.NDArray[np.void]
    """(n,) POINT, the points of the tile without exact duplicates."""
    first: IntArray
    """(n,) int64, their order by their count of returns."""
    found: ByteArray
    """(n,) uint8, the classes by what lies around them."""
    believed: ClassesInUse
    """Which of the file's classes are believed."""

    def of(self, records: npt.NDArray[np.void]) -> ByteArray:
        """The classes of records of the tile, (m,) uint8."""
        # points of one place and return number differ at most in their count of returns: the lowest decides for all
        at = self.first[index_of_each(*places_of(records), *places_of(self.core[self.first]))]
        return _believed(self.found[at], records["classification"], self.believed)


def classes_of_tile(task: LabelTask) -> TileClasses:
    """Classify the points of a tile by what lies around them."""
    task.scratch.check_cancelled()
    window = neighbourhood(task.tile, task.grid, task.settings)
    halo_mm = task.grid.core(task.tile).x0_mm - window.x0_mm
    loaded = load_window(task.scratch, dataclasses.replace(task.grid, halo_mm=halo_mm), task.tile)
    points, core = loaded.points, len(loaded.core)
    task.scratch.check_cancelled()
    wanted = np.zeros(len(points), np.bool_)
    wanted[:core] = True
    buildings, decks = ranges_near(task)
    evidence = evidence_of(task, loaded, window, buildings)
    found = classes_of(evidence, wanted, task.settings.vegetation, given=task.given)[:core]
    found[_held_by(task, decks, points, window)[:core] & (found != PointClass.GROUND)] = PointClass.BRIDGE_DECK
    first = np.argsort(points.return_count[:core], kind="stable")
    return TileClasses(core=loaded.core, first=first, found=found, believed=task.classes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SitesNear:
    """All stored sites by the tiles in which they lie."""

    groups: Mapping[Tile, Sequence[StoredGroup]]
    """The groups of which a candidate lies in the tile."""
    rejected: Mapping[Tile, Sequence[StoredRejected]]
    """Those of which a bridge lies in the tile."""

    @classmethod
    def of(cls, joined: Joined) -> SitesNear:
        """The sites of a run."""
        groups: dict[Tile, list[StoredGroup]] = {}
        rejected: dict[Tile, list[StoredRejected]] = {}
        for group in joined.groups:
            for tile in group.figures.tiles:
                groups.setdefault(tile, []).append(group)
        for listed in joined.rejected:
            for tile in listed.figures.bridges_in:
                rejected.setdefault(tile, []).append(listed)
        return cls(groups=groups, rejected=rejected)

    def groups_in(self, tiles: Iterable[Tile]) -> tuple[StoredGroup, ...]:
        """The groups of which a candidate lies in one of some tiles."""
        return tuple({(one.place, one.part): one for tile in tiles for one in self.groups.get(tile, ())}.values())

    def rejected_in(self, tiles: Iterable[Tile]) -> tuple[StoredRejected, ...]:
        """Those of which a bridge lies in one of some tiles."""
        return tuple({(one.place, one.part): one for tile in tiles for one in self.rejected.get(tile, ())}.values())


def ranges_near(task: LabelTask) -> tuple[list[PointRange], list[PointRange]]:
    """The points of the candidates and of the bridges in all tiles that the tile's neighbourhood meets."""
    near = set(task.grid.tiles_over(neighbourhood(task.tile, task.grid, task.settings)))
    buildings = (site for group in task.buildings for site in group.sites(task.scratch))
    decks = (
        site for listed in task.rejected for site in listed.sites(task.scratch) if site.verdict.reason is Reason.BRIDGE
    )
    return (
        [part for site in buildings for part in site.ranges if part.tile in near],
        [part for site in decks for part in site.ranges if part.tile in near],
    )


def class_path(scratch: Scratch, tile: Tile, bucket: str) -> Path:
    """Where the classes of a bucket are."""
    return scratch.path(FOLDER, tile.key, bucket)


def evidence_of(
    task: LabelTask, loaded: LoadedWindow, window: Window, buildings: Sequence[PointRange]
) -> PointEvidence:
    """What is known of the points of a tile's neighbourhood, of which some are those of `buildings`."""
    points = loaded.points
    around = surroundings_of(task.scratch, task.grid, window.grown(2 * MM))
    terrain = terrain_around(around)
    x, y, z = points.x_mm, points.y_mm, points.z_mm
    if task.classes.ground:
        ground = points.classification == GROUND_CLASS
    else:
        ground = ground_points(x, y, z, terrain, task.settings.ground)
    return PointEvidence(
        x_mm=x,
        y_mm=y,
        z_mm=z,
        height_mm=height_above(x, y, z, around.elevation_mm, around.column0, around.row0),
        rise_mm=-height_above(x, y, np.zeros_like(z), terrain.slope_mm, around.column0, around.row0),
        ground=ground,
        building=_held_by(task, buildings, points, window),
        outlier=~loaded.kept,
        echoes=points.return_count > 1,
    )


def _held_by(task: LabelTask, parts: Sequence[PointRange], points: WindowPoints, window: Window) -> BoolArray:
    """Mask of the points that some ranges hold."""
    if not parts:
        return np.zeros(len(points), np.bool_)
    records = np.concatenate([records_within(task.scratch, part, window) for part in parts])
    at = index_of_each(points.x_mm, points.y_mm, points.z_mm, points.return_number, *places_of(records))
    inside: BoolArray = at >= 0
    return inside


def records_within(scratch: Scratch, part: PointRange, window: Window) -> npt.NDArray[np.void]:
    """The records of a range that lie in a window, (m,) POINT."""
    stored = scratch.array(f"{part.folder}/{part.tile.key}", "points", mapped=True).view(POINT)
    records = np.array(stored[part.start : part.stop])
    return records[window.contains(records["x"], records["y"])]


def places_of(
    records: npt.NDArray[np.void],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64], ByteArray]:
    """Coordinates and return numbers of records, each in one piece."""
    return (
        np.ascontiguousarray(records["x"]),
        np.ascontiguousarray(records["y"]),
        records["z"].astype(np.int64),
        np.ascontiguousarray(records["return_number"]),
    )


def _believed(found: ByteArray, own: ByteArray, classes: ClassesInUse) -> ByteArray:
    """The classes, those of the file where they are believed."""
    labels = found.copy()
    if classes.ground:
        labels[own == GROUND_CLASS] = PointClass.GROUND
    if classes.building:
        labels[own == BUILDING_CLASS] = PointClass.BUILDING
    if classes.vegetation:
        labels[np.isin(own, VEGETATION_CLASSES) & (labels == PointClass.BUILDING)] = PointClass.VEGETATION
    return labels
