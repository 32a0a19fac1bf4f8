"""The steps that all recipes begin and end with: a frame of the building's own, and the terrain beside it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pipeline.errors import BuildingError
from pipeline.model import FloatArray, Plane, Reason
from pipeline.segmentation.surrounding_ground import far_from
from pipeline.tin.predicates import MAX_EXTENT_MM

MAX_EXTENT_M = MAX_EXTENT_MM / 1000.0 - 10.0
"""The TIN's limit, less its margins."""


def local_metres(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points about an origin of their own, in whole metres: the outcome is the same wherever the building stands.

    Parameters
    ----------
    points : (n, 3) float64
        Metres, whole millimetres.

    Returns
    -------
    points : (n, 3) float64
        Metres about the new origin, each coordinate at least 0.
    shift : (3,) float64
        The new origin about the old one, whole metres; 0 without points.
    """
    millimetres = np.rint(points * 1000.0).astype(np.int64)
    shift_m = millimetres.min(axis=0) // 1000 if len(points) else np.zeros(3, np.int64)
    return (millimetres - shift_m * 1000) / 1000.0, shift_m.astype(np.float64)


def plane_over_origin(plane: Plane, shift: FloatArray) -> Plane:
    """The plane over the candidate's own origin, from one over the origin of `local_metres`."""
    x, y, z = shift.tolist()
    return dataclasses.replace(plane, c=plane.c + z - plane.a * x - plane.b * y)


def check_extent(points: FloatArray) -> None:
    """Refuse what no single TIN can hold.

    Raises
    ------
    BuildingError
        Reason ``too_complex`` where the points, (n, 3) metres, extend over more than `MAX_EXTENT_M`.
    """
    extent_m = float(np.ptp(points[:, :2], axis=0).max())
    if extent_m > MAX_EXTENT_M:
        raise BuildingError(
            Reason.TOO_COMPLEX, f"the candidate extends over {extent_m:.0f} m, a TIN over at most {MAX_EXTENT_M:.0f} m"
        )


def ground_around(
    ground: FloatArray, shift: FloatArray, roof: FloatArray, gap_m: float, reach_m: float = math.inf
) -> FloatArray:
    """Samples of the terrain beside the building, and in its courtyards, about the same origin.

    Parameters
    ----------
    ground : (m, 3) float64
        The candidate's samples, metres about its own origin.
    shift : (3,) float64
        From `local_metres`.
    roof : (n, 3) float64
        Roof points about the new origin, at least one.
    gap_m : float
        Samples nearer in plan to a roof point than this are beneath the roof, and left out.
    reach_m : float
        Samples farther in plan from every roof point than this are left out too.

    Returns
    -------
    (k, 3) float64
        Metres about the new origin, in the order of the samples.
    """
    moved = (np.rint(ground * 1000.0) - shift * 1000.0) / 1000.0
    beside = far_from(moved, roof, gap_m)
    if math.isfinite(reach_m):
        beside &= ~far_from(moved, roof, reach_m) if reach_m > gap_m else False
    return np.asarray(moved[beside])
