"""Points as glTF 2.0 in one binary file (GLB): positions as integers, and per point its class and its building.

Positions are 16-bit integers (the extension KHR_mesh_quantization); the scale and the translation of the node lead to
metres. Attributes begin at multiples of four bytes, as glTF demands. The axes are those of the models' GLB
(`pipeline.export.glb`): x is easting, y elevation, z minus northing. Points are sorted by building, so that those of
one building can be cut out (`pipeline.extras.octree.building_points`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.export.glb_container import QUANTIZATION, VERSION, VERTICES, container, read_document
from pipeline.model import ByteArray, IntArray

NO_BUILDING = 65_535
"""Marker in `_BUILDING`: no building was modelled from the point."""
NO_PLANE = 65_535
"""Marker in `_PLANE`: no roof face lies above or below the point."""
NO_RESIDUAL = -32_768
"""Marker in `_RESIDUAL`: as for `_PLANE`."""
MAX_STEP_MM = 10
"""Largest step of positions: errors stay within half of it. Wider nodes have 32-bit floats."""

UShortArray = npt.NDArray[np.uint16]
ShortArray = npt.NDArray[np.int16]

_MM = 1000
_BYTE, _SHORT, _USHORT, _FLOAT = 5121, 5122, 5123, 5126
_TYPES = {_BYTE: "u1", _SHORT: "<i2", _USHORT: "<u2", _FLOAT: "<f4"}
_POINTS = 0
_STEPS = 65_535


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelledPoints:
    """Points with their class, and where they lie in the models; arrays of one length n."""

    xyz_mm: IntArray
    """(n, 3) int64, easting, northing, elevation in mm from an origin that is known elsewhere."""
    point_class: ByteArray
    """(n,) uint8, `pipeline.extras.classify.point_classes.PointClass`."""
    building: UShortArray
    """(n,) uint16, index into `buildings`; NO_BUILDING for points from which none was modelled."""
    plane: UShortArray
    """(n,) uint16, `plane_id` of the roof face above or below; NO_PLANE without one."""
    residual_mm: ShortArray
    """(n,) int16, vertical distance to that face, positive above it; NO_RESIDUAL without one."""
    buildings: tuple[str, ...]
    """Ids, sorted."""

    def __len__(self) -> int:
        """Number of points."""
        return len(self.xyz_mm)

    def take(self, index: IntArray) -> ModelledPoints:
        """Some of the points, with only their buildings."""
        building = self.building[index]
        held = np.unique(building[building != NO_BUILDING])
        number = np.full(_STEPS + 1, NO_BUILDING, np.uint16)
        number[held] = np.arange(len(held))
        return ModelledPoints(
            xyz_mm=self.xyz_mm[index],
            point_class=self.point_class[index],
            building=number[building],
            plane=self.plane[index],
            residual_mm=self.residual_mm[index],
            buildings=tuple(self.buildings[k] for k in held),
        )

    def by_building(self) -> ModelledPoints:
        """The points sorted by building, those without one last."""
        order = np.argsort(self.building, kind="stable")
        return ModelledPoints(
            xyz_mm=self.xyz_mm[order],
            point_class=self.point_class[order],
            building=self.building[order],
            plane=self.plane[order],
            residual_mm=self.residual_mm[order],
            buildings=self.buildings,
        )

    def starts(self) -> list[int]:
        """Where the points of each building start among points sorted by building, and where the last ones end."""
        found: list[int] = np.searchsorted(self.building, np.arange(len(self.buildings) + 1)).tolist()
        return found

    def moved(self, shift_mm: Sequence[int]) -> ModelledPoints:
        """The points about an origin that lies at `shift_mm` from theirs."""
        return dataclasses.replace(self, xyz_mm=self.xyz_mm - np.array(shift_mm, np.int64))


def united(parts: Sequence[ModelledPoints]) -> ModelledPoints:
    """All points of some parts, about one origin, part after part."""
    names = tuple(sorted({name for part in parts for name in part.buildings}))
    place = {name: k for k, name in enumerate(names)}
    buildings = []
    for part in parts:
        number = np.full(_STEPS + 1, NO_BUILDING, np.uint16)
        number[: len(part.buildings)] = [place[name] for name in part.buildings]
        buildings.append(number[part.building])
    return ModelledPoints(
        xyz_mm=np.concatenate([part.xyz_mm for part in parts]) if parts else np.empty((0, 3), np.int64),
        point_class=np.concatenate([np.empty(0, np.uint8), *(part.point_class for part in parts)]),
        building=np.concatenate([np.empty(0, np.uint16), *buildings]),
        plane=np.concatenate([np.empty(0, np.uint16), *(part.plane for part in parts)]),
        residual_mm=np.concatenate([np.empty(0, np.int16), *(part.residual_mm for part in parts)]),
        buildings=names,
    )


def points_glb(points: ModelledPoints, name: str, extras: Mapping[str, Any]) -> bytes:
    """At least one point as a GLB file; the same points give the same bytes.

    `extras` are those of the mesh, beside its buildings and its number of points; they should say where the origin is.
    The points are sorted by building.
    Raises ValueError without points: glTF has no empty accessor.
    """
    if len(points) == 0:
        raise ValueError("a GLB file of no points cannot be: glTF has no empty accessor")
    points = points.by_building()
    low, high = points.xyz_mm.min(axis=0), points.xyz_mm.max(axis=0)
    step_mm = max(1, -(-int((high - low).max()) // _STEPS))
    # north decreases along z, so that its largest value is where z begins
    corner = np.array([low[0], low[2], -high[1]])
    away = np.column_stack((points.xyz_mm[:, 0], points.xyz_mm[:, 2], -points.xyz_mm[:, 1])) - corner
    file = _File()
    if step_mm <= MAX_STEP_MM:
        stored = np.zeros((len(points), 4), "<u2")
        stored[:, :3] = (away + step_mm // 2) // step_mm
        position = file.add(stored, _USHORT, "VEC3", stored[:, :3])
    else:
        step_mm = _MM
        floats = (away / _MM).astype("<f4")
        position = file.add(floats, _FLOAT, "VEC3", floats)
    attributes = {
        "POSITION": position,
        "_CLASS": file.add(_widened(points.point_class, "u1"), _BYTE, "SCALAR"),
        "_BUILDING": file.add(_widened(points.building, "<u2"), _USHORT, "SCALAR"),
        "_PLANE": file.add(_widened(points.plane, "<u2"), _USHORT, "SCALAR"),
        "_RESIDUAL": file.add(_widened(points.residual_mm, "<i2"), _SHORT, "SCALAR"),
    }
    mesh = {
        "name": name,
        "primitives": [{"attributes": attributes, "mode": _POINTS}],
        "extras": {**extras, "points": len(points), "buildings": list(points.buildings), "starts": points.starts()},
    }
    node = {
        "name": name,
        "mesh": 0,
        "translation": [value / _MM for value in corner.tolist()],
        "scale": [step_mm / _MM] * 3,
    }
    return file.content(mesh, node)


def _widened(values: npt.NDArray[Any], kind: str) -> npt.NDArray[Any]:
    """Values at multiples of four bytes, (n, k)."""
    wide = np.zeros((len(values), 4 // np.dtype(kind).itemsize), kind)
    wide[:, 0] = values
    return wide


class _File:
    """A GLB file of one mesh, filled attribute by attribute."""

    def __init__(self) -> None:
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._pieces: list[bytes] = []
        self._size = 0

    def add(self, rows: npt.NDArray[Any], component: int, kind: str, bounded: npt.NDArray[Any] | None = None) -> int:
        """Append an attribute, (n, k) with the bytes between values; the number of its accessor."""
        piece = rows.tobytes()
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": len(piece)}
        self._views.append({**view, "byteStride": rows.strides[0], "target": VERTICES})
        accessor: dict[str, Any] = {
            "bufferView": len(self._accessors), "componentType": component, "count": len(rows), "type": kind
        }  # fmt: skip
        if bounded is not None:
            accessor |= {"min": bounded.min(axis=0).tolist(), "max": bounded.max(axis=0).tolist()}
        self._accessors.append(accessor)
        self._pieces.append(piece)
        self._size += len(piece)
        return len(self._accessors) - 1

    def content(self, mesh: Mapping[str, Any], node: Mapping[str, Any]) -> bytes:
        """The whole file."""
        document = {
            "asset": {"version": VERSION, "generator": "gablework"},
            "extensionsUsed": [QUANTIZATION],
            "extensionsRequired": [QUANTIZATION],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [node],
            "meshes": [mesh],
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._size}],
        }
        return container(document, self._pieces)


def read_points_glb(content: bytes) -> tuple[ModelledPoints, Mapping[str, Any]]:
    """The points of a file made by `points_glb`, and the extras of its mesh.

    Coordinates have the precision of the file: half a step, or that of a float. Raises ValueError if it is another
    kind of file.
    """
    document, start = read_document(content)
    mesh, node = document["meshes"][0], document["nodes"][0]

    def column(name: str, width: int) -> npt.NDArray[Any]:
        accessor = document["accessors"][mesh["primitives"][0]["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = np.dtype(_TYPES[accessor["componentType"]])
        values = np.frombuffer(content, kind, view["byteLength"] // kind.itemsize, start + view["byteOffset"])
        return values.reshape(accessor["count"], -1)[:, :width]

    stored = column("POSITION", 3)
    corner = np.rint(np.array(node["translation"]) * _MM).astype(np.int64)
    gltf = np.rint(stored * (node["scale"][0] * _MM)).astype(np.int64) + corner
    extras = mesh["extras"]
    points = ModelledPoints(
        xyz_mm=np.column_stack((gltf[:, 0], -gltf[:, 2], gltf[:, 1])),
        point_class=column("_CLASS", 1)[:, 0],
        building=column("_BUILDING", 1)[:, 0],
        plane=column("_PLANE", 1)[:, 0],
        residual_mm=column("_RESIDUAL", 1)[:, 0],
        buildings=tuple(extras["buildings"]),
    )
    return points, extras
