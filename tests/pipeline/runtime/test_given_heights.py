"""Heights from attributes end to end: blocks where points are missing, their sources, and faulty values."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import geopandas
import laspy
import numpy as np
import pytest
import shapely
from run_tables import rows
from shapely import Polygon

from pipeline.errors import SettingsError, UnreadableInputError
from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.io.gps_time import GpsTimeKind
from pipeline.model import Candidate, GivenHeights
from pipeline.runtime.digest import run_digest
from pipeline.runtime.isolation.replay_bundle import Bundle, Incident, read_bundle, write_bundle
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.gather import gather
from pipeline.runtime.stages.sites import CandidateSite
from pipeline.runtime.stages.window_points import Surroundings, surroundings_of
from pipeline.settings import RunSettings
from pipeline.tiling import Tile, TileGrid, Window

HEIGHTS = {"footprints": {"height": "h", "roof_elevation": "roof", "storeys": "n", "ground_elevation": "ground"}}


def rows_by_source(run_dir: str) -> dict[str, dict[str, Any]]:
    return {row["source_id"]: row for row in rows(run_dir)}


@pytest.fixture(scope="module")
def houses(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Polygon]:
    """Boxes around the suburb's three houses, from west to east."""
    out = str(tmp_path_factory.mktemp("found") / "run")
    run(RunRequest(inputs=(str(suburb),), out=out, resources=SERIAL))
    found = [shapely.from_wkb(row["geometry"]).envelope for row in rows(out)]
    assert len(found) == 3
    return sorted(found, key=lambda outline: outline.bounds)


@pytest.fixture(scope="module")
def holes(suburb: Path, houses: list[Polygon], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suburb without points on its first house, and without any within 25 m of the second."""
    las = laspy.read(suburb)
    x, y = np.array(las.x), np.array(las.y)
    gone = shapely.contains_xy(houses[0].buffer(0.5), x, y) | shapely.contains_xy(houses[1].buffer(25.0), x, y)
    gone &= ~shapely.contains_xy(houses[2].buffer(5.0), x, y)
    kept = laspy.LasData(las.header)
    kept.points = las.points[~gone]
    path = tmp_path_factory.mktemp("holes") / "holes.laz"
    kept.write(path)
    return path


def write_outlines(folder: Path, outlines: list[Polygon], **columns: Any) -> str:
    """A GeoPackage of outlines a, b and c with columns of heights."""
    values = {"id": list("abc")[: len(outlines)], "h": 7.5, "roof": None, "n": 2, "ground": 80.25} | columns
    path = folder / "outlines.gpkg"
    geopandas.GeoDataFrame(values, geometry=outlines, crs="EPSG:25832").to_file(path)
    return str(path)


def test_buildings_without_points_become_blocks_and_others_stay_as_they_are(
    holes: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    path = write_outlines(tmp_path, houses)
    plain = rows_by_source(reconstruct(holes, footprints=path).run_dir)
    summary = reconstruct(holes, footprints=path, settings=HEIGHTS)
    found = rows_by_source(summary.run_dir)
    assert {name: row["status"] for name, row in plain.items()} == {"a": "failed", "b": "failed", "c": "ok"}
    assert {name: row["height_source"] for name, row in plain.items()} == {"a": None, "b": None, "c": "points"}
    for name, ground in (("a", "terrain"), ("b", "attribute")):
        row = found[name]
        assert (row["status"], row["reason"], row["lod"]) == ("fallback", "height_given", "1.2")
        assert (row["height_source"], row["ground_source"]) == ("height", ground)
        assert row["height_m"] == 7.5
        assert "height 7.50 m by the attribute height" in row["reason_detail"]
        assert row["valid"]
        assert row["footprint_share"] == pytest.approx(1.0, abs=1e-3)
        assert {row[figure] for figure in ("rmse_m", "p95_m", "coverage", "noise_m", "ridge_z_sigma_m")} == {None}
    assert found["b"]["ground_z"] == 80.25
    # the lowest terrain at the outline: that of all within 14 m, which the failed record has, is lower
    assert plain["a"]["ground_z"] + 0.1 < found["a"]["ground_z"] < 90.0
    assert "settings_hash" in found["c"]
    same = {name: value for name, value in found["c"].items() if name != "settings_hash"}
    assert same == {name: value for name, value in plain["c"].items() if name != "settings_hash"}
    report = json.loads((Path(summary.run_dir) / "footprints.json").read_text())
    assert (report["values_not_used"], report["without_heights"], report["issues"]) == (0, 0, [])


def test_tiles_workers_and_a_rerun_give_the_same_blocks(
    holes: Path, houses: list[Polygon], reconstruct: Any, shuffled: Any, tmp_path: Path
) -> None:
    path = write_outlines(tmp_path, houses)
    # with tiles of 20 m the second house lies in tiles without any point
    changes = [{}, {"tile_size_m": 20.0}, {"tile_size_m": 33.0, "lattice_x_m": 7.0}]
    runs = [
        reconstruct(holes, footprints=path, settings=HEIGHTS | change, executor=shuffled(k) if k else None)
        for k, change in enumerate(changes)
    ]
    assert len({summary.digest for summary in runs}) == 1
    ids = [row["building_id"] for row in rows(runs[1].run_dir)]
    again = rerun(RerunRequest(run_dir=runs[1].run_dir, only=tuple(ids), resources=SERIAL))
    assert again.digest == runs[0].digest == run_digest(runs[1].run_dir)
    assert sorted(again.buildings.values()) == ["fallback", "fallback", "ok"]


def test_elevations_count_in_the_vertical_datum_beside_a_few_points(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    las = laspy.read(suburb)
    on_roof = np.flatnonzero(shapely.contains_xy(houses[0].buffer(0.5), np.array(las.x), np.array(las.y)))
    inside = np.flatnonzero(shapely.contains_xy(houses[0].buffer(-2.0), np.array(las.x), np.array(las.y)))
    kept = laspy.LasData(las.header)
    kept.points = las.points[np.setdiff1d(np.arange(len(las.points)), np.setdiff1d(on_roof, inside[:2]))]
    kept.write(tmp_path / "two.laz")
    path = write_outlines(tmp_path, houses, h=None, roof=97.25)
    row = rows_by_source(reconstruct(tmp_path / "two.laz", footprints=path, settings=HEIGHTS).run_dir)["a"]
    assert (row["status"], row["n_points"], row["height_source"]) == ("fallback", 2, "roof_elevation")
    assert row["ridge_z"] == 97.25
    assert row["height_m"] == pytest.approx(97.25 - row["ground_z"])


def test_an_override_rejects_a_block_and_gives_one_another_footprint(
    holes: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    smaller = houses[0].buffer(-1.0, join_style="mitre")
    entries = [f'source_id = "a"\nfootprint = "{smaller.wkt}"', 'source_id = "b"\naction = "reject"']
    (tmp_path / "overrides.toml").write_text("".join(f"[[building]]\n{entry}\n" for entry in entries))
    path = write_outlines(tmp_path, houses)
    summary = reconstruct(holes, footprints=path, settings=HEIGHTS, overrides=str(tmp_path / "overrides.toml"))
    found = rows_by_source(summary.run_dir)
    assert set(found) == {"a", "c"}
    assert (found["a"]["status"], found["a"]["overridden"]) == ("fallback", "footprint")
    assert found["a"]["footprint_area_m2"] == pytest.approx(smaller.area, rel=1e-3)


def test_faulty_values_are_listed_by_building_and_the_next_height_is_taken(
    holes: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    path = write_outlines(tmp_path, houses, h=["tall", "-3", None], n=[2, None, 4000])
    summary = reconstruct(holes, footprints=path, settings=HEIGHTS)
    found = rows_by_source(summary.run_dir)
    assert (found["a"]["height_source"], found["a"]["height_m"]) == ("storeys", 6.0)
    assert (found["b"]["status"], found["b"]["reason"]) == ("failed", "too_few_points")
    assert "no attribute gives its height" in found["b"]["reason_detail"]
    assert found["c"]["status"] == "ok"
    report = json.loads((Path(summary.run_dir) / "footprints.json").read_text())
    assert (report["used"], report["repaired"], report["left_out"], report["values_not_used"]) == (3, 0, 0, 3)
    issues = {issue["source_id"]: issue for issue in report["issues"]}
    assert {name: issue["detail"] for name, issue in issues.items()} == {
        "a": "its h is 'tall': not a number",
        "b": "its h is -3 m: a building has 0.1 to 1000 m",
        "c": "its n is 4000 storeys: a building has 0.1 to 300 storeys",
    }
    for issue in issues.values():
        assert (issue["problem"], issue["action"]) == ("bad_value", "the value is not used")
        assert any(warning.startswith(f"footprint {issue['source_id']}: its ") for warning in summary.warnings)
    features = geopandas.read_file(path, fid_as_index=True)
    assert {features.loc[issue["feature"], "id"] for issue in issues.values()} == set("abc")


def test_footprints_without_any_height_are_counted(
    holes: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    path = write_outlines(tmp_path, houses, h=[None, 7.5, None])
    summary = reconstruct(holes, footprints=path, settings={"footprints": {"height": "h"}})
    report = json.loads((Path(summary.run_dir) / "footprints.json").read_text())
    assert (report["values_not_used"], report["without_heights"], report["issues"]) == (0, 2, [])
    # the height of b is known, its ground is not
    assert "its ground is neither" in rows_by_source(summary.run_dir)["b"]["reason_detail"]


def test_a_column_that_is_not_there_ends_the_run_before_it_begins(
    holes: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    path = write_outlines(tmp_path, houses)
    settings = {"footprints": {"height": "hoehe", "storeys": "floors", "ground_elevation": "ground"}}
    words = (
        r"no column 'hoehe' \(\[settings.footprints\] height\), 'floors' .* columns of the file: id, h, roof, n, ground"
    )
    with pytest.raises(UnreadableInputError, match=words):
        reconstruct(holes, footprints=path, settings=settings, out=str(tmp_path / "never"))
    assert not (tmp_path / "never").exists()
    with pytest.raises(SettingsError, match=r"\[footprints\] height name.*none are given"):
        reconstruct(holes, settings={"footprints": {"height": "h"}}, out=str(tmp_path / "never"))


def test_classify_refuses_the_columns_that_a_run_refuses(
    holes: Path, houses: list[Polygon], run_classify: Any, tmp_path: Path
) -> None:
    settings = {"footprints": {"height": "hoehe"}}
    with pytest.raises(UnreadableInputError, match="no column 'hoehe'"):
        run_classify(holes, footprints=write_outlines(tmp_path, houses), settings=settings)
    with pytest.raises(SettingsError, match="none are given"):
        run_classify(holes, settings=settings)


def test_the_surroundings_of_a_building_with_heights_are_read_once(
    holes: Path, houses: list[Polygon], reconstruct: Any, candidates: list[Candidate], monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:  # fmt: skip
    views: list[Window] = []

    def watched(scratch: Scratch, grid: TileGrid, view: Window) -> Surroundings:
        views.append(view)
        return surroundings_of(scratch, grid, view)

    monkeypatch.setattr("pipeline.runtime.stages.gather.surroundings_of", watched)
    outlines = [house.buffer(3.0) for house in houses]
    reconstruct(holes, footprints=write_outlines(tmp_path, outlines), settings=HEIGHTS)
    assert len(views) == len(candidates) == 3
    assert [candidate.given is not None for candidate in candidates] == [True] * 3


def test_a_district_is_no_block(tmp_path: Path) -> None:
    def heights(side_m: float) -> GivenHeights | None:
        known = GivenHeights(height_m=7.0)
        outline = shapely.box(0.0, 0.0, side_m, 10.0)
        site = CandidateSite(building_id="a", owner=Tile(0, 0), ranges=(), points=0, footprint=outline, given=known)
        grid = TileGrid(size_mm=1_000_000, halo_mm=0, origin_x_mm=0, origin_y_mm=0)
        return gather(Scratch(str(tmp_path), ""), grid, site, GpsTimeKind.NONE)[0].given

    assert heights(2000.0) is not None
    assert heights(2001.0) is None


def test_terrain_that_is_missing_beside_roof_points_comes_from_the_attribute(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    las = laspy.read(suburb)
    x, y = np.array(las.x), np.array(las.y)
    # the roof of one house, and classified ground elsewhere
    on_roof = shapely.contains_xy(houses[2].buffer(-0.5), x, y)
    low = np.array(las.z) < np.quantile(las.z, 0.1)
    kept = laspy.LasData(las.header)
    kept.points = las.points[on_roof | low]
    is_low = low[on_roof | low]
    kept.x = np.where(is_low, kept.x - 400.0, kept.x)
    kept.classification[:] = np.where(is_low, 2, 6)
    kept.write(tmp_path / "roof.laz")
    path = write_outlines(tmp_path, houses[2:], h=None, ground=81.5)
    found = {
        name: rows(reconstruct(tmp_path / "roof.laz", footprints=path, settings=settings).run_dir)[0]
        for name, settings in (("without", {}), ("with", {"footprints": {"ground_elevation": "ground"}}))
    }
    assert (found["without"]["ground_source"], found["with"]["ground_source"]) == ("assumed", "attribute")
    assert found["with"]["ground_z"] == 81.5 != found["without"]["ground_z"]
    assert found["with"]["height_source"] == "points"


def test_settings_at_their_defaults_leave_the_hash_as_it_was() -> None:
    plain = RunSettings()
    assert plain.settings_hash == RunSettings.from_mapping({"footprints": {"storey_height_m": 3.0}}).settings_hash
    assert plain.settings_hash != RunSettings.from_mapping({"footprints": {"height": "h"}}).settings_hash
    content = {
        name: {
            field.name: getattr(section, field.name)
            for field in dataclasses.fields(section)
            if field.metadata["changes_geometry"] and not field.metadata.get("added")
        }
        for name, section in plain.sections().items()
        if name not in {"footprints", "guides"}
    }
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    assert plain.settings_hash == hashlib.sha256(text.encode()).hexdigest()


def test_a_bundle_keeps_the_heights(tmp_path: Path) -> None:
    known = GivenHeights(height_m=7.0, terrain_z_m=-1.5)
    candidate = Candidate(
        building_id="a",
        origin=(0.0, 0.0, 0.0),
        points=np.zeros((0, 3)),
        ground=np.zeros((0, 3)),
        ground_z_m=0.0,
        footprint=shapely.box(0, 0, 5, 5),
        given=known,
    )
    bundle = Bundle(
        candidate=candidate,
        method="arrangement",
        settings=RunSettings().building,
        incident=Incident(reason="crashed", detail=""),
    )
    kept = read_bundle(write_bundle(str(tmp_path), bundle)).candidate.given
    assert repr(kept) == repr(known)
