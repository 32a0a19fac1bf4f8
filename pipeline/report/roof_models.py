"""Buildings as footprints and planar roof faces: what scores look at, whatever wrote them."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import FloatArray, RoofType


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofSurface:
    """One planar roof face: z = a (x - origin_x) + b (y - origin_y) + c + origin_z over its polygon."""

    polygon: Polygon
    """2D, coordinates in metres."""
    coefficients: tuple[float, float, float]
    """a, b, c: rise per metre east and north, height over the origin."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Coordinates that the plane is given about."""

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
    """True where it is cut: as truth it need not be found, as a model it is not wrong."""

    def top(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Elevation of the highest roof face at places x, y; nan where there is none."""
        top = np.full(len(x), -np.inf)
        for surface in self.surfaces:
            inside = shapely.intersects_xy(surface.polygon, x, y)
            top[inside] = np.maximum(top[inside], surface.elevation(x[inside], y[inside]))
        return np.where(np.isfinite(top), top, np.nan)


def read_roof_models(run_dir: str | Path) -> list[RoofModel]:
    """The buildings of a run directory, or of the truth that `simulate` writes, sorted by building_id.

    Records without a footprint are left out. Coordinates are taken as metres, as simulated scenes have them.

    Raises
    ------
    RunError
        If there are no such tables.
    """
    from pipeline.export.geoparquet import read_table

    surfaces: dict[str, list[RoofSurface]] = {}
    for row in read_table(str(run_dir), "planes").to_pylist():
        normal_x, normal_y, normal_z, offset = row["coefficients"]
        geometry = shapely.force_2d(shapely.from_wkb(row["geometry"])) if row["geometry"] else Polygon()
        for polygon in shapely.get_parts(geometry).tolist():
            surfaces.setdefault(row["building_id"], []).append(
                RoofSurface(
                    polygon=polygon,
                    coefficients=(-normal_x / normal_z, -normal_y / normal_z, -offset / normal_z),
                    origin=(row["origin_x"], row["origin_y"], row["origin_z"]),
                )
            )
    return [
        RoofModel(
            building_id=row["building_id"],
            footprint=shapely.force_2d(shapely.from_wkb(row["geometry"])),
            roof_type=RoofType(row["roof_type"]),
            surfaces=tuple(surfaces.get(row["building_id"], ())),
            touches_data_edge=row["touches_data_edge"],
        )
        for row in read_table(str(run_dir), "buildings").to_pylist()
        if row["geometry"] is not None
    ]
