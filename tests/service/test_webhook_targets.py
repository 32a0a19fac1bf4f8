"""Where webhooks may go, and that the connection leads nowhere else."""

import contextlib
import ipaddress
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from typing import Any

import anyio
import httpcore
import pytest
import trustme
from live_service import DEADLINE_S
from webhook_receiver import receiving

from service import webhook_targets
from service.app import start
from service.driver import run_driver
from service.errors import StartUpError, TargetRefusedError
from service.settings import ServiceSettings
from service.store import JobStore
from service.webhook_targets import SendError, check_receiver, checked_receiver, is_public, post

PUBLIC = "93.184.216.34"
LOOK_UP = socket.getaddrinfo
HEAD = {"Content-Type": "application/json"}


def settings(*hosts: str) -> ServiceSettings:
    return ServiceSettings(webhook_hosts=hosts)


def send(url: str, *hosts: str) -> tuple[int, str | None]:
    return post(url, headers=HEAD, body=b"{}", settings=settings(*hosts))


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[list[str]]]:
    """Addresses of names, one list per look-up; the last one stays."""
    found: dict[str, list[list[str]]] = {}

    def look_up(host: str, port: int, *rest: Any, **more: Any) -> Any:
        if host not in found:
            return LOOK_UP(host, port, *rest, **more)
        answers = found[host]
        addresses = answers.pop(0) if len(answers) > 1 else answers[0]
        if not addresses:
            raise socket.gaierror("unknown name")
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port)) for address in addresses]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    return found


@pytest.mark.parametrize(
    "address",
    [
        *("127.0.0.1", "127.8.8.8", "10.1.2.3", "172.16.0.1", "192.168.1.1", "169.254.169.254", "0.0.0.0", "0.1.2.3"),
        *("100.64.0.1", "192.0.2.1", "198.18.0.1", "203.0.113.9", "224.0.0.1", "240.0.0.1", "255.255.255.255"),
        *("::", "::1", "fe80::1", "fc00::1", "fd12::1", "ff02::1", "2001:db8::1", "fec0::1"),
        *(
            "::ffff:127.0.0.1",
            "::ffff:10.0.0.1",
            "2002:7f00:1::",
            "2002:a00:1::",
            "64:ff9b::7f00:1",
            "64:ff9b:1::a00:1",
        ),
        *("2001:0:4136:e378:8000:63bf:3fff:fdd2", "::127.0.0.1"),
    ],
)
def test_an_address_that_is_not_public_is_refused(address: str) -> None:
    assert not is_public(ipaddress.ip_address(address))
    host = f"[{address}]" if ":" in address else address
    with pytest.raises(TargetRefusedError, match=r"not a public address.*GABLEWORK_WEBHOOK_HOSTS"):
        checked_receiver(f"https://{host}/hook", settings())


@pytest.mark.parametrize("address", ["8.8.8.8", PUBLIC, "2606:4700::1111", "::ffff:8.8.8.8"])
def test_a_public_address_is_allowed(address: str) -> None:
    assert is_public(ipaddress.ip_address(address))


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("http://hooks.example.org/", "webhooks go over https"),
        ("ftp://hooks.example.org/", "not a URL that can be called"),
        ("file:///etc/passwd", "not a URL that can be called"),
        ("hooks.example.org", "not a URL that can be called"),
        ("https://", "not a URL that can be called"),
        ("https://hooks.example.org/\r\nX: y", "not a URL that can be called"),
        ("https://" + "a" * 5000, "not a URL that can be called"),
        ("https://me:secret@hooks.example.org/", "contains a user or password"),
        ("https://hooks.example.org:99999/", "not a URL that can be called"),
    ],
)
def test_a_url_that_cannot_be_called_is_refused(url: str, words: str) -> None:
    with pytest.raises(TargetRefusedError, match=words) as raised:
        checked_receiver(url, settings())
    assert "secret" not in str(raised.value)


def test_an_entry_lists_one_origin() -> None:
    hosts = ("http://127.0.0.1:8080", "10.0.0.7:8443", "hooks.intern")
    for url in ("http://127.0.0.1:8080/a", "https://10.0.0.7:8443/", "https://HOOKS.intern/x?y=z"):
        assert str(checked_receiver(url, settings(*hosts))).lower() == url.lower()
    for url in ("http://127.0.0.1:8081/a", "https://127.0.0.1:8080/", "https://10.0.0.7/", "http://hooks.intern/"):
        with pytest.raises(TargetRefusedError):
            checked_receiver(url, settings(*hosts))


@pytest.mark.parametrize("addresses", [["127.0.0.1"], [PUBLIC, "10.0.0.1"], ["169.254.169.254"]])
def test_a_name_that_leads_inside_is_refused_at_submission_and_when_it_is_sent(names, addresses: list[str]) -> None:
    names["inside.example"] = [addresses]
    with pytest.raises(TargetRefusedError, match="not a public address"):
        anyio.run(check_receiver, "https://inside.example/", settings())
    with pytest.raises(TargetRefusedError, match="not a public address"):
        send("https://inside.example/")


@pytest.mark.parametrize("host", ["localhost", "127.1", "0x7f.1", "2130706433"])
def test_other_ways_to_write_this_machine_are_refused(host: str) -> None:
    with pytest.raises(TargetRefusedError):
        anyio.run(check_receiver, f"https://{host}/", settings())


def test_a_name_that_is_not_known_is_accepted_and_tried_later(names) -> None:
    names["new.example"] = [[]]
    anyio.run(check_receiver, "https://new.example/", settings())
    with pytest.raises(SendError, match="cannot be reached"):
        send("https://new.example/")


def test_a_name_that_changes_after_submission_leads_nowhere(names) -> None:
    with receiving() as receiver:
        port = receiver.url.rpartition(":")[2]
        names["changes.example"] = [[PUBLIC], ["127.0.0.1"]]
        anyio.run(check_receiver, f"https://changes.example:{port}/", settings())
        with pytest.raises(TargetRefusedError, match=r"leads to 127\.0\.0\.1"):
            send(f"https://changes.example:{port}/")
        assert receiver.received == []


def test_the_connection_goes_to_the_address_that_was_checked(names, monkeypatch: pytest.MonkeyPatch) -> None:
    names["changes.example"] = [[PUBLIC], ["127.0.0.1"]]
    tried: list[tuple[str, int]] = []

    def connect(_self: Any, host: str, port: int, *_rest: Any) -> Any:
        tried.append((host, port))
        raise httpcore.ConnectError("closed")

    monkeypatch.setattr(httpcore.SyncBackend, "connect_tcp", connect)
    with pytest.raises(SendError):
        send("https://changes.example/")
    assert tried == [(PUBLIC, 443)]
    assert names["changes.example"] == [["127.0.0.1"]]  # looked up once


def test_a_listed_receiver_gets_the_message_as_it_is() -> None:
    with receiving(lambda _message: 202) as receiver:
        assert send(f"{receiver.url}/a%20b?c=d", receiver.origin) == (202, None)
        (message,) = receiver.received
    assert (message.path, message.body) == ("/a%20b?c=d", b"{}")
    assert message.headers["host"] == receiver.url.removeprefix("http://")
    assert message.headers["content-type"] == "application/json"


@pytest.mark.parametrize("setting", ["webhook_hosts", "input_hosts"])
def test_a_listed_host_that_is_none_stops_the_service_and_its_driver_at_the_start(setting: str, tmp_path) -> None:
    values = ServiceSettings(state=tmp_path, **{setting: ("https://hooks.example/path",)})
    for begin in (
        lambda: run_driver(values, parent_pipe=None),
        lambda: start(values, JobStore(f"sqlite:///{tmp_path / 'a.db'}")),
    ):
        with pytest.raises(StartUpError, match=f"{setting} has 'https://hooks.example/path'"):
            begin()


def test_names_that_are_answered_slowly_do_not_hold_up_submissions(names, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook_targets, "LOOK_UP_S", 0.05)
    answered = threading.Event()

    def look_up(*_: Any) -> list[Any]:
        answered.wait(DEADLINE_S)
        return []

    monkeypatch.setattr(webhook_targets, "_addresses", look_up)

    async def submissions() -> None:
        async with anyio.create_task_group() as group:
            for number in range(30):
                group.start_soon(check_receiver, f"https://slow{number}.example/", settings())
        # the threads of requests are free, though the look-ups are not over
        limiter = anyio.to_thread.current_default_thread_limiter()
        assert limiter.borrowed_tokens == 0
        assert not answered.is_set()
        answered.set()

    anyio.run(submissions)


def test_redirects_are_not_followed_and_proxies_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    with receiving() as other, receiving(lambda _message: 307) as receiver:
        receiver.headers["Location"] = other.url
        receiver.headers["Retry-After"] = "7"
        for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
            monkeypatch.setenv(name, other.url)
        assert send(receiver.url, receiver.origin, other.origin) == (307, "7")
        assert (len(receiver.received), len(other.received)) == (1, 0)


def read_request(connection: socket.socket) -> None:
    """Read to the end of the body: a server that closes before would cut its own answer short."""
    received = b""
    while not received.endswith(b"\r\n\r\n{}"):
        piece = connection.recv(65_536)
        if not piece:
            return
        received += piece


@contextlib.contextmanager
def raw_server(serve: Callable[[socket.socket], None]) -> Iterator[str]:
    """A server of one connection that speaks as it likes."""
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def work() -> None:
            connection, _ = listening.accept()
            with connection, contextlib.suppress(OSError):
                serve(connection)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"
        thread.join(DEADLINE_S)
        assert not thread.is_alive()


def test_a_receiver_that_answers_byte_by_byte_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook_targets, "SEND_S", 0.3)
    over = threading.Event()

    def drip(connection: socket.socket) -> None:
        read_request(connection)
        for byte in b"HTTP/1.1 200 OK\r\n" + b"X: y\r\n" * 1000 + b"\r\n":
            connection.sendall(bytes([byte]))
            if over.wait(0.02):
                return

    with raw_server(drip) as url:
        with pytest.raises(SendError, match=r"did not answer within 0\.3 s"):
            send(url, url)
        over.set()


def test_the_body_of_an_answer_is_not_read() -> None:
    sent = 0

    def flood(connection: socket.socket) -> None:
        nonlocal sent
        read_request(connection)
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 100000000000\r\n\r\n")
        piece = bytes(1 << 20)
        while sent < 1 << 30:
            connection.sendall(piece)
            sent += len(piece)

    with raw_server(flood) as url:
        assert send(url, url) == (200, None)
    assert sent < 1 << 27


@pytest.mark.parametrize("answer", [b"", b"nonsense\r\n\r\n", b"HTTP/1.1 200"])
def test_an_answer_that_is_none_is_a_fault_that_may_pass(answer: bytes) -> None:
    def serve(connection: socket.socket) -> None:
        read_request(connection)
        connection.sendall(answer)

    with raw_server(serve) as url, pytest.raises(SendError, match="cannot be reached"):
        send(url, url)


@pytest.mark.parametrize("certified", ["hooks.example", "other.example"])
def test_the_certificate_must_be_that_of_the_name(
    names, certified: str, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names["hooks.example"] = [["127.0.0.1"]]
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "ca.pem"))
    webhook_targets._tls.cache_clear()
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert(certified).configure_cert(server)

    def serve(connection: socket.socket) -> None:
        with server.wrap_socket(connection, server_side=True) as encrypted:
            read_request(encrypted)
            encrypted.sendall(b"HTTP/1.1 204 No Content\r\n\r\n")

    try:
        with raw_server(serve) as url:
            origin = f"hooks.example:{url.rpartition(':')[2]}"
            if certified == "hooks.example":
                assert send(f"https://{origin}/", origin) == (204, None)
            else:
                with pytest.raises(SendError, match=r"(?i)certificate"):
                    send(f"https://{origin}/", origin)
    finally:
        webhook_targets._tls.cache_clear()
