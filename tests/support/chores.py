"""Tasks for workers under test; in a module of its own, because tests themselves are not importable there."""

import dataclasses
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from pipeline.runtime.isolation.isolated_items import supervise
from pipeline.runtime.isolation.process_limits import IsolationLimits
from pipeline.runtime.isolation.progress_reports import report_progress
from pipeline.runtime.scratch.folder import Scratch

DEADLINE_S = 120.0


def double(number: int) -> int:
    return 2 * number


def die_at_first(task: tuple[str, int, int]) -> int:
    """Kill the process when the task runs for the first so many times; leave a mark at every run."""
    folder, number, deaths = task
    runs = len(list(Path(folder).glob(f"{number}.*")))
    Path(folder, f"{number}.{runs}").touch()
    if runs < deaths:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die_if_five(number: int) -> int:
    """Kill the process for one number."""
    if number == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def _named_when(name: str, is_time: Callable[[], bool]) -> str:
    """The name, when it is time."""
    end = time.monotonic() + DEADLINE_S
    while not is_time():
        if time.monotonic() > end:
            raise TimeoutError(f"{name} was not released")
        time.sleep(0.02)
    return name


def wait_for_mark(task: tuple[str, str]) -> str:
    """Say who runs, by a file that counts up, then wait for the file `go`."""
    folder, name = task
    order = len(list(Path(folder).glob("started-*")))
    Path(folder, f"started-{order:03d}-{name}").touch()
    return _named_when(name, Path(folder, "go").exists)


def meet(task: tuple[str, str, int]) -> str:
    """Say that it runs, then wait until so many tasks have said so."""
    folder, name, others = task
    Path(folder, f"met-{name}").touch()
    return _named_when(name, lambda: len(list(Path(folder).glob("met-*"))) >= others)


def tasks_held(dask_worker: object) -> int:
    """How many tasks a worker has, whether they run or wait."""
    return len(dask_worker.state.tasks)  # type: ignore[attr-defined]


def variable(name: str) -> str:
    """A variable of the environment."""
    return os.environ.get(name, "")


def say(words: str) -> int:
    """Say something to standard error; the process's number."""
    print(words, file=sys.stderr, flush=True)
    return os.getpid()


def look_at_scratch(scratch: Scratch) -> None:
    """Raise the error of a task whose scratch is gone."""
    scratch.check_cancelled()


def fail(message: str) -> None:
    """Raise what no task of a run raises."""
    raise ZeroDivisionError(message)


@dataclasses.dataclass(frozen=True)
class Weighty:
    """A task that declares memory."""

    folder: str
    name: str
    memory_bytes: int


def weigh(task: Weighty) -> str:
    """Like `wait_for_mark`, of a task that declares memory."""
    return wait_for_mark((task.folder, task.name))


def memory_left(dask_worker: object) -> float:
    """What a worker has left of the memory that it announced."""
    return dask_worker.state.available_resources["MEMORY"]  # type: ignore[attr-defined,no-any-return]


def family(_: object) -> tuple[int, int, int]:
    """Process ids: of this process's parent, of this process, and of the parent of its supervised child."""
    ((_, found),) = supervise(eval, ["__import__('os').getppid()"], IsolationLimits(), loads=())
    assert isinstance(found, int)
    return os.getppid(), os.getpid(), found


def go_on(count: int) -> int:
    """Take longer than the limit of an item in this test's supervisor, and report each step."""
    for _ in range(count):
        time.sleep(1.1)
        report_progress()
    return count


def never_end(_: object) -> None:
    """Read nothing more."""
    while True:
        time.sleep(0.05)


def end_by_signal(_: object) -> None:
    """Crash as a decoder does."""
    os.kill(os.getpid(), signal.SIGSEGV)


def ask_for_too_much(_: object) -> None:
    """Ask for memory as a header that lies does."""
    raise MemoryError
