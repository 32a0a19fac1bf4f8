"""Classes of changes: pairs of houses made by hand, one change each, and differences that are not a change."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import pytest
from epochs_by_hand import ORIGIN, failed, house, rejected

from pipeline.model import BuildingResult, Reason, Status
from pipeline.ruler.epochs.epoch_settings import DiffSettings
from pipeline.ruler.simulation.roofs import RoofShape
from pipeline.runtime.manifest import RunStatus

Compare = Callable[..., dict[str, dict[str, Any]]]
FLAT: dict[str, Any] = {"shape": RoofShape.FLAT, "azimuth": 90.0}
GABLE_M3 = 12.0 * 9.0 * (5.0 + 4.5 * math.tan(math.radians(35.0)) / 2.0)


def one(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    (row,) = rows.values()
    return row


def test_a_house_that_is_as_it_was_is_unchanged_though_its_outline_jitters(compare: Compare) -> None:
    row = one(compare([house("a1")], [house("a2", 0.15, -0.1, length=12.3, eave=5.05)]))
    assert (row["change"], row["relation"], row["doubts"]) == ("unchanged", "one_to_one", [])
    assert row["change_ratio"] < 0.5
    assert row["height_change_m"] == pytest.approx(0.05, abs=0.08)
    assert row["iou"] > 0.9


def test_new_and_gone_houses_have_their_size(compare: Compare) -> None:
    rows = compare([house("a1"), house("b1", 50.0)], [house("a2"), house("c2", 0.0, 50.0)])
    assert {name: row["change"] for name, row in rows.items()} == {"a": "unchanged", "b": "gone", "c": "new"}
    assert rows["c"]["added_m2"] == rows["c"]["area_change_m2"] == pytest.approx(108.0, abs=0.1)
    assert rows["c"]["gained_m3"] == rows["c"]["volume_change_m3"] == pytest.approx(GABLE_M3, rel=1e-3)
    assert rows["b"]["removed_m2"] == -rows["b"]["area_change_m2"] == pytest.approx(108.0, abs=0.1)
    assert rows["b"]["lost_m3"] == -rows["b"]["volume_change_m3"] == pytest.approx(GABLE_M3, rel=1e-3)
    assert rows["b"]["old_ids"] == ["b1"]
    assert rows["b"]["new_ids"] == []
    assert rows["b"]["change_id"] == "o-b1"
    assert rows["c"]["change_id"] == "n-c2"


@pytest.mark.parametrize(("eave", "change"), [(6.0, "raised"), (4.0, "lowered"), (5.45, "unchanged")])
def test_a_house_with_other_walls_is_raised_or_lowered_by_as_much(compare: Compare, eave: float, change: str) -> None:
    row = one(compare([house("a1")], [house("a2", eave=eave)]))
    assert row["change"] == change
    assert [row["height_change_m"], row["ridge_change_m"]] == pytest.approx([eave - 5.0] * 2, abs=2e-3)
    assert not row["is_reshaped"]
    if change == "raised":
        assert row["volume_change_m3"] == pytest.approx(108.0, abs=0.1)
        assert row["gained_m3"] == pytest.approx(108.0, rel=0.02)
        assert row["raised_m2"] == pytest.approx(108.0, rel=0.02)


@pytest.mark.parametrize("shape", [RoofShape.FLAT, RoofShape.HIP])
def test_a_house_with_another_roof_is_reshaped_and_not_raised(compare: Compare, shape: RoofShape) -> None:
    pitch = 0.0 if shape is RoofShape.FLAT else 50.0
    row = one(compare([house("a1")], [house("a2", shape=shape, pitch=pitch)]))
    assert (row["change"], row["is_raised"], row["is_lowered"]) == ("reshaped", False, False)
    assert row["iou"] == pytest.approx(1.0, abs=1e-3)
    assert (row["old_roof_type"], row["new_roof_type"]) == ("gable", str(shape))
    assert row["volume_change_m3"] == pytest.approx(row["gained_m3"] - row["lost_m3"], rel=0.08)


def test_an_extension_has_its_area_and_volume(compare: Compare) -> None:
    row = one(compare([house("a1", 0.0, length=12.0, **FLAT)], [house("a2", 2.0, length=16.0, **FLAT)]))
    assert row["change"] == "reshaped"
    assert row["added_m2"] == pytest.approx(36.0, rel=0.05)
    assert row["gained_m3"] == pytest.approx(36.0 * 5.0, rel=0.05)
    assert row["removed_m2"] == row["lowered_m2"] == row["raised_m2"] == 0.0
    assert row["area_change_m2"] == pytest.approx(36.0, abs=0.1)


def test_a_house_may_be_raised_and_reshaped_and_the_larger_volume_names_the_class(compare: Compare) -> None:
    before = house("a1", length=12.0, **FLAT)
    mostly_up = one(compare([before], [house("a2", 1.0, length=14.0, eave=8.0, **FLAT)]))
    assert (mostly_up["change"], mostly_up["is_raised"], mostly_up["is_reshaped"]) == ("raised", True, True)


def test_what_is_narrow_does_not_count(compare: Compare) -> None:
    rows = compare(
        [house("a1", length=12.0, width=20.0, **FLAT), house("b1", 100.0, length=12.0, width=20.0, **FLAT)],
        [house("a2", 0.6, length=13.2, width=20.0, **FLAT), house("b2", 101.0, length=14.0, width=20.0, **FLAT)],
    )
    assert (rows["a"]["change"], rows["b"]["change"]) == ("unchanged", "reshaped")
    assert rows["a"]["added_m2"] == 0.0
    assert rows["a"]["area_change_m2"] == pytest.approx(24.0, abs=0.1)


def test_roofs_that_are_not_known_well_need_larger_changes(compare: Compare) -> None:
    rows = compare(
        [house("a1", sigma=0.3), house("b1", 50.0, sigma=0.03)],
        [house("a2", eave=6.0, sigma=0.37), house("b2", 50.0, eave=6.0, sigma=0.04)],
    )
    assert (rows["a"]["change"], rows["b"]["change"]) == ("unchanged", "raised")
    assert rows["a"]["least_height_change_m"] == pytest.approx(1.429, abs=1e-3)
    assert rows["b"]["least_height_change_m"] == 0.5
    assert rows["a"]["doubts"] == ["near_limit"]


def test_a_known_shift_of_the_surveys_is_no_change(compare: Compare) -> None:
    found = compare([house("a1")], [house("a2", eave=5.8)], DiffSettings(vertical_shift_m=0.8))
    assert one(found)["change"] == "unchanged"
    assert one(found)["height_change_m"] == pytest.approx(0.0, abs=2e-3)


def test_a_part_that_may_be_a_tree_and_a_roof_without_points_are_doubts(compare: Compare) -> None:
    grown = house("a2", 2.0, length=16.0, sigma=0.03, **FLAT)
    rough = dataclasses.replace(grown, planes=(dataclasses.replace(grown.planes[0], rmse_m=0.2),))
    bare = dataclasses.replace(grown, quality=dataclasses.replace(grown.quality, unexplained_m2=30.0))
    before = house("a1", length=12.0, sigma=0.03, **FLAT)
    for after, doubts in ((grown, []), (rough, ["rough_part"]), (bare, ["unexplained_part"])):
        row = one(compare([before], [after]))
        assert (row["change"], row["doubts"]) == ("reshaped", doubts)


def test_one_building_that_is_modelled_as_two_did_not_change(compare: Compare) -> None:
    halves = [house("b2", -5.0, length=10.0, **FLAT), house("c2", 5.0, length=10.0, **FLAT)]
    split = one(compare([house("a1", length=20.0, **FLAT)], halves))
    assert (split["change"], split["relation"], split["doubts"]) == ("unchanged", "split", ["other_units"])
    assert (split["old_ids"], split["new_ids"]) == (["a1"], ["b2", "c2"])
    assert split["new_area_m2"] == pytest.approx(180.0, abs=0.1)


def test_neighbours_that_share_out_one_roof_in_another_way_did_not_change(compare: Compare) -> None:
    rows = compare(
        [house("a1", -6.0, length=12.0, **FLAT), house("b1", 6.0, length=12.0, **FLAT)],
        [house("a2", -5.0, length=14.0, **FLAT), house("b2", 7.0, length=10.0, **FLAT)],
    )
    found = {name: (row["change"], row["relation"]) for name, row in rows.items()}
    assert found == dict.fromkeys("ab", ("unchanged", "one_to_one"))
    assert rows["a"]["area_change_m2"] == pytest.approx(18.0, abs=0.1)


def test_a_shed_under_a_new_hall_is_gone_and_the_hall_is_new(compare: Compare) -> None:
    rows = compare(
        [house("a1", length=5.0, width=4.0, eave=2.5, **FLAT)], [house("b2", length=40.0, width=30.0, eave=9.0, **FLAT)]
    )
    assert {name: row["change"] for name, row in rows.items()} == {"a": "gone", "b": "new"}
    assert rows["a"]["doubts"] == ["overlaps_another"]
    assert rows["b"]["doubts"] == []


# --- not comparable --------------------------------------------------------------------------------------------------


def test_a_failed_candidate_is_not_taken_for_a_gone_or_a_new_house(compare: Compare) -> None:
    rows = compare([house("a1"), failed("b1", 50.0, 0.0)], [failed("a2", 0.0, 0.0), house("b2", 50.0)])
    assert {name: (row["change"], row["reason"]) for name, row in rows.items()} == {
        "a": ("not_comparable", "failed_in_new"),
        "b": ("not_comparable", "failed_in_old"),
    }
    assert rows["a"]["gained_m3"] is None


def doubtful(name: str, **options: Any) -> BuildingResult:
    """A house whose points do not support its model."""
    reason = {"reason": Reason.SCATTERED, "reason_detail": "0.4 m"}
    return dataclasses.replace(house(name, **options), status=Status.DOUBTFUL, **reason)


def test_a_change_of_a_model_that_its_points_do_not_support_is_never_a_sure_one(compare: Compare) -> None:
    old = [doubtful("a1"), house("b1", 50.0), doubtful("c1", y=50.0), house("e1", 50.0, 50.0)]
    new = [house("a2", eave=8.0), doubtful("b2", x=50.0, eave=8.0), doubtful("d2", y=-50.0), house("e2", 50.0, 50.0)]
    rows = compare(old, new)
    assert {name: (row["change"], row["doubts"]) for name, row in rows.items()} == {
        "a": ("raised", ["doubtful_in_old"]),
        "b": ("raised", ["doubtful_in_new"]),
        "c": ("gone", ["doubtful_in_old"]),
        "d": ("new", ["doubtful_in_new"]),
        "e": ("unchanged", []),
    }


def test_one_doubtful_part_of_a_group_is_a_doubt_of_the_row(compare: Compare) -> None:
    parts = [house("b2", -5.0, length=10.0, **FLAT), doubtful("c2", x=5.0, length=10.0, **FLAT)]
    row = one(compare([house("a1", length=20.0, **FLAT)], parts))
    assert (row["change"], row["relation"], row["doubts"]) == ("unchanged", "split", ["doubtful_in_new", "other_units"])


def test_a_house_at_the_edge_of_the_data_is_not_compared(compare: Compare) -> None:
    rows = compare(
        [house("a1", at_edge=True), house("b1", 50.0)], [house("a2", length=18.0), house("c2", 100.0, at_edge=True)]
    )
    assert rows["a"]["reason"] == "edge_of_old"
    assert (rows["b"]["change"], rows["c"]["reason"]) == ("gone", "edge_of_new")


def test_what_lies_outside_of_the_other_epochs_data_is_neither_new_nor_gone(compare: Compare) -> None:
    narrow = (-500.0, -500.0, 60.0, 500.0)
    rows = compare(
        [house("a1"), house("b1", 30.0)],
        [house("a2"), house("c2", 100.0), house("d2", 56.0), house("e2", -50.0)],
        of_old={"extent": narrow},
    )
    assert {name: row["reason"] or row["change"] for name, row in rows.items()} == {
        "a": "unchanged",
        "b": "gone",
        "c": "outside_old",
        "d": "outside_old",
        "e": "new",
    }
    swapped = compare([house("c1", 100.0)], [], of_new={"extent": narrow})
    assert one(swapped)["reason"] == "outside_new"


def test_what_stands_in_a_tile_that_failed_is_neither_new_nor_gone(compare: Compare) -> None:
    side = 250.0
    keys = [f"x{int(ORIGIN[0] // side) + i}_y{int(ORIGIN[1] // side) + j}" for i in (-1, 0) for j in (-1, 0)]
    run = {
        "status": RunStatus.INCOMPLETE,
        "lattice": {"tile_size_m": side, "origin_x_m": 0.0, "origin_y_m": 0.0},
        "tiles": tuple(keys),
        "failed_tiles": (keys[-1],),
    }
    rows = compare([house("a1", 50.0, 50.0), house("b1", -50.0, 50.0)], [], of_new=run)
    assert (rows["a"]["reason"], rows["b"]["change"]) == ("tile_failed_in_new", "gone")


def test_a_like_object_that_the_other_epoch_rejected_leaves_it_open(compare: Compare) -> None:
    houses: list[BuildingResult] = [house("a1"), house("b1", 50.0), house("c1", 100.0)]
    others = [rejected("t", 0.0, 0.0), rejected("low", 50.0, 0.0, height=1.0), rejected("big", 100.0, 0.0, side=60.0)]
    rows = compare(houses, [], of_new={"others": others})
    assert {name: row["reason"] or row["change"] for name, row in rows.items()} == {
        "a": "rejected_in_new",
        "b": "gone",
        "c": "gone",
    }


@pytest.mark.parametrize("other", [{"engine_version": "9"}, {"method": "kmeans"}, {"settings_hash": "cd"}])
def test_another_version_is_a_doubt_of_shapes_alone(compare: Compare, other: dict[str, str]) -> None:
    old = [house("a1"), house("b1", 40.0), house("c1", 80.0)]
    new = [house("a2", length=18.0), house("b2", 40.0, eave=8.0), house("c2", 80.0), house("d2", 120.0)]
    rows = compare(old, new, of_new=other)
    assert {name: (row["change"], row["doubts"]) for name, row in rows.items()} == {
        "a": ("reshaped", ["other_version"]),
        "b": ("raised", []),
        "c": ("unchanged", []),
        "d": ("new", []),
    }
    assert compare(old, new)["a"]["doubts"] == []
