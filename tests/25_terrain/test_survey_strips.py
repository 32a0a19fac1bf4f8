"""Flight strips of a survey: how far they lie above one another, and where whole strips are moved to."""

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.terrain.flight_passes import SLICE_S, id_and_slice, slices_of
from pipeline.terrain.flight_strip import Strip, ids_of_timed
from pipeline.terrain.settings import StripSettings
from pipeline.terrain.strip_moves import moves_of, offsets_of, strips_warning, surfaces_warning
from pipeline.terrain.survey_strips import compared_strips, counted
from pipeline.tiling import Window

SETTINGS = StripSettings()


def ground(seed: int = 1, n: int = 6000, side_m: float = 60.0) -> npt.NDArray[np.float64]:
    """Points of a slope, in metres."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(0, side_m, n), random.uniform(0, side_m, n)
    return np.column_stack((x, y, 0.1 * x - 0.05 * y + random.normal(0.0, 0.03, n)))


def rows_of(
    xyz: npt.NDArray[np.float64],
    strip: npt.NDArray[np.int64],
    core: Window | None = None,
    time: npt.NDArray[np.float64] | None = None,
) -> npt.NDArray[np.int64]:
    x, y, z = np.rint(1000 * xyz.T).astype(np.int64).copy()
    single = np.ones(len(x), np.uint8)
    time = np.zeros(len(x)) if time is None else time
    return compared_strips((x, y, z), (single, single), strip.astype(np.uint16), time, core)


@pytest.mark.parametrize("lift_m", [0.15, 0.45, -1.5])
def test_an_offset_is_measured_to_a_centimetre_and_taken_out(lift_m: float) -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(3, 5, len(xyz))
    xyz[strip == 4, 2] += lift_m
    (pair,) = offsets_of([rows_of(xyz, strip)], SETTINGS)
    assert (pair.first, pair.second) == (Strip(3), Strip(4))
    assert pair.offset_m == pytest.approx(-lift_m, abs=0.011)
    moves_mm = moves_of([rows_of(xyz, strip)], SETTINGS)
    if abs(lift_m) < SETTINGS.align_m:
        assert moves_mm == {}
        return
    assert moves_mm[Strip(3)] == -moves_mm[Strip(4)]
    for name, move_mm in moves_mm.items():
        xyz[strip == name.source, 2] += move_mm / 1000.0
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
    assert moves_mm[Strip(0)] == moves_mm[Strip(1)] > 0 > moves_mm[Strip(2)]
    assert moves_mm[Strip(0)] - moves_mm[Strip(2)] == pytest.approx(890, abs=20)


def test_a_chain_of_strips_is_aligned_end_to_end() -> None:
    xyz = ground(n=12_000)
    # four strips side by side; each overlaps the next by a third
    number = np.minimum(xyz[:, 0] // 15.0, 3.0).astype(np.int64)
    strip = np.where(np.random.default_rng(2).random(len(xyz)) < 0.5, number, np.minimum(number + 1, 3))
    xyz[:, 2] += np.array([0.0, 0.6, 1.2, 0.5])[strip]
    for name, move_mm in moves_of([rows_of(xyz, strip)], SETTINGS).items():
        xyz[strip == name.source, 2] += move_mm / 1000.0
    assert offsets_of([rows_of(xyz, strip)], SETTINGS) == []


# --- strips that no id separates


def in_passes(
    xyz: npt.NDArray[np.float64], begins_s: list[float]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Which of some passes saw each point, at random, and when: 60 m in a second, from west to east."""
    number = np.random.default_rng(2).integers(0, len(begins_s), len(xyz))
    return number, np.array(begins_s)[number] + xyz[:, 0] / 60.0


@pytest.mark.parametrize("source", [0, 31])
@pytest.mark.parametrize("begin_s", [0.0, 7.5, 230_404.0, 3.06e8, -2.5e8])
def test_passes_of_one_id_are_strips_by_their_times(source: int, begin_s: float) -> None:
    xyz = ground()
    number, time = in_passes(xyz, [begin_s, begin_s + 30.0])
    xyz[number == 1, 2] += 0.6
    rows = rows_of(xyz, np.full(len(xyz), source), time=time)
    (pair,) = offsets_of([rows], SETTINGS)
    assert pair.offset_m == pytest.approx(-0.6, abs=0.011)
    ids, moves_mm = np.full(len(xyz), source, np.uint16), moves_of([rows], SETTINGS)
    held = np.array([pair.first.holds(ids, time), pair.second.holds(ids, time)])
    np.testing.assert_array_equal(held, [number == 0, number == 1])
    assert f"strip {source} at GPS time {pair.first.from_s:.0f} to" in strips_warning([pair], moves_mm)
    assert (moves_mm[pair.first], moves_mm[pair.second]) == (300, -300)
    for strip, move_mm in moves_mm.items():
        assert Strip.of(str(strip)) == strip
        xyz[strip.holds(ids, time), 2] += move_mm / 1000.0
    assert offsets_of([rows_of(xyz, ids, time=time)], SETTINGS) == []


def test_passes_of_one_id_that_fit_are_one_strip() -> None:
    xyz = ground(n=12_000)
    number, time = in_passes(xyz, [100.0, 400.0, 700.0])
    strip = np.array([5, 5, 8])[number]
    xyz[:, 2] += np.array([0.0, 0.03, 0.6])[number]
    (pair,) = offsets_of([rows_of(xyz, strip, time=time)], SETTINGS)
    assert (pair.first, pair.second) == (Strip(5), Strip(8))


def test_only_the_id_whose_passes_do_not_fit_is_divided() -> None:
    xyz = ground(n=18_000)
    number, time = in_passes(xyz, [100.0, 400.0, 700.0])
    strip = np.array([5, 5, 8])[number]
    xyz[:, 2] += np.array([0.0, 0.8, 0.0])[number]
    moves_mm = moves_of([rows_of(xyz, strip, time=time)], SETTINGS)
    assert [strip for strip in moves_mm if strip.source == 8] == [Strip(8)]
    early, late = sorted(strip for strip in moves_mm if strip.source == 5)
    assert early.to_s < late.from_s
    assert moves_mm[early] - moves_mm[late] == pytest.approx(800, abs=20)
    assert moves_mm[early] == moves_mm[Strip(8)]


def test_passes_that_join_in_time_elsewhere_are_strips_nonetheless() -> None:
    # a drone flies to and fro without a break, 4 m in a second
    xyz = ground(n=90_000, side_m=240.0)
    number = np.random.default_rng(2).integers(0, 2, len(xyz))
    time = np.where(number == 0, xyz[:, 0] / 4.0, 130.0 - xyz[:, 0] / 4.0)
    xyz[number == 1, 2] += 0.6
    moves_mm = moves_of([rows_of(xyz, np.zeros(len(xyz), np.int64), time=time)], SETTINGS)
    # around the turn, at 65 s, each slice of time has points of both
    out = [move_mm for strip, move_mm in moves_mm.items() if strip.to_s <= 56.0]
    back = [move_mm for strip, move_mm in moves_mm.items() if strip.from_s >= 72.0]
    assert out == pytest.approx([300] * 7, abs=20)
    assert back == pytest.approx([-300] * len(back), abs=20)
    assert len(back) >= 7


def test_tiles_and_orders_do_not_change_passes() -> None:
    xyz = ground()
    number, time = in_passes(xyz, [103.7, 400.0])
    xyz[number == 1, 2] += 0.6
    strip = np.zeros(len(xyz), np.int64)
    whole, parts = rows_of(xyz, strip, time=time), []
    for x0, x1 in ((0, 17), (17, 41), (41, 60)):
        near = (xyz[:, 0] >= x0 - 4) & (xyz[:, 0] < x1 + 4)
        core = Window(x0_mm=1000 * x0, y0_mm=0, x1_mm=1000 * x1, y1_mm=60_000)
        parts.append(rows_of(xyz[near], strip[near], core, time[near]))
    np.testing.assert_array_equal(counted(np.concatenate(parts)), whole)
    assert moves_of(parts, SETTINGS) == moves_of([whole], SETTINGS) != {}
    mixed = np.random.default_rng(4).permutation(len(xyz))
    np.testing.assert_array_equal(rows_of(xyz[mixed], strip[mixed], time=time[mixed]), whole)


def test_a_place_of_very_many_passes_is_not_compared() -> None:
    xyz = ground()
    time = 1000.0 * np.arange(len(xyz))
    rows = rows_of(xyz, np.zeros(len(xyz), np.int64), time=time)
    assert offsets_of([rows], SETTINGS) == []
    assert surfaces_warning([rows]) == ""


@pytest.mark.parametrize("share", [0.5, 0.3])
@pytest.mark.parametrize("lift_m", [0.3, 0.6, 1.5])
def test_strips_that_neither_ids_nor_times_separate_are_seen_as_two_surfaces(lift_m: float, share: float) -> None:
    xyz = ground()
    xyz[np.random.default_rng(2).random(len(xyz)) < share, 2] += lift_m
    warning = surfaces_warning([rows_of(xyz, np.zeros(len(xyz), np.int64))])
    assert f"two surfaces {lift_m:.2f} m apart" in warning
    assert "point_source_id" in warning


def test_two_surfaces_are_not_those_of_strips_that_ids_separate() -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(0, 2, len(xyz))
    xyz[strip == 1, 2] += 0.6
    assert surfaces_warning([rows_of(xyz, strip)]) == ""


def test_walls_trees_and_rough_ground_are_not_two_surfaces() -> None:
    random, xyz = np.random.default_rng(3), ground()
    strip = np.zeros(len(xyz), np.int64)
    steps = xyz.copy()
    steps[:, 2] += 3.0 * ((xyz[:, 0] // 5 + xyz[:, 1] // 7) % 2)
    rough = xyz + np.column_stack((0 * strip, 0 * strip, random.normal(0.0, 0.2, len(xyz))))
    trees = xyz + np.column_stack(
        (0 * strip, 0 * strip, random.integers(0, 2, len(xyz)) * random.uniform(1, 9, len(xyz)))
    )
    for points in (xyz, steps, rough, trees):
        assert surfaces_warning([rows_of(points, strip)]) == ""


def test_the_name_of_a_strip_is_read_back_and_no_other_text() -> None:
    for strip in (Strip(31), Strip(0, -16.0, 8.0), Strip(0, 230_400.0, 230_464.0)):
        assert Strip.of(str(strip)) == strip
    with pytest.raises(ValueError, match="does not name a strip"):
        Strip.of("31 at noon")


@pytest.mark.parametrize("begin_s", [-7e8, -3.0, 0.0, 7.9, 604_799.0, 3.4e8])
def test_slices_of_time_count_on_from_one_to_the_next(begin_s: float) -> None:
    time = begin_s + SLICE_S * np.arange(5)
    assert np.diff(slices_of(np.zeros(5, np.uint16), time)).tolist() == [1, 1, 1, 1]


def test_times_that_cannot_be_seconds_stay_within_their_id() -> None:
    found = slices_of(np.array([3, 3, 4, 4], np.uint16), np.array([-1e300, 1e300, -1e300, 1.7e18]))
    assert [id_and_slice(int(number))[0] for number in found] == [3, 3, 4, 4]
    assert found[2] - found[1] > 1


def test_passes_that_differ_by_too_little_to_move_whole_strips_are_separated_all_the_same() -> None:
    xyz = ground()
    number, time = in_passes(xyz, [100.0, 400.0])
    xyz[number == 1, 2] += 0.2
    rows = rows_of(xyz, np.zeros(len(xyz), np.int64), time=time)
    moves_mm = moves_of([rows], SETTINGS)
    assert set(moves_mm.values()) == {0}
    assert len(set(ids_of_timed(moves_mm).values())) == 2
    assert "aligned one by one" in strips_warning(offsets_of([rows], SETTINGS), moves_mm)
