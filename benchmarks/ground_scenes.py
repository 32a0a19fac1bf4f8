"""Small scenes with exact ground, each with one difficulty, for `benchmarks/ground.py`.

Terrain, buildings and vegetation are formulae in metres; points fall at random places, one last return per pulse. Each
scene is harder than a survey in one respect and simpler in all others, so a figure shows what goes wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.float64]
Mask: TypeAlias = npt.NDArray[np.bool_]
Drawn: TypeAlias = tuple[Floats, Floats, Floats, Mask]
"""x, y, z in metres, and what is ground."""

SIDE_M = 320.0
NOISE_M = 0.05


def _places(random: np.random.Generator, density: float) -> tuple[Floats, Floats]:
    n = round(SIDE_M * SIDE_M * density)
    x, y = random.uniform(0.0, SIDE_M, (2, n))
    return x, y


def _noisy(random: np.random.Generator, x: Floats, y: Floats, z: Floats, ground: Mask) -> Drawn:
    return x, y, z + random.normal(0.0, NOISE_M, len(z)), ground


def _hill(x: Floats, y: Floats, at: tuple[float, float], height: float, radius: float) -> Floats:
    return height * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2.0 * radius * radius))


def _turned(x: Floats, y: Floats, at: tuple[float, float], turn_deg: float) -> tuple[Floats, Floats]:
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    return c * (x - at[0]) + s * (y - at[1]), -s * (x - at[0]) + c * (y - at[1])


def _box(x: Floats, y: Floats, at: tuple[float, float], size: tuple[float, float], turn_deg: float) -> Mask:
    u, v = _turned(x, y, at, turn_deg)
    return (np.abs(u) < size[0] / 2) & (np.abs(v) < size[1] / 2)


def _trees(
    random: np.random.Generator, x: Floats, y: Floats, z: Floats, ground: Mask, cover: float, hidden: float
) -> tuple[Floats, Mask]:
    """Crowns over a share of the ground; of their pulses the given share never reaches it."""
    crowns = round(cover * SIDE_M * SIDE_M / (math.pi * 4.0**2))
    z, ground = z.copy(), ground.copy()
    open_ground = ground.copy()
    for cx, cy, top in zip(*random.uniform(0, SIDE_M, (2, crowns)), random.uniform(6, 20, crowns), strict=True):
        under = ((x - cx) ** 2 + (y - cy) ** 2 < 16.0) & open_ground & ground
        hit = under & (random.random(len(x)) < hidden)
        z[hit] += random.uniform(0.7, top, int(hit.sum()))
        ground[hit] = False
    return z, ground


def _house(
    x: Floats, y: Floats, terrain: Callable[[Floats, Floats], Floats], at: tuple[float, float], turn_deg: float
) -> tuple[Mask, Floats]:
    """A gable house of 9 x 12 m; its eave lies 5 m over the terrain at its middle."""
    inside = _box(x, y, at, (12.0, 9.0), turn_deg)
    _, v = _turned(x, y, at, turn_deg)
    base = float(terrain(np.array([at[0]]), np.array([at[1]]))[0])
    return inside, base + 5.0 + (4.5 - np.abs(v)) * 0.7


def _village(
    random: np.random.Generator, x: Floats, y: Floats, terrain: Callable[[Floats, Floats], Floats], pitch: float
) -> tuple[Floats, Mask]:
    z, ground = terrain(x, y), np.ones(len(x), np.bool_)
    for cx in np.arange(pitch / 2, SIDE_M, pitch):
        for cy in np.arange(pitch / 2, SIDE_M, pitch):
            at = (cx + random.uniform(-4, 4), cy + random.uniform(-4, 4))
            inside, roof = _house(x, y, terrain, at, random.uniform(0, 90))
            z = np.where(inside, np.maximum(roof, z + 2.0), z)
            ground &= ~inside
    return z, ground


def hills_and_halls(random: np.random.Generator, density: float) -> Drawn:
    """Round hills of 18 to 30 m between flat halls of 100 x 100, 100 x 60 and 70 x 45 m."""
    x, y = _places(random, density)
    z = 0.02 * x + _hill(x, y, (70, 250), 25, 28) + _hill(x, y, (250, 60), 18, 22) + _hill(x, y, (240, 270), 30, 40)
    ground = np.ones(len(x), np.bool_)
    halls = (
        ((80.0, 90.0), (100.0, 100.0), 0.0, 9.0),
        ((160.0, 200.0), (100.0, 60.0), 30.0, 8.0),
        ((180.0, 90.0), (70.0, 45.0), 75.0, 7.0),
    )
    for at, size, turn, height in halls:
        inside = _box(x, y, at, size, turn) & ground
        z = np.where(inside, 0.02 * at[0] + _hill(x, y, (70, 250), 25, 28).min() + height, z)
        ground &= ~inside
    return _noisy(random, x, y, z, ground)


def halls_at_the_edge(random: np.random.Generator, density: float) -> Drawn:
    """Halls 80 to 100 m wide of which the data's edge leaves a half, a quarter, a strip of 15 m."""
    x, y = _places(random, density)
    z = 0.03 * x - 0.02 * y + 1.5 * np.sin(x / 40.0)
    ground = np.ones(len(x), np.bool_)
    for at, size, height in (
        ((0.0, 90.0), (100.0, 80.0), 8.0),
        ((SIDE_M, SIDE_M), (100.0, 100.0), 10.0),
        ((190.0, -30.0), (100.0, 90.0), 7.0),
        ((100.0, SIDE_M + 10.0), (80.0, 80.0), 9.0),
    ):
        inside = _box(x, y, at, size, 0.0)
        z = np.where(inside, 0.03 * at[0] - 0.02 * at[1] + 1.5 + height, z)
        ground &= ~inside
    return _noisy(random, x, y, z, ground)


def river_with_bridges(random: np.random.Generator, density: float) -> Drawn:
    """A valley 9 m deep with water of few returns, crossed by decks 10 and 20 m wide that meet the road's level."""
    x, y = _places(random, density)
    away = np.abs(x - 160.0 - 20.0 * np.sin(y / 90.0))
    z = -9.0 * np.clip((45.0 - away) / 20.0, 0.0, 1.0)
    ground = np.ones(len(x), np.bool_)
    for middle, width in ((100.0, 10.0), (230.0, 20.0)):
        deck = (np.abs(y - middle) < width / 2) & (z < -0.5)
        z = np.where(deck, 0.0, z)
        ground &= ~deck
    wet = (away < 22.0) & ground & (random.random(len(x)) < 0.95)
    x, y, z, ground = x[~wet], y[~wet], z[~wet], ground[~wet]
    return _noisy(random, x, y, z, ground)


def houses_on_a_slope(random: np.random.Generator, density: float) -> Drawn:
    """Gable houses and some trees on a slope of 25 deg."""
    x, y = _places(random, density)

    def terrain(px: Floats, py: Floats) -> Floats:
        return math.tan(math.radians(25.0)) * px + 1.5 * np.sin(px / 25.0) * np.cos(py / 30.0)

    z, ground = _village(random, x, y, terrain, 32.0)
    z, ground = _trees(random, x, y, z, ground, 0.15, 0.6)
    return _noisy(random, x, y, z, ground)


def quarry(random: np.random.Generator, density: float) -> Drawn:
    """A pit of three benches: faces of 8 m, as steep as 75 deg, and berms 14 m wide."""
    x, y = _places(random, density)
    away = np.hypot(x - 160.0, 0.8 * (y - 150.0)) + 4.0 * np.sin(np.arctan2(y - 150.0, x - 160.0) * 5.0)
    z = 0.05 * x
    for edge in (60.0, 76.0, 92.0):
        z -= 8.0 * np.clip((edge - away) / 2.1, 0.0, 1.0)
    ground = np.ones(len(x), np.bool_)
    z, ground = _trees(random, x, y, z, ground, 0.04, 0.7)
    return _noisy(random, x, y, z, ground)


def embankments(random: np.random.Generator, density: float) -> Drawn:
    """A road dam of 6 m, a railway dam of 3 m and a cutting of 5 m, with slopes of 1 in 1.5; some houses."""
    x, y = _places(random, density)

    def terrain(px: Floats, py: Floats) -> Floats:
        dam = 6.0 - np.clip((np.abs(px - 80.0 - 0.1 * py) - 7.0) / 1.5, 0.0, 6.0)
        rails = 3.0 - np.clip((np.abs(py - 250.0) - 4.0) / 1.5, 0.0, 3.0)
        cutting = -5.0 + np.clip((np.abs(px - 240.0 + 0.2 * py) - 6.0) / 1.5, 0.0, 5.0)
        return np.maximum(dam, rails) + cutting

    z, ground = terrain(x, y), np.ones(len(x), np.bool_)
    for at in ((150.0, 60.0), (170.0, 90.0), (150.0, 130.0), (20.0, 60.0), (20.0, 120.0), (290.0, 200.0)):
        inside, roof = _house(x, y, terrain, at, 20.0)
        z, ground = np.where(inside, roof, z), ground & ~inside
    return _noisy(random, x, y, z, ground)


def forest_on_a_slope(random: np.random.Generator, density: float) -> Drawn:
    """Crowns over two thirds of a slope of 35 deg with gullies; two thirds of their pulses never reach the ground."""
    x, y = _places(random, density)
    z = math.tan(math.radians(35.0)) * x + 4.0 * np.sin(y / 18.0)
    z, ground = _trees(random, x, y, z, np.ones(len(x), np.bool_), 1.1, 0.66)
    return _noisy(random, x, y, z, ground)


def old_town(random: np.random.Generator, density: float) -> Drawn:
    """Blocks of 40 x 55 m around courtyards of 10 x 12 m, between streets of 7 m, on ground that falls by 4 %."""
    x, y = _places(random, density)
    terrain = 0.04 * x + 1.0 * np.sin(y / 60.0)
    u, v = x % 47.0, y % 62.0
    block = (u < 40.0) & (v < 55.0)
    yard = (np.abs(u - 20.0) < 5.0) & (np.abs(v - 27.0) < 6.0)
    roof = block & ~yard
    eave = 0.04 * (x - u + 20.0) + 10.0 + 3.0 * ((x // 47.0) % 3)
    z = np.where(roof, eave + 0.3 * (10.0 - np.abs(v % 20.0 - 10.0)), terrain)
    return _noisy(random, x, y, z, ~roof)


def low_outliers(random: np.random.Generator, density: float) -> Drawn:
    """A village on soft hills with single points and clumps of five to ten 2 to 15 m below the ground."""
    x, y = _places(random, density)

    def terrain(px: Floats, py: Floats) -> Floats:
        return 4.0 * np.sin(px / 50.0) * np.cos(py / 45.0)

    z, ground = _village(random, x, y, terrain, 30.0)
    low = ground & (random.random(len(x)) < 0.003)
    for cx, cy in random.uniform(20, SIDE_M - 20, (12, 2)):
        near = np.argsort(np.hypot(x - cx, y - cy))[: int(random.integers(5, 11))]
        low[near[np.hypot(x[near] - cx, y[near] - cy) < 1.5]] = True
    low &= ground
    z = np.where(low, z - random.uniform(2.0, 15.0, len(x)), z)
    return _noisy(random, x, y, z, ground & ~low)


def terraces(random: np.random.Generator, density: float) -> Drawn:
    """A vineyard: retaining walls of 2.5 m every 12 m up a slope, and a few huts."""
    x, y = _places(random, density)

    def terrain(px: Floats, py: Floats) -> Floats:
        along = px + 6.0 * np.sin(py / 35.0)
        return 2.5 * np.floor(along / 12.0) + 0.1 * along

    z, ground = terrain(x, y), np.ones(len(x), np.bool_)
    for at in random.uniform(20, SIDE_M - 20, (14, 2)).tolist():
        inside, roof = _house(x, y, terrain, (at[0], at[1]), 0.0)
        z, ground = np.where(inside, np.maximum(roof, z + 2.0), z), ground & ~inside
    return _noisy(random, x, y, z, ground)


def gaps(random: np.random.Generator, density: float) -> Drawn:
    """A village on hills with lakes and strips of up to 40 m without any return."""
    x, y = _places(random, density)

    def terrain(px: Floats, py: Floats) -> Floats:
        return 12.0 * np.sin(px / 45.0) * np.cos(py / 40.0)

    z, ground = _village(random, x, y, terrain, 34.0)
    gone = (np.hypot(x - 90, y - 80) < 30) | (np.abs(x - 200 - 0.3 * y) < 18) | (np.hypot(x - 60, y - 260) < 20)
    return _noisy(random, x[~gone], y[~gone], z[~gone], ground[~gone])


def embankment_with_bridges(random: np.random.Generator, density: float) -> Drawn:
    """A railway dam of 7 m with slopes of 1 in 1.5; roads pass below it under decks, and one crosses it on a bridge."""
    x, y = _places(random, density)
    away = np.abs(y - 160.0 - 10.0 * np.sin(x / 80.0))
    z = 7.0 - np.clip((away - 6.0) / 1.5, 0.0, 7.0)
    ground = np.ones(len(x), np.bool_)
    for middle, width in ((60.0, 12.0), (170.0, 8.0)):
        road = np.abs(x - middle) < width / 2
        deck = road & (away < 6.0)
        z = np.where(road, np.where(deck, 7.0, 0.0), z)
        ground &= ~deck
    # ramps of 1 in 12 lead up to a bridge 6 m over the rails, with walls beside it
    along = np.abs(x - 260.0) < 6.0
    ramp = along & (away >= 14.0)
    z = np.where(ramp, np.maximum(z, 13.0 - (away - 14.0) / 8.0), z)
    over = along & (away < 14.0)
    z = np.where(over, 13.0, z)
    return _noisy(random, x, y, z, ground & ~over)


def deep_cutting(random: np.random.Generator, density: float) -> Drawn:
    """A railway 14 m wide in a cutting 8 m deep, one side a wall and one of 50 deg, crossed by two roads; houses."""
    x, y = _places(random, density)

    def terrain(px: Floats, py: Floats) -> Floats:
        off = px - 160.0 - 25.0 * np.sin(py / 110.0)
        depth = np.where(off < 0.0, np.where(off > -7.0, 8.0, 0.0), np.clip(8.0 - (off - 7.0) * 1.2, 0.0, 8.0))
        return 0.03 * px - depth

    z, ground = terrain(x, y), np.ones(len(x), np.bool_)
    for at in ((60.0, 60.0), (60.0, 100.0), (90.0, 200.0), (250.0, 60.0), (240.0, 250.0), (280.0, 150.0)):
        inside, roof = _house(x, y, terrain, at, 10.0)
        z, ground = np.where(inside, roof, z), ground & ~inside
    for middle in (110.0, 220.0):
        deck = (np.abs(y - middle) < 6.0) & (z < 0.03 * x - 0.5) & ground
        z, ground = np.where(deck, 0.03 * x, z), ground & ~deck
    return _noisy(random, x, y, z, ground)


def vineyard(random: np.random.Generator, density: float) -> Drawn:
    """Terraces 7 m wide with walls of 1.5 m up a slope of 25 deg; vines of 1.6 m stop a third of the pulses in rows."""
    x, y = _places(random, density)
    across = x + 15.0 * np.sin(y / 60.0)
    z = 1.5 * np.floor(across / 7.0) + 0.25 * across
    vine = (across % 2.0 < 0.7) & (random.random(len(x)) < 0.33)
    z = np.where(vine, z + random.uniform(0.8, 1.6, len(x)), z)
    return _noisy(random, x, y, z, ~vine)


def castle_on_a_rock(random: np.random.Generator, density: float) -> Drawn:
    """A rock of 90 x 60 m and 14 m with cliffs of 70 deg and a ramp on one side; on it a keep, a range and a yard."""
    x, y = _places(random, density)
    u, v = _turned(x, y, (160.0, 160.0), 25.0)
    rim = 1.0 - np.hypot(u / 45.0, v / 30.0) + 0.04 * np.sin(7.0 * np.arctan2(v, u))
    rock = np.clip(rim * 30.0 / 0.36, 0.0, 14.0)
    ramp = np.where((np.abs(v) < 5.0) & (u > 0.0), np.clip(14.0 - (u - 40.0) / 5.0, 0.0, 14.0), 0.0)
    z = 0.05 * y + np.maximum(rock, ramp)
    ground = np.ones(len(x), np.bool_)
    for at, size, height in (((-22.0, 0.0), (14.0, 14.0), 18.0), ((5.0, 16.0), (36.0, 9.0), 9.0)):
        inside = (np.abs(u - at[0]) < size[0] / 2) & (np.abs(v - at[1]) < size[1] / 2)
        z, ground = np.where(inside, 0.05 * 160.0 + 14.0 + height, z), ground & ~inside
    z, ground = _trees(random, x, y, z, ground, 0.05, 0.7)
    return _noisy(random, x, y, z, ground)


def dyke(random: np.random.Generator, density: float) -> Drawn:
    """A sea dyke of 8 m with slopes of 1 in 3 and a berm, ditches 1.5 m deep in the polder, farms with barns."""
    x, y = _places(random, density)

    def terrain(px: Floats, py: Floats) -> Floats:
        off = np.abs(py - 90.0 - 15.0 * np.sin(px / 100.0))
        crest = np.clip(8.0 - (off - 3.0) / 3.0, 0.0, 8.0)
        berm = np.where(off < 36.0, np.maximum(crest, 2.0), crest)
        ditch = np.where((px % 40.0 < 3.0) & (py > 150.0), -1.5, 0.0)
        return berm + ditch

    z, ground = terrain(x, y), np.ones(len(x), np.bool_)
    for cx, cy in ((60.0, 200.0), (180.0, 230.0), (260.0, 190.0)):
        inside, roof = _house(x, y, terrain, (cx, cy), 0.0)
        z, ground = np.where(inside, roof, z), ground & ~inside
        barn = _box(x, y, (cx, cy + 35.0), (30.0, 18.0), 0.0)
        z, ground = np.where(barn, 4.0 + 0.35 * (9.0 - np.abs(y - cy - 35.0)), z), ground & ~barn
    return _noisy(random, x, y, z, ground)


def harbour(random: np.random.Generator, density: float) -> Drawn:
    """A quay 3 m above water of few returns, a pier 30 m wide, sheds of 80 x 25 and 60 x 20 m, barges, containers."""
    x, y = _places(random, density)
    pier = (np.abs(x - 200.0) < 15.0) & (y > 60.0)
    land = (y > 170.0) | pier
    z = np.where(land, 3.0, 0.0)
    ground = np.ones(len(x), np.bool_)
    wet = ~land & (random.random(len(x)) < 0.9)
    for at, size, height in (
        ((90.0, 210.0), (80.0, 25.0), 8.0),
        ((250.0, 260.0), (60.0, 20.0), 6.0),
        ((100.0, 270.0), (12.0, 2.5), 2.6),
        ((120.0, 275.0), (12.0, 7.5), 5.2),
        ((203.0, 120.0), (40.0, 12.0), 5.0),
        ((80.0, 160.0), (60.0, 9.0), -0.5),
        ((235.0, 110.0), (9.0, 50.0), 1.0),
    ):
        inside = _box(x, y, at, size, 0.0)
        z, ground, wet = np.where(inside, 3.0 + height, z), ground & ~inside, wet & ~inside
    return _noisy(random, x[~wet], y[~wet], z[~wet], ground[~wet])


KINDS: dict[str, Callable[[np.random.Generator, float], Drawn]] = {
    scene.__name__: scene
    for scene in (
        hills_and_halls, halls_at_the_edge, river_with_bridges, houses_on_a_slope, quarry, embankments,
        forest_on_a_slope, old_town, low_outliers, terraces, gaps, embankment_with_bridges, deep_cutting, vineyard,
        castle_on_a_rock, dyke, harbour,
    )
}  # fmt: skip
"""The scenes by name."""
