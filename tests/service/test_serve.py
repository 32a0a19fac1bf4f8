"""`gablework serve`, `driver` and `keys` as processes: starting, refusing, restarting the driver, ending."""

import contextlib
import inspect
import json
import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import httpx
import psutil
import pytest
from click.testing import Result
from command_line import app
from live_service import POINTS
from processes import LONG_S, wait_for
from pydantic import ValidationError
from typer.testing import CliRunner

from pipeline.options import ResourceOptions, options_of
from pipeline.runtime.isolation.process_limits import MIN_MEMORY_BYTES
from service import supervisor as supervisor_module
from service.connections import listen
from service.settings import ServiceSettings
from service.supervisor import Supervisor, environment_of


def gablework(*words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "service.cli", *words]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=LONG_S, **options)


def invoke(*words: str) -> Result:
    """The same, in this process: starting one takes longer than most commands do."""
    return CliRunner().invoke(app, list(words))


class Served:
    """A service that runs as a process."""

    def __init__(self, state: Path, *options: str) -> None:
        command = [sys.executable, "-m", "service.cli", "serve", "--json", "--port", "0", "--state", str(state)]
        self.process = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True)
        reported = ""
        while not reported.rstrip().endswith("}"):
            line = self.process.stdout.readline()
            assert line, f"serve ended with {self.process.wait()}"
            reported += line
        self.url = json.loads(reported)["url"]

    def driver(self) -> psutil.Process:
        """The driver's process."""

        def find() -> psutil.Process | None:
            with contextlib.suppress(psutil.NoSuchProcess):
                children = psutil.Process(self.process.pid).children()
                return next((child for child in children if "driver" in child.cmdline()), None)
            return None

        found = wait_for(find, "a driver beside the service")
        assert isinstance(found, psutil.Process)
        return found

    def end(self) -> None:
        with contextlib.suppress(psutil.NoSuchProcess):
            family = psutil.Process(self.process.pid).children(recursive=True)
            self.process.kill()
            for member in family:
                with contextlib.suppress(psutil.NoSuchProcess):
                    member.kill()
        self.process.wait()
        self.process.stdout.close()


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Callable[..., Served]]:
    with contextlib.ExitStack() as stack:

        def start(*options: str) -> Served:
            running = Served(tmp_path / "state", *options)
            stack.callback(running.end)
            return running

        yield start


# --- without a process


SCIENCE = ["numba", "scipy", "pandas", "matplotlib", "dask", "distributed", "pyarrow", "laspy", "pyogrio"]


@pytest.mark.parametrize(
    ("module", "heavy"),
    [("service.cli", ["fastapi", "sqlalchemy", "numba", "numpy"]), ("service.supervisor", SCIENCE)],
    ids=["help imports nothing of the service", "the API imports nothing of the science"],
)
def test_a_process_imports_nothing_that_it_does_not_need(module: str, heavy: list[str]) -> None:
    code = f"import sys; import {module}; print([m for m in {heavy} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_another_process_reads_the_same_settings_from_its_environment(tmp_path: Path, monkeypatch) -> None:
    settings = ServiceSettings(
        state=tmp_path,
        input_roots=(tmp_path, Path("/data")),
        input_hosts=("a.example",),
        max_points=5,
        rate_limit="9/second",
    )
    old = {"gablework_workers": "77", "GABLEWORK_SCHEDULER": "tcp://old:1", "HOME": "/"}
    environment = environment_of(settings, old)
    assert environment["HOME"] == "/"
    for name in list(os.environ):
        if name.upper().startswith("GABLEWORK_"):
            monkeypatch.delenv(name)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert ServiceSettings() == settings


@pytest.fixture
def handed_on(monkeypatch) -> list[ServiceSettings]:
    """The settings with which `serve` and `driver` would have started, in their order."""
    taken: list[ServiceSettings] = []
    monkeypatch.setattr("service.supervisor.serve", lambda settings, *_, **__: taken.append(settings))
    monkeypatch.setattr("service.driver.run_driver", lambda settings, **_: taken.append(settings))
    monkeypatch.setattr("service.commands._log_to_stderr", lambda: None)
    monkeypatch.setenv("GABLEWORK_WORKERS", "2")
    return taken


@pytest.mark.parametrize("command", ["serve", "driver"])
@pytest.mark.parametrize(("words", "workers"), [((), 2), (("--workers", "auto"), "auto"), (("--workers", "7"), 7)])
def test_the_option_for_workers_stands_above_the_environment_also_for_the_driver_beside(
    handed_on: list[ServiceSettings], tmp_path: Path, command: str, words: tuple[str, ...], workers: int | str
) -> None:
    found = invoke(command, "--state", str(tmp_path), *words)
    assert found.exit_code == 0, found.output
    (settings,) = handed_on
    assert settings.workers == workers
    assert environment_of(settings, os.environ)["GABLEWORK_WORKERS"] == str(workers)


@pytest.mark.parametrize("command", ["serve", "driver"])
@pytest.mark.parametrize("word", ["0", "1025", "-1", "all", "1.5", ""])
def test_numbers_of_workers_that_cannot_be_are_refused_as_option_and_in_the_environment(
    handed_on: list[ServiceSettings], tmp_path: Path, monkeypatch, command: str, word: str
) -> None:
    found = invoke(command, "--state", str(tmp_path), "--workers", word)
    assert found.exit_code == 2
    assert "use auto, or a whole number from 1 to 1024" in found.output
    monkeypatch.setenv("GABLEWORK_WORKERS", word)
    assert invoke(command, "--state", str(tmp_path)).exit_code == 2
    assert handed_on == []


@pytest.mark.parametrize(
    ("reported", "gib", "started"),
    [("auto", 64, 7), (None, 64, 7), ("3", 64, 3), ("auto", 6, 5), ("auto", 1, 2), ("7", 1, 7)],
)
def test_the_embedded_cluster_has_a_worker_per_core_with_memory_for_each_unless_a_number_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reported: str | None, gib: int, started: int
) -> None:
    from service.driver import shared_cluster

    counts: list[int] = []

    class Engine:
        def __init__(self, *, workers: int, **_: object) -> None:
            counts.append(workers)

        def __enter__(self) -> Self:
            return self

    monkeypatch.delenv("GABLEWORK_WORKERS", raising=False)
    if reported is not None:
        monkeypatch.setenv("GABLEWORK_WORKERS", reported)
    monkeypatch.setattr(shared_cluster, "cores", lambda: 7)
    monkeypatch.setattr(shared_cluster, "memory_bytes", lambda: gib * 2**30)
    monkeypatch.setattr(shared_cluster, "Cluster", Engine)
    shared_cluster.SharedCluster(ServiceSettings(state=tmp_path)).engine()
    assert counts == [started]


def test_port_0_takes_a_free_port_and_a_taken_one_is_reported(tmp_path: Path) -> None:
    from service.errors import StartUpError

    first, url = listen(ServiceSettings(state=tmp_path, port=0))
    with first:
        port = first.getsockname()[1]
        assert url == f"http://127.0.0.1:{port}"
        with pytest.raises(StartUpError, match=f"port {port}"):
            listen(ServiceSettings(state=tmp_path, port=port))


def test_a_supervised_process_is_started_again_and_ends_with_its_supervisor() -> None:
    dead: list[str] = []
    # ends by itself when its standard input closes
    supervisor = Supervisor([sys.executable, "-c", "import sys; sys.stdin.read()"], os.environ, dead.append)
    supervisor.start()
    first = supervisor.pid
    assert dead == []
    assert first is not None
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: supervisor.pid != first and supervisor.status() == "running", "another process")
    assert supervisor.deaths == 1
    assert len(dead) == 1
    last = supervisor.pid
    supervisor.end(LONG_S)
    assert supervisor.status() == "ending"
    assert last is not None
    assert not psutil.pid_exists(last)


def test_a_supervised_process_that_does_not_end_is_killed(tmp_path: Path) -> None:
    dead: list[str] = []
    up = tmp_path / "up"
    stubborn = (
        "import pathlib, signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
        f"pathlib.Path({str(up)!r}).touch(); time.sleep(900)"
    )
    supervisor = Supervisor([sys.executable, "-c", stubborn], os.environ, dead.append)
    supervisor.start()
    wait_for(up.exists, "the process ignores SIGTERM")
    supervisor.end(0.2)
    assert len(dead) == 1
    assert supervisor.pid is not None
    assert not psutil.pid_exists(supervisor.pid)


def test_a_supervised_process_is_asked_to_end_once_however_often_that_is_wanted(tmp_path: Path) -> None:
    dead: list[str] = []
    up, asked = tmp_path / "up", tmp_path / "asked"
    counting = (
        "import pathlib, signal\n"
        "signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])\n"
        f"pathlib.Path({str(up)!r}).touch()\n"
        "signal.sigwait([signal.SIGTERM])\n"
        f"pathlib.Path({str(asked)!r}).write_text('once')\n"
        "if signal.sigtimedwait([signal.SIGTERM], 0.5):\n"
        f"    pathlib.Path({str(asked)!r}).write_text('twice')\n"
    )
    supervisor = Supervisor([sys.executable, "-c", counting], os.environ, dead.append)
    supervisor.start()
    wait_for(up.exists, "the process waits for SIGTERM")
    supervisor.ask_to_end()
    wait_for(asked.exists, "the process is asked to end")
    supervisor.end(LONG_S)
    assert asked.read_text() == "once"
    assert dead == []


def test_a_driver_without_a_sign_of_life_is_killed_and_one_with_signs_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor_module, "SILENT_S", 2.0)
    dead: list[str] = []
    frozen, beats = tmp_path / "frozen", tmp_path / "beats"
    # it gives signs until the test wants it to stand still
    living = (
        "import os, pathlib, time\n"
        f"while not pathlib.Path({str(frozen)!r}).exists():\n"
        "    os.write(0, b'.')\n"
        f"    with open({str(beats)!r}, 'a') as stream:\n"
        "        stream.write('.')\n"
        "    time.sleep(0.1)\n"
        "time.sleep(900)\n"
    )
    supervisor = Supervisor([sys.executable, "-c", living], os.environ, dead.append)
    supervisor.start()
    first = supervisor.pid
    # far longer than the silence that is allowed
    wait_for(lambda: beats.exists() and len(beats.read_text()) > 60, "signs of life")
    assert (dead, supervisor.pid) == ([], first)
    frozen.touch()
    wait_for(lambda: dead, "the end of the silent process")
    frozen.unlink()
    wait_for(lambda: supervisor.pid != first and supervisor.status() == "running", "another process")
    supervisor.end(0.1)


# --- keys


def test_keys_are_made_listed_and_revoked(tmp_path: Path) -> None:
    state = ("--state", str(tmp_path / "state"))
    # made by a process of its own, and known to the commands after it
    made = json.loads(gablework("keys", "create", "--name", "a city", "--scope", "read", *state, "--json").stdout)
    assert made["key"].startswith("gw_")
    assert made["scopes"] == ["read"]
    listed = invoke("keys", "list", *state, "--json").stdout
    assert made["key"] not in listed
    assert [key["id"] for key in json.loads(listed)["keys"]] == [made["id"]]
    turned = json.loads(invoke("keys", "rotate", made["id"], "--days", "2", *state, "--json").stdout)
    assert turned["id"] == made["id"]
    assert turned["key"].startswith("gw_")
    assert turned["key"] != made["key"]
    assert turned["oldUntil"] < turned["expires"]
    assert json.loads(invoke("keys", "list", *state, "--json").stdout)["keys"][0]["expires"] == turned["expires"]
    assert invoke("keys", "revoke", made["id"], *state).exit_code == 0
    assert invoke("keys", "rotate", made["id"], *state).exit_code == 2
    assert json.loads(invoke("keys", "list", *state, "--json").stdout)["keys"][0]["revoked"] is not None
    unknown = invoke("keys", "revoke", "0" * 32, *state)
    assert unknown.exit_code == 2
    assert "0" * 32 in unknown.stderr


def test_a_scope_that_is_none_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    found = invoke("keys", "create", "--name", "x", "--scope", "root", "--state", str(tmp_path))
    assert found.exit_code == 2
    assert "read, submit, admin" in found.stderr


def test_serve_refuses_other_addresses_without_keys(tmp_path: Path) -> None:
    found = gablework("serve", "--host", "0.0.0.0", "--port", "0", "--state", str(tmp_path / "state"))
    assert found.returncode == 2
    assert "keys create" in found.stderr
    assert "Traceback" not in found.stderr


def test_faults_of_settings_are_reported_together(tmp_path: Path) -> None:
    environment = os.environ | {"GABLEWORK_MAX_POINTS": "-1", "GABLEWORK_LEASE_S": "soon"}
    found = gablework("serve", "--state", str(tmp_path), env=environment)
    assert found.returncode == 2
    assert "max_points" in found.stderr
    assert "lease_s" in found.stderr


def test_a_signal_before_the_server_listens_to_any_is_not_lost(tmp_path: Path) -> None:
    early = (
        "import os, pathlib, signal, sys\n"
        "from service import supervisor\n"
        "from service.settings import ServiceSettings\n"
        "plain = supervisor._Server.run\n"
        "def run(server, **options):\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    plain(server, **options)\n"
        "supervisor._Server.run = run\n"
        "supervisor.serve(ServiceSettings(state=pathlib.Path(sys.argv[1]), port=0), print, with_driver=False)\n"
    )
    command = [sys.executable, "-c", early, str(tmp_path / "state")]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=LONG_S)
    assert (ended.returncode, ended.stdout) == (0, ""), ended.stderr


def test_limits_that_no_run_takes_are_refused_at_the_start_and_not_by_every_job() -> None:
    assert ServiceSettings(building_memory_bytes=MIN_MEMORY_BYTES).building_memory_bytes == MIN_MEMORY_BYTES
    endless = dict.fromkeys(("building_timeout_s", "lease_s", "poll_s", "upload_days"), math.inf)
    with pytest.raises(ValidationError) as caught:
        ServiceSettings(building_memory_bytes=MIN_MEMORY_BYTES - 1, **endless)
    assert caught.value.error_count() == 5


# --- as processes


@pytest.mark.slow
def test_all_lines_of_a_service_and_its_driver_are_json_where_the_environment_asks(tmp_path: Path) -> None:
    said = tmp_path / "said"
    with said.open("w") as sink:
        command = [sys.executable, "-m", "service.cli", "serve", "--port", "0", "--state", str(tmp_path / "state")]
        env = {**os.environ, "GABLEWORK_LOG_JSON": "1", "GABLEWORK_WORKERS": "1"}
        process = subprocess.Popen(command, env=env, stdout=sink, stderr=sink)
        try:
            wait_for(lambda: "distributed.worker" in said.read_text(), "a worker of the driver")
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(LONG_S)
    lines = [json.loads(line) for line in said.read_text().splitlines()]
    assert {"uvicorn.error", "gablework.driver", "distributed.worker"} <= {line["logger"] for line in lines}
    assert any(line["message"].startswith("gablework listens on http://") for line in lines)


@pytest.mark.slow
def test_serve_answers_and_ends_with_its_driver_on_sigterm(served) -> None:
    running = served()
    driver = running.driver()
    assert httpx.get(f"{running.url}/readyz").json()["checks"]["driver"] == "running"
    service = psutil.Process(running.process.pid)
    wait_for(lambda: driver.nice() > service.nice(), "a driver that lets answers go before models")
    running.process.send_signal(signal.SIGTERM)
    assert running.process.wait(LONG_S) == 0
    assert not driver.is_running()


@pytest.mark.slow
def test_a_driver_that_dies_is_started_again(served) -> None:
    running = served()
    first = running.driver()
    first.kill()
    second = wait_for(lambda: (found := running.driver()).pid != first.pid and found, "another driver")
    assert second.is_running()
    assert httpx.get(f"{running.url}/healthz").status_code == 200


@pytest.mark.slow
def test_a_driver_ends_when_the_service_is_killed(served) -> None:
    running = served()
    driver = running.driver()
    running.process.kill()
    wait_for(lambda: not driver.is_running() or driver.status() == psutil.STATUS_ZOMBIE, "the driver's end")


@pytest.mark.slow
def test_an_event_stream_does_not_hold_up_the_end(served, tmp_path: Path) -> None:
    running = served("--no-driver")
    made = httpx.post(f"{running.url}/jobs", files={"tile": ("a.xyz", POINTS)}, data={"crs": "EPSG:28992"}).json()
    with httpx.stream("GET", f"{running.url}/jobs/{made['jobID']}/events?f=sse", timeout=LONG_S) as stream:
        lines = stream.iter_lines()
        assert any(line.startswith("data:") for line in lines)
        running.process.send_signal(signal.SIGTERM)
        assert list(lines) is not None  # the stream ends of itself
    assert running.process.wait(LONG_S) == 0


@pytest.mark.slow
def test_nothing_is_kept_of_an_upload_whose_client_goes(served, tmp_path: Path) -> None:
    import socket
    from urllib.parse import urlsplit

    running = served("--no-driver")
    uploads = tmp_path / "state" / "uploads"
    with socket.create_connection((urlsplit(running.url).hostname, urlsplit(running.url).port)) as link:
        head = b'--x\r\nContent-Disposition: form-data; name="tile"; filename="a.xyz"\r\n\r\n'
        link.sendall(
            b"POST /jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999999\r\n"
            b"Content-Type: multipart/form-data; boundary=x\r\n\r\n" + head + b"1 2 3\n" * 400_000
        )
        wait_for(lambda: any(uploads.iterdir()), "the beginning of an upload")
    wait_for(lambda: not any(uploads.iterdir()), "the end of the unfinished upload")
    assert httpx.get(f"{running.url}/jobs").json()["jobs"] == []


@pytest.mark.slow
def test_a_path_prefix_is_in_every_link(served, monkeypatch) -> None:
    monkeypatch.setenv("GABLEWORK_ROOT_PATH", "/gable")
    running = served("--no-driver")
    page = httpx.get(f"{running.url}/").json()
    assert all("/gable/" in link["href"] for link in page["links"])
    # what a proxy does: it takes the prefix away
    for link in page["links"]:
        answer = httpx.get(f"{running.url}{link['href'].partition('/gable')[2]}")
        assert answer.status_code == 200, link


def test_every_setting_is_read_somewhere() -> None:
    """One that no line reads has no effect, or its variable is parsed elsewhere by other rules."""
    source = "\n".join(path.read_text() for path in Path(inspect.getfile(ServiceSettings)).parent.rglob("*.py"))
    # those of resources are read by name: `ServiceSettings.resources`
    read = {option.name for option in options_of(ResourceOptions)}
    unread = {name for name in ServiceSettings.model_fields if re.search(rf"\.{name}\b", source) is None}
    assert unread <= read
