"""Limits of requests: counted for each client by itself, exactly, from any number of threads."""

import threading
from pathlib import Path

import pytest

from service.errors import StartUpError, TooManyRequestsError
from service.rate_limits import RateLimiter
from service.settings import ServiceSettings


def limiter(rate_limit: str) -> RateLimiter:
    return RateLimiter(ServiceSettings(rate_limit=rate_limit, state=Path("unused")))


def taken(limits: RateLimiter, client: str, times: int) -> int:
    count = 0
    for _ in range(times):
        try:
            limits.check(client)
            count += 1
        except TooManyRequestsError:
            pass
    return count


def test_the_limit_is_the_number_of_requests_that_are_taken() -> None:
    assert taken(limiter("5/hour"), "a", 20) == 5


def test_clients_are_counted_each_by_itself() -> None:
    limits = limiter("5/hour")
    assert [taken(limits, client, 10) for client in ("a", "b", "192.0.2.1")] == [5, 5, 5]


def test_an_ipv6_client_is_its_network_and_cannot_be_many() -> None:
    limits = limiter("5/hour")
    assert sum(taken(limits, f"2001:db8:1:2::{number:x}", 1) for number in range(1, 100)) == 5
    assert taken(limits, "2001:db8:1:3::1", 10) == 5


def test_the_refusal_says_the_limit_and_when_to_come_again() -> None:
    limits = limiter("1/minute")
    limits.check("a")
    with pytest.raises(TooManyRequestsError, match="more than 1 requests in 60 s") as caught:
        limits.check("a")
    assert 1.0 <= caught.value.retry_after_s <= 60.0


def test_two_limits_hold_both() -> None:
    limits = limiter("3/second;4/hour")
    assert taken(limits, "a", 3) == 3
    assert taken(limits, "a", 20) <= 1


def test_threads_together_get_no_more_than_the_limit() -> None:
    limits, counts = limiter("100/hour"), []

    def run() -> None:
        counts.append(taken(limits, "a", 50))

    threads = [threading.Thread(target=run) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(counts) == 100


def test_one_thread_counts_at_a_time() -> None:
    """The storage starts a timer on some hits, and a timer that two threads start raises."""
    limits, both_inside = limiter("100/hour"), []
    barrier = threading.Barrier(2)

    class Strategy:
        def hit(self, *_: object) -> bool:
            try:
                barrier.wait(0.2)
                both_inside.append(True)
            except threading.BrokenBarrierError:
                barrier.reset()
            return True

    limits._strategy = Strategy()  # type: ignore[assignment]
    threads = [threading.Thread(target=limits.check, args=("a",)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert both_inside == []


@pytest.mark.parametrize("text", ["", "many", "10", "0/minute", "-1/minute", "5/fortnight"])
def test_a_notation_that_is_none_stops_the_start(text: str) -> None:
    with pytest.raises(StartUpError, match="rate_limit is"):
        limiter(text)
