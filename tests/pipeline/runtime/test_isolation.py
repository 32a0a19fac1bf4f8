"""Supervised children: a building harms only itself, and no child outlives its parent."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import chores
import psutil
import pytest
from faults.asked import environment
from processes import LONG_S, wait_for
from run_tables import rows_by_id

import pipeline.recipe
from pipeline.errors import RunCancelledError, RunError, SettingsError
from pipeline.model import Reason
from pipeline.runtime.isolation import child_main, child_pool
from pipeline.runtime.isolation.child_messages import Frames, frame
from pipeline.runtime.isolation.isolated_items import supervise
from pipeline.runtime.isolation.process_limits import IsolationLimits, Loss
from pipeline.runtime.isolation.supervision import free_beginning
from pipeline.runtime.monitoring.progress import Event

LIMITS = IsolationLimits(timeout_s=120.0, memory_bytes=2**30)


@pytest.fixture(autouse=True)
def no_children_left() -> Iterator[None]:
    """No children of other tests before a test, and none after it."""
    child_pool.kill_children()
    yield
    child_pool.kill_children()
    assert child_processes() == []


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Children that load nothing and therefore start at once."""
    monkeypatch.setattr(child_pool, "_LOADS", ())


def child_processes(of: int | None = None) -> list[psutil.Process]:
    """The living children of a process, by default this one, without their server."""
    found = []
    for process in psutil.Process(of).children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            if process.name() == child_main.NAME and not ended(process):
                found.append(process)
    return found


def ended(process: psutil.Process) -> bool:
    try:
        return bool(process.status() == psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return True


# --- plain functions: promises of the supervisor ---------------------------------------------------------------


def outcomes(function: Callable[[Any], Any], items: list[Any], limits: IsolationLimits = LIMITS) -> list[Any]:
    """The outcome of each item, in order."""
    found = dict(supervise(function, items, limits))
    return [found[index] for index in range(len(items))]


Order = Callable[[str], str]

PROGRAM = """
import os, signal, time
def double(n):
    return 2 * n
def do(order):
    exec(order)
    return order
"""


@pytest.fixture
def orders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bare: None) -> Order:
    """A function that executes its item as Python in the child and returns it."""
    (tmp_path / "orders_of_a_test.py").write_text(PROGRAM)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.syspath_prepend(str(tmp_path))
    import orders_of_a_test  # type: ignore[import-not-found]

    do: Order = orders_of_a_test.do
    return do


def test_results_come_from_one_child_that_stays(orders: Order) -> None:
    assert outcomes(orders, ["1", "2", "3"]) == ["1", "2", "3"]
    (first,) = child_processes()
    assert outcomes(orders, ["4"]) == ["4"]
    assert child_processes() == [first]
    assert outcomes(orders, []) == []


@pytest.mark.parametrize(
    ("order", "reason", "words"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", Reason.CRASHED, "signal 11 (SIGSEGV)"),
        ("os.abort()", Reason.CRASHED, "signal 6 (SIGABRT)"),
        ("os._exit(3)", Reason.CRASHED, "exit code 3"),
        ("os.kill(os.getpid(), signal.SIGKILL)", Reason.CRASHED, "signal 9 (SIGKILL)"),
        ("os.closerange(3, 100)", Reason.CRASHED, "process"),
        pytest.param(
            *("held = [bytes(b'1' * 2**25) for _ in range(10**6)]", Reason.OUT_OF_MEMORY, "1 GiB"),
            marks=pytest.mark.slow,
        ),
        ("held = bytearray(2**46)", Reason.OUT_OF_MEMORY, "1 GiB"),
        ("raise MemoryError", Reason.OUT_OF_MEMORY, "1 GiB"),
    ],
)
def test_an_item_that_kills_its_process_harms_only_itself(
    orders: Order, order: str, reason: Reason, words: str
) -> None:
    before, loss, after = outcomes(orders, ["1", order, "2"])
    assert (before, after) == ("1", "2")
    assert isinstance(loss, Loss)
    assert loss.reason is reason
    assert words in loss.detail


ENDLESS = ["while True: pass", "import collections, itertools; collections.deque(itertools.repeat(0), maxlen=0)"]


@pytest.mark.slow
@pytest.mark.parametrize("order", ENDLESS)
def test_an_endless_item_is_ended_even_if_it_holds_the_interpreter(orders: Order, order: str) -> None:
    before, loss, after = outcomes(orders, ["1", order, "2"], IsolationLimits(timeout_s=1.5))
    assert (before, after) == ("1", "2")
    assert isinstance(loss, Loss)
    assert loss.reason is Reason.TIMED_OUT
    assert "1.5 s" in loss.detail
    assert loss.seconds >= 1.5
    assert "in do" in loss.stderr, "the traceback is there"


def test_an_item_that_succeeds_alone_is_not_lost(orders: Order, tmp_path: Path) -> None:
    first_only = f"p = '{tmp_path}/mark'\nif not os.path.exists(p): open(p, 'w').close(); os.abort()"
    again: dict[int, str] = {}
    found = dict(supervise(orders, ["1", first_only, "2"], LIMITS, on_second_chance=again.__setitem__))
    assert [found[index] for index in range(3)] == ["1", first_only, "2"]
    assert list(again) == [1]
    assert "signal 6 (SIGABRT)" in again[1]


PILES = "import sys; sys.modules['os'].__dict__.setdefault('pile', []).append(b'1' * ({mib} * 2**20))"


@pytest.mark.slow
def test_memory_used_by_earlier_items_is_not_blamed_on_the_last(orders: Order) -> None:
    piles = PILES.format(mib=400) + "; time.sleep(0.2)"
    assert outcomes(orders, [piles] * 4) == [piles] * 4


def test_a_child_that_holds_much_memory_is_replaced(orders: Order) -> None:
    piles = PILES.format(mib=700)
    assert outcomes(orders, [piles]) == [piles]
    assert child_processes() == []


@pytest.mark.slow
def test_the_same_fault_has_the_same_detail(orders: Order) -> None:
    # filling memory may take longer than the shortest time limit on a busy machine, so that fault has a longer one
    short = IsolationLimits(timeout_s=1.0, memory_bytes=2**29)
    long = IsolationLimits(timeout_s=LONG_S, memory_bytes=2**29)
    endless, full = "while True: pass", "held = [b'1' * 2**25 for _ in range(10**6)]"
    for faults, limits in ((["os.abort()", endless], short), (["os.abort()", full], long)):
        first, again = outcomes(orders, faults, limits), outcomes(orders, faults[::-1], limits)[::-1]
        assert [loss.detail for loss in first] == [loss.detail for loss in again]


LOUD = "print('x' * 10**6); os.write(1, b'y' * 10**6); os.system('echo z')"


@pytest.mark.parametrize("order", [LOUD, f"'{'a' * 5_000_000}'"], ids=["loud", "large"])
def test_much_output_and_a_large_result_pass_the_pipe_whole(orders: Order, order: str) -> None:
    assert outcomes(orders, [order, "1"]) == [order, "1"]


@pytest.mark.slow
def test_only_the_end_of_a_childs_output_is_kept(orders: Order) -> None:
    loud = "for _ in range(64): os.write(2, b'y' * 2**20); time.sleep(0.02)"
    _, loss = outcomes(orders, [loud, loud + "\nprint('last words', flush=True); os.abort()"])
    assert "last words" in loss.stderr
    assert len(loss.stderr) <= 6000


def test_what_a_child_appends_stays_when_the_beginning_of_its_output_is_freed(tmp_path: Path) -> None:
    path = tmp_path / "stderr"
    path.write_bytes(b"y" * 2**22 + b"words")
    with path.open("rb+") as file, path.open("ab") as other:
        other.write(b", last")  # after the size was read, as by a child
        other.flush()
        assert free_beginning(file.fileno(), 2**22)
    assert path.stat().st_size == 2**22 + len(b"words, last")
    assert path.stat().st_blocks * 512 < 2**20
    assert path.read_bytes().endswith(b"\0words, last")


def test_an_error_of_the_function_is_raised_here(orders: Order) -> None:
    with pytest.raises(PermissionError, match="not yours"):
        outcomes(orders, ["1", "raise PermissionError('not yours')"])
    with pytest.raises(RunError, match="Own: words"):  # a class that this process cannot know
        outcomes(orders, ["class Own(Exception): pass\nraise Own('words')"])


def test_cancelling_kills_the_child_within_an_item(orders: Order) -> None:
    began = time.monotonic()
    with pytest.raises(RunCancelledError):
        dict(supervise(orders, ["while True: pass"], LIMITS, lambda: time.monotonic() - began > 0.5))
    assert child_processes() == []


def test_a_child_killed_from_outside_costs_nothing(orders: Order, tmp_path: Path) -> None:
    waits = f"open('{tmp_path}/reached', 'a').write('1')\nwhile not os.path.exists('{tmp_path}/go'): time.sleep(0.02)"
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.extend(outcomes(orders, ["1", waits, "2"])))
    thread.start()
    reached = tmp_path / "reached"
    wait_for(lambda: reached.exists() and reached.read_text() == "1", "the first trial")
    (victim,) = child_processes()
    victim.kill()
    wait_for(lambda: reached.read_text() == "11", "the second trial")
    (tmp_path / "go").touch()
    thread.join(LONG_S)
    assert found == ["1", waits, "2"]


def test_an_idle_child_that_was_killed_is_replaced(orders: Order) -> None:
    outcomes(orders, ["1"])
    (victim,) = child_processes()
    victim.kill()
    wait_for(lambda: ended(victim), "the end of the child")
    assert outcomes(orders, ["2"]) == ["2"]


def test_threads_have_children_of_their_own(orders: Order, tmp_path: Path) -> None:
    def meeting(me: str, other: str) -> str:
        return f"open('{tmp_path}/{me}', 'w').close()\nwhile not os.path.exists('{tmp_path}/{other}'): time.sleep(0.02)"

    found: dict[str, list[Any]] = {}

    def go(me: str, other: str) -> None:
        found[me] = outcomes(orders, [meeting(me, other)])

    threads = [threading.Thread(target=go, args=pair) for pair in (("a", "b"), ("b", "a"))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONG_S)
    assert found == {"a": [meeting("a", "b")], "b": [meeting("b", "a")]}
    assert len(child_processes()) == 2


def test_a_new_child_calls_its_load_with_the_argument(tmp_path: Path) -> None:
    (outcome,) = supervise(os.path.abspath, ["."], LIMITS, loads=(f"os:chdir:{tmp_path}",))
    assert outcome == (0, str(tmp_path.resolve()))


def test_children_that_cannot_start_are_an_error_with_their_output(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_pool, "_LOADS", ("no_such_module:load",))
    with pytest.raises(RunError, match=r"(?s)3 times in a row.*No module named 'no_such_module'"):
        outcomes(len, ["abc"])


def test_children_that_die_before_an_item_begins_are_an_error(
    orders: Order, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "orders_of_a_test.py").write_text("import os; os._exit(9)")
    with pytest.raises(RunError, match="3 times in a row before it began: its process ended with exit code 9"):
        outcomes(orders, ["1"])


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"timeout_s": 0.0}, "0 s: use more than 0"),
        ({"timeout_s": float("nan")}, "nan s"),
        ({"memory_bytes": 2**20}, "use at least 0.5 GiB"),
    ],
)
def test_limits_too_small_for_any_building_are_refused(fields: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        IsolationLimits(**fields)


def test_bytes_that_are_not_a_message_are_an_error() -> None:
    with pytest.raises(ValueError, match="something else wrote"):
        list(Frames().feed(b"\xff" * 20))
    whole = frame({"a": 1})
    frames = Frames()
    assert [list(frames.feed(whole[i : i + 1])) for i in range(len(whole))][-1] == [{"a": 1}]


# --- no child outlives its parent -------------------------------------------------------------------------------

WORKER = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have started us with SIGINT ignored
sys.path.insert(0, sys.argv[1])
from pipeline.runtime.isolation import child_pool
from pipeline.runtime.isolation.isolated_items import supervise
from pipeline.runtime.isolation.process_limits import IsolationLimits
child_pool._LOADS = ()
import orders_of_a_test
for _ in supervise(orders_of_a_test.do, [sys.argv[2]], IsolationLimits()):
    print("done", flush=True)
time.sleep(1000)
"""


@pytest.mark.parametrize("order", ["1", *ENDLESS], ids=["idle", "busy", "busy with the lock"])
@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_child_is_gone_when_its_worker_is_killed(
    orders: Order, tmp_path: Path, order: str, sign: signal.Signals
) -> None:
    item = f"open('{tmp_path}/reached', 'w').close()\n{order}"
    with subprocess.Popen([sys.executable, "-c", WORKER, str(tmp_path), item], stderr=subprocess.DEVNULL) as worker:
        wait_for(lambda: (tmp_path / "reached").exists() or worker.poll() is not None, "the item")
        family = psutil.Process(worker.pid).children(recursive=True)
        (busy,) = child_processes(worker.pid)
        assert busy in family
        worker.send_signal(sign)
    for process in family:
        wait_for(lambda process=process: ended(process), "the end of the child and of its server")


def test_a_child_outlives_the_thread_that_started_it(orders: Order) -> None:
    thread = threading.Thread(target=lambda: outcomes(orders, ["1"]))
    thread.start()
    thread.join(LONG_S)
    (first,) = child_processes()
    assert outcomes(orders, ["2"]) == ["2"]
    assert child_processes() == [first]


# --- with buildings ---------------------------------------------------------------------------------------------------


def test_isolation_changes_no_content(suburb: Path, reconstruct: Any) -> None:
    bare, isolated = reconstruct(suburb, isolate=False), reconstruct(suburb, isolate=True)
    assert bare.statuses["ok"] >= 1
    assert isolated.digest == bare.digest
    assert not (Path(isolated.run_dir) / "quarantine").exists()


@pytest.mark.parametrize("isolate", [True, False])
def test_a_building_with_an_internal_error_leaves_a_bundle_with_and_without_a_child(
    suburb: Path, reconstruct: Any, monkeypatch: pytest.MonkeyPatch, isolate: bool
) -> None:
    victim = min(rows_by_id(reconstruct(suburb).run_dir))
    for name, value in environment(**{"raise": [victim]}).items():
        monkeypatch.setenv(name, value)
    real = pipeline.recipe._reconstruct

    def faulty(building: Any, *rest: Any, **options: Any) -> Any:
        if building.candidate.building_id == victim:
            raise ZeroDivisionError("on purpose")
        return real(building, *rest, **options)

    monkeypatch.setattr(pipeline.recipe, "_reconstruct", faulty)
    events: list[Event] = []
    summary = reconstruct(suburb, isolate=isolate, on_event=events.append)
    row = rows_by_id(summary.run_dir)[victim]
    assert (row["status"], row["reason"]) == ("failed", "internal_error")
    (detail,) = [event for event in events if event.kind == "detail"]
    assert detail.message == f"failed: internal_error: {row['reason_detail']}"
    assert (detail.stage, detail.facts["building"], detail.facts["reason"]) == ("reconstruct", victim, "internal_error")
    assert "on purpose" in row["reason_detail"]
    assert [path.name for path in Path(summary.run_dir, "quarantine").iterdir()] == [f"{victim}.bundle"]


@pytest.mark.slow
def test_every_fault_harms_only_its_building_and_leaves_record_and_bundle(
    town: Path, reconstruct: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = reconstruct(town)
    good = rows_by_id(whole.run_dir)
    wanted = {
        "crash": "crashed",
        "abort": "crashed",
        "exit": "crashed",
        "endless": "timed_out",
        "endless_native": "timed_out",
        "eat_memory": "out_of_memory",
        "ask_memory": "out_of_memory",
        "raise": "internal_error",
        "chatter": None,
        "crash_gather": "crashed",
    }
    victims = dict(zip(wanted, sorted(name for name, row in good.items() if row["status"] == "ok"), strict=False))
    assert len(victims) == len(wanted)
    for name, value in environment(**{fault: [victim] for fault, victim in victims.items()}).items():
        monkeypatch.setenv(name, value)
    events: list[Event] = []
    summary = reconstruct(
        town, isolate=True, building_timeout_s=20.0, building_memory_bytes=2**30, on_event=events.append
    )
    hurt = rows_by_id(summary.run_dir)
    assert {fault: hurt[victim]["reason"] for fault, victim in victims.items()} == wanted
    assert "there is no bundle" in hurt[victims["crash_gather"]]["reason_detail"]
    kept = {path.stem for path in Path(summary.run_dir, "quarantine").iterdir()}
    assert kept == {victim for fault, victim in victims.items() if wanted[fault] and fault != "crash_gather"}
    lost = {victim for fault, victim in victims.items() if wanted[fault]}
    details = [event for event in events if event.kind == "detail"]
    assert {event.facts["building"] for event in details if event.message.startswith("failed: ")} == lost
    again = {event.facts["building"] for event in details if event.message.startswith("modelled again")}
    assert again >= {victims[fault] for fault in ("crash", "abort", "exit", "crash_gather")}
    assert not again & {victims[fault] for fault in ("endless", "endless_native", "raise", "chatter")}
    columns = [name for name in next(iter(good.values())) if name != "mesh_path"]
    for name in good.keys() - lost:
        assert [hurt[name][column] for column in columns] == [good[name][column] for column in columns]
    for name in lost - {victims["crash_gather"]}:
        assert hurt[name]["geometry"] is not None, "its place is known"
        assert hurt[name]["input_hash"] == good[name]["input_hash"]


@pytest.mark.slow
def test_an_item_that_reports_progress_may_take_longer_than_the_limit(
    bare: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(chores.__file__).parent), prepend=os.pathsep)
    limits = IsolationLimits(timeout_s=5.0, memory_bytes=2**30)
    assert list(supervise(chores.go_on, [6], limits)) == [(0, 6)]
