"""Which hosts, URLs and CRS a stranger may name: one origin an entry, no parser is led astray, PROJ opens nothing."""

import contextlib
from pathlib import Path

import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj.enums import WktVersion

from pipeline.errors import CrsError
from pipeline.io.crs import horizontal_unit_of
from service.errors import InputRefusedError, StartUpError
from service.input_policy import checked_crs, checked_url, origin_of
from service.settings import ServiceSettings

# --- hosts and URLs --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("entry", "origin"),
    [
        ("example.org", ("https", "example.org", 443)),
        ("EXAMPLE.org", ("https", "example.org", 443)),
        ("example.org:8443", ("https", "example.org", 8443)),
        ("https://example.org", ("https", "example.org", 443)),
        ("http://10.0.0.7:9000", ("http", "10.0.0.7", 9000)),
        ("[::1]:8443", ("https", "::1", 8443)),
    ],
)
def test_a_listed_host_stands_for_one_origin(entry: str, origin: tuple[str, str, int]) -> None:
    assert origin_of(entry) == origin


@pytest.mark.parametrize("entry", ["", "*", "*.example.org", "example.org/path", "me@example.org", "ftp://example.org"])
def test_an_entry_that_is_no_host_stops_what_uses_it(entry: str) -> None:
    with pytest.raises(StartUpError, match="input_hosts has"):
        origin_of(entry)


@pytest.mark.parametrize(
    "value",
    [
        "http://example.org/a.laz",
        "https://example.org:444/a.laz",
        "https://example.org.evil.net/a.laz",
        "https://evil.net/example.org/a.laz",
        "https://evil.net#example.org/a.laz",
        "https://evil.net?example.org/a.laz",
        "https://evil.net\\@example.org/a.laz",
        "https://example.org@evil.net/a.laz",
        "https://me:pass@example.org/a.laz",
        "https://example.org./a.laz",
        "https://127.0.0.1/a.laz",
        "https://2130706433/a.laz",
        "https://0x7f.1/a.laz",
        "https://[::1]/a.laz",
        "https://[::ffff:127.0.0.1]/a.laz",
        "https://169.254.169.254/latest/meta-data/a.laz",
        "https://localhost/a.laz",
        "https://sub.example.org/a.laz",
        "https://ex\u0430mple.org/a.laz",
        "ftp://me:pass@example.org/a.laz",
        "file:///etc/passwd",
        "gopher://example.org/a.laz",
        "//example.org/a.laz",
        "https:///a.laz",
        "https://example.org:99999/a.laz",
        "https://example.org:port/a.laz",
        "https://example.org /a.laz",
        "https://example.org\n/a.laz",
        "javascript:alert(1)",
        "",
        "https://example.org/" + "a" * 5000 + ".laz",
    ],
)
def test_a_url_that_leads_elsewhere_is_refused(value: str) -> None:
    settings = ServiceSettings(state=Path("unused"), input_hosts=("example.org",))
    with pytest.raises(InputRefusedError) as caught:
        checked_url(value, settings)
    assert ":pass" not in str(caught.value)


@pytest.mark.parametrize(
    "value", ["https://example.org/a.laz", "https://EXAMPLE.org:443/a.laz", "https://example.org/a.laz?token=1"]
)
def test_a_url_of_a_listed_host_is_taken(value: str) -> None:
    checked_url(value, ServiceSettings(state=Path("unused"), input_hosts=("example.org",)))


@given(st.text(max_size=60))
def test_no_text_gets_by_that_is_not_of_a_listed_host(text: str) -> None:
    settings = ServiceSettings(state=Path("unused"), input_hosts=("example.org",))
    for value in (text, f"https://{text}/a.laz", f"https://example.org{text}/a.laz", f"https://{text}example.org/"):
        try:
            found = checked_url(value, settings)
        except InputRefusedError:
            continue
        assert (found.scheme, found.host, found.port, found.userinfo) == ("https", "example.org", None, b"")


# --- CRS -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:28992",
        "28992",
        " 28992+5709 ",
        " epsg:28992 ",
        "EPSG:28992+5709",
        "IGNF:LAMB93",
        "urn:ogc:def:crs:EPSG::28992",
        "http://www.opengis.net/def/crs/EPSG/0/28992",
        "urn:ogc:def:crs,crs:EPSG::28992,crs:EPSG::5709",
        "+proj=utm +zone=31 +datum=WGS84 +units=m +no_defs",
        "+proj=sterea +lat_0=52.1 +lon_0=5.3 +k=0.99 +ellps=bessel +towgs84=565.4,50.3,465.5,1.9,-0.4,1.7,4 +units=m",
    ],
)
def test_a_crs_is_taken_by_code_urn_and_plain_proj_string(text: str) -> None:
    assert horizontal_unit_of(checked_crs(text, path="crs"), path="crs") == 1.0


@pytest.mark.parametrize("version", list(WktVersion))
def test_a_crs_is_taken_as_wkt_of_every_kind_and_as_projjson(version: WktVersion) -> None:
    for crs in (pyproj.CRS("EPSG:28992"), pyproj.CRS("EPSG:7415"), pyproj.CRS("EPSG:25831")):
        with contextlib.suppress(pyproj.exceptions.CRSError):  # compound CRS cannot be said in every kind
            assert checked_crs(crs.to_wkt(version, pretty=True), path="crs").name
        assert checked_crs(crs.to_json(), path="crs") == crs


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Foo bar",
        "Amersfoort / RD New",
        "a" * 19_000,
        "/etc/passwd",
        "file:///etc/passwd",
        "http://127.0.0.1:9/crs",
        "+init=/etc/passwd:a",
        "+init=epsg:28992",
        "+proj=utm +zone=31 +nadgrids=/etc/passwd",
        "+proj=utm +zone=31 +geoidgrids=@x",
        "+proj=pipeline +step +init=/etc/passwd:a",
        "urn:ogc:def:crs:foo",
        "COMPO-1UNDCRS[PROJCRS[",
        "X" * 30 + ":1",
        'PROJCS["x",PARAMETERFILE["x","/etc/passwd"]]',
        "{" * 5000,
    ],
)
def test_a_text_that_makes_proj_search_or_open_files_does_not_get_there(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reached(*_: object, **__: object) -> None:
        raise AssertionError("PROJ was asked")

    monkeypatch.setattr("service.input_policy.parse_crs", reached)
    with pytest.raises(CrsError, match="Give one such as EPSG:28992"):
        checked_crs(text, path="crs")
