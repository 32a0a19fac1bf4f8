"""Slits between outlines of different candidates, closed where the two touch: each goes to one of the two.

Outlines are drawn one by one, and the points of a wall between two houses may belong to neither. What is closed
follows from the outlines nearby alone, so two tasks decide alike. What lies between several pairs stays open.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.roof.disjoint_outlines import effort
from pipeline.roof.footprint import polygons_of

GAP_MM = 1000.0
"""Two outlines may leave a slit up to this width: an alley is wider."""
_FACING_MM = 500.0
"""A slit runs at least this far along both outlines."""
_ROUNDING_MM = 1.5
"""Corners that lie on an edge are within this of it."""
_APART_MM = 2.0
"""What an outline takes of a slit ends this far from third outlines and from what these may take."""
_MARGIN_MM = 1.2
"""Width of a strip around it in which no other outline lies, even after rounding."""
_MITRE = 1.5
"""Offset corners sharper than 84 degrees are cut: areas between outlines lie within three quarters of the gap."""
_SHARP_MITRE = 10.0
"""The same at hairlines and margins: 12 degrees."""
_HELD = 256
"""Outlines that stay in memory, closed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Slit:
    """An area between two outlines that face each other."""

    area_mm: Polygon
    """Integer millimetres."""
    strips_mm: tuple[Polygon, Polygon]
    """What the first, or the second, covers in addition if it moves its whole edge up to the other one."""


def between(first_mm: MultiPolygon, second_mm: MultiPolygon) -> list[Polygon]:
    """The areas that are less than `GAP_MM` wide between two outlines, integer millimetres."""
    outlines = first_mm, second_mm
    alone = [closed for outline in outlines for closed in _closed_alone(outline)]
    both = _closed(shapely.union_all(outlines))
    areas = shapely.difference(both, shapely.union_all([*outlines, *alone], grid_size=1.0), grid_size=1.0)
    return polygons_of(shapely.normalize(areas))


def slits(
    outlines: tuple[MultiPolygon, MultiPolygon],
    areas: Sequence[Polygon],
    within: shapely.Geometry,
    third_mm: Sequence[MultiPolygon],
    of_others: Sequence[Polygon],
) -> list[Slit]:
    """The slits of some areas between two outlines, apart from third outlines and from areas between other pairs."""
    own, others = MultiPolygon(list(areas)), np.array([*third_mm, *of_others], dtype=object)
    taken = shapely.union_all(others[shapely.intersects(others, own)], grid_size=1.0)
    left = shapely.difference(own, taken, grid_size=1.0)
    beside = shapely.buffer(others, np.repeat([GAP_MM, _APART_MM], [len(third_mm), len(of_others)]), join_style="mitre")
    both = shapely.union_all(outlines, grid_size=1.0)
    found = []
    for area in polygons_of(shapely.normalize(left)):
        if not shapely.covers(within, area) or min(_common_mm(area, outline) for outline in outlines) < _FACING_MM:
            continue
        strips = [_strip(area, outline, both) for outline in outlines]
        mine, other = (
            strip if shapely.covers(within, strip) and not _overlap(strip, beside) else area for strip in strips
        )
        found.append(Slit(area_mm=area, strips_mm=(mine, other)))
    return found


def _strip(area: Polygon, own: MultiPolygon, both: shapely.Geometry) -> Polygon:
    """What an outline covers in addition if its edge beside a slit moves, parallel to itself, up to the other one.

    `both` are the two outlines.
    """
    ring = shapely.get_coordinates(area.exterior)
    edges = np.diff(ring, axis=0)
    middles = shapely.points(0.5 * (ring[1:] + ring[:-1]))
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    beside = np.where(shapely.dwithin(middles, own, _ROUNDING_MM), lengths, 0.0)
    if not beside.any():
        return area
    along = edges[np.argmax(beside)] / beside.max()
    # the slit lies to the right of its own ring, which runs clockwise
    across = np.array([along[1], -along[0]])
    width_mm = float(np.ptp(ring @ across))
    if width_mm > GAP_MM:
        return area  # it goes around a corner
    moved = np.rint(across * width_mm)
    swept = shapely.union_all([shapely.transform(own, lambda xy: xy + moved), area], grid_size=1.0)
    added = shapely.difference(swept, both, grid_size=1.0)
    place = shapely.point_on_surface(area)
    return next((piece for piece in polygons_of(added) if shapely.intersects(piece, place)), area)


def _closed(area: shapely.Geometry) -> shapely.Geometry:
    """An area with what lies between parts of it that are less than `GAP_MM` apart."""
    wide = shapely.buffer(area, 0.5 * GAP_MM, join_style="mitre", mitre_limit=_MITRE)
    narrow = shapely.buffer(wide, -0.5 * GAP_MM, join_style="mitre", mitre_limit=_MITRE)
    # a mitred offset can cross itself
    return shapely.set_precision(shapely.make_valid(narrow, method="structure"), 1.0)


@functools.lru_cache(maxsize=_HELD)
def _closed_alone(outline: MultiPolygon) -> list[shapely.Geometry]:
    """The same, of an outline that is compared with several others; none where nothing lies between."""
    closed = _closed(outline)
    return [] if shapely.equals(closed, outline) else [closed]


def _common_mm(piece: Polygon, outline_mm: MultiPolygon) -> float:
    """How far the borders of a piece run along an outline, within the rounding."""
    beside = shapely.buffer(outline_mm, _ROUNDING_MM, join_style="mitre")
    return float(shapely.length(shapely.intersection(piece.boundary, beside)))


def closed(
    first_mm: MultiPolygon, second_mm: MultiPolygon, found: Sequence[Slit]
) -> tuple[list[Polygon], list[Polygon]]:
    """What the first takes of the slits beside the second, and what the second takes.

    It is what takes least to describe, then the least area.
    """
    taken: tuple[list[Polygon], list[Polygon]] = ([], [])
    efforts = [_plain_effort(outline) for outline in (first_mm, second_mm)]
    for number, slit in enumerate(found):
        others = np.array([*taken[0], *taken[1], *(other.area_mm for other in found[number + 1 :])], dtype=object)
        options = [(0, slit.area_mm), (1, slit.area_mm)]
        strips = [(side, strip) for side, strip in enumerate(slit.strips_mm) if strip is not slit.area_mm]
        options += [(side, strip) for side, strip in strips if not _overlap(strip, others)]
        costs = []
        for k, (side, area) in enumerate(options):
            grown = united((first_mm, second_mm)[side], [*taken[side], area])
            costs.append((_plain_effort(grown) - efforts[side], area.area, k))
        side, area = options[min(costs)[2]]
        taken[side].append(area)
    return taken


def _plain_effort(outline_mm: MultiPolygon) -> float:
    """The effort without the corners that rounding leaves."""
    return effort(shapely.simplify(outline_mm, 2.0 * _ROUNDING_MM))


def without(area: Polygon, others: npt.NDArray[np.object_]) -> list[Polygon]:
    """An area apart from others, in integer millimetres."""
    near = others[shapely.dwithin(area, others, _APART_MM)]
    if len(near) == 0:
        return [area]
    wider = shapely.buffer(shapely.union_all(near, grid_size=1.0), _APART_MM, join_style="mitre")
    return polygons_of(shapely.difference(area, wider, grid_size=1.0))


def united(outline_mm: MultiPolygon, pieces: Sequence[Polygon]) -> MultiPolygon:
    """An outline with what it takes, without the hairlines that rounding leaves between them."""
    if not pieces:
        return outline_mm
    whole = shapely.union_all([outline_mm, *pieces])
    for distance in (_ROUNDING_MM, -_ROUNDING_MM):
        whole = shapely.buffer(whole, distance, join_style="mitre", mitre_limit=_SHARP_MITRE)
    return MultiPolygon(polygons_of(shapely.set_precision(whole, 1.0)))


def widened(kept_mm: MultiPolygon, pieces: Sequence[Polygon]) -> MultiPolygon:
    """What an outline keeps beside another one, with pieces of slits that others border, and a margin around these.

    Nothing else lies in the margin: what is taken keeps farther away from others.
    """
    if not pieces:
        return kept_mm
    wider = shapely.buffer(pieces, _MARGIN_MM, join_style="mitre", mitre_limit=_SHARP_MITRE)
    return MultiPolygon(polygons_of(shapely.union_all([kept_mm, *wider])))


def _overlap(area: Polygon, others: npt.NDArray[np.object_]) -> bool:
    near = others[shapely.intersects(others, area)]
    return bool((shapely.area(shapely.intersection(area, near)) > 0.0).any())
