"""Where a tile would lie by its CRS, and which places are refused."""

import math

import pyproj
import pytest

from pipeline.errors import CrsError
from pipeline.io import ReadOptions, open_source
from pipeline.io.area_of_use import AreaOfUse, Location, location_of, refuse_far_outside

DELFT = (84_500.0, 447_000.0)


def at(crs: str, x: float, y: float, wkt: str = "WKT2_2019") -> Location | None:
    return location_of(pyproj.CRS.from_user_input(crs).to_wkt(wkt), (x - 500.0, y - 500.0, x + 500.0, y + 500.0))


def the(location: Location | None) -> Location:
    assert location is not None
    return location


def test_delft_in_the_grid_of_new_zealand_lies_at_76_degrees_south_and_is_refused_with_all_that_names_it():
    location = the(at("EPSG:2193", *DELFT))
    assert location.longitude_latitude == pytest.approx((99.21, -75.98), abs=0.01)
    with pytest.raises(CrsError) as refused:
        refuse_far_outside("delft.laz", location)
    message = str(refused.value)
    for words in (
        "delft.laz: in EPSG:2193 (NZGD2000 / New Zealand Transverse Mercator 2000)",
        "75.98° S, 99.21° E",
        "New Zealand - North Island",
        "166.37° E to 178.63° E, 47.33° S to 34.10° S",
        "--crs EPSG:n",
        "--allow-outside-area-of-use",
    ):
        assert words in message


@pytest.mark.parametrize("wkt", ["WKT2_2019", "WKT1_GDAL", "WKT1_ESRI"])
@pytest.mark.parametrize("crs", ["EPSG:28992", "EPSG:7415", "EPSG:2193"])
def test_the_area_is_known_however_the_header_writes_the_crs(crs, wkt):
    if crs == "EPSG:7415" and wkt == "WKT1_ESRI":
        pytest.skip("ESRI's WKT has no compound CRS with this name")
    location = the(at(crs, *DELFT, wkt))
    assert location.area is not None
    assert location.is_far_outside == (crs == "EPSG:2193")


@pytest.mark.parametrize(
    ("crs", "x", "y"),
    [
        ("EPSG:28992", *DELFT),
        ("EPSG:28992", 300_000.0, 620_000.0),  # Germany, beyond the border
        ("EPSG:25832", 1_000_000.0, 5_700_000.0),  # Lausitz: Germany in one zone
        ("EPSG:25833", -75_000.0, 6_600_000.0),  # Utsira: Norway in one zone
        ("EPSG:25833", 1_115_000.0, 7_870_000.0),  # Vardø
        ("EPSG:32701", 170_000.0, 8_000_000.0),  # beyond the antimeridian
        ("EPSG:3851", 2_500_000.0, 7_000_000.0),  # an area that crosses it
        ("EPSG:3857", 486_000.0, 6_800_000.0),
    ],
)
def test_places_within_the_area_and_near_its_border_are_taken(crs, x, y):
    refuse_far_outside("a.laz", at(crs, x, y))


@pytest.mark.parametrize(
    ("crs", "x", "y"),
    [
        ("EPSG:28992", 447_000.0, 84_500.0),  # x and y exchanged
        ("EPSG:28992", 565_000.0, 5_934_000.0),  # UTM
        ("EPSG:25832", *DELFT),
        ("EPSG:28992", 1e12, 1e12),
    ],
)
def test_places_far_outside_are_refused(crs, x, y):
    with pytest.raises(CrsError, match="Give the right CRS"):
        refuse_far_outside("a.laz", at(crs, x, y))


def test_local_crs_and_those_without_an_area_are_not_judged():
    local = 'ENGCRS["site",EDATUM["site"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
    assert location_of(local, (0.0, 0.0, 9.0, 9.0)) is None
    beyond_proj = pyproj.CRS.from_epsg(28992).to_wkt().replace("Oblique Stereographic", "Odd").replace("9809", "9999")
    assert location_of(beyond_proj, (84_000.0, 447_000.0, 84_009.0, 447_009.0)) is None
    own = the(at("+proj=tmerc +lat_0=10 +lon_0=5 +k=0.9 +x_0=17 +ellps=GRS80 +units=m", *DELFT))
    assert own.area is None
    refuse_far_outside("a.laz", own)


def test_the_distance_from_an_area_is_that_on_the_sphere():
    across = AreaOfUse(name="across", west=170.0, south=-10.0, east=-170.0, north=10.0)
    for longitude in (170.0, 175.0, 180.0, -180.0, -170.0):
        assert across.distance_km(longitude, 5.0) == 0.0
    assert across.distance_km(169.0, 0.0) == pytest.approx(111.2)
    assert across.distance_km(-169.0, 0.0) == pytest.approx(111.2)
    assert across.distance_km(180.0, 20.0) == pytest.approx(1112.0)
    geod = pyproj.Geod(a=6_371_000.0, b=6_371_000.0)
    _, _, metres = geod.inv(10.0, 60.0, 12.0, 60.0)
    box = AreaOfUse(name="box", west=12.0, south=50.0, east=18.0, north=70.0)
    assert box.distance_km(10.0, 60.0) == pytest.approx(metres / 1000.0, rel=1e-3)
    world = AreaOfUse(name="world", west=-180.0, south=-90.0, east=180.0, north=90.0)
    assert world.distance_km(77.0, -30.0) == 0.0


def test_a_file_knows_its_place_in_the_units_of_its_crs(tmp_path, points, write_las):
    delft = open_source(write_las(tmp_path / "a.laz", points(100)), ReadOptions(crs="EPSG:28992")).info
    assert the(delft.location).longitude_latitude == pytest.approx((4.36, 52.01), abs=0.01)
    xyz = points(100) - [84_000.0, 447_000.0, 0.0] + [6_500_000.0, 1_800_000.0, 0.0]
    feet = open_source(write_las(tmp_path / "b.laz", xyz, crs="EPSG:2229")).info
    assert the(feet.location).longitude_latitude == pytest.approx((-118.2, 33.94), abs=0.01)
    assert open_source(write_las(tmp_path / "c.laz", points(100))).info.location is None


def test_one_far_point_does_not_move_the_place_of_a_tile(tmp_path, points, write_las):
    xyz = points(3_000)
    xyz[17] = [84_000.0 + 2e7, 447_000.0 - 2e7, 5.0]
    location = the(open_source(write_las(tmp_path / "a.laz", xyz, crs="EPSG:28992")).info.location)
    assert not location.is_far_outside
    assert math.dist(location.longitude_latitude or (0.0, 0.0), (4.36, 52.01)) < 0.2
