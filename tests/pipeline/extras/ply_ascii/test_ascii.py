"""ASCII tables of every habit, and rows that hold two echoes."""

import laspy
import numpy as np
import pytest
from measured import memory_below

from pipeline.errors import EmptyInputError, InconsistentInputError, SettingsError, UnreadableInputError
from pipeline.extras.ply_ascii.ascii import looks_like_pulses
from pipeline.io import ReadOptions, open_source

ROWS = np.array(
    [[513_000.25, 5_402_000.5, 300.0, 17], [513_001.5, 5_402_001.0, 301.25, 80], [513_002.0, 5_402_003.0, 299.5, 3]]
)


def write(path, text):
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text",
    [
        "513000.25 5402000.5 300 17\n513001.5 5402001 301.25 80\n513002 5402003 299.5 3\n",
        "513000.25\t5402000.5\t300\t17\r\n513001.5\t5402001\t301.25\t80\r\n513002\t5402003\t299.5\t3",
        "513000.25,5402000.5,300,17\n513001.5,5402001,301.25,80\n513002,5402003,299.5,3\n",
        "513000.25, 5402000.5, 300, 17\n513001.5, 5402001, 301.25, 80\n513002, 5402003, 299.5, 3\n\n",
        "513000.25;5402000.5;300;17\n513001.5;5402001;301.25;80\n513002;5402003;299.5;3\n",
        (
            "// made by a tool, 1 2 3\n#X Y Z Intensity\n\n513000.25 5402000.5 300 17\n# 4 5 6\n"
            "513001.5 5402001 301.25 80\n\n513002 5402003 299.5 3\n"
        ),
        "\ufeffX;Y;Z;Intensity\n513000.25;5402000.5;300;17\n513001.5;5402001;301.25;80\n\n513002;5402003;299.5;3\n",
        "  5.1300025e5   5.4020005e6  3e2 17\n513001.5 5402001 301.25 80\n 513002 5402003 299.5 3",
        "Intensity,z,Northing,Easting\n17,300,5402000.5,513000.25\n80,301.25,5402001,513001.5\n3,299.5,5402003,513002\n",
    ],
    ids=["spaces", "tabs_crlf", "commas", "commas_blanks", "semicolons", "comments", "bom_names", "exponents", "named"],
)
@pytest.mark.parametrize("chunk_size", [1, 2, 1_000])
def test_every_habit_of_writing_rows_gives_the_same_points(tmp_path, text, chunk_size):
    path = write(tmp_path / "a.xyz", text)
    source = open_source(path)
    pieces = list(source.chunks(chunk_size))
    np.testing.assert_array_equal(np.concatenate([piece.xyz for piece in pieces]), ROWS[:, :3])
    assert max(map(len, pieces)) <= chunk_size
    assert source.info.point_count == 3
    assert source.info.bounds_m == (*ROWS[:, :3].min(axis=0), *ROWS[:, :3].max(axis=0))
    assert not source.info.has_returns


def test_named_columns_fill_the_fields(tmp_path):
    path = write(
        tmp_path / "a.csv",
        "x,y,z,classification,return_number,number_of_returns,gps_time,point_source_id\n"
        "1,2,3,6,1,2,100.5,7\n2,3,4,7,2,2,101.5,8\n3,4,5,2,1,1,102.5,9\n",
    )
    source = open_source(path)
    (cloud,) = source.chunks()
    assert source.dropped["noise_class"] == 1
    assert cloud.classification.tolist() == [6, 2]
    assert cloud.return_number.tolist() == [1, 1]
    assert cloud.return_count.tolist() == [2, 1]
    assert cloud.gps_time.tolist() == [100.5, 102.5]
    assert cloud.source_id.tolist() == [7, 9]
    assert (source.info.has_returns, source.info.has_classes, source.info.has_gps_time) == (True, True, True)
    assert source.info.facts.dimensions[2:4] == (("z", "f8"), ("classification", "f8"))


def test_reported_columns_stand_above_all(tmp_path):
    path = write(tmp_path / "a.xyz", "6 1 2 3 99\n2 2 3 4 99\n")
    (cloud,) = open_source(path, ReadOptions(ascii_columns="classification x y z -")).chunks()
    assert cloud.xyz.tolist() == [[1, 2, 3], [2, 3, 4]]
    assert cloud.classification.tolist() == [6, 2]
    for wrong in ("x y", "x y z", "x y z x2 y2", "a b c d e"):
        with pytest.raises(SettingsError, match="among the 5 columns"):
            open_source(path, ReadOptions(ascii_columns=wrong))


def pulses(n=400):
    """First and last echoes; every fourth pulse has one echo only."""
    rng = np.random.default_rng(5)
    first = np.column_stack(
        (rng.uniform(513_000, 513_100, n), rng.uniform(5_402_000, 5_402_100, n), rng.uniform(300, 320, n))
    )
    drop = np.where(np.arange(n) % 4 == 0, 0.0, rng.uniform(0.5, 15.0, n))
    last = first - np.column_stack((0.2 * drop, -0.1 * drop, drop))
    return np.round(first, 2), np.round(last, 2)


@pytest.mark.parametrize("with_intensity", [False, True])
@pytest.mark.parametrize("chunk_size", [1, 7, 1_000])
def test_first_and_last_echo_in_a_row_become_two_returns(tmp_path, with_intensity, chunk_size):
    first, last = pulses()
    intensity = [np.arange(len(first))[:, None] % 200] if with_intensity else []
    table = np.hstack([first, *intensity, last, *intensity])
    np.savetxt(tmp_path / "a.txt", table, fmt="%.2f")
    source = open_source(tmp_path / "a.txt")
    pieces = list(source.chunks(chunk_size))
    xyz = np.concatenate([piece.xyz for piece in pieces])
    number = np.concatenate([piece.return_number for piece in pieces])
    count = np.concatenate([piece.return_count for piece in pieces])
    assert max(map(len, pieces)) <= max(chunk_size, 2)
    assert source.info.has_returns
    assert any("first and last echo" in warning for warning in source.warnings)
    np.testing.assert_array_equal(xyz[number == 1], first)
    different = (first != last).any(axis=1)
    np.testing.assert_array_equal(xyz[number == 2], last[different])
    assert (count == 1).sum() == (~different).sum() == 100
    assert source.info.point_count == len(xyz) == 400 + 300


def test_colours_normals_and_return_fields_are_not_taken_for_echoes():
    rng = np.random.default_rng(2)
    first, last = pulses()
    assert looks_like_pulses(first, last)
    assert not looks_like_pulses(last, first)
    assert not looks_like_pulses(first, rng.integers(0, 256, first.shape).astype(float))
    normals = rng.normal(size=first.shape)
    assert not looks_like_pulses(first, normals / np.linalg.norm(normals, axis=1)[:, None])
    local = first - first.min(axis=0)
    assert not looks_like_pulses(local, rng.integers(0, 256, first.shape).astype(float))
    assert not looks_like_pulses(first, first)
    sphere = normals / np.linalg.norm(normals, axis=1)[:, None]
    assert not looks_like_pulses(sphere, sphere * [1.0, 1.0, 0.5])


def test_six_columns_with_colours_stay_one_point_a_row(tmp_path):
    first, _ = pulses()
    colours = np.random.default_rng(2).integers(0, 256, first.shape)
    np.savetxt(tmp_path / "a.txt", np.hstack([first, colours]), fmt="%.2f")
    source = open_source(tmp_path / "a.txt")
    assert source.info.point_count == 400
    assert not source.info.has_returns


def test_the_two_echoes_of_the_stuttgart_survey_are_recognised(tmp_path, shared_data):
    las = laspy.read(shared_data / "isprs" / "CSite2_orig-utm.laz")
    xyz, number = las.xyz, np.asarray(las.return_number)
    first, last = xyz[number == 1][::20], xyz[number == 2][::20]
    np.savetxt(tmp_path / "CSite2.txt", np.hstack([first, last]), fmt="%.2f")
    source = open_source(tmp_path / "CSite2.txt", ReadOptions(crs="EPSG:32632"))
    cloud = next(iter(source.chunks()))
    np.testing.assert_allclose(cloud.xyz[cloud.return_number == 1], first, atol=1e-6)
    assert 0.85 * len(last) < (cloud.return_number == 2).sum() < len(last)


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "NaN"])
def test_coordinates_that_are_not_finite_are_refused_when_opened(tmp_path, value):
    path = write(tmp_path / "a.xyz", f"1 2 3\n4 5 6\n7 {value} 9\n")
    with pytest.raises(InconsistentInputError, match=r"row 3 .* holds \[7\.0, (nan|inf|-inf), 9\.0\]") as caught:
        open_source(path)
    assert str(path) in str(caught.value)
    assert "Remove" in caught.value.fix


@pytest.mark.parametrize("line", ["7 8", "7 8 9 10", "7 8 x", "7,8,9", "7 8 9 # note"])
def test_a_row_unlike_the_others_is_named_by_its_line(tmp_path, line):
    path = write(tmp_path / "a.xyz", f"# x y z\n1 2 3\n4 5 6\n{line}\n7 8 9\n")
    with pytest.raises(UnreadableInputError, match=f"line 4 is '{line}', not 3 numbers"):
        open_source(path)


@pytest.mark.parametrize("row", ["513000,25;5402000,5;300,0", "513000,25 5402000,5 300,0", "1,2,3 4", "1;2,3"])
def test_decimal_commas_and_mixed_separators_are_refused(tmp_path, row):
    with pytest.raises(UnreadableInputError, match=r"mixes commas.*decimals with points"):
        open_source(write(tmp_path / "a.xyz", f"{row}\n{row}\n1 2 3\n"))


def test_text_without_points_is_refused(tmp_path):
    with pytest.raises(UnreadableInputError, match="no row of at least three numbers"):
        open_source(write(tmp_path / "a.txt", "hello\n1 2\n" * 100))
    with pytest.raises((EmptyInputError, UnreadableInputError)):
        open_source(write(tmp_path / "b.xyz", "x y z\n"))


def test_a_count_in_the_first_line_of_pts_is_held_against_the_rows(tmp_path):
    assert open_source(write(tmp_path / "a.pts", "2\n1 2 3\n4 5 6\n")).info.point_count == 2
    with pytest.raises(InconsistentInputError, match="promises 3 points, there are 2"):
        open_source(write(tmp_path / "b.pts", "3\n1 2 3\n4 5 6\n"))


def test_memory_is_bounded_by_the_piece_and_not_by_the_file(tmp_path):
    rng = np.random.default_rng(0)
    block = "".join(f"{x:.2f} {y:.2f} {z:.2f}\n" for x, y, z in rng.uniform(0, 1_000, (5_000, 3)))
    path = write(tmp_path / "a.xyz", block * 20)
    options = ReadOptions(crs="EPSG:28992")
    list(open_source(write(tmp_path / "b.xyz", block), options).chunks())
    source = open_source(path, options)
    with memory_below(1.8e6):  # the coordinates alone have 2.4 MB
        assert sum(map(len, source.chunks(5_000))) == 100_000


def test_a_file_without_line_ends_is_refused_without_reading_it_whole(tmp_path):
    path = write(tmp_path / "a.xyz", "1 2 3\n" + "1 " * 5_000_000)
    message = "a line after line 0 has more than 65536 bytes"
    with memory_below(3e6), pytest.raises(UnreadableInputError, match=message):
        next(open_source(path).chunks(1_000))


SWAPPED = "5402000.5{0}513000.25{0}300{0}17\n5402001{0}513001.5{0}301.25{0}80\n5402003{0}513002{0}299.5{0}3\n"


@pytest.mark.parametrize(
    ("header", "separator"),
    [
        ("northing,easting,height,intensity", ","),
        ("N;E;H;Intensity", ";"),
        ("Y,X,Alt,i", ","),
        ("Hochwert;Rechtswert;Höhe;Intensität", ";"),
        ('"Y [m]","X [m]","Z [m]","I"', ","),
        ("Y_m,X_m,Height_m,i", ","),
        ("Y-Coordinate,X-Coordinate,Elevation (ft),red light", ","),
        ("//Y X Z Intensity", " "),
        ("# Columns: n e h i", " "),
        ("# Nord Ost Hoehe i", " "),
        ("% Hoch Rechts Höhe i", " "),
        ("# Noord Oost Hoogte i", " "),
        ("northing easting height i\n# in metres\n", " "),
    ],
)
def test_columns_are_read_by_the_names_of_their_coordinates(tmp_path, header, separator):
    path = write(tmp_path / "a.csv", f"{header}\n{SWAPPED.format(separator)}")
    (cloud,) = open_source(path).chunks()
    np.testing.assert_array_equal(cloud.xyz, ROWS[:, :3])


@pytest.mark.parametrize(
    ("header", "separator", "named"),
    [
        ("northing,easting,level,i", ",", "which of them is z is not known"),
        ("lat;lon;ell;i", ";", "which of them is x or y or z is not known"),
        ("#northing;b;c;d", ";", "which of them is x or z is not known"),
        ("north east up i", " ", "which of them is z is not known"),
        ("# breite laenge Hoehe i", " ", "which of them is x or y is not known"),
        ("y x z", " ", "its header names 3 columns ('y', 'x', 'z'), its rows have 4"),
        ("y,x,z,i,class,", ",", "its header names 5 columns"),
        ("# y x z", " ", "its header names 3 columns"),
        ("northing,easting,level,i\nm,m,m,-", ",", "is not known"),
    ],
)
def test_a_header_that_is_half_understood_is_refused_with_its_names(tmp_path, header, separator, named):
    path = write(tmp_path / "a.csv", f"{header}\n{SWAPPED.format(separator)}")
    with pytest.raises(UnreadableInputError, match=r"Name the columns x, y and z") as caught:
        open_source(path)
    assert named in caught.value.problem


@pytest.mark.parametrize(
    "words",
    [
        "# exported by some tool",
        "// height above the sea",
        "# est accuracy 0.1 m",
        "# x y z of all returns",
        "Survey of 2023, block 7",
        "3",
        "A title\n\n# north of the river",
    ],
)
def test_words_above_the_rows_that_name_no_columns_change_nothing(tmp_path, words):
    rows = "513000.25 5402000.5 300 17\n513001.5 5402001 301.25 80\n513002 5402003 299.5 3\n"
    (cloud,) = open_source(write(tmp_path / "a.xyz", f"{words}\n{rows}")).chunks()
    np.testing.assert_array_equal(cloud.xyz, ROWS[:, :3])


def test_the_surest_of_several_names_of_a_coordinate_counts(tmp_path):
    path = write(tmp_path / "a.csv", "id,easting,height,y,x,z\n1,7,9,2,1,3\n2,8,9,3,2,4\n")
    (cloud,) = open_source(path).chunks()
    assert cloud.xyz.tolist() == [[1, 2, 3], [2, 3, 4]]
