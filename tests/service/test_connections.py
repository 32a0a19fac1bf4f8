"""Connections: answers are not held back; clients that are silent or too slow do not stay, slow honest ones do."""

import contextlib
import heapq
import itertools
import json
import socket
import threading
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
import uvicorn
from hypothesis import given
from hypothesis import strategies as st
from live_service import DEADLINE_S, answer_to, raw_request, serving, settings_in
from processes import wait_for
from starlette.types import Receive, Scope, Send
from tus_client import begin, offset_once_free
from uvicorn.server import ServerState

from service.connections import KEEP_ALIVE_S, TimedConnection, listen, server_config
from service.crowd import SPARE, Crowd
from service.settings import ServiceSettings

IMPATIENT_S = 0.05
LINE = b"POST /uploads?filename=a.xyz HTTP/1.1\r\nHost: 127.0.0.1\r\n"
HEAD = LINE + b"Content-Length: 1000000000\r\n\r\n"
GET = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
LIMITS = ServiceSettings()
"""The defaults; the times below are of a clock that is set by hand."""


# --- without a network and without a clock ---------------------------------------------------------------------------


class HandLoop:
    """An event loop whose time is set by hand; it starts no task."""

    def __init__(self) -> None:
        self._now_s = 1000.0
        self._order = itertools.count()
        self._due: list[tuple[float, int, HandTimer]] = []

    def time(self) -> float:
        return self._now_s

    def call_later(self, delay_s: float, call: Callable[..., None], *args: object) -> "HandTimer":
        timer = HandTimer(lambda: call(*args))
        heapq.heappush(self._due, (self._now_s + delay_s, next(self._order), timer))
        return timer

    def create_task(self, work: Coroutine[Any, Any, Any], **_options: object) -> "HandLoop":
        work.close()
        return self

    def add_done_callback(self, _call: Callable[..., None]) -> None:
        """Of the task: it is never done."""

    def pass_s(self, seconds: float) -> None:
        """Let time pass."""
        end_s = self._now_s + seconds
        while self._due and self._due[0][0] <= end_s:
            self._now_s, _, timer = heapq.heappop(self._due)
            timer.run()
        self._now_s = end_s


class HandTimer:
    """A call that waits."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._call: Callable[[], None] | None = call

    def cancel(self) -> None:
        self._call = None

    def run(self) -> None:
        if self._call is not None:
            self._call()


class HandTransport:
    """A transport that keeps what is written."""

    def __init__(self) -> None:
        self.written = b""
        self.unread = 0
        self.ended: str | None = None

    def get_extra_info(self, name: str) -> object:
        return ("192.0.2.7", 4000) if name == "peername" else None

    def write(self, data: bytes) -> None:
        self.written += data

    def get_write_buffer_size(self) -> int:
        return self.unread

    def is_closing(self) -> bool:
        return self.ended is not None

    def close(self) -> None:
        self.ended = self.ended or "closed"

    def abort(self) -> None:
        self.ended = "aborted"

    def pause_reading(self) -> None:
        """Nothing reads."""

    resume_reading = pause_reading


class ByHand:
    """A connection with the default limits."""

    def __init__(self, crowd: Crowd | None = None) -> None:
        self.loop = HandLoop()
        self.transport = HandTransport()
        config = uvicorn.Config(self._app, log_config=None, timeout_keep_alive=KEEP_ALIVE_S)
        self.connection = TimedConnection(
            config, ServerState(), {}, self.loop, settings=LIMITS, crowd=crowd or Crowd(LIMITS)
        )
        self.connection.connection_made(self.transport)  # type: ignore[arg-type]

    async def _app(self, _scope: Scope, _receive: Receive, _send: Send) -> None:
        """Is never run."""

    def send(self, data: bytes) -> None:
        """Send as a client; the application reads at once."""
        self.connection.data_received(data)
        if self.connection.cycle is not None:
            self.connection.cycle.body.clear()
            self.connection.flow.resume_reading()

    def ends_within(self, limit_s: float) -> bool:
        """Whether it is open until the limit, but not much longer."""
        self.loop.pass_s(0.99 * limit_s)
        was_open = self.transport.ended is None
        self.loop.pass_s(0.06 * limit_s + 1.0)
        return was_open and self.transport.ended is not None

    @property
    def answer(self) -> tuple[bytes, str]:
        """Status line of what was answered, and the detail of the problem."""
        head, _, body = self.transport.written.partition(b"\r\n\r\n")
        return head.partition(b"\r\n")[0], json.loads(body)["detail"]


def test_a_client_that_sends_nothing_is_disconnected_without_a_word() -> None:
    link = ByHand()
    assert link.ends_within(LIMITS.max_head_s)
    assert link.transport.written == b""


def test_a_head_must_be_complete_in_time_however_often_a_byte_comes() -> None:
    link = ByHand()
    for byte in GET[:19]:
        link.send(bytes([byte]))
        link.loop.pass_s(1.0)
    assert link.ends_within(LIMITS.max_head_s - 19.0)
    assert link.answer == (
        b"HTTP/1.1 408 Request Timeout",
        "the head of the request did not arrive within 20 s: send it again, faster",
    )


def test_a_body_that_stops_ends_after_half_a_minute() -> None:
    link = ByHand()
    link.send(HEAD + b"1 2 3\n" * 10_000)
    assert link.ends_within(LIMITS.silent_s)
    status, detail = link.answer
    assert status == b"HTTP/1.1 408 Request Timeout"
    assert detail.startswith("no byte of the body arrived within 30 s")
    assert link.connection.cycle.disconnected


@pytest.mark.parametrize("chunked", [False, True])
def test_a_body_that_trickles_ends_after_a_minute(chunked: bool) -> None:
    link = ByHand()
    link.send(LINE + b"Transfer-Encoding: chunked\r\n\r\n" if chunked else HEAD)
    for _ in range(59):
        link.send(b"1\r\nx\r\n" if chunked else b"x")
        link.loop.pass_s(1.0)
    assert link.ends_within(LIMITS.slow_s - 59.0)
    assert "less than 1000 bytes per second over 60 s" in link.answer[1]


@given(st.floats(2000.0, 20_000.0), st.lists(st.floats(0.01, 25.0), min_size=1, max_size=60))
def test_a_slow_honest_upload_may_last_for_ever(rate: float, pauses_s: list[float]) -> None:
    link = ByHand()
    link.send(HEAD)
    for pause_s in pauses_s:
        link.loop.pass_s(pause_s)
        link.send(b"\0" * int(rate * pause_s))
    assert link.transport.ended is None


@given(st.floats(10.0, 950.0), st.floats(0.1, 5.0))
def test_an_upload_below_the_lowest_rate_ends(rate: float, pause_s: float) -> None:
    link = ByHand()
    link.send(HEAD)
    passed_s = 0.0
    while link.transport.ended is None and passed_s < 100.0:
        link.loop.pass_s(pause_s)
        passed_s += pause_s
        if link.transport.ended is None:
            link.send(b"\0" * int(rate * pause_s))
    assert LIMITS.slow_s <= passed_s <= LIMITS.slow_s + 2.0 * pause_s + 1.1


def test_a_client_does_not_pay_for_a_service_that_is_slow_itself() -> None:
    link = ByHand()
    link.connection.data_received(HEAD + b"\0" * 100_000)
    assert link.connection.flow.read_paused
    link.loop.pass_s(1000.0)
    assert link.transport.ended is None
    link.connection.flow.resume_reading()
    assert link.ends_within(LIMITS.silent_s)


def test_a_client_that_waits_for_leave_to_send_is_not_slow() -> None:
    link = ByHand()
    link.send(LINE + b"Content-Length: 1000000\r\nExpect: 100-continue\r\n\r\n")
    link.loop.pass_s(1000.0)
    assert link.transport.ended is None


def test_an_idle_connection_has_the_time_of_keep_alive() -> None:
    link = ByHand()
    link.send(GET)
    answered(link)
    assert link.ends_within(KEEP_ALIVE_S)


def test_a_part_of_a_head_after_an_answer_has_the_time_of_a_head() -> None:
    link = ByHand()
    link.send(GET)
    answered(link)
    link.loop.pass_s(KEEP_ALIVE_S - 1.0)
    link.send(GET[:9])
    assert link.ends_within(LIMITS.max_head_s)


def test_a_request_that_came_with_the_one_before_has_limits_too() -> None:
    link = ByHand()
    link.send(GET + HEAD + b"1 2 3\n")
    link.loop.pass_s(1000.0)
    assert link.transport.ended is None, "an answer may take its time"
    answered(link)
    assert link.ends_within(LIMITS.silent_s)


def test_the_rest_of_a_body_that_is_answered_already_has_a_minute() -> None:
    link = ByHand()
    link.send(HEAD)
    answered(link)
    for _ in range(59):
        link.send(b"\0" * 50_000)
        link.loop.pass_s(1.0)
    assert link.ends_within(LIMITS.slow_s - 59.0)
    assert link.transport.written.count(b"HTTP/1.1") == 1


def test_a_client_that_does_not_read_is_cut_off() -> None:
    link = ByHand()
    link.send(GET)
    link.transport.unread = 100_000
    link.connection.pause_writing()
    assert link.ends_within(LIMITS.unread_s)
    assert link.transport.ended == "aborted", "to close it would wait for the client"


@pytest.mark.parametrize(("rate", "is_open"), [(2000, True), (500, False)])
def test_a_client_that_reads_slowly_stays_above_the_lowest_rate(rate: int, is_open: bool) -> None:
    link = ByHand()
    link.send(GET)
    link.transport.unread = 10_000_000
    link.connection.pause_writing()
    for _ in range(20):
        # systems take bytes in steps of more than a minute's worth
        link.loop.pass_s(60.0)
        link.transport.unread -= 60 * rate
    assert (link.transport.ended is None) == is_open


def test_a_client_that_has_caught_up_is_watched_no_longer() -> None:
    link = ByHand()
    link.send(GET)
    link.connection.pause_writing()
    link.loop.pass_s(LIMITS.unread_s - 1.0)
    link.connection.resume_writing()
    link.loop.pass_s(1000.0)
    assert link.transport.ended is None


def answered(link: ByHand) -> None:
    """Send the answer as the application would."""

    def run(step: Coroutine[Any, Any, None]) -> None:
        with pytest.raises(StopIteration):
            step.send(None)

    run(link.connection.cycle.send({"type": "http.response.start", "status": 204, "headers": []}))
    run(link.connection.cycle.send({"type": "http.response.body", "body": b""}))


# --- how many --------------------------------------------------------------------------------------------------------


class Member:
    """A connection."""

    def __init__(self) -> None:
        self.has_ended = False

    def give_way(self) -> None:
        self.has_ended = True


def members_of(crowd: Crowd, count: int, address: str = "192.0.2.1", *, idle: bool = False) -> list[Member]:
    """So many new connections."""
    made = [Member() for _ in range(count)]
    for member in made:
        assert crowd.enter(member, address)
        if idle:
            crowd.idles(member)
    return made


def test_above_the_limit_the_one_that_was_idle_longest_goes() -> None:
    crowd = Crowd(ServiceSettings(max_connections=3))
    first, second, third = members_of(crowd, 3, idle=True)
    crowd.works(first)
    crowd.idles(first)
    members_of(crowd, 1)
    assert [one.has_ended for one in (first, second, third)] == [False, True, False]
    assert crowd.count == 3


def test_without_idle_ones_a_few_more_are_taken_and_the_rest_is_turned_away() -> None:
    crowd = Crowd(ServiceSettings(max_connections=3))
    busy = members_of(crowd, 3 + SPARE)
    assert not crowd.enter(Member(), "192.0.2.1")
    for member in busy:
        crowd.leave(member)
        crowd.leave(member)
    assert crowd.count == 0
    members_of(crowd, 3 + SPARE)


def refused_of(crowd: Crowd, members: list[Member]) -> int:
    """How many get no answer except to /healthz."""
    app = Endless()
    return sum(crowd.app_for(member, app) is not app for member in members)


def test_one_address_cannot_take_all_connections() -> None:
    crowd = Crowd(ServiceSettings(max_connections=100, max_connections_per_address=5))
    busy = members_of(crowd, 5, "2001:db8::1")
    more = members_of(crowd, 3, "2001:db8::2")
    assert refused_of(crowd, [*busy, *more]) == 3, "of one network"
    assert refused_of(crowd, members_of(crowd, 5, "2001:db8:1::1")) == 0


def test_an_address_with_too_many_idle_connections_loses_its_own() -> None:
    crowd = Crowd(ServiceSettings(max_connections=100, max_connections_per_address=5))
    others = members_of(crowd, 5, "192.0.2.2", idle=True)
    own = members_of(crowd, 5, idle=True)
    new = members_of(crowd, 1)
    assert [one.has_ended for one in own] == [True, False, False, False, False]
    assert not any(one.has_ended for one in others)
    assert refused_of(crowd, new) == 0


def test_many_connections_do_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    crowd = Crowd(ServiceSettings(max_connections=5))
    for _ in range(10):
        for member in members_of(crowd, 10):
            crowd.leave(member)
    assert caplog.text.count("too many connections: 6, of them 6 from 192.0.2.1") == 1


@pytest.mark.parametrize("idle", [True, False])
def test_there_is_always_room_to_ask_for_the_health(idle: bool) -> None:
    crowd = Crowd(ServiceSettings(max_connections=50, max_connections_per_address=20))
    for flood in range(100):
        # those that are refused get their answer, or wait for a request that never comes
        for member in members_of(crowd, 10, f"192.0.2.{flood % 3}"):
            if idle or refused_of(crowd, [member]):
                crowd.idles(member)
        asking = Member()
        assert crowd.enter(asking, "192.0.2.0")
        crowd.leave(asking)


def test_files_are_left_for_all_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("resource.getrlimit", lambda _: (256, 4096))
    assert Crowd(ServiceSettings()).most == 128


# --- over a network --------------------------------------------------------------------------------------------------


def connected(url: str) -> socket.socket:
    parts = urlsplit(url)
    return socket.create_connection((parts.hostname, parts.port), timeout=DEADLINE_S)


def received(client: socket.socket) -> bytes:
    """All that comes until the server ends the connection."""
    content = b""
    with contextlib.suppress(ConnectionResetError):
        while piece := client.recv(65_536):
            content += piece
    return content


def test_an_answer_does_not_wait_for_the_client_to_acknowledge_its_first_half(tmp_path: Path) -> None:
    listening, url = listen(settings_in(tmp_path, port=0))
    with listening, connected(url), listening.accept()[0] as accepted:
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_the_system_ends_event_streams_whose_clients_are_gone(tmp_path: Path) -> None:
    listening, url = listen(settings_in(tmp_path, port=0, unread_s=7.5))
    with listening, connected(url), listening.accept()[0] as accepted:
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 7500


@pytest.mark.parametrize("sent", [b"", GET[:30]], ids=["nothing", "half a head"])
def test_a_client_that_does_not_finish_its_request_is_disconnected(sent: bytes, tmp_path: Path) -> None:
    with serving(settings_in(tmp_path, max_head_s=IMPATIENT_S)) as url, connected(url) as client:
        client.sendall(sent)
        assert received(client).partition(b"\r\n")[0] == (b"HTTP/1.1 408 Request Timeout" if sent else b"")


FORM = b'--x\r\nContent-Disposition: form-data; name="tiles"; filename="a.xyz"\r\n\r\n1 2 3\n'


@pytest.mark.parametrize(
    "sent",
    [
        LINE + b"Content-Length: 1000\r\n\r\n1 2 3\n",
        LINE.replace(b"uploads?filename=a.xyz", b"jobs")
        + b"Content-Type: multipart/form-data; boundary=x\r\nContent-Length: 1000\r\n\r\n"
        + FORM,
        LINE.replace(b"uploads?filename=a.xyz", b"processes/reconstruct/execution")
        + b"Content-Type: application/json\r\nContent-Length: 1000\r\n\r\n{",
    ],
    ids=["file", "form", "document"],
)
def test_a_body_that_stops_is_disconnected_and_leaves_nothing(sent: bytes, tmp_path: Path) -> None:
    settings = settings_in(tmp_path, silent_s=IMPATIENT_S)
    with serving(settings) as url, connected(url) as client:
        client.sendall(sent)
        assert received(client).startswith(b"HTTP/1.1 408 ")
        wait_for(lambda: not list((settings.state / "uploads").iterdir()), "the removal")


def test_a_part_of_a_resumable_upload_that_stops_is_kept(tmp_path: Path) -> None:
    settings = settings_in(tmp_path, silent_s=0.5)
    with serving(settings) as url, httpx.Client(base_url=url, timeout=DEADLINE_S) as web:
        place = urlsplit(begin(web)).path
        with raw_request(
            url,
            f"PATCH {place}",
            b"1 2 3\n",
            Tus_Resumable="1.0.0",
            Upload_Offset="0",
            Content_Type="application/offset+octet-stream",
            Content_Length="1000",
        ) as client:
            assert received(client).startswith(b"HTTP/1.1 408 ")
        assert offset_once_free(web, place) == 6


def test_a_slow_client_may_go_on_as_long_as_it_sends(tmp_path: Path) -> None:
    with serving(settings_in(tmp_path)) as url, connected(url) as client:
        for byte in GET:
            client.sendall(bytes([byte]))
        assert client.recv(65_536).startswith(b"HTTP/1.1 200")


def test_the_health_of_a_full_service_can_be_asked(tmp_path: Path) -> None:
    settings = settings_in(tmp_path, max_connections_per_address=1)
    with serving(settings) as url, connected(url) as client:
        client.sendall(HEAD + b"1 2 3\n")
        wait_for(lambda: list((settings.state / "uploads").iterdir()), "the upload")
        assert answer_to(url, "GET /healthz").startswith(b"HTTP/1.1 200")
        refused = answer_to(url, "GET /jobs")
    assert refused.startswith(b"HTTP/1.1 503")
    assert b"retry-after: 5" in refused.lower()
    assert b"the limits are" in refused


class Endless:
    """An application that sends for ever, until its client is gone."""

    def __init__(self) -> None:
        self.ended = threading.Event()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        await send({"type": "http.response.start", "status": 200, "headers": []})
        is_gone = False
        await receive()
        while not is_gone:
            await send({"type": "http.response.body", "body": b"\0" * 65_536, "more_body": True})
            is_gone = bool(getattr(send, "__self__").disconnected)  # noqa: B009 - the cycle of the server
        self.ended.set()


@contextlib.contextmanager
def serving_app(app: Any, settings: ServiceSettings) -> Iterator[str]:
    """The URL of any application behind our connections."""
    listener, url = listen(settings)
    with listener:
        server = uvicorn.Server(server_config(app, settings, lifespan="off"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            wait_for(lambda: server.started, "the start of the server")
            yield url
        finally:
            server.should_exit = True
            thread.join(DEADLINE_S)


def test_a_download_that_is_not_read_ends(tmp_path: Path) -> None:
    app = Endless()
    with serving_app(app, settings_in(tmp_path, port=0, unread_s=0.2)) as url, connected(url) as client:
        client.sendall(GET)
        assert app.ended.wait(DEADLINE_S)
