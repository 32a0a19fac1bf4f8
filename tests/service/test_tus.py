"""Resumable uploads by the protocol tus: what it answers, what it refuses, and that nothing is left behind."""

import base64
import datetime as dt
import hashlib
from collections.abc import Iterator
from email.utils import parsedate_to_datetime
from typing import Any

import httpx
import pytest
from tus_client import CONTENT, PATCH, TUS, begin, creation, metadata, names_in, offset, send

from service import resumable
from service.disk import Disk
from service.driver.janitor import tidy_uploads
from service.files import StateFolder
from service.keys import Scope
from service.resumable import Unfinished


@pytest.fixture
def client(local_service: Any) -> httpx.Client:
    return local_service.client


# --- the protocol


@pytest.mark.parametrize("path", ["/uploads/tus", f"/uploads/tus/{'0' * 32}"])
def test_options_names_version_extensions_and_limits(starting: Any, path: str) -> None:
    answer = starting(max_upload_bytes=12_345).client.options(path)
    assert (answer.status_code, answer.content) == (204, b"")
    assert answer.headers["tus-version"] == "1.0.0"
    assert answer.headers["tus-max-size"] == "12345"
    assert "sha1" in answer.headers["tus-checksum-algorithm"].split(",")
    extensions = {"creation", "creation-with-upload", "checksum", "termination", "expiration"}
    assert set(answer.headers["tus-extension"].split(",")) == extensions


def test_an_upload_in_parts_ends_as_the_same_record_as_one_in_one_request(client: httpx.Client) -> None:
    at_once = client.post("/uploads?filename=tile.laz", content=CONTENT).json()
    url = begin(client)
    for start in range(0, len(CONTENT), 50_000):
        assert offset(client, url) == start
        last = send(client, url, start, CONTENT[start : start + 50_000])
        assert (last.status_code, last.headers["tus-resumable"]) == (204, "1.0.0"), last.text
    place = last.headers["content-location"]
    assert place.rpartition("/")[2] == url.rpartition("/")[2]
    record = client.get(place).json()
    differing = {"uploadID", "created", "expires", "links"}
    assert {name: value for name, value in record.items() if name not in differing} == {
        name: value for name, value in at_once.items() if name not in differing
    }
    finished = client.head(url, headers=TUS)
    assert finished.headers["upload-offset"] == finished.headers["upload-length"] == str(len(CONTENT))
    assert finished.headers["content-location"] == place


def test_the_first_bytes_may_come_with_the_creation(client: httpx.Client, local_service: Any) -> None:
    headers = {**PATCH, **creation()}
    some = client.post("/uploads/tus", headers=headers, content=CONTENT[:1000])
    assert (some.status_code, some.headers["upload-offset"]) == (201, "1000")
    assert offset(client, some.headers["location"]) == 1000
    whole = client.post("/uploads/tus", headers=headers, content=CONTENT)
    assert whole.status_code == 201
    assert client.get(whole.headers["content-location"]).json()["sha256"] == hashlib.sha256(CONTENT).hexdigest()


@pytest.mark.parametrize("first", [0, 1000])
def test_a_creation_that_is_sent_again_under_its_key_makes_one_upload(
    client: httpx.Client, local_service: Any, first: int
) -> None:
    headers = {**PATCH, **creation(), "Idempotency-Key": "one"}
    answers = [client.post("/uploads/tus", headers=headers, content=CONTENT[:first]) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [201, 201]
    assert answers[0].headers["location"] == answers[1].headers["location"]
    assert answers[0].headers["upload-offset"] == answers[1].headers["upload-offset"] == str(first)
    assert len(names_in(local_service)) == 1
    other = client.post("/uploads/tus", headers={**headers, "Upload-Length": "5000"}, content=CONTENT[:first])
    assert other.status_code == 422
    assert len(names_in(local_service)) == 1


def test_head_repeats_what_was_promised_and_must_not_be_cached(client: httpx.Client) -> None:
    asked = {"Upload-Metadata": metadata("Straße.laz", other="kept")}
    answer = client.head(begin(client, **asked), headers=TUS)
    assert answer.headers["upload-metadata"] == asked["Upload-Metadata"]
    assert answer.headers["upload-length"] == str(len(CONTENT))
    assert answer.headers["cache-control"] == "no-store"


@pytest.mark.parametrize("version", [{}, {"Tus-Resumable": "0.2.2"}])
def test_another_version_is_refused_with_the_one_that_is_spoken(client: httpx.Client, version: dict[str, str]) -> None:
    url = begin(client)
    without = {name: value for name, value in {**creation(), **PATCH}.items() if name != "Tus-Resumable"}
    for method, path in [("POST", "/uploads/tus"), ("HEAD", url), ("PATCH", url), ("DELETE", url)]:
        refused = client.request(method, path, headers={**without, "Upload-Offset": "0", **version})
        assert (refused.status_code, refused.headers["tus-version"]) == (412, "1.0.0"), method


@pytest.mark.parametrize("at", [0, 999, 1001, 10**15])
def test_bytes_that_do_not_continue_the_upload_change_nothing(client: httpx.Client, at: int) -> None:
    url = begin(client)
    assert send(client, url, 0, CONTENT[:1000]).status_code == 204
    refused = send(client, url, at, b"x" * 100)
    assert refused.status_code == 409
    assert "1000 bytes of tile.laz are here" in refused.json()["detail"]
    assert send(client, url, 1000, CONTENT[1000:]).status_code == 204
    assert client.get(f"/uploads/{url.rpartition('/')[2]}").json()["sha256"] == hashlib.sha256(CONTENT).hexdigest()


def test_a_finished_upload_takes_no_more_bytes(client: httpx.Client) -> None:
    url = begin(client)
    assert send(client, url, 0, CONTENT).status_code == 204
    assert send(client, url, len(CONTENT), b"more").status_code == 409
    assert send(client, url, len(CONTENT), b"").status_code == 204


def test_bytes_need_their_own_media_type(client: httpx.Client) -> None:
    assert send(client, begin(client), 0, CONTENT, **{"Content-Type": "text/plain"}).status_code == 415


def test_the_limit_of_other_bodies_does_not_hold_for_the_bytes(starting: Any) -> None:
    client = starting(max_body_bytes=1000).client
    assert send(client, begin(client), 0, CONTENT).status_code == 204


# --- checksums


@pytest.mark.parametrize("algorithm", ["sha1", "sha256"])
def test_damaged_bytes_are_refused_and_not_kept(client: httpx.Client, algorithm: str) -> None:
    url, digest = begin(client), base64.b64encode(hashlib.new(algorithm, CONTENT).digest()).decode()
    header = {"Upload-Checksum": f"{algorithm} {digest}"}
    refused = send(client, url, 0, b"x" + CONTENT[1:], **header)
    assert (refused.status_code, refused.json()["type"]) == (460, "urn:gablework:problem:wrong-checksum")
    assert offset(client, url) == 0
    assert send(client, url, 0, CONTENT, **header).status_code == 204


@pytest.mark.parametrize("header", ["md5 abcd", "sha1", "sha1 !", "sha1 AAAA", ""])
def test_a_checksum_that_cannot_be_checked_is_refused(client: httpx.Client, header: str) -> None:
    url = begin(client)
    assert send(client, url, 0, CONTENT[:10], **{"Upload-Checksum": header}).status_code == 400
    assert offset(client, url) == 0


def test_a_file_that_differs_from_its_promised_digest_is_removed(client: httpx.Client, local_service: Any) -> None:
    url = begin(client, **{"Upload-Metadata": metadata(sha256="0" * 64)})
    refused = send(client, url, 0, CONTENT)
    assert refused.status_code == 400
    assert hashlib.sha256(CONTENT).hexdigest() in refused.json()["detail"]
    assert names_in(local_service) == []
    assert client.head(url, headers=TUS).status_code == 404
    right = begin(client, **{"Upload-Metadata": metadata(sha256=hashlib.sha256(CONTENT).hexdigest().upper())})
    assert send(client, right, 0, CONTENT).status_code == 204


# --- what is refused, with nothing left behind


@pytest.mark.parametrize(
    ("headers", "status", "named"),
    [
        ({"Upload-Length": "2000000"}, 413, "GABLEWORK_MAX_UPLOAD_BYTES"),
        ({"Upload-Length": "-1"}, 400, "-1"),
        ({"Upload-Length": "many"}, 400, "many"),
        ({"Upload-Length": ""}, 400, "length"),
        ({"Upload-Metadata": ""}, 400, "filename"),
        ({"Upload-Metadata": metadata("a.exe")}, 400, "a.exe"),
        ({"Upload-Metadata": metadata("../..")}, 400, ".laz"),
        ({"Upload-Metadata": "filename ***"}, 400, "base64"),
        ({"Upload-Metadata": "filename /w=="}, 400, "UTF-8"),
        ({"Upload-Metadata": f"{metadata()},{metadata()}"}, 400, "twice"),
        ({"Upload-Metadata": metadata(sha256="abc")}, 400, "64 hexadecimal"),
        ({"Upload-Metadata": "x" * 5000}, 400, "4096"),
    ],
)
def test_an_upload_that_cannot_succeed_is_not_begun(
    starting: Any, headers: dict[str, str], status: int, named: str
) -> None:
    service = starting(max_upload_bytes=1_000_000)
    refused = service.client.post("/uploads/tus", headers={**creation(), **headers})
    assert refused.status_code == status
    assert named in refused.json()["detail"]
    assert names_in(service) == []


@pytest.mark.parametrize("upload_id", ["0" * 32, "..%2f..", "x", "%00"])
def test_an_unknown_upload_is_not_found(client: httpx.Client, upload_id: str) -> None:
    for method in ("HEAD", "PATCH", "DELETE"):
        answer = client.request(method, f"/uploads/tus/{upload_id}", headers={**PATCH, "Upload-Offset": "0"})
        assert answer.status_code in {404, 405}, method


def test_a_file_that_cannot_be_used_is_removed(client: httpx.Client, local_service: Any) -> None:
    bad = b"not a tile" * 100
    url = begin(client, **{"Upload-Length": str(len(bad))})
    assert send(client, url, 0, bad[:500]).status_code == 204
    refused = send(client, url, 500, bad[500:])
    assert (refused.status_code, refused.json()["type"]) == (422, "urn:gablework:problem:unusable-input")
    assert names_in(local_service) == []
    empty = client.post("/uploads/tus", headers=creation(0))
    assert empty.status_code == client.post("/uploads?filename=tile.laz", content=b"").status_code == 422
    assert names_in(local_service) == []


def test_more_bytes_than_announced_are_refused(client: httpx.Client, local_service: Any) -> None:
    def pieces() -> Iterator[bytes]:
        yield CONTENT + b"more"

    url = begin(client)
    assert send(client, url, 0, CONTENT + b"more").status_code == 413
    assert offset(client, url) == 0
    # without a length in the head it is seen only when it has come
    sent = client.patch(url, headers={**PATCH, "Upload-Offset": "0"}, content=pieces())
    assert sent.status_code == 413
    assert offset(client, url) <= len(CONTENT)


def test_a_key_has_a_limit_of_unfinished_uploads(starting: Any) -> None:
    service = starting(max_unfinished_uploads=2)
    urls = [begin(service.client) for _ in range(2)]
    refused = service.client.post("/uploads/tus", headers=creation())
    assert refused.status_code == 429
    assert "limit is 2" in refused.json()["detail"]
    assert send(service.client, urls[0], 0, CONTENT).status_code == 204
    begin(service.client)


def test_unfinished_uploads_count_for_the_quota_of_a_key(starting: Any) -> None:
    service = starting(max_upload_bytes_per_key=2 * len(CONTENT))
    owner = service.key(Scope.SUBMIT)
    urls = [begin(service.client, **owner) for _ in range(2)]
    refused = service.client.post("/uploads/tus", headers={**creation(), **owner})
    assert (refused.status_code, refused.json()["type"]) == (507, "urn:gablework:problem:quota-exceeded")
    assert send(service.client, urls[0], 0, CONTENT, **owner).status_code == 204
    assert service.client.post("/uploads/tus", headers={**creation(), **owner}).status_code == 507
    assert service.client.delete(urls[0], headers={**TUS, **owner}).status_code == 204
    begin(service.client, **owner)
    begin(service.client, **service.key(Scope.SUBMIT))


def test_an_upload_leaves_the_reserve_of_the_disk(starting: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    service = starting(reserve_bytes=1000)
    url = begin(service.client)
    monkeypatch.setattr(Disk, "free_bytes", property(lambda _self: 1000 + len(CONTENT) - 1))
    refused = service.client.post("/uploads/tus", headers=creation())
    assert (refused.status_code, refused.json()["type"]) == (507, "urn:gablework:problem:no-space")
    assert send(service.client, url, 0, CONTENT).status_code == 507
    assert offset(service.client, url) == 0
    assert send(service.client, url, 0, CONTENT[:1000]).status_code == 204


def test_only_its_owner_reaches_an_upload(local_service: Any) -> None:
    client, owner, other = local_service.client, local_service.key(Scope.SUBMIT), local_service.key(Scope.SUBMIT)
    url = begin(client, **owner)
    assert client.head(url, headers={**TUS, **other}).status_code == 404
    assert send(client, url, 0, CONTENT, **other).status_code == 404
    assert client.delete(url, headers={**TUS, **other}).status_code == 404
    assert client.post("/uploads/tus", headers=creation()).status_code == 401
    reader = local_service.key(Scope.READ)
    assert client.post("/uploads/tus", headers={**creation(), **reader}).status_code == 403
    assert send(client, url, 0, CONTENT, **owner).status_code == 204
    upload = f"/uploads/{url.rpartition('/')[2]}"
    assert (client.get(upload, headers=owner).status_code, client.get(upload, headers=other).status_code) == (200, 404)


# --- removal


def test_a_removed_upload_is_gone_finished_or_not(client: httpx.Client, local_service: Any) -> None:
    urls = [begin(client), begin(client)]
    assert send(client, urls[1], 0, CONTENT).status_code == 204
    for url in urls:
        assert client.delete(url, headers=TUS).status_code == 204
        assert client.head(url, headers=TUS).status_code == 404
    assert names_in(local_service) == []


def test_abandoned_uploads_expire_and_those_in_use_do_not(starting: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    service = starting(unfinished_upload_hours=2.0)
    folder, now = StateFolder(service.settings.state), service.store.now()
    abandoned, held, recent = (begin(service.client).rpartition("/")[2] for _ in range(3))
    expires = parsedate_to_datetime(service.client.head(f"/uploads/tus/{held}", headers=TUS).headers["upload-expires"])
    assert dt.timedelta(hours=1.9) < expires - now < dt.timedelta(hours=2.1)
    monkeypatch.setattr(service.store, "now", lambda: now + dt.timedelta(hours=1))
    assert send(service.client, f"/uploads/tus/{recent}", 0, b"x").status_code == 204
    monkeypatch.setattr(service.store, "now", lambda: now + dt.timedelta(hours=2.5))
    lock = Unfinished(folder, resumable.find(folder, held, None))
    assert [path.name for path in tidy_uploads(service.store, folder)] == [f".tus-{abandoned}"]
    lock.close()
    assert [path.name for path in tidy_uploads(service.store, folder)] == [f".tus-{held}"]
    assert names_in(service) == [f".tus-{recent}"]


@pytest.mark.parametrize("is_absent", [False, True])
def test_a_damaged_unfinished_upload_harms_no_other_and_is_removed(
    client: httpx.Client, local_service: Any, is_absent: bool
) -> None:
    folder = StateFolder(local_service.settings.state)
    url = begin(client)
    place = folder.uploads / f".tus-{url.rpartition('/')[2]}"
    if is_absent:
        # a half copy, in a backup that an earlier version made
        (place / "progress.json").unlink()
    else:
        for name in ("promise.json", "progress.json"):
            (place / name).write_bytes(b"")
    assert client.head(url, headers=TUS).status_code == 404
    assert offset(client, begin(client)) == 0
    assert tidy_uploads(local_service.store, folder) == [place]
