"""Roof type from the delivered planes, their areas, and how they meet.

Flat is below 7 degrees, a gable has two opposite sides "whose inclinations must not be the same", a hip roof two such
pairs (Hofmann, Maas and Streilein 2003). The finer names follow the list of roof types of CityGML and usage:

- The *main roof* decides: the largest part whose sloping faces meet. Flat faces count with it where they lie on top of
  it; others are annexes, and the roof is flat where these have half of the area.
- A *side* is all faces of one direction. Two opposite sides with a ridge are a gable, with a valley a butterfly.
- A side square to them is an *end* where it meets one of them in a hip. Ends that begin well above the eaves make a
  half-hip; ends that meet in a point, a pyramid.
- Where both sides have a steeper lower face the roof is a gambrel, with such ends a mansard.
- Valleys between sides square to each other are those of wings: one for an L, two for a T, four for a cross. Short ones
  are those of dormers.
- Three slopes of one direction behind one another are a sawtooth.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from itertools import combinations, permutations, product

from pipeline.model import FaceKind, Plane, RoofFace, RoofType, Solid, SolidFace
from pipeline.roof.roof_settings import RoofTypeSettings

_HALF = 0.5
_MAIN = 0.6
"""Share of the sloping faces from which a part of them decides alone."""
_LEAST_END = 0.008
"""Share of the main roof that an end has at least."""
_END_REACH = 0.7
"""Share of the height of the roof over which an end falls that is not half a hip's."""
_POINT = 0.04
"""Ridges shorter than this share of the hips are a point."""
_LEVEL = 0.15
"""Share of the height of a roof within which tops are at one height."""
_LEAST_VALLEY = 0.4
"""Share of the longest hip, else of the root of the area, from which a valley is that of a wing."""
_LEAST_KINK, _LEAST_KINK_DEG = 0.15, 5.0
"""Share of a side's area that the flatter and the steeper face of a gambrel have at least, and their angle."""
_STEEP_DEG = 45.0
"""Slope of the sides of a mansard under a flat top."""
_LEAST_ARM = 0.1
"""Share of the extent of one part from which the other part reaches beyond it."""
_TEETH, _TOOTH = 3, 0.08
"""Slopes of a sawtooth, and the least share of the roof of each."""

Folds = dict[tuple[int, int], float]
"""Length in plan over which two planes meet, by their numbers in both orders; each edge counts from both sides."""


@dataclasses.dataclass
class _Side:
    """All roof faces of one direction."""

    aspect_deg: float
    area: float
    planes: list[int]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Roof:
    """What decides the type of a roof, by the numbers of planes."""

    planes: Sequence[Plane]
    areas: dict[int, float]
    ridges: Folds
    bends: Folds
    corners: dict[int, list[tuple[float, float, float]]]
    """Of the faces."""
    settings: RoofTypeSettings

    def is_flat(self, p: int) -> bool:
        """Whether a plane is flat."""
        return self.planes[p].slope_deg < self.settings.flat_below_deg

    def area(self, planes: Iterable[int]) -> float:
        """Area of the faces of planes."""
        return math.fsum(self.areas[p] for p in planes)

    def length(self, met: Folds, a: _Side, b: _Side) -> float:
        """Length over which the faces of two sides meet."""
        return math.fsum(met.get(pair, 0.0) for pair in product(sorted(a.planes), sorted(b.planes)))

    def low(self, planes: Iterable[int]) -> float:
        """Height of the lowest corner of the faces of planes."""
        return min(z for p in planes for _, _, z in self.corners[p])

    def high(self, planes: Iterable[int]) -> float:
        """Height of the highest corner of the faces of planes."""
        return max(z for p in planes for _, _, z in self.corners[p])

    def turned(self, a: _Side, b: _Side, by_deg: float) -> bool:
        """Whether the directions of two sides are so far apart."""
        return abs(_turn(a.aspect_deg, b.aspect_deg) - by_deg) <= self.settings.aspect_tolerance_deg


def _turn(a_deg: float, b_deg: float) -> float:
    """Angle between two aspects, 0 to 180."""
    return abs((a_deg - b_deg + 180.0) % 360.0 - 180.0)


def roof_type(
    planes: Sequence[Plane], faces: Sequence[RoofFace], solids: Sequence[Solid], settings: RoofTypeSettings
) -> RoofType:
    """The type of a delivered roof; `solids` show where its faces meet.

    It is `none` without faces and `combination` for a roof without a simpler name.
    """
    areas: dict[int, float] = {}
    around: dict[int, float] = {}
    for face in faces:
        areas[face.plane] = areas.get(face.plane, 0.0) + face.polygon.area
        around[face.plane] = around.get(face.plane, 0.0) + face.polygon.length
    if math.fsum(areas.values()) <= 0.0:
        return RoofType.NONE
    ridges, bends = folds(planes, solids, settings.sliver_height_m)
    roof = _Roof(planes=planes, areas=areas, ridges=ridges, bends=bends, corners=_corners(solids), settings=settings)
    slopes = [p for p in areas if not roof.is_flat(p)]
    # each edge counts from both sides, so that a face with ridges all around has twice its length
    tops = [p for p in areas if roof.is_flat(p) and math.fsum(ridges.get((p, q), 0.0) for q in slopes) >= around[p]]
    if roof.area(areas) - roof.area(slopes) - roof.area(tops) >= _HALF * roof.area(areas) or not slopes:
        return RoofType.FLAT
    main = _main_roof(roof, slopes)
    return _named(roof, main, [p for p in tops if any((p, q) in ridges for q in main)])


def _corners(solids: Sequence[Solid]) -> dict[int, list[tuple[float, float, float]]]:
    """The corners of the roof faces of each plane."""
    corners: dict[int, list[tuple[float, float, float]]] = {}
    for solid in solids:
        vertices = solid.vertices.tolist()
        for face in solid.faces:
            if face.kind is FaceKind.ROOF:
                corners.setdefault(face.plane, []).extend(vertices[vertex] for ring in face.rings for vertex in ring)
    return corners


def _main_roof(roof: _Roof, slopes: list[int]) -> list[int]:
    """The largest part of the sloping faces that meet; all of them where none is much larger than the rest."""
    part_of = {p: {p} for p in slopes}
    for p, q in combinations(slopes, 2):
        if ((p, q) in roof.ridges or (p, q) in roof.bends) and part_of[p] is not part_of[q]:
            part_of[p] |= part_of[q]
            for other in part_of[q]:
                part_of[other] = part_of[p]
    largest = max(part_of.values(), key=lambda part: (roof.area(sorted(part)), -min(part)))
    return sorted(largest) if roof.area(largest) >= _MAIN * roof.area(slopes) else slopes


def _sides(roof: _Roof, slopes: Sequence[int]) -> list[_Side]:
    """Sloping planes by direction, largest first; of two directions nearly as near, that of the larger plane."""
    sides: list[_Side] = []
    for p in sorted(slopes, key=lambda p: (-roof.areas[p], p)):
        aspect_deg = roof.planes[p].aspect_deg
        for side in sides:
            if _turn(side.aspect_deg, aspect_deg) <= roof.settings.aspect_tolerance_deg:
                side.area += roof.areas[p]
                side.planes.append(p)
                break
        else:
            sides.append(_Side(aspect_deg=aspect_deg, area=roof.areas[p], planes=[p]))
    return sorted(sides, key=lambda side: -side.area)


def _named(roof: _Roof, main: Sequence[int], tops: Sequence[int]) -> RoofType:
    """The type of the main roof, with its flat tops."""
    total = roof.area(main) + roof.area(tops)
    sides = _sides(roof, main)
    if _is_sawtooth(roof, sides, total):
        return RoofType.SAWTOOTH
    if _is_pyramid_of_many(roof, sides, total):
        return RoofType.PYRAMID
    first = sides[0]
    second = next((one for one in sides if roof.turned(first, one, 180.0)), None)
    if second is not None and second.area < roof.settings.minor_share * total and not tops:
        second = None
    pair = [first] if second is None else [first, second]
    square = [one for one in sides if roof.turned(first, one, 90.0) and one.area >= _LEAST_END * total]
    wings = _wings(roof, pair, square, total)
    if wings is not None:
        return wings
    ends = [one for one in square if any((p, q) in roof.ridges for p in one.planes for q in _mains(roof, pair))]
    decided = math.fsum(side.area for side in pair + ends) + roof.area(tops)
    if total - decided >= roof.settings.minor_share_together * total:
        return RoofType.COMBINATION
    if second is None:
        return _of_one_side(roof, first, ends, total)
    kinked = all(_is_kinked(roof, side) for side in pair)
    if ends:
        return _hipped(roof, pair, ends, tops, is_kinked=kinked)
    has_ridge = roof.length(roof.ridges, first, second) > 0.0
    if kinked or (tops and not has_ridge):
        return RoofType.GAMBREL
    if has_ridge:
        return RoofType.GABLE
    return RoofType.BUTTERFLY if roof.length(roof.bends, first, second) > 0.0 else RoofType.COMBINATION


def _mains(roof: _Roof, pair: list[_Side]) -> list[int]:
    """The planes of two sides that meet in ridges, else the largest of each: no fronts of dormers."""
    opposite = [(p, q) for one, other in permutations(pair, 2) for p in one.planes for q in other.planes]
    return [p for p, q in opposite if (p, q) in roof.ridges] or [side.planes[0] for side in pair]


def _of_one_side(roof: _Roof, side: _Side, ends: Sequence[_Side], total: float) -> RoofType:
    """The type of a roof without an opposite side: a pent roof, or the half of a hip roof on one side of its ridge."""
    if side.area >= (1.0 - roof.settings.minor_share_together) * total:
        return RoofType.PENT
    return RoofType.HIP if len(ends) > 1 else RoofType.COMBINATION


def _hipped(
    roof: _Roof, pair: Sequence[_Side], ends: Sequence[_Side], tops: Sequence[int], *, is_kinked: bool
) -> RoofType:
    """The type of a roof with two opposite sides and at least one end."""
    mains = [p for side in pair for p in side.planes]
    least = roof.high(mains) - _END_REACH * (roof.high(mains) - roof.low(mains))
    whole = [end for end in ends if roof.low(end.planes) <= least]
    if not whole:
        return RoofType.GAMBREL if is_kinked else RoofType.HALF_HIP
    if is_kinked:
        return RoofType.MANSARD
    if tops:
        steep = math.fsum(roof.planes[p].slope_deg * roof.areas[p] for p in mains) >= _STEEP_DEG * roof.area(mains)
        return RoofType.MANSARD if steep else RoofType.HIP
    hips = math.fsum(roof.length(roof.ridges, end, side) for end in whole for side in pair)
    is_point = roof.length(roof.ridges, *pair) < _POINT * hips
    return RoofType.PYRAMID if len(whole) > 1 and is_point else RoofType.HIP


def _is_kinked(roof: _Roof, side: _Side) -> bool:
    """Whether a side has a steeper face below a flatter one, each with a good share of its area."""
    for p in side.planes:
        for q in side.planes:
            steeper_deg = roof.planes[q].slope_deg - roof.planes[p].slope_deg
            if steeper_deg >= _LEAST_KINK_DEG and (p, q) in roof.ridges:
                least = _LEAST_KINK * side.area
                if roof.areas[p] >= least and roof.areas[q] >= least:
                    return True
    return False


def _wings(roof: _Roof, pair: Sequence[_Side], square: Sequence[_Side], total: float) -> RoofType | None:
    """The form of a roof whose wings meet in valleys: an L, a T, a cross, or a combination; None without wings."""
    meetings = [
        (p, q) for one, other in product(pair, square) for p, q in product(sorted(one.planes), sorted(other.planes))
    ]
    longest_hip = max((roof.ridges.get(met, 0.0) for met in meetings), default=0.0)
    least = _LEAST_VALLEY * (longest_hip or math.sqrt(total))
    valleys = [met for met in meetings if roof.bends.get(met, 0.0) >= max(least, roof.ridges.get(met, 0.0))]
    wing = roof.area({q for _, q in valleys})
    if not valleys or wing < roof.settings.minor_share * total:
        return None
    side_of = {p: k for k, side in enumerate([*pair, *square]) for p in side.planes}
    arms: list[int] = []
    for one, other in combinations(valleys, 2):
        for main, across in ((0, 1), (1, 0)):
            is_arm = side_of[one[main]] == side_of[other[main]] and (one[across], other[across]) in roof.ridges
            if is_arm and one in valleys and other in valleys:
                arms.append(side_of[one[main]])
                valleys = [met for met in valleys if met not in (one, other)]
    if len(arms) + len(valleys) != 1 and (valleys or len(arms) != 2 or arms[0] == arms[1]):
        return RoofType.COMBINATION
    north_or_south, east_or_west = _overlaps(roof, pair, square)
    if north_or_south == east_or_west == 2:
        return RoofType.CROSS
    if north_or_south and east_or_west:
        return RoofType.L_SHAPE if north_or_south == east_or_west else RoofType.T_SHAPE
    return RoofType.CROSS if len(arms) == 2 else None


def _overlaps(roof: _Roof, pair: Sequence[_Side], square: Sequence[_Side]) -> tuple[int, int]:
    """At how many ends the wings reach beyond the main part of a roof, and that beyond the wings.

    Both parts are the faces at their ridges; faces at ends do not count.
    """
    parts = []
    for sides in (pair, square):
        planes = [p for side in sides for p in side.planes]
        parts.append([p for p in planes if any((p, q) in roof.ridges for q in planes)])
    if not all(parts):
        return 0, 0
    (mains, wings), plane = parts, roof.planes[pair[0].planes[0]]
    return _reached(roof, (plane.a, plane.b), wings, mains), _reached(roof, (-plane.b, plane.a), mains, wings)


def _reached(roof: _Roof, way: tuple[float, float], outer: Sequence[int], inner: Sequence[int]) -> int:
    """At how many ends, along a way, some faces reach well beyond others."""

    def ends(planes: Sequence[int]) -> tuple[float, float]:
        places = [x * way[0] + y * way[1] for p in planes for x, y, _ in roof.corners[p]]
        return min(places), max(places)

    (start, stop), (first, last) = ends(outer), ends(inner)
    least = _LEAST_ARM * (last - first)
    return (first - start > least) + (stop - last > least)


def _is_pyramid_of_many(roof: _Roof, sides: Sequence[_Side], total: float) -> bool:
    """Whether more than four sides meet in hips all around, and their tops in a point."""
    around = sorted((side for side in sides if side.area >= _LEAST_END * total), key=lambda side: side.aspect_deg)
    if len(around) <= 4 or math.fsum(side.area for side in around) < (1.0 - roof.settings.minor_share) * total:
        return False
    tops, low = [roof.high(side.planes) for side in around], min(roof.low(side.planes) for side in around)
    return max(tops) - min(tops) <= _LEVEL * (max(tops) - low) and all(
        roof.length(roof.ridges, side, other) > 0.0 for side, other in zip(around, around[1:] + around[:1], strict=True)
    )


def _is_sawtooth(roof: _Roof, sides: Sequence[_Side], total: float) -> bool:
    """Whether there are slopes of one direction and height behind one another, between walls or steeper faces."""
    side = sides[0]
    teeth = [p for p in side.planes if roof.areas[p] >= _TOOTH * total]
    if len(teeth) < _TEETH or roof.area(teeth) < _HALF * total:
        return False
    tops, rises = [roof.high([p]) for p in teeth], [roof.high([p]) - roof.low([p]) for p in teeth]
    backs = [p for one in sides[1:] if roof.turned(side, one, 180.0) for p in one.planes]
    is_even = max(tops) - min(tops) <= _HALF * min(rises)
    slope_deg = max(roof.planes[p].slope_deg for p in teeth)
    return is_even and all(roof.planes[p].slope_deg > slope_deg + roof.settings.slope_tolerance_deg for p in backs)


def folds(planes: Sequence[Plane], solids: Sequence[Solid], sliver_height_m: float) -> tuple[Folds, Folds]:
    """Where planes meet and fall away on both sides (ridges, hips), and where they do not (bends, valleys).

    Planes meet in a common edge, or across a wall that is nowhere higher than a sliver.
    """
    ridges: Folds = {}
    bends: Folds = {}
    for solid in solids:
        vertices: list[tuple[float, float, float]] = solid.vertices.tolist()
        owner = {edge: face.plane for face in solid.faces if face.kind is FaceKind.ROOF for edge in _edges(face)}
        met = [(edge, owner[edge[::-1]]) for edge in owner if edge[::-1] in owner]
        for face in solid.faces:
            if face.kind is FaceKind.WALL:
                roof_edges = [edge[::-1] for edge in _edges(face) if edge[::-1] in owner]
                if len(roof_edges) > 1 and _height_m(vertices, face) <= sliver_height_m:
                    met += [(edge, owner[other]) for edge in roof_edges for other in roof_edges]
        for (a, b), right in met:
            left = owner[a, b]
            if right == left:
                continue
            # a step of one metre to the left of the edge: the left plane lies below the right one's continuation
            (xa, ya, _), (xb, yb, _) = vertices[a], vertices[b]
            p, q = planes[left], planes[right]
            falls = (p.a - q.a) * (ya - yb) + (p.b - q.b) * (xb - xa) < 0.0
            turned = ridges if falls else bends
            for pair in ((left, right), (right, left)):
                turned[pair] = turned.get(pair, 0.0) + math.hypot(xb - xa, yb - ya)
    return ridges, bends


def _edges(face: SolidFace) -> list[tuple[int, int]]:
    """Directed edges of all rings."""
    return [edge for ring in face.rings for edge in zip(ring, ring[1:] + ring[:1], strict=True)]


def _height_m(vertices: Sequence[tuple[float, float, float]], face: SolidFace) -> float:
    """Greatest height of a wall over one place."""
    ends: dict[tuple[float, float], tuple[float, float]] = {}
    for vertex in face.rings[0]:
        x, y, z = vertices[vertex]
        low, high = ends.get((x, y), (z, z))
        ends[x, y] = min(low, z), max(high, z)
    return max(high - low for low, high in ends.values())
