"""3D Tiles 1.1: the tilesets over the points of a run (OGC 22-025r4).

Every tile of the run has a tileset of its own, with the nodes of its octree. The root tileset refers to them, and has
coarser nodes above them. Coordinates are metres from an origin, east, north and up: those of the run's CRS. The root is
written twice, once with transforms that stay in the CRS and once with transforms to EPSG:4978, where a globe expects
them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.export.tileset import node_entry, tileset_bytes
from pipeline.model import FloatArray, IntArray

if TYPE_CHECKING:
    from pipeline.extras.octree.point_octree import OctreeNode

ERROR_SPACINGS = 4.0
"""The geometric error of a node in spacings of its points. A viewer refines a tile whose error covers 16 pixels by
default (CesiumJS), so points are then at most 4 pixels apart."""

_MARGIN_MM = 10
"""Boxes are this much wider on each side than the points: those are rounded by up to half as much."""
_MM = 1000
_REACH_M = 100.0
"""Half the length over which the derivative of a transformation is taken."""


ToGlobe = Callable[[FloatArray], FloatArray]
"""From places (n, 3) in metres of the run's CRS to EPSG:4978, (n, 3) in metres; not finite where there is none."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TilesetNode:
    """A node of the root tileset, with content in a frame of its own."""

    origin_mm: tuple[int, int, int]
    """Origin of its content; whole metres."""
    low_mm: tuple[int, int, int]
    """Smallest coordinates of its own points."""
    high_mm: tuple[int, int, int]
    """The largest."""
    error_m: float
    """Its geometric error."""
    uri: str | None
    """Path of its content, relative to the tileset; None without any."""
    points: int
    """Number of points of its content; of an external tileset, all of them."""
    children: tuple[TilesetNode, ...] = ()
    """Finer nodes."""


def node_error_m(spacing_m: float) -> float:
    """Geometric error of a node with points so far apart."""
    return ERROR_SPACINGS * spacing_m


def tile_tileset(nodes: Sequence[OctreeNode], extras: Mapping[str, Any]) -> bytes:
    """The tileset of one octree, whose coordinates are about its own origin; `extras` say where that is."""
    entries: dict[str, dict[str, Any]] = {}
    for node in nodes:
        box = _box(_corners(node.low_mm, node.high_mm))
        entry = node_entry(
            {"box": box}, node_error_m(node.spacing_m), uri=f"{node.path}.glb", extras={"points": len(node.index)}
        )
        entries[node.path] = entry
        if node.parent:
            entries[node.parent].setdefault("children", []).append(entry)
    return _whole(entries[nodes[0].path], extras)


def root_tileset(root: TilesetNode, extras: Mapping[str, Any], to_globe: ToGlobe | None = None) -> bytes | None:
    """The root tileset in the coordinates of the run; with `to_globe` in EPSG:4978.

    None if `to_globe` finds no place on Earth for some coordinates.
    """
    frames = _Local(root.origin_mm) if to_globe is None else _Globe(to_globe)
    try:
        entry, _ = _entry(root, frames, None)
    except _NowhereError:
        return None
    return _whole(entry, extras)


class _NowhereError(Exception):
    """A place has no coordinates on Earth."""


@dataclasses.dataclass(frozen=True)
class _Local:
    """Frames in the coordinates of the run, about one origin."""

    origin_mm: tuple[int, int, int]

    def matrix(self, node: TilesetNode) -> FloatArray:
        """From coordinates about a node's origin to those of the whole, in metres, (4, 4)."""
        found = np.eye(4)
        found[:3, 3] = (np.array(node.origin_mm) - np.array(self.origin_mm)) / _MM
        return found


@dataclasses.dataclass(frozen=True)
class _Globe:
    """Frames in EPSG:4978: around the middle of each node the map projection is taken for affine."""

    to_globe: ToGlobe

    def matrix(self, node: TilesetNode) -> FloatArray:
        """As `_Local.matrix`; raises _NowhereError."""
        middle_m = (np.array(node.low_mm) + np.array(node.high_mm)) / (2 * _MM)
        steps = np.vstack((np.zeros(3), _REACH_M * np.eye(3), -_REACH_M * np.eye(3)))
        places = self.to_globe(middle_m + steps)
        if not np.isfinite(places).all():
            raise _NowhereError
        found = np.eye(4)
        found[:3, :3] = (places[1:4] - places[4:7]).T / (2.0 * _REACH_M)
        found[:3, 3] = places[0] - found[:3, :3] @ (middle_m - np.array(node.origin_mm) / _MM)
        return found


def _entry(node: TilesetNode, frames: _Local | _Globe, parent: FloatArray | None) -> tuple[dict[str, Any], FloatArray]:
    """A node as JSON with all below it, and the corners of its box in the coordinates of the whole, (8, 3)."""
    matrix = frames.matrix(node)
    below = [_entry(child, frames, matrix) for child in node.children]
    origin = np.array(node.origin_mm)
    own = _corners(np.array(node.low_mm) - origin, np.array(node.high_mm) - origin)
    inverse = np.array(np.linalg.inv(matrix), np.float64)
    together = np.vstack((own, *(_moved(corners, inverse) for _, corners in below)))
    low, high = together.min(axis=0), together.max(axis=0)
    box = np.array(list(itertools.product(*zip(low.tolist(), high.tolist(), strict=True))))
    entry = node_entry(
        {"box": _box(together)},
        node.error_m,
        transform=matrix if parent is None else np.linalg.inv(parent) @ matrix,
        uri=node.uri,
        extras=None if node.uri is None else {"points": node.points},
        children=[child for child, _ in below],
    )
    return entry, _moved(box, matrix)


def _moved(xyz: FloatArray, matrix: FloatArray) -> FloatArray:
    """Places (n, 3) in other coordinates."""
    moved: FloatArray = xyz @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def _corners(low_mm: IntArray, high_mm: IntArray) -> FloatArray:
    """Two opposite corners of a box with its margin in metres, (2, 3)."""
    return np.vstack((low_mm - _MARGIN_MM, high_mm + _MARGIN_MM)) / _MM


def _box(xyz: FloatArray) -> list[float]:
    """The box around places: its middle, and half its edges."""
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    half = (high - low) / 2.0
    middle = low + half
    values = [*middle, half[0], 0.0, 0.0, 0.0, half[1], 0.0, 0.0, 0.0, half[2]]
    # rounded to a tenth of a millimetre, which the margin covers
    return [round(float(value), 4) for value in values]


def _whole(root: dict[str, Any], extras: Mapping[str, Any]) -> bytes:
    """A tileset; the error of showing nothing is the size of its box."""
    size = 2.0 * math.hypot(*root["boundingVolume"]["box"][3:])
    error_m = round(max(size, root["geometricError"]), 3)
    return tileset_bytes({"version": "1.1"}, error_m, "ADD", root, extras=dict(extras))
