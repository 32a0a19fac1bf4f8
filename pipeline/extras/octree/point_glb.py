"""Points as glTF 2.0 in one binary file (GLB): positions as integers, and per point its class and its building.

The axes are those of the models' GLB (`pipeline.export.glb`): x is easting, y elevation, z minus northing. Points are
sorted by building, so that those of one building can be cut out (`pipeline.extras.octree.building_points`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.export.glb_arrays import add_vertices, quantized
from pipeline.export.glb_container import QUANTIZATION, GlbFile
from pipeline.model import ByteArray, IntArray

NO_BUILDING = 65_535
"""Marker in `_BUILDING`: no building was modelled from the point."""
NO_PLANE = 65_535
"""Marker in `_PLANE`: no roof face lies above or below the point."""
NO_RESIDUAL = -32_768
"""Marker in `_RESIDUAL`: as for `_PLANE`."""

UShortArray = npt.NDArray[np.uint16]
ShortArray = npt.NDArray[np.int16]

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
    x, y, z = points.xyz_mm.T
    place, positions = quantized(np.column_stack((x, z, -y)))
    file = GlbFile()
    attributes = {
        "POSITION": add_vertices(file, positions, "VEC3", bounded=True),
        "_CLASS": add_vertices(file, points.point_class, "SCALAR"),
        "_BUILDING": add_vertices(file, points.building.astype("<u2"), "SCALAR"),
        "_PLANE": add_vertices(file, points.plane.astype("<u2"), "SCALAR"),
        "_RESIDUAL": add_vertices(file, points.residual_mm.astype("<i2"), "SCALAR"),
    }
    mesh = {
        "name": name,
        "primitives": [{"attributes": attributes, "mode": _POINTS}],
        "extras": {**extras, "points": len(points), "buildings": list(points.buildings), "starts": points.starts()},
    }
    return file.content([{"name": name, "mesh": 0, **place}], [mesh], used=[QUANTIZATION])
