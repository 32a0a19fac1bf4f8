"""Given lines of roofs: four formats, kinds, other reference systems, and what is wrong with single lines."""

from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
import shapely
from shapely import LineString, MultiLineString, Point

from pipeline.errors import EmptyInputError, UnreadableInputError
from pipeline.extras.guides.guides_file import GivenLines, read_guides
from pipeline.io.crs import SpatialReference
from pipeline.io.crs_resolution import resolve_reference
from pipeline.model import GuideKind

RIDGE = LineString([(85_000.0, 447_004.0, 12.0), (85_010.0, 447_004.0, 12.0)])
EAVE = LineString([(85_000.0, 447_000.0), (85_010.0, 447_000.0), (85_010.0, 447_008.0)])
AREA = shapely.box(84_900, 446_900, 85_100, 447_100)


def reference(crs: str = "EPSG:7415") -> SpatialReference:
    return resolve_reference(path="points", crs=crs)[0]


def write(path: Path, lines: Any = (RIDGE, EAVE), crs: str | None = "EPSG:28992", **columns: Any) -> Path:
    """Written by geopandas: an independent writer."""
    frame = geopandas.GeoDataFrame(columns, geometry=list(lines), crs=crs)
    frame.to_parquet(path) if path.suffix == ".parquet" else frame.to_file(path)
    return path


def read(path: Path, **options: Any) -> GivenLines:
    return read_guides(path, reference(), **{"area": AREA, **options})


@pytest.mark.parametrize("suffix", [".gpkg", ".shp", ".geojson", ".parquet"])
def test_four_formats_give_the_same_lines_in_plan(tmp_path: Path, suffix: str) -> None:
    lines = [shapely.force_2d(RIDGE), EAVE] if suffix == ".shp" else [RIDGE, EAVE]
    found = read(write(tmp_path / f"a{suffix}", lines, kind=["Ridge", "eave"]))
    assert [guide.kind for guide in found.guides] == [GuideKind.RIDGE, GuideKind.EAVE]
    for guide, line in zip(found.guides, (RIDGE, EAVE), strict=True):
        assert guide.line.equals_exact(shapely.force_2d(line), 0.05 if suffix == ".geojson" else 1e-9)
        assert not guide.line.has_z
    assert (found.issues, found.elsewhere.count) == ((), 0)


def test_a_line_to_the_end_of_all_numbers_has_no_place_in_the_crs(tmp_path: Path) -> None:
    found = read(write(tmp_path / "a.parquet", [LineString([(85_000.0, 447_004.0), (1e300, 447_004.0)]), RIDGE]))
    assert [issue.problem for issue in found.issues] == ["outside_crs"]
    assert len(found.guides) == 1


def test_a_line_without_a_kind_is_of_any_kind(tmp_path: Path) -> None:
    found = read(write(tmp_path / "a.gpkg", kind=[None, " "]))
    assert [guide.kind for guide in found.guides] == [GuideKind.ANY] * 2
    assert found.warnings == ()
    found = read(write(tmp_path / "b.gpkg", name=["a", "b"]))
    assert [guide.kind for guide in found.guides] == [GuideKind.ANY] * 2
    assert found.warnings == ("the guides have no column 'kind': all are of kind any",)


def test_the_column_of_kinds_can_be_named_and_must_then_be_there(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", linetype=["hip", "valley"])
    assert [guide.kind for guide in read(path, kind_column="linetype").guides] == [GuideKind.HIP, GuideKind.VALLEY]
    with pytest.raises(UnreadableInputError, match=r"'sort' is not there.*kind_column .* linetype"):
        read(path, kind_column="sort")


def test_lines_in_degrees_are_reprojected_and_that_is_reported(tmp_path: Path) -> None:
    degrees = geopandas.GeoSeries([RIDGE, EAVE], crs="EPSG:28992").to_crs("EPSG:4326")
    found = read(write(tmp_path / "a.parquet", degrees, crs="EPSG:4326", kind=["ridge", "eave"]))
    assert found.guides[1].line.hausdorff_distance(EAVE) < 1e-3
    assert any("the guides are reprojected from 'WGS 84'" in warning for warning in found.warnings)


def test_lines_in_feet_become_metres(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", crs="EPSG:2992", kind=["ridge", "eave"])
    area = shapely.transform(AREA, lambda xy: xy * 0.3048)
    found = read_guides(path, reference("EPSG:2992"), area=area)
    assert found.guides[0].line.length == pytest.approx(3.048)


def test_every_fault_of_a_line_is_listed_and_the_others_are_used(tmp_path: Path) -> None:
    lines = {
        "good": EAVE,
        "none": None,
        "point": Point(85_000, 447_000),
        "empty": LineString(),
        "gable": EAVE,
        "two": MultiLineString([RIDGE, EAVE]),
    }
    kinds = [name if name == "gable" else "eave" for name in lines]
    found = read(write(tmp_path / "a.gpkg", lines.values(), kind=kinds))
    assert len(found.guides) == 3
    numbers = {name: number for number, name in enumerate(lines, 1)}
    assert {(issue.feature, issue.problem) for issue in found.issues} == {
        (numbers["none"], "no_geometry"),
        (numbers["point"], "not_line"),
        (numbers["empty"], "empty"),
        (numbers["gable"], "unknown_kind"),
    }
    (unknown,) = (str(issue) for issue in found.issues if issue.problem == "unknown_kind")
    assert "its kind is 'gable': use one of ridge, hip, valley, eave, step, any: left out" in unknown
    (summary,) = found.warnings
    assert summary.startswith("4 guides are left out: ")


def test_lines_off_the_area_are_passed_over_and_counted(tmp_path: Path) -> None:
    far = shapely.transform(EAVE, lambda xy: xy + 5_000.0)
    found = read(write(tmp_path / "a.gpkg", [EAVE, far, far], kind=["eave"] * 3))
    assert (len(found.guides), found.elsewhere.count) == (1, 2)


def test_a_file_without_a_usable_line_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EmptyInputError, match=r"none of the 2 features is a line"):
        read(write(tmp_path / "a.gpkg", [None, Point(np.array([85_000, 447_000]))], kind=["ridge", "eave"]))
