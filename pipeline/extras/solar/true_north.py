"""Where places of a run are on the earth, and where true north is there."""

from __future__ import annotations

import math

from pipeline.errors import RunError
from pipeline.io.crs import SpatialReference

_STEP_M = 100.0
"""Length of the step to grid north by which its direction is measured."""


def longitude_and_latitude(reference: SpatialReference, x_m: float, y_m: float) -> tuple[float, float]:
    """Degrees (WGS 84) of a place in metres of a known CRS; raises RunError if the CRS has no such place."""
    transformer, unit_m = reference.to_degrees, reference.horizontal_unit_m
    longitude, latitude = math.nan, math.nan
    if transformer is not None:
        longitude, latitude = transformer.transform(x_m / unit_m, y_m / unit_m)
    if not (math.isfinite(longitude) and math.isfinite(latitude)):
        raise RunError(
            f"{reference.name} has no place at {x_m / unit_m:.0f}, {y_m / unit_m:.0f}: the run has a wrong CRS. "
            "Run it again with the right --crs"
        )
    return float(longitude), float(latitude)


def convergence_deg(reference: SpatialReference, x_m: float, y_m: float) -> float:
    """The azimuth of grid north at a place, clockwise from true north (meridian convergence); 0 if the CRS is unknown.

    Raises RunError if the CRS has no such place.
    """
    if reference.wkt is None:
        return 0.0
    import pyproj

    here = longitude_and_latitude(reference, x_m, y_m)
    there = longitude_and_latitude(reference, x_m, y_m + _STEP_M)
    azimuth, _, _ = pyproj.Geod(ellps="WGS84").inv(*here, *there)
    return float(azimuth)
