"""The given footprints of a run, cut to its data."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import SettingsError, UnreadableInputError
from pipeline.extras.footprints.footprints_file import FootprintIssue, Footprints, read_footprints
from pipeline.extras.footprints.given_heights import given_heights
from pipeline.extras.footprints.placed_features import off_the_data
from pipeline.io import shown
from pipeline.io.reading import one_input
from pipeline.model import GivenHeights
from pipeline.roof.roof_settings import FootprintSettings
from pipeline.runtime.run_plan import Plan
from pipeline.tiling import MM, Tile, TileGrid

Outline: TypeAlias = Polygon | MultiPolygon
"""In metres of the CRS."""

_COVERED = 0.05
"""Smallest share of an outline that another one covers for a word about it: neighbours overlap by centimetres."""
_ISSUES_NAMED = 10
"""Faults of footprints that are warned of one by one; `footprints.json` lists them all."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GivenFootprints:
    """Given outlines that meet the data, in an order that does not depend on the file's."""

    polygons: tuple[Outline, ...]
    """In metres of the CRS."""
    ids: tuple[str, ...]
    """Their own ids."""
    attributes: tuple[str, ...]
    """Their columns, each as the text of a JSON object."""
    heights: tuple[GivenHeights | None, ...]
    """Their heights by attributes, elevations in the vertical datum; None where none is known or asked for."""
    overlaps: tuple[str, ...]
    """Which other one has the points where both lie, in words; empty where none has."""
    warnings: tuple[str, ...]
    """What is odd but usable."""
    report: dict[str, Any]
    """The content of `footprints.json`: how many were read, used, repaired and left out, and every single fault."""


def data_area(plan: Plan) -> shapely.Geometry:
    """The bounds of a run's inputs, cut by --bbox and --aoi, in metres of its CRS."""
    area = shapely.union_all([shapely.box(*i.bounds_m[:2], *i.bounds_m[3:5]) for i in plan.sources])
    unit = plan.reference.horizontal_unit_m
    if plan.options.bbox is not None:
        area &= shapely.box(*(v * unit for v in plan.options.bbox))
    if plan.options.aoi is not None:
        area &= shapely.transform(plan.options.aoi, lambda xy: xy * unit)
    return area


def footprints_of_run(
    path: str | None, plan: Plan, settings: FootprintSettings, layer: str | None = None
) -> GivenFootprints | None:
    """The footprints within the bounds of a run's inputs, cut by --bbox and --aoi; None without a file.

    `settings` name the columns of heights, `layer` that of a file with several. Raises InputError if the file cannot
    be used, lacks one of these columns, or has no footprint on the data, and SettingsError if columns or a layer are
    named, but no file.
    """
    if path is not None:
        with one_input(shown(path)):
            return _given_footprints(path, plan, settings, layer)
    if layer is not None:
        raise SettingsError([f"--layer {layer} names a layer of footprints, and none are given: give --footprints"])
    if settings.columns:
        names = ", ".join(settings.columns)
        raise SettingsError([f"[footprints] {names} name columns of given footprints, and none are given: give them"])
    return None


def _given_footprints(path: str, plan: Plan, settings: FootprintSettings, layer: str | None) -> GivenFootprints:
    """The footprints of a file."""
    area = data_area(plan)
    found = read_footprints(path, plan.reference, layer=layer, area=area)
    _check_columns(path, found, settings)
    shapely.prepare(area)  # many inputs give it many corners, and every footprint is tested against it
    inside = [k for k, polygon in enumerate(found.polygons) if area.intersects(polygon)]
    if not inside:
        raise off_the_data(shown(path), "footprints", found.elsewhere, area, plan.reference)
    # a fault far from the data does not concern this run; one without a place may
    issues = [i for i in found.issues if i.bounds_m is None or shapely.box(*i.bounds_m).intersects(area)]
    lost = sum(issue.action == "left out" for issue in issues)
    repaired = len(issues) - lost
    # overlaps are decided by this order
    inside.sort(key=lambda k: (found.polygons[k].bounds, found.ids[k], found.polygons[k].wkb))
    heights, faults = _heights(found, inside, settings, plan.reference.vertical_unit_m)
    issues += faults
    overlaps = _overlaps([found.polygons[k] for k in inside], [found.ids[k] for k in inside])
    issues += [
        FootprintIssue(
            feature=found.features[k],
            source_id=found.ids[k],
            problem="overlap",
            detail=words,
            action="used without them",
            bounds_m=found.polygons[k].bounds,
        )
        for k, words in zip(inside, overlaps, strict=True)
        if words
    ]
    warnings = [*found.warnings, *(str(issue) for issue in issues[:_ISSUES_NAMED])]
    if len(issues) > _ISSUES_NAMED:
        warnings.append(f"{len(issues) - _ISSUES_NAMED} more faults of footprints, each in footprints.json of a run")
    polygons = len(found.polygons) + found.elsewhere.count
    if len(inside) < polygons:
        warnings.append(f"{polygons - len(inside)} of {polygons} footprints lie off the data")
    about_heights = {"values_not_used": len(faults), "without_heights": heights.count(None)}
    return GivenFootprints(
        polygons=tuple(found.polygons[k] for k in inside),
        ids=tuple(found.ids[k] for k in inside),
        attributes=tuple(json.dumps(found.attributes[k], ensure_ascii=False) for k in inside),
        heights=heights,
        overlaps=overlaps,
        warnings=tuple(warnings),
        report={
            "path": shown(path),
            "used": len(inside),
            "off_the_data": polygons - len(inside),
            "repaired": repaired,
            "left_out": lost,
            **(about_heights if settings.columns else {}),
            "issues": [dataclasses.asdict(issue) for issue in issues],
        },
    )


def _overlaps(polygons: Sequence[Outline], ids: Sequence[str]) -> tuple[str, ...]:
    """Of each outline, which earlier one covers most of it: the first one has the points where several lie."""
    words = [""] * len(polygons)
    firsts, seconds = np.sort(shapely.STRtree(polygons).query(polygons, predicate="intersects"), axis=0)
    pairs = np.unique(np.column_stack((seconds, firsts))[firsts < seconds], axis=0)
    outlines = np.array(polygons, object)
    areas = shapely.area(shapely.intersection(outlines[pairs[:, 0]], outlines[pairs[:, 1]]))
    shares = areas / shapely.area(outlines[pairs[:, 0]])
    most: dict[int, float] = {}
    for (later, first), share in zip(pairs.tolist(), shares.tolist(), strict=True):
        if share >= _COVERED and share > most.get(later, 0.0):
            most[later] = share
            words[later] = f"footprint {ids[first]} covers {share:.0%} of it, and has the points there"
    return tuple(words)


def _check_columns(path: str, found: Footprints, settings: FootprintSettings) -> None:
    """Refuse settings that name columns which the file does not have, all at once."""
    missing = [
        f"{column!r} ([settings.footprints] {setting})"
        for setting, column in settings.columns.items()
        if column not in found.columns
    ]
    if missing:
        have = ", ".join(found.columns) or "(none)"
        raise UnreadableInputError(
            shown(path), f"it has no column {', '.join(missing)}", f"Name columns of the file: {have}"
        )


def _heights(
    found: Footprints, inside: Sequence[int], settings: FootprintSettings, vertical_unit_m: float
) -> tuple[tuple[GivenHeights | None, ...], list[FootprintIssue]]:
    """The heights of some footprints by their attributes, and one fault for each value that cannot be used."""
    heights: list[GivenHeights | None] = []
    issues = []
    for k in inside:
        known, faults = given_heights(found.attributes[k], settings, vertical_unit_m)
        heights.append(known)
        issues += [
            FootprintIssue(
                feature=found.features[k],
                source_id=found.ids[k],
                problem="bad_value",
                detail=fault,
                action="the value is not used",
                bounds_m=found.polygons[k].bounds,
            )
            for fault in faults
        ]
    return tuple(heights), issues


def numbers_by_tile(tiles: Iterable[Tile], grid: TileGrid, outlines: Sequence[Outline]) -> dict[Tile, list[int]]:
    """The outlines, by number, that meet each tile."""
    tree = shapely.STRtree(outlines)
    numbers: dict[Tile, list[int]] = {}
    for tile in tiles:
        core = grid.core(tile)
        box = shapely.box(core.x0_mm / MM, core.y0_mm / MM, core.x1_mm / MM, core.y1_mm / MM)
        numbers[tile] = sorted(int(k) for k in tree.query(box))
    return numbers
