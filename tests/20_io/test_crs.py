"""Coordinate reference systems and units, from headers and from the user."""

import dataclasses
import pickle
import struct

import laspy
import numpy as np
import pyproj
import pytest
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr

from pipeline.errors import CrsError
from pipeline.io import ReadOptions, open_source
from pipeline.io.crs import US_SURVEY_FOOT_M, SpatialReference, resolve_reference

FOOT_M = 0.3048


def resolve(in_header=None, **more):
    header = None if in_header is None else pyproj.CRS.from_user_input(in_header)
    return resolve_reference(path="tile.laz", header_crs=header, **more)


@pytest.mark.parametrize(
    ("crs", "epsg", "horizontal_m", "vertical_m", "assumed"),
    [
        ("EPSG:28992", 28992, 1.0, 1.0, True),
        ("EPSG:7415", 7415, 1.0, 1.0, False),
        ("EPSG:2992", 2992, FOOT_M, FOOT_M, True),
        ("EPSG:2263", 2263, US_SURVEY_FOOT_M, US_SURVEY_FOOT_M, True),
        ("EPSG:2263+6360", None, US_SURVEY_FOOT_M, US_SURVEY_FOOT_M, False),
        ("EPSG:2263+5703", None, US_SURVEY_FOOT_M, 1.0, False),
        ("EPSG:2154+5720", None, 1.0, 1.0, False),
    ],
)
def test_units_of_plan_and_elevation_come_from_their_own_axes(crs, epsg, horizontal_m, vertical_m, assumed):
    reference, reported = resolve(crs)
    assert reference.horizontal_unit_m == pytest.approx(horizontal_m, rel=1e-9)
    assert reference.vertical_unit_m == pytest.approx(vertical_m, rel=1e-9)
    assert reference.vertical_unit_assumed == assumed
    # a user must decide only if the horizontal unit is not the metre
    assert any("no vertical unit" in warning for warning in reported) == (assumed and horizontal_m != 1.0)
    if epsg is not None:
        assert reference.epsg == epsg


def test_the_order_of_precedence_of_the_vertical_unit():
    assert resolve("EPSG:28992", vertical_unit="ft")[0].vertical_unit_m == FOOT_M
    assert resolve("EPSG:7415", vertical_unit="us-ft")[0].vertical_unit_m == US_SURVEY_FOOT_M
    reference, reported = resolve("EPSG:28992", header_vertical_unit_m=FOOT_M)
    assert (reference.vertical_unit_m, reported) == (FOOT_M, ())
    assert resolve("EPSG:7415", header_vertical_unit_m=FOOT_M)[0].vertical_unit_m == 1.0
    # The header's unit belongs to the header's CRS.
    assert resolve("EPSG:2992", crs="EPSG:28992", header_vertical_unit_m=FOOT_M)[0].vertical_unit_m == 1.0


def test_no_crs_is_unknown_and_reported_with_its_fix():
    reference, reported = resolve()
    assert reference == SpatialReference()
    assert (reference.wkt, reference.epsg, reference.projjson, reference.crs) == (None, None, None, None)
    assert len(reported) == 1
    assert "--crs" in reported[0]
    in_feet, _ = resolve(header_horizontal_unit_m=FOOT_M)
    assert (in_feet.horizontal_unit_m, in_feet.vertical_unit_m) == (FOOT_M, FOOT_M)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:4979", "EPSG:4326+5773", "EPSG:4978", "EPSG:5709"])
def test_degrees_geocentric_and_vertical_only_are_refused_with_the_fix(crs):
    for arguments in ({"crs": pyproj.CRS(crs).to_wkt()}, {"header_crs": pyproj.CRS(crs)}):
        with pytest.raises(CrsError, match=r"^tile\.laz: .*EPSG:n"):
            resolve_reference(path="tile.laz", **arguments)


@pytest.mark.parametrize("crs", ["EPSG:99999999", "nonsense", "PROJCS[broken"])
def test_a_crs_that_no_one_knows_is_refused(crs):
    with pytest.raises(CrsError, match=r"not understood.*EPSG:28992"):
        resolve(None, crs=crs)


def test_an_unknown_unit_lists_the_known_ones():
    with pytest.raises(CrsError, match=r"'furlong' is not known.*m, .*ft, .*us-ft"):
        resolve("EPSG:28992", vertical_unit="furlong")


def test_the_given_crs_replaces_the_header_s_and_says_so_only_where_they_differ():
    reference, reported = resolve("EPSG:2154", crs="EPSG:7415")
    assert reference.epsg == 7415
    assert any("replaces the header's" in warning for warning in reported)
    assert resolve("EPSG:28992", crs="EPSG:7415")[1] == ()


def test_a_reference_is_frozen_hashable_survives_pickling_and_is_the_same_by_wkt_as_by_code():
    reference, _ = resolve(crs="EPSG:7415")
    for same in (pickle.loads(pickle.dumps(reference)), resolve(crs=pyproj.CRS("EPSG:7415").to_wkt())[0]):
        assert same == reference
        assert hash(same) == hash(reference)
    assert reference.projjson["type"] == "CompoundCRS"
    assert pyproj.CRS.from_json_dict(reference.projjson).to_epsg() == 7415
    with pytest.raises(dataclasses.FrozenInstanceError):
        reference.epsg = 1


def write_keys(path, keys, wkt=None):
    """A LAS file with GeoTIFF keys, and WKT beside where given."""
    header = laspy.LasHeader(version="1.2", point_format=0)
    header.scales = np.full(3, 0.01)
    vlr = GeoKeyDirectoryVlr()
    vlr.geo_keys = [
        GeoKeyEntryStruct(id=key, tiff_tag_location=0, count=1, value_offset=value) for key, value in keys.items()
    ]
    vlr.geo_keys_header.number_of_keys = len(keys)
    header.vlrs.append(vlr)
    if wkt:
        header.vlrs.append(WktCoordinateSystemVlr(wkt))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]).T
    las.write(path)
    return open_source(path).info


def test_geotiff_keys_give_the_crs_and_the_vertical_unit(tmp_path):
    info = write_keys(tmp_path / "a.las", {1024: 1, 3072: 2992, 4099: 9001})
    assert (info.reference.epsg, info.reference.vertical_unit_m, info.warnings) == (2992, 1.0, ())
    info = write_keys(tmp_path / "b.las", {1024: 1, 3072: 2263, 4096: 6360})
    assert info.reference.vertical_unit_m == pytest.approx(US_SURVEY_FOOT_M)
    assert (info.reference.projjson["type"], info.warnings) == ("CompoundCRS", ())


def test_wkt_stands_above_geotiff_keys(tmp_path):
    info = write_keys(tmp_path / "a.las", {1024: 1, 3072: 2992}, pyproj.CRS("EPSG:7415").to_wkt())
    assert info.reference.epsg == 7415


@pytest.mark.parametrize(
    ("keys", "wkt", "unit_m", "reported"),
    [
        ({1024: 1, 2048: 4269, 3072: 32767, 3076: 9002}, None, FOOT_M, "user-defined"),  # and is not geographic
        ({}, "PROJCS[broken", 1.0, "WKT is not understood"),
    ],
)
def test_a_crs_that_is_not_understood_is_unknown_with_its_unit_and_reported(tmp_path, keys, wkt, unit_m, reported):
    info = write_keys(tmp_path / "a.las", keys, wkt)
    assert (info.reference.wkt, info.reference.horizontal_unit_m) == (None, unit_m)
    assert any(reported in warning for warning in info.warnings)


def test_wkt_in_an_extended_record_is_found_behind_a_large_one(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.las", points(20), version="1.4", point_format=6)
    raw = bytearray(path.read_bytes())
    struct.pack_into("<QI", raw, 235, len(raw), 2)
    wkt = pyproj.CRS("EPSG:7415").to_wkt().encode() + b"\0"
    for user, record, data in ((b"waves", 65_535, bytes(100_000)), (b"LASF_Projection", 2112, wkt)):
        raw += struct.pack("<H16sHQ32s", 0, user, record, len(data), b"") + data
    path.write_bytes(raw)
    source = open_source(path)
    assert source.info.reference.epsg == 7415
    assert sum(map(len, source.chunks())) == 20


def test_options_reach_the_reference(tmp_path, points, write_las):
    path = write_las(tmp_path / "a.laz", points(20))
    reference = open_source(path, ReadOptions(crs="EPSG:28992", vertical_unit="ft")).info.reference
    assert (reference.epsg, reference.vertical_unit_m) == (28992, FOOT_M)


def test_degrees_without_a_crs_are_not_taken_for_metres(tmp_path):
    rng = np.random.default_rng(0)
    degrees = np.column_stack(
        (4.35 + rng.uniform(0, 0.002, 500), 52.01 + rng.uniform(0, 0.001, 500), np.full(500, 3.0))
    )
    np.savetxt(tmp_path / "a.xyz", degrees, fmt="%.8f")
    with pytest.raises(CrsError, match=r"look like degrees.*Reproject.*--crs"):
        open_source(tmp_path / "a.xyz")
    assert open_source(tmp_path / "a.xyz", ReadOptions(crs="EPSG:28992")).info.point_count == 500
    # A small scene at the origin in metres is not mistaken.
    np.savetxt(tmp_path / "b.xyz", (degrees - degrees[0]) * [5e3, 1e4, 1.0], fmt="%.4f")
    assert open_source(tmp_path / "b.xyz").info.point_count == 500


@pytest.mark.parametrize("unit", ["0", "1e308", "1e-300"])
def test_a_unit_that_no_coordinates_are_in_is_refused(unit: str) -> None:
    plane = f'LOCAL_CS["site",UNIT["own",{unit}]]'
    standing = 'VERT_CS["up",VERT_DATUM["x",2005],UNIT["own",{}]]'
    for wkt in (plane, f'COMPD_CS["site",LOCAL_CS["site",UNIT["m",1]],{standing.format(unit)}]'):
        with pytest.raises(CrsError, match=r"a\.laz: CRS 'site' has a unit of .* m\. Give --crs"):
            resolve_reference(path="a.laz", header_crs=pyproj.CRS.from_wkt(wkt))
