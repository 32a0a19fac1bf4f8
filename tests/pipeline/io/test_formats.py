"""Formats are recognised by content, and paths, folders and patterns become a sorted list of files."""

import os
from pathlib import Path

import pytest

from pipeline.errors import UnreadableInputError
from pipeline.io import find_inputs, open_source
from pipeline.io.formats import FORMATS, recognise_format


@pytest.fixture
def folder(tmp_path, points, write_las):
    """A folder with three tiles, a point table, a text that is none, and other things."""
    for name in ("b.laz", "a.las", "C.LAZ"):
        write_las(tmp_path / name, points(10))
    (tmp_path / "d.txt").write_text("x y z\n1 2 3\n")
    (tmp_path / "readme.txt").write_text("These are the tiles of 2026.\nEnjoy.\n")
    (tmp_path / "picture.png").write_bytes(b"\x89PNG")
    (tmp_path / ".hidden.laz").write_bytes(b"LASF")
    (tmp_path / "below").mkdir()
    write_las(tmp_path / "below" / "e.laz", points(10))
    return tmp_path


def names(paths):
    return [Path(path).name for path in paths]


def test_a_folder_gives_its_point_files_sorted(folder):
    assert names(find_inputs([folder])) == ["C.LAZ", "a.las", "b.laz", "d.txt"]


def test_patterns_files_and_folders_together_give_each_file_once(folder):
    found = find_inputs([folder / "*.laz", str(folder), folder / "a.las", folder / "below" / ".." / "b.laz"])
    assert names(found) == ["C.LAZ", "a.las", "b.laz", "d.txt"]
    assert names(find_inputs([str(folder / "**" / "e.laz")])) == ["e.laz"]


def test_a_file_that_is_named_like_a_pattern_is_a_file(folder):
    odd = folder / "tile[1].laz"
    odd.write_bytes((folder / "b.laz").read_bytes())
    assert find_inputs([odd]) == [os.path.realpath(odd)]


def test_an_empty_folder_and_one_without_points_are_separated(tmp_path):
    with pytest.raises(UnreadableInputError, match="the folder is empty"):
        find_inputs([tmp_path])
    (tmp_path / "notes.txt").write_text("nothing here\n")
    with pytest.raises(UnreadableInputError, match=r"none of the 1 files.*Valid are LAS"):
        find_inputs([tmp_path])


def test_a_missing_file_an_empty_pattern_and_no_input_are_reported(tmp_path):
    with pytest.raises(UnreadableInputError, match="no such file"):
        find_inputs([tmp_path / "missing.laz"])
    with pytest.raises(UnreadableInputError, match="matches no file"):
        find_inputs([tmp_path / "*.laz"])
    with pytest.raises(UnreadableInputError, match=r"a\.laz: no such file.*1 more input .*b\.laz: no such file"):
        find_inputs([tmp_path / "a.laz", tmp_path / "b.laz"])
    with pytest.raises(UnreadableInputError, match="no input files are given"):
        find_inputs([])


def test_an_unreadable_folder_is_reported(tmp_path, monkeypatch):
    def refuse(self):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(UnreadableInputError, match=r"the folder cannot be read \(Permission denied\)"):
        find_inputs([tmp_path])


def test_a_folder_given_as_a_file_is_reported(tmp_path):
    with pytest.raises(UnreadableInputError, match="a folder, not a file"):
        open_source(tmp_path)


def test_the_content_decides_and_not_the_name(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.laz", points(10))
    renamed = path.rename(tmp_path / "a.bin")
    assert recognise_format(renamed).name == "las"
    table = tmp_path / "points.dat"
    table.write_text("1.0 2.0 3.0\n")
    assert recognise_format(table).name == "ascii"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.xyz.gz", b"\x1f\x8b\x08", "gzip"),
        ("a.tif", b"II*\0", "TIFF"),
        ("a.gpkg", b"SQLite format 3\0", "footprints"),
        ("a.e57", b"ASTM-E57", "convert"),
        ("a.ply", b"solid", "not a PLY file"),
        ("a.asc", b"ncols 3\nnrows 2\n1 2 3\n4 5 6\n", "raster"),
        ("a.foo", b"\0\1\2\3", "format not known"),
        ("a.foo", b"hello world\n", "format not known"),
        ("a.txt", b"1 2 3\0", "format not known"),
    ],
)
def test_other_formats_are_refused_and_the_valid_ones_listed(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(UnreadableInputError, match=words) as caught:
        open_source(path)
    for valid in ("LAS", "LAZ", "PLY", "ASCII"):
        assert valid in caught.value.fix


def test_every_format_has_its_reader(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\n")
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    (tmp_path / "a.las").write_bytes(b"LASF")
    assert {recognise_format(tmp_path / f"a.{suffix}").name for suffix in ("ply", "xyz", "las")} == {
        form.name for form in FORMATS
    }


def test_links_to_one_file_are_one_input(folder):
    link = folder / "z.laz"
    link.symlink_to(folder / "b.laz")
    assert names(find_inputs([folder / "b.laz", link])) == ["b.laz"]
