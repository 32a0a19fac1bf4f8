"""From the CRS of a run to that of maps: the horizontal part alone, since maps are flat."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pyproj

from pipeline.errors import RunError
from pipeline.model import FloatArray

Project = Callable[[FloatArray], FloatArray]
"""From coordinates, (n, 2), to others of the same shape."""


def horizontal_crs(crs: Mapping[str, Any] | None) -> pyproj.CRS:
    """The horizontal part of the CRS that a manifest states; raises RunError if it is unknown."""
    wkt = (crs or {}).get("wkt")
    if not wkt:
        raise RunError(
            "the CRS of the run is unknown, so its place on a map is, too: run it again with --crs, such as EPSG:25832"
        )
    whole = pyproj.CRS.from_wkt(wkt)
    return (whole.sub_crs_list[0] if whole.is_compound else whole).to_2d()


def projection_to(crs: Mapping[str, Any] | None, target: str) -> Project:
    """The projection from the horizontal part of a run's CRS to another one, x or longitude first.

    Raises RunError if the CRS is unknown or has no place on the earth; so does the projection, outside the CRS.
    """
    try:
        transformer = pyproj.Transformer.from_crs(horizontal_crs(crs), target, always_xy=True)
    except pyproj.exceptions.ProjError as fault:
        raise RunError(
            f"the CRS of the run has no place on the earth ({str(fault)[:160]}): run it again with --crs"
        ) from fault

    def project(xy: FloatArray) -> FloatArray:
        found: FloatArray = np.column_stack(transformer.transform(xy[:, 0], xy[:, 1]))
        outside = ~np.isfinite(found).all(axis=1)
        if outside.any():
            x, y = xy[outside][0]
            raise RunError(f"{x:.0f}, {y:.0f} lies outside the CRS of the run: run it again with the right --crs")
        return found

    return project
