"""COPC: a window is read through the octree and gives what laspy's own query and a plain read give."""

import struct

import laspy
import numpy as np
import pytest
from laspy.copc import Bounds
from shapely import Polygon

from pipeline.errors import UnreadableInputError
from pipeline.io import ReadOptions, open_source
from pipeline.io.copc import ENTRY, nodes_within, octree_info
from pipeline.io.file_facts import Window

BOX = (84_010.0, 447_020.0, 84_030.0, 447_040.0)


def sorted_points(source, chunk_size=1_000_000):
    pieces = [piece.xyz for piece in source.chunks(chunk_size)]
    xyz = np.concatenate(pieces) if pieces else np.empty((0, 3))
    return xyz[np.lexsort(xyz.T)]


def test_the_whole_file_streams_like_laz(tmp_path, points, write_copc):
    xyz = points(5_000)
    source = open_source(write_copc(tmp_path / "a.copc.laz", xyz))
    assert source.info.format == "copc"
    assert source.info.reference.epsg == 7415
    np.testing.assert_allclose(sorted_points(source, 333), xyz[np.lexsort(xyz.T)], atol=1e-6)


@pytest.mark.parametrize("chunk_size", [100, 1_000_000])
def test_a_window_gives_what_laspy_s_query_gives(tmp_path, points, write_copc, chunk_size):
    path = write_copc(tmp_path / "a.copc.laz", points(5_000))
    source = open_source(path, ReadOptions(bbox=BOX))
    found = sorted_points(source, chunk_size)
    with laspy.CopcReader.open(path) as reader:
        theirs = reader.query(Bounds(np.array(BOX[:2]), np.array(BOX[2:])))
    expected = np.column_stack((theirs.x, theirs.y, theirs.z))
    np.testing.assert_allclose(found, expected[np.lexsort(expected.T)], atol=1e-6)
    assert source.dropped["outside"] == 5_000 - len(found)
    assert all(len(piece) <= chunk_size for piece in source.chunks(chunk_size))


def test_nodes_outside_the_window_are_not_decoded(tmp_path, points, write_copc):
    path = write_copc(tmp_path / "a.copc.laz", points(5_000))
    with path.open("rb") as stream:
        info = octree_info(laspy.LasHeader.read_from(stream).vlrs[0])
        assert info is not None
        window = Window(x_min=BOX[0], y_min=BOX[1], x_max=BOX[2], y_max=BOX[3])
        nodes = nodes_within(path, stream, info, window, path.stat().st_size)
    # The root, and of the eight children the two above one another in the south-west.
    keys = sorted(zip(nodes["level"].tolist(), nodes["x"].tolist(), nodes["y"].tolist(), strict=True))
    assert keys == [(0, 0, 0), (1, 0, 0), (1, 0, 0)]


def test_an_area_of_interest_cuts_the_window_further(tmp_path, points, write_copc):
    xyz = points(5_000)
    triangle = Polygon([(84_010, 447_010), (84_060, 447_010), (84_010, 447_060)])
    source = open_source(write_copc(tmp_path / "a.copc.laz", xyz), ReadOptions(aoi=triangle))
    inside = (xyz[:, 0] >= 84_010) & (xyz[:, 1] >= 447_010) & (xyz[:, 0] + xyz[:, 1] <= 84_010 + 447_060)
    assert len(sorted_points(source)) == inside.sum()


def test_a_window_beside_the_file_gives_nothing(tmp_path, points, write_copc):
    path = write_copc(tmp_path / "a.copc.laz", points(500))
    source = open_source(path, ReadOptions(bbox=(0.0, 0.0, 10.0, 10.0)))
    assert list(source.chunks()) == []
    assert source.dropped["outside"] == 500


def test_a_hierarchy_that_leads_into_a_circle_ends(tmp_path, points, write_copc):
    path = write_copc(tmp_path / "a.copc.laz", points(500))
    raw = bytearray(path.read_bytes())
    root = struct.unpack_from("<Q", raw, 375 + 54 + 40)[0]
    # The entry that names the second page names the first one instead.
    struct.pack_into("<Q", raw, root + 5 * 32 + 16, root)
    struct.pack_into("<i", raw, root + 5 * 32 + 24, 6 * 32)
    path.write_bytes(raw)
    source = open_source(path, ReadOptions(bbox=(84_000.0, 447_000.0, 84_100.0, 447_100.0)))
    assert 0 < len(sorted_points(source)) < 500


def test_a_hierarchy_outside_the_file_is_refused(tmp_path, points, write_copc):
    path = write_copc(tmp_path / "a.copc.laz", points(500))
    raw = bytearray(path.read_bytes())
    struct.pack_into("<Q", raw, 375 + 54 + 40, len(raw) + 1_000)
    path.write_bytes(raw)
    source = open_source(path, ReadOptions(bbox=BOX))
    with pytest.raises(UnreadableInputError, match="octree page at byte"):
        list(source.chunks())
    assert sum(map(len, open_source(path).chunks())) == 500


def first_entry(raw):
    """Byte of the first entry of the root page."""
    return struct.unpack_from("<Q", raw, 375 + 54 + 40)[0]


@pytest.mark.parametrize(("field", "value"), [("count", 57), ("size", 2**31 - 1), ("offset", 7)])
def test_nodes_that_are_not_the_chunks_of_the_file_are_refused(tmp_path, points, write_copc, field, value):
    path = write_copc(tmp_path / "a.copc.laz", points(500))
    raw = bytearray(path.read_bytes())
    struct.pack_into({"offset": "<Q"}.get(field, "<i"), raw, first_entry(raw) + ENTRY.fields[field][1], value)
    path.write_bytes(raw)
    source = open_source(path, ReadOptions(bbox=BOX))
    with pytest.raises(UnreadableInputError, match="its nodes are not the compressed chunks of the file"):
        list(source.chunks())
    assert sum(map(len, open_source(path).chunks())) == 500


def test_a_chunk_that_two_nodes_name_is_refused(tmp_path, points, write_copc):
    path = write_copc(tmp_path / "a.copc.laz", points(500))
    raw = bytearray(path.read_bytes())
    at = first_entry(raw)
    # the place, the size and the count of the root instead of those of its first child
    raw[at + 32 + 16 : at + 64] = raw[at + 16 : at + 32]
    path.write_bytes(raw)
    whole = ReadOptions(bbox=(84_000.0, 447_000.0, 84_100.0, 447_100.0))
    with pytest.raises(UnreadableInputError, match="its nodes are not the compressed chunks of the file"):
        list(open_source(path, whole).chunks())


def test_impossible_levels_are_refused(tmp_path, points, write_copc):
    path = write_copc(tmp_path / "a.copc.laz", points(500))
    raw = bytearray(path.read_bytes())
    struct.pack_into("<i", raw, first_entry(raw), 2_000)
    path.write_bytes(raw)
    with pytest.raises(UnreadableInputError, match="impossible levels"):
        list(open_source(path, ReadOptions(bbox=BOX)).chunks())


def test_a_file_without_its_hierarchy_is_read_whole_like_laz(tmp_path, points, write_copc):
    path = write_copc(tmp_path / "a.copc.laz", points(500))
    raw = bytearray(path.read_bytes())
    (evlr_at,) = struct.unpack_from("<Q", raw, 235)
    struct.pack_into("<QI", raw, 235, 0, 0)
    path.write_bytes(raw[:evlr_at])
    assert sum(map(len, open_source(path).chunks())) == 500
    with pytest.raises(UnreadableInputError, match="octree page at byte"):
        list(open_source(path, ReadOptions(bbox=BOX)).chunks())
