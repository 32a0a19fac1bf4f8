"""Buildings as footprints, planar roof faces and solids: what the measures look at, whatever wrote them."""

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
    """Coordinates that the plane is given about."""
    plane_id: int = -1
    """Number of its plane within the building, as in the record; -1 where it has none."""
    group: int = -1
    """Surfaces of one building with one group >= 0 count as one face: the two parts of a bent hip face."""

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
    """A building as far as the score looks at it."""

    building_id: str
    """Its name."""
    footprint: Polygon | MultiPolygon
    """2D, coordinates in metres."""
    roof_type: RoofType
    """What it is said to be."""
    surfaces: tuple[RoofSurface, ...]
    """Its roof faces."""
    touches_data_edge: bool = False
    """True where it is cut, or a speck of the raster: as reference it need not be found. Of a model it is the model's
    own claim, which excuses it only at the end of the reference's extent."""
    source_id: str | None = None
    """As in the record; in simulated truth the block, which buildings that touch share."""
    status: Status = Status.OK
    """ok, or fallback where a block stands in place of a model; what others made is ok."""
    lod: str = "2.2"
    """Level of detail, as the model says."""
    solids: tuple[Solid, ...] = ()
    """Its closed solids about `solid_origin`; empty where only surfaces are known."""
    solid_origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Coordinates of the solids' origin, metres."""

    def top(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Elevation of the highest roof face at places x, y; nan where there is none."""
        top = np.full(len(x), -np.inf)
        for surface in self.surfaces:
            inside = shapely.intersects_xy(surface.polygon, x, y)
            top[inside] = np.maximum(top[inside], surface.elevation(x[inside], y[inside]))
        return np.where(np.isfinite(top), top, np.nan)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelSet:
    """Models as one program delivered them, in metres."""

    name: str
    """What the report calls them: the method of a run, else the file's name."""
    kind: Literal["run", "cityjson", "cityjsonseq", "obj"]
    """What was read."""
    path: str
    """Where."""
    models: tuple[RoofModel, ...]
    """Those with a footprint and at least one roof face, sorted by building_id."""
    failed: tuple[RoofModel, ...] = ()
    """Records without a model: failed candidates, objects without geometry. Their footprint may be empty."""
    crs: str | None = None
    """Name or code of the coordinate reference system; None where unknown."""
    has_footprints: bool = False
    """True where the models follow given footprints: neighbours in a row are then told apart."""
    notes: tuple[str, ...] = ()
    """What the reader had to assume or leave out, as sentences for the report."""
