"""The fallback: an LoD1.2 block, a footprint extruded to one height."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from pipeline.errors import BuildingError
from pipeline.model import FloatArray, Plane, Reason
from pipeline.roof.footprint import polygons_of
from pipeline.roof.footprint_in_mm import without_repeated
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import SolidPart, solid_parts

_MIN_HEIGHT_M = 0.1
"""Height of the lowest block: it must be a solid."""
_DRAWN_BACK_MM = (2.0, 20.0, 100.0)
_SHARES_OF_TOLERANCE = (0.0, 0.5, 1.0)
"""Forms of an outline that touches itself, the nearest to it first."""


def block_plane(points: FloatArray, ground_z_m: float, percentile: float) -> Plane:
    """The horizontal plane at a percentile (0 to 100) of the elevations of points, (n, 3) with n >= 1.

    It is rounded to 1 mm and lies at least 0.1 m above the floor.
    """
    z = np.sort(points[:, 2])
    height = float(z[min(len(z) - 1, math.floor(percentile / 100.0 * len(z)))])
    height = round(max(height, ground_z_m + _MIN_HEIGHT_M), 3)
    squares = math.fsum(((z - height) ** 2).tolist())
    return Plane(a=0.0, b=0.0, c=height, n_points=len(z), rmse_m=math.sqrt(squares / len(z)))


def block_forms(
    footprint_mm: MultiPolygon,
    plane: Plane,
    ground_z_m: float,
    tolerance_m: float,
    min_area_m2: float,
    outline_mm: MultiPolygon | None = None,
) -> Iterator[Callable[[], list[SolidPart]]]:
    """Ways to draw one block for every part of a footprint, the nearest to it first, with a horizontal plane.

    First on the footprint itself, in valid integer millimetres; then opened by a few centimetres where it pinches,
    drawn back until parts and holes do not touch, more and more simplified, up to `tolerance_m`; at last on its convex
    hull. Parts below `min_area_m2` are left out if a larger one exists. An outline that others touch cuts all of them.

    Each way draws the blocks, at least one and not yet judged. It raises BuildingError where they cannot be drawn:
    `no_footprint` where no part has an area, `no_partition` where parts overlap or touch; or what GEOS raises.
    """
    build = partial(_blocks, plane=plane, ground_z_m=ground_z_m, min_area_m2=min_area_m2, outline_mm=outline_mm)
    yield partial(build, footprint_mm)
    for share in _SHARES_OF_TOLERANCE if tolerance_m > 0.0 else (0.0,):
        for back_mm in _DRAWN_BACK_MM:
            yield partial(_drawn_back, footprint_mm, back_mm, partial(build, tolerance_mm=share * tolerance_m * 1e3))
    yield lambda: build(_opened(footprint_mm).convex_hull)


def _opened(footprint_mm: MultiPolygon) -> BaseGeometry:
    """The footprint without what is narrower than 5 cm."""
    return shapely.buffer(shapely.buffer(footprint_mm, -25.0, join_style="mitre"), 25.0, join_style="mitre")


def _drawn_back(
    footprint_mm: MultiPolygon, back_mm: float, build: Callable[[BaseGeometry], list[SolidPart]]
) -> list[SolidPart]:
    """Blocks on the opened footprint, drawn back."""
    return build(shapely.buffer(_opened(footprint_mm), -back_mm, join_style="mitre"))


def _blocks(
    shape: BaseGeometry,
    *,
    plane: Plane,
    ground_z_m: float,
    min_area_m2: float,
    outline_mm: MultiPolygon | None,
    tolerance_mm: float = 0.0,
) -> list[SolidPart]:
    """Extrude the large parts of a shape, simplified."""
    polygons = _clean_parts(shape, tolerance_mm, min_area_m2)
    if not polygons:
        raise BuildingError(Reason.NO_FOOTPRINT, f"the outline has an area of {shape.area * 1e-6:g} m2")
    partition = RoofPartition(polygons=tuple(polygons), labels=np.zeros(len(polygons), np.int32))
    return solid_parts(partition, [plane], ground_z_m, outline_mm)


def _clean_parts(shape: BaseGeometry, tolerance_mm: float, min_area_m2: float) -> list[Polygon]:
    """Simplified polygons on whole millimetres: those large enough, else the largest; none of an empty shape."""
    if tolerance_mm > 0.0:
        shape = shapely.simplify(shape, tolerance_mm, preserve_topology=True)
    snapped = polygons_of(shapely.set_precision(shape, 1.0))
    polygons = [thinned for polygon in snapped for thinned in without_repeated(polygon, 5.0)]
    large = [p for p in polygons if p.area >= min_area_m2 * 1e6] or sorted(polygons, key=lambda p: -p.area)[:1]
    if not shapely.is_valid(large).all():  # left out it would be missing, and another form may have it
        raise BuildingError(Reason.NO_PARTITION, "the outline of a block crosses itself")
    return large
