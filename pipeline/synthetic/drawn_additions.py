"""Dormers and superstructures drawn at random, where a roof has room for them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import shapely

from pipeline.synthetic.roofs import ROOFS, Addition, AdditionKind, FaceRings, RoofDimensions, RoofFaces, RoofShape
from pipeline.synthetic.scene import face_plane

_TRIES = 60
_APART_M = 0.6
_STEEPEST_DEG, _FLATTEST_DEG = 62.0, 18.0

_WITHOUT_DORMERS = {RoofShape.FLAT, RoofShape.MULTI_LEVEL_FLAT, RoofShape.PENT, RoofShape.PYRAMID}


def can_have_dormers(shape: RoofShape) -> bool:
    """Whether roofs of a shape carry dormers."""
    return shape not in _WITHOUT_DORMERS


def random_dormers(
    shape: RoofShape, size: RoofDimensions, random: np.random.Generator, *, besides: tuple[Addition, ...] = ()
) -> tuple[Addition, ...]:
    """One to four dormers of one kind and size on the faces of a roof.

    Parameters
    ----------
    shape, size : RoofShape, RoofDimensions
        The roof.
    random : numpy.random.Generator
        Of number, sizes and places.
    besides : tuple of Addition
        What stands there already.

    Returns
    -------
    tuple of Addition
        Apart from one another and from the others, each on one face; none where no face has room.
    """
    roof = ROOFS[shape](dataclasses.replace(size, additions=()))
    faces = [(polygon, fall) for polygon, fall in map(_falling, *_each(roof)) if fall is not None]
    if not faces:
        return ()
    wanted = int(random.integers(1, 5))
    kind = AdditionKind.GABLE_DORMER if random.random() < 0.6 else AdditionKind.PENT_DORMER
    breadth = float(random.uniform(1.6, 3.2))
    found: list[Addition] = []
    taken = [_rectangle(one.u_m, one.v_m, one.length_m, one.width_m) for one in besides]
    for attempt in range(_TRIES):
        shrink = 1.0 - 0.5 * attempt / _TRIES
        polygon, (rise_u, rise_v) = faces[int(random.integers(len(faces)))]
        steep = abs(rise_u) + abs(rise_v)
        depth, wide = float(random.uniform(2.2, 3.8)) * shrink, breadth * shrink
        rise = steep * depth
        height = rise * float(random.uniform(0.45, 0.7))
        if kind is AdditionKind.GABLE_DORMER:
            height = min(max(rise - wide / 2 * float(random.uniform(0.6, 1.0)), 0.3 * rise), 0.75 * rise)
        along, across = (depth, wide) if abs(rise_u) > abs(rise_v) else (wide, depth)
        place = _room_for(polygon, along, across, taken, random)
        if place is not None:
            u, v, rectangle = place
            taken.append(rectangle)
            found.append(Addition(kind=kind, u_m=u, v_m=v, length_m=along, width_m=across, height_m=height))
        if len(found) == wanted:
            break
    return tuple(found)


def random_superstructures(
    shape: RoofShape,
    size: RoofDimensions,
    random: np.random.Generator,
    *,
    besides: tuple[Addition, ...] = (),
    at_most: int = 3,
) -> tuple[Addition, ...]:
    """Boxes on a roof: lift shafts and attic boxes on flat roofs, chimneys and shafts on sloping ones.

    Parameters
    ----------
    shape, size : RoofShape, RoofDimensions
        The roof.
    random : numpy.random.Generator
        Of number, sizes and places.
    besides : tuple of Addition
        What stands there already.
    at_most : int
        Largest number.

    Returns
    -------
    tuple of Addition
        At least one wherever the roof is as large as a chimney.
    """
    roof = ROOFS[shape](dataclasses.replace(size, additions=()))
    outline = shapely.union_all(_each(roof)[0])
    taken = [_rectangle(one.u_m, one.v_m, one.length_m, one.width_m) for one in besides]
    is_flat = shape in {RoofShape.FLAT, RoofShape.MULTI_LEVEL_FLAT}
    wanted = int(random.integers(1, at_most + 1))
    found: list[Addition] = []
    for attempt in range(_TRIES):
        shrink = 1.0 - 0.7 * attempt / _TRIES
        low, high, tall = (2.5, 6.0, (2.0, 3.5)) if is_flat else (1.2, 3.0, (0.6, 1.8))
        along, across = (float(side) * shrink for side in random.uniform(low, high, 2))
        height = float(random.uniform(*tall))
        place = _room_for(outline, along, across, taken, random)
        if place is not None:
            u, v, rectangle = place
            taken.append(rectangle)
            found.append(Addition(kind=AdditionKind.BOX, u_m=u, v_m=v, length_m=along, width_m=across, height_m=height))
        if len(found) == wanted:
            break
    return tuple(found)


def _each(roof: RoofFaces) -> tuple[list[shapely.Polygon], list[tuple[float, float]]]:
    """Plan polygon and rise (per metre of u, of v) of every face."""

    def polygon(rings: FaceRings) -> shapely.Polygon:
        plan = roof.vertices[:, :2]
        return shapely.Polygon(plan[list(rings[0])], [plan[list(hole)] for hole in rings[1:]])

    def rise(rings: FaceRings) -> tuple[float, float]:
        plane = face_plane(roof.vertices[list(rings[0])])
        return plane.a, plane.b

    return [polygon(face) for face in roof.faces], [rise(face) for face in roof.faces]


def _falling(polygon: shapely.Polygon, rise: tuple[float, float]) -> tuple[shapely.Polygon, tuple[float, float] | None]:
    """A face with its rise; None for the rise where no dormer fits: too flat, too steep, or turned."""
    flattest, steepest = (math.tan(math.radians(angle)) for angle in (_FLATTEST_DEG, _STEEPEST_DEG))
    fits = min(abs(rise[0]), abs(rise[1])) < 1e-9 and flattest < max(abs(rise[0]), abs(rise[1])) < steepest
    return polygon, rise if fits else None


def _rectangle(u: float, v: float, along: float, across: float) -> shapely.Polygon:
    return shapely.box(u - along / 2, v - across / 2, u + along / 2, v + across / 2)


def _room_for(
    polygon: shapely.Polygon, along: float, across: float, taken: list[shapely.Polygon], random: np.random.Generator
) -> tuple[float, float, shapely.Polygon] | None:
    """One try at a place for a rectangle inside a polygon, away from its border and from what is taken."""
    u0, v0, u1, v1 = polygon.bounds
    if u1 - u0 <= along + 2 * _APART_M or v1 - v0 <= across + 2 * _APART_M:
        return None
    u = round(float(random.uniform(u0 + along / 2, u1 - along / 2)), 2)
    v = round(float(random.uniform(v0 + across / 2, v1 - across / 2)), 2)
    rectangle = _rectangle(u, v, along, across)
    with_border = rectangle.buffer(_APART_M, join_style="mitre")
    if not polygon.contains(with_border) or any(rectangle.distance(one) < 2 * _APART_M for one in taken):
        return None
    return u, v, rectangle
