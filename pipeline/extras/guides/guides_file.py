"""Given lines of roofs from GeoPackage, GeoJSON, Shapefile or GeoParquet, in metres of the run's CRS."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import shapely
from shapely import LineString

from pipeline.errors import EmptyInputError, UnreadableInputError
from pipeline.extras.footprints.placed_features import boxes_around, in_metres, left_out, usable, within
from pipeline.extras.vector_files.nearby import Elsewhere, Shape, VectorLayer
from pipeline.extras.vector_files.vector_layer import read_layer
from pipeline.io.crs import LARGEST_COORDINATE, SpatialReference
from pipeline.io.locations import shown
from pipeline.model import Guide, GuideKind

LINES = Shape(
    "LineString", (shapely.GeometryType.LINESTRING, shapely.GeometryType.MULTILINESTRING), "guides", one="line"
)
"""What the features are."""
KIND_COLUMN = "kind"
"""The default column of kinds; only this one may be missing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GuideIssue:
    """What was wrong with one feature, which was left out."""

    feature: int
    """The file's own number of the feature."""
    problem: str
    """One of `PROBLEMS`."""
    detail: str
    """The fault in words."""

    def __str__(self) -> str:
        """The issue as a sentence."""
        return f"guide {self.feature}: {self.detail}: left out"


@dataclasses.dataclass(frozen=True, kw_only=True)
class GivenLines:
    """The lines of a file that can be used."""

    guides: tuple[Guide, ...]
    """In metres of the run's CRS, the parts of a multiple line one by one."""
    warnings: tuple[str, ...]
    """What was left out or assumed, one sentence each."""
    issues: tuple[GuideIssue, ...]
    """Every feature that was left out, in the file's order."""
    elsewhere: Elsewhere
    """Lines of the file that were passed over."""


def read_guides(
    path: str | Path, reference: SpatialReference, *, kind_column: str = KIND_COLUMN, area: shapely.Geometry
) -> GivenLines:
    """The lines of a vector file near an area, in metres of the run's CRS; elevations are dropped.

    A line without a kind, or all of them without the default column, are of kind `any`. A feature that cannot be used
    is left out and listed among the issues.

    Raises
    ------
    UnreadableInputError
        If the file cannot be read as vector data, or another column than the default one is not there.
    EmptyInputError
        If it has no line that can be used, wherever it lies.
    CrsError
        If its coordinates are degrees and the run's CRS is unknown, or a CRS is not understood.
    """
    name = shown(str(path))
    warnings: list[str] = []
    found = read_layer(path, None, lambda own: boxes_around(area, own, reference, name), LINES)
    warnings += found.warnings
    if kind_column not in found.columns and kind_column != KIND_COLUMN:
        there = ", ".join(found.columns) or "(none)"
        raise UnreadableInputError(
            name, f"column {kind_column!r} is not there", f"Set kind_column in [settings.guides] to one of {there}"
        )
    if kind_column not in found.columns:
        warnings.append(f"the guides have no column {kind_column!r}: all are of kind any")
    problems: dict[int, tuple[str, str]] = {}
    geometries = usable(found, LINES, problems)
    with np.errstate(over="ignore"):
        lengths = shapely.length(geometries)
    for row in np.flatnonzero(lengths == 0.0).tolist():
        problems.setdefault(row, ("empty", "its line has no length"))
    kinds = _kinds(found, kind_column, problems)
    kept = np.array([row for row in range(len(geometries)) if row not in problems], np.int64)
    lines = in_metres(name, "guides", shapely.force_2d(geometries[kept]), found.crs, reference, warnings)
    whole = within(lines, LARGEST_COORDINATE)
    for row in kept[~whole].tolist():
        problems[row] = ("outside_crs", "it has no place in the run's CRS")
    if not whole.any() and not found.elsewhere.count:
        raise EmptyInputError(name, f"none of the {len(geometries)} features is a line that can be used", "Give lines")
    guides = tuple(
        Guide(kind=kinds[row], line=part)
        for row, line in zip(kept[whole].tolist(), lines[whole].tolist(), strict=True)
        for part in shapely.get_parts(line).tolist()
        if isinstance(part, LineString) and part.length > 0.0
    )
    issues = tuple(
        GuideIssue(feature=int(found.feature_ids[row]), problem=problem, detail=detail)
        for row, (problem, detail) in sorted(problems.items())
    )
    warnings += left_out([issue.problem for issue in issues], "guides")
    return GivenLines(guides=guides, warnings=tuple(warnings), issues=issues, elsewhere=found.elsewhere)


def _kinds(layer: VectorLayer, column: str, problems: dict[int, tuple[str, str]]) -> list[GuideKind]:
    """The kind of each line; one that is unknown goes to the problems, unless the line has another."""
    valid = {kind.value: kind for kind in GuideKind}
    kinds = []
    for row, value in enumerate(layer.columns.get(column, [None] * len(layer.geometries))):
        is_empty = value is None or (isinstance(value, float) and math.isnan(value))
        text = "" if is_empty else str(value).strip().lower()
        kinds.append(valid.get(text, GuideKind.ANY))
        if text and text not in valid:
            problems.setdefault(row, ("unknown_kind", f"its kind is {value!r}: use one of {', '.join(valid)}"))
    return kinds
