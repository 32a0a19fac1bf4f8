"""Single buildings under curved roofs: barrels, cones, domes and caps. The id is FORM-NUMBER.

The surfaces are planes that touch them, near enough that their edges are far below the noise of a survey.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pipeline.ruler.simulation.envelope import Line, Place, RoofPart
from pipeline.ruler.simulation.plots import scene_of_forms
from pipeline.ruler.simulation.roof_dimensions import CurvedForm
from pipeline.ruler.simulation.roof_parts import rectangle
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.sweep import Cell

CELLS = tuple(
    Cell(density_per_m2=density, noise_m=noise) for density in (2.0, 8.0, 30.0) for noise in (0.01, 0.02, 0.05)
)

_SECTORS, _RINGS, _STRIPS = 36, 9, 40
_STEEPEST_DEG = 80.0
"""Slope of the lowest planes of a half circle."""


def _drawn(random: np.random.Generator, low: float, high: float) -> float:
    return float(random.uniform(low, high))


def _part(outline: tuple[Place, ...], planes: list[Line]) -> list[RoofPart]:
    return [RoofPart(outline=outline, planes=tuple(planes), labels=tuple(f"curve {k}" for k in range(len(planes))))]


def _round(radius: float, sides: int = 2 * _SECTORS) -> tuple[Place, ...]:
    return tuple(
        (radius * math.cos(2 * math.pi * k / sides), radius * math.sin(2 * math.pi * k / sides)) for k in range(sides)
    )


def _tangents(radius: float, most_deg: float, count: int, stretch: float = 1.0) -> list[tuple[float, float]]:
    """Fall and height over the middle of lines that touch an arc with its crown over the middle, at equal turns.

    The arc turns by `most_deg` to each side and is `stretch` times as high as a circle's.
    """
    turns = np.radians(np.linspace(0.0, most_deg, count))
    base = radius * math.cos(turns[-1])
    return [(stretch * math.tan(turn), stretch * (radius / math.cos(turn) - base)) for turn in turns.tolist()]


def _barrel(half_deg: tuple[float, float], stretch: tuple[float, float] = (1.0, 1.0)) -> Callable[..., list[RoofPart]]:
    """A vault 6 to 14 m wide that turns by so many degrees from its crown to each eave."""

    def parts(random: np.random.Generator) -> list[RoofPart]:
        v, turn_deg, high = _drawn(random, 3.0, 7.0), _drawn(random, *half_deg), _drawn(random, *stretch)
        u = v * _drawn(random, 0.8, 2.2)
        radius = v / math.sin(math.radians(turn_deg))
        arc = _tangents(radius, min(turn_deg, _STEEPEST_DEG), _STRIPS // 2, high)
        planes = [(0.0, side * fall, at) for fall, at in arc for side in ((1.0, -1.0) if fall > 0.0 else (1.0,))]
        return _part(rectangle(-u, u, -v, v), planes)

    return parts


def _cone(random: np.random.Generator) -> list[RoofPart]:
    """A cone of 20 to 55 degrees."""
    radius, slope = _drawn(random, 3.0, 8.0), math.tan(math.radians(_drawn(random, 20.0, 55.0)))
    angles = [2 * math.pi * (k + 0.5) / (2 * _SECTORS) for k in range(2 * _SECTORS)]
    planes = [(-slope * math.cos(a), -slope * math.sin(a), slope * radius) for a in angles]
    return _part(_round(radius), planes)


def _sphere(radius: float, most_deg: float) -> list[Line]:
    """Planes that touch a sphere, from its crown down to a slope."""
    (_, top), *rings = _tangents(radius, most_deg, _RINGS + 1)
    angles = [2 * math.pi * (k + 0.5) / _SECTORS for k in range(_SECTORS)]
    return [(0.0, 0.0, top), *((-fall * math.cos(a), -fall * math.sin(a), at) for fall, at in rings for a in angles)]


def _dome(random: np.random.Generator) -> list[RoofPart]:
    """Half a sphere or nearly."""
    radius = _drawn(random, 3.5, 8.0)
    turn_deg = _drawn(random, 65.0, 90.0)
    return _part(_round(radius * math.sin(math.radians(turn_deg))), _sphere(radius, min(turn_deg, _STEEPEST_DEG)))


def _cap(random: np.random.Generator) -> list[RoofPart]:
    """A flat part of a sphere over a round plan."""
    reach, turn_deg = _drawn(random, 4.0, 9.0), _drawn(random, 25.0, 50.0)
    return _part(_round(reach), _sphere(reach / math.sin(math.radians(turn_deg)), turn_deg))


def _square_cap(random: np.random.Generator) -> list[RoofPart]:
    """A part of a sphere over a rectangle."""
    u = _drawn(random, 4.0, 7.0)
    v, turn_deg = u * _drawn(random, 0.75, 1.0), _drawn(random, 28.0, 50.0)
    return _part(rectangle(-u, u, -v, v), _sphere(math.hypot(u, v) / math.sin(math.radians(turn_deg)), turn_deg))


FORMS: dict[CurvedForm, Callable[[np.random.Generator], list[RoofPart]]] = {
    CurvedForm.SHALLOW_BARREL: _barrel((25.0, 45.0)),
    CurvedForm.BARREL: _barrel((45.0, 70.0)),
    CurvedForm.HALF_BARREL: _barrel((90.0, 90.0)),
    CurvedForm.ELLIPTIC_BARREL: _barrel((60.0, 80.0), (0.6, 1.4)),
    CurvedForm.CONE: _cone,
    CurvedForm.DOME: _dome,
    CurvedForm.CAP: _cap,
    CurvedForm.SQUARE_CAP: _square_cap,
}
"""Convex parts of a roof of each form."""


def curved_roofs(seed: int) -> Scene:
    """Four buildings of each form on plots of their own on nearly level ground."""
    return scene_of_forms("curved_roofs", FORMS, np.random.default_rng([seed, 0xC5]), 5_942_000.0)
