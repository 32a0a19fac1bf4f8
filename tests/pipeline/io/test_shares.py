"""Shares of a file: together they are the file, however it is cut."""

import dataclasses
import functools
import operator
from collections import Counter

import numpy as np
import pytest

from pipeline.errors import InconsistentInputError, UnreadableInputError
from pipeline.io import ReadOptions, open_source
from pipeline.io.file_facts import Share
from pipeline.io.source import Findings

BOX = (84_010.0, 447_020.0, 84_030.0, 447_090.0)
N = 180_000
"""Points: more than three chunks of LAZ, as laspy writes them."""


def read_whole(source):
    return np.concatenate([piece.xyz for piece in source.chunks(7_000)]), source.findings


def read_in_shares(source, of):
    """The points of each share, and what was found of all."""
    parts, found = [], []
    for number in range(of):
        pieces = [piece.xyz for piece in source.chunks(7_000, Share(number=number, of=of))]
        assert all(0 < len(piece) <= 7_000 for piece in pieces)
        parts.append(np.concatenate(pieces) if pieces else np.empty((0, 3)))
        found.append(source.findings)
    return parts, functools.reduce(operator.add, found).of_whole(source.info)


@pytest.fixture
def written(tmp_path, points, write_las, write_copc):
    """Makes a file of some format with points of two classes."""

    def write(name):
        xyz = points(N)
        classes = np.where(np.arange(len(xyz)) % 7 == 0, 7, 2).astype(np.uint8)
        if name == "copc":
            return write_copc(tmp_path / "a.copc.laz", xyz, classification=classes)
        suffix, point_format = name.split(".")
        version = "1.4" if int(point_format) > 5 else "1.2"
        return write_las(
            tmp_path / f"a.{suffix}", xyz, version=version, point_format=int(point_format), classification=classes
        )

    return write


@pytest.mark.parametrize("box", [None, BOX])
@pytest.mark.parametrize("of", [1, 3, 50])
@pytest.mark.parametrize("name", ["las.1", "laz.1", "laz.6", "copc"])
def test_shares_hold_the_points_of_the_file_in_its_order(written, name, of, box):
    source = open_source(written(name), ReadOptions(bbox=box))
    assert source.info.is_divisible
    whole, found = read_whole(source)
    parts, together = read_in_shares(source, of)
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert together == found
    assert together.dropped["noise_class"] > 0
    if of == 3 and box is None:
        assert max(map(len, parts)) < 0.7 * len(whole)


def test_a_file_with_too_large_chunks_is_its_first_share(written, monkeypatch):
    path = written("laz.6")
    monkeypatch.setattr("pipeline.io.laz_chunks.CHUNK_SIZE_LIMIT", 10_000)
    source = open_source(path)
    whole, _ = read_whole(source)
    first, second = read_in_shares(source, 2)[0]
    np.testing.assert_array_equal(first, whole)
    assert len(second) == 0


def test_strays_are_judged_over_the_whole_file():
    few, many = Findings(n_read=1000, dropped=Counter(off_earth=20), off_earth=(1e9, 0.0, 0.0)), Findings(n_read=99_000)
    assert "20 of 100000 points do not lie on Earth, such as x 1000000000" in (few + many).warnings("a.laz")[0]
    with pytest.raises(InconsistentInputError, match="20 of 1000 points do not lie on Earth"):
        few.warnings("a.laz")


@pytest.mark.parametrize("name", ["laz.6", "copc"])
def test_a_damaged_chunk_fails_the_share_that_holds_it_and_no_other(written, name):
    path = written(name)
    before = open_source(path)
    chunks = before.file._chunks
    raw = bytearray(path.read_bytes())
    last = int(np.flatnonzero(chunks.counts)[-1])
    # the sizes of the layers follow the first record and the count
    at = int(chunks.offsets[last]) + chunks.item_size + 4
    raw[at : at + 4] = b"\xff\xff\xff\x7f"
    path.write_bytes(raw)
    source = open_source(path, known=dataclasses.replace(before.info, modified_ns=path.stat().st_mtime_ns))
    assert sum(map(len, source.chunks(7_000, Share(number=0, of=2)))) > 0
    with pytest.raises(UnreadableInputError, match="layers of the chunk at byte"):
        list(source.chunks(7_000, Share(number=1, of=2)))


@pytest.mark.parametrize("name", ["laz.1", "laz.6", "copc"])
def test_a_file_that_shrinks_while_a_share_is_read_is_reported(written, name):
    path = written(name)
    source = open_source(path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 20])
    with pytest.raises(UnreadableInputError, match="truncated"):
        list(source.chunks(7_000, Share(number=0, of=1)))
