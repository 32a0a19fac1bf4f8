"""`gablework warm-up` as a user meets it: which kernels it compiles for which words; nothing is compiled here."""

import json
from collections.abc import Callable, Iterable

import pytest
from command_line import invoke

from pipeline.compiler import warm_up
from pipeline.compiler.warm_up import Listed


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[list[Listed]]:
    """The kernels of each call of the compiler, which reports them one by one and compiles none."""
    calls: list[list[Listed]] = []

    def compile_kernels(
        kernels: Iterable[Listed], processes: int, on_progress: Callable[[int, int, float], None]
    ) -> int:
        assert processes >= 1
        calls.append(list(kernels))
        total = len(calls[-1])
        for done in range(1, total + 1):
            on_progress(done, total, float(total - done))
        return total

    monkeypatch.setattr(warm_up, "compile_kernels", compile_kernels)
    return calls


@pytest.mark.parametrize(
    ("words", "groups"),
    [
        ((), ["reconstruct"]),
        (("classify",), ["classify"]),
        (("simulate", "diff"), ["simulate", "diff"]),
        (("all",), None),
        (("diff", "all"), None),
    ],
    ids=["nothing", "one", "two", "all", "all beside another"],
)
def test_what_is_named_is_compiled_and_nothing_else(
    compiled: list[list[Listed]], words: tuple[str, ...], groups: list[str] | None
) -> None:
    code, said, _ = invoke("warm-up", *words)
    assert code == 0
    assert compiled == [warm_up.listed(groups)]
    assert said.startswith(f"{len(compiled[0])} kernels are compiled; it took ")


def test_every_group_that_is_listed_can_be_named_and_adds_kernels(compiled: list[list[Listed]]) -> None:
    help_text = " ".join(invoke("warm-up", "--help")[1].split())
    for name in warm_up.groups():
        assert invoke("warm-up", name)[0] == 0
        assert compiled[-1]
        assert name in help_text
    assert sum(map(len, compiled)) == len(warm_up.listed())


@pytest.mark.parametrize("words", [("magic",), ("reconstruct", "magic"), ("all", "magic")])
def test_a_name_that_is_not_known_is_exit_code_2_with_the_choices(
    compiled: list[list[Listed]], words: tuple[str, ...]
) -> None:
    code, _, reported = invoke("warm-up", *words)
    reported = " ".join(reported.split())
    assert code == 2
    assert f"'magic' is not known: use {', '.join(warm_up.groups())} or all" in reported
    assert "'reconstruct' is not known" not in reported
    assert compiled == []


def test_all_names_that_are_not_known_are_reported_at_once(compiled: list[list[Listed]]) -> None:
    reported = invoke("warm-up", "magic", "spells")[2]
    assert "'magic'" in reported
    assert "'spells'" in reported
    assert compiled == []


def test_machines_get_seconds_and_kernels_and_how_far_it_is(compiled: list[list[Listed]]) -> None:
    code, said, reported = invoke("warm-up", "diff", "--json")
    assert code == 0
    document = json.loads(said)
    count = len(compiled[0])
    assert set(document) == {"seconds", "kernels"}
    assert document["kernels"] == count
    assert document["seconds"] >= 0.0
    events = [json.loads(line) for line in reported.splitlines()]
    assert {event["stage"] for event in events} == {"compile"}
    assert [event["done"] for event in events if event["kind"] == "progress"] == list(range(1, count + 1))
    assert {event["total"] for event in events} == {count}
