"""Fewer vertices on the borders of a partition, without breaking its topology."""

from __future__ import annotations

import numpy as np
import shapely

from pipeline.errors import BuildingError
from pipeline.model import Reason
from pipeline.roof.partition import RoofPartition


def simplify_partition(partition: RoofPartition, tolerance_m: float, *, outline_too: bool = True) -> RoofPartition:
    """Drop border vertices that matter little, the same on both sides of every border.

    A vertex whose triangle with its neighbours covers less than the squared tolerance is dropped, smallest first
    (Visvalingam and Whyatt 1993), unless borders would touch or cross. Vertices are dropped, never moved, so the
    millimetre grid is kept; nodes where three borders meet stay.

    Parameters
    ----------
    partition : RoofPartition
        A valid coverage.
    tolerance_m : float
        Square root of the area that may be cut off or added, metres.
    outline_too : bool
        Whether the outer border is simplified as well.

    Returns
    -------
    RoofPartition
        The same polygons in the same order.

    Raises
    ------
    BuildingError
        `no_partition` where a polygon vanished or fell apart.
    """
    polygons = shapely.coverage_simplify(
        np.array(partition.polygons, dtype=object), tolerance_m * 1e3, simplify_boundary=outline_too
    )
    if shapely.is_empty(polygons).any() or (shapely.get_type_id(polygons) != shapely.GeometryType.POLYGON).any():
        raise BuildingError(Reason.NO_PARTITION, f"a roof face vanished when simplified by {tolerance_m:g} m")
    return RoofPartition(polygons=tuple(polygons), labels=partition.labels)
