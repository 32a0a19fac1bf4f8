"""Party walls of a run: every pair once, one tile or two, any unit, nothing of the run changed."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import geopandas
import geoparquet_validator
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
import small_buildings as small
from command_line import invoke
from small_runs import content, moved, write_run

import pipeline.extras.party_walls.party_walls_of_run as runs
from pipeline.errors import RunError, SettingsError
from pipeline.export.geoparquet import read_table
from pipeline.export.record_rows import RecordContext
from pipeline.export.result_file import ResultFile
from pipeline.export.tile import write_tile
from pipeline.extras.party_walls.party_wall_settings import PartyWallSettings
from pipeline.extras.party_walls.party_wall_tables import BUILDINGS, FACTS, WALLS
from pipeline.extras.party_walls.party_walls_of_run import party_walls
from pipeline.model import BuildingResult, Reason, Status
from pipeline.runtime.digest import run_digest
from pipeline.runtime.run_tiles import TILES_IN_MEMORY

TILES = 20
GABLE_END = 8.0 * 3.0 + 12.0
HALVES = 2
"""The walls of a gable end, one under each roof face."""
ROW = 5


def row(pitch_m: float = 10.0) -> list[BuildingResult]:
    """A row of five gables of 10 m by 8 m, and a failed candidate; at a pitch of 10 m they share their gable ends."""
    gables = [moved(dataclasses.replace(small.gable(), building_id=f"b{ROW - k}"), pitch_m * k) for k in range(ROW)]
    failed = dataclasses.replace(
        small.failed(),
        building_id="c",
        status=Status.FAILED,
        reason=Reason.TOO_FEW_POINTS,
        footprint=shapely.box(0, 0, 9, 9),
    )
    return [*gables, moved(failed, -10.0)]


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """The row on two tiles: two gables on the first, three on the second."""
    return write_run(tmp_path / "run", row())


def tables(run_dir: Path, folder: Path, **changes: Any) -> tuple[pa.Table, pa.Table]:
    """The pairs and the buildings of a run."""
    pairs, areas = folder / f"{run_dir.name}_pairs.parquet", folder / f"{run_dir.name}_areas.parquet"
    party_walls(str(run_dir), str(pairs), buildings=str(areas), **changes)
    return pq.read_table(pairs), pq.read_table(areas)


def test_a_row_of_gables_shares_its_gable_ends(run_dir: Path, tmp_path: Path) -> None:
    before, digest = content(run_dir), run_digest(str(run_dir))
    pairs, areas = tables(run_dir, tmp_path / "new")
    assert pairs.column_names == [*(column.name for column in WALLS), "bbox"]
    assert areas.column_names == [*(column.name for column in BUILDINGS), "bbox"]
    names = list(zip(pairs["building_a"].to_pylist(), pairs["building_b"].to_pylist(), strict=True))
    assert sorted(names) == sorted(HALVES * [(f"b{k}", f"b{k + 1}") for k in range(1, ROW)])
    assert pairs["area_m2"].to_pylist() == [GABLE_END / 2] * HALVES * (ROW - 1)
    assert {*pairs["distance_m"].to_pylist(), *pairs["angle_deg"].to_pylist()} == {0.0}
    whole = 2 * 30.0 + 2 * GABLE_END
    found = {one["building_id"]: one for one in areas.to_pylist()}
    assert set(found) == {f"b{k}" for k in range(1, ROW + 1)}
    for name, one in found.items():
        neighbours = 1 if name in ("b1", f"b{ROW}") else 2
        assert (one["neighbours"], one["wall_area_m2"], one["inner_wall_area_m2"]) == (neighbours, whole, 0.0)
        assert one["shared_wall_area_m2"] == neighbours * GABLE_END
        assert one["exposed_wall_area_m2"] == whole - neighbours * GABLE_END
    assert content(run_dir) == before
    assert run_digest(str(run_dir)) == digest
    assert len(list((tmp_path / "new").iterdir())) == 2


def test_faces_are_numbered_as_in_the_solids_of_the_run(run_dir: Path, tmp_path: Path) -> None:
    pairs, _ = tables(run_dir, tmp_path)
    stored = {one["building_id"]: one for one in read_table(str(run_dir), "buildings").to_pylist()}
    for pair in pairs.to_pylist():
        shared = shapely.get_coordinates(shapely.from_wkb(pair["geometry"]), include_z=True)
        for side in "ab":
            building = stored[pair[f"building_{side}"]]
            assert building["solid_surfaces"][pair[f"face_{side}"]] == "WallSurface"
            face = shapely.get_parts(shapely.from_wkb(building["solid"]))[pair[f"face_{side}"]]
            corners = shapely.get_coordinates(face, include_z=True)
            # gable ends that coincide are shared as a whole
            assert {*map(tuple, corners.tolist())} == {*map(tuple, shared.tolist())}
        # counter-clockwise seen from outside a, which lies to the east of b here
        steps = np.diff(shared, axis=0)
        assert np.cross(steps[:-1], steps[1:]).sum(axis=0)[0] < 0.0


def test_one_tile_or_two_give_the_same_rows(tmp_path: Path) -> None:
    context = RecordContext(reference=small.Reference(), settings_hash="ab", engine_version="0")
    found = []
    for name, cuts in (("whole", [6]), ("parted", [1, 4, 6]), ("single", [1, 2, 3, 4, 5, 6])):
        folder = write_run(tmp_path / name, [])
        for k, (first, last) in enumerate(zip([0, *cuts[:-1]], cuts, strict=True)):
            write_tile(folder, f"n{k}", row()[first:last], [], context)
        found.append(
            [
                sorted(table.drop_columns(["tile"]).to_pylist(), key=lambda one: str(list(one.values())))
                for table in tables(folder, tmp_path)
            ]
        )
    assert len(found[0][0]) == HALVES * (ROW - 1)
    assert found[0] == found[1] == found[2]


def test_walls_exactly_at_the_limit_touch_also_across_tiles(tmp_path: Path) -> None:
    context = RecordContext(reference=small.Reference(), settings_hash="ab", engine_version="0")
    found = []
    for name, cuts in (("whole", [ROW]), ("single", range(1, ROW + 1))):
        folder = write_run(tmp_path / name, [])
        for first, last in zip([0, *cuts], cuts, strict=False):
            write_tile(folder, f"n{last}", row(pitch_m=10.1)[first:last], [], context)
        found.append(tables(folder, tmp_path)[0].num_rows)
    assert found == 2 * [HALVES * (ROW - 1)]


def test_files_are_geoparquet_with_their_tolerances_and_the_same_bytes_each_time(run_dir: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        tables(run_dir, tmp_path / name, settings=PartyWallSettings(max_distance_m=0.2))
    one, two = content(tmp_path / "one"), content(tmp_path / "two")
    assert list(one.values()) == list(two.values())
    for data in one.values():
        report = geoparquet_validator.check_bytes("table.parquet", data)
        assert geoparquet_validator.failed(report) == []
    for path in (tmp_path / "one").iterdir():
        facts = json.loads(pq.read_metadata(path).metadata[FACTS.encode()])
        assert (facts["max_distance_m"], facts["max_angle_deg"], facts["settings_hash"]) == (0.2, 5.0, "ab")
        assert len(geopandas.read_parquet(path)) > 0


def test_a_run_in_feet_has_the_same_areas(tmp_path: Path) -> None:
    runs_in = [write_run(tmp_path / name, row(), unit) for name, unit in (("metres", 1.0), ("feet", 0.3048))]
    metres, feet = (tables(run, tmp_path) for run in runs_in)
    for name in ("area_m2", "distance_m"):
        assert feet[0][name].to_pylist() == pytest.approx(metres[0][name].to_pylist(), abs=2e-2)
    assert feet[1]["exposed_wall_area_m2"].to_pylist() == pytest.approx(
        metres[1]["exposed_wall_area_m2"].to_pylist(), abs=5e-2
    )
    shapes = [shapely.from_wkb(table["geometry"].to_pylist()) for table, _ in (metres, feet)]
    assert shapely.total_bounds(shapes[1]) == pytest.approx(shapely.total_bounds(shapes[0]) / 0.3048, abs=0.02)


def test_solids_of_one_building_share_inner_walls_and_no_party_wall(tmp_path: Path) -> None:
    pairs, areas = tables(write_run(tmp_path / "run", [small.two_parts()]), tmp_path)
    assert pairs.num_rows == 0
    assert areas["inner_wall_area_m2"].to_pylist() == [2 * GABLE_END]
    assert areas["shared_wall_area_m2"].to_pylist() == [0.0]
    assert areas["neighbours"].to_pylist() == [0]


def test_buildings_that_stand_alone_and_runs_without_any_give_empty_tables(tmp_path: Path) -> None:
    pairs, areas = tables(write_run(tmp_path / "apart", row(pitch_m=11.0)), tmp_path)
    assert (pairs.num_rows, areas.num_rows) == (0, ROW)
    assert areas["exposed_wall_area_m2"].to_pylist() == areas["wall_area_m2"].to_pylist()
    pairs, areas = tables(write_run(tmp_path / "none", []), tmp_path)
    assert (pairs.num_rows, areas.num_rows) == (0, 0)


def test_memory_holds_some_tiles_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_dir = write_run(tmp_path / "run", [])
    context = RecordContext(reference=small.Reference(), settings_hash="ab", engine_version="0")
    for number in range(TILES):
        gable = dataclasses.replace(small.gable(), building_id=f"m{number:02}")
        write_tile(run_dir, f"m{number:02}", [moved(gable, 10.0 * number)], [], context)
    kept: list[Any] = []
    made = runs._Run
    monkeypatch.setattr(runs, "_Run", lambda *words: kept.append(made(*words)) or kept[0])
    pairs, _ = tables(run_dir, tmp_path)
    assert pairs.num_rows == HALVES * (TILES - 1)
    memory = kept[0].tile.cache_info()
    assert (memory.currsize, memory.misses) == (TILES_IN_MEMORY, TILES + 2)


def test_what_cannot_be_written_or_read_is_refused_and_leaves_the_files_of_before(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, areas = tmp_path / "a.parquet", tmp_path / "b.parquet"
    areas.write_text("of before")
    with pytest.raises(RunError, match=r"b\.parquet exists already.*--overwrite"):
        party_walls(str(run_dir), str(out), buildings=str(areas))
    with pytest.raises(SettingsError, match=r"--out and --buildings are both .*a\.parquet: give two files"):
        party_walls(str(run_dir), str(out), buildings=str(out))

    def broken(*_: Any) -> None:
        raise RunError("the disk is gone")

    with monkeypatch.context() as patched:
        patched.setattr(ResultFile, "write", broken)
        with pytest.raises(RunError, match="the disk is gone"):
            party_walls(str(run_dir), str(out), buildings=str(areas), overwrite=True)
    assert areas.read_text() == "of before"
    assert {path.name for path in tmp_path.iterdir()} == {"run", "b.parquet"}


def test_the_command_writes_and_says_what(run_dir: Path, tmp_path: Path) -> None:
    out, areas = tmp_path / "a.parquet", tmp_path / "b.parquet"
    words = ["party-walls", str(run_dir), "--out", str(out), "--max-angle", "1"]
    code, said, _ = invoke(*words, "--min-area", "40", "--json")
    assert code == 0
    assert json.loads(said)["rows"] == {"party_walls": 0}
    code, said, _ = invoke(*words, "--buildings", str(areas), "--overwrite")
    assert code == 0
    assert f"{HALVES * (ROW - 1)} pairs of walls" in said
    assert pq.read_table(areas).num_rows == ROW
    assert invoke(*words)[0] == 4
    code, _, fault = invoke(*words, "--max-distance", "-1", "--overwrite")
    assert code == 2
    assert "max_distance_m is -1: use 0 to 5 m" in fault
