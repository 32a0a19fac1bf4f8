"""Cron times: against a slow scalar twin that looks at every minute, and on the days when clocks are shifted."""

import dataclasses
import datetime as dt
import itertools
import sys
import zoneinfo

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.schedule import Cron, time_zone
from pipeline.schedule.cron import LONGEST, WORDS, expression_faults

MINUTE = dt.timedelta(minutes=1)

SHIFTS = {
    "Europe/Amsterdam": ("2026-03-29", "2026-10-25"),
    "America/New_York": ("2026-03-08", "2026-11-01"),
    "Australia/Lord_Howe": ("2026-10-04", "2026-04-05"),
    "America/Havana": ("2026-03-08", "2026-11-01"),
    "Asia/Kathmandu": ("2026-03-29", "2026-10-25"),
    "UTC": ("2026-03-29", "2026-10-25"),
}
"""Days on which clocks are put forward and back (where there are such days): by 60 min, by 30 min, at midnight."""


def start_of(day: str, zone: str) -> dt.datetime:
    """Midnight at the beginning of a day."""
    return dt.datetime.fromisoformat(day).replace(tzinfo=time_zone(zone))


def times_of(expression: str, zone: str, day: str) -> list[str]:
    """The times of a day, as the clock on the wall shows them, with the offset to UTC."""
    start = start_of(day, zone)
    end = dt.datetime.combine(start.date() + dt.timedelta(days=1), dt.time(), start.tzinfo).astimezone(dt.UTC)
    found = Cron(expression, zone).times(start.astimezone(dt.UTC) - dt.timedelta(seconds=1))
    inside = itertools.takewhile(lambda at: at.astimezone(dt.UTC) < end, found)
    return [f"{at:%H:%M%z}" for at in inside]


# --- the twin


@dataclasses.dataclass(frozen=True)
class Fields:
    """An expression as sets, so that the twin reads nothing."""

    minutes: frozenset[int]
    hours: frozenset[int]
    days: frozenset[int] | None
    months: frozenset[int] | None
    weekdays: frozenset[int] | None

    def text(self) -> str:
        return " ".join(
            "*" if chosen is None or chosen == every else ",".join(map(str, sorted(chosen)))
            for chosen, every in (
                (self.minutes, frozenset(range(60))),
                (self.hours, frozenset(range(24))),
                (self.days, None),
                (self.months, None),
                (self.weekdays, None),
            )
        )

    @property
    def is_fixed(self) -> bool:
        return len(self.minutes) < 60 and len(self.hours) < 24

    def fit(self, wall: dt.datetime) -> bool:
        if wall.minute not in self.minutes or wall.hour not in self.hours:
            return False
        if self.months is not None and wall.month not in self.months:
            return False
        of_month = self.days is None or wall.day in self.days
        of_week = self.weekdays is None or wall.isoweekday() % 7 in self.weekdays
        either = self.days is not None and self.weekdays is not None
        return (of_month or of_week) if either else (of_month and of_week)


def subsets(low: int, high: int) -> st.SearchStrategy[frozenset[int]]:
    return st.frozensets(st.integers(low, high), min_size=1, max_size=5)


FIELD_SETS = st.builds(
    Fields,
    minutes=subsets(0, 59) | st.just(frozenset(range(60))),
    # where clocks are shifted, mostly
    hours=subsets(0, 4) | subsets(0, 23) | st.just(frozenset(range(24))),
    days=st.none() | subsets(1, 31),
    months=st.none() | st.just(frozenset({3, 4, 10, 11})),
    weekdays=st.none() | subsets(0, 6),
)


def twin(fields: Fields, zone: str, after: dt.datetime, until: dt.datetime) -> list[dt.datetime]:
    """All times in UTC, by looking at every minute on the wall and in UTC."""
    place = time_zone(zone)
    margin = dt.timedelta(hours=3)
    shown: dict[dt.datetime, list[dt.datetime]] = {}
    at = after - margin
    while at <= until + margin:
        shown.setdefault(at.astimezone(place).replace(tzinfo=None, fold=0), []).append(at)
        at += MINUTE
    found: set[dt.datetime] = set()
    wall, end = min(shown), max(shown)
    while wall <= end:
        if fields.fit(wall):
            if not fields.is_fixed:
                found.update(shown.get(wall, []))
            else:
                real = wall
                while real not in shown and real <= end:
                    real += MINUTE
                found.update(shown.get(real, [])[:1])
        wall += MINUTE
    return sorted(at for at in found if after < at <= until)


@pytest.mark.parametrize("zone", SHIFTS)
@given(fields=FIELD_SETS, which=st.integers(0, 1), begin=st.integers(-120, 300))
@settings(max_examples=examples(40), deadline=None)
def test_the_times_around_a_shift_are_those_of_the_twin(zone: str, fields: Fields, which: int, begin: int) -> None:
    after = start_of(SHIFTS[zone][which], zone).astimezone(dt.UTC) + begin * MINUTE
    until = after + dt.timedelta(hours=9)
    expected = twin(fields, zone, after, until)
    text = fields.text()
    if expression_faults(text):
        assert expected == []  # 31 February and the like
        return
    found = [at.astimezone(dt.UTC) for at in Cron(text, zone).next_times(after, len(expected) + 1)]
    assert found[: len(expected)] == expected
    assert all(at > until for at in found[len(expected) :])


@given(fields=FIELD_SETS, zone=st.sampled_from(sorted(SHIFTS)))
@settings(max_examples=examples(100), deadline=None)
def test_times_strictly_increase_and_from_each_the_next_is_found(fields: Fields, zone: str) -> None:
    if expression_faults(fields.text()):
        return
    cron = Cron(fields.text(), zone)
    times = cron.next_times(dt.datetime(2026, 3, 1, tzinfo=dt.UTC), 60)
    utc = [at.astimezone(dt.UTC) for at in times]
    assert all(one < other for one, other in itertools.pairwise(utc))
    assert len(set(utc)) == 60
    assert [cron.next_time(at).astimezone(dt.UTC) for at in times[:-1]] == utc[1:]
    # what the clock shows at a time is a time that exists
    assert all(
        at.astimezone(dt.UTC).astimezone(at.tzinfo).replace(tzinfo=None) == at.replace(tzinfo=None) for at in times
    )


def test_every_minute_of_a_plain_day_is_hit_once() -> None:
    minutes = times_of("* * * * *", "Europe/Amsterdam", "2026-06-01")
    assert minutes == [f"{hour:02}:{minute:02}+0200" for hour in range(24) for minute in range(60)]


# --- the days when clocks are shifted, in figures


@pytest.mark.parametrize(
    ("expression", "zone", "day", "expected"),
    [
        # put forward: a fixed time in the gap comes when it ends, and several of them come once
        ("30 2 * * *", "Europe/Amsterdam", "2026-03-29", ["03:00+0200"]),
        ("0,15,30 2 * * *", "Europe/Amsterdam", "2026-03-29", ["03:00+0200"]),
        ("0 2,3 * * *", "Europe/Amsterdam", "2026-03-29", ["03:00+0200"]),
        ("30 2 * * *", "America/New_York", "2026-03-08", ["03:00-0400"]),
        ("15 2 * * *", "Australia/Lord_Howe", "2026-10-04", ["02:30+1100"]),
        ("45 2 * * *", "Australia/Lord_Howe", "2026-10-04", ["02:45+1100"]),
        ("0 0 * * *", "America/Havana", "2026-03-08", ["01:00-0400"]),
        # put back: a fixed time that comes twice counts once, the first one
        ("30 2 * * *", "Europe/Amsterdam", "2026-10-25", ["02:30+0200"]),
        ("30 1 * * *", "America/New_York", "2026-11-01", ["01:30-0400"]),
        ("45 1 * * *", "Australia/Lord_Howe", "2026-04-05", ["01:45+1100"]),
        ("30 0 * * *", "America/Havana", "2026-11-01", ["00:30-0400"]),
        # wildcards follow the wall: nothing in the gap, twice what comes twice
        ("*/30 2 * * *", "Europe/Amsterdam", "2026-03-29", []),
        ("*/30 2 * * *", "Europe/Amsterdam", "2026-10-25", ["02:00+0200", "02:30+0200", "02:00+0100", "02:30+0100"]),
        ("*/15 2 * * *", "Australia/Lord_Howe", "2026-10-04", ["02:30+1100", "02:45+1100"]),
        ("*/30 1 * * *", "Australia/Lord_Howe", "2026-04-05", ["01:00+1100", "01:30+1100", "01:30+1030"]),
        ("*/15 3 * * *", "Australia/Lord_Howe", "2026-04-05", ["03:00+1030", "03:15+1030", "03:30+1030", "03:45+1030"]),
        ("0 */6 * * *", "America/Havana", "2026-03-08", ["06:00-0400", "12:00-0400", "18:00-0400"]),
        # places without such days
        ("30 2 * * *", "Asia/Kathmandu", "2026-03-29", ["02:30+0545"]),
        ("30 2 * * *", "UTC", "2026-03-29", ["02:30+0000"]),
    ],
)
def test_a_day_on_which_clocks_are_shifted(expression: str, zone: str, day: str, expected: list[str]) -> None:
    assert times_of(expression, zone, day) == expected


@pytest.mark.parametrize(
    ("zone", "day", "hours"),
    [
        ("Europe/Amsterdam", "2026-03-29", 23),
        ("Europe/Amsterdam", "2026-10-25", 25),
        ("America/New_York", "2026-03-08", 23),
        ("America/New_York", "2026-11-01", 25),
        ("Asia/Kathmandu", "2026-03-29", 24),
        ("UTC", "2026-10-25", 24),
    ],
)
def test_an_hourly_run_comes_as_often_as_the_day_has_hours(zone: str, day: str, hours: int) -> None:
    assert len(times_of("@hourly", zone, day)) == hours


@pytest.mark.parametrize("zone", SHIFTS)
def test_a_daily_run_comes_once_on_each_day_of_a_year(zone: str) -> None:
    for expression in ("30 2 * * *", "15 0 * * *", "45 1 * * *"):
        times = Cron(expression, zone).next_times(start_of("2026-01-01", zone), 365)
        assert [at.timetuple().tm_yday for at in times] == list(range(1, 366))


def test_a_start_in_the_second_of_two_hours_finds_nothing_that_has_passed() -> None:
    second = dt.datetime(2026, 10, 25, 2, 20, tzinfo=zoneinfo.ZoneInfo("Europe/Amsterdam"), fold=1)
    assert Cron("30 2 * * *", "Europe/Amsterdam").next_time(second).isoformat() == "2026-10-26T02:30:00+01:00"
    first = second.replace(minute=50, fold=0)
    assert Cron("*/15 2 * * *", "Europe/Amsterdam").next_time(first).isoformat() == "2026-10-25T02:00:00+01:00"


# --- words, letters, faults


def test_words_names_and_letters_are_understood() -> None:
    def first(expression: str) -> str:
        return f"{Cron(expression, 'UTC').next_time(dt.datetime(2026, 1, 1, 0, 0, 30, tzinfo=dt.UTC)):%m-%d %H:%M}"

    assert {word: first(word) for word in WORDS} == {
        "@hourly": "01-01 01:00",
        "@daily": "01-02 00:00",
        "@midnight": "01-02 00:00",
        "@weekly": "01-04 00:00",
        "@monthly": "02-01 00:00",
        "@yearly": "01-01 00:00",
        "@annually": "01-01 00:00",
    }
    assert first(" @Daily ") == "01-02 00:00"
    assert first("0 3 * * mon-fri") == "01-01 03:00"
    assert first("0 3 * feb sun") == "02-01 03:00"
    assert first("0 3 L * *") == "01-31 03:00"
    assert first("0 3 LW * *") == "01-30 03:00"
    assert first("0 3 * * MON#2") == "01-12 03:00"
    assert first("0 3 * * 7") == first("0 3 * * 0") == "01-04 03:00"
    # a star in neither field of days: one of them is enough
    assert first("0 3 20 * MON") == "01-05 03:00"


@pytest.mark.parametrize(
    ("expression", "fault"),
    [
        ("61 * * * *", "minute is '61', use 0 to 59"),
        ("* 25 0 13 9", "hour is '25'"),
        ("* 25 0 13 9", "day-of-month is '0'"),
        ("* 25 0 13 9", "month is '13'"),
        ("* 25 0 13 9", "day-of-week is '9'"),
        ("0 3 * * FRI-SUN", "write FRI,SAT,SUN"),
        ("*/0 * * * *", r"minute is '\*/0'"),
        ("* * *", "with 3 fields: use five"),
        ("0 0 3 * * *", "with 6 fields: use five"),
        ("", "with 0 fields"),
        ("@reboot", "use one of @hourly"),
        ("0 0 31 2 *", "this date never occurs"),
        ("0 0 30,31 feb *", "this date never occurs"),
        ("1" * (LONGEST + 1), f"use at most {LONGEST}"),
        ("9" * 150 + " * * * *", "minute is"),
    ],
)
def test_a_bad_expression_is_reported_with_its_field_and_the_fix(expression: str, fault: str) -> None:
    with pytest.raises(SettingsError, match=fault):
        Cron(expression, "UTC")


@given(st.text(max_size=40) | st.from_regex(r"([0-9*,/#LW-]{1,6} ){4}[0-9*,/#L-]{1,6}", fullmatch=True))
@settings(max_examples=examples(120), deadline=None)
def test_any_text_is_an_expression_or_a_reported_fault(text: str) -> None:
    faults = expression_faults(text)
    if faults:
        assert all(fault.startswith("cron is") for fault in faults)
        with pytest.raises(SettingsError):
            Cron(text, "Europe/Amsterdam")
        return
    after = dt.datetime(2026, 3, 1, tzinfo=dt.UTC)
    assert Cron(text, "Europe/Amsterdam").next_time(after) > after


@pytest.mark.parametrize(
    "name",
    [
        "Europe/Amstedam",
        "europe/amsterdam",
        "",
        "../UTC",
        "/etc/localtime",
        "Europe",
        "localtime",
        "right/UTC",
        "a\0",
        "x" * 300,
    ],
)
def test_a_zone_that_is_not_known_is_reported(name: str) -> None:
    with pytest.raises(SettingsError, match=r"time zone is .* not known: (did you mean|use a name)"):
        Cron("@daily", name)


def test_the_likely_zone_is_named() -> None:
    with pytest.raises(SettingsError, match=r"did you mean Europe/Amsterdam"):
        time_zone("europe/amstedam")


def test_expression_and_zone_are_reported_at_once() -> None:
    with pytest.raises(SettingsError) as raised:
        Cron("61 * * * *", "Mars/Olympus")
    assert len(raised.value.faults) == 2


def test_without_a_database_of_zones_utc_works_and_the_others_tell_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("tzdata", *(name for name in sys.modules if name.startswith("tzdata."))):
        monkeypatch.setitem(sys.modules, name, None)  # pandas brings it
    before = zoneinfo.TZPATH
    zoneinfo.reset_tzpath(to=[])
    zoneinfo.ZoneInfo.clear_cache()
    time_zone.cache_clear()
    try:
        assert Cron("@daily", "UTC").next_time(dt.datetime(2026, 1, 1, tzinfo=dt.UTC)).day == 2
        with pytest.raises(SettingsError, match="install the system's package tzdata"):
            time_zone("Europe/Amsterdam")
    finally:
        zoneinfo.reset_tzpath(to=before)
        zoneinfo.ZoneInfo.clear_cache()


def test_a_time_without_a_zone_is_refused() -> None:
    with pytest.raises(ValueError, match="has no time zone"):
        Cron("@daily", "UTC").next_time(dt.datetime(2026, 1, 1))  # noqa: DTZ001
