"""A run that is cancelled ends soon and leaves nothing; tasks may die half way, run twice, or come too late."""

import json
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import RunCancelledError
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.manifest import RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.measurement import Measured, measure
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import RunSummary, run
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import run_and_store
from pipeline.settings import RunSettings

STAGES = ("ingest", "split", "reconstruct", "publish")


class RecordingExecutor(SerialExecutor):
    """Keeps the tasks of every stage."""

    def __init__(self) -> None:
        self.tasks: dict[str, list[Any]] = {}

    def map(
        self, stage: str, function: Callable[[Any], Any], tasks: Sequence[Any], watch: Any
    ) -> Generator[Measured[Any], None, None]:
        """As the serial executor does."""
        self.tasks[stage] = list(tasks)
        yield from super().map(stage, function, tasks, watch)


class KilledError(BaseException):
    """Stands for the death of a process: nothing in the pipeline catches it."""


class Deaths:
    """Makes the n-th file that a thread completes its last: what it was about to rename stays under its other name."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._left = threading.local()
        rename = Path.replace

        def replace(path: Path, target: Any) -> Path:
            left = getattr(self._left, "count", None)
            if left == 0:
                raise KilledError
            if left is not None:
                self._left.count = left - 1
            return rename(path, target)

        monkeypatch.setattr(Path, "replace", replace)

    def run(self, function: Callable[[Any], Any], task: Any, files: int) -> bool:
        """Whether the task died before it had completed more than so many files."""
        self._left.count = files
        try:
            function(task)
        except KilledError:
            return True
        else:
            return False
        finally:
            self._left.count = None


class ClumsyExecutor(SerialExecutor):
    """Runs every task until it dies at its first file, at its second, and so on; then twice at the same time."""

    def __init__(self, deaths: Deaths) -> None:
        self._deaths = deaths
        self.died: dict[str, int] = dict.fromkeys(STAGES, 0)

    def map(
        self, stage: str, function: Callable[[Any], Any], tasks: Sequence[Any], watch: Any
    ) -> Generator[Measured[Any], None, None]:
        """The first of two results."""
        del watch
        for task in tasks:
            files = 0
            while self._deaths.run(function, task, files):
                self.died[stage] = self.died.get(stage, 0) + 1
                files += 1 + files // 3
            with ThreadPoolExecutor(2) as threads:
                ways = [threads.submit(measure, function, task) for _ in range(2)]
            yield ways[0].result()


Start = Callable[..., RunSummary]
Tasks = dict[str, list[Any]]


@pytest.fixture
def start(suburb: Path, tmp_path: Path) -> Start:
    """Run the suburb serially into `tmp_path/run`, in tiles of 40 m."""

    def go(out: str = "run", **options: Any) -> RunSummary:
        settings = RunSettings.from_mapping({"tile_size_m": 40.0})
        place = {"inputs": (str(suburb),), "out": str(tmp_path / out), "overwrite": True}
        return run(RunRequest(**place, settings=settings, resources=SERIAL), **options)

    return go


def files_below(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def results_of(folder: Path) -> dict[str, bytes]:
    return {name: content for name, content in files_below(folder).items() if name != "run.json"}


# --- cancelled ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stage", STAGES)
def test_a_run_is_cancelled_in_any_stage(
    stage: str, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reached = threading.Event()
    marked = threading.Event()
    real = Scratch.cancel

    def cancel(scratch: Scratch) -> None:
        real(scratch)
        marked.set()

    def on_event(event: Event) -> None:
        if event.kind == "stage" and event.stage == stage:
            reached.set()
            # the watching thread marks the scratch before the stage's first task begins
            assert marked.wait(60.0)

    monkeypatch.setattr(Scratch, "cancel", cancel)
    with pytest.raises(RunCancelledError):
        start(on_event=on_event, cancelled=reached.is_set)
    manifest = read_manifest(tmp_path / "run")
    assert manifest.status is RunStatus.CANCELLED
    assert any("RunCancelledError" in warning for warning in manifest.warnings)
    assert "scratch" not in {path.name.lstrip(".").split(".")[0] for path in (tmp_path / "run").iterdir()}


def test_a_run_that_was_cancelled_can_be_started_again(start: Start) -> None:
    whole = start("whole")
    with pytest.raises(RunCancelledError):
        start(cancelled=lambda: True)
    assert start().digest == whole.digest


def test_an_interrupt_from_the_keyboard_is_a_cancelled_run(start: Start, tmp_path: Path) -> None:
    def on_event(event: Event) -> None:
        if event.kind == "progress" and event.stage == "split":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        start(on_event=on_event)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "cancelled"
    assert not (tmp_path / "run" / "scratch").exists()


def test_a_listener_that_fails_fails_the_run(start: Start, tmp_path: Path) -> None:
    def on_event(event: Event) -> None:
        if event.stage == "reconstruct":
            raise LookupError("the job is another driver's")

    with pytest.raises(LookupError):
        start(on_event=on_event)
    assert read_manifest(tmp_path / "run").status is RunStatus.FAILED


# --- tasks that come too late ----------------------------------------------------------------------------------------


@pytest.fixture
def late(start: Start) -> Tasks:
    """The tasks of a run that is over."""
    executor = RecordingExecutor()
    start(executor=executor)
    return executor.tasks


def test_no_late_task_changes_a_run_that_is_over(late: Tasks, tmp_path: Path) -> None:
    before = files_below(tmp_path / "run")
    for stage, tasks in late.items():
        for task in tasks if stage != "digest" else ():  # which leaves nothing
            with pytest.raises((RunCancelledError, FileNotFoundError)):
                run_and_store(task)
    assert files_below(tmp_path / "run") == before


def test_a_late_task_does_not_meet_the_scratch_of_the_next_run(late: Tasks, start: Start) -> None:
    refused = []

    def on_event(event: Event) -> None:
        if event.kind == "stage" and event.stage == "reconstruct":
            for task in late["ingest"]:
                with pytest.raises(RunCancelledError):
                    run_and_store(task)
                refused.append(task)

    digest = start("other").digest
    assert start(on_event=on_event).digest == digest
    assert refused


def test_scratch_that_is_gone_is_not_made_again(tmp_path: Path) -> None:
    scratch = Scratch(str(tmp_path / "scratch"))
    scratch.create()
    assert scratch.path("points", "tile", "0.bin").parent.is_dir()
    (tmp_path / "scratch").rename(tmp_path / "gone")
    assert scratch.cancelled
    scratch.cancel()
    with pytest.raises(RunCancelledError, match="is gone"):
        scratch.path("points", "tile", "1.bin")
    with pytest.raises(RunCancelledError):
        scratch.put_bytes("kept/models/x0_y0/0", b"")
    assert not (tmp_path / "scratch").exists()


# --- tasks that die half way, and tasks that run twice ---------------------------------------------------------------


@pytest.mark.slow
def test_tasks_that_died_half_way_and_tasks_that_run_twice_at_once_change_nothing(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = start("whole")
    clumsy = ClumsyExecutor(Deaths(monkeypatch))
    hurt = start("hurt", executor=clumsy)
    assert all(clumsy.died.values()), clumsy.died
    assert hurt.digest == whole.digest
    assert hurt.statuses == whole.statuses
    assert hurt.counts == whole.counts
    leftover = {name for name in results_of(tmp_path / "hurt") if ".part" in name}
    ours = {name: content for name, content in results_of(tmp_path / "hurt").items() if name not in leftover}
    assert ours.keys() == results_of(tmp_path / "whole").keys()
