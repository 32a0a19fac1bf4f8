"""Elevations in feet over a plan in metres: every format states the unit, or has one for all axes."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pyproj
import pytest
import rasterio
from las_files import write_las

from pipeline.errors import CrsError
from pipeline.export.geoparquet import read_table
from pipeline.extras.publish_3dtiles.publishing_3dtiles import publish_3dtiles
from pipeline.extras.publish_gis.geopackage import publish_geopackage
from pipeline.extras.publish_gis.pmtiles import publish_pmtiles
from pipeline.extras.terrain_tin.terrain_files import read_terrain
from pipeline.io import ReadOptions, arrow_at
from pipeline.io.crs import vertical_unit_of
from pipeline.ruler.evaluation.reading import read_models
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.runtime.run_plan import make_plan
from pipeline.settings import RunSettings

FOOT_M = 1200.0 / 3937.0
CRS = "EPSG:26910+6360"
"""UTM in metres, NAVD88 in US survey feet."""
FLOOR_M, TOP_M = 100.0, 106.0


def flat_house(unit_m: float = FOOT_M) -> np.ndarray:
    """A flat roof of 14 x 10 m on a level plain: x, y in metres, z in a unit."""
    rng = np.random.default_rng(4)
    x, y = rng.uniform(0.0, 40.0, (2, 40 * 40 * 8))
    roof = (x > 13) & (x < 27) & (y > 15) & (y < 25)
    z = np.where(roof, TOP_M, FLOOR_M) + rng.normal(0.0, 0.01, len(x))
    return np.column_stack([x + 500_000, y + 4_880_000, z / unit_m])


@pytest.fixture(scope="module")
def tile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_las(tmp_path_factory.mktemp("feet") / "feet.laz", flat_house(), CRS)


def modelled(tile: Path, out: Path, **more: Any) -> Path:
    settings = RunSettings.from_mapping({"terrain": "tin"})
    run(RunRequest(inputs=(str(tile),), out=str(out), settings=settings, resources=SERIAL, meshes="glb", **more))
    return out


@pytest.fixture(scope="module")
def out(tile: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with the header's horizontal CRS given."""
    return modelled(tile, tmp_path_factory.mktemp("runs") / "given", crs="26910")


def rows_of(run_dir: Path, name: str) -> list[dict[str, Any]]:
    filesystem, folder = arrow_at(run_dir)
    rows: list[dict[str, Any]] = read_table(folder, name, filesystem).to_pylist()
    return rows


def test_a_given_plan_keeps_the_feet_of_the_header(out: Path) -> None:
    (row,) = rows_of(out, "buildings")
    assert row["height_m"] == pytest.approx(TOP_M - FLOOR_M, abs=0.1)
    assert row["ridge_z"] * FOOT_M == pytest.approx(TOP_M, abs=0.1)
    manifest = read_manifest(out)
    assert any("units are mixed" in warning and "US survey foot" in warning for warning in manifest.warnings)
    assert manifest.crs is not None
    assert pyproj.CRS.from_wkt(manifest.crs["wkt"]).sub_crs_list[1].to_epsg() == 6360


def test_tables_state_the_unit_by_their_crs(out: Path) -> None:
    for name in ("buildings", "planes", "rejected"):
        (path,) = out.glob(f"{name}/*/*.parquet")
        geo = json.loads(pyarrow_metadata(path)[b"geo"])
        for column in geo["columns"].values():
            assert vertical_unit_of(pyproj.CRS.from_json_dict(column["crs"])) == pytest.approx(FOOT_M, rel=1e-12)


def pyarrow_metadata(path: Path) -> dict[bytes, bytes]:
    import pyarrow.parquet as pq

    return dict(pq.read_schema(path).metadata)


def test_cityjson_has_the_unit_of_its_reference_system_for_all_axes_and_attributes(out: Path) -> None:
    (buildings,), (terrain,) = out.glob("cityjson/*/*.jsonl"), out.glob("terrain/*/*.jsonl")
    lines = buildings.read_text().splitlines()
    heading, feature = (json.loads(line) for line in lines)
    assert heading["metadata"]["referenceSystem"].endswith("/EPSG/0/26910")
    assert heading["transform"]["scale"] == [0.001, 0.001, 0.001]
    z = np.array(feature["vertices"])[:, 2] * 0.001 + heading["transform"]["translate"][2]
    assert (z.min(), z.max()) == (pytest.approx(FLOOR_M, abs=0.1), pytest.approx(TOP_M, abs=0.1))
    assert heading["metadata"]["geographicalExtent"][2::3] == [z.min(), z.max()]
    attributes = feature["CityObjects"][feature["id"]]["attributes"]
    assert (attributes["ground_z"], attributes["ridge_z"]) == (pytest.approx(z.min()), pytest.approx(z.max()))
    ground = read_terrain(terrain.read_text().splitlines()).vertices[:, 2]
    assert ground == pytest.approx(np.full(len(ground), FLOOR_M), abs=0.1)


def test_meshes_state_the_unit(out: Path) -> None:
    (glb,) = out.glob("meshes/*/*.glb")
    document, _ = parts_of(glb)
    place = next(node["extras"] for node in document["nodes"] if "origin_m" in node.get("extras", {}))
    assert (place["crs"].rsplit("/", 1)[1], place["vertical_unit_m"]) == ("26910", 1.0)
    assert place["origin_m"][2] == pytest.approx(FLOOR_M, abs=1.0)
    (obj,) = out.glob("terrain/*/*.obj")
    heading, _, vertex, *_ = obj.read_text().splitlines()
    assert "0.304800609601 m vertically" in heading
    assert float(vertex.split()[3]) * FOOT_M == pytest.approx(FLOOR_M, abs=0.1)


def test_published_forms_state_it_or_are_in_metres(out: Path, tmp_path: Path) -> None:
    (row,) = rows_of(out, "buildings")
    publish_geopackage(str(out), str(tmp_path / "a.gpkg"))
    info = pyogrio.read_info(tmp_path / "a.gpkg", layer="planes")
    assert vertical_unit_of(pyproj.CRS.from_user_input(info["crs"])) == pytest.approx(FOOT_M, rel=1e-9)
    publish_pmtiles(str(out), str(tmp_path / "a.pmtiles"))
    meta, _, _, values = pyogrio.raw.read(tmp_path / "a.pmtiles")
    ridge = {name: found[0] for name, found in zip(meta["fields"], values, strict=True)}["ridge_z"]
    assert ridge == round(row["ridge_z"] * FOOT_M, 3)
    publish_3dtiles(str(out), str(tmp_path / "tiles"))
    root = json.loads((tmp_path / "tiles" / "tileset.json").read_text())["root"]
    low, high = root["boundingVolume"]["region"][4:]
    assert (low, high) == (pytest.approx(FLOOR_M, abs=0.1), pytest.approx(TOP_M, abs=0.1))
    (models,) = (tmp_path / "tiles" / "models").glob("*.glb")
    document, binary = parts_of(models)
    (table,) = document["extensions"]["EXT_structural_metadata"]["propertyTables"]
    view = document["bufferViews"][table["properties"]["ridge_z"]["values"]]
    assert np.frombuffer(binary, "<f8", 1, view.get("byteOffset", 0))[0] == ridge


def parts_of(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary part of a GLB file."""
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def test_the_models_are_read_back_in_metres(out: Path) -> None:
    (model,) = read_models(out).models
    z = np.concatenate([solid.vertices[:, 2] for solid in model.solids]) + model.solid_origin[2]
    assert (z.min(), z.max()) == (pytest.approx(FLOOR_M, abs=0.1), pytest.approx(TOP_M, abs=0.1))


def test_a_given_vertical_unit_reaches_the_header_of_the_classified_points(tmp_path: Path, run_classify: Any) -> None:
    write_las(tmp_path / "a.laz", flat_house(), "EPSG:26910+5703")  # the header says metres
    summary = run_classify(tmp_path / "a.laz", vertical_unit="us-ft", rasters=True)
    crs = laspy.read(summary.files[0].path).header.parse_crs()
    assert crs.sub_crs_list[1].to_epsg() == 6360
    with rasterio.open(Path(summary.out) / "terrain.tif") as raster:
        assert raster.units == ("US survey foot",)
        assert vertical_unit_of(pyproj.CRS.from_user_input(raster.crs)) == pytest.approx(FOOT_M, rel=1e-9)
    assert any("replaces the header's metre" in warning for warning in summary.warnings)


def test_headers_with_and_without_a_vertical_crs_make_one_run_where_its_plan_is_given(tmp_path: Path) -> None:
    paths = [str(tmp_path / f"{name}.laz") for name in "ab"]
    for path, crs in zip(paths, ("EPSG:28992", "EPSG:7415"), strict=True):
        write_las(Path(path), flat_house(1.0) - [400_000, 4_433_000, 0], crs)
    options = ReadOptions(crs="EPSG:28992")
    for inputs in (paths, paths[::-1]):
        assert make_plan(inputs, options, RunSettings()).reference.epsg == 7415
    with pytest.raises(CrsError, match="--crs"):
        make_plan(paths, ReadOptions(), RunSettings())
    write_las(Path(paths[0]), flat_house(), "EPSG:28992+6360")
    with pytest.raises(CrsError, match="EPSG:28992\\+5709"):
        make_plan(paths, options, RunSettings())
    assert make_plan(paths, ReadOptions(crs="EPSG:7415"), RunSettings()).reference.epsg == 7415
