"""Runs the API and keeps a driver beside it: a child process, started again when it dies, ended with its parent."""

from __future__ import annotations

import functools
import json
import logging
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI

from pipeline.backoff import Backoff
from service.app import create_app, start
from service.connections import listen, server_config
from service.errors import StoreError
from service.settings import ServiceSettings
from service.store import JobStore

RESTARTS = Backoff(first_s=0.5, longest_s=5.0)
"""Pauses before a driver that died is started again; meanwhile no job goes on."""

STEADY_S = 60.0
"""Seconds after which a driver counts as steady: if it dies, the pauses begin anew."""

GRACE_S = 10.0
"""Seconds that a driver gets for its own end, in addition to those for draining."""

SILENT_S = 30.0
"""Seconds without a sign of life after which a driver is killed: it is stopped, or one of its threads keeps the others
from working. Its jobs go on in the next one."""

START_S = 120.0
"""Seconds until the first sign of life, on a busy machine with cold caches."""

_TICK_S = 0.2

_log = logging.getLogger("gablework.serve")


def environment_of(settings: ServiceSettings, inherited: Mapping[str, str]) -> dict[str, str]:
    """The environment in which another process reads the same settings.

    Parameters
    ----------
    settings : ServiceSettings
        The settings that it must read.
    inherited : mapping
        This process's own environment.
    """
    prefix = "GABLEWORK_"
    environment = dict(inherited)
    for name in ServiceSettings.model_fields:
        # on this machine their names may have any case
        for written in [given for given in environment if given.upper() == f"{prefix}{name}".upper()]:
            del environment[written]
        value = getattr(settings, name)
        if value is not None:
            environment[f"{prefix}{name}".upper()] = _written(value)
    return environment


def _written(value: Any) -> str:
    if isinstance(value, tuple):
        return json.dumps([str(item) for item in value])
    return str(value.resolve()) if isinstance(value, Path) else str(value)


class Supervisor:
    """Keeps one driver running.

    Parameters
    ----------
    command : sequence of str
        Starts a driver; its unique name is appended. Its standard input is a socket that closes when this process ends
        in any way, and takes a byte every second as a sign of life.
    environment : mapping
        Its environment.
    on_death : callable
        Gets the name of each driver that ended by itself or was killed.
    """

    def __init__(self, command: list[str], environment: Mapping[str, str], on_death: Callable[[str], None]) -> None:
        self._command = command
        self._environment = dict(environment)
        self._on_death = on_death
        self._name = ""
        self._child: subprocess.Popen[bytes] | None = None
        self._signs: socket.socket | None = None
        # a signal handler may take it while this thread holds it
        self._lock = threading.RLock()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="supervisor", daemon=True)
        self.deaths = 0
        """Number of deaths since the last steady driver."""

    def start(self) -> None:
        """Start the driver, and watch it."""
        self._launch()
        self._thread.start()

    def status(self) -> str:
        """running, starting again, or ending."""
        if self._ending.is_set():
            return "ending"
        child = self._child
        return "running" if child is not None and child.poll() is None else "starting again"

    @property
    def pid(self) -> int | None:
        """Process id of the driver."""
        return None if self._child is None else self._child.pid

    def _launch(self) -> None:
        with self._lock:
            if not self._ending.is_set():
                self._name = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(3)}"
                command = [*self._command, self._name]
                ours, theirs = socket.socketpair()
                ours.settimeout(_TICK_S)
                with theirs:
                    self._child = subprocess.Popen(command, env=self._environment, stdin=theirs.fileno())  # noqa: S603
                if self._signs is not None:
                    self._signs.close()
                self._signs = ours

    def _keep(self) -> None:
        while not self._ending.is_set():
            began = time.monotonic()
            child = self._child
            assert child is not None
            code = self._watched(child)
            if self._ending.is_set():
                return
            self.deaths = 1 if time.monotonic() - began > STEADY_S else self.deaths + 1
            wait_s = RESTARTS.bound_s(self.deaths)
            _log.error("the driver ended with code %d; another one starts in %.1f s", code, wait_s)
            self._on_death(self._name)
            if self._ending.wait(wait_s):
                return
            self._launch()

    def _watched(self, child: subprocess.Popen[bytes]) -> int:
        """The return code of a driver, which is killed if it gives no sign of life for too long."""
        signs, silent_s = self._signs, SILENT_S - START_S
        assert signs is not None
        while child.poll() is None:
            began_s = time.monotonic()
            try:
                if signs.recv(4096):
                    silent_s = 0.0
                    continue
                # its end is closed: it ends, or has broken off
                time.sleep(_TICK_S)
            except TimeoutError:
                pass
            # if this process was stopped, too, that time says nothing about the driver
            silent_s += min(time.monotonic() - began_s, 2.0 * _TICK_S)
            if silent_s > SILENT_S and not self._ending.is_set():
                _log.error(
                    "the driver gave no sign of life for %.0f s and is killed; its jobs go on in another", silent_s
                )
                child.kill()
        return child.wait()

    def ask_to_end(self) -> None:
        """Ask the driver once to finish its jobs and end; a second signal would end it at once."""
        with self._lock:
            if not self._ending.is_set() and self._child is not None and self._child.poll() is None:
                self._child.terminate()
            self._ending.set()

    def end(self, within_s: float) -> None:
        """Wait until the driver has ended; after `within_s` seconds it is killed."""
        self.ask_to_end()
        child = self._child
        if child is None:
            return
        try:
            child.wait(within_s)
        except subprocess.TimeoutExpired:
            _log.error("the driver did not end within %.0f s and is killed; its jobs go back to the queue", within_s)
            child.kill()
        if child.wait():
            self._on_death(self._name)

    def kill(self) -> None:
        """End the driver now; `end` gives its jobs back to the queue."""
        with self._lock:
            self._ending.set()
            if self._child is not None:
                self._child.kill()


class _Server(uvicorn.Server):
    """A server that reports when it listens, and when it must end."""

    def __init__(
        self, config: uvicorn.Config, app: FastAPI, *, on_ready: Callable[[], None], on_exit: Callable[[], None]
    ) -> None:
        super().__init__(config)
        self._application = app
        self._on_ready = on_ready
        self._on_exit = on_exit

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, then report it."""
        await super().startup(sockets)
        if self.started and not self.should_exit:
            self._on_ready()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """End; streams end by themselves, and the driver starts to drain."""
        self._application.state.streams.closing = True
        self._on_exit()
        super().handle_exit(sig, frame)


def _give_back(store: JobStore, max_attempts: int, driver: str) -> None:
    """Put the jobs of a dead driver back into the queue now; otherwise they would wait for their leases to end."""
    try:
        for job_id in store.give_up(driver, max_attempts=max_attempts):
            _log.warning("job %s of driver %s waits for another driver", job_id, driver)
    except StoreError as error:
        _log.warning("the jobs of driver %s wait until their leases end: %s", driver, error)


def serve(settings: ServiceSettings, on_ready: Callable[[str], None], *, with_driver: bool = True) -> None:
    """Answer requests until SIGTERM or SIGINT, with a driver beside it.

    Parameters
    ----------
    settings : ServiceSettings
        All settings.
    on_ready : callable
        Gets the URL when requests are answered.
    with_driver : bool
        Whether to keep a driver; without, one runs elsewhere.

    Raises
    ------
    StartUpError
        The address is not available, or needs keys.
    StoreError
        The database does not answer.
    """
    with JobStore(settings.database) as store:
        start(settings, store)
    listening, url = listen(settings)
    app = create_app(settings)
    supervisor = None
    if with_driver:
        command = [sys.executable, "-m", "service.cli", "driver", "--with-parent", "--name"]
        give_back = functools.partial(_give_back, app.state.store, settings.max_attempts)
        supervisor = Supervisor(command, environment_of(settings, os.environ), give_back)
        app.state.driver = supervisor.status
    config = server_config(app, settings)

    def on_exit() -> None:
        if supervisor is not None:
            supervisor.ask_to_end()

    server = _Server(config, app, on_ready=lambda: on_ready(url), on_exit=on_exit)
    signals: list[int] = []

    def on_signal(number: int, _frame: FrameType | None) -> None:
        # while it runs, the server has its own handlers; it passes the caught signals on to this one
        signals.append(number)
        server.should_exit = True
        if len(signals) > 1 and supervisor is not None:
            _log.warning("second signal: the driver is killed")
            supervisor.kill()

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        if supervisor is not None:
            supervisor.start()
        server.run(sockets=[listening])
    finally:
        if supervisor is not None:
            supervisor.end(settings.drain_s + GRACE_S)
        for number, handler in before.items():
            signal.signal(number, handler)
        listening.close()
