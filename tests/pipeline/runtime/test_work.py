"""A work folder: an interrupted run resumes, a later one repeats only what changed, and the results stay the same."""

import dataclasses
import fcntl
import json
import os
import pickle
import shutil
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from pipeline.errors import RunError
from pipeline.export.geoparquet import read_table
from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.cluster.serial_executor import SerialExecutor
from pipeline.runtime.digest import run_digest
from pipeline.runtime.monitoring.measurement import Measured
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run
from pipeline.runtime.run_plan import tiles_per_block
from pipeline.runtime.scratch.work_folder import is_at_work, locked_work
from pipeline.settings import RunSettings
from pipeline.tiling import MM, Tile

STAGES = ("ingest", "split", "reconstruct", "publish")
TILE_M = 40.0


class CountingExecutor(SerialExecutor):
    """Counts the tasks of each stage, and sends each through a pickle."""

    def __init__(self) -> None:
        self.tasks: Counter[str] = Counter()

    def map(
        self, stage: str, function: Callable[[Any], Any], tasks: Sequence[Any], watch: Any
    ) -> Generator[Measured[Any], None, None]:
        for task in tasks:
            if stage not in {"check", "digest"}:  # the first makes nothing, the other is always made
                self.tasks[stage] += 1
            # as to another process
            yield from super().map(stage, function, [pickle.loads(pickle.dumps(task))], watch)


class Place:
    """Inputs that can be changed, a work folder, and runs there."""

    def __init__(self, folder: Path, tiles: Path) -> None:
        self.folder = folder
        self.inputs = folder / "inputs"
        shutil.copytree(tiles, self.inputs)
        self.tasks: Counter[str] = Counter()

    def run(
        self, out: str = "run", work: str | None = "work", settings: dict[str, Any] | None = None, **options: Any
    ) -> RunSummary:
        """Run serially."""
        executor = CountingExecutor()
        request = RunRequest(
            inputs=(str(self.inputs),),
            out=str(self.folder / out),
            settings=RunSettings.from_mapping({"tile_size_m": TILE_M, **(settings or {})}),
            resources=Resources(workers=0, work=None if work is None else str(self.folder / work)),
        )
        try:
            return run(request, executor=executor, **options)
        finally:
            self.tasks = executor.tasks

    def fresh(self, settings: dict[str, Any] | None = None) -> RunSummary:
        """A run of the same inputs that knows nothing of any other."""
        shutil.rmtree(self.folder / "fresh", ignore_errors=True)
        return self.run("fresh", None, settings)

    def run_as_fresh(self, settings: dict[str, Any] | None = None) -> RunSummary:
        """Run in the work folder; the outcome is that of a fresh run."""
        summary = self.run(settings=settings)
        tasks = self.tasks
        assert summary.digest == self.fresh(settings).digest
        assert files_of(self.folder / "run") == files_of(self.folder / "fresh")
        self.tasks = tasks
        return summary

    def change(self, name: str, change: Callable[[laspy.LasData], Any]) -> None:
        """Change the points of one input."""
        path = self.inputs / name
        las = laspy.read(path)
        change(las)
        las.write(path)


@pytest.fixture(scope="module")
def quarters(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small town in four files by place."""
    folder = tmp_path_factory.mktemp("quarters")
    simulate("town", folder.with_name("whole"), 5, size_m=(110.0, 100.0), density_per_m2=3.0)
    las = laspy.read(folder.with_name("whole") / "town.laz")
    east, north = las.x > np.median(las.x), las.y > np.median(las.y)
    for name, chosen in (("sw", ~east & ~north), ("se", east & ~north), ("nw", ~east & north), ("ne", east & north)):
        part = laspy.LasData(las.header)
        part.points = las.points[chosen]
        part.write(folder / f"{name}.laz")
    return folder


@pytest.fixture
def place(quarters: Path, tmp_path: Path) -> Place:
    return Place(tmp_path, quarters)


@dataclasses.dataclass(frozen=True)
class Finished:
    """A place after a whole run, and a copy of it as it was then."""

    place: Place
    aside: Path
    summary: RunSummary
    tasks: Counter[str]


@pytest.fixture(scope="module")
def finished(quarters: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """One run for all tests that begin after one."""
    place = Place(tmp_path_factory.mktemp("finished") / "place", quarters)
    summary = place.run()
    aside = shutil.copytree(place.folder, place.folder.with_name("aside"))
    return Finished(place, aside, summary, place.tasks)


@pytest.fixture
def used(finished: Finished) -> Place:
    """The place where the run was, as the run left it: the same paths and times."""
    shutil.rmtree(finished.place.folder)
    shutil.copytree(finished.aside, finished.place.folder)
    finished.place.tasks = Counter()
    return finished.place


def raised(las: laspy.LasData) -> None:
    """One corner of a file lies 30 cm higher: about one building."""
    corner = (las.x > las.x.max() - 25.0) & (las.y > las.y.max() - 25.0)
    z = np.array(las.z)
    z[corner] += 0.3
    las.z = z


def files_of(run_dir: Path) -> dict[str, bytes]:
    """What a run delivered, but for its manifest."""
    return {
        str(path.relative_to(run_dir)): path.read_bytes()
        for path in sorted(run_dir.rglob("*"))
        if path.is_file() and path.name != "run.json"
    }


def states_of(run_dir: Path) -> dict[str, bytes]:
    """The states of the tiles, which hold the digests of their files."""
    return {path.name: path.read_bytes() for path in (run_dir / "state").iterdir()}


def stop_at(stage: str, done: int) -> Callable[[Event], None]:
    """Interrupts a run when a stage is so far."""

    def on_event(event: Event) -> None:
        if event.kind == "progress" and event.stage == stage and event.done >= done:
            raise KeyboardInterrupt

    return on_event


@pytest.mark.slow
def test_a_run_in_a_work_folder_is_any_run(place: Place) -> None:
    place.run_as_fresh()


def test_a_run_after_a_finished_one_does_nothing_again(used: Place, finished: Finished) -> None:
    first = finished.summary
    assert min(finished.tasks[stage] for stage in STAGES) > 0
    before = files_of(used.folder / "run")
    again = used.run()
    assert not used.tasks
    assert again.digest == first.digest
    assert again.counts["reused"] == again.counts["candidates"]
    assert {**again.counts, "reused": 0} == first.counts
    assert files_of(used.folder / "run") == before


@pytest.mark.parametrize(
    "stage", [pytest.param(stage, marks=[pytest.mark.slow] * (stage != "reconstruct")) for stage in STAGES]
)
def test_a_run_that_was_cut_off_goes_on_where_it_stopped(place: Place, finished: Finished, stage: str) -> None:
    with pytest.raises(KeyboardInterrupt):
        place.run(on_event=stop_at(stage, 2))
    before = place.tasks
    assert json.loads((place.folder / "run" / "run.json").read_text())["status"] == "cancelled"
    assert place.run().digest == finished.summary.digest
    assert before[stage] > 0
    assert before + place.tasks == finished.tasks
    assert files_of(place.folder / "run") == files_of(finished.aside / "run")


def test_what_changed_is_done_again_and_nothing_else(used: Place, finished: Finished) -> None:
    first, whole = finished.summary, finished.tasks
    used.change("sw.laz", raised)
    assert used.run_as_fresh().digest != first.digest
    assert used.tasks["ingest"] == 1
    assert 0 < used.tasks["split"] <= whole["split"]


def test_only_tiles_whose_files_differ_are_published_again(used: Place, finished: Finished) -> None:
    used.change("sw.laz", raised)
    used.run()
    before, after = states_of(finished.aside / "run"), states_of(used.folder / "run")
    differing = [name for name in after if after[name] != before[name]]
    assert 0 < len(differing) == used.tasks["publish"] < len(after)


def test_a_file_that_was_only_touched_costs_its_reading(used: Place, finished: Finished) -> None:
    used.change("ne.laz", len)
    again = used.run()
    assert used.tasks == {"ingest": 1}
    assert again.digest == finished.summary.digest


@pytest.mark.slow
def test_models_of_input_that_did_not_change_are_taken_again(used: Place) -> None:
    used.change("sw.laz", raised)
    again = used.run()
    assert used.tasks["reconstruct"] > 0
    remade = again.counts["candidates"] - again.counts["reused"]
    assert 0 < remade < again.counts["candidates"] / 2
    assert used.run().counts["reused"] == again.counts["candidates"]


@pytest.mark.slow
def test_a_file_that_is_gone_and_one_that_is_new(used: Place, finished: Finished) -> None:
    (used.inputs / "nw.laz").rename(used.folder / "nw.laz")
    used.run_as_fresh()
    (used.folder / "nw.laz").rename(used.inputs / "nw.laz")
    assert used.run().digest == finished.summary.digest
    assert files_of(used.folder / "run") == files_of(finished.aside / "run")


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {"candidates": {"min_area_m2": 30.0}},
        {"method": "kmeans"},
        {"tile_size_m": 60.0},
        {"lods": "1.2,2.2"},
    ],
)
def test_other_settings_are_another_result(used: Place, settings: dict[str, Any]) -> None:
    used.run_as_fresh(settings)


def test_classes_that_are_no_longer_believed_give_other_sites(place: Place) -> None:
    def classified(las: laspy.LasData) -> None:
        """Every second building is classified as one, the others as trees."""
        height, number = np.array(las.z) - np.array(las.z).min(), np.array(las.x) // 20 + np.array(las.y) // 20
        las.classification = np.where(height < 1.5, 2, np.where(number % 2, 6, 5)).astype(np.uint8)

    for name in ("sw", "se", "nw", "ne"):
        place.change(f"{name}.laz", classified)
    trusted = place.run_as_fresh({"classes": "trust"})
    ignored = place.run_as_fresh({"classes": "ignore"})
    assert ignored.digest != trusted.digest
    assert place.run_as_fresh({"classes": "trust"}).digest == trusted.digest


def test_what_a_rerun_changed_is_published_again(used: Place, finished: Finished) -> None:
    before, digest = files_of(used.folder / "run"), finished.summary.digest
    name = read_table(str(used.folder / "run"), "buildings")["building_id"][0].as_py()
    overrides = used.folder / "overrides.toml"
    overrides.write_text(f'[[building]]\nbuilding_id = "{name}"\naction = "reject"\n')
    request = RerunRequest(run_dir=str(used.folder / "run"), overrides=str(overrides), resources=Resources(workers=0))
    assert rerun(request).digest != digest
    again = used.run()
    assert again.digest == run_digest(str(used.folder / "run")) == digest
    assert used.tasks == {"publish": 1}
    assert files_of(used.folder / "run") == before


@pytest.mark.slow
def test_another_run_directory_is_published_without_modelling_again(used: Place, finished: Finished) -> None:
    second = used.run("second")
    assert set(used.tasks) == {"publish"}
    assert second.digest == finished.summary.digest
    assert files_of(used.folder / "second") == files_of(used.folder / "run")


def test_what_a_user_removed_from_the_run_directory_is_published_again(used: Place, finished: Finished) -> None:
    before = files_of(used.folder / "run")
    shutil.rmtree(used.folder / "run" / "state")
    shutil.rmtree(used.folder / "run" / "buildings")
    assert used.run().digest == finished.summary.digest
    assert set(used.tasks) == {"publish"}
    assert files_of(used.folder / "run") == before


@pytest.mark.slow
def test_what_a_task_left_half_done_is_no_result(place: Place, finished: Finished) -> None:
    with pytest.raises(KeyboardInterrupt):
        place.run(on_event=stop_at("ingest", 2))
    scratch = place.folder / "work" / "scratch"
    bucket = next((scratch / "points").glob("*/*.bin"))
    (bucket.parent / f"{'0' * 16}.bin").write_bytes(bucket.read_bytes())
    (bucket.parent / f"{'1' * 16}.{'2' * 32}.part").write_bytes(bucket.read_bytes())
    assert place.run().digest == finished.summary.digest


def cut(path: Path) -> None:
    """Only the first half of a file reached the disk."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def emptied(path: Path) -> None:
    """Nothing of it did."""
    path.write_bytes(b"")


def zeroed(path: Path) -> None:
    """The file has its length, and the second half is zeros."""
    content = path.read_bytes()
    half = len(content) // 2
    path.write_bytes(content[:half] + bytes(len(content) - half))


def flipped(path: Path) -> None:
    """One bit of the last byte is wrong."""
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))


TEARS = [cut, emptied, zeroed, flipped, Path.unlink]


def torn(folder: Path, pattern: str, tear: Callable[[Path], object], number: int = 0) -> Path:
    """Tear one of the files of a pattern, empty ones apart; its path."""
    path = sorted(path for path in folder.glob(pattern) if path.stat().st_size)[number]
    before = path.read_bytes() if path.is_file() else b""
    tear(path)
    assert not path.is_file() or path.read_bytes() != before
    return path


def has_warned(summary: RunSummary, where: str) -> bool:
    """Whether a run said that something stored was damaged, and its task ran again."""
    return any("were damaged and are made again" in line and where in line for line in summary.warnings)


@pytest.mark.parametrize("tear", TEARS)
def test_a_torn_outcome_or_published_file_costs_its_task(
    used: Place, finished: Finished, tear: Callable[[Path], object]
) -> None:
    kept, run_dir = used.folder / "work" / "scratch" / "kept", used.folder / "run"
    for stage in ("ingest", "cells", "ground", "tiles", "units", "join"):
        torn(kept, f"{stage}/*/*", tear)
    tiles = {torn(kept, "publish-*/*/*", tear, 1).parent.name}
    tiles.add(torn(run_dir, "state/*.json", tear, 2).stem)
    for number, table in enumerate(("buildings", "planes", "rejected", "decisions", "cityjson")):
        tiles.add(torn(run_dir, f"{table}/*/*", tear, number % 3 + 2).parent.name.removeprefix("tile="))
    tiles.add(torn(run_dir, "meshes/*/*", tear, 5).parent.name)
    torn(run_dir, "run.json", tear)
    torn(used.folder / "work", "work.json", tear)
    again = used.run()
    assert again.digest == finished.summary.digest
    found = {"ingest": 1, "cells": 1, "ground": 1, "split": 1, "join": 1, "outline": 1}
    assert used.tasks == {**found, "publish": len(tiles)}
    assert files_of(run_dir) == files_of(finished.aside / "run")
    assert has_warned(again, "publish")
    assert used.run().digest == again.digest
    assert not used.tasks


@pytest.mark.parametrize("tear", TEARS)
def test_a_torn_file_of_points_or_terrain_costs_its_task_where_it_is_read(
    used: Place, finished: Finished, tear: Callable[[Path], object]
) -> None:
    scratch = used.folder / "work" / "scratch"
    arrays = ("cells/*/states", "cells/*/lowest", "ground/*/terrain", "ground/*/corner")
    files = [torn(scratch, f"{name}.npy", tear, 2 * k) for k, name in enumerate(arrays)]
    files += [torn(scratch, "points/*/*.bin", tear, 5), torn(scratch, "units/*/*/*/points.npy", tear)]
    used.run()
    assert not used.tasks  # nothing reads them
    for path in scratch.glob("kept/models-*/*/*"):
        path.unlink()
    used.tasks.clear()
    again = used.run()
    whole = finished.tasks
    assert again.digest == finished.summary.digest
    side = tiles_per_block(round(TILE_M * MM))
    torn_ground = [Tile.from_key(path.parent.name) for path in files[2:4]]
    blocks = {(tile.column // side, tile.row // side) for tile in torn_ground}
    repaired = {"ingest": 1, "cells": 2, "ground": len(blocks), "outline": 1}
    assert used.tasks == {"reconstruct": whole["reconstruct"], **repaired}
    assert has_warned(again, "")
    # the sorted points of a tile are read where units are divided
    files.append(max(scratch.glob("tiles/*/points.npy"), key=lambda path: path.stat().st_size))
    tear(files[-1])
    units = [*scratch.glob("kept/units/*/*")]
    for path in units:
        path.unlink()
    used.tasks.clear()
    assert used.run().digest == finished.summary.digest
    assert used.tasks == {"split": 1, "outline": len(units)}
    for path in files:
        assert path.read_bytes() == (finished.aside / path.relative_to(used.folder)).read_bytes()


@pytest.mark.parametrize("tear", [flipped, zeroed])
def test_a_torn_batch_of_models_is_made_again_where_it_is_published(
    used: Place, finished: Finished, tear: Callable[[Path], object]
) -> None:
    path = torn(used.folder / "work" / "scratch" / "kept", "models-*/*/*", tear, 1)
    shutil.rmtree(used.folder / "run" / "state")
    again = used.run()
    assert again.digest == finished.summary.digest
    assert used.tasks == {"reconstruct": 1, "publish": finished.tasks["publish"]}
    assert has_warned(again, path.parent.name)


def test_a_check_whether_a_folder_is_locked_refuses_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with locked_work(str(tmp_path / "work")):
        pass
    asking = os.open(tmp_path / "work" / "lock", os.O_RDWR)
    fcntl.flock(asking, fcntl.LOCK_SH)
    monkeypatch.setattr("time.sleep", lambda _: fcntl.flock(asking, fcntl.LOCK_UN))
    with locked_work(str(tmp_path / "work")):
        assert is_at_work(str(tmp_path / "work"))
    os.close(asking)


def test_two_runs_do_not_work_in_one_folder(place: Place) -> None:
    with locked_work(str(place.folder / "work")):
        assert is_at_work(str(place.folder / "work"))
        with pytest.raises(RunError, match=r"at work already \(process \d+ on "):
            place.run()
    assert not is_at_work(str(place.folder / "work"))
    place.run()


def test_a_folder_of_other_things_is_no_work_folder(place: Place) -> None:
    with pytest.raises(RunError, match="is no work folder"):
        place.run(work="inputs")


def test_tasks_of_a_driver_that_died_write_nothing_any_more(tmp_path: Path) -> None:
    with locked_work(str(tmp_path / "work")) as late:
        pass
    assert not late.cancelled
    with locked_work(str(tmp_path / "work")) as now:
        assert late.cancelled
        assert not now.cancelled
