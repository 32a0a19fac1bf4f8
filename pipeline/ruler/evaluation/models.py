"""Buildings of any program as footprints, planar roof faces and solids: the input of all measures."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import FloatArray, RoofType, Solid, Status


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofSurface:
    """One planar roof face: z = a (x - origin_x) + b (y - origin_y) + c + origin_z over its polygon."""

    polygon: Polygon
    """2D, coordinates in metres."""
    coefficients: tuple[float, float, float]
    """a, b, c: rise per metre east and north, height over the origin."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    plane_id: int = -1
    """Number of its plane within the building, as in the record; -1 if it has none."""
    group: int = -1
    """Surfaces of one building with one group >= 0 count as one face, such as the two parts of a bent hip face."""

    def elevation(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Elevation of the plane at places x, y."""
        a, b, c = self.coefficients
        return a * (x - self.origin[0]) + b * (y - self.origin[1]) + (c + self.origin[2])

    @property
    def normal(self) -> FloatArray:
        """(3,) float64, unit normal that points up."""
        a, b, _ = self.coefficients
        return np.array([-a, -b, 1.0]) / math.sqrt(1.0 + a * a + b * b)

    @property
    def area_m2(self) -> float:
        """Area in the plane, square metres."""
        return float(self.polygon.area / self.normal[2])


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofModel:
    """A building for the measures."""

    building_id: str
    footprint: Polygon | MultiPolygon
    """2D, coordinates in metres."""
    roof_type: RoofType
    surfaces: tuple[RoofSurface, ...]
    touches_data_edge: bool = False
    """True if it is cut by the edge of the data, or a speck of the raster: such a reference building need not be found.
    For a model it is a claim, which excuses it only at the edge of the extent of the reference."""
    source_id: str | None = None
    """As in the record; in simulated truth the block, which buildings that touch share."""
    status: Status = Status.OK
    """ok, doubtful, or fallback for a block; models of other programs are ok."""
    lod: str = "2.2"
    """Level of detail that the model claims."""
    solids: tuple[Solid, ...] = ()
    """Its closed solids about `solid_origin`; empty where only surfaces are known."""
    solid_origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Coordinates of the solids' origin, metres."""

    def top(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Elevation of the highest roof face at places x, y; nan without one."""
        top = np.full(len(x), -np.inf)
        for surface in self.surfaces:
            inside = shapely.intersects_xy(surface.polygon, x, y)
            top[inside] = np.maximum(top[inside], surface.elevation(x[inside], y[inside]))
        return np.where(np.isfinite(top), top, np.nan)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelSet:
    """The models of one program, in metres."""

    name: str
    """Their name in the report: the method of a run, else the name of the file."""
    kind: Literal["run", "cityjson", "cityjsonseq", "obj"]
    path: str
    models: tuple[RoofModel, ...]
    """Those with a footprint and at least one roof face, sorted by building_id."""
    failed: tuple[RoofModel, ...] = ()
    """Records without a model: failed candidates, objects without geometry. Their footprint may be empty."""
    crs: str | None = None
    """Name or code of the coordinate reference system; None if unknown."""
    has_footprints: bool = False
    """True if the models follow given footprints, which separate neighbours in a row."""
    notes: tuple[str, ...] = ()
    """Assumptions and omissions of the reader, as sentences for the report."""
