"""A small town of points with known truth: rolling terrain, a gable house, a flat block of two levels, and trees."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.model import BoolArray, ByteArray, FloatArray
from pipeline.scene import WindowPoints

GROUND, BUILDING, TREE = 2, 6, 5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Town:
    """Points and what each of them lies on."""

    points: WindowPoints
    """Classes are the truth's."""
    truth: ByteArray
    """(n,) uint8, 2 ground, 5 tree, 6 building."""
    house: BoolArray
    """(n,) the gable house."""


def terrain_m(x: FloatArray, y: FloatArray) -> FloatArray:
    return 0.03 * x - 0.02 * y + 0.5 * np.sin(x / 30.0) * np.cos(y / 25.0)


HOUSE = (40.0, 44.0, 52.0, 52.0)
BLOCK = (66.0, 20.0, 90.0, 36.0)
TOWER = (72.0, 24.0, 80.0, 32.0)
TREES = ((20.0, 20.0), (24.0, 60.0), (60.0, 70.0), (64.0, 72.0), (36.0, 24.0), (101.0, 62.0))


def _inside(x: FloatArray, y: FloatArray, box: tuple[float, float, float, float]) -> BoolArray:
    mask: BoolArray = (x >= box[0]) & (x < box[2]) & (y >= box[1]) & (y < box[3])
    return mask


def roofs_m(x: FloatArray, y: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Elevation of the roofs (or of the terrain), and the mask of the buildings."""
    z = terrain_m(x, y)
    base = float(terrain_m(np.array([46.0]), np.array([48.0]))[0])
    house = _inside(x, y, HOUSE)
    z = np.where(house, base + 6.5 - math.tan(math.radians(35.0)) * np.abs(y - 48.0), z)
    block = _inside(x, y, BLOCK)
    z = np.where(block, 9.0, z)
    z = np.where(_inside(x, y, TOWER), 15.0, z)
    return z, house | block


def make_town(*, seed: int = 0, side_m: float = 110.0, per_m2: float = 5.0, noise_m: float = 0.02) -> Town:
    """Pulses straight from above; a crown returns once or twice, and half of its pulses reach the ground."""
    random = np.random.default_rng(seed)
    n = round(side_m * side_m * per_m2)
    x, y = random.uniform(0, side_m - 0.001, (2, n))
    z, building = roofs_m(x, y)
    truth = np.where(building, BUILDING, GROUND)
    ones = np.ones(n, np.int64)
    parts: list[list[npt.NDArray[np.float64]]] = []
    crown = np.zeros(n, np.bool_)
    reaches = random.random(n) < 0.5
    for tx, ty in TREES:
        over = ((x - tx) / 3.5) ** 2 + ((y - ty) / 3.5) ** 2
        under = (over < 1) & ~building & ~crown
        crown |= under
        depth = 3.5 * np.sqrt(1 - over[under])
        top = terrain_m(x[under], y[under]) + 7.0 + depth * random.uniform(-0.9, 1.0, under.sum())
        parts.append([x[under], y[under], top, reaches[under] + 1.0])
    # where a pulse reaches the ground, its crown return is the first of two; else the crown is all there is
    keep = ~crown | reaches
    tree = np.concatenate([np.array(p) for p in parts], axis=1)
    xyz = np.column_stack((np.append(x[keep], tree[0]), np.append(y[keep], tree[1]), np.append(z[keep], tree[2])))
    xyz[:, 2] += random.normal(0, noise_m, len(xyz))
    count = np.append(np.where(crown, 2, ones)[keep], tree[3].astype(np.int64))
    number = np.append(np.where(crown, 2, ones)[keep], np.ones(tree.shape[1], np.int64))
    truth = np.append(truth[keep], np.full(tree.shape[1], TREE)).astype(np.uint8)
    x_mm, y_mm, z_mm = np.rint(1000 * xyz).astype(np.int64).T.copy()
    points = WindowPoints(
        x_mm=x_mm,
        y_mm=y_mm,
        z_mm=z_mm,
        return_number=number.astype(np.uint8),
        return_count=count.astype(np.uint8),
        classification=truth,
    )
    return Town(points=points, truth=truth, house=_inside(xyz[:, 0], xyz[:, 1], HOUSE) & (truth == BUILDING))


@pytest.fixture(scope="session")
def town() -> Town:
    """The town of 110 m by 110 m with its corner at the origin."""
    return make_town()


@pytest.fixture(scope="session")
def town_of() -> Callable[..., Town]:
    """`town_of(seed=, side_m=, per_m2=, noise_m=)`."""
    return make_town
