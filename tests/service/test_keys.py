"""Keys: random, hashed, with scopes that are steps."""

import dataclasses
import datetime as dt
import hashlib

import pytest

from service.keys import Key, Scope, digest_of, looks_like_key, new_key

NOW = dt.datetime(2026, 3, 1, tzinfo=dt.UTC)


def test_a_key_has_256_random_bits_and_a_prefix_that_scanners_know() -> None:
    secrets = {new_key("a", Scope.READ, now=NOW)[1] for _ in range(100)}
    assert len(secrets) == 100
    assert all(secret.startswith("gw_") and looks_like_key(secret) for secret in secrets)
    # 43 characters of 6 bits hold 32 bytes.
    assert {len(secret) for secret in secrets} == {3 + 43}


def test_what_is_stored_does_not_hold_the_key() -> None:
    key, secret = new_key("a", Scope.SUBMIT, now=NOW)
    assert key.digest == hashlib.sha256(secret.encode()).hexdigest() == digest_of(secret)
    assert secret not in repr(key)
    assert secret[3:] not in str(dataclasses.asdict(key))


def test_each_scope_includes_those_before_it() -> None:
    assert Scope.READ.included == {Scope.READ}
    assert Scope.SUBMIT.included == {Scope.READ, Scope.SUBMIT}
    assert Scope.ADMIN.included == set(Scope)


def test_a_key_that_was_stored_with_one_scope_has_what_that_includes() -> None:
    key = Key(key_id="1" * 32, name="a", digest="0" * 64, scopes=frozenset({Scope.SUBMIT}), created_at=NOW)
    assert key.scopes == {Scope.READ, Scope.SUBMIT}


def test_a_key_without_a_scope_cannot_be() -> None:
    with pytest.raises(ValueError, match=r"has no scope: choose from read, submit, admin"):
        Key(key_id="1" * 32, name="a", digest="0" * 64, scopes=frozenset(), created_at=NOW)


@pytest.mark.parametrize(
    "text", ["", "gw_", "gw_" + "a" * 42, "gw_" + "a" * 44, "gw_" + "a" * 42 + "\n", "xx_" + "a" * 43]
)
def test_what_is_no_key_is_not_taken_for_one(text: str) -> None:
    assert not looks_like_key(text)
