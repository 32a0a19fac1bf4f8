"""A run as a user sees it: records for every candidate, clear refusals, nothing lost."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import shapely
from las_files import write_las
from method_by_hand import MethodByHand
from run_tables import rows, write_footprints

import pipeline.export.tile
import pipeline.recipe
from pipeline.errors import BuildingError, EmptyInputError, InconsistentInputError, InputError, RunError
from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.extras.publish_stac.stac import publish_stac
from pipeline.model import Reason
from pipeline.runtime.digest import run_digest
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.runtime.scratch.folder_lock import locked_results
from pipeline.settings import RunSettings


def test_every_candidate_has_a_record_and_a_mesh(suburb: Path, reconstruct: Any) -> None:
    summary = reconstruct(suburb)
    buildings = rows(summary.run_dir)
    assert len(buildings) == summary.counts["candidates"] == sum(summary.statuses.values())
    for row in buildings:
        assert (Path(summary.run_dir) / row["mesh_path"]).is_file() == (row["status"] != "failed")
        assert row["valid"] == (row["status"] != "failed")
    assert len(rows(summary.run_dir, "rejected")) == sum(summary.rejected.values())


def test_the_state_of_each_tile_names_files_that_are_there(suburb: Path, reconstruct: Any) -> None:
    run_dir = Path(reconstruct(suburb, settings={"tile_size_m": 40.0}).run_dir)
    states = [json.loads(path.read_text()) for path in sorted((run_dir / "state").glob("*.json"))]
    assert len(states) > 1
    assert all((run_dir / name).is_file() for state in states for name in state["files"])
    assert not (run_dir / "scratch").exists()


def test_one_broken_building_costs_only_itself(suburb: Path, reconstruct: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = reconstruct(suburb)
    victim = min(row["building_id"] for row in rows(whole.run_dir))
    real = pipeline.recipe.method_named

    def sabotaged(name: str) -> Any:
        method = real(name)

        def segment(cloud: Any, settings: Any) -> Any:
            if cloud.candidate.building_id == victim:
                raise ZeroDivisionError("on purpose")
            return method.segment(cloud, settings)

        return MethodByHand(name=name, segment=segment, settings_type=method.settings_type)

    monkeypatch.setattr(pipeline.recipe, "method_named", sabotaged)
    hurt = {row["building_id"]: row for row in rows(reconstruct(suburb).run_dir)}
    assert hurt[victim]["status"] == "failed"
    assert hurt[victim]["reason"] == "internal_error"
    assert "on purpose" in hurt[victim]["reason_detail"]
    assert sum(row["status"] == "failed" for row in hurt.values()) == 1
    assert len(hurt) == whole.counts["candidates"]


def test_a_candidate_with_too_few_points_for_a_model_is_rejected_unless_a_user_overrides_it(
    suburb: Path, reconstruct: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    whole = reconstruct(suburb)
    victim = min(row["building_id"] for row in rows(whole.run_dir))
    real = pipeline.recipe.roof_points

    def sparse(cloud: Any, settings: Any, decisions: Any = None) -> Any:
        if cloud.candidate.building_id == victim:
            raise BuildingError(Reason.TOO_FEW_POINTS, "on purpose")
        return real(cloud, settings, decisions)

    monkeypatch.setattr(pipeline.recipe, "roof_points", sparse)
    summary = reconstruct(suburb, out=str(tmp_path / "run"))
    (lost,) = [row for row in rows(summary.run_dir, "rejected") if row["object_id"] == victim]
    assert (lost["reason"], lost["reason_detail"]) == ("too_few_points", "on purpose")
    assert lost["area_m2"] > 10
    assert summary.rejected["too_few_points"] == whole.rejected.get("too_few_points", 0) + 1
    assert len(rows(summary.run_dir)) == summary.counts["candidates"] == whole.counts["candidates"] - 1
    assert summary.counts["failed"] == 0
    assert len(rows(summary.run_dir, "rejected")) == summary.counts["rejected"]
    overrides = tmp_path / "overrides.toml"
    for entry in ('method = "kmeans"', 'action = "accept"'):
        overrides.write_text(f'[[building]]\nbuilding_id = "{victim}"\n{entry}\n')
        known = reconstruct(suburb, out=str(tmp_path / entry), overrides=str(overrides))
        assert {row["building_id"]: row["status"] for row in rows(known.run_dir)}[victim] == "failed"
        assert known.warnings == summary.warnings


def test_given_footprints_are_the_candidates_also_where_there_are_no_points(
    suburb: Path, reconstruct: Any, tmp_path: Path
) -> None:
    found = [row for row in rows(reconstruct(suburb).run_dir) if row["status"] == "ok"]
    outlines = [shapely.from_wkb(row["geometry"]) for row in found[:2]]
    bare = shapely.box(*(np.array(outlines[0].bounds[:2]) - 6.0), *(np.array(outlines[0].bounds[:2]) - 3.0))
    named = {"one": outlines[0], "two": outlines[1], "bare": bare}
    path = write_footprints(tmp_path / "footprints.geojson", named)
    summary = reconstruct(suburb, footprints=str(path))
    records = {row["source_id"]: row for row in rows(summary.run_dir)}
    assert set(records) == {"one", "two", "bare"}
    assert records["one"]["status"] == records["two"]["status"] == "ok"
    assert (records["bare"]["status"], records["bare"]["reason"]) == ("failed", "too_few_points")


def test_points_on_one_line_are_refused(tmp_path: Path, reconstruct: Any) -> None:
    path = tmp_path / "line.xyz"
    path.write_text("".join(f"{500000 + k * 0.6:.3f} {5800000 + k * 0.8:.3f} {10 + k % 7:.2f}\n" for k in range(500)))
    with pytest.raises(InconsistentInputError, match=r"all 500 points lie on one line .* Check the columns"):
        reconstruct(path)


def test_a_box_without_points_is_refused_and_reported(suburb: Path, reconstruct: Any) -> None:
    with pytest.raises(EmptyInputError, match=r"no usable point is left .*outside"):
        reconstruct(suburb, bbox=(0.0, 0.0, 10.0, 10.0))


def test_an_earlier_run_is_kept_without_overwrite(suburb: Path, reconstruct: Any, tmp_path: Path) -> None:
    out = str(tmp_path / "run")
    first = reconstruct(suburb, out=out)
    with pytest.raises(RunError, match="is not empty"):
        reconstruct(suburb, out=out)
    assert reconstruct(suburb, out=out, overwrite=True).digest == first.digest


def test_two_runs_never_write_one_directory_at_once(suburb: Path, reconstruct: Any, tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    with locked_results(str(out)), pytest.raises(RunError, match=r"is being written by another run: wait for it, or"):
        reconstruct(suburb, out=str(out))
    assert list(out.iterdir()) == []
    first = reconstruct(suburb, out=str(out))
    with locked_results(first.run_dir):
        with pytest.raises(RunError, match="is being written by another run"):
            reconstruct(suburb, out=str(out), overwrite=True)
        with pytest.raises(RunError, match="is being written by another run"):
            rerun(RerunRequest(run_dir=first.run_dir, resources=SERIAL))
    assert run_digest(first.run_dir) == first.digest


def test_a_folder_that_is_no_run_is_never_replaced(suburb: Path, reconstruct: Any, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(RunError, match=r"holds thesis.txt and no run.json"):
        reconstruct(suburb, out=str(tmp_path / "mine"), overwrite=True)
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years of work"


def test_progress_is_reported_by_stage_and_never_runs_backwards(suburb: Path, tmp_path: Path) -> None:
    events: list[Event] = []
    settings = RunSettings.from_mapping({"tile_size_m": 40.0})
    out = str(tmp_path / "run")
    run(RunRequest(inputs=(str(suburb),), out=out, settings=settings, resources=SERIAL), events.append)
    stages = [event.stage for event in events if event.kind == "stage"]
    assert stages == ["ingest", "cells", "ground", "split", "join", "outline", "reconstruct", "publish"]
    for stage in ("ingest", "split", "reconstruct", "publish"):
        steps = [event for event in events if event.kind == "progress" and event.stage == stage]
        assert [s.done for s in steps] == sorted(s.done for s in steps)
        assert steps[-1].done == steps[-1].total > 0
    assert events[-1].kind == "finished"


def test_one_return_only_and_no_classes_are_used_and_reported(tmp_path: Path, suburb: Path, reconstruct: Any) -> None:
    las = laspy.read(suburb)
    first = np.asarray(las.return_number) == 1
    path = tmp_path / "first.xyz"
    np.savetxt(path, np.column_stack((las.x, las.y, las.z))[first], fmt="%.3f")
    summary = reconstruct(path, crs="EPSG:25832")
    # a tree over a roof hides it from first returns: one house may go
    assert summary.statuses["ok"] >= reconstruct(suburb).statuses["ok"] - 1
    assert any("one return per pulse" in warning for warning in summary.warnings)
    assert any("no classes" in warning for warning in summary.warnings)


def test_gross_outliers_are_left_out_and_reported(tmp_path: Path, suburb: Path, reconstruct: Any) -> None:
    las = laspy.read(suburb)
    xyz = np.column_stack((las.x, las.y, las.z))
    centre = xyz.mean(axis=0)
    wild = centre + np.array([[3.0, 4.0, 180.0], [-20.0, 11.0, -180.0], [15.0, -15.0, 95.0]])
    for name, points in (("clean", xyz), ("wild", np.vstack((xyz, wild)))):
        np.savetxt(tmp_path / f"{name}.xyz", points, fmt="%.3f")
    clean, hurt = (reconstruct(tmp_path / f"{name}.xyz", crs="EPSG:25832") for name in ("clean", "wild"))
    assert hurt.counts["outliers"] == 3
    assert any("3 gross outliers" in warning for warning in hurt.warnings)
    assert hurt.digest == clean.digest


def test_feet_give_the_buildings_of_metres(tmp_path: Path, suburb: Path, reconstruct: Any) -> None:
    las = laspy.read(suburb)
    xyz = np.column_stack((las.x - 450000, las.y - 5500000, las.z))
    np.savetxt(tmp_path / "metres.xyz", xyz, fmt="%.3f")
    np.savetxt(tmp_path / "feet.xyz", xyz / 0.3048, fmt="%.5f")
    metres = reconstruct(tmp_path / "metres.xyz", crs="EPSG:25832", allow_outside_area_of_use=True)
    feet = reconstruct(tmp_path / "feet.xyz", crs="EPSG:2994", allow_outside_area_of_use=True)
    assert feet.statuses == metres.statuses
    height = {r["building_id"]: r for r in rows(metres.run_dir)}
    areas = sorted(row["footprint_area_m2"] for row in height.values())
    in_feet = rows(feet.run_dir)
    assert sorted(row["footprint_area_m2"] for row in in_feet) == pytest.approx(areas, rel=0.02)
    ratio = np.array(sorted(r["ridge_z"] for r in in_feet)) / np.array(sorted(r["ridge_z"] for r in height.values()))
    assert ratio == pytest.approx(1 / 0.3048, rel=0.01)


def test_stray_class_codes_are_not_believed(suburb: Path, tmp_path: Path, reconstruct: Any) -> None:
    las = laspy.read(suburb)
    las.classification[100] = 2
    las.write(tmp_path / "stray.laz")
    plain, stray = reconstruct(suburb), reconstruct(tmp_path / "stray.laz")
    assert stray.statuses == plain.statuses
    assert any("1 of 1 inputs are not classified" in warning for warning in stray.warnings)


def test_footprints_outside_the_box_are_left_out_and_reported(suburb: Path, tmp_path: Path, reconstruct: Any) -> None:
    found = [shapely.from_wkb(row["geometry"]) for row in rows(reconstruct(suburb).run_dir)]
    x0, y0, x1, y1 = found[0].bounds
    far = [outline for outline in found[1:] if not outline.intersects(shapely.box(x0 - 2, y0 - 2, x1 + 2, y1 + 2))]
    named = {str(k): outline for k, outline in enumerate([found[0], *far])}
    path = write_footprints(tmp_path / "footprints.geojson", named)
    summary = reconstruct(suburb, footprints=str(path), bbox=(x0 - 2, y0 - 2, x1 + 2, y1 + 2))
    assert summary.counts["candidates"] == 1
    assert any(f"{len(far)} of {len(far) + 1} footprints lie off the data" in w for w in summary.warnings)


def test_a_request_that_cannot_work_leaves_the_earlier_run_alone(
    suburb: Path, tmp_path: Path, reconstruct: Any
) -> None:
    out = tmp_path / "run"
    first = reconstruct(suburb, out=str(out))
    with pytest.raises(InputError):
        reconstruct(suburb, out=str(out), overwrite=True, footprints=str(tmp_path / "nowhere.gpkg"))
    assert json.loads((out / "run.json").read_text())["status"] == "finished"
    assert len(rows(str(out))) == first.counts["candidates"]


def test_a_run_that_breaks_says_so_in_its_manifest(suburb: Path, tmp_path: Path, reconstruct: Any) -> None:
    with pytest.raises(EmptyInputError):
        reconstruct(suburb, out=str(tmp_path / "run"), bbox=(0.0, 0.0, 10.0, 10.0))
    manifest = json.loads((tmp_path / "run" / "run.json").read_text())
    assert manifest["status"] == "failed"
    assert "no usable point is left" in manifest["warnings"][-1]


def test_a_tile_that_cannot_be_written_costs_only_itself(
    suburb: Path, reconstruct: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = reconstruct(suburb, settings={"tile_size_m": 40.0})
    tiles = sorted({row["tile"] for row in rows(whole.run_dir)})
    real = pipeline.export.tile.write_tile

    def sabotaged(run_dir: str, tile_key: str, *rest: Any, **options: Any) -> Any:
        if tile_key == tiles[0]:
            raise RunError("the disk is full, on purpose")
        return real(run_dir, tile_key, *rest, **options)

    monkeypatch.setattr(pipeline.export.tile, "write_tile", sabotaged)
    hurt = reconstruct(suburb, settings={"tile_size_m": 40.0})
    assert hurt.failed_tiles == (tiles[0],)
    state = json.loads((Path(hurt.run_dir) / "state" / f"{tiles[0]}.json").read_text())
    assert (state["state"], state["files"]) == ("failed", {})
    assert "on purpose" in state["error"]
    assert json.loads((Path(hurt.run_dir) / "run.json").read_text())["status"] == "incomplete"
    assert sorted({row["tile"] for row in rows(hurt.run_dir)}) == tiles[1:]


@pytest.mark.parametrize("out", ["ftp://host/run", "https://host/run"])
def test_a_place_where_nothing_can_be_stored_is_refused_at_once(suburb: Path, reconstruct: Any, out: str) -> None:
    with pytest.raises(RunError, match=rf"{out}: .*Use "):
        reconstruct(suburb.with_name("missing.laz"), out=out)


def test_a_meadow_has_no_building_and_ends_well(tmp_path: Path, reconstruct: Any) -> None:
    rng = np.random.default_rng(1)
    x, y = 200_000.0 + rng.uniform(0.0, 60.0, 8000), 500_000.0 + rng.uniform(0.0, 60.0, 8000)
    write_las(tmp_path / "meadow.las", np.column_stack((x, y, rng.normal(0.0, 0.02, 8000))))
    whole = reconstruct(tmp_path / "meadow.las", crs="EPSG:28992")
    tiled = reconstruct(tmp_path / "meadow.las", crs="EPSG:28992", settings={"tile_size_m": 25.0})
    assert whole.counts["candidates"] == whole.counts["rejected"] == 0
    assert tiled.counts["tiles"] > 1
    assert tiled.digest == whole.digest == run_digest(whole.run_dir)


def test_the_catalogue_of_a_run_counts_the_points_of_whole_files(tmp_path: Path, reconstruct: Any) -> None:
    """Noise and what lies off the window are not used, and count nevertheless; the headers say how many there are."""
    rng = np.random.default_rng(1)
    paths = [tmp_path / "west.las", tmp_path / "east.laz"]
    for shift, path in zip((0.0, 60.0), paths, strict=True):
        x, y = 200_000.0 + shift + rng.uniform(0.0, 60.0, 8000), 500_000.0 + rng.uniform(0.0, 60.0, 8000)
        noise = np.where(np.arange(8000) < 50, 7, 1)
        write_las(path, np.column_stack((x, y, rng.normal(0.0, 0.02, 8000))), "EPSG:28992", classification=noise)
    run_dir = reconstruct(*paths, bbox=(200_000.0, 500_000.0, 200_090.0, 500_060.0)).run_dir
    publish_stac(run_dir, str(tmp_path / "out"))
    documents = [json.loads(path.read_text()) for path in sorted((tmp_path / "out" / "points").glob("*-*.json"))]
    for path, document in zip(sorted(paths), documents, strict=True):
        header, found = laspy.open(path).header, document["properties"]
        assert (found["title"], found["pc:count"]) == (f"Points of {path.name}", header.point_count)
        assert found["proj:bbox"] == pytest.approx([*header.mins[:2], *header.maxs[:2]], abs=0.001)
        assert found["pc:encoding"] == ("LASzip" if path.suffix == ".laz" else "LAS")
        dimensions = [one.name for one in header.point_format.dimensions]
        assert [one["name"] for one in found["pc:schemas"]] == dimensions
    used = [entry.n_points for entry in read_manifest(run_dir).inputs]
    assert used[0] < 5000
    assert used[1] == 7950
    (tile,) = (json.loads(path.read_text()) for path in (tmp_path / "out").glob("x*/*.json"))
    assert sum(link["rel"] == "derived_from" for link in tile["links"]) == 2
