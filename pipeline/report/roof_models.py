"""Buildings as footprints and planar roof faces: what scores look at, whatever wrote them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
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
    source_id: str | None = None
    """As in the record; in simulated truth the block, which buildings that touch share."""

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
            source_id=row["source_id"],
        )
        for row in read_table(str(run_dir), "buildings").to_pylist()
        if row["geometry"] is not None
    ]


def joined_blocks(models: Sequence[RoofModel]) -> list[RoofModel]:
    """Models that share a source_id as one, in the order of their first ones; those without one stay alone.

    Without given footprints nothing tells where one house of a row ends: a run without them is to be compared with
    blocks. The roof type of a block is that of its parts where they agree, else combination.
    """
    groups: dict[str, list[RoofModel]] = {}
    for number, model in enumerate(models):
        groups.setdefault(model.source_id or f"alone {number}", []).append(model)
    joined = []
    for parts in groups.values():
        if len(parts) == 1:
            joined.append(parts[0])
            continue
        types = {part.roof_type for part in parts}
        joined.append(
            RoofModel(
                building_id=parts[0].building_id,
                footprint=shapely.union_all([part.footprint for part in parts], grid_size=0.001),
                roof_type=types.pop() if len(types) == 1 else RoofType.COMBINATION,
                surfaces=tuple(surface for part in parts for surface in part.surfaces),
                touches_data_edge=any(part.touches_data_edge for part in parts),
                source_id=parts[0].source_id,
            )
        )
    return joined
