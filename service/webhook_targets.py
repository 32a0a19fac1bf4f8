"""Where webhooks may go, and the connection that leads only there.

Every public address is allowed over https. Private, loopback, link-local and reserved addresses, and plain http, need
an entry in the setting `webhook_hosts`, which has the form of `input_hosts`. The address is checked after the name was
looked up, and the connection goes to that address: a name that changes in between leads nowhere else. Redirects are
not followed, and no proxy, password or cookie is used.
"""

from __future__ import annotations

import functools
import ipaddress
import socket
import ssl
import time
from collections.abc import Iterable, Mapping
from typing import Any

import anyio
import anyio.to_thread
import httpcore
import httpx
from anyio.lowlevel import RunVar

from service.errors import TargetRefusedError
from service.input_policy import LONGEST_URL, PORTS, origin_of, shown
from service.settings import ServiceSettings

SEND_S = 30.0
"""Seconds for one whole attempt, from the look-up of the name to the status of the answer."""
CONNECT_S = 10.0
"""Seconds for the connection to one address."""
LOOK_UP_S = 2.0
"""Seconds that a submission waits for the look-up of a name; without an answer the driver checks it later."""
LOOK_UPS = 4
"""Threads that look up names; a submission that finds none free in time is not checked until it is sent."""
_SMALLEST_S = 0.01
_LARGEST_PORT = 65_535

_limiter: RunVar[anyio.CapacityLimiter] = RunVar("look_ups")

Address = ipaddress.IPv4Address | ipaddress.IPv6Address

_SHARED = ipaddress.ip_network("100.64.0.0/10")
"""Addresses behind a carrier's translation (RFC 6598): neither private nor global in Python's words."""
_TRANSLATED = (ipaddress.ip_network("64:ff9b::/96"), ipaddress.ip_network("64:ff9b:1::/48"))
"""IPv6 addresses that gateways translate to the IPv4 address at their end (RFC 6052, RFC 8215)."""


class SendError(Exception):
    """The receiver was not reached, or did not answer; another attempt may help."""


def checked_receiver(text: str, settings: ServiceSettings) -> httpx.URL:
    """The URL of a receiver, as far as it can be checked without a look-up.

    Raises
    ------
    TargetRefusedError
        It is not a URL, or it needs an entry in `webhook_hosts`. The message does not repeat passwords or queries.
    """
    try:
        url = httpx.URL(text) if len(text) <= LONGEST_URL and text.isprintable() else None
    except (httpx.InvalidURL, ValueError):
        url = None
    if url is None or url.scheme not in PORTS or not url.host or not 0 < _port(url) <= _LARGEST_PORT:
        public = text.rpartition("@")[2].partition("?")[0]
        raise TargetRefusedError(f"{public[:80]!r} is not a URL that can be called: give https://host/path")
    if url.userinfo:
        raise TargetRefusedError(f"{shown(url)} contains a user or password: give a URL without them")
    if _is_listed(url, settings):
        return url
    if url.scheme != "https":
        raise TargetRefusedError(
            f"{shown(url)}: webhooks go over https: give an https URL, or add {_entry(url)} to GABLEWORK_WEBHOOK_HOSTS"
        )
    try:
        address: Address | None = ipaddress.ip_address(url.host)
    except ValueError:
        address = None
    if address is not None:
        _check_address(url, address)
    return url


async def check_receiver(text: str, settings: ServiceSettings) -> None:
    """Refuse a receiver to which nothing can be sent, with a short look-up of its name.

    Raises
    ------
    TargetRefusedError
        It is not a URL, or it leads to an address that needs an entry in `webhook_hosts`.
    """
    url = checked_receiver(text, settings)
    if _is_listed(url, settings):
        return
    with anyio.move_on_after(LOOK_UP_S):
        try:
            found = await anyio.to_thread.run_sync(
                _addresses, url.host, _port(url), abandon_on_cancel=True, limiter=_look_ups()
            )
        except OSError:
            return
        for address in found:
            _check_address(url, address)


def _look_ups() -> anyio.CapacityLimiter:
    """Limits the look-ups of one event loop: names that are answered slowly must not take the threads of requests."""
    try:
        return _limiter.get()
    except LookupError:
        made = anyio.CapacityLimiter(LOOK_UPS)
        _limiter.set(made)
        return made


def is_public(address: Address) -> bool:
    """Whether an address is one of the public internet.

    >>> [is_public(ipaddress.ip_address(text)) for text in ("8.8.8.8", "10.0.0.1", "::ffff:127.0.0.1")]
    [True, False, False]
    """
    if isinstance(address, ipaddress.IPv6Address):
        inner = address.ipv4_mapped or address.sixtofour
        is_tunnel = address.teredo is not None or any(address in network for network in _TRANSLATED)
        if is_tunnel or address.is_site_local:
            return False
        if inner is not None:
            return is_public(inner)
    is_other = address.is_multicast or address.is_reserved or address.is_unspecified or address.is_link_local
    return address.is_global and not is_other and address not in _SHARED


def post(url: str, *, headers: Mapping[str, str], body: bytes, settings: ServiceSettings) -> tuple[int, str | None]:
    """Send a message; the status of the answer and its header Retry-After. The answer's body is not read.

    Raises
    ------
    TargetRefusedError
        The URL, or an address of its host, is not allowed.
    SendError
        There was no answer in time.
    """
    target = checked_receiver(url, settings)
    backend = _CheckedConnections(target, settings)
    all_headers = [("Host", target.netloc.decode("ascii")), *headers.items(), ("Content-Length", str(len(body)))]
    timeout = {"connect": CONNECT_S, "read": SEND_S, "write": SEND_S, "pool": SEND_S}
    try:
        with (
            httpcore.ConnectionPool(ssl_context=_tls(), network_backend=backend, max_connections=1) as pool,
            pool.stream(
                "POST",
                httpcore.URL(scheme=target.raw_scheme, host=target.raw_host, port=target.port, target=target.raw_path),
                headers=all_headers,
                content=body,
                extensions={"timeout": timeout},
            ) as answer,
        ):
            found = dict(answer.headers)
            after = next((found[name] for name in found if name.lower() == b"retry-after"), None)
            return answer.status, None if after is None else after.decode("ascii", "replace")
    except httpcore.TimeoutException as error:
        raise SendError(f"the receiver did not answer within {SEND_S:g} s") from error
    except (httpcore.NetworkError, httpcore.ProtocolError, OSError) as error:
        raise SendError(f"the receiver cannot be reached: {error or type(error).__name__}") from error


@functools.cache
def _tls() -> ssl.SSLContext:
    """How certificates are checked; made once, since it reads hundreds of them."""
    return httpx.create_ssl_context()


class _CheckedConnections(httpcore.SyncBackend):
    """Connects to the checked addresses of one URL, within the time of one attempt."""

    def __init__(self, url: httpx.URL, settings: ServiceSettings) -> None:
        self._url = url
        self._is_listed = _is_listed(url, settings)
        self._until_s = time.monotonic() + SEND_S

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        """Look up the host once, check every address, and connect to the first one that answers."""
        addresses = _addresses(host, port)
        if not self._is_listed:
            for address in addresses:
                _check_address(self._url, address)
        fault: Exception = SendError(f"{host} has no address")
        for address in addresses:
            wait_s = min(timeout or CONNECT_S, _left_s(self._until_s))
            try:
                stream = super().connect_tcp(str(address), port, wait_s, local_address, socket_options)
            except (httpcore.ConnectError, httpcore.ConnectTimeout) as error:
                fault = error
            else:
                return _TimedStream(stream, self._until_s)
        raise fault


class _TimedStream(httpcore.NetworkStream):
    """A connection whose whole time is limited: a receiver that sends byte by byte cannot hold a sender."""

    def __init__(self, stream: httpcore.NetworkStream, until_s: float) -> None:
        self._stream = stream
        self._until_s = until_s

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        """Read within the time that is left."""
        return self._stream.read(max_bytes, self._left_s(timeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        """Write within the time that is left."""
        self._stream.write(buffer, self._left_s(timeout))

    def close(self) -> None:
        """Close."""
        self._stream.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        """Encrypt; the certificate must be that of the URL's host."""
        return _TimedStream(self._stream.start_tls(ssl_context, server_hostname, self._left_s(timeout)), self._until_s)

    def get_extra_info(self, info: str) -> Any:
        """As the connection itself."""
        return self._stream.get_extra_info(info)

    def _left_s(self, timeout: float | None) -> float:
        left_s = _left_s(self._until_s)
        return left_s if timeout is None else min(timeout, left_s)


def _left_s(until_s: float) -> float:
    """Seconds that are left.

    Raises
    ------
    httpcore.ReadTimeout
        None are.
    """
    left_s = until_s - time.monotonic()
    if left_s < _SMALLEST_S:
        raise httpcore.ReadTimeout(f"not answered within {SEND_S:g} s")
    return left_s


def _addresses(host: str, port: int) -> list[Address]:
    """All addresses of a host, in the system's order.

    Raises
    ------
    OSError
        The name is not known, or the look-up failed.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except UnicodeError as error:
        raise OSError(f"{host[:80]!r} is not a host name") from error
    # the scope of a link-local address is part of its text
    return [ipaddress.ip_address(str(entry[4][0])) for entry in found]


def _check_address(url: httpx.URL, address: Address) -> None:
    if not is_public(address):
        raise TargetRefusedError(
            f"{shown(url)} leads to {address}, which is not a public address: "
            f"give another URL, or add {_entry(url)} to GABLEWORK_WEBHOOK_HOSTS"
        )


def _is_listed(url: httpx.URL, settings: ServiceSettings) -> bool:
    origin = (url.scheme, url.host.lower(), _port(url))
    return origin in {origin_of(entry) for entry in settings.webhook_hosts}


def _port(url: httpx.URL) -> int:
    return url.port or PORTS[url.scheme]


def _entry(url: httpx.URL) -> str:
    """The entry that would list a URL's host."""
    return f"{url.scheme}://{url.netloc.decode('ascii')}"
