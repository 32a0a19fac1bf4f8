"""Publishing a tile: the designed paths, whole files only, the same twice."""

import dataclasses
import hashlib
from pathlib import Path

import pytest
import small_buildings as small
from small_buildings import Contexts, RejectedObjects

from pipeline.errors import RunError
from pipeline.export.folders import put_local
from pipeline.export.geoparquet import read_table
from pipeline.export.tile import write_tile

BUILT = (small.gable, small.two_parts, small.failed)


def files_of(folder: Path) -> dict[str, str]:
    """sha256 of every file under a folder, by relative path."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_a_tile_writes_the_designed_files_and_says_their_digests(
    tmp_path: Path, contexts: Contexts, rejected_objects: RejectedObjects
) -> None:
    reported = write_tile(tmp_path, "x85_y447", [build() for build in BUILT], rejected_objects, contexts["compound"])
    assert sorted(reported.digests) == [
        "buildings/tile=x85_y447/part-0.parquet",
        "cityjson/tile=x85_y447/part-0.city.jsonl",
        "decisions/tile=x85_y447/part-0.parquet",
        "meshes/x85_y447/gable.obj",
        "meshes/x85_y447/two_parts.obj",
        "planes/tile=x85_y447/part-0.parquet",
        "rejected/tile=x85_y447/part-0.parquet",
    ]
    assert reported.digests == files_of(tmp_path)
    assert (reported.n_buildings, reported.n_planes, reported.n_rejected) == (3, 6, 2)


def test_the_mesh_of_a_tile_names_every_solid(tmp_path: Path, contexts: Contexts) -> None:
    write_tile(tmp_path, "t1", [build() for build in BUILT], [], contexts["compound"], "tile")
    lines = (tmp_path / "meshes" / "t1" / "t1.obj").read_text().splitlines()
    assert [line for line in lines if line.startswith("o ")] == ["o gable-0", "o two_parts-0", "o two_parts-1"]


def test_publishing_twice_in_another_order_changes_nothing(
    tmp_path: Path, contexts: Contexts, rejected_objects: RejectedObjects
) -> None:
    results = [build() for build in BUILT]
    once = write_tile(tmp_path, "t1", results, rejected_objects, contexts["compound"])
    twice = write_tile(tmp_path, "t1", results[::-1], rejected_objects[::-1], contexts["compound"])
    assert once == twice
    assert once.digests == files_of(tmp_path)


def test_a_cut_off_put_leaves_the_old_file_and_no_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put = put_local(tmp_path)
    put("a/b.parquet", b"old")

    def no_space(path: Path, data: bytes) -> int:
        with path.open("wb") as stream:
            stream.write(data[:1])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", no_space)
    with pytest.raises(RunError, match="No space left"):
        put("a/b.parquet", b"new")
    assert (tmp_path / "a" / "b.parquet").read_bytes() == b"old"
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b.parquet"]


def test_a_temporary_file_is_seen_by_no_reader(tmp_path: Path, contexts: Contexts) -> None:
    write_tile(tmp_path, "t1", [small.gable()], [], contexts["compound"])
    (tmp_path / "buildings" / "tile=t1" / ".part-0.parquet.17-abcd.part").write_bytes(b"half a file")
    assert read_table(str(tmp_path), "buildings").num_rows == 1


def test_another_store_gets_the_same_files(tmp_path: Path, contexts: Contexts) -> None:
    stored: dict[str, bytes] = {}
    reported = write_tile("bucket/run", "t1", [small.gable()], [], contexts["compound"], put=stored.__setitem__)
    assert {path: hashlib.sha256(data).hexdigest() for path, data in stored.items()} == reported.digests
    assert write_tile(tmp_path, "t1", [small.gable()], [], contexts["compound"]) == reported


@pytest.mark.parametrize(
    ("key", "meshes", "fault"),
    [
        *((key, "building", "hive key") for key in ("", "85", "-3", "a/b", "tile=x", "x 1")),
        ("t1", "all", "'all': use one of building, tile, glb, none"),
    ],
)
def test_a_key_that_readers_would_misread_and_unknown_meshes_are_refused(
    tmp_path: Path, contexts: Contexts, key: str, meshes: str, fault: str
) -> None:
    with pytest.raises(RunError, match=fault):
        write_tile(tmp_path, key, [], [], contexts["compound"], meshes)


def test_one_building_twice_is_refused(tmp_path: Path, contexts: Contexts) -> None:
    again = dataclasses.replace(small.pent(), building_id="gable")
    with pytest.raises(RunError, match="gable more than once"):
        write_tile(tmp_path, "t1", [small.gable(), again], [], contexts["compound"])


@pytest.mark.parametrize(
    ("meshes", "stems", "ending"),
    [
        ("building", ("levelled", "courtyard"), "obj"),
        ("tile", ("t1",), "obj"),
        ("glb", ("t1",), "glb"),
        ("none", (), ""),
    ],
)
def test_every_level_of_detail_has_mesh_files_of_its_own(
    tmp_path: Path, contexts: Contexts, meshes: str, stems: tuple[str, ...], ending: str
) -> None:
    context = dataclasses.replace(contexts["compound"], further_lods=("1.2", "1.3"))
    reported = write_tile(tmp_path, "t1", [small.levelled(), small.courtyard(), small.failed()], [], context, meshes)
    wanted = {f"meshes/t1/{stem}{suffix}.{ending}" for stem in stems for suffix in ("", "-lod12", "-lod13")}
    assert {path for path in reported.digests if path.startswith("meshes/")} == wanted
    assert reported.digests == files_of(tmp_path)
    paths = {path for path in read_table(str(tmp_path), "buildings")["mesh_path"].to_pylist() if path}
    assert paths == {path for path in wanted if "-lod" not in path}
