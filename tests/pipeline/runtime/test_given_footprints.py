"""Given footprints end to end: every fault is reported, none stops a run, ids and attributes come out again."""

import json
from pathlib import Path
from typing import Any

import geopandas
import pytest
import shapely
from run_tables import rows
from shapely import Point, Polygon

from pipeline.errors import EmptyInputError
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run


def rows_by_source(run_dir: str) -> dict[str, dict[str, Any]]:
    return {row["source_id"]: row for row in rows(run_dir)}


def features(run_dir: str) -> dict[str, dict[str, Any]]:
    """Attributes of the CityJSON buildings, by their source_id."""
    found = {}
    for path in Path(run_dir).glob("cityjson/*/*.jsonl"):
        for line in path.read_text().splitlines()[1:]:
            for entry in json.loads(line)["CityObjects"].values():
                if entry["type"] == "Building":
                    found[entry["attributes"]["source_id"]] = entry["attributes"]
    return found


@pytest.fixture(scope="module")
def houses(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Polygon]:
    """Outlines of the suburb's houses, by a run without footprints."""
    out = str(tmp_path_factory.mktemp("found") / "run")
    run(RunRequest(inputs=(str(suburb),), out=out, resources=SERIAL))
    return sorted((shapely.from_wkb(row["geometry"]).envelope for row in rows(out)), key=lambda outline: outline.bounds)


def write_parquet(folder: Path, outlines: list[Any]) -> str:
    """A GeoParquet file of outlines, numbered from 0."""
    frame = geopandas.GeoDataFrame({"id": range(len(outlines))}, geometry=outlines, crs="EPSG:25832")
    frame.to_parquet(folder / "a.parquet")
    return str(folder / "a.parquet")


def twisted(polygon: Polygon) -> Polygon:
    """The rectangle's corners as a bow tie."""
    a, b, c, d = polygon.exterior.coords[:4]
    return Polygon([a, c, b, d])


@pytest.mark.parametrize("name", ["a.gpkg", "a.parquet"])
def test_attributes_and_ids_come_out_again(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path, name: str
) -> None:
    columns = {"id": ["x-1", "x-2"], "status": ["built", None], "year": [1901, 1955], "Größe": [1.5, 2.5]}
    frame = geopandas.GeoDataFrame(columns, geometry=houses[:2], crs="EPSG:25832")
    path = tmp_path / name
    frame.to_parquet(path) if name.endswith("parquet") else frame.to_file(path)
    summary = reconstruct(suburb, footprints=str(path))
    found = rows_by_source(summary.run_dir)
    wanted = {
        "x-1": {"id": "x-1", "status": "built", "year": 1901, "Größe": 1.5},
        "x-2": {"id": "x-2", "status": None, "year": 1955, "Größe": 2.5},
    }
    assert {name: json.loads(row["source_attributes"]) for name, row in found.items()} == wanted
    assert {name: found["source_attributes"] for name, found in features(summary.run_dir).items()} == wanted
    # a column of the file with the name of one of ours stays apart from it
    assert features(summary.run_dir)["x-1"]["status"] == "ok"
    report = json.loads((Path(summary.run_dir) / "footprints.json").read_text())
    counts = {"used": 2, "off_the_data": 0, "repaired": 0, "left_out": 0}
    assert report == {"path": str(path), **counts, "issues": []}


def test_every_fault_is_reported_by_its_id_and_none_stops_the_run(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    far = shapely.box(0, 0, 10, 10)
    line = Polygon([houses[0].exterior.coords[k] for k in (0, 2, 0, 2)])
    outlines = {
        "good": houses[0],
        "bow tie": twisted(houses[1]),
        "empty": Polygon(),
        "none": None,
        "point": Point(houses[0].centroid),
        "line": line,
        "far": far,
        "far bow tie": twisted(far),
    }
    path = tmp_path / "a.gpkg"
    geopandas.GeoDataFrame({"id": list(outlines)}, geometry=list(outlines.values()), crs="EPSG:25832").to_file(path)
    summary = reconstruct(suburb, footprints=str(path))
    assert set(rows_by_source(summary.run_dir)) == {"good", "bow tie"}
    report = json.loads((Path(summary.run_dir) / "footprints.json").read_text())
    assert (report["used"], report["off_the_data"], report["repaired"], report["left_out"]) == (2, 2, 1, 4)
    problems = {"bow tie": "invalid", "empty": "empty", "none": "no_geometry"}
    problems |= {"point": "not_polygon", "line": "no_area"}
    assert {issue["source_id"]: issue["problem"] for issue in report["issues"]} == problems
    for issue in report["issues"]:
        assert any(warning.startswith(f"footprint {issue['source_id']}: ") for warning in summary.warnings)
    assert "repaired to 2 polygons" in next(i["action"] for i in report["issues"] if i["source_id"] == "bow tie")


def test_many_faults_are_warned_of_ten_by_ten_and_listed_whole(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    summary = reconstruct(suburb, footprints=write_parquet(tmp_path, [houses[0], *[None] * 30]))
    assert sum(warning.startswith("footprint ") for warning in summary.warnings) == 10
    assert "20 more faults of footprints, each in footprints.json of a run" in summary.warnings
    assert len(json.loads((Path(summary.run_dir) / "footprints.json").read_text())["issues"]) == 30


def test_a_later_run_without_footprints_leaves_no_report_behind(
    suburb: Path, houses: list[Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    out = str(tmp_path / "run")
    reconstruct(suburb, footprints=write_parquet(tmp_path, houses[:1]), out=out)
    assert (tmp_path / "run" / "footprints.json").is_file()
    reconstruct(suburb, out=out, overwrite=True)
    assert not (tmp_path / "run" / "footprints.json").exists()
    assert not (tmp_path / "run" / "overrides.json").exists()


def test_footprints_of_which_none_can_be_used_are_refused(suburb: Path, reconstruct: Any, tmp_path: Path) -> None:
    with pytest.raises(EmptyInputError, match="none of the 2 features is a polygon"):
        reconstruct(suburb, footprints=write_parquet(tmp_path, [Polygon(), None]))


def test_the_footprints_of_delft_model_their_buildings_with_their_attributes(
    shared_data: Path, reconstruct: Any, tmp_path: Path
) -> None:
    """A corner of Delft's old town: terraced houses, from the GeoPackage and from GeoParquet."""
    known = geopandas.read_file(shared_data / "ahn3" / "footprints.gpkg")
    x, y = known.geometry.iloc[0].centroid.coords[0]
    window = (x - 30.0, y - 30.0, x + 30.0, y + 30.0)
    known.to_parquet(tmp_path / "a.parquet")
    tiles = [shared_data / "ahn3" / f"delft_{side}.laz" for side in ("west", "east")]
    digests = set()
    for path in (shared_data / "ahn3" / "footprints.gpkg", tmp_path / "a.parquet"):
        summary = reconstruct(*tiles, crs="EPSG:7415", footprints=str(path), bbox=window)
        found = rows_by_source(summary.run_dir)
        inside = known[known.intersects(shapely.box(*window))].set_index("bgt_id")
        assert set(found) == set(inside.index)
        for name, row in found.items():
            columns = json.loads(row["source_attributes"])
            assert (columns["bgt_id"], columns["status"]) == (name, inside.loc[name, "status"])
        # dates are written in the writer's own way; all else is the same
        digests.add(tuple(sorted((name, row["status"], row["geometry"]) for name, row in found.items())))
    assert len(digests) == 1
