"""The given footprints of a run, cut to its data."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import shapely
from shapely import MultiPolygon, Polygon

from pipeline.io import shown
from pipeline.io.footprints import read_footprints
from pipeline.runtime.plan import Plan
from pipeline.tiling import MM, Tile, TileGrid

Outline: TypeAlias = Polygon | MultiPolygon
"""In metres of the CRS."""

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
    warnings: tuple[str, ...]
    """What is odd but usable."""
    report: dict[str, Any]
    """The content of `footprints.json`: how many were read, used, repaired and left out, and every single fault."""


def given_footprints(path: str, plan: Plan) -> GivenFootprints:
    """Read the footprints of a run, within the bounds of its inputs, cut by --bbox and --aoi.

    Raises InputError if the file cannot be used.
    """
    area = shapely.union_all([shapely.box(*i.bounds_m[:2], *i.bounds_m[3:5]) for i in plan.sources])
    unit = plan.reference.horizontal_unit_m
    if plan.options.bbox is not None:
        area &= shapely.box(*(v * unit for v in plan.options.bbox))
    if plan.options.aoi is not None:
        area &= shapely.transform(plan.options.aoi, lambda xy: xy * unit)
    found = read_footprints(path, plan.reference, area=area)
    shapely.prepare(area)  # many inputs give it many corners, and every footprint is tested against it
    inside = [k for k, polygon in enumerate(found.polygons) if area.intersects(polygon)]
    # a fault far from the data does not concern this run; one without a place may
    issues = [i for i in found.issues if i.bounds_m is None or shapely.box(*i.bounds_m).intersects(area)]
    warnings = [*found.warnings, *(str(issue) for issue in issues[:_ISSUES_NAMED])]
    if len(issues) > _ISSUES_NAMED:
        warnings.append(f"{len(issues) - _ISSUES_NAMED} more faults of footprints, each in footprints.json of a run")
    polygons = len(found.polygons) + found.elsewhere
    if len(inside) < polygons:
        warnings.append(f"{polygons - len(inside)} of {polygons} footprints lie off the data")
    # overlaps are decided by this order
    inside.sort(key=lambda k: (found.polygons[k].bounds, found.ids[k]))
    return GivenFootprints(
        polygons=tuple(found.polygons[k] for k in inside),
        ids=tuple(found.ids[k] for k in inside),
        attributes=tuple(json.dumps(found.attributes[k], ensure_ascii=False) for k in inside),
        warnings=tuple(warnings),
        report={
            "path": shown(path),
            "used": len(inside),
            "off_the_data": polygons - len(inside),
            "repaired": sum(issue.action != "left out" for issue in issues),
            "left_out": sum(issue.action == "left out" for issue in issues),
            "issues": [dataclasses.asdict(issue) for issue in issues],
        },
    )


def numbers_by_tile(tiles: Iterable[Tile], grid: TileGrid, outlines: Sequence[Outline]) -> dict[Tile, list[int]]:
    """The outlines, by number, that meet each tile."""
    tree = shapely.STRtree(outlines)
    numbers: dict[Tile, list[int]] = {}
    for tile in tiles:
        core = grid.core(tile)
        box = shapely.box(core.x0_mm / MM, core.y0_mm / MM, core.x1_mm / MM, core.y1_mm / MM)
        numbers[tile] = sorted(int(k) for k in tree.query(box))
    return numbers
