"""From the `Authorization` header to a principal with scopes.

If no key was ever made, and the service listens on loopback (or `open_without_keys` is set), every client may do
everything. As soon as there is a key, every client needs one, even after the last key was revoked.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import hmac
import threading
import time
import weakref
from typing import Protocol

from service.errors import ForbiddenError, UnauthorizedError
from service.keys import Key, Scope, digest_of, looks_like_key
from service.settings import ServiceSettings

TRUST_S = 2.0
"""Seconds for which an answer of the key table is reused; a revoked key works at most this long."""
_MOMENT_S = 0.5
"""Seconds for which an answer must still be trusted for `needs_table`: the caller authenticates soon after."""
REMEMBERED = 4096
"""Maximum number of keys in memory."""
FIX = "Send the header `Authorization: Bearer gw_…` with a key from `gablework keys create --name NAME`"


class KeyTable(Protocol):
    """The part of the store that is used here."""

    def keys(self) -> list[Key]:
        """All keys that were ever made, revoked ones included."""

    def key_by_digest(self, digest: str) -> Key | None:
        """The key, even if it is revoked."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Principal:
    """The caller and its scopes."""

    key_id: str | None
    """Id of the key; None if keys are not used."""
    scopes: frozenset[Scope]
    """The scopes."""

    @property
    def owner(self) -> str | None:
        """The key whose jobs and uploads the caller sees; None for all (admin, or no keys)."""
        return None if Scope.ADMIN in self.scopes else self.key_id

    def require(self, scope: Scope) -> None:
        """Refuse a caller without the scope.

        Raises
        ------
        ForbiddenError
            The key lacks it.
        """
        if scope not in self.scopes:
            raise ForbiddenError(
                f"this needs the scope {scope}, the key has {', '.join(sorted(self.scopes))}: "
                f"make one with `gablework keys create --name NAME --scope {scope}`"
            )


KEYLESS = Principal(key_id=None, scopes=frozenset(Scope))
"""Every caller if keys are not used."""


class _Memory:
    """Answers of one key table, each for `TRUST_S` seconds; unknown keys are not remembered."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._keys: dict[str, tuple[Key, float]] = {}
        self._has_keys: tuple[bool, float] = (False, float("-inf"))

    def key(self, digest: str, table: KeyTable, now_s: float) -> Key | None:
        """The key, from memory if that is fresh."""
        with self._lock:
            held = self._keys.get(digest)
        if held is not None and now_s - held[1] < TRUST_S:
            return held[0]
        key = table.key_by_digest(digest)
        with self._lock:
            if key is None:
                self._keys.pop(digest, None)
            else:
                if len(self._keys) >= REMEMBERED:
                    self._keys.clear()
                self._keys[digest] = (key, now_s)
        return key

    def holds(self, digest: str | None, now_s: float) -> bool:
        """Whether it is known, without the table, whose a key is; without a key, whether keys are used."""
        is_used, since_s = self._has_keys
        if not is_used and now_s - since_s >= TRUST_S:
            return False
        if digest is None or not is_used:
            return True
        with self._lock:
            held = self._keys.get(digest)
        return held is not None and now_s - held[1] < TRUST_S

    def has_keys(self, table: KeyTable, now_s: float) -> bool:
        """Whether a key was ever made; a yes is final."""
        held, since_s = self._has_keys
        if held or now_s - since_s < TRUST_S:
            return held
        found = bool(table.keys())
        self._has_keys = (found, now_s)
        return found


_memories: weakref.WeakKeyDictionary[KeyTable, _Memory] = weakref.WeakKeyDictionary()
_memories_lock = threading.Lock()


def _memory_of(table: KeyTable) -> _Memory:
    with _memories_lock:
        return _memories.setdefault(table, _Memory())


def needs_table(authorization: str | None, store: KeyTable) -> bool:
    """Whether `authenticate` may ask the key table in the next moment; otherwise it takes no time."""
    secret = _secret_of(authorization)
    return not _memory_of(store).holds(None if secret is None else digest_of(secret), time.monotonic() + _MOMENT_S)


def _secret_of(authorization: str | None) -> str | None:
    """The key in a header; None if it holds none."""
    scheme, _, secret = (authorization or "").strip().partition(" ")
    secret = secret.strip()
    return secret if scheme.lower() == "bearer" and looks_like_key(secret) else None


def authenticate(
    authorization: str | None,
    store: KeyTable,
    settings: ServiceSettings,
    *,
    now_s: float | None = None,
    at: dt.datetime | None = None,
) -> Principal:
    """The principal of a request, from its header (None without one). `now_s` is a monotonic time, `at` one of day.

    Raises
    ------
    UnauthorizedError
        A key is needed and none was sent, or it is malformed, unknown, revoked or expired. The message does not
        repeat it.
    """
    memory = _memory_of(store)
    now_s = time.monotonic() if now_s is None else now_s
    if not memory.has_keys(store, now_s) and (settings.is_loopback or settings.open_without_keys):
        return KEYLESS
    if authorization is None:
        raise UnauthorizedError(f"this service needs a key. {FIX}")
    secret = _secret_of(authorization)
    if secret is None:
        raise UnauthorizedError(f"the header Authorization holds no key. {FIX}")
    digest = digest_of(secret)
    key = memory.key(digest, store, now_s)
    if key is None or not any(hmac.compare_digest(known, digest) for known in (key.digest, key.old_digest or "")):
        raise UnauthorizedError(f"the key is not known. {FIX}")
    fault = key.fault(digest, dt.datetime.now(dt.UTC) if at is None else at)
    if fault is not None:
        raise UnauthorizedError(f"the key {key.name!r} {fault}. {FIX}")
    return Principal(key_id=key.key_id, scopes=key.scopes)
