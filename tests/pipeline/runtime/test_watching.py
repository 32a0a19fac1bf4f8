"""Figures, log lines and the page about the workers' time say what happened, with ids, and stay bounded."""

import io
import json
import logging
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import chores
import httpx
import pytest
import typer
from processes import free_port
from prometheus_client import CollectorRegistry, generate_latest

from pipeline.console import Console
from pipeline.errors import RunCancelledError, RunError, SettingsError
from pipeline.runtime.cluster.dask_executor import Cluster
from pipeline.runtime.cluster.performance_report import BINS, ROWS, PerformanceReport
from pipeline.runtime.cluster.run_metrics import RunMetrics, TallyMetrics, combined, serve_metrics
from pipeline.runtime.engine import executor_for
from pipeline.runtime.monitoring import log_lines, logs
from pipeline.runtime.monitoring.measurement import TALLIES, Measured, Tallies, measure
from pipeline.runtime.monitoring.progress import Event, Watch
from pipeline.runtime.resources import Resources
from pipeline.runtime.scratch.folder import Scratch
from pipeline.tiling import Tile


def shown(registry: CollectorRegistry) -> dict[str, float]:
    """All figures by name and labels."""
    lines = [line for line in generate_latest(registry).decode().splitlines() if not line.startswith("#")]
    return {line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in lines}


# --- figures ---------------------------------------------------------------------------------------------------------


def test_events_of_a_run_become_figures() -> None:
    registry = CollectorRegistry()
    now_s = [100.0]
    metrics = RunMetrics(registry, clock=lambda: now_s[0])
    heard: list[Event] = []
    tell = combined(metrics, heard.append)
    tell(Event(kind="stage", stage="split", total=400))
    tell(Event(kind="progress", stage="split", done=400, total=400))
    tell(Event(kind="stage", stage="reconstruct", total=20_000))
    now_s[0] = 160.0
    tell(Event(kind="progress", stage="reconstruct", done=500, total=20_000, failed=3))
    tell(Event(kind="warning", stage="reconstruct", message="odd"))
    found = shown(registry)
    units = {name: value for name, value in found.items() if name.startswith("gablework_run_units")}
    assert units == {
        'gablework_run_units{stage="split",state="done",unit="tiles"}': 400,
        'gablework_run_units{stage="split",state="failed",unit="tiles"}': 0,
        'gablework_run_units{stage="split",state="queued",unit="tiles"}': 0,
        'gablework_run_units{stage="reconstruct",state="done",unit="buildings"}': 500,
        'gablework_run_units{stage="reconstruct",state="failed",unit="buildings"}': 3,
        'gablework_run_units{stage="reconstruct",state="queued",unit="buildings"}': 19_500,
    }
    assert [name for name, value in found.items() if name.startswith("gablework_run_stage") and value] == [
        'gablework_run_stage{stage="reconstruct"}'
    ]
    assert (found["gablework_run_warnings_total"], found["gablework_run_waiting"]) == (1, 0)
    assert found["gablework_run_last_event_timestamp_seconds"] == 160.0
    tell(Event(kind="waiting", stage="reconstruct", message="no worker"))
    assert shown(registry)["gablework_run_waiting"] == 1
    tell(Event(kind="finished"))
    over = shown(registry)
    assert (over["gablework_run_finished"], over["gablework_run_waiting"]) == (1, 0)
    assert over['gablework_run_stage{stage="reconstruct"}'] == 0
    assert len(heard) == 7
    metrics.close()
    assert shown(registry) == {}


def test_what_a_process_sent_and_worked_off_become_figures() -> None:
    tallies, registry = Tallies(), CollectorRegistry()
    registry.register(TallyMetrics(tallies))
    for _ in range(3):
        tallies.send("split", 1, 100)
    tallies.land("split", "done", 1)
    tallies.begin()
    tallies.end("ingest", "failed", 2.5)
    tallies.begin()
    tallies.building("failed", "crashed")
    tallies.building("ok", None)
    found = shown(registry)
    assert found['gablework_tasks_in_flight{stage="split"}'] == 2
    assert found['gablework_task_bytes_sent_total{stage="split"}'] == 300
    assert found['gablework_tasks_landed_total{outcome="done",stage="split"}'] == 1
    assert found['gablework_tasks_worked_total{outcome="failed",stage="ingest"}'] == 1
    assert found['gablework_task_seconds_total{stage="ingest"}'] == 2.5
    assert found["gablework_tasks_running"] == 1
    assert found['gablework_buildings_total{reason="crashed",status="failed"}'] == 1
    assert found['gablework_buildings_total{reason="",status="ok"}'] == 1
    assert found["gablework_peak_memory_bytes"] > 2**20


def test_figures_are_served_and_a_taken_port_is_refused() -> None:
    port = free_port()
    end = serve_metrics(port)
    try:
        page = httpx.get(f"http://127.0.0.1:{port}/metrics", timeout=60.0).text
        assert "gablework_tasks_running" in page
        assert "process_resident_memory_bytes" in page
        with pytest.raises(SettingsError, match=rf"127\.0\.0\.1:{port}: .*in use; use another port"):
            serve_metrics(port)
    finally:
        end()
    serve_metrics(port)()


# --- log lines -------------------------------------------------------------------------------------------------------


@pytest.fixture
def lines() -> Iterator[io.StringIO]:
    """What the loggers of gablework write, as JSON."""
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(log_lines.formatter(as_json=True))
    logger = logging.getLogger("gablework")
    before, level = list(logger.handlers), logger.level
    logger.handlers = [handler]
    logger.setLevel(logging.INFO)
    yield stream
    logger.handlers = before
    logger.setLevel(level)


def logged(lines: io.StringIO) -> list[dict[str, object]]:
    return [json.loads(line) for line in lines.getvalue().splitlines()]


def test_a_task_that_fails_logs_its_run_stage_and_tile(lines: io.StringIO) -> None:
    task = SimpleNamespace(scratch=Scratch("/runs/one/.scratch/ab12"), tile=Tile(85, 447))
    before = dict(TALLIES.worked)

    def broken(given: object) -> None:
        logs.LOG.info("from deep inside", extra={"building": "b1"})
        raise ZeroDivisionError(f"of {given is task}")

    with pytest.raises(ZeroDivisionError):
        measure(broken, task, "split")
    ids = {"run": "ab12", "stage": "split", "tile": "x85_y447"}
    inside, failed = logged(lines)
    assert inside.items() >= {**ids, "building": "b1", "level": "info", "message": "from deep inside"}.items()
    assert failed.items() >= {**ids, "level": "error", "message": "the task failed"}.items()
    assert "ZeroDivisionError: of True" in str(failed["exception"])
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT[\d:.]+\+00:00", str(failed["at"]))
    assert TALLIES.worked["split", "failed"] == before.get(("split", "failed"), 0) + 1
    # nothing sticks to the thread
    logs.LOG.info("later")
    assert set(logged(lines)[-1]) == {"at", "level", "logger", "message"}


def test_a_fault_of_the_input_has_no_traceback_and_a_run_that_is_cancelled_no_line(lines: io.StringIO) -> None:
    for error in (RunError("disk full: make room"), RunCancelledError("cancelled")):

        def broken(_: object, error: Exception = error) -> None:
            raise error

        with pytest.raises(type(error)):
            measure(broken, None, "publish")
    (line,) = logged(lines)
    assert line["message"] == "the task failed: disk full: make room"
    assert "exception" not in line


def test_a_command_logs_its_events_as_json_lines_where_the_environment_asks(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(logs.VARIABLE, "1")
    logger = logging.getLogger("gablework")
    before, propagates = list(logger.handlers), logger.propagate
    try:
        with Console() as console, logs.about(run="ab12"):
            console.on_event(Event(kind="stage", stage="split", total=4))
            console.on_event(Event(kind="warning", stage="split", message="odd"))
    finally:
        logger.handlers, logger.propagate = before, propagates
    begun, odd = (json.loads(line) for line in capsys.readouterr().err.splitlines())
    assert begun.items() >= {"level": "info", "run": "ab12", "stage": "split", "done": 0, "total": 4}.items()
    assert odd.items() >= {"level": "warning", "run": "ab12", "stage": "split", "message": "odd"}.items()
    monkeypatch.setenv(logs.VARIABLE, "perhaps")
    with pytest.raises(SettingsError, match="GABLEWORK_LOG_JSON is 'perhaps': use 1 or 0"):
        logs.wants_json()


SPEAKS = """
import logging, threading, warnings
from pipeline.runtime.isolation.start_up import start_own_process

start_own_process()
warnings.warn("odd")
import distributed

logging.getLogger("distributed.client").error("the connection broke")
logging.getLogger("distributed.scheduler").info("State start")
logging.getLogger("gablework.run").info("ours")
thread = threading.Thread(target=lambda: 1 / 0, name="adder")
thread.start()
thread.join()
raise KeyError("lost")
"""


def test_all_output_of_a_process_is_json_also_lines_of_libraries_and_uncaught_exceptions() -> None:
    environment = {**os.environ, logs.VARIABLE: "1"}
    ended = subprocess.run([sys.executable, "-c", SPEAKS], env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    odd, broke, ours, thread, lost = (json.loads(line) for line in ended.stderr.splitlines())
    assert (odd["logger"], broke["logger"], ours["logger"]) == ("py.warnings", "distributed.client", "gablework.run")
    assert broke["message"] == "the connection broke"
    assert "adder ended with an exception: division by zero" in thread["message"]
    assert "ZeroDivisionError" in thread["exception"]
    assert "KeyError: 'lost'" in lost["exception"]


def test_a_failing_command_reports_it_in_json_and_restores_the_loggers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(logs.VARIABLE, "1")
    root, hook = logging.getLogger(), sys.excepthook
    before = list(root.handlers)

    def serve() -> None:
        with Console() as console:
            logging.getLogger("a.library").warning("a line of a library")
            console.status("listening")
            raise ZeroDivisionError("by nought")

    with pytest.raises(typer.Exit):
        serve()
    assert (root.handlers, sys.excepthook) == (before, hook)
    said = capsys.readouterr()
    library, listening, fault = (json.loads(line) for line in said.err.splitlines())
    assert (said.out, listening["message"]) == ("", "listening")
    assert library["logger"] == "a.library"
    assert (fault["level"], fault["message"]) == ("error", "by nought")
    assert "ZeroDivisionError: by nought" in fault["exception"]


# --- the page about the workers' time --------------------------------------------------------------------------------


def took(seconds: float, began_s: float, process: str = "host:1") -> Measured[int]:
    return Measured(result=0, seconds=seconds, cpu_s=seconds, process=process, peak_bytes=2**28, began_s=began_s)


def test_the_page_lists_stages_processes_and_the_longest_tasks(tmp_path: Path) -> None:
    now_s = [1000.0]
    path = tmp_path / "time.html"
    with PerformanceReport(str(path), clock=lambda: now_s[0]) as report:
        report.add("split", took(6.0, 1000.0))
        report.add("split", took(2.0, 1000.0, "host:2"))
        report.add("<script>", took(2.0, 1006.0))
        now_s[0] = 1010.0
    page = path.read_text()
    assert report.efficiency == pytest.approx(0.5)
    assert "3 tasks on 2 processes, which were busy 50 % of the time" in page
    assert "<td>split</td><td>2</td><td>8.0</td><td>4.000</td><td>6.00</td>" in page
    assert "<td>host:1</td><td>2</td><td>8.0</td><td>80</td><td>256</td>" in page
    assert "<script>" not in page
    assert page.count("<svg") == 2
    assert [p.name for p in tmp_path.iterdir()] == ["time.html"]


def test_the_page_stays_bounded_and_loses_no_second(tmp_path: Path) -> None:
    report = PerformanceReport(str(tmp_path / "time.html"), clock=lambda: 0.0)
    for k in range(20_000):
        report.add("reconstruct", took(1.5, float(k), f"host:{k % 300}"))
    report.add("publish", took(1.0, -5.0))
    assert sum(report._by_stage["reconstruct"]) == pytest.approx(30_000.0)
    assert {len(bins) for bins in report._by_stage.values()} == {BINS}
    assert len(report._by_process) == ROWS
    assert len(report.page()) < 2_000_000


def test_the_page_is_written_also_where_the_run_breaks_off(tmp_path: Path) -> None:
    path = tmp_path / "time.html"
    with pytest.raises(ZeroDivisionError), PerformanceReport(str(path)):
        raise ZeroDivisionError
    assert "No task was finished" in path.read_text()


def test_an_unusable_place_for_the_page_is_refused_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="make the folder"):
        Cluster(scheduler="tcp://127.0.0.1:9").executor(performance_report=str(tmp_path / "none" / "time.html"))
    with pytest.raises(SettingsError, match="this run has none: use --workers 1"):
        executor_for(Resources(workers=0, performance_report=str(tmp_path / "time.html")), local_directory="")


def test_a_run_on_workers_leaves_the_page_and_its_tallies(tmp_path: Path) -> None:
    path = tmp_path / "time.html"
    before = TALLIES.sent["double"]
    with Cluster(workers=1) as cluster, cluster.executor(performance_report=str(path)) as executor:
        measured = list(executor.map("double", chores.double, range(20), Watch()))
    assert all(one.began_s > 1e9 for one in measured)
    assert TALLIES.sent["double"] - before == 20
    assert TALLIES.in_flight["double"] == 0
    assert "<td>double</td><td>20</td>" in path.read_text()
