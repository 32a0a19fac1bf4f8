"""The order in which a tile's points are stored."""

import numpy as np
import pytest

from pipeline.runtime.stages.split import _order_by_owner


def points(n: int, side_mm: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    x, y = 84_000_000 + random.integers(0, side_mm, n), 447_000_000 + random.integers(0, side_mm, n)
    return x, y, random.integers(-5, 5, n)


@pytest.mark.parametrize(
    ("side_mm", "owners"),
    [(40, 3), (250_000, 200), (2**20, 7), (2**20 + 2_000_000, 7), (1000, 2**24)],
    ids=["ties", "tile", "widest", "too-wide", "too-many-owners"],
)
def test_points_come_by_owner_then_by_place(side_mm: int, owners: int) -> None:
    x, y, z = points(3_000, side_mm, 1)
    owner = np.random.default_rng(2).integers(0, owners, len(x))
    order = _order_by_owner(x, y, z, owner)
    assert sorted(order.tolist()) == list(range(len(x)))
    keys = list(zip(owner.tolist(), x.tolist(), y.tolist(), z.tolist(), strict=True))
    assert [keys[k] for k in order] == sorted(keys)


def test_no_points_have_no_order() -> None:
    assert len(_order_by_owner(*points(0, 10, 1), np.empty(0, np.int64))) == 0
