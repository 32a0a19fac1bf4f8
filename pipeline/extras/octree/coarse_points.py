"""The coarse nodes above the tiles of a run, and the root tilesets over its points.

Each tile leaves a share of its points to the coarser levels. A node above the tiles brings the shares of two by two
tiles together, the next one those of four by four, and so on: far away, a whole city is one request.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.export.folders import POINTS_FOLDER
from pipeline.extras.octree.coarse_terrain import terrain_document, terrain_spacing
from pipeline.extras.octree.octree_tileset import TilesetNode, node_error_m, root_tileset
from pipeline.extras.octree.point_files import COARSE, GLOBE_TILESET, TERRAIN, TILESET
from pipeline.extras.octree.point_glb import ModelledPoints, points_glb, united
from pipeline.extras.octree.point_octree import CELL_BITS, Cube
from pipeline.extras.octree.tile_points import TilePoints
from pipeline.extras.publish_3dtiles.globe import to_globe
from pipeline.io import storage_at
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.run_plan import Plan
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Place, drop_outcomes, key_of, part_of, whole
from pipeline.runtime.stages.cleanup import writing_points
from pipeline.tiling import MM, Tile, Window

Triple = tuple[int, int, int]


def coarse_levels(tiles: Sequence[Tile]) -> int:
    """Number of levels above some tiles that bring them into one node, or at most 7.

    >>> coarse_levels([Tile(4, 7)]), coarse_levels([Tile(4, 7), Tile(8, 7)])
    (0, 3)
    """
    columns, rows = [tile.column for tile in tiles], [tile.row for tile in tiles]
    span = 1 + max(max(columns) - min(columns), max(rows) - min(rows))
    return min(CELL_BITS, math.ceil(math.log2(span)))


@dataclasses.dataclass(frozen=True, kw_only=True)
class CoarseTask:
    """One node above the tiles."""

    key: str
    """Its path in the run directory."""
    run_dir: str
    """The run directory."""
    level: int
    """1 is just above the tiles."""
    shares: tuple[tuple[Place, tuple[int, int, int]], ...]
    """Outcomes of the tiles beneath it, and the origins of their points."""
    origin_mm: tuple[int, int, int]
    """Its own origin; whole metres."""
    scratch: Scratch
    """Where the outcomes are."""


def write_coarse(task: CoarseTask) -> int:
    """Write a node above the tiles, if it has points; the number of its points."""
    task.scratch.check_cancelled()
    parts = []
    for place, origin_mm in task.shares:
        share: ModelledPoints = part_of(task.scratch, place, task.level - 1)
        parts.append(share.moved(np.array(task.origin_mm) - np.array(origin_mm)))
    points = united(parts)
    if len(points):
        origin_m = [value // MM for value in task.origin_mm]
        content = points_glb(points, task.key, {"origin_m": origin_m})
        storage_at(task.run_dir).put(f"{POINTS_FOLDER}/{task.key}", content)
    return len(points)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Pyramid:
    """The nodes above the tiles."""

    tiles: Mapping[Place, TilePoints]
    """The tiles that were written."""
    west: int
    """Column of the westernmost tile of the run."""
    south: int
    """Row of the southernmost."""
    levels: int
    """Number of levels above the tiles."""

    def members(self) -> dict[Triple, list[tuple[Place, TilePoints]]]:
        """The tiles beneath each node, by its level, column and row."""
        found: dict[Triple, list[tuple[Place, TilePoints]]] = {}
        for level in range(self.levels, 0, -1):
            for place, one in self.tiles.items():
                found.setdefault(self.above(one.tile, level), []).append((place, one))
        return found

    def above(self, tile: Tile, level: int) -> Triple:
        """The node of a level above a tile; at level 0 the tile's own place."""
        return level, (tile.column - self.west) >> level, (tile.row - self.south) >> level


def write_coarse_points(
    context: RunContext, tiles: Mapping[Place, TilePoints], all_tiles: Sequence[Tile], run_dir: str
) -> set[str]:
    """Write the nodes above the tiles, the terrain, then the root tilesets; the paths of all these files.

    `tiles` are at least one of `all_tiles` of the run: those whose points were written.
    """
    scratch, storage = context.scratch, storage_at(run_dir)
    pyramid = _Pyramid(
        tiles=tiles,
        west=min(tile.column for tile in all_tiles),
        south=min(tile.row for tile in all_tiles),
        levels=coarse_levels(all_tiles),
    )
    tasks: dict[Place, CoarseTask] = {}
    stage = f"{writing_points(run_dir)}-above"
    drop_outcomes(scratch, stage, ())  # they are quickly made, and may have been removed from the run directory
    places = {}
    for at, members in pyramid.members().items():
        task = CoarseTask(
            key=f"{COARSE}/{'_'.join(map(str, at))}.glb",
            run_dir=run_dir,
            level=at[0],
            shares=tuple((place, one.origin_mm) for place, one in members),
            origin_mm=_edge([one.origin_mm for _, one in members], min),
            scratch=scratch,
        )
        places[at] = Place(stage, "_".join(map(str, at)), key_of(task.shares))
        tasks[places[at]] = task
    made = context.map_stored("octree", write_coarse, tasks, whole, quiet=True)
    counts = {at: made[place] for at, place in places.items()}
    root = _root(pyramid, context.plan, counts)
    extras = _extras(context.plan, tiles, sum(counts.values()), root)
    written = {f"{POINTS_FOLDER}/{tasks[places[at]].key}" for at, count in counts.items() if count}
    storage.put(f"{POINTS_FOLDER}/{TERRAIN}", _terrain(tiles.values(), terrain_spacing(all_tiles, context.plan.grid)))
    written.add(f"{POINTS_FOLDER}/{TERRAIN}")
    globe = to_globe(context.plan.reference)
    on_globe = None if globe is None else root_tileset(root, extras, globe)
    if on_globe is not None:
        storage.put(f"{POINTS_FOLDER}/{GLOBE_TILESET}", on_globe)
        written.add(f"{POINTS_FOLDER}/{GLOBE_TILESET}")
    content = root_tileset(root, extras)
    if content is not None:
        storage.put(f"{POINTS_FOLDER}/{TILESET}", content)
        written.add(f"{POINTS_FOLDER}/{TILESET}")
    return written


def _terrain(tiles: Collection[TilePoints], spacing: int) -> bytes:
    """The terrain within the bounds of the points."""
    low, high = _edge([one.low_mm for one in tiles], min), _edge([one.high_mm for one in tiles], max)
    bounds = Window(x0_mm=low[0], y0_mm=low[1], x1_mm=high[0], y1_mm=high[1])
    return terrain_document((one.terrain for one in tiles if one.terrain is not None), spacing, bounds)


def _root(pyramid: _Pyramid, plan: Plan, counts: Mapping[Triple, int]) -> TilesetNode:
    """The tree above the tiles."""
    square = Cube(corner_mm=(0, 0, 0), side_mm=plan.grid.size_mm)
    level_nodes: dict[Triple, TilesetNode] = {}
    for one in sorted(pyramid.tiles.values(), key=lambda one: one.tile):
        level_nodes[pyramid.above(one.tile, 0)] = TilesetNode(
            origin_mm=one.origin_mm,
            low_mm=one.low_mm,
            high_mm=one.high_mm,
            # what is missing without its points
            error_m=max(node_error_m(square.cell_m(-1)), one.error_m),
            uri=f"{one.tile.key}/{TILESET}" if one.points else None,
            points=one.points,
        )
    for level in range(1, pyramid.levels + 1):
        groups: dict[Triple, list[TilesetNode]] = {}
        for (_, column, row), node in level_nodes.items():
            groups.setdefault((level, column >> 1, row >> 1), []).append(node)
        level_nodes = {at: _above(children, at, counts[at], square) for at, children in groups.items()}
    nodes = list(level_nodes.values())
    if len(nodes) == 1:
        return nodes[0]
    return _above(nodes, (pyramid.levels + 1, 0, 0), 0, square)


def _above(children: Sequence[TilesetNode], at: Triple, points: int, square: Cube) -> TilesetNode:
    """The node above some nodes."""
    error_m = node_error_m(square.cell_m(-at[0]))
    return TilesetNode(
        origin_mm=_edge([child.origin_mm for child in children], min),
        low_mm=_edge([child.low_mm for child in children], min),
        high_mm=_edge([child.high_mm for child in children], max),
        error_m=max(error_m, *(child.error_m for child in children)),
        uri=f"{COARSE}/{'_'.join(map(str, at))}.glb" if points else None,
        points=points,
        children=tuple(child for child in children if child.uri is not None or child.children),
    )


def _extras(plan: Plan, tiles: Mapping[Place, TilePoints], above: int, root: TilesetNode) -> dict[str, Any]:
    """Where the coordinates lie, and what the points are."""
    reference, classes = plan.reference, Counter[int]()
    for one in tiles.values():
        classes.update(one.classes)
    code = reference.epsg
    return {
        "origin_m": [value // MM for value in root.origin_mm],
        "horizontal_unit_m": reference.horizontal_unit_m,
        "vertical_unit_m": reference.vertical_unit_m,
        "crs": None if code is None else f"https://www.opengis.net/def/crs/EPSG/0/{code}",
        "bounds_m": [[value / MM for value in corner] for corner in (root.low_mm, root.high_mm)],
        "n_points": above + sum(one.points for one in tiles.values()),
        "classes": {str(code): classes[code] for code in sorted(classes)},
        "residual_unit_m": 1 / MM,
        "terrain": TERRAIN,
    }


def _edge(corners: Sequence[Triple], edge: Any) -> Triple:
    """The smallest or largest of each coordinate."""
    x, y, z = (int(edge(values)) for values in zip(*corners, strict=True))
    return x, y, z
