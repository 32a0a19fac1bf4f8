"""Uploads: whole or not at all, counted and hashed on the way, under a name that cannot lead anywhere."""

import asyncio
import base64
import dataclasses
import datetime as dt
import errno
import hashlib
import json
import os
import threading
import time
import tracemalloc
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from finished_runs import problem as problem_of
from hypothesis import given
from hypothesis import strategies as st
from live_service import DEADLINE_S, POINTS, add_key, answer_to, las_bytes, raw_request, serving, settings_in
from processes import wait_for

from service import preflight, uploads
from service.deliveries import Delivery
from service.errors import NoSpaceError, RequestError, TooLargeError, TooManyUploadsError
from service.filenames import NAME_LIMIT, SUFFIXES, clean_filename
from service.files import StateFolder
from service.jobs import Upload
from service.keys import Scope
from service.settings import ServiceSettings
from service.uploads import TEMPORARY, receive, remove_leftovers

NOW = dt.datetime(2026, 3, 1, tzinfo=dt.UTC)


class FakeTable:
    """Keeps the records; fails on demand."""

    def __init__(self, fault: Exception | None = None) -> None:
        self.held: list[Upload] = []
        self.fault = fault

    def now(self) -> dt.datetime:
        return NOW

    def add_upload(self, upload: Upload) -> None:
        if self.fault is not None:
            raise self.fault
        self.held.append(upload)


async def pieces(content: bytes, size: int = 65_536, fault: BaseException | None = None) -> AsyncIterator[bytes]:
    for begin in range(0, len(content), size):
        yield content[begin : begin + size]
    if fault is not None:
        raise fault


def take(folder: Path, content: bytes, name: str = "tile.laz", **values: Any) -> Upload:
    return take_stream(folder, pieces(content, fault=values.pop("fault", None)), name, **values)


def take_stream(folder: Path, stream: AsyncIterator[bytes], name: str, **values: Any) -> Upload:
    """Keep what comes; `values` are a store, a promised hash, and settings."""
    store, sha256 = values.pop("store", FakeTable()), values.pop("sha256", None)
    kept = {"store": store, "folder": StateFolder(folder), "settings": ServiceSettings(state=folder, **values)}
    return asyncio.run(receive(stream, name, owner="1" * 32, sha256=sha256, **kept))


def files_in(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def eventually_empty(folder: Path) -> None:
    """Nothing is left behind, once the server has seen that the client has gone."""
    wait_for(lambda: not list(folder.iterdir()), "an empty folder")


# --- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "kept"),
    [
        ("tile.laz", "tile.laz"),
        ("../../../etc/cron.d/a.laz", "a.laz"),
        ("..\\..\\windows\\a.las", "a.las"),
        ("/abs/olute/a.ply", "a.ply"),
        ("C:\\a.xyz", "a.xyz"),
        ("a\0b.laz", "ab.laz"),
        ("a\nb\rc\x7f\u202egpj.laz", "abcgpj.laz"),
        ("....laz", None),
        (".laz", None),
        ("-rf.laz", "-rf.laz"),
        ("a:b*c?.copc.laz", "a_b_c_.copc.laz"),
        ("COM1.laz", "_COM1.laz"),
        ("nul.tar.las", "_nul.tar.las"),
        ("Straße 日本.LAZ", "Straße 日本.LAZ"),
        ("  . spaced . .geojson", "spaced.geojson"),
        ("a.laz/", None),
        ("a.rar", None),
        ("a.laz.exe", None),
        ("a.doc", None),
        ("", None),
        ("\ud800.laz", None),
    ],
)
def test_a_name_is_cleaned_or_refused_with_the_endings_that_are_taken(sent: str, kept: str | None) -> None:
    if kept is not None:
        assert clean_filename(sent) == kept
        return
    with pytest.raises(RequestError, match=r"\.las, \.laz, \.ply.*\.gpkg, \.geojson"):
        clean_filename(sent)


@given(st.text(max_size=300), st.sampled_from([*SUFFIXES, ""]))
def test_whatever_is_sent_the_name_stays_in_its_folder(stem: str, suffix: str) -> None:
    try:
        name = clean_filename(stem + suffix)
    except RequestError:
        return
    assert name == Path(name).name
    assert name not in {".", ".."}
    assert not set(name) & set('/\\\0<>:"|?*\n\r')
    assert len(name.encode()) <= NAME_LIMIT
    assert name.lower().endswith(SUFFIXES)
    assert not name.startswith(".")
    assert clean_filename(name) == name


# --- whole or not at all ---------------------------------------------------------------------------------------------


def test_an_upload_is_stored_under_its_id_with_its_hash_and_what_its_header_says(tmp_path: Path) -> None:
    content, store = las_bytes(500), FakeTable()
    upload = take(tmp_path, content, "../x/Tile 1.laz", store=store)
    assert store.held == [upload]
    assert (upload.filename, upload.size_bytes) == ("Tile 1.laz", len(content))
    assert upload.sha256 == hashlib.sha256(content).hexdigest()
    assert upload.expires_at == NOW + dt.timedelta(days=7)
    assert (tmp_path / "uploads" / upload.upload_id / "Tile 1.laz").read_bytes() == content
    assert upload.preflight["format"] == "laz"
    assert upload.preflight["pointCount"] == 500
    assert upload.preflight["crs"] == {"name": "Amersfoort / RD New", "epsg": 28992}
    assert upload.preflight["usable"] is True
    x_min, y_min, _, x_max, y_max, _ = upload.preflight["bounds"]
    assert 84_000 <= x_min < x_max <= 84_100
    assert 447_000 <= y_min < y_max <= 447_100
    json.dumps(dict(upload.preflight), allow_nan=False)


def test_one_byte_more_than_the_limit_is_refused_and_the_limit_itself_is_not(tmp_path: Path) -> None:
    content = las_bytes(100)
    take(tmp_path / "fits", content, max_upload_bytes=len(content))
    with pytest.raises(TooLargeError, match=rf"more than {len(content) - 1} bytes.*GABLEWORK_MAX_UPLOAD_BYTES"):
        take(tmp_path / "not", content, max_upload_bytes=len(content) - 1)
    assert files_in(tmp_path / "not") == []


def test_an_endless_upload_is_cut_off_at_the_limit(tmp_path: Path) -> None:
    sent = 0

    async def endless() -> AsyncIterator[bytes]:
        nonlocal sent
        while True:
            sent += 65_536
            yield b"\0" * 65_536

    with pytest.raises(TooLargeError):
        take_stream(tmp_path, endless(), "a.laz", max_upload_bytes=5_000_000)
    assert sent < 5_000_000 + 2 * uploads.BLOCK_BYTES
    assert files_in(tmp_path) == []


@pytest.mark.parametrize("fault", [ConnectionResetError(), RuntimeError("a fault"), asyncio.CancelledError()])
def test_whatever_breaks_off_the_stream_nothing_is_left_behind(tmp_path: Path, fault: BaseException) -> None:
    store = FakeTable()
    with pytest.raises(type(fault)):
        take(tmp_path, las_bytes(10_000), store=store, fault=fault)
    assert store.held == []
    eventually_empty(tmp_path / "uploads")


def test_a_record_that_cannot_be_kept_takes_its_file_with_it(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="no database"):
        take(tmp_path, las_bytes(10), store=FakeTable(RuntimeError("no database")))
    assert list((tmp_path / "uploads").iterdir()) == []


def test_a_full_disk_is_reported_as_such_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: object, block: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(uploads._Sink, "write", full)
    with pytest.raises(NoSpaceError, match=r"no room on the disk for tile\.laz\. Remove finished jobs or uploads"):
        take(tmp_path, las_bytes(10))
    assert list((tmp_path / "uploads").iterdir()) == []


def test_a_geographic_crs_is_taken_and_reported_for_a_job_may_name_another(tmp_path: Path) -> None:
    upload = take(tmp_path, las_bytes(10, crs="EPSG:4326"))
    assert upload.preflight["usable"] is False
    assert "is geographic" in upload.preflight["problems"][0]
    assert upload.preflight["pointCount"] == 10


def test_a_large_upload_is_never_held_in_memory(tmp_path: Path) -> None:
    row = b"84000.00 447000.00 12.34\n"
    content_bytes, held = 150 << 20, row * 40_000

    async def rows() -> AsyncIterator[bytes]:
        sent = 0
        while sent < content_bytes:
            sent += len(held)
            for begin in range(0, len(held), 65_536):
                yield held[begin : begin + 65_536]

    tracemalloc.start()
    try:
        upload = take_stream(tmp_path, rows(), "rows.xyz")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert upload.size_bytes >= content_bytes
    assert peak < 12 << 20
    assert upload.preflight["bounds"] is None
    assert "the job reads it through" in upload.preflight["warnings"][0]


def test_what_a_dead_process_left_behind_is_cleared_and_what_is_being_written_is_not(tmp_path: Path) -> None:
    folder = StateFolder(tmp_path)
    kept = take(tmp_path, las_bytes(10))
    old, new = (folder.uploads / f"{TEMPORARY}{digit * 32}" for digit in "ab")
    for path in (old, new):
        path.mkdir()
        (path / "a.laz").write_bytes(b"half")
    long_ago_s = time.time() - 7200.0
    for path in (old / "a.laz", old):
        os.utime(path, (long_ago_s, long_ago_s))
    assert remove_leftovers(folder, now_s=time.time(), stale_s=3600.0) == [old]
    assert sorted(folder.uploads.iterdir()) == sorted([new, folder.upload(kept.upload_id)])


# --- over HTTP -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> ServiceSettings:
    return settings_in(tmp_path_factory.mktemp("uploads"), max_upload_bytes=2_000_000)


@pytest.fixture(scope="module")
def url(settings: ServiceSettings) -> Iterator[str]:
    with serving(settings) as found:
        yield found


@pytest.fixture
def client(url: str) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=url, timeout=DEADLINE_S) as found:
        yield found


def problem(response: httpx.Response) -> str:
    assert response.headers["content-type"] == "application/problem+json"
    document = response.json()
    assert document["status"] == response.status_code
    return str(document["detail"])


def test_a_body_is_stored_answered_with_its_place_and_found_there(client: httpx.Client) -> None:
    content = las_bytes(300)
    answer = client.post("/uploads", params={"filename": "a b.laz"}, content=content)
    assert answer.status_code == 201
    reported = answer.json()
    assert reported["filename"] == "a b.laz"
    assert reported["bytes"] == len(content)
    assert reported["sha256"] == hashlib.sha256(content).hexdigest()
    assert reported["preflight"]["pointCount"] == 300
    assert dt.datetime.fromisoformat(reported["created"]) < dt.datetime.fromisoformat(reported["expires"])
    assert client.get(answer.headers["location"]).json() == reported
    assert reported in client.get("/uploads").json()["uploads"]
    assert client.delete(answer.headers["location"]).status_code == 204
    assert client.get(answer.headers["location"]).status_code == 404


@pytest.mark.parametrize(
    ("headers", "name"),
    [
        ({"Content-Disposition": 'attachment; filename="tile 7.laz"'}, "tile 7.laz"),
        ({"Content-Disposition": "attachment; filename*=UTF-8''Stra%C3%9Fe.laz"}, "Straße.laz"),
        ({"X-Filename": "Stra%C3%9Fe.laz"}, "Straße.laz"),
        ({"X-Filename": "..%2F..%2Fetc%2Fa.laz"}, "a.laz"),
        ({"Content-Disposition": 'attachment; filename="../../a.laz"'}, "a.laz"),
    ],
)
def test_a_header_can_name_the_file(client: httpx.Client, headers: dict[str, str], name: str) -> None:
    assert client.post("/uploads", headers=headers, content=las_bytes(10)).json()["filename"] == name


def test_a_form_with_one_file_is_taken_too(client: httpx.Client) -> None:
    answer = client.post("/uploads", files={"file": ("a.laz", las_bytes(20))})
    assert answer.status_code == 201
    assert answer.json()["preflight"]["pointCount"] == 20


def test_a_form_that_is_more_or_less_than_one_file_is_refused_and_leaves_nothing(
    client: httpx.Client, settings: ServiceSettings
) -> None:
    before = sorted(StateFolder(settings.state).uploads.iterdir())
    two = [("file", ("a.laz", las_bytes(20))), ("file", ("b.laz", las_bytes(20)))]
    assert "send one file" in problem(client.post("/uploads", files=two))
    assert "send one file" in problem(client.post("/uploads", files={"tile": ("a.laz", las_bytes(20))}))
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    assert "the form has no file" in problem(client.post("/uploads", headers=headers, content=b"--x--\r\n"))
    cut = b'--x\r\nContent-Disposition: form-data; name="file"; filename="a.laz"\r\n\r\n' + las_bytes(20)
    assert client.post("/uploads", headers=headers, content=cut).status_code == 400
    after_part = cut + b"\r\n--x\r\nContent-Disposition: form-data; na"
    assert client.post("/uploads", headers=headers, content=after_part).status_code == 400
    assert sorted(StateFolder(settings.state).uploads.iterdir()) == before


@pytest.mark.parametrize("header", ["Content-Digest", "Repr-Digest"])
def test_a_digest_header_is_checked(client: httpx.Client, header: str) -> None:
    content = las_bytes(10)
    right = base64.b64encode(hashlib.sha256(content).digest()).decode()
    wrong = base64.b64encode(hashlib.sha256(b"").digest()).decode()

    def post(value: str) -> httpx.Response:
        return client.post("/uploads?filename=a.laz", headers={header: value}, content=content)

    assert post(f"sha-256=:{right}:").status_code == 201
    assert post(f"sha-512=:AAAA:, sha-256=:{right}:").status_code == 201
    assert post("md5=:AAAA:").status_code == 201
    assert post(f"sha-256=:{wrong}:").status_code == 400
    assert post("sha-256=:AAAA:").status_code == 400


@pytest.mark.parametrize("encoding", ["gzip", "br", "deflate", "GZIP", "gzip, identity"])
def test_an_encoded_body_is_refused_for_it_could_grow(client: httpx.Client, encoding: str) -> None:
    answer = client.post("/uploads?filename=a.laz", headers={"Content-Encoding": encoding}, content=las_bytes(10))
    assert answer.status_code == 415
    assert "send the body as it is" in problem(answer)


def test_the_answer_to_a_body_without_a_name_or_with_another_ending_names_what_is_accepted(
    client: httpx.Client,
) -> None:
    assert "?filename=" in problem(client.post("/uploads", content=las_bytes(10)))
    answer = client.post("/uploads?filename=a.rar", content=b"Rar!")
    assert answer.status_code == 400
    assert ".laz" in problem(answer)


@pytest.mark.parametrize(
    ("name", "content", "status"),
    [
        ("a.laz", b"", 422),
        ("a.laz", b"LASF", 422),
        ("a.xyz", b"no numbers here\n" * 100, 422),
        ("a.geojson", b"[]", 422),
        ("a.gpkg", b"SQLite format 3\0" + b"\0" * 100, 422),
        ("a.laz", b"PK\x03\x04" * 30, 422),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_and_not_kept(
    client: httpx.Client, settings: ServiceSettings, name: str, content: bytes, status: int
) -> None:
    before = sorted(StateFolder(settings.state).uploads.iterdir())
    answer = client.post("/uploads", params={"filename": name}, content=content)
    assert answer.status_code == status
    assert str(settings.state) not in problem(answer)
    assert sorted(StateFolder(settings.state).uploads.iterdir()) == before


def test_a_body_that_says_it_is_too_long_is_refused_before_it_is_sent(url: str) -> None:
    with raw_request(url, "POST /uploads?filename=a.laz", Content_Length="999999999999") as link:
        assert link.recv(100).startswith(b"HTTP/1.1 413")


def test_a_client_that_goes_away_leaves_nothing_behind(tmp_path: Path) -> None:
    settings = settings_in(tmp_path)
    with serving(settings) as url:
        folder = StateFolder(settings.state).uploads
        body = b"\0" * 3_000_000
        with raw_request(url, "POST /uploads?filename=a.laz", body, Content_Length="9000000"):
            wait_for(lambda: list(folder.glob(f"{TEMPORARY}*/a.laz")), "the beginning of an upload")
        eventually_empty(folder)


@pytest.mark.parametrize(
    "upload_id",
    [
        "0" * 32,
        "%2e%2e",
        "%2e%2e%2f%2e%2e%2fetc%2fpasswd",
        "..%5c..%5cservice.db",
        "%00",
        "a%00b",
        "%2fetc%2fpasswd",
        f".tmp-{'0' * 32}",
        "%F0%9F%92%A9",
        "*",
        "'%20OR%201=1--",
        "A" * 32,
        "0" * 5000,
    ],
)
@pytest.mark.parametrize("method", ["GET", "DELETE"])
def test_an_id_that_is_none_of_ours_is_not_found_and_never_a_path(
    client: httpx.Client, upload_id: str, method: str
) -> None:
    answer = client.request(method, f"/uploads/{upload_id}")
    assert answer.status_code in {404, 405}
    assert "root:" not in answer.text


def test_a_path_with_dots_is_sent_as_it_is_and_finds_nothing(url: str) -> None:
    """Clients tidy such paths; a raw socket does not."""
    for path in (
        "/uploads/..",
        "/uploads/../../../../etc/passwd",
        "/uploads/..%2f..%2f..%2fetc%2fpasswd",
        "//etc/passwd",
        "/viewer/assets/../../../../etc/passwd",
        "/viewer/assets/..%2f..%2f..%2f..%2fetc%2fpasswd",
        "/viewer/assets/%2e%2e/%2e%2e/settings.py",
        "/jobs/..%2f..%2fservice.db/results",
        "/jobs/%2e%2e/results/buildings",
    ):
        answer = answer_to(url, f"GET {path}")
        assert answer.split(b" ", 2)[1] in {b"400", b"404", b"405"}, path
        assert b"root:" not in answer
        assert b"SQLite" not in answer
        assert b"ServiceSettings" not in answer


def test_half_a_character_in_a_request_is_refused_and_reported(client: httpx.Client) -> None:
    body = b'{"inputs": {"tiles": [], "settings": {"\\ud800": 1}, "\\udfff": "\\ud800"}}'
    answer = client.post("/processes/reconstruct/execution", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 400
    assert "?" in problem(answer)


def test_keys_see_their_own_uploads_and_an_admin_all(tmp_path: Path) -> None:
    settings = settings_in(tmp_path)
    scopes = {"one": Scope.SUBMIT, "two": Scope.SUBMIT, "reader": Scope.READ, "admin": Scope.ADMIN}
    headers = {name: {"Authorization": add_key(settings, scope)[1]} for name, scope in scopes.items()}
    content = las_bytes(10)
    with serving(settings) as url, httpx.Client(base_url=url, timeout=DEADLINE_S) as client:
        assert client.post("/uploads?filename=a.laz", content=content).status_code == 401
        refused = client.post("/uploads?filename=a.laz", content=content, headers=headers["reader"])
        assert refused.status_code == 403
        assert "submit" in problem(refused)
        place = client.post("/uploads?filename=a.laz", content=content, headers=headers["one"]).headers["location"]
        statuses = {name: client.get(place, headers=headers[name]).status_code for name in scopes}
        assert statuses == {"one": 200, "two": 404, "reader": 404, "admin": 200}
        seen = {name: len(client.get("/uploads", headers=headers[name]).json()["uploads"]) for name in scopes}
        assert seen == {"one": 1, "two": 0, "reader": 0, "admin": 1}
        assert client.delete(place, headers=headers["two"]).status_code == 404
        assert client.delete(place, headers=headers["reader"]).status_code == 403
        assert client.delete(place, headers=headers["admin"]).status_code == 204


def test_a_client_is_refused_before_its_body_is_stored(tmp_path: Path) -> None:
    settings = settings_in(tmp_path)
    add_key(settings, Scope.SUBMIT)
    with serving(settings) as url:
        with raw_request(url, "POST /uploads?filename=a.laz", Content_Length="9000000") as link:
            assert link.recv(100).startswith(b"HTTP/1.1 401")
        assert list(StateFolder(settings.state).uploads.iterdir()) == []


def test_a_small_file_does_not_wait_for_large_ones_that_are_read_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preflight, "QUICK_BYTES", 100)
    large, reading, done = pieces_of_text(50), threading.Event(), threading.Event()

    def examine(path: Path, max_points: int) -> dict[str, Any]:
        if path.stat().st_size > 100 and path.suffix == ".xyz":
            reading.set()
            assert done.wait(DEADLINE_S), "the small files waited for the large one"
        return {"kind": "points"}

    monkeypatch.setattr(uploads, "preflight", examine)
    kept = {"store": FakeTable(), "folder": StateFolder(tmp_path), "settings": ServiceSettings(state=tmp_path)}

    async def send_all() -> None:
        slow = [asyncio.create_task(receive(pieces(large), f"{number}.xyz", owner=None, **kept)) for number in range(3)]
        await asyncio.get_running_loop().run_in_executor(None, reading.wait, DEADLINE_S)
        await receive(pieces(pieces_of_text(1)), "small.xyz", owner=None, **kept)
        await receive(pieces(las_bytes(500)), "large.laz", owner=None, **kept)
        done.set()
        await asyncio.gather(*slow)

    asyncio.run(send_all())


def pieces_of_text(lines: int) -> bytes:
    return b"1.0 2.0 3.0\n" * lines


@pytest.mark.parametrize(("turn_s", "pauses"), [(0.0015, []), (0.02, [pytest.approx(0.2)])])
def test_uploads_pause_while_the_service_is_busy(turn_s: float, pauses: list[Any]) -> None:
    slept = []

    async def run() -> None:
        loop, sleep = asyncio.get_running_loop(), asyncio.sleep
        now_s = 100.0

        async def pause(seconds: float) -> None:
            nonlocal now_s
            if seconds:
                slept.append(seconds)
            await sleep(0.0)
            now_s += turn_s

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(loop, "time", lambda: now_s)
            patch.setattr(uploads.asyncio, "sleep", pause)
            await uploads.make_way()

    asyncio.run(run())
    assert slept == pauses


def test_many_uploads_at_once_are_each_stored_once(tmp_path: Path) -> None:
    settings, content, answers = settings_in(tmp_path), las_bytes(2000), []
    with serving(settings) as url:

        def send(number: int) -> None:
            answers.append(httpx.post(f"{url}/uploads?filename={number}.laz", content=content, timeout=DEADLINE_S))

        threads = [threading.Thread(target=send, args=(number,)) for number in range(20)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [answer.status_code for answer in answers] == [201] * 20
        assert len(httpx.get(f"{url}/uploads").json()["uploads"]) == 20
    assert len(files_in(StateFolder(settings.state).uploads)) == 20


def test_a_key_has_a_number_of_uploads(starting) -> None:
    service = starting(max_uploads_per_key=2)
    mine, others = service.key(Scope.SUBMIT), service.key(Scope.SUBMIT)
    first = service.upload(**mine)
    service.upload(**mine)

    def refused(answer: httpx.Response) -> None:
        assert "2 uploads, which is the limit" in problem_of(answer, 429, "too-many-uploads")
        assert int(answer.headers["retry-after"]) > 0

    refused(service.client.post("/uploads?filename=b.xyz", content=POINTS, headers=mine))
    refused(service.client.post("/jobs", data={"crs": "EPSG:28992"}, files={"tile": ("a.xyz", POINTS)}, headers=mine))
    tus = {"Tus-Resumable": "1.0.0", "Upload-Length": "5", "Upload-Metadata": "filename cG9pbnRzLnh5eg=="}
    refused(service.client.post("/uploads/tus", headers={**tus, **mine}))
    assert len(list((service.settings.state / "uploads").iterdir())) == 2
    service.upload(**others)
    assert service.client.delete(f"/uploads/{first}", headers=mine).status_code == 204
    assert service.client.post("/uploads/tus", headers={**tus, **mine}).status_code == 201
    refused(service.client.post("/uploads/tus", headers={**tus, **mine}))


def test_the_number_of_uploads_is_checked_where_they_are_stored(starting) -> None:
    service = starting()
    stored = service.store.upload(service.upload())
    more = [dataclasses.replace(stored, upload_id=f"{n:032x}") for n in range(2)]
    with pytest.raises(TooManyUploadsError, match="2 uploads"):
        service.store.add_uploads(Delivery(uploads=more, max_uploads=2))
    service.store.add_uploads(Delivery(uploads=more[:1], max_uploads=2))
    assert len(service.store.upload_ids()) == 2
