"""Run directories, the truth of simulated scenes, and what is nothing that can be read."""

import dataclasses
import datetime as dt
import shutil
from pathlib import Path

import model_files as files
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from model_files import small

from pipeline.errors import InputError, RunError
from pipeline.export.obj import obj_text
from pipeline.ruler.evaluation.reading import READERS, read_models
from pipeline.runtime.manifest import RunManifest, RunStatus, write_manifest

FOOT_M = 0.3048


def manifest(status: RunStatus = RunStatus.FINISHED, **crs: object) -> RunManifest:
    return RunManifest(
        status=status,
        engine_version="0",
        method="arrangement",
        settings={},
        settings_hash="ab",
        started_at=dt.datetime(2025, 1, 1, tzinfo=dt.UTC),
        crs={"epsg": None, "name": "unknown", "wkt": None, "horizontal_unit_m": 1.0, "vertical_unit_m": 1.0, **crs},
    )


def test_the_manifest_has_the_units(tmp_path: Path) -> None:
    metres = read_models(files.write_run(tmp_path / "metres", files.village()))
    feet = files.write_run(tmp_path / "feet", files.village(), files.reference(None, FOOT_M, 1.0))
    write_manifest(feet, manifest(horizontal_unit_m=FOOT_M, cityjson_vertical_unit_m=FOOT_M))
    read = read_models(feet)
    files.assert_same_models(metres, read)
    assert (read.crs, read.notes) == (None, ("made by gablework 0 with settings ab",))


def test_a_run_that_broke_off_or_lacks_solids_says_so(tmp_path: Path) -> None:
    run = files.write_run(tmp_path / "run", files.village())
    write_manifest(run, manifest(RunStatus.INCOMPLETE))
    shutil.rmtree(run / "cityjson")
    models = read_models(run)
    assert len(models.models) == 4
    assert all(model.solids == () for model in models.models)
    facts = [note.split(":")[0] for note in models.notes]
    assert facts[1:] == ["the run is incomplete", "no folder cityjson in the run"]


def test_of_several_levels_of_detail_the_finest_is_measured(tmp_path: Path) -> None:
    (model,) = read_models(files.write_run(tmp_path / "run", [small.levelled()])).models
    assert (model.lod, len(model.solids), len(model.surfaces)) == ("2.2", 2, 3)
    (same,) = read_models(next((tmp_path / "run").glob("cityjson/*/*.city.jsonl"))).models
    assert (same.lod, len(same.solids), len(same.surfaces)) == ("2.2", 2, 3)


def test_obj_files_of_coarser_levels_of_detail_are_passed_over(tmp_path: Path) -> None:
    reference = small.Reference()
    for suffix, lod in (("", None), ("-lod12", "1.2"), ("-lod13", "1.3")):
        (tmp_path / f"levelled{suffix}.obj").write_text(obj_text([small.levelled()], reference, lod))
    read = read_models(tmp_path)
    assert [(len(model.solids), len(model.surfaces)) for model in read.models] == [(2, 3)]
    assert "2 files of coarser levels of detail are passed over" in read.notes
    (tmp_path / "levelled.obj").unlink()
    (tmp_path / "levelled-lod13.obj").unlink()
    (block,) = read_models(tmp_path).models
    assert len(block.surfaces) == 2


def test_given_footprints_are_known_by_their_ids(tmp_path: Path) -> None:
    for name, source_id in (("given", "block 1"), ("none", None)):
        models = read_models(files.write_run(tmp_path / name, [small.gable(source_id=source_id), small.pent()]))
        assert models.has_footprints is (source_id is not None)
        assert [model.source_id for model in models.models] == [source_id, None]


def test_the_truth_knows_which_faces_count_as_one(tmp_path: Path) -> None:
    truth = files.write_run(tmp_path / "truth", [small.two_parts(), small.gable()])
    assert {surface.group for model in read_models(truth).models for surface in model.surfaces} == {-1}
    groups = {"building_id": ["gable", "two_parts"], "groups": [[0, 1], [0, 1, 0, 2]]}
    pq.write_table(pa.table(groups), truth / "conditions.parquet")
    found = files.by_id(read_models(truth))
    assert [surface.group for surface in found["gable"].surfaces] == [0, 1]
    assert {surface.plane_id: surface.group for surface in found["two_parts"].surfaces} == {0: 0, 1: 1, 2: 0, 3: 2}
    (truth / "conditions.parquet").write_text("no table")
    with pytest.raises(InputError, match=r"conditions\.parquet"):
        read_models(truth)


def test_a_failed_record_keeps_its_outline(tmp_path: Path) -> None:
    outline = small.Polygon([(0, 0), (8, 0), (8, 8), (0, 8)])
    run = files.write_run(tmp_path / "run", [dataclasses.replace(small.failed(), footprint=outline)])
    models = read_models(run)
    assert models.models == ()
    assert [model.footprint.area for model in models.failed] == [64.0]


def test_a_run_without_any_building_is_read(tmp_path: Path) -> None:
    run = files.write_run(tmp_path / "run", [])
    write_manifest(run, manifest())
    models = read_models(run)
    assert (models.name, models.models, models.failed) == ("arrangement", (), ())


def test_damaged_runs_are_refused(tmp_path: Path) -> None:
    run = files.write_run(tmp_path / "run", files.village())
    sequence = run / "cityjson" / "tile=t1" / "part-0.city.jsonl"
    whole = sequence.read_text()
    sequence.write_text(whole[:-40])
    with pytest.raises(InputError, match=r"part-0\.city\.jsonl: line \d+"):
        read_models(run)
    sequence.write_text(whole)
    (run / "planes" / "tile=t1" / "part-0.parquet").write_text("no table")
    with pytest.raises(RunError, match="planes"):
        read_models(run)
    shutil.rmtree(run / "planes")
    with pytest.raises(RunError, match="planes"):
        read_models(run)


def test_an_unreadable_path_is_an_error_that_lists_readable_ones(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    (mixed / "a.obj").write_text("o a\n")
    (mixed / "a.city.jsonl").write_text("{}")
    outer = tmp_path / "data"
    files.write_run(outer / "truth", [small.gable()])
    (tmp_path / "empty").mkdir()
    cases = {
        tmp_path / "nowhere": "nothing is there",
        tmp_path / "notes.txt": "'.txt'",
        mixed: "several kinds",
        outer: "truth",
        tmp_path / "empty": "without files",
    }
    for path, facts in cases.items():
        with pytest.raises(InputError) as caught:
            read_models(path)
        assert facts in caught.value.problem
        assert all(reader.description in caught.value.fix for reader in READERS)


def test_a_path_may_be_given_as_text(tmp_path: Path) -> None:
    run = files.write_run(tmp_path / "run", [small.gable()])
    assert read_models(str(run)).path == str(run)


@pytest.mark.parametrize("coefficients", [[0.0, 1.0, 0.0, 2.0], [0.0, float("nan"), 1.0, 2.0]])
def test_a_plane_that_does_not_look_up_is_named(tmp_path: Path, coefficients: list[float]) -> None:
    run = files.write_run(tmp_path / "run", files.village())
    part = next((run / "planes").glob("*/*.parquet"))
    table = pq.read_table(part, partitioning=None)
    column = table.schema.get_field_index("coefficients")
    values = [coefficients, *table["coefficients"].to_pylist()[1:]]
    pq.write_table(table.set_column(column, table.field(column), pa.array(values, table.field(column).type)), part)
    with pytest.raises(RunError, match=rf"plane \d+ of {table['building_id'][0].as_py()} has the coefficients"):
        read_models(run)
