"""The CPU time of a task: that of its own thread and of its children, and no other."""

import threading
import time
from collections.abc import Iterator

import pytest

from pipeline.runtime.isolation import child_pool
from pipeline.runtime.isolation.isolated_items import supervise
from pipeline.runtime.isolation.process_limits import IsolationLimits
from pipeline.runtime.monitoring.measurement import charge, measure

LIMITS = IsolationLimits(timeout_s=120.0, memory_bytes=2**30)
SPUN_S = 0.5
BURN = f"import time\nwhile time.process_time() < {SPUN_S}: pass"


@pytest.fixture(autouse=True)
def bare_children(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Children that load nothing, and none afterwards."""
    child_pool.kill_children()
    monkeypatch.setattr(child_pool, "_LOADS", ())
    yield
    child_pool.kill_children()


def spin(seconds: float) -> None:
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def in_child(order: str) -> int:
    return len(list(supervise(exec, [order], LIMITS)))


@pytest.mark.slow
def test_a_task_is_charged_with_what_its_thread_spins() -> None:
    measured = measure(spin, 0.2)
    assert 0.2 <= measured.cpu_s <= measured.seconds + 0.01


def test_a_task_is_charged_with_what_its_child_spins() -> None:
    measured = measure(in_child, BURN)
    assert measured.result == 1
    # the system counts a child's time in hundredths of a second
    assert measured.cpu_s > SPUN_S - 0.05


def test_a_child_is_charged_once_though_it_lives_on() -> None:
    first = measure(in_child, BURN)
    second = measure(in_child, "pass")
    assert second.cpu_s < first.cpu_s / 2


@pytest.mark.slow
def test_a_child_that_dies_is_charged_with_what_was_seen_of_it() -> None:
    measured = measure(in_child, f"{BURN}\nimport os, signal\nos.kill(os.getpid(), signal.SIGKILL)")
    assert measured.cpu_s > SPUN_S - 0.05


def test_tasks_of_other_threads_pay_for_themselves() -> None:
    neighbour = threading.Thread(target=lambda: (charge(1000.0), spin(0.2)))
    neighbour.start()
    measured = measure(lambda _: neighbour.join(), None)
    assert measured.cpu_s < 0.2


def test_a_measurement_has_the_start_of_the_task() -> None:
    before = time.time()
    measured = measure(spin, 0.01)
    assert before <= measured.began_s <= time.time()
