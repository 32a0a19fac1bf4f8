"""Every shape as convex parts, the input of `envelope`."""

from __future__ import annotations

import math
from collections.abc import Callable

from pipeline.ruler.simulation.envelope import Line, Place, RoofPart
from pipeline.ruler.simulation.roof_dimensions import RoofDimensions, RoofShape

_SIDES = ("right", "left", "rear", "front")


def _slope(pitch_deg: float) -> float:
    return math.tan(math.radians(pitch_deg))


def rectangle(u0: float, u1: float, v0: float, v1: float) -> tuple[Place, ...]:
    """A rectangle with sides along u and v, counter-clockwise."""
    return (u0, v0), (u1, v0), (u1, v1), (u0, v1)


def _main(size: RoofDimensions) -> tuple[Place, ...]:
    u, v = size.length_m / 2, size.width_m / 2
    return rectangle(-u, u, -v, v)


def _rising(u: float, v: float, slopes: tuple[float, ...], at: float = 0.0) -> tuple[Line, ...]:
    """Planes that rise inwards from the sides v = -v, v = v, u = -u, u = u, where they have the height `at`."""
    directions = ((0.0, 1.0, v), (0.0, -1.0, v), (1.0, 0.0, u), (-1.0, 0.0, u))
    return tuple((s * a, s * b, s * c + at) for s, (a, b, c) in zip(slopes, directions, strict=False))


def _one(size: RoofDimensions, planes: tuple[Line, ...], labels: tuple[str, ...] | None = None) -> list[RoofPart]:
    """One part over the main rectangle."""
    names = labels or tuple(f"main {k}" for k in range(len(planes)))
    return [RoofPart(outline=_main(size), planes=planes, labels=names)]


def _flat(size: RoofDimensions) -> list[RoofPart]:
    return _one(size, ((0.0, 0.0, 0.0),))


def _pent(size: RoofDimensions) -> list[RoofPart]:
    return _one(size, _rising(0.0, size.width_m / 2, (_slope(size.pitch_deg),)))


def _gable(size: RoofDimensions) -> list[RoofPart]:
    slope = _slope(size.pitch_deg)
    return _one(size, _rising(0.0, size.width_m / 2, (slope, slope)))


def _hip(size: RoofDimensions) -> list[RoofPart]:
    return _one(size, _rising(size.length_m / 2, size.width_m / 2, (_slope(size.pitch_deg),) * 4))


def _half_hip(size: RoofDimensions) -> list[RoofPart]:
    """A gable with clipped ends: the hips begin part of the way up the end walls."""
    slope, u, v = _slope(size.pitch_deg), size.length_m / 2, size.width_m / 2
    if not 0 < size.break_share < 1 or size.break_share * v >= u:
        raise ValueError(
            f"hips over {size.break_share:g} of the rise do not fit a roof of {size.length_m:g} x {size.width_m:g} m:"
            " break_share must be between 0 and 1 and leave a ridge"
        )
    begin = (1 - size.break_share) * v * slope
    return _one(size, _rising(u, v, (slope, slope)) + _rising(u, v, (slope,) * 4, begin)[2:])


def _pyramid(size: RoofDimensions) -> list[RoofPart]:
    """Four faces that meet in one point over the middle."""
    slope = _slope(size.pitch_deg)
    end = slope * size.width_m / size.length_m
    return _one(size, _rising(size.length_m / 2, size.width_m / 2, (slope, slope, end, end)))


def _unequal_gable(size: RoofDimensions) -> list[RoofPart]:
    """Two pitches, one eave height: the ridge is off the middle, nearer to the steeper side."""
    return _one(size, _rising(0.0, size.width_m / 2, (_slope(size.pitch_deg), _slope(size.second_pitch_deg))))


def _break_m(size: RoofDimensions, *, lower_is_steeper: bool) -> float:
    """Distance from the eave to where the slope changes."""
    lower, upper = size.pitch_deg, size.second_pitch_deg
    if not lower_is_steeper:
        lower, upper = upper, lower
    if not 0 < size.break_share < 1 or (lower > upper) != lower_is_steeper:
        raise ValueError(
            f"a roof with {lower:g} deg below and {upper:g} deg above {size.break_share:g} of the way to the middle"
            f" has no such break: the lower part must be {'steeper' if lower_is_steeper else 'flatter'}"
        )
    return size.break_share * size.width_m / 2


def _bent_hip(size: RoofDimensions) -> list[RoofPart]:
    """A hip whose lower part is flatter. The parts of a side are two faces, but one group."""
    u, v = size.length_m / 2, size.width_m / 2
    out, lower = _break_m(size, lower_is_steeper=False), _slope(size.second_pitch_deg)
    upper = _rising(u - out, v - out, (_slope(size.pitch_deg),) * 4, out * lower)
    inner = RoofPart(outline=rectangle(out - u, u - out, out - v, v - out), planes=upper, labels=_SIDES)
    return [*_one(size, _rising(u, v, (lower,) * 4), _SIDES), inner]


def _mansard(size: RoofDimensions) -> list[RoofPart]:
    """Steep faces on all sides, above them a flat top or a low hip."""
    u, v = size.length_m / 2, size.width_m / 2
    out, steep = _break_m(size, lower_is_steeper=True), _slope(size.pitch_deg)
    upper: tuple[Line, ...] = ((0.0, 0.0, out * steep),)
    if size.second_pitch_deg > 0:
        upper = _rising(u - out, v - out, (_slope(size.second_pitch_deg),) * 4, out * steep)
    return _one(size, _rising(u, v, (steep,) * 4) + upper)


def _gambrel(size: RoofDimensions) -> list[RoofPart]:
    """Two pitches on each side of the ridge."""
    v = size.width_m / 2
    out, steep, low = _break_m(size, lower_is_steeper=True), _slope(size.pitch_deg), _slope(size.second_pitch_deg)
    return _one(size, _rising(0.0, v, (steep, steep)) + _rising(0.0, v - out, (low, low), out * steep))


def _wing(size: RoofDimensions, middle: float, v0: float, v1: float, name: str) -> RoofPart:
    """A gable across the main ridge."""
    half, slope = size.wing_width_m / 2, _slope(size.pitch_deg)
    planes = ((slope, 0.0, slope * (half - middle)), (-slope, 0.0, slope * (half + middle)))
    outline = rectangle(middle - half, middle + half, v0, v1)
    return RoofPart(outline=outline, planes=planes, labels=(f"{name} rear", f"{name} front"))


def _require_wing(size: RoofDimensions, *, middle: float, out: float, equal: bool = True) -> None:
    wing = size.wing_width_m
    widest = size.width_m if equal else math.nextafter(size.width_m, 0.0)
    if not (0 < wing <= widest and out > 0 and abs(middle) + wing / 2 <= size.length_m / 2 * (1 + 1e-12)):
        raise ValueError(f"a wing {wing:g} m wide and {out:g} m long does not fit {size.length_m:g} x {size.width_m:g}")


def _l_shape(size: RoofDimensions) -> list[RoofPart]:
    middle = size.length_m / 2 - size.wing_width_m / 2
    _require_wing(size, middle=middle, out=size.wing_length_m, equal=False)
    return [*_gable(size), _wing(size, middle, 0.0, size.width_m / 2 + size.wing_length_m, "wing")]


def _t_shape(size: RoofDimensions) -> list[RoofPart]:
    """A gable with a wing on the left side, anywhere along the ridge."""
    _require_wing(size, middle=size.wing_offset_m, out=size.wing_length_m)
    return [*_gable(size), _wing(size, size.wing_offset_m, 0.0, size.width_m / 2 + size.wing_length_m, "wing")]


def _u_shape(size: RoofDimensions) -> list[RoofPart]:
    """A gable with wings on the left side at both ends."""
    middle = size.length_m / 2 - size.wing_width_m / 2
    second = size.second_wing_length_m or size.wing_length_m
    _require_wing(size, middle=middle, out=min(size.wing_length_m, second))
    if 2 * size.wing_width_m >= size.length_m:
        raise ValueError(f"two wings of {size.wing_width_m:g} m fill a side of {size.length_m:g} m: no court is left")
    reach = size.width_m / 2
    return [
        *_gable(size),
        _wing(size, middle, 0.0, reach + size.wing_length_m, "front wing"),
        _wing(size, -middle, 0.0, reach + second, "rear wing"),
    ]


def _cross(size: RoofDimensions) -> list[RoofPart]:
    """Two crossing gables of one eave."""
    _require_wing(size, middle=size.wing_offset_m, out=size.wing_length_m)
    reach = size.width_m / 2 + size.wing_length_m
    return [*_gable(size), _wing(size, size.wing_offset_m, -reach, reach, "wing")]


def _courtyard(size: RoofDimensions) -> list[RoofPart]:
    """A closed ring of four gabled wings around a court: hips at the outer corners, valleys at the inner ones."""
    u, v, wing, slope = size.length_m / 2, size.width_m / 2, size.wing_width_m, _slope(size.pitch_deg)
    if not 0 < wing < min(u, v):
        raise ValueError(f"four wings {wing:g} m wide leave no court in {size.length_m:g} x {size.width_m:g} m")
    outer = _rising(u, v, (slope,) * 4)
    inner = _rising(u - wing, v - wing, (-slope,) * 4)
    outlines = (
        rectangle(-u, u, -v, wing - v),
        rectangle(-u, u, v - wing, v),
        rectangle(-u, wing - u, -v, v),
        rectangle(u - wing, u, -v, v),
    )
    parts = []
    for k, outline in enumerate(outlines):
        own = [k, *(n for n in range(4) if n // 2 != k // 2)]
        planes = (*(outer[n] for n in own), inner[k])
        labels = (*(f"outer {_SIDES[n]}" for n in own), f"inner {_SIDES[k]}")
        parts.append(RoofPart(outline=outline, planes=planes, labels=labels))
    return parts


def _multi_level_flat(size: RoofDimensions) -> list[RoofPart]:
    """Flat parts of several levels that touch."""
    if len(size.levels) < 2 or min(level.height_m for level in size.levels) < 0:
        raise ValueError("a flat roof of several levels needs two or more of them, none under the eave (below 0)")
    return [
        RoofPart(
            outline=rectangle(
                level.u_m - level.length_m / 2,
                level.u_m + level.length_m / 2,
                level.v_m - level.width_m / 2,
                level.v_m + level.width_m / 2,
            ),
            planes=((0.0, 0.0, level.height_m),),
            labels=(f"level {k}",),
        )
        for k, level in enumerate(size.levels)
    ]


PARTS: dict[RoofShape, Callable[[RoofDimensions], list[RoofPart]]] = {
    RoofShape.FLAT: _flat,
    RoofShape.PENT: _pent,
    RoofShape.GABLE: _gable,
    RoofShape.HIP: _hip,
    RoofShape.L_SHAPE: _l_shape,
    RoofShape.HALF_HIP: _half_hip,
    RoofShape.BENT_HIP: _bent_hip,
    RoofShape.PYRAMID: _pyramid,
    RoofShape.UNEQUAL_GABLE: _unequal_gable,
    RoofShape.MANSARD: _mansard,
    RoofShape.GAMBREL: _gambrel,
    RoofShape.T_SHAPE: _t_shape,
    RoofShape.U_SHAPE: _u_shape,
    RoofShape.CROSS: _cross,
    RoofShape.COURTYARD: _courtyard,
    RoofShape.MULTI_LEVEL_FLAT: _multi_level_flat,
}
"""The function of every shape; its additions are not included."""
