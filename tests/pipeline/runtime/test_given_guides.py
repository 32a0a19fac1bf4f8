"""Given lines of roofs end to end: digests, records, faults, and what is modelled again where a line changed."""

import json
from pathlib import Path
from typing import Any

import geopandas
import pytest
import shapely
from run_tables import rows_by_id
from shapely import LineString, Point, Polygon

from pipeline.errors import EmptyInputError, InputError, RunError
from pipeline.extras.overrides.overrides_file import read_overrides
from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.io.crs import SpatialReference
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.settings import RunSettings

NO_GUIDES = ("guides_followed", "guides_not_followed")


@pytest.fixture(scope="module")
def plain(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A run without guides."""
    out = str(tmp_path_factory.mktemp("plain") / "run")
    return run(RunRequest(inputs=(str(suburb),), out=out, resources=SERIAL))


@pytest.fixture(scope="module")
def houses(plain: Any) -> dict[str, Polygon]:
    """The outlines of its buildings, by id."""
    return {name: shapely.from_wkb(row["geometry"]) for name, row in rows_by_id(plain.run_dir).items()}


def longest_edge(outline: Polygon, outwards_m: float = 0.0) -> LineString:
    """The longest edge of an outline, farther outwards."""
    edge = max(
        (LineString(ends) for ends in zip(outline.exterior.coords, outline.exterior.coords[1:], strict=False)),
        key=lambda line: line.length,
    )
    sides = [edge.offset_curve(side * max(outwards_m, 1e-6)) for side in (1, -1)]
    return max(sides, key=outline.distance) if outwards_m else edge


def write(path: Path, lines: Any, kinds: Any = None) -> str:
    frame = geopandas.GeoDataFrame({"kind": kinds or ["eave"] * len(lines)}, geometry=list(lines), crs="EPSG:25832")
    frame.to_file(path)
    return str(path)


def test_an_eave_moves_the_outline_and_the_record_counts_it(
    suburb: Path, plain: Any, houses: dict[str, Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    name, outline = next(iter(houses.items()))
    eave = longest_edge(outline, 0.2)
    found = reconstruct(suburb, guides=write(tmp_path / "a.gpkg", [eave]))
    rows = rows_by_id(found.run_dir)
    assert rows.keys() == houses.keys()
    moved = shapely.from_wkb(rows[name]["geometry"])
    assert eave.interpolate(0.5, normalized=True).distance(moved.boundary) < 0.01
    assert [rows[name][column] for column in NO_GUIDES] == [1, 0]
    for other in houses.keys() - {name}:
        before = rows_by_id(plain.run_dir)[other]
        assert [rows[other][column] for column in NO_GUIDES] == [None, None]
        assert {k: v for k, v in rows[other].items() if k != "input_hash"} == {
            k: v for k, v in before.items() if k != "input_hash"
        }
    report = json.loads(Path(found.run_dir, "guides.json").read_text())
    assert report == {"path": str(tmp_path / "a.gpkg"), "used": 1, "off_the_data": 0, "left_out": 0, "issues": []}
    assert any(
        entry["path"].endswith("a.gpkg") for entry in json.loads(Path(found.run_dir, "run.json").read_text())["inputs"]
    )


def test_guides_off_the_data_leave_the_digest_and_are_refused_where_none_lies_on_it(
    suburb: Path, houses: dict[str, Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    outlines = list(houses.values())
    east, north = shapely.union_all(outlines).bounds[2:]
    far = LineString([(east + 5_000.0, north), (east + 5_010.0, north)])
    near = longest_edge(outlines[0], 0.2)
    alone = reconstruct(suburb, guides=write(tmp_path / "a.gpkg", [near]))
    found = reconstruct(suburb, guides=write(tmp_path / "b.gpkg", [near, far]))
    assert found.digest == alone.digest
    assert "1 of 2 guides lie off the data" in found.warnings
    with pytest.raises(EmptyInputError, match="none of its guides lies on the data: they lie at x"):
        reconstruct(suburb, guides=write(tmp_path / "c.gpkg", [far]))


def test_the_digest_with_guides_does_not_depend_on_tiles_or_on_the_order_of_lines(
    suburb: Path, plain: Any, houses: dict[str, Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    lines = [longest_edge(outline, 0.2) for outline in houses.values()]
    lines += [LineString([outline.centroid, outline.exterior.coords[0]]) for outline in houses.values()]
    kinds = ["eave"] * len(houses) + ["any"] * len(houses)
    one = reconstruct(suburb, guides=write(tmp_path / "a.gpkg", lines, kinds))
    small = reconstruct(
        suburb,
        guides=write(tmp_path / "b.gpkg", lines[::-1], kinds[::-1]),
        settings={"tile_size_m": 40.0, "lattice_x_m": 13.0, "lattice_y_m": 7.0},
    )
    assert one.digest == small.digest != plain.digest


def test_a_changed_guide_models_only_what_it_touches_again(
    suburb: Path, houses: dict[str, Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    work = str(tmp_path / "work")
    lines = {name: longest_edge(outline, 0.2) for name, outline in houses.items()}
    first = reconstruct(suburb, guides=write(tmp_path / "a.gpkg", lines.values()), work=work, out=str(tmp_path / "run"))
    changed = next(iter(lines))
    lines[changed] = longest_edge(houses[changed], 0.1)
    again = reconstruct(suburb, guides=write(tmp_path / "b.gpkg", lines.values()), work=work, out=str(tmp_path / "run"))
    fresh = reconstruct(suburb, guides=str(tmp_path / "b.gpkg"))
    assert first.digest != again.digest == fresh.digest
    assert again.counts["candidates"] - again.counts["reused"] == 1


def test_a_rerun_keeps_the_guides_and_refuses_another_file_of_them(
    suburb: Path, houses: dict[str, Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    name, outline = next(iter(houses.items()))
    path = write(tmp_path / "a.gpkg", [longest_edge(outline, 0.2)])
    found = reconstruct(suburb, guides=path)
    assert rerun(RerunRequest(run_dir=found.run_dir, only=(name,), resources=SERIAL)).digest == found.digest
    Path(path).unlink()
    write(tmp_path / "a.gpkg", [longest_edge(outline, 0.1)])
    with pytest.raises(RunError, match=r"a\.gpkg is not the file that the run read"):
        rerun(RerunRequest(run_dir=found.run_dir, only=(name,), resources=SERIAL))


def test_faults_of_lines_are_reported_and_stop_nothing(
    suburb: Path, houses: dict[str, Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    outline = next(iter(houses.values()))
    lines = [longest_edge(outline, 0.2), Point(outline.centroid), longest_edge(outline)]
    found = reconstruct(suburb, guides=write(tmp_path / "a.gpkg", lines, ["eave", "eave", "gutter"]))
    report = json.loads(Path(found.run_dir, "guides.json").read_text())
    assert (report["used"], report["left_out"]) == (1, 2)
    assert [issue["problem"] for issue in report["issues"]] == ["not_line", "unknown_kind"]
    assert "2 guides are left out: 1 no lines, 1 of an unknown kind" in found.warnings


def test_a_method_that_traces_faces_takes_no_guides(
    suburb: Path, houses: dict[str, Polygon], reconstruct: Any, tmp_path: Path
) -> None:
    path = write(tmp_path / "a.gpkg", [longest_edge(next(iter(houses.values())))])
    with pytest.raises(InputError, match=r"kmeans traces roof faces .* takes no guides"):
        reconstruct(suburb, guides=path, settings={"method": "kmeans", "preset": "faithful"})
    assert not list(tmp_path.glob("run-*/run.json"))


def test_a_building_can_have_a_distance_of_its_own_and_defaults_leave_the_hash(tmp_path: Path) -> None:
    own = RunSettings.from_mapping({"guides": {"distance_m": 1.0}})
    assert own.settings_hash != RunSettings().settings_hash == RunSettings.from_mapping({"guides": {}}).settings_hash
    path = tmp_path / "overrides.toml"
    path.write_text('[[building]]\nbuilding_id = "a"\nsettings.guides.distance_m = 1.0\n')
    (override,) = read_overrides(str(path), SpatialReference(), RunSettings())
    assert override.settings == {"guides": {"distance_m": 1.0}}
