"""GeoParquet from strangers: taken where it is what it says, refused where its few bytes stand for too much."""

import base64
import io
import json
from pathlib import Path
from typing import Any

import geopandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from examples import examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.errors import CrsError, EmptyInputError, InputError, UnreadableInputError
from pipeline.extras.footprints.footprints_file import read_footprints
from pipeline.io import SpatialReference
from service import parquet
from service.errors import LimitError, TooLargeError
from service.filenames import clean_filename
from service.preflight import Examiner, examine

MOST = 10_000_000
"""Points that are allowed here."""
HOUSE = shapely.box(85_000, 447_000, 85_010, 447_008)


def outlines(crs: str | None = "EPSG:28992", count: int = 2) -> bytes:
    """As geopandas writes them."""
    stream = io.BytesIO()
    frame = geopandas.GeoDataFrame({"id": range(count)}, geometry=[HOUSE] * count, crs=crs)
    frame.to_parquet(stream)
    return stream.getvalue()


def by_hand(columns: dict[str, Any], **about: Any) -> bytes:
    """With the metadata that the test wants."""
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": {"encoding": "WKB", **about}}}
    table = pa.table({"geometry": pa.array([HOUSE.wkb] * len(next(iter(columns.values())))), **columns})
    stream = io.BytesIO()
    pq.write_table(table.replace_schema_metadata({"geo": json.dumps(geo)}), stream)
    return stream.getvalue()


def written(folder: Path, content: bytes, name: str = "a.parquet") -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("name", ["a.parquet", "b.geoparquet", "C.PARQUET"])
def test_a_plain_file_is_described_by_its_metadata(tmp_path: Path, name: str) -> None:
    reported = examine(written(tmp_path, outlines(), clean_filename(name)), max_points=MOST)
    assert (reported["kind"], reported["format"]) == ("footprints", "geoparquet")
    assert (reported["featureCount"], reported["usable"]) == (2, True)
    assert reported["crs"] == {"name": "Amersfoort / RD New", "epsg": 28992}
    assert reported["layers"] == ["geometry"]


def test_its_crs_may_be_unknown_missing_or_a_code(tmp_path: Path) -> None:
    row = {"id": [1]}
    cases = (({"crs": None}, None), ({}, None), ({"crs": "EPSG:28992"}, 28992))
    for about, epsg in cases:
        crs = examine(written(tmp_path, by_hand(row, **about)), max_points=MOST)["crs"]
        assert crs is None if about.get("crs", "") is None else crs["epsg"] == epsg


@pytest.mark.parametrize("crs", ["Amersfoort", "+proj=longlat +nadgrids=/etc/passwd", {"type": "No such CRS"}, 7])
def test_a_crs_that_proj_may_not_be_asked_about_is_refused(tmp_path: Path, crs: object) -> None:
    with pytest.raises(CrsError):
        examine(written(tmp_path, by_hand({"id": [1]}, crs=crs)), max_points=MOST)


def no_geometry() -> bytes:
    stream = io.BytesIO()
    pq.write_table(pa.table({"id": [1]}), stream)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "reported"),
    [
        (b"PK\x03\x04" * 10, "not Parquet"),
        (b"PAR1", "truncated"),
        (outlines()[:-4], "truncated"),
        (b"PAR1" + b"\xff\xff\xff\x7fPAR1", "its footer claims"),
        (b"PAR1" + b"\0" * 40 + b"\x10\0\0\0PAR1", "cannot be read as Parquet"),
        (no_geometry(), "no `geo` metadata"),
        (by_hand({"id": [1]}, encoding="point"), "encoded as 'point'"),
    ],
    ids=["another format", "four bytes", "cut off", "footer", "empty footer", "no geometry", "encoding"],
)
def test_a_file_that_is_none_is_refused_with_the_reason(tmp_path: Path, content: bytes, reported: str) -> None:
    with pytest.raises(UnreadableInputError, match=reported):
        examine(written(tmp_path, content), max_points=MOST)


def test_a_file_without_rows_is_empty(tmp_path: Path) -> None:
    with pytest.raises(EmptyInputError, match="no rows"):
        examine(written(tmp_path, outlines(count=0)), max_points=MOST)


def test_more_rows_than_are_taken_are_refused_before_one_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parquet, "ROWS_LIMIT", 1)
    monkeypatch.setattr(parquet, "DECODED_LIMIT", 0)
    with pytest.raises(TooLargeError, match="has 2 rows, footprints or guides may have 1"):
        examine(written(tmp_path, outlines()), max_points=MOST)


def test_a_long_text_that_every_row_repeats_is_refused_by_what_it_decodes_to(tmp_path: Path) -> None:
    count, text = 3_000, "x" * (1 << 20)
    names = pa.DictionaryArray.from_arrays(pa.array([0] * count, pa.int32()), pa.array([text]))
    bomb = by_hand({"name": names})
    assert len(bomb) < 1 << 20
    examiner = Examiner()
    try:
        with pytest.raises((TooLargeError, UnreadableInputError)):
            examiner.examine(written(tmp_path, bomb), max_points=MOST)
    finally:
        examiner.close()


@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.binary(min_size=1, max_size=8)), min_size=1, max_size=4))
@settings(max_examples=examples(100), deadline=None, suppress_health_check=list(HealthCheck))
def test_a_damaged_file_is_understood_or_refused_by_an_error_that_is_meant(
    tmp_path: Path, changes: list[tuple[float, bytes]]
) -> None:
    raw = bytearray(outlines())
    for place, value in changes:
        at = int(place * len(raw))
        raw[at : at + len(value)] = value
    path = written(tmp_path, bytes(raw))
    for read in (lambda: examine(path, max_points=MOST), lambda: read_footprints(path, SpatialReference())):
        try:
            read()
        except (InputError, LimitError):
            continue


def test_it_is_uploaded_and_given_by_reference_and_by_value(local_service: Any) -> None:
    client, content = local_service.client, outlines()
    upload = client.post("/uploads?filename=houses.parquet", content=content)
    assert upload.status_code == 201, upload.text
    tile = {"href": f"/uploads/{local_service.upload()}"}
    by_reference = {"href": f"/uploads/{upload.json()['uploadID']}"}
    by_value = {"value": base64.b64encode(content).decode(), "encoding": "base64"}
    for footprints in (by_reference, by_value):
        inputs = {"tiles": tile, "crs": "EPSG:28992", "footprints": footprints}
        answer = client.post("/processes/reconstruct/execution", json={"inputs": inputs})
        reference = local_service.request_of(answer).footprints
        kept = local_service.store.upload(reference.value)
        assert kept.filename in {"houses.parquet", "footprints.parquet"}
        assert kept.size_bytes == len(content)


def test_a_bad_one_is_refused_when_it_is_sent(local_service: Any) -> None:
    answer = local_service.client.post("/uploads?filename=houses.parquet", content=no_geometry())
    assert answer.status_code == 422
    assert "no `geo` metadata" in answer.text
