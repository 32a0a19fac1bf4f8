"""The facts of the real files, held against laspy and the data's own description."""

import laspy
import numpy as np
import pytest

from pipeline.io import find_inputs, open_source
from pipeline.io.gps_time import GpsTimeKind

# count, EPSG, metres a unit, points/m2, returns, classes, GPS times
FACTS = {
    "ahn3/delft_west.laz": (640_510, None, 1.0, 14.62, True, True, GpsTimeKind.WEEK),
    "ahn3/delft_east.laz": (208_432, None, 1.0, 12.62, True, True, GpsTimeKind.WEEK),
    "ign/hdf_870000_6617100.laz": (70_840, 2154, 1.0, 11.45, True, True, GpsTimeKind.ADJUSTED),
    "ign/hd_770500_6277500.laz": (84_524, 2154, 1.0, 33.81, True, True, GpsTimeKind.ADJUSTED),
    "isprs/CSite2_orig-utm.laz": (486_800, 32632, 1.0, 1.83, True, False, GpsTimeKind.NONE),
    "isprs/samp11-utm.laz": (38_010, 32632, 1.0, 0.94, False, True, GpsTimeKind.NONE),
    "isprs/samp51-utm.laz": (17_845, 32632, 1.0, 0.18, False, True, GpsTimeKind.NONE),
    "oregon/autzen_trim.las": (110_000, None, 0.3048, 1.79, True, True, GpsTimeKind.WEEK),
}


@pytest.mark.parametrize("name", FACTS)
def test_the_facts_are_those_of_the_description(shared_data, name):
    info = open_source(shared_data / name).info
    count, epsg, unit_m, density, returns, classes, times = FACTS[name]
    assert (info.point_count, info.reference.epsg) == (count, epsg)
    assert info.reference.horizontal_unit_m == info.reference.vertical_unit_m == pytest.approx(unit_m, rel=1e-12)
    assert info.density_per_m2 == pytest.approx(density, abs=0.01)
    assert (info.has_returns, info.has_classes, info.gps_time_kind) == (returns, classes, times)
    assert (info.acquired_from is not None) == (times is GpsTimeKind.ADJUSTED)


@pytest.mark.parametrize("name", ["isprs/CSite2_orig-utm.laz", "ign/hdf_870000_6617100.laz", "oregon/autzen_trim.las"])
def test_the_points_are_laspy_s(shared_data, name):
    source = open_source(shared_data / name)
    las = laspy.read(shared_data / name)
    pieces = list(source.chunks(40_000))
    unit_m = source.info.reference.horizontal_unit_m
    np.testing.assert_allclose(np.concatenate([piece.xyz for piece in pieces]), las.xyz * unit_m, rtol=0, atol=1e-7)
    numbers = np.concatenate([piece.return_number for piece in pieces])
    np.testing.assert_array_equal(numbers, np.asarray(las.return_number))
    classes = np.concatenate([piece.classification for piece in pieces])
    np.testing.assert_array_equal(classes, np.asarray(las.classification))
    assert sum(source.dropped.values()) == 0


def test_every_real_file_is_read_to_its_last_point(shared_data):
    files = find_inputs([shared_data / folder for folder in ("ahn3", "ign", "isprs", "oregon")])
    assert len(files) == 13
    for path in files:
        source = open_source(path)
        assert sum(map(len, source.chunks(200_000))) == source.info.point_count, path


def test_the_oregon_survey_is_in_feet_both_ways_and_reported(shared_data):
    info = open_source(shared_data / "oregon" / "autzen_trim.las").info
    assert info.reference.wkt is not None
    assert any("no vertical unit" in warning and "0.3048 m" in warning for warning in info.warnings)
    # A park by a river at about 125 m above the sea.
    assert 120.0 < info.bounds_m[2] < info.bounds_m[5] < 160.0


def test_the_french_flights_are_dated_although_their_flag_says_week(shared_data):
    info = open_source(shared_data / "ign" / "hd_770500_6277500.laz").info
    assert info.acquired_from is not None
    assert info.acquired_from.date().isoformat() == "2021-05-28"
    assert any("flagged as seconds of the week" in warning for warning in info.warnings)
