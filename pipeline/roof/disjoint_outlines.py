"""Outlines of different candidates that overlap, made disjoint: each piece of an overlap goes to one of the two.

Outlines drawn one by one end about half a point spacing outside of the outermost points, so those of two sheds that
touch cross. The division of an overlap follows from the two outlines and their points alone, so two tasks decide alike,
whatever the order and the tiles. A third outline changes nothing between the two: each keeps what it keeps beside all
others, and places where such parts cross are rounded inward. Everything is done in integer millimetres of the CRS. A
border between two outlines has the same corners on both sides, except beside a third one.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.geometry import corners_of_rings
from pipeline.model import FloatArray, IntArray
from pipeline.roof.footprint import polygons_of
from pipeline.roof.partition import RoofPartition
from pipeline.roof.within_outline import within_outline

# None of these is a setting: they choose between ways to divide an area that is narrower than a few point spacings.
_SMALL_MM2 = 2e4
"""A piece of less goes to the higher candidate: it changes no corner that anyone sees."""
_CORNER_COS = 0.98
"""Cosine of the least turn that counts as a corner: 11 degrees."""
_ACUTE_COS = 0.7
"""An inner angle is acute where its cosine is larger: 45 degrees."""
_SHORT_MM = 700.0
"""Edges below this are short."""
_ACUTE_COST, _SHORT_COST, _PART_COST, _WRONG_COST = 3.0, 1.0, 4.0, 2.0
"""Costs of what a division leaves, in corners, and of a point on the wrong side."""
_KEPT_SHARE = 0.4
"""A candidate that would keep less of its outline keeps the piece instead, if the other can spare it."""
_BARRED = 1e6
"""Cost of leaving too little."""
_FEWEST_WRONG = 2
"""An overlap is divided along a chord where at least so many points lie on the wrong side without one."""
_DIRECTIONS = 3
"""Longest edges of an overlap that give a chord its direction."""
_NEEDLE_MM = 120.0
"""Half the width of a part that is not left of an outline: no wing of a house is as narrow."""
_LEAST_NEEDLE_MM2 = 0.5 * _NEEDLE_MM * _NEEDLE_MM
"""A smaller part is not a needle."""
_SHORTEST_MM = 20.0
"""Corners nearer to each other are united when a solid is made, which would move a common border."""
_PLAIN_MM = 3.0
"""Corners that rounding and crossings leave lie within this of plain edges."""
_MITRE = 6.0
"""Offset corners sharper than 20 degrees are cut."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Claim:
    """A candidate that overlaps others."""

    name: str
    """Its id."""
    outline_mm: MultiPolygon
    """Drawn around its points alone, or together with the other units of its block; integer millimetres."""
    points_mm: IntArray
    """(n, 3), ascending by x; n may be 0."""

    @functools.cached_property
    def rank(self) -> tuple[float, str]:
        """The higher one first, which covers the lower one's eave; then by id."""
        return -float(np.median(self.points_mm[:, 2])) if len(self.points_mm) else 0.0, self.name

    @functools.cached_property
    def effort(self) -> float:
        """What it takes to describe its outline."""
        return effort(self.outline_mm)

    @functools.cached_property
    def inner_mm(self) -> FloatArray:
        """(k, 2), its points within its outline."""
        xy = self.points_mm[:, :2].astype(np.float64)
        shapely.prepare(self.outline_mm)
        inner: FloatArray = xy[shapely.contains_xy(self.outline_mm, xy)]
        return inner


def divided(first: Claim, second: Claim) -> tuple[MultiPolygon, MultiPolygon]:
    """What either of two outlines keeps beside the other: parts of one drawing, which do not overlap.

    Both are in integer millimetres. The result is the same, swapped, for swapped arguments.
    """
    if second.rank < first.rank:
        lower, upper = divided(second, first)
        return upper, lower
    to_first: list[Polygon] = []
    to_second: list[Polygon] = []
    for piece in polygons_of(shapely.intersection(first.outline_mm, second.outline_mm, grid_size=1.0)):
        mine, theirs = ([piece], []) if piece.area < _SMALL_MM2 else _shares(piece, first, second)
        to_first += mine
        to_second += theirs
    drawn = [first.outline_mm, second.outline_mm, *to_first, *to_second]
    net = shapely.union_all(shapely.boundary(drawn), grid_size=1.0)
    cells = np.array(polygons_of(shapely.polygonize(shapely.get_parts(net))), dtype=object)
    places = shapely.point_on_surface(cells)
    is_first = shapely.intersects(first.outline_mm, places)
    is_second = shapely.intersects(second.outline_mm, places)
    is_first &= ~shapely.intersects(shapely.union_all(to_second), places)
    is_second &= ~(is_first | shapely.intersects(shapely.union_all(to_first), places))
    kept, left = (_united(cells[chosen]) for chosen in (is_first, is_second))
    return kept, left


def _united(cells: np.ndarray[tuple[int], np.dtype[np.object_]]) -> MultiPolygon:
    """Cells of one drawing as one shape."""
    found: MultiPolygon = shapely.normalize(MultiPolygon(polygons_of(shapely.coverage_union_all(cells))))
    return found


def _shares(piece: Polygon, first: Claim, second: Claim) -> tuple[list[Polygon], list[Polygon]]:
    """What both take from the other in one piece of their overlap, by the least cost; of equal ones the first one."""
    own, other = _inside(piece, first.points_mm), _inside(piece, second.points_mm)
    none: list[Polygon] = []
    whole = first.effort, second.effort
    least, best = math.inf, ([piece], none, len(other))

    def compare(mine: list[Polygon], theirs: list[Polygon], wrong: int) -> None:
        nonlocal least, best
        # whatever is left of an outline is a part at least
        cost = _WRONG_COST * wrong + (_PART_COST if theirs else whole[0]) + (_PART_COST if mine else whole[1])
        for claim, lost in ((first, theirs), (second, mine)):
            if lost and cost < least:
                left = shapely.difference(claim.outline_mm, MultiPolygon(lost), grid_size=1.0)
                cost += effort(left) - _PART_COST
                cost += _BARRED if left.area < _KEPT_SHARE * claim.outline_mm.area else 0.0
        if cost < least:
            least, best = cost, (mine, theirs, wrong)

    compare(*best)
    compare(none, [piece], len(own))
    if min(len(own), len(other)) >= _FEWEST_WRONG:
        for option in _chords(piece, own, other, lambda wrong: _WRONG_COST * wrong + 2.0 * _PART_COST < least):
            compare(*option)
    if least - _WRONG_COST * best[2] > sum(whole):  # corners came in
        for taken, wrong in _retreats(piece, second, (least - whole[0] - _PART_COST) / _WRONG_COST):
            compare(taken, none, wrong)
        for taken, wrong in _retreats(piece, first, (least - whole[1] - _PART_COST) / _WRONG_COST):
            compare(none, taken, wrong)
    return best[:2]


def _inside(piece: Polygon, points_mm: IntArray) -> IntArray:
    """The places (k, 2) of those points (n, 3), ascending by x, that lie in a piece."""
    west, south, east, north = piece.bounds
    first, last = np.searchsorted(points_mm[:, 0], [west, east + 1])
    near = points_mm[first:last, :2]
    near = near[(near[:, 1] >= south) & (near[:, 1] <= north)]
    inside: IntArray = near[shapely.contains_xy(piece, near[:, 0], near[:, 1])]
    return inside


def _retreats(piece: Polygon, claim: Claim, most: float) -> Iterator[tuple[list[Polygon], int]]:
    """What a candidate gives up if it ends before a piece, along or square to its longest edge; its points in that.

    Left out where these are so many at least.
    """
    ring = shapely.get_coordinates(max(claim.outline_mm.geoms, key=lambda part: (part.area, part.bounds)).exterior)
    edges = np.diff(ring, axis=0)
    longest = edges[int(np.argmax(np.hypot(edges[:, 0], edges[:, 1])))]
    reach = 2.0 * float(np.ptp(ring, axis=0).sum()) / np.hypot(*longest)
    places = shapely.get_coordinates(piece)
    for _ in range(4):
        along = np.rint(reach * longest)
        across = np.array([-along[1], along[0]])
        nearest = places[int(np.argmin((places - places[0]) @ across))]
        # points this near to the line may lie on it, rounded
        if np.count_nonzero(claim.inner_mm @ across > nearest @ across + _PLAIN_MM * math.hypot(*across)) < most:
            ends = np.array([nearest - along, nearest + along])
            beyond = shapely.intersection(claim.outline_mm, Polygon([*ends, *(ends[::-1] + across)]), grid_size=1.0)
            taken = polygons_of(shapely.union_all([beyond, piece], grid_size=1.0))
            yield taken, sum(len(_inside(one, claim.points_mm)) for one in taken)
        longest = across / reach


def _chords(
    piece: Polygon, own: IntArray, other: IntArray, is_worth: Callable[[int], bool]
) -> Iterator[tuple[list[Polygon], list[Polygon], int]]:
    """Divisions of a piece along a line parallel to one of its longest edges, where most points are on their side.

    Left out where so many on the wrong one are not worth it.
    """
    ring = shapely.get_coordinates(piece.exterior)
    edges = np.diff(ring, axis=0)
    corner = np.floor(ring[0])
    points = np.concatenate((own, other)) - corner
    sign = np.repeat([1, -1], [len(own), len(other)])
    reach = 2.0 * float(np.ptp(ring, axis=0).sum())
    for k in np.argsort(-np.hypot(edges[:, 0], edges[:, 1]), kind="stable")[:_DIRECTIONS].tolist():
        along = edges[k] / np.hypot(*edges[k])
        across = np.array([-along[1], along[0]])
        offset = points @ across
        order = np.argsort(offset, kind="stable")
        behind = np.cumsum(sign[order])[:-1]  # own points less others on the near side
        best = int(np.argmax(np.abs(behind - 0.5 * sign.sum())))
        middle = across * 0.5 * (offset[order[best]] + offset[order[best + 1]]) + corner
        ends = np.rint(np.array([middle - along * reach, middle + along * reach]))
        half = Polygon([*ends, ends[1] - np.rint(across * reach), ends[0] - np.rint(across * reach)])
        wrong = len(own) - int(behind[best]) if behind[best] > 0.5 * sign.sum() else len(other) + int(behind[best])
        if is_worth(wrong):
            near = polygons_of(shapely.intersection(piece, half, grid_size=1.0))
            far = polygons_of(shapely.difference(piece, half, grid_size=1.0))
            yield (near, far, wrong) if behind[best] > 0.5 * sign.sum() else (far, near, wrong)


def effort(area: shapely.Geometry) -> float:
    """What it takes to describe an area: its corners; acute ones, short edges and parts cost more."""
    polygons = polygons_of(area)
    xy, ring, _ = corners_of_rings(polygons)
    return _PART_COST * len(polygons) + _effort_of_rings(xy, ring)


@kernel
def _effort_of_rings(xy: FloatArray, ring: IntArray) -> float:
    """The effort of corners (n, 2) of closed rings, each with the number of its ring (n,)."""
    cost = 0.0
    first = last = 0
    while first < len(xy):
        last = first
        while last + 1 < len(xy) and ring[last + 1] == ring[first]:
            last += 1
        ux, uy = 0.0, 0.0
        # the last edge goes before the first one
        for turn in range(2):
            for k in range(first, last):
                dx, dy = xy[k + 1, 0] - xy[k, 0], xy[k + 1, 1] - xy[k, 1]
                if dx == 0.0 and dy == 0.0:
                    continue
                length = math.hypot(dx, dy)
                vx, vy = dx / length, dy / length
                if turn == 1:
                    cosine = ux * vx + uy * vy
                    cost += (cosine < _CORNER_COS) + _ACUTE_COST * (cosine < -_ACUTE_COS)
                    cost += _SHORT_COST * (length < _SHORT_MM)
                ux, uy = vx, vy
        first = last + 1
    return cost


def left_of(outline_mm: MultiPolygon, kept: Sequence[MultiPolygon], min_area_m2: float) -> MultiPolygon:
    """What is left of an outline by what it keeps beside each other one; within all of these, to the millimetre.

    Needles are cut off, and parts below the least area left out, except the largest. Empty where others took all.
    """
    if all(shape is outline_mm for shape in kept):
        return outline_mm
    # the order decides how crossings are rounded
    limits = sorted({shape.wkb: shape for shape in kept}.items())
    left = functools.reduce(shapely.intersection, (shape for _, shape in limits))
    own = [_without_short_edges(part) for polygon in polygons_of(left) for part in _without_needles(polygon)]
    within = [_plain(part, left) for polygon in own for part in _on_grid_within(polygon, left)]
    large = [polygon for polygon in within if polygon.area >= min_area_m2 * 1e6]
    large = large or sorted(within, key=lambda polygon: (polygon.area, polygon.bounds))[-1:]
    # the order of the pieces decides where rings begin
    return shapely.normalize(MultiPolygon(large))


def _on_grid_within(polygon: Polygon, limit: shapely.Geometry) -> list[Polygon]:
    """A polygon with its vertices on the grid, within a limit; without what is too narrow for that."""
    on_grid = polygons_of(shapely.set_precision(polygon, 1.0))
    if not on_grid:
        return []
    faces = RoofPartition(polygons=tuple(on_grid), labels=np.zeros(len(on_grid), np.int32))
    try:
        return list(within_outline(faces, MultiPolygon(polygons_of(limit))).polygons)
    except BuildingError:
        return []


def _plain(polygon: Polygon, limit: shapely.Geometry) -> Polygon:
    """A polygon without short edges, millimetres farther inside where that takes it; as it is where nothing helps."""
    if not _has_short_edges(polygon):
        return polygon
    plain = shapely.simplify(polygon, _PLAIN_MM)
    for back_mm in (0.0, 1.0, 2.0, _PLAIN_MM + 1.0):
        inner = shapely.buffer(plain, -back_mm, join_style="mitre", mitre_limit=_MITRE)
        tried = polygons_of(shapely.set_precision(inner, 1.0))
        if len(tried) == 1 and not _has_short_edges(tried[0]) and shapely.covers(limit, tried[0]):
            return tried[0]
    return polygon


def _has_short_edges(polygon: Polygon) -> bool:
    xy, ring, _ = corners_of_rings([polygon])
    dx, dy = np.diff(xy, axis=0)[ring[1:] == ring[:-1]].T
    return bool((np.hypot(dx, dy) < _SHORTEST_MM).any())


def _without_needles(polygon: Polygon) -> list[Polygon]:
    """A polygon without parts that are narrower than two needle widths; nothing is left of one that is a needle."""
    inner = shapely.buffer(polygon, -_NEEDLE_MM, join_style="mitre", mitre_limit=_MITRE)
    opened = shapely.buffer(inner, _NEEDLE_MM, join_style="mitre", mitre_limit=_MITRE)
    needles = [one for one in polygons_of(shapely.difference(polygon, opened)) if _is_needle(one)]
    return polygons_of(shapely.difference(polygon, MultiPolygon(needles), grid_size=1.0)) if needles else [polygon]


def _is_needle(part: Polygon) -> bool:
    """Whether a part that an opening removes is more than a film along an edge or a cut corner."""
    return bool(part.area > _LEAST_NEEDLE_MM2 and 2.0 * part.area > 0.1 * _NEEDLE_MM * part.length)


def _without_short_edges(polygon: Polygon) -> Polygon:
    """A polygon without edges that a solid cannot have, where that adds nothing."""
    polygon = polygon.normalize()
    if not _has_short_edges(polygon):
        return polygon
    rings = [_thinned(shapely.get_coordinates(ring)[:-1]) for ring in shapely.get_rings(polygon).tolist()]
    thinned = Polygon(rings[0], rings[1:])
    return thinned if thinned.is_valid else polygon


def _thinned(ring: FloatArray) -> FloatArray:
    """A ring (n, 2) with the area to its right, without short edges.

    A corner at one end is cut off. Where both are inner corners, the edges beside it are continued to where they meet.
    """
    while len(ring) > 4:
        into, out = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
        cut_off = into[:, 1] * out[:, 0] - into[:, 0] * out[:, 1]
        short = np.hypot(out[:, 0], out[:, 1]) < _SHORTEST_MM
        free = (short | np.roll(short, 1)) & (cut_off >= 0.0)
        if free.any():
            ring = np.delete(ring, int(np.argmin(np.where(free, cut_off, np.inf))), axis=0)
            continue
        met = [_meeting(ring, k) for k in np.flatnonzero(short).tolist()]
        k, place = next(
            ((k, place) for k, place in zip(np.flatnonzero(short), met, strict=True) if len(place)), (0, ())
        )
        if not len(place):
            break
        ring = np.roll(ring, -k, axis=0)
        ring = np.concatenate(([place], ring[2:]))
    return ring


def _meeting(ring: FloatArray, k: int) -> FloatArray:
    """Where the edges beside edge k meet if they are continued, (2,); empty if that is not near."""
    a, b, c, d = np.take(ring, range(k - 1, k + 3), axis=0, mode="wrap")
    (ux, uy), (vx, vy), (wx, wy) = b - a, c - d, d - a
    det = ux * vy - uy * vx
    if det == 0.0:
        return np.empty(0)
    place = a + (wx * vy - wy * vx) / det * (b - a)
    return place if max(math.dist(place, b), math.dist(place, c)) < _SHORTEST_MM else np.empty(0)
