"""Methods and parameters that no route handles by itself: HEAD, OPTIONS, Allow, unknown query parameters; gzip."""

import gzip
from collections.abc import Iterator
from pathlib import Path

import finished_runs as runs
import httpx
import pytest
from live_service import POINTS, serving, settings_in
from starlette.testclient import TestClient

from service import compression


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(settings_in(tmp_path_factory.mktemp("methods"))) as found:
        yield found


# --- methods


@pytest.mark.parametrize(
    ("path", "allowed"),
    [
        ("/jobs", "GET, HEAD, OPTIONS, POST"),
        (f"/jobs/{'0' * 32}", "DELETE, GET, HEAD, OPTIONS, PATCH"),
        (f"/schedules/{'0' * 32}", "DELETE, GET, HEAD, OPTIONS, PATCH"),
        ("/processes/reconstruct/execution", "OPTIONS, POST"),
    ],
)
def test_a_wrong_method_is_answered_with_all_methods_of_the_path(url: str, path: str, allowed: str) -> None:
    refused = httpx.put(url + path)
    assert (refused.status_code, refused.headers["allow"]) == (405, allowed)
    assert allowed in refused.json()["detail"]
    asked = httpx.options(url + path)
    assert (asked.status_code, asked.headers["allow"], asked.content) == (204, allowed, b"")


@pytest.mark.parametrize("path", ["/", "/healthz", "/processes", "/jobs", "/openapi.json", f"/jobs/{'0' * 32}"])
def test_the_head_of_an_answer_is_that_of_get_without_its_body(url: str, path: str) -> None:
    with httpx.Client(base_url=url, headers={"Accept-Encoding": "identity"}) as client:
        whole, head = client.get(path), client.head(path)
        assert head.status_code == whole.status_code
        assert head.content == b""
        for name in ("content-type", "content-length"):
            assert head.headers[name] == whole.headers[name]
        # the connection is still in step
        assert client.get("/healthz").json()["status"] == "ok"


def test_the_head_of_an_event_stream_ends_and_is_notcounted_as_an_open_stream(tmp_path: Path) -> None:
    settings = settings_in(tmp_path, max_event_streams=1)
    with serving(settings) as url:
        form = {"tile": ("points.xyz", POINTS)}
        job = httpx.post(f"{url}/jobs", files=form, data={"crs": "EPSG:28992"})
        assert job.status_code == 201, job.text
        for _ in range(3):
            head = httpx.head(f"{job.headers['location']}/events?f=sse")
            assert (head.status_code, head.headers["content-type"][:17]) == (200, "text/event-stream")


# --- query parameters


@pytest.mark.parametrize(
    ("path", "named"),
    [
        ("/jobs?limit=1&stauts=failed", ['query "stauts"', "status", "limit"]),
        ("/healthz?verbose=1", ['query "verbose"', "no query parameters"]),
        (f"/jobs/{'0' * 32}?g=json", ['query "g"', "use f"]),
    ],
)
def test_an_unknown_query_parameter_is_refused_with_those_that_are_known(url: str, path: str, named: list[str]) -> None:
    answer = httpx.get(url + path)
    assert answer.status_code == 400
    for text in named:
        assert text in answer.json()["detail"]


def test_a_parameter_is_known_on_the_method_that_has_it(url: str) -> None:
    assert httpx.post(f"{url}/uploads?filename=a.xyz", content=b"1 2 3\n" * 9).status_code == 201
    assert httpx.get(f"{url}/uploads?filename=a.xyz").status_code == 400
    assert httpx.get(f"{url}/?f=json").status_code == 200


# --- compression


def test_a_document_is_compressed_if_the_client_accepts_that(url: str) -> None:
    with httpx.stream("GET", f"{url}/openapi.json", headers={"Accept-Encoding": "gzip"}) as answer:
        packed = b"".join(answer.iter_raw())
    plain = httpx.get(f"{url}/openapi.json", headers={"Accept-Encoding": "identity"})
    assert answer.headers["content-encoding"] == "gzip"
    assert "Accept-Encoding" in answer.headers["vary"]
    assert "content-encoding" not in plain.headers
    assert gzip.decompress(packed) == plain.content
    assert len(packed) < len(plain.content) / 4


@pytest.fixture(scope="module")
def results(service: runs.Service) -> str:
    """The path of the results of a finished job."""
    return f"/jobs/{service.finished()}/results"


def test_a_compressed_file_has_a_weak_tag_and_a_range_is_of_its_own_bytes(client: TestClient, results: str) -> None:
    place = f"{results}/cityjson"
    plain = client.get(place, headers={"Accept-Encoding": "identity"})
    packed = client.get(place, headers={"Accept-Encoding": "gzip"})
    assert packed.headers["content-encoding"] == "gzip"
    assert packed.content == plain.content
    assert packed.headers["etag"] == f"W/{plain.headers['etag']}"
    assert client.get(place, headers={"If-None-Match": packed.headers["etag"]}).status_code == 304
    wanted = {"Range": "bytes=10-29", "Accept-Encoding": "gzip"}
    part = client.get(place, headers=wanted | {"If-Range": plain.headers["etag"]})
    assert (part.status_code, part.content) == (206, plain.content[10:30])
    whole = client.get(place, headers=wanted | {"If-Range": packed.headers["etag"]})
    assert (whole.status_code, whole.content) == (200, plain.content)


def test_files_that_are_compressed_already_or_large_are_sent_as_they_are(
    client: TestClient, results: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    accepted = {"Accept-Encoding": "gzip"}
    assert "content-encoding" not in client.get(f"{results}/buildings", headers=accepted).headers
    monkeypatch.setattr(compression, "MAX_BYTES", 100)
    answer = client.get(f"{results}/cityjson", headers=accepted)
    assert "content-encoding" not in answer.headers
    assert answer.headers["content-length"] == str(len(answer.content))
