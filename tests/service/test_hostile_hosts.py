"""Hosts of inputs that do their worst: each wait for them ends in time, and at once if the job is cancelled."""

import dataclasses
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hostile_host import TEMPERS, TRICKLING, HostileHost, hostile_host
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import RunCancelledError, UnreadableInputError
from service import downloads
from service.downloads import BACKOFF, download
from service.errors import TooLargeError
from service.fetching import gather
from service.files import StateFolder
from service.jobs import InputReference, JobRequest
from service.pace import Pace
from service.settings import ServiceSettings

SLOW_S = 1.5
"""Seconds that a share of the bytes may take here."""
TOO_SLOW = r"the server sends less than 1000 bytes per second over 1\.5 s"


@pytest.fixture
def host() -> Iterator[HostileHost]:
    """A host whose trickle is fifty bytes a second."""
    with hostile_host(pause_s=0.02) as one:
        yield one


def fetched(
    host: HostileHost, temper: str, folder: Path, cancelled: Callable[[], bool] = lambda: False, **limits: Any
) -> list[int]:
    """Fetch a file, which fails; what was reported meanwhile. Nothing of it stays."""
    settings = ServiceSettings(state=folder, input_hosts=(host.origin, f"http://{host.origin}"), **limits)
    reported: list[int] = []
    try:
        download(host.url(temper), settings=settings, target=folder, cancelled=cancelled, progress=reported.append)
    finally:
        assert not [path for path in folder.rglob("*") if path.is_file()]
    return reported


@pytest.mark.parametrize("temper", [*TRICKLING, "silence", "stop", "hints"])
def test_a_host_that_is_slower_than_allowed_is_given_up(host: HostileHost, temper: str, tmp_path: Path) -> None:
    with pytest.raises(UnreadableInputError, match=TOO_SLOW):
        fetched(host, temper, tmp_path, slow_s=SLOW_S)
    assert host.requests


@pytest.mark.parametrize("temper", [*TRICKLING, *TEMPERS])
def test_a_cancelled_job_does_not_wait_for_any_host(host: HostileHost, temper: str, tmp_path: Path) -> None:
    with pytest.raises(RunCancelledError):
        fetched(
            host,
            temper,
            tmp_path,
            lambda: bool(host.requests),
            # no other limit can end it
            slow_s=3600.0,
            silent_s=3600.0,
            max_fetch_s=36_000.0,
            max_upload_bytes=1 << 60,
            reserve_bytes=0,
        )


def test_a_cancelled_job_does_not_wait_for_the_look_up_of_a_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, answered = threading.Event(), threading.Event()

    def look_up(*_args: object, **_values: object) -> list[Any]:
        asked.set()
        answered.wait()
        return []

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    settings = ServiceSettings(state=tmp_path, input_hosts=("http://host.example",))
    try:
        with pytest.raises(RunCancelledError):
            download("http://host.example/a.laz", settings=settings, target=tmp_path, cancelled=asked.is_set)
    finally:
        answered.set()


def test_the_time_for_one_file_holds_however_fast_it_comes(host: HostileHost, tmp_path: Path) -> None:
    with pytest.raises(UnreadableInputError, match=r"not fetched within 0\.2 s"):
        fetched(host, "endless", tmp_path, max_fetch_s=0.2, max_upload_bytes=1 << 60, reserve_bytes=0)


def test_silence_ends_an_attempt_and_another_one_follows(
    host: HostileHost, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(downloads, "BACKOFF", dataclasses.replace(BACKOFF, first_s=0.0))
    with pytest.raises(UnreadableInputError, match=r"does not answer \(ReadTimeout\) \(tried 4 times\)"):
        fetched(host, "stop", tmp_path, silent_s=0.2)
    assert len(host.requests) == BACKOFF.attempts


@pytest.mark.parametrize("temper", ["heads", "short", "negative"])
def test_an_answer_that_breaks_the_protocol_is_given_up_after_some_attempts(
    host: HostileHost, temper: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(downloads, "BACKOFF", dataclasses.replace(BACKOFF, first_s=0.0))
    with pytest.raises(UnreadableInputError, match=r"does not answer \(RemoteProtocolError\) \(tried 4 times\)"):
        fetched(host, temper, tmp_path)
    assert len(host.requests) == BACKOFF.attempts


def test_pauses_that_a_host_asks_for_are_short_and_do_not_count_as_slow(
    host: HostileHost, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert BACKOFF.longest_s <= 60.0
    rests: list[float] = []
    monkeypatch.setattr(downloads, "BACKOFF", dataclasses.replace(BACKOFF, longest_s=0.01))
    monkeypatch.setattr(Pace, "rest", lambda _pace, seconds: rests.append(seconds))
    with pytest.raises(UnreadableInputError, match=r"the server answers 429 \(tried 4 times\)"):
        fetched(host, "busy", tmp_path)
    assert rests == [0.01] * 3


def test_bytes_are_reported_as_they_come_and_a_trickle_is_not(
    host: HostileHost, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(downloads, "REPORT_S", 0.0)
    reported: list[int] = []
    settings = ServiceSettings(state=tmp_path, input_hosts=(f"http://{host.origin}",), max_upload_bytes=1_000_000)
    with pytest.raises(TooLargeError):
        download(
            host.url("endless"),
            settings=settings,
            target=tmp_path,
            cancelled=lambda: False,
            progress=reported.append,
        )
    assert len(reported) > 2
    assert reported == sorted(reported)
    assert reported[-1] <= 1_000_000 + 65_536
    reported.clear()
    settings = settings.model_copy(update={"slow_s": SLOW_S})
    with pytest.raises(UnreadableInputError, match=TOO_SLOW):
        download(
            host.url("body"), settings=settings, target=tmp_path, cancelled=lambda: False, progress=reported.append
        )
    assert reported == []


def test_the_bytes_of_all_inputs_are_reported_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fetch(text: str, *, progress: Callable[[int], None], **_values: object) -> tuple[Path, str]:
        for so_far in (5, 10):
            progress(so_far)
        return tmp_path / text.rpartition("/")[2], "0" * 64

    monkeypatch.setattr("service.fetching.download", fetch)
    monkeypatch.setattr("service.fetching.preflight", lambda *_: {})
    reported: list[int] = []
    tiles = tuple(InputReference(kind="url", value=f"https://host.example/{name}.laz") for name in "ab")
    gather(
        JobRequest(tiles=tiles),
        store=None,  # type: ignore[arg-type]  # no input is an upload
        folder=StateFolder(tmp_path),
        settings=ServiceSettings(state=tmp_path),
        target=tmp_path,
        cancelled=lambda: False,
        progress=reported.append,
    )
    # an input that was examined is progress, too
    assert reported == [5, 10, 10, 15, 20, 20]


# --- the pace, without a clock ---------------------------------------------------------------------------------------

RATE = 1000.0
WITHIN_S = 60.0


def ended_at(rate: float, pieces_s: list[float]) -> float | None:
    """When a transfer of constant rate, whose pieces come at such intervals, is found slow; None if it is not."""
    pace, now_s = Pace(RATE, WITHIN_S, now_s=0.0), 0.0
    for pause_s in pieces_s:
        now_s += pause_s
        if pace.is_slow(now_s):
            return now_s
        pace.took(int(rate * pause_s), now_s)
    return None


@given(st.floats(1.05, 1000.0), st.lists(st.floats(0.01, 1.0), min_size=1, max_size=300))
def test_a_transfer_above_the_lowest_rate_may_go_on_for_ever(factor: float, pieces_s: list[float]) -> None:
    assert ended_at(factor * RATE + 100.0, pieces_s) is None


def test_a_rest_is_left_out() -> None:
    pace = Pace(RATE, WITHIN_S, now_s=0.0)
    pace.rest(100.0)
    assert not pace.is_slow(159.0)
    assert pace.is_slow(161.0)


@given(st.floats(0.0, 0.95), st.floats(0.01, 1.0))
def test_a_transfer_below_the_lowest_rate_ends_after_its_time(factor: float, piece_s: float) -> None:
    pieces_s = [piece_s] * (int(WITHIN_S / piece_s) + 3)
    found = ended_at(factor * RATE, pieces_s)
    assert found is not None
    assert WITHIN_S < found <= WITHIN_S + piece_s * 1.001
