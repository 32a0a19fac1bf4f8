"""Embankments: large smooth surfaces that slopes lead up to join the ground, halls, rows of houses and woods do not."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipeline.terrain import morphological
from pipeline.terrain.embankments import embankments
from pipeline.terrain.lattice import NO_DATA
from pipeline.terrain.morphological import morphological_ground
from pipeline.terrain.reach import BLOCK_CELLS, LINK_CELLS, embankments_support_m
from pipeline.terrain.terrain_settings import GroundSettings

Grid = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]


def coordinates(rows: int, columns: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    c, r = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    return c, r


def sampled(z_m: npt.NDArray[np.float64], share: float = 1.0, seed: int = 0) -> Grid:
    """Elevations in mm with 3 cm of noise, where a share of the cells holds a point."""
    random = np.random.default_rng(seed)
    z = np.rint(1000 * z_m + random.normal(0.0, 30.0, z_m.shape)).astype(np.int32)
    z[random.random(z.shape) >= share] = NO_DATA
    return z


def found_on(
    lowest: Grid,
    ground: Mask,
    narrow: Mask | None = None,
    wide: Mask | None = None,
    corner: tuple[int, int] = (0, 0),
    least_m2: int = 600,
) -> Mask:
    nothing = np.zeros(lowest.shape, np.bool_)
    objects = (nothing if narrow is None else narrow, nothing if wide is None else wide)
    found: Mask = embankments(lowest, ground, objects, corner, least_m2)
    return found


def dam(side: float) -> npt.NDArray[np.float64]:
    """A dam 7 m high along the columns of 120 m: a wall to the west, to the east a face that rises `side` per metre."""
    c, _ = coordinates(120, 100)
    return np.where(c < 40.0, 0.0, np.clip(7.0 - (c - 54.0) * side, 0.0, 7.0))


def without_foot(z: npt.NDArray[np.float64]) -> Mask:
    """Openings leave the foot of a slope to the ground."""
    high: Mask = z > 1.0
    return high


# -- what joins --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.4, 0.6, 1.0])
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_dam_with_a_wall_on_one_side_joins_and_one_with_two_walls_does_not(share: float, turns: int) -> None:
    for side, joins in ((0.8, True), (7.0, False)):
        z = np.rot90(dam(side), turns).copy()
        lowest = sampled(z, share)
        high = without_foot(z) & (lowest != NO_DATA)
        found = found_on(lowest, (lowest != NO_DATA) & ~high)
        assert not found[~high].any()
        assert found[high].mean() > 0.85 if joins else not found.any()


def cut_dam() -> tuple[Grid, Mask]:
    """Sparse points of a dam with a wall on one side and a face of 45 degrees, cut by the data's edge; its crest."""
    c, r = coordinates(140, 140)
    away = (c - r) / math.sqrt(2)
    lowest = sampled(np.where(away < -10.0, 0.0, np.clip(9.0 - away, 2.0, 7.0)) + 0.02 * r, 0.25, seed=3)
    return lowest, (away > -8.0) & (away < 2.0) & (lowest != NO_DATA)


def test_the_filter_keeps_a_dam_with_a_wall_that_the_edge_of_the_data_cuts_only_as_an_embankment() -> None:
    lowest, crest = cut_dam()
    with_them, without = (morphological_ground(lowest, (500, 300), GroundSettings(embankment_m2=m2)) for m2 in (600, 0))
    assert without[0][crest].mean() < 0.3
    assert with_them[0][crest].mean() > 0.9
    assert with_them[0][without[0]].all()
    # terrain is drawn from far away only through the ground that looks less far
    np.testing.assert_array_equal(with_them[1], without[1])


def test_decks_on_an_embankment_are_not_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    lowest, crest = cut_dam()
    deck = crest & (np.arange(140)[:, None] // 10 == 7)

    def decks(*_: object) -> Mask:
        return deck

    monkeypatch.setattr(morphological, "between_walls", decks)
    found, _ = morphological_ground(lowest, (500, 300), GroundSettings())
    assert not found[deck].any()
    assert found[crest & ~deck].mean() > 0.8


def test_the_blocks_of_the_filter_begin_every_16_metres_at_the_origin_of_the_coordinates() -> None:
    # so large that the dam's parts in some blocks suffice and in others do not
    chosen = GroundSettings(embankment_m2=900)
    masks = [morphological_ground(cut_dam()[0], (column, 300), chosen)[0] for column in (496, 504, 512)]
    np.testing.assert_array_equal(masks[0], masks[2])
    assert (masks[0] != masks[1]).sum() > 100


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_a_wood_on_a_bank_falls_into_small_surfaces(share: float) -> None:
    random = np.random.default_rng(5)
    z = dam(0.8)
    high = without_foot(z)
    wood = np.where(high, z + random.uniform(0.0, 5.0, z.shape), z)
    lowest = sampled(wood, share)
    high &= lowest != NO_DATA
    assert not found_on(lowest, (lowest != NO_DATA) & ~high).any()


def test_a_roof_that_meets_the_ground_on_a_level_is_not_an_embankment() -> None:
    c, _ = coordinates(120, 100)
    roof = (c > 30) & (c < 60)
    # one side at the level of a terrace behind it, the others walls
    lowest = sampled(np.where(c >= 60, 6.0, np.where(roof, 6.0, 0.0)))
    assert not found_on(lowest, ~roof).any()


def test_small_surfaces_stay_objects_and_area_counts_gaps_between_points() -> None:
    c, r = coordinates(60, 60)
    mound = np.clip((16.0 - np.maximum(np.abs(c - 24), np.abs(r - 24))) * 0.6, 0.0, 3.0)
    for share in (1.0, 0.3):
        lowest = sampled(mound, share)
        high = without_foot(mound) & (lowest != NO_DATA)
        ground = (lowest != NO_DATA) & ~high
        # 28 m square
        assert found_on(lowest, ground, least_m2=600)[high].mean() > 0.8
        assert not found_on(lowest, ground, least_m2=1200).any()


def test_narrow_objects_on_an_embankment_stay_and_where_they_prevail_all_does() -> None:
    z = dam(0.8)
    lowest, high = sampled(z), without_foot(z)
    _, r = coordinates(*z.shape)
    some, most = high & (r % 10 < 3), high & (r % 10 < 4)
    found = found_on(lowest, ~high, narrow=some)
    assert not found[some].any()
    assert found[high & ~some].mean() > 0.9
    assert not found_on(lowest, ~high, narrow=most).any()


def test_a_wide_object_needs_slopes_on_two_thirds_of_its_border() -> None:
    c, r = coordinates(60, 60)
    down, across = np.abs(r - 24), np.abs(c - 24)
    for walls, joins in ((False, True), (True, False)):
        away = np.where(walls & (across < 18), down, np.maximum(down, across))
        mound = np.clip((18.0 - away) * 0.6, 0.0, 3.0)
        lowest, high = sampled(mound), without_foot(mound)
        assert found_on(lowest, ~high)[high].mean() > 0.9
        found = found_on(lowest, ~high, wide=high)
        assert found[high].mean() > 0.9 if joins else not found.any()


# -- a slow twin -------------------------------------------------------------------------------------------------------


def around(reach: int) -> list[tuple[int, int]]:
    """Rows and columns to the cells within reach, the nearest first."""
    square = range(-reach, reach + 1)
    near = [(a, b) for a in square for b in square if 0 < a * a + b * b <= reach * reach]
    return sorted(near, key=lambda at: (at[0] ** 2 + at[1] ** 2, at))


FAR, NEAR = around(6), around(5)


def known_around(lowest: Grid, r: int, c: int, offsets: list[tuple[int, int]]) -> list[tuple[int, int]]:
    rows, columns = lowest.shape
    inside = [(a, b) for a, b in offsets if 0 <= r + a < rows and 0 <= c + b < columns]
    return [(a, b) for a, b in inside if lowest[r + a, c + b] != NO_DATA]


def neighbours(lowest: Grid, r: int, c: int) -> list[tuple[int, int]]:
    """Rows and columns to the neighbours of a cell, the nearest first."""
    kept: list[tuple[int, int]] = []
    for a, b in known_around(lowest, r, c, FAR):
        # a nearer neighbour in the circle over the link sees both its ends at more than a right angle
        if all(y * (a - y) + x * (b - x) <= 0 for y, x in kept) and len(kept) < 12:
            kept.append((a, b))
    return kept


def is_smooth(lowest: Grid, r: int, c: int) -> bool:
    rows: list[tuple[float, int, int, int]] = []
    for a, b in known_around(lowest, r, c, NEAR):
        rise = int(lowest[r + a, c + b]) - int(lowest[r, c])
        if len(rows) < 8 and abs(rise) <= 300 + 700 * math.hypot(a, b):
            rows.append((1.0, a, b, rise))
    if len(rows) < 4:
        return False
    values = np.array(rows)
    scatter = np.cov(values[:, 1:3].T, bias=True) * len(values)
    if np.linalg.det(scatter) <= 0.05 * np.trace(scatter) ** 2:
        return False
    plane = np.linalg.lstsq(values[:, :3], values[:, 3], rcond=None)[0]
    return bool(abs(plane[0]) <= 500)


def twin(lowest: Grid, ground: Mask, narrow: Mask, wide: Mask, corner: tuple[int, int], least_m2: int) -> Mask:
    rows, columns = lowest.shape
    out = np.zeros(lowest.shape, np.bool_)
    cells = [tuple(at) for at in np.argwhere((lowest != NO_DATA) & ~ground).tolist()]
    near = {at: neighbours(lowest, *at) for at in cells}
    smooth = {at: is_smooth(lowest, *at) for at in cells}
    for south in range(-(corner[1] % 16) - 32, rows, 16):
        for west in range(-(corner[0] % 16) - 32, columns, 16):
            inside = [at for at in cells if south <= at[0] < south + 48 and west <= at[1] < west + 48]
            index = {at: i for i, at in enumerate(inside)}
            pairs = [
                (index[at], index[at[0] + a, at[1] + b])
                for at in inside
                for a, b in near[at]
                if (at[0] + a, at[1] + b) in index
                and abs(int(lowest[at]) - int(lowest[at[0] + a, at[1] + b])) <= 300 + 700 * math.hypot(a, b)
            ]
            one, other = (np.array([pair[k] for pair in pairs], np.int64) for k in (0, 1))
            graph = coo_matrix((np.ones(len(pairs)), (one, other)), shape=(len(inside), len(inside)))
            count, labels = connected_components(graph, directed=False) if inside else (0, np.zeros(0))
            for label in range(count):
                members = [at for at, own in zip(inside, labels, strict=True) if own == label]
                area, slopes, walls = 0, 0, 0
                for at in members:
                    far = [math.hypot(a, b) for a, b in near[at]]
                    if far and not narrow[at]:
                        area += round(87 * float(np.mean(far)) ** 2)
                    for (a, b), d in zip(near[at], far, strict=True):
                        if ground[at[0] + a, at[1] + b]:
                            rise = int(lowest[at]) - int(lowest[at[0] + a, at[1] + b])
                            walls += rise > 300 + 1000 * (d + 0.6)
                            slopes += 250 + 200 * d < rise <= 300 + 1000 * (d + 0.6)
                if area < 100 * least_m2 or slopes == 0:
                    continue
                if 3 * sum(bool(narrow[at]) for at in members) > len(members):
                    continue
                for at in members:
                    enough = slopes >= (2 / 3 if wide[at] else 0.45) * (slopes + walls)
                    out[at] |= bool(enough and smooth[at] and not narrow[at])
    return out


@pytest.mark.parametrize(("seed", "share", "corner"), [(0, 0.3, (0, 0)), (1, 0.5, (5, -9)), (2, 0.3, (1003, 27))])
def test_a_slow_twin_finds_the_same(seed: int, share: float, corner: tuple[int, int]) -> None:
    random = np.random.default_rng(seed)
    c, r = coordinates(60, 64)
    z = 0.05 * c
    for _ in range(14):
        at, size = random.uniform(0, 64, 2), random.uniform(4, 16, 2)
        away = np.maximum(np.abs(c - at[0]) / size[0], np.abs(r - at[1]) / size[1])
        z = np.maximum(z, 0.05 * c + np.clip((1.3 - away) * random.uniform(4, 60), 0.0, random.uniform(2, 7)))
    lowest = sampled(z + np.where(random.random(z.shape) < 0.1, random.uniform(0, 2, z.shape), 0.0), share, seed)
    ground = (lowest != NO_DATA) & (z < 0.05 * c + 0.2)
    narrow, wide = (np.kron(random.random((6, 8)) < 0.25, np.ones((10, 8))).astype(np.bool_) for _ in range(2))
    joined = []
    for least_m2 in (20, 300, 1500):
        found = found_on(lowest, ground, narrow, wide, corner, least_m2)
        np.testing.assert_array_equal(found, twin(lowest, ground, narrow, wide, corner, least_m2))
        joined.append(int(found.sum()))
    assert joined[0] > joined[2]


# -- how far it looks --------------------------------------------------------------------------------------------------


def test_a_decision_looks_a_block_and_a_link_far_wherever_the_window_begins() -> None:
    assert embankments_support_m() == BLOCK_CELLS - 1 + LINK_CELLS
    random = np.random.default_rng(8)
    c, r = coordinates(260, 260)
    z = np.clip(4.0 * np.sin(c / 9.0) * np.sin(r / 13.0) + random.normal(0, 0.1, c.shape), 0.0, 3.0)
    lowest = sampled(z, 0.4, seed=9)
    ground = (lowest != NO_DATA) & (z < 0.3)
    whole = found_on(lowest, ground, corner=(-20, 7), least_m2=150)
    far = int(embankments_support_m())
    for south, west, side in ((90, 101, 30), (120, 75, 50), (131, 140, 20)):
        part = (slice(south - far, south + side + far), slice(west - far, west + side + far))
        own = found_on(
            lowest[part].copy(), ground[part].copy(), corner=(-20 + west - far, 7 + south - far), least_m2=150
        )
        np.testing.assert_array_equal(own[far:-far, far:-far], whole[south : south + side, west : west + side])
    assert 0.1 < whole[lowest != NO_DATA].mean() < 0.9


def test_where_there_are_no_objects_nothing_joins() -> None:
    lowest = sampled(np.zeros((60, 60)), 0.5)
    assert not found_on(lowest, lowest != NO_DATA).any()
    assert not found_on(np.full((60, 60), NO_DATA, np.int32), np.zeros((60, 60), np.bool_)).any()
