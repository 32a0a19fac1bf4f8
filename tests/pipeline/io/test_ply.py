"""PLY in three encodings, and PLY that cannot be used."""

import numpy as np
import pytest
from measured import memory_below

from pipeline.errors import EmptyInputError, InconsistentInputError, UnreadableInputError
from pipeline.io import ReadOptions, open_source

TYPES = [("x", "double"), ("y", "double"), ("z", "float"), ("red", "uchar"), ("scalar_Classification", "float")]
NUMPY = {"double": "f8", "float": "f4", "uchar": "u1"}
RD = ReadOptions(crs="EPSG:7415")


def table(points, n):
    xyz = points(n)
    rows = np.zeros(n, dtype=[(name, NUMPY[kind]) for name, kind in TYPES])
    rows["x"], rows["y"], rows["z"] = xyz.T
    rows["red"] = 200
    rows["scalar_Classification"] = np.where(np.arange(n) % 10 == 0, 7.0, 6.0)
    return rows


def header(encoding, count, before="", after=""):
    properties = "".join(f"property {kind} {name}\n" for name, kind in TYPES)
    return (
        f"ply\nformat {encoding} 1.0\ncomment from a test\nobj_info none\n{before}"
        f"element vertex {count}\n{properties}{after}end_header\n"
    ).encode()


def body(rows, encoding):
    if encoding == "ascii":
        return "".join(" ".join(repr(value) for value in row.item()) + "\n" for row in rows).encode()
    order = "<" if encoding == "binary_little_endian" else ">"
    return rows.astype(rows.dtype.newbyteorder(order)).tobytes()


ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]
FACES = "element face 1\nproperty list uchar int vertex_indices\n"
CAMERA = "element camera 2\nproperty double focal\nproperty int id\n"


def camera_and_faces(encoding):
    if encoding == "ascii":
        return b"1.5 1\n2.5 2\n", b"3 0 1 2\n"
    order = "<" if encoding == "binary_little_endian" else ">"
    camera = np.array([(1.5, 1), (2.5, 2)], dtype=[("focal", f"{order}f8"), ("id", f"{order}i4")]).tobytes()
    return camera, b"\3" + np.array([0, 1, 2], dtype=f"{order}i4").tobytes()


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("with_others", [False, True])
def test_every_encoding_gives_the_same_points(tmp_path, points, encoding, with_others):
    rows = table(points, 500)
    path = tmp_path / "a.ply"
    camera, faces = camera_and_faces(encoding) if with_others else (b"", b"")
    before, after = (CAMERA, FACES) if with_others else ("", "")
    path.write_bytes(header(encoding, 500, before, after) + camera + body(rows, encoding) + faces)
    source = open_source(path, RD)
    pieces = list(source.chunks(70))
    xyz = np.concatenate([piece.xyz for piece in pieces])
    kept = rows[np.arange(500) % 10 != 0]
    np.testing.assert_array_equal(xyz, np.column_stack([kept["x"], kept["y"], kept["z"].astype(np.float64)]))
    assert source.dropped == {"withheld": 0, "noise_class": 50, "outside": 0, "off_earth": 0}
    assert max(map(len, pieces)) <= 70
    info = source.info
    assert (info.format, info.point_count, info.has_classes, info.has_returns) == ("ply", 500, True, False)
    assert info.bounds_m[0] == rows["x"].min()
    assert info.warnings == ()


def test_return_fields_and_times_are_used(tmp_path):
    text = (
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n"
        "property uchar return_number\nproperty uchar number_of_returns\nproperty double gps_time\nend_header\n"
        "1 2 3 1 2 10.5\n2 3 2 2 2 11.5\n"
    )
    (tmp_path / "a.ply").write_text(text)
    source = open_source(tmp_path / "a.ply")
    (cloud,) = source.chunks()
    assert cloud.return_number.tolist() == [1, 2]
    assert cloud.return_count.tolist() == [2, 2]
    assert cloud.gps_time.tolist() == [10.5, 11.5]
    assert source.info.has_returns
    assert source.info.has_gps_time
    assert source.info.facts.dimensions[2:4] == (("z", "f8"), ("return_number", "u1"))


def test_single_precision_that_is_too_coarse_is_reported(tmp_path):
    dtype = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    rows = np.array([(513_000, 5_402_000, 300), (513_010, 5_402_010, 310)], dtype=dtype)
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    head += b"property float x\nproperty float y\nproperty float z\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head + rows.tobytes())
    reported = open_source(tmp_path / "a.ply", RD).info.warnings
    assert [warning[0] for warning in reported] == ["x", "y"]
    assert "steps are 0.5 units" in reported[1]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_coordinates_that_are_not_finite_are_refused_when_opened(tmp_path, points, encoding, value):
    rows = table(points, 50)
    rows["y"][30] = value
    path = tmp_path / "a.ply"
    path.write_bytes(header(encoding, 50) + body(rows, encoding))
    with pytest.raises(InconsistentInputError, match="vertex 31 has the coordinates") as caught:
        open_source(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("claim", [49, 51, 4_000_000_000])
def test_a_count_that_is_not_the_data_s_is_refused(tmp_path, points, encoding, claim):
    path = tmp_path / "a.ply"
    path.write_bytes(header(encoding, claim) + body(table(points, 50), encoding))
    with memory_below(2e6), pytest.raises(InconsistentInputError, match=f"promises {claim} vertices"):
        open_source(path)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_truncated_file_is_refused(tmp_path, points, encoding):
    path = tmp_path / "a.ply"
    content = header(encoding, 50) + body(table(points, 50), encoding)
    path.write_bytes(content[:-40])
    with pytest.raises((InconsistentInputError, UnreadableInputError), match=r"50 (vertices )?|are damaged"):
        open_source(path)
    path.write_bytes(content[:60])
    with pytest.raises(UnreadableInputError, match=r"truncated|has the line"):
        open_source(path)


def test_zero_vertices_are_an_empty_input(tmp_path):
    (tmp_path / "a.ply").write_bytes(header("ascii", 0))
    with pytest.raises(EmptyInputError, match="0 vertices"):
        open_source(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"element vertex", b"element node", "0 vertex elements"),
        (b"property double x", b"property double a", "have the properties a y z"),
        (b"property uchar red", b"property list uchar int red", "no lists there"),
        (b"format ascii", b"format binary_pdp_endian", "has the line"),
        (b"property double y", b"property quad y", "has the line"),
        (b"element vertex 50", b"element vertex many", "has the line"),
        (b"format ascii 1.0\n", b"", "no format"),
        (b"\nend_header", b"", "has the line"),
    ],
)
def test_headers_that_mean_nothing_are_refused_with_their_line(tmp_path, points, old, new, words):
    path = tmp_path / "a.ply"
    content = header("ascii", 50) + body(table(points, 50), "ascii")
    path.write_bytes(content.replace(old, new, 1))
    with pytest.raises(UnreadableInputError, match=words):
        open_source(path)


def test_lists_before_binary_vertices_are_refused(tmp_path, points):
    path = tmp_path / "a.ply"
    path.write_bytes(
        header("binary_little_endian", 5, FACES) + bytes(13) + body(table(points, 5), "binary_little_endian")
    )
    with pytest.raises(UnreadableInputError, match="Write the vertices first"):
        open_source(path)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_memory_is_bounded_by_the_piece_and_not_by_the_file(tmp_path, points, encoding):
    path = tmp_path / "a.ply"
    rows = np.tile(table(points, 1_000), 80)
    path.write_bytes(header(encoding, len(rows)) + body(rows[:1_000], encoding) * 80)
    source = open_source(path, RD)
    with memory_below(1.5e6):  # the coordinates alone have 1.7 MB
        assert sum(map(len, source.chunks(5_000))) == 72_000
