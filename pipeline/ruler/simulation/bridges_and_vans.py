"""Bridges over cuttings and vehicles at the kerb, without a single building: flat tops that look like roofs.

The ground is a series of cuttings that run north. Bridges cross them, level with the ground at both ends. Vans, trucks
and containers stand along two kerbs on the crests between the cuttings, some bumper to bumper. Decks are closed to the
ground, so no pulse reaches what lies beneath them.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.ruler.simulation.simulated_scene import Box, Scene, Terrain, turned
from pipeline.ruler.simulation.strips import ScannerSettings

BRIDGES = 15
"""The first boxes of the scene; two in five are footbridges."""
FOOTBRIDGE_M, ROAD_BRIDGE_M = (2.0, 4.0), (6.0, 14.0)
"""Widths."""
VAN_LENGTH_M, VAN_WIDTH_M, VAN_HEIGHT_M = (5.0, 8.0), (1.9, 2.4), (2.0, 3.5)
"""Of all vehicles."""
SCANNER = ScannerSettings(pulse_density_per_m2=8.0, altitude_m=900.0, strip_spacing_m=120.0)

_CUTTINGS, _CUTTING_M = 3, 48.0
"""Cuttings, and the distance from crest to crest."""
_DEPTH_M = (3.6, 4.8)
_ABUTMENT_M = 6.0
"""From the crest to the end of a bridge."""
_APART_M = 40.0
_KERB_M = 3.5
_GAP_M = (0.4, 8.0)


def bridges_and_vans(seed: int) -> Scene:
    """Fifteen bridges, then the vehicles."""
    random = np.random.default_rng([seed, 0xB7])
    length = _APART_M * BRIDGES / _CUTTINGS
    waves = np.array([(float(random.uniform(*_DEPTH_M)) / 2, 2.0 * math.pi / _CUTTING_M, 0.0, math.pi / 2)])
    terrain = Terrain(base_z_m=30.0, slope_y=float(random.uniform(-0.02, 0.02)), waves=waves)
    bridges = [_bridge(number, terrain, random) for number in range(BRIDGES)]
    vans = []
    for crest in range(_CUTTINGS + 1):
        for side in (-1.0, 1.0):
            y = float(random.uniform(*_GAP_M))
            while (end := y + float(random.uniform(*VAN_LENGTH_M))) < length:
                vans.append(_van(crest * _CUTTING_M + side * _KERB_M, (y, end), terrain, random))
                y = end + float(random.uniform(*_GAP_M))
    return Scene(
        name="bridges_and_vans",
        origin=(569_000.0, 5_938_000.0, 0.0),
        extent=(-_CUTTING_M / 4, 0.0, _CUTTING_M * (_CUTTINGS + 0.25), length),
        terrain=terrain,
        boxes=(*bridges, *vans),
    )


def _bridge(number: int, terrain: Terrain, random: np.random.Generator) -> Box:
    """A deck across a cutting."""
    cutting, place = number % _CUTTINGS, number // _CUTTINGS
    width = float(random.uniform(*(FOOTBRIDGE_M if number % 5 < 2 else ROAD_BRIDGE_M)))
    x, y = _CUTTING_M * (cutting + 0.5), _APART_M * (place + 0.5)
    u, v = _CUTTING_M / 2 - _ABUTMENT_M, width / 2
    local = np.array([(-u, -v), (u, -v), (u, v), (-u, v)])
    ground = terrain.elevation(np.array([x - u, x + u]), np.array([y, y]))
    return Box(corners=turned(local, x, y, 90.0 + float(random.uniform(-8.0, 8.0))), top_z_m=float(ground.mean()))


def _van(x: float, ends: tuple[float, float], terrain: Terrain, random: np.random.Generator) -> Box:
    """A vehicle that stands from one northing to another."""
    middle, half = (ends[0] + ends[1]) / 2, float(random.uniform(*VAN_WIDTH_M)) / 2
    corners = np.array([(x - half, ends[0]), (x + half, ends[0]), (x + half, ends[1]), (x - half, ends[1])])
    ground = terrain.at(x, middle)
    return Box(corners=corners, top_z_m=ground + float(random.uniform(*VAN_HEIGHT_M)))
