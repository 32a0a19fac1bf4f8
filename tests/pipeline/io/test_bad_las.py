"""LAS and LAZ that cannot be used: a clear error each, naming file, value and fix, before memory is asked for."""

import shutil
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from las_files import write_las
from measured import memory_below

from pipeline.errors import CrsError, EmptyInputError, InconsistentInputError, InputError, UnreadableInputError
from pipeline.io import ReadOptions, open_source

COUNT_AT = 107
COUNT_14_AT = 247


def read_through(path: Path) -> int:
    return sum(len(piece) for piece in open_source(path).chunks(10_000))


def patch(path: Path, layout: str, at: int, *values: object) -> Path:
    raw = bytearray(path.read_bytes())
    struct.pack_into(layout, raw, at, *values)
    path.write_bytes(raw)
    return path


def set_count(path: Path, count: int) -> Path:
    """Writes the count that holds: in LAS 1.4 the 64-bit one, and the old one with it where it is used."""
    raw = path.read_bytes()
    if raw[25] == 4:
        patch(path, "<Q", COUNT_14_AT, count)
        if struct.unpack_from("<I", raw, COUNT_AT)[0]:
            patch(path, "<I", COUNT_AT, min(count, 2**32 - 1))
        return path
    return patch(path, "<I", COUNT_AT, count)


def assert_names_file_and_fix(fault: InputError, path: Path) -> None:
    assert fault.path == str(path)
    assert str(path) in str(fault)
    assert fault.fix


FORMATS = [("1.2", 1), ("1.4", 1), ("1.4", 6)]


@pytest.mark.parametrize(("version", "point_format"), FORMATS)
@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("share", [0.002, 0.05, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused_when_opened(tmp_path, points, write_las, version, point_format, suffix, share):
    path = write_las(tmp_path / f"a{suffix}", points(60_000), version=version, point_format=point_format)
    raw = path.read_bytes()
    path.write_bytes(raw[: int(len(raw) * share)])
    with pytest.raises((UnreadableInputError, InconsistentInputError)) as caught:
        open_source(path)
    assert_names_file_and_fix(caught.value, path)
    assert "truncated" in str(caught.value) or "promises 60000 points" in str(caught.value)


@pytest.mark.parametrize(("version", "point_format"), FORMATS)
@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("error", [-60_000 + 1, -10_001, -50, -1, 1, 50, 10_001, 1_000_000])
def test_a_count_that_is_not_the_data_s_is_refused(tmp_path, points, write_las, version, point_format, suffix, error):
    path = write_las(tmp_path / f"a{suffix}", points(60_000), version=version, point_format=point_format)
    assert read_through(path) == 60_000
    set_count(path, 60_000 + error)
    with pytest.raises(InputError, match=f"promises {60_000 + error} points") as caught:
        read_through(path)
    assert_names_file_and_fix(caught.value, path)


@pytest.mark.parametrize(("version", "point_format"), FORMATS)
@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("claim", [4_000_000_000, 2**62])
def test_a_claim_of_billions_is_refused_without_memory_for_them(
    tmp_path, points, write_las, version, point_format, suffix, claim
):
    if version == "1.2" and claim > 2**32:
        claim = 2**32 - 1
    path = write_las(tmp_path / f"a{suffix}", points(1_000), version=version, point_format=point_format)
    set_count(path, claim)
    with memory_below(2e6), pytest.raises(InputError, match=f"promises {claim} points"):
        open_source(path)


def test_a_claim_of_many_compressed_chunks_is_refused(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.laz", points(1_000))
    raw = path.read_bytes()
    offset = struct.unpack_from("<I", raw, 96)[0]
    table_at = struct.unpack_from("<q", raw, offset)[0]
    set_count(path, 4_000_000_000)
    patch(path, "<I", table_at + 4, 80_000)
    with pytest.raises(UnreadableInputError, match="80000 chunks in"):
        open_source(path)


def test_a_laz_record_with_a_monstrous_chunk_size_does_not_allocate_for_it(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.laz", points(1_000))
    assert read_through(path) == 1_000
    record_at = path.read_bytes().index(b"laszip encoded") - 2 + 54
    patch(path, "<I", record_at + 12, 4_000_000_000)
    set_count(path, 3_999_999_999)
    with memory_below(4e6), pytest.raises(UnreadableInputError, match="damaged or truncated"):
        read_through(path)


def test_a_large_chunk_size_of_few_points_is_read_all_the_same(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.laz", points(1_000))
    record_at = path.read_bytes().index(b"laszip encoded") - 2 + 54
    patch(path, "<I", record_at + 12, 4_000_000_000)
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30));"
        "from pipeline.io import open_source; print(sum(map(len, open_source(sys.argv[1]).chunks())))"
    )
    # In a process of its own: the library under laspy would abort it for want of memory.
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "1000")


def test_text_and_archives_named_las_are_reported_for_what_they_are(tmp_path):
    text = tmp_path / "a.las"
    text.write_text("1.0 2.0 3.0\n" * 100)
    with pytest.raises(UnreadableInputError, match=r"not a LAS file.*LAS and LAZ.*PLY.*ASCII"):
        open_source(text)
    archive = tmp_path / "b.laz"
    with zipfile.ZipFile(archive, "w") as stream:
        stream.writestr("tile.laz", b"LASF")
    with pytest.raises(UnreadableInputError, match="zip archive: unpack it first"):
        open_source(archive)


def test_the_signature_alone_is_truncated(tmp_path):
    path = tmp_path / "a.las"
    path.write_bytes(b"LASF" + bytes(40))
    with pytest.raises(UnreadableInputError, match=r"LAS version 0.0 is not known"):
        open_source(path)
    raw = bytearray(b"LASF" + bytes(60))
    raw[24], raw[25] = 1, 2
    path.write_bytes(raw)
    with pytest.raises(UnreadableInputError, match="truncated: 64 bytes"):
        open_source(path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_zero_points_are_an_empty_input(tmp_path, write_las, suffix):
    path = write_las(tmp_path / f"a{suffix}", np.empty((0, 3)))
    with pytest.raises(EmptyInputError, match="promises 0 points"):
        open_source(path)
    (tmp_path / "b.las").touch()
    with pytest.raises(EmptyInputError, match="0 bytes"):
        open_source(tmp_path / "b.las")


@pytest.mark.parametrize(
    ("kind", "at", "value", "message"),
    [
        *(
            ("<d", at, value, f"the {axis} scale factor is {value}")
            for axis, at in (("x", 131), ("y", 139), ("z", 147))
            for value in (0.0, float("nan"), float("inf"), -0.01)
        ),
        ("<d", 163, float("inf"), "y offset inf"),
        ("<I", 100, 4_000_000_000, "4000000000 variable length records"),
    ],
)
def test_a_value_of_the_header_that_cannot_be_is_refused(tmp_path, points, write_las, kind, at, value, message):
    path = patch(write_las(tmp_path / "a.las", points(100)), kind, at, value)
    with pytest.raises(InconsistentInputError, match=message) as caught:
        open_source(path)
    assert_names_file_and_fix(caught.value, path)


def test_a_geographic_crs_names_the_fix_and_a_projected_override_helps(tmp_path, points, write_las):
    for version, point_format in FORMATS:
        path = write_las(tmp_path / "a.laz", points(100), version=version, point_format=point_format, crs="EPSG:4326")
        with pytest.raises(CrsError, match=r"geographic.*degrees.*Reproject.*--crs EPSG:n"):
            open_source(path)
        info = open_source(path, ReadOptions(crs="EPSG:28992")).info
        assert info.reference.epsg == 28992
        assert any("replaces the header's" in warning for warning in info.warnings)


def test_counts_that_contradict_each_other_in_las_14_are_reported(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.las", points(100), version="1.4", point_format=1)
    patch(path, "<I", COUNT_AT, 90)
    source = open_source(path)
    assert sum(map(len, source.chunks())) == 100
    assert any("old point count 90" in warning for warning in source.warnings)
    patch(path, "<Q", COUNT_14_AT, 0)
    with pytest.raises(InconsistentInputError, match="0 points in its 64-bit count and 90"):
        open_source(path)


def test_layers_that_claim_gigabytes_are_refused_before_they_are_decoded(tmp_path, points, write_las):
    for point_format in (6, 7, 8):
        path = write_las(tmp_path / "a.laz", points(60_000), version="1.4", point_format=point_format)
        raw = bytearray(path.read_bytes())
        offset, item_size = struct.unpack_from("<I", raw, 96)[0], struct.unpack_from("<H", raw, 105)[0]
        # The sizes of the layers of the first chunk stand after its first record and its count.
        struct.pack_into("<2I", raw, offset + 8 + item_size + 4, 2**31, 2**31)
        path.write_bytes(raw)
        with pytest.raises(UnreadableInputError, match=r"layers of the chunk .* are damaged") as caught:
            open_source(path)
        assert_names_file_and_fix(caught.value, path)


def test_a_chunk_whose_own_count_is_another_is_refused(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.laz", points(60_000), version="1.4", point_format=6)
    offset = struct.unpack_from("<I", path.read_bytes(), 96)[0]
    patch(path, "<I", offset + 8 + 30, 49_000)
    with pytest.raises(InconsistentInputError, match="has 49000 points, the chunk table says 50000"):
        open_source(path)


@pytest.mark.parametrize(("version", "point_format"), FORMATS)
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_file_that_ends_while_it_is_read_is_reported(tmp_path, points, write_las, version, point_format, suffix):
    path = write_las(tmp_path / f"a{suffix}", points(120_000), version=version, point_format=point_format)
    source = open_source(path)
    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) // 2])
    with pytest.raises(UnreadableInputError, match="truncated") as caught:
        list(source.chunks(10_000))
    assert_names_file_and_fix(caught.value, path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_no_single_damaged_byte_of_a_header_escapes_as_another_error(tmp_path, points, write_las, suffix):
    path = write_las(tmp_path / f"a{suffix}", points(300), version="1.4", point_format=6)
    raw, bad = path.read_bytes(), tmp_path / f"b{suffix}"
    rng = np.random.default_rng(3)
    refusals = []
    for at in [*range(4, 375, 2), *rng.integers(375, len(raw), 60).tolist()]:
        damaged = bytearray(raw)
        damaged[at] ^= 0xFF
        bad.write_bytes(damaged)
        try:
            read_through(bad)
        except InputError as fault:
            refusals.append(fault)
    assert len(refusals) > 10
    assert all(fault.fix and fault.path == str(bad) for fault in refusals)


def test_a_file_that_may_not_be_read_is_reported(tmp_path, points, write_las, monkeypatch):
    path = write_las(tmp_path / "a.las", points(10))
    original = Path.open

    def refuse(self, *args, **kwargs):
        if self == path:
            raise PermissionError(13, "Permission denied")
        return original(self, *args, **kwargs)

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(UnreadableInputError, match=r"Permission denied.*permissions"):
        open_source(path)


def test_trailing_bytes_that_are_no_records_are_reported_and_the_points_used(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.las", points(100))
    with path.open("ab") as stream:
        stream.write(b"\0" * 5)
    source = open_source(path)
    assert sum(map(len, source.chunks())) == 100
    assert any("5 bytes follow" in warning for warning in source.warnings)


def test_real_laz_is_held_to_its_count_to_the_point(tmp_path, shared_data):
    for name in ("isprs/samp41-utm.laz", "isprs/samp21-utm.laz", "ign/hdf_870000_6617100.laz"):
        original = shared_data / name
        count = open_source(original).info.point_count
        for error in (-1, 1):
            path = Path(shutil.copyfile(original, tmp_path / "copy.laz"))
            path.chmod(0o644)
            set_count(path, count + error)
            with pytest.raises(InconsistentInputError, match=f"promises {count + error} points"):
                open_source(path)


def test_records_before_the_points_are_bounded_before_they_are_read(tmp_path: Path) -> None:
    path = write_las(tmp_path / "a.las", np.zeros((1, 3)))
    patch(path, "<I", 96, 3 << 30)
    with path.open("r+b") as stream:
        stream.truncate(4 << 30)  # without a block on the disk
    with memory_below(2**28), pytest.raises(InconsistentInputError, match="points begin at byte 3221225472: records"):
        open_source(path)
