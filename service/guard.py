"""Checks before all routes: host and origin of a request; encoding, size and shape of its body; headers for browsers.

A service on loopback without keys trusts every client that reaches it, but must not trust web pages in a browser on
the same machine. Therefore the `Host` must be one of ours (else a page could give its own name to this address, "DNS
rebinding"), and a request that changes anything must not come from another origin.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import bodies
from service.errors import RequestError, TooLargeError
from service.problems import AMBIGUOUS, ENCODED, FOREIGN, answer, answer_error
from service.settings import ServiceSettings

STREAMED = frozenset({("POST", "/jobs"), ("POST", "/uploads"), ("POST", "/uploads/tus"), ("PATCH", "/uploads/tus/*")})
"""Requests with files: their routes count the bytes. `*` is any last part of a path."""

TUS = "/uploads/tus"
"""Path of resumable uploads; all answers there name the version of their protocol."""

READING = frozenset({"GET", "HEAD", "OPTIONS"})
"""Methods that change nothing; without CORS another site cannot read their answers."""

LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
"""Names of this machine."""

_PAGE_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:{tiles}; worker-src 'self' blob:; object-src 'none'; "
    "base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)


def page_policy(tile_origin: str | None) -> str:
    """Content security policy of the web page.

    Parameters
    ----------
    tile_origin : str or None
        The only other origin from which the page may load pictures: tiles beneath its map.
    """
    return _PAGE_POLICY.format(tiles="" if tile_origin is None else f" {tile_origin}")


DATA_POLICY = "default-src 'none'; frame-ancestors 'none'"
"""Content security policy of all other answers, unless a route sets its own: a browser runs nothing from a file."""


class Guard:
    """Checks every request before a route sees it; adds the headers that protect browsers."""

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self.app = app
        self.settings = settings
        public = urlsplit(settings.public_url or "")
        self._public_origin = f"{public.scheme}://{public.netloc}".lower() if public.netloc else None
        self._page_policy = page_policy(settings.map_origin)
        self._hosts = LOOPBACK | {settings.host.lower()} | ({public.hostname} if public.hostname else set())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse, or pass on."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        path = scope["path"].removeprefix(scope.get("root_path", ""))
        own = {"Tus-Resumable": "1.0.0"} if path == TUS or path.startswith(f"{TUS}/") else {}
        guarded_send = functools.partial(self._send, send, own, self._page_policy)
        refusal = self._foreign(scope["method"], scope.get("scheme", "http"), headers)
        if refusal is not None:
            await answer(FOREIGN, refusal, scope["path"])(scope, receive, guarded_send)
            return
        if "content-length" in headers and "transfer-encoding" in headers:
            # another program on the way may believe the other one, and take the rest of the body for a request
            both = "the request has Content-Length and Transfer-Encoding: send one of them"
            refused = answer(AMBIGUOUS, both, scope["path"], headers={"Connection": "close"})
            await refused(scope, receive, guarded_send)
            return
        encoding = headers.get("content-encoding", "identity").strip().lower()
        if encoding != "identity":
            packed = f"Content-Encoding is {encoding[:40]!r}: send the body as it is"
            await answer(ENCODED, packed, scope["path"])(scope, receive, guarded_send)
            return
        if not STREAMED.isdisjoint({(scope["method"], path), (scope["method"], f"{path.rpartition('/')[0]}/*")}):
            await self.app(scope, receive, guarded_send)
            return
        if headers.get("content-length", "0") == "0" and "transfer-encoding" not in headers:
            await self.app(scope, receive, guarded_send)
            return
        try:
            whole = await _whole_body(receive, headers, self.settings.max_body_bytes)
        except (RequestError, TooLargeError) as fault:
            await answer_error(fault, scope["path"])(scope, receive, guarded_send)
            return
        if whole is not None:
            await self.app(scope, _again(whole, receive), guarded_send)

    def _foreign(self, method: str, scheme: str, headers: Headers) -> str | None:
        """Why a request is refused as one from another site; None if it is accepted."""
        host = headers.get("host", "")
        if self.settings.is_loopback and _hostname(host) not in self._hosts:
            return (
                f"the header Host is {host[:80]!r}: use {self.settings.host}, or set GABLEWORK_PUBLIC_URL to the URL "
                "by which clients reach the service"
            )
        if method in READING:
            return None
        origin = headers.get("origin")
        if origin is not None and origin.lower() not in {f"{scheme}://{host}".lower(), self._public_origin}:
            return f"the header Origin is {origin[:80]!r}: only the service's own page may change anything"
        if origin is None and headers.get("sec-fetch-site", "none") not in {"none", "same-origin"}:
            return "the browser says that another site sends this: only the service's own page may change anything"
        return None

    @staticmethod
    async def _send(send: Send, own: Mapping[str, str], page_policy: str, message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.update(own)
            is_page = headers.get("content-type", "").startswith("text/html")
            headers["X-Content-Type-Options"] = "nosniff"
            headers["Referrer-Policy"] = "no-referrer"
            # a page among the results may do less than the service's own
            headers.setdefault("Content-Security-Policy", page_policy if is_page else DATA_POLICY)
            headers["Cross-Origin-Resource-Policy"] = "same-origin"
        await send(message)


def _hostname(host: str) -> str:
    """The name in a Host header, without its port.

    >>> _hostname("Localhost:8000"), _hostname("[::1]:8000"), _hostname("a b")
    ('localhost', '::1', 'a b')
    """
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


async def _whole_body(receive: Receive, headers: Headers, most: int) -> bytes | None:
    """The body of a request whose route does not count its bytes; None if the client has gone.

    Raises
    ------
    TooLargeError
        It has more than `most` bytes.
    RequestError
        It is JSON with more in it than clients have reason to send.
    """
    length = headers.get("content-length", "0")
    if length.isdigit() and int(length) > most:
        raise _too_large(most)
    held: list[bytes] = []
    seen, is_over = 0, False
    while not is_over:
        message = await receive()
        if message["type"] != "http.request":
            return None
        held.append(message.get("body", b""))
        seen += len(held[-1])
        if seen > most:
            raise _too_large(most)
        is_over = not message.get("more_body", False)
    whole = b"".join(held)
    del held  # many bodies may wait for their turn
    if "json" in headers.get("content-type", "").lower():
        await bodies.check(whole, most)
    return whole


def _again(whole: bytes, receive: Receive) -> Receive:
    """The body as one message, then what the server says."""
    held = [whole]

    async def received() -> Message:
        return {"type": "http.request", "body": held.pop(), "more_body": False} if held else await receive()

    return received


def _too_large(most: int) -> TooLargeError:
    return TooLargeError(
        f"the body has more than {most} bytes: send files to /uploads, or raise GABLEWORK_MAX_BODY_BYTES"
    )
