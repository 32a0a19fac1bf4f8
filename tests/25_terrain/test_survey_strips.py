"""Flight strips of a survey: how far they lie above one another, and where whole strips are moved to."""

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.terrain.settings import StripSettings
from pipeline.terrain.survey_strips import compared_strips, counted, moves_of, offsets_of, strips_warning
from pipeline.tiling import Window

SETTINGS = StripSettings()


def ground(seed: int = 1, n: int = 6000, side_m: float = 60.0) -> npt.NDArray[np.float64]:
    """Points of a slope, in metres."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(0, side_m, n), random.uniform(0, side_m, n)
    return np.column_stack((x, y, 0.1 * x - 0.05 * y + random.normal(0.0, 0.03, n)))


def rows_of(
    xyz: npt.NDArray[np.float64], strip: npt.NDArray[np.int64], core: Window | None = None
) -> npt.NDArray[np.int64]:
    x, y, z = np.rint(1000 * xyz.T).astype(np.int64).copy()
    single = np.ones(len(x), np.uint8)
    return compared_strips((x, y, z), (single, single), strip.astype(np.uint16), core)


@pytest.mark.parametrize("lift_m", [0.15, 0.45, -1.5])
def test_an_offset_is_measured_to_a_centimetre_and_taken_out(lift_m: float) -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(3, 5, len(xyz))
    xyz[strip == 4, 2] += lift_m
    (pair,) = offsets_of([rows_of(xyz, strip)], SETTINGS)
    assert (pair.first, pair.second) == (3, 4)
    assert pair.offset_m == pytest.approx(-lift_m, abs=0.011)
    moves_mm = moves_of([rows_of(xyz, strip)], SETTINGS)
    if abs(lift_m) < SETTINGS.align_m:
        assert moves_mm == {}
        return
    assert moves_mm[3] == -moves_mm[4]
    for number, move_mm in moves_mm.items():
        xyz[strip == number, 2] += move_mm / 1000.0
    assert offsets_of([rows_of(xyz, strip)], SETTINGS) == []
    assert f"{abs(pair.offset_m):.2f} m" in strips_warning([pair], moves_mm)


def test_strips_that_fit_within_their_noise_are_not_named() -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(0, 3, len(xyz))
    xyz[:, 2] += np.array([0.0, 0.03, -0.02])[strip]
    assert offsets_of([rows_of(xyz, strip)], SETTINGS) == []


def test_a_forest_shows_no_offset() -> None:
    random = np.random.default_rng(3)
    xyz = random.uniform((0, 0, 0), (60, 60, 15), (8000, 3))
    strip = random.integers(0, 2, len(xyz))
    xyz[strip == 1, 2] += 2.0
    assert offsets_of([rows_of(xyz, strip)], SETTINGS) == []


def test_a_strip_that_is_tilted_is_named_with_its_range_and_stays() -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(0, 2, len(xyz))
    xyz[strip == 1, 2] += (xyz[strip == 1, 0] - 30.0) / 60.0
    (pair,) = offsets_of([rows_of(xyz, strip)], SETTINGS)
    assert pair.high_m - pair.low_m == pytest.approx(0.5, abs=0.1)
    assert "to +0.2" in str(pair)
    assert moves_of([rows_of(xyz, strip)], SETTINGS) == {}


def test_tiles_add_up_to_the_whole() -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(0, 2, len(xyz))
    whole = rows_of(xyz, strip)
    parts = []
    for x0, x1 in ((0, 17), (17, 41), (41, 60)):
        near = (xyz[:, 0] >= x0 - 4) & (xyz[:, 0] < x1 + 4)
        core = Window(x0_mm=1000 * x0, y0_mm=0, x1_mm=1000 * x1, y1_mm=60_000)
        parts.append(rows_of(xyz[near], strip[near], core))
    assert all(len(part) for part in parts)
    np.testing.assert_array_equal(counted(np.concatenate(parts)), whole)
    mixed = np.random.default_rng(4).permutation(len(xyz))
    np.testing.assert_array_equal(rows_of(xyz[mixed], strip[mixed]), whole)


def test_strips_that_fit_move_together() -> None:
    xyz = ground(n=12_000)
    strip = np.random.default_rng(2).integers(0, 3, len(xyz))
    xyz[:, 2] += np.array([0.0, 0.02, 0.9])[strip]
    moves_mm = moves_of([rows_of(xyz, strip)], SETTINGS)
    assert moves_mm[0] == moves_mm[1] > 0 > moves_mm[2]
    assert moves_mm[0] - moves_mm[2] == pytest.approx(890, abs=20)


def test_a_chain_of_strips_is_aligned_end_to_end() -> None:
    xyz = ground(n=12_000)
    # four strips side by side; each overlaps the next by a third
    number = np.minimum(xyz[:, 0] // 15.0, 3.0).astype(np.int64)
    strip = np.where(np.random.default_rng(2).random(len(xyz)) < 0.5, number, np.minimum(number + 1, 3))
    xyz[:, 2] += np.array([0.0, 0.6, 1.2, 0.5])[strip]
    for name, move_mm in moves_of([rows_of(xyz, strip)], SETTINGS).items():
        xyz[strip == name, 2] += move_mm / 1000.0
    assert offsets_of([rows_of(xyz, strip)], SETTINGS) == []
