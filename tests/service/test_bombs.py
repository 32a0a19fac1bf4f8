"""Files that are built to harm: refused by their header, within bounded memory and time, by errors that are meant."""

import contextlib
import functools
import io
import json
import os
import re
import resource
import signal
import sqlite3
import struct
import tempfile
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import laspy
import numpy as np
import pytest
from examples import examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from live_service import las_bytes
from processes import wait_for

from pipeline.errors import EmptyInputError, InputError, UnreadableInputError
from pipeline.extras.footprints.footprints_file import read_footprints
from pipeline.io import SpatialReference
from service import vectors
from service.errors import LimitError, TooLargeError
from service.preflight import CHILD_S, Examiner, examine
from service.vectors import DEPTH_LIMIT, _levels

MOST = 10_000_000
"""Points that are allowed here."""
POLYGON = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}
COLLECTION = {
    "type": "FeatureCollection",
    "features": [{"type": "Feature", "properties": {"name": 'a "quoted" ]}{[ \\ name'}, "geometry": POLYGON}],
}
PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement camera 2\nproperty uchar a\nelement vertex 5\n"
    b"property double x\nproperty double y\nproperty double z\nproperty uchar classification\nend_header\n"
)


def written(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def patched(content: bytes, at: int, layout: str, *values: object) -> bytes:
    raw = bytearray(content)
    struct.pack_into(layout, raw, at, *values)
    return bytes(raw)


def laz_1_4(n: int = 300) -> bytes:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.01)
    las = laspy.LasData(header)
    rng = np.random.default_rng(3)
    las.x, las.y, las.z = rng.uniform(0, 100, (3, n))
    stream = io.BytesIO()
    las.write(stream, do_compress=True)
    return stream.getvalue()


def peak_of(call: Callable[[], object]) -> int:
    """Most bytes that a call held, whatever it raises."""
    tracemalloc.start()
    try:
        with pytest.raises((InputError, LimitError)):
            call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


# --- points ----------------------------------------------------------------------------------------------------------


def test_a_header_with_too_many_points_is_refused_before_anything_is_decoded(tmp_path: Path) -> None:
    # The bytes are not there either: the limit comes first.
    for name, content in (
        ("a.las", patched(las_bytes(10, compressed=False), 107, "<I", 4_000_000_000)),
        ("a.laz", patched(laz_1_4(), 247, "<Q", 10**15)),
        ("a.ply", PLY.replace(b"vertex 5", b"vertex 1000000000000000000")),
    ):
        path = written(tmp_path, name, content)
        assert peak_of(functools.partial(examine, path, max_points=MOST)) < 4 << 20
        with pytest.raises(TooLargeError, match=rf"{name} has \d+ points, this service takes {MOST}: cut it"):
            examine(path, max_points=MOST)


def test_text_with_too_many_lines_is_refused_without_being_parsed(tmp_path: Path) -> None:
    path = written(tmp_path, "a.xyz", b"1 2 3\n" * 1001)
    with pytest.raises(TooLargeError, match="has 1002 points, this service takes 1000"):
        examine(path, max_points=1000)
    assert examine(path, max_points=2000)["pointCount"] == 1001


@pytest.mark.parametrize(
    "content",
    [
        patched(las_bytes(10, compressed=False), 107, "<I", 1_000_000),
        patched(las_bytes(1000), 107, "<I", 9_000_000),
        patched(laz_1_4(), 247, "<Q", 9_000_000),
        patched(las_bytes(10, compressed=False), 105, "<H", 65_535),
        patched(las_bytes(10, compressed=False), 100, "<I", 2**32 - 1),
        patched(laz_1_4(), 235, "<QI", 2**63, 2**32 - 1),
        patched(laz_1_4(), 131, "<d", float("nan")),
        patched(laz_1_4(), 131, "<d", 1e300),
    ],
    ids=["las count", "laz count", "laz 1.4 count", "record size", "vlrs", "evlrs", "scale nan", "scale huge"],
)
def test_a_header_that_promises_what_the_bytes_do_not_hold_is_refused(tmp_path: Path, content: bytes) -> None:
    path = written(tmp_path, "a.laz", content)
    assert peak_of(lambda: examine(path, max_points=MOST)) < 8 << 20


@pytest.mark.parametrize("words", [(0, 2**32 - 1), (0, 0), (0, 2), (0, 100_000_000)])
def test_a_table_of_compressed_chunks_that_is_nonsense_is_refused(tmp_path: Path, words: tuple[int, int]) -> None:
    content = laz_1_4()
    start = struct.unpack_from("<I", content, 96)[0]
    table = struct.unpack_from("<q", content, start)[0]
    path = written(tmp_path, "a.laz", patched(content, table, "<II", *words))
    assert peak_of(lambda: examine(path, max_points=MOST)) < 8 << 20


def test_extended_records_without_end_are_not_followed(tmp_path: Path) -> None:
    content = laz_1_4()
    records = struct.pack("<H16sHQ32s", 0, b"x", 1, 0, b"") * 50_000
    forged = patched(content, 235, "<QI", len(content), 2**32 - 1) + records
    assert examine(written(tmp_path, "a.laz", forged), max_points=MOST)["crs"] is None


@pytest.mark.parametrize("filling", [b"1", b" ", b"1 ", b"\t", b"#"])
def test_text_in_one_endless_line_is_refused_within_bounded_memory(tmp_path: Path, filling: bytes) -> None:
    path = written(tmp_path, "a.xyz", filling * ((40 << 20) // len(filling)))
    assert peak_of(lambda: examine(path, max_points=MOST)) < 8 << 20


def test_rows_of_text_that_never_end_are_refused_within_bounded_memory(tmp_path: Path) -> None:
    path = written(tmp_path, "a.xyz", b"1 2 3\n" * 100 + b"9" * (40 << 20))
    assert peak_of(lambda: examine(path, max_points=MOST)) < 64 << 20


def test_vertices_of_a_ply_that_are_endless_lines_are_refused_within_bounded_memory(tmp_path: Path) -> None:
    header = b"ply\nformat ascii 1.0\nelement vertex 1000\nproperty float x\nproperty float y\nproperty float z\n"
    path = written(tmp_path, "a.ply", header + b"end_header\n" + (b"1" * 60_000 + b"\n") * 1000)
    assert peak_of(lambda: examine(path, max_points=MOST)) < 8 << 20


def test_a_ply_whose_other_elements_are_countless_is_refused_at_once(tmp_path: Path) -> None:
    header = b"ply\nformat ascii 1.0\nelement junk 1000000000000000000\nproperty float x\n"
    header += b"element vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n"
    with pytest.raises(InputError):
        examine(written(tmp_path, "a.ply", header), max_points=MOST)


# --- footprints ------------------------------------------------------------------------------------------------------


def geopackage(path: Path, *statements: str) -> Path:
    """A small GeoPackage with the layer `houses`, and statements after it."""
    with sqlite3.connect(path) as database:
        database.executescript(
            """
            PRAGMA application_id = 0x47504B47;
            CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT, srs_id INTEGER PRIMARY KEY, organization TEXT,
                organization_coordsys_id INTEGER, definition TEXT, description TEXT);
            INSERT INTO gpkg_spatial_ref_sys VALUES ('Amersfoort / RD New', 28992, 'EPSG', 28992, '', '');
            CREATE TABLE gpkg_contents (table_name TEXT, data_type TEXT, identifier TEXT, srs_id INTEGER);
            INSERT INTO gpkg_contents VALUES ('houses', 'features', 'houses', 28992);
            CREATE TABLE gpkg_geometry_columns (table_name TEXT, column_name TEXT, geometry_type_name TEXT,
                srs_id INTEGER, z INTEGER, m INTEGER);
            INSERT INTO gpkg_geometry_columns VALUES ('houses', 'geom', 'POLYGON', 28992, 0, 0);
            CREATE TABLE houses (fid INTEGER PRIMARY KEY, geom BLOB);
            INSERT INTO houses (geom) VALUES (x'00');
            """
        )
        for statement in statements:
            database.executescript(statement)
    database.close()
    return path


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT"


def test_a_plain_geopackage_is_described_by_its_tables(tmp_path: Path) -> None:
    reported = examine(geopackage(tmp_path / "a.gpkg"), max_points=MOST)
    assert (reported["format"], reported["featureCount"], reported["layers"]) == ("geopackage", 1, ["houses"])
    assert reported["crs"] == {"name": "Amersfoort / RD New", "epsg": 28992}


@pytest.mark.parametrize(
    "statement",
    [
        f"DROP TABLE houses; CREATE VIEW houses AS {ENDLESS} i AS fid, zeroblob(100000000) AS geom FROM n;",
        f"DROP TABLE gpkg_contents; CREATE VIEW gpkg_contents AS {ENDLESS} 'houses' AS table_name FROM n;",
        "DROP TABLE houses; CREATE TABLE houses (fid INTEGER PRIMARY KEY, geom BLOB AS (zeroblob(1000000000)));",
        "DROP TABLE houses; CREATE TABLE houses (fid INTEGER PRIMARY KEY, geom BLOB AS (zeroblob(1000000000)) STORED);",
        "DROP TABLE houses;",
        "DELETE FROM gpkg_contents;",
        "DELETE FROM houses;",
        "UPDATE gpkg_geometry_columns SET geometry_type_name = 'POINT';",
        "UPDATE gpkg_contents SET table_name = 'sqlite_master';",
        "UPDATE gpkg_contents SET table_name = 'houses\"; DROP TABLE houses; --';",
        "PRAGMA application_id = 0;",
        "CREATE VIRTUAL TABLE evil USING fts3tokenize('simple');",
    ],
)
def test_a_geopackage_with_a_program_in_it_is_refused(tmp_path: Path, statement: str) -> None:
    path = geopackage(tmp_path / "a.gpkg", statement)
    assert peak_of(lambda: examine(path, max_points=MOST)) < 8 << 20


def test_a_geopackage_is_only_read(tmp_path: Path) -> None:
    path = geopackage(tmp_path / "a?mode=rwc#.gpkg")
    before = path.read_bytes()
    examine(path, max_points=MOST)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_a_geopackage_with_two_layers_is_taken_and_reported_to_be_unusable(tmp_path: Path) -> None:
    second = (
        "CREATE TABLE barns (fid INTEGER PRIMARY KEY, geom BLOB);"
        "INSERT INTO gpkg_contents VALUES ('barns', 'features', 'barns', 28992);"
        "INSERT INTO gpkg_geometry_columns VALUES ('barns', 'geom', 'POLYGON', 28992, 0, 0);"
    )
    reported = examine(geopackage(tmp_path / "a.gpkg", second), max_points=MOST)
    assert reported["usable"] is False
    assert sorted(reported["layers"]) == ["barns", "houses"]


@pytest.mark.parametrize(
    "text",
    [
        "[" * 1_000_000,
        '{"type":"FeatureCollection","features":' + "[" * 1_000_000,
        '{"type":"Feature","properties":' + '{"a":' * 100_000,
        '{"type":"FeatureCollection","features":[]}',
        '{"type":"FeatureCollection","features":[{"type":"Feature"',
        '{"type":"Feature"}}}}{{{{',
        '{"type":"Feature","properties":{"a":"' + "x" * 1_000_000,
        '{"type":"Topology"}',
        "",
        "\\",
        '{"type":"Feature","a":"\\',
    ],
)
def test_geojson_that_is_nested_without_measure_cut_off_or_none_is_refused(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, "a.geojson", text.encode())
    assert peak_of(lambda: examine(path, max_points=MOST)) < 64 << 20


@pytest.mark.parametrize(
    "text",
    [
        '<OGRVRTDataSource><OGRVRTLayer name="a"><SrcDataSource>CSV:/etc/passwd</SrcDataSource></OGRVRTLayer>',
        "<OGRWFSDataSource><URL>http://127.0.0.1:1/</URL></OGRWFSDataSource>",
        '{"type":"gdal_streamed_alg","command_line":"gdal vector pipeline ! read CSV:/etc/passwd ! write -"}',
        '{"type":"gdal_streamed_alg","command_line":"x","a":{"type":"Feature"}}',
    ],
)
@pytest.mark.parametrize("name", ["a.geojson", "a.json", "a.gpkg", "a.shp"])
def test_a_file_that_names_others_to_read_is_no_footprints(tmp_path: Path, text: str, name: str) -> None:
    path = written(tmp_path, name, text.encode())
    if '"Feature"' not in text or not name.endswith("json"):
        with pytest.raises(UnreadableInputError):
            examine(path, max_points=MOST)
    # The reader itself does not follow either, however it is reached.
    with pytest.raises(InputError):
        read_footprints(path, SpatialReference())


def test_footprints_larger_than_memory_allows_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vectors, "GEOJSON_LIMIT", 100)
    monkeypatch.setattr(vectors, "GEOPACKAGE_LIMIT", 100)
    written(tmp_path, "a.geojson", json.dumps(COLLECTION).encode())
    geopackage(tmp_path / "a.gpkg")
    for name in ("a.geojson", "a.gpkg"):
        with pytest.raises(TooLargeError, match=r"footprints or guides in .* may have 100: cut out the area"):
            examine(tmp_path / name, max_points=MOST)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=8) | st.sampled_from(['"', "\\", '\\"', "]}", "[{"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=12,
)


@given(json_values, st.booleans(), st.integers(1, 9))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_brackets_arecounted_as_a_parser_does_wherever_blocks_end(
    tmp_path: Path, value: object, ascii_only: bool, block: int
) -> None:
    text = json.dumps({"a": value}, ensure_ascii=ascii_only).encode("utf-8", "replace")
    path = written(tmp_path, "a.json", text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vectors, "BLOCK_BYTES", block + 1)
        level, highest, lowest = 0, 0, 0
        for (low, high, last), _ in _levels(path):
            highest, lowest = max(highest, level + high), min(lowest, level + low)
            level += last

    def depth(item: object) -> int:
        inner = item.values() if isinstance(item, dict) else item if isinstance(item, list) else None
        return 0 if inner is None else 1 + max(map(depth, inner), default=0)

    assert (level, highest, lowest) == (0, depth({"a": value}), 0)


def test_geojson_with_quotes_and_brackets_in_its_texts_is_taken(tmp_path: Path) -> None:
    reported = examine(written(tmp_path, "a.geojson", json.dumps(COLLECTION).encode()), max_points=MOST)
    assert (reported["featureCount"], reported["usable"], reported["crs"]["name"]) == (1, True, "WGS 84 (CRS84)")
    assert DEPTH_LIMIT > 12


# --- whatever is damaged ---------------------------------------------------------------------------------------------


def samples() -> list[tuple[str, bytes]]:
    """Small whole files of every format."""
    rows = b"".join(b"%d.5 %d.25 3.0 2 100\n" % (84_000 + n, 447_000 + n) for n in range(50))
    pulses = b"".join(b"%d %d 9 1 %d %d 3 1\n" % (n, n, n, n) for n in range(60))
    return [
        (".laz", las_bytes(200)),
        (".las", las_bytes(20, compressed=False)),
        (".laz", laz_1_4()),
        (".ply", PLY + b"\1\2" + np.arange(33 * 5, dtype=np.uint8).tobytes()),
        (".ply", PLY.replace(b"binary_little_endian", b"ascii") + b"1\n2\n" + b"1 2 3 4\n" * 5),
        (".xyz", b"x y z classification gps_time\n" + rows),
        (".csv", b"x,y,z\n1,2,3\n4,5,6\n"),
        (".pts", pulses),
        (".geojson", json.dumps(COLLECTION).encode()),
    ]


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, bytes]]:
    path = geopackage(tmp_path_factory.mktemp("whole") / "a.gpkg")
    return [*samples(), (".gpkg", path.read_bytes())]


ODD = [b"\xff" * 8, b"\0" * 8, b"9" * 30, b"nan", b"1e999", b"\n", b"[", b'"', b"\\"]
ODD += [struct.pack("<d", float("nan")), struct.pack("<d", 1e308), struct.pack("<Q", 2**63)]
ODD += [b"property list uchar int x\n", b"property float x\n", b"element vertex -5\n"]
edits = st.lists(
    st.tuples(
        st.sampled_from(["set", "insert", "delete", "cut"]),
        st.floats(0.0, 1.0),
        st.binary(min_size=1, max_size=12) | st.sampled_from(ODD),
    ),
    min_size=1,
    max_size=5,
)


def edited(content: bytes, changes: list[tuple[str, float, bytes]], head: int) -> bytes:
    raw = bytearray(content)
    for kind, place, value in changes:
        at = int(place * min(len(raw), head))
        if kind == "set":
            raw[at : at + len(value)] = value
        elif kind == "insert":
            raw[at:at] = value
        elif kind == "delete":
            del raw[at : at + len(value)]
        else:
            del raw[at:]
    return bytes(raw)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("number", range(10))
@given(edits, st.sampled_from([150, 400, 10**9]))
@settings(max_examples=examples(60), deadline=None, suppress_health_check=list(HealthCheck))
def test_a_damaged_header_is_understood_or_refused_by_an_error_that_is_meant(
    tmp_path: Path,
    whole_files: list[tuple[str, bytes]],
    number: int,
    changes: list[tuple[str, float, bytes]],
    head: int,
) -> None:
    suffix, content = whole_files[number]
    path = written(tmp_path, f"a{suffix}", edited(content, changes, head))
    try:
        reported = examine(path, max_points=MOST)
    except (InputError, LimitError):
        return
    json.dumps(reported, allow_nan=False)
    assert reported["kind"] in {"points", "footprints", "guides"}


# --- the child -------------------------------------------------------------------------------------------------------


@pytest.fixture
def examiner() -> Iterator[Examiner]:
    made = Examiner()
    yield made
    made.close()


@pytest.fixture
def good(tmp_path: Path) -> Path:
    """A file of a hundred points."""
    return written(tmp_path, "a.laz", las_bytes(100))


def test_the_child_answers_as_the_function_does(tmp_path: Path, good: Path, examiner: Examiner) -> None:
    assert examiner.examine(good, max_points=MOST) == examine(good, max_points=MOST)
    with pytest.raises(TooLargeError, match="has 100 points, this service takes 99"):
        examiner.examine(good, max_points=99)
    for name, content in (("b.laz", b"LASF"), ("c.laz", b""), ("d.xyz", b"words\n"), ("e.gpkg", b"x")):
        path = written(tmp_path, name, content)
        with pytest.raises(InputError) as direct:
            examine(path, max_points=MOST)
        with pytest.raises(type(direct.value), match=re.escape(str(direct.value))):
            examiner.examine(path, max_points=MOST)


def test_a_file_over_which_the_child_hangs_is_refused_and_the_next_is_served(good: Path, examiner: Examiner) -> None:
    child = examiner._running()
    child.send_signal(signal.SIGSTOP)
    examiner._timeout_s = 1.0
    with pytest.raises(UnreadableInputError, match="could not be read within 1 s"):
        examiner.examine(good, max_points=MOST)
    assert child.returncode == -signal.SIGKILL
    examiner._timeout_s = CHILD_S
    assert examiner.examine(good, max_points=MOST)["pointCount"] == 100


@pytest.mark.slow
def test_what_a_child_has_unpacked_goes_with_it(
    tmp_path: Path, good: Path, examiner: Examiner, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setenv("TMPDIR", str(place))
    monkeypatch.setattr(tempfile, "tempdir", None)
    archive = tmp_path / "large.zip"
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("large.gpkg", bytes(400 << 20))  # takes a second to unpack
    examiner.examine(good, max_points=MOST)
    examiner._timeout_s = 5.0
    with ThreadPoolExecutor(1) as pool:
        refused = pool.submit(examiner.examine, archive, max_points=MOST)
        wait_for(lambda: list(place.rglob("large.gpkg")), "what is unpacked")
        assert examiner._child is not None
        examiner._child.send_signal(signal.SIGSTOP)
        with pytest.raises(UnreadableInputError, match="could not be read within 5 s"):
            refused.result()
    assert list(place.iterdir()) == []


def test_a_file_over_which_the_child_dies_is_refused_and_the_next_is_served(good: Path, examiner: Examiner) -> None:
    killed: set[int] = set()

    def kill_the_reader() -> bool:
        child = examiner._child
        if child is not None and child.pid not in killed:
            killed.add(child.pid)
            child.kill()
        return len(killed) == 2  # it is tried twice

    with ThreadPoolExecutor(1) as pool:
        killing = pool.submit(wait_for, kill_the_reader, "two children")
        with pytest.raises(UnreadableInputError, match="crashes the reader"):
            examiner.examine(good, max_points=MOST)
        killing.result()
    assert examiner.examine(good, max_points=MOST)["pointCount"] == 100


def test_an_answer_that_cannot_be_read_is_not_taken_for_that_of_the_next_file(
    tmp_path: Path, examiner: Examiner, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = written(tmp_path, "a.laz", las_bytes(100)), written(tmp_path, "b.laz", las_bytes(55))
    with monkeypatch.context() as broken:
        broken.setattr("service.preflight._line_of", lambda *_: b"no JSON\n")
        with pytest.raises(ValueError, match="Expecting value"):
            examiner.examine(first, max_points=MOST)
    assert examiner.examine(second, max_points=MOST)["pointCount"] == 55


def test_the_child_answers_also_where_a_thousand_files_and_connections_are_open(good: Path, examiner: Examiner) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = 2000
    if hard != resource.RLIM_INFINITY and hard < wanted:
        pytest.skip(f"this machine allows {hard} open files")
    with contextlib.ExitStack() as stack:
        if soft != resource.RLIM_INFINITY and soft < wanted:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        for _ in range(1100):
            stack.callback(os.close, os.open(os.devnull, os.O_RDONLY))
        assert examiner.examine(good, max_points=MOST)["pointCount"] == 100
        examiner.close()


def test_a_child_that_was_killed_is_started_again_without_a_word(good: Path, examiner: Examiner) -> None:
    for _ in range(2):
        assert examiner.examine(good, max_points=MOST)["pointCount"] == 100
        examiner._child.kill()
        examiner._child.wait()


def test_a_header_that_asks_for_all_memory_is_an_unreadable_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hungry(path: Path) -> dict[str, object]:
        raise MemoryError

    monkeypatch.setattr("service.preflight.examine_vector", hungry)
    with pytest.raises(UnreadableInputError, match="needs more memory"):
        examine(written(tmp_path, "a.geojson", b"{}"), max_points=MOST)


def test_the_child_knows_none_of_the_services_secrets(
    tmp_path: Path, examiner: Examiner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GABLEWORK_DATABASE_URL", "postgresql+pg8000://me:secret@host/db")
    examiner.examine(written(tmp_path, "a.laz", las_bytes(10)), max_points=MOST)
    environment = Path(f"/proc/{examiner._child.pid}/environ")
    if not environment.exists():
        pytest.skip("this system does not show a process's environment")
    assert b"GABLEWORK_" not in environment.read_bytes()


def test_an_empty_file_is_reported_as_empty(tmp_path: Path) -> None:
    with pytest.raises(EmptyInputError, match="0 bytes"):
        examine(written(tmp_path, "a.laz", b""), max_points=MOST)
