"""Requests with more in them than clients have reason to send: refused early, in few words, and one after the other."""

from __future__ import annotations

import asyncio
import json
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from finished_runs import problem
from live_service import answer_to, serving, settings_in

from service import bodies
from service.errors import MOST_FAULTS, Further, RequestError, few
from service.routes.negotiation import MAX_ENTRIES, preferred
from service.wire.execute import Execute
from service.wire.faults import shortened
from service.wire.inputs import ReconstructInputs

EXECUTION = "/processes/reconstruct/execution"
MANY = 80_000
MIB = 2**20


def names(number: int) -> dict[str, int]:
    return {f"k{n}": 1 for n in range(number)}


def errors_of(answer: httpx.Response) -> list[str]:
    problem(answer, 400, "invalid-request")
    listed: list[str] = answer.json()["errors"]
    return listed


def test_a_body_with_80_000_unknown_inputs_is_refused_in_one_sentence(local_service: Any) -> None:
    answer = local_service.client.post(EXECUTION, json={"inputs": names(MANY)})
    assert errors_of(answer) == ["inputs has 80,000 members: use at most 1,000"]
    assert len(answer.content) < 1000


@pytest.mark.parametrize("path", [EXECUTION, "/schedules", "/webhooks", "/jobs/0/retry"])
@pytest.mark.parametrize("place", [lambda many: many, lambda many: {"inputs": {"settings": {"roof": many}}}])
def test_every_path_measures_its_body(local_service: Any, path: str, place: Callable[[Any], Any]) -> None:
    answer = local_service.client.post(path, json=place(names(2_000)))
    assert "has 2,000 members: use at most 1,000" in problem(answer, 400, "invalid-request")


def test_twenty_faults_are_named_and_the_others_are_counted(local_service: Any) -> None:
    answer = local_service.client.post(EXECUTION, json={"inputs": {**names(900), "tiles": "x"}})
    listed = errors_of(answer)
    assert len(listed) == MOST_FAULTS + 1
    # one of the faults is that of tiles
    assert listed[-1] == "and 881 more"
    assert answer.json()["detail"].endswith("; and 881 more")


@pytest.mark.parametrize(
    "inputs",
    [
        {"tiles": [1] * 900},
        {"tiles": [{"href": 1, "x": 1}] * 900},
        {"tiles": [{"href": "/srv/a.laz"}], "settings": names(900)},
        {"tiles": [{"href": "/srv/a.laz"}], "settings": {"candidates": names(900)}},
        {"tiles": [{"href": "/srv/a.laz", **names(900)}]},
        {"tiles": [{"href": "/srv/a.laz"}] * 2_000},
        {"tiles": [{"href": "/srv/a.laz"}], "publish": ["x"] * 60_000},
        {"tiles": [{"href": "/srv/a.laz"}], "bbox": ["x"] * 60_000},
        {"tiles": [{"href": "/srv/a.laz"}], "title": ["x"] * 60_000},
        {"tiles": [{"href": "/srv/a.laz"}], "crs": "x" * 500_000},
    ],
    ids=["tiles", "links", "settings", "table", "link", "too many tiles", "publish", "bbox", "title", "crs"],
)
@pytest.mark.parametrize("path", [EXECUTION, "/schedules"])
def test_no_input_makes_a_long_answer(local_service: Any, path: str, inputs: dict[str, Any]) -> None:
    asked = {"inputs": inputs}
    body = asked if path == EXECUTION else {"cron": "0 0 * * *", "execute": asked}
    answer = local_service.client.post(path, json=body)
    assert 1 <= len(errors_of(answer)) <= MOST_FAULTS + 1
    assert len(answer.content) < 20_000


def test_the_faults_of_many_tiles_cost_as_little_as_those_of_twenty() -> None:
    def calls(number: int) -> int:
        seen = 0

        class Counted(str):
            __slots__ = ()

            def isprintable(self) -> bool:
                nonlocal seen
                seen += 1
                return False

        with pytest.raises(RequestError) as caught:
            Execute(inputs={"tiles": [{"href": Counted("a")} for _ in range(number)]}).draft("reconstruct", 10**6)
        assert caught.value.faults[-1] == f"and {number - MOST_FAULTS:,} more"
        return seen

    assert calls(30) == calls(3_000) == MOST_FAULTS


def test_a_list_that_is_cut_counts_faults_that_were_counted_before() -> None:
    assert few(["a", Further(5), *"b" * 21, Further(3)])[-1] == "and 10 more"
    assert few("abc") == ("a", "b", "c")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[" + b"[]," * 200_000 + b"1]", "lists and objects"),
        (b"[" + b"1," * 400_000 + b"1]", "commas"),
        (b"[" * 50_000, "levels deep"),
        (b"[" * 150 + b"]" * 150, "levels deep"),
        (b'{"a":' * 150 + b"1" + b"}" * 150, "levels deep"),
    ],
    ids=["empty lists", "numbers", "open lists", "lists", "objects"],
)
def test_a_body_of_many_values_or_levels_is_refused(local_service: Any, content: bytes, words: str) -> None:
    headers = {"Content-Type": "application/json"}
    answer = local_service.client.post(EXECUTION, content=content, headers=headers)
    assert words in problem(answer, 400, "invalid-request")


def test_outlines_of_thousands_of_buildings_within_a_request_are_accepted() -> None:
    ring = [[84_000.123, 447_000.456], [84_010.789, 447_000.456], [84_010.789, 447_010.123], [84_000.123, 447_000.456]]
    one = {"type": "Feature", "properties": {"id": 1}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    outlines = {"type": "FeatureCollection", "features": [one] * 4_800}
    body = json.dumps({"inputs": {"tiles": "/srv/a.laz", "footprints": outlines}}).encode()
    assert 0.9 * MIB < len(body) < MIB
    asyncio.run(bodies.check(body, MIB))


def test_large_bodies_wait_for_one_another_and_leave_the_loop_free_between_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reading, turns = [0], []

    def read(_text: bytes, _most: int) -> None:
        reading[0] += 1
        turns.append("read")
        time.sleep(0.005)  # as long as a real one takes: the pause after it is as long

    monkeypatch.setattr(bodies, "_check", read)

    async def other() -> None:
        while reading[0] < 5:
            turns.append("other")
            await asyncio.sleep(0.0)

    async def all_at_once() -> None:
        text = b" " * (bodies.SMALL_BYTES + 1)
        await asyncio.gather(other(), *(bodies.check(text, MIB) for _ in range(5)))

    asyncio.run(all_at_once())
    assert turns.count("read") == 5
    assert "read, read" not in ", ".join(turns)


@pytest.mark.slow
def test_forty_bodies_at_once_leave_no_memory_behind(tmp_path: Path) -> None:
    body = json.dumps({"inputs": names(MANY)}).encode()

    async def burst(url: str) -> None:
        async with httpx.AsyncClient(base_url=url, timeout=60.0) as client:
            headers = {"Content-Type": "application/json"}
            sent = [client.post(EXECUTION, content=body, headers=headers) for _ in range(40)]
            assert {answer.status_code for answer in await asyncio.gather(*sent)} == {400}

    with serving(settings_in(tmp_path)) as url:
        asyncio.run(burst(url))
        tracemalloc.start()
        try:
            before, _ = tracemalloc.get_traced_memory()
            asyncio.run(burst(url))
            after, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    # client and server are in one process here: the peak is that of their buffers
    assert peak - before > 10 * len(body)
    assert after - before < 2 * len(body)


def test_a_field_of_a_form_is_measured_as_a_body_is(local_service: Any) -> None:
    def refused(**fields: str) -> str:
        parts = {name: (None, value) for name, value in {"tile": "/srv/a.laz", **fields}.items()}
        return problem(local_service.client.post("/jobs", files=parts), 400, "invalid-request")

    assert "has 2,000 members" in refused(settings=json.dumps(names(2_000)))
    assert "levels deep" in refused(settings="[" * 5_000)
    assert "fewer digits" in refused(priority="9" * 5_000)
    assert "has 1,001 words: use at most 100" in refused(outputs="a," * 1_001)
    assert "has 1,001 words: use at most 100" in refused(methods="a," * 1_001)


def test_unknown_query_parameters_are_counted(local_service: Any) -> None:
    listed = errors_of(local_service.client.get("/jobs?" + "&".join(f"k{n}=1" for n in range(5_000))))
    assert len(listed) == MOST_FAULTS + 1
    assert listed[-1] == "and 4,980 more"


def test_the_words_of_a_query_parameter_are_few(local_service: Any) -> None:
    detail = problem(local_service.client.get("/jobs?processID=" + ",".join(names(500))), 400, "invalid-request")
    assert "use at most 100 words" in detail


def test_a_long_accept_header_is_not_read_to_its_end() -> None:
    assert preferred("a/b," * (MAX_ENTRIES - 1) + "model/obj", ["text/html", "model/obj"]) == "model/obj"
    with pytest.raises(Exception, match="name one of them"):
        preferred("a/b," * MAX_ENTRIES + "model/obj", ["text/html", "model/obj"])


def test_a_crs_that_is_nested_without_end_is_refused(local_service: Any) -> None:
    crs = '{"a":' * 3_000 + "1" + "}" * 3_000
    answer = local_service.client.post(EXECUTION, json={"inputs": {"tiles": {"href": "/srv/a.laz"}, "crs": crs}})
    assert "is not understood" in errors_of(answer)[0]


def test_a_long_value_is_not_written_whole() -> None:
    assert shortened("a" * 10**6) == '"' + "a" * 76 + "..."
    assert shortened({"a": ["b"] * 10**6}).startswith('{"a": ["b", "b",')
    assert len(shortened({"a": ["b"] * 10**6})) == 80
    assert shortened({"a": [1, None, "b"]}) == '{"a": [1, null, "b"]}'


def test_the_names_of_members_are_cut_in_paths(local_service: Any) -> None:
    answer = local_service.client.post(EXECUTION, json={"inputs": {}, "outputs": {"o" * 50_000: {"format": 1}}})
    assert all(len(fault) < 500 for fault in errors_of(answer))


def test_a_request_with_two_lengths_is_refused_and_its_connection_closed(tmp_path: Path) -> None:
    smuggled = b"GET /jobs HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    with serving(settings_in(tmp_path)) as url:
        for path in (EXECUTION, "/uploads?filename=a.xyz", "/nothing"):
            headers = {"Content_Type": "application/json", "Content_Length": "5", "Transfer_Encoding": "chunked"}
            answer = answer_to(url, f"POST {path}", b"0\r\n\r\n" + smuggled, **headers)
            assert answer.startswith(b"HTTP/1.1 400"), path
            assert answer.count(b"HTTP/1.1") == 1
            assert b"connection: close" in answer.lower()
            assert b"send one of them" in answer


def test_the_schema_of_the_inputs_is_as_before() -> None:
    schema = ReconstructInputs.model_json_schema()["properties"]
    assert schema["tiles"]["minItems"] == 1
    assert "oneOf" in schema["tiles"]["items"]
