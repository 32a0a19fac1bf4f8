"""Buildings on the globe as the content of 3D Tiles: one GLB file with one mesh for all, and their records.

A file has three primitives: roofs, walls and grounds, each with its material. Each vertex has the number of its
building (EXT_mesh_features), which is a row of the property table (EXT_structural_metadata); those of roofs have the
number of their plane, too. Positions are 16-bit integers (KHR_mesh_quantization) about a place on the ellipsoid, east,
north and up; a matrix leads from there to EPSG:4978, rigidly: the curvature of the Earth is in the positions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from shapely import Polygon
from shapely.geometry.polygon import orient

from pipeline.export.glb import MATERIALS, Frame, SolidMesh, materials, record_level
from pipeline.export.glb_arrays import MOST_SHORT, add_triangles, add_vertices, gltf_axes, quantized
from pipeline.export.glb_container import QUANTIZATION, GlbFile
from pipeline.extras.publish_3dtiles.property_table import StoredColumn
from pipeline.model import FloatArray, IntArray

Geodesy = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""From places (n, 3) in metres of the CRS to longitude and latitude in degrees and ellipsoidal height in metres (n, 3),
and to EPSG:4978 (n, 3) in metres; not finite where there is none."""
BUILDING, ROOF_PLANE = "building", "roof_plane"
"""Labels of the sets of feature ids, and of the class of the records."""
NO_PLANE = MOST_SHORT
"""Feature id of a roof without a plane: a block's."""
SIMPLER_M = 0.5
"""How far outlines of blocks may be from those of the models; a tenth of the least error of blocks."""
_SEMI_MAJOR_M, _ECCENTRICITY_2 = 6_378_137.0, 6.69437999014e-3
"""The ellipsoid of WGS 84."""
_MM = 1000
_REACH_M = 100.0
_FEATURES, _METADATA = "EXT_mesh_features", "EXT_structural_metadata"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Placed:
    """A building on the globe."""

    record: Mapping[str, Any]
    """Its columns."""
    geocentric: FloatArray
    """(v, 3) corners in EPSG:4978."""
    normals: FloatArray
    """(v, 3) unit normals there."""
    planes: IntArray
    """(v,) number of the roof plane, -1 elsewhere."""
    surfaces: Mapping[str, IntArray]
    """Triangles (t, 3) of each semantic surface."""
    region: FloatArray
    """(2, 3) smallest and largest longitude, latitude (degrees), ellipsoidal height (m)."""

    @property
    def size_m(self) -> float:
        """Diagonal of the box around the building, along the axes of EPSG:4978: at least its size."""
        return float(np.linalg.norm(np.ptp(self.geocentric, axis=0)))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Content:
    """A stored file and where it lies."""

    uri: str
    """Its path, relative to the tileset."""
    matrix: FloatArray
    """(4, 4) from its axes, turned to z up, to EPSG:4978."""


def block_feature(feature: Mapping[str, Any], frame: Frame, top: float) -> dict[str, Any]:
    """The block of a building: its grounds, simplified, raised to `top`, in vertical units of the CRS.

    That is LoD1.2 as `pipeline.extras.lods.lower_lods` has it, and every run has what it takes; its outline is within
    `SIMPLER_M`. It has no floor. Where a ground lies above `top`, the block is a unit high.
    """
    objects: dict[str, Any] = {}
    vertices: list[list[int]] = []
    level = record_level(feature)
    for part, entry in feature["CityObjects"].items():
        geometry = next((g for g in entry.get("geometry", ()) if g["lod"] == level), None)
        if geometry is None:
            continue
        semantics = geometry["semantics"]
        kinds = [semantics["surfaces"][value]["type"] for value in semantics["values"][0]]
        roofs: list[list[list[int]]] = []
        walls: list[list[list[int]]] = []
        for face, kind in zip(geometry["boundaries"][0], kinds, strict=True):
            if kind != "GroundSurface":
                continue
            rings = [[feature["vertices"][corner] for corner in ring] for ring in face]
            low = max(corner[2] for ring in rings for corner in ring)
            high = max(round(top * int(frame.steps[2])) - int(frame.shift[2]), low + int(frame.steps[2]))
            roofs.append([])
            for ring in _simpler(rings, SIMPLER_M / float(frame.units_m[0]) * int(frame.steps[0])):
                count, start = len(ring), len(vertices)
                vertices.extend([x, y, z] for z in (low, high) for x, y in ring)
                roofs[-1].append([start + count + k for k in reversed(range(count))])
                for k in range(count):
                    before = (k - 1) % count
                    walls.append([[start + k, start + before, start + count + before, start + count + k]])
        surfaces = [{"type": "RoofSurface"}, {"type": "WallSurface"}]
        values = [[0] * len(roofs) + [1] * len(walls)]
        block = {"lod": "1.2", "boundaries": [[*roofs, *walls]], "semantics": {"surfaces": surfaces, "values": values}}
        objects[part] = {"geometry": [block]}
    return {"CityObjects": objects, "vertices": vertices}


def _simpler(rings: Sequence[Sequence[Sequence[int]]], tolerance: float) -> list[list[tuple[int, int]]]:
    """The rings of a ground in plan with fewer corners, clockwise from above, holes the other way round."""
    shell, *holes = ([corner[:2] for corner in ring] for ring in rings)
    simpler = orient(Polygon(shell, holes).simplify(tolerance), -1.0)
    return [[(int(x), int(y)) for x, y in ring.coords[:-1]] for ring in (simpler.exterior, *simpler.interiors)]


def placed(meshes: Sequence[tuple[Mapping[str, Any], SolidMesh]], geodesy: Geodesy) -> list[Placed]:
    """Buildings of one tile, with their records, on the globe.

    Raises ValueError if one has no place there.
    """
    if not meshes:
        return []
    corners = np.concatenate([mesh.low_mm + mesh.local_mm for _, mesh in meshes]) / _MM
    geodetic, geocentric = geodesy(corners)
    if not np.isfinite(geocentric).all():
        worst = corners[~np.isfinite(geocentric).all(axis=1)][0]
        raise ValueError(f"the place {worst[0]:.0f} m east, {worst[1]:.0f} m north has no longitude and latitude")
    steps = np.vstack((_REACH_M * np.eye(3), -_REACH_M * np.eye(3))) + corners.mean(axis=0)
    there = geodesy(steps)[1]
    # a plane's normal goes by the inverse of what its points go by
    turn = np.linalg.inv((there[:3] - there[3:]).T / (2.0 * _REACH_M))
    found, start = [], 0
    for record, mesh in meshes:
        part = slice(start, start := start + len(mesh.local_mm))
        normals = mesh.normals @ turn
        groups: dict[str, list[IntArray]] = {}
        for _, surface, triangles in mesh.triangles:
            groups.setdefault(surface, []).append(triangles)
        found.append(
            Placed(
                record=record,
                # not a view: it would keep those of the whole tile
                geocentric=geocentric[part].copy(),
                normals=normals / np.linalg.norm(normals, axis=1)[:, None],
                planes=mesh.planes,
                surfaces={surface: np.concatenate(parts) for surface, parts in groups.items()},
                region=np.vstack((geodetic[part].min(axis=0), geodetic[part].max(axis=0))),
            )
        )
    return found


def region_of(buildings: Sequence[Placed]) -> FloatArray:
    """The region (2, 3) around buildings, as `Placed.region`."""
    regions = np.array([building.region for building in buildings])
    return np.vstack((regions[:, 0].min(axis=0), regions[:, 1].max(axis=0)))


def local_axes(region: FloatArray) -> FloatArray:
    """East, north and up at the middle of a region, on its floor: the matrix (4, 4) to EPSG:4978."""
    lon, lat = (region[0, :2] + region[1, :2]) / 2.0
    east, north = np.radians(lon), np.radians(lat)
    across = _SEMI_MAJOR_M / np.sqrt(1.0 - _ECCENTRICITY_2 * np.sin(north) ** 2)
    height = region[0, 2]
    found = np.eye(4)
    found[:3, 3] = (
        (across + height) * np.cos(north) * np.cos(east),
        (across + height) * np.cos(north) * np.sin(east),
        (across * (1.0 - _ECCENTRICITY_2) + height) * np.sin(north),
    )
    found[:3, 0] = -np.sin(east), np.cos(east), 0.0
    found[:3, 1] = -np.sin(north) * np.cos(east), -np.sin(north) * np.sin(east), np.cos(north)
    found[:3, 2] = np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)
    return found


def globe_glb(buildings: Sequence[Placed], columns: Sequence[StoredColumn], matrix: FloatArray) -> bytes:
    """At least one building as a GLB file about the axes of `matrix`; the same buildings give the same bytes."""
    turn, origin = matrix[:3, :3], matrix[:3, 3]
    metres = gltf_axes((np.concatenate([b.geocentric for b in buildings]) - origin) @ turn)
    node, positions = quantized(np.rint(metres * _MM).astype(np.int64))
    normals = np.rint(gltf_axes(np.concatenate([b.normals for b in buildings]) @ turn) * 127.0).astype("|i1")
    planes = np.concatenate([b.planes for b in buildings])
    counts = [len(b.geocentric) for b in buildings]
    numbers = np.repeat(np.arange(len(buildings)), counts)
    starts = np.cumsum([0, *counts])
    file = GlbFile(alignment=8)
    # all primitives share the corners: those of a building's roof and walls are near one another, as gzip needs it
    attributes = {
        "POSITION": add_vertices(file, positions, "VEC3", bounded=True),
        "NORMAL": add_vertices(file, normals, "VEC3", normalized=True),
        "_FEATURE_ID_0": add_vertices(file, numbers.astype("<u2" if len(buildings) <= NO_PLANE else "<f4"), "SCALAR"),
    }
    sets = [{"featureCount": len(buildings), "attribute": 0, "label": BUILDING, "propertyTable": 0}]
    plane_attributes, plane_sets = {}, []
    if (planes >= 0).any():
        held = np.where(planes < 0, NO_PLANE, planes)
        plane_attributes["_FEATURE_ID_1"] = add_vertices(file, held.astype("<u2"), "SCALAR")
        count = len(np.unique(planes[planes >= 0]))
        plane_sets.append({"featureCount": count, "attribute": 1, "label": ROOF_PLANE, "nullFeatureId": NO_PLANE})
    primitives = []
    for name in MATERIALS:
        parts = [b.surfaces[name] + start for b, start in zip(buildings, starts, strict=False) if name in b.surfaces]
        if not parts:
            continue
        roof = name == "RoofSurface"
        primitives.append(
            {
                "attributes": {**attributes, **plane_attributes} if roof else attributes,
                "indices": add_triangles(file, np.concatenate(parts)),
                "material": list(MATERIALS).index(name),
                "extensions": {_FEATURES: {"featureIds": [*sets, *plane_sets] if roof else sets}},
            }
        )
    table = {"class": BUILDING, "count": len(buildings), "properties": _properties(file, buildings, columns)}
    classes = {BUILDING: {"properties": {column.name: column.definition for column in columns}}}
    return file.content(
        [{"mesh": 0, **node}],
        [{"primitives": primitives}],
        materials=materials(()),
        used=(QUANTIZATION, _FEATURES, _METADATA),
        extensions={_METADATA: {"schema": {"id": "gablework", "classes": classes}, "propertyTables": [table]}},
    )


def _properties(file: GlbFile, buildings: Sequence[Placed], columns: Sequence[StoredColumn]) -> dict[str, Any]:
    """Append the columns of a property table that have values; its properties."""
    found = {}
    for column in columns:
        values = [building.record[column.name] for building in buildings]
        if all(value is None for value in values):
            continue
        data, offsets = column.stored(values)
        found[column.name] = {"values": file.view(data or b"\0")}
        if offsets is not None:
            found[column.name]["stringOffsets"] = file.view(offsets)
    return found
