"""The given lines of roofs of a run, cut to its data, and those near some tiles."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import shapely

from pipeline.extras.footprints.given_footprints import data_area
from pipeline.extras.footprints.placed_features import off_the_data
from pipeline.extras.guides.guides_file import read_guides
from pipeline.io import shown
from pipeline.io.reading import one_input
from pipeline.model import Guide
from pipeline.roof.roof_settings import GUIDE_REACH_M
from pipeline.runtime.run_plan import Plan
from pipeline.tiling import MM, Tile, TileGrid

_ISSUES_NAMED = 10
"""Faults of guides that are warned of one by one; `guides.json` lists them all."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GivenGuides:
    """Given lines that meet the data, in an order that does not depend on the file's."""

    guides: tuple[Guide, ...]
    """In metres of the CRS."""
    warnings: tuple[str, ...]
    """What is odd but usable."""
    report: dict[str, Any]
    """The content of `guides.json`: how many were read, used and left out, and every single fault."""

    _tree: shapely.STRtree = dataclasses.field(init=False, repr=False, compare=False)

    def near(self, tiles: Iterable[Tile], grid: TileGrid) -> tuple[Guide, ...]:
        """Those within reach of some tiles, in order."""
        cores = [grid.core(tile).grown(round(GUIDE_REACH_M * MM)) for tile in tiles]
        boxes = [shapely.box(c.x0_mm / MM, c.y0_mm / MM, c.x1_mm / MM, c.y1_mm / MM) for c in cores]
        found = {int(k) for box in boxes for k in self._tree.query(box)}
        return tuple(self.guides[k] for k in sorted(found))

    def __post_init__(self) -> None:
        """Index the lines by place."""
        object.__setattr__(self, "_tree", shapely.STRtree([guide.line for guide in self.guides]))


def given_guides(path: str, plan: Plan, kind_column: str) -> GivenGuides:
    """Read the guides of a run, within the bounds of its inputs, cut by --bbox and --aoi.

    Raises InputError if the file cannot be used.
    """
    area = data_area(plan)
    with one_input(shown(path)):
        found = read_guides(path, plan.reference, kind_column=kind_column, area=area)
    shapely.prepare(area)
    inside = [guide for guide in found.guides if area.intersects(guide.line)]
    warnings = [*found.warnings, *(str(issue) for issue in found.issues[:_ISSUES_NAMED])]
    if len(found.issues) > _ISSUES_NAMED:
        warnings.append(f"{len(found.issues) - _ISSUES_NAMED} more faults of guides, each in guides.json of a run")
    lines = len(found.guides) + found.elsewhere.count
    if not inside:
        raise off_the_data(shown(path), "guides", found.elsewhere, area, plan.reference)
    if len(inside) < lines:
        warnings.append(f"{lines - len(inside)} of {lines} guides lie off the data")
    inside.sort(key=lambda guide: (guide.line.wkb, guide.kind))
    return GivenGuides(
        guides=tuple(inside),
        warnings=tuple(warnings),
        report={
            "path": shown(path),
            "used": len(inside),
            "off_the_data": lines - len(inside),
            "left_out": len(found.issues),
            "issues": [dataclasses.asdict(issue) for issue in found.issues],
        },
    )
