"""What must not depend on which epoch comes first, on the order of rows, on tiles, on place and units."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from epochs_by_hand import ORIGIN, by_name, compared, failed, house, write_epoch

from pipeline.model import BuildingResult
from pipeline.ruler.epochs import epoch_comparison as comparing
from pipeline.ruler.epochs import epoch_matching as matching
from pipeline.ruler.simulation.roofs import RoofShape

MIRRORED = {
    "new": "gone",
    "gone": "new",
    "raised": "lowered",
    "lowered": "raised",
    "only_old": "only_new",
    "only_new": "only_old",
    "split": "merged",
    "merged": "split",
}
PAIRS = (
    *(("old", "new"), ("added", "removed"), ("raised_m2", "lowered_m2"), ("gained", "lost"), ("max_raise", "max_drop")),
    ("is_raised", "is_lowered"),
)
SIGNED = ("area_change_m2", "height_change_m", "ridge_change_m", "ground_change_m", "volume_change_m3")


def street(origin: tuple[float, float, float] = ORIGIN) -> tuple[list[BuildingResult], list[BuildingResult]]:
    """A pair of epochs with a change of every class, and a turned row of touching houses."""
    flat: dict[str, Any] = {"shape": RoofShape.FLAT, "azimuth": 90.0}
    everywhere: dict[str, Any] = {"origin": origin}
    old = [
        house("a1", **everywhere),
        house("b1", 40.0, **everywhere),
        house("c1", 80.0, **everywhere),
        house("d1", 120.0, **everywhere),
        house("e1", 0.0, 40.0, length=12.0, **flat, **everywhere),
        house("g1", -6.0, 80.0, **flat, **everywhere),
        house("h1", 6.0, 80.0, **flat, **everywhere),
    ]
    new = [
        house("a2", 0.1, **everywhere),
        house("b2", 40.0, eave=7.8, **everywhere),
        house("c2", 80.0, eave=3.0, **everywhere),
        house("e2", 2.0, 40.0, length=16.0, eave=8.0, **flat, **everywhere),
        house("f2", 40.0, 40.0, shape=RoofShape.HIP, length=14.0, **everywhere),
        house("g2", -5.0, 80.0, length=14.0, **flat, **everywhere),
        house("h2", 7.0, 80.0, length=10.0, eave=6.5, **flat, **everywhere),
    ]
    return old, new


def figures(row: dict[str, Any]) -> dict[str, Any]:
    """All of a row but its geometry, numbers to the centimetre."""
    return {
        name: round(value, 2) + 0.0 if isinstance(value, float) else value
        for name, value in row.items()
        if name not in {"geometry", "bbox"}
    }


def mirrored(row: dict[str, Any]) -> dict[str, Any]:
    """A row with the epochs exchanged."""
    found = {}
    for name, value in figures(row).items():
        other = name
        for first, second in PAIRS:
            if first in name or second in name:
                other = name.replace(first, "*").replace(second, first).replace("*", second)
                break
        if name in SIGNED and value is not None:
            found[other] = -value + 0.0
        else:
            found[other] = MIRRORED.get(value, value) if name in {"change", "relation"} else value
    found.pop("change_id")
    return found


def test_exchanging_the_epochs_mirrors_every_figure(tmp_path: Path) -> None:
    old, new = street()
    before, after = write_epoch(tmp_path / "old", old), write_epoch(tmp_path / "new", new)
    there, back = by_name(compared(before, after, tmp_path / "a")), by_name(compared(after, before, tmp_path / "b"))
    assert {row["change"] for row in there.values()} >= {"new", "gone", "raised", "lowered", "reshaped", "unchanged"}
    for name, row in there.items():
        expected = figures(back[name])
        expected.pop("change_id")
        assert mirrored(row) == expected, name


def test_the_same_run_twice_did_not_change_at_all(tmp_path: Path) -> None:
    run = write_epoch(tmp_path / "run", street()[1])
    rows = by_name(compared(run, run, tmp_path / "out"))
    assert {row["change"] for row in rows.values()} == {"unchanged"}
    assert {row["change_ratio"] for row in rows.values()} == {0.0}
    assert {row["iou"] for row in rows.values()} == {1.0}


def test_neither_order_nor_tiles_nor_the_size_of_parts_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old, new = street()
    first = compared(write_epoch(tmp_path / "o", old), write_epoch(tmp_path / "n", new), tmp_path / "a")
    scattered = [
        {"x3_y1": one[::-2], "x1_y9": [building for k, building in enumerate(one) if k not in range(len(one))[::-2]]}
        for one in (old, new)
    ]
    runs = [write_epoch(tmp_path / f"s{k}", one) for k, one in enumerate(scattered)]
    second = compared(runs[0], runs[1], tmp_path / "b")
    assert (tmp_path / "a" / "changes.parquet").read_bytes() == (tmp_path / "b" / "changes.parquet").read_bytes()
    monkeypatch.setattr(matching, "ROWS_PER_PART", 2)
    monkeypatch.setattr(comparing, "GROUPS_PER_PART", 2)
    monkeypatch.setattr(matching.parts_of, "__defaults__", (2,))
    in_parts = compared(runs[0], runs[1], tmp_path / "c")
    assert in_parts.sort_by("change_id").equals(second.sort_by("change_id"))
    assert first.num_rows == in_parts.num_rows == 8


def test_moving_the_scene_moves_the_result(tmp_path: Path) -> None:
    away = (ORIGIN[0] + 3_217.0, ORIGIN[1] - 1_044.0, ORIGIN[2] + 55.0)
    found = []
    for k, origin in enumerate((ORIGIN, away)):
        runs = [
            write_epoch(tmp_path / f"{k}{which}", one, extent=None)
            for which, one in zip("on", street(origin), strict=True)
        ]
        found.append(by_name(compared(runs[0], runs[1], tmp_path / f"out{k}")))
    here, there = found
    for name, row in here.items():
        assert figures(row) == figures(there[name]), name
        moved = shapely.transform(shapely.from_wkb(row["geometry"]), lambda xy: xy + np.array([3_217.0, -1_044.0]))
        assert shapely.equals_exact(moved, shapely.from_wkb(there[name]["geometry"]), tolerance=1e-6, normalize=True)


def test_runs_in_feet_give_the_figures_of_runs_in_metres(tmp_path: Path) -> None:
    found = []
    for crs in ("EPSG:25832", "EPSG:2263"):
        runs = [write_epoch(tmp_path / f"{crs[5:]}{k}", one, crs=crs) for k, one in enumerate(street())]
        found.append(by_name(compared(runs[0], runs[1], tmp_path / f"out{crs[5:]}")))
    metres, feet = found
    for name, row in metres.items():
        for column, value in row.items():
            if isinstance(value, float):
                assert feet[name][column] == pytest.approx(value, rel=0.01, abs=0.02), (name, column)
        assert row["change"] == feet[name]["change"]
    ratio = shapely.area(shapely.from_wkb(feet["a"]["geometry"])) / shapely.area(
        shapely.from_wkb(metres["a"]["geometry"])
    )
    assert ratio == pytest.approx((3937.0 / 1200.0) ** 2, rel=1e-4)


def test_candidates_without_geometry_come_last_and_are_not_lost(tmp_path: Path) -> None:
    import dataclasses

    nowhere = dataclasses.replace(failed("z1", 0.0, 0.0), footprint=None)
    old, new = street()
    table = compared(write_epoch(tmp_path / "o", [nowhere, *old]), write_epoch(tmp_path / "n", new), tmp_path / "out")
    last = table.to_pylist()[-1]
    assert (last["old_ids"], last["reason"], last["geometry"], last["bbox"]) == (["z1"], "failed_in_old", None, None)
    names = [name for row in table.to_pylist() for name in (*row["old_ids"], *row["new_ids"])]
    assert sorted(names) == sorted(one.building_id for one in (nowhere, *old, *new))
