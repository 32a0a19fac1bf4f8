"""Solar energy of a run: every plane, nothing of the run changed, one tile or two, any unit, with and without a CRS."""

import dataclasses
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import geopandas
import geoparquet_validator
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pyproj
import pytest
import shapely
import small_buildings as small
from command_line import invoke
from small_runs import moved, street, write_run
from weather_files import write_epw

import pipeline.extras.solar.solar_of_run as runs
from pipeline.errors import RunError
from pipeline.export.geoparquet import read_table
from pipeline.export.record_rows import RecordContext
from pipeline.export.tile import write_tile
from pipeline.extras.solar.roof_planes import RoofPlanes
from pipeline.extras.solar.solar_of_run import solar
from pipeline.extras.solar.solar_settings import SolarSettings
from pipeline.extras.solar.solar_table import COLUMNS, FACTS
from pipeline.extras.solar.true_north import convergence_deg
from pipeline.extras.solar.weather import Site, clear_sky
from pipeline.io import SpatialReference
from pipeline.runtime.digest import run_digest
from pipeline.runtime.manifest import write_manifest
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.run_tiles import TILES_IN_MEMORY

TILES = 20
ENERGY = ("irradiation_kwh_m2", "irradiation_kwh", "beam_kwh_m2", "sky_kwh_m2", "ground_kwh_m2", "beam_loss")


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A finished run of four buildings on two tiles, in an unknown CRS."""
    return write_run(tmp_path / "run", street())


def restated(run_dir: Path, **changes: Any) -> Path:
    """Change the manifest of a run."""
    write_manifest(run_dir, dataclasses.replace(read_manifest(run_dir), **changes))
    return run_dir


def placed(run_dir: Path, epsg: int = 28992) -> Path:
    """The same run in a known CRS."""
    crs = pyproj.CRS.from_epsg(epsg)
    stated = dict(read_manifest(run_dir).crs or {})
    return restated(run_dir, crs=stated | {"name": crs.name, "wkt": crs.to_wkt()})


def sky(run_dir: Path, out: Path, **changes: Any) -> pa.Table:
    """The table of a run without energy."""
    solar(str(run_dir), str(out), sky_only=True, **changes)
    return pq.read_table(out)


def content(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_every_plane_has_a_row_and_the_run_stays_as_it_is(run_dir: Path, tmp_path: Path) -> None:
    before, digest = content(run_dir), run_digest(str(run_dir))
    table = sky(run_dir, tmp_path / "new" / "sky.parquet")
    planes = read_table(str(run_dir), "planes")
    key = [("building_id", "ascending"), ("plane_id", "ascending")]
    ordered = table.sort_by(key)
    for name in ("building_id", "plane_id", "geometry", "area_m2", "tile"):
        assert ordered[name].to_pylist() == planes.sort_by(key)[name].to_pylist()
    assert ordered["tilt_deg"].to_pylist() == planes.sort_by(key)["slope_deg"].to_pylist()
    assert table.column_names == [*(column.name for column in COLUMNS), "bbox"]
    assert table.select(["tile", "building_id", "plane_id"]).to_pylist() == (
        table.sort_by([("tile", "ascending"), *key]).select(["tile", "building_id", "plane_id"]).to_pylist()
    )
    assert content(run_dir) == before
    assert run_digest(str(run_dir)) == digest
    assert list((tmp_path / "new").iterdir()) == [tmp_path / "new" / "sky.parquet"]


def test_the_file_is_geoparquet_with_its_assumptions(run_dir: Path, tmp_path: Path) -> None:
    sky(placed(run_dir), tmp_path / "sky.parquet")
    report = geoparquet_validator.check_bytes("table.parquet", (tmp_path / "sky.parquet").read_bytes())
    assert geoparquet_validator.failed(report) == []
    read = geopandas.read_parquet(tmp_path / "sky.parquet")
    assert read.crs.to_epsg() == 28992
    metadata = pq.read_metadata(tmp_path / "sky.parquet").metadata
    geo = json.loads(metadata[b"geo"])["columns"]["geometry"]
    assert geo["bbox"][:2] == pytest.approx(read.total_bounds[:2])
    assert geo["bbox"][3:5] == pytest.approx(read.total_bounds[2:])
    facts = json.loads(metadata[FACTS.encode()])
    assert facts["azimuth_from"] == "true north"
    assert (facts["reach_m"], facts["settings_hash"]) == (100.0, "ab")


def test_a_run_gives_the_same_bytes_each_time(run_dir: Path, tmp_path: Path) -> None:
    for name in ("a.parquet", "b.parquet"):
        sky(run_dir, tmp_path / name)
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_one_tile_or_two_give_the_same_view_of_the_sky(tmp_path: Path) -> None:
    near = street()
    near[2] = moved(near[2], -45.0)
    whole, parted = write_run(tmp_path / "whole", []), write_run(tmp_path / "parted", near)
    context = RecordContext(reference=small.Reference(), settings_hash="ab", engine_version="0")
    write_tile(whole, "t1", near, [], context)
    found = [
        sky(run, tmp_path / f"{run.name}.parquet").sort_by([("building_id", "ascending"), ("plane_id", "ascending")])
        for run in (whole, parted)
    ]
    for name in ("building_id", "sky_view", "horizon_deg", "samples"):
        assert found[0][name].to_pylist() == found[1][name].to_pylist()
    lonely = sky(parted, tmp_path / "lonely.parquet", settings=SolarSettings(reach_m=0.0))
    assert sum(lonely["sky_view"].to_pylist()) > sum(found[0]["sky_view"].to_pylist()) + 0.01


def test_buildings_of_several_tiles_stay_apart(tmp_path: Path) -> None:
    def run(name: str, *, with_far: bool) -> pa.Table:
        folder = write_run(tmp_path / name, [])
        context = RecordContext(reference=small.Reference(), settings_hash="ab", engine_version="0")
        gable = street()[0]
        far, near = (
            dataclasses.replace(moved(gable, *place), building_id=word)
            for word, place in (("c", (0.0, 80.0)), ("d", (-30.0, 0.0)))
        )
        write_tile(folder, "n1", [gable], [], context)
        write_tile(folder, "n2", [moved(dataclasses.replace(gable, building_id="b"), 30.0)], [], context)
        write_tile(folder, "n3", [far, near] if with_far else [near], [], context)
        table = sky(folder, tmp_path / f"{name}.parquet", settings=SolarSettings(reach_m=45.0))
        return table.filter(pc.equal(table["tile"], "n1")).select(["sky_view", "horizon_deg"])

    assert run("with", with_far=True).equals(run("without", with_far=False))


def test_a_run_in_feet_sees_the_same_sky(tmp_path: Path) -> None:
    metres, feet = (
        sky(write_run(tmp_path / name, street(), unit_m), tmp_path / f"{name}.parquet")
        for name, unit_m in (("metres", 1.0), ("feet", 0.3048))
    )
    for name in ("azimuth_deg", "tilt_deg", "area_m2", "sky_view"):
        assert metres[name].to_pylist() == pytest.approx(feet[name].to_pylist(), abs=2e-3)


def test_energy_is_the_sum_of_its_parts_and_fits_pvlib(run_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("pvlib")
    written = solar(str(placed(run_dir)), str(tmp_path / "year.parquet"), settings=SolarSettings(linke_turbidity=3.0))
    table = pq.read_table(tmp_path / "year.parquet")
    assert written.rows == {"planes": table.num_rows}
    for row in table.to_pylist():
        parts = sum(row[name] for name in ("beam_kwh_m2", "sky_kwh_m2", "ground_kwh_m2"))
        assert row["irradiation_kwh_m2"] == pytest.approx(parts, abs=0.2)
        area = row["area_m2"]
        assert row["irradiation_kwh"] == pytest.approx(row["irradiation_kwh_m2"] * area, abs=0.06 * area + 0.1)
        assert 0.0 <= row["beam_loss"] <= 1.0
        assert 200.0 < row["irradiation_kwh_m2"] < 2200.0
    facts = json.loads(pq.read_metadata(tmp_path / "year.parquet").metadata[FACTS.encode()])
    assert (facts["linke_turbidity"], facts["albedo"], facts["years"]) == (3.0, 0.2, [2025])
    assert facts["latitude_deg"] == pytest.approx(52.01, abs=0.02)
    assert facts["longitude_deg"] == pytest.approx(4.37, abs=0.02)
    again = tmp_path / "again.parquet"
    solar(str(run_dir), str(again), settings=SolarSettings(linke_turbidity=3.0))
    assert again.read_bytes() == (tmp_path / "year.parquet").read_bytes()


def test_weather_of_another_place_is_used_with_a_warning(run_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("pvlib")
    here, warned = Site(longitude_deg=4.37, latitude_deg=52.01, altitude_m=0.0), {}
    for word, site in (("near", here), ("far", dataclasses.replace(here, latitude_deg=48.0))):
        weather = tmp_path / f"{word}.epw"
        write_epw(weather, clear_sky(site, 3.0), site, utc_offset_h=1)
        events: list[Event] = []
        solar(str(placed(run_dir)), str(tmp_path / f"{word}.parquet"), weather=str(weather), on_event=events.append)
        warned[word] = [event.message for event in events if event.kind == "warning"]
        facts = json.loads(pq.read_metadata(tmp_path / f"{word}.parquet").metadata[FACTS.encode()])
        assert facts["file"] == weather.name
        assert facts["file_sha256"] == hashlib.sha256(weather.read_bytes()).hexdigest()
    assert warned["near"] == []
    assert "far.epw is of a place 446 km away" in warned["far"][0]


def test_without_a_crs_the_sky_is_known_and_energy_is_refused(run_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("pvlib")
    with pytest.raises(RunError, match=r"CRS of the run is unknown.*again with a CRS, such as EPSG:25832"):
        solar(str(run_dir), str(tmp_path / "year.parquet"))
    assert not (tmp_path / "year.parquet").exists()
    table = sky(run_dir, tmp_path / "sky.parquet")
    assert all(0.0 < value <= 1.0 for value in table["sky_view"].to_pylist())
    assert {value for name in ENERGY for value in table[name].to_pylist()} == {None}
    metadata = pq.read_metadata(tmp_path / "sky.parquet").metadata
    assert json.loads(metadata[FACTS.encode()])["azimuth_from"] == "grid north"
    assert json.loads(metadata[b"geo"])["columns"]["geometry"]["crs"] is None


def test_without_pvlib_the_error_says_how_to_install_it(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pvlib", None)
    with pytest.raises(RunError, match=r"pip install pvlib.*--sky-only"):
        solar(str(placed(run_dir)), str(tmp_path / "year.parquet"))
    sky(run_dir, tmp_path / "sky.parquet")


def test_a_run_without_planes_gives_an_empty_table(tmp_path: Path) -> None:
    pytest.importorskip("pvlib")
    run_dir = placed(write_run(tmp_path / "run", []))
    assert solar(str(run_dir), str(tmp_path / "none.parquet")).rows == {"planes": 0}
    assert pq.read_table(tmp_path / "none.parquet").num_rows == 0


def test_memory_holds_some_tiles_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_dir = write_run(tmp_path / "run", [])
    context = RecordContext(reference=small.Reference(), settings_hash="ab", engine_version="0")
    for number in range(TILES):
        write_tile(run_dir, f"m{number:02}", [moved(street()[0], 100.0 * number)], [], context)
    kept: list[Any] = []
    made = runs._Run
    monkeypatch.setattr(runs, "_Run", lambda *words: kept.append(made(*words)) or kept[0])
    sky(run_dir, tmp_path / "sky.parquet")
    memory = kept[0].tile.cache_info()
    # two empty tiles are near to none; the others are read once, although their neighbours need them, too
    assert (memory.currsize, memory.misses) == (TILES_IN_MEMORY, TILES + 2)
    assert memory.hits > TILES


@pytest.mark.parametrize(("epsg", "x", "y"), [(25832, 750_000.0, 5_900_000.0), (28992, 85_000.0, 447_000.0)])
def test_azimuths_are_those_of_the_earth(epsg: int, x: float, y: float) -> None:
    crs = pyproj.CRS.from_epsg(epsg)
    reference = SpatialReference(wkt=crs.to_wkt(), name=crs.name)
    north = convergence_deg(reference, x, y)
    longitude, latitude = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform(x, y)
    assert north == pytest.approx(pyproj.Proj(crs).get_factors(longitude, latitude).meridian_convergence, abs=0.02)
    ends = np.array([(x, y, 0.0), (x + 80.0, y + 60.0, 0.0)])
    planes = RoofPlanes(
        faces=np.array([shapely.LineString(ends)], dtype=object),
        building=np.zeros(1, np.int64),
        slope_deg=np.zeros(1),
        aspect_deg=np.array([math.degrees(math.atan2(80.0, 60.0))]),
        through=ends[1:],
    )
    turned = planes.turned(ends[0], north)
    degrees = pyproj.Transformer.from_crs(crs, 4326, always_xy=True).transform(*ends[:, :2].T)
    azimuth, _, _ = pyproj.Geod(ellps="WGS84").inv(degrees[0][0], degrees[1][0], degrees[0][1], degrees[1][1])
    east, to_north, _ = turned.through[0]
    assert math.degrees(math.atan2(east, to_north)) == pytest.approx(azimuth, abs=0.02)
    assert turned.aspect_deg[0] == pytest.approx(azimuth, abs=0.02)
    assert shapely.get_coordinates(turned.faces)[1] == pytest.approx(turned.through[0, :2])
    assert abs(north) > 0.5


def test_the_command_ends_with_the_code_of_the_fault(run_dir: Path, tmp_path: Path) -> None:
    words = ("solar", str(run_dir), "--out", str(tmp_path / "sky.parquet"), "--sky-only")
    assert invoke(*words, "--reach", "-1")[0] == 2
    assert invoke(*words, "--weather", "x.epw")[0] == 2
    assert invoke("solar", str(placed(run_dir)), "--out", str(tmp_path / "a.parquet"), "--weather", "x.epw")[0] == 3
