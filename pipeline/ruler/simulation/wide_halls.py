"""Wide halls that the edge of the data cuts: the ground around them is seen on two or three sides only."""

from __future__ import annotations

import numpy as np

from pipeline.ruler.simulation.roofs import RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Scene, place_building, undulating_terrain
from pipeline.ruler.simulation.strips import ScannerSettings

SIZE_M = 400.0
HALL_M = (40.0, 90.0)
"""Length and width of a hall."""
HEIGHT_M = (3.5, 9.0)
"""Of the eaves."""
INSIDE = (0.4, 0.95)
"""Share of a hall, across the edge, that lies within the data."""
SCANNER = ScannerSettings(pulse_density_per_m2=4.0, altitude_m=900.0, strip_spacing_m=250.0)


def wide_halls(seed: int) -> Scene:
    """Four halls across the edges of the data and four across its corners, flat or with a low gable; four houses."""
    random = np.random.default_rng([seed, 0x4A])
    terrain = undulating_terrain(55.0, 0.8, float(random.uniform(0, 360)), 1.0, 300.0, random)
    buildings = []
    for number in range(8):
        side, is_corner = number % 4, number >= 4
        across, along = (float(value) for value in random.uniform(*HALL_M, 2))
        # the middle of a hall, counted from the edge inwards and along it
        inwards = (float(random.uniform(*INSIDE)) - 0.5) * across
        beside = (float(random.uniform(*INSIDE)) - 0.5) * along
        place = float(random.uniform(0.45, 0.55)) * SIZE_M
        if is_corner:
            place = SIZE_M - beside if side in {1, 2} else beside
        x, y = ((inwards, place), (place, inwards), (SIZE_M - inwards, place), (place, SIZE_M - inwards))[side]
        is_flat = random.random() < 0.6
        buildings.append(
            place_building(
                f"hall-{number}",
                RoofShape.FLAT if is_flat else RoofShape.GABLE,
                RoofDimensions(length_m=along, width_m=across, pitch_deg=0.0 if is_flat else 8.0),
                at=(x, y),
                azimuth_deg=90.0 * (side % 2) + float(random.uniform(-5.0, 5.0)),
                eave_height_m=float(random.uniform(*HEIGHT_M)),
                terrain=terrain,
            )
        )
    houses = [
        place_building(
            f"house-{k}",
            RoofShape.GABLE,
            RoofDimensions(length_m=12.0, width_m=9.0, pitch_deg=35.0),
            at=(SIZE_M / 2 + 25.0 * (k % 2), SIZE_M / 2 + 25.0 * (k // 2)),
            azimuth_deg=float(random.uniform(0.0, 180.0)),
            eave_height_m=4.0,
            terrain=terrain,
        )
        for k in range(4)
    ]
    return Scene(
        name="wide_halls",
        origin=(570_000.0, 5_939_000.0, 0.0),
        extent=(0.0, 0.0, SIZE_M, SIZE_M),
        terrain=terrain,
        buildings=(*buildings, *houses),
    )
