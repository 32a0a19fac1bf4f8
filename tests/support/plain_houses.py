"""Three houses on level ground, whose points a test gives classes and flight strips of its own."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyproj

AREAS_M2 = (84.0, 150.0, 169.0)
"""Plan areas of the gable and of the two flat roofs."""
SIDE_M = 70.0
_BOXES = ((10.0, 12.0, 22.0, 19.0), (40.0, 12.0, 55.0, 22.0), (25.0, 42.0, 38.0, 55.0))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Houses:
    """Points of the scene; arrays of one length n."""

    xyz: npt.NDArray[np.float64]
    """(n, 3), metres."""
    house: npt.NDArray[np.int8]
    """The house on whose roof each lies, -1 on the ground."""


def houses(seed: int = 5, per_m2: float = 6.0, noise_m: float = 0.02) -> Houses:
    """A gable of 12 m by 7 m, and flat roofs of 15 m by 10 m and 13 m by 13 m, without walls and trees."""
    random = np.random.default_rng(seed)
    n = round(per_m2 * SIDE_M**2)
    x, y = random.uniform(0.0, SIDE_M, n), random.uniform(0.0, SIDE_M, n)
    z, house = np.full(n, 50.0), np.full(n, -1, np.int8)
    for k, (x0, y0, x1, y1) in enumerate(_BOXES):
        inside = (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
        house[inside] = k
        z[inside] = (58.0 - 0.8 * np.abs(y - 15.5), np.full(n, 55.0), np.full(n, 60.0))[k][inside]
    z += random.normal(0.0, noise_m, n)
    return Houses(xyz=np.column_stack((x + 400_000.0, y + 5_700_000.0, z)), house=house)


def write_houses(
    path: Path,
    found: Houses,
    classes: npt.ArrayLike = 0,
    strips: npt.ArrayLike = 1,
    lift_m: npt.ArrayLike = 0.0,
    times_s: npt.ArrayLike = 0.0,
) -> Path:
    """Write the points with classes, flight strips, a lift and a GPS time of each, in EPSG:25832 with NHN heights."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(found.xyz.min(axis=0))
    header.add_crs(pyproj.CRS("EPSG:25832+7837"))
    las = laspy.LasData(header)
    n = len(found.house)
    las.x, las.y, las.z = found.xyz[:, 0], found.xyz[:, 1], found.xyz[:, 2] + np.asarray(lift_m)
    values: dict[str, Any] = {"return_number": 1, "number_of_returns": 1, "classification": classes}
    for name, value in (values | {"point_source_id": strips, "gps_time": times_s}).items():
        las[name] = np.broadcast_to(np.asarray(value), n)
    las.write(path)
    return path
