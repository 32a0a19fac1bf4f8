"""Temporary folders: private, gone at the end, and of killed processes gone when the next one is made."""

import fcntl
import os
import signal
import stat
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipeline.extras.vector_files.nearby import POLYGONS
from pipeline.extras.vector_files.vector_archive import unpacked
from pipeline.io.temporary import remove_left_folders, temporary_folder


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """A zip archive with one vector file."""
    path = tmp_path / "houses.zip"
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("houses.gpkg", b"SQLite format 3\0" + bytes(1000))
    return path


@contextmanager
def another_process(work: Callable[[Callable[[], None]], None]) -> Iterator[int]:
    """A process that works until it is killed; it has called the argument of `work`, and waits."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.close(reading)

        def wait() -> None:
            os.write(writing, b"!")
            signal.pause()

        try:
            work(wait)
        finally:
            os._exit(1)
    os.close(writing)
    try:
        assert os.read(reading, 1) == b"!"
        yield child
    finally:
        os.close(reading)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_a_folder_is_private_and_gone_at_the_end_also_after_an_error(place: Path) -> None:
    with temporary_folder() as folder:
        assert folder.parent == place
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        (folder / "deep").mkdir()
        (folder / "deep" / "file").write_bytes(b"1")
    assert list(place.iterdir()) == []
    with pytest.raises(ValueError, match="broken"), temporary_folder():
        raise ValueError("broken")
    assert list(place.iterdir()) == []


def test_several_folders_of_one_process_do_not_remove_one_another(place: Path) -> None:
    with temporary_folder() as first, temporary_folder() as second:
        assert remove_left_folders() == []
        assert sorted(place.iterdir()) == sorted((first, second))


def test_only_folders_of_this_kind_that_no_one_locks_are_left(place: Path, tmp_path: Path) -> None:
    with temporary_folder() as folder:
        kind = folder.name[: -len(folder.name.rpartition("-")[2])]
    names = ("left", "locked", "linked", "file")
    left, locked, linked, file = (place / f"{kind}{name}" for name in names)
    left.mkdir()
    locked.mkdir()
    (tmp_path / "elsewhere").mkdir()
    linked.symlink_to(tmp_path / "elsewhere")
    file.write_bytes(b"1")
    (place / "gablework-of-another-kind").mkdir()
    handle = os.open(locked, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    assert remove_left_folders() == [left]
    assert not left.exists()
    os.close(handle)
    assert remove_left_folders() == [locked]
    assert len(list(place.iterdir())) == 3
    assert (tmp_path / "elsewhere").is_dir()


@pytest.mark.slow
def test_what_a_killed_process_unpacked_goes_when_the_next_one_unpacks(place: Path, archive: Path) -> None:
    def read(wait: Callable[[], None]) -> None:
        with unpacked(archive, None, POLYGONS):
            wait()

    with another_process(read) as child:
        (inner,) = place.rglob("houses.gpkg")
        with unpacked(archive, None, POLYGONS) as (path, _):
            assert path.is_file()
        assert inner.is_file(), "its process is alive"
        os.kill(child, signal.SIGKILL)
        os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
        assert inner.is_file(), "a killed process removes nothing"
        with unpacked(archive, None, POLYGONS) as (path, _):
            assert not inner.exists()
            assert path.is_file()
    assert list(place.iterdir()) == []
