"""Many clients that ask for statuses: they are answered together, each with what it would get alone."""

from __future__ import annotations

import asyncio
import contextvars
import threading
from typing import TYPE_CHECKING, Any

import httpx
import pytest

from service.errors import NoSuchJobError, StoreBusyError, StoreError
from service.gathering import Gathered
from service.keys import Scope
from service.routes.polling import PolledJobs
from service.store import queries

if TYPE_CHECKING:
    from conftest import LocalService, Starting

QUICK = {"Accept": "application/json"}
BY_FRAMEWORK = {"Accept": "application/json, text/html;q=0.1"}
"""The same wish in words that take the framework's way."""


def asked_in_both_ways(service: LocalService, path: str, **headers: str) -> tuple[httpx.Response, httpx.Response]:
    return tuple(service.client.get(path, headers=headers | way) for way in (QUICK, BY_FRAMEWORK))  # type: ignore[return-value]


def same(answers: tuple[httpx.Response, httpx.Response]) -> httpx.Response:
    quick, other = answers
    assert (quick.status_code, quick.json(), quick.headers) == (other.status_code, other.json(), other.headers)
    return quick


def test_both_ways_give_the_same_answer(starting: Starting) -> None:
    service = starting()
    for job in (service.waiting(), service.running()):
        answer = same(asked_in_both_ways(service, f"/jobs/{job.job_id}"))
        assert answer.status_code == 200
        assert answer.json()["jobID"] == job.job_id
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["vary"] == "Accept, Accept-Encoding"


@pytest.mark.parametrize("job_id", ["0" * 32, "no-id", "%00", "a" * 5000])
def test_an_unknown_job_is_refused_in_both_ways(starting: Starting, job_id: str) -> None:
    service = starting()
    assert same(asked_in_both_ways(service, f"/jobs/{job_id}")).status_code == 404


def test_a_key_sees_its_own_jobs_in_both_ways(starting: Starting) -> None:
    service = starting()
    reader, admin = service.key(Scope.READ), service.key(Scope.ADMIN)
    others = service.waiting(owner="another key")
    assert same(asked_in_both_ways(service, f"/jobs/{others.job_id}", **reader)).status_code == 404
    assert same(asked_in_both_ways(service, f"/jobs/{others.job_id}", **admin)).status_code == 200
    assert same(asked_in_both_ways(service, f"/jobs/{others.job_id}")).status_code == 401


def test_each_request_counts_against_the_limit_in_both_ways(starting: Starting) -> None:
    service = starting(rate_limit="3/hour")
    job = service.waiting()
    ways = [QUICK, BY_FRAMEWORK, QUICK, BY_FRAMEWORK, QUICK]
    codes = [service.client.get(f"/jobs/{job.job_id}", headers=way).status_code for way in ways]
    assert codes == [200, 200, 200, 429, 429]


def test_a_parameter_and_a_page_are_not_for_the_quick_way(starting: Starting) -> None:
    service = starting()
    path = f"/jobs/{service.waiting().job_id}"
    assert service.client.get(f"{path}?colour=red").status_code == 400
    assert service.client.get(f"{path}?f=html").headers["content-type"].startswith("text/html")
    assert service.client.get(path, headers={"Accept": "text/html"}).headers["content-type"].startswith("text/html")


def test_the_head_of_a_status_is_that_of_the_status(starting: Starting) -> None:
    service = starting()
    path = f"/jobs/{service.waiting().job_id}"
    answer = service.client.head(path, headers=QUICK)
    assert answer.status_code == 200
    assert answer.content == b""
    assert answer.headers == service.client.get(path, headers=QUICK).headers


def test_a_caller_is_checked_before_the_database_is_asked_for_the_job(
    starting: Starting, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = starting(rate_limit="2/hour")
    path, key = f"/jobs/{service.waiting().job_id}", service.key(Scope.READ)
    assert service.client.get(path, headers=key | QUICK).status_code == 404

    def away(*_: object) -> None:
        raise StoreError("the database does not answer")

    monkeypatch.setattr(service.store, "existing", away)
    monkeypatch.setattr(service.store, "key_by_digest", away)
    codes = [service.client.get(path, headers=headers | QUICK).status_code for headers in ({}, key, key)]
    assert codes == [401, 503, 429]


def test_a_job_that_cannot_be_read_fails_only_those_who_ask_for_it(
    starting: Starting, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = starting()
    good, bad = service.waiting().job_id, service.waiting().job_id
    read = queries.job_of

    def job_of(row: Any) -> Any:
        if row.job_id == bad:
            raise TypeError("a field of a later version")
        return read(row)

    monkeypatch.setattr(queries, "job_of", job_of)

    async def ask() -> list[Any]:
        polled = PolledJobs(service.store, wait_s=60.0)
        return await asyncio.gather(*map(polled.job, (good, bad, "0" * 32)), return_exceptions=True)

    found, fault, unknown = asyncio.run(ask())
    assert found.job_id == good
    assert isinstance(fault, TypeError)
    assert isinstance(unknown, NoSuchJobError)


def test_a_database_that_does_not_answer_is_waited_for_only_so_long(starting: Starting) -> None:
    service = starting()
    may_answer = threading.Event()

    class Slow:
        def existing(self, job_ids: set[str]) -> dict[str, Any]:
            assert may_answer.wait(60.0)
            return dict.fromkeys(job_ids, service.waiting())

    async def ask() -> Any:
        polled = PolledJobs(Slow(), wait_s=0.05)  # type: ignore[arg-type]
        faults = await asyncio.gather(*(polled.job(name) for name in "abc"), return_exceptions=True)
        may_answer.set()
        return faults, await PolledJobs(Slow(), wait_s=60.0).job("d")  # type: ignore[arg-type]

    faults, found = asyncio.run(ask())
    assert [type(fault) for fault in faults] == [StoreBusyError] * 3
    assert found is not None


def test_questions_that_come_during_a_call_share_the_next() -> None:
    calls: list[set[int]] = []
    is_asked, may_answer = threading.Event(), threading.Event()

    def squares(numbers: set[int]) -> dict[int, int | Exception]:
        calls.append(numbers)
        is_asked.set()
        assert may_answer.wait(60.0)
        return {number: ValueError(str(number)) if number == 3 else number**2 for number in numbers if number != 7}

    async def ask() -> list[Any]:
        gathered = Gathered(squares)
        first = asyncio.create_task(gathered.ask(1))
        await asyncio.to_thread(is_asked.wait)
        others = [asyncio.create_task(gathered.ask(number)) for number in (2, 3, 4, 5, 5, 7)]
        await asyncio.sleep(0)  # each has asked
        others[2].cancel()
        may_answer.set()
        found = await asyncio.gather(first, *others, return_exceptions=True)
        return [*found, await gathered.ask(6)]

    one, four, fault, gone, *squares_of_five, nothing, alone = asyncio.run(ask())
    assert calls == [{1}, {2, 3, 5, 7}, {6}]
    assert (one, four, squares_of_five, nothing, alone) == (1, 4, [25, 25], None, 36)
    assert isinstance(fault, ValueError)
    assert isinstance(gone, asyncio.CancelledError)


def test_a_call_that_fails_fails_all_and_the_next_works() -> None:
    def fail_first(numbers: set[int]) -> dict[int, int | Exception]:
        if 1 in numbers:
            raise OSError("no database")
        return {number: number for number in numbers}

    async def ask() -> list[Any]:
        gathered = Gathered(fail_first)
        found = await asyncio.gather(gathered.ask(1), gathered.ask(2), return_exceptions=True)
        return [*found, await gathered.ask(3)]

    first, second, third = asyncio.run(ask())
    assert isinstance(first, OSError)
    assert isinstance(second, OSError)
    assert third == 3


def test_a_call_belongs_to_none_of_those_who_ask() -> None:
    trace: contextvars.ContextVar[str] = contextvars.ContextVar("trace", default="none")
    gathered = Gathered(lambda names: dict.fromkeys(names, trace.get()))

    async def ask() -> str | None:
        trace.set("of this request")
        return await gathered.ask("a")

    assert asyncio.run(ask()) == "none"
