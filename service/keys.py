"""Keys identify clients and limit what they may do. No SQL, no HTTP; time is an argument.

A key is the text `gw_` and 256 random bits. It is shown once, when it is made; only its SHA-256 is stored. (The hash
needs no salt and need not be slow, because a random key cannot be guessed.)

Each scope includes those before it:

| scope | may |
|---|---|
| read | see the service's own pages, and its own jobs, schedules, uploads, results and events |
| submit | also send and remove its own uploads, submit, dismiss and remove its own jobs; its own schedules |
| admin | all of this with the jobs, schedules and uploads of all keys; webhooks for all jobs, metrics |

Keys are made, listed and revoked on the machine itself (`gablework keys`), never over HTTP.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import hashlib
import re
import secrets
import uuid
from enum import StrEnum

PREFIX = "gw_"
"""Prefix of every key, so scanners recognise a leaked one."""

_KEY = re.compile(r"gw_[A-Za-z0-9_-]{43}")


class Scope(StrEnum):
    """The permissions of a key; each includes those before it."""

    READ = "read"
    """See its own jobs, uploads, results and events."""
    SUBMIT = "submit"
    """Also send uploads, submit jobs, dismiss and remove its own."""
    ADMIN = "admin"
    """All of this with the data of all keys."""

    @property
    def included(self) -> frozenset[Scope]:
        """The scope itself and those before it.

        >>> sorted(Scope.SUBMIT.included)
        [<Scope.READ: 'read'>, <Scope.SUBMIT: 'submit'>]
        """
        steps = list(Scope)
        return frozenset(steps[: steps.index(self) + 1])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Key:
    """A key as it is stored, without the key itself."""

    key_id: str
    """32 hexadecimal digits; the owner of jobs and uploads. Not a secret."""
    name: str
    """The user's name for it."""
    digest: str
    """SHA-256 of the key, hexadecimal."""
    scopes: frozenset[Scope]
    """Its scopes, with all that they include."""
    created_at: dt.datetime
    """With a time zone."""
    revoked_at: dt.datetime | None = None
    """When it was revoked; None if it was not."""
    expires_at: dt.datetime | None = None
    """When it expires; None for never."""
    old_digest: str | None = None
    """Digest of the secret before the last rotation; None without one."""
    old_until: dt.datetime | None = None
    """How long that secret is accepted beside the new one."""

    def __post_init__(self) -> None:
        if not self.scopes:
            raise ValueError(f"the key {self.name!r} has no scope: choose from {', '.join(Scope)}")
        object.__setattr__(self, "scopes", frozenset().union(*(Scope(scope).included for scope in self.scopes)))

    def fault(self, digest: str, now: dt.datetime) -> str | None:
        """Why a secret with this digest, that of this key, is refused; None if it is accepted."""
        if self.revoked_at is not None:
            return "was revoked"
        if self.expires_at is not None and self.expires_at <= now:
            return f"expired on {self.expires_at:%Y-%m-%d}"
        if digest == self.old_digest and (self.old_until is None or self.old_until <= now):
            return "was rotated, and its old secret is no longer accepted"
        return None


def new_key(name: str, scope: Scope, *, now: dt.datetime, lasting: dt.timedelta | None = None) -> tuple[Key, str]:
    """Make a key with a scope and those before it: the stored record, and the key itself, which is shown once."""
    secret = PREFIX + secrets.token_urlsafe(32)
    key = Key(
        key_id=uuid.uuid4().hex,
        name=name,
        digest=digest_of(secret),
        scopes=scope.included,
        created_at=now,
        expires_at=None if lasting is None else now + lasting,
    )
    return key, secret


def rotated(key: Key, *, now: dt.datetime, grace: dt.timedelta, lasting: dt.timedelta | None = None) -> tuple[Key, str]:
    """The key with a new secret, and that secret; the old one is accepted for `grace` longer.

    With `lasting` it expires so long after now; otherwise its end stays.
    """
    secret = PREFIX + secrets.token_urlsafe(32)
    changed = dataclasses.replace(
        key,
        digest=digest_of(secret),
        old_digest=key.digest,
        old_until=now + grace,
        expires_at=key.expires_at if lasting is None else now + lasting,
    )
    return changed, secret


def digest_of(secret: str) -> str:
    """SHA-256 of a key, hexadecimal, as it is stored."""
    return hashlib.sha256(secret.encode()).hexdigest()


def looks_like_key(text: str) -> bool:
    """Whether the text has the shape of a key; anything else is not even looked up."""
    return _KEY.fullmatch(text) is not None
