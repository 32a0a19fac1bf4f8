"""A published tile with some buildings replaced is the tile that publishing the whole would have written."""

import dataclasses
import hashlib
from pathlib import Path

import pytest
import small_buildings as small
from small_buildings import Contexts, RejectedObjects

from pipeline.errors import RunError
from pipeline.export.tile import write_tile
from pipeline.extras.overrides.tile_update import updated_tile
from pipeline.model import BuildingResult

KEY = "x85_y447"
FAR = small.gable("away", 2_000.0)
MOVED = small.gable("gable", -350.0)
CASES: dict[str, tuple[list[BuildingResult], list[BuildingResult], set[str]]] = {
    "another model of one": ([small.gable(), small.two_parts(), FAR], [MOVED], {"gable"}),
    "one that is no more": ([small.gable(), small.two_parts(), small.failed()], [], {"gable"}),
    "one that moves the origin": ([small.gable(), small.two_parts(), MOVED], [small.failed("gable")], {"gable"}),
    "a new one first": ([small.gable(), small.two_parts()], [FAR], {"away"}),
    "one that has a model now": ([small.gable(), small.failed("two_parts")], [small.two_parts()], {"two_parts"}),
    "the last with a model": ([small.gable(), small.failed()], [small.failed("gable")], {"gable"}),
    "the first with a model": ([small.failed("gable")], [small.gable()], {"gable"}),
    "one with levels of detail": ([small.gable(), small.levelled()], [small.gable("levelled", 40.0)], {"levelled"}),
    "one that has levels now": ([small.courtyard(), small.failed("levelled")], [small.levelled()], {"levelled"}),
    "all of them": ([small.gable(), small.two_parts()], [small.courtyard(), FAR], {"gable", "two_parts"}),
}


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("case", list(CASES))
@pytest.mark.parametrize("meshes", ["building", "tile", "glb", "none"])
@pytest.mark.parametrize("crs", ["compound", "feet and metres", "US feet", "unknown"])
def test_an_updated_tile_is_the_tile_written_whole(
    tmp_path: Path, contexts: Contexts, rejected_objects: RejectedObjects, crs: str, meshes: str, case: str
) -> None:
    before, fresh, replaced = CASES[case]
    if case == "one that moves the origin":
        before = [*[b for b in before if b.building_id != "gable"], MOVED]
    context = dataclasses.replace(contexts[crs], further_lods=("1.3",))
    write_tile(tmp_path / "old", KEY, before, rejected_objects[:1], context, meshes)
    after = [*[b for b in before if b.building_id not in replaced], *fresh]
    gone = dataclasses.replace(rejected_objects[1], object_id="gable" if "gable" in replaced else "pole")
    has_gable = any(b.building_id == "gable" for b in after)
    rejected = rejected_objects[:1] if has_gable else [*rejected_objects[:1], gone]
    reported = write_tile(tmp_path / "new", KEY, after, rejected, context, meshes)
    update = updated_tile(tmp_path / "old", KEY, replaced, fresh, rejected[1:], context, meshes)
    found = {**contents(tmp_path / "old"), **update.files}
    assert set(update.gone) <= set(found) - set(update.files)
    assert {path: data for path, data in found.items() if path not in update.gone} == contents(tmp_path / "new")
    assert all(reported.digests[path] == digest for path, digest in update.digests.items())
    assert update.digests == {path: hashlib.sha256(data).hexdigest() for path, data in update.files.items()}


def test_an_update_writes_nothing_itself(tmp_path: Path, contexts: Contexts) -> None:
    write_tile(tmp_path, KEY, [small.gable()], [], contexts["compound"])
    before = contents(tmp_path)
    updated_tile(tmp_path, KEY, {"gable"}, [FAR], [], contexts["compound"], "building")
    assert contents(tmp_path) == before


def test_a_tile_that_is_not_there_or_damaged_is_refused(tmp_path: Path, contexts: Contexts) -> None:
    with pytest.raises(RunError, match=r"city\.jsonl cannot be read"):
        updated_tile(tmp_path, KEY, {"gable"}, [], [], contexts["compound"], "none")
    write_tile(tmp_path, KEY, [small.gable()], [], contexts["compound"], "none")
    (tmp_path / "planes" / f"tile={KEY}" / "part-0.parquet").write_bytes(b"PAR1")
    with pytest.raises(RunError, match=r"planes.*cannot be read: .* Run the whole again"):
        updated_tile(tmp_path, KEY, {"gable"}, [], [], contexts["compound"], "none")
