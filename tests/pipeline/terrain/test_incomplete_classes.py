"""Undecided vertices on a roof: on one plane with building around them, beside it, or neither."""

import numpy as np
import numpy.typing as npt

from pipeline.model import IntArray, KindArray
from pipeline.terrain.incomplete_classes import OnRoof, undecided_on_roofs
from pipeline.terrain.terrain_settings import VegetationSettings


def judged(xyz_mm: IntArray, building: npt.NDArray[np.bool_]) -> KindArray:
    used = np.ones(len(xyz_mm), np.bool_)
    return undecided_on_roofs(tuple(xyz_mm.T.copy()), building, used, ~building, VegetationSettings(), 1.0)  # type: ignore[arg-type]


def roof(seed: int = 1, per_m2: float = 4.0, side_m: float = 12.0) -> IntArray:
    """Vertices of a gable with its ridge along x, in mm."""
    random = np.random.default_rng(seed)
    n = round(per_m2 * side_m**2)
    x, y = random.uniform(0, side_m, n), random.uniform(0, side_m, n)
    z = 9.0 - 0.6 * np.abs(y - side_m / 2) + random.normal(0.0, 0.02, n)
    xyz_mm: IntArray = np.rint(1000 * np.column_stack((x, y, z))[np.lexsort((y, x))]).astype(np.int64)
    return xyz_mm


def test_what_class_6_leaves_out_of_a_roof_lies_on_it() -> None:
    xyz_mm = roof()
    building = np.random.default_rng(2).random(len(xyz_mm)) < 0.6
    found = judged(xyz_mm, building)
    assert (found[~building] == OnRoof.YES).mean() > 0.97
    assert (found[building] == OnRoof.NO).all()


def test_a_vertex_off_the_plane_lies_beside_the_roof_only_where_it_surrounds_it() -> None:
    xyz_mm = roof(per_m2=8.0)
    x, y, _ = xyz_mm.T
    building = np.ones(len(xyz_mm), np.bool_)
    middle = np.argmin((x - 6000) ** 2 + (y - 3000) ** 2)
    corner = np.argmin(x + y)
    building[[middle, corner]] = False
    xyz_mm[[middle, corner], 2] += 500
    assert judged(xyz_mm, building)[[middle, corner]].tolist() == [OnRoof.BESIDE, OnRoof.NO]
    xyz_mm[middle, 2] += 1000
    assert judged(xyz_mm, building)[middle] == OnRoof.NO, "1.5 m above: another level"


def test_a_crown_that_touches_an_eave_is_not_roof() -> None:
    xyz_mm = roof()
    random = np.random.default_rng(3)
    crown = np.rint(1000 * random.uniform((12.0, 0.0, 4.0), (18.0, 12.0, 9.0), (300, 3))).astype(np.int64)
    both = np.concatenate((xyz_mm, crown))
    order = np.lexsort((both[:, 1], both[:, 0]))
    building = (np.arange(len(both)) < len(xyz_mm))[order]
    found = judged(both[order], building)[~building]
    assert (found == OnRoof.NO).mean() > 0.95


def test_the_verdicts_do_not_depend_on_the_place() -> None:
    xyz_mm = roof(seed=4)
    building = np.random.default_rng(5).random(len(xyz_mm)) < 0.5
    moved = xyz_mm + np.array([400_000_123, 5_700_000_456, 77_000])
    np.testing.assert_array_equal(judged(xyz_mm, building), judged(moved, building))


def test_without_building_nothing_is_on_a_roof() -> None:
    xyz_mm = roof()
    assert (judged(xyz_mm, np.zeros(len(xyz_mm), np.bool_)) == OnRoof.NO).all()
