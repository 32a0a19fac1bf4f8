"""Windows, areas of interest and options: what of a file is wanted."""

import os
import pickle

import numpy as np
import pytest
import shapely
from shapely import MultiPolygon, Polygon, box

from pipeline.errors import InputError, SettingsError
from pipeline.extras.ply_ascii.ascii import AsciiFile
from pipeline.extras.ply_ascii.ply import PlyFile
from pipeline.io import ReadOptions, open_source
from pipeline.io.las import LasFile


def test_a_bbox_keeps_points_on_its_edge_and_counts_the_others(tmp_path, write_las):
    xyz = np.array([[84_000.0, 447_000.0, 1.0], [84_010.0, 447_010.0, 1.0], [84_010.01, 447_005.0, 1.0]])
    source = open_source(
        write_las(tmp_path / "a.las", xyz), ReadOptions(bbox=(84_000.0, 447_000.0, 84_010.0, 447_010.0))
    )
    assert [len(piece) for piece in source.chunks()] == [2]
    assert source.dropped == {"withheld": 0, "noise_class": 0, "outside": 1, "off_earth": 0}


def test_an_area_with_a_hole_keeps_what_shapely_says_point_by_point(tmp_path, points, write_las):
    xyz = points(2_000)
    ring = Polygon(box(84_010, 447_010, 84_090, 447_090).exterior, [box(84_030, 447_030, 84_060, 447_060).exterior])
    area = MultiPolygon([ring, box(84_092, 447_000, 84_100, 447_100)])
    source = open_source(write_las(tmp_path / "a.laz", xyz), ReadOptions(aoi=area))
    kept = np.concatenate([piece.xyz for piece in source.chunks(300)])
    expected = xyz[[area.intersects(shapely.Point(x, y)) for x, y, _ in xyz]]
    np.testing.assert_allclose(kept, expected, atol=1e-6)


def test_a_bbox_and_an_area_hold_together(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.laz", points(2_000))
    left, low = box(84_000, 447_000, 84_050, 447_100), (84_000.0, 447_000.0, 84_100.0, 447_050.0)
    both = sum(map(len, open_source(path, ReadOptions(aoi=left, bbox=low)).chunks()))
    quarter = ReadOptions(bbox=(84_000.0, 447_000.0, 84_050.0, 447_050.0))
    assert both == sum(map(len, open_source(path, quarter).chunks())) > 0
    apart = ReadOptions(aoi=left, bbox=(84_060.0, 447_000.0, 84_100.0, 447_100.0))
    source = open_source(path, apart)
    assert list(source.chunks()) == []
    assert source.dropped["outside"] == 2_000


def test_a_bbox_is_in_the_units_of_the_crs(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.las", points(1_000), crs="EPSG:2992")
    source = open_source(path, ReadOptions(bbox=(84_000.0, 447_000.0, 84_050.0, 447_100.0)))
    xyz = np.concatenate([piece.xyz for piece in source.chunks()])
    assert 400 < len(xyz) < 600
    assert xyz[:, 0].max() <= 84_050.0 * 0.3048 + 1e-6


def test_all_faults_of_the_options_are_reported_at_once():
    bow_tie = Polygon([(0, 0), (1, 1), (1, 0), (0, 1)])
    with pytest.raises(SettingsError) as caught:
        ReadOptions(bbox=(1.0, 0.0, 0.0, 1.0), aoi=bow_tie, drop_classes=(7, 300))
    assert len(caught.value.faults) == 3
    assert "Self-intersection" in str(caught.value)
    assert "300" in str(caught.value)
    with pytest.raises(SettingsError, match="x_min < x_max"):
        ReadOptions(bbox=(0.0, 0.0, float("nan"), 1.0))


def test_a_chunk_size_below_one_is_refused(tmp_path, points, write_las):
    with pytest.raises(SettingsError, match="chunk_size is 0"):
        next(open_source(write_las(tmp_path / "a.las", points(10))).chunks(0))


def test_what_is_dropped_and_kept_adds_up_to_the_file(tmp_path, points, write_las):
    rng = np.random.default_rng(1)
    path = write_las(
        tmp_path / "a.laz",
        points(3_000),
        version="1.4",
        point_format=6,
        classification=rng.choice(np.array([1, 2, 6, 7, 18], dtype=np.uint8), 3_000),
        withheld=rng.integers(0, 2, 3_000).astype(np.uint8),
    )
    source = open_source(path, ReadOptions(bbox=(84_020.0, 447_020.0, 84_090.0, 447_090.0)))
    kept = sum(map(len, source.chunks(250)))
    assert kept + sum(source.dropped.values()) == source.info.point_count
    assert min(kept, *(source.dropped[cause] for cause in ("outside", "withheld", "noise_class"))) > 0


def text_of(path, xyz):
    np.savetxt(path, xyz, fmt="%.2f")
    return path


def ply_of(path, xyz):
    names = "".join(f"property double {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{names}end_header\n"
    path.write_bytes(header.encode() + xyz.astype("<f8").tobytes())
    return path


@pytest.mark.parametrize("name", ["a.laz", "a.las", "a.xyz", "a.ply"])
def test_a_file_opened_before_is_not_looked_through_again(tmp_path, points, write_las, monkeypatch, name):
    writers = {"laz": write_las, "las": write_las, "xyz": text_of, "ply": ply_of}
    path = writers[name[2:]](tmp_path / name, points(3_000))
    options = ReadOptions(crs="EPSG:7415")
    first = open_source(path, options)
    # as a task of another process gets it
    known = pickle.loads(pickle.dumps(first.info))
    assert known == first.info
    with monkeypatch.context() as patched:
        for forbidden in (LasFile, PlyFile, AsciiFile):
            patched.setattr(forbidden, "_sample" if forbidden is LasFile else "_measure", None)
        patched.setattr("pipeline.io.las.check_chunks", None)
        again = open_source(path, options, known)
    assert again.info == first.info
    assert again.crs_given == first.crs_given
    for one, other in zip(first.chunks(700), again.chunks(700), strict=True):
        np.testing.assert_array_equal(one.xyz, other.xyz)
        np.testing.assert_array_equal(one.classification, other.classification)
    assert (again.dropped, again.warnings) == (first.dropped, first.warnings)


def test_a_file_that_was_changed_since_is_opened_anew(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.laz", points(3_000))
    known = open_source(path).info
    write_las(path, points(4_000))
    assert open_source(path, None, known).info.point_count == 4_000
    cut = path.read_bytes()
    known = open_source(path).info
    path.write_bytes(cut[:-1_000])
    with pytest.raises(InputError):
        open_source(path, None, known)


def test_a_file_of_one_size_that_was_written_again_is_opened_anew(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.las", points(3_000))
    known = open_source(path).info
    write_las(path, points(3_000) + 7.0)
    os.utime(path, ns=(known.modified_ns + 1, known.modified_ns + 1))
    assert path.stat().st_size == known.file_size
    assert open_source(path, None, known).info.bounds_m[0] == pytest.approx(known.bounds_m[0] + 7.0)
