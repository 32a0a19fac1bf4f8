"""Work of attempts that goes wrong in every way, for processes that a driver must survive."""

import os
import signal
import threading
import time
from typing import Any

from pipeline.errors import UnreadableInputError
from pipeline.io.temporary import temporary_folder
from pipeline.runtime.isolation import child_main
from pipeline.runtime.monitoring.progress import Event
from service.driver.attempt_child import End, Order
from service.errors import RequestError

Done = tuple[str, dict[str, Any]]

_kept: list[bytearray] = []


def _begin(stage: str = "split") -> None:
    child_main.say(Event(kind="stage", stage=stage))


def loop_for_ever(_order: Order) -> Done:
    """A loop as in a chain of causes that is a circle."""
    _begin()
    while True:
        pass


def loop_unless_urgent(order: Order) -> Done:
    return _results(order) if order.job.priority else loop_for_ever(order)


def keep_the_interpreter(_order: Order) -> Done:
    """A native loop that no signal and no other thread of the process interrupts."""
    _begin()
    return str(sum(range(10**15))), {}


def stop_itself(_order: Order) -> Done:
    _begin()
    os.kill(os.getpid(), signal.SIGSTOP)
    return "never", {}


def wait_for_itself(_order: Order) -> Done:
    _begin()
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()
    return "never", {}


def eat_memory(_order: Order) -> Done:
    _begin()
    eaten = []
    while True:
        eaten.append(bytearray(os.urandom(1)) * 2**27)


def eat_memory_at_once(_order: Order) -> Done:
    _begin()
    return str(len(bytearray(2**40))), {}


def crash(_order: Order) -> Done:
    _begin()
    os.kill(os.getpid(), signal.SIGSEGV)
    return "never", {}


def crash_with_much_unpacked(order: Order) -> Done:
    with temporary_folder() as folder:
        (folder / "unpacked").write_bytes(bytes(100))
        return crash(order)


def be_killed(_order: Order) -> Done:
    """SIGKILL from outside looks the same."""
    _begin()
    os.kill(os.getpid(), signal.SIGKILL)
    return "never", {}


def refuse(_order: Order) -> Done:
    _begin("inputs")
    raise UnreadableInputError("tile.laz", "is truncated", "Send it again")


def refuse_the_request(_order: Order) -> Done:
    raise RequestError(["the first fault", "the second fault"])


def work_slowly(order: Order) -> Done:
    """Honest work: each step takes a part of what a step may take, all together several times as long."""
    _begin("split")
    steps = 5
    for step in range(steps):
        time.sleep(order.settings.stall_s / 3.0)
        child_main.say(Event(kind="progress", stage="split", done=step + 1, total=steps))
    return _results(order)


def refuse_unless_urgent(order: Order) -> Done:
    return _results(order) if order.job.priority else refuse(order)


def keep_much(order: Order) -> Done:
    """A process that holds as much memory as the job's priority says, in MiB, when its attempt is over."""
    _kept.append(bytearray(os.urandom(1)) * (order.job.priority * 2**20))
    return _results(order)


def crash_in_a_used_process(order: Order) -> Done:
    """What the first job of a process left there ends the next one; both kinds of job are innocent."""
    if _kept:
        crash(order)
    _kept.append(bytearray(1))
    return _results(order)


def say_too_late(order: Order) -> Done:
    """A thread that says something when the attempt is over."""

    def say() -> None:
        while not (order.settings.state / "go").exists():
            time.sleep(0.01)
        child_main.say(Event(kind="stage", stage="late"))
        (order.settings.state / "said").touch()

    if not (order.settings.state / "go").exists():
        threading.Thread(target=say, daemon=True).start()
    return _results(order)


def stop_when_asked(order: Order) -> Done:
    """An attempt that stops in good order, and says so; the second one is done."""
    left = order.place / "left"
    if left.exists():
        return _results(order)
    _begin("split")
    while not isinstance(child_main.HEARD.get(), End):
        continue
    left.write_text(str(order.job.attempt))
    raise RequestError(["stopped"])


def stop_never_then_work(order: Order) -> Done:
    """An attempt that does not hear; the second one is done."""
    left = order.place / "left"
    if left.exists():
        return _results(order)
    left.write_text(str(order.job.attempt))
    return loop_for_ever(order)


def _results(order: Order) -> Done:
    (order.place / "outputs").mkdir(exist_ok=True)
    (order.place / "outputs" / "outputs.json").write_text("{}")
    return f"done in {order.place.name}", {"engine_version": "1", "pid": os.getpid()}
