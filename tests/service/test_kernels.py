"""Jobs that come before the kernels are compiled say so, wait, and can be ended; nothing is compiled here."""

import threading
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import pytest
from driver_bench import Bench, Engine
from processes import LONG_S, wait_for

from pipeline.compiler.warm_up import groups
from pipeline.errors import RunCancelledError
from pipeline.runtime.monitoring.progress import Event, Listener
from service.driver.attempt_process import InOwnProcess
from service.driver.kernels import Kernels, needs_all_kernels
from service.jobs import InputReference, JobRequest, JobStatus

ABOUT = "compiling, once, about 30 s"


class Compiler:
    """Compiles a group when the test says so; `goes` has an event for each call."""

    def __init__(self, fault: Exception | None = None) -> None:
        self.calls: list[tuple[str, ...]] = []
        self.goes = [threading.Event(), threading.Event()]
        self.hear: Listener = lambda _: None
        self.fault = fault
        self.cancelled: Callable[[], bool] = lambda: False

    def __call__(self, on_event: Listener, groups: Sequence[str], *, cancelled: Callable[[], bool]) -> None:
        self.calls.append(tuple(groups))
        self.hear, self.cancelled = on_event, cancelled
        on_event(Event(kind="stage", stage="compile", total=4, message=ABOUT))
        go = self.goes[len(self.calls) - 1]
        wait_for(lambda: go.is_set() or cancelled(), "the word of the test")
        if self.fault is not None:
            raise self.fault


class Held:
    """A job that only listens."""

    def __init__(self, **asked: Any) -> None:
        request = JobRequest(tiles=(InputReference(kind="path", value="/data/a.laz"),), **asked)
        self.job = SimpleNamespace(request=request)
        self.events: list[Event] = []
        self.ended = threading.Event()

    def record(self, event: Event) -> None:
        self.events.append(event)

    def cancelled(self) -> bool:
        return self.ended.is_set()

    def wait(self, seconds: float) -> bool:
        return self.ended.wait(seconds)


def waiting(kernels: Kernels, held: Held) -> threading.Thread:
    thread = threading.Thread(target=kernels.wait_for, args=(held,), daemon=True)
    thread.start()
    return thread


def ends(thread: threading.Thread) -> None:
    thread.join(LONG_S)
    assert not thread.is_alive()


def test_a_job_waits_for_its_kernels_and_says_what_is_compiled_and_how_far_it_is() -> None:
    compiler = Compiler()
    kernels = Kernels(compiles=True, compile_groups=compiler)
    kernels.start()
    early = Held()
    first = waiting(kernels, early)
    wait_for(lambda: early.events, "the first word")
    assert early.events[0].message == ABOUT
    compiler.hear(Event(kind="progress", stage="compile", done=1, total=4, message="compiling, once, about 20 s left"))
    wait_for(lambda: len(early.events) == 2, "the progress")
    # a job that comes later hears both
    late = Held()
    second = waiting(kernels, late)
    wait_for(lambda: [event.done for event in late.events] == [0, 1], "what the first has heard")
    compiler.goes[0].set()
    for thread in (first, second):
        ends(thread)
    wait_for(lambda: len(compiler.calls) == 2, "the rest")
    assert compiler.calls[0] == ("reconstruct",)
    assert set(compiler.calls[1]) == {"classify", "compare", "solar", "terrain"}
    assert {name for call in compiler.calls for name in call} <= set(groups())
    # most jobs need no more; a classification waits for the rest
    kernels.wait_for(Held())
    other = Held(process_id="classify")
    third = waiting(kernels, other)
    wait_for(lambda: other.events, "the word about the rest")
    assert third.is_alive()
    compiler.goes[1].set()
    ends(third)


def test_a_job_that_is_ended_does_not_wait_on() -> None:
    kernels = Kernels(compiles=True, compile_groups=Compiler())
    kernels.start()
    held = Held()
    held.ended.set()
    with pytest.raises(RunCancelledError):
        kernels.wait_for(held)
    kernels.wait_for(Held(process_id="echo"))
    kernels.stop()


def test_jobs_go_on_where_the_compiler_fails_and_hear_its_warnings() -> None:
    compiler = Compiler(fault=RuntimeError("no"))
    kernels = Kernels(compiles=True, compile_groups=compiler)
    kernels.start()
    wait_for(lambda: compiler.calls, "the compiler")
    compiler.hear(Event(kind="warning", stage="compile", message="set NUMBA_CACHE_DIR"))
    for go in compiler.goes:
        go.set()
    held = Held(points=True)
    kernels.wait_for(held)
    assert held.events[-1].message == "set NUMBA_CACHE_DIR"


def test_a_driver_that_ends_compiles_no_more() -> None:
    compiler = Compiler()
    kernels = Kernels(compiles=True, compile_groups=compiler)
    kernels.start()
    wait_for(lambda: compiler.calls, "the compiler")
    kernels.stop()
    assert compiler.cancelled()
    kernels.wait_for_first()
    assert len(compiler.calls) == 1


def test_workers_elsewhere_compile_for_themselves() -> None:
    compiler = Compiler()
    kernels = Kernels(compiles=False, compile_groups=compiler)
    kernels.start()
    kernels.wait_for_first()
    held = Held(process_id="compare")
    kernels.wait_for(held)
    assert (compiler.calls, held.events) == ([], [])


@pytest.mark.parametrize(
    ("asked", "all_of_them"),
    [
        ({}, False),
        ({"settings": {"classes": "ignore", "candidates": {"min_area_m2": 9.0}}}, False),
        ({"settings": {"method": "arrangement"}}, False),
        ({"settings": {"method": "kmeans"}}, True),
        ({"settings": {"general": {"method": "kmeans"}}}, True),
        ({"settings": {"terrain": "tin"}}, True),
        ({"points": True}, True),
        ({"publish": ("solar",)}, True),
        ({"process_id": "classify"}, True),
    ],
)
def test_what_most_jobs_need_is_enough_for_the_default(asked: dict[str, Any], all_of_them: bool) -> None:
    assert needs_all_kernels(Held(**asked).job.request) is all_of_them


def test_a_driver_that_ends_while_it_compiles_starts_no_workers(bench: Bench) -> None:
    compiler = Compiler()
    kernels = Kernels(compiles=True, compile_groups=compiler)
    bench.performs = lambda parts, name: InOwnProcess(parts, name, kernels=kernels)
    started = Engine.started
    driver = bench.driver()
    wait_for(lambda: compiler.calls, "the compiler")
    driver.stop()
    wait_for(lambda: bench.codes, "the end of the driver")
    assert (bench.codes, Engine.started) == ([0], started)
    assert compiler.cancelled()


@pytest.mark.slow
def test_the_job_shows_the_stage_before_all_others(bench: Bench) -> None:
    """With a real driver and processes of attempts: the words are in the job and in its events."""
    compiler = Compiler()
    kernels = Kernels(compiles=True, compile_groups=compiler)
    bench.performs = lambda parts, name: InOwnProcess(parts, name, kernels=kernels)
    job = bench.submit()
    bench.driver()
    wait_for(lambda: bench.store.get(job.job_id).stage == "compile", "the stage")
    shown = bench.store.get(job.job_id)
    assert shown.status is JobStatus.RUNNING
    assert shown.message.startswith(ABOUT)
    bench.store.dismiss(job.job_id)
    assert bench.over(job).status is JobStatus.DISMISSED
    other = bench.submit()
    for go in compiler.goes:
        go.set()
    # its tile does not exist: it gets as far as its inputs
    assert bench.over(other).stage == "inputs"
    stages = [event.stage for event in bench.store.events(other.job_id) if event.kind == "stage"]
    assert stages[-1] == "inputs"
