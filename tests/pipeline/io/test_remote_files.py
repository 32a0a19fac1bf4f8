"""Files behind URLs: read by ranges or fetched, from servers of every temper."""

import os

import laspy
import numpy as np
import pytest
from hostile_host import hostile_host
from one_file_site import CONTENT, one_file_site

from pipeline.backoff import Backoff
from pipeline.errors import UnreadableInputError
from pipeline.extras.remote import urls
from pipeline.extras.remote.remote_file import BLOCK_BYTES, BLOCKS_KEPT, RemoteFile
from pipeline.io import ReadOptions, open_source
from pipeline.io.places import file_at, on_this_machine

QUICK = Backoff(attempts=3, first_s=0.01, longest_s=0.01)


@pytest.fixture
def site():
    with one_file_site() as site:
        yield site


def test_a_part_is_read_without_the_rest(site):
    with file_at(site.url).open("rb") as stream:
        stream.seek(2_000_000)
        assert stream.read(1000) == CONTENT[2_000_000:2_001_000]
        assert stream.seek(-10, os.SEEK_END) == len(CONTENT) - 10
        assert stream.read() == CONTENT[-10:]
    ranges = [asked for method, asked in site.asked if method == "GET"]
    assert len(ranges) == 2
    assert all(asked is not None for asked in ranges)


def test_anyone_who_reads_on_reads_larger_pieces_and_each_byte_once(site):
    with file_at(site.url).open("rb") as stream:
        parts = list(iter(lambda: stream.read(10_000), b""))
    assert b"".join(parts) == CONTENT
    spans = site.spans()
    assert len(spans) < len(CONTENT) / BLOCK_BYTES / 2
    assert sum(last - first + 1 for first, last in spans) == len(CONTENT)


def test_memory_is_bounded_however_much_is_read(site):
    site.content = CONTENT * 10
    file = RemoteFile(site.url)
    with file.open("rb") as stream:
        while stream.read(1 << 20):
            assert sum(map(len, file._blocks.values())) <= BLOCKS_KEPT * BLOCK_BYTES


@pytest.mark.parametrize(("ranges", "says_size"), [(True, True), (False, True), (False, False)])
def test_a_file_is_fetched_from_servers_that_know_ranges_and_others(site, tmp_path, ranges, says_size):
    site.ranges, site.says_size = ranges, says_size
    file = RemoteFile(site.url, QUICK)
    file.fetch(tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == CONTENT
    assert file.stat().st_size == len(CONTENT)
    with file.open("rb") as stream:
        stream.seek(1_000_000)
        assert stream.read(10) == CONTENT[1_000_000:1_000_010]


def test_busy_servers_are_asked_again_and_counted(site, tmp_path):
    site.faults = [503, 429]
    RemoteFile(site.url, QUICK).fetch(tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == CONTENT


def test_attempts_do_not_multiply_where_ranges_are_not_known(site):
    site.ranges = False
    file = RemoteFile(site.url, QUICK)
    file.stat()
    site.asked.clear()
    site.faults = [200, *[503] * 99]
    with pytest.raises(UnreadableInputError, match="the server is busy at all of 3 attempts"):
        file.read_at(1_000_000, 10)
    assert len(site.asked) <= 2 * QUICK.attempts


def test_what_cannot_be_fetched_is_reported_by_url_status_and_fix_without_its_secrets(site):
    site.faults = [404] * 9
    with pytest.raises(UnreadableInputError, match=r"a\.laz\?query-.*: cannot be fetched: .*404.*Check the name"):
        RemoteFile(f"{site.url}?token=hidden", QUICK).stat()
    site.faults = [503] * 99
    with pytest.raises(UnreadableInputError, match=r"the server is busy at all of 3 attempts .*503") as reported:
        RemoteFile(site.url.replace("http://", "http://me:hidden@") + "?token=hidden", QUICK).stat()
    assert "hidden" not in str(reported.value)
    assert reported.value.__cause__ is None


def test_a_server_that_is_not_there_is_reported():
    with pytest.raises(UnreadableInputError, match="the connection broke at all of 3 attempts"):
        RemoteFile("http://127.0.0.1:9/a.laz", QUICK).stat()


@pytest.mark.parametrize("temper", ["status", "headers", "body"])
def test_a_request_ends_in_time_however_often_a_byte_comes(temper, monkeypatch):
    monkeypatch.setattr(urls, "REQUEST_S", 0.5)
    with hostile_host(pause_s=0.02) as host:
        file = RemoteFile(f"http://{host.origin}/{temper}/a.laz", Backoff(attempts=1, first_s=0.0))
        with pytest.raises(UnreadableInputError, match="no answer in time"):
            file.read_at(0, 1000)


def test_a_file_that_changes_once_is_fetched_again_and_one_that_never_rests_is_refused(site, tmp_path):
    file = RemoteFile(site.url, QUICK)
    file.stat()
    site.content, site.etag = CONTENT[:2_000_000], '"2"'
    with pytest.raises(UnreadableInputError):  # its end is not there any more
        file.read_at(2_500_000, 10)

    class Restless(RemoteFile):
        def read_at(self, begin, length):
            raise NotImplementedError

        def _range(self, begin, end):
            content = super()._range(begin, end)
            if changes and changes.pop():
                site.etag = f'"{len(changes)}-{begin}"'
            return content

    changes = [False, True]
    Restless(site.url, QUICK).fetch(tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == site.content
    changes = [True] * 9
    with pytest.raises(UnreadableInputError, match="changes while it is read"):
        Restless(site.url, QUICK).fetch(tmp_path / "copy")


def test_fetching_stops_when_the_run_is_called_off(site, tmp_path):
    def check() -> None:
        raise InterruptedError("cancelled")

    with pytest.raises(InterruptedError):
        RemoteFile(site.url).fetch(tmp_path / "copy", check)
    assert [method for method, _ in site.asked] == ["HEAD"]


def test_a_copy_for_libraries_goes_when_it_was_used(site):
    with on_this_machine(f"{site.url}?x=1") as path:
        assert path.read_bytes() == CONTENT
        assert path.suffix == ".laz"
    assert not path.parent.exists()


def test_the_header_and_the_points_of_a_remote_tile_are_those_of_the_local_one(site, tmp_path):
    rng = np.random.default_rng(1)
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.scales, las.header.offsets = [0.01] * 3, [0.0] * 3
    for name in "xyz":
        setattr(las, name, rng.uniform(0.0, 300.0, 1_200_000))
    las.write(tmp_path / "a.laz")
    site.content = (tmp_path / "a.laz").read_bytes()
    here, there = (open_source(place, ReadOptions(crs="EPSG:28992")) for place in (tmp_path / "a.laz", site.url))
    assert there.info.bounds_m == here.info.bounds_m
    assert there.info.point_count == here.info.point_count
    assert there.info.path == site.url
    # eight of its 24 chunks are sampled
    assert sum(last - first + 1 for first, last in site.spans()) < 0.5 * len(site.content)
    clouds = [np.vstack([cloud.xyz for cloud in source.chunks()]) for source in (here, there)]
    assert np.array_equal(*clouds)


def test_of_a_remote_octree_only_the_nodes_in_the_window_are_fetched(site, tmp_path, points, write_copc):
    path = write_copc(tmp_path / "a.copc.laz", points(600_000))
    site.content = path.read_bytes()
    box = ReadOptions(bbox=(84_010.0, 447_020.0, 84_030.0, 447_040.0))
    here, there = (open_source(place, box) for place in (path, site.url))
    assert there.info.facts == here.info.facts
    read = [np.concatenate([piece.xyz for piece in source.chunks()]) for source in (here, there)]
    np.testing.assert_array_equal(*read)
    assert here.findings == there.findings
    chunks = here.file._chunks
    spans, fetched = site.spans(), []
    for offset, size in zip(chunks.offsets.tolist(), chunks.sizes.tolist(), strict=True):
        middle = range(offset + BLOCK_BYTES, offset + size - BLOCK_BYTES)
        fetched.append(any(first < middle.stop and last >= middle.start for first, last in spans))
    # the root, and the two children above one another in the south-west
    assert sum(fetched) == 3
    assert fetched[0]


def test_a_damaged_node_of_a_remote_octree_is_reported_when_it_is_read(site, tmp_path, points, write_copc):
    path = write_copc(tmp_path / "a.copc.laz", points(20_000))
    chunks = open_source(path).file._chunks
    raw = bytearray(path.read_bytes())
    at = int(chunks.offsets[3]) + chunks.item_size + 4
    raw[at : at + 4] = b"\xff\xff\xff\x7f"
    site.content = bytes(raw)
    with pytest.raises(UnreadableInputError, match="layers of the chunk at byte"):
        list(open_source(site.url).chunks())
    whole = ReadOptions(bbox=(84_000.0, 447_000.0, 84_100.0, 447_100.0))
    with pytest.raises(UnreadableInputError, match="layers of the chunk at byte"):
        list(open_source(site.url, whole).chunks())
