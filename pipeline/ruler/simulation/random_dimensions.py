"""Plausible sizes of roofs, drawn at random."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np

from pipeline.ruler.simulation.roof_dimensions import FlatPart, RoofDimensions, RoofShape

SHORTEST_SIDE_M = 4.0
"""No roof and, where the area allows, no wing is narrower."""

_NARROWEST_WING_M = 2.5
"""Narrowest wing if the area is too small for wings of 4 m."""
_SHORTEST_RIDGE_M = 0.3
"""Shorter ridges become the point of a pyramid."""
_TRIES = 400
"""Draws before an area counts as too small."""

_AREAS_M2 = {RoofShape.COURTYARD: (300.0, 1200.0), RoofShape.MULTI_LEVEL_FLAT: (120.0, 900.0)}
_PITCHES_DEG = {
    RoofShape.FLAT: (0.0, 0.0),
    RoofShape.PENT: (7.5, 20.0),
    RoofShape.BENT_HIP: (35.0, 45.0),
    RoofShape.MANSARD: (58.0, 70.0),
    RoofShape.GAMBREL: (52.0, 65.0),
    RoofShape.MULTI_LEVEL_FLAT: (0.0, 0.0),
}
_ASPECTS = {
    RoofShape.FLAT: (1.0, 2.0),
    RoofShape.HIP: (1.2, 2.0),
    RoofShape.PYRAMID: (1.0, 1.0),
    RoofShape.L_SHAPE: (1.3, 2.0),
    RoofShape.T_SHAPE: (1.5, 2.3),
    RoofShape.U_SHAPE: (2.3, 3.0),
    RoofShape.CROSS: (1.5, 2.2),
    RoofShape.COURTYARD: (1.0, 1.5),
    RoofShape.MULTI_LEVEL_FLAT: (1.2, 2.5),
}
_WITH_RIDGE = {RoofShape.HIP, RoofShape.HALF_HIP, RoofShape.BENT_HIP, RoofShape.MANSARD}


def random_dimensions(
    shape: RoofShape, random: np.random.Generator, *, area_m2: float | None = None, pitch_deg: float | None = None
) -> RoofDimensions:
    """Draw the size of a roof, in whole centimetres; nothing stands on it.

    Parameters
    ----------
    area_m2 : float, optional
        Footprint, reached within 2 %. By default 60 to 400 m2; more for courtyards and flats of several levels.
    pitch_deg : float, optional
        Pitch of the sloping faces: the upper ones of a bent hip, the lower ones of mansard and gambrel, the right one
        of an unequal gable. By default 25 to 45; pent 7.5 to 20, too steep to be flat; mansard and gambrel steeper.

    Raises
    ------
    ValueError
        The area is too small for the shape with sides of 4 m (wings of compound roofs: 2.5 m).
    """
    low, high = _AREAS_M2.get(shape, (60.0, 400.0))
    drawn_area = float(np.clip(math.sqrt(low * high) * math.exp(0.4 * random.normal()), low, high))
    area = drawn_area if area_m2 is None else area_m2
    low, high = _PITCHES_DEG.get(shape, (25.0, 45.0))
    drawn_pitch = float(random.uniform(low, high))
    pitch = drawn_pitch if pitch_deg is None or shape in {RoofShape.FLAT, RoofShape.MULTI_LEVEL_FLAT} else pitch_deg
    if shape not in _COMPOUND:
        return _simple(shape, area, pitch, random)
    for attempt in range(_TRIES):
        size, footprint = _COMPOUND[shape](float(random.uniform(*_ASPECTS[shape])), random)
        scaled = _scaled(size, math.sqrt(area / footprint))
        narrowest = SHORTEST_SIDE_M if 2 * attempt < _TRIES else _NARROWEST_WING_M
        if scaled.width_m >= SHORTEST_SIDE_M and _narrowest(scaled) >= narrowest:
            return dataclasses.replace(scaled, pitch_deg=pitch)
    raise ValueError(f"area_m2 is {area:g}: too small for a {shape} with sides of {SHORTEST_SIDE_M:g} m")


def _simple(shape: RoofShape, area: float, pitch: float, random: np.random.Generator) -> RoofDimensions:
    """A rectangle of the wanted area."""
    least = SHORTEST_SIDE_M
    if area < least * least * (1 - 1e-9):
        raise ValueError(f"area_m2 is {area:g}: too small for a {shape} with sides of {least:g} m")
    aspect = float(random.uniform(*_ASPECTS.get(shape, (1.1, 1.9))))
    width = max(least, round(math.sqrt(area / aspect), 2))
    length = max(least, round(area / width, 2))
    if shape is RoofShape.PYRAMID or (shape in _WITH_RIDGE and length - width < _SHORTEST_RIDGE_M):
        width = length = max(least, round(math.sqrt(area), 2))
    size = RoofDimensions(length_m=length, width_m=width, pitch_deg=pitch)
    if shape is RoofShape.HALF_HIP:
        return dataclasses.replace(size, break_share=float(random.uniform(0.25, 0.5)))
    if shape is RoofShape.UNEQUAL_GABLE:
        turn = float(random.uniform(5.0, 15.0)) * (1.0 if random.random() < 0.5 else -1.0)
        second = pitch + turn if 10.0 <= pitch + turn <= 60.0 else pitch - turn
        return dataclasses.replace(size, second_pitch_deg=second)
    if shape is RoofShape.BENT_HIP:
        flatter = float(random.uniform(10.0, 18.0))
        return dataclasses.replace(size, second_pitch_deg=max(pitch - flatter, pitch / 2))
    if shape is RoofShape.MANSARD:
        upper = 0.0 if random.random() < 0.4 else float(random.uniform(10.0, 25.0))
        share = float(random.uniform(0.22, 0.32))
        return dataclasses.replace(size, second_pitch_deg=min(upper, pitch / 2), break_share=share)
    if shape is RoofShape.GAMBREL:
        upper, share = float(random.uniform(20.0, 30.0)), float(random.uniform(0.3, 0.45))
        return dataclasses.replace(size, second_pitch_deg=min(upper, pitch / 2), break_share=share)
    return size


def _centimetres(value: float, scale: float) -> float:
    return round(value * scale, 2)


def _scaled(size: RoofDimensions, scale: float) -> RoofDimensions:
    """All lengths in plan times a factor, in whole centimetres (parts of a flat roof: their sides)."""
    levels = []
    for level in size.levels:
        u0, u1 = (_centimetres(level.u_m + side * level.length_m / 2, scale) for side in (-1, 1))
        v0, v1 = (_centimetres(level.v_m + side * level.width_m / 2, scale) for side in (-1, 1))
        levels.append(
            dataclasses.replace(level, u_m=(u0 + u1) / 2, v_m=(v0 + v1) / 2, length_m=u1 - u0, width_m=v1 - v0)
        )
    return dataclasses.replace(
        size,
        length_m=_centimetres(size.length_m, scale),
        width_m=_centimetres(size.width_m, scale),
        wing_length_m=_centimetres(size.wing_length_m, scale),
        wing_width_m=_centimetres(size.wing_width_m, scale),
        wing_offset_m=_centimetres(size.wing_offset_m, scale),
        second_wing_length_m=_centimetres(size.second_wing_length_m, scale),
        levels=tuple(levels),
    )


def _narrowest(size: RoofDimensions) -> float:
    """Width of the narrowest wing or part."""
    return min((min(level.length_m, level.width_m) for level in size.levels), default=size.wing_width_m)


def _equal_or_narrower(low: float, high: float, equal: float, random: np.random.Generator) -> float:
    """A wing's share of the main width: as wide with the chance `equal`, else clearly narrower."""
    share = float(random.uniform(low, high))
    return 1.0 if random.random() < equal else share


def _l_or_t_shape(aspect: float, random: np.random.Generator, *, at_the_end: bool) -> tuple[RoofDimensions, float]:
    wing = _equal_or_narrower(0.65, 0.92, 0.0 if at_the_end else 0.2, random)
    out = aspect * float(random.uniform(0.35, 0.6))
    room = 0.0 if at_the_end else aspect / 2 - wing / 2 - 0.08
    offset = float(random.uniform(-0.5, 0.5)) * room
    size = RoofDimensions(length_m=aspect, width_m=1.0, wing_length_m=out, wing_width_m=wing, wing_offset_m=offset)
    return size, aspect + out * wing


def _u_shape(aspect: float, random: np.random.Generator) -> tuple[RoofDimensions, float]:
    wing = _equal_or_narrower(0.7, 0.92, 0.2, random)
    out, second = (float(length) for length in random.uniform(0.4, 1.0, 2))
    if random.random() < 0.5:
        second = out
    size = RoofDimensions(
        length_m=aspect, width_m=1.0, wing_length_m=out, wing_width_m=wing, second_wing_length_m=second
    )
    return size, aspect + (out + second) * wing


def _cross(aspect: float, random: np.random.Generator) -> tuple[RoofDimensions, float]:
    wing = _equal_or_narrower(0.65, 0.92, 0.3, random)
    out, offset = float(random.uniform(0.3, 0.7)), float(random.uniform(-0.4, 0.4)) * (aspect / 2 - wing / 2 - 0.08)
    size = RoofDimensions(length_m=aspect, width_m=1.0, wing_length_m=out, wing_width_m=wing, wing_offset_m=offset)
    return size, aspect + 2 * out * wing


def _courtyard(aspect: float, random: np.random.Generator) -> tuple[RoofDimensions, float]:
    wing = float(random.uniform(0.25, 0.36))
    size = RoofDimensions(length_m=aspect, width_m=1.0, wing_width_m=wing)
    return size, aspect - (aspect - 2 * wing) * (1.0 - 2 * wing)


def _multi_level_flat(aspect: float, random: np.random.Generator) -> tuple[RoofDimensions, float]:
    """Two or three parts along u; one of them may be parted again along v, and an end may be narrower.

    Parts meet in T-junctions only, and no two have one level.
    """
    columns = int(random.integers(2, 4))
    shares = random.uniform(0.7, 1.3, columns)
    edges = np.concatenate([[0.0], np.cumsum(shares / shares.sum())]) * aspect - aspect / 2
    parted = int(random.integers(columns)) if random.random() < 0.5 else -1
    narrower = int(random.choice([0, columns - 1])) if random.random() < 0.6 else -1
    bounds: list[tuple[float, float, float, float]] = []
    for k in range(columns):
        u0, u1 = float(edges[k]), float(edges[k + 1])
        if k == parted:
            cut = float(random.uniform(-0.08, 0.08))
            bounds += [(u0, u1, -0.5, cut), (u0, u1, cut, 0.5)]
        elif k == narrower:
            bounds.append((u0, u1, -0.5, 0.5 - float(random.uniform(0.15, 0.35))))
        else:
            bounds.append((u0, u1, -0.5, 0.5))
    heights = np.concatenate([[0.0], np.cumsum(random.uniform(1.2, 3.5, len(bounds) - 1))])
    heights = np.round(random.permutation(heights), 2)
    levels = tuple(
        FlatPart(u_m=(u0 + u1) / 2, v_m=(v0 + v1) / 2, length_m=u1 - u0, width_m=v1 - v0, height_m=float(height))
        for (u0, u1, v0, v1), height in zip(bounds, heights, strict=True)
    )
    area = sum(level.length_m * level.width_m for level in levels)
    return RoofDimensions(length_m=aspect, width_m=1.0, levels=levels), area


_COMPOUND: dict[RoofShape, Callable[[float, np.random.Generator], tuple[RoofDimensions, float]]] = {
    RoofShape.L_SHAPE: functools.partial(_l_or_t_shape, at_the_end=True),
    RoofShape.T_SHAPE: functools.partial(_l_or_t_shape, at_the_end=False),
    RoofShape.U_SHAPE: _u_shape,
    RoofShape.CROSS: _cross,
    RoofShape.COURTYARD: _courtyard,
    RoofShape.MULTI_LEVEL_FLAT: _multi_level_flat,
}
"""Functions from an aspect to the proportions of a compound shape of width 1 and their area."""
