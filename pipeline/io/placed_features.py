"""Features of a vector file, placed in the CRS of a run: where to look for them, and their geometries in metres."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.errors import CrsError
from pipeline.io.crs import SpatialReference, horizontal_part, horizontal_unit_of, parse_crs

if TYPE_CHECKING:
    import pyproj

ACCURACY_LIMIT_M = 0.5
"""A coarser reprojection gives a warning."""
AROUND_M = 100.0
"""How far off an area features are still read: more than its edges bend, and operations differ, between two CRS."""


def boxes_around(
    area: shapely.Geometry, crs: str | None, reference: SpatialReference, name: str
) -> npt.NDArray[np.float64] | None:
    """Boxes around the parts of an area in a layer's CRS, (k, 4); None if they cannot be computed there."""
    own, target = None if crs is None else horizontal_part(parse_crs(crs, path=name)), reference.horizontal_crs
    around = shapely.bounds(shapely.get_parts(area)) + AROUND_M * np.array([-1.0, -1.0, 1.0, 1.0])
    boxes: npt.NDArray[np.float64] = around / reference.horizontal_unit_m
    if own is not None and target is not None and not own.equals(target, ignore_axis_order=True):
        import pyproj

        try:
            project = pyproj.Transformer.from_crs(target, own, always_xy=True).transform_bounds
            boxes = np.array([project(x0, y0, x1, y1, 21) for x0, y0, x1, y1 in boxes.tolist()]).reshape(-1, 4)
        except pyproj.exceptions.ProjError:
            return None
        # a box across the antimeridian comes with its sides swapped
        if not np.isfinite(boxes).all() or (boxes[:, :2] > boxes[:, 2:]).any():
            return None
    return boxes


def in_metres(
    name: str,
    what: str,
    features: npt.NDArray[np.object_],
    crs: str | None,
    reference: SpatialReference,
    warnings: list[str],
) -> npt.NDArray[np.object_]:
    """Geometries of a file in metres of the run's CRS; `what` names them in the warnings that are added.

    Raises CrsError if they are degrees and the run's CRS is unknown, or cannot be reprojected.
    """
    own, target = None if crs is None else horizontal_part(parse_crs(crs, path=name)), reference.horizontal_crs
    if own is None:
        warnings.append(f"the {what} have no CRS: that of the points is assumed")
    elif target is None:
        # Raises where the {what} are in degrees: metres and degrees cannot meet.
        if not math.isclose(horizontal_unit_of(own, path=name), reference.horizontal_unit_m, rel_tol=1e-9):
            raise CrsError(
                name,
                f"the {what} are in {own.name!r} and the points' CRS is unknown, with another unit",
                "Give --crs for the points",
            )
        warnings.append(f"the points' CRS is unknown: that of the {what}, {own.name!r}, is assumed to be the same")
    elif len(features) and not own.equals(target, ignore_axis_order=True):
        features = _reprojected(name, what, features, own, target, warnings)
    if reference.horizontal_unit_m == 1.0:
        return features
    scaled: npt.NDArray[np.object_] = shapely.transform(features, lambda xy: xy * reference.horizontal_unit_m)
    return scaled


def _reprojected(
    name: str, what: str, features: npt.NDArray[np.object_], own: pyproj.CRS, target: pyproj.CRS, warnings: list[str]
) -> npt.NDArray[np.object_]:
    """The geometries in another CRS, with a word on how well that can be done."""
    import pyproj

    try:
        transformer = pyproj.Transformer.from_crs(own, target, always_xy=True)
    except pyproj.exceptions.ProjError as fault:
        raise CrsError(
            name,
            f"the {what} cannot be reprojected from {own.name!r} to {target.name!r}: PROJ knows of no operation",
            f"Check the CRS of the {what} and that of the points",
        ) from fault

    def project(xy: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.column_stack(transformer.transform(xy[:, 0], xy[:, 1]))

    moved: npt.NDArray[np.object_] = shapely.transform(features, project)
    if not np.isfinite(shapely.bounds(moved)).any():
        raise CrsError(
            name,
            f"the {what} cannot be reprojected from {own.name!r} to {target.name!r}: they lie outside its area",
            f"Check the CRS of the {what} and that of the points",
        )
    accuracy_m = _accuracy_m(transformer)
    if accuracy_m is None or not 0.0 <= accuracy_m <= ACCURACY_LIMIT_M:
        good_to = (
            "an unknown accuracy" if accuracy_m is None or accuracy_m < 0.0 else f"an accuracy of {accuracy_m:g} m"
        )
        warnings.append(f"the {what} are reprojected from {own.name!r} to {target.name!r} with {good_to}")
    else:
        warnings.append(f"the {what} are reprojected from {own.name!r} to {target.name!r}")
    return moved


def _accuracy_m(transformer: pyproj.Transformer) -> float | None:
    """The accuracy of the operation that PROJ used last, of those that it weighs; None where PROJ cannot name it."""
    import pyproj

    try:
        accuracy: float | None = transformer.get_last_used_operation().accuracy
    except pyproj.exceptions.ProjError:  # some parameters of a projection leave it without a name
        return None
    return accuracy
