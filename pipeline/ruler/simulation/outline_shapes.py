"""Single buildings whose outlines must keep their form: round, oblique, bent and trapezoid ones beside ordinary ones.

An id is SHAPE-NUMBER; houses of a row are row-NUMBER-HOUSE and share the block row-NUMBER. Roofs are flat, gabled or,
on regular polygons, tents. Nothing else is in the scene.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from pipeline.ruler.simulation.envelope import Line, Place, RoofPart
from pipeline.ruler.simulation.plots import PlannedRoof, packed_plots
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roof_parts import PARTS, rectangle
from pipeline.ruler.simulation.roofs import RoofShape
from pipeline.ruler.simulation.simulated_scene import Scene, undulating_terrain
from pipeline.ruler.simulation.strips import ScannerSettings
from pipeline.ruler.simulation.sweep import Cell, Row, random_row

OF_EACH = 5
"""Buildings of each shape in a scene."""
BEND_DEG = 15.0
SPACINGS_M = {25.0: 0.2, 2.04: 0.7, 0.444: 1.5}
"""Distance of the pulses at the densities whose outlines are compared."""
SIGMA_PER_M2 = (0.3, 0.7, 1.5, 3.0, 8.0)
"""Densities at which the stated uncertainty of outlines is judged."""
CELLS = tuple(Cell(density_per_m2=density, noise_m=0.03) for density in (*SPACINGS_M, *SIGMA_PER_M2))
SCANNER = ScannerSettings(altitude_m=800.0, strip_spacing_m=150.0)

_MARGIN_M = 4.0
_CIRCLE = 48
"""Corners of a round tower: it turns by less than 10 degrees at each."""

Parts = list[RoofPart]
_FLAT: tuple[Line, ...] = ((0.0, 0.0, 0.0),)


def _part(outline: tuple[Place, ...], planes: tuple[Line, ...] = _FLAT) -> RoofPart:
    return RoofPart(outline=outline, planes=planes, labels=tuple(f"face {k}" for k in range(len(planes))))


def _gable(half_m: float, random: np.random.Generator, turn_deg: float = 0.0) -> tuple[Line, ...]:
    """No slope, or a ridge through the origin that falls over half_m to both sides; it is turned to the left."""
    if random.random() < 0.5:
        return _FLAT
    slope, turn = math.tan(math.radians(random.uniform(15.0, 40.0))), math.radians(turn_deg)
    a, b, c = slope * math.sin(turn), slope * math.cos(turn), slope * half_m
    return (-a, b, c), (a, -b, c)


def _regular(corners: int, random: np.random.Generator) -> Parts:
    """A regular polygon of 3 to 8 m radius, flat or under a tent."""
    radius, angles = float(random.uniform(3.0, 8.0)), 2 * np.pi * np.arange(corners) / corners
    outline = tuple((radius * math.cos(angle), radius * math.sin(angle)) for angle in angles)
    if corners == _CIRCLE or random.random() < 0.5:
        return [_part(outline)]
    slope, reach = math.tan(math.radians(random.uniform(15.0, 40.0))), radius * math.cos(math.pi / corners)
    sides = angles + np.pi / corners
    return [_part(outline, tuple((-slope * math.cos(a), -slope * math.sin(a), slope * reach) for a in sides))]


def _trapezoid(random: np.random.Generator, area_m2: tuple[float, float]) -> Parts:
    """Two parallel sides, the shorter 55 to 85 % of the longer and anywhere above it."""
    share, aspect = float(random.uniform(0.55, 0.85)), float(random.uniform(1.0, 1.9))
    long = math.sqrt(float(random.uniform(*area_m2)) * aspect * 2 / (1 + share))
    u, v, short = long / 2, long / aspect / 2, share * long
    start = float(random.uniform(-u, u - short))
    return [_part(((-u, -v), (u, -v), (start + short, v), (start, v)), _gable(v, random))]


def _oblique_wall(random: np.random.Generator) -> Parts:
    """A rectangle with one end wall 5 to 30 degrees off."""
    u, v = float(random.uniform(4.5, 8.0)), float(random.uniform(3.5, 5.5))
    off = v * math.tan(math.radians(random.uniform(5.0, 30.0)))
    return [_part(((-u, -v), (u - off, -v), (u + off, v), (-u, v)), _gable(v, random))]


def _bend(random: np.random.Generator) -> Parts:
    """Two wings of 9 to 18 m that meet with a bend."""
    half, turn = float(random.uniform(3.5, 5.5)), math.radians(BEND_DEG / 2)
    cos, sin, meet = math.cos(turn), math.sin(turn), half / math.cos(turn)
    right, left = (float(length) for length in random.uniform(9.0, 18.0, 2))
    planes = _gable(half, random, BEND_DEG / 2)
    return [
        _part(((0, -meet), (right * cos + half * sin, right * sin - half * cos),
               (right * cos - half * sin, right * sin + half * cos), (0, meet)), planes),
        _part(((0, -meet), (0, meet), (half * sin - left * cos, left * sin + half * cos),
               (-half * sin - left * cos, left * sin - half * cos)), tuple((-a, b, c) for a, b, c in planes)),
    ]  # fmt: skip


def _small_step(random: np.random.Generator) -> Parts:
    """A rectangle one end of which is 0.5 to 1.5 m narrower on one side, under one roof."""
    u, v = float(random.uniform(5.5, 9.0)), float(random.uniform(3.5, 5.5))
    at, step = float(random.uniform(-0.4, 0.4)) * u, float(random.uniform(0.5, 1.5))
    planes = _gable(v, random)
    return [_part(rectangle(-u, at, -v, v), planes), _part(rectangle(at, u, -v, v - step), planes)]


def _known(shape: RoofShape) -> Callable[[np.random.Generator], Parts]:
    """A parametric shape with its gables, or flat."""

    def parts(random: np.random.Generator) -> Parts:
        size = random_dimensions(shape, random, area_m2=float(random.uniform(*_AREAS_M2[shape])))
        return PARTS[shape](size if random.random() < 0.5 else dataclasses.replace(size, pitch_deg=0.0))

    return parts


_AREAS_M2 = {
    RoofShape.GABLE: (60.0, 160.0),
    RoofShape.L_SHAPE: (90.0, 220.0),
    RoofShape.T_SHAPE: (90.0, 220.0),
    RoofShape.U_SHAPE: (160.0, 320.0),
    RoofShape.COURTYARD: (350.0, 600.0),
}
SHAPES: dict[str, Callable[[np.random.Generator], Parts]] = {
    "round_tower": lambda random: _regular(_CIRCLE, random),
    "hexagon": lambda random: _regular(6, random),
    "octagon": lambda random: _regular(8, random),
    "trapezoid_house": lambda random: _trapezoid(random, (60.0, 160.0)),
    "trapezoid_shed": lambda random: _trapezoid(random, (8.0, 20.0)),
    "oblique_wall": _oblique_wall,
    "bend": _bend,
    "rectangle": _known(RoofShape.GABLE),
    "l_shape": _known(RoofShape.L_SHAPE),
    "t_shape": _known(RoofShape.T_SHAPE),
    "u_shape": _known(RoofShape.U_SHAPE),
    "small_step": _small_step,
    "courtyard": _known(RoofShape.COURTYARD),
}
"""Convex parts of a roof of each shape; rows of houses come on top."""
ROW = "row"


def _planned(shape: str, number: int, random: np.random.Generator) -> PlannedRoof:
    parts, azimuth = SHAPES[shape](random), float(random.uniform(0.0, 360.0))
    eave_m = float(random.uniform(2.3, 3.2) if shape == "trapezoid_shed" else random.uniform(3.0, 9.0))
    return PlannedRoof.over(parts, f"{shape}-{number}", azimuth_deg=azimuth, eave_height_m=eave_m, margin_m=_MARGIN_M)


def outline_shapes(seed: int) -> Scene:
    """Five buildings of each shape, and five rows of houses, on plots of their own on nearly level ground."""
    random = np.random.default_rng([seed, 0x05])
    singles = [_planned(shape, number, random) for shape in SHAPES for number in range(OF_EACH)]
    rows: list[Row] = [random_row(random) for _ in range(OF_EACH)]
    boxes = [one.box for one in singles] + [row.as_one for row in rows]
    plots, extent = packed_plots(boxes, SCANNER.strip_spacing_m, 1)
    terrain = undulating_terrain(40.0, 1.0, float(random.uniform(0, 360)), 0.4, 150.0, random)
    buildings = [one.built(plot, terrain) for one, plot in zip(singles, plots, strict=False)]
    for number, (row, plot) in enumerate(zip(rows, plots[len(singles) :], strict=True)):
        buildings += row.houses(f"{ROW}-{number}", plot.x, plot.y, terrain)
    return Scene(
        name="outline_shapes",
        origin=(571_000.0, 5_940_000.0, 0.0),
        extent=(0.0, 0.0, *extent),
        terrain=terrain,
        buildings=tuple(buildings),
    )
