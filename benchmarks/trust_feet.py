"""The files of a simulated scene in feet: what a survey in feet makes of the same points."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pyproj
from laspy.vlrs.known import WktCoordinateSystemVlr

FOOT_M = 0.3048
"""The international foot."""


def crs_in_feet(crs: pyproj.CRS) -> pyproj.CRS:
    """A compound CRS in metres with feet on all axes, so that a place has the same coordinates over `FOOT_M`."""
    changed = crs.to_json_dict()
    changed.pop("id", None)
    for part in changed["components"]:
        part.pop("id", None)
        part["name"] += " (ft)"
        for axis in part["coordinate_system"]["axis"]:
            axis["unit"] = {"type": "LinearUnit", "name": "foot", "conversion_factor": FOOT_M}
    return pyproj.CRS.from_json_dict(changed)


def write_in_feet(metres: Path, feet: Path) -> None:
    """Write a copy of a LAZ file whose coordinates are in feet, to 0.001 ft, and whose compound CRS says so."""
    las = laspy.read(metres)
    header = laspy.LasHeader(version=las.header.version, point_format=las.header.point_format)
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(las.header.offsets / FOOT_M)
    header.global_encoding.gps_time_type = las.header.global_encoding.gps_time_type
    header.global_encoding.wkt = True
    crs = las.header.parse_crs()
    assert crs is not None
    header.vlrs.append(WktCoordinateSystemVlr(crs_in_feet(crs).to_wkt("WKT1_GDAL")))
    copy = laspy.LasData(header)
    for name in set(las.point_format.dimension_names) - {"X", "Y", "Z"}:
        copy[name] = las[name]
    for axis in "xyz":
        setattr(copy, axis, np.asarray(las[axis]) / FOOT_M)
    copy.write(feet)
