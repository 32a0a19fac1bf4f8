"""The points of one building, cut out of the nodes that hold some, without a numerical library.

The files are those of `pipeline.extras.octree.point_glb`. Points of one building follow each other there, so its bytes
are copied as they are; each node of the octree becomes a node of the new file, with its own translation and scale.
"""

from __future__ import annotations

import array
import json
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from pipeline.export.glb_container import QUANTIZATION, VERTICES, GlbFile, read_document
from pipeline.extras.octree.point_files import INDEX, TILESET

_TYPES = {5123: "H", 5126: "f"}

Get = Callable[[str], bytes]
"""The content of a file in the folder of a run's points, such as `x85_y447/r04.glb`."""


def building_points(get: Get, tile: str, building_id: str) -> bytes | None:
    """The points of one building as a GLB file; None if the tile, which owns it, has none.

    The positions are metres from `asset.extras.origin_m`. Raises what `get` raises if a file is missing.
    """
    index: dict[str, Any] = json.loads(get(f"{tile}/{INDEX}"))
    if building_id not in index:
        return None
    root = json.loads(get(TILESET))
    paths: list[str] = []
    for key in index[building_id]["tiles"]:
        own = index if key == tile else json.loads(get(f"{key}/{INDEX}"))
        paths.extend(f"{key}/{node}.glb" for node in own[building_id]["nodes"])
    paths.extend(_above(root["root"], {f"{key}/{TILESET}" for key in index[building_id]["tiles"]}))
    cuts = [cut for cut in (_Cut(get(path), building_id) for path in paths) if cut.count]
    place = {name: root["extras"][name] for name in ("horizontal_unit_m", "vertical_unit_m", "crs")}
    return _united(building_id, cuts, place)


def _above(node: Mapping[str, Any], tilesets: set[str]) -> list[str]:
    """The contents of the nodes above some tilesets, each once."""

    def walk(node: Mapping[str, Any]) -> tuple[bool, list[str]]:
        uri = node.get("content", {}).get("uri", "")
        if uri in tilesets:
            return True, []
        found = [walk(child) for child in node.get("children", ())]
        if not any(is_above for is_above, _ in found):
            return False, []
        own = [uri] if uri else []
        return True, [*own, *(path for _, paths in found for path in paths)]

    return walk(node)[1]


class _Cut:
    """The points of a building in one node."""

    def __init__(self, content: bytes, building_id: str) -> None:
        document, binary = read_document(content)
        mesh = document["meshes"][0]
        extras = mesh["extras"]
        self.origin_m: list[int] = extras["origin_m"]
        """Origin of the node's coordinates."""
        self.node: dict[str, Any] = document["nodes"][0]
        """Its node, with translation and scale."""
        self.columns: dict[str, tuple[dict[str, Any], int, bytes]] = {}
        """By attribute, an accessor without its view, the distance of two values, and the bytes."""
        self.count = 0
        """Number of points."""
        if building_id not in extras["buildings"]:
            return
        k = extras["buildings"].index(building_id)
        first, last = extras["starts"][k : k + 2]
        self.count = last - first
        for name, number in mesh["primitives"][0]["attributes"].items():
            accessor = document["accessors"][number]
            view = document["bufferViews"][accessor["bufferView"]]
            stride = view["byteStride"]
            offset = binary + view["byteOffset"]
            rows = content[offset + first * stride : offset + last * stride]
            kept = {key: accessor[key] for key in ("componentType", "type")}
            if name == "POSITION":
                kept |= _bounds(rows, stride, accessor["componentType"])
            elif name == "_BUILDING":
                rows = bytes(len(rows))  # it is the only one of its file
            self.columns[name] = ({**kept, "count": self.count}, stride, rows)


def _bounds(rows: bytes, stride: int, component: int) -> dict[str, list[float]]:
    """Smallest and largest position of rows that are `stride` bytes wide."""
    values = array.array(_TYPES[component], rows)
    if sys.byteorder == "big":
        values.byteswap()
    width = stride // values.itemsize
    axes = [values[axis::width] for axis in range(3)]
    return {"min": [min(axis) for axis in axes], "max": [max(axis) for axis in axes]}


def _united(building_id: str, cuts: Iterable[_Cut], place: Mapping[str, Any]) -> bytes:
    """One file of all cuts, in their order; its origin is that of the first one."""
    file = GlbFile()
    nodes: list[dict[str, Any]] = []
    meshes: list[dict[str, Any]] = []
    origin_m: list[int] = []
    for cut in cuts:
        origin_m = origin_m or cut.origin_m
        east, north, up = (own - first for own, first in zip(cut.origin_m, origin_m, strict=True))
        x, y, z = cut.node["translation"]
        attributes = {}
        for name, (accessor, stride, rows) in cut.columns.items():
            attributes[name] = file.accessor(file.view(rows, byteStride=stride, target=VERTICES), **accessor)
        nodes.append({**cut.node, "mesh": len(meshes), "translation": [x + east, y + up, z - north]})
        extras = {"points": cut.count, "buildings": [building_id]}
        meshes.append({"primitives": [{"attributes": attributes, "mode": 0}], "extras": extras})
    return file.content(
        nodes,
        meshes,
        scene={"nodes": list(range(len(nodes)))},
        asset={"extras": {"title": f"points of building {building_id}", "origin_m": origin_m, **place}},
        used=[QUANTIZATION],
    )
