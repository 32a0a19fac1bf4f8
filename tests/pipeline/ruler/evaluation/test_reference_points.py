"""Classified points as a reference: buildings by given footprints, or by what hangs together on the raster."""

import itertools
from pathlib import Path

import laspy
import numpy as np
import pyogrio.raw
import pyproj
import pytest
import shapely
from las_files import write_las

from pipeline.errors import InconsistentInputError, InputError, SettingsError
from pipeline.io import ReadOptions
from pipeline.model import FloatArray
from pipeline.ruler.evaluation.detection_scores import detect, detection_measures
from pipeline.ruler.evaluation.ground_scores import ground_blocks
from pipeline.ruler.evaluation.reference_points import read_points_reference
from pipeline.ruler.evaluation.subsets import subsets

CORNER = np.array([690_000.0, 5_330_000.0, 0.0])
HOUSES = {
    "a": shapely.box(690_005, 5_330_005, 690_015, 5_330_013),
    "b": shapely.box(690_020, 5_330_005, 690_028, 5_330_015),
    "shed": shapely.box(690_032, 5_330_030, 690_034, 5_330_032),
    "cut": shapely.box(689_990, 5_330_030, 690_006, 5_330_038),
}


def street(step: float = 0.25) -> tuple[FloatArray, np.ndarray]:
    """Points and classes of 40 x 40 m with the four houses on a level ground."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.05, 40, step), np.arange(0.05, 40, step)))
    xyz = np.column_stack((x, y, np.zeros(len(x)))) + CORNER
    built = shapely.contains_xy(shapely.union_all(list(HOUSES.values())), xyz[:, 0], xyz[:, 1])
    xyz[built, 2] = 6.0
    return xyz, np.where(built, 6, 2).astype(np.uint8)


def write(path: Path, xyz: FloatArray, classes: np.ndarray, returns: int = 1, unit: float = 1.0) -> Path:
    return write_las(path, xyz / unit, classification=classes, number_of_returns=returns)


def write_footprints(path: Path) -> Path:
    pyogrio.raw.write(
        path,
        np.array([shapely.to_wkb(polygon) for polygon in HOUSES.values()], dtype=object),
        [np.array(list(HOUSES), dtype=object)],
        np.array(["id"]),
        driver="GPKG",
        geometry_type="Polygon",
        crs="EPSG:32632",
    )
    return path


@pytest.fixture
def tile(tmp_path: Path) -> Path:
    return write(tmp_path / "street.laz", *street())


def test_outlines_of_the_raster_are_the_buildings_where_no_footprints_are_given(tile: Path) -> None:
    reference = read_points_reference([tile], crs="EPSG:32632")
    assert (reference.kind, reference.outlines, reference.has_faces, reference.has_ground) == (
        "points",
        "raster",
        False,
        True,
    )
    assert reference.crs == "EPSG:32632"
    by_area = sorted(reference.buildings, key=lambda building: -building.footprint.area)
    # the cross takes one cell at each corner; beyond the data there is no building
    assert [building.footprint.area for building in by_area] == pytest.approx([80 - 1, 80 - 1, 48 - 1, 4 - 1])
    for building in by_area[:2]:
        assert min(building.footprint.symmetric_difference(HOUSES[name]).area for name in ("a", "b")) == 1.0
    # the third is cut by the end of the data, the last is a speck: neither need be found
    assert [building.touches_data_edge for building in by_area] == [False, False, True, True]
    assert any("1 of them are smaller than 10 m2" in note for note in reference.notes)
    (points,) = reference.points()
    for number, building in enumerate(reference.buildings):
        inside = shapely.contains_xy(building.footprint, points.xyz[:, 0], points.xyz[:, 1])
        assert (points.building[inside] == number).all()
        assert (points.is_roof[inside] == (points.classification[inside] == 6)).all()
    assert not points.is_roof[points.building < 0].any()


def test_given_footprints_with_points_are_the_buildings_and_the_rest_is_noted(tile: Path, tmp_path: Path) -> None:
    xyz, classes = street()
    # of the shed's points only ten are left
    shed = np.flatnonzero(shapely.contains_xy(HOUSES["shed"], xyz[:, 0], xyz[:, 1]))
    keep = np.ones(len(xyz), bool)
    keep[shed[10:]] = False
    sparse = write(tmp_path / "sparse.laz", xyz[keep], classes[keep])
    footprints = write_footprints(tmp_path / "f.gpkg")
    reference = read_points_reference([sparse], footprints=footprints, crs="EPSG:32632")
    assert reference.outlines == "given"
    assert reference.extent is None
    assert [building.source_id for building in reference.buildings] == ["a", "b", "cut"]
    assert [building.touches_data_edge for building in reference.buildings] == [False, False, True]
    assert any("1 of 4 given footprints have fewer than 11 points of class 6" in note for note in reference.notes)
    (points,) = reference.points()
    assert np.bincount(points.building[points.is_roof]).tolist() == [
        int(shapely.contains_xy(HOUSES[name], xyz[:, 0], xyz[:, 1]).sum()) for name in ("a", "b", "cut")
    ]
    assert len(read_points_reference([tile], footprints=footprints, crs="EPSG:32632").buildings) == 4


@pytest.mark.parametrize("n", [2, 3])
def test_tiles_of_the_same_points_give_the_same_reference(tile: Path, tmp_path: Path, n: int) -> None:
    xyz, classes = street()
    whole = read_points_reference([tile], crs="EPSG:32632")
    borders = np.linspace(xyz[:, 0].min(), xyz[:, 0].max() + 1, n + 1)
    paths = [
        write(tmp_path / f"part{k}.laz", xyz[inside], classes[inside])
        for k, (low, high) in enumerate(itertools.pairwise(borders))
        if (inside := (xyz[:, 0] >= low) & (xyz[:, 0] < high)).any()
    ]
    split = read_points_reference(paths, crs="EPSG:32632")
    assert len(split.tiles) == n
    assert [b.footprint for b in split.buildings] == [b.footprint for b in whole.buildings]
    assert [b.touches_data_edge for b in split.buildings] == [b.touches_data_edge for b in whole.buildings]
    assert shapely.area(split.extent) == pytest.approx(shapely.area(whole.extent), rel=1e-3)


def test_the_outlines_scored_as_models_are_perfectly_detected(tile: Path) -> None:
    reference = read_points_reference([tile], crs="EPSG:32632")
    inside = [building for building in reference.buildings if not building.touches_data_edge]
    measured = {m.name: m for m in detection_measures(detect(reference.buildings, reference), subsets(reference)[0])}
    assert all(measure.value == 1.0 for measure in measured.values())
    assert measured["detection.object_completeness"].n == len(inside) == 2


def test_feet_become_metres(tmp_path: Path) -> None:
    path = write(tmp_path / "feet.laz", *street(), unit=0.3048)
    metres = read_points_reference([write(tmp_path / "metres.laz", *street())], crs="EPSG:32632")
    feet = read_points_reference([path], crs="+proj=utm +zone=32 +ellps=WGS84 +units=ft", vertical_unit="ft")
    assert [b.footprint.area for b in feet.buildings] == pytest.approx([b.footprint.area for b in metres.buildings])
    assert next(feet.points()).xyz[:, 2].max() == pytest.approx(6.0, abs=1e-3)


def test_only_the_last_returns_are_last(tmp_path: Path) -> None:
    path = write(tmp_path / "first.laz", *street(), returns=2)
    (points,) = read_points_reference([path]).points()
    assert not points.last.any()
    assert points.return_number is not None
    assert (points.return_number == 1).all()


def test_without_class_6_only_the_ground_can_be_measured(tmp_path: Path) -> None:
    xyz, classes = street()
    reference = read_points_reference([write(tmp_path / "samp.laz", xyz, np.where(classes == 6, 0, classes))])
    assert reference.buildings == ()
    assert reference.extent is None
    assert reference.has_ground
    assert any("only the ground can be measured" in note for note in reference.notes)
    rows = ground_blocks(reference, lambda points: points.xyz[:, 2] < 3.0)
    assert (rows["right"] + rows["other"]).sum() == len(xyz)
    assert detection_measures(detect([], reference), subsets(reference)[0]) == []


def test_files_without_classes_are_refused_with_the_fix(tmp_path: Path) -> None:
    xyz, _ = street()
    path = write(tmp_path / "raw.laz", xyz, np.ones(len(xyz), np.uint8))
    with pytest.raises(InputError, match=r"raw\.laz: no point of class 2 .* its classes are 1.*classified file"):
        read_points_reference([path])
    with pytest.raises(SettingsError, match="name at least one"):
        read_points_reference([])


def test_files_of_two_crs_are_refused(tmp_path: Path) -> None:
    paths = [write(tmp_path / "a.laz", *street()), write(tmp_path / "b.laz", *street())]
    las = laspy.read(paths[1])
    las.header.add_crs(pyproj.CRS("EPSG:32633"))
    las.write(paths[1])
    with pytest.raises(InconsistentInputError, match=r"b\.laz"):
        read_points_reference(paths)
    assert len(read_points_reference(paths, crs="EPSG:32632", read_options=ReadOptions()).tiles) == 2
    # a header that adds its vertical CRS to the given one makes no other CRS
    las.header.add_crs(pyproj.CRS("EPSG:32633+5773"))
    las.write(paths[1])
    assert read_points_reference(paths, crs="EPSG:32632").crs == "WGS 84 / UTM zone 32N + EGM96 height"


def test_the_real_tiles_of_delft(shared_data: Path) -> None:
    tiles = [shared_data / "ahn3" / f"delft_{side}.laz" for side in ("west", "east")]
    reference = read_points_reference(tiles, footprints=shared_data / "ahn3" / "footprints.gpkg", crs="EPSG:7415")
    assert len(reference.buildings) == 160
    assert not any(building.touches_data_edge for building in reference.buildings)
    roofs = sum(int(points.is_roof.sum()) for points in reference.points())
    assert 70_000 < roofs < 80_000
