"""Inputs by upload, path and URL: nothing is read that is not allowed, at submission and again when the job runs."""

from __future__ import annotations

import dataclasses
import datetime as dt
import gzip
import hashlib
import http.server
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_service import las_bytes

from pipeline.errors import InputError, RunCancelledError, UnreadableInputError
from pipeline.runtime.monitoring.progress import Progress
from pipeline.runtime.request import plan_inputs
from service import downloads
from service.downloads import BACKOFF, PASSING, pause_s
from service.driver.attempt import run_request
from service.errors import InputRefusedError, NoSuchUploadError, RequestError, ServiceError, TooLargeError
from service.fetching import Fetched, JobFiles, gather, materialise, resolve_inputs
from service.files import StateFolder
from service.input_policy import checked_path
from service.jobs import InputReference, JobRequest, Upload
from service.settings import ServiceSettings

NOW = dt.datetime(2026, 3, 1, tzinfo=dt.UTC)
MINE, OTHERS = "1" * 32, "2" * 32


class FakeTable:
    """Uploads in a dictionary."""

    def __init__(self) -> None:
        self.held: dict[str, Upload] = {}

    def upload(self, upload_id: str, *, owner: str | None = None) -> Upload:
        found = self.held.get(upload_id)
        if found is None or (owner is not None and found.owner != owner):
            raise NoSuchUploadError(f"there is no upload {upload_id}")
        return found


class World:
    """A state folder with uploads, a root with files, and settings."""

    server = ""
    """The URL of a server, if there is one."""
    answers: type[Answers]
    """What it answers, and what it saw."""

    def __init__(self, folder: Path, **values: Any) -> None:
        self.root = folder / "tiles"
        self.root.mkdir()
        self.outside = folder / "outside"
        self.outside.mkdir()
        self.folder = StateFolder(folder / "state")
        self.store = FakeTable()
        self.target = folder / "inputs"
        chosen: dict[str, Any] = {"state": self.folder.root, "input_roots": (self.root,)} | values
        self.settings = ServiceSettings(**chosen)

    @property
    def known(self) -> dict[str, Any]:
        return {"store": self.store, "folder": self.folder, "settings": self.settings}

    def add_upload(self, filename: str = "a.laz", content: bytes = b"", *, owner: str = MINE, **reported: Any) -> str:
        upload_id = f"{len(self.store.held) + 10:032x}"
        place = self.folder.upload(upload_id)
        place.mkdir(parents=True)
        content = content or las_bytes(100)
        (place / filename).write_bytes(content)
        self.store.held[upload_id] = Upload(
            upload_id=upload_id,
            owner=owner,
            filename=filename,
            size_bytes=len(content),
            sha256=hashlib.sha256(content).hexdigest(),
            created_at=NOW,
            expires_at=NOW + dt.timedelta(days=7),
            preflight={"kind": "points", "pointCount": 100, "problems": []} | reported,
        )
        return upload_id

    def add_file(self, name: str = "a.laz", content: bytes = b"", *, outside: bool = False) -> Path:
        path = (self.outside if outside else self.root) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content or las_bytes(100))
        return path

    def resolve(self, *tiles: InputReference, owner: str | None = MINE, **values: Any) -> None:
        request = JobRequest(tiles=tiles, **values)
        resolve_inputs(request, owner=owner, **self.known)

    def materialise(self, reference: InputReference, cancelled: Callable[[], bool] = lambda: False) -> Fetched:
        return materialise(reference, target=self.target, cancelled=cancelled, **self.known)

    def fetched(self, path: str, cancelled: Callable[[], bool] = lambda: False) -> Fetched:
        """From the server."""
        return self.materialise(url(f"{self.server}/{path}"), cancelled)

    def refuses(self, reference: InputReference, kind: type[ServiceError], match: str) -> None:
        """At submission and when it runs."""
        with pytest.raises(kind, match=match):
            self.resolve(reference)
        with pytest.raises(kind, match=match):
            self.materialise(reference)


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


def upload(value: str) -> InputReference:
    return InputReference(kind="upload", value=value)


def path(value: Path | str) -> InputReference:
    return InputReference(kind="path", value=str(value))


def url(value: str) -> InputReference:
    return InputReference(kind="url", value=value)


# --- uploads ---------------------------------------------------------------------------------------------------------


def test_an_upload_of_ones_own_is_taken_where_it_lies(world: World) -> None:
    upload_id = world.add_upload()
    world.resolve(upload(upload_id))
    found = world.materialise(upload(upload_id))
    assert found.path == world.folder.upload(upload_id) / "a.laz"
    assert (found.points, found.sha256) == (100, world.store.held[upload_id].sha256)


def test_an_upload_of_another_key_does_not_exist(world: World) -> None:
    upload_id = world.add_upload(owner=OTHERS)
    with pytest.raises(RequestError, match="there is no upload"):
        world.resolve(upload(upload_id))
    world.resolve(upload(upload_id), owner=None)


def test_an_upload_whose_file_is_gone_or_cut_counts_as_gone(world: World) -> None:
    upload_id = world.add_upload()
    file = world.folder.upload(upload_id) / "a.laz"
    file.write_bytes(file.read_bytes()[:-1])
    for _ in range(2):
        with pytest.raises(RequestError, match=r"is gone: upload a\.laz again"):
            world.resolve(upload(upload_id))
        with pytest.raises(NoSuchUploadError, match="is gone"):
            world.materialise(upload(upload_id))
        file.unlink(missing_ok=True)


def test_points_are_no_footprints_and_footprints_no_points(world: World) -> None:
    points, outlines = world.add_upload("a.laz"), world.add_upload("b.gpkg")
    world.resolve(upload(points), footprints=upload(outlines))
    with pytest.raises(RequestError, match=r"b\.gpkg' is not a point cloud.*a\.laz' is not a file of footprints"):
        world.resolve(upload(outlines), footprints=upload(points))


def test_guides_are_checked_like_footprints_and_must_be_lines(world: World) -> None:
    tile = upload(world.add_upload("a.laz"))
    line = b'{"type": "LineString", "coordinates": [[1, 1], [9, 1]]}'
    polygons, lines, both = (
        upload(world.add_upload(f"{'_'.join(shapes)}.geojson", line, shapes=shapes))
        for shapes in (["polygons"], ["lines"], ["polygons", "lines"])
    )
    world.resolve(tile, footprints=polygons, guides=lines)
    world.resolve(tile, footprints=both, guides=both)
    with pytest.raises(RequestError, match=r"a\.laz' is not a file of guides: its name must end in \.gpkg"):
        world.resolve(tile, guides=tile)
    with pytest.raises(RequestError, match=r"polygons\.geojson' is not a file of guides: it holds polygons, not lines"):
        world.resolve(tile, guides=polygons)
    with pytest.raises(
        RequestError, match=r"lines\.geojson' is not a file of footprints: it holds lines, not polygons"
    ):
        world.resolve(tile, footprints=lines)
    request = JobRequest(tiles=(tile,), footprints=polygons, guides=lines)
    found = gather(request, target=world.target, cancelled=lambda: False, **world.known)
    assert [file.reference for file in found.all] == [tile, polygons, lines]
    assert set(request.upload_ids) == {tile.value, polygons.value, lines.value}


def test_a_problem_that_a_crs_heals_is_reported_unless_a_crs_is_given(world: World) -> None:
    upload_id = world.add_upload(problems=["the CRS is geographic. Give crs"])
    with pytest.raises(RequestError, match=r"a\.laz\): the CRS is geographic"):
        world.resolve(upload(upload_id))
    world.resolve(upload(upload_id), crs="EPSG:28992")


def test_points_of_all_inputs_together_are_limited(tmp_path: Path) -> None:
    world = World(tmp_path, max_points=250)
    uploads = [upload(world.add_upload()) for _ in range(3)]
    world.resolve(*uploads[:2])
    # The same tile twice is one tile.
    world.resolve(*uploads[:2], uploads[0])
    with pytest.raises(TooLargeError, match="300 points together, this service takes 250 per job"):
        world.resolve(*uploads)
    with pytest.raises(TooLargeError):
        world.resolve(*uploads[:2], path(world.add_file("b.laz")))
    request = JobRequest(tiles=tuple(uploads))
    with pytest.raises(TooLargeError):
        gather(request, target=world.target, cancelled=lambda: False, **world.known)


def test_inputs_are_counted(tmp_path: Path) -> None:
    world = World(tmp_path, max_inputs=2)
    uploads = [upload(world.add_upload()) for _ in range(3)]
    with pytest.raises(TooLargeError, match="names 3 inputs, this service takes 2"):
        world.resolve(*uploads)


def test_all_faults_are_reported_at_once(world: World) -> None:
    with pytest.raises(RequestError) as caught:
        world.resolve(upload("0" * 32), path("/etc/passwd"), url("https://example.org/a.laz"), path("relative.laz"))
    assert len(caught.value.faults) == 4


# --- paths -----------------------------------------------------------------------------------------------------------


def test_a_file_below_a_root_is_read_in_place(world: World) -> None:
    file = world.add_file("deep/er/a.laz")
    world.resolve(path(file))
    found = world.materialise(path(file))
    assert (found.path, found.points, found.sha256) == (file, 100, None)


@pytest.mark.parametrize(
    "value",
    [
        "/etc/passwd",
        "/etc/shadow.laz",
        "{root}/../outside/a.laz",
        "{root}/deep/../../outside/a.laz",
        "{root}/link/a.laz",
        "{root}/link.laz",
        "{root}/chain.laz",
        "{root}",
        "{root}/",
        "{root}/.",
        "{root}x/a.laz",
        "/proc/self/environ",
        "/dev/zero",
        "//etc/passwd",
        "{root}/no/../../such/a.laz",
    ],
)
def test_a_path_that_leads_out_of_the_roots_is_refused_without_a_word_about_it(world: World, value: str) -> None:
    secret = world.add_file("a.laz", outside=True)
    (world.root / "deep").mkdir()
    (world.root / "link").symlink_to(world.outside)
    (world.root / "link.laz").symlink_to(secret)
    (world.root / "chain.laz").symlink_to(world.root / "link.laz")
    beside = world.root.with_name(world.root.name + "x")
    beside.mkdir()
    (beside / "a.laz").write_bytes(las_bytes(10))
    world.refuses(path(value.format(root=world.root)), InputRefusedError, "is not below a folder from which inputs")


@pytest.mark.parametrize("value", ["a.laz", "../a.laz", "", "~/a.laz", "file:///etc/passwd", "/tiles/a\0.laz"])
def test_a_path_that_is_not_absolute_is_refused(world: World, value: str) -> None:
    world.refuses(path(value), InputRefusedError, "is not an absolute path")


def test_without_roots_no_path_is_read(tmp_path: Path) -> None:
    world = World(tmp_path, input_roots=())
    world.refuses(path(world.add_file()), InputRefusedError, r"\(none\): upload the file, or add its folder")


def test_a_root_that_is_a_link_and_a_link_within_a_root_are_followed(tmp_path: Path) -> None:
    world = World(tmp_path)
    file = world.add_file()
    (world.root / "b.laz").symlink_to(file)
    linked = tmp_path / "linked"
    linked.symlink_to(world.root)
    world.settings = ServiceSettings(state=world.folder.root, input_roots=(linked,))
    for name in ("a.laz", "b.laz"):
        assert world.materialise(path(linked / name)).path == file


def test_a_link_that_is_turned_away_after_the_submission_is_refused_when_the_job_runs(world: World) -> None:
    inside, outside = world.add_file(), world.add_file("a.laz", outside=True)
    link = world.root / "current.laz"
    link.symlink_to(inside)
    world.resolve(path(link))
    link.unlink()
    link.symlink_to(outside)
    with pytest.raises(InputRefusedError):
        world.materialise(path(link))


def test_what_is_no_file_is_refused_without_waiting_for_it(world: World) -> None:
    os.mkfifo(world.root / "pipe.laz")
    (world.root / "folder.laz").mkdir()
    for name in ("pipe.laz", "folder.laz"):
        with pytest.raises(UnreadableInputError, match="not a file"):
            checked_path(str(world.root / name), world.settings)
    with pytest.raises(RequestError, match="cannot be read"):
        world.resolve(path(world.root / "missing.laz"))


def test_a_file_that_is_swapped_while_it_is_looked_at_is_refused(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    file, secret = world.add_file(), world.add_file("secret.laz", outside=True)
    opened = os.open

    def swap_then_open(*args: Any, **values: Any) -> int:
        file.unlink(missing_ok=True)
        file.hardlink_to(secret)
        handle = opened(*args, **values)
        file.unlink()
        file.write_bytes(las_bytes(10))
        return handle

    monkeypatch.setattr(os, "open", swap_then_open)
    with pytest.raises(InputRefusedError, match="changes while it is checked"):
        checked_path(str(file), world.settings)


def test_a_damaged_file_below_a_root_is_reported_when_it_is_submitted(world: World) -> None:
    with pytest.raises(RequestError, match="truncated"):
        world.resolve(path(world.add_file("a.laz", las_bytes(10)[:200])))


def test_a_shapefile_is_taken_by_path_only(world: World) -> None:
    points = path(world.add_file())
    world.resolve(points, footprints=path(world.add_file("b.shp", b"\0\0\x27\x0a")))
    world.settings = ServiceSettings(state=world.folder.root, input_hosts=("example.org",))
    with pytest.raises(RequestError, match="a Shapefile is several files"):
        world.resolve(footprints=url("https://example.org/b.shp"))


# --- URLs ------------------------------------------------------------------------------------------------------------


class Answers(http.server.BaseHTTPRequestHandler):
    """Answers by the first part of the path."""

    content = las_bytes(100)
    seen: ClassVar[list[tuple[str, dict[str, str]]]] = []
    failures: ClassVar[dict[str, int]] = {}
    elsewhere = ""
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self.seen.append((self.path, dict(self.headers)))
        word, _, rest = self.path.lstrip("/").partition("/")
        getattr(self, f"_{word}")(rest)

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def _send(self, status: int, body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | headers).items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def _good(self, _rest: str) -> None:
        self._send(200, self.content)

    def _status(self, rest: str) -> None:
        self._send(int(rest.split("/", maxsplit=1)[0]))

    def _busy(self, rest: str) -> None:
        left = self.failures[rest] = self.failures.get(rest, 2) - 1
        if left >= 0:
            self._send(503, Retry_After="0")
        else:
            self._good(rest)

    def _hop(self, rest: str) -> None:
        count, _, name = rest.partition("/")
        self._send(302, Location=f"/hop/{int(count) - 1}/{name}" if int(count) else f"/good/{name}")

    def _away(self, _rest: str) -> None:
        self._send(302, Location=f"{self.elsewhere}/good/a.laz", Set_Cookie="a=b")

    def _file(self, _rest: str) -> None:
        self._send(302, Location="file:///etc/passwd")

    def _nowhere(self, _rest: str) -> None:
        self._send(302)

    def _gzip(self, _rest: str) -> None:
        self._send(200, gzip.compress(b"\0" * 50_000_000), Content_Encoding="gzip")

    def _secretly(self, _rest: str) -> None:
        # A gzip file without the header that would make a client unpack it.
        self._send(200, gzip.compress(b"\0" * 50_000_000))

    def _endless(self, _rest: str) -> None:
        self.send_response(200)
        self.send_header("Transfer-Encoding", "chunked")
        self.end_headers()
        try:
            while True:
                self.wfile.write(b"10000\r\n" + b"\0" * 0x10000 + b"\r\n")
        except OSError:
            self.close_connection = True

    def _cut(self, _rest: str) -> None:
        self.send_response(200)
        self.send_header("Content-Length", str(len(self.content)))
        self.end_headers()
        self.wfile.write(self.content[:100])
        self.close_connection = True

    def _boastful(self, _rest: str) -> None:
        self.send_response(200)
        self.send_header("Content-Length", "999999999999")
        self.end_headers()
        self.close_connection = True


@pytest.fixture
def server() -> Iterator[tuple[str, type[Answers]]]:
    """A server on loopback: its URL, and what it saw."""
    handler = type("TheseAnswers", (Answers,), {"seen": [], "failures": {}})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as listener:
        listener.daemon_threads = True
        thread = threading.Thread(target=listener.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{listener.server_port}", handler
        listener.shutdown()
        thread.join()


@pytest.fixture
def web(tmp_path: Path, server: tuple[str, type[Answers]], monkeypatch: pytest.MonkeyPatch) -> World:
    """A world that may fetch from the server, and does not wait long between tries."""
    monkeypatch.setattr(downloads, "BACKOFF", dataclasses.replace(BACKOFF, first_s=0.01))
    world = World(tmp_path, input_hosts=(server[0],), max_upload_bytes=1_000_000)
    world.server, world.answers = server
    return world


def left_of(world: World) -> list[Path]:
    return [file for file in world.target.rglob("*") if file.is_file()]


def test_a_url_is_fetched_as_it_is_with_its_hash(web: World) -> None:
    place = f"{web.server}/good/tile%201.laz?token=secret"
    web.resolve(url(place))
    found = web.materialise(url(place))
    assert found.path.read_bytes() == Answers.content
    assert found.path.name == "tile 1.laz"
    assert found.path.is_relative_to(web.target)
    assert (found.points, found.sha256) == (100, hashlib.sha256(Answers.content).hexdigest())
    ((_, headers),) = web.answers.seen
    assert headers["Accept-Encoding"] == "identity"
    assert not {"Cookie", "Authorization"} & set(headers)


def test_nothing_is_fetched_when_a_job_is_submitted(web: World) -> None:
    web.resolve(url(f"{web.server}/good/a.laz"))
    assert web.answers.seen == []


@pytest.mark.parametrize("name", ["a.zip", "", "a", "..", "%2e%2e", "a.laz%00.exe", "a.laz/"])
def test_a_url_whose_name_ends_in_no_format_is_refused(web: World, name: str) -> None:
    with pytest.raises(RequestError):
        web.resolve(url(f"{web.server}/good/{name}"))


@pytest.mark.parametrize("name", ["..%2f..%2f..%2fa.laz", "%2fetc%2fa.laz", "..%5c..%5ca.laz", "a%00.laz", "%0aa.laz"])
def test_a_url_cannot_name_a_place_on_our_disk(web: World, name: str) -> None:
    found = web.fetched(f"good/{name}")
    assert found.path.name == "a.laz"
    assert found.path.parent.parent == web.target


def test_redirects_are_followed_within_the_list_and_not_for_ever(web: World) -> None:
    assert web.fetched("hop/2/a.laz").points == 100
    with pytest.raises(UnreadableInputError, match="redirects more than 3 times"):
        web.fetched("hop/9/a.laz")


@pytest.mark.parametrize("word", ["away", "file", "nowhere"])
def test_a_redirect_to_another_place_is_refused_before_it_is_asked(web: World, word: str) -> None:
    class Other(Answers):
        seen: ClassVar[list[tuple[str, dict[str, str]]]] = []

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Other) as listener:
        thread = threading.Thread(target=listener.serve_forever)
        thread.start()
        web.answers.elsewhere = f"http://127.0.0.1:{listener.server_port}"
        with pytest.raises((InputRefusedError, UnreadableInputError)):
            web.fetched(f"{word}/a.laz")
        listener.shutdown()
        thread.join()
    assert Other.seen == []
    assert left_of(web) == []


def test_a_compressed_answer_is_refused_and_never_unpacked(web: World) -> None:
    with pytest.raises(UnreadableInputError, match="with the encoding 'gzip'"):
        web.fetched("gzip/a.laz")
    with pytest.raises(UnreadableInputError, match="gzip file: unpack it first"):
        web.fetched("secretly/a.laz")
    assert all(file.stat().st_size < 1_000_000 for file in left_of(web))


@pytest.mark.parametrize("word", ["endless", "boastful"])
def test_an_answer_that_is_too_long_is_cut_off(web: World, word: str) -> None:
    with pytest.raises(TooLargeError, match=r"bytes or more, this service takes 1000000"):
        web.fetched(f"{word}/a.laz")
    assert left_of(web) == []


def test_a_busy_server_is_asked_again_and_a_refusing_one_is_not(web: World) -> None:
    assert web.fetched("busy/a.laz").points == 100
    assert len(web.answers.seen) == 3
    web.answers.seen.clear()
    with pytest.raises(UnreadableInputError, match="the server answers 404"):
        web.fetched("status/404/a.laz")
    assert len(web.answers.seen) == 1


def test_an_answer_that_breaks_off_is_requested_again_and_then_reported(web: World) -> None:
    with pytest.raises(UnreadableInputError, match=r"does not answer .* \(tried 4 times\)"):
        web.fetched("cut/a.laz")
    assert len(web.answers.seen) == BACKOFF.attempts
    assert left_of(web) == []


def test_an_absent_server_is_reported_without_the_secrets_in_the_url(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(downloads, "BACKOFF", dataclasses.replace(BACKOFF, first_s=0.01))
    world = World(tmp_path, input_hosts=("http://127.0.0.1:9",))
    with pytest.raises(UnreadableInputError, match="does not answer") as caught:
        world.materialise(url("http://127.0.0.1:9/a.laz?signature=secret"))
    assert "secret" not in str(caught.value)


def test_a_job_that_is_called_off_stops_fetching(web: World) -> None:
    web.settings = ServiceSettings(state=web.folder.root, input_hosts=(web.server,))
    with pytest.raises(RunCancelledError):
        web.fetched("endless/a.laz", lambda: any(file.stat().st_size for file in left_of(web)))
    assert left_of(web) == []


def test_a_job_that_is_called_off_does_not_wait_for_the_next_try(web: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(downloads, "BACKOFF", dataclasses.replace(BACKOFF, first_s=3600.0, longest_s=3600.0))
    with pytest.raises(RunCancelledError):
        web.fetched("status/503/a.laz", lambda: bool(web.answers.seen))


def test_proxies_and_passwords_of_the_environment_are_not_used(
    web: World, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    netrc = tmp_path / "netrc"
    netrc.write_text("machine 127.0.0.1 login me password secret\n")
    netrc.chmod(0o600)
    monkeypatch.setenv("NETRC", str(netrc))
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:9")
    monkeypatch.setenv("ALL_PROXY", "http://127.0.0.1:9")
    assert web.fetched("good/a.laz").points == 100
    assert "Authorization" not in web.answers.seen[0][1]


def test_too_many_points_are_refused_after_fetching(web: World) -> None:
    web.settings = ServiceSettings(state=web.folder.root, input_hosts=(web.server,), max_points=99)
    web.resolve(url(f"{web.server}/good/a.laz"))
    with pytest.raises(TooLargeError, match="has 100 points, this service takes 99"):
        web.fetched("good/a.laz")


@given(st.integers(1, 20), st.none() | st.integers(100, 599), st.none() | st.text(max_size=12))
def test_pauses_are_bounded_and_only_for_what_may_pass(
    attempt: int, status: int | None, retry_after: str | None
) -> None:
    wait_s = pause_s(attempt, status=status, retry_after=retry_after)
    assert (wait_s is not None) == (attempt < 4 and (status is None or status in PASSING))
    assert wait_s is None or 0.0 < wait_s <= BACKOFF.longest_s


def test_a_server_that_asks_for_patience_gets_it_within_reason() -> None:
    assert pause_s(1, status=429, retry_after="7") == 7.0
    assert pause_s(1, status=429, retry_after="9" * 400) == BACKOFF.longest_s
    assert pause_s(1, status=429, retry_after="Wed, 21 Oct 2026 07:28:00 GMT") == 1.0


def test_a_tile_that_reads_as_a_tile_index_leads_nowhere(tmp_path: Path) -> None:
    secret = tmp_path / "others.laz"
    secret.write_bytes(b"LASF")
    tile = tmp_path / "tiles.txt"
    tile.write_text(f"{secret}\ns3://bucket/others.laz\n")
    fetched = Fetched(reference=InputReference(kind="upload", value="u"), path=tile, points=0, sha256=None)
    request = run_request(JobRequest(tiles=()), JobFiles(tiles=[fetched]), tmp_path / "run", ServiceSettings())
    with pytest.raises(InputError, match=r"tiles\.txt: ") as refused:
        plan_inputs(request, Progress(lambda _: None))
    assert "others.laz" not in str(refused.value)


LAYERS = {
    "kind": "footprints",
    "shapes": ["polygons"],
    "layers": ["houses", "sheds"],
    "problems": ["2 layers: give one"],
}


def test_a_layer_that_an_upload_does_not_have_is_refused_with_its_layers(world: World) -> None:
    tile, given = upload(world.add_upload()), upload(world.add_upload("a.gpkg", b"x", pointCount=None, **LAYERS))
    world.resolve(tile, footprints=given, footprints_layer="sheds")
    with pytest.raises(RequestError, match="2 layers: give one"):
        world.resolve(tile, footprints=given)
    with pytest.raises(RequestError, match=r"footprintsLayer: .* has no layer 'barns': name one of houses, sheds"):
        world.resolve(tile, footprints=given, footprints_layer="barns")
