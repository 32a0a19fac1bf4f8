"""The patterns of the OpenAPI document and the code agree: a text of a pattern is refused only for what it means."""

from __future__ import annotations

import re
from collections.abc import Callable
from zoneinfo import available_timezones

import pytest
from examples import examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.schedule.cron import LONGEST, expression_faults
from service.deliveries import key_of
from service.errors import RequestError
from service.routes.tus import _checksum, _metadata
from service.wire import patterns
from service.wire.inputs import _printable
from service.wire.queries import interval, window, words

WORDS = ["ok", "fallback", "failed"]


def cron(text: str) -> None:
    if faults := expression_faults(text):
        raise RequestError(faults)


CASES: dict[str, tuple[str, Callable[[str], object], str, list[str], list[str]]] = {
    "interval": (
        patterns.INTERVAL,
        interval,
        "use a day that exists|use an end that is not before",
        ["2026-03-01", "2026-03-01T09:30Z", "../2026-03-01T09:30:00.5+02:00", "2024-02-29/", "/"],
        ["", "2026-13-01", "2026-03-32", "2026-03-01T25:00Z", "today", "2026-03-01/2026-03-02/..", " 2026-03-01"],
    ),
    "window": (
        patterns.WINDOW,
        lambda text: window(text, in_degrees=True),
        "longitudes reach|lies north",
        ["4.35,51.99,4.37,52.01", "1,2,3,4", "-1e1,+.5, 3. ,4"],
        ["", "1,2,3", "1,2,3,4,5", "a,b,c,d", "1_0,2,3,4", "nan,1,2,3", "1e999,2,3,4", "inf,2,3,4"],
    ),
    "key": (
        patterns.KEY,
        lambda text: key_of([text]),
        "nothing",
        ['"a b"', "8e03978e-40d5", r'"\""', "x" * 255],
        ["", '""', '"a', "a b", "a,b", "a;b", "x" * 256, '"tab\there"'],
    ),
    "metadata": (
        patterns.METADATA,
        _metadata,
        "twice|UTF-8|has no filename",
        ["filename ZGVsZnRfZWFzdC5sYXo=", "is_secret,filename YQ==,sha256 YWI="],
        ["", "filename", "filename a", "name YQ=="],
    ),
    "checksum": (
        patterns.CHECKSUM,
        _checksum,
        "nothing",
        ["sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0="],
        ["", "md5 Kq5sNclPz7QV2+lfQIuc6R7oRu0=", "sha1 Kq5s", "sha256 Kq5sNclPz7QV2+lfQIuc6R7oRu0="],
    ),
    "text": (patterns.TEXT, _printable, "nothing", ["a", " a\tb\n"], ["", "  ", "a\x00", "\x7fa", "\x85"]),
    "cron": (
        patterns.CRON,
        cron,
        "a range goes up|this date never occurs",
        ["30 2 * * *", "*/5 8-18/2 1,15 JAN-mar MON-FRI", "@daily", "0 0 LW * 5L", "00 05 * * 1#2"],
        ["", "* * * *", "60 0 * * *", "0 24 * * *", "0 0 0 * *", "0 0 * 13 *", "0 0 * * 8", "@often", "a b c d e"],
    ),
    "words": (
        patterns.any_of(WORDS),
        lambda text: words(WORDS)([text]),
        "nothing",
        ["ok", "ok, failed,", ""],
        ["okay"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_text_of_the_pattern_is_refused_only_for_what_it_means(name: str) -> None:
    pattern, read, meaning, _, _ = CASES[name]
    texts = st.from_regex(pattern, fullmatch=True).filter(lambda text: text == text.strip() and len(text) <= LONGEST)

    @settings(max_examples=examples(50), suppress_health_check=list(HealthCheck), deadline=None)
    @given(texts)
    def check(text: str) -> None:
        faults = []
        try:
            read(text)
        except (RequestError, ValueError) as fault:
            faults = [str(fault)]
        assert all(re.search(meaning, fault) for fault in faults), (text, faults)

    check()


@pytest.mark.parametrize("name", CASES)
def test_the_pattern_and_the_code_take_and_refuse_the_same_examples(name: str) -> None:
    pattern, read, _, right, wrong = CASES[name]
    for text in right:
        assert patterns.fits(pattern, text), text
        read(text)
    for text in wrong:
        assert not patterns.fits(pattern, text), text
        with pytest.raises((RequestError, ValueError)):
            read(text)


def test_every_time_zone_has_a_name_of_the_pattern() -> None:
    assert [name for name in available_timezones() if not patterns.fits(patterns.ZONE, name)] == []
