"""LAZ that the decoder does not expect: files of LASzip 1, panics, and numbers beyond its own."""

import os
import struct
import subprocess
import sys
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pytest
from las_files import write_las

from pipeline.console import ExitCode
from pipeline.errors import UnreadableInputError
from pipeline.io import open_source
from pipeline.io.laz_chunks import decoding
from pipeline.runtime.isolation.start_up import WITHOUT_THREADS


@pytest.fixture
def xyz() -> np.ndarray:
    return np.random.default_rng(1).uniform(0.0, 100.0, (3000, 3))


def of_laszip_1(folder: Path, xyz: np.ndarray, chunk_size: int) -> Path:
    """A file compressed point by point: a file of one chunk without the table of chunks and the offset to it."""
    path = write_las(folder / "chunk.laz", xyz, point_format=1)
    raw = path.read_bytes()
    begin = struct.unpack_from("<I", raw, 96)[0]
    table = struct.unpack_from("<q", raw, begin)[0]
    record = raw.index(b"laszip encoded") - 2 + 54
    head = bytearray(raw[:begin])
    struct.pack_into("<H", head, record, 1)
    struct.pack_into("<I", head, record + 12, chunk_size)
    made = folder / "pointwise.laz"
    made.write_bytes(bytes(head) + raw[begin + 8 : table])
    return made


@pytest.mark.parametrize("chunk_size", [0, 1, 50_000])
def test_a_file_without_chunks_is_read_from_its_first_point_on(
    tmp_path: Path, xyz: np.ndarray, chunk_size: int
) -> None:
    path = of_laszip_1(tmp_path, xyz, chunk_size)
    expected = laspy.read(tmp_path / "chunk.laz")
    source = open_source(path)
    found = np.concatenate([cloud.xyz for cloud in source.chunks(700)])
    assert np.array_equal(found, np.column_stack([expected.x, expected.y, expected.z]))
    assert source.info.point_count == 3000


@pytest.mark.parametrize("kept", [0.02, 0.5, 0.97])
def test_a_file_without_chunks_that_is_cut_off_is_refused(tmp_path: Path, xyz: np.ndarray, kept: float) -> None:
    path = of_laszip_1(tmp_path, xyz, 0)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * kept) + 400])
    with pytest.raises(UnreadableInputError, match=r"pointwise\.laz: .*damaged or truncated"):
        list(open_source(path).chunks(700))


def test_a_panic_of_the_decoder_is_a_fault_of_the_file(
    tmp_path: Path, xyz: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = of_laszip_1(tmp_path, xyz, 0)
    monkeypatch.setattr("pipeline.io.las.decodable_record", lambda record: record)
    with pytest.raises(UnreadableInputError, match=r"pointwise\.laz: .*the decoder met what cannot be"):
        open_source(path)


def test_other_ends_of_a_process_pass_through() -> None:
    for error in (KeyboardInterrupt, SystemExit):
        with pytest.raises(error), decoding():
            raise error
    with pytest.raises(lazrs.LazrsError, match="more memory than there is"), decoding():
        raise MemoryError


def test_a_chunk_table_with_numbers_beyond_all_files_is_refused(
    tmp_path: Path, xyz: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_las(tmp_path / "a.laz", xyz)
    monkeypatch.setattr("lazrs.read_chunk_table", lambda *_: [(2**64 - 1, 7)])
    with pytest.raises(UnreadableInputError, match=r"a\.laz: the table of compressed chunks is damaged"):
        open_source(path)


def changing_without_end(folder: Path, point_format: int) -> Path:
    """A file whose GPS times change from one sequence to another without end: most of its chunk is one byte."""
    rng = np.random.default_rng(1)
    laid = write_las(folder / "whole.laz", rng.uniform(0.0, 100.0, (5000, 3)), point_format=point_format)
    las = laspy.read(laid)
    las.gps_time = np.cumsum(rng.uniform(0.0, 1e-3, 5000)) + rng.integers(0, 3, 5000) * 1e5
    las.write(laid)
    raw = bytearray(laid.read_bytes())
    begin = struct.unpack_from("<I", raw, 96)[0] + 2000
    raw[begin : begin + 20_000] = b"\xff" * 20_000
    path = folder / "changing.laz"
    path.write_bytes(raw)
    return path


@pytest.mark.parametrize("command", [("inspect",), ("reconstruct", "--workers", "0", "--out", "run")])
@pytest.mark.parametrize("point_format", [1, 3])
def test_a_file_on_which_the_decoder_crashes_is_refused_by_name(
    tmp_path: Path, point_format: int, command: tuple[str, ...]
) -> None:
    path = changing_without_end(tmp_path, point_format)
    words = [sys.executable, "-m", "pipeline.cli", command[0], path.name, *command[1:]]
    made = subprocess.run(words, cwd=tmp_path, check=False, capture_output=True, text=True)
    assert made.returncode == ExitCode.INPUT, made.stderr
    said = "changing.laz: it cannot be read: the process that decoded some of its points was ended by signal"
    assert said in made.stderr


def test_what_is_done_apart_returns_raises_and_leaves_nothing_behind(tmp_path: Path) -> None:
    # in a process of its own: the one of the tests has threads
    script = """
import os, signal
from pathlib import Path
from pipeline.errors import EmptyInputError
from pipeline.io.apart import apart
from pipeline.io.reading import heard_by, moved

seen, here = [], os.getpid()

def long():
    for _ in range(3):
        moved()
    return os.getpid(), bytes(10**6)

def empty():
    raise EmptyInputError("a.laz", "no points", "none")

def hangs():
    signal.pause()

def alarm(*_):
    raise TimeoutError

with heard_by(lambda: seen.append(1)):
    pid, sent = apart(long, "a.laz")
assert pid != here and sent == bytes(10**6) and seen
try:
    apart(empty, "a.laz")
except EmptyInputError as error:
    print(error)
signal.signal(signal.SIGALRM, alarm)
signal.setitimer(signal.ITIMER_REAL, 0.2)
try:
    apart(hangs, "a.laz")
except TimeoutError:
    print("ended")
assert not Path(f"/proc/{here}/task/{here}/children").read_text()
"""
    env = {**os.environ, **WITHOUT_THREADS}
    made = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=env, check=True, capture_output=True, text=True
    )
    assert made.stdout.split("\n")[:2] == ["a.laz: no points. none", "ended"]
