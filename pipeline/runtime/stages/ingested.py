"""What the input files held: points by tile, content, classes."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
import operator
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.io import SourceInfo
from pipeline.io.source import Findings
from pipeline.model import FloatArray, IntArray
from pipeline.runtime.stages.tile_content import ZoneSums, zone_sums_of
from pipeline.scene import BUILDING_CLASS, GROUND_CLASS, VEGETATION_CLASSES
from pipeline.terrain.flight_passes import united_slices
from pipeline.terrain.terrain_settings import ClassesInUse
from pipeline.tiling import MM, Tile

_CLASSIFIED_SHARE = 0.05
"""Smallest share of ground points (class 2) in a classified file, and of building points (class 6) in one that knows
roofs from ground. Not a setting: any share between that of stray codes
and that of real ground will do, and the setting `classes` overrules it."""

_NO_POINTS = np.zeros(3, np.uint64)


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class Ingested:
    """What one input file held, or a share of it."""

    path: str
    """The file."""
    parts: tuple[str, ...]
    """Names of its buckets, in the order of its points."""
    points_by_tile: dict[Tile, int]
    """Points in each tile's bucket."""
    content: dict[Tile, bytes]
    """Which points those are: the bytes of the tile's `ZoneSums`."""
    classes: dict[int, int]
    """Kept points by ASPRS class."""
    findings: Findings
    """What was left out, and why."""
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
    slices: bytes
    """When each flight strip saw kept points: the bytes of `slices_of`, int64."""
    sha256: str
    """Digest of the file, empty for its shares but the first; of the points in the window where only its nodes were
    fetched."""


def of_file(info: SourceInfo, shares: Sequence[Ingested]) -> Ingested:
    """What a file held, of what its shares held, in the order of the file.

    Raises InconsistentInputError if many points do not lie on Earth.
    """
    whole = shares[0] if len(shares) == 1 else _together(info, shares)
    return whole if whole.sha256 else dataclasses.replace(whole, sha256=_digest_of_points(whole))


def _digest_of_points(found: Ingested) -> str:
    """The digest of an input's points, however they are cut into shares and tiles."""
    sums = sum(
        (zone_sums_of(stored).sum(axis=(0, 1), dtype=np.uint64) for stored in found.content.values()), _NO_POINTS
    )
    return hashlib.sha256(sums.astype("<u8").tobytes()).hexdigest()


def _together(info: SourceInfo, shares: Sequence[Ingested]) -> Ingested:
    """What several shares of a file held."""
    findings = functools.reduce(operator.add, (share.findings for share in shares)).of_whole(info)
    first_mm = next((share.first_mm for share in shares if share.bounds_mm is not None), (0, 0))
    boxes = np.array([share.bounds_mm for share in shares if share.bounds_mm is not None])
    classes = Counter[int]()
    for share in shares:
        classes.update(share.classes)
    return Ingested(
        path=shares[0].path,
        parts=tuple(part for share in shares for part in share.parts),
        points_by_tile=dict(points_by_tile(shares)),
        content={tile: sums.tobytes() for tile, sums in content_by_tile(shares).items()},
        classes={code: classes[code] for code in sorted(classes)},
        findings=findings,
        warnings=info.warnings + findings.warnings(info.path),
        bounds_mm=(*boxes[:, :3].min(axis=0).tolist(), *boxes[:, 3:].max(axis=0).tolist()) if len(boxes) else None,
        moments=tuple(sum((_moments_about(share, first_mm) for share in shares), np.zeros(6)).tolist()),
        first_mm=first_mm,
        multiple_returns=any(share.multiple_returns for share in shares),
        slices=slices_in(shares).tobytes(),
        sha256=shares[0].sha256,
    )


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


def slices_in(ingested: Sequence[Ingested]) -> IntArray:
    """When each flight strip saw points of all inputs, as `slices_of`."""
    return united_slices(np.frombuffer(found.slices, np.int64) for found in ingested)


def classes_in_use(ingested: Sequence[Ingested], *, trust: bool) -> tuple[ClassesInUse, str]:
    """Which classes are believed, and a sentence on why; empty where there is nothing to explain.

    Ground, buildings and vegetation are believed only where every input is classified: at least 5 % of its points are
    ground. A file with stray codes, or one that was never classified, is not taken at its word. Where an input has many
    points of class 6, these are not ground in any case.
    """
    if not trust:
        return ClassesInUse(), ""
    bare = [found.path for found in ingested if found.classes and _share_of(found, GROUND_CLASS) < _CLASSIFIED_SHARE]
    if bare:
        some = len(bare) < len(ingested) or any(
            found.classes.get(code, 0) for found in ingested for code in (GROUND_CLASS, BUILDING_CLASS)
        )
        why = "the inputs have no classes" if not some else f"{len(bare)} of {len(ingested)} inputs are not classified"
        roofs = any(_share_of(found, BUILDING_CLASS) >= _CLASSIFIED_SHARE for found in ingested)
        but = ", and class 6 is not taken for ground" if roofs else ""
        return ClassesInUse(roofs=roofs), f"{why}: ground and buildings are found in the points alone{but}"
    buildings = any(found.classes.get(BUILDING_CLASS, 0) for found in ingested)
    return ClassesInUse(ground=True, building=buildings, vegetation=True), ""


def without_roofs(points_by_class: Mapping[int, int], *, trust: bool) -> str:
    """A sentence on points whose classes leave none that could lie on a roof; empty where some could, by these classes.

    >>> without_roofs({2: 990, 5: 10}, trust=True)
    'all 1000 points are of classes 2 and 5, so none can be a roof: give --classes ignore if they are not what they say'
    >>> without_roofs({2: 990, 1: 10}, trust=True) or without_roofs({2: 990}, trust=False)
    ''
    """
    codes, points = sorted(code for code, count in points_by_class.items() if count), sum(points_by_class.values())
    is_classified = points_by_class.get(GROUND_CLASS, 0) >= _CLASSIFIED_SHARE * points > 0
    if not (trust and is_classified and {*codes} <= {GROUND_CLASS, *VEGETATION_CLASSES}):
        return ""
    named = f"class {GROUND_CLASS} (ground)" if len(codes) == 1 else "classes " + ", ".join(map(str, codes[:-1]))
    named += f" and {codes[-1]}" if len(codes) > 1 else ""
    return (
        f"all {points} points are of {named}, so none can be a roof: "
        "give --classes ignore if they are not what they say"
    )


def _share_of(found: Ingested, code: int) -> float:
    """Share of an input's points with a class; 0 without points."""
    return found.classes.get(code, 0) / max(sum(found.classes.values()), 1)


def spread_m(results: Sequence[Ingested]) -> float:
    """Standard deviation of all points, in metres, across the line that fits them best: 0 where they lie on it."""
    anchor = next((result.first_mm for result in results if result.moments[0]), (0, 0))
    n, sx, sy, sxx, sxy, syy = sum((_moments_about(result, anchor) for result in results), np.zeros(6))
    if n == 0:
        return 0.0
    xx, xy, yy = sxx / n - (sx / n) ** 2, sxy / n - sx * sy / n**2, syy / n - (sy / n) ** 2
    smallest = (xx + yy) / 2 - math.hypot((xx - yy) / 2, xy)
    return math.sqrt(max(0.0, smallest))


def _moments_about(found: Ingested, anchor_mm: tuple[int, int]) -> FloatArray:
    """Moments (6,) of an input's points about another point than its first."""
    n, sx, sy, sxx, sxy, syy = found.moments
    dx, dy = (found.first_mm[0] - anchor_mm[0]) / MM, (found.first_mm[1] - anchor_mm[1]) / MM
    return np.array(
        (
            n,
            sx + n * dx,
            sy + n * dy,
            sxx + 2 * dx * sx + n * dx * dx,
            sxy + dx * sy + dy * sx + n * dx * dy,
            syy + 2 * dy * sy + n * dy * dy,
        )
    )
