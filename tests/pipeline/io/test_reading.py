"""The time limit of an input, and what is not a file."""

import functools
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from las_files import write_las

from pipeline.errors import UnreadableInputError
from pipeline.io import open_source, sha256_of
from pipeline.io.reading import heard_by, moved, one_input, set_input_timeout, stalled
from pipeline.options import ResourceOptions


@pytest.fixture(autouse=True)
def usual_limit() -> Iterator[None]:
    yield
    set_input_timeout(ResourceOptions.input_timeout_s)


def left_s() -> float:
    return signal.getitimer(signal.ITIMER_REAL)[0]


def test_waiting_for_an_input_ends_after_the_limit_with_its_name_and_the_option() -> None:
    waited, written = os.pipe()
    set_input_timeout(0.2)
    words = r"a\.laz: nothing more .* for 0\.2 s\. .*--input-timeout"
    with pytest.raises(UnreadableInputError, match=words), one_input("a.laz"):
        os.read(waited, 1)
    os.close(waited)
    os.close(written)
    assert (left_s(), signal.getsignal(signal.SIGALRM)) == (0.0, signal.SIG_DFL)


def test_whatever_is_read_begins_the_limit_anew() -> None:
    set_input_timeout(1000.0)
    with one_input("a.laz"):
        while left_s() > 999.99:
            pass
        before = left_s()
        moved()
        assert before <= 999.99 < left_s() <= 1000.0
        with one_input("b.laz"):  # within another one
            assert left_s() > 999.0
        assert left_s() > 999.0
    assert left_s() == 0.0


def test_no_alarm_is_set_in_a_thread_or_where_another_watches_or_uses_it() -> None:
    seen: list[float] = []

    def look() -> None:
        with one_input("a.laz"):
            seen.append(left_s())

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    with heard_by(lambda: None):
        look()
    before = signal.signal(signal.SIGALRM, signal.SIG_IGN)
    try:
        look()
    finally:
        signal.signal(signal.SIGALRM, before)
    assert seen == [0.0, 0.0, 0.0]


def test_every_reader_reports_its_progress(tmp_path: Path) -> None:
    xyz = np.column_stack([np.arange(400_000.0, 400_100.0)] * 2 + [np.full(100, 7.0)])
    las, laz = write_las(tmp_path / "a.las", xyz), write_las(tmp_path / "a.laz", xyz)
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in xyz.tolist())
    text, ply = tmp_path / "a.xyz", tmp_path / "a.ply"
    text.write_text(rows)
    columns = "".join(f"property double {axis}\n" for axis in "xyz")
    ply.write_text(f"ply\nformat ascii 1.0\nelement vertex 100\n{columns}end_header\n{rows}")
    for path in (las, laz, text, ply):
        reports: list[int] = []
        with heard_by(functools.partial(reports.append, 1)):
            source = open_source(path)
            opened = len(reports)
            assert sum(map(len, source.chunks(10))) == 100
        assert opened >= 1
        assert len(reports) - opened >= 10 if path != text else len(reports) > opened
    hashed: list[int] = []
    with heard_by(lambda: hashed.append(1)):
        sha256_of(las)
    assert hashed


def test_an_input_that_stalled_keeps_its_words_from_process_to_process() -> None:
    error = stalled("a.laz", 600.0)
    assert str(type(error)(*error.__reduce__()[1])) == str(error)


def test_a_pipe_is_refused_before_it_is_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.laz")
    with pytest.raises(UnreadableInputError, match=r"a\.laz: a pipe or a device, not a file\. Write it to a file"):
        open_source(tmp_path / "a.laz")
