"""Kernels of a fresh installation, compiled once from the start of a driver on; jobs that need them say so and wait."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Protocol

from pipeline.errors import RunCancelledError
from pipeline.runtime.compile_listed import STAGE
from pipeline.runtime.compiling import RECONSTRUCT, compile_first
from pipeline.runtime.monitoring.progress import Event, Listener
from service.driver.leased_job import LOG, LeasedJob
from service.jobs import JobRequest

_LOOK_S = 0.25
"""Seconds between two looks of a waiting job."""
_OTHERS = ("classify", "terrain", "compare", "solar")
"""Groups of kernels that other jobs call."""
_DEFAULT = {"method": "arrangement", "terrain": "none"}
"""General settings with which a reconstruction needs the first kernels alone."""


class CompileFirst(Protocol):
    """`pipeline.runtime.compiling.compile_first`."""

    def __call__(self, on_event: Listener, groups: Sequence[str], *, cancelled: Callable[[], bool]) -> None:
        """Compile what some groups of kernels lack."""


def needs_all_kernels(request: JobRequest) -> bool:
    """Whether a job calls other kernels than a reconstruction by the default method."""
    general = {**request.settings.get("general", {}), **request.settings}
    changed = any(general.get(name, usual) != usual for name, usual in _DEFAULT.items())
    return request.process_id != "reconstruct" or request.points or bool(request.publish) or changed


class Kernels:
    """Compiles in a thread: first what most jobs need, then the rest.

    Parameters
    ----------
    compiles : bool
        Whether jobs run on this machine; a cluster elsewhere compiles for itself.
    compile_groups : callable
        Compiles groups of kernels; replaced in tests.
    """

    def __init__(self, *, compiles: bool, compile_groups: CompileFirst = compile_first) -> None:
        self._compile = compile_groups
        self._stopped = threading.Event()
        self._first, self._rest = threading.Event(), threading.Event()
        self._said: tuple[Event, ...] = ()
        """What is compiled, and how far it is."""
        self._warnings: tuple[Event, ...] = ()
        self._thread = threading.Thread(target=self._work, name="kernels", daemon=True) if compiles else None
        if self._thread is None:
            self._first.set()
            self._rest.set()

    def start(self) -> None:
        """Begin; where all is compiled it takes a second."""
        if self._thread is not None and self._thread.ident is None:
            self._thread.start()

    def stop(self) -> None:
        """Begin no further kernel; what is compiled is lost."""
        self._stopped.set()

    def wait_for_first(self) -> None:
        """Wait until the kernels of most jobs are there, or this is stopped."""
        while not self._first.wait(_LOOK_S) and not self._stopped.is_set():
            continue

    def wait_for(self, held: LeasedJob) -> None:
        """Wait until the kernels of a job are there, and record in the job what is compiled.

        Raises
        ------
        RunCancelledError
            The job must end.
        """
        if held.job.request.process_id == "echo":
            return
        ready = self._rest if needs_all_kernels(held.job.request) else self._first
        heard: tuple[Event, ...] = ()
        while not ready.is_set():
            # a job that comes later hears what is compiled, and then how far it is
            said = self._said
            for event in said:
                if not any(event is known for known in heard):
                    held.record(event)
            heard = said
            if held.cancelled() or held.wait(_LOOK_S):
                raise RunCancelledError("the job was cancelled")
        for warning in self._warnings:
            held.record(warning)

    def _work(self) -> None:
        for names, done in ((RECONSTRUCT, self._first), (_OTHERS, self._rest)):
            if self._stopped.is_set():
                return
            try:
                self._compile(self._say, names, cancelled=self._stopped.is_set)
            except Exception:  # noqa: BLE001 - jobs must not wait for ever; they compile what they call
                LOG.exception("kernels were not compiled ahead")
            finally:
                done.set()

    def _say(self, event: Event) -> None:
        if event.kind == "warning":
            self._warnings = (*self._warnings, event)
            LOG.warning("%s", event.message, extra={"stage": STAGE})
            return
        self._said = (event,) if event.kind == "stage" else (self._said[0], event)
        if event.kind == "stage" or event.done == event.total:
            LOG.info("%s", event.message or f"{event.total} kernels are compiled", extra={"stage": STAGE})
