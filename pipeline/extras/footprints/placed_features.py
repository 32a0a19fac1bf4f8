"""Features of a vector file, placed in the CRS of a run: the area to search, and their geometries in metres."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.errors import CrsError, EmptyInputError, InputError
from pipeline.extras.vector_files.nearby import Elsewhere, Shape, VectorLayer
from pipeline.io.crs import SpatialReference, horizontal_part, horizontal_unit_of
from pipeline.io.crs_given import parse_crs

if TYPE_CHECKING:
    import pyproj

ACCURACY_LIMIT_M = 0.5
"""A coarser reprojection gives a warning."""
LARGEST_LONGITUDE = 360.0
"""Degrees; no coordinate of a place on the globe is larger, by any habit of counting."""
AROUND_M = 100.0
"""How far off an area features are still read: more than its edges bend, and operations differ, between two CRS."""


PROBLEMS = {
    "no_geometry": "without a geometry",
    "unreadable": "with a geometry that cannot be read",
    "not_polygon": "no polygons",
    "not_line": "no lines",
    "empty": "empty",
    "not_finite": "with coordinates that are NaN or infinite",
    "outside_crs": "outside the run's CRS",
    "unknown_kind": "of an unknown kind",
    "too_large": "larger than any building",
    "no_area": "invalid and without area",
    "invalid": "invalid",
    "tangled": "invalid with too many crossings to be repaired",
    "bad_value": "with an attribute that cannot be used",
    "overlap": "covered by another one",
}
"""What can be wrong with a feature, and how a message counts it."""


def usable(layer: VectorLayer, shape: Shape, problems: dict[int, tuple[str, str]]) -> npt.NDArray[np.object_]:
    """The geometries of a shape, None for all others; what is wrong with these goes to the problems, by row."""
    geometries = layer.geometries.copy()
    kinds = shapely.get_type_id(geometries)
    fits = np.isin(kinds, shape.kinds)
    for row in np.flatnonzero(~fits).tolist():
        if layer.unreadable[row]:
            problems[row] = ("unreadable", "its geometry cannot be read")
        elif kinds[row] < 0:
            problems[row] = ("no_geometry", "it has no geometry")
        else:
            problems[row] = (f"not_{shape.one}", f"it is a {geometries[row].geom_type}")
    for row in np.flatnonzero(fits & shapely.is_empty(geometries)).tolist():
        problems[row] = ("empty", f"its {shape.one} is empty")
    for row in np.flatnonzero(fits & ~within(geometries, np.finfo(np.float64).max)).tolist():
        problems.setdefault(row, ("not_finite", "it has coordinates that are NaN or infinite"))
    geometries[list(problems)] = None
    return geometries


def within(geometries: npt.NDArray[np.object_], largest: float) -> npt.NDArray[np.bool_]:
    """(n,) bool, whether all coordinates are numbers up to the largest; bounds do not show it, they pass over NaN."""
    xy, owners = shapely.get_coordinates(geometries, return_index=True)
    found = np.ones(len(geometries), np.bool_)
    found[owners[~(np.abs(xy) <= largest).all(axis=1)]] = False
    return found


def left_out(problems: Iterable[str], what: str) -> list[str]:
    """How many features were left out, by problem, in one sentence; empty without any."""
    counted = Counter(problems)
    reasons = ", ".join(f"{count} {PROBLEMS[problem]}" for problem, count in counted.items())
    return [f"{counted.total()} {what} are left out: {reasons}"] if counted else []


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


def off_the_data(
    name: str,
    what: str,
    found: Elsewhere,
    area: shapely.Geometry,
    reference: SpatialReference,
) -> InputError:
    """The error for a file of which no feature lies on the data, with both places and what may be wrong.

    `area` is that of the data in metres of the run's CRS; `what` names the features.
    """
    own = None if found.crs is None else horizontal_part(parse_crs(found.crs, path=name))
    if own is not None and found.bounds is not None and (fault := _not_degrees(name, what, found.bounds, own)):
        return fault
    there = (
        "" if found.bounds is None else f": they lie at {_place(found.bounds)}{'' if own is None else f' ({own.name})'}"
    )
    boxes = None if area.is_empty else boxes_around(area, found.crs, reference, name)
    data = None if boxes is None else (*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist())
    problem = f"none of its {what} lies on the data{there}"
    fix = f"Check the CRS of the {what} and that of the points, and --bbox and --aoi where they are given"
    if data is not None and found.bounds is not None:
        problem += f", the data at {_place(data)}"
        if shapely.box(*(found.bounds[k] for k in (1, 0, 3, 2))).intersects(shapely.box(*data)):
            fix = f"Write x before y, longitude before latitude: the {what} have them swapped"
    return EmptyInputError(name, problem, fix)


def _place(bounds: Sequence[float]) -> str:
    """Bounds in words."""
    x_min, y_min, x_max, y_max = bounds
    return f"x {x_min:.9g} to {x_max:.9g}, y {y_min:.9g} to {y_max:.9g}"


def _not_degrees(name: str, what: str, bounds: Sequence[float], own: pyproj.CRS) -> CrsError | None:
    """The error for coordinates in a geographic CRS that cannot be degrees; None where they can."""
    x_min, y_min, x_max, y_max = bounds
    most = LARGEST_LONGITUDE
    if not own.is_geographic or (x_min <= most and y_min <= most and x_max >= -most and y_max >= -most):
        return None
    return CrsError(
        name,
        f"the {what} are in {own.name!r}, in degrees, which x {x_max:.9g}, y {y_max:.9g} cannot be",
        "Write their CRS into the file: GeoJSON without a member crs is in degrees",
    )


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
        if fault := _not_degrees(name, what, shapely.total_bounds(features).tolist(), own):
            raise fault
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
