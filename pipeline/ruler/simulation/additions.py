"""Dormers and superstructures: drawn at random, and as further parts of the envelope of a roof."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.model import FloatArray
from pipeline.ruler.simulation.envelope import Line, Place, RoofPart, envelope
from pipeline.ruler.simulation.roof_dimensions import (
    Addition,
    AdditionKind,
    FaceRings,
    RoofDimensions,
    RoofFaces,
    RoofShape,
)
from pipeline.ruler.simulation.roof_parts import PARTS, rectangle

_TOLERANCE_M = 1e-6
"""Numerical guard, also in square metres."""
_EDGE_M = 0.3
"""Free roof along the edges of a face; plausible."""
_APART_M = 0.5
"""Free roof between additions; plausible."""
_MIN_CLEARANCE_M = 0.05
"""Finest detail of a roof: smaller ones would vanish in the rounding of models."""
_ALONG_M = 1e-3
"""A side this close to an edge runs along it."""
_TRIES = 40
"""Draws before the roof counts as full."""
_ON_FLAT_ROOFS = (1.5, 1.5, 0.8), (4.5, 4.0, 3.2)
_CHIMNEY = (0.5, 0.5, 0.5), (1.1, 1.1, 1.1)
"""Smallest and largest length, width and height in metres."""
_WITHOUT_DORMERS = {RoofShape.FLAT, RoofShape.PENT, RoofShape.MULTI_LEVEL_FLAT}


def plan_rectangle(addition: Addition) -> tuple[Place, ...]:
    """Its rectangle in plan, counter-clockwise."""
    u, v, along, across = addition.u_m, addition.v_m, addition.length_m / 2, addition.width_m / 2
    return rectangle(u - along, u + along, v - across, v + across)


def addition_parts(base: RoofFaces, additions: Sequence[Addition]) -> list[RoofPart]:
    """The parts of the additions to a bare roof, one each; they follow the parts of the roof.

    A box has a flat top above all of the roof beneath it. A dormer stands on one sloping face: its front wall is at the
    low side of its rectangle, and its roof runs into the face at the high side. Raises ValueError if one hangs over the
    outline, or if a dormer does not stand on one sloping face or does not run into it.
    """
    if not additions:
        return []
    polygons = [_polygon(base, face) for face in base.faces]
    planes = [_plane(base, face) for face in base.faces]
    return [_part(addition, f"addition {k}", polygons, planes) for k, addition in enumerate(additions)]


def _part(addition: Addition, name: str, polygons: Sequence[shapely.Polygon], planes: Sequence[Line]) -> RoofPart:
    outline = plan_rectangle(addition)
    own = shapely.Polygon(outline)
    beneath = [
        (share, plane)
        for polygon, plane in zip(polygons, planes, strict=True)
        if (share := shapely.intersection(polygon, own)).area > _TOLERANCE_M
    ]
    if sum(share.area for share, _ in beneath) < own.area - 1e-3 * math.sqrt(own.area):
        raise ValueError(f"{_named(addition)} hangs over the outline of the roof")
    if addition.kind is AdditionKind.BOX:
        highest = max(a * u + b * v + c for share, (a, b, c) in beneath for u, v in shapely.get_coordinates(share))
        roof: tuple[Line, ...] = ((0.0, 0.0, float(highest) + addition.height_m),)
    else:
        if len(beneath) != 1:
            raise ValueError(f"{_named(addition)} stands on {len(beneath)} faces: a dormer stands on one")
        roof = _dormer(addition, beneath[0][1])
    return RoofPart(outline=outline, planes=roof, labels=tuple(f"{name} {k}" for k in range(len(roof))))


def _dormer(addition: Addition, face: Line) -> tuple[Line, ...]:
    """The planes of a dormer on a face that falls along u or v."""
    a, b, c = face
    across = abs(b) >= abs(a)
    depth, breadth = (addition.width_m, addition.length_m) if across else (addition.length_m, addition.width_m)
    steep = b if across else a
    # Its high and its low end, measured along the axis on which the face falls.
    middle = addition.v_m if across else addition.u_m
    aside = addition.u_m if across else addition.v_m
    low = middle - math.copysign(depth / 2, steep)
    high = middle + math.copysign(depth / 2, steep)
    back = steep * high + c
    eave = steep * low + c + addition.height_m
    if min(abs(a), abs(b)) > 1e-9 or steep == 0.0 or back - eave <= 0.0:
        raise ValueError(
            f"{_named(addition)} does not run into the roof: its eave would be {eave - back:.2f} m over the roof at its"
            " back; it needs more depth, less height, or a face that falls along u or v"
        )
    if addition.kind is AdditionKind.PENT_DORMER:
        slope = (back - eave) / (high - low)
        lines = [(slope, 0.0, back - slope * high)]
    else:
        slope = (back - eave) / (breadth / 2)
        lines = [(0.0, side * slope, back - side * slope * aside) for side in (1.0, -1.0)]
    return tuple((along, over, c) if not across else (over, along, c) for along, over, c in lines)


def _named(addition: Addition) -> str:
    return f"{addition.kind} of {addition.length_m:g} x {addition.width_m:g} m at {addition.u_m:g}, {addition.v_m:g}"


def _polygon(roof: RoofFaces, face: FaceRings) -> shapely.Polygon:
    plan = roof.vertices[:, :2]
    return shapely.Polygon(plan[list(face[0])], [plan[list(hole)] for hole in face[1:]])


def _plane(roof: RoofFaces, face: FaceRings) -> Line:
    """The plane through a face, by Newell's sums."""
    ring: FloatArray = roof.vertices[list(face[0])]
    x = y = z = 0.0
    for (x1, y1, z1), (x2, y2, z2) in zip(ring, [*ring[1:], ring[0]], strict=True):
        x += (y1 - y2) * (z1 + z2)
        y += (z1 - z2) * (x1 + x2)
        z += (x1 - x2) * (y1 + y2)
    a, b = -x / z, -y / z
    a, b = (0.0 if abs(slope) < 1e-9 else float(slope) for slope in (a, b))
    u, v, height = (float(value) for value in ring.mean(axis=0))
    return a, b, height - a * u - b * v


def can_have_dormers(shape: RoofShape) -> bool:
    """Whether a roof of this shape has faces that are steep enough for dormers."""
    return shape not in _WITHOUT_DORMERS


def random_dormers(
    shape: RoofShape, size: RoofDimensions, random: np.random.Generator, *, besides: Sequence[Addition] = ()
) -> tuple[Addition, ...]:
    """Draw one to three equal dormers in a row on one face of the bare roof, clear of `besides`.

    Empty if no face is large and steep enough.
    """
    if not can_have_dormers(shape):
        return ()
    bare = envelope(PARTS[shape](size))
    faces = []
    for face in bare.faces:
        a, b, c = _plane(bare, face)
        if 20.0 <= math.degrees(math.atan(math.hypot(a, b))) <= 75.0:
            free = shapely.buffer(_polygon(bare, face), -_EDGE_M, join_style="mitre")
            if not free.is_empty:
                faces.append((free, (a, b, c)))
    taken = [shapely.Polygon(plan_rectangle(one)) for one in besides]
    wanted = int(random.integers(1, 4))
    for shrink in (1.0, 0.8, 0.65, 0.5):
        # The larger a face, the more likely it comes first.
        keys = [-(float(random.random()) ** (1.0 / free.area)) for free, _ in faces]
        for k in sorted(range(len(faces)), key=keys.__getitem__):
            free, plane = faces[k]
            row = _row_of_dormers(free, plane, wanted, shrink, taken, random)
            if row:
                return row
    return ()


def _row_of_dormers(
    free: shapely.Polygon,
    plane: Line,
    wanted: int,
    shrink: float,
    taken: Sequence[shapely.Polygon],
    random: np.random.Generator,
) -> tuple[Addition, ...]:
    """Up to so many dormers of one size and one front line inside a polygon of one slope."""
    across = abs(plane[1]) >= abs(plane[0])
    fall = math.hypot(plane[0], plane[1])
    kind = AdditionKind.PENT_DORMER if random.random() < 0.5 else AdditionKind.GABLE_DORMER
    breadth = round(shrink * float(random.uniform(1.4, 2.8)), 2)
    height = round(shrink * float(random.uniform(1.0, 1.5)), 2)
    pitch = math.degrees(math.atan(fall))
    if kind is AdditionKind.PENT_DORMER:
        depth = height / (fall - math.tan(math.radians(min(float(random.uniform(3.0, 15.0)), pitch / 2))))
    else:
        depth = (height + breadth / 2 * math.tan(math.radians(float(random.uniform(20.0, 40.0))))) / fall
    depth = round(depth, 2)
    length, width = (breadth, depth) if across else (depth, breadth)
    u0, v0, u1, v1 = free.bounds
    room_u, room_v = u1 - u0 - length, v1 - v0 - width
    if min(room_u, room_v) < 0.0:
        return ()
    row: list[Addition] = []
    for _ in range(_TRIES):
        u, v = (round(float(value), 2) for value in random.uniform((0.0, 0.0), (room_u, room_v)))
        u, v = round(u0 + length / 2, 2) + u, round(v0 + width / 2, 2) + v
        if row and across:
            v = row[0].v_m
        elif row:
            u = row[0].u_m
        one = Addition(kind=kind, u_m=u, v_m=v, length_m=length, width_m=width, height_m=height)
        own = shapely.Polygon(plan_rectangle(one))
        others = [*taken, *(shapely.Polygon(plan_rectangle(other)) for other in row)]
        if free.contains(own) and not any(shapely.dwithin(own, other, _APART_M) for other in others):
            row.append(one)
            if len(row) == wanted:
                break
    return tuple(row)


def random_superstructures(
    shape: RoofShape,
    size: RoofDimensions,
    random: np.random.Generator,
    *,
    besides: Sequence[Addition] = (),
    at_most: int = 3,
) -> tuple[Addition, ...]:
    """Draw one to `at_most` boxes clear of `besides`: lift shafts on flat faces, chimneys on sloping ones.

    Their sides keep clear of ridges and eaves, or cross them. Empty if there is no room.
    """
    parts = PARTS[shape](size)
    bare = envelope(parts)
    polygons = [_polygon(bare, face) for face in bare.faces]
    flat = [polygon for polygon, face in zip(polygons, bare.faces, strict=True) if _plane(bare, face)[:2] == (0.0, 0.0)]
    ground = max(flat, key=lambda polygon: polygon.area) if flat else shapely.union_all(polygons)
    free = shapely.buffer(ground, -_EDGE_M, join_style="mitre")
    edges = shapely.buffer(shapely.union_all([polygon.boundary for polygon in polygons]), _ALONG_M)
    taken = [shapely.Polygon(plan_rectangle(one)) for one in besides]
    wanted = int(random.integers(1, at_most + 1))
    found: list[Addition] = []
    for _ in range(_TRIES):
        length, width, height = random.uniform(*(_ON_FLAT_ROOFS if flat else _CHIMNEY))
        u0, v0, u1, v1 = free.bounds
        length, width = min(float(length), 0.6 * (u1 - u0)), min(float(width), 0.6 * (v1 - v0))
        u, v = random.uniform((u0, v0), (u1, v1))
        one = Addition(
            kind=AdditionKind.BOX,
            u_m=round(float(u), 2),
            v_m=round(float(v), 2),
            length_m=round(length, 2),
            width_m=round(width, 2),
            height_m=round(float(height), 2),
        )
        own = shapely.Polygon(plan_rectangle(one))
        if not free.contains(own) or any(shapely.dwithin(own, other, _APART_M) for other in taken):
            continue
        if shapely.intersection(own.exterior, edges).length > _MIN_CLEARANCE_M:
            continue  # a side along a ridge would leave a wall without height on it
        both = envelope([*parts, *addition_parts(bare, [one])])
        if min(shapely.minimum_clearance(_polygon(both, face)) for face in both.faces) < _MIN_CLEARANCE_M:
            continue
        found.append(one)
        taken.append(own)
        if len(found) == wanted:
            break
    return tuple(found)
