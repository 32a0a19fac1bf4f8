"""From the coordinates of a run to geocentric ones (EPSG:4978), as a globe needs them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.io.crs import SpatialReference
from pipeline.model import FloatArray


def to_globe(reference: SpatialReference) -> Callable[[FloatArray], FloatArray] | None:
    """A function from places (n, 3) in metres of the CRS to EPSG:4978, (n, 3) in metres; None if the CRS is unknown.

    Places that have none get infinite coordinates. Elevations above a geoid are converted if PROJ has its grid, else
    they are taken for heights above the ellipsoid.
    """
    crs = reference.crs
    if crs is None:
        return None
    import pyproj

    whole = crs if len(crs.axis_info) == 3 else crs.to_3d()
    transformer = pyproj.Transformer.from_crs(whole, pyproj.CRS.from_epsg(4978), always_xy=True)
    horizontal_m = reference.horizontal_unit_m
    # `to_3d` adds an axis in metres
    vertical_m = reference.vertical_unit_m if whole is crs else 1.0

    def transform(xyz_m: FloatArray) -> FloatArray:
        x, y, z = xyz_m.T
        found: FloatArray = np.column_stack(transformer.transform(x / horizontal_m, y / horizontal_m, z / vertical_m))
        return found

    return transform
