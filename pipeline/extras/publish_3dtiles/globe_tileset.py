"""The 3D Tiles 1.1 of a run's models: a tree over its tiles, coarse to fine (OGC 22-025r4).

Each tile of the run has two nodes: blocks, and the models that replace them near the viewer. Above are nodes for
squares of two by two tiles, four by four and so on, if they have at least `SKYLINE_FROM` buildings: they show the
`MOST_BLOCKS` largest of them as blocks, so that the first look at a city is one small file. Only the root may lack
content: where an inner node without content is far enough away not to be refined, a viewer shows a hole.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.export.tileset import node_entry, tileset_bytes
from pipeline.extras.publish_3dtiles.globe_glb import Content, Placed
from pipeline.model import FloatArray
from pipeline.tiling import Tile

MOST_BLOCKS = 1000
"""Most buildings in a node above the tiles; enough for a skyline, and some hundred kilobytes."""
SKYLINE_FROM = 4000
"""Fewest buildings of a square with such a node: those of one level then take a quarter of what blocks take at most,
and what replaces the lowest are some dozens of files."""
LEAST_ERROR_M = 5.0
"""Least geometric error of blocks: CesiumJS then shows models instead from about 300 m, whatever their roofs."""
TERRAIN_ERROR_M = 20.0
"""Geometric error of a place without its terrain: CesiumJS then shows terrain from about a kilometre."""

_RADIUS_M = 6_371_000.0
_MARGIN = np.array([[-1e-7, -1e-7, -0.02], [1e-7, 1e-7, 0.02]])
"""Regions are this much larger than the corners, in degrees (1 cm) and metres: those are rounded to 1 cm."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Node:
    """A node of the tree."""

    region: FloatArray
    """(2, 3) smallest and largest longitude, latitude (degrees), ellipsoidal height (m), of all below, too."""
    error_m: float
    """Geometric error: how far what is shown is from the models."""
    uri: str | None = None
    """Its file, relative to the tileset; None without one."""
    matrix: FloatArray | None = None
    """(4, 4) from its content to EPSG:4978; None without any."""
    children: tuple[Node, ...] = ()
    """What replaces it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Branch:
    """Some tiles of the run, and what the nodes above them need."""

    nodes: tuple[Node, ...]
    """The nodes that show them together; at least one."""
    blocks: tuple[Placed, ...]
    """The largest buildings below, as blocks, the largest first: one more than a node may have."""
    buildings: int
    """How many there are below."""


def blocks_of(blocks: Sequence[Placed]) -> tuple[Placed, ...]:
    """The largest of some blocks, as `Branch.blocks`; among equals the ids decide."""
    ordered = sorted(blocks, key=lambda block: (-block.size_m, block.record["building_id"]))
    return tuple(ordered[: MOST_BLOCKS + 1])


def grown(
    tiles: Sequence[Tile],
    leaf: Callable[[Tile], Branch | None],
    store: Callable[[str, Sequence[Placed], FloatArray], Content],
) -> Branch | None:
    """The tree over tiles, depth first: at any time it holds the blocks of a few nodes of each level.

    Parameters
    ----------
    tiles : sequence of Tile
        At least one tile.
    leaf : callable
        The branch of one tile; None if it has no models.
    store : callable
        Stores blocks about a region under the name of a node.
    """
    if len(tiles) == 1:
        return leaf(tiles[0])
    column, row = min(tile.column for tile in tiles), min(tile.row for tile in tiles)
    level = max(max(tile.column - column, tile.row - row) for tile in tiles).bit_length()
    quarters: dict[tuple[int, int], list[Tile]] = {}
    for tile in sorted(tiles):
        quarter = (tile.column - column) >> (level - 1), (tile.row - row) >> (level - 1)
        quarters.setdefault(quarter, []).append(tile)
    found = [grown(quarters[quarter], leaf, store) for quarter in sorted(quarters)]
    branches = [branch for branch in found if branch is not None]
    if len(branches) < 2:
        return branches[0] if branches else None
    nodes = tuple(node for branch in branches for node in branch.nodes)
    blocks = blocks_of([block for branch in branches for block in branch.blocks])
    count = sum(branch.buildings for branch in branches)
    if count >= SKYLINE_FROM:
        region = _region_around(nodes)
        content = store(f"x{column}_y{row}_{2**level}", blocks[:MOST_BLOCKS], region)
        # the largest building that is not shown
        error_m = max(round(blocks[MOST_BLOCKS].size_m, 3), *(node.error_m for node in nodes))
        nodes = (Node(region=region, error_m=error_m, uri=content.uri, matrix=content.matrix, children=nodes),)
    return Branch(nodes=nodes, blocks=blocks, buildings=count)


def terrain_node(content: Content, region: FloatArray) -> Node:
    """The node of a tile's terrain, which has no coarser content: nothing far away, then all."""
    shown = Node(region=region, error_m=0.0, uri=content.uri, matrix=content.matrix)
    return Node(region=region, error_m=TERRAIN_ERROR_M, children=(shown,))


def _region_around(nodes: Sequence[Node]) -> FloatArray:
    """The region around those of some nodes."""
    regions = np.array([node.region for node in nodes])
    return np.vstack((regions[:, 0].min(axis=0), regions[:, 1].max(axis=0)))


def globe_tileset(branch: Branch, extras: Mapping[str, Any]) -> bytes:
    """The tileset; `extras` say in its asset where the coordinates come from. The same tree gives the same bytes."""
    region = _region_around(branch.nodes)
    low, high = np.radians(region[:, :2])
    # the error of showing nothing: the size of what is not seen, on a sphere
    size_m = round(float(np.hypot(*(high - low))) * _RADIUS_M, 3)
    error_m = max(size_m, *(node.error_m for node in branch.nodes))
    whole = Node(region=region, error_m=error_m, children=branch.nodes)
    root = branch.nodes[0] if len(branch.nodes) == 1 else whole
    return tileset_bytes({"version": "1.1", "extras": dict(extras)}, error_m, "REPLACE", _entry(root, np.eye(4)))


def _entry(node: Node, parent: FloatArray) -> dict[str, Any]:
    """A node as JSON, with all below it; `parent` is the matrix (4, 4) that those above it have together."""
    low, high = node.region + _MARGIN
    region = [*np.radians(low[:2]).round(10), *np.radians(high[:2]).round(10), round(low[2], 3), round(high[2], 3)]
    matrix = parent if node.matrix is None else node.matrix
    return node_entry(
        {"region": [float(value) for value in region]},
        node.error_m,
        transform=None if np.array_equal(matrix, parent) else np.linalg.inv(parent) @ matrix,
        uri=node.uri,
        children=[_entry(child, matrix) for child in node.children],
    )
