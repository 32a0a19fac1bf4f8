"""What the client does with refusals, foreign answers and services that are away; its URL and its key."""

import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import trustme
from client_site import Site
from hostile_host import hostile_host
from live_service import POINTS

from pipeline.errors import SettingsError
from service import client as api
from service.client import Client
from service.keys import Scope

# --- refusals, and services that are away


class Scripted:
    """A server that answers in turn as a script says, and counts."""

    def __init__(self, *answers: tuple[int, dict[str, str], bytes]) -> None:
        script, self.seen = list(answers), []
        self.methods: list[str] = []

        class Handler(BaseHTTPRequestHandler):
            def answer(handler) -> None:  # noqa: N805 - self is the script
                self.seen.append(handler.headers)
                self.methods.append(handler.command)
                status, headers, body = script.pop(0) if len(script) > 1 else script[0]
                if not status:
                    handler.close_connection = True
                    return
                handler.send_response(status)
                for name, value in {"Content-Length": str(len(body)), **headers}.items():
                    handler.send_header(name, value)
                handler.end_headers()
                handler.wfile.write(body)

            do_GET = do_POST = do_DELETE = answer  # noqa: N815 - names of the library

            def log_message(self, *_: object) -> None:
                """Print nothing."""

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def client(self, **options: Any) -> Client:
        return Client(self.url, notify=[].append, **options)


@pytest.fixture
def scripted() -> Iterator[Callable[..., Scripted]]:
    started = []

    def start(*given: tuple[int, dict[str, str], bytes]) -> Scripted:
        started.append(Scripted(*given))
        return started[-1]

    yield start
    for one in started:
        one.server.shutdown()
        one.server.server_close()


PROBLEM = {"Content-Type": "application/problem+json"}
JSON = {"Content-Type": "application/json"}
LOST = (0, {}, b"")
"""The connection is closed without an answer."""
NO_JOBS = (200, JSON, b'{"jobs": [], "links": []}')


def busy(status: int, **headers: str) -> tuple[int, dict[str, str], bytes]:
    return status, {**PROBLEM, **headers}, json.dumps({"status": status, "detail": f"busy {status}"}).encode()


@pytest.mark.parametrize("status", [429, 503, 507, 409, 423])
def test_a_service_that_says_when_is_asked_again_then(
    scripted: Callable[..., Scripted], monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    pauses: list[float] = []
    monkeypatch.setattr("service.client.transport.time.sleep", pauses.append)
    server = scripted(busy(status, **{"Retry-After": "7"}), busy(status, **{"Retry-After": "20"}), NO_JOBS)
    assert server.client().jobs() == []
    assert pauses == [7.0, 20.0]


def test_patience_has_an_end(scripted: Callable[..., Scripted]) -> None:
    with pytest.raises(api.BusyError, match=r"busy 503.*asks to wait 400 s.*patience is 300 s") as caught:
        scripted(busy(503, **{"Retry-After": "400"})).client().jobs()
    assert caught.value.status == 503
    with pytest.raises(api.BusyError, match="busy 429"):
        scripted(busy(429)).client(patience_s=0.0).jobs()
    for status in (507, 413, 422, 500):
        server = scripted(busy(status))
        with pytest.raises(api.RefusedError, match=f"busy {status}"):
            server.client().jobs()
        assert len(server.seen) == 1


def test_a_request_that_changes_something_is_not_repeated_blindly(scripted: Callable[..., Scripted]) -> None:
    server = scripted(busy(503, **{"Retry-After": "0"}), (201, JSON, b"{}"))
    with pytest.raises(api.BusyError):
        server.client().request("POST", "/webhooks", document={})
    assert len(server.seen) == 1


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ((404, {"Content-Type": "text/html"}, b"<h1>no</h1>"), "404 (text/html), which is not an answer of gablework"),
        ((200, {"Content-Type": "text/html"}, b"<h1>hello</h1>"), "200 (text/html)"),
        ((200, JSON, b"{"), "200 (application/json)"),
        ((200, JSON, b"{}"), "something else than jobs"),
        ((301, {"Location": "https://elsewhere.example/"}, b""), "redirects to https://elsewhere.example/"),
        ((500, {}, b""), "500 (without a media type)"),
    ],
)
def test_an_answer_of_something_else_is_recognised(
    scripted: Callable[..., Scripted], answer: tuple[int, dict[str, str], bytes], said: str
) -> None:
    with pytest.raises(api.ForeignAnswerError) as caught:
        scripted(answer).client().jobs()
    assert said in str(caught.value)


def test_a_message_that_is_no_event_is_recognised(scripted: Callable[..., Scripted]) -> None:
    stream = (200, {"Content-Type": "text/event-stream"}, b'id: 1\ndata: {"hello": 1}\n\n')
    with pytest.raises(api.ForeignAnswerError, match="something else than events"):
        list(scripted(stream).client().watch("0f" * 16))


@pytest.mark.parametrize("status", ["dismissed", "running"])
def test_a_cancellation_whose_answer_is_lost_is_sent_again_only_to_a_job_that_goes_on(
    scripted: Callable[..., Scripted], site: Site, status: str
) -> None:
    def job(status: str) -> tuple[int, dict[str, str], bytes]:
        found = site.client().job(site.echoed().job_id).document
        return 200, JSON, json.dumps({**found, "jobID": "0" * 32, "status": status}).encode()

    server = scripted(job("running"), LOST, job(status), job("dismissed"))
    assert server.client().cancel("0" * 32).status == "dismissed"
    # a second request would remove a job that is dismissed
    assert server.methods.count("DELETE") == (1 if status == "dismissed" else 2)


def test_a_service_that_never_answered_is_given_up_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    monkeypatch.setattr("service.client.session.time.monotonic", lambda: sum(pauses))
    monkeypatch.setattr("service.client.transport.time.sleep", pauses.append)
    with pytest.raises(api.UnreachableError, match=r"Check the URL") as caught:
        Client("http://127.0.0.1:1", notify=[].append).jobs()
    assert "127.0.0.1:1" in str(caught.value)
    assert sum(pauses) == pytest.approx(5.0)


def test_an_answer_that_trickles_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.client.transport.SLOW_S", 0.2)
    said = r"the answer came with less than 60000 bytes in 0\.2 s"
    with (
        hostile_host(pause_s=0.02) as host,
        Client(f"http://{host.origin}", patience_s=0.0) as client,
        pytest.raises(api.UnreachableError, match=said),
    ):
        client.request("GET", "/body/a.laz")


def test_keys_and_scopes_that_are_missing_are_explained(site: Site) -> None:
    reader, secret = site.key(Scope.READ), "gw_" + "A" * 43
    with pytest.raises(api.UnauthorizedError, match="GABLEWORK_KEY"):
        site.client().jobs()
    with pytest.raises(api.UnauthorizedError) as caught:
        site.client(key=secret).jobs()
    assert secret not in str(caught.value)
    with pytest.raises(api.ForbiddenError, match="scope submit"):
        site.client(key=reader).submit(site.file("points.xyz", POINTS))
    assert site.client(key=reader).jobs() == []


def test_a_certificate_must_be_trusted(scripted: Callable[..., Scripted], tmp_path: Path) -> None:
    import ssl

    authority = trustme.CA()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("127.0.0.1").configure_cert(context)
    server = scripted(NO_JOBS)
    server.server.socket = context.wrap_socket(server.server.socket, server_side=True)
    url = server.url.replace("http:", "https:")
    with pytest.raises(api.UnreachableError, match="certificate is not trusted"):
        Client(url, notify=[].append).jobs()
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    assert Client(url, ca=tmp_path / "ca.pem").jobs() == []
    with pytest.raises(SettingsError, match=r"no\.pem"):
        Client(url, ca=tmp_path / "no.pem")
    with pytest.raises(api.UnreachableError, match="begin the URL with http://"):
        Client(scripted(NO_JOBS).url.replace("http:", "https:"), notify=[].append).jobs()


# --- URL and key


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("models.example.org", "write it in full"),
        ("ftp://models.example.org", "write it in full"),
        ("http://", "write it in full"),
        ("http://models.example.org:port", "port"),
        ("https://me:secret@models.example.org", "leave them out"),
        ("https://models.example.org/?a=b", "end it with the path"),
    ],
)
def test_a_url_that_cannot_be_one_of_a_service_is_refused(url: str, said: str) -> None:
    with pytest.raises(SettingsError) as caught:
        Client(url)
    assert said in str(caught.value)
    assert "secret" not in str(caught.value)


def test_url_and_key_come_from_the_nearest_place(
    scripted: Callable[..., Scripted], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    server = scripted(NO_JOBS)
    (tmp_path / "key").write_text("gw_of-file\n")
    (tmp_path / "other").write_text("gw_of-other-file\n")
    monkeypatch.setenv("GABLEWORK_URL", f"{server.url}/")
    monkeypatch.setenv("GABLEWORK_KEY_FILE", str(tmp_path / "key"))
    Client().jobs()
    monkeypatch.setenv("GABLEWORK_KEY", "gw_of-environment")
    Client().jobs()
    Client(key_file=tmp_path / "other").jobs()
    Client(key="gw_given").jobs()
    keys = [headers["Authorization"].removeprefix("Bearer gw_") for headers in server.seen]
    assert keys == ["of-file", "of-environment", "of-other-file", "given"]


@pytest.mark.parametrize("text", ["", "two words", "gw_ü", "line\nline"])
def test_what_cannot_be_a_key_is_refused_without_repeating_it(tmp_path: Path, text: str) -> None:
    (tmp_path / "key").write_text(text)
    for options in ({"key": text}, {"key_file": tmp_path / "key"}):
        with pytest.raises(SettingsError, match="holds no key") as caught:
            Client(**options)
        assert not text or text not in str(caught.value)
    with pytest.raises(SettingsError, match="cannot be read"):
        Client(key_file=tmp_path / "nowhere")


def test_a_key_that_travels_without_encryption_is_reported() -> None:
    said: list[str] = []
    Client("http://127.0.0.1:1", key="gw_a", notify=said.append)
    Client("https://models.example.org", key="gw_a", notify=said.append)
    assert said == []
    Client("http://models.example.org", key="gw_a", notify=said.append)
    assert "without encryption" in said[0]
