"""Vector files of strangers: each is read or refused by name, in our words, and in time that its size bounds."""

from __future__ import annotations

import logging
import random
import shutil
import socket
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from shapely import LineString, MultiPolygon, Polygon, affinity, box

from pipeline.errors import CrsError, InconsistentInputError, InputError, UnreadableInputError, causes
from pipeline.extras.footprints.footprints_file import read_area, read_footprints
from pipeline.extras.footprints.repairs import Repairs, crossings
from pipeline.extras.guides.guides_file import read_guides
from pipeline.extras.vector_files import nearby
from pipeline.extras.vector_files.wkb import DEPTH_LIMIT, geometries_of
from pipeline.io.crs import SpatialReference
from pipeline.io.crs_given import parse_crs
from pipeline.io.crs_resolution import resolve_reference
from pipeline.io.library_faults import DAMAGED, TOO_LARGE, in_our_words
from service.errors import TooLargeError
from service.vectors import examine_vector

AREA = box(85_000, 447_000, 85_100, 447_100)
HOUSES = [box(85_000 + 20 * k, 447_000, 85_010 + 20 * k, 447_008) for k in range(4)]
RIDGES = [LineString([(85_000 + 20 * k, 447_004), (85_010 + 20 * k, 447_004)]) for k in range(4)]
LEAKS = ("realloc", "malloc", "set_int_max", "Arrow", "codec", "sqlite", "Thrift", "GDAL", "GEOS", "pyogrio", "CPLE")
"""Words of libraries, which are in no message."""


def reference() -> SpatialReference:
    return resolve_reference(path="points", crs="EPSG:7415")[0]


def write(path: Path, geometries: list[Any] = HOUSES, **columns: Any) -> Path:
    """Writes with geopandas: an independent writer."""
    columns = columns or {"naam": [f"huis {k}" for k in range(len(geometries))]}
    frame = geopandas.GeoDataFrame(columns, geometry=list(geometries), crs="EPSG:28992")
    if path.suffix == ".parquet":
        frame.to_parquet(path)
    else:
        (frame.to_crs("EPSG:4326") if path.suffix == ".geojson" else frame).to_file(path)
    return path


WHOLE = "[[4.3,52],[4.4,52],[4.4,52.1],[4.3,52]]"


def geojson(path: Path, ring: str = WHOLE, top: str = "", value: str = '"x"') -> Path:
    """A polygon of a ring, and one that is whole, with an attribute n."""
    features = ",".join(
        f'{{"type":"Feature","properties":{{"n":{value}}},"geometry":{{"type":"Polygon","coordinates":[{one}]}}}}'
        for one in (ring, WHOLE)
    )
    path.write_text(f'{{"type":"FeatureCollection",{top}"features":[{features}]}}', encoding="utf-8")
    return path


def set_text(path: Path, value: bytes, row: int = 1) -> None:
    """Write bytes as the text of column naam of one row of a GeoPackage, as a careless tool does."""
    database = sqlite3.connect(path)
    for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
        database.execute(f'DROP TRIGGER "{name}"')
    database.execute(f'UPDATE "{path.stem}" SET naam = CAST(? AS TEXT) WHERE fid = ?', (value, row))
    database.commit()
    database.close()


def readers(path: Path) -> dict[str, Callable[[], Any]]:
    """All that reads vector files."""
    return {
        "examine": lambda: examine_vector(path),
        "footprints": lambda: read_footprints(path, reference()),
        "footprints near": lambda: read_footprints(path, reference(), area=AREA),
        "guides": lambda: read_guides(path, reference(), area=AREA),
        "area": lambda: read_area(path, reference()),
    }


# Damage


def damaged(content: bytes, draw: random.Random) -> bytes:
    """A copy with one to three faults."""
    data = bytearray(content)
    for _ in range(draw.randint(1, 3)):
        at, width = draw.randrange(max(len(data), 1)), draw.choice((1, 8, 64, 300))
        match draw.randrange(8):
            case 0 if data:
                data[at] ^= 1 << draw.randrange(8)
            case 1:
                data[at : at + width] = draw.randbytes(width)
            case 2:
                data[at : at + width] = bytes(width)
            case 3:
                data[at : at + width] = b"\xff" * width
            case 4:
                del data[at:]
            case 5:
                del data[at : at + width]
            case 6:
                data[at:at] = data[at : at + width]
            case _:
                data[at : at + 8] = draw.choice((b"9" * 4000, b"1e400", b"NaN", struct.pack("<d", np.inf), b"\xe9\x8c"))
    return bytes(data)


@pytest.mark.parametrize("suffix", [".gpkg", ".geojson", ".shp", ".parquet"])
def test_a_damaged_file_is_read_or_refused_by_name_without_a_word_of_a_library(tmp_path: Path, suffix: str) -> None:
    originals = {}
    for name, geometries in (("houses", HOUSES), ("ridges", RIDGES)):
        write(tmp_path / f"{name}{suffix}", geometries, naam=["Café", "b", "c", "d"], hoogte=[1.5, 2.5, np.nan, 3.0])
        originals[name] = sorted(tmp_path.glob(f"{name}.*"))
    refused = 0
    for seed in range(25):
        draw = random.Random(f"{suffix} {seed}")
        files = originals[draw.choice(sorted(originals))]
        copy = tmp_path / f"copy {seed}"
        copy.mkdir()
        for file in files:
            shutil.copy(file, copy)
        victim = copy / draw.choice(files).name
        victim.write_bytes(damaged(victim.read_bytes(), draw))
        path = copy / f"{files[0].stem}{suffix}"
        for name, read in readers(path).items():
            problem = ""
            try:
                found = read()
            except InputError as fault:
                problem = fault.problem
            assert not [word for word in LEAKS if word in problem], (seed, name, problem)
            assert problem or name != "footprints" or all(map(shapely.is_valid, found.polygons)), seed
            refused += bool(problem)
    assert refused > 10


# Numbers


@pytest.mark.parametrize("number", ["1" * 4000, "1" * 5000, "1e400", "-1e999"])
@pytest.mark.parametrize("place", ["coordinate", "attribute"])
def test_a_number_that_cannot_be_held_is_named(tmp_path: Path, number: str, place: str) -> None:
    path = tmp_path / "a.geojson"
    if place == "coordinate":
        geojson(path, f"[[4.3,52],[4.4,52],[{number},52.1],[4.3,52]]")
    else:
        geojson(path, value=number)
    for name, read in readers(path).items():
        with pytest.raises(UnreadableInputError, match="is not a number that can be held") as fault:
            read()
        assert number[:24].lstrip("-") in str(fault.value), name
        assert len(str(fault.value)) < 500
        assert len(list(causes(fault.value))) < 9


@pytest.mark.parametrize("suffix", [".gpkg", ".parquet"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_a_coordinate_that_has_no_place_costs_its_feature_only(tmp_path: Path, suffix: str, value: float) -> None:
    odd = Polygon([(85_000, 447_000), (85_010, 447_000), (85_010, value), (85_000, 447_008)])
    for area in (None, AREA):
        found = read_footprints(write(tmp_path / f"a{suffix}", [odd, *HOUSES]), reference(), area=area)
        assert len(found) == len(HOUSES)
        assert [issue.problem for issue in found.issues] == ["outside_crs" if value == 1e300 else "not_finite"]


def test_many_decimals_are_fine(tmp_path: Path) -> None:
    path = geojson(tmp_path / "a.geojson", f"[[4.3,52],[4.4,52],[4.{'3' * 4000},52.1],[4.3,52]]")
    assert examine_vector(path)["usable"]
    assert len(read_footprints(path, reference())) == 2


# Text


@pytest.mark.parametrize("area", [None, AREA])
def test_text_of_a_geopackage_that_is_not_utf8_is_read_as_cp1252_and_reported(
    tmp_path: Path, area: Polygon | None
) -> None:
    path = write(tmp_path / "a.gpkg", naam=["x", "ß€", "x", "x"])
    set_text(path, "Œuvre é".encode("cp1252"), row=1)
    set_text(path, "Müller".encode("cp1252"), row=4)
    found = read_footprints(path, reference(), area=area)
    assert [row["naam"] for row in found.attributes] == ["Œuvre é", "ß€", "x", "Müller"]
    assert found.warnings == (
        "the text in column 'naam' of row 1 is not UTF-8 and is read as Windows-1252 ('Œuvre é'), as is one more",
    )


def test_text_of_guides_and_of_geojson_is_read_alike(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", RIDGES, kind=["ridge"] * 4, naam=["x"] * 4)
    set_text(path, b"\xe9", row=2)
    found = read_guides(path, reference(), area=AREA)
    assert len(found.guides) == 4
    assert "column 'naam' of row 2 is not UTF-8" in found.warnings[0]
    path = geojson(tmp_path / "a.geojson", value='"caf@"')
    path.write_bytes(path.read_bytes().replace(b"@", b"\xe9"))
    assert examine_vector(path)["usable"]
    assert read_footprints(path, reference()).attributes[0]["n"] == "café"


def test_the_name_of_a_column_may_be_cp1252_too(tmp_path: Path) -> None:
    path = geojson(tmp_path / "a.geojson")
    path.write_bytes(path.read_bytes().replace(b'"n"', b'"h\xf6he"'))
    far = box(0, 0, 1, 1)
    for area in (None, far):
        found = read_footprints(path, reference(), area=area)
        assert found.columns == ("höhe",)
        assert any("name of column b'h\\xf6he' is not UTF-8" in warning for warning in found.warnings)
    assert found.elsewhere.count == 2


def shapefile(path: Path, texts: list[str], encoding: str, cpg: str | None, language: int = 0) -> Path:
    """A Shapefile of texts in an encoding, which declares one by its .cpg file or by the language in its .dbf."""
    frame = geopandas.GeoDataFrame({"naam": ["x" * 20] * len(texts)}, geometry=HOUSES[: len(texts)], crs="EPSG:28992")
    frame.to_file(path)
    data = bytearray(path.with_suffix(".dbf").read_bytes())
    data[29] = language
    for text in texts:
        raw = text.encode(encoding)
        data = data.replace(b"x" * 20, raw.ljust(20), 1)
    path.with_suffix(".dbf").write_bytes(data)
    path.with_suffix(".cpg").unlink()
    if cpg is not None:
        path.with_suffix(".cpg").write_text(cpg)
    return path


@pytest.mark.parametrize(
    ("encoding", "cpg", "language", "warned"),
    [
        ("utf-8", "UTF-8", 0, False),
        ("utf-8", None, 0, False),
        ("utf-8", "nonsense", 0, False),
        ("cp1252", "1252", 0, False),
        ("cp1252", "ISO-8859-1", 0, False),
        ("cp1252", None, 0x57, False),
        ("cp1252", None, 0x03, False),
        ("cp1252", None, 0, True),
        ("cp1252", "UTF-8", 0, True),
    ],
)
def test_text_of_a_shapefile_follows_what_it_declares(
    tmp_path: Path, encoding: str, cpg: str | None, language: int, warned: bool
) -> None:
    texts = ["Œuvre", "Müllerstraße", "plain"]
    found = read_footprints(shapefile(tmp_path / "a.shp", texts, encoding, cpg, language), reference())
    assert [row["naam"] for row in found.attributes] == texts
    warnings = [warning for warning in found.warnings if "is not UTF-8" in warning]
    assert len(warnings) == warned


def test_a_declared_encoding_is_not_taken_for_utf8(tmp_path: Path) -> None:
    path = shapefile(tmp_path / "a.shp", ["Ж дом"], "cp866", "866")
    assert read_footprints(path, reference()).attributes[0]["naam"] == "Ж дом"


def test_text_of_geoparquet_that_is_not_utf8_is_read_as_cp1252(tmp_path: Path) -> None:
    path = write(tmp_path / "a.parquet")
    table = pq.read_table(path)
    raw = pa.array([b"\x8c", b"b", None, b"d"]).view(pa.string())
    table = table.set_column(table.schema.get_field_index("naam"), "naam", raw)
    pq.write_table(table, path)
    found = read_footprints(path, reference())
    assert [row["naam"] for row in found.attributes] == ["Œ", "b", None, "d"]
    assert "the text in column 'naam' of row 0 is not UTF-8 and is read as Windows-1252 ('Œ')" in found.warnings


# Messages


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError("realloc of size 800000000 failed"), TOO_LARGE),
        (RuntimeError("realloc of size 800000000 failed"), TOO_LARGE),
        (pa.ArrowMemoryError("malloc of size 1 failed"), TOO_LARGE),
        (sqlite3.DatabaseError("database disk image is malformed"), "its database is damaged"),
        (sqlite3.OperationalError("no such table: gpkg_contents"), "its database has no table gpkg_contents"),
        (RecursionError("maximum recursion depth exceeded"), "it is nested too deep"),
        (PermissionError(13, "Permission denied"), "Permission denied"),
        (pa.ArrowInvalid("Parquet magic bytes not found in footer."), "its footer is damaged or cut off"),
        (ValueError("month must be in 1..12"), "it has a date with the month wrong"),
        (shapely.errors.GEOSException("IllegalArgumentException: orientationIndex"), DAMAGED),
    ],
)
def test_an_error_of_a_library_is_said_in_our_words_and_logged_in_its_own(
    error: Exception, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "gablework")
    with pytest.raises(UnreadableInputError) as fault, in_our_words("a.gpkg", "vector data", "Write it again"):
        raise error
    assert str(fault.value) == f"a.gpkg: cannot be read as vector data: {words}. Write it again"
    assert list(causes(fault.value))[1] is error
    assert str(error) in caplog.text


def test_our_own_errors_and_those_that_are_named_pass() -> None:
    for error in (CrsError("a", "b", "c"), KeyboardInterrupt(), TooLargeError("d")):
        with pytest.raises(type(error)) as raised, in_our_words("a", "b", "c", passing=(TooLargeError,)):
            raise error
        assert raised.value is error


# Links


@pytest.mark.parametrize("kind", ["link", "url", "LINK", "\\u006cink"])
@pytest.mark.parametrize("member", ["crs", "CRS", "\\u0063r\\u0073"])
@pytest.mark.parametrize("inside", [False, True])
def test_a_crs_by_a_link_is_refused_and_no_server_is_asked(
    tmp_path: Path, kind: str, member: str, inside: bool
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        address = f"http://127.0.0.1:{server.getsockname()[1]}/crs"
        crs = f'"{member}" :\n {{"type":"{kind}","properties":{{"href":"{address}","url":"{address}"}}}},'
        path = geojson(tmp_path / "a.geojson", top="" if inside else crs)
        if inside:
            path.write_text(path.read_text().replace('"type":"Polygon"', f'{crs} "type":"Polygon"'))
        for read in readers(path).values():
            with pytest.raises(UnreadableInputError, match=r"crs is a link, which is not followed.*EPSG:28992"):
                read()
        with pytest.raises(BlockingIOError):
            server.accept()


def test_a_crs_by_its_name_is_followed(tmp_path: Path) -> None:
    crs = '"crs":{"type":"name","properties":{"name":"urn:ogc:def:crs:EPSG::28992"}},'
    ring = "[[85000,447000],[85010,447000],[85010,447010],[85000,447000]]"
    path = geojson(tmp_path / "a.geojson", ring, top=crs)
    assert examine_vector(path)["crs"]["epsg"] == 28992
    assert read_footprints(path, reference()).polygons[0].area == pytest.approx(50.0)


# Depth


def nested(depth: int, kind: int, order: str = "<") -> bytes:
    return (struct.pack(f"{order}BII", order == "<", kind, 1)) * depth + struct.pack(
        f"{order}BII", order == "<", kind, 0
    )


@pytest.mark.parametrize("kind", [6, 7, 1006, 0x8000_0007])
@pytest.mark.parametrize("order", "<>")
def test_wkb_that_would_exhaust_the_stack_is_not_read(tmp_path: Path, kind: int, order: str) -> None:
    deep = nested(200_000, kind, order)
    behind = struct.pack("<BII", 1, 7, 2) + struct.pack("<BIdd", 1, 1, 0.0, 0.0) + deep
    found = geometries_of(np.array([deep, behind, shapely.to_wkb(HOUSES[0]), None], dtype=object))
    assert [geometry is None for geometry in found] == [True, True, False, True]
    path = write(tmp_path / "a.parquet")
    table = pq.read_table(path)
    column = pa.array([deep, *table["geometry"].to_pylist()[1:]], pa.binary())
    pq.write_table(table.set_column(table.schema.get_field_index("geometry"), "geometry", column), path)
    for area in (None, AREA):
        issues = read_footprints(path, reference(), area=area).issues
        assert [issue.problem for issue in issues] == ["unreadable"]


def test_wkb_of_many_parts_is_read_whole() -> None:
    rng = np.random.default_rng(3)
    corners = rng.uniform(0, 1e5, (400, 2)).tolist()
    many = MultiPolygon([box(x, y, x + 1, y + 1) for x, y in corners])
    both = [many, shapely.GeometryCollection([many, shapely.GeometryCollection([many])]), shapely.force_3d(many)]
    for flavor in ("iso", "extended"):
        for order in (0, 1):
            wkb = shapely.to_wkb(both, flavor=flavor, byte_order=order, include_srid=flavor == "extended")
            assert shapely.equals_identical(geometries_of(np.asarray(wkb, object)), both).all()
    allowed = nested(DEPTH_LIMIT - 1, 7)
    assert geometries_of(np.array([allowed], dtype=object))[0] is not None


def test_a_nested_crs_and_nested_metadata_are_refused(tmp_path: Path) -> None:
    deep = '{"type":"BoundCRS","source_crs":' * 3000 + "1" + "}" * 3000
    with pytest.raises(CrsError, match=r"is not understood \(it is nested too deep\)"):
        parse_crs(deep, path="a")
    path = write(tmp_path / "a.parquet")
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata({"geo": "[" * 100_000}), path)
    for read in readers(path).values():
        with pytest.raises(UnreadableInputError, match="`geo` metadata"):
            read()


# Work


def star(corners: int, x: float = 85_050.0) -> Polygon:
    """A star of an odd number of corners: nearly every edge crosses every other."""
    angle = 2 * np.pi * np.arange(corners) * (corners // 2) / corners
    return Polygon(np.column_stack([x + 40 * np.cos(angle), 447_050 + 40 * np.sin(angle)]))


def test_crossings_are_counted_as_every_pair_of_edges_is() -> None:
    rng = np.random.default_rng(7)
    for corners in (5, 12, 40):
        ring = shapely.linearrings(rng.uniform(0, 100, (corners, 2)))
        xy = shapely.get_coordinates(ring)
        edges = shapely.linestrings(np.stack([xy[:-1], xy[1:]], axis=1))
        expected = sum(
            bool(shapely.crosses(edges[i], edges[j])) for i in range(len(edges)) for j in range(i + 1, len(edges))
        )
        count = crossings(np.array([ring]))
        assert count is not None
        assert count.crossings == expected


def test_a_star_is_left_out_and_what_lies_beside_it_is_repaired(tmp_path: Path) -> None:
    bow_tie = Polygon([(85_000, 447_000), (85_010, 447_010), (85_010, 447_000), (85_000, 447_010)])
    found = read_footprints(write(tmp_path / "a.gpkg", [star(701), bow_tie, *HOUSES]), reference())
    assert [(issue.feature, issue.problem) for issue in found.issues] == [(1, "tangled"), (2, "invalid")]
    assert "702 corners cross too often to repair it" in str(found.issues[0])
    assert "1 features are left out: 1 invalid with too many crossings to be repaired" in found.warnings
    assert isinstance(found.polygons[0], MultiPolygon)
    assert len(found) == len(HOUSES) + 1


def test_repairs_end_by_counted_work_and_are_exact_up_to_it() -> None:
    exact = Repairs().of(star(11))
    assert exact is not None
    assert shapely.union_all(exact).equals(shapely.make_valid(star(11)))
    simple = Repairs(pairs=0).of(star(11))
    assert simple is not None
    assert shapely.is_valid(shapely.union_all(simple))
    assert Repairs(pairs=0, simple=0).of(star(11)) is None
    assert Repairs(looks=10).of(star(11)) is None
    assert Repairs(looks=100_000).of(star(1_001)) is None  # its crossings are not even counted to the end


def test_an_area_of_interest_that_is_a_thicket_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    strips = [box(85_000, 447_000 + k, 85_100, 447_000.5 + k) for k in range(20)]
    strips += [box(85_000 + k, 447_000, 85_000.5 + k, 447_100) for k in range(20)]
    path = write(tmp_path / "a.gpkg", strips, naam=["x"] * 40)
    assert read_area(path, reference()).is_valid
    monkeypatch.setattr("pipeline.extras.footprints.footprints_file.AREA_CROSSINGS", 1000)
    with pytest.raises(InconsistentInputError, match=r"40 polygons cross each other in more than 1000.*Dissolve"):
        read_area(path, reference())


def test_an_area_of_interest_may_be_large_and_of_many_parts_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.extras.footprints.footprints_file.AREA_CROSSINGS", 0)
    large = write(
        tmp_path / "large.gpkg", [box(60_000, 420_000, 90_000, 450_000), box(90_000, 420_000, 91_000, 421_000)]
    )
    assert read_area(large, reference()).area == pytest.approx(901e6)
    squares = [box(85_000 + x, 447_000 + y, 85_001 + x, 447_001 + y) for x in range(20) for y in range(20)]
    assert read_area(write(tmp_path / "parcels.gpkg", squares), reference()).area == pytest.approx(400.0)


def test_an_area_of_interest_with_a_part_that_cannot_be_repaired_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.extras.footprints.repairs.PAIRS_LIMIT", 0)
    monkeypatch.setattr("pipeline.extras.footprints.footprints_file.Repairs", lambda: Repairs(pairs=0, simple=0))
    parts = [box(85_000, 447_000, 85_010, 447_010), affinity.translate(star(11), 85_000, 447_000)]
    with pytest.raises(InconsistentInputError, match="feature 2"):
        read_area(write(tmp_path / "a.gpkg", parts), reference())


def test_more_values_than_can_be_held_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nearby, "CELLS_LIMIT", 5)
    columns: dict[str, Any] = {"a": [1] * 4, "b": [2] * 4}
    far_apart = [box(x, 447_000, x + 10, 447_010) for x in (85_000, 86_000, 87_000, 88_000)]
    for suffix in (".gpkg", ".shp", ".geojson", ".parquet"):
        path = write(tmp_path / f"a{suffix}", far_apart, **columns)
        with pytest.raises(UnreadableInputError, match=r"more than 5.*columns"):
            read_footprints(path, reference())
        assert len(read_footprints(path, reference(), area=box(85_000, 447_000, 85_001, 447_001))) == 1
