"""An independent reader of GLB files: numpy and the text of the glTF 2.0 specification, nothing of the writer.

`read_glb` asserts the rules of the specification (ISO/IEC 12113:2022, its section in brackets) that concern static
triangle meshes, and gives the nodes with their triangles in the file's own coordinates.
"""

import dataclasses
import json
import struct
from typing import Any

import numpy as np

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
VERTICES, INDICES = 34962, 34963


@dataclasses.dataclass(frozen=True)
class Primitive:
    """One primitive of a node's mesh."""

    material: str
    extras: dict[str, Any]
    indices: np.ndarray
    """(t, 3)"""
    positions: np.ndarray
    """(v, 3) float64 in the node's coordinates."""
    normals: np.ndarray
    planes: np.ndarray

    @property
    def triangles(self) -> np.ndarray:
        """(t, 3, 3) corners in the node's coordinates."""
        return self.positions[self.indices]


@dataclasses.dataclass(frozen=True)
class Node:
    """A node with a mesh."""

    name: str
    extras: dict[str, Any]
    translation: np.ndarray
    primitives: tuple[Primitive, ...]


@dataclasses.dataclass(frozen=True)
class Glb:
    """What a file holds."""

    document: dict[str, Any]
    nodes: dict[str, Node]

    @property
    def place(self) -> dict[str, Any]:
        """The place stored in the asset."""
        return self.document["asset"]["extras"]

    def crs_coordinates(self, node: Node, xyz: np.ndarray) -> np.ndarray:
        """Points of a node as easting, northing, elevation in the CRS's units, as `axes` says."""
        x, y, z = np.moveaxis(xyz + node.translation, -1, 0)
        east, north, up = self.place["origin_m"]
        plan, vertical = self.place["horizontal_unit_m"], self.place["vertical_unit_m"]
        return np.stack(((east + x) / plan, (north - z) / plan, (up + y) / vertical), axis=-1)


def chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The two chunks of a GLB file (4.4)."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert (kind, size % 4) == (b"JSON", 0)
    text = data[20 : 20 + size]
    start = 20 + size
    size, kind = struct.unpack_from("<I4s", data, start)
    assert (kind, size % 4, start + 8 + size) == (b"BIN\0", 0, len(data))
    assert text[:1] == b"{"
    assert not text.rstrip(b" ").endswith((b"\0", b"\n"))
    document = json.loads(text.decode("utf-8"))
    assert json.dumps(document, allow_nan=False)
    return document, data[start + 8 :]


def values_of(document: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    """The values (n, k) of an accessor with a view of its own; they have the bounds that it states."""
    found = document["accessors"][index]
    view = document["bufferViews"][found["bufferView"]]
    kind, width = np.dtype(COMPONENTS[found["componentType"]]), WIDTHS[found["type"]]
    stride = view.get("byteStride", kind.itemsize * width) // kind.itemsize
    values = np.frombuffer(binary, kind, found["count"] * stride, view["byteOffset"]).reshape(-1, stride)[:, :width]
    for name, bound in (("min", values.min(axis=0)), ("max", values.max(axis=0))):
        assert name not in found or found[name] == bound.tolist()
    return values


def read_glb(data: bytes) -> Glb:
    """Read a file and hold it against the rules."""
    document, binary = chunks(data)
    assert document["asset"]["version"] == "2.0"
    (buffer,) = document["buffers"]  # (3.6.1) the first, without uri, is the binary chunk, with at most 3 bytes more
    assert "uri" not in buffer
    assert 0 <= len(binary) - buffer["byteLength"] < 4
    for name, entries in document.items():
        assert entries not in ([], {}), f"{name} is empty"  # (5) arrays and objects have at least one entry
    views = document["bufferViews"]
    for view in views:
        assert view["byteOffset"] + view["byteLength"] <= buffer["byteLength"]
        assert view.get("byteStride", 4) % 4 == 0
        assert ("byteStride" in view) == (view["target"] == VERTICES)
    arrays = [_accessor(accessor, views, binary) for accessor in document["accessors"]]
    roots = _tree(document)
    nodes = {}
    for index, entry in enumerate(document["nodes"]):
        if "mesh" not in entry:
            assert index in roots
            assert "translation" not in entry
            continue
        mesh = document["meshes"][entry["mesh"]]
        primitives = tuple(_primitive(primitive, document, arrays) for primitive in mesh["primitives"])
        assert entry["name"] not in nodes
        shift = np.array(entry["translation"], dtype=float)
        assert np.array_equal(shift, shift.astype(np.float32))
        nodes[entry["name"]] = Node(entry["name"], entry["extras"], shift, primitives)
    used = {p["material"] for mesh in document["meshes"] for p in mesh["primitives"]}
    assert used == set(range(len(document["materials"])))
    assert sorted(n["mesh"] for n in document["nodes"] if "mesh" in n) == list(range(len(document["meshes"])))
    return Glb(document, nodes)


def _tree(document: dict[str, Any]) -> set[int]:
    """The roots; every node hangs below exactly one of them (3.5.2)."""
    roots = document["scenes"][document["scene"]]["nodes"]
    met = list(roots)
    for index in met:
        met.extend(document["nodes"][index].get("children", ()))
    assert sorted(met) == list(range(len(document["nodes"])))
    return set(roots)


def _accessor(accessor: dict[str, Any], views: list[dict[str, Any]], binary: bytes) -> np.ndarray:
    """The values of an accessor (3.6.2): aligned, inside its view, within its stated bounds."""
    view, width = views[accessor["bufferView"]], WIDTHS[accessor["type"]]
    kind = np.dtype(COMPONENTS[accessor["componentType"]])
    stride = view.get("byteStride", width * kind.itemsize)
    start = view["byteOffset"] + accessor["byteOffset"]
    assert start % kind.itemsize == 0
    assert accessor["count"] >= 1
    assert accessor["byteOffset"] + stride * (accessor["count"] - 1) + width * kind.itemsize <= view["byteLength"]
    rows = [np.frombuffer(binary, kind, width, start + stride * i) for i in range(accessor["count"])]
    values = np.array(rows)
    if kind.kind == "f":
        assert np.isfinite(values).all()
    for name in ("min", "max"):
        if name in accessor:
            assert np.array_equal(np.array(accessor[name], dtype=kind), getattr(values, name)(axis=0))
    return values


def _primitive(primitive: dict[str, Any], document: dict[str, Any], arrays: list[np.ndarray]) -> Primitive:
    """A primitive of triangles (3.7.2)."""
    assert primitive.get("mode", 4) == 4
    accessors, names = document["accessors"], primitive["attributes"]
    assert all(name in {"POSITION", "NORMAL"} or name.startswith("_") for name in names)
    assert {"min", "max"} <= set(accessors[names["POSITION"]])
    for name, index in names.items():
        assert document["bufferViews"][accessors[index]["bufferView"]]["target"] == VERTICES
        assert accessors[index]["componentType"] == 5126, name
        assert len(arrays[index]) == len(arrays[names["POSITION"]])
    assert document["bufferViews"][accessors[primitive["indices"]]["bufferView"]]["target"] == INDICES
    assert accessors[primitive["indices"]]["componentType"] in {5121, 5123, 5125}
    indices = arrays[primitive["indices"]].reshape(-1, 3).astype(int)
    positions, normals = arrays[names["POSITION"]].astype(float), arrays[names["NORMAL"]].astype(float)
    assert indices.max() < len(positions)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    return Primitive(
        material=document["materials"][primitive["material"]]["name"],
        extras=primitive["extras"],
        indices=indices,
        positions=positions,
        normals=normals,
        planes=arrays[names["_PLANE_ID"]][:, 0],
    )
