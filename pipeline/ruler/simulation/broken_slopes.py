"""Single buildings whose slopes break: mansards, kicked eaves, dormers, saw teeth, parapets. The id is FORM-NUMBER.

Every face of a roof is a face of its own here, also where `sweep` counts both parts of a bent side as one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from pipeline.ruler.simulation.envelope import Line, Place, RoofPart
from pipeline.ruler.simulation.plots import scene_of_forms
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roof_parts import PARTS, rectangle
from pipeline.ruler.simulation.roofs import BrokenForm, RoofShape
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.sweep import Cell

DENSITIES_PER_M2 = (2.0, 8.0, 30.0)
NOISES_M = (0.005, 0.02, 0.05)
CELLS = tuple(Cell(density_per_m2=density, noise_m=noise) for density in DENSITIES_PER_M2 for noise in NOISES_M)

_CLEAR_M = 0.4
"""Free roof between a dormer and the eave, the ridge or another dormer."""
_TRIES = 100

Parts = list[RoofPart]


def _drawn(random: np.random.Generator, low: float, high: float) -> float:
    return float(random.uniform(low, high))


def _slope(random: np.random.Generator, low_deg: float, high_deg: float) -> float:
    return math.tan(math.radians(_drawn(random, low_deg, high_deg)))


def _part(outline: tuple[Place, ...], name: str, *planes: Line) -> RoofPart:
    return RoofPart(outline=outline, planes=planes, labels=tuple(f"{name} {k}" for k in range(len(planes))))


def _known(shape: RoofShape) -> Callable[[np.random.Generator], Parts]:
    """A parametric shape of 40 to 240 m2."""
    return lambda random: PARTS[shape](random_dimensions(shape, random, area_m2=_drawn(random, 40.0, 240.0)))


def _bent(shape: RoofShape, lower_deg: tuple[float, float], share: tuple[float, float]) -> Callable[..., Parts]:
    """A mansard or gambrel that is 9 to 30 degrees flatter above the break."""

    def parts(random: np.random.Generator) -> Parts:
        size = random_dimensions(shape, random, area_m2=_drawn(random, 40.0, 240.0))
        lower, turn = _drawn(random, *lower_deg), _drawn(random, 9.0, 30.0)
        at, upper = _drawn(random, *share), lower - turn
        return PARTS[shape](dataclasses.replace(size, pitch_deg=lower, second_pitch_deg=upper, break_share=at))

    return parts


def _sides(u: float, v: float, slope: float, at: float = 0.0, *, hipped: bool) -> tuple[Line, ...]:
    """Planes that rise inwards from the long sides, and from the ends if hipped; their height is `at` at the sides."""
    directions = ((0.0, 1.0, v), (0.0, -1.0, v), (1.0, 0.0, u), (-1.0, 0.0, u))[: 4 if hipped else 2]
    return tuple((slope * a, slope * b, slope * c + at) for a, b, c in directions)


def _kicked(*, hipped: bool) -> Callable[[np.random.Generator], Parts]:
    """A roof of 38 to 52 degrees that is 6 to 20 degrees flatter over the last 0.8 to 2.5 m before its eaves."""

    def parts(random: np.random.Generator) -> Parts:
        v = _drawn(random, 2.2, 5.5)
        u, out = v * _drawn(random, 1.2, 1.9), min(_drawn(random, 0.8, 2.5), 0.6 * v)
        pitch_deg, turn_deg = _drawn(random, 38.0, 52.0), _drawn(random, 6.0, 20.0)
        steep, low = (math.tan(math.radians(deg)) for deg in (pitch_deg, pitch_deg - turn_deg))
        end = u - out if hipped else u
        upper = _sides(end, v - out, steep, low * out, hipped=hipped)
        return [
            _part(rectangle(-u, u, -v, v), "lower", *_sides(u, v, low, hipped=hipped)),
            _part(rectangle(-end, end, out - v, v - out), "upper", *upper),
        ]

    return parts


def _hexagonal_pyramid(random: np.random.Generator) -> Parts:
    radius, slope = _drawn(random, 4.0, 8.0), _slope(random, 20.0, 45.0)
    angles = np.arange(6) * np.pi / 3
    outline = tuple((radius * math.cos(angle), radius * math.sin(angle)) for angle in angles)
    reach = radius * math.cos(math.pi / 6)
    planes = [(-slope * math.cos(a), -slope * math.sin(a), slope * reach) for a in angles + np.pi / 6]
    return [_part(outline, "side", *planes)]


def _sawtooth(random: np.random.Generator) -> Parts:
    """Three to five teeth with vertical or steep backs."""
    teeth, length, v = int(random.integers(3, 6)), _drawn(random, 4.5, 7.0), _drawn(random, 4.5, 8.0)
    rise, back = _slope(random, 18.0, 28.0), _slope(random, 58.0, 68.0)
    is_vertical = random.random() < 0.5
    parts = []
    for k in range(teeth):
        start, end = k * length, (k + 1) * length
        planes = [(rise, 0.0, -rise * start)] + ([] if is_vertical else [(-back, 0.0, back * end)])
        parts.append(_part(rectangle(start, end, -v, v), f"tooth {k}", *planes))
    return parts


def _butterfly(random: np.random.Generator) -> Parts:
    """Two planes that fall to a valley near the middle."""
    u, v, valley = _drawn(random, 5.0, 8.0), _drawn(random, 4.0, 6.5), _drawn(random, -1.0, 1.0)
    right, left = _slope(random, 9.0, 20.0), _slope(random, 9.0, 20.0)
    return [
        _part(rectangle(-u, u, -v, valley), "right", (0.0, -right, right * valley)),
        _part(rectangle(-u, u, valley, v), "left", (0.0, left, -left * valley)),
    ]


def _dormer(form: BrokenForm, middle: float, front: float, sizes: tuple[float, float, float], roof: Line) -> RoofPart:
    """A dormer about `middle` along the ridge with its wall at `front`, of some breadth, height and slope."""
    breadth, height, slope = sizes
    _, steep, at = roof
    eave = steep * front + at + height
    if form is BrokenForm.SHED_DORMERS:
        depth = height / (steep - slope)
        planes: list[Line] = [(0.0, slope, eave - slope * front)]
    else:
        depth = (height + slope * breadth / 2) / steep
        planes = [(side * slope, 0.0, eave + slope * (breadth / 2 - side * middle)) for side in (1.0, -1.0)]
        if form is BrokenForm.HIPPED_DORMERS:
            planes.append((0.0, slope, eave - slope * front))
    half = breadth / 2
    return _part(rectangle(middle - half, middle + half, front, front + depth), f"dormer {middle:.3f}", *planes)


def _dormers(form: BrokenForm) -> Callable[[np.random.Generator], Parts]:
    """A gable with one to three equal dormers of 1.6 to 3.2 m on one side."""

    def parts(random: np.random.Generator) -> Parts:
        u, v, pitch = _drawn(random, 5.5, 8.0), _drawn(random, 4.0, 5.5), _slope(random, 38.0, 50.0)
        sides = _sides(u, v, pitch, hipped=False)
        count = int(random.integers(1, 4))
        room = 2 * u / count
        is_shed = form is BrokenForm.SHED_DORMERS
        for _ in range(_TRIES):
            breadth, height, front = _drawn(random, 1.6, 3.2), _drawn(random, 1.0, 1.5), _drawn(random, 0.4, 1.2) - v
            sizes = breadth, height, _slope(random, 5.0, 15.0) if is_shed else _slope(random, 25.0, 40.0)
            spare = room - breadth - 2 * _CLEAR_M
            middles = [(k + 0.5) * room - u + _drawn(random, -0.5, 0.5) * max(spare, 0.0) for k in range(count)]
            dormers = [_dormer(form, middle, front, sizes, sides[0]) for middle in middles]
            if spare > 0.0 and dormers[0].outline[2][1] < -_CLEAR_M:
                return [_part(rectangle(-u, u, -v, v), "main", *sides), *dormers]
        raise ValueError(f"no {form} on a roof of {2 * u:g} x {2 * v:g} m")

    return parts


def _parapet(random: np.random.Generator) -> Parts:
    """A flat roof within a parapet of 0.3 to 1 m."""
    u, v = _drawn(random, 5.0, 10.0), _drawn(random, 4.0, 8.0)
    thick, top = _drawn(random, 0.25, 0.45), (0.0, 0.0, _drawn(random, 0.3, 1.0))
    strips = ((-u, u, -v, thick - v), (-u, u, v - thick, v), (-u, thick - u, -v, v), (u - thick, u, -v, v))
    walls = [_part(rectangle(*strip), "parapet", top) for strip in strips]
    return [*walls, _part(rectangle(-u, u, -v, v), "roof", (0.0, 0.0, 0.0))]


def _parapet_gable(random: np.random.Generator) -> Parts:
    """A gable whose end walls rise 0.3 to 0.6 m above it."""
    u, v, thick, over = (_drawn(random, *b) for b in ((5.5, 8.0), (4.0, 5.5), (0.25, 0.45), (0.3, 0.6)))
    slope = _slope(random, 30.0, 48.0)
    raised = _sides(u, v, slope, over, hipped=False)
    ends = ((-u, thick - u, "rear"), (u - thick, u, "front"))
    return [
        _part(rectangle(-u, u, -v, v), "main", *_sides(u, v, slope, hipped=False)),
        *(_part(rectangle(u0, u1, -v, v), name, *raised) for u0, u1, name in ends),
    ]


FORMS: dict[BrokenForm, Callable[[np.random.Generator], Parts]] = {
    BrokenForm.MANSARD: _bent(RoofShape.MANSARD, (45.0, 70.0), (0.22, 0.4)),
    BrokenForm.GAMBREL: _bent(RoofShape.GAMBREL, (38.0, 62.0), (0.3, 0.6)),
    BrokenForm.KICKED_HIP: _kicked(hipped=True),
    BrokenForm.KICKED_GABLE: _kicked(hipped=False),
    BrokenForm.JERKINHEAD: _known(RoofShape.HALF_HIP),
    BrokenForm.CROSS_GABLE: _known(RoofShape.CROSS),
    BrokenForm.HEXAGONAL_PYRAMID: _hexagonal_pyramid,
    BrokenForm.SAWTOOTH: _sawtooth,
    BrokenForm.BUTTERFLY: _butterfly,
    **{form: _dormers(form) for form in (BrokenForm.GABLE_DORMERS, BrokenForm.SHED_DORMERS, BrokenForm.HIPPED_DORMERS)},
    BrokenForm.PARAPET: _parapet,
    BrokenForm.PARAPET_GABLE: _parapet_gable,
}
"""Convex parts of a roof of each form."""


def broken_slopes(seed: int) -> Scene:
    """Four buildings of each form on plots of their own on nearly level ground."""
    return scene_of_forms("broken_slopes", FORMS, np.random.default_rng([seed, 0xB5]), 5_941_000.0)
