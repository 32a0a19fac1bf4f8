"""LAS and LAZ of every version give what laspy wrote, in pieces, in metres."""

import struct
from pathlib import Path

import numpy as np
import pytest
from measured import memory_below

from pipeline.io import ReadOptions, open_source
from pipeline.model import PointCloud


def read_all(path: Path, options: ReadOptions | None = None, chunk_size: int = 1_000_000) -> PointCloud:
    pieces = list(open_source(path, options).chunks(chunk_size))
    names = ("xyz", "return_number", "return_count", "classification", "gps_time", "source_id")
    return PointCloud(**{name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names})


VERSIONS = [("1.2", 0), ("1.2", 1), ("1.2", 3), ("1.3", 1), ("1.4", 1), ("1.4", 6), ("1.4", 7), ("1.4", 8)]


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(("version", "point_format"), VERSIONS)
def test_every_version_and_point_format_gives_what_was_written(
    tmp_path, points, write_las, version, point_format, suffix
):
    xyz = points(3_000)
    fields = {
        "return_number": np.tile(np.array([1, 2, 3], dtype=np.uint8), 1_000),
        "number_of_returns": np.full(3_000, 3, dtype=np.uint8),
        "classification": np.tile(np.array([2, 6], dtype=np.uint8), 1_500),
        "point_source_id": np.arange(3_000, dtype=np.uint16),
    }
    if point_format != 0:
        fields["gps_time"] = np.linspace(3e8, 3e8 + 60.0, 3_000)
    path = write_las(tmp_path / f"tile{suffix}", xyz, version=version, point_format=point_format, **fields)
    info = open_source(path).info
    cloud = read_all(path, chunk_size=700)
    np.testing.assert_allclose(cloud.xyz, xyz, atol=1e-6)
    np.testing.assert_array_equal(cloud.return_number, fields["return_number"])
    np.testing.assert_array_equal(cloud.return_count, fields["number_of_returns"])
    np.testing.assert_array_equal(cloud.classification, fields["classification"])
    np.testing.assert_array_equal(cloud.source_id, fields["point_source_id"])
    np.testing.assert_array_equal(cloud.gps_time, fields.get("gps_time", np.zeros(3_000)))
    assert (info.format, info.point_count, info.has_returns, info.has_classes) == (suffix[1:], 3_000, True, True)
    assert info.has_gps_time == (point_format != 0)
    np.testing.assert_allclose(info.bounds_m, (*xyz.min(axis=0), *xyz.max(axis=0)), atol=1e-6)
    assert info.density_per_m2 == pytest.approx(0.3, rel=0.01)


def test_dimensions_have_names_and_types_and_bits_count_as_a_byte(tmp_path, points, write_las):
    old, new = (
        dict(open_source(write_las(path, points(9), version=version, point_format=form)).info.facts.dimensions)
        for path, version, form in ((tmp_path / "a.las", "1.2", 0), (tmp_path / "b.laz", "1.4", 7))
    )
    assert (old["X"], old["return_number"], old["scan_angle_rank"], "gps_time" in old) == ("i4", "u1", "i1", False)
    assert (new["scan_angle"], new["gps_time"], new["blue"]) == ("i2", "f8", "u2")


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("n", [1, 49_999, 50_000, 50_001, 100_000])
def test_counts_around_the_size_of_a_compressed_chunk_are_read_whole(tmp_path, points, write_las, n, suffix):
    for point_format, version in ((1, "1.2"), (6, "1.4")):
        path = write_las(tmp_path / f"tile{suffix}", points(n), version=version, point_format=point_format)
        source = open_source(path)
        assert [len(piece) for piece in source.chunks(30_000)] == [min(30_000, n - at) for at in range(0, n, 30_000)]


def test_withheld_points_and_noise_are_dropped_and_counted(tmp_path, points, write_las):
    classes = np.repeat(np.array([2, 7, 18, 6], dtype=np.uint8), 100)
    withheld = np.zeros(400, dtype=np.uint8)
    withheld[90:110] = 1
    path = write_las(
        tmp_path / "a.laz", points(400), version="1.4", point_format=6, classification=classes, withheld=withheld
    )
    source = open_source(path)
    assert sum(map(len, source.chunks(33))) == 400 - 200 - 10
    assert source.dropped == {"withheld": 20, "noise_class": 190, "outside": 0, "off_earth": 0}
    everything = ReadOptions(keep_withheld=True, drop_classes=())
    source = open_source(path, everything)
    assert sum(map(len, source.chunks())) == 400
    assert source.dropped == {"withheld": 0, "noise_class": 0, "outside": 0, "off_earth": 0}


def test_the_old_withheld_bit_is_heeded_too(tmp_path, points, write_las):
    withheld = (np.arange(300) % 3 == 0).astype(np.uint8)
    path = write_las(tmp_path / "a.las", points(300), point_format=1, withheld=withheld)
    assert len(read_all(path)) == 200


def test_a_second_pass_gives_the_same_points_and_counts(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.laz", points(500), classification=np.full(500, 7, dtype=np.uint8))
    source = open_source(path, ReadOptions(drop_classes=(18,)))
    first = np.concatenate([piece.xyz for piece in source.chunks(100)])
    second = np.concatenate([piece.xyz for piece in source.chunks(77)])
    np.testing.assert_array_equal(first, second)


def test_returns_that_a_writer_left_at_zero_become_one(tmp_path, points, write_las):
    zeros = np.zeros(50, dtype=np.uint8)
    path = write_las(tmp_path / "a.las", points(50), return_number=zeros, number_of_returns=zeros)
    cloud = read_all(path)
    assert (cloud.return_number == 1).all()
    assert (cloud.return_count == 1).all()


def test_feet_become_metres_in_plan_and_elevation_apart(tmp_path, points, write_las):
    xyz = points(200)
    path = write_las(tmp_path / "a.las", xyz, crs="EPSG:2992")  # Oregon Lambert, international feet
    source = open_source(path)
    assert source.info.reference.horizontal_unit_m == pytest.approx(0.3048)
    assert source.info.reference.vertical_unit_m == pytest.approx(0.3048)
    assert any("vertical unit" in warning for warning in source.warnings)
    np.testing.assert_allclose(next(iter(source.chunks())).xyz, xyz * 0.3048, atol=1e-6)
    in_metres_up = next(iter(open_source(path, ReadOptions(vertical_unit="m")).chunks())).xyz
    np.testing.assert_allclose(in_metres_up, xyz * [0.3048, 0.3048, 1.0], atol=1e-6)


def with_header_box(path, **values):
    """Write other bounds into a header."""
    raw = bytearray(path.read_bytes())
    for name, value in values.items():
        struct.pack_into("<d", raw, 179 + 8 * ("x_max", "x_min", "y_max", "y_min", "z_max", "z_min").index(name), value)
    path.write_bytes(raw)
    return path


ZEROS = dict.fromkeys(("x_max", "x_min", "y_max", "y_min", "z_max", "z_min"), 0.0)
MILLIMETRES = {"x_min": 84e6, "x_max": 84.1e6, "y_min": 447e6, "y_max": 447.1e6, "z_min": 0.0, "z_max": 2e4}


@pytest.mark.parametrize(
    ("box", "named"),
    [
        ({"x_max": float("nan")}, "cannot be"),
        ({"y_max": -1.0}, "cannot be"),
        (ZEROS, "do not hold the points, such as x 8"),
        (MILLIMETRES, "do not hold the points"),
        ({"x_max": 84_050.0}, "do not hold the points"),
        ({"z_min": 0.0, "z_max": 0.0}, "do not hold the points"),
        ({"y_min": 0.0}, "are far wider than the points"),
        ({"x_max": 84e6}, "are far wider than the points"),
    ],
)
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_header_bounds_that_the_points_contradict_are_measured_and_reported(
    tmp_path, points, write_las, box, named, suffix
):
    xyz = points(500)
    info = open_source(with_header_box(write_las(tmp_path / f"a{suffix}", xyz), **box)).info
    np.testing.assert_allclose(info.bounds_m, (*xyz.min(axis=0), *xyz.max(axis=0)), atol=1e-6)
    (warning,) = (warning for warning in info.warnings if "the header's bounds" in warning)
    assert named in warning
    assert warning.endswith("taken from the points")


def test_a_header_that_is_right_costs_no_pass_and_no_word(tmp_path, points, write_las, monkeypatch):
    monkeypatch.delattr("pipeline.io.las.LasFile._bounds_of_points")
    xyz = points(500)
    assert not [w for w in open_source(write_las(tmp_path / "a.laz", xyz)).info.warnings if "bounds" in w]


def test_single_points_beyond_the_header_bounds_are_used_and_reported(tmp_path, points, write_las):
    xyz = points(500)
    second = float(np.sort(xyz[:, 0])[-2])
    source = open_source(with_header_box(write_las(tmp_path / "a.las", xyz), x_max=second + 0.01))
    assert sum(map(len, source.chunks(100))) == 500
    assert any("1 points lie outside the bounds" in warning for warning in source.warnings)


def test_gps_times_give_dates_only_where_they_have_one(tmp_path, points, write_las):
    adjusted = write_las(tmp_path / "a.las", points(100), gps_time=np.linspace(297_417_271.0, 297_417_281.0, 100))
    week = write_las(tmp_path / "b.las", points(100), gps_time=np.linspace(230_038.0, 230_770.0, 100))
    info = open_source(adjusted).info
    assert info.acquired_from is not None
    assert info.acquired_to is not None
    assert info.acquired_from.isoformat() == "2021-02-15T09:40:53+00:00"
    assert (info.acquired_to - info.acquired_from).total_seconds() == pytest.approx(10.0)
    assert open_source(week).info.acquired_from is None
    assert open_source(week).info.has_gps_time


@pytest.mark.parametrize(("suffix", "point_format"), [(".las", 1), (".laz", 1), (".laz", 6)])
def test_memory_is_bounded_by_the_piece_and_not_by_the_file(tmp_path, points, write_las, suffix, point_format):
    version = "1.4" if point_format == 6 else "1.2"
    path = write_las(tmp_path / f"a{suffix}", points(600_000), version=version, point_format=point_format)
    source = open_source(path)
    for _ in source.chunks(20_000):
        pass  # imports and caches are not the file's
    with memory_below(6e6):  # 600,000 points are 24 MB as records and coordinates; a piece is 30 times smaller
        assert sum(map(len, source.chunks(20_000))) == 600_000


def test_times_that_are_no_numbers_become_zero(tmp_path, points, write_las):
    times = np.linspace(1.0, 2.0, 100)
    times[7] = np.nan
    assert read_all(write_las(tmp_path / "a.laz", points(100), gps_time=times)).gps_time[7] == 0.0


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_points_without_a_strip_are_of_the_strip_that_the_header_names(tmp_path, points, write_las, suffix):
    path = write_las(tmp_path / f"a.{suffix}", points(6), point_source_id=np.array([0, 0, 3, 0, 9, 0], np.uint16))
    assert read_all(path).source_id.tolist() == [0, 0, 3, 0, 9, 0]
    raw = bytearray(path.read_bytes())
    struct.pack_into("<H", raw, 4, 7)
    path.write_bytes(raw)
    found = read_all(path).source_id
    assert (found.tolist(), found.dtype) == ([7, 7, 3, 7, 9, 7], np.uint16)
