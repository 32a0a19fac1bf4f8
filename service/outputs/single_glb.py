"""One building cut out of a tile's GLB file: its node with its bytes, without a numerical library.

The files are those of `pipeline.export.glb`: one buffer, vertices and indices in separate views, and no accessor is
used by two buildings.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

from pipeline.export.glb_container import container, read_document

_INDEX_BYTES = 4


def cut_glb(path: Path, building_id: str) -> bytes | None:
    """The GLB file of one building, placed as in the tile; None if the tile has no such node.

    Raises
    ------
    FileNotFoundError
        The tile's file is gone.
    """
    with path.open("rb") as stream:
        document, start = read_document(stream)
        node = next((node for node in document["nodes"] if node["name"] == building_id and "mesh" in node), None)
        return None if node is None else _of_node(document, node, stream, start)


def _of_node(document: dict[str, Any], node: dict[str, Any], stream: BinaryIO, start: int) -> bytes:
    """The file of one node; the binary data of the tile's file begins at `start`."""
    mesh = document["meshes"][node["mesh"]]
    used = sorted({n for p in mesh["primitives"] for n in (*p["attributes"].values(), p["indices"])})
    views = [{**view, "byteLength": 0} for view in document["bufferViews"]]
    pieces: list[list[bytes]] = [[] for _ in views]
    accessors = []
    for number in used:
        accessor = document["accessors"][number]
        index = accessor["bufferView"]
        view = document["bufferViews"][index]
        length = accessor["count"] * view.get("byteStride", _INDEX_BYTES)
        stream.seek(start + view["byteOffset"] + accessor["byteOffset"])
        pieces[index].append(stream.read(length))
        accessors.append({**accessor, "byteOffset": views[index]["byteLength"]})
        views[index]["byteLength"] += length
    size = 0
    for view in views:
        view["byteOffset"] = size
        size += view["byteLength"]
    place = {number: place for place, number in enumerate(used)}
    primitives = [
        {
            **primitive,
            "attributes": {name: place[number] for name, number in primitive["attributes"].items()},
            "indices": place[primitive["indices"]],
        }
        for primitive in mesh["primitives"]
    ]
    root = document["nodes"][document["scenes"][document["scene"]]["nodes"][0]]
    alone = {
        **document,
        "nodes": [{**root, "children": [1]}, {**node, "mesh": 0}],
        "meshes": [{**mesh, "primitives": primitives}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
    return container(alone, (piece for group in pieces for piece in group))  # all components have four bytes
