"""Connections: answers are not held back, and silent clients do not stay."""

import socket
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from live_service import DEADLINE_S, serving, settings_in

from service import connections
from service.connections import listen

IMPATIENT_S = 0.05


def connected(url: str) -> socket.socket:
    parts = urlsplit(url)
    return socket.create_connection((parts.hostname, parts.port), timeout=DEADLINE_S)


def test_an_answer_does_not_wait_for_the_client_to_acknowledge_its_first_half(tmp_path: Path) -> None:
    listening, url = listen(settings_in(tmp_path, port=0))
    with listening, connected(url), listening.accept()[0] as accepted:
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


@pytest.mark.parametrize("sent", [b"", b"GET /healthz HTTP/1.1\r\nHost: local"], ids=["nothing", "half a head"])
def test_a_client_that_does_not_finish_its_request_is_disconnected(
    sent: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "HEAD_S", IMPATIENT_S)
    with serving(settings_in(tmp_path)) as url, connected(url) as client:
        client.sendall(sent)
        assert client.recv(1) == b""


def test_half_a_head_after_an_answer_is_disconnected_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(settings_in(tmp_path)) as url, connected(url) as client:
        client.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert client.recv(65_536).startswith(b"HTTP/1.1 200")
        monkeypatch.setattr(connections, "HEAD_S", IMPATIENT_S)
        client.sendall(b"GET /heal")
        while piece := client.recv(65_536):
            assert b"HTTP/1.1" not in piece


def test_a_body_that_stops_is_disconnected_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "BODY_S", IMPATIENT_S)
    settings = settings_in(tmp_path)
    with serving(settings) as url, connected(url) as client:
        client.sendall(
            b"POST /uploads?filename=a.xyz HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1000\r\n\r\n1 2 3\n"
        )
        while client.recv(65_536):
            pass
    assert not list((settings.state / "uploads").iterdir())


def test_a_slow_client_may_go_on_as_long_as_it_sends(tmp_path: Path) -> None:
    with serving(settings_in(tmp_path)) as url, connected(url) as client:
        for byte in b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n":
            client.sendall(bytes([byte]))
        assert client.recv(65_536).startswith(b"HTTP/1.1 200")
