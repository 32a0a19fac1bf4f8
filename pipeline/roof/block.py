"""The fallback: an LoD1.2 block, a footprint extruded to one height."""

from __future__ import annotations

import math

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from pipeline.errors import BuildingError
from pipeline.model import FloatArray, Plane, Reason
from pipeline.roof.footprint import polygons_of, without_repeated
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import SolidPart, solid_parts

_MINIMUM_HEIGHT_M = 0.1
_DRAWN_BACK_MM = (2.0, 20.0, 100.0)


def block_plane(points: FloatArray, ground_z_m: float, percentile: float) -> Plane:
    """The horizontal plane at a percentile of the points' elevations.

    Parameters
    ----------
    points : (n, 3) float64
        Roof points, at least one.
    ground_z_m : float
        The floor; the plane lies at least 0.1 m above it.
    percentile : float
        0 to 100.

    Returns
    -------
    Plane
        Rounded to 1 mm.
    """
    z = np.sort(points[:, 2])
    height = float(z[min(len(z) - 1, math.floor(percentile / 100.0 * len(z)))])
    height = round(max(height, ground_z_m + _MINIMUM_HEIGHT_M), 3)
    squares = math.fsum(((z - height) ** 2).tolist())
    return Plane(a=0.0, b=0.0, c=height, n_points=len(z), rmse_m=math.sqrt(squares / len(z)))


def block_parts(
    footprint_mm: MultiPolygon, plane: Plane, ground_z_m: float, tolerance_m: float, minimum_area_m2: float
) -> list[SolidPart]:
    """One block for every part of a footprint.

    Parts are opened by a few centimetres where they pinch, and simplified.

    Parameters
    ----------
    footprint_mm : MultiPolygon
        Integer millimetres, valid.
    plane : Plane
        The horizontal roof.
    ground_z_m : float
        Elevation of the floor.
    tolerance_m : float
        Simplification of the outline (0 for none).
    minimum_area_m2 : float
        Smaller parts are left out unless there is no larger one.

    Returns
    -------
    list of SolidPart
        At least one.

    Raises
    ------
    BuildingError
        `no_footprint` where no part has an area.
    """
    opened = shapely.buffer(shapely.buffer(footprint_mm, -25.0, join_style="mitre"), 25.0, join_style="mitre")
    fault = BuildingError(Reason.NO_FOOTPRINT, f"the outline has an area of {footprint_mm.area * 1e-6:g} m2")
    # the opening can leave parts or holes that touch: draw them back, in the last resort fill everything
    for shape in (*(shapely.buffer(opened, -mm, join_style="mitre") for mm in _DRAWN_BACK_MM), opened.convex_hull):
        large = _clean_parts(shape, tolerance_m, minimum_area_m2)
        if not large:
            continue
        partition = RoofPartition(polygons=tuple(large), labels=np.zeros(len(large), np.int32))
        try:
            return solid_parts(partition, [plane], ground_z_m)
        except BuildingError as error:
            fault = error
    raise fault


def _clean_parts(shape: BaseGeometry, tolerance_m: float, minimum_area_m2: float) -> list[Polygon]:
    """Simplified polygons on whole millimetres: those large enough, else the largest; none of an empty shape."""
    if tolerance_m > 0.0:
        shape = shapely.simplify(shape, tolerance_m * 1e3, preserve_topology=True)
    snapped = polygons_of(shapely.set_precision(shape, 1.0))
    polygons = [thinned for polygon in snapped for thinned in without_repeated(polygon, 5.0) if thinned.is_valid]
    large = [p for p in polygons if p.area >= minimum_area_m2 * 1e6]
    return large or sorted(polygons, key=lambda p: -p.area)[:1]
