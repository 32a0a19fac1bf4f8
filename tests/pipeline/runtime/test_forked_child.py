"""Children forked from a preloaded server have what it loaded; the loss of the server costs only time."""

import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import psutil
import pytest
from processes import LONG_S, wait_for

from pipeline.errors import RunCancelledError, RunError
from pipeline.runtime.isolation import child_pool, fork_server
from pipeline.runtime.isolation.isolated_items import supervise
from pipeline.runtime.isolation.process_limits import IsolationLimits, Loss

LIMITS = IsolationLimits(timeout_s=120.0, memory_bytes=2**30)

PROGRAM = """
import os, threading, time
LOADED_BY = os.getpid()
def load():
    pass
def load_with_thread():
    threading.Thread(target=time.sleep, args=(1000,), daemon=True).start()
def read(path):
    open(path).read()
def fail():
    raise OSError("not loaded")
def ask(expression):
    return eval(expression)
"""

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked only on Linux")


@pytest.fixture(autouse=True)
def no_children_left() -> Iterator[None]:
    """Neither children nor servers of other tests, and none afterwards."""
    child_pool.kill_children()
    yield
    child_pool.kill_children()
    assert ours() == []


Ask = Callable[..., Any]


@pytest.fixture
def ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ask:
    """Evaluates an expression in a fresh child that has loaded a module of the test."""
    (tmp_path / "loaded_by_a_test.py").write_text(PROGRAM)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.syspath_prepend(str(tmp_path))
    import loaded_by_a_test  # type: ignore[import-not-found]

    def asked(expression: str, loads: str = "loaded_by_a_test:load") -> Any:
        for child in tuple(child_pool._pool._idle):
            child.begun = 1
        with child_pool.borrowed_child(lambda: False, fresh=True, loads=(loads,)) as child:
            child.begun = 1
        ((_, found),) = supervise(loaded_by_a_test.ask, [expression], LIMITS, loads=(loads,))
        return found

    return asked


def ours() -> list[psutil.Process]:
    """Children and servers of this process, without the server of Dask's workers, which outlives other tests."""
    of_dask = forkserver._forkserver._forkserver_pid
    found = psutil.Process().children(recursive=True)
    return [process for process in found if process.name().startswith("gable") and process.pid != of_dask]


def servers() -> list[psutil.Process]:
    """The living servers of this process."""
    found = [process for process in ours() if process.name() == fork_server.NAME]
    return [process for process in found if process.status() != psutil.STATUS_ZOMBIE]


def test_children_have_what_their_server_loaded(ask: Ask) -> None:
    loaded_by, first = ask("__import__('loaded_by_a_test').LOADED_BY, os.getpid()")
    assert [server.pid for server in servers()] == [loaded_by]
    assert ask("__import__('loaded_by_a_test').LOADED_BY") == loaded_by
    assert first != loaded_by


def test_a_server_can_start_before_its_first_child(ask: Ask) -> None:
    child_pool.preload(["loaded_by_a_test"])
    (server,) = wait_for(servers, "the server")
    assert ask("__import__('loaded_by_a_test').LOADED_BY") == server.pid


def test_a_child_reports_what_its_server_cannot_load(ask: Ask) -> None:
    child_pool.preload(["loaded_by_a_test:fail"])
    assert ask("1 + 1") == 2
    with pytest.raises(RunError, match=r"(?s)3 times in a row.*OSError: not loaded"):
        ask("1", "loaded_by_a_test:fail")


def test_children_have_the_present_environment_and_folder(
    ask: Ask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = ask("os.getppid()")
    monkeypatch.setenv("SOME_WORD", "new")
    monkeypatch.chdir(tmp_path)
    child_pool._pool._idle[0].end()
    assert ask("os.environ['SOME_WORD'], os.getcwd(), os.getppid()") == ("new", str(tmp_path), server)


def test_a_change_of_a_variable_that_is_read_once_starts_another_server(
    ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = ask("os.getppid()")
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    child_pool._pool._idle[0].end()
    after = ask("os.getppid()")
    assert after != before
    wait_for(lambda: [server.pid for server in servers()] == [after], "the end of the retired server")


def test_children_begin_with_one_thread_and_their_own_session(ask: Ask) -> None:
    assert ask("len(os.listdir('/proc/self/task')), os.getsid(0) == os.getpid() == os.getpgid(0)") == (2, True)


def test_children_of_a_server_that_is_killed_die_and_the_work_is_done_by_others(ask: Ask, tmp_path: Path) -> None:
    mark, go = tmp_path / "mark", tmp_path / "go"
    order = f"open('{mark}', 'a').write('1') and [time.sleep(0.02) for _ in iter(lambda: os.path.exists('{go}'), True)]"
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(ask(order)))
    thread.start()
    wait_for(lambda: mark.exists() and mark.read_text() == "1", "the first trial")
    (server,) = servers()
    server.kill()
    wait_for(lambda: mark.read_text() == "11", "the second trial")
    go.touch()
    thread.join(LONG_S)
    assert len(found) == 1
    assert not isinstance(found[0], Loss)
    assert [other.pid for other in servers()] != [server.pid]


def test_a_server_ignores_sigterm(ask: Ask) -> None:
    server = ask("os.getppid()")
    os.kill(server, signal.SIGTERM)
    child_pool._pool._idle[0].end()
    assert ask("os.getppid()") == server


def test_nothing_is_forked_from_a_process_with_threads(
    ask: Ask, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child_pool._pool, "_can_fork", True)  # restored after the test
    with caplog.at_level(logging.WARNING):
        assert ask("os.getppid()", "loaded_by_a_test:load_with_thread") == os.getpid()
        child_pool._pool._idle[0].end()
        assert ask("os.getppid()", "loaded_by_a_test:load") == os.getpid()
    assert "started threads" in caplog.text


def test_children_are_spawned_if_nothing_can_be_forked(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_pool._pool, "_can_fork", False)
    assert ask("os.getppid()") == os.getpid()
    loss = ask("os.kill(os.getpid(), 11)")
    assert "signal 11 (SIGSEGV), also alone" in loss.detail
    assert servers() == []


def test_a_child_cancelled_before_its_server_has_loaded_never_begins(ask: Ask, tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)  # opening it waits for a writer
    with (
        pytest.raises(RunCancelledError),
        child_pool.borrowed_child(lambda: True, fresh=False, loads=(f"loaded_by_a_test:read:{fifo}",)),
    ):
        pytest.fail("it is not ready")
    assert child_pool._pool._all == set()


FIRST_FILE = """
import functools, os, sys
held = os.open(sys.argv[1], os.O_RDONLY)
assert held == 3, held
from pipeline.runtime.isolation import child_pool
from pipeline.runtime.isolation.isolated_items import supervise
from pipeline.runtime.isolation.process_limits import IsolationLimits
child_pool.fork_own_server()
limits = IsolationLimits(timeout_s=120.0, memory_bytes=2**30)
for turn in range(2):
    print([found for _, found in supervise(functools.partial(os.pread, 3, 5), [0, 1], limits)])
"""


def test_children_read_a_file_opened_before_the_fork_by_its_number(tmp_path: Path) -> None:
    """Libraries such as PROJ keep the descriptor of their database; a pipe with that number broke both."""
    (tmp_path / "data").write_bytes(b"held data")
    command = [sys.executable, "-P", "-c", FIRST_FILE, str(tmp_path / "data")]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.stdout.splitlines() == ["[b'held ', b'eld d']"] * 2, ended.stderr
