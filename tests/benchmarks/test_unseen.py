"""What is kept aside never meets what settings are chosen on."""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
import shapely

from benchmarks.unseen import ClassScore, half_of, judged_points, tallinn_half, thinned_to


def tile(x: np.ndarray, y: np.ndarray) -> laspy.LasData:
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.scales, las.header.offsets = [0.01] * 3, [x[0], y[0], 0.0]
    las.x, las.y, las.z = x, y, np.zeros(len(x))
    return las


def drawn(seed: int, n: int, side_m: float) -> laspy.LasData:
    return tile(*np.random.default_rng(seed).uniform(0.0, side_m, (2, n)))


def test_the_halves_of_a_tile_have_no_point_in_common_and_all_together() -> None:
    west, east = (half_of(drawn(1, 500, 100.0), eastern=eastern) for eastern in (False, True))
    assert len(west.x) + len(east.x) == 500
    assert np.max(west.x) < np.min(east.x)


def test_every_second_building_is_kept_aside_with_its_points(tmp_path: Path) -> None:
    source = tmp_path / "data" / "more" / "building3d"
    source.mkdir(parents=True)
    names = ["10", "2", "33", "4"]
    places = {name: shapely.box(100.0 * k, 0.0, 100.0 * k + 10.0, 10.0) for k, name in enumerate(names)}
    features = [
        {"type": "Feature", "properties": {"id": name}, "geometry": shapely.geometry.mapping(place)}
        for name, place in places.items()
    ]
    (source / "outlines.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    (source / "wireframes.json").write_text(json.dumps({name: {"v": [], "e": []} for name in names}))
    x = np.concatenate([100.0 * k + np.linspace(-20.0, 30.0, 25) for k in range(4)])
    tile(x, np.full(100, 5.0)).write(source / "tallinn.laz")
    seen: list[set[str]] = []
    for kept_aside in (False, True):
        place = tallinn_half(tmp_path / "data", tmp_path / f"{kept_aside}", kept_aside=kept_aside)
        chosen = set(json.loads((place / "wireframes.json").read_text()))
        given = json.loads((place / "outlines.geojson").read_text())["features"]
        assert {feature["properties"]["id"] for feature in given} == chosen
        las = laspy.read(place / "tallinn.laz")
        assert {names[round(float(v) // 100.0 + (float(v) % 100.0 > 60.0))] for v in las.x} == chosen
        assert len(las.x) == 50
        seen.append(chosen)
    assert seen == [{"10", "33"}, {"2", "4"}]


def test_shares_of_class_6_are_those_of_the_points() -> None:
    assert ClassScore(right=60, said=80, true=100).shares == pytest.approx((0.5, 0.6, 0.75))


def test_the_house_that_a_file_leaves_unclassified_is_not_judged() -> None:
    las = tile(np.array([870220.0, 870300.0]), np.array([6617100.0, 6617100.0]))
    assert judged_points("hdf", las).tolist() == [False, True]
    assert judged_points("delft_west", las).all()


def test_a_tile_is_thinned_to_a_density() -> None:
    las = thinned_to(0.5)(drawn(2, 20_000, 100.0))
    assert 4_700 < len(las.x) < 5_300
