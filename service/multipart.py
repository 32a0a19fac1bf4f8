"""Parses forms with files (multipart/form-data) part by part while they arrive, without temporary files.

The framework's own parser writes every file to a temporary one before a route sees it; here a route passes the bytes
to their destination and stops when the limit is exceeded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncIterator

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from service.deliveries import Fingerprint
from service.errors import RequestError, TooLargeError


class Part:
    """One part of a form; its unread rest is skipped when the next part is read."""

    def __init__(self, form: Form, headers: dict[bytes, bytes]) -> None:
        kind, options = parse_options_header(headers.get(b"content-disposition", b""))
        if kind != b"form-data" or b"name" not in options:
            raise RequestError(["a part of the form has no name: send Content-Disposition: form-data; name=…"])
        self._form = form
        self._over = False
        self.name = options[b"name"].decode("utf-8", "replace")
        """Name of the field."""
        filename = options.get(b"filename")
        self.filename = None if filename is None else filename.decode("utf-8", "replace")
        """The client's name of the file; None for a plain field."""

    async def chunks(self) -> AsyncIterator[bytes]:
        """The content as it arrives."""
        while not self._over:
            data = await self._form.following()
            assert not isinstance(data, dict)
            if data is None:
                self._over = True
            else:
                yield data

    async def text(self, max_bytes: int) -> str:
        """The content as text.

        Raises
        ------
        TooLargeError
            It is longer than `max_bytes`.
        RequestError
            It is not UTF-8.
        """
        held = bytearray()
        async for chunk in self.chunks():
            held += chunk
            if len(held) > max_bytes:
                raise TooLargeError(f"the field {self.name[:80]!r} has more than {max_bytes} bytes")
        try:
            return held.decode("utf-8")
        except UnicodeDecodeError:
            raise RequestError([f"the field {self.name[:80]!r} is not UTF-8"]) from None


class Form:
    """A form that is arriving.

    Parameters
    ----------
    stream : asynchronous iterator of bytes
        The request's body.
    content_type : str
        The request's header; names the boundary.
    max_parts : int
        Maximum number of parts.
    fingerprint : Fingerprint, optional
        Takes the parts as they arrive.

    Raises
    ------
    RequestError
        The header is not one of a form.
    """

    def __init__(
        self,
        stream: AsyncIterator[bytes],
        content_type: str,
        *,
        max_parts: int,
        fingerprint: Fingerprint | None = None,
    ) -> None:
        kind, options = parse_options_header(content_type)
        boundary = options.get(b"boundary", b"")
        if kind != b"multipart/form-data" or not boundary:
            state = f"is {content_type[:80]!r}" if content_type else "is missing"
            raise RequestError([f"the content type {state}: send multipart/form-data with a boundary"])
        self._stream = stream
        self._max_parts = max_parts
        self._fingerprint = fingerprint
        self._field = self._value = b""
        self._headers: dict[bytes, bytes] = {}
        # headers begin a part, bytes are data of it, None ends it
        self._seen: deque[dict[bytes, bytes] | bytes | None] = deque()
        self._complete = False
        try:
            self._parser = MultipartParser(
                boundary,
                {
                    "on_part_begin": self._on_part_begin,
                    "on_header_field": self._on_header_field,
                    "on_header_value": self._on_header_value,
                    "on_header_end": self._on_header_end,
                    "on_headers_finished": self._on_headers_finished,
                    "on_part_data": self._on_part_data,
                    "on_part_end": self._on_part_end,
                    "on_end": self._on_end,
                },
            )
        except FormParserError as error:
            raise RequestError([f"the form's boundary cannot be used: {error}"]) from error

    async def parts(self) -> AsyncIterator[Part]:
        """The parts in order.

        Raises
        ------
        RequestError
            The body is not a form, ends too early, or has too many parts.
        """
        count = 0
        # each part consumes its own end, so another end is that of the form
        while isinstance(seen := await self.following(), dict):
            count += 1
            if count > self._max_parts:
                raise RequestError([f"the form has more than {self._max_parts} parts"])
            part = Part(self, seen)
            yield part
            async for _ in part.chunks():
                pass

    async def following(self) -> dict[bytes, bytes] | bytes | None:
        """The next thing in the form; None at the end of a part and of the form."""
        while not self._seen:
            if self._complete:
                return None
            chunk = await anext(self._stream, None)
            if chunk is None:
                raise RequestError(["the form ends before its last boundary"])
            if chunk:
                try:
                    self._parser.write(chunk)
                except FormParserError as error:
                    raise RequestError([f"the body is not a form: {error}"]) from error
        return self._seen.popleft()

    # --- what the parser calls

    def _on_part_begin(self) -> None:
        self._headers = {}

    def _on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._field += data[start:end]

    def _on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def _on_header_end(self) -> None:
        self._headers[self._field.lower()] = self._value
        self._field = self._value = b""

    def _on_headers_finished(self) -> None:
        self._seen.append(self._headers)
        if self._fingerprint is not None:
            self._fingerprint.part(self._headers.get(b"content-disposition", b""))

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        self._seen.append(data[start:end])
        if self._fingerprint is not None:
            self._fingerprint.update(data[start:end])

    def _on_part_end(self) -> None:
        self._seen.append(None)

    def _on_end(self) -> None:
        self._complete = True
