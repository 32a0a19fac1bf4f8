"""Which faults are worth another attempt, and when it is made."""

import errno

import pytest

from pipeline.backoff import Backoff
from pipeline.extras.remote.retries import CODES, POLICY, STATUSES, GaveUpError, cause_of, persistently, without_secrets


class AnswerError(Exception):
    """An answer as botocore reports it."""

    def __init__(self, code: str, status: int) -> None:
        self.response = {"Error": {"Code": code}, "ResponseMetadata": {"HTTPStatusCode": status}}
        super().__init__(f"{code} {status}")


class Clock:
    """Time that passes only during sleep or work."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.waits: list[float] = []

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.waits.append(seconds)
        self.now_s += seconds


def attempts(policy, errors, *, seconds_each=0.0, draw=1.0):
    """What came of work that fails so, and the clock."""
    clock, left = Clock(), list(errors)

    def work() -> str:
        clock.now_s += seconds_each
        if left:
            raise left.pop(0)
        return "done"

    try:
        return persistently(work, policy, clock=clock, sleep=clock.sleep, draw=lambda: draw), clock
    except GaveUpError as error:
        return error, clock


def test_waits_double_up_to_a_bound_and_are_drawn_between_half_and_all_of_it():
    policy = Backoff(first_s=0.5, longest_s=4.0, jitter=(0.5, 1.0), attempts=8)
    assert [policy.pause_s(n, draw=1.0) for n in range(1, 9)] == [0.5, 1.0, 2.0, 4.0, 4.0, 4.0, 4.0, None]
    assert policy.pause_s(3, draw=0.0) == 1.0
    assert policy.pause_s(3, draw=0.5) == 1.5


def test_work_that_recovers_is_done_and_was_waited_for():
    result, clock = attempts(Backoff(first_s=1.0), [TimeoutError(), ConnectionResetError()])
    assert result == "done"
    assert clock.waits == [1.0, 2.0]


def test_the_number_of_attempts_is_bounded_and_reported():
    gave_up, clock = attempts(Backoff(attempts=3, first_s=1.0), [TimeoutError("late")] * 9)
    assert gave_up.attempts == 3
    assert clock.waits == [1.0, 2.0]
    assert gave_up.problem == "no answer in time at all of 3 attempts (late)"


def test_no_attempt_begins_after_the_limit():
    policy = Backoff(attempts=100, first_s=1.0, longest_s=1.0, limit_s=130.0)
    gave_up, clock = attempts(policy, [TimeoutError()] * 99, seconds_each=60.0)
    assert gave_up.attempts == 3
    assert clock.now_s - 100.0 <= 130.0 + 60.0


def test_what_another_attempt_cannot_mend_is_reported_at_once():
    for error in (AnswerError("AccessDenied", 403), FileNotFoundError("x"), ValueError("a fault of ours")):
        gave_up, clock = attempts(POLICY, [error])
        assert (gave_up.attempts, clock.waits) == (1, [])


def test_the_check_before_each_attempt_ends_the_work():
    asked = []

    def check() -> None:
        asked.append(1)
        if len(asked) == 2:
            raise InterruptedError("cancelled")

    def fail() -> None:
        raise TimeoutError

    with pytest.raises(InterruptedError):
        persistently(fail, check=check, sleep=lambda _: None)


def test_a_full_disk_of_this_machine_is_no_fault_of_the_storage():
    with pytest.raises(OSError, match="No space"):
        persistently(lambda: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space left on device")))


@pytest.mark.parametrize("code", sorted(CODES))
def test_the_code_of_an_answer_counts_before_its_status(code):
    assert cause_of(AnswerError(code, 400)) is CODES[code]


@pytest.mark.parametrize(
    ("status", "again"), [(400, False), (403, False), (404, False), (429, True), (500, True), (599, True)]
)
def test_a_status_without_a_known_code_decides(status, again):
    assert cause_of(AnswerError(str(status), status)).again is again


def test_what_the_server_said_counts_before_what_the_library_made_of_it():
    # fsspec reports every failed request to a web server as a missing file
    error = FileNotFoundError("https://host/a.laz")
    error.__cause__ = AnswerError("SlowDown", 503)
    assert cause_of(error) is CODES["SlowDown"]
    assert STATUSES[404] is cause_of(FileNotFoundError("x"))


def test_errors_of_the_libraries_are_in_the_table():
    aiohttp = pytest.importorskip("aiohttp")
    exceptions = pytest.importorskip("botocore.exceptions")
    again = (
        TimeoutError(),
        ConnectionResetError(),
        aiohttp.ServerDisconnectedError(),
        aiohttp.ClientPayloadError("half"),
        aiohttp.SocketTimeoutError("late"),
        exceptions.EndpointConnectionError(endpoint_url="http://host"),
        exceptions.ConnectTimeoutError(endpoint_url="http://host"),
        exceptions.ReadTimeoutError(endpoint_url="http://host"),
        exceptions.ConnectionClosedError(endpoint_url="http://host"),
        exceptions.IncompleteReadError(actual_bytes=1, expected_bytes=2),
    )
    for error in again:
        assert cause_of(error).again, error
    for error in (exceptions.NoCredentialsError(), exceptions.ProfileNotFound(profile="p"), PermissionError("no")):
        assert not cause_of(error).again, error
    assert "AWS_ACCESS_KEY_ID" in cause_of(exceptions.NoCredentialsError()).fix
    assert "certificate" in cause_of(exceptions.SSLError(endpoint_url="https://host", error="self-signed")).words


def test_texts_lose_users_passwords_and_queries_of_their_urls():
    text = "403, url='https://me:pw@host:8443/a/b.laz?X-Amz-Signature=12&t=3' and s3://bucket/key"
    assert without_secrets(text) == "403, url='https://host:8443/a/b.laz?…' and s3://bucket/key"
