"""True buildings where the survey saw them: moved by the error of the strips that hit them.

The shift of a strip moves all its points alike. No method can detect it from the points, and against the unmoved truth
every model of that strip is off by as much. To judge the method and not the survey, each true building is moved by the
mean shift of its points. Differences between the strips of one building remain, as do all other errors.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from pipeline.errors import InputError
from pipeline.model import FloatArray, LabelArray
from pipeline.ruler.evaluation.models import RoofModel

_FIX = "Simulate the scene again with this version, or measure against the truth where it stands"


def strip_shifts(scene: Mapping[str, Any], path: str) -> FloatArray:
    """(strips, 3) float64, metres, from scene.json; InputError if it has none."""
    shifts = np.array(scene.get("strip_shifts_m") or np.zeros((0, 3)), np.float64)
    if shifts.ndim != 2 or shifts.shape[1:] != (3,) or len(shifts) == 0:
        raise InputError(path, "strip_shifts_m is missing: the shift of each strip is unknown", _FIX)
    return shifts


def mean_shifts(count: int, hits: Iterable[tuple[LabelArray, LabelArray]], shifts: FloatArray) -> FloatArray:
    """Mean shift (count, 3) of the points of each building, metres; zero for buildings without points.

    `hits` are index of the building and number of the strip, from 0, of points on roofs, each (n,); `shifts`
    (strips, 3) go by strip.
    """
    sums, points = np.zeros((count, 3)), np.zeros(count)
    for building, strip in hits:
        points += np.bincount(building, minlength=count)
        for axis in range(3):
            sums[:, axis] += np.bincount(building, shifts[strip, axis], minlength=count)
    moved: FloatArray = sums / np.maximum(points, 1.0)[:, None]
    return moved


def moved_buildings(buildings: Sequence[RoofModel], shifts: FloatArray) -> tuple[RoofModel, ...]:
    """Each building moved by its row of shifts (buildings, 3)."""
    return tuple(_moved(building, shift) for building, shift in zip(buildings, shifts, strict=True))


def _moved(building: RoofModel, shift: FloatArray) -> RoofModel:
    def in_plan(places: FloatArray) -> FloatArray:
        return places + shift[:2]

    east, north, up = (float(value) for value in shift)
    surfaces = tuple(
        dataclasses.replace(
            surface,
            polygon=shapely.transform(surface.polygon, in_plan),
            origin=(surface.origin[0] + east, surface.origin[1] + north, surface.origin[2] + up),
        )
        for surface in building.surfaces
    )
    x, y, z = building.solid_origin
    return dataclasses.replace(
        building,
        footprint=shapely.transform(building.footprint, in_plan),
        surfaces=surfaces,
        solid_origin=(x + east, y + north, z + up),
    )
