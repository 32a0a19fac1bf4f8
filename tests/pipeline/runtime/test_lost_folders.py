"""A folder that is removed while a run works in it is named by an error; it never reads as a cancelled run."""

import json
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.batch.batch_file import read_batch
from pipeline.batch.batch_run import run_batch
from pipeline.batch.batch_status import read_status
from pipeline.errors import FolderLostError, InputError, RunCancelledError, RunOverError
from pipeline.extras.classify.classify import ClassifyRequest, classify
from pipeline.runtime.cluster.local_executor import LocalExecutor
from pipeline.runtime.manifest import RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.folder_lock import locked_results
from pipeline.settings import RunSettings

STAGES = ("ingest", "ground", "split", "join", "reconstruct", "publish")

Start = Callable[..., RunSummary]


@pytest.fixture
def start(suburb: Path, tmp_path: Path) -> Start:
    """Run the suburb into `tmp_path/run`, in tiles of 40 m, with its scratch in a folder of `tmp_path`."""

    def go(place: str = "run", **options: object) -> RunSummary:
        folder = {place: str(tmp_path / place)} if place != "run" else {}
        request = RunRequest(
            inputs=(str(suburb),),
            out=str(tmp_path / "run"),
            settings=RunSettings.from_mapping({"tile_size_m": 40.0}),
            resources=Resources(workers=0, **folder),
            overwrite=True,
        )
        return run(request, **options)

    return go


class Once:
    """Does something when a stage begins, the first time."""

    def __init__(self, stage: str, act: Callable[[], object], kind: str = "stage") -> None:
        self._wanted, self._act, self.done = (stage, kind), act, False

    def __call__(self, event: Event) -> None:
        """Listen."""
        if not self.done and (event.stage, event.kind) == self._wanted:
            self.done = True
            self._act()


def removal(folder: Path) -> Callable[[], None]:
    return lambda: shutil.rmtree(folder)


@pytest.mark.parametrize(
    ("place", "stage"), [*(("work", stage) for stage in STAGES), ("run", "split"), ("scratch", "split")]
)
def test_scratch_that_is_removed_is_named_whatever_the_stage(
    start: Start, tmp_path: Path, place: str, stage: str
) -> None:
    listener = Once(stage, removal(tmp_path / place))
    with pytest.raises(FolderLostError, match=rf"{place}/.*was removed while the run was going") as caught:
        start(place, on_event=listener)
    assert listener.done
    assert str(tmp_path / place) in str(caught.value)
    manifest = read_manifest(tmp_path / "run")
    assert manifest.status is RunStatus.FAILED
    assert "was removed while the run was going" in manifest.warnings[-1]


def test_a_work_folder_that_another_run_took_is_named(start: Start, tmp_path: Path) -> None:
    def take_over() -> None:
        shutil.rmtree(tmp_path / "work")
        Scratch(str(tmp_path / "work" / "scratch"), attempt="other").create()

    with pytest.raises(FolderLostError, match="work/scratch was changed while the run was going, by another run"):
        start("work", on_event=Once("split", take_over))
    assert read_manifest(tmp_path / "run").status is RunStatus.FAILED


@pytest.mark.slow
def test_a_run_directory_that_is_removed_never_ends_as_a_finished_run(start: Start, tmp_path: Path) -> None:
    listener = Once("publish", removal(tmp_path / "run"), kind="progress")
    with pytest.raises(FolderLostError, match="run was removed while the run was going, with what had been written"):
        start("work", on_event=listener)
    assert read_manifest(tmp_path / "run").status is RunStatus.FAILED
    shutil.rmtree(tmp_path / "run")
    # what the work folder knows of the lost files does not count
    assert start("work").digest
    assert list((tmp_path / "run" / "state").iterdir())


@pytest.mark.parametrize("place", ["work", "scratch"])
def test_a_fault_and_a_cancellation_keep_their_names(start: Start, tmp_path: Path, place: str) -> None:
    def fail() -> None:
        raise InputError("a.laz", "it broke", "Mend it")

    with pytest.raises(InputError, match="it broke"):
        start(place, on_event=Once("split", fail))
    asked = threading.Event()
    listener = Once("split", lambda: asked.wait(60.0))  # the run may be over before it asks again

    def cancelled() -> bool:
        if listener.done:
            asked.set()
        return listener.done

    with pytest.raises(RunCancelledError):
        start(place, on_event=listener, cancelled=cancelled)
    assert read_manifest(tmp_path / "run").status is RunStatus.CANCELLED


def test_a_task_knows_only_that_its_run_is_over(tmp_path: Path) -> None:
    for scratch in (Scratch(str(tmp_path / "a")), Scratch(str(tmp_path / "b"), attempt="mine")):
        scratch.create()
        scratch.check_cancelled()
        shutil.rmtree(scratch.root)
        with pytest.raises(RunOverError, match="it was cancelled, or the folder was removed"):
            scratch.check_cancelled()


def test_results_are_the_same_folder_only_if_no_one_replaced_it(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with locked_results(str(folder)) as check:
        check()
        folder.rename(tmp_path / "elsewhere")
        with pytest.raises(FolderLostError, match="was removed"):
            check()
        folder.mkdir()
        with pytest.raises(FolderLostError, match="was removed"):
            check()


def test_classify_names_its_scratch_too(suburb: Path, tmp_path: Path) -> None:
    request = ClassifyRequest(
        inputs=(str(suburb),),
        out=str(tmp_path / "out"),
        settings=RunSettings.from_mapping({"classes": "ignore"}),
        resources=Resources(workers=0),
    )
    with pytest.raises(FolderLostError, match=r"out/.*was removed while the run was going"):
        classify(request, Once("split", removal(tmp_path / "out")))


@pytest.fixture
def batch_file(suburb: Path, tmp_path: Path) -> Path:
    path = tmp_path / "batch.toml"
    content = {"inputs": {"paths": [str(suburb)]}, "output": {"path": "run"}, "work": {"path": "work"}}
    lines = [
        f"[{table}]\n" + "".join(f"{k} = {json.dumps(v)}\n" for k, v in rows.items()) for table, rows in content.items()
    ]
    path.write_text("\n".join([*lines, "[cluster]\nworkers = 0\n", "[settings]\ntile_size_m = 40.0\n"]))
    return path


@pytest.mark.slow
def test_a_batch_whose_work_folder_is_removed_has_failed_and_runs_again(batch_file: Path, tmp_path: Path) -> None:
    with pytest.raises(FolderLostError, match="work/scratch was removed while the run was going"):
        run_batch(read_batch(batch_file), Once("reconstruct", removal(tmp_path / "work")))
    # the folder was made again for the status
    status = read_status(str(tmp_path / "work"))
    assert status.state == "failed"
    assert "work/scratch was removed while the run was going" in status.message
    assert run_batch(read_batch(batch_file)).is_complete


@pytest.mark.slow
@pytest.mark.parametrize("place", ["work", "scratch"])
def test_a_child_process_that_finds_no_scratch_first_does_not_hide_it(start: Start, tmp_path: Path, place: str) -> None:
    # the driver only waits for results here, so its children are the first to miss the folder
    listener = Once("reconstruct", removal(tmp_path / place))
    with pytest.raises(FolderLostError, match="was removed while the run was going"):
        start(place, on_event=listener, executor=LocalExecutor(2))
    assert listener.done
    assert read_manifest(tmp_path / "run").status is RunStatus.FAILED
