"""glTF 2.0 in one binary file (GLB): one node per building with its record, one material per semantic surface.

glTF uses metres, 32-bit floats and a y axis that points up. So every building has its own node, whose
translation is whole metres from the file's origin, and vertices in metres from there: x is easting, y elevation, z
minus northing. This keeps millimetres. `asset.extras` holds the origin and the units, which lead back to the CRS.
The models come from CityJSONSeq, so both files always agree.

The rules are those of the Khronos Group's glTF 2.0 specification (ISO/IEC 12113:2022).
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.compiler import kernel
from pipeline.export.glb_arrays import bounds_of, gltf_axes, values_of
from pipeline.export.glb_container import INDICES, VERTICES, GlbFile
from pipeline.model import FloatArray, IntArray
from pipeline.triangulation.face_triangles import DONE, area_vector, triangulate_rings

MATERIALS: Mapping[str, tuple[float, float, float]] = {
    "RoofSurface": (0.50, 0.09, 0.06),
    "WallSurface": (0.71, 0.66, 0.58),
    "GroundSurface": (0.25, 0.25, 0.25),
    "OuterCeilingSurface": (0.55, 0.50, 0.42),
}
"""One material per semantic surface of CityJSON, by its name, with its colour in linear RGB."""
_ONLY_IF_USED = "OuterCeilingSurface"
"""The last material: only models with overhangs have this surface."""
PLANE_ID = "_PLANE_ID"
"""Vertex attribute: `plane_id` of the roof plane, -1 on walls and ground."""

_MM = 1000
_AXES = (
    "metres from origin_m: x easting, y elevation, z minus northing; "
    "easting = (origin_m[0] + x) / horizontal_unit_m, northing = (origin_m[1] - z) / horizontal_unit_m, "
    "elevation = (origin_m[2] + y) / vertical_unit_m"
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SolidMesh:
    """The solids of one building as triangles."""

    lod: str
    """Their level of detail."""
    low_mm: IntArray
    """(3,) easting, northing, elevation below all corners: whole metres, in mm."""
    local_mm: IntArray
    """(v, 3) mm from there; every face has corners of its own."""
    normals: FloatArray
    """(v, 3) unit normals of the faces, outward."""
    planes: IntArray
    """(v,) number of the roof plane, -1 elsewhere."""
    triangles: tuple[tuple[str, str, IntArray], ...]
    """Name of the part, semantic surface, and its triangles (t, 3), counter-clockwise seen from outside."""


def glb_bytes(
    lines: Iterable[str], horizontal_unit_m: float = 1.0, vertical_unit_m: float = 1.0, lod: str | None = None
) -> bytes:
    """The buildings of a CityJSONSeq text (`cityjson_lines`) as a GLB file; the same text gives the same bytes.

    Units are metres in one unit of easting and northing, and of elevation. `lod` is the finest level of detail that is
    taken; None for that of each building's record. Buildings without a solid are left out; without any the file is
    empty, since glTF has no empty scene of meshes. Raises ValueError if a face cannot be cut into triangles: it crosses
    or touches itself.
    """
    heading, *features = (json.loads(line) for line in lines)
    frame = Frame.of(heading["transform"], (horizontal_unit_m, horizontal_unit_m, vertical_unit_m))
    modelled = [(feature, mesh) for feature in features if (mesh := solid_mesh(feature, frame, lod)) is not None]
    if not modelled:
        return b""
    origin_mm = np.min([mesh.low_mm for _, mesh in modelled], axis=0)
    scene = _Scene()
    for feature, mesh in modelled:
        name = str(feature["id"])
        attributes = feature["CityObjects"][name]["attributes"]
        scene.add(name, {"building_id": name, **attributes, "lod": mesh.lod}, mesh, origin_mm)
    metadata = heading["metadata"]
    place = {
        "origin_m": [int(v) // _MM for v in origin_mm],
        "horizontal_unit_m": horizontal_unit_m,
        "vertical_unit_m": vertical_unit_m,
        "crs": metadata.get("referenceSystem"),
        "axes": _AXES,
    }
    return scene.file(str(metadata["title"]), place)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Frame:
    """The transform of a CityJSONSeq text."""

    shift: IntArray
    """(3,) what the translation adds to a vertex, in steps of its scale."""
    steps: IntArray
    """(3,) steps in one unit of the CRS: powers of ten."""
    units_m: FloatArray
    """(3,) metres in one unit."""

    @classmethod
    def of(cls, transform: Mapping[str, Sequence[float]], units_m: Sequence[float]) -> Frame:
        """The frame of a file's `transform`, in a CRS with these units, (3,)."""
        steps = np.array([10 ** round(-math.log10(scale)) for scale in transform["scale"]], dtype=np.int64)
        shift = np.rint(transform["translate"]).astype(np.int64) * steps
        return cls(shift=shift, steps=steps, units_m=np.array(units_m))

    def millimetres(self, vertices: Sequence[Sequence[int]]) -> IntArray:
        """Absolute coordinates in mm, shape (v, 3): the exporters keep 1 mm in any unit."""
        steps = np.array(vertices, dtype=np.int64).reshape(-1, 3) + self.shift
        return np.rint(steps / self.steps * self.units_m * _MM).astype(np.int64)


def solid_mesh(feature: Mapping[str, Any], frame: Frame, lod: str | None) -> SolidMesh | None:
    """The triangles of a feature's solids at the finest level up to `lod`, or its record's; None where it has none."""
    corners, ring_starts, face_starts = [], [0], [0]
    face_keys: list[tuple[str, str]] = []
    planes: list[int] = []
    levels = {g["lod"] for entry in feature["CityObjects"].values() for g in entry.get("geometry", ())}
    level = record_level(feature) if lod is None else max((name for name in levels if name <= lod), default="")
    for part, entry in feature["CityObjects"].items():
        for geometry in entry.get("geometry", ()):
            if geometry["lod"] != level:
                continue
            semantics = geometry["semantics"]
            for face, value in zip(geometry["boundaries"][0], semantics["values"][0], strict=True):
                for ring in face:
                    corners.extend(ring)
                    ring_starts.append(len(corners))
                face_starts.append(len(ring_starts) - 1)
                surface = semantics["surfaces"][value]
                face_keys.append((part, surface["type"]))
                planes.extend([surface.get("plane_id", -1)] * (len(corners) - len(planes)))
    if not corners:
        return None
    xyz_mm = frame.millimetres(feature["vertices"])[np.array(corners, dtype=np.int64)]
    low_mm = xyz_mm.min(axis=0) // _MM * _MM
    local_mm = xyz_mm - low_mm
    triangles, counts, normals = _triangulated(local_mm, np.array(ring_starts), np.array(face_starts))
    if len(counts) < len(face_keys):
        part, surface_type = face_keys[len(counts)]
        raise ValueError(f"face {len(counts)} of {part}, a {surface_type}, cannot be cut into triangles")
    of_face = np.repeat(np.arange(len(face_keys)), counts)
    groups: dict[tuple[str, str], list[int]] = {}
    for index, key in enumerate(face_keys):
        groups.setdefault(key, []).append(index)
    parts = list(dict.fromkeys(part for part, _ in face_keys))
    wanted = [(part, name) for part in parts for name in MATERIALS if (part, name) in groups]
    return SolidMesh(
        lod=level,
        low_mm=low_mm,
        local_mm=local_mm,
        normals=normals,
        planes=np.array(planes, np.int64),
        triangles=tuple((*key, triangles[np.isin(of_face, groups[key])]) for key in wanted),
    )


def record_level(feature: Mapping[str, Any]) -> str:
    """The level of detail of a building's record; without a record the finest there is, empty without a model."""
    objects = feature["CityObjects"].values()
    stated = (entry["attributes"]["lod"] for entry in objects if "lod" in entry.get("attributes", ()))
    finest = max((geometry["lod"] for entry in objects for geometry in entry.get("geometry", ())), default="")
    level: str = next(stated, finest)
    return level


@kernel
def _triangulated(
    corners: IntArray, ring_starts: IntArray, face_starts: IntArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Triangles of many faces, each of corners of its own.

    `corners` (n, 3) are those of all rings of all faces in mm, each face's outer ring first; rings start in them at
    `ring_starts` (r + 1,), faces in the rings at `face_starts` (f + 1,). Returns triangles (t, 3) as indices into
    corners, how many each face has (f,), and the unit normal of the face of each corner (n, 3); the counts end before a
    face that cannot be cut.
    """
    n_faces = len(face_starts) - 1
    triangles = np.empty((len(corners) + 2 * len(ring_starts), 3), np.int64)
    counts = np.empty(n_faces, np.int64)
    normals = np.empty((len(corners), 3))
    written = 0
    for face in range(n_faces):
        rings = ring_starts[face_starts[face] : face_starts[face + 1] + 1]
        start, stop = rings[0], rings[-1]
        cut, status = triangulate_rings(corners[start:stop], rings - start)
        if status != DONE:
            return triangles[:written], counts[:face], normals
        for t in range(len(cut)):
            for k in range(3):
                triangles[written, k] = start + cut[t, k]
            written += 1
        counts[face] = len(cut)
        x, y, z = area_vector(corners, start, rings[1])
        length = math.sqrt(float(x) * x + float(y) * y + float(z) * z)
        for corner in range(start, stop):
            normals[corner, 0], normals[corner, 1], normals[corner, 2] = x / length, y / length, z / length
    return triangles[:written], counts, normals


class _Scene:
    """The nodes, meshes and buffers of a file, filled building by building; all components have four bytes."""

    def __init__(self) -> None:
        self._file = GlbFile()
        self._nodes: list[dict[str, Any]] = []
        self._meshes: list[dict[str, Any]] = []
        self._views = [bytearray() for _ in range(4)]

    def add(self, name: str, extras: Mapping[str, Any], mesh: SolidMesh, origin_mm: IntArray) -> None:
        """Append a building."""
        corners = gltf_axes(mesh.local_mm / _MM).astype("<f4")
        attributes = {
            "POSITION": self._accessor(0, corners, "VEC3", **bounds_of(corners)),
            "NORMAL": self._accessor(1, gltf_axes(mesh.normals).astype("<f4"), "VEC3"),
            PLANE_ID: self._accessor(2, mesh.planes.astype("<f4"), "SCALAR"),
        }
        primitives = [
            {
                "attributes": attributes,
                "indices": self._accessor(3, triangles.astype("<u4").reshape(-1), "SCALAR"),
                "material": list(MATERIALS).index(surface),
                "extras": {"part": part},
            }
            for part, surface, triangles in mesh.triangles
        ]
        east, north, up = ((mesh.low_mm - origin_mm) // _MM).tolist()
        node = {"name": name, "mesh": len(self._meshes), "translation": [east, up, -north], "extras": dict(extras)}
        self._meshes.append({"name": name, "primitives": primitives})
        self._nodes.append(node)

    def _accessor(self, view: int, values: Any, kind: str, **more: Any) -> int:
        """Append values to a view; the number of their accessor."""
        place = len(self._views[view])
        self._views[view] += values.tobytes()
        return self._file.accessor(view, byteOffset=place, **values_of(values, kind), **more)

    def file(self, title: str, place: Mapping[str, Any]) -> bytes:
        """The whole file."""
        *vertices, indices = map(bytes, self._views)
        for data, stride in zip(vertices, (12, 12, 4), strict=True):
            self._file.view(data, byteStride=stride, target=VERTICES)
        self._file.view(indices, target=INDICES)
        root = {"name": title, "children": list(range(1, len(self._nodes) + 1)), "extras": dict(place)}
        used = {primitive["material"] for mesh in self._meshes for primitive in mesh["primitives"]}
        return self._file.content(
            [root, *self._nodes],
            self._meshes,
            scene={"name": title, "nodes": [0]},
            materials=materials(used),
            asset={"extras": {"title": title, **place}},
        )


def materials(used: Container[int]) -> list[dict[str, Any]]:
    """All materials in their order; that of undersides only if its number is among those that are used."""
    return [
        material(name, colour)
        for number, (name, colour) in enumerate(MATERIALS.items())
        if name != _ONLY_IF_USED or number in used
    ]


def material(name: str, colour: Sequence[float]) -> dict[str, Any]:
    """A dull material of one colour."""
    return {
        "name": name,
        "pbrMetallicRoughness": {"baseColorFactor": [*colour, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0},
    }
