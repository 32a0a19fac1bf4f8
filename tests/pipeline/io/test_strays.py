"""Gross errors of coordinates: single points are left out and named, and spoil no bounds."""

import numpy as np
import pytest

from pipeline.errors import InconsistentInputError
from pipeline.io import ReadOptions, open_source
from pipeline.io.strays import off_earth, typical_bounds, without_strays

METRES = np.ones(3)


@pytest.mark.parametrize("place", [0, 17, -1])
@pytest.mark.parametrize("stray", [(1e12, 447_000.0, 3.0), (84_000.0, -1e12, 3.0), (84_000.0, 447_000.0, 1e12)])
def test_one_point_off_the_earth_is_left_out_and_named(tmp_path, points, stray, place):
    xyz = points(500)
    xyz[place] = stray
    np.savetxt(tmp_path / "a.xyz", xyz, fmt="%.2f")
    source = open_source(tmp_path / "a.xyz")
    kept = np.concatenate([piece.xyz for piece in source.chunks(100)])
    assert len(kept) == 499
    assert np.abs(kept).max() < 1e6
    assert source.dropped["off_earth"] == 1
    (warning,) = [words for words in source.warnings if "left out" in words]
    assert f"{next(value for value in stray if abs(value) == 1e12):.10g}" in warning
    info = source.info
    assert info.bounds_m[3] - info.bounds_m[0] < 25_000.0
    assert 0.04 < info.density_per_m2 < 0.06


def test_many_points_off_the_earth_are_a_wrong_scale_and_refused(tmp_path, points):
    xyz = points(500)
    np.savetxt(tmp_path / "a.xyz", xyz * [1.0, 1.0, 1e6], fmt="%.2f")
    with pytest.raises(InconsistentInputError, match=r"49\d of 500 points do not lie on Earth.*Check the columns"):
        list(open_source(tmp_path / "a.xyz").chunks())


def test_units_count(tmp_path, points):
    xyz = points(200) * [1.0, 1.0, 0.0] + [0.0, 0.0, 200_000.0]
    np.savetxt(tmp_path / "a.xyz", xyz, fmt="%.2f")
    feet = open_source(tmp_path / "a.xyz", ReadOptions(vertical_unit="ft"))
    assert sum(map(len, feet.chunks())) == 200
    with pytest.raises(InconsistentInputError, match="200 of 200 points"):
        list(open_source(tmp_path / "a.xyz").chunks())


def test_a_far_point_in_the_header_spoils_neither_bounds_nor_density(tmp_path, points, write_las):
    clean = open_source(write_las(tmp_path / "clean.laz", points(20_000))).info
    xyz = points(20_000)
    xyz[5] = [84_000.0 + 2e7, 447_000.0 - 2e7, 5.0]
    source = open_source(write_las(tmp_path / "far.laz", xyz))
    assert source.info.density_per_m2 == pytest.approx(clean.density_per_m2, rel=0.1)
    assert source.info.bounds_m[3] < 100_000.0
    assert any("x reaches from 84000" in words and "20084000" in words for words in source.info.warnings)
    # it is left to the outlier filter, which knows its neighbours
    assert sum(map(len, source.chunks())) == 20_000


def test_bounds_without_far_points_stay_as_they_are():
    tile = (0.0, 0.0, 0.0, 1000.0, 1000.0, 40.0)
    assert without_strays(tile, (10.0, 10.0, 1.0, 990.0, 990.0, 30.0), METRES) == (tile, ())
    assert without_strays(tile, None, METRES) == (tile, ())
    corridor = (0.0, 0.0, 0.0, 400_000.0, 900.0, 300.0)
    assert without_strays(corridor, (3_000.0, 10.0, 1.0, 390_000.0, 880.0, 280.0), METRES) == (corridor, ())


@pytest.mark.parametrize("n", [1, 2, 3, 51, 101, 5_000])
def test_typical_bounds_hold_nearly_all_of_a_sample(n):
    xyz = np.random.default_rng(n).uniform(0.0, 1.0, (n, 3))
    if n > 50:
        xyz[n // 2] = 1e9
    bounds = np.array(typical_bounds([xyz[: n // 3], xyz[n // 3 :]]))
    assert (bounds[:3] <= bounds[3:]).all()
    assert bounds.max() <= 1.0
    inside = ((xyz >= bounds[:3]) & (xyz <= bounds[3:])).mean()
    assert inside > 0.9 or n < 51


def test_points_on_earth_are_not_even_looked_at_twice():
    assert off_earth(np.array([[6.4e7, 1e7, 9_000.0]]), METRES) is None
    assert off_earth(np.array([[6.4e7, 1e7, 9_000.0], [np.inf, 0.0, 0.0]]), METRES).tolist() == [False, True]
