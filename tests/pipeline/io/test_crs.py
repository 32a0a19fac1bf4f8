"""Coordinate reference systems and units, from headers and from the user."""

import ctypes
import dataclasses
import pickle
import struct

import laspy
import numpy as np
import pyproj
import pytest
from laspy.vlrs.known import GeoDoubleParamsVlr, GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr

from pipeline.errors import CrsError
from pipeline.io import ReadOptions, open_source
from pipeline.io.crs import US_SURVEY_FOOT_M, SpatialReference
from pipeline.io.crs_resolution import resolve_reference

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
    # a CRS without a vertical part says nothing about elevations
    assert resolve("EPSG:2992", crs="EPSG:28992", header_vertical_unit_m=FOOT_M)[0].vertical_unit_m == FOOT_M
    assert resolve("EPSG:2992", crs="EPSG:7415", header_vertical_unit_m=FOOT_M)[0].vertical_unit_m == 1.0


@pytest.mark.parametrize("given", ["EPSG:26910", "26910", " 26910 ", pyproj.CRS("EPSG:26910").to_wkt(), "EPSG:32610"])
def test_a_given_horizontal_crs_keeps_the_header_s_vertical_one_and_says_where_units_are_mixed(given):
    reference, reported = resolve("EPSG:26910+6360", crs=given)
    assert reference.horizontal_unit_m == 1.0
    assert reference.vertical_unit_m == pytest.approx(US_SURVEY_FOOT_M, rel=1e-12)
    assert not reference.vertical_unit_assumed
    assert [part.to_epsg() for part in reference.crs.sub_crs_list] == [pyproj.CRS(given.strip()).to_epsg(), 6360]
    assert sum("units are mixed" in warning and "US survey foot" in warning for warning in reported) == 1
    # a user who states both parts knows, and without a mixture there is nothing to say
    assert resolve("EPSG:26910+6360", crs="EPSG:26910+6360")[1] == ()
    assert resolve("EPSG:26910+6360", crs="EPSG:26910", vertical_unit="us-ft")[1] == ()
    assert not any("mixed" in warning for warning in resolve("EPSG:2263+6360", crs="EPSG:2263")[1])
    reference, reported = resolve("EPSG:7415", crs="EPSG:28992")
    assert (reference.epsg, reference.named, reported) == (7415, "EPSG:28992", ())


def test_an_option_that_overrides_the_header_s_vertical_unit_says_so():
    for more in ({"vertical_unit": "m"}, {"crs": "EPSG:26910+5703"}):
        reference, reported = resolve("EPSG:26910+6360", **more)
        assert reference.vertical_unit_m == 1.0
        assert [w for w in reported if "metre, replaces the header's US survey foot" in w] == list(reported)
    # in its own datum
    assert reference.crs.sub_crs_list[1].to_epsg() == 5703
    assert resolve("EPSG:26910+6360", vertical_unit="m")[0].crs.sub_crs_list[1].to_epsg() == 5703
    assert resolve("EPSG:28992", vertical_unit="ft")[1] == ()
    assert any("replaces" in w for w in resolve(header_vertical_unit_m=FOOT_M, vertical_unit="m")[1])


@pytest.mark.parametrize(
    ("crs", "more"),
    [
        ("EPSG:28992", {"vertical_unit": "ft"}),
        ("EPSG:7415", {"vertical_unit": "ft"}),
        ("EPSG:2263", {"vertical_unit": "m"}),
        ("EPSG:2992", {"header_vertical_unit_m": 1.0}),
        ("EPSG:26910+6360", {"vertical_unit": "ft"}),
        ("+proj=utm +zone=33 +ellps=bessel +towgs84=598,73,418,0.2,0.05,-2.5,6.7 +units=m", {"vertical_unit": "us-ft"}),
    ],
)
def test_the_crs_of_the_outputs_states_every_vertical_unit_that_is_not_its_horizontal_one(crs, more):
    reference, _ = resolve(crs, **more)
    again, reported = resolve_reference(path="a", header_crs=pyproj.CRS.from_json_dict(reference.projjson))
    assert again.vertical_unit_m == pytest.approx(reference.vertical_unit_m, rel=1e-12)
    assert (again.horizontal_unit_m, reported) == (reference.horizontal_unit_m, ())
    assert reference.vertical_unit_m != reference.horizontal_unit_m
    # ids of buildings are those of before
    code = pyproj.CRS(crs).to_epsg()
    assert reference.named == (pyproj.CRS(crs).name if code is None else f"EPSG:{code}")


def test_a_vertical_crs_alone_is_kept_too(tmp_path):
    reference, reported = resolve("EPSG:6360", crs="EPSG:26910")
    assert [part.to_epsg() for part in reference.crs.sub_crs_list] == [26910, 6360]
    assert any("units are mixed" in warning for warning in reported)
    # the vertical key beside a user-defined plan
    write_keys(tmp_path / "a.las", {1024: 1, 3072: 32767, 4096: 6360})
    info = open_source(tmp_path / "a.las", ReadOptions(crs="EPSG:26910")).info
    assert info.reference.vertical_unit_m == pytest.approx(US_SURVEY_FOOT_M)
    assert any("units are mixed" in warning for warning in info.warnings)


def test_a_3d_crs_of_the_header_keeps_its_vertical_unit_too():
    reference, reported = resolve(pyproj.CRS("EPSG:26910").to_3d(), crs="EPSG:2992")
    assert (reference.horizontal_unit_m, reference.vertical_unit_m) == (FOOT_M, 1.0)
    assert any("units are mixed" in warning for warning in reported)
    reference, reported = resolve(pyproj.CRS("EPSG:26910").to_3d(), crs="EPSG:26910")
    assert (reference.epsg, reported) == (26910, ())


def test_the_facts_of_an_older_run_make_a_reference():
    facts = {"wkt": None, "name": "unknown", "epsg": None, "horizontal_unit_m": FOOT_M, "vertical_unit_m": FOOT_M}
    assert SpatialReference.of_facts({**facts, "of_a_later_version": 1}).vertical_unit_m == FOOT_M
    assert SpatialReference.of_facts(None) == SpatialReference()


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


def write_keys(path, keys, wkt=None, doubles=(), **options):
    """A LAS file with GeoTIFF keys, and WKT beside where given; `doubles` are pairs of a key and its number."""
    header = laspy.LasHeader(version="1.2", point_format=0)
    header.scales = np.full(3, 0.01)
    vlr = GeoKeyDirectoryVlr()
    vlr.geo_keys = [
        GeoKeyEntryStruct(id=key, tiff_tag_location=0, count=1, value_offset=value) for key, value in keys.items()
    ]
    vlr.geo_keys += [
        GeoKeyEntryStruct(id=key, tiff_tag_location=34736, count=1, value_offset=place)
        for place, (key, _) in enumerate(doubles)
    ]
    vlr.geo_keys_header.number_of_keys = len(vlr.geo_keys)
    header.vlrs.append(vlr)
    if doubles:
        numbers = GeoDoubleParamsVlr()
        numbers.doubles = [ctypes.c_double(number) for _, number in doubles]
        header.vlrs.append(numbers)
    if wkt:
        header.vlrs.append(WktCoordinateSystemVlr(wkt))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]).T
    las.write(path)
    return open_source(path, ReadOptions(**options)).info


def test_geotiff_keys_give_the_crs_and_the_vertical_unit(tmp_path):
    info = write_keys(tmp_path / "a.las", {1024: 1, 3072: 2992, 4099: 9001})
    assert (info.reference.named, info.reference.vertical_unit_m, info.warnings) == ("EPSG:2992", 1.0, ())
    info = write_keys(tmp_path / "b.las", {1024: 1, 3072: 2263, 4096: 6360})
    assert info.reference.vertical_unit_m == pytest.approx(US_SURVEY_FOOT_M)
    assert (info.reference.projjson["type"], info.warnings) == ("CompoundCRS", ())


@pytest.mark.parametrize(
    ("code", "unit", "found", "unit_m"),
    [
        (32128, 9003, 2271, US_SURVEY_FOOT_M),  # Pennsylvania North
        (32119, 9003, 2264, US_SURVEY_FOOT_M),  # North Carolina, whose false eastings differ by 0.8 mm
        (2285, 9001, 32148, 1.0),  # Washington North
        (2992, 9001, 2991, 1.0),  # Oregon, by another name
        (26910, 9002, None, FOOT_M),  # no such zone in the registry
        (2263, 9002, None, FOOT_M),
    ],
)
def test_a_units_key_overrides_the_unit_of_its_pcs_code_and_names_the_crs_that_has_it(
    tmp_path, code, unit, found, unit_m
):
    info = write_keys(tmp_path / "a.las", {1024: 1, 3072: code, 3076: unit, 4099: unit})
    reference = info.reference
    assert reference.epsg == found
    assert [reference.horizontal_unit_m, reference.vertical_unit_m] == pytest.approx([unit_m] * 2, rel=1e-12)
    (warning,) = info.warnings
    assert "key 3076" in warning
    assert (reference.name if found is None else f"EPSG:{found} ({reference.name})") in warning
    assert "--crs EPSG:n" in warning
    # the same places as by the code itself
    own = pyproj.CRS.from_epsg(code)
    x, y = pyproj.Transformer.from_crs(own.geodetic_crs, own, always_xy=True).transform(*own.area_of_use.bounds[:2])
    factor = own.axis_info[0].unit_conversion_factor / unit_m
    ways = [(own, x, y), (reference.horizontal_crs, x * factor, y * factor)]
    places = [pyproj.Transformer.from_crs(crs, own.geodetic_crs, always_xy=True).transform(*xy) for crs, *xy in ways]
    assert np.abs(np.subtract(*places)).max() < 1e-7


@pytest.mark.parametrize(
    ("given", "found"),
    [("EPSG:32128", [2271]), ("EPSG:32128+5703", [2271, 5703]), ("EPSG:5070", [None])],
)
def test_a_given_crs_keeps_the_unit_that_a_header_without_crs_states_for_its_coordinates(tmp_path, given, found):
    keys = {1024: 1, 3076: 9003}
    info = write_keys(tmp_path / "a.las", keys, crs=given)
    crs = info.reference.crs
    assert [part.to_epsg() for part in (crs.sub_crs_list or [crs])] == found
    assert info.reference.horizontal_unit_m == pytest.approx(US_SURVEY_FOOT_M, rel=1e-12)
    assert info.reference.vertical_unit_m == (1.0 if "+" in given else pytest.approx(US_SURVEY_FOOT_M, rel=1e-12))
    assert any("key 3076" in warning and "mend the key" in warning for warning in info.warnings)
    assert not any("units are mixed" in warning for warning in info.warnings)
    # a CRS in the header's unit is taken as it is
    agreed = write_keys(tmp_path / "a.las", keys, crs="EPSG:2271")
    assert agreed.reference.epsg == 2271
    assert not any("key 3076" in warning for warning in agreed.warnings)
    with pytest.raises(CrsError, match="geographic"):
        write_keys(tmp_path / "a.las", keys, crs="EPSG:4326")


def test_units_keys_that_agree_with_their_codes_change_nothing(tmp_path):
    info = write_keys(tmp_path / "a.las", {1024: 1, 3072: 2271, 3076: 9003, 4096: 6360, 4099: 9003})
    assert [part.to_epsg() for part in info.reference.crs.sub_crs_list] == [2271, 6360]
    assert info.warnings == ()


def test_a_vertical_units_key_overrides_the_unit_of_its_vertical_crs(tmp_path):
    info = write_keys(tmp_path / "a.las", {1024: 1, 3072: 26910, 4096: 5703, 4099: 9003})
    assert [part.to_epsg() for part in info.reference.crs.sub_crs_list] == [26910, 6360]
    assert info.reference.vertical_unit_m == pytest.approx(US_SURVEY_FOOT_M, rel=1e-12)
    (warning,) = info.warnings
    assert "key 4099" in warning
    assert "EPSG:6360 (NAVD88 height (ftUS))" in warning


def test_units_of_keys_may_be_any_of_the_registry_or_a_number_and_others_are_reported(tmp_path):
    clarke_m = 0.3047972654
    info = write_keys(tmp_path / "a.las", {1024: 1, 3072: 26910, 3076: 9005, 4099: 9005})
    assert info.reference.horizontal_unit_m == pytest.approx(clarke_m, rel=1e-9)
    keys = {1024: 1, 3072: 26910, 3076: 32767}
    info = write_keys(tmp_path / "b.las", keys, doubles=[(3077, 0.5)])
    assert (info.reference.horizontal_unit_m, info.reference.name) == (0.5, "NAD83 / UTM zone 10N (unit of 0.5 m)")
    for more in ({3076: 32767}, {3076: 9102}, {4099: 17}):
        info = write_keys(tmp_path / "c.las", {1024: 1, 3072: 26910, **more})
        assert info.reference.epsg == 26910
        ((key, code),) = more.items()
        assert any(f"units key {key} has {code}" in warning for warning in info.warnings)


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
    assert (reference.named, reference.vertical_unit_m) == ("EPSG:28992", FOOT_M)
    assert reference.crs.sub_crs_list[0].to_epsg() == 28992


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
