"""Keys: what a client sends to be known, and what it may do. No SQL, no HTTP; time is an argument.

A key is the text `gw_` and 256 random bits. It is shown once, when it is made; only its SHA-256 is stored. (The hash
needs no salt and need not be slow: what it hides is random, there is nothing to guess.)

Scopes are steps, each includes those before it:

| scope | may |
|---|---|
| read | see the service's own pages, and its own jobs, schedules, uploads, results and events |
| submit | also send and remove its own uploads, submit, dismiss and remove its own jobs; its own schedules |
| admin | all of this with everybody's jobs, schedules and uploads |

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
"""How every key starts, so that a leaked one is recognised by those who search for them."""

_KEY = re.compile(r"gw_[A-Za-z0-9_-]{43}")


class Scope(StrEnum):
    """What a key may do; each includes those before it."""

    READ = "read"
    """See its own jobs, uploads, results and events."""
    SUBMIT = "submit"
    """Also send uploads, submit jobs, dismiss and remove its own."""
    ADMIN = "admin"
    """All of this with everybody's."""

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
    """A key as it is stored: the key itself is not in it."""

    key_id: str
    """32 hexadecimal digits; the owner of jobs and uploads. No secret."""
    name: str
    """The user's words for it."""
    digest: str
    """SHA-256 of the key, hexadecimal."""
    scopes: frozenset[Scope]
    """What it may do, with all that those scopes include."""
    created_at: dt.datetime
    """With a time zone."""
    revoked_at: dt.datetime | None = None
    """Since when it counts no more; None while it does."""

    def __post_init__(self) -> None:
        if not self.scopes:
            raise ValueError(f"the key {self.name!r} has no scope: choose from {', '.join(Scope)}")
        object.__setattr__(self, "scopes", frozenset().union(*(Scope(scope).included for scope in self.scopes)))


def new_key(name: str, scope: Scope, *, now: dt.datetime) -> tuple[Key, str]:
    """Make a key.

    Parameters
    ----------
    name : str
        The user's words for it.
    scope : Scope
        The highest scope; those before it are included.
    now : datetime
        With a time zone.

    Returns
    -------
    tuple of Key and str
        What is stored, and the key itself, to be shown once.
    """
    secret = PREFIX + secrets.token_urlsafe(32)
    key = Key(key_id=uuid.uuid4().hex, name=name, digest=digest_of(secret), scopes=scope.included, created_at=now)
    return key, secret


def digest_of(secret: str) -> str:
    """SHA-256 of a key, hexadecimal: under what it is stored."""
    return hashlib.sha256(secret.encode()).hexdigest()


def looks_like_key(text: str) -> bool:
    """Whether the text has the shape of a key; anything else is not even looked up."""
    return _KEY.fullmatch(text) is not None
