"""The points of one tile as an octree: with their classes, their buildings, and their distances to the models."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from pipeline.errors import RunCancelledError
from pipeline.export.folders import POINTS_FOLDER
from pipeline.extras.classify.label import LabelTask, classes_of_tile, places_of, records_within
from pipeline.extras.classify.point_classes import index_of_each
from pipeline.extras.octree.coarse_terrain import TerrainPart, terrain_part
from pipeline.extras.octree.octree_tileset import node_error_m, tile_tileset
from pipeline.extras.octree.point_files import INDEX, TILESET
from pipeline.extras.octree.point_glb import (
    NO_BUILDING,
    NO_PLANE,
    NO_RESIDUAL,
    ModelledPoints,
    ShortArray,
    UShortArray,
    points_glb,
)
from pipeline.extras.octree.point_octree import Cube, Octree, octree_of
from pipeline.io import Storage, storage_at
from pipeline.model import BuildingResult, IntArray
from pipeline.quality.residuals import surface_of
from pipeline.runtime.scratch.outcomes import InParts, Place
from pipeline.runtime.stages.model_batch import stored_results
from pipeline.runtime.stages.sites import PointRange
from pipeline.tiling import MM, Tile

_RESIDUAL_LIMIT_MM = 32_767


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileBuilding:
    """A building with points in a tile."""

    building_id: str
    """Its id."""
    ranges: tuple[PointRange, ...]
    """Its points in this tile."""
    tiles: tuple[str, ...]
    """Keys of all tiles with points of it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointsTask:
    """One tile."""

    label: LabelTask
    """How its points are classified."""
    run_dir: str
    """Where the files go."""
    batches: tuple[Place, ...]
    """Outcomes of the batches that modelled them."""
    above: int
    """Number of coarser levels above the tiles of the run."""
    terrain_spacing: int
    """Metres between the nodes of the terrain."""
    memory_bytes: int
    """Estimated peak memory of the process."""
    again: bool = False
    """Whether the tile's points were written there before: files that it no longer has are removed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TilePoints:
    """What the driver needs of a tile's points."""

    tile: Tile
    """The tile."""
    origin_mm: tuple[int, int, int]
    """Origin of the coordinates in its files; whole metres."""
    low_mm: tuple[int, int, int]
    """Smallest coordinates of its points."""
    high_mm: tuple[int, int, int]
    """The largest."""
    points: int
    """Points in the nodes of its octree, without those of the coarser levels above."""
    error_m: float
    """Geometric error of its octree's root."""
    classes: Mapping[int, int]
    """All its points by class."""
    terrain: TerrainPart | None
    """The nodes of the terrain; None where its points could not be written."""
    error: str = ""
    """Why they could not be written; empty where they were."""


def write_tile_points(task: PointsTask) -> InParts[TilePoints]:
    """Write the octree of one tile; may run twice. Its parts are its shares of the coarser levels, the next one first.

    A tile that fails harms only itself: the brief says why.
    """
    storage, tile = storage_at(task.run_dir), task.label.tile
    try:
        return _written(task, storage)
    except RunCancelledError:
        raise
    except Exception as fault:  # noqa: BLE001 - goes into the warnings, the manifest and the exit code
        task.label.scratch.check_cancelled()
        nothing = TilePoints(
            tile=tile, origin_mm=(0, 0, 0), low_mm=(0, 0, 0), high_mm=(0, 0, 0), points=0, error_m=0.0, classes={},
            terrain=None, error=f"{type(fault).__name__}: {fault}",
        )  # fmt: skip
        return InParts(brief=nothing, parts=())


def _written(task: PointsTask, storage: Storage) -> InParts[TilePoints]:
    tile, scratch = task.label.tile, task.label.scratch
    buildings = buildings_in(task.label)
    points, origin_mm = modelled_points(task, buildings)
    scratch.check_cancelled()
    core, side_mm = task.label.grid.core(tile), task.label.grid.size_mm
    while side_mm <= int(points.xyz_mm[:, 2].max()):
        side_mm *= 2
    cube = Cube(corner_mm=(core.x0_mm - origin_mm[0], core.y0_mm - origin_mm[1], 0), side_mm=side_mm)
    # what points of one place carry gives them an order
    ties = (points.point_class.astype(np.int64) << 32) | (points.building.astype(np.int64) << 16) | points.plane
    tree = octree_of(points.xyz_mm, ties, cube, task.above)
    folder = f"{POINTS_FOLDER}/{tile.key}"
    origin_m = [value // MM for value in origin_mm]
    written = set()
    with storage.several(scratch.check_cancelled) as puts:
        for node in tree.nodes:
            content = points_glb(points.take(node.index), f"{tile.key}/{node.path}", {"origin_m": origin_m})
            puts.put(f"{folder}/{node.path}.glb", content)
            written.add(f"{folder}/{node.path}.glb")
        puts.wait()
        if tree.nodes:
            puts.put(f"{folder}/{TILESET}", tile_tileset(tree.nodes, {"origin_m": origin_m}))
            written.add(f"{folder}/{TILESET}")
            puts.wait()
        # last: a tile with this file is complete
        puts.put(f"{folder}/{INDEX}", _index(buildings, points, tree))
        written.add(f"{folder}/{INDEX}")
    if task.again:
        for name in sorted(set(storage.keys(folder)) - written):
            storage.delete(name)
    low, high = (edge(axis=0) + np.array(origin_mm) for edge in (points.xyz_mm.min, points.xyz_mm.max))
    histogram = np.bincount(points.point_class)
    brief = TilePoints(
        tile=tile,
        origin_mm=origin_mm,
        low_mm=_triple(low),
        high_mm=_triple(high),
        points=sum(len(node.index) for node in tree.nodes),
        error_m=node_error_m(tree.nodes[0].spacing_m) if tree.nodes else 0.0,
        classes={int(code): int(histogram[code]) for code in np.flatnonzero(histogram)},
        terrain=terrain_part(scratch, task.label.grid, tile, task.terrain_spacing),
    )
    return InParts(brief=brief, parts=tuple(points.take(index) for index in tree.above))


def buildings_in(task: LabelTask) -> list[TileBuilding]:
    """The buildings with points in a tile, by id."""
    sites = (site for group in task.buildings if task.tile in group.figures.tiles for site in group.sites(task.scratch))
    return sorted(
        (
            TileBuilding(
                building_id=site.building_id,
                ranges=tuple(part for part in site.ranges if part.tile == task.tile),
                tiles=tuple(sorted({part.tile.key for part in site.ranges})),
            )
            for site in sites
            if any(part.tile == task.tile for part in site.ranges)
        ),
        key=lambda one: one.building_id,
    )


def modelled_points(task: PointsTask, buildings: Sequence[TileBuilding]) -> tuple[ModelledPoints, tuple[int, int, int]]:
    """The points of a tile, at least one, about an origin; and that origin, in whole metres."""
    classes = classes_of_tile(task.label)
    records = classes.core
    core = task.label.grid.core(task.label.tile)
    origin_mm = (core.x0_mm // MM * MM, core.y0_mm // MM * MM, int(records["z"].min()) // MM * MM)
    xyz_mm = np.column_stack([records[name].astype(np.int64) for name in "xyz"])
    building, models = _buildings_of(task, buildings, records)
    names = tuple(one.building_id for one in buildings if one.building_id in models)
    plane = np.full(len(records), NO_PLANE, np.uint16)
    residual = np.full(len(records), NO_RESIDUAL, np.int16)
    number = np.full(NO_BUILDING + 1, NO_BUILDING, np.uint16)
    order = np.argsort(building, kind="stable")
    starts = np.searchsorted(building[order], np.arange(len(buildings) + 1))
    for k, one in enumerate(buildings):
        model = models.get(one.building_id)
        if model is None:
            continue
        number[k] = names.index(one.building_id)
        index = order[starts[k] : starts[k + 1]]
        plane[index], residual[index] = _distances(xyz_mm[index], model)
    points = ModelledPoints(
        xyz_mm=xyz_mm - np.array(origin_mm),
        point_class=classes.of(records),
        building=number[building],
        plane=plane,
        residual_mm=residual,
        buildings=names,
    )
    return points, origin_mm


def _buildings_of(
    task: PointsTask, buildings: Sequence[TileBuilding], records: npt.NDArray[np.void]
) -> tuple[UShortArray, dict[str, BuildingResult]]:
    """The building of each record, (n,) by its number, and the models of those that are buildings."""
    held = np.full(len(records), NO_BUILDING, np.uint16)
    wanted = {one.building_id for one in buildings}
    stored = [entry for place in task.batches for entry in stored_results(task.label.scratch, place, wanted)]
    models = {entry.result.building_id: entry.result for entry in stored if not entry.is_rejected}
    core = task.label.grid.core(task.label.tile)
    parts = [(k, part) for k, one in enumerate(buildings) for part in one.ranges]
    if parts:
        pieces = [records_within(task.label.scratch, part, core) for _, part in parts]
        of_piece = np.repeat(np.array([k for k, _ in parts], np.uint16), [len(piece) for piece in pieces])
        at = index_of_each(*places_of(records), *places_of(np.concatenate(pieces)))
        held[at >= 0] = of_piece[at[at >= 0]]
    return held, models


def _distances(xyz_mm: IntArray, model: BuildingResult) -> tuple[UShortArray, ShortArray]:
    """The roof plane above or below each point, and the vertical distance to it in mm; both (n,)."""
    plane = np.full(len(xyz_mm), NO_PLANE, np.uint16)
    residual = np.full(len(xyz_mm), NO_RESIDUAL, np.int16)
    if model.faces:
        x, y, z = ((xyz_mm - np.rint(np.array(model.origin) * MM).astype(np.int64)) / MM).T
        top, face = surface_of(model.faces, model.planes).at(x, y)
        covered = np.flatnonzero(face >= 0)
        plane[covered] = np.array([one.plane for one in model.faces], np.uint16)[face[covered]]
        away = np.rint((z[covered] - top[covered]) * MM)
        residual[covered] = np.clip(away, -_RESIDUAL_LIMIT_MM, _RESIDUAL_LIMIT_MM)
    return plane, residual


def _index(buildings: Sequence[TileBuilding], points: ModelledPoints, tree: Octree) -> bytes:
    """The nodes that hold points of each building, as JSON, and the tiles that do."""
    nodes: dict[str, list[str]] = {name: [] for name in points.buildings}
    for node in tree.nodes:
        for k in np.unique(points.building[node.index]).tolist():
            if k != NO_BUILDING:
                nodes[points.buildings[k]].append(node.path)
    tiles = {one.building_id: list(one.tiles) for one in buildings}
    content = {name: {"nodes": nodes[name], "tiles": tiles[name]} for name in points.buildings}
    return json.dumps(content, separators=(",", ":")).encode()


def _triple(values: IntArray) -> tuple[int, int, int]:
    x, y, z = values.tolist()
    return x, y, z
