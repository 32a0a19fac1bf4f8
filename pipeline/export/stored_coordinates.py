"""Coordinates of the outputs: from local metres to the units of the coordinate reference system."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Protocol, TypeVar

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from pipeline.model import FloatArray

Geometry = TypeVar("Geometry", bound=BaseGeometry)


class SpatialReference(Protocol):
    """What the outputs need to know of a coordinate reference system (CRS)."""

    @property
    def horizontal_unit_m(self) -> float:
        """Metres in one unit of easting and northing."""

    @property
    def vertical_unit_m(self) -> float:
        """Metres in one unit of elevation."""

    @property
    def epsg(self) -> int | None:
        """EPSG code of the whole CRS, compound where it is; None where it has none."""

    @property
    def projjson(self) -> dict[str, Any] | None:
        """The CRS as PROJJSON; None where it is unknown."""


@dataclasses.dataclass(frozen=True)
class _OneUnit:
    """A reference whose elevations are in the unit of its eastings."""

    horizontal_unit_m: float
    epsg: int | None
    projjson: dict[str, Any] | None

    @property
    def vertical_unit_m(self) -> float:
        return self.horizontal_unit_m


def one_unit(reference: SpatialReference) -> SpatialReference:
    """The reference for formats that name a CRS by one EPSG code, and no unit beside it.

    Elevations are in the unit of eastings and northings, unless the code is that of a CRS with a vertical axis. The
    reference itself where that is so already.
    """
    stated = reference.epsg is not None and _has_elevations(reference.projjson)
    if stated or math.isclose(reference.horizontal_unit_m, reference.vertical_unit_m, rel_tol=1e-9):
        return reference
    return _OneUnit(reference.horizontal_unit_m, reference.epsg, reference.projjson)


def _has_elevations(projjson: Mapping[str, Any] | None) -> bool:
    """Whether a CRS has a vertical axis."""
    part = projjson or {}
    axes = (part.get("coordinate_system") or {}).get("axis") or ()
    return (
        len(axes) > 2 or bool(part.get("components")) or ("source_crs" in part and _has_elevations(part["source_crs"]))
    )


def decimals(unit_m: float) -> int:
    """Decimals that keep 1 mm: 3 in metres; in other units one more than needed, so that 1 mm survives the way back.

    >>> decimals(1.0), decimals(0.3048)
    (3, 4)
    """
    return 3 if unit_m == 1.0 else max(0, math.ceil(3.0 + math.log10(unit_m)) + 1)


def crs_coordinates(local: FloatArray, origin: tuple[float, float, float], reference: SpatialReference) -> FloatArray:
    """Local metres, (n, 2) or (n, 3), as coordinates in the CRS's own units, rounded to 1 mm or finer.

    `origin` is the absolute easting, northing, elevation of the local origin in metres.
    """
    units = (reference.horizontal_unit_m, reference.horizontal_unit_m, reference.vertical_unit_m)[: local.shape[1]]
    absolute = local + np.array(origin[: local.shape[1]])
    if units.count(1.0) == len(units):  # metres, as nearly always: one step for all axes, and a division by 1 less
        rounded: FloatArray = np.round(absolute, decimals(1.0)) + 0.0
        return rounded
    out = np.empty(local.shape)
    for axis, unit_m in enumerate(units):
        out[:, axis] = np.round(absolute[:, axis] / unit_m, decimals(unit_m))
    return out + 0.0


def crs_elevation(local_z_m: float, origin: tuple[float, float, float], reference: SpatialReference) -> float:
    """An elevation in the CRS's own vertical unit, rounded to 1 mm or finer; nan stays nan."""
    unit_m = reference.vertical_unit_m
    return round((local_z_m + origin[2]) / unit_m, decimals(unit_m)) + 0.0


def crs_geometry(geometry: Geometry, origin: tuple[float, float, float], reference: SpatialReference) -> Geometry:
    """A polygon in CRS units in one canonical form, whatever the order in which it was built.

    Exterior rings run counter-clockwise, holes clockwise, every ring starts at its smallest vertex, parts and holes
    are in the order of GEOS's normal form.
    """
    moved = shapely.transform(
        geometry, lambda local: crs_coordinates(local, origin, reference), include_z=bool(geometry.has_z)
    )
    canonical: Geometry = shapely.orient_polygons(shapely.normalize(moved))
    return canonical


def epsg_code(reference: SpatialReference) -> int | None:
    """The EPSG code of a CRS; of its horizontal part where a compound CRS has none; None where neither has one."""
    if reference.epsg is not None:
        return reference.epsg
    part = reference.projjson
    while part is not None:
        identifier = part.get("id") or {}
        if identifier.get("authority") == "EPSG" and str(identifier.get("code", "")).isdigit():
            return int(identifier["code"])
        components = part.get("components") or []
        part = components[0] if components else part.get("source_crs")
    return None
