"""Who asks: keys on any address but loopback, scopes, revocation within seconds, and no key in a message or a log."""

import dataclasses
import datetime as dt
import logging
from pathlib import Path

import pytest

from service import auth
from service.auth import TRUST_S, Principal, authenticate
from service.errors import ForbiddenError, UnauthorizedError
from service.keys import Key, Scope, new_key, rotated
from service.settings import ServiceSettings

NOW = dt.datetime(2026, 3, 1, tzinfo=dt.UTC)


class FakeTable:
    """Keys in a list; counts how often it is asked."""

    def __init__(self, *keys: Key) -> None:
        self.held = list(keys)
        self.asked = 0

    def keys(self) -> list[Key]:
        return list(self.held)

    def key_by_digest(self, digest: str) -> Key | None:
        self.asked += 1
        return next((key for key in self.held if digest in (key.digest, key.old_digest)), None)

    def revoke(self, key: Key) -> None:
        self.held = [dataclasses.replace(one, revoked_at=NOW) if one == key else one for one in self.held]


def settings(host: str = "127.0.0.1", *, is_open: bool = False) -> ServiceSettings:
    return ServiceSettings(host=host, open_without_keys=is_open, state=Path("unused"))


def bearer(secret: str) -> str:
    return f"Bearer {secret}"


def test_on_loopback_without_keys_everybody_may_do_everything() -> None:
    principal = authenticate(None, FakeTable(), settings())
    assert principal.owner is None
    for scope in Scope:
        principal.require(scope)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "gablework.example.org"])
def test_on_any_other_address_a_key_is_needed_even_when_there_is_none(host: str) -> None:
    with pytest.raises(UnauthorizedError, match="needs a key"):
        authenticate(None, FakeTable(), settings(host))


def test_a_closed_network_can_be_open_when_the_operator_says_so() -> None:
    assert authenticate(None, FakeTable(), settings("0.0.0.0", is_open=True)).key_id is None


def test_once_there_is_a_key_loopback_needs_one_too() -> None:
    table = FakeTable()
    authenticate(None, table, settings(), now_s=0.0)
    table.held.append(new_key("first", Scope.READ, now=NOW)[0])
    with pytest.raises(UnauthorizedError):
        authenticate(None, table, settings(), now_s=TRUST_S)


def test_revoking_the_last_key_does_not_open_the_door_again() -> None:
    key, secret = new_key("only", Scope.READ, now=NOW)
    table = FakeTable(key)
    table.revoke(key)
    for number, header in enumerate((None, bearer(secret), None)):
        with pytest.raises(UnauthorizedError):
            authenticate(header, table, settings(is_open=True), now_s=10.0 * TRUST_S * number)


def test_a_key_sees_its_own_and_an_admin_sees_all() -> None:
    plain, secret = new_key("plain", Scope.SUBMIT, now=NOW)
    admin, admin_secret = new_key("admin", Scope.ADMIN, now=NOW)
    table = FakeTable(plain, admin)
    assert authenticate(bearer(secret), table, settings()).owner == plain.key_id
    principal = authenticate(bearer(admin_secret), table, settings())
    assert (principal.owner, principal.key_id) == (None, admin.key_id)


def test_a_scope_that_lacks_is_named_with_the_way_to_get_it() -> None:
    principal = Principal(key_id="1" * 32, scopes=Scope.READ.included)
    principal.require(Scope.READ)
    with pytest.raises(ForbiddenError, match=r"needs the scope submit, the key has read.*--scope submit"):
        principal.require(Scope.SUBMIT)


@pytest.mark.parametrize(
    "header",
    ["", "Bearer", "Bearer ", "Basic {}", "{}", "Bearer {} {}", "Bearer gw_{}", "Bearer\t{}", "Bearer {}x", "Token {}"],
)
def test_a_malformed_header_is_refused_although_the_key_is_right(header: str) -> None:
    key, secret = new_key("a", Scope.READ, now=NOW)
    with pytest.raises(UnauthorizedError):
        authenticate(header.format(secret, secret), FakeTable(key), settings())


@pytest.mark.parametrize("header", ["bearer {}", "BEARER {}", "  Bearer   {}  "])
def test_the_scheme_is_read_whatever_its_case(header: str) -> None:
    key, secret = new_key("a", Scope.READ, now=NOW)
    assert authenticate(header.format(secret), FakeTable(key), settings()).key_id == key.key_id


def test_an_unknown_key_is_refused_however_often_it_comes() -> None:
    table = FakeTable(new_key("a", Scope.READ, now=NOW)[0])
    other = new_key("b", Scope.ADMIN, now=NOW)[1]
    for _ in range(3):
        with pytest.raises(UnauthorizedError, match="not known"):
            authenticate(bearer(other), table, settings())
    assert table.asked == 3


def test_many_requests_of_a_key_ask_the_table_once_in_some_seconds() -> None:
    key, secret = new_key("a", Scope.READ, now=NOW)
    table = FakeTable(key)
    for number in range(200):
        authenticate(bearer(secret), table, settings(), now_s=TRUST_S * number / 200.0)
    assert table.asked == 1
    authenticate(bearer(secret), table, settings(), now_s=TRUST_S)
    assert table.asked == 2


def test_a_revoked_key_works_no_longer_than_some_seconds() -> None:
    key, secret = new_key("a", Scope.READ, now=NOW)
    table = FakeTable(key)
    authenticate(bearer(secret), table, settings(), now_s=0.0)
    table.revoke(key)
    with pytest.raises(UnauthorizedError, match="was revoked"):
        authenticate(bearer(secret), table, settings(), now_s=TRUST_S)
    assert TRUST_S <= 5.0


def test_a_key_is_accepted_until_it_expires() -> None:
    key, secret = new_key("a", Scope.READ, now=NOW, lasting=dt.timedelta(days=2))
    table = FakeTable(key)
    just_before = NOW + dt.timedelta(days=2, microseconds=-1)
    assert authenticate(bearer(secret), table, settings(), at=just_before).key_id == key.key_id
    with pytest.raises(UnauthorizedError, match="'a' expired on 2026-03-03"):
        authenticate(bearer(secret), table, settings(), at=NOW + dt.timedelta(days=2))


def test_the_old_secret_of_a_rotated_key_works_for_a_while() -> None:
    first, old = new_key("a", Scope.READ, now=NOW, lasting=dt.timedelta(days=9))
    key, new = rotated(first, now=NOW, grace=dt.timedelta(hours=3))
    assert (key.key_id, key.expires_at) == (first.key_id, first.expires_at)
    table = FakeTable(key)
    for secret in (old, new):
        assert authenticate(bearer(secret), table, settings(), at=NOW).key_id == key.key_id
    later = NOW + dt.timedelta(hours=3)
    assert authenticate(bearer(new), table, settings(), at=later).key_id == key.key_id
    with pytest.raises(UnauthorizedError, match="old secret is no longer accepted"):
        authenticate(bearer(old), table, settings(), at=later)
    longer, _ = rotated(key, now=NOW, grace=dt.timedelta(0), lasting=dt.timedelta(days=30))
    assert longer.expires_at == NOW + dt.timedelta(days=30)
    assert longer.old_digest == key.digest


def test_services_in_one_process_do_not_share_their_keys() -> None:
    key, secret = new_key("a", Scope.READ, now=NOW)
    authenticate(bearer(secret), FakeTable(key), settings())
    with pytest.raises(UnauthorizedError):
        authenticate(bearer(secret), FakeTable(new_key("b", Scope.READ, now=NOW)[0]), settings())


def test_a_key_is_in_no_message_and_no_log(caplog: pytest.LogCaptureFixture) -> None:
    key, secret = new_key("a", Scope.READ, now=NOW)
    table = FakeTable(new_key("b", Scope.READ, now=NOW)[0])
    with caplog.at_level(logging.DEBUG):
        for header in (bearer(secret), f"Basic {secret}", bearer(secret + "x")):
            with pytest.raises(UnauthorizedError) as caught:
                authenticate(header, table, settings())
            assert secret[3:20] not in str(caught.value)
    assert secret[3:20] not in caplog.text
    assert key.digest not in caplog.text


def test_remembered_keys_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(auth, "REMEMBERED", 10)
    made = [new_key(str(number), Scope.READ, now=NOW) for number in range(30)]
    table = FakeTable(*(key for key, _ in made))
    for _, secret in made:
        authenticate(bearer(secret), table, settings())
    assert len(auth._memory_of(table)._keys) <= 10
