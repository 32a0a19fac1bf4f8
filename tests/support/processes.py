"""Real programs for tests: found or skipped, each logged in its own process group and ended by id."""

import contextlib
import functools
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar
from urllib.parse import quote

import psutil
import pytest

Value = TypeVar("Value")

REQUIRED = "GABLEWORK_REQUIRE_PROGRAMS"
"""Environment variable of .ci/run: with 1 a test fails if a program is missing, instead of being skipped."""

LONG_S = 300.0
"""A deadline for work that takes seconds on an idle machine; not a promise of speed."""

_POSTGRES_FOLDERS = "/usr/lib/postgresql/*/bin"
_LOG_TAIL_LINES = 60


def missing(what: str) -> NoReturn:
    """Skip the test for lack of a program, or fail if programs are required."""
    if os.environ.get(REQUIRED) == "1":
        pytest.fail(f"{what}, and {REQUIRED}=1")
    pytest.skip(what)


def program(name: str, *elsewhere: str) -> Path:
    """A program of this environment, of the PATH, or of the folders that match one of the patterns, newest last."""
    beside = Path(sys.executable).parent / name
    if beside.exists():
        return beside
    found = shutil.which(name)
    if found is not None:
        return Path(found)
    for pattern in elsewhere:
        for folder in sorted(Path("/").glob(pattern.lstrip("/")), reverse=True):
            if (folder / name).exists():
                return folder / name
    missing(f"the program {name} is not installed")


def free_port() -> int:
    """A free TCP port of the loopback."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
        return port


def wait_for(
    condition: Callable[[], Value | None], what: str, deadline_s: float = LONG_S, *, interval_s: float = 0.02
) -> Value:
    """Wait until the condition is true; returns its value, or fails after the deadline with the name of `what`.

    After the first seconds it looks less often: what is waited for needs the processor more.
    """
    began = time.monotonic()
    end = began + deadline_s
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > end:
            pytest.fail(f"waited {deadline_s:g} s in vain for {what}")
        time.sleep(max(interval_s, min(0.1, (time.monotonic() - began) / 20.0)))


def listens(port: int, host: str = "127.0.0.1") -> bool:
    with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=1.0):
        return True
    return False


def lives(process: psutil.Process) -> bool:
    """Whether a process still runs; one that only waits to be reaped does not."""
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def as_user(user: str | int | None) -> dict[str, Any]:
    """Options by which a process runs with the rights of a user alone; None is this user."""
    return {"user": user, "group": user, "extra_groups": None if user is None else []}


class Program:
    """One started program; its standard output and standard error go to the file `log`."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        log: Path,
        *,
        env: Mapping[str, str] | None = None,
        cwd: Path | None = None,
        user: str | int | None = None,
    ) -> None:
        self.name = name
        self.command = tuple(command)
        self.log = log
        with log.open("ab") as output:
            self.process = subprocess.Popen(
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=None if env is None else dict(env),
                cwd=cwd,
                start_new_session=True,
                **as_user(user),
            )
        self._seen: set[psutil.Process] = set()

    @property
    def pid(self) -> int:
        """Process id, of the process group too."""
        return self.process.pid

    @property
    def alive(self) -> bool:
        """Whether the process itself still runs."""
        return self.process.poll() is None

    @property
    def text(self) -> str:
        return self.log.read_text(errors="replace")

    def children(self) -> list[psutil.Process]:
        """All descendants that are alive."""
        with contextlib.suppress(psutil.NoSuchProcess):
            self._seen.update(psutil.Process(self.pid).children(recursive=True))
        return [child for child in self._seen if lives(child)]

    def wait_for(
        self,
        condition: Callable[[], Value | None],
        what: str,
        deadline_s: float = LONG_S,
        *,
        interval_s: float = 0.02,
    ) -> Value:
        """Like `wait_for`, but fails at once where the program has ended."""

        def alive_and_true() -> Value | None:
            value = condition()
            if not value and not self.alive:
                pytest.fail(f"{self.name} ended with {self.process.returncode}, waited for {what}:\n{self.tail()}")
            return value

        return wait_for(alive_and_true, f"{what} of {self.name}", deadline_s, interval_s=interval_s)

    def wait_for_port(self, port: int) -> None:
        """Wait until a program listens on a port of the loopback."""
        self.wait_for(lambda: listens(port), f"port {port}")

    def wait_for_text(self, words: str, deadline_s: float = LONG_S) -> None:
        """Wait until the log holds some words."""
        self.wait_for(lambda: words in self.text, f"the words {words!r} in the log", deadline_s)

    def ended(self, deadline_s: float = LONG_S) -> int:
        """The exit code, once the process has ended."""
        try:
            return self.process.wait(deadline_s)
        except subprocess.TimeoutExpired:
            pytest.fail(f"{self.name} has not ended after {deadline_s:g} s:\n{self.tail()}")

    def stop(self, deadline_s: float = LONG_S) -> int:
        """Ask it to end (SIGTERM) and wait for it; the exit code."""
        self.children()
        if self.alive:
            self.process.send_signal(signal.SIGTERM)
        return self.ended(deadline_s)

    def kill(self, *, group: bool = True) -> None:
        """Kill it (SIGKILL), its process group too, and wait until it is gone."""
        self.children()
        if group:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
        elif self.alive:
            self.process.kill()
        self.process.wait(LONG_S)

    def end(self) -> None:
        """Leave nothing of it: the group and every descendant that was ever seen."""
        self.children()
        self.kill()
        for child in self.children():
            with contextlib.suppress(psutil.NoSuchProcess):
                child.kill()

    def tail(self) -> str:
        lines = self.text.splitlines()
        return "\n".join([f"--- {self.name}: {' '.join(self.command)}", *lines[-_LOG_TAIL_LINES:]])


class Programs:
    """The programs of one test; all are ended when it is over, and their logs are shown if it failed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.started: list[Program] = []

    def start(self, name: str, command: Sequence[str], *, inherit: bool = True, **options: Any) -> Program:
        """Start a program; its `env` goes on top of this process's environment, or is all there is."""
        env = {**(os.environ if inherit else {}), **(options.pop("env", None) or {})}
        one = Program(name, command, self._folder / f"{name}.log", env=env, **options)
        self.started.append(one)
        return one

    def start_scheduler(self, port: int, *options: str, **more: Any) -> Program:
        """Start `dask scheduler` on the loopback, and wait until it listens."""
        command = [str(program("dask")), "scheduler", "--host", "127.0.0.1", "--port", str(port)]
        started = self.start("scheduler", [*command, "--dashboard-address", "127.0.0.1:0", *options], **more)
        started.wait_for_port(port)
        return started

    def end(self) -> None:
        """End all, the last first; what is printed here shows up in the report of a failed test."""
        for one in reversed(self.started):
            one.end()
        for name in dict.fromkeys(one.name for one in self.started):
            print(next(one for one in self.started if one.name == name).tail())


@pytest.fixture
def programs(tmp_path: Path) -> Iterator[Programs]:
    folder = tmp_path / "logs"
    folder.mkdir()
    some = Programs(folder)
    try:
        yield some
    finally:
        some.end()


class PostgresServer:
    """A PostgreSQL server with a fresh cluster in a folder, on a free port of the loopback, with a password.

    PostgreSQL refuses to run as root; then it runs as the user `postgres`.
    """

    user = "gablework"

    def __init__(self, folder: Path) -> None:
        self._bin = program("postgres", _POSTGRES_FOLDERS).resolve().parent
        self._account = "postgres" if os.geteuid() == 0 else None
        self._data = folder / "data"
        self._log = folder / "postgres.log"
        self.password = secrets.token_urlsafe(12)
        self.port = free_port()
        password_file = folder / "password"
        password_file.write_text(self.password)
        if self._account is not None:
            for path in (folder, password_file):
                shutil.chown(path, self._account)
        self._check(
            *("initdb", f"--pgdata={self._data}", f"--username={self.user}", f"--pwfile={password_file}", "--no-sync"),
            *("--auth=scram-sha-256", "--encoding=UTF8", "--locale=C"),
        )
        password_file.unlink()
        self.process = self._started()

    def _check(self, name: str, *arguments: str) -> None:
        """Run one of PostgreSQL's programs to its end."""
        subprocess.run(
            [self._bin / name, *arguments],
            check=True,
            capture_output=True,
            cwd="/",
            **as_user(self._account),
        )

    def _started(self) -> Program:
        # fsync guards against the loss of power, not of processes
        options = {
            "listen_addresses": "127.0.0.1",
            "port": self.port,
            "unix_socket_directories": "",
            "fsync": "off",
            "max_connections": 100,
        }
        command = [str(self._bin / "postgres"), "-D", str(self._data)]
        command += [part for name, value in options.items() for part in ("-c", f"{name}={value}")]
        process = Program("postgres", command, self._log, cwd=Path("/"), user=self._account)
        process.wait_for(self._answers, "an answer")
        return process

    def _answers(self) -> bool:
        arguments = ["--host=127.0.0.1", f"--port={self.port}", "--quiet"]
        return subprocess.run([self._bin / "pg_isready", *arguments], check=False).returncode == 0

    def url(self, database: str = "postgres") -> str:
        """The SQLAlchemy URL of a database."""
        return f"postgresql+pg8000://{self.user}:{quote(self.password)}@127.0.0.1:{self.port}/{database}"

    def create_database(self, *, with_tables: bool = False) -> str:
        """The SQLAlchemy URL of a fresh database: empty, or with the service's tables and nothing in them."""
        import pg8000.native

        name = f"test_{secrets.token_hex(6)}"
        template = self._with_tables if with_tables else "template1"
        connection = pg8000.native.Connection(
            self.user, host="127.0.0.1", port=self.port, database="postgres", password=self.password
        )
        try:
            connection.run(f'CREATE DATABASE "{name}" TEMPLATE "{template}"')
        finally:
            connection.close()
        return self.url(name)

    @functools.cached_property
    def _with_tables(self) -> str:
        """The name of a database that was migrated once, for others to be copied from."""
        from service.store import JobStore

        url = self.create_database()
        with JobStore(url) as store:
            store.migrate()
        return url.rpartition("/")[2]

    def stop(self) -> None:
        """Stop it, connections are cut; the data stay."""
        if self.process.alive:
            self.process.process.send_signal(signal.SIGINT)
        self.process.ended()

    def start(self) -> None:
        """Start it again on the same port."""
        self.process = self._started()


@contextlib.contextmanager
def _open_folder(purpose: str) -> Iterator[Path]:
    # not below pytest's own folder: another user could not enter it
    with tempfile.TemporaryDirectory(prefix=f"gablework-{purpose}-") as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


@pytest.fixture(scope="module")
def open_folder() -> Iterator[Path]:
    """A temporary folder that other users may enter."""
    with _open_folder("test") as folder:
        yield folder


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[PostgresServer]:
    """A PostgreSQL server for all tests of the session; tests take a database each (`postgres_url`)."""
    with _open_folder("postgres") as folder:
        server = PostgresServer(folder)
        try:
            yield server
        finally:
            server.process.end()


@pytest.fixture
def postgres_url(postgres_server: PostgresServer) -> str:
    """The SQLAlchemy URL of a fresh PostgreSQL database."""
    return postgres_server.create_database()
