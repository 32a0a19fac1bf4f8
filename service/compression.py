"""Compresses answers on the way out, if the client accepts that and it is worth the time."""

from __future__ import annotations

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipResponder
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MIN_BYTES = 1024
"""A smaller answer fits into one packet anyway."""

MAX_BYTES = 32 << 20
"""Larger files are sent as they are, so that a client sees how much is left and can continue a broken download."""

LEVEL = 5
"""Higher levels take three times as long for a few percent."""

COMPRESSED = (
    *DEFAULT_EXCLUDED_CONTENT_TYPES,
    "application/vnd.apache.parquet",
    "application/vnd.laszip",
    "image/*",
)
"""Media types that are compressed already, or must not be held back."""


class Compressed:
    """Compresses answers with gzip."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http" or "gzip" not in Headers(scope=scope).get("accept-encoding", ""):
            await self.app(scope, receive, send)
        else:
            await _Responder(self.app)(scope, receive, send)


class _Responder(GZipResponder):
    """One answer."""

    def __init__(self, app: ASGIApp) -> None:
        super().__init__(app, MIN_BYTES, LEVEL, exclude_content_types=COMPRESSED)
        self._as_it_is = False

    async def send_with_compression(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = Headers(raw=message.get("headers", ()))
            self._as_it_is = int(headers.get("content-length", "0")) > MAX_BYTES
        if self._as_it_is:
            await self.send(message)
        else:
            await super().send_with_compression(message)

    async def apply_compression(self, body: bytes, *, more_body: bool) -> bytes:
        """Compress some of the body."""
        _weaken(self.initial_message)
        return await super().apply_compression(body, more_body=more_body)


def _weaken(start: Message) -> None:
    """Mark the ETag of a file as weak: a range of its compressed bytes must not be joined to one of its own bytes."""
    headers = MutableHeaders(raw=start["headers"])
    etag = headers.get("etag")
    if etag is not None and "accept-ranges" in headers and not etag.startswith("W/"):
        headers["etag"] = f"W/{etag}"
