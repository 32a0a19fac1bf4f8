"""Flight strips of a survey: how far they lie above one another, and where whole strips are moved to."""

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.terrain.flight_passes import SLICE_S, Strip, ids_of, ids_of_timed, passes_of, slices_of, united_slices
from pipeline.terrain.strip_moves import moves_of, offsets_of, strips_warning, surfaces_warning
from pipeline.terrain.survey_strips import Rows, compared_strips, counted
from pipeline.terrain.terrain_settings import StripSettings
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
    slices: npt.NDArray[np.int64] | None = None,
) -> tuple[Rows, npt.NDArray[np.int64]]:
    """How strips differ, and when they saw points; `slices` are the latter of the whole survey."""
    x, y, z = np.rint(1000 * xyz.T).astype(np.int64).copy()
    single = np.ones(len(x), np.uint8)
    time = np.zeros(len(x)) if time is None else time
    ids = strip.astype(np.uint16)
    slices = slices_of(ids, time) if slices is None else slices
    return compared_strips((x, y, z), (single, single), ids, time, core, passes_of(slices)), slices


@pytest.mark.parametrize("lift_m", [0.15, 0.45, -1.5])
def test_an_offset_is_measured_to_a_centimetre_and_taken_out(lift_m: float) -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(3, 5, len(xyz))
    xyz[strip == 4, 2] += lift_m
    (pair,) = offsets_of(*rows_of(xyz, strip), SETTINGS)
    assert (pair.first, pair.second) == (Strip(3), Strip(4))
    assert pair.offset_m == pytest.approx(-lift_m, abs=0.011)
    moves_mm = moves_of(*rows_of(xyz, strip), SETTINGS)
    if abs(lift_m) < SETTINGS.align_m:
        assert moves_mm == {}
        return
    assert moves_mm[Strip(3)] == -moves_mm[Strip(4)]
    for name, move_mm in moves_mm.items():
        xyz[strip == name.source, 2] += move_mm / 1000.0
    assert offsets_of(*rows_of(xyz, strip), SETTINGS) == []
    assert f"{abs(pair.offset_m):.2f} m" in strips_warning([pair], moves_mm)


def test_strips_that_fit_within_their_noise_are_not_named() -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(0, 3, len(xyz))
    xyz[:, 2] += np.array([0.0, 0.03, -0.02])[strip]
    assert offsets_of(*rows_of(xyz, strip), SETTINGS) == []


def test_a_forest_shows_no_offset() -> None:
    random = np.random.default_rng(3)
    xyz = random.uniform((0, 0, 0), (60, 60, 15), (8000, 3))
    strip = random.integers(0, 2, len(xyz))
    xyz[strip == 1, 2] += 2.0
    assert offsets_of(*rows_of(xyz, strip), SETTINGS) == []


def test_a_strip_that_is_tilted_is_named_with_its_range_and_stays() -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(0, 2, len(xyz))
    xyz[strip == 1, 2] += (xyz[strip == 1, 0] - 30.0) / 60.0
    (pair,) = offsets_of(*rows_of(xyz, strip), SETTINGS)
    assert pair.high_m - pair.low_m == pytest.approx(0.5, abs=0.1)
    assert "to +0.2" in str(pair)
    assert moves_of(*rows_of(xyz, strip), SETTINGS) == {}


def test_tiles_add_up_to_the_whole() -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(0, 2, len(xyz))
    whole, _ = rows_of(xyz, strip)
    parts = []
    for x0, x1 in ((0, 17), (17, 41), (41, 60)):
        near = (xyz[:, 0] >= x0 - 4) & (xyz[:, 0] < x1 + 4)
        core = Window(x0_mm=1000 * x0, y0_mm=0, x1_mm=1000 * x1, y1_mm=60_000)
        parts.append(rows_of(xyz[near], strip[near], core)[0])
    assert all(len(part) for part in parts)
    np.testing.assert_array_equal(counted(np.concatenate(parts)), whole)
    mixed = np.random.default_rng(4).permutation(len(xyz))
    np.testing.assert_array_equal(rows_of(xyz[mixed], strip[mixed])[0], whole)


def test_strips_that_fit_move_together() -> None:
    xyz = ground(n=12_000)
    strip = np.random.default_rng(2).integers(0, 3, len(xyz))
    xyz[:, 2] += np.array([0.0, 0.02, 0.9])[strip]
    moves_mm = moves_of(*rows_of(xyz, strip), SETTINGS)
    assert moves_mm[Strip(0)] == moves_mm[Strip(1)] > 0 > moves_mm[Strip(2)]
    assert moves_mm[Strip(0)] - moves_mm[Strip(2)] == pytest.approx(890, abs=20)


def test_a_chain_of_strips_is_aligned_end_to_end() -> None:
    xyz = ground(n=12_000)
    # four strips side by side; each overlaps the next by a third
    number = np.minimum(xyz[:, 0] // 15.0, 3.0).astype(np.int64)
    strip = np.where(np.random.default_rng(2).random(len(xyz)) < 0.5, number, np.minimum(number + 1, 3))
    xyz[:, 2] += np.array([0.0, 0.6, 1.2, 0.5])[strip]
    for name, move_mm in moves_of(*rows_of(xyz, strip), SETTINGS).items():
        xyz[strip == name.source, 2] += move_mm / 1000.0
    assert offsets_of(*rows_of(xyz, strip), SETTINGS) == []


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
    found = rows_of(xyz, np.full(len(xyz), source), time=time)
    (pair,) = offsets_of(*found, SETTINGS)
    assert pair.offset_m == pytest.approx(-0.6, abs=0.011)
    ids, moves_mm = np.full(len(xyz), source, np.uint16), moves_of(*found, SETTINGS)
    held = np.array([pair.first.holds(ids, time), pair.second.holds(ids, time)])
    np.testing.assert_array_equal(held, [number == 0, number == 1])
    assert f"strip {source} at GPS time {pair.first.from_s:.0f} to" in strips_warning([pair], moves_mm)
    assert (moves_mm[pair.first], moves_mm[pair.second]) == (300, -300)
    for strip, move_mm in moves_mm.items():
        assert Strip.of(str(strip)) == strip
        xyz[strip.holds(ids, time), 2] += move_mm / 1000.0
    assert offsets_of(*rows_of(xyz, ids, time=time), SETTINGS) == []


def test_passes_of_one_id_that_fit_are_one_strip() -> None:
    xyz = ground(n=12_000)
    number, time = in_passes(xyz, [100.0, 400.0, 700.0])
    strip = np.array([5, 5, 8])[number]
    xyz[:, 2] += np.array([0.0, 0.03, 0.6])[number]
    (pair,) = offsets_of(*rows_of(xyz, strip, time=time), SETTINGS)
    assert (pair.first, pair.second) == (Strip(5), Strip(8))


def test_only_the_id_whose_passes_do_not_fit_is_divided() -> None:
    xyz = ground(n=18_000)
    number, time = in_passes(xyz, [100.0, 400.0, 700.0])
    strip = np.array([5, 5, 8])[number]
    xyz[:, 2] += np.array([0.0, 0.8, 0.0])[number]
    moves_mm = moves_of(*rows_of(xyz, strip, time=time), SETTINGS)
    assert [strip for strip in moves_mm if strip.source == 8] == [Strip(8)]
    early, late = sorted(strip for strip in moves_mm if strip.source == 5)
    assert early.to_s < late.from_s
    assert moves_mm[early] - moves_mm[late] == pytest.approx(800, abs=20)
    assert moves_mm[early] == moves_mm[Strip(8)]


def test_passes_without_a_gap_in_their_times_are_left_to_the_warning() -> None:
    # a drone flies to and fro without a break, 4 m in a second
    xyz = ground(n=90_000, side_m=240.0)
    number = np.random.default_rng(2).integers(0, 2, len(xyz))
    time = np.where(number == 0, xyz[:, 0] / 4.0, 130.0 - xyz[:, 0] / 4.0)
    xyz[number == 1, 2] += 0.6
    found = rows_of(xyz, np.zeros(len(xyz), np.int64), time=time)
    assert moves_of(*found, SETTINGS) == {}
    assert "two surfaces 0.60 m apart" in surfaces_warning(*found, SETTINGS)


def test_tiles_and_orders_do_not_change_passes() -> None:
    xyz = ground()
    number, time = in_passes(xyz, [103.7, 400.0])
    xyz[number == 1, 2] += 0.6
    strip = np.zeros(len(xyz), np.int64)
    (whole, slices), parts = rows_of(xyz, strip, time=time), []
    for x0, x1 in ((0, 17), (17, 41), (41, 60)):
        near = (xyz[:, 0] >= x0 - 4) & (xyz[:, 0] < x1 + 4)
        core = Window(x0_mm=1000 * x0, y0_mm=0, x1_mm=1000 * x1, y1_mm=60_000)
        parts.append(rows_of(xyz[near], strip[near], core, time[near], slices)[0])
    np.testing.assert_array_equal(counted(np.concatenate(parts)), whole)
    assert moves_of(whole, slices, SETTINGS) != {}
    mixed = np.random.default_rng(4).permutation(len(xyz))
    again, united = rows_of(xyz[mixed], strip[mixed], time=time[mixed])
    np.testing.assert_array_equal(again, whole)
    np.testing.assert_array_equal(united, slices)


def meaningless_times(kind: str, n: int) -> npt.NDArray[np.float64]:
    """Times that are not those of passes."""
    random = np.random.default_rng(7)
    if kind == "random":
        return random.uniform(0.0, 1e5, n)
    if kind == "hundredth":
        return random.uniform(7.01, 7.02, n)
    if kind == "huge":
        return 1.6e15 + random.uniform(0.0, 1e9, n)
    return np.arange(n) * (1.0 if kind == "row" else 1000.0)


@pytest.mark.parametrize("kind", ["random", "row", "thousand rows", "huge", "hundredth"])
def test_times_that_are_not_those_of_passes_hide_no_offset_between_ids(kind: str) -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(3, 5, len(xyz))
    xyz[strip == 4, 2] += 0.6
    found = rows_of(xyz, strip, time=meaningless_times(kind, len(xyz)))
    assert moves_of(*found, SETTINGS) == moves_of(*rows_of(xyz, strip), SETTINGS) == {Strip(3): 300, Strip(4): -300}


@pytest.mark.parametrize("kind", ["random", "row", "thousand rows", "huge", "hundredth"])
def test_times_that_are_not_those_of_passes_leave_one_id_to_the_warning(kind: str) -> None:
    xyz = ground()
    xyz[np.random.default_rng(2).random(len(xyz)) < 0.5, 2] += 0.6
    found = rows_of(xyz, np.full(len(xyz), 7), time=meaningless_times(kind, len(xyz)))
    assert moves_of(*found, SETTINGS) == {}
    assert "two surfaces 0.60 m apart" in surfaces_warning(*found, SETTINGS)


def test_all_points_of_a_divided_id_belong_to_a_strip_that_is_listed() -> None:
    # each of two flights returns to the same place forty times; three points lie elsewhere, later
    xyz = ground(n=40_000, side_m=30.0)
    random = np.random.default_rng(2)
    late = random.integers(0, 2, len(xyz))
    time = 1000.0 + 5000.0 * late + 24.0 * random.integers(0, 40, len(xyz)) + random.uniform(0.0, 2.0, len(xyz))
    time[:3] = 9000.0
    xyz[late == 1, 2] += 0.6
    ids = np.full(len(xyz), 7, np.uint16)
    moves_mm = moves_of(*rows_of(xyz, ids.astype(np.int64), time=time), SETTINGS)
    held = np.array([strip.holds(ids, time) for strip in moves_mm])
    np.testing.assert_array_equal(held.sum(axis=0), 1)
    moved = np.array([*moves_mm.values()]) @ held
    assert moved[3:][late[3:] == 0].tolist() == [300] * int((late[3:] == 0).sum())
    assert moved[3:][late[3:] == 1].tolist() == [-300] * int((late[3:] == 1).sum())


def test_ids_of_separated_passes_are_none_of_the_survey() -> None:
    xyz = ground(n=12_000)
    number, time = in_passes(xyz, [100.0, 400.0, 700.0])
    xyz[:, 2] += np.array([0.0, 0.3, 0.3])[number]
    strip = np.array([7, 7, 65535])[number]
    # an id far away that no square compares
    xyz = np.concatenate((xyz, xyz[:50] + np.array([500.0, 0.0, 0.0])))
    strip, time = np.append(strip, np.full(50, 65534)), np.append(time, time[:50])
    moves_mm = moves_of(*rows_of(xyz, strip, time=time), SETTINGS)
    assert {one.source for one in moves_mm} == {7, 65534, 65535}
    assert sorted(ids_of_timed(moves_mm).values()) == [65532, 65533]


@pytest.mark.parametrize("share", [0.5, 0.3])
@pytest.mark.parametrize("lift_m", [0.3, 0.6, 1.5])
def test_strips_that_neither_ids_nor_times_separate_are_seen_as_two_surfaces(lift_m: float, share: float) -> None:
    xyz = ground()
    xyz[np.random.default_rng(2).random(len(xyz)) < share, 2] += lift_m
    warning = surfaces_warning(*rows_of(xyz, np.zeros(len(xyz), np.int64)), SETTINGS)
    assert f"two surfaces {lift_m:.2f} m apart" in warning
    assert "point_source_id" in warning


@pytest.mark.parametrize("begin_s", [1000.0, 3e8])
def test_what_one_pass_saw_on_two_surfaces_is_not_two_strips(begin_s: float) -> None:
    xyz = ground()
    xyz[np.random.default_rng(2).random(len(xyz)) < 0.5, 2] += 0.6
    time = begin_s + xyz[:, 0] / 60.0
    assert surfaces_warning(*rows_of(xyz, np.full(len(xyz), 11), time=time), SETTINGS) == ""


@pytest.mark.parametrize("height_m", [0.7, 1.0, 4.0])
@pytest.mark.parametrize("share", [0.15, 0.4, 0.6])
def test_a_greenhouse_or_a_crop_on_a_part_of_a_survey_without_times_is_not_two_strips(
    share: float, height_m: float
) -> None:
    xyz = ground()
    through = np.random.default_rng(2).random(len(xyz)) < 0.5
    xyz[through & (xyz[:, 0] < 60.0 * share), 2] += height_m
    assert surfaces_warning(*rows_of(xyz, np.zeros(len(xyz), np.int64)), SETTINGS) == ""


def test_passes_that_gps_times_separate_are_not_two_surfaces() -> None:
    xyz = ground()
    number, time = in_passes(xyz, [100.0, 400.0])
    xyz[number == 1, 2] += 0.6
    assert surfaces_warning(*rows_of(xyz, np.full(len(xyz), 7), time=time), SETTINGS) == ""


def test_two_surfaces_are_not_those_of_strips_that_ids_separate() -> None:
    xyz = ground()
    strip = np.random.default_rng(2).integers(0, 2, len(xyz))
    xyz[strip == 1, 2] += 0.6
    assert surfaces_warning(*rows_of(xyz, strip), SETTINGS) == ""


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
        assert surfaces_warning(*rows_of(points, strip), SETTINGS) == ""


def test_the_name_of_a_strip_is_read_back_and_no_other_text() -> None:
    for strip in (Strip(31), Strip(0, -16.0, 8.0), Strip(0, 230_400.0, 230_464.0)):
        assert Strip.of(str(strip)) == strip
    with pytest.raises(ValueError, match="does not name a strip"):
        Strip.of("31 at noon")


@pytest.mark.parametrize("begin_s", [-7e8, -3.0, 0.0, 7.9, 604_799.0, 3.4e8])
def test_slices_of_time_count_on_and_a_gap_of_two_ends_a_pass(begin_s: float) -> None:
    time = begin_s + SLICE_S * np.array([0, 1, 2, 3, 4, 6])
    slices = slices_of(np.full(6, 9, np.uint16), time)
    assert np.diff(slices).tolist() == [1, 1, 1, 1, 2]
    early, late = passes_of(slices)
    assert (early.to_s - early.from_s, late.to_s - late.from_s) == (5 * SLICE_S, SLICE_S)
    assert passes_of(slices[:5]) == ()


def test_times_that_cannot_be_seconds_and_those_of_too_many_slices_make_no_passes_in_any_order() -> None:
    slices = slices_of(np.array([3, 3, 4, 4], np.uint16), np.array([-1e300, 5.0, 900.0, 1.7e18]))
    assert (ids_of(slices), passes_of(slices)) == ([3, 4], ())
    time = np.arange(40_000) * 3 * SLICE_S
    ids = np.where(np.arange(len(time)) % 2, 5, 6).astype(np.uint16)
    whole = slices_of(ids, time)
    assert (ids_of(whole), passes_of(whole)) == ([5, 6], ())
    order = np.random.default_rng(1).permutation(len(time))
    parts = [slices_of(ids[own], time[own]) for own in np.array_split(order, 7)]
    np.testing.assert_array_equal(united_slices([united_slices(parts[:4]), *parts[4:]]), whole)


def test_passes_that_differ_by_too_little_to_move_whole_strips_are_separated_all_the_same() -> None:
    xyz = ground()
    number, time = in_passes(xyz, [100.0, 400.0])
    xyz[number == 1, 2] += 0.2
    found = rows_of(xyz, np.zeros(len(xyz), np.int64), time=time)
    moves_mm = moves_of(*found, SETTINGS)
    assert set(moves_mm.values()) == {0}
    assert len(set(ids_of_timed(moves_mm).values())) == 2
    assert "aligned one by one" in strips_warning(offsets_of(*found, SETTINGS), moves_mm)
