"""Jobs as records, and what is decided about them: no database, no clock."""

import datetime as dt
import errno
import json
import logging
import re
from pathlib import Path
from typing import Any

import pytest
from driver_bench import run_summary
from hypothesis import given
from hypothesis import strategies as st

import service.jobs
from pipeline.errors import ClusterError, CrsError, RunError, SettingsError, UnreadableInputError, VersionMismatchError
from pipeline.runtime.monitoring.log_lines import formatter
from service.driver.failure_words import Scrubber, digest_of, outcome
from service.driver.failures import failure_of, is_tried_again
from service.driver.job_progress import CLASSIFY_WEIGHTS, COMPILING, WEIGHTS, WORDS, percent
from service.errors import InputRefusedError, NoSpaceError, NoSuchUploadError, RequestError, StoreError, TooLargeError
from service.jobs import Fault, InputReference, Job, JobRequest, JobStatus
from service.settings import ServiceSettings
from service.store.changes import MAX_KEPT
from service.store.policies import duration_ms, lease_expired, loss

NOON = dt.datetime(2026, 5, 1, 12, tzinfo=dt.UTC)


def job(**values: Any) -> Job:
    request = JobRequest(tiles=(InputReference(kind="path", value="/a.laz"),))
    known = {"job_id": "0" * 32, "owner": None, "request": request, "status": JobStatus.RUNNING}
    return Job(**{**known, "created_at": NOON, "updated_at": NOON, **values})


# --- records


references = st.builds(InputReference, kind=st.sampled_from(["upload", "path", "url"]), value=st.text(max_size=20))
numbers = st.floats(allow_nan=False, allow_infinity=False)
requests = st.builds(
    JobRequest,
    tiles=st.lists(references, min_size=1, max_size=3).map(tuple),
    footprints=st.none() | references,
    guides=st.none() | references,
    bbox=st.none() | st.tuples(numbers, numbers, numbers, numbers),
    settings=st.dictionaries(st.text(max_size=5), numbers | st.booleans() | st.text(max_size=5), max_size=3),
    outputs=st.none() | st.lists(st.text(max_size=5), max_size=3).map(tuple),
    title=st.none() | st.text(max_size=20),
)


@given(requests)
def test_a_request_survives_json(request: JobRequest) -> None:
    assert JobRequest.from_dict(json.loads(json.dumps(request.as_dict()))) == request


# --- leases


@pytest.mark.parametrize(
    ("left_s", "expired"),
    [(1.0, False), (0.001, False), (0.0, True), (-5.0, True)],
)
def test_a_lease_counts_until_its_very_end(left_s: float, expired: bool) -> None:
    held = job(lease_owner="a", lease_until=NOON + dt.timedelta(seconds=left_s))
    assert lease_expired(held, NOON) is expired


@pytest.mark.parametrize("status", [status for status in JobStatus if status is not JobStatus.RUNNING])
def test_only_a_running_job_has_a_lease(status: JobStatus) -> None:
    assert not lease_expired(job(status=status, lease_until=NOON), NOON + dt.timedelta(days=1))


def test_a_loss_names_the_number_the_stage_and_the_fix() -> None:
    reported = loss(job(lost_attempts=2, stage="split"))
    assert reported.fault is Fault.LOST
    assert reported.detail.startswith("3 drivers were lost during this job (the last one at stage split)")
    assert "smaller tiles" in reported.detail


def test_a_duration_runs_from_the_first_claim() -> None:
    assert duration_ms(job(), NOON) is None
    assert duration_ms(job(started_at=NOON), NOON + dt.timedelta(seconds=1.5)) == 1500
    # a clock that was put back gives no negative time
    assert duration_ms(job(started_at=NOON), NOON - dt.timedelta(hours=1)) == 0


# --- progress


@given(st.lists(st.tuples(st.sampled_from(list(WEIGHTS)), st.integers(0, 50), st.integers(0, 50)), max_size=30))
def test_progress_grows_with_the_stages_and_within_them(steps: list[tuple[str, int, int]]) -> None:
    order = list(WEIGHTS)
    steps = sorted((order.index(stage), done / total if total else 0.0, done, total) for stage, done, total in steps)
    found = [percent(order[number], done, total) for number, _, done, total in steps]
    assert found == sorted(found)
    assert all(0 <= value <= 99 for value in found)


def test_the_stages_make_up_the_whole_job() -> None:
    # what a comparison does besides is short: progress stands still meanwhile; kernels are compiled once
    others = {"compile", "redraw", "records", "points", "pictures", "page"}
    assert set(WORDS) - set(WEIGHTS) - set(CLASSIFY_WEIGHTS) == others
    assert [percent("compile", done, 100) for done in (0, 50, 100)] == [0, COMPILING // 2, COMPILING]
    for weights in (WEIGHTS, CLASSIFY_WEIGHTS):
        assert sum(weights.values()) == 100
        assert set(weights) <= set(WORDS)
    assert percent("write", 1, 2, CLASSIFY_WEIGHTS) == 76
    assert percent("inputs", 0, 0) == 0
    assert percent("outputs", 5, 5) == 99
    assert percent("unheard of", 5, 5) == 0


# --- sentences


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("/var/lib/gablework/jobs/ab/run is not empty", "run is not empty"),
        ("[Errno 13] Permission denied: '/srv/x/y.npy'", "[Errno 13] Permission denied: 'y.npy'"),
        ("3 m/s and 4 points/m2, eave/ridge", "3 m/s and 4 points/m2, eave/ridge"),
        ("see https://example.org/a/b/c for it", "see https://example.org/a/b/c for it"),
        ("the scheduler tcp://10.0.0.1:8786 was lost", "the scheduler was lost"),
        ("scheduler tls://[::1]:8786: python 3.11", "scheduler: python 3.11"),
        ("./tiles/a.laz", "./tiles/a.laz"),
        ("/a/b/ is a folder", "… is a folder"),
    ],
)
def test_messages_lose_the_paths_of_the_machine_and_nothing_else(message: str, expected: str) -> None:
    assert Scrubber()(message) == expected


def test_a_path_with_blanks_is_replaced_by_its_name() -> None:
    scrub = Scrubber()
    scrub.name("/my state/", "/state/")
    scrub.name("/my state/uploads/0a/my tile.laz", "my tile.laz")
    assert scrub("/my state/uploads/0a/my tile.laz: bad") == "my tile.laz: bad"
    assert scrub("/my state/uploads/0b") == "0b"


def test_the_outcome_is_reported_honestly() -> None:
    summary = run_summary(statuses={"ok": 78, "failed": 2}, rejected={"tree": 120, "car": 9})
    assert outcome(summary) == "80 buildings: 78 ok, 0 doubtful, 0 fallback, 2 failed; 129 objects rejected"
    worse = run_summary(statuses={"fallback": 1}, rejected={}, failed_tiles=("x1_y2",), warnings=("w",))
    assert outcome(worse) == (
        "1 building: 0 ok, 0 doubtful, 1 fallback, 0 failed; "
        "1 tile could not be published: its buildings are missing; 1 warning"
    )
    without = run_summary(statuses={"ok": 1}, rejected={}, tiles_without_points=("x1_y2", "x1_y3"))
    one = "1 building: 1 ok, 0 doubtful, 0 fallback, 0 failed"
    assert outcome(without) == f"{one}; the points of 2 tiles could not be written"
    assert digest_of(without, Scrubber(), "1.0")["tiles_without_points"] == ["x1_y2", "x1_y3"]
    bare = run_summary(statuses={"ok": 1}, rejected={}, tiles_without_terrain=("x1_y2",))
    assert outcome(bare) == f"{one}; the terrain of 1 tile could not be written"
    assert digest_of(bare, Scrubber(), "1.0")["tiles_without_terrain"] == ["x1_y2"]


# --- faults


@pytest.mark.parametrize(
    ("error", "fault", "words"),
    [
        (UnreadableInputError("/up/0a/tile.laz", "truncated", "Send it again"), Fault.INPUT, "tile.laz: truncated"),
        (CrsError("/up/0a/tile.laz", "degrees", "Give --crs"), Fault.INPUT, "degrees"),
        (NoSuchUploadError("upload 0a is gone"), Fault.INPUT, "gone"),
        (RequestError(["tiles: none"]), Fault.INPUT, "tiles: none"),
        (SettingsError(["cell_size_m is 0"]), Fault.SETTINGS, "cell_size_m is 0"),
        (InputRefusedError("host a.b is not listed"), Fault.REFUSED, "a.b"),
        (TooLargeError("5 points, 3 allowed"), Fault.REFUSED, "5 points"),
        (ClusterError("the scheduler was lost"), Fault.CLUSTER, "lost 2 times"),
        (VersionMismatchError("python 3.11 here, 3.12 there"), Fault.CLUSTER, "3.12 there"),
        (RunError("/jobs/ab/run cannot be written"), Fault.INTERNAL, "run cannot be written (reference ab12)"),
        (NoSpaceError("12 bytes left on /x/y"), Fault.NO_SPACE, "tried 2 times (reference ab12)"),
        (OSError(errno.ENOSPC, "no space", "/x/y"), Fault.NO_SPACE, "disk had no room"),
        (KeyError("password=hunter2"), Fault.INTERNAL, "KeyError (reference ab12)"),
        (MemoryError(), Fault.INTERNAL, "MemoryError"),
    ],
)
def test_every_exception_has_its_kind_and_says_no_path_and_no_secret(
    error: Exception, fault: Fault, words: str
) -> None:
    reported = failure_of(error, scrub=Scrubber(), reference="ab12", attempts=2)
    assert reported.fault is fault
    assert words in reported.detail
    assert "/" not in reported.detail
    assert "hunter2" not in reported.detail


def test_only_a_lost_cluster_an_absent_database_and_a_full_disk_are_tried_again() -> None:
    assert is_tried_again(ClusterError("x"), job(), max_attempts=3)
    assert not is_tried_again(ClusterError("x"), job(lost_attempts=2), max_attempts=3)
    assert not is_tried_again(VersionMismatchError("x"), job(), max_attempts=3)
    assert is_tried_again(StoreError("x"), job(lost_attempts=2), max_attempts=3)
    assert is_tried_again(NoSpaceError("x"), job(), max_attempts=3)
    assert not is_tried_again(NoSpaceError("x"), job(lost_attempts=2), max_attempts=3)
    assert not is_tried_again(RunError("x"), job(), max_attempts=3)


# --- logs


def test_lines_of_the_log_name_the_job_and_the_attempt() -> None:
    facts = {"job": "ab", "attempt": 2}
    record = logging.makeLogRecord({"name": "x", "levelname": "INFO", "msg": "runs %d", "args": (3,), **facts})
    line = json.loads(formatter(as_json=True).format(record))
    assert (line["message"], line["job"], line["attempt"], line["level"]) == ("runs 3", "ab", 2, "info")
    assert formatter(as_json=False).format(record).endswith("runs 3 [job ab, attempt 2]")


# --- the page about jobs

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how_to" / "jobs.md"


def test_the_page_draws_the_transitions_as_the_code_does() -> None:
    drawn = re.findall(r"```\n(.*?)```", PAGE.read_text(), re.DOTALL)[0]
    assert drawn in service.jobs.__doc__


def test_the_page_names_settings_that_exist_with_their_defaults() -> None:
    text = PAGE.read_text()
    fields = ServiceSettings.model_fields
    for name in re.findall(r"GABLEWORK_([A-Z_]+)", text):
        assert name.lower() in fields
    reported = dict(re.findall(r"`GABLEWORK_([A-Z_]+)` \((\d+)", text))
    assert set(reported) == {"LEASE_S", "MAX_ATTEMPTS", "DRIVER_JOBS", "DRAIN_S", "STALL_S", "STOP_S", "STALLED_DAYS"}
    for name, value in reported.items():
        assert fields[name.lower()].default == float(value)


def test_the_page_says_the_shares_of_the_stages_and_every_cause() -> None:
    text = " ".join(PAGE.read_text().split())
    assert ", ".join(f"{stage} {weight}" for stage, weight in WEIGHTS.items()) in text
    assert {fault for fault in Fault if f"`{fault}`" in text} == set(Fault)
    assert f"the last {MAX_KEPT} warnings" in text
    for status in JobStatus:
        assert f"| {status} |" in text
