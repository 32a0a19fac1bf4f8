"""What belongs to the creation of one thing by one request: the files that came with it, and the answer that is kept.

A client that sends the header `Idempotency-Key` may send a request again without knowing whether the first one was
done. The key is claimed before the body is read. The answer is kept in the transaction that makes the thing, so after
a crash either both are there or neither.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, TypeVar

from service.errors import RequestError
from service.jobs import Upload

Made = TypeVar("Made")
"""What a request makes."""

CLAIM_S = 30.0
"""Seconds after which a claim ends that is not renewed: its process has died."""
MAX_KEY = 255
"""Maximum number of characters of a key."""
_QUOTED = re.compile(r'"((?:[\x20\x21\x23-\x5b\x5d-\x7e]|\\["\\])*)"')
_PLAIN = re.compile(r"[\x21\x23-\x2b\x2d-\x3a\x3c-\x5b\x5d-\x7e]+")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Claim:
    """A client's key that one request holds."""

    owner: str
    """Id of the API key; empty if keys are not used."""
    key: str
    """As the client sent it."""
    token: str = dataclasses.field(default_factory=lambda: uuid.uuid4().hex)
    """Names the request."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredAnswer:
    """The answer to a request, for those who send it again."""

    fingerprint: str
    """Digest of the request."""
    size_bytes: int
    """Size of its body."""
    status: int
    headers: Mapping[str, str]
    body: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Delivery(Generic[Made]):
    """What is written in the transaction in which a thing is made."""

    uploads: Sequence[Upload] = ()
    """Files of the request."""
    max_upload_bytes: int = 0
    """Maximum bytes of all uploads of their owner; 0 for any number."""
    max_uploads: int = 0
    """Maximum number of uploads of their owner; 0 for any number."""
    claim: Claim | None = None
    """The key of the request; None if it has none."""
    answer: Callable[[Made], StoredAnswer] | None = None
    """The answer to be kept under the key."""
    kept_s: float = 0.0
    """Seconds for which it is kept."""


def key_of(headers: Sequence[str]) -> str | None:
    """The key in the headers `Idempotency-Key` of a request; None if there is none.

    The draft of the IETF has a text in quotes. A key without quotes counts as the same text in quotes.

    Raises
    ------
    RequestError
        There are several, or one that is malformed.

    >>> key_of(['"a b"']), key_of(["8e03978e-40d5"]), key_of([])
    ('a b', '8e03978e-40d5', None)
    """
    if not headers:
        return None
    if len(headers) > 1:
        raise RequestError([f"the header Idempotency-Key is given {len(headers)} times: give it once"])
    text = headers[0].strip()
    quoted = _QUOTED.fullmatch(text)
    key = re.sub(r"\\(.)", r"\1", quoted[1]) if quoted else text
    if not 1 <= len(key) <= MAX_KEY or not (quoted or _PLAIN.fullmatch(text)):
        raise RequestError(
            [f"the header Idempotency-Key is {text[:80]!r}: use 1 to {MAX_KEY} printable ASCII characters, in quotes"]
        )
    return key


class Fingerprint:
    """Digest of a request, taken while its body arrives.

    Parameters
    ----------
    words : str
        What counts besides the body: method, path, query.
    """

    def __init__(self, *words: str) -> None:
        self._digest = hashlib.sha256(repr(words).encode("utf-8", "replace"))
        self.size_bytes = 0
        """Bytes of the body so far, without the frame of a form."""

    def part(self, header: bytes) -> None:
        """Begin a part of a form; its boundary may differ between two requests with the same content."""
        self._digest.update(b"\0%d %b\0" % (self.size_bytes, header))

    def update(self, data: bytes) -> None:
        """Add some bytes of the body."""
        self.size_bytes += len(data)
        self._digest.update(data)

    def hexdigest(self) -> str:
        """The digest, hexadecimal."""
        return self._digest.hexdigest()
