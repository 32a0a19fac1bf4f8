"""What the input files held: points by tile, content, classes."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from pipeline.runtime.stages.tile_content import ZoneSums, zone_sums_of
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS
from pipeline.terrain.scene_settings import ClassesInUse
from pipeline.tiling import MM, Tile

_CLASSIFIED_SHARE = 0.05
"""Smallest share of ground points (class 2) in a classified file. Not a setting: any share between that of stray codes
and that of real ground will do, and the setting `classes` overrules it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ingested:
    """What one input file held."""

    path: str
    """The file."""
    part: str
    """Name of its buckets."""
    points_by_tile: dict[Tile, int]
    """Points in each tile's bucket."""
    content: dict[Tile, bytes]
    """Which points those are: the bytes of the tile's `ZoneSums`."""
    classes: dict[int, int]
    """Kept points by ASPRS class."""
    dropped: dict[str, int]
    """Points left out, by cause."""
    warnings: tuple[str, ...]
    """What is odd but usable."""
    bounds_mm: tuple[int, int, int, int, int, int] | None
    """x, y, z minimum, then maximum, of the kept points; None where there are none."""
    moments: tuple[float, ...]
    """n, Sx, Sy, Sxx, Sxy, Syy in metres about the first kept point: shows whether all lie on one line."""
    first_mm: tuple[int, int]
    """That first point."""
    multiple_returns: bool
    """Whether any kept pulse has more than one return."""
    sha256: str
    """Digest of the file."""


def points_by_tile(ingested: Sequence[Ingested]) -> Counter[Tile]:
    """Points of each tile over all inputs."""
    tiles: Counter[Tile] = Counter()
    for found in ingested:
        tiles.update(found.points_by_tile)
    return tiles


def content_by_tile(ingested: Sequence[Ingested]) -> dict[Tile, ZoneSums]:
    """Content of each tile over all inputs."""
    content: dict[Tile, ZoneSums] = {}
    for found in ingested:
        for tile, stored in found.content.items():
            sums = zone_sums_of(stored)
            content[tile] = content[tile] + sums if tile in content else sums
    return content


def classes_in_use(ingested: Sequence[Ingested], *, trust: bool) -> tuple[ClassesInUse, str]:
    """Which classes are believed, and a sentence on why; empty where there is nothing to explain.

    Ground, buildings and vegetation are believed only where every input is classified: at least 5 % of its points are
    ground. A file with stray codes, or one that was never classified, is not taken at its word.
    """
    if not trust:
        return ClassesInUse(), ""
    bare = [
        found.path
        for found in ingested
        if found.classes and found.classes.get(GROUND_CLASS, 0) < _CLASSIFIED_SHARE * sum(found.classes.values())
    ]
    if bare:
        some = len(bare) < len(ingested) or any(
            found.classes.get(code, 0) for found in ingested for code in (GROUND_CLASS, BUILDING_CLASS)
        )
        why = "the inputs have no classes" if not some else f"{len(bare)} of {len(ingested)} inputs are not classified"
        return ClassesInUse(), f"{why}: ground and buildings are found in the points alone"
    buildings = any(found.classes.get(BUILDING_CLASS, 0) for found in ingested)
    return ClassesInUse(ground=True, building=buildings, vegetation=True), ""


def spread_m(results: Sequence[Ingested]) -> float:
    """Standard deviation of all points, in metres, across the line that fits them best: 0 where they lie on it."""
    total = np.zeros(6)
    anchor: tuple[int, int] | None = None
    for result in results:
        n, sx, sy, sxx, sxy, syy = result.moments
        if n == 0:
            continue
        if anchor is None:
            anchor = result.first_mm
        # move the moments to the first file's first point
        dx, dy = (result.first_mm[0] - anchor[0]) / MM, (result.first_mm[1] - anchor[1]) / MM
        total += (
            n,
            sx + n * dx,
            sy + n * dy,
            sxx + 2 * dx * sx + n * dx * dx,
            sxy + dx * sy + dy * sx + n * dx * dy,
            syy + 2 * dy * sy + n * dy * dy,
        )
    n, sx, sy, sxx, sxy, syy = total
    if n == 0:
        return 0.0
    xx, xy, yy = sxx / n - (sx / n) ** 2, sxy / n - sx * sy / n**2, syy / n - (sy / n) ** 2
    smallest = (xx + yy) / 2 - math.hypot((xx - yy) / 2, xy)
    return math.sqrt(max(0.0, smallest))
